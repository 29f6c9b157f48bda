"""Rays and the point where two of them meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosp.arrays import FloatArray


@dataclass(frozen=True)
class Rays:
    """Half lines in a local frame.

    Parameters
    ----------
    origin, direction : (..., 3) arrays, m
        The direction has length one.
    """

    origin: FloatArray
    direction: FloatArray

    def at(self, distance_m: FloatArray) -> FloatArray:
        """Points at the given distances, (..., 3)."""
        return self.origin + np.asarray(distance_m)[..., None] * self.direction


def meet(first: Rays, second: Rays) -> tuple[FloatArray, FloatArray]:
    """Ground points nearest to two rays each, and the gap between the rays.

    The point halfway along the common perpendicular: the least-squares solution of the
    perpendicular distances to the two rays.

    Returns
    -------
    ground : (..., 3) array, m
        NaN where the rays are parallel.
    gap_m : (...) array, m
        Length of the common perpendicular.

    References
    ----------
    [Ghuffar2022] equation 13, solved in closed form.
    """
    between = second.origin - first.origin
    cosine = (first.direction * second.direction).sum(-1)
    along_first = (first.direction * between).sum(-1)
    along_second = (second.direction * between).sum(-1)
    sine_squared = 1.0 - cosine**2
    with np.errstate(divide="ignore", invalid="ignore"):
        t_first = (along_first - cosine * along_second) / sine_squared
        t_second = (cosine * along_first - along_second) / sine_squared
        a, b = first.at(t_first), second.at(t_second)
    parallel = sine_squared < 1e-12
    ground = np.where(parallel[..., None], np.nan, (a + b) / 2)
    gap = np.where(parallel, np.nan, np.linalg.norm(a - b, axis=-1))
    return ground, gap
