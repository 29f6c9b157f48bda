"""Bundle adjustment of any number of panoramic images with control and tie points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosp.adjustment.observations import Control, HeightReference, Priors, Ties
from cosp.adjustment.rows import Rows, control_rows, height_rows, intersections, tie_rows
from cosp.adjustment.solver import START_SIGMA, Equations, Solution, minimise
from cosp.adjustment.unknowns import PARAMETERS, values_of, with_values
from cosp.arrays import BoolArray, FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import NotEnoughMatchesError

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
    height_weights : tuple of (N,) arrays
        Of the reference heights of the sets of tie points that were held to them; 0 for the others.
    covariance : (P n, P n) array
        Of the 13 parameters of all images at a variance factor of one; of 14 with a free focal length.
    sigma_naught : float
        Root of the variance factor: one if the given standard deviations are right.
    redundancy : int
    cost : float
    iterations : int
    """

    cameras: tuple[PanoramicCamera, ...]
    control_weights: tuple[FloatArray, ...]
    tie_weights: tuple[FloatArray, ...]
    height_weights: tuple[FloatArray, ...]
    covariance: FloatArray
    sigma_naught: float
    redundancy: int
    cost: float
    iterations: int

    @property
    def unknowns(self) -> int:
        """Number P of unknowns of a camera: 13, or 14 with a free focal length."""
        return len(self.covariance) // len(self.cameras)


def adjust(
    cameras: Sequence[PanoramicCamera],
    control: Sequence[Control],
    ties: Sequence[Ties],
    *,
    priors: Priors,
    gate_sigma: float,
    prior_cameras: Sequence[PanoramicCamera] | None = None,
    start_sigma: float = START_SIGMA,
    information: FloatArray | None = None,
    reference: HeightReference | None = None,
    to_reference: Sequence[BoolArray] | None = None,
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
    information : (P n, P n) array
        What else is believed of the cameras, about `prior_cameras`. Its size says whether the focal lengths are
        unknowns too: P is 13 or 14.
    reference : HeightReference
    to_reference : sequence of (N,) arrays of bool
        Tie points that are held to the heights of the reference; none if left out.

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

    information = np.zeros((PARAMETERS * len(cameras),) * 2) if information is None else information.copy()
    width = len(information) // len(cameras)
    for i, camera in enumerate(prior_cameras or cameras):
        block = slice(width * i, width * i + PARAMETERS)
        information[block, block] += priors.information(camera)
    held = [n for n in range(len(ties)) if reference and to_reference is not None and to_reference[n].any()]

    def cameras_of(unknowns: FloatArray) -> list[PanoramicCamera]:
        rows = unknowns.reshape(-1, width)
        return [with_values(camera, row) for camera, row in zip(cameras, rows, strict=True)]

    def linearise(unknowns: FloatArray) -> list[Equations]:
        now = cameras_of(unknowns)
        groups = [
            control_equations(camera, points, i, width)
            for i, (camera, points) in enumerate(zip(now, control, strict=True))
        ]
        groups += [tie_equations(now, points, width) for points in ties]
        if reference is not None and to_reference is not None:
            groups += [height_equations(now, ties[n], reference, to_reference[n], width) for n in held]
        return groups

    solution = minimise(
        linearise,
        np.concatenate([values_of(camera, width) for camera in cameras]),
        information,
        prior_mean=np.concatenate([values_of(camera, width) for camera in prior_cameras or cameras]),
        gate_sigma=gate_sigma,
        start_sigma=start_sigma,
    )
    return _adjustment(cameras_of(solution.unknowns), [len(points) for points in ties], held, solution, information)


def control_equations(
    camera: PanoramicCamera, control: Control, image: int = 0, unknowns: int = PARAMETERS
) -> Equations:
    """Whitened equations of the control points of one image in the unknowns of its camera: two per point."""
    return _of_cameras(control_rows(camera, control, image, unknowns))


def tie_equations(cameras: Sequence[PanoramicCamera], ties: Ties, unknowns: int = PARAMETERS) -> Equations:
    """Whitened equations of tie points in the unknowns of two images, ground points eliminated: one per point."""
    return _of_cameras(tie_rows(intersections(cameras, ties, unknowns), ties))


def height_equations(
    cameras: Sequence[PanoramicCamera],
    ties: Ties,
    reference: HeightReference,
    chosen: BoolArray,
    unknowns: int = PARAMETERS,
) -> Equations:
    """Whitened equations that hold the chosen tie points to the reference's heights: one per point."""
    rows = height_rows(intersections(cameras, ties, unknowns), ties, cameras, reference)
    rows.residuals[~chosen] = np.nan
    return _of_cameras(rows)


def _of_cameras(rows: Rows) -> Equations:
    jacobian = rows.by_camera()
    width = jacobian.shape[-1]
    return Equations(
        columns=np.concatenate([np.arange(width) + width * image for image in rows.images]),
        residuals=rows.residuals,
        jacobian=jacobian.reshape(*jacobian.shape[:2], width * len(rows.images)),
    )


def _adjustment(
    cameras: list[PanoramicCamera], ties: list[int], held: list[int], solution: Solution, information: FloatArray
) -> Adjustment:
    """`ties` are the sizes of the sets of tie points, `held` the sets that were held to the reference."""
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
    heights: list[FloatArray] = [np.zeros(count) for count in ties]
    for n, weight in zip(held, solution.weights[images + len(ties) :], strict=True):
        heights[n] = weight
    return Adjustment(
        cameras=tuple(cameras),
        control_weights=tuple(solution.weights[:images]),
        tie_weights=tuple(solution.weights[images : images + len(ties)]),
        height_weights=tuple(heights),
        covariance=covariance,
        sigma_naught=float(np.sqrt(square / redundancy)),
        redundancy=redundancy,
        cost=solution.cost,
        iterations=solution.iterations,
    )
