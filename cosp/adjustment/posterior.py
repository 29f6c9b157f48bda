"""How well an adjusted pair knows the height of its ground, everywhere on its film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from cosp.adjustment.calibration import Calibration
from cosp.adjustment.observations import Ties
from cosp.adjustment.rows import Rows, camera_derivatives, ground_by_film, intersections
from cosp.arrays import FloatArray
from cosp.camera.panoramic import PanoramicCamera


@dataclass(frozen=True)
class HeightSigma:
    """Standard deviation of heights of a pair from its cameras and film fields, without that of matching.

    Parameters
    ----------
    scene : str
        The film whose points the places are.
    x_mm : (X,) array
    y_mm : (Y,) array
    sigma_m : (Y, X) array, m
        Continued from the nearest place where the films do not overlap.
    height_m : float
        Ellipsoidal height of the ground that was assumed.
    """

    KIND: ClassVar[str] = "height_sigma"
    VERSION: ClassVar[int] = 1

    scene: str
    x_mm: FloatArray
    y_mm: FloatArray
    sigma_m: FloatArray
    height_m: float

    def at(self, film_mm: FloatArray) -> FloatArray:
        """Standard deviations (...) in m at film points (..., 2), linear between places; NaN for NaN."""
        columns = (film_mm[..., 0] - self.x_mm[0]) / (self.x_mm[1] - self.x_mm[0])
        rows = (film_mm[..., 1] - self.y_mm[0]) / (self.y_mm[1] - self.y_mm[0])
        known = np.isfinite(rows) & np.isfinite(columns)
        places = [np.where(known, rows, 0.0), np.where(known, columns, 0.0)]
        found = map_coordinates(self.sigma_m, places, order=1, mode="nearest")
        return np.asarray(np.where(known, found, np.nan))


def height_sigma(
    cameras: Sequence[PanoramicCamera],
    first: int,
    second: int,
    *,
    covariance: FloatArray,
    calibration: Calibration | None,
    film_sigma_mm: float,
    reference_sigma_m: float = 0.0,
    height_m: float,
    step_mm: float,
) -> HeightSigma:
    """Heights' standard deviation over the first film of a pair, propagated from the covariance of an adjustment.

    Parameters
    ----------
    cameras : sequence of PanoramicCamera
        All of the block, adjusted.
    first, second : int
        Images of the pair.
    covariance : (P n, P n) array
        Of the unknowns of the cameras; used where there is no calibration.
    calibration : Calibration or None
        Its covariance of cameras and film fields is used instead.
    film_sigma_mm : float
        Distortion of film that the adjustment did not describe, per axis and film.
    reference_sigma_m : float
        Smooth error of the reference heights, which the adjustment copies.
    height_m : float
        Ellipsoidal height of the ground.
    step_mm : float
        Distance of the places, about.
    """
    camera, other = cameras[first], cameras[second]
    x, y = (
        np.linspace(-half, half, max(2, round(2.0 * half / step_mm) + 1))
        for half in (camera.half_length_mm, camera.half_width_mm)
    )
    film = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    seen = other.project(camera.locate(film, height_m))
    with np.errstate(invalid="ignore"):
        inside = (np.abs(seen) <= [other.half_length_mm, other.half_width_mm]).all(axis=1)
    pair = Ties(first, second, film[inside], seen[inside], np.ones(int(inside.sum())))
    at = intersections(cameras, pair, len(covariance) // len(cameras))
    # Up in the local frame is up on the ellipsoid to within a degree: nothing to a standard deviation.
    by_film = ground_by_film(at.film_by_ground)[:, 2]
    rows = Rows(
        kind="dem",
        images=(first, second),
        residuals=np.zeros((len(by_film), 1)),
        by_film=by_film.reshape(-1, 1, 2, 2),
        film_by_camera=at.film_by_camera,
        imaged_mm=at.imaged_mm,
    )
    variance = _variances(rows, covariance, calibration)[:, 0]
    sigma = np.full(len(film), np.nan)
    sigma[inside] = np.sqrt(variance + film_sigma_mm**2 * (by_film**2).sum(axis=1) + reference_sigma_m**2)
    return HeightSigma(camera.scene, x, y, _continued(sigma.reshape(len(y), len(x))), height_m)


def place_sigma_m(
    cameras: Sequence[PanoramicCamera],
    image: int,
    *,
    covariance: FloatArray,
    calibration: Calibration | None,
    height_m: float,
) -> tuple[float, float]:
    """Standard deviations east and north of where film points lie at a known height, root mean square over the film.

    Parameters
    ----------
    cameras : sequence of PanoramicCamera
        All of the block, adjusted.
    image : int
        Which of them.
    covariance, calibration, height_m
        As for `height_sigma`.
    """
    camera = cameras[image]
    x, y = (np.linspace(-half, half, count) for half, count in ((camera.half_length_mm, 21), (camera.half_width_mm, 5)))
    film = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    by_camera, by_ground = camera_derivatives(
        camera, camera.locate(film, height_m), film, len(covariance) // len(cameras)
    )
    rows = Rows(
        kind="gcp",
        images=(image,),
        residuals=np.zeros((len(film), 2)),
        by_film=-np.linalg.inv(by_ground[:, :, :2])[:, :, None, :],
        film_by_camera=by_camera[:, None],
        imaged_mm=camera.imaged(film)[:, None],
    )
    east, north = np.sqrt(_variances(rows, covariance, calibration).mean(axis=0))
    return float(east), float(north)


def _variances(rows: Rows, covariance: FloatArray, calibration: Calibration | None) -> FloatArray:
    """Variances (M, K) of what rows compute, from the calibration if there is one."""
    if calibration is not None:
        return calibration.variances_of(rows)
    by_camera = rows.by_camera()
    width = by_camera.shape[-1]
    jacobian = by_camera.reshape(*rows.residuals.shape, width * len(rows.images))
    columns = np.concatenate([np.arange(width) + width * image for image in rows.images])
    return np.asarray(np.einsum("nka,ab,nkb->nk", jacobian, covariance[np.ix_(columns, columns)], jacobian))


def _continued(values: FloatArray) -> FloatArray:
    """Values with gaps filled from the nearest place that has one."""
    gaps = np.isnan(values)
    if not gaps.any() or gaps.all():
        return values
    nearest = distance_transform_edt(gaps, return_distances=False, return_indices=True)
    return np.asarray(values[tuple(nearest)])
