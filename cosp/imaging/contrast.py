"""Contrast of images."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cosp.arrays import BoolArray, ByteArray, Float32Array


def local_normalise(image: NDArray[Any], sigma_px: float, floor: float = 1.0) -> Float32Array:
    """Grey values minus their local mean, over their local standard deviation.

    Parameters
    ----------
    image : (R, C) array
    sigma_px : float
        Of the Gaussian window.
    floor : float
        Smallest standard deviation divided by, in grey levels: flat areas stay flat.
    """
    values = image.astype(np.float32)
    mean = cv2.GaussianBlur(values, (0, 0), sigma_px)
    variance = cv2.GaussianBlur(values * values, (0, 0), sigma_px) - mean * mean
    return np.asarray((values - mean) / np.sqrt(np.maximum(variance, floor**2)), np.float32)


def percentile_stretch(
    image: NDArray[Any], low: float = 1.0, high: float = 99.0, mask: BoolArray | None = None
) -> ByteArray:
    """Grey values 1 to 255 between two percentiles of the masked (or finite) pixels; 0 elsewhere."""
    valid = np.isfinite(image) if mask is None else mask & np.isfinite(image)
    if not valid.any():
        return np.zeros(image.shape, np.uint8)
    a, b = np.percentile(image[valid], [low, high])
    scaled = 1 + 254 * np.clip((np.nan_to_num(image) - a) / max(b - a, 1e-9), 0, 1)
    return np.where(valid, np.round(scaled), 0).astype(np.uint8)
