"""Steps between the blocks of the scanner: found in the overlaps of the parts, taken out where they are significant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from cosp.arrays import ByteArray, FloatArray
from cosp.film.continuity import Boundary, Continuity
from cosp.film.stitching import GATE_PX, Seam, correlate_patches, robust_rigid, thinned
from cosp.geometry.robust import huber_weights
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
    """The blocks of the scanner: along each part a boundary every `spacing_mm`, one of them at `first_mm` (or None)."""

    spacing_mm: float
    first_mm: tuple[float | None, ...]

    def along(self, part: int, length_mm: float) -> FloatArray:
        """Boundaries of a part, mm from its first column; none where the part shows no block."""
        first = self.first_mm[part]
        return np.empty(0) if first is None else np.arange(first % self.spacing_mm, length_mm, self.spacing_mm)


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


def find_blocks(places_mm: Sequence[FloatArray], *, part_mm: float, tolerance_mm: float) -> Blocks | None:
    """Spacing of the scanner's blocks, where breaks of the picture fall on combs of one spacing beyond chance.

    Parameters
    ----------
    places_mm : (N,) array of each part
        Breaks of its picture.
    part_mm : float
        Length of the longest part.
    tolerance_mm : float
        Of a place.

    Returns
    -------
    Blocks or None
        None where chance would explain it too.
    """
    ratio = 1.0 + tolerance_mm / part_mm
    spacings = _SPACINGS_MM[0] * ratio ** np.arange(int(np.log(_SPACINGS_MM[1] / _SPACINGS_MM[0]) / np.log(ratio)) + 1)
    worth, trials = np.zeros(len(spacings)), 0.0
    firsts: list[FloatArray | None] = []
    for places in places_mm:
        count, first = np.zeros(len(spacings)), np.zeros(len(spacings))
        for place in places:  # each in turn gives the phase
            off = (places - place + spacings[:, None] / 2) % spacings[:, None] - spacings[:, None] / 2
            on = np.abs(off) < tolerance_mm
            better = on.sum(axis=1) > count
            count[better] = on.sum(axis=1)[better]
            first[better] = np.asarray(place + np.where(on, off, 0.0).sum(axis=1) / np.maximum(on.sum(axis=1), 1))[
                better
            ]
        firsts.append(first if len(places) else None)
        # Log likelihood of so many places on the comb beside that of chance; one place gave the phase.
        chance = np.minimum(2.0 * tolerance_mm / spacings, 0.5)
        share = np.clip((count - 1) / max(len(places), 1), chance, 1.0 - 1e-9)
        worth += len(places) * (share * np.log(share / chance) + (1 - share) * np.log((1 - share) / (1 - chance)))
        trials += np.log(max(len(places), 1))
    k = int(worth.argmax())
    if worth[k] < np.log(20.0 * len(spacings)) + trials:
        return None
    return _refined(
        Blocks(float(spacings[k]), tuple(None if f is None else float(f[k]) for f in firsts)), places_mm, tolerance_mm
    )


def _refined(blocks: Blocks, places_mm: Sequence[FloatArray], tolerance_mm: float) -> Blocks:
    """Spacing and first boundaries through the breaks near them, by least squares."""
    for _ in range(3):
        rows, target = [], []
        for k, (first, places) in enumerate(zip(blocks.first_mm, places_mm, strict=True)):
            if first is None:
                continue
            number = np.rint((places - first) / blocks.spacing_mm)
            near = np.abs(places - first - number * blocks.spacing_mm) < tolerance_mm
            rows.append(np.column_stack([number[near], np.tile(np.eye(len(places_mm))[k], (near.sum(), 1))]))
            target.append(places[near])
        solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(target), rcond=None)[0]
        firsts = [None if old is None else float(new) for old, new in zip(blocks.first_mm, solution[1:], strict=True)]
        blocks = Blocks(float(solution[0]), tuple(firsts))
    return blocks


def find_steps(
    overlaps: Sequence[Overlap],
    motions: Sequence[Rigid],
    continuities: Sequence[Continuity],
    *,
    pixel_mm: float,
    min_significance: float,
    min_step_px: float,
    tolerance_mm: float,
) -> tuple[list[tuple[Jump, ...]], list[tuple[Boundary, ...]], Blocks | None]:
    """Steps of each overlap with the part that each belongs to, steps between the overlaps, and the scanner's blocks.

    Where the pictures of the parts break on combs of one spacing, these are the blocks: at each of their boundaries the
    step is what the break and, in an overlap, the residuals say together. A step of an overlap that lies on no block
    belongs to the part whose picture breaks there; where neither does, to either.

    Parameters
    ----------
    overlaps : Overlap of each seam
    motions : Rigid of each seam
        Right part to left part.
    continuities : Continuity of each part
    pixel_mm : float
    min_significance, min_step_px : float
        See `find_jumps`.
    tolerance_mm : float
        Of a boundary's place; never less than a pixel and a half.

    Returns
    -------
    jumps : of each overlap
    boundaries : of each part
        Those that no overlap holds.
    blocks : Blocks or None
    """
    tolerance = max(tolerance_mm, 1.5 * pixel_mm)
    reach = int(np.ceil(tolerance / pixel_mm))
    breaks = [continuity.break_columns(min_significance) for continuity in continuities]
    part_mm = max(continuity.part.shape[1] for continuity in continuities) * pixel_mm
    blocks = find_blocks([columns * pixel_mm for columns in breaks], part_mm=part_mm, tolerance_mm=tolerance)
    known: list[list[Boundary]] = []
    for k, continuity in enumerate(continuities):
        places = np.empty(0) if blocks is None else blocks.along(k, continuity.part.shape[1] * pixel_mm)
        known.append([continuity.strongest(place / pixel_mm, reach) for place in places])
    found: list[tuple[Jump, ...]] = []
    for k, (overlap, motion) in enumerate(zip(overlaps, motions, strict=True)):
        inside = [_inside(overlap, boundary, motion, side) for side in (0, 1) for boundary in known[k + side]]
        here = [candidate for candidate in inside if candidate is not None]
        jumps, model = _sized(overlap, here)
        rest = replace(overlap, shift_px=overlap.shift_px - model)
        loose = find_jumps(rest, motion, min_significance=min_significance, min_step_px=min_step_px)
        shared = []
        for jump in loose:
            broken = [
                (side, continuities[k + side].strongest(place, overlap.patch_px))
                for side, place in enumerate((jump.left_px, jump.right_px))
            ]
            owners = [(side, boundary) for side, boundary in broken if boundary.significance >= min_significance]
            for side, boundary in owners:
                candidate = _inside(overlap, boundary, motion, side)
                if candidate is not None and all(abs(boundary.column_px - b.column_px) > 2 for b in known[k + side]):
                    known[k + side].append(boundary)
                    here.append(candidate)
            if not owners:
                shared.append(jump)
        jumps, _ = _sized(overlap, here)
        jumps = [
            jump for jump in jumps if jump.significance >= _LEAST_ON_COMB and np.hypot(*jump.size_px) >= min_step_px
        ]
        found.append(tuple(sorted([*jumps, *shared], key=lambda jump: jump.left_px)))
        for side in (0, 1):
            taken = [candidate.boundary for candidate in here if candidate.side == side]
            known[k + side] = [boundary for boundary in known[k + side] if boundary not in taken]
    kept = [
        tuple(
            boundary
            for boundary in (_significant(each) for each in boundaries)
            if np.hypot(*boundary.size_px) >= min_step_px
        )
        for boundaries in known
    ]
    return found, kept, blocks


def _significant(boundary: Boundary) -> Boundary:
    """The boundary with a size of zero along an axis where it is hardly more than its standard deviation."""
    size = [v if abs(v) >= _LEAST_ON_COMB * sd else 0.0 for v, sd in zip(boundary.size_px, boundary.sd_px, strict=True)]
    return replace(boundary, size_px=(size[0], size[1]))


@dataclass(frozen=True)
class _Candidate:
    """A boundary of the left (0) or right (1) part and its column in the left part."""

    boundary: Boundary
    side: int
    left_px: float
    right_px: float


def _inside(overlap: Overlap, boundary: Boundary, motion: Rigid, side: int) -> _Candidate | None:
    """The boundary as the overlap sees it; None where it does not."""
    if len(overlap.column_px) < 2 * _FEWEST_COLUMNS:
        return None
    middle = float(np.median(overlap.points[:, 1]))
    place = np.array([boundary.column_px, middle])
    left = place if side == 0 else motion.apply(place)
    right = motion.inverse().apply(place) if side == 0 else place
    ends = overlap.column_px[[1, -2]]
    if not ends[0] - overlap.patch_px / 2 < left[0] < ends[1] + overlap.patch_px / 2:
        return None
    return _Candidate(boundary, side, float(left[0]), float(right[0]))


def _sized(overlap: Overlap, candidates: Sequence[_Candidate]) -> tuple[list[Jump], FloatArray]:
    """Jumps at known boundaries and the curve (M, 2) they make, from the residuals and the breaks of the picture.

    Least squares: a step each, over film that may wave smoothly between two scans.
    """
    x, values = overlap.column_px, overlap.shift_px
    if not candidates:
        return [], np.zeros_like(values)
    between = np.diff(values, axis=0) / np.hypot(overlap.sd_px[1:], overlap.sd_px[:-1])[:, None]
    sd = overlap.sd_px * max(1.0, nmad(between))
    signs = np.array([1.0, -1.0])[[candidate.side for candidate in candidates]]
    passed = np.clip((x[:, None] - [c.left_px for c in candidates]) / overlap.patch_px + 0.5, 0.0, 1.0)
    # A patch on both sides of a step sees whichever side has more texture.
    sd = np.where(((passed > 0) & (passed < 1)).any(axis=1), _STRADDLING_PX, sd)
    nodes = np.linspace(x[0], x[-1], max(2, len(x) // _COLUMNS_A_NODE + 1))
    waves = np.stack([np.interp(x, nodes, unit) for unit in np.eye(len(nodes))], axis=1)
    bends = np.diff(np.eye(len(nodes)), n=2, axis=0) / _BEND_PX
    n, m = len(candidates), len(nodes)
    sizes, sds = np.zeros((n, 2)), np.zeros((n, 2))
    for axis in (0, 1):
        prior = np.array([c.boundary.size_px[axis] for c in candidates])
        prior_sd = np.array([max(c.boundary.sd_px[axis], _LEAST_PRIOR_PX) for c in candidates])
        weight: FloatArray = np.ones(len(x))
        for _ in range(6):
            scaled = (np.sqrt(weight) / sd)[:, None]
            design = np.vstack(
                [
                    np.hstack([passed * signs, waves]) * scaled,
                    np.hstack([np.diag(1.0 / prior_sd), np.zeros((n, m))]),
                    np.hstack([np.zeros((len(bends), n)), bends]),
                ]
            )
            target = np.concatenate([values[:, axis] * scaled[:, 0], prior / prior_sd, np.zeros(len(bends))])
            normal = np.linalg.inv(design.T @ design + 1e-9 * np.eye(n + m))
            solution = normal @ (design.T @ target)
            misfit = values[:, axis] - np.hstack([passed * signs, waves]) @ solution
            weight = np.asarray(huber_weights(misfit / sd))
        sizes[:, axis], sds[:, axis] = solution[:n], np.sqrt(np.diag(normal)[:n])
    jumps = [
        Jump(
            c.left_px,
            c.right_px,
            (float(sign * size[0]), float(sign * size[1])),
            float(np.hypot(*(size / deviation))),
            "left" if c.side == 0 else "right",
        )
        for c, sign, size, deviation in zip(candidates, signs, sizes, sds, strict=True)
    ]
    return jumps, passed @ (signs[:, None] * sizes)


def steps_of_parts(
    seams: Sequence[Sequence[Jump]], boundaries: Sequence[Sequence[Boundary]] | None = None
) -> tuple[Steps, ...]:
    """Steps of each part, left to right, from those of the overlaps and those between them (none, where not given)."""
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
        for boundary in boundaries[k] if boundaries is not None else ():
            events.append((boundary.column_px, np.array(boundary.size_px)))
        events = sorted((event for event in events if event[1].any()), key=lambda event: event[0])
        if not events:
            parts.append(Steps())
            continue
        levels = level + np.vstack([np.zeros(2), np.cumsum([size for _, size in events], axis=0)])
        parts.append(Steps(tuple(column for column, _ in events), tuple((float(x), float(y)) for x, y in levels)))
    return tuple(parts)


def without_steps(seam: Seam, overlap: Overlap, left: Steps, right: Steps) -> Seam:
    """The seam once the steps of both parts are taken out: motion and residuals anew."""
    if len(overlap.points) < _FEWEST_POINTS:  # hardly a residual: the blocks in the overlap's middle move the seam
        middle = np.array([(max(seam.motion.shift[0], 0.0) + seam.motion.shift[0] + seam.overlap_px) / 2, 0.0])
        moved = right.at(seam.motion.inverse().apply(middle)[0]) - left.at(middle[0])
        shift = (float(seam.motion.shift[0] + moved[0]), float(seam.motion.shift[1] + moved[1]))
        return replace(seam, motion=Rigid(seam.motion.rotation_rad, shift))
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
_FEWEST_POINTS = 40  # of an overlap
_FEWEST_COLUMNS = 3  # of a block
_NEAR_COLUMNS = 6
_FEWEST_FOR_A_BEND = 10  # columns, of two blocks
_SPACINGS_MM = (4.0, 80.0)  # of the blocks of scanners
_LEAST_ON_COMB = 3.0  # standard deviations: that there is a boundary is beyond doubt
_STRADDLING_PX = 1.0
_LEAST_PRIOR_PX = 0.1
_COLUMNS_A_NODE = 8
_BEND_PX = 0.1  # by which a film may bend between two scans from node to node
