"""Robust resection of single images, with both scan directions tried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from cosp.adjustment.bundle import adjust
from cosp.adjustment.observations import Control, Priors
from cosp.adjustment.solver import START_SIGMA
from cosp.arrays import FloatArray
from cosp.camera.panoramic import PanoramicCamera

DIRECTIONS = (1, -1)


@dataclass(frozen=True)
class Resection:
    """One image oriented from its control points.

    Parameters
    ----------
    camera : PanoramicCamera
    weights : (N,) array
        Robust weights; 0 marks a gross error.
    residuals_px : (N, 2) array
        Observed minus computed; NaN where a point falls outside the sweep.
    sigma0 : float
        Root of the variance factor, one if the given sigmas are right.
    scan_direction : +1 or -1
    other_direction_cost : float
        By how much the cost of the other scan direction is higher; NaN if it was not tried. Twice the logarithm of the
        odds between the two: below about 6 nothing is decided.
    covariance : (13, 13) array
        At a variance factor of one.
    """

    camera: PanoramicCamera
    weights: FloatArray
    residuals_px: FloatArray
    sigma0: float
    scan_direction: int
    other_direction_cost: float
    covariance: FloatArray


def resect(
    camera: PanoramicCamera,
    film_mm: FloatArray,
    ground_local: FloatArray,
    *,
    sigma_px: ArrayLike,
    pixel_mm: float,
    priors: Priors,
    gate_sigma: float,
    sigma_ground_m: ArrayLike = 0.0,
    sigma_height_m: ArrayLike = 0.0,
    directions: Sequence[int] = DIRECTIONS,
    start_sigma: float = START_SIGMA,
    information: FloatArray | None = None,
) -> Resection:
    """The 13 parameters of one image from control points, half or more of which may be wrong.

    Parameters
    ----------
    camera : PanoramicCamera
        Start, and mean of the priors; may be off by tens of kilometres.
    film_mm : (N, 2) array, mm
    ground_local : (N, 3) array, m
        In the camera's local frame.
    sigma_px : float or (N,) array, px
        Standard deviation of a film point per axis, unmodelled film distortion included.
    pixel_mm : float
        Size of a digitised pixel.
    priors : Priors
    gate_sigma : float
        Points beyond this many standard deviations are gross errors.
    sigma_ground_m, sigma_height_m : float or (N,) arrays, m
        Standard deviations of the ground points.
    directions : sequence of +1 and -1
        Scan directions to try; the cheaper is kept. To the points alone the two are one (time is only labelled
        the other way); it is the priors on velocity, rates and image motion that tell them apart.
    start_sigma : float
        First width of the robust weights.
    information : (13, 13) array
        What else is believed of the camera.

    Raises
    ------
    NotEnoughMatchesError
        If fewer points are given than an image needs.
    """
    film_mm = np.asarray(film_mm, float)
    count = len(film_mm)
    control = Control(
        film_mm=film_mm,
        ground_m=np.asarray(ground_local, float),
        sigma_mm=np.broadcast_to(np.asarray(sigma_px, float) * pixel_mm, count),
        sigma_ground_m=np.broadcast_to(np.asarray(sigma_ground_m, float), count),
        sigma_height_m=np.broadcast_to(np.asarray(sigma_height_m, float), count),
    )
    found = resect_control(
        camera,
        control,
        priors=priors,
        gate_sigma=gate_sigma,
        directions=directions,
        start_sigma=start_sigma,
        information=information,
    )
    return replace(found, residuals_px=found.residuals_px / pixel_mm)


def resect_control(
    camera: PanoramicCamera,
    control: Control,
    *,
    priors: Priors,
    gate_sigma: float,
    directions: Sequence[int] = DIRECTIONS,
    start_sigma: float = START_SIGMA,
    information: FloatArray | None = None,
) -> Resection:
    """The same as `resect` for points that are control already: a pixel is a millimetre, in the residuals too."""
    tried = [
        adjust(
            [camera.with_parameters(camera.parameters(), scan_direction=direction)],
            [control],
            [],
            priors=priors,
            gate_sigma=gate_sigma,
            start_sigma=start_sigma,
            information=information,
        )
        for direction in directions
    ]
    tried.sort(key=lambda adjustment: adjustment.cost)
    best = tried[0]
    found = best.cameras[0]
    return Resection(
        camera=found,
        weights=best.control_weights[0],
        residuals_px=control.film_mm - found.project(control.ground_m),
        sigma0=best.sigma_naught,
        scan_direction=found.scan_direction,
        other_direction_cost=tried[1].cost - best.cost if len(tried) > 1 else float("nan"),
        covariance=best.covariance,
    )
