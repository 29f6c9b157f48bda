"""Grey values between pixels, and images at a coarser size."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from cosp.arrays import BoolArray, Float32Array, FloatArray

cv2.setNumThreads(1)  # parallel work is by windows, in threads of ours

Interpolation = Literal["nearest", "linear", "cubic", "lanczos"]
_FLAGS = {
    "nearest": cv2.INTER_NEAREST,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
_REACH = {"nearest": 1, "linear": 1, "cubic": 2, "lanczos": 4}
_BLOCK = 2048  # pixels a side of a block of results; OpenCV refuses sides of 32767 and more


def sample(
    image: NDArray[Any],
    rows: FloatArray,
    columns: FloatArray,
    *,
    interpolation: Interpolation = "cubic",
    border: float = 0,
) -> NDArray[Any]:
    """Values of an image at places between its pixels.

    Parameters
    ----------
    image : (R, C) array, uint8, uint16 or float32
        Of any size; it is cut as OpenCV needs it.
    rows, columns : arrays of one shape, (N,) or (H, W)
        Integers at pixel centres. NaN gives `border`.
    interpolation : str
    border : float
        Value outside the image. Places more than half a pixel outside get exactly this.

    Returns
    -------
    array of the shape of `rows` and the type of `image`
    """
    rows, columns = np.asarray(rows), np.asarray(columns)
    flat = rows.ndim != 2
    rows2, columns2 = (np.atleast_1d(a).reshape(-1, 1) if flat else a for a in (rows, columns))
    if flat and rows2.shape[0] > _BLOCK:  # long lists as pictures, so that a block is one call
        padded = -(-rows2.shape[0] // _BLOCK) * _BLOCK
        rows2, columns2 = (np.resize(a, (padded // _BLOCK, _BLOCK)) for a in (rows2, columns2))
    result = np.empty(rows2.shape, image.dtype)
    for r in range(0, rows2.shape[0], _BLOCK):
        for c in range(0, rows2.shape[1], _BLOCK):
            part = (slice(r, r + _BLOCK), slice(c, c + _BLOCK))
            result[part] = _sample_block(image, rows2[part], columns2[part], interpolation, border)
    return result.ravel()[: rows.size].reshape(rows.shape) if flat else result


def _sample_block(
    image: NDArray[Any], rows: FloatArray, columns: FloatArray, interpolation: Interpolation, border: float
) -> NDArray[Any]:
    with np.errstate(invalid="ignore"):
        inside: BoolArray = (
            (rows > -0.5) & (rows < image.shape[0] - 0.5) & (columns > -0.5) & (columns < image.shape[1] - 0.5)
        )
    if not inside.any():
        return np.full(rows.shape, border, image.dtype)
    reach = _REACH[interpolation] + 1
    row0 = max(int(np.floor(rows[inside].min())) - reach, 0)
    row1 = min(int(np.ceil(rows[inside].max())) + reach + 1, image.shape[0])
    column0 = max(int(np.floor(columns[inside].min())) - reach, 0)
    column1 = min(int(np.ceil(columns[inside].max())) + reach + 1, image.shape[1])
    if max(row1 - row0, column1 - column0) >= 32767:
        return _sample_halves(image, rows, columns, interpolation, border)
    window = np.ascontiguousarray(image[row0:row1, column0:column1])
    map_x = np.where(inside, columns - column0, -1e4).astype(np.float32)
    map_y = np.where(inside, rows - row0, -1e4).astype(np.float32)
    values = cv2.remap(window, map_x, map_y, _FLAGS[interpolation], borderMode=cv2.BORDER_REPLICATE)
    values[~inside] = border
    return values


def _sample_halves(
    image: NDArray[Any], rows: FloatArray, columns: FloatArray, interpolation: Interpolation, border: float
) -> NDArray[Any]:
    """Places too far apart for one call: those of each piece of the image by themselves."""
    size = 30000
    result = np.full(rows.shape, border, image.dtype)
    with np.errstate(invalid="ignore"):
        piece = np.floor_divide(rows, size) * 1000 + np.floor_divide(columns, size)
    for value in np.unique(piece[np.isfinite(piece)]):
        chosen = piece == value
        result[chosen] = _sample_block(
            image, np.where(chosen, rows, np.nan), np.where(chosen, columns, np.nan), interpolation, border
        )[chosen]
    return result


def block_mean(image: NDArray[Any], factor: int) -> NDArray[Any]:
    """Means of factor x factor blocks, in the type of the image (rounded); ragged edges are repeated outwards.

    The centre of block (0, 0) lies at row and column (factor - 1) / 2 of the image.
    """
    if factor == 1:
        return image
    pad = [(0, -n % factor) for n in image.shape]
    padded = np.pad(image, pad, mode="edge") if any(p[1] for p in pad) else image
    size = (padded.shape[1] // factor, padded.shape[0] // factor)
    return np.asarray(cv2.resize(padded, size, interpolation=cv2.INTER_AREA))


def block_extremes(values: NDArray[Any], factor: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Lowest and highest of what is given (not NaN) in factor x factor blocks; blocks at ragged edges hold less."""
    pad = [(0, -n % factor) for n in values.shape]
    padded = np.pad(values, pad, mode="edge") if any(p[1] for p in pad) else values
    blocks = padded.reshape(padded.shape[0] // factor, factor, padded.shape[1] // factor, factor)
    return np.fmin.reduce(blocks, axis=(1, 3)), np.fmax.reduce(blocks, axis=(1, 3))


def pyramid(image: NDArray[Any], levels: int) -> list[NDArray[Any]]:
    """The image and `levels` halvings of it (Gaussian); pixel i of a level lies on pixel 2 i of the one before."""
    result = [image]
    for _ in range(levels):
        result.append(cv2.pyrDown(result[-1]))
    return result


def upsample_grid(values: Float32Array, rows: FloatArray, columns: FloatArray) -> Float32Array:
    """A coarse grid at fractional rows and columns, bilinear, continued by its edge values.

    Parameters
    ----------
    values : (R, C) float32 array
    rows, columns : arrays of one shape
        In units of the coarse grid.
    """
    r = np.clip(rows, 0, values.shape[0] - 1)
    c = np.clip(columns, 0, values.shape[1] - 1)
    return np.asarray(sample(values.astype(np.float32), r, c, interpolation="linear"), np.float32)
