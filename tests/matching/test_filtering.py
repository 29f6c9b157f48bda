import numpy as np

from cosp.matching.filtering import agreeing_with_neighbours, consistent_by_tile, in_check_blocks, thinned

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


TEMPLATE_MM = 10.0


def templates(rng, *, right):
    """Film points of templates in fours, half a template apart, and shifts of which those of a wrong four are alike."""
    middle = points(rng, 400)
    film_mm = (middle[:, None] + TEMPLATE_MM / 4 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])).reshape(-1, 2)
    # A placed camera that is off by more than the gate, and otherwise at the other end of the film.
    bent = np.column_stack([0.6 + 0.3 * film_mm[:, 0] / HALF_LENGTH_MM, -0.2 - (film_mm[:, 0] / 500) ** 2])
    wrong = np.repeat(rng.random(len(middle)) >= right, 4)
    chance = np.repeat(rng.uniform(-1.4, 1.4, middle.shape), 4, axis=0)
    shift = np.where(wrong[:, None], chance, bent) + 0.03 * rng.standard_normal(film_mm.shape)
    return film_mm, shift, wrong, np.linalg.norm(shift - bent, axis=1)


def neighbourly(film_mm, shift, **changes):
    chosen = dict(template_mm=TEMPLATE_MM, reach_mm=30.0, gate_mm=0.3, min_places=4, min_share=0.5)
    return agreeing_with_neighbours(film_mm - shift, film_mm, **{**chosen, **changes})


def test_weak_matches_are_kept_where_most_of_their_neighbours_say_the_same():
    film_mm, shift, wrong, error_mm = templates(np.random.default_rng(6), right=0.7)
    keep = neighbourly(film_mm, shift)
    assert keep[~wrong].mean() > 0.9
    assert error_mm[keep].max() < 0.5  # the gate, and what right ones differ by
    assert (keep & (error_mm > 0.3)).sum() < 0.02 * keep.sum()


def test_where_the_film_shows_nothing_no_match_is_kept_though_those_of_a_template_err_alike():
    for seed in range(5):
        film_mm, shift, *_ = templates(np.random.default_rng(seed), right=0.0)
        assert not neighbourly(film_mm, shift).any()
        # Were they asked, those nearest would vouch for it.
        assert neighbourly(film_mm, shift, template_mm=1.0, min_share=0.05).mean() > 0.3


def test_among_a_majority_of_wrong_matches_few_are_kept_and_these_are_right():
    for seed in range(7, 10):
        film_mm, shift, _, error_mm = templates(np.random.default_rng(seed), right=0.3)
        keep = neighbourly(film_mm, shift)
        assert 0.0 < keep.mean() < 0.1
        assert error_mm[keep].max() < 0.5


def test_a_match_without_enough_neighbours_apart_is_not_kept():
    film_mm = np.array([[0.0, 0.0], [12.0, 0.0], [0.0, 12.0], [12.0, 12.0], [24.0, 0.0]])
    shift = np.full(film_mm.shape, 0.3)
    assert neighbourly(film_mm, shift).all()
    assert not neighbourly(film_mm[:4], shift[:4]).any()
    assert neighbourly(film_mm[:4], shift[:4], min_places=3).all()
    shift[0] = np.nan
    assert not neighbourly(film_mm, shift).any()


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
