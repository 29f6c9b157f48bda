"""Memory that tiles use one after another: touching fresh memory takes as long as matching."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

_LINE = 64  # bytes of a line of the cache: what crosses from one to the next takes twice as long to store


class Workspace:
    """Arrays by name, not filled, that keep their memory; what one holds is lost when it is asked for again."""

    def __init__(self) -> None:
        self._pieces: dict[str, NDArray[np.uint8]] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """A contiguous array in the memory of that name."""
        size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if name not in self._pieces or self._pieces[name].size < size:
            self._pieces.pop(name, None)  # before the next is asked for
            whole = np.empty(size + _LINE, np.uint8)
            self._pieces[name] = whole[-whole.ctypes.data % _LINE :]
        return self._pieces[name][:size].view(dtype).reshape(shape)


_spare: list[Workspace] = []


@contextmanager
def workspace() -> Iterator[Workspace]:
    """A workspace that no other thread has meanwhile."""
    try:
        chosen = _spare.pop()
    except IndexError:
        chosen = Workspace()
    try:
        yield chosen
    finally:
        _spare.append(chosen)
