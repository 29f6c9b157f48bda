"""Claims about bringing a model onto a reference."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.dem.coregistration import coregister, describe, displaced, match_tiles, whole_shift
from cosp.dem.least_squares_matching import AffineShift, match_surfaces
from cosp.geometry.statistics import nmad
from cosp.imaging.windows import Window
from tests.dem.synthetic import CRS, GRID, ground, moved, reference

SHIFT_M = np.array([47.0, -22.0, 8.0])
WHOLE = {"outlier_m": 150.0, "least_cells": 2000, "most_cells": 50_000}
MATCH = {"sigma_matrix": 5e-4, "sigma_shift_m": 20.0, "cells_per_independent": 4.0, "most_cells": 40_000}
TILES = {"tile_m": 4000.0, "overlap_m": 1200.0, "least_share": 0.3, "outlier_m": 150.0}
STABLE = np.ones(GRID.shape, bool)


@pytest.fixture(scope="module")
def rough():
    return ground(np.random.default_rng(8))


@pytest.fixture
def rng():
    return np.random.default_rng(9)


def test_a_shift_of_a_cell_and_a_half_is_found_to_a_hundredth(rough, rng):
    heights = moved(rough, SHIFT_M) + rng.normal(0, 2, GRID.shape).astype(np.float32)
    shift_m, method = whole_shift(heights, reference(rough), STABLE, GRID, CRS, rng=rng, **WHOLE)
    assert method == "nuth_kaab"
    assert_allclose(shift_m, SHIFT_M, atol=0.5)


def test_unstable_ground_has_no_say(rough, rng):
    heights = moved(rough, SHIFT_M)
    stable = STABLE.copy()
    stable[:, 100:200] = False
    heights[:, 100:200] -= 60  # a third of the ground sank
    shift_m, _ = whole_shift(heights, reference(rough), stable, GRID, CRS, rng=rng, **WHOLE)
    assert_allclose(shift_m, SHIFT_M, atol=0.5)


def test_on_flat_ground_only_the_height_is_shifted(rng):
    flat = ground(rng, relief_m=0.5)
    shift_m, method = whole_shift(moved(flat, SHIFT_M), reference(flat), STABLE, GRID, CRS, rng=rng, **WHOLE)
    assert method == "vertical"
    assert_allclose(shift_m, [0, 0, SHIFT_M[2]], atol=0.1)


def test_without_common_ground_nothing_is_shifted(rough, rng):
    empty = np.full(GRID.shape, np.nan, np.float32)
    shift_m, method = whole_shift(empty, reference(rough), STABLE, GRID, CRS, rng=rng, **WHOLE)
    assert method == "none"
    assert not shift_m.any()


def test_an_affine_transformation_is_recovered_within_its_standard_deviations(rough, rng):
    xy = GRID.centres()
    centre = np.array([*xy.reshape(-1, 2).mean(0), 2000.0])
    matrix = np.array([[2e-4, -3e-4, 0], [1e-4, 2e-4, 0], [6e-4, -4e-4, 0]])
    points = np.concatenate([xy, reference(rough)[..., None]], axis=-1)
    truth = AffineShift(centre, SHIFT_M, matrix)
    heights = moved(rough, truth.displacement(points)) + rng.normal(0, 2, GRID.shape).astype(np.float32)
    found = match_surfaces(heights, reference(rough), STABLE, GRID, start_m=np.array([40.0, -15, 0]), **MATCH)
    error = found.transformation.displacement(points) - truth.displacement(points)
    assert np.abs(error[..., :2]).max() < 1.5  # of displacements that differ by 5 m over the model
    assert np.abs(error[..., 2]).max() < 0.8
    # The noise has the deviation that one cell has, but every fourth cell counts: half of it is what to expect.
    assert np.abs(error.reshape(-1, 3).mean(0) / found.sigma_shift_m).max() < 4
    assert found.nmad_after_m < 2.3 < found.nmad_before_m


def test_gross_errors_of_a_fifth_of_the_cells_do_not_move_the_match(rough, rng):
    heights = moved(rough, SHIFT_M)
    wrong = rng.random(GRID.shape) < 0.2
    heights[wrong] += rng.uniform(20, 200, wrong.sum()).astype(np.float32)
    found = match_surfaces(heights, reference(rough), STABLE, GRID, start_m=SHIFT_M - 5, **MATCH)
    assert_allclose(found.transformation.shift_m, SHIFT_M, atol=0.6)


def test_on_flat_ground_the_match_falls_back_to_a_plane(rng):
    flat = ground(rng, relief_m=0.02)
    east = GRID.centres()[..., 0] - GRID.x0
    tilt = np.stack([np.zeros(GRID.shape), np.zeros(GRID.shape), 5 + 4e-4 * east], axis=-1)
    start_m = np.array([3.0, -2.0, 0.0])
    heights = moved(flat, tilt) + rng.normal(0, 1, GRID.shape).astype(np.float32)
    found = match_surfaces(heights, reference(flat), STABLE, GRID, start_m=start_m, **MATCH)
    points = np.concatenate([GRID.centres(), reference(flat)[..., None]], axis=-1)
    displacement = found.transformation.displacement(points)
    assert_allclose(displacement[..., :2], np.broadcast_to(start_m[:2], (*GRID.shape, 2)), atol=10.0)  # half the prior
    assert_allclose(displacement[..., 2], tilt[..., 2], atol=0.15)
    assert (found.sigma_shift_m[:2] > 10).all()  # and says that it knows nothing of the shift in plan


def test_tiles_take_out_a_smooth_distortion_that_one_shift_cannot(rough, rng):
    xy = GRID.centres() - [GRID.x0, GRID.y0]
    wave = 12 * np.sin(xy[..., 0] / 3500) + 8 * np.cos(xy[..., 1] / 4000)
    wanted = SHIFT_M + np.stack([np.zeros(GRID.shape)] * 2 + [wave], axis=-1)
    heights = moved(rough, wanted) + rng.normal(0, 1.5, GRID.shape).astype(np.float32)
    shift_m, _ = whole_shift(heights, reference(rough), STABLE, GRID, CRS, rng=rng, **WHOLE)
    shifted = displaced(
        heights,
        GRID,
        [AffineShift(np.zeros(3), shift_m, np.zeros((3, 3)))],
        [Window(0, *GRID.shape[:1], 0, 320)],
        border_cells=1,
    )
    found = match_tiles(heights, reference(rough), STABLE, GRID, shift_m, **TILES, **MATCH)
    assert all(tile.method == "affine" for tile in found)
    result = coregister(heights, found, GRID, overlap_m=TILES["overlap_m"])
    assert nmad(shifted - reference(rough)) > 5
    assert nmad(result - reference(rough)) < 2
    assert np.isnan(result).mean() < 0.02
    assert describe(found[0], GRID)["nmad_after_m"] < describe(found[0], GRID)["nmad_before_m"]


def test_a_tile_without_enough_stable_ground_keeps_the_shift_of_the_whole(rough):
    stable = STABLE.copy()
    stable[:, :100] = False
    heights = moved(rough, SHIFT_M)
    found = match_tiles(heights, reference(rough), stable, GRID, SHIFT_M, **TILES, **MATCH)
    methods = {tile.method for tile in found}
    assert methods == {"affine", "shift"}
    for tile in found:
        if tile.method == "shift":
            assert tile.share < TILES["least_share"]
            assert np.array_equal(tile.transformation.shift_m, SHIFT_M)
    result = coregister(heights, found, GRID, overlap_m=TILES["overlap_m"])
    assert nmad(result - reference(rough)) < 1


def test_a_model_smaller_than_a_tile_is_one_tile(rough):
    found = match_tiles(
        moved(rough, SHIFT_M), reference(rough), STABLE, GRID, SHIFT_M, **(TILES | {"tile_m": 20_000.0}), **MATCH
    )
    assert len(found) == 1
    assert found[0].window == Window(0, 300, 0, 320)


def test_blended_tiles_leave_no_step():
    plane = np.full(GRID.shape, 1000, np.float32)
    halves = [Window(0, 300, 0, 180), Window(0, 300, 140, 320)]
    both = [AffineShift(np.zeros(3), np.array([0, 0, up]), np.zeros((3, 3))) for up in (0.0, 10.0)]
    result = displaced(plane, GRID, both, halves, border_cells=40)
    assert_allclose(result[150, :135], 1000, atol=1e-3)
    assert_allclose(result[150, 185:], 1010, atol=1e-3)
    # 10 m over 40 cells with a cosine: nowhere more than pi/2 times the mean rise
    assert np.abs(np.diff(result, axis=1)).max() < 10 / 40 * 1.7


def test_moving_without_a_displacement_changes_nothing_not_even_the_holes(rough, rng):
    heights = reference(rough).copy()
    heights[rng.random(GRID.shape) < 0.1] = np.nan
    whole = Window(0, 300, 0, 320)
    result = displaced(
        heights, GRID, [AffineShift(np.zeros(3), np.zeros(3), np.zeros((3, 3)))], [whole], border_cells=1
    )
    assert_allclose(result, heights, atol=1e-3)


def test_threads_change_nothing(rough, rng):
    heights = moved(rough, SHIFT_M) + rng.normal(0, 2, GRID.shape).astype(np.float32)
    one, two = (
        coregister(
            heights,
            match_tiles(heights, reference(rough), STABLE, GRID, SHIFT_M, **TILES, **MATCH, threads=threads),
            GRID,
            overlap_m=TILES["overlap_m"],
        )
        for threads in (1, 2)
    )
    assert np.array_equal(one, two, equal_nan=True)
