"""Steps between the blocks of the scanner: found in the overlaps of the parts, taken out where they are significant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from cosp.arrays import ByteArray, FloatArray
from cosp.film.stitching import GATE_PX, Seam, correlate_patches, robust_rigid, thinned
from cosp.geometry.statistics import nmad
from cosp.geometry.transforms import Rigid, estimate_rigid


@dataclass(frozen=True)
class Steps:
    """Displacement of a part's blocks, constant between boundaries along its columns; empty: none.

    Parameters
    ----------
    columns_px : (N,) floats
        Boundaries, ascending.
    shifts_px : (N + 1) pairs of floats
        By how much (x, y) each block lies off its place.
    """

    columns_px: tuple[float, ...] = ()
    shifts_px: tuple[tuple[float, float], ...] = ()

    def at(self, columns: FloatArray) -> FloatArray:
        """Displacement (..., 2) of places in the columns (...), px."""
        columns = np.asarray(columns)
        if not self.columns_px:
            return np.zeros((*columns.shape, 2))
        return np.asarray(np.array(self.shifts_px)[np.searchsorted(self.columns_px, columns, side="right")])

    @property
    def largest_px(self) -> float:
        """Size of the largest displacement in a coordinate."""
        return float(np.abs(self.shifts_px).max()) if self.columns_px else 0.0

    def reduced(self, factor: int) -> Steps:
        """The steps of the part reduced by means of factor x factor pixels."""
        return Steps(
            tuple((column - (factor - 1) / 2) / factor for column in self.columns_px),
            tuple((x / factor, y / factor) for x, y in self.shifts_px),
        )


@dataclass(frozen=True)
class Overlap:
    """How two parts lie to each other all over their overlap, once their rigid motion is taken out.

    Parameters
    ----------
    points : (N, 2) array
        Places (x, y) in the left part, px.
    residuals : (N, 2) array
        By how much the left part shows the film farther right and down than the right part does, px.
    column_px : (M,) array
        Columns of the left part, ascending.
    shift_px : (M, 2) array
        Mean residual in each of them.
    sd_px : (M,) array
        Its standard deviation, per coordinate.
    patch_px : int
        Columns that a mean rests on.
    """

    points: FloatArray
    residuals: FloatArray
    column_px: FloatArray
    shift_px: FloatArray
    sd_px: FloatArray
    patch_px: int


@dataclass(frozen=True)
class Jump:
    """A step of the scanner in an overlap.

    Parameters
    ----------
    left_px, right_px : float
        Column of the left and of the right part.
    size_px : (x, y)
        Change of the residual from left to right.
    significance : float
        Its size in standard deviations.
    belongs_to : "left", "right" or "either"
        The part that has it; "either": its overlap does not tell, each part is given half.
    """

    left_px: float
    right_px: float
    size_px: tuple[float, float]
    significance: float
    belongs_to: Literal["left", "right", "either"] = "either"


@dataclass(frozen=True)
class Blocks:
    """The blocks of the scanner: a boundary at `first_mm` and every `spacing_mm` from there, along every part."""

    spacing_mm: float
    first_mm: float


def measure_overlap(
    left: ByteArray, right: ByteArray, motion: Rigid, *, min_score: float, search_px: int, threads: int
) -> Overlap:
    """Residuals of narrow patches in close columns all over an overlap, and their mean in each column.

    Parameters
    ----------
    left, right : (rows, columns) uint8 arrays
    motion : Rigid
        Right part to left part.
    min_score : float
        Least correlation of a patch.
    search_px : int
        Largest residual looked for.
    threads : int
    """
    width = left.shape[1] - max(motion.shift[0], 0.0)
    patch = int(np.clip(width / 48, 12, 32)) // 2 * 2
    reach = patch // 2 + search_px
    xs = np.arange(np.ceil(max(motion.shift[0], 0.0)) + reach, left.shape[1] - reach, patch)
    ys = np.arange(_PATCH_ROWS, left.shape[0] - _PATCH_ROWS, max(_PATCH_ROWS, left.shape[0] / _ROWS_OF_PATCHES))
    points = np.stack(np.meshgrid(xs, np.round(ys)), axis=-1).reshape(-1, 2)
    shift, score, ratio = correlate_patches(
        left, right, motion, points, size=(_PATCH_ROWS, patch), search_px=search_px, threads=threads
    )
    good = (score > min_score) & (ratio < 0.95) & np.isfinite(shift).all(axis=1)
    points, residuals = points[good], -shift[good][:, ::-1]
    columns, means, sds = [], [], []
    turn, middle = _turn_left(points, residuals), left.shape[0] / 2
    for x in xs:
        here = points[:, 0] == x
        if here.sum() < _FEWEST_PATCHES:
            continue
        tilt = np.column_stack([middle - points[here, 1], np.full(here.sum(), x - xs.mean())])
        values = residuals[here] - turn * tilt
        columns.append(x)
        means.append(np.median(values, axis=0))
        sds.append(1.25 * max(nmad(values - means[-1]), 0.02) / np.sqrt(here.sum()))
    return Overlap(
        points,
        residuals,
        np.array(columns, float),
        np.array(means, float).reshape(-1, 2),
        np.array(sds, float),
        patch,
    )


def _turn_left(points: FloatArray, residuals: FloatArray) -> float:
    """Small rotation (rad) that the residuals along x show across the film, columns apart; steps do not disturb it."""
    slopes = []
    for x in np.unique(points[:, 0]):
        here = points[:, 0] == x
        y = points[here, 1] - points[here, 1].mean()
        if here.sum() >= _FEWEST_PATCHES and np.ptp(y) > 0:
            # A small turn moves places below the middle to the left.
            slopes.append(-(y @ residuals[here, 0]) / (y @ y))
    return float(np.median(slopes)) if slopes else 0.0


def find_jumps(overlap: Overlap, motion: Rigid, *, min_significance: float, min_step_px: float) -> tuple[Jump, ...]:
    """Steps of an overlap: the piecewise constant curve of least cost, less what is not significant.

    The curve is the exact minimum of squared misfit plus a price per step (the l0 form of total variation denoising, by
    dynamic programming). A step counts if it stands against a gentle bend through both its sides: film that
    stretches smoothly between two scans has none.

    Parameters
    ----------
    overlap : Overlap
    motion : Rigid
        Right part to left part.
    min_significance : float
        Least size in standard deviations.
    min_step_px : float
        Least size.

    References
    ----------
    [Friedrich2008]
    """
    x, values = overlap.column_px, overlap.shift_px
    if len(x) < 3 * _FEWEST_COLUMNS:
        return ()
    # Columns scatter more than their patches say where the scanner itself is not quite even.
    between = np.diff(values, axis=0) / np.hypot(overlap.sd_px[1:], overlap.sd_px[:-1])[:, None]
    sd = overlap.sd_px * max(1.0, nmad(between))
    starts = _best_segments(values, sd, price=min_significance**2)
    while len(starts) > 1:
        tests = [_tested(x, values, sd, starts, k) for k in range(1, len(starts))]
        weakest = min(range(len(tests)), key=lambda k: tests[k][1] if tests[k][2] >= min_step_px else -1.0)
        if tests[weakest][1] >= min_significance and tests[weakest][2] >= min_step_px:
            break
        del starts[weakest + 1]
    back = motion.inverse()
    middle = float(np.median(overlap.points[:, 1])) if len(overlap.points) else 0.0
    jumps = []
    for k, (size, significance, _) in enumerate([_tested(x, values, sd, starts, k) for k in range(1, len(starts))], 1):
        column = _boundary(x, values, starts, k, size)
        right = float(back.apply(np.array([column, middle]))[0])
        jumps.append(Jump(column, right, (float(size[0]), float(size[1])), significance))
    return tuple(jumps)


def _best_segments(values: FloatArray, sd: FloatArray, *, price: float) -> list[int]:
    """First index of each piece of the piecewise constant curve with least misfit plus price per step."""
    n = len(values)
    weight = 1.0 / sd**2
    w = np.r_[0.0, np.cumsum(weight)]
    first = np.vstack([np.zeros(2), np.cumsum(weight[:, None] * values, axis=0)])
    second = np.r_[0.0, np.cumsum(weight * (values**2).sum(axis=1))]
    cost = np.full(n + 1, np.inf)
    cost[0] = -price
    source = np.zeros(n + 1, int)
    for stop in range(_FEWEST_COLUMNS, n + 1):
        begin = np.arange(0, stop - _FEWEST_COLUMNS + 1)
        misfit = second[stop] - second[begin]
        misfit = misfit - ((first[stop] - first[begin]) ** 2).sum(axis=1) / (w[stop] - w[begin])
        total = cost[begin] + misfit + price
        source[stop] = int(begin[total.argmin()])
        cost[stop] = total.min()
    starts, stop = [], n
    while stop > 0:
        stop = int(source[stop])
        starts.append(stop)
    return starts[::-1]


def _tested(
    x: FloatArray, values: FloatArray, sd: FloatArray, starts: list[int], k: int
) -> tuple[FloatArray, float, float]:
    """Size (2,) of the step before piece k, its significance beside a gentle bend through both pieces, and its length.

    The size is the difference of medians near the step: a bend changes little there, and single columns that show
    something else have no say. The column next to the step on either side may show both its sides and is left out.
    """
    stop = starts[k + 1] if k + 1 < len(starts) else len(x)
    before, after = (np.arange(*ends) for ends in ((starts[k - 1], starts[k]), (starts[k], stop)))
    before = before[:-1] if len(before) > _FEWEST_COLUMNS else before
    after = after[1:] if len(after) > _FEWEST_COLUMNS else after
    near = before[-_NEAR_COLUMNS:], after[:_NEAR_COLUMNS]
    size = np.median(values[near[1]], axis=0) - np.median(values[near[0]], axis=0)
    length = float(np.hypot(*size))
    here = np.r_[before, after]
    place = (x[here] - x[starts[k]]) / max(np.ptp(x[here]), 1.0)
    smooth = [place**degree for degree in range(3 if len(here) >= _FEWEST_FOR_A_BEND else 2)]
    design = np.column_stack([here >= starts[k], *smooth]) / sd[here, None]
    normal = np.linalg.inv(design.T @ design)
    beside = (normal @ design.T @ (values[here] / sd[here, None]))[0]
    return size, min(length, float(np.hypot(*beside))) / float(np.sqrt(normal[0, 0])), length


def _boundary(x: FloatArray, values: FloatArray, starts: list[int], k: int, size: FloatArray) -> float:
    """Column of the step before piece k, from the columns whose patches lie on both sides of it."""
    stop = starts[k + 1] if k + 1 < len(starts) else len(x)
    near = slice(max(starts[k] - 2, starts[k - 1] + 1), min(starts[k] + 2, stop - 1))
    before = np.median(values[starts[k - 1] : starts[k]], axis=0)
    passed = np.clip((values[near] - before) @ size / (size @ size), 0.0, 1.0)
    spacing = float(np.median(np.diff(x)))
    return float(x[near.start] - spacing / 2 + spacing * (1.0 - passed).sum())


def find_blocks(places_mm: Sequence[tuple[float, float]], *, part_mm: float, tolerance_mm: float) -> Blocks | None:
    """Spacing of the scanner's blocks, where the steps of all overlaps fall on one comb beyond chance.

    Parameters
    ----------
    places_mm : (left, right) of each step
        Where it lies along the left and along the right part, as they were digitised.
    part_mm : float
        Length of the longest part.
    tolerance_mm : float
        Of a place.

    Returns
    -------
    Blocks or None
        None where chance would explain it too.
    """
    if len(places_mm) < 3:
        return None
    left, right = np.array(places_mm, float).T
    ratio = 1.0 + tolerance_mm / part_mm
    spacings = _SPACINGS_MM[0] * ratio ** np.arange(int(np.log(_SPACINGS_MM[1] / _SPACINGS_MM[0]) / np.log(ratio)) + 1)
    best = (0.0, 0.0, 0.0)
    for first in np.r_[left, right]:
        gaps = [np.abs((side - first + b / 2) % b - b / 2) for side in (left, right) for b in [spacings[:, None]]]
        explained = (np.minimum(*gaps) < tolerance_mm).sum(axis=1)
        # Each step explained is worth its chance to lie on the comb of either part; the first one gave the phase.
        worth = (explained - 1) * np.log(np.maximum(spacings / (4.0 * tolerance_mm), 1.0))
        worth = np.where(explained >= 0.75 * len(left), worth, 0.0)
        k = int(worth.argmax())
        if worth[k] > best[0]:
            best = (float(worth[k]), float(spacings[k]), float(first % spacings[k]))
    if best[0] < np.log(20.0 * len(spacings) * 2 * len(left)):
        return None
    return Blocks(best[1], best[2])


def attributed(jump: Jump, blocks: Blocks | None, place_mm: tuple[float, float], *, tolerance_mm: float) -> Jump:
    """The step with the part it belongs to, if it lies on the blocks of one part only."""
    if blocks is None:
        return jump
    b = blocks.spacing_mm
    on = [abs((place - blocks.first_mm + b / 2) % b - b / 2) < tolerance_mm for place in place_mm]
    if on[0] == on[1]:
        return jump
    return replace(jump, belongs_to="left" if on[0] else "right")


def find_steps(
    overlaps: Sequence[Overlap],
    motions: Sequence[Rigid],
    *,
    widths_px: Sequence[int],
    turned: Sequence[bool],
    pixel_mm: float,
    min_significance: float,
    min_step_px: float,
    tolerance_mm: float,
) -> tuple[list[tuple[Jump, ...]], Blocks | None]:
    """Steps of each overlap with the part that each belongs to, and the blocks that tell it.

    Parameters
    ----------
    overlaps : Overlap of each seam
    motions : Rigid of each seam
        Right part to left part.
    widths_px : int of each part
        Columns.
    turned : bool of each part
        Whether it lies turned by 180 degrees: blocks are counted from its first column as it was digitised.
    pixel_mm : float
    min_significance, min_step_px : float
        See `find_jumps`.
    tolerance_mm : float
        Of a step's place; never less than a third of a patch.
    """
    found = [
        find_jumps(overlap, motion, min_significance=min_significance, min_step_px=min_step_px)
        for overlap, motion in zip(overlaps, motions, strict=True)
    ]

    def digitised_mm(k: int, jump: Jump) -> tuple[float, float]:
        sides = ((k, jump.left_px), (k + 1, jump.right_px))
        left, right = (pixel_mm * (widths_px[i] - 1 - column if turned[i] else column) for i, column in sides)
        return left, right

    places = [[digitised_mm(k, jump) for jump in jumps] for k, jumps in enumerate(found)]
    tolerance = max([tolerance_mm, *(overlap.patch_px * pixel_mm / 3 for overlap in overlaps)])
    part_mm = max(widths_px) * pixel_mm
    blocks = find_blocks([place for each in places for place in each], part_mm=part_mm, tolerance_mm=tolerance)
    owned = [
        tuple(attributed(jump, blocks, place, tolerance_mm=tolerance) for jump, place in zip(*both, strict=True))
        for both in zip(found, places, strict=True)
    ]
    return owned, blocks


def steps_of_parts(seams: Sequence[Sequence[Jump]]) -> tuple[Steps, ...]:
    """Steps of each part, left to right, from those of the overlaps between them; the middle of a part stays."""
    parts = []
    for k in range(len(seams) + 1):
        events: list[tuple[float, FloatArray]] = []
        level = np.zeros(2)
        for jump in seams[k - 1] if k > 0 else ():
            size = np.array(jump.size_px) * {"left": 0.0, "right": 1.0, "either": 0.5}[jump.belongs_to]
            level += size
            events.append((jump.right_px, -size))
        for jump in seams[k] if k < len(seams) else ():
            size = np.array(jump.size_px) * {"left": 1.0, "right": 0.0, "either": 0.5}[jump.belongs_to]
            events.append((jump.left_px, size))
        events = sorted((event for event in events if event[1].any()), key=lambda event: event[0])
        if not events:
            parts.append(Steps())
            continue
        levels = level + np.vstack([np.zeros(2), np.cumsum([size for _, size in events], axis=0)])
        parts.append(Steps(tuple(column for column, _ in events), tuple((float(x), float(y)) for x, y in levels)))
    return tuple(parts)


def without_steps(seam: Seam, overlap: Overlap, left: Steps, right: Steps) -> Seam:
    """The seam once the steps of both parts are taken out: motion and residuals anew."""
    source = seam.motion.inverse().apply(overlap.points - overlap.residuals)
    target = overlap.points - left.at(overlap.points[:, 0])
    source = source - right.at(source[:, 0])
    motion = robust_rigid(source, target, seam.motion)
    residuals = target - motion.apply(source)
    kept = np.linalg.norm(residuals, axis=1) < GATE_PX
    half = np.arange(kept.sum()) % 2 == 0
    source, target, residuals = source[kept], target[kept], residuals[kept]
    check = target[~half] - estimate_rigid(source[half], target[half]).apply(source[~half])
    return replace(
        seam,
        motion=motion,
        patches=len(overlap.points),
        inliers=int(kept.sum()),
        rms_px=float(np.sqrt(np.mean(residuals**2))),
        check_rms_px=float(np.sqrt(np.mean(check**2))),
        residuals=thinned(target, residuals),
    )


_PATCH_ROWS = 48
_ROWS_OF_PATCHES = 48
_FEWEST_PATCHES = 5  # a column with fewer says nothing
_FEWEST_COLUMNS = 3  # of a block
_NEAR_COLUMNS = 6
_FEWEST_FOR_A_BEND = 10  # columns, of two blocks
_SPACINGS_MM = (4.0, 80.0)  # of the blocks of scanners
