from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from cosp.arrays import ByteArray
from cosp.errors import InputError, StitchingError
from cosp.film.arrangement import Arrangement, SeamLimits, arrange, posed
from cosp.film.joining import Layout, compose, compose_reduced, lay_out
from cosp.film.stitching import (
    Seam,
    correlate_patches,
    find_features,
    match_features,
    match_patches,
    refine_seam,
    require_part,
)
from cosp.geometry.transforms import Rigid
from cosp.imaging.resampling import block_mean, sample
from cosp.imaging.windows import Window
from tests.film.synthetic import Film, cut, make_film, texture

LIMITS = SeamLimits(
    overlap_mm=(5, 120), offset_mm=10, feature_pixel_mm=0.28, ratio=0.85, min_features=15, min_margin=2.0
)
GAINS = (1.0, 0.9, 1.1)


@pytest.fixture(scope="module")
def film() -> Film:
    return make_film(np.random.default_rng(4), pixel_mm=0.14, length_mm=300.0, leader_mm=8.0)


@pytest.fixture(scope="module")
def scanned(film: Film) -> tuple[list[ByteArray], list[Rigid]]:
    return cut(
        film,
        np.random.default_rng(5),
        overlaps_mm=(30.0, 14.0),
        rotations_deg=(0.1, -0.4, 0.5),
        gains=GAINS,
    )


@pytest.fixture(scope="module")
def joined(scanned: tuple[list[ByteArray], list[Rigid]]) -> tuple[Arrangement, list[Seam], Layout]:
    parts, _ = scanned
    arrangement = _arranged(parts)
    seams = _seams(parts, arrangement)
    return arrangement, seams, lay_out([p.shape for p in parts], seams, feather_px=12.0)


def _arranged(parts: list[ByteArray], names: str = "abcd") -> Arrangement:
    return arrange(parts, names=list(names), pixel_mm=0.14, limits=LIMITS, rng=np.random.default_rng(0))


def _seams(parts: list[ByteArray], arrangement: Arrangement) -> list[Seam]:
    laid = [posed(parts[i], pose) for i, pose in zip(arrangement.order, arrangement.poses, strict=True)]
    return [
        refine_seam(
            laid[k],
            laid[k + 1],
            coarse,
            min_score=0.5,
            min_inliers=10,
            names=("a", "b"),
            rng=np.random.default_rng(0),
            threads=1,
        )
        for k, coarse in enumerate(arrangement.seams)
    ]


def _worst_px(motion: Rigid, truth: Rigid, shape: tuple[int, ...], overlap_px: int) -> float:
    """Largest difference of two motions over the overlap."""
    corners = np.array([[x, y] for x in (0, overlap_px) for y in (0, shape[0])], float)
    return float(np.linalg.norm(motion.apply(corners) - truth.apply(corners), axis=1).max())


def test_seams_are_found_within_a_twentieth_of_a_pixel(scanned, joined):
    parts, motions = scanned
    _, seams, _ = joined
    for k, seam in enumerate(seams):
        truth = motions[k].inverse().after(motions[k + 1])
        assert _worst_px(seam.motion, truth, parts[k].shape, seam.overlap_px) < 0.05
        # Grain of one grey level and interpolation leave something, but little.
        assert 0.001 < seam.rms_px < 0.1
        assert seam.check_rms_px < 0.1


def test_brightness_of_the_parts_is_balanced(joined, scanned):
    _, seams, layout = joined
    for k, seam in enumerate(seams):
        assert_allclose(seam.gain, GAINS[k] / GAINS[k + 1], rtol=0.01)
    gains = np.array([g for g, _ in layout.greys])
    assert_allclose(gains * GAINS, (gains * GAINS).mean(), rtol=0.01)
    assert_allclose(np.log(gains).mean(), 0.0, atol=1e-12)


def test_the_joined_film_is_the_film_that_was_cut(film, joined, scanned):
    parts, motions = scanned
    _, _, layout = joined
    whole = compose(parts, layout, Window(0, layout.shape[0], 0, layout.shape[1]))
    # Joined film -> part a -> film, at places over the whole picture, joints included.
    rng = np.random.default_rng(1)
    back = motions[0].after(layout.motions[0].inverse())
    xy = np.column_stack([rng.uniform(100, film.image.shape[1] - 100, 40), rng.uniform(180, 380, 40)])
    for joint in layout.joints_px:
        xy = np.vstack([xy, [[joint, y] for y in (180.0, 280.0, 380.0)]])
    for x, y in xy:
        r, c = np.mgrid[-12:13, -12:13]
        here = back.inverse().apply(np.array([x, y]))
        grid = back.apply(np.stack([c + np.rint(here[0]), r + np.rint(here[1])], axis=-1))
        expected = sample(film.image.astype(np.float32), grid[..., 1], grid[..., 0])
        rows, columns = r + round(here[1]), c + round(here[0])
        found = whole[rows, columns].astype(float)
        # Contrast may differ by the balance, structure may not: a ghost of 0.3 px would cost several per cent.
        assert np.corrcoef(found.ravel(), expected.ravel())[0, 1] > 0.985


