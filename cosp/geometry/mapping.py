"""Between a local frame and a map, for millions of points."""

from __future__ import annotations

import math

import numpy as np
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from cosp.arrays import FloatArray
from cosp.geometry import kernels
from cosp.geometry.frames import LocalFrame

_NODE_M = 250.0  # the Earth bends by 1 mm over half of it
_REFERENCE_HEIGHT_M = 4000.0  # heights are taken as linear up to about twice this


def utm_crs(longitude_deg: float, latitude_deg: float) -> str:
    """Name of the UTM zone of a place on WGS 84, such as "EPSG:32632"."""
    area = AreaOfInterest(longitude_deg, latitude_deg, longitude_deg, latitude_deg)
    found = query_utm_crs_info(datum_name="WGS 84", area_of_interest=area)
    return f"EPSG:{found[0].code}"


class MapFrame:
    """Fast change between local coordinates and easting, northing, ellipsoidal height.

    Both ways are exact on a lattice of nodes and bilinear between them; heights enter linearly.
    Up to 8 km of height the error stays below 3 mm in height and 6 cm in plan.

    Parameters
    ----------
    frame : LocalFrame
    crs : str
        Map projection, such as "EPSG:32632"; its unit must be the metre.
    bounds : (xmin, ymin, xmax, ymax), m
        Area on the map that is asked for.
    margin_m : float
        Added on all sides.
    """

    def __init__(
        self, frame: LocalFrame, crs: str, bounds: tuple[float, float, float, float], margin_m: float = 2000.0
    ) -> None:
        self.frame = frame
        self.crs = crs
        if CRS.from_user_input(crs).is_geographic:
            raise ValueError(f"{crs} is not a map projection in metres")
        self._from_geodetic = Transformer.from_crs("EPSG:4979", crs, always_xy=True)
        self._to_geodetic = Transformer.from_crs(crs, "EPSG:4979", always_xy=True)
        xmin, ymin, xmax, ymax = bounds
        x, y = self._nodes(xmin - margin_m, xmax + margin_m), self._nodes(ymin - margin_m, ymax + margin_m)
        self._to_local = self._lattice(x, y, self._exact_local_from_map)
        self._map_nodes = (x[0], y[0], x[1] - x[0])
        corners = self._exact_local_from_map(np.array([[a, b, 0.0] for a in (x[0], x[-1]) for b in (y[0], y[-1])]))
        low, high = corners[:, :2].min(0), corners[:, :2].max(0)
        x, y = self._nodes(low[0], high[0]), self._nodes(low[1], high[1])
        self._to_map = self._lattice(x, y, self._exact_map_from_local)
        self._local_nodes = (x[0], y[0], x[1] - x[0])

    def map_from_local(self, local_m: FloatArray) -> FloatArray:
        """Easting, northing, ellipsoidal height (..., 3) of local points (..., 3); NaN outside the area."""
        return self._evaluate(self._to_map, self._local_nodes, local_m)

    @property
    def lattice_to_map(self) -> tuple[FloatArray, tuple[float, float, float]]:
        """What `map_from_local` looks up: a lattice, (R, C, 6), and (x, y, step) of its nodes, for compiled loops."""
        return self._to_map, self._local_nodes

    def local_from_map(self, map_m: FloatArray) -> FloatArray:
        """Local points (..., 3) of easting, northing, ellipsoidal height (..., 3); NaN outside the area."""
        return self._evaluate(self._to_local, self._map_nodes, map_m)

    def geodetic_from_map(self, map_m: FloatArray) -> FloatArray:
        """Longitude, latitude (degrees), height of map points (..., 3), by PROJ itself."""
        return np.stack(self._to_geodetic.transform(*np.moveaxis(np.asarray(map_m, float), -1, 0)), axis=-1)

    def map_from_geodetic(self, lonlath: FloatArray) -> FloatArray:
        """Easting, northing, height of longitude, latitude (degrees), height (..., 3), by PROJ itself."""
        return np.stack(self._from_geodetic.transform(*np.moveaxis(np.asarray(lonlath, float), -1, 0)), axis=-1)

    def _exact_local_from_map(self, map_m: FloatArray) -> FloatArray:
        return self.frame.local_from_geodetic(self.geodetic_from_map(map_m))

    def _exact_map_from_local(self, local_m: FloatArray) -> FloatArray:
        return self.map_from_geodetic(self.frame.geodetic_from_local(local_m))

    @staticmethod
    def _nodes(low: float, high: float) -> FloatArray:
        count = max(2, math.ceil((high - low) / _NODE_M) + 1)
        return low + _NODE_M * np.arange(count)

    @staticmethod
    def _lattice(x: FloatArray, y: FloatArray, exact) -> FloatArray:  # type: ignore[no-untyped-def]
        xy = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)
        base = exact(np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], axis=-1))
        raised = exact(np.concatenate([xy, np.full((*xy.shape[:-1], 1), _REFERENCE_HEIGHT_M)], axis=-1))
        return np.concatenate([base, (raised - base) / _REFERENCE_HEIGHT_M], axis=-1)

    @staticmethod
    def _evaluate(lattice: FloatArray, nodes: tuple[float, float, float], points: FloatArray) -> FloatArray:
        points = np.asarray(points, dtype=float)
        result = np.empty(points.shape)
        kernels.evaluate_lattice(lattice, *nodes, np.ascontiguousarray(points.reshape(-1, 3)), result.reshape(-1, 3))
        return result
