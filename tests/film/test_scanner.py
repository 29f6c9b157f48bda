from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.arrays import ByteArray, FloatArray
from cosp.film.joining import compose, lay_out
from cosp.film.scanner import (
    Blocks,
    Jump,
    Overlap,
    Steps,
    attributed,
    find_blocks,
    find_jumps,
    measure_overlap,
    steps_of_parts,
    without_steps,
)
from cosp.film.stitching import CoarseSeam, Seam, refine_seam
from cosp.geometry.transforms import Rigid
from cosp.imaging.resampling import sample
from cosp.imaging.windows import Window
from tests.film.synthetic import texture

LIMITS = {"min_significance": 6.0, "min_step_px": 0.15}
WIDTH, HEIGHT = 1500, 700


def _part(
    ground: FloatArray, motion: Rigid, boundaries: list[float], shifts: list[list[float]], wave_px: float, seed: int
) -> ByteArray:
    """A part whose blocks show the ground `shifts` off their place, and which waves smoothly across the film."""
    columns, rows = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    off = np.array(shifts)[np.searchsorted(boundaries, np.arange(WIDTH), side="right")]
    wave = wave_px * np.sin(np.arange(WIDTH) / 300.0)
    place = motion.apply(np.stack([columns - off[:, 0], rows - off[:, 1] + wave], axis=-1))
    grey = sample(ground, place[..., 1], place[..., 0])
    noise = np.random.default_rng(seed).normal(0.0, 2.0, grey.shape)
    return np.clip(np.rint(grey + noise), 1, 255).astype(np.uint8)


MOTIONS = (Rigid(-0.001, (15.3, 20.0)), Rigid(0.003, (915.7, 22.4)))
NONE: tuple[list[float], list[list[float]]] = ([], [[0.0, 0.0]])
LEFT = ([1150.0], [[0.0, 0.0], [1.0, -0.4]])  # by which its right end is off
RIGHT = ([420.0], [[-0.5, 0.8], [0.0, 0.0]])  # by which its left end is off


@pytest.fixture(scope="module")
def ground() -> FloatArray:
    return (40 + 170 * texture((HEIGHT + 60, 2480), np.random.default_rng(11))).astype(np.float32)


def _scanned(
    ground: FloatArray, left: tuple = NONE, right: tuple = NONE, wave_px: float = 0.0
) -> tuple[list[ByteArray], Seam, Overlap]:
    parts = [_part(ground, MOTIONS[0], *left, 0.0, 1), _part(ground, MOTIONS[1], *right, wave_px, 2)]
    truth = MOTIONS[0].inverse().after(MOTIONS[1])
    coarse = CoarseSeam(Rigid(truth.rotation_rad, (truth.shift[0] + 3.0, truth.shift[1] - 2.0)), 50, 1)
    options = {"min_score": 0.6, "threads": 1}
    seam = refine_seam(
        *parts, coarse, min_inliers=12, names=("a", "b"), rng=np.random.default_rng(0), **options
    )  # fmt: skip
    return parts, seam, measure_overlap(*parts, seam.motion, search_px=6, **options)


def _worst_px(motion: Rigid) -> float:
    corners = np.array([[0.0, 0.0], [580.0, 0.0], [0.0, HEIGHT], [580.0, HEIGHT]])
    truth = MOTIONS[0].inverse().after(MOTIONS[1])
    return float(np.abs(motion.apply(corners) - truth.apply(corners)).max())


def test_steps_of_one_pixel_are_found_where_they_are_and_taken_out(ground):
    parts, seam, overlap = _scanned(ground, LEFT, RIGHT)
    jumps = find_jumps(overlap, seam.motion, **LIMITS)
    assert len(jumps) == 2
    first, second = jumps
    assert abs(first.left_px - 1150) < 4
    assert abs(second.right_px - 420) < 4
    # Left minus right part: the left end of the right part is off by (-0.5, 0.8), which ends there.
    assert_allclose(first.size_px, [1.0, -0.4], atol=0.05)
    assert_allclose(second.size_px, [-0.5, 0.8], atol=0.05)
    told = (
        [Jump(j.left_px, j.right_px, j.size_px, j.significance, side)]
        for j, side in zip(jumps, ("left", "right"), strict=True)
    )
    steps = steps_of_parts([[jump for each in told for jump in each]])
    assert_allclose(steps[0].at(np.array([100.0, 1149.0 - 8, 1151.0 + 8])), [[0, 0], [0, 0], [1.0, -0.4]], atol=0.05)
    assert_allclose(steps[1].at(np.array([410.0, 430.0])), [[-0.5, 0.8], [0, 0]], atol=0.05)
    mended = without_steps(seam, overlap, *steps)
    assert _worst_px(mended.motion) < 0.1 < 0.4 < _worst_px(seam.motion)
    assert mended.rms_px < 0.1 < 0.3 < measure_rms(overlap)


def measure_rms(overlap: Overlap) -> float:
    """Residuals before anything is taken out."""
    return float(np.sqrt(np.mean(overlap.residuals**2)))


