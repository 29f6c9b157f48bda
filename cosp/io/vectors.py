"""Polygons: unstable terrain, areas of interest."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pyogrio
from pyogrio.errors import DataSourceError
from rasterio.features import rasterize

from cosp.arrays import BoolArray
from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.io.rasters import _transform_of
from cosp.io.temporary import temporary_for

_GEOPACKAGE_DATE = "2000-01-01T00:00:00.000Z"  # a GeoPackage says when it was changed; products must not


def read(path: str | Path, crs: str) -> gpd.GeoDataFrame:
    """Features of a GeoPackage, GeoJSON or Shapefile in a reference system.

    Raises
    ------
    InputError
        If the file cannot be read or has no reference system.
    """
    try:
        features = gpd.read_file(path)
    except (DataSourceError, FileNotFoundError) as error:
        raise InputError(f"{path}: not a file of polygons that can be read ({error})") from error
    if features.crs is None:
        raise InputError(f"{path}: the polygons have no coordinate reference system")
    return features.to_crs(crs)


def write(path: str | Path, features: gpd.GeoDataFrame, layer: str) -> None:
    """Write a GeoPackage, whole or not at all; the same features give the same bytes."""
    path = Path(path)
    temporary = temporary_for(path)
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _GEOPACKAGE_DATE})
    try:
        features.to_file(temporary, driver="GPKG", layer=layer, engine="pyogrio")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})


def rasterise(path: str | Path, grid: PixelGrid, crs: str) -> BoolArray:
    """Which pixels of a grid any polygon of the file touches."""
    shapes = [shape for shape in read(path, crs).geometry if shape is not None and not shape.is_empty]
    if not shapes:
        return np.zeros(grid.shape, bool)
    burnt = rasterize(shapes, out_shape=grid.shape, transform=_transform_of(grid), all_touched=True, dtype="uint8")
    return np.asarray(burnt, bool)


def bounds(path: str | Path, crs: str) -> tuple[float, float, float, float]:
    """xmin, ymin, xmax, ymax of all features in a reference system."""
    xmin, ymin, xmax, ymax = (float(v) for v in read(path, crs).total_bounds)
    return xmin, ymin, xmax, ymax
