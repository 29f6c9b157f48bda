from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from cosp.dense.coarse_to_fine import FRACTIONS, STRIP_HALO_PX, Pass, match, plan_passes, strip_alignment_px
from cosp.dense.resampling import SmoothField
from cosp.dense.validity import Validity, doubly_claimed
from cosp.geometry.statistics import nmad
from tests.dense.synthetic import errors, render, texture


def bad_share(error, limit_px=1.0):
    return (np.abs(error) > limit_px).mean()


def test_a_leaning_plane_is_recovered_almost_everywhere(pair, settings):
    error, density = errors(pair, match(pair.left, pair.right, (0, 48), **settings))
    assert density > 0.99
    assert bad_share(error) < 0.01
    assert abs(np.median(error)) < 0.02
    assert 0.01 < nmad(error) < 0.1  # px; a parabola instead of equal slopes gives 0.22


def test_sub_pixel_disparities_are_not_drawn_to_whole_pixels(pair, settings):
    found = match(pair.left, pair.right, (0, 48), **settings)
    given = pair.seen & (found.validity == 0)
    fraction = (pair.disparity % 1)[given]
    error = (found.disparity - pair.disparity)[given]
    bias = [np.median(error[(fraction >= low) & (fraction < low + 0.1)]) for low in np.arange(10) / 10]
    assert np.ptp(bias) < 0.05  # px; measured 0.02


@pytest.mark.parametrize("gamma", [0.7, 1.4])
def test_a_change_of_gamma_and_contrast_costs_little(ground, slope, settings, gamma):
    changed = render(ground, slope, gamma=gamma, rng=np.random.default_rng(1))
    error, density = errors(changed, match(changed.left, changed.right, (0, 48), **settings))
    assert density > 0.98
    assert bad_share(error) < 0.015


def test_a_cliff_stays_a_cliff(ground, settings):
    cliff = np.full(ground.shape, 10.0)
    cliff[:, 200:] = 22.0
    stepped = render(ground, cliff, rng=np.random.default_rng(1))
    found = match(stepped.left, stepped.right, (0, 48), **settings)
    error, _ = errors(stepped, found)
    assert bad_share(error) < 0.02
    given = (found.validity == 0) & stepped.seen
    between = given & (np.abs(found.disparity - 16) < 4)
    assert between.sum() < 3 * len(cliff)  # columns in each row that lie on neither level


def test_what_only_the_left_picture_sees_is_masked(ground, settings):
    wall = np.full(ground.shape, 22.0)
    wall[:, 200:] = 10.0  # the higher left part hides twelve columns of the lower right one
    hidden = render(ground, wall, rng=np.random.default_rng(1))
    found = match(hidden.left, hidden.right, (0, 48), **settings)
    assert not hidden.seen[20:-20, 202:210].any()
    assert (found.validity[20:-20, 202:210] != 0).mean() > 0.4  # a surface laid over it may be consistent, too
    assert (found.validity[20:-20, 230:380] != 0).mean() < 0.01


def test_saturated_snow_is_masked_and_not_invented(pair, settings):
    snow = np.s_[60:160, 120:260]
    left, right = pair.left.copy(), pair.right.copy()
    left[snow] = 255
    right[60:160, 140:290] = 255
    found = match(left, right, (0, 48), **settings)
    assert (found.validity[70:150, 130:240] & Validity.SATURATED != 0).all()
    assert np.isnan(found.disparity[70:150, 130:240]).all()
    assert (found.validity[170:230, 60:330] == 0).mean() > 0.98


def test_ground_without_texture_is_masked(pair, settings):
    rng = np.random.default_rng(8)
    left, right = pair.left.copy(), pair.right.copy()
    left[60:160, 120:260] = np.rint(120 + rng.normal(0, 1, (100, 140)))
    right[60:160, 140:290] = np.rint(120 + rng.normal(0, 1, (100, 150)))
    found = match(left, right, (0, 48), **settings)
    assert (found.validity[70:150, 130:240] & Validity.LOW_TEXTURE != 0).all()


