"""Claims about points turned into a raster of heights."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.geometry.grids import PixelGrid
from cosp.surface.gridding import HALO_CELLS, boxes_meeting, grid_points, map_boxes
from tests.surface.synthetic import ORIGIN

CHOICES = {"kernel_cells": 0.5, "gate_sigmas": 5.0, "point_sigma_m": 1.5, "points_per_independent": 1.0}
GRID = PixelGrid.covering((600_000, 5_200_000, 600_600, 5_200_500), 10.0)


def plane(xy):
    return 1500 + 0.6 * (xy[..., 0] - 600_000) - 0.9 * (xy[..., 1] - 5_200_000)


@pytest.fixture
def rng():
    return np.random.default_rng(17)


def scattered(rng, count=20_000, bounds=(600_000, 5_200_000, 600_600, 5_200_500)):
    xmin, ymin, xmax, ymax = bounds
    xy = np.stack([rng.uniform(xmin, xmax, count), rng.uniform(ymin, ymax, count)], axis=-1)
    return np.concatenate([xy, plane(xy)[:, None]], axis=-1)


def test_a_steep_plane_is_recovered_however_unevenly_the_points_lie(rng):
    points = scattered(rng)
    found = grid_points(points, GRID, **CHOICES)
    error = found.height_m - plane(GRID.centres())
    assert np.isfinite(error).all()
    # Points lie up to 10 m of height from their cell's centre: a mean of them would be metres off.
    assert np.abs(error[1:-1, 1:-1]).max() < 0.05
    assert np.abs(error).max() < 0.5


@pytest.mark.parametrize("height_m", [0.0, 8000.0])
def test_each_height_is_that_of_the_weighted_plane_through_its_nine_cells(rng, height_m):
    points = scattered(rng, count=60_000)
    points[:, 2] += height_m + rng.normal(0, 3.0, len(points))
    weights = rng.uniform(0.2, 1.0, len(points)).astype(np.float32)
    found = grid_points(points, GRID, **CHOICES, weights=weights)
    # More columns than are fitted side by side in one go; cells on both sides of the seam.
    for row, column in ((5, 7), (20, 31), (20, 32), (44, 57), (30, 1), (1, 30)):
        x, y = GRID.pixels(points[:, :2])[::-1]
        cells = np.rint(x) - column, np.rint(y) - row
        near = (np.abs(cells[0]) <= 1) & (np.abs(cells[1]) <= 1)
        spatial = np.exp(-(cells[0] ** 2 + cells[1] ** 2)[near] / (2 * 0.5**2))
        root = np.sqrt(spatial * weights[near])
        design = np.column_stack([np.ones(near.sum()), x[near] - column, y[near] - row])
        solution = np.linalg.lstsq(design * root[:, None], points[near, 2] * root)[0]
        residual = np.sqrt(np.sum((root * (points[near, 2] - design @ solution)) ** 2) / np.sum(root**2))
        assert found.height_m[row, column] == pytest.approx(solution[0], abs=0.02)
        independent = np.sum(root**2) ** 2 / np.sum(root**4 / weights[near])
        assert found.sigma_m[row, column] == pytest.approx(max(residual, 1.5) / np.sqrt(independent), rel=1e-3)
        assert found.count[row, column] == ((cells[0] == 0) & (cells[1] == 0)).sum()


def test_gross_errors_leave_no_trace_up_to_a_fifth_of_the_points(rng):
    points = scattered(rng)
    points[:, 2] += rng.normal(0, 1.5, len(points))
    clean = grid_points(points, GRID, **CHOICES).height_m - plane(GRID.centres())
    wrong = rng.random(len(points)) < 0.2
    points[wrong, 2] += rng.choice([-1, 1], wrong.sum()) * rng.uniform(100, 800, wrong.sum())
    error = grid_points(points, GRID, **CHOICES).height_m - plane(GRID.centres())
    assert np.isfinite(error).mean() > 0.995
    usual = np.nanstd(clean)
    assert 0.3 < usual < 1.5
    assert np.nanpercentile(np.abs(error), 99) < 6 * usual


def test_the_stated_standard_deviation_is_that_of_the_heights(rng):
    points = scattered(rng)
    points[:, 2] += rng.normal(0, 3.0, len(points))
    found = grid_points(points, GRID, **CHOICES)
    ratio = (found.height_m - plane(GRID.centres()))[1:-1, 1:-1] / found.sigma_m[1:-1, 1:-1]
    assert 0.8 < ratio.std() < 1.3


def test_surer_points_count_for_more_and_the_standard_deviation_knows(rng):
    points = scattered(rng)
    weights = rng.choice([1.0, 0.04], len(points))  # half of the points have five times the noise
    points[:, 2] += rng.normal(0, 1.5, len(points)) / np.sqrt(weights)
    inner = (slice(1, -1), slice(1, -1))
    alike, weighted = (grid_points(points, GRID, **CHOICES, weights=w) for w in (np.ones(len(points)), weights))
    errors = [(found.height_m - plane(GRID.centres()))[inner] for found in (alike, weighted)]
    # Equal weights of variances s and 25 s leave 13 s on average, the right ones 1.92 s, as the harmonic mean.
    assert errors[1].std() < 0.55 * errors[0].std()
    # The scatter is never believed to be less than the matching noise, so that few points make it a little large.
    assert 0.7 < (errors[1] / weighted.sigma_m[inner]).std() < 1.2


def test_points_without_weight_are_not_there(rng):
    points = scattered(rng)
    weights = np.ones(len(points))
    weights[::3] = 0
    found = grid_points(points, GRID, **CHOICES, weights=weights)
    expected = grid_points(points[weights > 0], GRID, **CHOICES)
    assert np.array_equal(found.height_m, expected.height_m, equal_nan=True)
    assert np.array_equal(found.count, expected.count)


def test_neighbours_that_err_together_make_the_standard_deviation_larger(rng):
    points = scattered(rng)
    alone = grid_points(points, GRID, **CHOICES).sigma_m
    together = grid_points(points, GRID, **(CHOICES | {"points_per_independent": 4.0})).sigma_m
    assert_allclose(np.median(together / alone), 2.0, rtol=0.15)
    assert together.max() <= np.float32(1.5)  # never worse than a single point


def test_matching_noise_is_the_least_that_is_claimed(rng):
    found = grid_points(scattered(rng), GRID, **CHOICES)  # without any noise
    # 1.5 m over the root of the points of a cell, seven on average, and some of its neighbours'
    assert found.sigma_m.min() > 1.5 / np.sqrt(60)
    assert found.sigma_m.max() <= np.float32(1.5)


def test_a_slope_turned_away_from_the_lens_has_no_holes(rng):
    # Foreshortened: points 18 m apart across 10 m cells in one direction, 3 m in the other.
    x, y = np.meshgrid(np.arange(600_000.5, 600_600, 18.0), np.arange(5_200_000.5, 5_200_500, 3.0))
    xy = np.stack([x.ravel(), y.ravel()], axis=-1)
    points = np.concatenate([xy, plane(xy)[:, None]], axis=-1)
    found = grid_points(points, GRID, **CHOICES)
    inner = found.height_m[2:-2, 2:-2]
    assert (found.count[2:-2, 2:-2] == 0).mean() > 0.3  # many cells hold no point of their own
    assert np.isfinite(inner).all()
    assert np.abs(inner - plane(GRID.centres())[2:-2, 2:-2]).max() < 1.0


@pytest.mark.parametrize("posting", [5.0, 7.5, 10.0, 20.0, 30.0])
@pytest.mark.parametrize("facing", [1.0, 2.6])
def test_any_posting_from_5_to_30_m_is_whole_and_says_how_well_it_is_known(posting, facing):
    """Pixels of a 7 um film on a plane: 2.2 m apart, more along a slope that is turned away from the lens."""
    rng = np.random.default_rng(round(posting * 10))
    side = 900.0
    i, j = np.meshgrid(np.arange(0, side, 2.2), np.arange(0, side, 2.2 * facing), indexing="ij")
    turn = np.radians(12.0)  # rows of the film do not run along the map's
    x = 600_000 + np.cos(turn) * j - np.sin(turn) * i
    y = 5_200_000 + np.sin(turn) * j + np.cos(turn) * i
    xy = np.stack([x, y], axis=-1).reshape(-1, 2) + rng.normal(0, 0.3, (x.size, 2))
    points = np.concatenate([xy, plane(xy)[:, None]], axis=-1)
    noise_m = 2.0
    noisy = points + np.array([0.0, 0.0, 1.0]) * rng.normal(0, noise_m, len(points))[:, None]
    grid = PixelGrid.covering((600_000, 5_200_200, 600_600, 5_200_700), posting)
    choices = CHOICES | {"point_sigma_m": noise_m}
    exact, found = (grid_points(each, grid, **choices) for each in (points, noisy))
    # No holes wherever the whole cell lies among the points.
    back = np.stack([np.cos(turn), np.sin(turn)]), np.stack([-np.sin(turn), np.cos(turn)])
    centre = grid.centres() - np.array([600_000, 5_200_000])
    depth = np.min([np.minimum(centre @ axis, side - centre @ axis) for axis in back], axis=0)
    inside = depth > 2 * posting
    inside[[0, -1]] = inside[:, [0, -1]] = False  # cells that are asked for without their neighbours
    assert inside.mean() > 0.4
    assert np.isfinite(found.height_m[inside]).all()
    assert np.isfinite(found.sigma_m[inside]).all()
    # What the plane itself leaves is little beside the noise.
    assert np.abs((exact.height_m - plane(grid.centres())) / found.sigma_m)[inside].max() < 0.25
    # Points of a cell: its area by that of a pixel.
    expected = posting**2 / (2.2 * 2.2 * facing)
    assert_allclose(found.count[inside].mean(), expected, rtol=0.05)
    # The standard deviation is that of the errors, no more and no less.
    ratio = ((found.height_m - plane(grid.centres())) / found.sigma_m)[inside]
    assert 0.8 < ratio.std() < 1.25
    assert abs(ratio.mean()) < 4 / np.sqrt(ratio.size / 4)


def test_a_tiny_hole_is_filled_and_a_larger_one_is_not(rng):
    points = scattered(rng)
    rows, columns = (np.rint(v).astype(int) for v in GRID.pixels(points[:, :2]))
    tiny = (rows == 20) & (columns == 20)
    large = (abs(rows - 35) <= 2) & (abs(columns - 40) <= 2)
    found = grid_points(points[~tiny & ~large], GRID, **CHOICES)
    assert abs(found.height_m[20, 20] - plane(GRID.centres())[20, 20]) < 0.5
    assert found.count[20, 20] == 0
    assert np.isnan(found.height_m[34:37, 39:42]).all()


def test_the_model_does_not_grow_beyond_its_points(rng):
    points = scattered(rng, bounds=(600_200, 5_200_200, 600_400, 5_200_400))
    found = grid_points(points, GRID, **CHOICES)
    outside = np.ones(GRID.shape, bool)
    outside[10:30, 20:40] = False
    assert np.isnan(found.height_m[outside]).all()
    assert np.isfinite(found.height_m[~outside]).all()


def test_tiles_with_a_halo_give_the_heights_of_the_whole(rng):
    points = scattered(rng, count=4000)
    points[:, 2] += rng.normal(0, 3, len(points))
    points[::50, 2] += 300
    whole = grid_points(points, GRID, **CHOICES)
    part = GRID.window(10 - HALO_CELLS, 30 + HALO_CELLS, 20 - HALO_CELLS, 45 + HALO_CELLS)
    tile = grid_points(points, part, **CHOICES)
    inner = (slice(HALO_CELLS, -HALO_CELLS), slice(HALO_CELLS, -HALO_CELLS))
    assert_allclose(tile.height_m[inner], whole.height_m[10:30, 20:45], atol=1e-3)
    assert_allclose(tile.sigma_m[inner], whole.sigma_m[10:30, 20:45], atol=1e-3)
    assert np.array_equal(tile.count[inner], whole.count[10:30, 20:45])


def test_no_points_make_an_empty_model():
    found = grid_points(np.empty((0, 3)), GRID, **CHOICES)
    assert np.isnan(found.height_m).all()
    assert not found.count.any()


def test_boxes_on_the_map_hold_all_that_the_local_boxes_held(rng):
    low = np.array([[-60_000.0, -3000, 0], [20_000, 1000, 500]])
    high = low + [2000.0, 4000, 1500]
    map_frame, boxes = map_boxes(ORIGIN, "EPSG:32632", low, high)
    for k in range(2):
        inside = map_frame.map_from_local(rng.uniform(low[k], high[k], (500, 3)))
        assert (inside[:, :2] >= boxes[k, :2] - 0.5).all()
        assert (inside[:, :2] <= boxes[k, 2:] + 0.5).all()
    assert boxes_meeting(boxes, tuple(boxes[1])) == [1]
    assert boxes_meeting(boxes, (boxes[:, 0].min(), boxes[:, 1].min(), boxes[:, 2].max(), boxes[:, 3].max())) == [0, 1]
