import numpy as np
import pytest
from scipy.ndimage import shift as shift_image

from cosp.errors import InputError
from cosp.matching.correspondences import Correspondences
from cosp.matching.ground import lattice_rc
from cosp.matching.matchers import matcher_by_name, structural
from cosp.matching.structural import orientation_channels

from .conftest import texture


def pair(shift_rc, *, size=200, reverse=False, noise=0.0, seed=1):
    rng = np.random.default_rng(seed)
    fixed = texture((size, size), rng)
    moving = shift_image(fixed, -np.array(shift_rc), order=3, mode="wrap")
    if reverse:
        moving = 255 - moving
    return moving + noise * rng.standard_normal(moving.shape), fixed


def matcher(search_px=12, template_px=49, min_score=0.3):
    return structural(template_px, search_px, min_score, 0.9, 1.0)


def inner(size=200):
    return lattice_rc((size, size), 24, 40)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.3, -5.7), (-8.5, 9.25)])
@pytest.mark.parametrize("reverse", [False, True])
def test_known_shifts_are_recovered_under_noise_and_contrast_reversal(shift, reverse):
    moving, fixed = pair(shift, reverse=reverse, noise=10.0)
    found = matcher().match(moving, fixed, inner(), threads=1)
    error = found.fixed_rc - found.moving_rc - shift
    assert len(found) > 0.9 * len(inner())
    assert np.abs(np.median(error, axis=0)).max() < 0.05
    assert np.sqrt((error**2).mean()) < 0.15


def test_stated_sigma_is_neither_much_too_small_nor_much_too_large():
    moving, fixed = pair((2.4, -1.3), noise=25.0)
    found = matcher().match(moving, fixed, inner(), threads=1)
    error = found.fixed_rc - found.moving_rc - (2.4, -1.3)
    ratio = np.sqrt((error**2).mean()) / np.median(found.sigma_px)
    assert 0.1 < ratio < 1.5


def test_unrelated_images_do_not_match():
    rng = np.random.default_rng(3)
    found = matcher().match(texture((200, 200), rng), texture((200, 200), rng), inner(), threads=1)
    assert len(found) <= 1


def test_a_shift_beyond_the_search_is_not_found():
    moving, fixed = pair((0.0, 30.0))
    assert len(matcher(search_px=8).match(moving, fixed, inner(), threads=1)) <= 1


def test_ground_without_data_gives_no_matches_and_spoils_none_beside_it():
    moving, fixed = pair((1.5, 0.5))
    fixed[:, 100:] = np.nan
    found = matcher().match(moving, fixed, inner(), threads=1)
    assert len(found) > 5
    assert found.fixed_rc[:, 1].max() < 90
    assert np.abs(found.fixed_rc - found.moving_rc - (1.5, 0.5)).max() < 0.3


def test_matches_are_the_same_with_any_number_of_threads():
    moving, fixed = pair((1.5, 0.5), size=260)
    points = lattice_rc((260, 260), 20, 40)
    one, three = (matcher().match(moving, fixed, points, threads=n) for n in (1, 3))
    np.testing.assert_array_equal(one.fixed_rc, three.fixed_rc)


def test_channels_are_blind_to_contrast_and_contrast_reversal():
    image = texture((80, 80), np.random.default_rng(2))
    plain = orientation_channels(image, bins=9, sigma_px=1.0)
    np.testing.assert_allclose(orientation_channels(400 - 3 * image, bins=9, sigma_px=1.0), plain, atol=1e-3)


def test_a_ramp_fills_the_channel_of_its_direction():
    rows, columns = np.mgrid[0:60, 0:60]
    angle = np.radians(40.0)  # the centre of channel 2 of 9
    channels = orientation_channels(columns * np.cos(angle) + rows * np.sin(angle), bins=9, sigma_px=1.0)
    assert channels[:, 30, 30].argmax() == 2


def test_sift_finds_a_shift_between_images_that_look_alike():
    moving, fixed = pair((4.0, -3.0), size=300)
    sift = matcher_by_name("sift", template_px=49, search_px=12, min_score=0.3, max_ratio=0.9, max_return_px=1.0)
    found = sift.match(moving, fixed, inner(), threads=1)
    assert len(found) > 30
    np.testing.assert_allclose(np.median(found.fixed_rc - found.moving_rc, axis=0), (4.0, -3.0), atol=0.1)


@pytest.mark.parametrize(
    ("name", "message"), [("lightglue", "not one of"), ("superglue", "superglue_weights"), ("orb", "not one of")]
)
def test_a_matcher_that_cannot_be_had_is_refused_by_name(name, message):
    with pytest.raises(InputError, match=message):
        matcher_by_name(name, template_px=49, search_px=12, min_score=0.3, max_ratio=0.9, max_return_px=1.0)


def test_rough_matches_are_refined_to_a_fraction_of_a_pixel_and_wrong_ones_left_out():
    shift = np.array([3.3, -5.7])
    moving, fixed = pair(shift, noise=10.0)
    rng = np.random.default_rng(6)
    points = inner()
    rough = points + shift + rng.uniform(-1.5, 1.5, points.shape)
    wrong = np.arange(len(points)) % 3 == 0
    rough[wrong] += rng.choice([-20.0, 20.0], (wrong.sum(), 2))
    score = np.where(wrong, 0.9, rng.random(len(points)))
    given = Correspondences(points, rough, score, np.ones(len(points)))
    found = matcher().refine(moving, fixed, given, reach_px=4, threads=1)
    error = found.fixed_rc - found.moving_rc - shift
    assert np.sqrt((error**2).mean()) < 0.15
    assert len(found) >= 0.9 * (~wrong).sum()
    # A match keeps its own score.
    kept = {tuple(point): s for point, s in zip(points, score, strict=True)}
    assert [kept[tuple(point)] for point in found.moving_rc] == found.score.tolist()