def test_what_lies_beyond_the_edge_of_the_right_picture_takes_no_match_from_others(ground, settings):
    flat = np.full(ground.shape, 12.0)
    pair = render(ground, flat, rng=np.random.default_rng(1))
    right = pair.right.copy()
    right[:, 300:] = 0  # columns 288 and beyond of the left picture are seen by it alone
    found = match(pair.left, right, (-80, 48), **{**settings, "least_correlation": 0.0, "largest_speckle_px": 0})
    assert (found.validity[20:-20, 90:270] == 0).mean() > 0.98
    assert (found.validity[:, 296:] == 0).mean() < 0.01


def test_a_right_pixel_goes_to_the_better_supported_of_two_claims():
    disparity = np.full((40, 300), np.nan, np.float32)
    disparity[:, 20:150] = 30.0  # right columns 50 to 179
    disparity[10:20, 200:210] = -100.0  # right columns 100 to 109 again, a small patch
    confidence = np.full(disparity.shape, 50, np.uint8)
    lost = doubly_claimed(disparity, confidence, 320)
    expected = np.zeros(disparity.shape, bool)
    expected[10:20, 200:210] = True
    assert_array_equal(lost, expected)


def test_where_a_picture_has_no_data_there_is_no_disparity(pair, settings):
    left, right = pair.left.copy(), pair.right.copy()
    left[:40] = 0
    right[200:] = 0
    found = match(left, right, (0, 48), **settings)
    # The census of 7 x 9 pixels reaches three rows further than the pixel itself.
    without = np.zeros(left.shape, bool)
    without[:43] = True
    assert_array_equal(found.validity & Validity.NO_DATA_LEFT != 0, without)
    assert (found.validity[205:] & Validity.NO_DATA_RIGHT != 0).all()
    error, _ = errors(replace(pair, seen=pair.seen & (left > 0)), found)
    assert bad_share(error) < 0.01
    assert (found.validity[50:190, 20:370] == 0).mean() > 0.98


def test_the_amount_of_nothing_around_a_film_changes_no_bit(pair, settings):
    found = []
    for margin in (512, 640):  # whole pixels of the coarsest level
        left, right = (np.pad(picture, margin) for picture in (pair.left, pair.right))
        one = match(left, right, (0, 200), **settings)
        inner = np.s_[margin:-margin, margin:-margin]
        outer = one.validity.copy()
        outer[inner] = Validity.NO_DATA_LEFT
        assert (outer & Validity.NO_DATA_LEFT != 0).all()
        found.append([values[inner] for values in (one.disparity, one.validity, one.confidence, one.similarity)])
    for less, more in zip(*found, strict=True):
        assert_array_equal(less, more)


def test_a_scratch_over_water_is_not_matched_with_one_of_the_other_film(pair, settings):
    rng = np.random.default_rng(3)
    left, right = (np.rint(120 + rng.normal(0, 1, pair.left.shape)).astype(np.uint8) for _ in range(2))
    left[:, 200:202] = right[:, 215:217] = 200
    left[:, :60], right[:, :80] = pair.left[:, :60], pair.right[:, :80]
    found = match(left, right, (0, 48), **settings)
    assert (found.validity[:, 100:300] != 0).all()
    assert (found.validity[20:-20, 10:50] == 0).mean() > 0.9


def test_edges_of_the_films_are_not_matched_with_each_other(ground, slope, settings):
    pair = render(ground, slope, rng=np.random.default_rng(1))
    left, right = pair.left.copy(), pair.right.copy()
    left[:, :60] = 0
    right[:, :130] = 0  # what left columns 60 to 105 show lies beyond
    found = match(left, right, (0, 64), **settings)
    beyond = np.arange(420) + slope < 125
    wrong = (found.validity == 0) & (np.abs(found.disparity - slope) > 1)
    assert (beyond[:, 60:]).sum() > 5000
    assert (found.validity[beyond] == 0).mean() < 0.002
    assert wrong.mean() < 0.01  # the last columns before an edge lean on one side only


