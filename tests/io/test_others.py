"""Tables, polygons, geoids, logs."""

import time

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.io import heights, logs, tables, vectors


def test_a_table_survives_its_file(tmp_path):
    table = pd.DataFrame({"x_mm": [1.5, 2.5], "role": ["control", "check"]})
    tables.write(tmp_path / "t.parquet", table)
    pd.testing.assert_frame_equal(tables.read(tmp_path / "t.parquet"), table)


def test_a_broken_table_is_named(tmp_path):
    (tmp_path / "t.parquet").write_text("no")
    with pytest.raises(InputError, match=r"t\.parquet"):
        tables.read(tmp_path / "t.parquet")


def test_polygons_of_another_reference_system_fall_where_they_should(tmp_path):
    square = gpd.GeoDataFrame(geometry=[shapely.box(600_020, 5_199_900, 600_050, 5_199_950)], crs="EPSG:32632")
    square.to_crs("EPSG:4326").to_file(tmp_path / "glacier.geojson")
    grid = PixelGrid.covering((600_000, 5_199_800, 600_100, 5_200_000), 10.0)
    mask = vectors.rasterise(tmp_path / "glacier.geojson", grid, "EPSG:32632")
    rows, columns = np.nonzero(mask)
    assert (columns.min(), columns.max()) in {(2, 4), (1, 5), (2, 5), (1, 4)}
    assert abs(mask.sum() - 15) <= 20
    assert mask[7, 3]


def test_polygons_written_twice_are_the_same_bytes(tmp_path):
    square = gpd.GeoDataFrame(geometry=[shapely.box(600_020, 5_199_900, 600_050, 5_199_950)], crs="EPSG:32632")
    for name in ("a.gpkg", "b.gpkg"):
        vectors.write(tmp_path / name, square, "lake")
        time.sleep(1.1)  # the format's clock has seconds
    assert (tmp_path / "a.gpkg").read_bytes() == (tmp_path / "b.gpkg").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.gpkg", "b.gpkg"]


def test_no_polygons_is_an_error_that_names_the_file(tmp_path):
    with pytest.raises(InputError, match=r"none\.gpkg"):
        vectors.read(tmp_path / "none.gpkg", "EPSG:32632")


@pytest.mark.parametrize(("longitude", "latitude", "expected"), [(0.0, 0.0, 17.16), (86.925, 27.988, -28.7)])
def test_the_geoid_has_its_published_height(longitude, latitude, expected):
    """EGM96 is 17.16 m at 0 N 0 E and about -28.7 m at Mount Everest."""
    assert heights.undulation_at(np.array([longitude, latitude]), "egm96") == pytest.approx(expected, abs=0.5)


def test_ellipsoidal_heights_have_no_undulation():
    assert heights.undulation(PixelGrid(0, 0, 10, -10, (3, 4)), "EPSG:32632", "ellipsoidal").max() == 0


def test_the_coarse_undulation_grid_agrees_with_the_points():
    grid = PixelGrid.covering((600_000, 5_190_000, 620_000, 5_200_000), 500.0)
    from pyproj import Transformer

    found = heights.undulation(grid, "EPSG:32632", "egm96")
    centres = grid.centres()
    lonlat = np.stack(
        Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform(centres[..., 0], centres[..., 1]), -1
    )
    np.testing.assert_allclose(found, heights.undulation_at(lonlat, "egm96"), atol=0.05)


def test_a_failure_leaves_its_traceback_in_the_log(tmp_path, capsys):
    def fail():
        with logs.log_to(tmp_path / "job.log"):
            raise InputError("part_a.tif: no such file")

    with pytest.raises(InputError):
        fail()
    text = (tmp_path / "job.log").read_text()
    assert "Traceback" in text
    assert "part_a.tif: no such file" in text
    assert "part_a.tif: no such file" in capsys.readouterr().err
