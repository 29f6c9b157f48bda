import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import map_coordinates

from cosp.dense import kernels
from cosp.dense.aggregation import aggregate_costs
from cosp.dense.census import left_census, right_census


@pytest.fixture
def pictures():
    """Noise with a hole, and the same moved by three columns, wide enough for 64 disparities."""
    rng = np.random.default_rng(2)
    left = rng.integers(1, 256, (30, 75), dtype=np.uint8)
    left[10:14, 30:45] = 0
    right = rng.integers(1, 256, (30, 75 + 80), dtype=np.uint8)
    right[:, 43:118] = left
    return left, right


def passes_of(function, left, right, disparities):
    rows, columns = left.shape
    winners = np.empty((rows, columns), np.uint8)
    costs = np.empty((rows, columns, 4), np.uint16)
    right_winners = np.empty((rows, columns + disparities), np.uint8)
    volume = np.empty((2, rows, columns, disparities), np.uint8)
    leasts = np.empty((rows, columns), np.uint32)
    function(left_census(left), right_census(right), 8, 24, 64, volume, leasts, winners, costs, right_winners)
    return volume, leasts, winners, costs, right_winners


def test_the_vector_census_is_the_plain_one_bit_for_bit(pictures):
    for picture in pictures:
        vector, plain = (np.full((kernels.PLANES, *picture.shape), 9, np.uint16) for _ in range(2))
        kernels.census_vector(picture, vector)
        kernels.census_plain(picture, plain)
        assert_array_equal(vector, plain)


@pytest.mark.parametrize("disparities", [32, 64])
def test_the_vector_passes_are_the_plain_ones_bit_for_bit(pictures, disparities):
    vector = passes_of(kernels.vector_passes(disparities), *pictures, disparities)
    plain = passes_of(kernels.plain_passes, *pictures, disparities)
    for ours, reference in zip(vector, plain, strict=True):
        assert_array_equal(ours, reference)


def test_the_census_sets_a_bit_for_every_darker_neighbour():
    rng = np.random.default_rng(3)
    picture = rng.integers(1, 256, (9, 44), dtype=np.uint8)
    window = picture[1:8, 6:15].ravel()
    darker = np.delete(window < window[31], 31)
    words = np.packbits(darker, bitorder="little").view(np.uint16)
    assert_array_equal(left_census(picture)[:, 4, 10], words)


def test_paths_are_those_of_a_direct_computation_of_the_recursion(pictures):
    left, right = (picture[:9, :44] for picture in pictures)
    right = np.ascontiguousarray(np.pad(left, ((0, 0), (24, 24)), mode="reflect"))
    left = np.ascontiguousarray(left)
    disparities, small, large = 32, 5, 40
    a, b = left_census(left), right_census(right)
    rows, columns = left.shape
    cost = np.zeros((rows, columns, disparities), int)
    for d in range(disparities):
        cost[..., d] = np.bitwise_count(a ^ b[:, :, 8 + d : 8 + d + columns]).sum(axis=0)
    total, surplus = np.zeros_like(cost), np.zeros_like(cost)
    for down, across in [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]:
        path = np.zeros_like(cost)
        for row in range(rows)[:: down or 1]:
            for column in range(columns)[:: across or 1]:
                i, j = row - down, column - across
                before = path[i, j] if 0 <= i < rows and 0 <= j < columns else np.zeros(disparities, int)
                before = before - before.min()
                beside = np.pad(before, 1, constant_values=999)
                reached = np.minimum(before, np.minimum(beside[:-2], beside[2:]) + small)
                path[row, column] = cost[row, column] + np.minimum(reached, large)
        total += path
        if (down, across) in [(0, 1), (1, 0), (1, 1), (1, -1)]:  # the first sweep's
            surplus += path - path.min(axis=2, keepdims=True)
    found = aggregate_costs(a, b, disparities=disparities, small_step=small, large_step=large)
    assert_array_equal(found.winners, total.argmin(axis=2))
    assert_array_equal(found.costs[..., kernels.BEST], total.min(axis=2))
    apart = np.abs(np.arange(disparities) - found.winners[..., None]) > 1
    kept = total - np.maximum(surplus - 255, 0)  # a byte keeps what the first sweep finds above its least
    assert_array_equal(found.costs[..., kernels.RUNNER_UP], np.where(apart, kept, 9999).min(axis=2))