def test_windows_of_the_joined_film_agree_with_the_whole(joined, scanned):
    parts, _ = scanned
    _, _, layout = joined
    whole = compose(parts, layout, Window(0, layout.shape[0], 0, layout.shape[1]))
    joint = round(layout.joints_px[0])
    window = Window(37, 300, joint - 101, joint + 77)
    # Places are rounded to a 32nd of a pixel, which a steep edge shows.
    assert np.abs(whole[window.slices].astype(int) - compose(parts, layout, window)).max() <= 3


def test_the_reduced_film_is_the_joined_film_reduced(joined, scanned):
    parts, _ = scanned
    _, _, layout = joined
    whole = compose(parts, layout, Window(0, layout.shape[0], 0, layout.shape[1]))
    small = compose_reduced(parts, layout, 3)
    expected = block_mean(whole, 3)
    assert small.shape == expected.shape
    inside = np.zeros(small.shape, bool)
    inside[10:-10, 10:-10] = True
    difference = small.astype(float) - expected
    assert np.abs(difference[inside]).mean() < 6.0  # fine texture between pixels, seen twice
    # A shift by half a small pixel would show in the product of difference and gradient.
    for axis in (0, 1):
        slope = np.gradient(expected.astype(float), axis=axis)
        assert abs((difference * slope)[inside].sum() / (slope[inside] ** 2).sum()) < 0.02


def test_parts_back_to_front_are_put_in_order(scanned):
    parts, _ = scanned
    assert _arranged(parts[::-1]).order == (2, 1, 0)


def test_a_film_of_one_part_passes_through_unchanged(film):
    arrangement = _arranged([film.image])
    layout = lay_out([film.image.shape], [], feather_px=10.0)
    assert arrangement.seams == ()
    rows, columns = film.image.shape
    assert_array_equal(compose([film.image], layout, Window(0, rows, 0, columns)), film.image)


@pytest.mark.slow
def test_shuffled_turned_and_mirrored_parts_are_put_right(scanned):
    parts, _ = scanned
    shuffled = [parts[2], np.ascontiguousarray(parts[0][::-1, ::-1]), np.ascontiguousarray(parts[1][::-1])]
    arrangement = _arranged(shuffled)
    laid = [posed(shuffled[i], pose) for i, pose in zip(arrangement.order, arrangement.poses, strict=True)]
    assert arrangement.order == (1, 2, 0)
    for found, expected in zip(laid, parts, strict=True):
        assert_array_equal(found, expected)


@pytest.mark.slow
def test_two_pieces_that_a_nearly_blank_overlap_joins_are_put_in_order(film):
    """Sea under the first overlap: of the eight ways to lay the part beside the others, closer looks tell one."""
    image = film.image.astype(np.float32)
    left = image.shape[1] // 3
    image[:, left - 200 : left + 200] = 80 + 0.12 * (image[:, left - 200 : left + 200] - 80)
    sea = Film(np.rint(image).astype(np.uint8), film.centre, film.pixel_mm, film.tilt_rad)
    parts, motions = cut(
        sea, np.random.default_rng(6), overlaps_mm=(40.0, 20.0), rotations_deg=(0.1, -0.4, 0.5), gains=GAINS
    )
    shuffled = [parts[1], parts[2], np.ascontiguousarray(parts[0][::-1, ::-1])]
    arrangement = _arranged(shuffled)
    assert arrangement.order == (2, 0, 1)
    laid = [posed(shuffled[i], pose) for i, pose in zip(arrangement.order, arrangement.poses, strict=True)]
    for found, expected in zip(laid, parts, strict=True):
        assert_array_equal(found, expected)
    seam = _seams(shuffled, arrangement)[0]
    assert _worst_px(seam.motion, motions[0].inverse().after(motions[1]), parts[0].shape, seam.overlap_px) < 0.3


def test_patches_find_the_place_of_ground_without_keypoints():
    """Sea: one grey level of texture under two of noise."""
    rng = np.random.default_rng(12)
    sea = 90 + 5 * (texture((660, 1500), rng) - 0.5)
    truth = Rigid(0.004, (880.3, 9.6))
    columns, rows = np.meshgrid(np.arange(620.0), np.arange(600.0))
    place = truth.apply(np.stack([columns, rows], axis=-1))
    left, right, other = (
        np.rint(image + rng.normal(0, 2.0, image.shape)).astype(np.uint8)
        for image in (
            sea[:600, :1000].astype(np.float32),
            sample(sea.astype(np.float32), place[..., 1], place[..., 0]),
            90 + 5 * (texture((600, 620), rng).astype(np.float32) - 0.5),
        )
    )
    wanted = {"overlap_px": (35.0, 850.0), "offset_px": 60.0, "gate_px": 4.0, "rng": np.random.default_rng(0)}
    features = [find_features(part, factor=1) for part in (left, right)]
    by_keypoints = match_features(*features, left_width_px=1000, ratio=0.85, **wanted)
    assert by_keypoints is None or by_keypoints.inliers < 12
    by_patches = match_patches(left, right, factor=2, patch_px=48, **wanted)
    assert by_patches is not None
    assert by_patches.inliers > 15 > 5 * by_patches.rivals
    corners = np.array([[0.0, 0.0], [110.0, 0.0], [0.0, 590.0], [110.0, 590.0]])
    assert_allclose(by_patches.motion.apply(corners), truth.apply(corners), atol=1.5)
    unrelated = match_patches(left, other, factor=2, patch_px=48, **wanted)
    assert unrelated is None or unrelated.inliers < 12


