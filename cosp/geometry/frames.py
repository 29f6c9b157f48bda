"""Local frames: east, north, up about an origin, one rigid motion away from the Earth-centred frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from pyproj import Transformer

from cosp.arrays import FloatArray


@dataclass(frozen=True)
class LocalFrame:
    """Topocentric frame (east, north, up; metres) on the WGS 84 ellipsoid.

    Parameters
    ----------
    longitude_deg, latitude_deg : float
    height_m : float
        Ellipsoidal height of the origin.
    """

    KIND: ClassVar[str] = "local_frame"
    VERSION: ClassVar[int] = 1

    longitude_deg: float
    latitude_deg: float
    height_m: float = 0.0

    @cached_property
    def _transformer(self) -> Transformer:
        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lon_0={float(self.longitude_deg)!r} "
            f"+lat_0={float(self.latitude_deg)!r} +h_0={float(self.height_m)!r}"
        )

    def local_from_geodetic(self, lonlath: FloatArray) -> FloatArray:
        """East, north, up of geodetic points.

        Parameters
        ----------
        lonlath : (..., 3) array
            Longitude and latitude in degrees, ellipsoidal height in metres.

        Returns
        -------
        (..., 3) array, m
        """
        lonlath = np.asarray(lonlath, dtype=float)
        return np.stack(self._transformer.transform(*np.moveaxis(lonlath, -1, 0)), axis=-1)

    def geodetic_from_local(self, local_m: FloatArray) -> FloatArray:
        """Longitude, latitude (degrees) and ellipsoidal height (metres) of local points.

        Parameters
        ----------
        local_m : (..., 3) array, m

        Returns
        -------
        (..., 3) array
            NaN where a coordinate is not finite.
        """
        local_m = np.asarray(local_m, dtype=float)
        finite = np.asarray(np.isfinite(local_m).all(axis=-1))
        safe = np.where(finite[..., None], local_m, 0.0)
        x, y, z = np.moveaxis(safe, -1, 0)
        lonlath = np.stack(self._transformer.transform(x, y, z, direction="INVERSE"), axis=-1)
        return np.where(finite[..., None], lonlath, np.nan)

    def ecef_from_local(self, local_m: FloatArray) -> FloatArray:
        """Earth-centred coordinates of local points, (..., 3) in metres."""
        return np.asarray(local_m, dtype=float) @ self.axes + self.origin_ecef_m

    def local_from_ecef(self, ecef_m: FloatArray) -> FloatArray:
        """Local coordinates of Earth-centred points, (..., 3) in metres."""
        return (np.asarray(ecef_m, dtype=float) - self.origin_ecef_m) @ self.axes.T

    @cached_property
    def axes(self) -> FloatArray:
        """Rows: the east, north and up axes in the Earth-centred frame, (3, 3)."""
        lon, lat = np.radians([self.longitude_deg, self.latitude_deg])
        sl, cl, sb, cb = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
        return np.array([[-sl, cl, 0.0], [-sb * cl, -sb * sl, cb], [cb * cl, cb * sl, sb]])

    @cached_property
    def origin_ecef_m(self) -> FloatArray:
        """Earth-centred coordinates of the origin, (3,) in metres."""
        cart = Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
        )
        return np.array(cart.transform(self.longitude_deg, self.latitude_deg, self.height_m))
