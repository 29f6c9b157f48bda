"""What other tools' forms of a camera have in common: points to fit them at, and how well they fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosp.arrays import FloatArray
from cosp.geometry.grids import PixelGrid

CHECKS = (61, 11, 7)  # columns, rows, heights of the points that a residual is measured at


@dataclass(frozen=True)
class Residual:
    """How far a form is from the camera it was made of, in pixels of the image.

    Parameters
    ----------
    rms_px : float
        Of the distances.
    largest_px : float
    """

    rms_px: float
    largest_px: float

    @classmethod
    def of(cls, differences_px: FloatArray) -> Residual:
        """Residual of differences (..., 2) in columns and rows."""
        distances = np.hypot(differences_px[..., 0], differences_px[..., 1])
        return cls(float(np.sqrt((distances**2).mean())), float(distances.max()))


def film_lattice(
    grid: PixelGrid, heights_m: tuple[float, float], counts: tuple[int, int, int] = CHECKS
) -> tuple[FloatArray, FloatArray]:
    """Film points and heights all over an image, denser towards its edges, where fits are worst.

    Lattices of other counts than one that was fitted to share its corners and little else.

    Parameters
    ----------
    grid : PixelGrid
        Image of the film, mm.
    heights_m : lowest and highest
    counts : columns, rows, heights

    Returns
    -------
    film_mm : (N, 2) array, mm
    height_m : (N,) array, m
    """
    spans = ((-0.5, grid.shape[1] - 0.5), (-0.5, grid.shape[0] - 0.5), heights_m)
    axes = [
        low + (high - low) * (1.0 - np.cos(np.pi * np.arange(count) / (count - 1))) / 2.0
        for (low, high), count in zip(spans, counts, strict=True)
    ]
    columns, rows, height_m = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
    return grid.points(rows, columns), height_m