def test_swapping_the_pictures_only_changes_the_sign_of_disparity(pair, settings):
    forth = match(pair.left, pair.right, (0, 48), **settings)
    back = match(pair.right, pair.left, (-48, 0), **settings)
    rows, columns = np.nonzero((forth.validity == 0) & pair.seen)
    there = np.rint(columns + forth.disparity[rows, columns]).astype(int)
    inside = (there >= 0) & (there < pair.right.shape[1])
    difference = forth.disparity[rows, columns][inside] + back.disparity[rows[inside], there[inside]]
    difference = difference[np.isfinite(difference)]
    assert difference.size > 0.97 * inside.sum()
    assert abs(np.median(difference)) < 0.02
    assert bad_share(difference) < 0.01


def test_y_parallax_given_brings_the_accuracy_back(ground, slope, pair, settings):
    columns = np.arange(ground.shape[1])
    nodes = np.arange(0, ground.shape[1] + 20, 20)
    y_parallax = 2.5 * np.sin(columns / 60) + 0.5  # by left column
    moved = render(ground, slope, y_parallax=y_parallax_on_the_right(y_parallax, slope), rng=np.random.default_rng(1))
    field = SmoothField(np.tile(np.interp(nodes, columns, y_parallax), (2, 1)).astype(np.float32), 0, 0, 300, 20)
    unmasked = {**settings, "least_uniqueness": 0.0, "least_correlation": -1.0}
    without, _ = errors(moved, match(moved.left, moved.right, (0, 48), **unmasked))
    folded, density = errors(moved, match(moved.left, moved.right, (0, 48), y_parallax=field, **settings))
    clean, _ = errors(pair, match(pair.left, pair.right, (0, 48), **settings))
    assert nmad(without) > 2.5 * nmad(clean)
    assert nmad(folded) < 1.8 * nmad(clean)  # between rows the right picture is interpolated, which blurs it
    assert bad_share(clean) < 0.001
    assert bad_share(folded) < 0.002
    assert bad_share(without) > 20 * bad_share(folded)
    assert density > 0.98


def y_parallax_on_the_right(y_parallax, disparity):
    """The same by the right picture's columns, as the renderer wants it."""
    columns = np.arange(disparity.shape[1])
    return np.stack([np.interp(columns, columns + line, y_parallax) for line in disparity])


def test_the_number_of_threads_changes_nothing(pair, settings):
    one = match(pair.left, pair.right, (0, 48), **{**settings, "threads": 1}, tile_px=128)
    three = match(pair.left, pair.right, (0, 48), **{**settings, "threads": 3}, tile_px=128)
    for ours, theirs in ((one.disparity, three.disparity), (one.validity, three.validity)):
        assert_array_equal(ours, theirs)
    assert_array_equal(one.confidence, three.confidence)


def test_tiling_changes_next_to_nothing(pair, settings):
    whole = match(pair.left, pair.right, (0, 48), **settings)
    tiled = match(pair.left, pair.right, (0, 48), **settings, tile_px=100)
    inner = well_inside(pair)
    assert np.mean((whole.validity == 0)[inner] != (tiled.validity == 0)[inner]) < 0.001
    both = (whole.validity == 0) & (tiled.validity == 0) & inner
    assert bad_share((whole.disparity - tiled.disparity)[both], 0.25) < 0.003  # tiles a tenth of the usual size


def well_inside(pair, margin_px=20):
    """Pixels whose surroundings both pictures see."""
    return cv2.erode(pair.seen.astype(np.uint8), np.ones((5, 2 * margin_px + 1)), borderValue=0) > 0


