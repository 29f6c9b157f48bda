"""Bundle adjustment of any number of panoramic images with control and tie points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosp.adjustment.observations import Control, Priors, Ties
from cosp.adjustment.solver import START_SIGMA, Equations, Solution, minimise
from cosp.arrays import FloatArray
from cosp.camera.derivatives import film_derivatives
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import NotEnoughMatchesError
from cosp.geometry.rays import meet

PARAMETERS = 13
CONTROL_NEEDED = 7  # two equations each: one more than the 13 unknowns of an image


@dataclass(frozen=True)
class Adjustment:
    """A block after its adjustment.

    Parameters
    ----------
    cameras : tuple of PanoramicCamera
    control_weights : tuple of (N,) arrays
        Per image; 0 marks a gross error.
    tie_weights : tuple of (N,) arrays
        Per set of tie points.
    covariance : (13 n, 13 n) array
        Of the parameters of all images, at a variance factor of one.
    sigma_naught : float
        Root of the variance factor: one if the given standard deviations are right.
    redundancy : int
    cost : float
    iterations : int
    """

    cameras: tuple[PanoramicCamera, ...]
    control_weights: tuple[FloatArray, ...]
    tie_weights: tuple[FloatArray, ...]
    covariance: FloatArray
    sigma_naught: float
    redundancy: int
    cost: float
    iterations: int


def adjust(
    cameras: Sequence[PanoramicCamera],
    control: Sequence[Control],
    ties: Sequence[Ties],
    *,
    priors: Priors,
    gate_sigma: float,
    prior_cameras: Sequence[PanoramicCamera] | None = None,
    start_sigma: float = START_SIGMA,
) -> Adjustment:
    """Cameras of a block from control and tie points.

    Ground points of control carry their covariance into the film, those of tie points are eliminated row by row: a tie
    point's four equations are projected onto what no ground point can explain, the one condition that the two
    rays meet. That is the Schur complement of the normal equations, exactly.

    Parameters
    ----------
    cameras : sequence of PanoramicCamera
        Start values, all in one local frame.
    control : sequence of Control
        One per image; may be empty.
    ties : sequence of Ties
    priors : Priors
    gate_sigma : float
        Points beyond this many standard deviations are gross errors.
    prior_cameras : sequence of PanoramicCamera
        Means of the priors; the start values if left out.
    start_sigma : float
        First width of the robust weights, standard deviations.

    Raises
    ------
    NotEnoughMatchesError
        If there is too little control for the images.
    ValueError
        If the cameras are not in one local frame.

    References
    ----------
    [Ghuffar2022] section III.C, with weights and elimination added.
    """
    cameras = list(cameras)
    if any(camera.origin != cameras[0].origin for camera in cameras):
        raise ValueError("the cameras of a block must share one local frame")
    found = sum(len(points) for points in control)
    # Tie points tell images to each other, not to the ground: the block as a whole needs control.
    needed = CONTROL_NEEDED if ties else CONTROL_NEEDED * len(cameras)
    if found < needed:
        scenes = ", ".join(camera.scene for camera in cameras)
        raise NotEnoughMatchesError(f"{scenes}: {found} of the {needed} control points needed")

    information = np.zeros((PARAMETERS * len(cameras),) * 2)
    for i, camera in enumerate(prior_cameras or cameras):
        block = slice(PARAMETERS * i, PARAMETERS * (i + 1))
        information[block, block] = priors.information(camera)

    def cameras_of(unknowns: FloatArray) -> list[PanoramicCamera]:
        rows = unknowns.reshape(-1, PARAMETERS)
        return [camera.with_parameters(row) for camera, row in zip(cameras, rows, strict=True)]

    def linearise(unknowns: FloatArray) -> list[Equations]:
        now = cameras_of(unknowns)
        groups = [
            control_equations(camera, points, first_column=PARAMETERS * i)
            for i, (camera, points) in enumerate(zip(now, control, strict=True))
        ]
        return groups + [tie_equations(now, points) for points in ties]

    solution = minimise(
        linearise,
        np.concatenate([camera.parameters() for camera in cameras]),
        information,
        prior_mean=np.concatenate([camera.parameters() for camera in prior_cameras or cameras]),
        gate_sigma=gate_sigma,
        start_sigma=start_sigma,
    )
    return _adjustment(cameras_of(solution.unknowns), solution, information)


def control_equations(camera: PanoramicCamera, control: Control, first_column: int = 0) -> Equations:
    """Whitened equations of the control points of one image: two per point."""
    film = camera.project(control.ground_m)
    by_parameters, by_ground = film_derivatives(camera, control.ground_m, film)
    variance = np.stack([control.sigma_ground_m**2, control.sigma_ground_m**2, control.sigma_height_m**2], axis=1)
    covariance = np.einsum("nik,nk,njk->nij", by_ground, variance, by_ground)
    covariance[:, [0, 1], [0, 1]] += control.sigma_mm[:, None] ** 2
    whiten = _whitening(covariance)
    return Equations(
        columns=np.arange(first_column, first_column + PARAMETERS),
        residuals=(whiten @ (control.film_mm - film)[..., None])[..., 0],
        jacobian=whiten @ by_parameters,
    )


def tie_equations(cameras: Sequence[PanoramicCamera], ties: Ties) -> Equations:
    """Whitened equations of tie points with their ground points eliminated: one per point."""
    first, second = cameras[ties.first], cameras[ties.second]
    ground, _ = meet(first.rays(ties.first_mm), second.rays(ties.second_mm))
    parts = []
    for camera, observed in ((first, ties.first_mm), (second, ties.second_mm)):
        film = camera.project(ground)
        parts.append((observed - film, *film_derivatives(camera, ground, film)))
    (first_residual, first_by, first_ground), (second_residual, second_by, second_ground) = parts

    by_ground = np.concatenate([first_ground, second_ground], axis=1)
    condition = _left_null_vector(by_ground)
    residual = (condition * np.concatenate([first_residual, second_residual], axis=1)).sum(1)
    by_first = (condition[:, None, :2] @ first_by)[:, 0]
    by_second = (condition[:, None, 2:] @ second_by)[:, 0]
    columns = [np.arange(PARAMETERS * i, PARAMETERS * (i + 1)) for i in (ties.first, ties.second)]
    return Equations(
        columns=np.concatenate(columns),
        residuals=(residual / ties.sigma_mm)[:, None],
        jacobian=(np.concatenate([by_first, by_second], axis=1) / ties.sigma_mm[:, None])[:, None, :],
    )


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


def _adjustment(cameras: list[PanoramicCamera], solution: Solution, information: FloatArray) -> Adjustment:
    used = [int((weight > 0).sum()) for weight in solution.weights]
    equations = sum(count * group.residuals.shape[1] for count, group in zip(used, solution.equations, strict=True))
    scale = 1.0 / np.sqrt(np.diag(solution.normal))
    covariance = np.linalg.inv(solution.normal * scale[:, None] * scale) * scale[:, None] * scale
    # Unknowns that the prior settles take no redundancy from the points.
    settled_by_points = solution.unknowns.size - float((covariance * information).sum())
    redundancy = max(1, round(equations - settled_by_points))
    square = sum(
        float((weight[weight > 0, None] * group.residuals[weight > 0] ** 2).sum())
        for weight, group in zip(solution.weights, solution.equations, strict=True)
    )
    images = len(cameras)
    return Adjustment(
        cameras=tuple(cameras),
        control_weights=tuple(solution.weights[:images]),
        tie_weights=tuple(solution.weights[images:]),
        covariance=covariance,
        sigma_naught=float(np.sqrt(square / redundancy)),
        redundancy=redundancy,
        cost=solution.cost,
        iterations=solution.iterations,
    )
