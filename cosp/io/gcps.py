"""Ground control points that people measured: CSV, or point features of a GeoPackage or GeoJSON."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
from pyogrio.errors import DataSourceError

from cosp.errors import InputError

GROUND = ("longitude_deg", "latitude_deg")
FILM = ("x_mm", "y_mm")
OPTIONAL = {"height_m": np.nan, "sigma_px": 1.0, "sigma_ground_m": np.nan, "sigma_height_m": np.nan}
"""Columns that may be left out, and what then stands there; NaN is filled from the reference DEM and the config."""
_LIMITS = {
    "longitude_deg": (-180.0, 360.0),
    "latitude_deg": (-90.0, 90.0),
    "x_mm": (-400.0, 400.0),
    "y_mm": (-35.0, 35.0),
}


def read(path: str | Path) -> pd.DataFrame:
    """Points with the columns scene, x_mm, y_mm, longitude_deg, latitude_deg and those of `OPTIONAL`.

    Of point features the geometry, in any reference system, gives longitude and latitude.

    Raises
    ------
    InputError
        Naming file, row and column, what was found and what is needed.
    """
    path = Path(path)
    table = _csv(path) if path.suffix.lower() in (".csv", ".tsv", ".txt") else _features(path)
    needed = ("scene", *FILM, *GROUND)
    missing = [name for name in needed if name not in table]
    if missing:
        raise InputError(f"{path}: no column {', '.join(missing)}; needed are {', '.join(needed)}")
    result = pd.DataFrame({"scene": table["scene"].astype(str).str.strip()})
    for name in (*FILM, *GROUND, *OPTIONAL):
        optional = name in OPTIONAL
        given = table[name] if name in table else pd.Series(np.nan, table.index)
        values = pd.to_numeric(given, errors="coerce")
        low, high = _LIMITS.get(name, (-np.inf, np.inf))
        if name.startswith("sigma"):
            low = np.nextafter(0.0, 1.0)
        wrong = ((values < low) | (values > high)) | (values.isna() & (given.notna() if optional else True))
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            expected = f"a number from {low:g} to {high:g}" if name in _LIMITS else "a number"
            expected = "a number above 0" if name.startswith("sigma") else expected
            raise InputError(f"{path}, row {row + 2}, column {name}: found {given.iloc[row]!r}; expected {expected}")
        result[name] = values.fillna(OPTIONAL[name]).astype(float) if optional else values.astype(float)
    if result.empty:
        raise InputError(f"{path}: holds no point")
    return result


def _csv(path: Path) -> pd.DataFrame:
    try:
        return pd.read_csv(path, sep="\t" if path.suffix.lower() == ".tsv" else ",", comment="#", skipinitialspace=True)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a table of ground control points that can be read ({error})") from error


def _features(path: Path) -> pd.DataFrame:
    try:
        features = gpd.read_file(path)
    except (DataSourceError, OSError) as error:
        raise InputError(f"{path}: not a file of points that can be read ({error})") from error
    if features.crs is None:
        raise InputError(f"{path}: the points have no coordinate reference system")
    if not (features.geom_type == "Point").all():
        raise InputError(f"{path}: expected points, found {', '.join(sorted(set(features.geom_type) - {'Point'}))}")
    geodetic = features.to_crs("EPSG:4326").geometry
    table = pd.DataFrame(features.drop(columns=features.geometry.name))
    return table.assign(longitude_deg=geodetic.x.to_numpy(), latitude_deg=geodetic.y.to_numpy())
