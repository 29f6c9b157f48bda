"""Distortion taken out of an image puts everything where the camera imaged it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.camera.field import FilmField
from cosp.camera.ideal_film import measured_window, without_field
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window, tiles

GRID = PixelGrid(-40.0, 15.0, 0.1, -0.1, (300, 800))


@pytest.fixture(scope="module")
def field():
    flat = FilmField.flat(half_length_mm=40.0, half_width_mm=15.0, knots_along_mm=20.0, knots_across_mm=15.0)
    return flat.with_coefficients(np.random.default_rng(3).normal(0.0, 0.2, (*flat.shape, 2)))


def pattern(film_mm):
    """Smooth grey values of film points as the camera images them."""
    x, y = film_mm[..., 0], film_mm[..., 1]
    return 128.0 + 60.0 * np.sin(x / 0.9) + 50.0 * np.cos(y / 1.1 + x / 5.0)


@pytest.fixture(scope="module")
def measured(field):
    return np.rint(pattern(field.corrected(GRID.centres()))).astype(np.uint8)


def ideal(field, measured, window):
    return without_field(field, GRID, window, measured[measured_window(field, GRID, window).slices])


def test_what_the_camera_imaged_is_where_it_imaged_it(field, measured):
    wanted = pattern(GRID.centres())
    found = ideal(field, measured, Window(0, 300, 0, 800)).astype(float)
    inner = (slice(10, -10), slice(10, -10))
    assert np.abs(found - wanted)[inner].max() < 2.0
    # The distortion is there to be taken out.
    assert np.abs(measured - wanted)[inner].max() > 15.0


def test_tiles_join_to_what_the_whole_gives(field, measured):
    whole = ideal(field, measured, Window(0, 300, 0, 800))
    joined = np.empty_like(whole)
    for window in tiles(GRID.shape, 128):
        joined[window.slices] = ideal(field, measured, window)
    # Interpolation knows places to 1/32 px, counted from the window: single greys are rounded the other way.
    difference = np.abs(joined.astype(int) - whole)
    assert difference.max() <= 1
    assert difference.mean() < 1e-3


def test_the_window_that_is_read_reaches_as_far_as_the_distortion(field):
    window = Window(100, 150, 200, 300)
    source = measured_window(field, GRID, window)
    places = GRID.window(100, 150, 200, 300).centres()
    rows, columns = GRID.pixels(field.distorted(places))
    assert source.row0 <= rows.min() - 2
    assert source.row1 >= rows.max() + 3
    assert source.column0 <= columns.min() - 2
    assert source.column1 >= columns.max() + 3


def test_no_distortion_leaves_the_image_as_it_is(measured):
    flat = FilmField.flat(half_length_mm=40.0, half_width_mm=15.0, knots_along_mm=20.0, knots_across_mm=15.0)
    assert_allclose(ideal(flat, measured, Window(3, 200, 5, 700)), measured[3:200, 5:700])
