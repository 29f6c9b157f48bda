"""Claims about the measurement of y-parallax."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from cosp.epipolar import kernels
from cosp.epipolar.parallax import measure_y_parallax, node_grid
from cosp.epipolar.patches import Reduced, image_patches
from cosp.epipolar.smoothing import local_median, smooth_field
from cosp.errors import NotEnoughMatchesError
from cosp.imaging.correlation import FLAT, ncc_surfaces
from cosp.imaging.windows import Window

SHAPE = (1100, 900)
CHOICES = {
    "template_px": 32,
    "least_score": 0.6,
    "largest_ratio": 0.85,
    "smoothing_nodes": 2.0,
    "fewest_matches": 50,
}


def true_y_parallax(rows, columns):
    return 1.5 * np.sin(rows / 260.0) + 0.8 * np.cos(columns / 300.0) + 1.2


def true_disparity(rows, columns):
    """Hills of 150 px, and a slope."""
    hills = 150 * np.exp(-((rows - 500) ** 2 + (columns - 450) ** 2) / (2 * 260.0**2))
    return hills - 60 + 0.03 * (columns - 450) + 4 * np.sin(rows / 40.0) * np.sin(columns / 50.0)


@functools.cache
def synthetic_pair():
    """Fore and aft picture with known disparity and y-parallax, other contrast, grain, snow and a black border."""
    rng = np.random.default_rng(5)
    margin = 250
    size = (SHAPE[0] + 2 * margin, SHAPE[1] + 2 * margin)
    ground = sum(
        cv2.GaussianBlur(rng.standard_normal(size).astype(np.float32), (0, 0), s) * s for s in (1.0, 2.5, 8.0, 25.0)
    )
    ground *= 30 / ground.std()
    ground[500:760, 300:620] = 90.0  # snow: no texture at all
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    aft = cv2.getRectSubPix(ground, SHAPE[::-1], (size[1] / 2 - 0.5, size[0] / 2 - 0.5))
    # The fore pixel (r, c) shows the ground of aft pixel (r + p, c + d).
    p, d = true_y_parallax(rows, columns), true_disparity(rows, columns)
    fore = cv2.remap(
        ground, (columns + d + margin).astype(np.float32), (rows + p + margin).astype(np.float32), cv2.INTER_CUBIC
    )
    fore = np.clip(120 + fore + rng.normal(0, 3, SHAPE), 1, 255).astype(np.uint8)
    aft = np.clip(100 + 0.7 * aft + rng.normal(0, 3, SHAPE), 1, 255).astype(np.uint8)
    fore[:, :60] = 0
    aft[1050:] = 0
    return fore, aft


@functools.cache
def measured(threads=1, least_score=0.6, bounds=(-140.0, 180.0)):
    fore, aft = synthetic_pair()
    nodes = node_grid(SHAPE, spacing_px=32, fewest_nodes=100)
    return measure_y_parallax(
        image_patches(lambda window: fore[window.slices], SHAPE),
        image_patches(lambda window: aft[window.slices], SHAPE),
        nodes,
        (np.full(nodes.shape, bounds[0]), np.full(nodes.shape, bounds[1])),
        threads=threads,
        **{**CHOICES, "least_score": least_score},
    )


def test_a_known_smooth_field_is_recovered_under_unknown_disparity():
    result = measured()
    centres = result.grid.centres()
    truth = true_y_parallax(centres[..., 1], centres[..., 0])
    error = result.raw_px - truth
    found = np.isfinite(error)
    assert 0.5 < found.mean() < 0.95  # not the snow, not beyond the border
    # Windows on the slopes (0.4 px of disparity per px) see bent ground, hence a wider spread than noise alone gives.
    assert np.nanstd(error) < 0.2
    assert abs(np.nanmean(error)) < 0.03
    assert (result.smooth_px - truth)[found].std() < 0.06
    assert np.abs(result.smooth_px - truth)[found].max() < 0.4
    assert np.isfinite(result.smooth_px).all()
    d_error = (result.disparity_px - true_disparity(centres[..., 1], centres[..., 0]))[found]
    assert np.median(np.abs(d_error)) < 0.5


def test_the_smooth_field_takes_out_what_would_hurt_the_dense_matcher():
    summary = measured().summary()
    assert summary["sd_px"] > 0.8
    assert summary["sd_about_smooth_px"] < 0.2
    assert summary["nmad_about_smooth_px"] < 0.12
    assert summary["share_within_1_px"] < 0.6


def test_snow_and_black_are_not_measured():
    result = measured()
    centres = result.grid.centres()
    aft_row = centres[..., 1] + true_y_parallax(centres[..., 1], centres[..., 0])
    aft_column = centres[..., 0] + true_disparity(centres[..., 1], centres[..., 0])
    snow = (np.abs(aft_row - 380) < 105) & (np.abs(aft_column - 210) < 135)
    assert snow.sum() > 20
    assert np.isfinite(result.raw_px[snow]).mean() < 0.05
    assert np.isnan(result.raw_px[centres[..., 0] < 58]).all()
    assert np.isnan(result.raw_px[aft_row > 1070]).all()


def test_threads_change_nothing():
    one, three = measured(threads=1), measured(threads=3)
    assert_array_equal(one.raw_px, three.raw_px)
    assert_array_equal(one.smooth_px, three.smooth_px)


def test_too_few_matches_are_an_error_that_counts_them():
    with pytest.raises(NotEnoughMatchesError, match="of the 50 nodes needed"):
        measured(least_score=0.9999)


def test_small_images_get_closer_nodes():
    assert node_grid((106000, 8000), spacing_px=128, fewest_nodes=1000).step_x == 128
    coarse = node_grid((2600, 240), spacing_px=128, fewest_nodes=1000)
    assert coarse.step_x == 16
    assert coarse.shape == (162, 15)
    rows, columns = coarse.centres()[..., 1], coarse.centres()[..., 0]
    assert abs((rows.min() + rows.max()) - 2599) <= 1
    assert abs((columns.min() + columns.max()) - 239) <= 1


def test_the_local_median_is_that_of_the_measured_neighbours(rng):
    values = rng.normal(0, 1, (9, 11))
    values[rng.random(values.shape) < 0.4] = np.nan
    values[5:, 7:] = np.nan
    medians = local_median(values, 1)
    for r, c in np.ndindex(values.shape):
        near = values[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]
        near = near[np.isfinite(near)]
        assert (np.isnan(medians[r, c]) and near.size == 0) or medians[r, c] == pytest.approx(np.median(near))


def test_a_smooth_field_goes_on_with_its_slope_and_leaves_blunders_out(rng):
    rows, columns = np.mgrid[:40, :30].astype(float)
    truth = 0.1 * rows - 0.05 * columns + np.sin(rows / 9)
    values = truth + rng.normal(0, 0.05, truth.shape)
    wrong = rng.random(truth.shape) < 0.15
    values[wrong] += rng.choice([-3.0, 5.0], wrong.sum())
    values[15:25, 10:20] = np.nan
    field = smooth_field(values, np.ones(values.shape), sigma_nodes=2.0)
    assert np.abs(field - truth)[:, [0, -1]].max() < 0.25  # borders, where a mean would be 0.15 * slope * sigma off
    measured_nodes = np.isfinite(values)
    assert (field - truth)[measured_nodes].std() < 0.05
    assert np.abs(field - truth)[15:25, 10:20].max() < 0.5


def test_a_reduced_image_is_the_mean_of_blocks_and_is_read_once(rng):
    image = rng.integers(0, 256, (4500, 2300)).astype(np.uint8)
    read = []

    def reader(window):
        read.append(window)
        return image[window.slices]

    reduced = Reduced(reader, image.shape)
    for factor in (16, 4, 2):
        part = Window(-3, 4480 // factor - 5, 7, 2288 // factor)
        blocks = image[: 4480 // factor * factor, : 2288 // factor * factor].astype(float)
        blocks = blocks.reshape(4480 // factor, factor, 2288 // factor, factor).mean(axis=(1, 3))
        found = reduced(part, factor)
        assert not found[:3].any()
        # Rounded once for each halving.
        assert np.abs(found[3:] - blocks[: part.row1, 7:]).max() <= 0.5 * np.log2(factor) + 1e-6
    assert len(read) == len(set(read)) == 6
    assert_array_equal(reduced(Window(100, 130, 2290, 2310), 1)[:, :10], image[100:130, 2290:])
    assert not reduced(Window(5000, 5010, 0, 4), 2).any()


def test_the_correlation_of_small_windows_is_that_by_transforms(rng):
    searches = rng.integers(0, 256, (6, 20, 31)).astype(np.uint8)
    templates = rng.integers(0, 256, (6, 14, 16)).astype(np.uint8)
    templates[0] = searches[0, 4:18, 9:25]
    templates[1] = 255 - searches[1, 2:16, 3:19]
    templates[2] = 77
    searches[3, :, :20] = 0
    searches[4], searches[4, :, 12:] = 200, 201
    searches[5] = 90
    surfaces = np.full((6, 7, 16), np.nan, np.float32)
    kernels.correlate(templates, searches, FLAT, surfaces)
    assert_allclose(surfaces, ncc_surfaces(templates, searches), atol=1e-6)
    assert_allclose([surfaces[0, 4, 9], surfaces[1, 2, 3]], [1.0, -1.0], atol=1e-6)
    assert not surfaces[2].any()
    assert not surfaces[3, :, :5].any()
    assert surfaces[4].any()
    assert not surfaces[5].any()
