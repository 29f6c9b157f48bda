"""Observation equations of control, tie points and reference heights, told by how films are displaced.

Whatever moves a film point, a parameter of its camera or the distortion of its film, moves it in two coordinates. An
equation is therefore written once, by its derivatives with respect to displacements on the films; the unknowns follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosp.adjustment.observations import Control, HeightReference, Ties
from cosp.adjustment.unknowns import PARAMETERS
from cosp.arrays import FloatArray
from cosp.camera.derivatives import film_derivatives, focal_derivatives
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.rays import meet

SLOPE_STEP_M = 30.0  # over which slopes of the reference are taken


@dataclass(frozen=True)
class Rows:
    """Equations of one group, whitened: every residual has standard deviation one where the sigmas are right.

    Parameters
    ----------
    kind : "gcp", "tie" or "dem"
    images : tuple of int
        The I images of the block that they touch.
    residuals : (M, K) array
        Observed minus computed; the K residuals of a row share one robust weight. NaN rows count for nothing.
    by_film : (M, K, I, 2) array
        Derivatives of the computed values with respect to displacements on the films, per mm.
    film_by_camera : (M, I, 2, P) array
        Derivatives of the film points with respect to the P unknowns of their cameras.
    imaged_mm : (M, I, 2) array
        Film points as the cameras image them, where distortion is to be looked up.
    """

    kind: str
    images: tuple[int, ...]
    residuals: FloatArray
    by_film: FloatArray
    film_by_camera: FloatArray
    imaged_mm: FloatArray

    def by_camera(self) -> FloatArray:
        """Derivatives of the computed values with respect to the unknowns of the cameras, (M, K, I, P)."""
        return np.asarray(np.swapaxes(np.swapaxes(self.by_film, 1, 2) @ self.film_by_camera, 1, 2))


@dataclass(frozen=True)
class Intersections:
    """Tie points at the ground points where their rays meet.

    Parameters
    ----------
    ground_m : (N, 3) array
    misfit_mm : (N, 2, 2) array
        Measured minus computed film points, per image.
    film_by_camera : (N, 2, 2, P) array
    film_by_ground : (N, 2, 2, 3) array
    imaged_mm : (N, 2, 2) array
    """

    ground_m: FloatArray
    misfit_mm: FloatArray
    film_by_camera: FloatArray
    film_by_ground: FloatArray
    imaged_mm: FloatArray


def camera_derivatives(
    camera: PanoramicCamera, ground_m: FloatArray, film_mm: FloatArray, unknowns: int = PARAMETERS
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of film points by the 13 or 14 unknowns of their camera (N, 2, P), and by ground points (N, 2, 3)."""
    by_camera, by_ground = film_derivatives(camera, ground_m, film_mm)
    if unknowns > PARAMETERS:
        by_camera = np.concatenate([by_camera, focal_derivatives(camera, film_mm)[..., None]], axis=-1)
    return by_camera, by_ground


def control_rows(camera: PanoramicCamera, control: Control, image: int = 0, unknowns: int = PARAMETERS) -> Rows:
    """Two equations per control point; the covariance of its ground point is carried into the film."""
    film = camera.project(control.ground_m)
    by_camera, by_ground = camera_derivatives(camera, control.ground_m, film, unknowns)
    variance = np.stack([control.sigma_ground_m**2, control.sigma_ground_m**2, control.sigma_height_m**2], axis=1)
    covariance = np.einsum("nik,nk,njk->nij", by_ground, variance, by_ground) + control.covariance_mm2
    covariance[:, [0, 1], [0, 1]] += control.sigma_mm[:, None] ** 2
    whiten = _whitening(covariance)
    return Rows(
        kind="gcp",
        images=(image,),
        residuals=(whiten @ (control.film_mm - film)[..., None])[..., 0],
        by_film=whiten[:, :, None, :],
        film_by_camera=by_camera[:, None],
        imaged_mm=camera.imaged(film)[:, None],
    )


def intersections(cameras: Sequence[PanoramicCamera], ties: Ties, unknowns: int = PARAMETERS) -> Intersections:
    """Ground points of tie points under the present cameras, and how the film points follow them."""
    sides = ((cameras[ties.first], ties.first_mm), (cameras[ties.second], ties.second_mm))
    ground, _ = meet(*(camera.rays(film) for camera, film in sides))
    parts = []
    for camera, observed in sides:
        film = camera.project(ground)
        parts.append((observed - film, *camera_derivatives(camera, ground, film, unknowns), camera.imaged(film)))
    misfit, by_camera, by_ground, imaged = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
    return Intersections(ground, misfit, by_camera, by_ground, imaged)


