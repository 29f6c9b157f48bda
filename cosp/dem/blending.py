"""Several rasters on one grid joined without steps."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from cosp.arrays import BoolArray, ByteArray, Float32Array, FloatArray


def edge_weights(valid: BoolArray, others: BoolArray, *, ramp_cells: float) -> Float32Array:
    """Weights of a model that rise from nearly zero where it ends amid others to one `ramp_cells` inside.

    Only edges beyond which another model goes on count: where all end together, or where there is no other, nothing has
    to fade.

    Parameters
    ----------
    valid, others : (R, C) boolean arrays
        Where this model, and where any model, has values.
    ramp_cells : float
    """
    ends = others & ~valid
    if not ends.any():
        return valid.astype(np.float32)
    distance = cv2.distanceTransform((~ends).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    ramp = np.clip((distance - 0.5) / ramp_cells, 1e-3, 1)
    return np.where(valid, 0.5 - 0.5 * np.cos(np.pi * ramp), 0).astype(np.float32)


def mosaic(models: Sequence[FloatArray], *, ramp_cells: float) -> Float32Array:
    """Mean of several models on one grid, weighted by the distance to the edge of each.

    Parameters
    ----------
    models : arrays of one shape
        NaN where a model has no value.
    ramp_cells : float
        Width of the blend.

    Returns
    -------
    float32 array
        NaN where none has a value; exactly a model's value where only that one has some.
    """
    total = np.zeros(np.shape(models[0]), np.float32)
    weighted = np.zeros_like(total)
    # About the first value at hand, so that float32 keeps millimetres of thousands of metres.
    base = np.full_like(total, np.nan)
    for model in models:
        base = np.where(np.isnan(base), model, base).astype(np.float32)
    known = np.isfinite(base)
    for model in models:
        valid = np.isfinite(model)
        weight = edge_weights(valid, known, ramp_cells=ramp_cells)
        weighted += np.where(valid, weight * (model - base), 0).astype(np.float32)
        total += weight
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total > 0, base + weighted / total, np.nan).astype(np.float32)


def grey_levels(images: Sequence[ByteArray], *, ramp_cells: float) -> list[tuple[float, float]]:
    """Gain and offset that bring each orthophoto to the contrast of those before it, where they overlap.

    Thinned images on one grid serve as well as whole ones; 0 is no data.
    """
    levelled: list[FloatArray] = []
    levels = []
    for image in images:
        grey = np.where(image > 0, image, np.nan).astype(np.float32)
        gain, offset = _level(grey, mosaic(levelled, ramp_cells=ramp_cells)) if levelled else (1.0, 0.0)
        levels.append((gain, offset))
        levelled.append(gain * grey + offset)
    return levels


def mosaic_orthophotos(
    images: Sequence[ByteArray], *, ramp_cells: float, levels: Sequence[tuple[float, float]] | None = None
) -> ByteArray:
    """Orthophotos on one grid joined like `mosaic`; 0 is no data.

    Parameters
    ----------
    images : uint8 arrays of one shape
    ramp_cells : float
    levels : (gain, offset) of each image, optional
        From `grey_levels`; found from these images unless given, as it must be for tiles of a larger mosaic.
    """
    levels = grey_levels(images, ramp_cells=ramp_cells) if levels is None else levels
    levelled = [
        np.where(image > 0, gain * image.astype(np.float32) + offset, np.nan)
        for image, (gain, offset) in zip(images, levels, strict=True)
    ]
    joined = mosaic(levelled, ramp_cells=ramp_cells)
    return np.where(np.isfinite(joined), np.clip(np.rint(joined), 1, 255), 0).astype(np.uint8)


def _level(image: Float32Array, target: Float32Array, least_cells: int = 100) -> tuple[float, float]:
    """Gain and offset that give the image the median and spread of the target where both have values."""
    both = np.isfinite(image) & np.isfinite(target)
    if both.sum() < least_cells:
        return 1.0, 0.0
    low, middle, high = np.percentile(image[both], [16, 50, 84])
    target_low, target_middle, target_high = np.percentile(target[both], [16, 50, 84])
    gain = float((target_high - target_low) / (high - low)) if high > low else 1.0
    return gain, float(target_middle - gain * middle)
