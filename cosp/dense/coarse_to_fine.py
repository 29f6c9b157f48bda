"""Dense matching from coarse to fine: work per pixel stays the same whatever the relief.

At each level of a pyramid the right picture is resampled with the disparity of the level before. What is left over is
small, and slopes have become flat, which is what semi-global aggregation likes; a fixed small range of disparities is
searched for it. Tiles are matched side by side in threads; each sees `HALO_PX` of its neighbours, so that the result in
its interior does not depend on where tiles end.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from cosp.arrays import BoolArray, ByteArray, Float32Array
from cosp.dense import kernels
from cosp.dense.aggregation import aggregate_costs
from cosp.dense.census import left_census, right_census
from cosp.dense.memory import Workspace, workspace
from cosp.dense.resampling import (
    CONTEXT_PX,
    SmoothField,
    StartInterval,
    continue_beyond_edges,
    picture_pyramid,
    prior_of,
    resample_right,
)
from cosp.dense.selection import DisparityMap, select_disparities
from cosp.dense.validity import Validity, correlation, doubly_claimed, no_data, picture_validity, speckles, uniqueness
from cosp.imaging.windows import Window, tiles

_log = logging.getLogger(__name__)

TILE_PX = 2048
HALO_PX = 32
"""What a tile sees of its neighbours."""

STRIP_HALO_PX = 256
"""What a strip matched on its own must see of its neighbours: coarse levels look further."""

BAND_ROWS = 1024
"""Whole rows taken at once where tiles will not do."""

LEFT_OVER = 32
"""Disparities searched at the fine levels for what the level before did not know."""

FRACTIONS = 64
"""Disparities are rounded to this part of a pixel, a tenth of their noise, so that files compress."""

_SEEN_PX = 16  # how far the windows of masks, and the census of what they look at, reach
_SLACK_PX = 8  # coarse pixels searched beyond the range on either side; columns resampled beyond what is searched
_FEWEST_LEVELS = 2
_NO_FIELD = SmoothField(np.zeros((1, 1), np.float32), 0.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True)
class Pass:
    """One matching of the whole picture: pyramid level, number of disparities searched."""

    level: int
    disparities: int


@dataclass(frozen=True)
class _Task:
    """What all tiles of one pass share."""

    step: Pass
    left: ByteArray
    right: ByteArray
    before: Float32Array | None  # disparity of the pass before, at `before_level`
    before_level: int
    range_px: tuple[float, float]  # at this level
    y_parallax: SmoothField
    start: StartInterval | None
    small_step: int
    large_step: int


def plan_passes(span_px: float) -> list[Pass]:
    """Levels and ranges that find any disparity of a span, coarsest first.

    The coarsest level searches everything, then once more what that left over, now that slopes are flat. Mistakes of
    the coarse levels last and their work is little, so those search widely, and twice.
    """
    levels = _FEWEST_LEVELS
    while span_px / 2**levels + 2 * _SLACK_PX > 2 * LEFT_OVER:
        levels += 1
    whole = LEFT_OVER if span_px / 2**levels + 2 * _SLACK_PX <= LEFT_OVER else 2 * LEFT_OVER
    passes = [Pass(levels, whole), Pass(levels, 2 * LEFT_OVER)]
    for level in range(levels - 1, -1, -1):
        if level >= 2:
            passes.append(Pass(level, 2 * LEFT_OVER))
        passes.append(Pass(level, LEFT_OVER))
    return passes


def match(
    left: ByteArray,
    right: ByteArray,
    disparity_range_px: tuple[float, float],
    *,
    small_step: int,
    large_step: int,
    least_texture_sd: float,
    saturated_from: int,
    least_correlation: float,
    least_uniqueness: float,
    largest_speckle_px: int,
    speckle_step_px: float,
    threads: int,
    y_parallax: SmoothField | None = None,
    start: StartInterval | None = None,
    rows: tuple[int, int] | None = None,
    tile_px: int = TILE_PX,
) -> DisparityMap:
    """Disparity of every pixel of the left picture that can be matched with confidence.

    The same whatever the number of threads. Right column = left column + disparity, right row = left row + y-parallax.

    Parameters
    ----------
    left, right : (rows, columns) arrays
        Rectified pictures with the same rows; columns may differ. 0 is no data.
    disparity_range_px : (lowest, highest)
    small_step, large_step : int
        Penalties of a change of disparity by one and by more between neighbours, in bits of the census (62).
    least_texture_sd : float, grey values
        Standard deviation within 9 x 9 px below which a pixel is masked.
    saturated_from : int
        Grey value from which film counts as saturated; a pixel is masked where most of the 9 x 9 px are.
    least_correlation : float
        Correlation of the pictures within 15 x 15 px, the disparity taken out, below which a pixel is masked.
    least_uniqueness : float
        Masked is where, in the mean of 15 x 15 px, the cheapest disparity is cheaper than all but its neighbours by
        less than this share of their cost: no match stands out, as beyond the edge of the right picture.
    largest_speckle_px, speckle_step_px
        Islands of up to so many pixels, cut off by steps of more than so much, are masked.
    y_parallax : SmoothField, px
        Right row minus left row by left pixel; taken out in the resampling that happens anyway.
    start : StartInterval
        Between which disparities each match must lie, within the range: others count as at the edge of the range, and
        in their stead finer levels start from the middle.
    rows : (first, last)
        Rows of which the disparity is wanted, the last excluded. The coarser a level, the more of the rows around are
        matched, too.

    Returns
    -------
    DisparityMap
        Of the rows wanted.

    References
    ----------
    [Hirschmuller2008] for the aggregation, [Zabih1994] for the cost.
    """
    low, high = disparity_range_px
    if not low < high:
        raise ValueError(f"disparity range {low} to {high} px: the lowest must be less than the highest")
    if left.shape[0] != right.shape[0]:
        raise ValueError(f"pictures of {left.shape[0]} and {right.shape[0]} rows: the same number is needed")
    cv2.setNumThreads(1)
    columns = left.shape[1]
    first, end = rows or (0, left.shape[0])
    wanted = Window(first, end, 0, columns)
    # Claims and islands look around a pixel, too.
    seen = wanted.grown(HALO_PX, left.shape)
    with ThreadPoolExecutor(threads) as pool:
        last = _coarse_to_fine(
            left,
            right,
            disparity_range_px,
            y_parallax or _NO_FIELD,
            start,
            seen,
            small_step=small_step,
            large_step=large_step,
            tile_px=tile_px,
            pool=pool,
        )
        result = DisparityMap(
            np.full(seen.shape, np.nan, np.float32),
            np.full(seen.shape, int(Validity.NO_DATA_LEFT), np.uint8),
            *(np.zeros(seen.shape, np.uint8) for _ in range(2)),
        )

        def finish(window: Window) -> None:
            grown, part = _with_halo(left, window)
            if min(part.shape) == 0:
                return
            inside = part.inside(grown).slices
            target = part.inside(seen).slices
            with workspace() as memory:
                tile = _cleaned(
                    last.left[grown.slices],
                    *_matched(last, grown, memory, least_texture_sd=least_texture_sd, saturated_from=saturated_from),
                    memory,
                    least_correlation=least_correlation,
                    least_uniqueness=least_uniqueness,
                    largest_speckle_px=largest_speckle_px,
                    speckle_step_px=speckle_step_px,
                )
                result.disparity[target] = tile.disparity[inside]
                result.validity[target] = tile.validity[inside]
                result.confidence[target] = tile.confidence[inside]
                result.similarity[target] = tile.similarity[inside]

        _log.info("level 0: %d disparities", last.step.disparities)
        _over_tiles(finish, seen, tile_px, pool)
        _settle_claims(
            result,
            right.shape[1],
            largest_speckle_px=largest_speckle_px,
            speckle_step_px=speckle_step_px,
            pool=pool,
        )
    part = wanted.inside(seen).slices
    return DisparityMap(result.disparity[part], result.validity[part], result.confidence[part], result.similarity[part])


def _coarse_to_fine(
    left: ByteArray,
    right: ByteArray,
    range_px: tuple[float, float],
    y_parallax: SmoothField,
    start: StartInterval | None,
    wanted: Window,
    *,
    small_step: int,
    large_step: int,
    tile_px: int,
    pool: ThreadPoolExecutor,
) -> _Task:
    """All passes but the last, which is returned as the task that it is."""
    low, high = range_px
    passes = plan_passes(high - low)
    levels = passes[0].level
    lefts, rights = pool.map(lambda one: picture_pyramid(np.ascontiguousarray(one), levels), (left, right))
    needed = _needed(passes, wanted, lefts)
    found: Float32Array | None = None
    level = levels
    for step, window_needed in zip(passes, needed, strict=True):
        task = _Task(
            step,
            lefts[step.level],
            rights[step.level],
            found,
            level,
            (low / 2**step.level, high / 2**step.level),
            y_parallax,
            start,
            # Before the first resampling slopes are not flat yet.
            small_step if found is not None else max(small_step // 2, 1),
            large_step,
        )
        if step is passes[-1]:
            break
        coarse = np.full(lefts[step.level].shape, np.nan, np.float32)

        def keep(window: Window, task: _Task = task, coarse: Float32Array = coarse) -> None:
            grown, part = _with_halo(task.left, window)
            if min(part.shape) > 0:
                with workspace() as memory:
                    coarse[part.slices] = _matched(task, grown, memory)[0].disparity[part.inside(grown).slices]

        _log.info("level %d: %d disparities", step.level, step.disparities)
        # The volume of a tile stays the same.
        size = tile_px if step.disparities == LEFT_OVER else 2 * tile_px // 3
        _over_tiles(keep, window_needed, size, pool)
        continue_beyond_edges(coarse)
        found, level = coarse, step.level
    return task


def _needed(passes: list[Pass], wanted: Window, pictures: list[ByteArray]) -> list[Window]:
    """What each pass has to match for the last one to know all that it looks at in the window wanted."""
    windows = [wanted]
    for finer, step in zip(passes[:0:-1], passes[-2::-1], strict=True):
        ratio = 2 ** (step.level - finer.level)
        rows, columns = pictures[step.level].shape
        same = Window(windows[-1].row0 // ratio, -(-windows[-1].row1 // ratio), 0, columns)
        # A tile's halo at the finer level, and what a prior looks at beyond.
        windows.append(same.grown(HALO_PX // ratio + CONTEXT_PX, (rows, columns)))
    return windows[::-1]


def _settle_claims(
    result: DisparityMap,
    right_columns: int,
    *,
    largest_speckle_px: int,
    speckle_step_px: float,
    pool: ThreadPoolExecutor,
) -> None:
    """Take out the worse of two matches with the same right pixel, and the islands that this leaves, in place."""
    shape = result.disparity.shape
    claimed, left_over = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    whole = Window(0, shape[0], 0, shape[1])
    bands = (BAND_ROWS, shape[1])  # whole rows, since the two may lie tiles apart

    def claim(window: Window) -> None:
        band = window.grown(HALO_PX, shape)
        lost = doubly_claimed(result.disparity[band.slices], result.confidence[band.slices], right_columns)
        if lost.any():
            claimed[window.slices] = lost[window.inside(band).slices]

    def clear(window: Window) -> None:
        grown = window.grown(HALO_PX, shape)
        if claimed[grown.slices].any():
            islands = speckles(
                result.disparity[grown.slices], largest_speckle_px=largest_speckle_px, speckle_step_px=speckle_step_px
            )
            left_over[window.slices] = islands[window.inside(grown).slices]

    # Nothing is taken out before all have looked at their surroundings.
    _over_tiles(claim, whole, bands, pool)
    _over_tiles(lambda window: _take_out(result, claimed, window, Validity.INCONSISTENT), whole, bands, pool)
    _over_tiles(clear, whole, BAND_ROWS, pool)
    _over_tiles(lambda window: _take_out(result, left_over, window, Validity.SPECKLE), whole, bands, pool)


def _take_out(result: DisparityMap, where: BoolArray, window: Window, reason: Validity) -> None:
    """Mask pixels of a result within a window, in place."""
    chosen = where[window.slices]
    if chosen.any():
        kernels.take_out(chosen, int(reason), result.disparity[window.slices], result.validity[window.slices])


def _over_tiles(
    work: Callable[[Window], None], whole: Window, size: int | tuple[int, int], pool: ThreadPoolExecutor
) -> None:
    """Do the work of every tile of a window, so many at once; each writes to its own part of the result."""
    windows = [
        Window(
            tile.row0 + whole.row0, tile.row1 + whole.row0, tile.column0 + whole.column0, tile.column1 + whole.column0
        )
        for tile in tiles(whole.shape, size)
    ]
    for done, _ in enumerate(pool.map(work, windows), start=1):
        _log.debug("tile %d/%d", done, len(windows))


def _with_halo(picture: ByteArray, tile: Window) -> tuple[Window, Window]:
    """What is to be matched for a tile, and the part of the tile that this covers: all of it that has data."""
    grown = tile.grown(HALO_PX, picture.shape)
    column, row, columns, rows = cv2.boundingRect(picture[grown.slices])
    row, column = row + grown.row0, column + grown.column0
    data = Window(row, row + rows, column, column + columns)
    if rows > 0:  # and what windows about a pixel with data look at
        data = data.grown(_SEEN_PX, picture.shape)
    grown = grown.common(data)
    return grown, tile.common(grown)


def _matched(
    task: _Task, window: Window, memory: Workspace, *, least_texture_sd: float | None = None, saturated_from: int = 256
) -> tuple[DisparityMap, ByteArray]:
    """One pass in one window, and the right picture at the matches.

    Without a least texture only data and consistency are asked for, as a prior needs.
    """
    left = np.ascontiguousarray(task.left[window.slices])
    disparities = task.step.disparities
    margin = disparities // 2 + _SLACK_PX
    wide = Window(window.row0, window.row1, window.column0 - margin, window.column1 + margin)
    low, high = task.range_px
    if task.before is None:
        prior = np.full(wide.shape, (low + high) / 2, np.float32)
    else:
        finer = task.before_level != task.step.level
        prior = prior_of(
            task.before,
            wide,
            finer=finer,
            otherwise=(low + high) / (4 if finer else 2),
            limits=task.range_px,
            memory=memory,
        )
        if task.start is not None:
            np.clip(prior, *task.start.over(wide, task.step.level), out=prior)
    right = resample_right(
        task.right,
        prior,
        wide.row0,
        wide.column0,
        y_parallax=task.y_parallax,
        level=task.step.level,
        memory=memory,
    )
    if least_texture_sd is None:
        left_validity = no_data(left, Validity.NO_DATA_LEFT)
        right_validity = no_data(right, Validity.NO_DATA_RIGHT)
    else:
        left_validity, right_validity = (
            picture_validity(image, flag, least_texture_sd=least_texture_sd, saturated_from=saturated_from)
            for image, flag in ((left, Validity.NO_DATA_LEFT), (right, Validity.NO_DATA_RIGHT))
        )
    found = aggregate_costs(
        left_census(left, memory),
        right_census(right, memory),
        disparities=disparities,
        small_step=task.small_step,
        large_step=task.large_step,
        memory=memory,
    )
    result, matched = select_disparities(
        found,
        prior,
        right,
        left_validity=left_validity,
        right_validity=right_validity,
        tolerated=0 if least_texture_sd is not None else int(Validity.AT_RANGE_EDGE),
        whole=least_texture_sd is not None,
        memory=memory,
    )
    if task.start is not None:
        _put_back(result, *task.start.over(window, task.step.level))
    return result, matched


def _put_back(result: DisparityMap, lowest: Float32Array, highest: Float32Array) -> None:
    """Flag what lies outside an interval and put the middle in its place, in place."""
    with np.errstate(invalid="ignore"):
        outside = (result.disparity < lowest) | (result.disparity > highest)
    result.validity[outside] |= np.uint8(Validity.AT_RANGE_EDGE)
    result.disparity[outside] = (lowest[outside] + highest[outside]) / 2


def _cleaned(
    left: ByteArray,
    tile: DisparityMap,
    right: ByteArray,
    memory: Workspace,
    *,
    least_correlation: float,
    least_uniqueness: float,
    largest_speckle_px: int,
    speckle_step_px: float,
) -> DisparityMap:
    """Median of 5 x 5; what is not alike, what does not stand out and islands masked; disparities rounded.

    right : the right picture at the matches
    """
    if tile.validity.all():
        return tile
    disparity: Float32Array = memory.array("median", tile.disparity.shape, np.float32)
    cv2.medianBlur(tile.disparity, 5, dst=disparity)
    kernels.clean(
        disparity,
        correlation(np.ascontiguousarray(left), right, memory),
        uniqueness(tile.confidence),
        least_correlation,
        255 * least_uniqueness,
        int(Validity.LOW_CORRELATION),
        int(Validity.INCONSISTENT),
        FRACTIONS,
        tile.validity,
        tile.similarity,
    )
    islands = speckles(disparity, largest_speckle_px=largest_speckle_px, speckle_step_px=speckle_step_px)
    kernels.take_out(islands, int(Validity.SPECKLE), disparity, tile.validity)
    return DisparityMap(disparity, tile.validity, tile.confidence, tile.similarity)


def strip_alignment_px(span_px: float) -> int:
    """Rows of which a strip should begin at a multiple, so that its pyramid is that of the whole picture."""
    return 1 << plan_passes(span_px)[0].level
