import geopandas as gpd
import numpy as np
import pytest
from shapely.geometry import Point

from cosp import sheets
from cosp.errors import InputError
from cosp.io import gcps

SCENE = "DS1104-2169DF092"
HEADER = "scene,x_mm,y_mm,longitude_deg,latitude_deg"


def written(tmp_path, *lines, name="points.csv"):
    path = tmp_path / name
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_a_sheet_with_the_needed_columns_is_enough(tmp_path):
    table = gcps.read(written(tmp_path, HEADER, "# by hand", f"{SCENE}, -120.5, 3.25, 98.1, 44.2"))
    assert table.iloc[0, :5].tolist() == [SCENE, -120.5, 3.25, 98.1, 44.2]
    assert table["sigma_px"].tolist() == [1.0]
    assert table[["height_m", "sigma_ground_m", "sigma_height_m"]].isna().all(axis=None)


def test_points_of_a_geopackage_come_in_any_system(tmp_path):
    features = gpd.GeoDataFrame(
        {"scene": [SCENE], "x_mm": [1.0], "y_mm": [2.0], "height_m": [812.5]},
        geometry=[Point(500000.0, 4871985.0)],
        crs="EPSG:32647",
    )
    features.to_file(tmp_path / "points.gpkg", driver="GPKG")
    table = gcps.read(tmp_path / "points.gpkg")
    np.testing.assert_allclose(table[["longitude_deg", "latitude_deg"]].to_numpy(), [[99.0, 44.0]], atol=5e-3)
    assert table["height_m"].tolist() == [812.5]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([HEADER.replace("x_mm,", ""), f"{SCENE},1,98,44"], "no column x_mm"),
        ([HEADER, f"{SCENE},1,2,98,144"], "row 2, column latitude_deg: found .*144.*expected a number from -90 to 90"),
        ([HEADER, f"{SCENE},1,2,98,44", f"{SCENE},one,2,98,44"], "row 3, column x_mm: found 'one'"),
        ([HEADER, f"{SCENE},1,,98,44"], "row 2, column y_mm"),
        ([HEADER + ",sigma_px", f"{SCENE},1,2,98,44,0"], "column sigma_px: .*above 0"),
        ([HEADER + ",height_m", f"{SCENE},1,2,98,44,high"], "column height_m: found 'high'"),
        ([HEADER], "no point"),
    ],
)
def test_what_is_wrong_is_named_by_row_and_column(tmp_path, lines, message):
    with pytest.raises(InputError, match=message):
        gcps.read(written(tmp_path, *lines))


def test_a_file_that_is_no_table_of_points_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match="nothing.csv"):
        gcps.read(tmp_path / "nothing.csv")
    with pytest.raises(InputError, match="broken.gpkg"):
        gcps.read(written(tmp_path, "no", name="broken.gpkg"))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (f"{SCENE},1,2,98,44", None),
        (f"{SCENE},1,2,98,144", "row 2, column latitude_deg"),
        (
            "DS1104-2169DF099,1,2,98,44",
            f"points of DS1104-2169DF099; expected points of scenes of this site: .*{SCENE}",
        ),
    ],
)
def test_own_points_are_checked_before_any_job(tmp_path, line, message):
    written(tmp_path, HEADER, line)
    (tmp_path / "dem.tif").touch()
    columns = ["scene", "site", "parts", *sheets.CORNER_COLUMNS]
    corners = {"nw": (44.3, 97.0), "ne": (44.1, 99.0), "se": (43.9, 99.0), "sw": (44.1, 97.0)}
    cells = [str(value) for corner in sheets.CORNERS for value in corners[corner]]
    rows = [[scene, "site", "scans", *cells] for scene in (SCENE, "DS1104-2169DA098")]
    written(tmp_path, *("\t".join(row) for row in [columns, *rows]), name="scenes.tsv")
    settings = {"scenes": "scenes.tsv", "sites": {"site": {"reference_dem": "dem.tif", "gcps": "points.csv"}}}
    if message is None:
        assert sheets.load(settings, folder=tmp_path).settings["sites"]["site"]["gcps"] == "points.csv"
    else:
        with pytest.raises(sheets.FaultySheets, match=message):
            sheets.load(settings, folder=tmp_path)
