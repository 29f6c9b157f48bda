"""Ground control from where an elevation model of the films themselves lies against the reference."""

from __future__ import annotations

import numpy as np
import pandas as pd

from cosp.arrays import FloatArray
from cosp.camera.mapping import MapProjector
from cosp.camera.panoramic import PanoramicCamera
from cosp.matching.control import film_by_ground
from cosp.matching.ground import Bounds, grown

SOURCE = "dem"
# Both films show a point by the same displacement: each is told half of what it says.
_FILMS = 2.0
_COLUMNS = (
    *("x_mm", "y_mm", "longitude_deg", "latitude_deg", "height_m", "role", "source", "score"),
    *("sigma_px", "sigma_ground_m", "sigma_height_m", "sigma_x_px", "sigma_y_px", "correlation_xy"),
)


def control_of_displacements(
    camera: PanoramicCamera,
    places_m: FloatArray,
    shifts_m: FloatArray,
    covariances_m2: FloatArray,
    *,
    crs: str,
    pixel_mm: float,
) -> pd.DataFrame:
    """Control points of a film from displacements of an elevation model that was made with its camera.

    The film point is where the camera sees a place of the model, the ground point is the place displaced. Whatever
    the camera was wrong by, it was wrong by in both, so that the pair of them is right.

    Parameters
    ----------
    camera : PanoramicCamera
        That the elevation model was made with.
    places_m, shifts_m : (N, 3) arrays
        Easting, northing, height of places of the model, and what brings them onto the reference.
    covariances_m2 : (N, 3, 3) array
        Of the shifts.
    crs : str
        Of the map.
    pixel_mm : float
        Of the film.

    Returns
    -------
    gcps : table
        The columns of `cosp.matching.control.collect` without residuals, of the places that the film shows.
        `sigma_x_px`, `sigma_y_px` and `correlation_xy` are what counts; `sigma_ground_m`, the larger of the plan, and
        `sigma_height_m` are to be read.
    """
    places, shifts = np.reshape(places_m, (-1, 3)), np.reshape(shifts_m, (-1, 3))
    if not len(places):
        kinds = {name: object if name in ("role", "source") else float for name in _COLUMNS}
        return pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in kinds.items()})
    covariances = _FILMS * np.reshape(covariances_m2, (-1, 3, 3))
    ground = places + shifts
    bounds: Bounds = (*np.minimum(places, ground)[:, :2].min(axis=0), *np.maximum(places, ground)[:, :2].max(axis=0))
    projector = MapProjector(camera, crs, grown(bounds, 100.0))

    def project(map_m: FloatArray) -> FloatArray:
        return projector.film(map_m[:, 0], map_m[:, 1], map_m[:, 2])

    film = project(places)
    lonlath = projector.map_frame.geodetic_from_map(ground)
    by_ground = film_by_ground(project, places)
    covariance = by_ground @ covariances @ np.swapaxes(by_ground, 1, 2)
    sigma = np.sqrt(covariance[:, [0, 1], [0, 1]])
    table = pd.DataFrame(
        {
            "x_mm": film[:, 0],
            "y_mm": film[:, 1],
            "longitude_deg": lonlath[:, 0],
            "latitude_deg": lonlath[:, 1],
            "height_m": lonlath[:, 2],
            "role": "control",
            "source": SOURCE,
            "score": 1.0,
            "sigma_px": 0.0,
            "sigma_ground_m": np.sqrt(np.linalg.eigvalsh(covariances[:, :2, :2])[:, 1]),
            "sigma_height_m": np.sqrt(covariances[:, 2, 2]),
            "sigma_x_px": sigma[:, 0] / pixel_mm,
            "sigma_y_px": sigma[:, 1] / pixel_mm,
            "correlation_xy": covariance[:, 0, 1] / sigma.prod(axis=1),
        }
    )
    shown = (np.abs(film[:, 0]) <= camera.half_length_mm) & (np.abs(film[:, 1]) <= camera.half_width_mm)
    return table[shown].reset_index(drop=True)
