"""Sampling between pixels, against the function that was sampled."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from cosp.imaging.resampling import block_extremes, block_mean, pyramid, sample, upsample_grid


def waves(rows, columns):
    return np.float32(100 + 40 * np.sin(np.asarray(rows) / 5) * np.cos(np.asarray(columns) / 7))


@pytest.fixture
def image():
    return waves(np.arange(80)[:, None], np.arange(120)[None, :])


# OpenCV's cubic kernel sharpens (a = -0.75) and is off on parabolas; its Lanczos rounds places to 1/32 px.
@pytest.mark.parametrize(("interpolation", "bound"), [("linear", 0.3), ("cubic", 0.45), ("lanczos", 0.25)])
def test_values_between_pixels_are_those_of_the_function(image, interpolation, bound):
    rng = np.random.default_rng(0)
    rows, columns = rng.uniform(5, 74, 5000), rng.uniform(5, 114, 5000)
    found = sample(image, rows, columns, interpolation=interpolation)
    assert np.abs(found - waves(rows, columns)).max() < bound


def test_integers_are_pixel_centres(image):
    assert_allclose(sample(image, np.array([3.0, 79.0]), np.array([4.0, 119.0])), [image[3, 4], image[79, 119]])


def test_outside_is_the_border_value(image):
    found = sample(image, np.array([-1.0, 40.0, np.nan]), np.array([10.0, 120.0, 5.0]), border=-5)
    assert_allclose(found, -5)


def test_long_images_are_cut_as_needed():
    film = np.arange(70_000, dtype=np.float32)[None].repeat(4, 0)
    columns = np.array([[10.5, 69_990.25], [40_000.0, 35_000.5]])
    assert_allclose(sample(film, np.ones((2, 2)), columns, interpolation="linear"), columns, atol=0.02)


def test_block_means_are_means():
    blocks = block_mean(np.arange(24, dtype=np.float32).reshape(4, 6), 2)
    assert_allclose(blocks, [[3.5, 5.5, 7.5], [15.5, 17.5, 19.5]])


def test_a_level_of_the_pyramid_lies_on_every_second_pixel(image):
    assert_allclose(pyramid(image, 1)[1][10:30, 10:50], image[20:60:2, 20:100:2], atol=3.0)


def test_a_coarse_grid_is_bilinear_between_nodes_and_constant_beyond():
    grid = np.array([[0.0, 2.0], [4.0, 6.0]], np.float32)
    found = upsample_grid(grid, np.array([[0.5, -3.0]]), np.array([[0.5, 9.0]]))
    assert_allclose(found, [[3.0, 2.0]], atol=0.05)


def test_extremes_of_blocks_are_of_what_is_given_also_at_ragged_edges():
    values = np.arange(35, dtype=np.float32).reshape(5, 7)
    values[0, 0] = values[2:4, 2:4] = np.nan
    lowest, highest = block_extremes(values, 2)
    assert_array_equal(lowest, [[1, 2, 4, 6], [14, np.nan, 18, 20], [28, 30, 32, 34]])
    assert_array_equal(highest, [[8, 10, 12, 13], [22, np.nan, 26, 27], [29, 31, 33, 34]])
    same = block_extremes(values, 1)
    assert_array_equal(same, [values, values])
