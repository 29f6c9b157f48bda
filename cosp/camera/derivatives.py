"""How a film point moves with the 13 parameters of its camera and with its ground point."""

from __future__ import annotations

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.rotations import rotation_matrix

PARAMETER_NAMES = ("X", "Y", "Z", "X1", "Y1", "Z1", "omega", "phi", "kappa", "omega1", "phi1", "kappa1", "P")


def film_derivatives(
    camera: PanoramicCamera, ground_m: FloatArray, film_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of film points with respect to the camera's parameters and to the ground points.

    The time at which a point is exposed depends on where it falls along the scan, so x stands on both sides
    of x = f atan(-Nx/Nz). The derivative goes through that equation: dropping the implicit term would
    leave 0.3 to 0.7 per cent.

    Parameters
    ----------
    camera : PanoramicCamera
    ground_m : (N, 3) array, m
        In the camera's local frame.
    film_mm : (N, 2) array, mm
        `camera.project(ground_m)`; rows that are NaN give NaN.

    Returns
    -------
    by_parameters : (N, 2, 13) array
        mm per metre, per radian and per unit, in the order of `PanoramicCamera.parameters`.
    by_ground : (N, 2, 3) array
        mm per metre.

    References
    ----------
    [Ghuffar2022] equations 7 to 12, differentiated implicitly.
    """
    p = camera.parameters()
    focal, sign = camera.focal_length_mm, camera.scan_direction
    imaged_mm = camera.imaged(film_mm)
    x = imaged_mm[:, 0]
    tau = camera.scan_fraction(x)
    alpha = x / focal
    sine, cosine = np.sin(alpha), np.cos(alpha)
    angles = p[6:9] + tau[:, None] * p[9:12]
    rotation = rotation_matrix(angles)
    from_centre = ground_m - p[0:3] - tau[:, None] * p[3:6]
    n = (rotation @ from_centre[..., None])[..., 0]

    by_angles = _by_angles(angles, rotation, from_centre, n)
    # Derivatives of N = R(tau) (X - C(tau)) at fixed tau, (N, 3, 13), and along tau, (N, 3).
    n_by_parameters = np.zeros((len(n), 3, 13))
    n_by_parameters[:, :, 0:3] = -rotation
    n_by_parameters[:, :, 3:6] = -tau[:, None, None] * rotation
    n_by_parameters[:, :, 6:9] = by_angles
    n_by_parameters[:, :, 9:12] = tau[:, None, None] * by_angles
    n_by_tau = by_angles @ p[9:12] - rotation @ p[3:6]
    n_by_all = np.concatenate([n_by_parameters, rotation], axis=2)

    zero = np.zeros_like(x)
    nz = n[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        # cos^2(alpha) = 1 / (1 + (Nx/Nz)^2)
        x_by_n = (focal * cosine**2)[:, None] * np.stack([-1 / nz, zero, n[:, 0] / nz**2], axis=1)
        tau_by_x = sign / camera.scan_length_mm
        implicit = 1.0 - tau_by_x * (x_by_n * n_by_tau).sum(1)
        x_by_all = (x_by_n[:, None, :] @ n_by_all)[:, 0] / implicit[:, None]

        slope = n[:, 1] / nz
        y_by_n = (-focal * cosine)[:, None] * np.stack([zero, 1 / nz, -slope / nz], axis=1)
    motion = sign * p[12] * np.cos(p[6])
    y_by_x = sine * slope - motion * cosine + tau_by_x * (y_by_n * n_by_tau).sum(1)
    y_by_all = (y_by_n[:, None, :] @ n_by_all)[:, 0] + y_by_x[:, None] * x_by_all
    y_by_all[:, 6] += sign * p[12] * np.sin(p[6]) * focal * sine
    y_by_all[:, 12] -= sign * np.cos(p[6]) * focal * sine

    by_all = np.stack([x_by_all, y_by_all], axis=1)
    if camera.film_field is not None:
        by_all = by_all + camera.film_field.gradient(imaged_mm) @ by_all
    return by_all[:, :, :13], by_all[:, :, 13:]


def focal_derivatives(camera: PanoramicCamera, film_mm: FloatArray) -> FloatArray:
    """Derivatives (N, 2) of film points (N, 2) with respect to the focal length.

    A longer lens images everything on a larger scale and nothing else: the time at which a point is exposed follows the
    scan angle, whatever the length of film that the sweep covers.
    """
    imaged_mm = camera.imaged(film_mm)
    by_focal = imaged_mm / camera.focal_length_mm
    if camera.film_field is None:
        return by_focal
    return np.asarray(by_focal + (camera.film_field.gradient(imaged_mm) @ by_focal[..., None])[..., 0])


def _by_angles(angles: FloatArray, rotation: FloatArray, from_centre: FloatArray, n: FloatArray) -> FloatArray:
    """Derivatives of R d with respect to omega, phi and kappa, (N, 3, 3) with the angle last."""
    # Omega turns first, about the world's x axis: dR/d(omega) d = R (dz ey - dy ez) = R (0, dz, -dy).
    turned = np.stack([np.zeros(len(n)), from_centre[:, 2], -from_centre[:, 1]], axis=1)
    by_omega = (rotation @ turned[..., None])[..., 0]
    # Kappa turns last, about the camera's z axis.
    by_kappa = np.stack([n[:, 1], -n[:, 0], np.zeros(len(n))], axis=1)
    # Phi turns about the y axis that kappa then turns to (sin kappa, cos kappa, 0): dN = -axis x N.
    sine, cosine = np.sin(angles[:, 2]), np.cos(angles[:, 2])
    axis = np.stack([sine, cosine, np.zeros(len(n))], axis=1)
    by_phi = -np.cross(axis, n)
    return np.stack([by_omega, by_phi, by_kappa], axis=2)
