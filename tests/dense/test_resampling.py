import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from cosp.dense.resampling import (
    SmoothField,
    continue_beyond_edges,
    fill_holes,
    median_of_given,
    picture_pyramid,
    prior_of,
    resample_right,
)
from cosp.imaging.windows import Window


def no_y_parallax():
    return SmoothField(np.zeros((1, 1), np.float32), 0, 0, 1, 1)


def test_resampling_reads_the_right_picture_one_disparity_and_one_y_parallax_further():
    rows, columns = np.mgrid[:60, :90]
    right = (rows + 2 * columns).astype(np.uint8)
    prior = np.full((20, 30), 7, np.float32)
    field = SmoothField(np.array([[3.0, 3.0], [5.0, 5.0]], np.float32), 10, 0, 20, 80)  # three px at row 10, five at 30
    found = resample_right(right, prior, 10, 20, y_parallax=field, level=0)
    expected = (10 + np.arange(20)) + 3 + 0.1 * np.arange(20)
    assert_allclose(found, expected[:, None] + 2 * (27 + np.arange(30)), atol=0.55)  # grey values are whole numbers


def test_y_parallax_shrinks_with_the_level_of_the_pyramid():
    rows, _ = np.mgrid[:60, :90]
    field = SmoothField(np.full((2, 2), 8, np.float32), 0, 0, 100, 100)
    found = resample_right((4 * rows).astype(np.uint8), np.zeros((20, 30), np.float32), 5, 0, y_parallax=field, level=2)
    assert_array_equal(found[:, 0], 4 * (5 + np.arange(20) + 2))


def test_beyond_the_right_picture_there_is_no_data():
    right = np.full((20, 50), 9, np.uint8)
    away = np.full((20, 30), 1000, np.float32)
    assert not resample_right(right, away, 0, 0, y_parallax=no_y_parallax(), level=0).any()
    half = resample_right(right, np.full((20, 30), 35, np.float32), 0, 0, y_parallax=no_y_parallax(), level=0)
    assert_array_equal(half[0] > 0, np.arange(30) + 35 < 50)


def test_filling_keeps_what_is_given_and_bridges_a_slope():
    rows, columns = np.mgrid[:64, :64]
    plane = (0.5 * rows + 0.25 * columns).astype(np.float32)
    holed = plane.copy()
    holed[20:30, 25:40] = np.nan
    filled = fill_holes(holed)
    given = ~np.isnan(holed)
    assert_array_equal(filled[given], plane[given])
    assert np.abs(filled - plane)[~given].max() < 2.5  # the hole spans 5 px of disparity down and 4 across


def test_a_map_without_any_disparity_cannot_be_filled():
    with pytest.raises(ValueError, match="no value"):
        fill_holes(np.full((4, 4), np.nan, np.float32))


def test_beyond_the_outermost_matches_a_row_goes_on_as_it_slopes_there():
    rows, columns = np.mgrid[:6, :120]
    slope = 0.25 * columns - 3.0 * rows
    disparity = slope.astype(np.float32)
    disparity[:, :40] = disparity[:, 100:] = disparity[2, 60:64] = np.nan
    disparity[4] = np.nan
    disparity[4, 50:55] = 7.0  # too few to say how they slope
    disparity[5, 40:] *= 8.0  # steeper than ground is
    given = disparity.copy()
    continue_beyond_edges(disparity)
    known = ~np.isnan(given)
    assert_array_equal(disparity[known], given[known])
    assert_array_equal(np.isnan(disparity[2, 60:64]), True)
    for row in (0, 1, 2, 3):
        assert_allclose(disparity[row, 28:40], slope[row, 28:40], atol=1e-4)
        assert_allclose(disparity[row, 100:112], slope[row, 100:112], atol=1e-4)
        assert_allclose(disparity[row, :28], slope[row, 28], atol=1e-4)
        assert_allclose(disparity[row, 112:], slope[row, 111], atol=1e-4)
    assert_array_equal(disparity[4], given[4])
    assert_allclose(np.diff(disparity[5, 28:40]), 0.6, atol=1e-4)


def test_the_median_removes_single_outliers_and_leaves_holes():
    disparity = np.full((20, 20), 3, np.float32)
    disparity[5, 5] = 40
    disparity[12, 12] = np.nan
    expected = np.full((20, 20), 3, np.float32)
    expected[12, 12] = np.nan
    assert_array_equal(median_of_given(disparity), expected)


def test_a_prior_doubles_in_number_and_in_size():
    rows, columns = np.mgrid[:40, :50]
    coarse = (2 + 0.1 * rows + 0.2 * columns).astype(np.float32)
    prior = prior_of(coarse, Window(20, 50, 30, 70), finer=True, otherwise=0.0)
    rows, columns = np.mgrid[20:50, 30:70]
    assert_allclose(prior, 2 * (2 + 0.1 * rows / 2 + 0.2 * columns / 2), atol=1e-4)


def test_a_pyramid_takes_no_grey_from_where_there_is_no_data():
    picture = np.full((64, 64), 100, np.uint8)
    picture[:, 31:] = 0
    for level in picture_pyramid(picture, 3)[1:]:
        assert set(np.unique(level)) <= {0, 99, 100, 101}
        assert (level == 0).mean() == pytest.approx(0.5, abs=0.15)
