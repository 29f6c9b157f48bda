"""Ellipsoidal heights from DEMs whose heights stand above a geoid."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Literal

import numpy as np
from pyproj import CRS, Transformer
from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]

from cosp.arrays import Float32Array, FloatArray
from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.imaging.resampling import upsample_grid
from cosp.io import rasters

HeightSystem = Literal["ellipsoidal", "egm96", "egm2008"]

_GRIDS = {
    "egm96": ("us_nga_egm96_15.tif", "egm96_15.gtx"),
    "egm2008": ("us_nga_egm08_25.tif", "egm08_25.gtx"),
}
_SYSTEM_FOLDERS = (Path("/usr/share/proj"), Path("/usr/local/share/proj"))
_log = logging.getLogger(__name__)
_NODE_M = 2000.0
_DEGREE_M = 111_200.0


def ellipsoidal_heights(path: str | Path, grid: PixelGrid, crs: str, heights: HeightSystem) -> Float32Array:
    """Heights of a DEM on a grid, above the WGS 84 ellipsoid.

    Parameters
    ----------
    path : path of a GeoTIFF in any reference system
    grid, crs : the grid and its reference system
    heights : "ellipsoidal", "egm96" or "egm2008"
        What the DEM's heights refer to.

    Returns
    -------
    (rows, columns) float32 array, m
        NaN where the DEM has nothing.
    """
    values = rasters.read_on_grid(path, grid, crs)
    if heights != "ellipsoidal":
        values = values + undulation(grid, crs, heights)
    return values


def undulation(grid: PixelGrid, crs: str, heights: HeightSystem) -> Float32Array:
    """Height of a geoid above the WGS 84 ellipsoid on a grid, m.

    Raises
    ------
    InputError
        If the geoid's grid is not installed.
    """
    if heights == "ellipsoidal":
        return np.zeros(grid.shape, np.float32)
    step_m = abs(grid.step_x) * (_DEGREE_M if CRS.from_user_input(crs).is_geographic else 1.0)
    factor = max(1, math.floor(_NODE_M / step_m))
    rows = np.arange(-(-grid.shape[0] // factor) + 1)
    columns = np.arange(-(-grid.shape[1] // factor) + 1)
    nodes = grid.points(rows[:, None] * factor, columns[None, :] * factor)
    to_geodetic = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    longitude, latitude = to_geodetic.transform(nodes[..., 0], nodes[..., 1])
    coarse = undulation_at(np.stack([longitude, latitude], axis=-1), heights).astype(np.float32)
    where = np.meshgrid(np.arange(grid.shape[0]) / factor, np.arange(grid.shape[1]) / factor, indexing="ij")
    return upsample_grid(coarse, where[0], where[1])


def undulation_at(lonlat_deg: FloatArray, heights: HeightSystem) -> FloatArray:
    """Height of a geoid above the WGS 84 ellipsoid at longitudes and latitudes (..., 2), m."""
    lonlat_deg = np.asarray(lonlat_deg, float)
    if heights == "ellipsoidal":
        return np.zeros(lonlat_deg.shape[:-1])
    transformer = Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=vgridshift "
        f"+grids={_geoid_file(heights)} +multiplier=1 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    zero = np.zeros(lonlat_deg.shape[:-1])
    _, _, height = transformer.transform(lonlat_deg[..., 0], lonlat_deg[..., 1], zero)
    return np.asarray(height)


def _geoid_file(heights: HeightSystem) -> Path:
    """The grid of a geoid among those PROJ has on this machine; EGM96 stands in for a missing EGM2008."""
    folders = [Path(get_user_data_dir()), Path(get_data_dir()), *_SYSTEM_FOLDERS]
    found = [folder / name for name in _GRIDS[heights] for folder in folders if (folder / name).exists()]
    if found:
        return found[0]
    if heights == "egm2008":
        _log.warning(
            "no grid of EGM2008 (%s) is installed: EGM96 is used instead, up to about a metre off in heights; "
            "differences against the reference DEM are not touched. 'projsync --file us_nga_egm08_25' installs it",
            ", ".join(_GRIDS[heights]),
        )
        return _geoid_file("egm96")
    raise InputError(
        f"heights {heights!r} need one of the grids {', '.join(_GRIDS[heights])}, found none in "
        f"{', '.join(str(folder) for folder in folders)}; Debian's package proj-data holds it"
    )
