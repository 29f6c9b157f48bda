"""The ground of a site at two epochs: heights, glaciers, lakes, and the light that leaves it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, label, minimum

from cosp.arrays import ByteArray, Float32Array
from cosp.geometry.grids import PixelGrid
from cosp.simulation import kernels
from cosp.simulation.site import SitePlan

GLACIER = 1
LAKE = 2
FILM_EPOCH = 1
MODERN_EPOCH = 2
SHADOW_BLOCK_CELLS = 16
_ROWS = 64
_BLUR_CELLS = 4


@dataclass(frozen=True)
class Terrain:
    """Heights above the ellipsoid at both epochs, what is unstable (0, GLACIER, LAKE), share of valley floor."""

    film: Float32Array
    modern: Float32Array
    unstable: ByteArray
    valley: ByteArray


@dataclass(frozen=True)
class Scenery:
    """How bright the ground is (0-255, level snow about 165) and how strong its fine texture, on the terrain grid."""

    radiance: ByteArray
    strength: ByteArray


def make_terrain(plan: SitePlan, dem: Float32Array | None = None, *, threads: int) -> Terrain:
    """Terrain of a site at the film's and the modern epoch.

    dem : ellipsoidal heights on the plan's terrain grid, NaN where there are none; there and beyond its edge the
        procedural terrain goes on without a step.
    """
    settings, grid = plan.settings, plan.terrain_grid
    modern = np.empty(grid.shape, np.float32)
    valley = np.empty(grid.shape, np.uint8)
    centre_east = grid.x0 + grid.step_x * grid.shape[1] / 2.0
    _by_rows(
        lambda row0, row1: kernels.fill_procedural(
            modern, valley, grid.x0, grid.y0, grid.step_x, row0, row1, centre_east, settings.seed * 7919
        ),
        grid.shape[0],
        threads,
    )
    unstable = np.zeros(grid.shape, np.uint8)
    _fill_lakes(modern, valley, unstable, grid, settings.seed)
    if dem is not None:
        known = np.isfinite(dem)
        unstable[known] = 0
        modern = continue_terrain(dem, modern, posting_m=grid.step_x)
        steep = np.hypot(*np.gradient(modern, grid.step_x))
        valley[known] = np.where(steep[known] < 0.06, 255, 0)
    ice = _glaciers(modern, grid, settings.snow_line_m)
    modern += _valley_fill(modern, grid) * ice * (0.6 if dem is None else 0.0)
    unstable[ice > 0.25] = GLACIER
    # Tongues thin most, ice near the crests hardly.
    lower = np.clip((settings.modern_snow_line_m + 500.0 - modern) / 900.0, 0.0, 1.0)
    film = modern + (settings.glacier_thinning_m * ice * lower).astype(np.float32)
    return Terrain(film, modern, unstable, valley)


def continue_terrain(dem: Float32Array, procedural: Float32Array, *, posting_m: float) -> Float32Array:
    """A DEM inside its cover, procedural heights far outside, and a gentle passage where the DEM ends.

    Beyond the edge the height of the nearest known cell gives way to the procedural one over a few kilometres, so no
    height lies outside the range of both.
    """
    known = np.isfinite(dem)
    if not known.any() or known.all():
        return np.where(known, dem, procedural).astype(np.float32)
    distance, nearest = distance_transform_edt(~known, return_indices=True)
    edge = dem[nearest[0], nearest[1]]
    del nearest
    # The edge's profile is carried straight outwards; smoothing what lies far from it avoids streaks.
    smooth = cv2.GaussianBlur(edge, (0, 0), 500.0 / posting_m, borderType=cv2.BORDER_REPLICATE)
    near = np.exp(-np.square(distance * (posting_m / 500.0))).astype(np.float32)
    edge = near * edge + (1.0 - near) * smooth
    share = np.exp(-np.square(distance * (posting_m / 2500.0))).astype(np.float32)
    return np.where(known, dem, share * edge + (1.0 - share) * procedural).astype(np.float32)


def light_terrain(
    plan: SitePlan,
    terrain: Terrain,
    epoch: int,
    photo: Float32Array | None = None,
    *,
    threads: int,
) -> Scenery:
    """Brightness and texture of the ground under the sun and snow of one epoch.

    photo : grey values (0-255) of an orthophoto on the terrain grid, NaN where there is none.
    """
    settings, grid = plan.settings, plan.terrain_grid
    film = epoch == FILM_EPOCH
    azimuth = np.radians(settings.sun_azimuth_deg if film else settings.modern_sun_azimuth_deg)
    elevation = np.radians(settings.sun_elevation_deg if film else settings.modern_sun_elevation_deg)
    sun = (np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation))
    heights = terrain.film if film else terrain.modern
    maxima = kernels.block_maxima(heights, SHADOW_BLOCK_CELLS)
    radiance = np.empty(grid.shape, np.uint8)
    strength = np.empty(grid.shape, np.uint8)
    if photo is None:
        grey = np.zeros((1, 1), np.uint8)
        weight = np.zeros((1, 1), np.float32)
        grey, weight = np.broadcast_to(grey, grid.shape), np.broadcast_to(weight, grid.shape)
    else:
        seen = np.isfinite(photo)
        grey = np.where(seen, photo, 0.0).astype(np.uint8)
        weight = np.minimum(distance_transform_edt(np.pad(seen, 1))[1:-1, 1:-1] * grid.step_x / 600.0, 1.0)
        weight = weight.astype(np.float32)
    _by_rows(
        lambda row0, row1: kernels.fill_scenery(
            heights, maxima, SHADOW_BLOCK_CELLS, terrain.valley, terrain.unstable, radiance, strength,
            grid.x0, grid.y0, grid.step_x, row0, row1,
            *sun, settings.snow_line_m if film else settings.modern_snow_line_m, settings.changed_share, 300 * epoch,
            settings.seed * 7919, grey, weight,
        ),
        grid.shape[0],
        threads,
    )  # fmt: skip
    scaled = np.clip(strength.astype(np.float32) * settings.texture, 0.0, 255.0).astype(np.uint8)
    return Scenery(radiance, scaled)


def _by_rows(fill: Callable[[int, int], None], rows: int, threads: int) -> None:
    """Run `fill(row0, row1)` over strips of rows."""
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda row: fill(row, min(row + _ROWS, rows)), range(0, rows, _ROWS)))


def _blurred(heights: Float32Array, grid: PixelGrid, sigma_m: float) -> Float32Array:
    """Heights smoothed over hundreds of metres, worked out on a coarser grid."""
    factor = max(1, int(sigma_m / grid.step_x / _BLUR_CELLS))
    size = (max(heights.shape[1] // factor, 2), max(heights.shape[0] // factor, 2))
    small = cv2.resize(heights, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma_m / (factor * grid.step_x), borderType=cv2.BORDER_REFLECT)
    return np.asarray(cv2.resize(small, heights.shape[::-1], interpolation=cv2.INTER_CUBIC), dtype=np.float32)


def _valley_fill(heights: Float32Array, grid: PixelGrid) -> Float32Array:
    """How far a cell lies below its surroundings, m."""
    return np.asarray(np.maximum(_blurred(heights, grid, 500.0) - heights, 0.0), dtype=np.float32)


def _glaciers(heights: Float32Array, grid: PixelGrid, snow_line_m: float) -> Float32Array:
    """Share of ice (0 to 1): high hollows and the upper valleys below them."""
    around = _blurred(heights, grid, 900.0)
    hollow = np.clip((around - heights - 15.0) / 40.0, 0.0, 1.0)
    high = np.clip((_blurred(heights, grid, 2000.0) - snow_line_m + 450.0) / 150.0, 0.0, 1.0)
    ice = cv2.GaussianBlur(hollow * high, (0, 0), max(90.0 / grid.step_x, 0.6))
    return np.asarray(np.clip(2.0 * ice - 0.4, 0.0, 1.0), dtype=np.float32)


def _fill_lakes(heights: Float32Array, valley: ByteArray, unstable: ByteArray, grid: PixelGrid, seed: int) -> None:
    """Level water on part of the valley floors, in place."""
    rng = np.random.default_rng([seed, 31])
    factor = max(1, round(300.0 / grid.step_x))
    small = rng.standard_normal((grid.shape[0] // factor + 2, grid.shape[1] // factor + 2)).astype(np.float32)
    cells = 2500.0 / (factor * grid.step_x)
    small = cv2.GaussianBlur(small, (0, 0), cells) * np.float32(2.0 * np.sqrt(np.pi) * cells)
    field = cv2.resize(small, heights.shape[::-1], interpolation=cv2.INTER_CUBIC)
    water = (field > 1.5) & (valley > 235)
    labels, count = label(water)
    if count:
        # Only water of some size is worth its shore.
        areas = np.bincount(labels.ravel())
        keep = areas * grid.step_x**2 > 2e5
        keep[0] = False
        levels = np.asarray(minimum(heights, labels, np.arange(count + 1)), dtype=np.float32)
        water = keep[labels]
        heights[water] = levels[labels[water]]
        unstable[water] = LAKE
