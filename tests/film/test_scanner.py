from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import gaussian_filter

from cosp.arrays import ByteArray, FloatArray
from cosp.film.continuity import Continuity, measure_continuity
from cosp.film.joining import compose, lay_out
from cosp.film.scanner import (
    Jump,
    Overlap,
    Steps,
    find_blocks,
    find_jumps,
    find_steps,
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


def test_breaks_on_one_comb_tell_its_spacing_and_where_it_lies_on_each_part():
    rng = np.random.default_rng(1)
    firsts = (4.1, 11.9, 0.3)
    places = []
    for first in firsts:
        comb = np.arange(first, 220.0, 17.3)
        seen = np.sort(rng.choice(comb, 7, replace=False)) + rng.normal(0, 0.03, 7)
        places.append(np.sort(np.r_[seen, rng.uniform(0, 220, 4)]))  # marks and the ends of the picture break it too
    found = find_blocks([*places, np.empty(0)], part_mm=220.0, tolerance_mm=0.15)
    assert found is not None
    assert_allclose(found.spacing_mm, 17.3, atol=0.01)
    for k, first in enumerate(firsts):
        assert_allclose(found.along(k, 220.0), np.arange(first, 220.0, 17.3), atol=0.1)
    assert found.along(3, 220.0).size == 0


def test_breaks_by_chance_have_no_spacing():
    rng = np.random.default_rng(5)
    for _ in range(20):
        places = [np.sort(rng.uniform(0, 220, 8)) for _ in range(4)]
        assert find_blocks(places, part_mm=220.0, tolerance_mm=0.15) is None


BOUNDARIES = [[250.0, 650.0, 1050.0, 1450.0], [250.0, 650.0, 1050.0]]
BLOCKS = [
    [[0.3, 0.2], [1.0, -0.5], [0.0, 0.6], [0.9, -0.2], [-0.3, 0.5]],
    [[0.2, 0.9], [-0.6, 0.0], [0.3, 1.0], [0.0, 0.2]],
]


@pytest.fixture(scope="module")
def blocked(ground: FloatArray) -> tuple[list[ByteArray], Seam, Overlap]:
    left, right = zip(BOUNDARIES, BLOCKS, strict=True)
    return _scanned(gaussian_filter(ground, 1.0), left, right)  # lens, film and scanner blur over more than a pixel


def _found(scanned: tuple[list[ByteArray], Seam, Overlap], continuities: list[Continuity]):
    _, seam, overlap = scanned
    return find_steps(
        [overlap], [seam.motion], continuities, pixel_mm=0.02, tolerance_mm=0.06, **LIMITS
    )  # fmt: skip


def test_the_picture_breaks_at_the_boundaries_of_blocks_by_as_much_as_they_are_apart(blocked):
    errors = []
    for part, boundaries, shifts in zip(blocked[0], BOUNDARIES, BLOCKS, strict=True):
        continuity = measure_continuity(part, reach_px=4, threads=1)
        assert set(np.array(boundaries) - 0.5) <= set(continuity.break_columns(6.0))
        for place, step in zip(boundaries, np.diff(shifts, axis=0), strict=True):
            boundary = continuity.strongest(place + 2.0, 4)
            assert boundary.column_px == place - 0.5
            assert all(0.005 < sd < 0.25 for sd in boundary.sd_px)
            errors.append(np.abs(boundary.size_px - step))
    # With 700 rows what is usual hereabouts is not quite what is usual at the joint.
    along, across = np.array(errors).T
    assert np.median(along) < 0.3
    assert across.max() < 0.25


def test_every_step_is_given_to_its_part_and_taken_out_of_all_of_it(blocked):
    continuities = [measure_continuity(part, reach_px=4, threads=1) for part in blocked[0]]
    jumps, boundaries, blocks = _found(blocked, continuities)
    assert blocks is not None
    assert_allclose(blocks.spacing_mm, 400 * 0.02, atol=0.01)
    assert [jump.belongs_to for jump in jumps[0]] == ["left", "right", "left"]
    assert [len(each) for each in boundaries] == [2, 2]
    for steps, places, shifts in zip(steps_of_parts(jumps, boundaries), BOUNDARIES, BLOCKS, strict=True):
        middles = np.convolve([0.0, *places, WIDTH], [0.5, 0.5], "valid")
        left = steps.at(middles) - np.array(shifts)
        assert np.median(np.abs(np.diff(left, axis=0))) < 0.2
        assert np.abs(np.diff(left[:, 1])).max() < 0.25
    # Where the two parts overlap, steps are known far better.
    first, second = steps_of_parts(jumps, boundaries)
    assert_allclose(
        np.diff(first.at(np.array([900.0, 1200.0, 1480.0])), axis=0), np.diff(BLOCKS[0][2:], axis=0), atol=0.1
    )
    assert_allclose(np.diff(second.at(np.array([200.0, 300.0])), axis=0), np.diff(BLOCKS[1][:2], axis=0), atol=0.1)


def test_a_picture_without_blocks_has_no_boundaries(ground):
    scanned = _scanned(ground)
    jumps, boundaries, blocks = _found(
        scanned, [measure_continuity(part, reach_px=4, threads=1) for part in scanned[0]]
    )
    assert (jumps, boundaries, blocks) == ([()], [(), ()], None)


def test_continuity_does_not_depend_on_the_number_of_threads(blocked):
    one, two = (measure_continuity(blocked[0][0], reach_px=4, threads=threads) for threads in (1, 2))
    assert_array_equal(one.breaks, two.breaks)
