import numpy as np

from cosp.geometry.grids import PixelGrid
from cosp.matching.control import coverage, height_sigma_m, saturated, slope_deg
from cosp.matching.film_image import FilmImage
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


def test_coverage_tells_a_full_film_from_one_end():
    rng = np.random.default_rng(6)
    film_mm = points(rng, 4000)
    whole = coverage(film_mm, HALF_LENGTH_MM, HALF_WIDTH_MM, 20, 3)
    end = coverage(film_mm[film_mm[:, 0] > 286], HALF_LENGTH_MM, HALF_WIDTH_MM, 20, 3)
    assert (whole["cells"], whole["along"], whole["across"]) == (1.0, 1.0, 1.0)
    assert (end["along"], end["across"]) == (0.1, 1.0)
    assert np.sum(whole["counts"]) == 4000


def test_slope_of_a_plane_is_its_own_and_makes_heights_uncertain():
    columns = np.arange(20.0)[None, :] * np.ones((20, 1))
    slope = slope_deg((30.0 * columns).astype(np.float32), 30.0)
    np.testing.assert_allclose(slope, 45.0, atol=1e-4)
    np.testing.assert_allclose(height_sigma_m(np.array([0.0, 45.0]), np.array([3.0, 3.0]), 4.0), [4.0, 5.0])


def test_overexposed_snow_is_known():
    pixels = np.full((100, 400), 120, np.uint8)
    pixels[:, 200:] = 255
    film = FilmImage.from_array(pixels, PixelGrid(-20.0, 5.0, 0.1, -0.1, pixels.shape))
    found = saturated(film, np.array([[-10.0, 0.0], [10.0, 0.0]]), window_mm=0.5, white=252, max_share=0.5)
    assert found.tolist() == [False, True]
