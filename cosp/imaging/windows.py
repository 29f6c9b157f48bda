"""Windows of rasters: tiles, strips, halos and blending weights."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from cosp.arrays import FloatArray

WorkT = TypeVar("WorkT")
ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class Window:
    """Rows row0 to row1 and columns column0 to column1 of a raster, ends excluded."""

    row0: int
    row1: int
    column0: int
    column1: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.row1 - self.row0, self.column1 - self.column0

    @property
    def slices(self) -> tuple[slice, slice]:
        """For indexing an array of the whole raster."""
        return slice(self.row0, self.row1), slice(self.column0, self.column1)

    def grown(self, halo: int, shape: tuple[int, int]) -> Window:
        """The window with a halo, cut at the edges of a raster of the given shape."""
        return Window(
            max(self.row0 - halo, 0),
            min(self.row1 + halo, shape[0]),
            max(self.column0 - halo, 0),
            min(self.column1 + halo, shape[1]),
        )

    def common(self, other: Window) -> Window:
        """What both windows cover; without rows or columns where that is nothing."""
        row0, column0 = max(self.row0, other.row0), max(self.column0, other.column0)
        return Window(
            row0, max(min(self.row1, other.row1), row0), column0, max(min(self.column1, other.column1), column0)
        )

    def inside(self, outer: Window) -> Window:
        """Rows and columns counted from the corner of an outer window."""
        return Window(
            self.row0 - outer.row0,
            self.row1 - outer.row0,
            self.column0 - outer.column0,
            self.column1 - outer.column0,
        )


def tiles(shape: tuple[int, int], size: int | tuple[int, int], overlap: int = 0) -> list[Window]:
    """Windows of `size` that cover a raster, row by row; neighbours share `overlap` pixels."""
    height, width = (size, size) if isinstance(size, int) else size
    rows, columns = shape
    return [
        Window(r, min(r + height, rows), c, min(c + width, columns))
        for r in range(0, max(rows - overlap, 1), height - overlap)
        for c in range(0, max(columns - overlap, 1), width - overlap)
    ]


def strips(length: int, count: int) -> list[tuple[int, int]]:
    """(start, stop) of `count` nearly equal pieces of a length, in order; never an empty piece but for length 0."""
    edges = [round(i * length / count) for i in range(count + 1)]
    return list(zip(edges[:-1], edges[1:], strict=True))


def strip_of(length: int, scatteritem: str) -> tuple[int, int]:
    """(start, stop) of the piece that a name such as "3-of-16" stands for."""
    index, count = (int(v) for v in scatteritem.split("-of-"))
    return strips(length, count)[index - 1]


def worked_on(
    pool: Executor, function: Callable[[WorkT], ResultT], works: Iterable[WorkT], *, ahead: int
) -> Iterator[tuple[WorkT, ResultT]]:
    """Pieces of work, such as windows, and what becomes of them, in their order, while the next ones are worked on.

    Parameters
    ----------
    pool : Executor
    function : function of a piece of work
    works : iterable
        Asked for one by one, each when its work can begin.
    ahead : int
        Pieces in work or done that wait for their turn at most; bounds the memory.
    """
    waiting: deque[tuple[WorkT, Future[ResultT]]] = deque()
    for work in works:
        waiting.append((work, pool.submit(function, work)))
        if len(waiting) > ahead:
            done, result = waiting.popleft()
            yield done, result.result()
    for done, result in waiting:
        yield done, result.result()


def cosine_weights(shape: tuple[int, int], border: int) -> FloatArray:
    """Weights that rise from nearly zero at the edge to one at `border` pixels inside."""

    def ramp(length: int) -> FloatArray:
        distance = np.minimum(np.arange(length) + 0.5, length - 0.5 - np.arange(length))
        return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(distance / max(border, 1), 0, 1)))

    return np.asarray(np.outer(ramp(shape[0]), ramp(shape[1])))
