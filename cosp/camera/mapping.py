"""Film points of map points, for whole orthophotos at once."""

from __future__ import annotations

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.mapping import MapFrame


class MapProjector:
    """Projects map points into a film.

    Parameters
    ----------
    camera : PanoramicCamera
    crs : str
        Map projection in metres.
    bounds : (xmin, ymin, xmax, ymax), m
        Area on the map that will be asked for.
    """

    def __init__(self, camera: PanoramicCamera, crs: str, bounds: tuple[float, float, float, float]) -> None:
        self.camera = camera
        self.map_frame = MapFrame(camera.origin, crs, bounds)

    def film(self, easting_m: FloatArray, northing_m: FloatArray, height_m: FloatArray) -> FloatArray:
        """Film points (..., 2) in mm; NaN where the height is NaN or the point is not seen.

        Parameters
        ----------
        easting_m, northing_m, height_m : arrays that broadcast together
            Ellipsoidal heights.
        """
        return self.camera.project(self.local(easting_m, northing_m, height_m))

    def local(self, easting_m: FloatArray, northing_m: FloatArray, height_m: FloatArray) -> FloatArray:
        """The same points in the camera's local frame, (..., 3) in metres."""
        points = np.stack(np.broadcast_arrays(easting_m, northing_m, height_m), axis=-1)
        return self.map_frame.local_from_map(points)
