"""Values that change slowly, given at nodes, at every pixel of a window."""

from __future__ import annotations

import numpy as np

from cosp.arrays import Float32Array, FloatArray


def between_nodes(values: FloatArray, rows: FloatArray, columns: FloatArray) -> Float32Array:
    """A lattice at rows and columns that form a grid themselves, bilinear; its edge values go on beyond it.

    Quicker than places one by one: lines are made once, then mixed.

    Parameters
    ----------
    values : (R, C) array
        NaN makes NaN of what lies beside it.
    rows, columns : (H,), (W,) arrays
        In units of the lattice.

    Returns
    -------
    (H, W) array
    """
    r, p = _left_and_part(rows, values.shape[0])
    c, q = _left_and_part(columns, values.shape[1])
    needed = values[r.min() : r.max() + 2].astype(np.float32)
    r -= r.min()
    lines = needed[:, c] * (1 - q) + needed[:, np.minimum(c + 1, values.shape[1] - 1)] * q
    lower = lines[np.minimum(r + 1, len(lines) - 1)]
    lower *= p[:, None]
    upper = lines[r]
    upper *= 1 - p[:, None]
    upper += lower
    return np.asarray(upper, np.float32)


def _left_and_part(places: FloatArray, count: int) -> tuple[np.ndarray[tuple[int], np.dtype[np.intp]], Float32Array]:
    """Node before each place, and how far on it lies towards the next."""
    inside = np.clip(places, 0, count - 1)
    left = np.minimum(inside.astype(np.intp), max(count - 2, 0))
    return left, (inside - left).astype(np.float32)
