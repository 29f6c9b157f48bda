"""Claims about the scripts from cameras and films to an epipolar pair, on films whose distortion is a formula."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from cosp.epipolar.rectification import Rectification
from cosp.geometry.grids import PixelGrid
from cosp.io import rasters, records
from tests.epipolar.pairs import distorted_pair, film_grid

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
Y_PARALLAX = {
    "spacing_px": 16,
    "fewest_nodes": 1,
    "template_px": 32,
    "least_score": 0.6,
    "largest_ratio": 0.85,
    "smoothing_nodes": 2.0,
    "fewest_matches": 100,
}
RECTIFY = {
    "reference_dem_heights": "ellipsoidal",
    "degree_along": 9,
    "degree_across": 3,
    "total_degree": 0,
    "height_margin_m": 300.0,
    "disparity_margin_px": 4.0,
    "area_margin_px": 8,
    "correction_spacing_px": 16,
    "y_parallax": Y_PARALLAX,
    "threads": 1,
}


def function(name):
    return runpy.run_path(str(SCRIPTS / f"{name}.py"))[name]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Cameras, films and a level reference DEM as files."""
    folder = tmp_path_factory.mktemp("pair")
    cameras, _, films = distorted_pair()
    for look, camera, film in zip(("fore", "aft"), cameras, films, strict=True):
        records.write(folder / f"{look}.json", camera)
        rasters.write(folder / f"{look}.tif", film, grid=film_grid(camera), crs=rasters.FILM_CRS)
    lonlat = cameras[0].locate_geodetic(film_grid(cameras[0]).points([0, 0, 380, 380], [0, 480, 0, 480]), 1200.0)
    grid = PixelGrid.covering((*(lonlat[:, :2].min(0) - 0.1), *(lonlat[:, :2].max(0) + 0.1)), 0.01)
    level = np.full(grid.shape, 1200.0, np.float32)
    rasters.write(folder / "reference.tif", level, grid=grid, crs="EPSG:4326")
    return folder


def rectify(folder, name, **choices):
    function("rectify")(
        *(folder / f"{look}.json" for look in ("fore", "aft")),
        *(folder / f"{look}.tif" for look in ("fore", "aft")),
        folder / "reference.tif",
        None,
        folder / name,
        **{**RECTIFY, **choices},
    )
    return records.read(folder / name, Rectification)


def test_polynomials_have_their_high_degree_along_the_film(folder):
    rectification = rectify(folder, "plain.json", correction_spacing_px=0)
    assert rectification.fore.rows.shape == (4, 10)  # across the film, along it
    assert rectification.model_largest_px < 1e-3
    assert rectification.aft.correction is None


def test_the_polynomials_of_the_literature_can_be_chosen(folder):
    rectification = rectify(folder, "total.json", correction_spacing_px=0, total_degree=4)
    assert rectification.fore.rows.shape == (5, 5)
    assert np.count_nonzero(rectification.aft.rows) == 15


def test_what_the_films_show_across_the_rows_is_taken_out(folder):
    rectify(folder, "rectification.json")
    function("resample_epipolar")(
        *(folder / f"{look}.tif" for look in ("fore", "aft")),
        folder / "rectification.json",
        folder / "fore_epipolar.tif",
        folder / "aft_epipolar.tif",
        interpolation="cubic",
        threads=1,
    )
    function("measure_y_parallax")(
        folder / "fore_epipolar.tif",
        folder / "aft_epipolar.tif",
        folder / "rectification.json",
        folder / "y_parallax.tif",
        folder / "y_parallax.json",
        **Y_PARALLAX,
        threads=1,
    )
    summary = records.read_json(folder / "y_parallax.json")
    assert summary["count"] > 300
    assert abs(summary["median_px"]) < 0.03
    assert summary["nmad_px"] < 0.1
    assert summary["share_within_1_px"] > 0.99