@pytest.mark.slow
def test_parts_that_do_not_join_are_refused_by_name(scanned):
    parts, _ = scanned
    with pytest.raises(StitchingError, match="seam [a-c] - [a-c]"):
        _arranged([parts[0], parts[2]])


@pytest.mark.slow
def test_parts_of_two_films_are_refused_by_name(scanned):
    parts, _ = scanned
    other, _ = cut(
        make_film(np.random.default_rng(40), pixel_mm=0.14, length_mm=300.0, leader_mm=8.0),
        np.random.default_rng(5),
        overlaps_mm=(30.0, 14.0),
        rotations_deg=(0.1, -0.4, 0.5),
    )
    with pytest.raises(StitchingError, match="seam [a-c] - [a-c]"):
        _arranged([parts[0], parts[1], other[2]])


def test_a_part_given_twice_is_refused_by_name(scanned):
    parts, _ = scanned
    with pytest.raises(StitchingError, match="a and c are the same picture"):
        _arranged([parts[0], parts[1], parts[0].copy()])


def test_two_real_overlapping_scans_are_joined():
    folder = os.environ.get("COSP_TEST_DATA")
    if not folder:
        pytest.skip("COSP_TEST_DATA is not set: no real film")
    parts = [cv2.imread(str(Path(folder) / "film" / f"kh9mc_1216-5_part_{k}.png"), cv2.IMREAD_GRAYSCALE) for k in "ab"]
    if any(part is None for part in parts):
        pytest.skip(f"{folder}/film has no KH-9 parts: no real film")
    limits = SeamLimits((5, 120), 8, 0.133, 0.8, 12, 2.0)
    arrangement = arrange(parts, names=["a", "b"], pixel_mm=0.133, limits=limits, rng=np.random.default_rng(0))
    assert arrangement.order == (0, 1)
    # The seam sees every other band of rows; the others hold the tie points that it is held against.
    rows = np.arange(parts[0].shape[0])
    hidden = rows // 120 % 2 == 1
    rng = np.random.default_rng(7)
    shown = [part.copy() for part in parts]
    for part in shown:
        part[hidden] = rng.integers(60, 200, (hidden.sum(), part.shape[1]))
    (seam,) = _seams(shown, arrangement)
    assert_allclose(seam.motion.shift, [1686.7, 0.8], atol=1.0)
    points = np.stack(np.meshgrid(np.arange(1700, 1756, 16.0), np.arange(20, 1745, 16.0)), axis=-1).reshape(-1, 2)
    points = points[np.abs(points[:, 1] % 240 - 180) < 50]
    shift, score, ratio = correlate_patches(
        *parts, seam.motion, points, size=(16, 16), search_px=5, threads=1
    )  # fmt: skip
    tied = (score > 0.6) & (ratio < 0.95) & (np.linalg.norm(shift, axis=1) < 3.0)
    assert tied.sum() >= 40
    assert 0.05 < np.sqrt(np.mean((shift[tied] ** 2).sum(axis=1))) < 0.6


def test_a_blank_overlap_is_refused_by_name(scanned, joined):
    parts, _ = scanned
    arrangement, _, _ = joined
    blank = np.random.default_rng(2).integers(100, 104, parts[1].shape).astype(np.uint8)
    with pytest.raises(StitchingError, match="seam a - b"):
        _seams([parts[0], blank, parts[2]], arrangement)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"dtype": "uint16"}, "1 band.s. of uint16"),
        ({"bands": 3}, "3 band.s. of uint8"),
        ({"shape": (500, 400)}, "longer along its columns"),
        ({"pixel_mm": 0.014}, "is pixel_um right"),
    ],
)
def test_a_raster_that_is_no_part_is_named(change, said):
    good = {"shape": (10000, 30000), "bands": 1, "dtype": "uint8", "pixel_mm": 0.007}
    require_part("film_a.tif", **good, width_mm=(60.0, 110.0))
    with pytest.raises(InputError, match=f"film_a.tif.*{said}"):
        require_part("film_a.tif", **{**good, **change}, width_mm=(60.0, 110.0))