def test_the_joined_film_shows_no_step(ground):
    parts, seam, overlap = _scanned(ground, LEFT, RIGHT)
    jumps = find_jumps(overlap, seam.motion, **LIMITS)
    sides = ("left", "right")
    jumps = tuple(Jump(j.left_px, j.right_px, j.size_px, j.significance, s) for j, s in zip(jumps, sides, strict=True))
    steps = steps_of_parts([jumps])
    mended = without_steps(seam, overlap, *steps)
    shapes = [part.shape for part in parts]
    worst = {}
    for name, layout in {
        "as it came": lay_out(shapes, [seam], feather_px=40.0),
        "mended": lay_out(shapes, [mended], feather_px=40.0, steps=steps),
    }.items():
        film = compose(parts, layout, Window(0, layout.shape[0], 0, layout.shape[1]))
        # The film against the ground, each column by itself: the left part's frame is the film's.
        back = MOTIONS[0].after(layout.motions[0].inverse())
        columns, rows = np.meshgrid(np.arange(1000.0, 1450.0), np.arange(100.0, 600.0))
        place = back.apply(np.stack([columns, rows], axis=-1))
        slope = [
            (
                sample(ground, place[..., 1] + dy, place[..., 0] + dx)
                - sample(ground, place[..., 1] - dy, place[..., 0] - dx)
            )
            for dx, dy in ((0.5, 0.0), (0.0, 0.5))
        ]
        misfit = film[100:600, 1000:1450].astype(float) - sample(ground, place[..., 1], place[..., 0])
        misfit -= misfit.mean()
        shift = np.array(
            [
                (misfit * s).reshape(500, 15, 30).sum(axis=(0, 2)) / (s**2).reshape(500, 15, 30).sum(axis=(0, 2))
                for s in slope
            ]
        )
        worst[name] = float(np.abs(shift).max())
    assert worst["mended"] < 0.3
    assert worst["as it came"] > 0.5


@pytest.mark.parametrize("wave_px", [0.0, 0.6], ids=["rigid", "a film that waves"])
def test_a_film_without_blocks_is_left_alone(ground, wave_px):
    _, seam, overlap = _scanned(ground, wave_px=wave_px)
    assert len(overlap.column_px) > 30
    assert find_jumps(overlap, seam.motion, **LIMITS) == ()
    if wave_px == 0:
        assert np.abs(overlap.shift_px).max() < 0.1
        assert _worst_px(seam.motion) < 0.02


def test_no_step_changes_nothing():
    assert steps_of_parts([(), ()]) == (Steps(), Steps(), Steps())
    assert_allclose(Steps().at(np.arange(4.0)), np.zeros((4, 2)))


def test_a_step_of_unknown_owner_is_shared():
    steps = steps_of_parts([[Jump(900.0, 50.0, (1.0, 0.0), 9.0)]])
    assert_allclose(steps[0].at(np.array([0.0, 899.0, 901.0])), [[0, 0], [0, 0], [0.5, 0]])
    assert_allclose(steps[1].at(np.array([0.0, 49.0, 51.0])), [[0.5, 0], [0.5, 0], [0, 0]])


def test_steps_of_a_part_of_half_the_size_are_half_as_large():
    half = Steps((101.5,), ((0.0, 1.0), (2.0, 0.0))).reduced(2)
    assert_allclose(half.at(np.array([50.4, 50.6])), [[0.0, 0.5], [1.0, 0.0]])


def test_steps_on_one_comb_tell_their_spacing_and_their_owner():
    blocks = Blocks(17.3, 4.1)
    rng = np.random.default_rng(1)
    places, owners = [], []
    for low in (190.0, 185.0, 193.0):
        for k in range(5, 14):
            mine = blocks.first_mm + k * blocks.spacing_mm
            other = mine - low
            if low < mine < 220:
                places.append((mine, other))
                owners.append("left")
            if 0 < mine % 40 < 30:
                places.append((mine % 40 // 17.3 * 17.3 + 4.1 + low, mine % 40 // 17.3 * 17.3 + 4.1))
                owners.append("right")
    noisy = [tuple(np.array(place) + rng.normal(0, 0.03)) for place in places]
    found = find_blocks(noisy, part_mm=220.0, tolerance_mm=0.15)
    assert found is not None
    assert_allclose(found.spacing_mm, 17.3, atol=0.1)
    told = [attributed(Jump(0, 0, (1, 0), 9), found, place, tolerance_mm=0.3).belongs_to for place in noisy]
    assert all(t in (owner, "either") for t, owner in zip(told, owners, strict=True))
    assert told.count("either") < len(told) / 3


def test_steps_by_chance_have_no_spacing():
    rng = np.random.default_rng(5)
    for _ in range(20):
        places = [tuple(p) for p in rng.uniform([190, 0], [220, 30], (6, 2))]
        assert find_blocks(places, part_mm=220.0, tolerance_mm=0.15) is None
