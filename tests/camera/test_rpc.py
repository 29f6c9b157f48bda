"""Rational polynomials against the camera they were fitted to, by our own evaluation and by GDAL's."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose
from rasterio.transform import RPCTransformer

from cosp.camera.exits import film_lattice
from cosp.camera.rpc import fit_pieces, fit_rpc, residuals_px
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters, views
from tests.authorities.parameter_table import PIXEL_MM, pair

GRID = PixelGrid(-357.3, 27.699, PIXEL_MM, -PIXEL_MM, (7915, 102100))
QUARTER = GRID.window(0, 7915, 51050, 76575)
HEIGHTS_M = (0.0, 5000.0)


def points(grid, count=800, seed=0):
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.5, 0.5 + np.array(grid.shape) - 1.0, (count, 2))
    return grid.points(places[:, 0], places[:, 1]), rng.uniform(*HEIGHTS_M, count)


def cameras():
    """Fore and aft, nodding and compensated by the lens."""
    for camera in pair("1117"):
        yield camera
        yield replace(camera, imc_factor=0.0145, angles_change_deg=(0.0, *camera.angles_change_deg[1:]))


@pytest.mark.parametrize("number", range(4))
def test_pieces_of_a_film_do_what_the_camera_does_to_a_fiftieth_of_a_pixel(number):
    camera = list(cameras())[number]
    pieces = fit_pieces(camera, GRID, heights_m=HEIGHTS_M, pieces=4, largest_px=0.02)
    assert 4 <= len(pieces) <= 6
    assert [window.column0 for window, _, _ in pieces[1:]] == [window.column1 for window, _, _ in pieces[:-1]]
    assert (pieces[0][0].column0, pieces[-1][0].column1) == (0, GRID.shape[1])
    for window, rpc, residual in pieces:
        part = GRID.window(window.row0, window.row1, window.column0, window.column1)
        # Places that neither the fit nor its residual knows.
        left = np.abs(residuals_px(rpc, camera, part, *points(part)))
        assert left.max() < 0.022
        assert residual.rms_px < residual.largest_px <= 0.02


def test_a_whole_film_is_too_much_for_one_set_of_coefficients():
    camera = pair("1117")[0]
    whole = fit_rpc(camera, GRID, heights_m=HEIGHTS_M)
    assert np.abs(residuals_px(whole, camera, GRID, *points(GRID))).max() > 1.0


def test_no_denominator_vanishes_within_an_image():
    # With the smallest ridge alone some halves have a strip that is wrong by pixels and more.
    fore = pair("1112")[0]
    for camera in (*cameras(), fore, replace(fore, imc_factor=0.0145, angles_change_deg=(0.0, -0.04, 0.0))):
        for start in (0, 51050):
            half = GRID.window(0, 7915, start, start + 51050)
            rpc = fit_rpc(camera, half, heights_m=(0.0, 6000.0))
            left = residuals_px(rpc, camera, half, *film_lattice(half, (0.0, 6000.0), (80, 15, 5)))
            assert np.abs(left).max() < 1.0


def test_gdal_finds_the_same_pixels_as_the_camera(tmp_path):
    camera = pair("1112")[0]
    coarse = PixelGrid(-1.0, 27.0, 0.7, -0.7, (78, 250))
    rpc = fit_rpc(camera, coarse, heights_m=HEIGHTS_M)
    rasters.write(tmp_path / "film.tif", np.ones((78, 400), np.uint8), grid=coarse, crs=rasters.FILM_CRS, nodata=0)
    views.write(tmp_path / "part.vrt", tmp_path / "film.tif", Window(0, 78, 0, 250), metadata={"RPC": rpc.metadata()})
    rasters.write(tmp_path / "part.tif", np.ones((78, 250), np.uint8), grid=PixelGrid(0.5, 0.5, 1, 1, (78, 250)))
    (tmp_path / "part_RPC.TXT").write_text(rpc.text(), encoding="utf-8")

    film_mm, height_m = points(coarse, 200)
    rows, columns = coarse.pixels(film_mm)
    lonlat = camera.locate_geodetic(film_mm, height_m)[:, :2]
    for name in ("part.vrt", "part.tif"):
        with rasters._quiet(), rasterio.open(tmp_path / name) as image, RPCTransformer(image.rpcs) as gdal:
            assert image.crs is None
            assert image.transform.is_identity
            found = gdal.rowcol(lonlat[:, 0], lonlat[:, 1], zs=height_m, op=lambda x: x)
        # GDAL counts from the corner of the first pixel.
        assert_allclose(np.array(found[0]) - 0.5, rows, atol=1e-3)
        assert_allclose(np.array(found[1]) - 0.5, columns, atol=1e-3)


def test_a_film_across_the_date_line_has_coefficients_as_any_other():
    camera = pair("1117")[0]
    shifted = replace(camera, origin=LocalFrame(180.0, camera.origin.latitude_deg))
    assert np.ptp(shifted.locate_geodetic(points(QUARTER)[0], 0.0)[:, 0]) > 300.0
    rpc = fit_rpc(shifted, QUARTER, heights_m=HEIGHTS_M)
    assert np.abs(residuals_px(rpc, shifted, QUARTER, *points(QUARTER))).max() < 0.05
    assert rpc.ground_scale[0] < 2.0
