import numpy as np

from cosp.matching.filtering import consistent_by_tile, in_check_blocks, thinned

HALF_LENGTH_MM, HALF_WIDTH_MM = 357.4, 27.7


def points(rng, count=1500):
    return rng.uniform(-1, 1, (count, 2)) * (HALF_LENGTH_MM, HALF_WIDTH_MM)


def consistent(predicted, measured, rng):
    return consistent_by_tile(predicted, measured, tile_mm=40.0, gate_mm=0.06, minimum=8, trials=100, rng=rng)


def test_consistent_matches_are_kept_and_gross_errors_removed():
    rng = np.random.default_rng(1)
    predicted = points(rng)
    # A smooth distortion far larger than the gate, but nearly affine over a tile.
    measured = predicted + 0.8 * np.sin(predicted[:, ::-1] / 150) + 0.01 * rng.standard_normal(predicted.shape)
    wrong = rng.random(len(predicted)) < 0.4
    measured[wrong] += rng.uniform(-1.5, 1.5, (wrong.sum(), 2))
    keep = consistent(predicted, measured, rng)
    assert keep[~wrong].mean() > 0.97
    assert keep[wrong].mean() < 0.05


def test_matches_without_agreement_leave_a_tile_empty():
    rng = np.random.default_rng(2)
    predicted = points(rng, 600)
    keep = consistent(predicted, predicted + rng.uniform(-1.5, 1.5, predicted.shape), rng)
    assert keep.mean() < 0.05


def test_points_the_camera_does_not_see_never_agree():
    rng = np.random.default_rng(3)
    predicted = points(rng)
    measured = predicted.copy()
    predicted[::7] = np.nan
    keep = consistent(predicted, measured, rng)
    assert not keep[::7].any()
    assert keep.sum() > 1000


def test_thinning_keeps_the_best_of_each_cell():
    film_mm = np.array([[0.0, 0.0], [0.5, 0.5], [-0.5, 0.2], [30.0, 0.0]])
    keep = thinned(film_mm, np.array([0.2, 0.9, 0.5, 0.1]), cell_mm=5.0, per_cell=2)
    assert keep.tolist() == [False, True, True, True]


def test_thinning_evens_out_a_crowd():
    rng = np.random.default_rng(4)
    crowd = np.concatenate([points(rng, 300), rng.uniform(-4, 4, (3000, 2))])
    keep = thinned(crowd, rng.random(len(crowd)), cell_mm=10.0, per_cell=2)
    assert (np.abs(crowd[keep]).max(axis=1) < 4).sum() <= 2 * 4


def test_check_blocks_are_half_of_the_film_and_whole():
    rng = np.random.default_rng(5)
    film_mm = points(rng, 20000)
    check = in_check_blocks(film_mm, HALF_LENGTH_MM, HALF_WIDTH_MM, columns=10, rows=2)
    assert abs(check.mean() - 0.5) < 0.02
    block = np.floor((film_mm / (2 * np.array([HALF_LENGTH_MM, HALF_WIDTH_MM])) + 0.5) * (10, 2))
    for value in np.unique(block, axis=0):
        assert len(np.unique(check[(block == value).all(axis=1)])) == 1
