"""Omega, phi, kappa to rotation matrices and back."""

from __future__ import annotations

import numpy as np

from cosp.arrays import FloatArray


def rotation_matrix(angles_rad: FloatArray) -> FloatArray:
    """Rotation that takes world axes to camera axes, R = R_kappa R_phi R_omega.

    Omega turns first. A camera with a small negative omega looks towards -y.

    Parameters
    ----------
    angles_rad : (..., 3) array, rad
        Omega, phi, kappa.

    Returns
    -------
    (..., 3, 3) array

    References
    ----------
    docs/conventions.md, "Camera"; the order follows from the signs of the parameter table of [Ghuffar2022].
    """
    angles = np.asarray(angles_rad, dtype=float)
    so, sp, sk = np.moveaxis(np.sin(angles), -1, 0)
    co, cp, ck = np.moveaxis(np.cos(angles), -1, 0)
    rows = [
        [cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck],
        [-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk],
        [sp, -so * cp, co * cp],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def angles_from_matrix(matrix: FloatArray) -> FloatArray:
    """Omega, phi, kappa of a rotation matrix; phi within a quarter turn.

    Parameters
    ----------
    matrix : (..., 3, 3) array

    Returns
    -------
    (..., 3) array, rad
    """
    matrix = np.asarray(matrix, dtype=float)
    phi = np.arcsin(np.clip(matrix[..., 2, 0], -1.0, 1.0))
    omega = np.arctan2(-matrix[..., 2, 1], matrix[..., 2, 2])
    kappa = np.arctan2(-matrix[..., 1, 0], matrix[..., 0, 0])
    return np.stack([omega, phi, kappa], axis=-1)