def test_a_strip_matched_on_its_own_is_a_part_of_the_whole(settings):
    rng = np.random.default_rng(6)
    rows, columns = np.mgrid[:900, :160]
    tall = render(texture(rows.shape, rng), 10 + 8 * np.sin(rows / 80) + 0.02 * columns, rng=rng)
    whole = match(tall.left, tall.right, (-4, 28), **settings)
    first, last = 400, 600
    start = (first - STRIP_HALO_PX) // strip_alignment_px(32) * strip_alignment_px(32)
    seen = slice(start, last + STRIP_HALO_PX)
    strip = match(tall.left[seen], tall.right[seen], (-4, 28), **settings)
    part, own = whole.disparity[first:last], strip.disparity[first - start : last - start]
    both = np.isfinite(part) & np.isfinite(own) & well_inside(tall)[first:last]
    assert both.mean() > 0.5
    assert bad_share((part - own)[both], 0.25) < 0.001
    # Asked for these rows alone, finer levels match less of what lies around.
    asked = match(tall.left[seen], tall.right[seen], (-4, 28), **settings, rows=(first - start, last - start))
    assert asked.disparity.shape == asked.validity.shape == part.shape
    inner = well_inside(tall)[first:last]
    assert inner.mean() > 0.5
    assert (np.isfinite(part) != np.isfinite(asked.disparity))[inner].mean() < 0.001
    both = inner & np.isfinite(part) & np.isfinite(asked.disparity)
    assert bad_share((part - asked.disparity)[both], 0.25) < 0.001


def test_disparities_are_whole_fractions_and_missing_exactly_where_they_are_invalid(pair, settings):
    found = match(pair.left, pair.right, (0, 48), **settings)
    assert_array_equal(np.isnan(found.disparity), found.validity != 0)
    scaled = found.disparity[found.validity == 0] * FRACTIONS
    assert_array_equal(scaled, np.rint(scaled))


def test_confidence_is_lower_where_matches_are_wrong(ground, slope, settings):
    grainy = render(ground, slope, gain=8.0, grain=8.0, rng=np.random.default_rng(1))
    found = match(
        grainy.left, grainy.right, (0, 48), **{**settings, "least_correlation": -1.0, "least_uniqueness": 0.0}
    )
    given = grainy.seen & (found.validity == 0)
    wrong = given & (np.abs(found.disparity - grainy.disparity) > 1)
    assert wrong.sum() > 200
    assert np.median(found.confidence[wrong]) < 0.8 * np.median(found.confidence[given & ~wrong])

    checked = match(grainy.left, grainy.right, (0, 48), **settings)
    kept = checked.validity == 0
    assert (wrong & kept).sum() < 0.7 * wrong.sum()
    assert (wrong & ~kept).sum() / wrong.sum() > 10 * (given & ~wrong & ~kept).sum() / (given & ~wrong).sum()


def test_the_range_searched_grows_by_levels_and_not_by_work():
    for span in (10, 64, 256, 1400, 3000):
        passes = plan_passes(span)
        assert passes[-2:] == [Pass(1, 32), Pass(0, 32)]
        assert max(step.disparities for step in passes) <= 64
        assert span / 2 ** passes[0].level <= passes[0].disparities - 16
    assert plan_passes(1400)[0] == Pass(5, 64)


def test_pictures_of_different_height_are_refused(settings):
    with pytest.raises(ValueError, match="20 and 21 rows"):
        match(np.ones((20, 50), np.uint8), np.ones((21, 50), np.uint8), (0, 8), **settings)


def test_a_range_upside_down_is_refused(settings):
    with pytest.raises(ValueError, match="lowest"):
        match(np.ones((20, 50), np.uint8), np.ones((20, 50), np.uint8), (8, 0), **settings)


def test_a_picture_smaller_than_the_census_gives_nothing_and_does_not_fail(settings):
    found = match(np.full((5, 6), 9, np.uint8), np.full((5, 6), 9, np.uint8), (0, 8), **settings)
    assert (found.validity != 0).all()
