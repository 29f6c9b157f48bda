"""Control from a draft elevation model: wrong cameras in, ground points that the true ones see where the films do."""

import numpy as np
import pytest

from cosp import sheets
from cosp.imaging.windows import Window
from cosp.io import rasters, records, tables
from cosp.matching.ground import grown, map_bounds
from scripts.match_dem import match_dem

from .conftest import CRS, make_camera, moved
from .test_relief import mountains

PIXEL_MM = 0.14


def choices(section):
    """Of a rule, as the config has them."""
    filled = sheets.fill_defaults(sheets.schema("config"), {"sites": {"here": {"reference_dem": "dem.tif"}}})
    return filled[section]


def run(folder, films, cameras):
    for name, film in films.items():
        whole = Window(0, film.grid.shape[0], 0, film.grid.shape[1])
        rasters.write(folder / f"{name}.tif", film.read(whole), grid=film.grid, crs=rasters.FILM_CRS)
        records.write(folder / f"{name}.json", cameras[name])
    match_dem(
        [folder / f"{name}.tif" for name in films],
        [folder / f"{name}.json" for name in films],
        folder / "dem.tif",
        None,
        folder / "gcps.parquet",
        folder / "summary.json",
        folder / "figure.png",
        pair="the_pair",
        reference_dem_heights="ellipsoidal",
        **choices("match_dem"),
        rectify=choices("rectify"),
        y_parallax=choices("measure_y_parallax"),
        dense=choices("match_dense"),
        triangulate=choices("triangulate"),
        grid_dem=choices("grid_dem"),
        threads=1,
    )
    return tables.read(folder / "gcps.parquet"), records.read_json(folder / "summary.json")


@pytest.mark.slow
def test_both_films_gain_control_that_the_true_cameras_agree_with(tmp_path):
    rng = np.random.default_rng(6)
    true = {look: make_camera(look, half_length_mm=110.0) for look in ("fore", "aft")}
    bounds = np.array([map_bounds(camera, CRS, (0.0, 3500.0)) for camera in true.values()])
    world = mountains(grown((*bounds[:, :2].min(axis=0), *bounds[:, 2:].max(axis=0)), 6000.0), rng)
    noisy = world.heights + 2.5 * rng.standard_normal(world.heights.shape).astype(np.float32)
    rasters.write(tmp_path / "dem.tif", noisy, grid=world.grid, crs=CRS)
    films = {look: world.expose(camera, rng=rng, pixel_mm=PIXEL_MM) for look, camera in true.items()}
    first = {look: moved(camera, 60.0, -45.0) for look, camera in true.items()}
    gcps, summary = run(tmp_path, films, first)

    assert summary["tiles"]["kept"] >= 8
    assert (tmp_path / "figure.png").stat().st_size > 10_000
    for camera in true.values():
        mine = gcps[gcps.scene == camera.scene]
        assert len(mine) >= 8
        ground = camera.origin.local_from_geodetic(mine[["longitude_deg", "latitude_deg", "height_m"]].to_numpy())
        off_px = (camera.project(ground) - mine[["x_mm", "y_mm"]].to_numpy()) / PIXEL_MM
        first_px = (first[_look(camera)].project(ground) - mine[["x_mm", "y_mm"]].to_numpy()) / PIXEL_MM
        assert np.median(np.linalg.norm(first_px, axis=1)) > 1.2
        assert np.median(np.linalg.norm(off_px, axis=1)) < 0.4
        ratio = off_px / mine[["sigma_x_px", "sigma_y_px"]].to_numpy()
        assert 0.2 < np.sqrt(np.mean(ratio**2)) < 1.5

    # Films that show nothing give none, and say why.
    blank = {
        look: type(film)(film.grid, lambda window: np.full(window.shape, 90, np.uint8)) for look, film in films.items()
    }
    gcps, summary = run(tmp_path, blank, first)
    assert len(gcps) == 0
    assert "y-parallax" in summary["reason"]


def _look(camera):
    return "fore" if "DF" in camera.scene else "aft"