def tie_rows(at: Intersections, ties: Ties) -> Rows:
    """One equation per tie point, that its rays meet: what its four leave when the ground point is eliminated."""
    condition = _left_null_vector(at.film_by_ground.reshape(-1, 4, 3))
    residual = (condition * at.misfit_mm.reshape(-1, 4)).sum(1)
    return Rows(
        kind="tie",
        images=(ties.first, ties.second),
        residuals=(residual / ties.sigma_mm)[:, None],
        by_film=(condition / ties.sigma_mm[:, None]).reshape(-1, 1, 2, 2),
        film_by_camera=at.film_by_camera,
        imaged_mm=at.imaged_mm,
    )


def height_rows(at: Intersections, ties: Ties, cameras: Sequence[PanoramicCamera], reference: HeightReference) -> Rows:
    """One equation per tie point on stable ground: its intersected height is that of the reference.

    Together with `tie_rows` these are all that eliminating the ground points leaves: film noise moves the
    point within the plane of its rays, and the gap between the rays is independent of it.
    """
    origin = cameras[ties.first].origin

    def above(ground_m: FloatArray) -> FloatArray:
        lonlath = origin.geodetic_from_local(ground_m)
        return np.asarray(lonlath[:, 2] - reference.heights_at(lonlath[:, :2]))

    steps = SLOPE_STEP_M * np.eye(3)
    normal = np.stack([above(at.ground_m + step) - above(at.ground_m - step) for step in steps], axis=1) / (
        2.0 * SLOPE_STEP_M
    )
    by_film = -(normal[:, None, :] @ ground_by_film(at.film_by_ground))[:, 0]
    slope = np.hypot(normal[:, 0], normal[:, 1])
    sigma = np.sqrt(
        reference.sigma_m**2 + (slope * reference.sigma_horizontal_m) ** 2 + ties.sigma_mm**2 * (by_film**2).sum(axis=1)
    )
    sigma[slope > np.tan(np.radians(reference.largest_slope_deg))] = np.nan
    return Rows(
        kind="dem",
        images=(ties.first, ties.second),
        residuals=(-above(at.ground_m) / sigma)[:, None],
        by_film=(by_film / sigma[:, None]).reshape(-1, 1, 2, 2),
        film_by_camera=at.film_by_camera,
        imaged_mm=at.imaged_mm,
    )


def ground_by_film(film_by_ground: FloatArray) -> FloatArray:
    """How a least-squares ground point (N, 3) follows its two film points (N, 4), from the inverse, m per mm."""
    across = film_by_ground.reshape(-1, 4, 3)
    turned = np.swapaxes(across, 1, 2)
    product = turned @ across
    known = np.isfinite(product).all(axis=(1, 2))
    found = np.full(turned.shape, np.nan)
    found[known] = np.linalg.solve(product[known], turned[known])
    return found


def _whitening(covariance: FloatArray) -> FloatArray:
    """Inverse of the lower Cholesky factor of (N, 2, 2) covariances; NaN stays NaN."""
    a, b, c = covariance[:, 0, 0], covariance[:, 1, 0], covariance[:, 1, 1]
    first = np.sqrt(a)
    low = b / first
    second = np.sqrt(c - low**2)
    whiten = np.zeros_like(covariance)
    whiten[:, 0, 0] = 1.0 / first
    whiten[:, 1, 0] = -low / (first * second)
    whiten[:, 1, 1] = 1.0 / second
    return whiten


def _left_null_vector(matrix: FloatArray) -> FloatArray:
    """Unit vectors (N, 4) orthogonal to the columns of (N, 4, 3) matrices, by cofactors; NaN stays NaN."""
    vector = np.empty(matrix.shape[:2])
    for row in range(4):
        rest = np.delete(matrix, row, axis=1)
        vector[:, row] = (-1) ** row * np.einsum("ni,ni->n", rest[:, 0], np.cross(rest[:, 1], rest[:, 2]))
    return np.asarray(vector / np.linalg.norm(vector, axis=1, keepdims=True))