def test_penalties_that_would_overflow_a_byte_are_refused(pictures):
    left, right = pictures
    with pytest.raises(ValueError, match="0 < small <= large <= 65"):
        aggregate_costs(left_census(left), right_census(right), disparities=32, small_step=24, large_step=66)


@pytest.mark.parametrize("nodes", [(1, 1), (1, 2), (2, 1), (3, 7)])
def test_the_vector_resampling_is_the_plain_one_bit_for_bit(nodes):
    rng = np.random.default_rng(4)
    source = np.pad(rng.integers(1, 256, (40, 90), dtype=np.uint8), kernels.RIM)
    prior = rng.normal(3, 20, (30, 61)).astype(np.float32)  # out of the source on all sides
    field = rng.normal(0, 6, nodes).astype(np.float32)
    found = np.full((2, *prior.shape), 9, np.uint8)
    for resample, target in zip((kernels.resample_vector, kernels.resample_plain), found, strict=True):
        resample(source, prior, field, (0.3, -0.4, 0.1, 0.09), 0.5, 12.25, 3.5, target)
    assert_array_equal(*found)
    assert 0.05 < (found[0] == 0).mean() < 0.5


@pytest.mark.parametrize("first", [(0, 0), (3, 5), (-3, -6)])
def test_doubling_puts_pixels_on_pixels_and_means_between(first):
    coarse = np.random.default_rng(6).normal(size=(12, 15)).astype(np.float32)
    fine = np.full((40, 47), np.nan, np.float32)
    kernels.enlarge(coarse, *first, fine)
    rows, columns = (
        np.clip((start + np.arange(n)) / 2, 0, size - 1)
        for start, n, size in zip(first, fine.shape, coarse.shape, strict=True)
    )
    expected = 2 * map_coordinates(coarse.astype(float), np.meshgrid(rows, columns, indexing="ij"), order=1)
    assert_allclose(fine, expected, atol=1e-5)


@pytest.mark.parametrize(("whole", "tolerated", "margin"), [(True, 0, 18), (False, 32, 24)])
def test_the_vector_selection_is_the_plain_one_bit_for_bit(whole, tolerated, margin):
    rng = np.random.default_rng(8)
    rows, columns, disparities = 7, 75, 32
    wide = (rows, columns + 2 * margin)
    costs = rng.integers(0, 2048, (rows, columns, 4)).astype(np.uint16)
    costs[..., kernels.BEST] = rng.integers(0, costs.min(axis=-1) + 1)
    costs[::2, ::3] = costs[::2, ::3, kernels.BEST, None]  # all the same
    winners = rng.integers(0, disparities, (rows, columns), dtype=np.uint8)
    right_winners = rng.integers(0, disparities, (rows, columns + disparities), dtype=np.uint8)
    prior = rng.normal(0, 300, wide).astype(np.float32)
    right, right_flags = rng.integers(0, 256, wide, dtype=np.uint8), rng.integers(0, 2, wide, dtype=np.uint8)
    flags = np.where(rng.random((rows, columns)) < 0.2, 8, 0).astype(np.uint8)
    found = []
    for select in (kernels.select_vector, kernels.select_plain):
        disparity, ours = np.empty((rows, columns), np.float32), flags.copy()
        confidence, matched = (np.empty((rows, columns), np.uint8) for _ in range(2))
        select(
            winners, costs, right_winners, prior, right, right_flags,
            4, 32, tolerated, whole, disparity, ours, confidence, matched,
        )  # fmt: skip
        found.append((disparity, ours, confidence, matched))
    for vector, plain in zip(*found, strict=True):
        assert_array_equal(vector, plain)
    disparity, ours, confidence, matched = found[0]
    assert np.bitwise_or.reduce(ours, axis=None) == 1 | 4 | 8 | 32
    assert (ours == 0).mean() > 0.02
    assert np.isnan(disparity).any() != whole
    assert np.ptp(confidence) > 200
    at_rest = (costs[..., kernels.BELOW] == costs[..., kernels.ABOVE]) & (ours == 0)
    row, column = np.nonzero(at_rest)
    place = margin + column + winners[at_rest] - disparities // 2
    assert len(row) > 0
    assert_array_equal(disparity[at_rest], prior[row, place] + (winners[at_rest] - np.float32(disparities // 2)))
    assert_array_equal(matched[at_rest], right[row, place])
