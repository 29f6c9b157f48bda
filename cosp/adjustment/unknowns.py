"""The unknowns of a camera: its 13 parameters and, where it is asked for, the focal length after them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera.derivatives import PARAMETER_NAMES
from cosp.camera.panoramic import PanoramicCamera

PARAMETERS = len(PARAMETER_NAMES)
NAMES = (*PARAMETER_NAMES, "f")
SAME_LENS_MM = 0.01  # by how much a lens may change its focal length from frame to frame


def values_of(camera: PanoramicCamera, count: int = PARAMETERS) -> FloatArray:
    """The first `count` unknowns of a camera: 13, or 14 with the focal length in mm."""
    return np.append(camera.parameters(), camera.focal_length_mm)[:count]


def with_values(camera: PanoramicCamera, values: FloatArray) -> PanoramicCamera:
    """The camera with other values of its 13 or 14 unknowns."""
    changed = camera.with_parameters(values[:PARAMETERS])
    return changed if len(values) == PARAMETERS else replace(changed, focal_length_mm=float(values[PARAMETERS]))


def with_focal_lengths(information: FloatArray, film_groups: Sequence[int], sigma_mm: float) -> FloatArray:
    """Information of cameras (13 n, 13 n) with what is believed of their focal lengths, (14 n, 14 n).

    Parameters
    ----------
    information : (13 n, 13 n) array
    film_groups : sequence of int
        Which images were taken by the same camera: they share its lens.
    sigma_mm : float
        Standard deviation of a focal length about the one given.
    """
    images = len(film_groups)
    wide = np.zeros((images, PARAMETERS + 1, images, PARAMETERS + 1))
    wide[:, :PARAMETERS, :, :PARAMETERS] = information.reshape(images, PARAMETERS, images, PARAMETERS)
    focal = np.zeros((images, images))
    for group in sorted(set(film_groups)):
        mine = np.flatnonzero(np.asarray(film_groups) == group)
        # One lens, whose focal length is believed in once.
        focal[np.ix_(mine, mine)] = np.linalg.inv(sigma_mm**2 + SAME_LENS_MM**2 * np.eye(len(mine)))
    wide[:, PARAMETERS, :, PARAMETERS] = focal
    return wide.reshape(images * (PARAMETERS + 1), -1)
