"""The joined film, which is never stored: any view of it is resampled once from the digitised parts.

A part is a (rows, columns) uint8 array. Places in a part and in the joined film are points (x, y) = (column, row) in
pixels, pixel centres on integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from cosp.arrays import ByteArray, Float32Array, FloatArray
from cosp.film.scanner import Steps
from cosp.film.stitching import Seam
from cosp.geometry.transforms import Rigid
from cosp.imaging.resampling import block_mean, sample
from cosp.imaging.windows import Window, tiles


@dataclass(frozen=True)
class Layout:
    """Where the parts lie in the joined film, left to right.

    Parameters
    ----------
    motions : Rigid of each part
        Part to joined film, px.
    steps : Steps of each part
        Displacement of the scanner's blocks, taken out before the motion.
    greys : (gain, offset) of each part
        Balanced grey value = gain * grey value + offset.
    joints_px : float of each seam
        Column in which one part hands over to the next.
    feathers_px : float of each seam
        Width of the band in which they are blended.
    shape : (rows, columns)
        Of the joined film.
    """

    KIND: ClassVar[str] = "layout"
    VERSION: ClassVar[int] = 1

    motions: tuple[Rigid, ...]
    steps: tuple[Steps, ...]
    greys: tuple[tuple[float, float], ...]
    joints_px: tuple[float, ...]
    feathers_px: tuple[float, ...]
    shape: tuple[int, int]

    def reduced(self, factor: int) -> Layout:
        """The layout of parts reduced by means of factor x factor pixels, for a joined film reduced alike."""
        middle = np.full(2, (factor - 1) / 2)
        motions = []
        for motion in self.motions:
            shift = (motion.apply(middle) - middle) / factor
            motions.append(Rigid(motion.rotation_rad, (float(shift[0]), float(shift[1]))))
        rows, columns = (-(-n // factor) for n in self.shape)
        return Layout(
            tuple(motions),
            tuple(steps.reduced(factor) for steps in self.steps),
            self.greys,
            tuple((joint - middle[0]) / factor for joint in self.joints_px),
            tuple(max(1.0, feather / factor) for feather in self.feathers_px),
            (rows, columns),
        )


def lay_out(
    shapes: Sequence[tuple[int, int]],
    seams: Sequence[Seam],
    *,
    feather_px: float,
    steps: Sequence[Steps] | None = None,
) -> Layout:
    """Parts placed side by side by their seams, grey values balanced so that the mean change is none.

    Parameters
    ----------
    shapes : (rows, columns) of each part, left to right
    seams : Seam between each two
    feather_px : float
        Width of the blended band; less where the overlap is narrow.
    steps : Steps of each part, optional
        None: parts without steps.
    """
    motions = [Rigid(0.0, (0.0, 0.0))]
    greys = [(1.0, 0.0)]
    for seam in seams:
        motions.append(motions[-1].after(seam.motion))
        gain, offset = greys[-1]
        greys.append((gain * seam.gain, gain * seam.offset + offset))
    mean_gain = float(np.exp(np.mean([np.log(g) for g, _ in greys])))
    mean_offset = float(np.mean([128.0 * g / mean_gain + o / mean_gain - 128.0 for g, o in greys]))
    greys = [(g / mean_gain, o / mean_gain - mean_offset) for g, o in greys]

    corners = [
        m.apply(np.array([[0, 0], [c - 1, 0], [0, r - 1], [c - 1, r - 1]], float))
        for m, (r, c) in zip(motions, shapes, strict=True)
    ]
    low = np.floor(np.min([c.min(axis=0) for c in corners], axis=0) + 1e-6)
    high = np.ceil(np.max([c.max(axis=0) for c in corners], axis=0) - 1e-6)
    moved = tuple(Rigid(m.rotation_rad, (float(m.shift[0] - low[0]), float(m.shift[1] - low[1]))) for m in motions)
    joints, feathers = [], []
    for k in range(len(seams)):
        begin, end = corners[k + 1][[0, 2], 0].max() - low[0], corners[k][[1, 3], 0].min() - low[0]
        joints.append(float((begin + end) / 2))
        feathers.append(float(max(1.0, min(feather_px, (end - begin) / 2))))
    columns, rows = (high - low).astype(int) + 1
    none = tuple(Steps() for _ in shapes)
    return Layout(
        moved,
        none if steps is None else tuple(steps),
        tuple(greys),
        tuple(joints),
        tuple(feathers),
        (int(rows), int(columns)),
    )


def view(parts: Sequence[ByteArray], layout: Layout, begin: FloatArray, end: FloatArray, rows: int) -> ByteArray:
    """The joined film along straight lines: each part resampled once (bicubic), balanced, blended across the joints.

    Parameters
    ----------
    parts : (rows, columns) uint8 array of each place of the layout
    layout : Layout
    begin, end : (N, 2) arrays
        Places (x, y) in the joined film of the first and of the last grey value of each line.
    rows : int
        Grey values a line.

    Returns
    -------
    (rows, N) uint8 array
        0 outside the film.
    """
    share = np.linspace(0.0, 1.0, rows, dtype=np.float32)[:, None]
    low, high = np.minimum(begin[:, 0], end[:, 0]), np.maximum(begin[:, 0], end[:, 0])
    out = np.zeros((rows, len(begin)), np.uint8)
    total: Float32Array | None = None
    weights = np.zeros_like(out, np.float32)
    for k, part in enumerate(parts):
        used = np.ones(len(begin), bool)
        whole = True
        for seam, entering in ((k - 1, True), (k, False)):
            if 0 <= seam < len(layout.joints_px):
                joint, half = layout.joints_px[seam], layout.feathers_px[seam] / 2
                used &= high > joint - half if entering else low < joint + half
        if not used.any():
            continue
        first, last = int(np.flatnonzero(used)[0]), int(np.flatnonzero(used)[-1]) + 1
        here = slice(first, last)
        seen = _one_part(part, layout.motions[k], layout.steps[k], begin[here], end[here], share)
        table = np.clip(_balanced(layout.greys[k]), 1.0, 255.0).astype(np.float32)
        table[0] = 0.0
        for seam in (k - 1, k):
            if 0 <= seam < len(layout.joints_px):
                joint, half = layout.joints_px[seam], layout.feathers_px[seam] / 2
                whole &= not bool(((high > joint - half) & (low < joint + half))[here].any())
        if whole and total is None and first == 0 and last == len(begin):
            return np.asarray(np.rint(table).astype(np.uint8)[seen])
        if total is None:
            total = np.zeros(out.shape, np.float32)
        places = begin[here, 0].astype(np.float32) + share * (end[here, 0] - begin[here, 0]).astype(np.float32)
        weight = _weight(places, layout, k)
        weight[seen == 0] = 0.0
        total[:, here] += weight * table[seen]
        weights[:, here] += weight
    if total is None:
        return out
    return np.asarray(np.rint(np.divide(total, weights, out=total, where=weights > 0)), np.uint8)


def _balanced(grey: tuple[float, float]) -> FloatArray:
    return np.asarray(grey[0] * np.arange(256) + grey[1])


def _one_part(
    part: ByteArray, motion: Rigid, steps: Steps, begin: FloatArray, end: FloatArray, share: Float32Array
) -> ByteArray:
    """Grey values of one part along lines of the joined film; 0 where it does not reach."""
    back = motion.inverse()
    # A rigid motion keeps lines straight: two of their places give the others.
    start, stop = back.apply(begin), back.apply(end)
    margin = 4.0 + steps.largest_px
    low = np.floor(np.minimum(start, stop).min(axis=0) - margin).astype(int)
    high = np.ceil(np.maximum(start, stop).max(axis=0) + margin).astype(int) + 1
    box = Window(max(low[1], 0), min(high[1], part.shape[0]), max(low[0], 0), min(high[0], part.shape[1]))
    if box.row1 <= box.row0 or box.column1 <= box.column0:
        return np.zeros((len(share), len(begin)), np.uint8)
    # Single precision is enough for places counted from the corner of the box, not for those of a film.
    start, stop = start - (box.column0, box.row0), stop - (box.column0, box.row0)
    columns, rows = (start[:, i].astype(np.float32) + share * (stop - start)[:, i].astype(np.float32) for i in (0, 1))
    if steps.columns_px:
        shift = steps.at(np.arange(box.column0, box.column1, dtype=float)).astype(np.float32)
        nearest = np.clip(np.rint(columns), 0, len(shift) - 1).astype(np.int32)
        columns += shift[:, 0][nearest]
        rows += shift[:, 1][nearest]
    return np.asarray(sample(part[box.slices], rows, columns, interpolation="cubic"), np.uint8)


def _weight(columns: Float32Array, layout: Layout, part: int) -> Float32Array:
    """Weight of a part at columns of the joined film: 1, but for a smooth passage across its joints."""
    weight = np.ones_like(columns)
    for seam, entering in ((part - 1, True), (part, False)):
        if 0 <= seam < len(layout.joints_px):
            ramp = np.clip((columns - layout.joints_px[seam]) / layout.feathers_px[seam] + 0.5, 0.0, 1.0)
            step = ramp * ramp * (3.0 - 2.0 * ramp)
            weight *= step if entering else 1.0 - step
    return weight


def compose(parts: Sequence[ByteArray], layout: Layout, window: Window) -> ByteArray:
    """The joined film in a window; 0 outside."""
    x = np.arange(window.column0, window.column1, dtype=float)
    begin, end = (np.column_stack([x, np.full_like(x, row)]) for row in (window.row0, window.row1 - 1))
    return view(parts, layout, begin, end, window.row1 - window.row0)


def compose_reduced(parts: Sequence[ByteArray], layout: Layout, factor: int) -> ByteArray:
    """The whole joined film, reduced: pixel i lies on the middle of pixels factor i to factor (i + 1) - 1."""
    small = layout.reduced(factor)
    reduced = [block_mean(np.ascontiguousarray(part), factor) for part in parts]
    out = np.empty(small.shape, np.uint8)
    for window in tiles(small.shape, (small.shape[0], 2048)):
        out[window.slices] = compose(reduced, small, window)
    return out
