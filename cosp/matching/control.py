"""From matches to ground control: heights, slopes, covariances, roles, coverage."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from pyproj import Transformer

from cosp.arrays import BoolArray, Float32Array, FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import NotEnoughMatchesError
from cosp.geometry.grids import PixelGrid
from cosp.geometry.statistics import summarise
from cosp.imaging.resampling import sample
from cosp.matching.film_image import FilmImage
from cosp.matching.filtering import block_of, consistent_by_tile, in_check_blocks, thinned
from cosp.matching.ground import Bounds, OnGrid, ground_pixel_m, grown
from cosp.matching.refit import refit_camera

log = logging.getLogger(__name__)

# What a film's own distortion adds before it is modelled: its usual size, so that the first gate lies at about 8 px.
_FILM_SIGMA_MM = 0.02
# A point this many standard deviations off the single-image resection is an error.
_GATE_SIGMA = 4.0
# Cells that coverage is counted in, along and across the film.
_COVERAGE_CELLS = (20, 3)
# Surroundings of a point that are looked at for saturation, and the share of them that may be white.
_SATURATION_WINDOW_MM = 0.5
_SATURATED_SHARE = 0.5
_FINEST_POSTING_M = 30.0


def collect(
    matches: pd.DataFrame,
    film: FilmImage,
    camera: PanoramicCamera,
    *,
    heights_on: OnGrid,
    unstable_on: Callable[[PixelGrid], BoolArray] | None,
    crs: str,
    dem_posting_m: float,
    tile_mm: float,
    gate_px: float,
    min_per_tile: int,
    trials: int,
    cell_mm: float,
    per_cell: int,
    max_slope_deg: float,
    white: int,
    reference_sigma_m: float,
    dem_sigma_m: float,
    check_columns: int,
    check_rows: int,
    min_gcps: int,
    rng: np.random.Generator,
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Ground control points of a film, and how they came about.

    Points on voids, steep slopes, unstable terrain and overexposed film are left out; those that disagree with their
    neighbours or with a robust resection of the film are kept as rejected; the rest is thinned to an even spread and
    every other block of the film is held back as check points.

    Parameters
    ----------
    matches : table
        Columns x_mm, y_mm, longitude_deg, latitude_deg, score, sigma_px, posting_m.
    film : FilmImage
    camera : PanoramicCamera
        Of the placed film.
    heights_on : function of a PixelGrid
        Ellipsoidal heights of the reference DEM, NaN in voids.
    unstable_on : function of a PixelGrid, or None
        Where the ground may have moved.
    crs : str
        Map projection in metres to work in.
    dem_posting_m : float
        Of the reference DEM.
    tile_mm, gate_px, min_per_tile, trials
        See `consistent_by_tile`; the gate in pixels of the images that were matched.
    cell_mm, per_cell
        See `thinned`.
    max_slope_deg : float
    white : int
        Grey value from which film is overexposed.
    reference_sigma_m, dem_sigma_m : float
        Standard deviations of the reference image (per coordinate) and of the DEM (height).
    check_columns, check_rows : int
        Blocks along and across the film.
    min_gcps : int
    rng : numpy Generator

    Returns
    -------
    gcps : table
        Columns x_mm y_mm longitude_deg latitude_deg height_m role score sigma_px sigma_ground_m sigma_height_m
        residual_x_px residual_y_px (measured minus projected, resection of the control points).
    summary : dict
        Counts by reason, coverage, statistics of residuals.

    Raises
    ------
    NotEnoughMatchesError
        If fewer than `min_gcps` points remain.
    """
    scene = camera.scene
    require(len(matches), min_gcps, scene, "ground control points")
    film_mm = matches[["x_mm", "y_mm"]].to_numpy(float)
    lonlat = matches[["longitude_deg", "latitude_deg"]].to_numpy(float)
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    east_north = np.stack(to_map.transform(lonlat[:, 0], lonlat[:, 1]), axis=-1)
    posting = max(dem_posting_m, _FINEST_POSTING_M)
    grid = PixelGrid.covering(grown(_bounds_of(east_north), 10 * posting), posting)
    heights = heights_on(grid)
    height = at_points(heights, grid, east_north)
    slope = at_points(slope_deg(heights, posting), grid, east_north)
    no_height = ~(np.isfinite(height) & np.isfinite(slope))
    steep = ~no_height & (slope > max_slope_deg)
    unstable = np.zeros(len(matches), bool)
    if unstable_on is not None:
        unstable = at_points(unstable_on(grid), grid, east_north, nearest=True) > 0.5
    overexposed = saturated(
        film, film_mm, window_mm=_SATURATION_WINDOW_MM, white=white, max_share=_SATURATED_SHARE
    )  # fmt: skip
    usable = ~(no_height | steep | unstable | overexposed)

    ground = camera.origin.local_from_geodetic(np.column_stack([lonlat, np.where(no_height, 0.0, height)]))
    pixel_m = ground_pixel_m(camera, film.pixel_mm, float(np.nanmedian(height)))
    mm_per_m = film.pixel_mm / pixel_m
    predicted = np.where(usable[:, None], camera.project(ground), np.nan)
    gate_mm = gate_px * float(matches["posting_m"].median()) * mm_per_m
    agreeing = consistent_by_tile(
        predicted, film_mm, tile_mm=tile_mm, gate_mm=gate_mm, minimum=min_per_tile, trials=trials, rng=rng
    )
    score = matches["score"].to_numpy(float)
    kept = np.zeros(len(matches), bool)
    chosen = np.flatnonzero(agreeing)
    kept[chosen[thinned(film_mm[chosen], score[chosen], cell_mm=cell_mm, per_cell=per_cell)]] = True
    require(int(kept.sum()), min_gcps, scene, "ground control points")

    check = in_check_blocks(
        film_mm, camera.half_length_mm, camera.half_width_mm, columns=check_columns, rows=check_rows
    )  # fmt: skip
    sigma_px = matches["sigma_px"].to_numpy(float)
    sigma_ground = np.full(len(matches), float(reference_sigma_m))
    sigma_height = height_sigma_m(np.nan_to_num(slope), sigma_ground, dem_sigma_m)
    sigma_mm = np.hypot(sigma_px * film.pixel_mm, np.hypot(sigma_ground, 0.5 * sigma_height) * mm_per_m)
    sigma_mm = np.hypot(sigma_mm, _FILM_SIGMA_MM)
    control = kept & ~check
    require(int(control.sum()), min_gcps // 2, scene, "ground control points outside the check blocks")
    fitted = refit_camera(camera, film_mm[control], ground[control], sigma_mm[control]).camera
    residual = film_mm - fitted.project(ground)
    gross = ~(np.linalg.norm(residual, axis=1) <= _GATE_SIGMA * sigma_mm)
    rejected = (kept & gross) | (usable & ~agreeing)
    kept &= ~gross
    require(int((kept & ~check).sum()), min_gcps // 2, scene, "ground control points outside the check blocks")

    listed = kept | rejected
    role = np.where(rejected, "rejected", np.where(check, "check", "control"))
    residual_px = residual / film.pixel_mm
    table = pd.DataFrame(
        {
            "x_mm": film_mm[:, 0],
            "y_mm": film_mm[:, 1],
            "longitude_deg": lonlat[:, 0],
            "latitude_deg": lonlat[:, 1],
            "height_m": height,
            "role": role,
            "score": score,
            "sigma_px": sigma_px,
            "sigma_ground_m": sigma_ground,
            "sigma_height_m": sigma_height,
            "residual_x_px": residual_px[:, 0],
            "residual_y_px": residual_px[:, 1],
        }
    )
    summary: dict[str, Any] = {
        "matches": len(matches),
        "no_height": int(no_height.sum()),
        "steep": int(steep.sum()),
        "unstable": int(unstable.sum()),
        "overexposed": int(overexposed.sum()),
        "agreeing": int(agreeing.sum()),
        "control": int((kept & ~check).sum()),
        "check": int((kept & check).sum()),
        "rejected": int(rejected.sum()),
        "median_sigma_px": float(np.median(sigma_px[kept])),
        "coverage": coverage(film_mm[kept], camera.half_length_mm, camera.half_width_mm, *_COVERAGE_CELLS),
        "residual_px": {
            name: {axis: summarise(residual_px[part, i]) for i, axis in enumerate("xy")}
            for name, part in (("control", kept & ~check), ("check", kept & check))
        },
    }
    log.info("%d control and %d check points of %d matches", summary["control"], summary["check"], len(matches))
    return table[listed].reset_index(drop=True), summary


def _bounds_of(points: FloatArray) -> Bounds:
    low, high = points.min(axis=0), points.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def slope_deg(heights_m: Float32Array, posting_m: float) -> Float32Array:
    """Slope of a height grid, degrees; NaN beside gaps."""
    down, right = np.gradient(heights_m.astype(np.float32), posting_m)
    return np.asarray(np.degrees(np.arctan(np.hypot(down, right))), np.float32)


def at_points(raster: Any, grid: PixelGrid, easting_northing: FloatArray, *, nearest: bool = False) -> FloatArray:
    """Values of a raster at map points (N, 2), between its pixels or of the nearest one; NaN outside."""
    rows, columns = grid.pixels(easting_northing)
    values = sample(
        np.asarray(raster, np.float32), rows, columns, interpolation="nearest" if nearest else "linear", border=np.nan
    )
    return np.asarray(values, float)


def saturated(film: FilmImage, film_mm: FloatArray, *, window_mm: float, white: int, max_share: float) -> BoolArray:
    """Points whose surroundings on the film are mostly overexposed, (N,) bool.

    Parameters
    ----------
    film : FilmImage
    film_mm : (N, 2) array
    window_mm : float
        Side of the surroundings.
    white : int
        Grey value from which a pixel holds no picture.
    max_share : float
        Of such pixels.
    """
    masked = FilmImage(film.grid, lambda window: np.where(film.read(window) >= white, 255, 1).astype(np.uint8))
    share = masked.reduced(max(1, round(window_mm / film.pixel_mm))).sample(film_mm)
    return np.asarray(np.nan_to_num(share, nan=255.0) > 255 * max_share)


def height_sigma_m(slope: FloatArray, ground_sigma_m: FloatArray, dem_sigma_m: float) -> FloatArray:
    """Standard deviation of interpolated heights: that of the DEM, and of the point's place on a slope (degrees)."""
    return np.hypot(dem_sigma_m, np.tan(np.radians(slope)) * ground_sigma_m)


def coverage(
    film_mm: FloatArray, half_length_mm: float, half_width_mm: float, columns: int, rows: int
) -> dict[str, Any]:
    """Share of the film's cells that hold points: of all, of columns along and of rows across; counts of each cell."""
    block = block_of(film_mm, half_length_mm, half_width_mm, columns, rows)
    counts = np.zeros((rows, columns), int)
    np.add.at(counts, (block[:, 1], block[:, 0]), 1)
    filled = counts > 0
    return {
        "cells": float(filled.mean()),
        "along": float(filled.any(axis=0).mean()),
        "across": float(filled.any(axis=1).mean()),
        "counts": counts.tolist(),
    }


def require(count: int, needed: int, scene: str, what: str) -> None:
    """Stop where too few points remain.

    Raises
    ------
    NotEnoughMatchesError
    """
    if count < needed:
        raise NotEnoughMatchesError(f"{scene}: {count} of the {needed} {what} needed remain after filtering")
