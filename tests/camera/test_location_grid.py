"""Location grids: exact at their nodes, as good as was asked for between them."""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.testing import assert_allclose

from cosp.camera.location_grid import location_grid, residuals_px
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from tests.authorities.parameter_table import pair

GRID = PixelGrid(-350.0, 27.0, 0.056, -0.056, (240, 900))  # the end of a film, where its rays turn fastest
HEIGHTS_M = (100.0, 4200.0)
CAMERA = pair("1117")[0]


@cache
def made(camera=CAMERA, step_mm=0.4):
    return location_grid(camera, GRID, heights_m=HEIGHTS_M, step_mm=step_mm, height_step_m=1000.0)


def points(count=1000):
    rng = np.random.default_rng(1)
    places = rng.uniform(-0.5, 0.5 + np.array(GRID.shape) - 1.0, (count, 2))
    return GRID.points(places[:, 0], places[:, 1]), rng.uniform(*HEIGHTS_M, count)


def test_nodes_are_where_the_camera_looks_and_cover_the_image():
    grid = made()
    levels, _, rows, columns = grid.lonlat_deg.shape
    assert grid.step_px == (7, 7)
    assert (rows - 1) * 7 >= GRID.shape[0]
    assert (columns - 1) * 7 >= GRID.shape[1]
    assert levels == 6
    assert_allclose(np.diff(grid.heights_m), 820.0)
    # Node (3, 5) lies 21 rows and 35 columns from the corner of the image, half a pixel before the first centre.
    there = CAMERA.locate_geodetic(GRID.points(21 - 0.5, 35 - 0.5), float(grid.heights_m[2]))
    assert_allclose(grid.lonlat_deg[2, :, 3, 5], there[:2], atol=1e-12)


def test_between_nodes_the_grid_is_good_to_a_fiftieth_of_a_pixel_of_7_um():
    left = np.abs(residuals_px(made(), CAMERA, GRID, *points()))
    assert 0.001 < left.max() * 8 < 0.02


def test_the_error_grows_with_the_square_of_the_step():
    fine, coarse = (np.abs(residuals_px(made(step_mm=step), CAMERA, GRID, *points())).max() for step in (1.12, 4.48))
    assert 12.0 < coarse / fine < 18.0


def test_bands_come_height_by_height_and_say_so():
    grid = made()
    tags = grid.tags()
    assert tags["REF"] == "EPSG:4326"
    assert float(tags["ALTITUDE_B4"]) == float(tags["ALTITUDE_B5"]) == grid.heights_m[2]
    assert_allclose(grid.bands()[4:6], grid.lonlat_deg[2])


def test_longitudes_do_not_jump_at_the_date_line():
    shifted = replace(CAMERA, origin=LocalFrame(180.0, CAMERA.origin.latitude_deg))
    grid = made(shifted)
    assert np.ptp(grid.lonlat_deg[:, 0]) < 5.0
    assert np.abs(residuals_px(grid, shifted, GRID, *points())).max() < 0.02
