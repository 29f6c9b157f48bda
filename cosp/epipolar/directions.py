"""One epipolar direction for a whole film."""

from __future__ import annotations

import math

import numpy as np

from cosp.arrays import FloatArray


def mean_direction_rad(directions: FloatArray) -> float:
    """Angle of the line that unit vectors follow on average, in (-pi/2, pi/2].

    Angles are doubled before the mean, so that a vector and its opposite count as the same line.

    Parameters
    ----------
    directions : (N, 2) array

    References
    ----------
    [Deseilligny2020] section 3.1
    """
    doubled = (directions[:, 0] + 1j * directions[:, 1]) ** 2
    return float(np.angle(doubled.mean()) / 2)


def common_directions_rad(fore_directions: FloatArray, aft_directions: FloatArray) -> tuple[float, float]:
    """Angles of the epipolar direction on the fore and on the aft film that stand for the same sense on the ground.

    Rising along a ray of the other camera moves a point towards that camera's station, which is forwards on one film
    and backwards on the other: directions from low to high are opposite in sense. The sense taken is the one that
    keeps the other axis, across and to the right of it, along the film's +x where the epipolar direction is nearer
    to y, and else along -y; rectified pictures are then turned, not mirrored, with rows along the scan.

    Parameters
    ----------
    fore_directions, aft_directions : (N, 2), (M, 2) arrays
        Unit vectors from low to high ground points.
    """
    fore = mean_direction_rad(fore_directions)
    if abs(math.sin(fore)) >= abs(math.cos(fore)):
        fore = fore % math.pi
    fore_rises = _sense(fore, fore_directions)
    aft = mean_direction_rad(aft_directions)
    if _sense(aft, aft_directions) == fore_rises:
        aft += math.pi
    return fore, math.remainder(aft, math.tau)


def _sense(angle_rad: float, directions: FloatArray) -> float:
    """Whether most directions follow (+1) or oppose (-1) an angle."""
    along = directions @ np.array([math.cos(angle_rad), math.sin(angle_rad)])
    return float(np.sign(np.sign(along).sum()))
