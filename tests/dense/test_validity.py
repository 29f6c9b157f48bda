import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy import ndimage

from cosp.dense.validity import (
    NARROWEST_TEXTURE_PX,
    TEXTURE_WINDOW_PX,
    Validity,
    correlation,
    picture_validity,
    speckles,
    summarise_disparity,
)


def test_texture_and_saturation_are_those_of_the_window_around():
    rng = np.random.default_rng(4)
    spread = np.linspace(0, 6, 120)
    picture = 120 + spread * rng.standard_normal((80, 120))
    picture[30:60, 70:110] += 133
    picture = np.clip(np.rint(picture), 1, 255).astype(np.uint8)
    bits = picture_validity(picture, Validity.NO_DATA_LEFT, least_texture_sd=2.0, saturated_from=250)
    windows = np.lib.stride_tricks.sliding_window_view(picture, (TEXTURE_WINDOW_PX, TEXTURE_WINDOW_PX))
    inner = bits[4:-4, 4:-4]
    around = np.ones((NARROWEST_TEXTURE_PX, NARROWEST_TEXTURE_PX), bool)
    flat = ndimage.binary_closing(np.pad(windows.std(axis=(2, 3)) < 2.0, 20), around)[20:-20, 20:-20]
    deep = np.s_[10:-10, 10:-10]
    assert_array_equal(((inner & Validity.LOW_TEXTURE) != 0)[deep], flat[deep])
    assert 0.1 < flat[deep].mean() < 0.9
    assert_array_equal((inner & Validity.SATURATED) != 0, (windows >= 250).mean(axis=(2, 3)) > 0.5)


def test_zero_is_no_data():
    picture = np.full((20, 20), 50, np.uint8)
    picture[3:6, 4:9] = 0
    bits = picture_validity(picture, Validity.NO_DATA_RIGHT, least_texture_sd=0.0, saturated_from=255)
    near = np.zeros(picture.shape, bool)
    near[:9, :13] = True  # as far as the window of the census reaches
    assert_array_equal(bits & Validity.NO_DATA_RIGHT != 0, near)


@pytest.mark.parametrize("seed", range(3))
def test_speckles_are_the_small_connected_islands(seed):
    rng = np.random.default_rng(seed)
    height = rng.integers(0, 3, (60, 90))
    disparity = (10.0 * height).astype(np.float32)  # islands of equal height, whatever their outline
    disparity[rng.random(disparity.shape) < 0.1] = np.nan
    expected = np.zeros(disparity.shape, bool)
    for value in range(3):
        labels, _ = ndimage.label(disparity == 10 * value)
        sizes = np.bincount(labels.ravel())
        expected |= (labels > 0) & (sizes[labels] <= 12)
    found = speckles(disparity, largest_speckle_px=12, speckle_step_px=1.5)
    assert_array_equal(found, expected)
    assert 0.1 < found.mean() < 0.9


def test_a_slope_is_one_island_however_high_it_climbs():
    climb = np.arange(100, dtype=np.float32)[None] * np.ones((3, 1), np.float32)
    assert not speckles(climb, largest_speckle_px=299, speckle_step_px=1.0).any()
    assert speckles(climb, largest_speckle_px=3, speckle_step_px=0.9).all()


def test_the_summary_counts_bits_and_what_both_pictures_see():
    counts = np.zeros(256, np.int64)
    counts[0], counts[Validity.NO_DATA_RIGHT], counts[Validity.INCONSISTENT | Validity.SATURATED] = 60, 20, 20
    summary = summarise_disparity(counts, np.array([1.0, 2.0, 3.0, np.nan]))
    assert summary["density"] == 60 / 80
    assert summary["share_by_bit"]["no_data_right"] == 0.2
    assert summary["share_by_bit"]["saturated"] == 0.2
    assert summary["disparity_px"]["median"] == 2


def test_grain_of_two_films_does_not_correlate_and_shared_texture_does():
    rng = np.random.default_rng(5)
    texture = rng.normal(0, 12, (80, 80))
    left, right = (
        np.clip(128 + gain * texture + rng.normal(0, 6, (80, 80)), 1, 255).astype(np.uint8) for gain in (1.0, 0.7)
    )
    expected = 0.7 * 144 / np.sqrt((144 + 36) * (0.49 * 144 + 36))  # covariance over standard deviations
    found = correlation(left, right)[10:-10, 10:-10]
    assert abs(found.mean() - expected) < 0.03
    corner = np.corrcoef(left[:8, :8].ravel().astype(float), right[:8, :8].ravel())[0, 1]  # windows are cut
    assert abs(correlation(left, right)[0, 0] - corner) < 1e-5
    grain, other_grain = (np.clip(240 + rng.normal(0, 6, (80, 80)), 1, 255).astype(np.uint8) for _ in range(2))
    assert np.abs(correlation(grain, other_grain)).max() < 0.35
    assert np.abs(correlation(np.full((30, 30), 255, np.uint8), left[:30, :30])).max() < 0.02  # rounding
