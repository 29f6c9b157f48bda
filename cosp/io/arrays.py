"""Plain arrays, for what one rule leaves to the next and is then removed: written and read as fast as memory allows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosp.errors import InputError
from cosp.io.temporary import temporary_for


def write(path: str | Path, parts: Sequence[NDArray[Any]]) -> None:
    """Write arrays of one shape and type as one with an axis more, whole or not at all."""
    path = Path(path)
    temporary = temporary_for(path)
    try:
        with temporary.open("wb") as file:
            header = {"descr": parts[0].dtype.str, "fortran_order": False, "shape": (len(parts), *parts[0].shape)}
            np.lib.format.write_array_header_1_0(file, header)
            for part in parts:
                np.ascontiguousarray(part).tofile(file)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def view(path: str | Path) -> NDArray[Any]:
    """An array that is read from its file as it is looked at.

    Raises
    ------
    InputError
        If the file is missing, is no array, or ends too soon.
    """
    try:
        return np.asarray(np.load(path, mmap_mode="r"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not an array that can be read ({error})") from error
