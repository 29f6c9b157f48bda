"""From matches to ground control: masks, heights, covariances, roles, coverage."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from pyproj import Transformer

from cosp.arrays import BoolArray, FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import NotEnoughMatchesError
from cosp.geometry.grids import PixelGrid
from cosp.geometry.statistics import nmad, summarise
from cosp.matching.film_image import FilmImage
from cosp.matching.filtering import agreeing_with_neighbours, block_of, consistent_by_tile, in_check_blocks, thinned
from cosp.matching.ground import Bounds, OnGrid, ground_pixel_m, grown
from cosp.matching.masks import at_points, film_faults, gradient, still_water
from cosp.matching.redundancy import sigma_factor
from cosp.matching.refit import refit_camera

log = logging.getLogger(__name__)

# What a film's own distortion adds before it is modelled: its usual size, so that the first gate lies at about 8 px.
_FILM_SIGMA_MM = 0.02
# A point this many standard deviations off the single-image resection is an error.
_GATE_SIGMA = 4.0
# Cells that coverage is counted in, along and across the film.
_COVERAGE_CELLS = (20, 3)
# Less of the film's length than this under control is worth a warning: beyond it the camera extrapolates.
_LEAST_COVERAGE = 0.8
# Surroundings of a point that are looked at for saturation, and the share of them that may be white.
_SATURATION_WINDOW_MM = 0.5
_SATURATED_SHARE = 0.5
_FINEST_POSTING_M = 30.0
# Water hardly matches: where more than this share of the matches seems to lie on it, it is a plain in whole metres.
_MOST_WATER = 0.2
# So many points of the user's own carry a film without matches.
_ENOUGH_OWN = 12
# Templates of relief are large: so many of them away a match still counts for a neighbour.
_REACH_TEMPLATES = 3.0
# Steps of the derivatives of film points by the ground, m.
_STEP_M = 1.0


def collect(
    matches: pd.DataFrame,
    film: FilmImage,
    camera: PanoramicCamera,
    *,
    heights_on: OnGrid,
    unstable_on: Callable[[PixelGrid], BoolArray] | None,
    crs: str,
    dem_posting_m: float,
    reference_shift_m: tuple[float, float],
    own: pd.DataFrame | None,
    tile_mm: float,
    gate_px: float,
    min_per_tile: int,
    trials: int,
    relief: bool,
    relief_min_places: int,
    relief_min_share: float,
    cell_mm: float,
    per_cell: int,
    max_slope_deg: float,
    white: int,
    scratch_grey: float,
    reference_sigma_m: float,
    dem_sigma_m: float,
    check_columns: int,
    check_rows: int,
    min_gcps: int,
    rng: np.random.Generator,
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Ground control points of a film, and how they came about.

    Points on voids, steep slopes, still water, unstable terrain, overexposed film and scratches are left out; those
    that disagree with their neighbours or with a robust resection of the film are kept as rejected; the rest is thinned
    to an even spread and every other block of the film is held back as check points. The standard deviations that the
    matcher states are scaled by what neighbours say. Points of the user's own are all control, whatever they say.

    Parameters
    ----------
    matches : table
        Columns x_mm, y_mm, longitude_deg, latitude_deg, score, sigma_px, posting_m, template_px (of the images that
        were matched).
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
    reference_shift_m : (east, north)
        Added to the places of the matches, before their heights are taken from the DEM.
    own : table, or None
        Points of the user's own on this film: x_mm, y_mm, longitude_deg, latitude_deg, height_m, sigma_px,
        sigma_ground_m, sigma_height_m; NaN of the last four means from the DEM and the values given here.
    tile_mm, gate_px, min_per_tile, trials
        See `consistent_by_tile`; the gate in pixels of the images that were matched.
    relief : bool
        Whether the matches are with shaded relief, so weak that they count by what their neighbours say.
    relief_min_places, relief_min_share
        See `agreeing_with_neighbours`.
    cell_mm, per_cell
        See `thinned`.
    max_slope_deg : float
    white, scratch_grey
        See `film_faults`.
    reference_sigma_m, dem_sigma_m : float
        Standard deviations of the reference image (per coordinate) and of the DEM (height).
    check_columns, check_rows : int
        Blocks along and across the film.
    min_gcps : int
        Twelve points of the user's own are enough without.
    rng : numpy Generator

    Returns
    -------
    gcps : table
        Columns x_mm y_mm longitude_deg latitude_deg height_m role source score sigma_px sigma_ground_m sigma_height_m
        sigma_x_px sigma_y_px correlation_xy (match, reference and slope together, on the film) residual_x_px
        residual_y_px (measured minus projected, resection of the control points).
    summary : dict
        Counts by reason, coverage, statistics of residuals.

    Raises
    ------
    NotEnoughMatchesError
        If fewer than `min_gcps` points remain.
    """
    scene = camera.scene
    needed = min_gcps if own is None or len(own) < _ENOUGH_OWN else 0
    require(len(matches), needed, scene, "ground control points")
    points = _joined(matches, own, reference_sigma_m)
    mine = points["source"].to_numpy() == "own"
    film_mm = points[["x_mm", "y_mm"]].to_numpy(float)
    lonlat = points[["longitude_deg", "latitude_deg"]].to_numpy(float)
    sigma_px = points["sigma_px"].to_numpy(float)
    sigma_ground = points["sigma_ground_m"].to_numpy(float)
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    east_north = np.stack(to_map.transform(lonlat[:, 0], lonlat[:, 1]), axis=-1)
    if any(reference_shift_m):
        east_north[~mine] += reference_shift_m
        east, north = east_north[~mine].T
        lonlat[~mine] = np.stack(to_map.transform(east, north, direction="INVERSE"), axis=-1)

    posting = max(dem_posting_m, _FINEST_POSTING_M)
    grid = PixelGrid.covering(grown(_bounds_of(east_north), 10 * posting), posting)
    heights = heights_on(grid)
    down, right = gradient(heights, posting)
    rise = np.stack([at_points(right, grid, east_north), -at_points(down, grid, east_north)], axis=-1)
    of_dem = at_points(heights, grid, east_north)
    height = np.where(np.isfinite(points["height_m"]), points["height_m"], of_dem)
    unstable = np.zeros(len(points), bool)
    if unstable_on is not None:
        unstable = at_points(unstable_on(grid), grid, east_north, nearest=True) > 0.5
    overexposed, scratched = film_faults(
        film,
        film_mm,
        window_mm=_SATURATION_WINDOW_MM,
        white=white,
        max_share=_SATURATED_SHARE,
        scratch_grey=scratch_grey,
    )
    water = at_points(still_water(heights), grid, east_north, nearest=True) > 0.5
    if water.mean() > _MOST_WATER:
        log.info("%.0f %% of the points lie on level ground, which is taken for a plain", 100 * water.mean())
        water[:] = False
    reasons = {
        "no_height": ~(np.isfinite(of_dem) & np.isfinite(rise).all(axis=1)),
        "steep": np.hypot(*rise.T) > np.tan(np.radians(max_slope_deg)),
        "water": water,
        "unstable": unstable,
        "overexposed": overexposed,
        "scratched": scratched,
    }
    usable = ~np.any(list(reasons.values()), axis=0) & ~mine

    rise = np.nan_to_num(rise)
    ground = camera.origin.local_from_geodetic(np.column_stack([lonlat, np.nan_to_num(height)]))
    pixel_m = ground_pixel_m(camera, film.pixel_mm, float(np.nanmedian(height)))
    agreeing = np.zeros(len(points), bool)
    if usable.any():
        gate_mm = gate_px * float(points["posting_m"].median()) * film.pixel_mm / pixel_m
        template_mm = float((points["template_px"] * points["posting_m"]).median()) * film.pixel_mm / pixel_m
        predicted = np.where(usable[:, None], camera.project(ground), np.nan)
        if relief:
            agreeing = agreeing_with_neighbours(
                predicted,
                film_mm,
                template_mm=template_mm,
                reach_mm=max(tile_mm / 2, _REACH_TEMPLATES * template_mm),
                gate_mm=gate_mm,
                min_places=relief_min_places,
                min_share=relief_min_share,
            )
        else:
            agreeing = consistent_by_tile(
                predicted, film_mm, tile_mm=tile_mm, gate_mm=gate_mm, minimum=min_per_tile, trials=trials, rng=rng
            )
    score = points["score"].to_numpy(float)
    kept = np.zeros(len(points), bool)
    chosen = np.flatnonzero(agreeing)
    kept[chosen[thinned(film_mm[chosen], score[chosen], cell_mm=cell_mm, per_cell=per_cell)]] = True
    kept |= mine & np.isfinite(height)
    require(int(kept.sum()), needed, scene, "ground control points")

    check = ~mine & in_check_blocks(
        film_mm, camera.half_length_mm, camera.half_width_mm, columns=check_columns, rows=check_rows
    )
    given = points["sigma_height_m"].to_numpy(float)
    known_height = mine & np.isfinite(points["height_m"])
    dem_sigma = np.where(np.isfinite(given), given, dem_sigma_m)
    rise[known_height] = 0.0  # measured with the point, not read from the DEM at its place
    sigma_height = np.hypot(dem_sigma, np.hypot(*rise.T) * sigma_ground)
    control = kept & ~check
    require(int(control.sum()), needed // 2, scene, "ground control points outside the check blocks")

    def covariances() -> tuple[FloatArray, FloatArray]:
        """Of the points alone, and with what the film adds."""
        of_points = film_covariance(camera, ground, sigma_px * film.pixel_mm, sigma_ground, dem_sigma, rise)
        return of_points, of_points + _FILM_SIGMA_MM**2 * np.eye(2)

    spread_mm = np.sqrt(np.trace(covariances()[1], axis1=1, axis2=2) / 2)
    fitted = refit_camera(camera, film_mm[control], ground[control], spread_mm[control]).camera
    residual = film_mm - fitted.project(ground)
    # What a matcher states of itself is a guess that errs on the safe side; the matches tell.
    factor = None
    if agreeing.any():
        factor = sigma_factor(film_mm[agreeing], residual[agreeing], sigma_px[agreeing] * film.pixel_mm, template_mm)
    if factor is not None:
        sigma_px = np.where(mine, sigma_px, factor * sigma_px)
    covariance, total = covariances()
    standardised = np.sqrt(np.einsum("ni,nij,nj->n", residual, np.linalg.inv(total), residual))
    gross = ~(standardised <= _GATE_SIGMA)
    rejected = ~mine & ((kept & gross) | (usable & ~agreeing))
    kept &= ~gross | mine
    require(int((kept & ~check).sum()), needed // 2, scene, "ground control points outside the check blocks")
    if (mine & gross).any():
        places = ", ".join(f"({x:.1f}, {y:.1f}) mm" for x, y in film_mm[mine & gross][:5])
        log.warning("%d points of your own disagree with the resection: %s", (mine & gross).sum(), places)

    sigma_film = np.sqrt(covariance[:, [0, 1], [0, 1]])
    residual_px = residual / film.pixel_mm
    role = np.where(rejected, "rejected", np.where(check, "check", "control"))
    table = pd.DataFrame(
        {
            "x_mm": film_mm[:, 0],
            "y_mm": film_mm[:, 1],
            "longitude_deg": lonlat[:, 0],
            "latitude_deg": lonlat[:, 1],
            "height_m": height,
            "role": role,
            "source": points["source"].to_numpy(),
            "score": score,
            "sigma_px": sigma_px,
            "sigma_ground_m": sigma_ground,
            "sigma_height_m": sigma_height,
            "sigma_x_px": sigma_film[:, 0] / film.pixel_mm,
            "sigma_y_px": sigma_film[:, 1] / film.pixel_mm,
            "correlation_xy": covariance[:, 0, 1] / sigma_film.prod(axis=1),
            "residual_x_px": residual_px[:, 0],
            "residual_y_px": residual_px[:, 1],
        }
    )
    covered = coverage(film_mm[kept], camera.half_length_mm, camera.half_width_mm, *_COVERAGE_CELLS)
    summary: dict[str, Any] = {
        "matches": len(matches),
        **{reason: int((found & ~mine).sum()) for reason, found in reasons.items()},
        "agreeing": int(agreeing.sum()),
        "control": int((kept & ~check).sum()),
        "check": int((kept & check).sum()),
        "rejected": int(rejected.sum()),
        "own": int((kept & mine).sum()),
        "own_disagreeing": int((kept & mine & gross).sum()),
        "sigma_factor": factor,
        "median_sigma_px": float(np.median(sigma_px[kept])),
        "coverage": covered,
        "residual_px": {
            name: {axis: summarise(residual_px[part, i]) for i, axis in enumerate("xy")}
            for name, part in (("control", kept & ~check), ("check", kept & check))
        },
        "residual_over_sigma": {
            axis: nmad(residual[kept, i] / np.sqrt(total[kept, i, i])) for i, axis in enumerate("xy")
        },
    }
    log.info("%d control and %d check points of %d matches", summary["control"], summary["check"], len(matches))
    if covered["along"] < _LEAST_COVERAGE:
        log.warning("control covers only %.0f %% of the length of the film", 100 * covered["along"])
    return table[kept | rejected].reset_index(drop=True), summary


def _joined(matches: pd.DataFrame, own: pd.DataFrame | None, reference_sigma_m: float) -> pd.DataFrame:
    """Matches and the user's own points in one table, by source."""
    parts = [matches.assign(height_m=np.nan, sigma_ground_m=reference_sigma_m, sigma_height_m=np.nan, source="match")]
    if own is not None and len(own):
        ground = own["sigma_ground_m"].fillna(reference_sigma_m)
        parts.append(own.assign(source="own", score=1.0, posting_m=np.nan, template_px=np.nan, sigma_ground_m=ground))
    return pd.concat([part for part in parts if len(part)], ignore_index=True)


def _bounds_of(points: FloatArray) -> Bounds:
    low, high = points.min(axis=0), points.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def film_covariance(
    camera: PanoramicCamera,
    ground_m: FloatArray,
    match_sigma_mm: FloatArray,
    ground_sigma_m: FloatArray,
    height_sigma_m: FloatArray,
    rise: FloatArray,
) -> FloatArray:
    """Covariance (N, 2, 2), mm^2, of film points less the projections of their ground points.

    A point that is wrong in plan by the error of the reference takes its height at the wrong place, so that on a slope
    the errors of plan and height go together.

    Parameters
    ----------
    ground_m : (N, 3) array
        In the camera's local frame.
    match_sigma_mm, ground_sigma_m, height_sigma_m : (N,) arrays
        Standard deviations of the match and of the plan, per coordinate, and of the DEM's height.
    rise : (N, 2) array
        Rise of the ground per metre towards east and towards north; 0 where the height was not taken from a DEM.
    """
    by_ground = film_by_ground(camera.project, ground_m)
    # Film by plan, the height following the slope; film by the height alone.
    by_plan = by_ground[:, :, :2] + by_ground[:, :, 2:] * rise[:, None, :]
    plan = np.einsum("nij,nkj->nik", by_plan, by_plan) * ground_sigma_m[:, None, None] ** 2
    by_height = by_ground[:, :, 2]
    height = by_height[:, :, None] * by_height[:, None, :] * height_sigma_m[:, None, None] ** 2
    return np.asarray(match_sigma_mm[:, None, None] ** 2 * np.eye(2) + plan + height)


def film_by_ground(project: Callable[[FloatArray], FloatArray], ground_m: FloatArray) -> FloatArray:
    """Derivatives (N, 2, 3) of the film points that a function gives of ground points (N, 3), mm per metre."""
    steps = _STEP_M * np.eye(3)
    return np.stack([(project(ground_m + step) - project(ground_m - step)) / (2 * _STEP_M) for step in steps], axis=-1)


def coverage(
    film_mm: FloatArray, half_length_mm: float, half_width_mm: float, columns: int, rows: int
) -> dict[str, Any]:
    """How a film's points are spread over it.

    Returns
    -------
    dict
        Shares of cells, of columns along and of rows across that hold points; the longest stretch along and across the
        film without one, its ends included, mm; evenness, 1 where all cells hold as many; counts by row of cells.
    """
    block = block_of(film_mm, half_length_mm, half_width_mm, columns, rows)
    counts = np.zeros((rows, columns), int)
    np.add.at(counts, (block[:, 1], block[:, 0]), 1)
    filled = counts > 0
    share = counts[filled] / max(counts.sum(), 1)
    entropy = float(-(share * np.log(share)).sum())
    return {
        "cells": float(filled.mean()),
        "along": float(filled.any(axis=0).mean()),
        "across": float(filled.any(axis=1).mean()),
        "longest_gap_along_mm": _longest_gap(film_mm[:, 0], half_length_mm),
        "longest_gap_across_mm": _longest_gap(film_mm[:, 1], half_width_mm),
        "evenness": float(np.exp(entropy) / counts.size),
        "counts": counts.tolist(),
    }


def _longest_gap(places_mm: FloatArray, half_mm: float) -> float:
    """Longest stretch between two neighbouring places, or a place and an end."""
    return float(np.diff(np.sort(np.concatenate([[-half_mm], places_mm, [half_mm]]))).max())


def require(count: int, needed: int, scene: str, what: str) -> None:
    """Stop where too few points remain.

    Raises
    ------
    NotEnoughMatchesError
    """
    if count < needed:
        raise NotEnoughMatchesError(f"{scene}: {count} of the {needed} {what} needed remain after filtering")
