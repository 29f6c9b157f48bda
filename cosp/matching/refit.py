"""Camera from film points of known ground, with priors and against gross errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera.derivatives import film_derivatives
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.robust import geman_mcclure_weights

_POSITION = [1e5, 1e5, 2e4]
_VELOCITY = [1e3, 1e3, 1e3]
_ANGLES = np.radians([3.0, 3.0, 8.0])
_RATES = np.radians([0.5, 0.5, 0.3])
PRIOR_SIGMA: FloatArray = np.concatenate([_POSITION, _VELOCITY, _ANGLES, _RATES, [0.02]])
"""Standard deviations of the 13 parameters about their prediction, metres and radians (docs/conventions.md)."""

_LEAST_CONVEXITY = 9.0  # three standard deviations
_CONVEXITY_STEP = 1.6  # [Yang2020] uses 1.4; methods differ little between 1.4 and 2


@dataclass(frozen=True)
class Refit:
    """A camera fitted to points, and how the points agree.

    Parameters
    ----------
    camera : PanoramicCamera
    weights : (N,) array
        0 (gross error) to 1.
    residuals_mm : (N, 2) array
        Measured minus projected film points.
    """

    camera: PanoramicCamera
    weights: FloatArray
    residuals_mm: FloatArray


def refit_camera(
    camera: PanoramicCamera,
    film_mm: FloatArray,
    ground_m: FloatArray,
    sigma_mm: FloatArray,
    *,
    prior: PanoramicCamera | None = None,
    prior_sigma: FloatArray = PRIOR_SIGMA,
    iterations: int = 25,
) -> Refit:
    """The 13 parameters that bring ground points to their film points, by graduated non-convexity.

    Parameters
    ----------
    camera : PanoramicCamera
        Where to start.
    film_mm : (N, 2) array
    ground_m : (N, 3) array
        In the camera's local frame.
    sigma_mm : (N,) array
        Standard deviation of the film points per coordinate.
    prior : PanoramicCamera
        Where the parameters are expected, in the same frame; `camera` by default.
    prior_sigma : (13,) array
        Standard deviations about it.

    References
    ----------
    [Yang2020] graduated non-convexity with the Geman-McClure cost.
    """
    expected = (camera if prior is None else prior).parameters()
    parameters = camera.parameters()
    weights = np.ones(len(film_mm))
    convexity = 0.0
    for iteration in range(iterations):
        current = camera.with_parameters(parameters)
        residuals = film_mm - current.project(ground_m)
        seen = np.isfinite(residuals).all(axis=1)
        standardised = np.where(seen, np.linalg.norm(np.nan_to_num(residuals), axis=1) / sigma_mm, np.inf)
        if iteration == 0:
            convexity = max(_LEAST_CONVEXITY, float(np.max(standardised[seen] ** 2, initial=0.0)))
        weights = np.where(seen, geman_mcclure_weights(np.where(seen, standardised, 0.0), convexity), 0.0)
        jacobian = np.nan_to_num(_derivatives(current, ground_m)) * prior_sigma
        scale = (np.sqrt(weights) / sigma_mm)[:, None]
        design = np.concatenate([(jacobian * scale[..., None]).reshape(-1, 13), np.eye(13)])
        misfit = np.concatenate([(np.nan_to_num(residuals) * scale).ravel(), (expected - parameters) / prior_sigma])
        step = np.linalg.lstsq(design, misfit, rcond=None)[0]
        parameters = parameters + step * prior_sigma
        if convexity == _LEAST_CONVEXITY and np.abs(jacobian @ step).max(initial=0.0) < 1e-5:
            break
        convexity = max(_LEAST_CONVEXITY, convexity / _CONVEXITY_STEP**2)
    fitted = camera.with_parameters(parameters)
    return Refit(fitted, weights, film_mm - fitted.project(ground_m))


def refit_sigma_mm(
    camera: PanoramicCamera,
    ground_m: FloatArray,
    sigma_mm: FloatArray,
    elsewhere_m: FloatArray,
    *,
    prior_sigma: FloatArray = PRIOR_SIGMA,
) -> FloatArray:
    """Standard deviations (M, 2) of film points of other ground, by a camera fitted to some points.

    Parameters
    ----------
    camera : PanoramicCamera
        The fitted one.
    ground_m : (N, 3) array
        What it was fitted to, in its local frame.
    sigma_mm : (N,) array
        Standard deviations of their film points per coordinate.
    elsewhere_m : (M, 3) array
    prior_sigma : (13,) array
        As in the fit.
    """
    jacobian = np.nan_to_num(_derivatives(camera, ground_m)) * prior_sigma / np.asarray(sigma_mm)[:, None, None]
    information = np.einsum("nij,nik->jk", jacobian, jacobian) + np.eye(13)
    change = _derivatives(camera, elsewhere_m) * prior_sigma
    return np.asarray(np.sqrt(np.einsum("nij,jk,nik->ni", change, np.linalg.inv(information), change)))


def _derivatives(camera: PanoramicCamera, ground_m: FloatArray) -> FloatArray:
    """Change of film points with the parameters, (N, 2, 13), mm per metre or radian; NaN where they are not seen."""
    return film_derivatives(camera, ground_m, camera.project(ground_m))[0]
