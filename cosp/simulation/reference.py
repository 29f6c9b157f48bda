"""Reference data of the modern epoch, each with an error of its own: DEM, orthoimage, outlines of unstable terrain."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import geopandas as gpd
import numpy as np
from pyproj import CRS, Transformer
from rasterio.features import shapes
from rasterio.transform import Affine
from shapely.geometry import shape

from cosp.arrays import ByteArray, Float32Array, FloatArray
from cosp.geometry.grids import PixelGrid
from cosp.imaging.resampling import sample
from cosp.simulation import kernels
from cosp.simulation.site import SitePlan
from cosp.simulation.terrain import GLACIER, LAKE, MODERN_EPOCH, Scenery, Terrain

_NODES_M = 600.0


def smooth_noise(size: tuple[int, int], length_cells: float, rng: np.random.Generator) -> Float32Array:
    """A Gaussian random field of unit variance with a correlation length in cells."""
    factor = max(1, int(length_cells / 4.0))
    small: Float32Array = rng.standard_normal((size[0] // factor + 3, size[1] // factor + 3)).astype(np.float32)
    sigma = length_cells / 2.0 / factor
    if sigma > 0.3:
        small = np.asarray(cv2.GaussianBlur(small, (0, 0), sigma, borderType=cv2.BORDER_REFLECT), np.float32)
        small *= np.float32(2.0 * np.sqrt(np.pi) * sigma)
    if factor == 1:
        return np.ascontiguousarray(small[: size[0], : size[1]])
    wide = cv2.resize(small, (small.shape[1] * factor, small.shape[0] * factor), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(wide[: size[0], : size[1]])


def reference_grid(plan: SitePlan, posting_m: float) -> PixelGrid:
    """Grid of a reference raster, a little inside the terrain."""
    xmin, ymin, xmax, ymax = plan.terrain_grid.bounds
    inset = 5.0 * plan.terrain_grid.step_x
    return PixelGrid.covering((xmin + inset, ymin + inset, xmax - inset, ymax - inset), posting_m)


def make_reference_dem(
    plan: SitePlan, terrain: Terrain, rng: np.random.Generator
) -> tuple[Float32Array, PixelGrid, str]:
    """Modern heights with correlated noise and a long wave, their grid and its reference system.

    The grid is the reference's own: of the site's system or of the one the settings name; NaN where terrain ends.
    """
    settings = plan.settings
    inner = reference_grid(plan, settings.reference_dem_m)
    crs, grid = plan.crs, inner
    if settings.reference_dem_crs != "auto":
        crs = settings.reference_dem_crs
        transformer = Transformer.from_crs(plan.crs, crs, always_xy=True)
        bounds = transformer.transform_bounds(*inner.bounds)
        posting = settings.reference_dem_m
        if CRS.from_user_input(crs).is_geographic:
            posting = max(1, round(posting / 30.9)) / 3600.0
        grid = PixelGrid.covering(bounds, posting)
    back = Transformer.from_crs(crs, plan.crs, always_xy=True)
    heights = np.empty(grid.shape, np.float32)
    for first in range(0, grid.shape[0], 256):
        last = min(first + 256, grid.shape[0])
        points = grid.points(np.arange(first, last)[:, None], np.arange(grid.shape[1])[None, :])
        if crs != plan.crs:
            points = np.stack(back.transform(points[..., 0], points[..., 1]), axis=-1)
        rows, columns = plan.terrain_grid.pixels(points)
        heights[first:last] = sample(terrain.modern, rows, columns, interpolation="linear", border=np.nan)
    cells = (90.0 / settings.reference_dem_m, 20e3 / settings.reference_dem_m)
    heights += np.float32(settings.reference_dem_noise_m) * smooth_noise(grid.shape, cells[0], rng)
    heights += np.float32(settings.reference_dem_long_wave_m) * smooth_noise(grid.shape, cells[1], rng)
    return heights, grid, crs


def make_reference_image(
    plan: SitePlan, scenery: Scenery, rng: np.random.Generator, *, threads: int
) -> tuple[ByteArray, PixelGrid]:
    """Modern orthoimage (uint8, 0 nowhere) through a smooth geolocation error, in the site's system."""
    settings, ground = plan.settings, plan.terrain_grid
    grid = reference_grid(plan, settings.reference_image_m)
    nodes = max(1, round(_NODES_M / settings.reference_image_m))
    size = (grid.shape[0] // nodes + 3, grid.shape[1] // nodes + 3)
    shift_east, shift_north = (
        settings.reference_image_error_m * smooth_noise(size, 6000.0 / _NODES_M, rng) for _ in range(2)
    )
    image = np.empty(grid.shape, np.uint8)
    gain = 150.0 / max(float(np.percentile(scenery.radiance[::7, ::7], 80.0)), 1.0)

    def fill(row: int) -> None:
        kernels.fill_reference(
            image, grid.x0, grid.y0, grid.step_x, row, min(row + 64, grid.shape[0]),
            scenery.radiance, scenery.strength, ground.x0, ground.y0, ground.step_x,
            shift_east, shift_north, float(nodes), settings.changed_share, 300 * MODERN_EPOCH,
            settings.seed * 7919, gain,
        )  # fmt: skip

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, range(0, grid.shape[0], 64)))
    return image, grid


def unstable_polygons(plan: SitePlan, terrain: Terrain) -> gpd.GeoDataFrame:
    """Outlines of glaciers and lakes, column `kind`, in the site's system."""
    grid = plan.terrain_grid
    factor = max(1, round(60.0 / grid.step_x))
    coarse = grid.coarsened(factor)
    records: list[dict[str, object]] = []
    for kind, code in (("glacier", GLACIER), ("lake", LAKE)):
        rows, columns = (-(-n // factor) * factor for n in grid.shape)
        padded = np.zeros((rows, columns), bool)
        padded[: grid.shape[0], : grid.shape[1]] = terrain.unstable == code
        mask = padded.reshape(rows // factor, factor, columns // factor, factor).any(axis=(1, 3))
        xmin, _, _, ymax = coarse.bounds
        transform = Affine(coarse.step_x, 0.0, xmin, 0.0, coarse.step_y, ymax)
        for outline, value in shapes(mask.astype(np.uint8), mask=mask, transform=transform):
            if value:
                records.append({"kind": kind, "geometry": shape(outline).simplify(0.6 * coarse.step_x)})
    if not records:
        return gpd.GeoDataFrame({"kind": []}, geometry=[], crs=plan.crs)
    return gpd.GeoDataFrame(records, crs=plan.crs)


def heights_at(terrain: Float32Array, grid: PixelGrid, xy: FloatArray) -> FloatArray:
    """Heights between grid points, bilinear, as the film saw them; xy (..., 2) in the grid's system."""
    rows, columns = grid.pixels(xy)
    rows = np.clip(rows, 0.0, grid.shape[0] - 1.000001)
    columns = np.clip(columns, 0.0, grid.shape[1] - 1.000001)
    r, c = rows.astype(int), columns.astype(int)
    v, u = rows - r, columns - c
    top = terrain[r, c] * (1.0 - u) + terrain[r, c + 1] * u
    bottom = terrain[r + 1, c] * (1.0 - u) + terrain[r + 1, c + 1] * u
    return np.asarray(top * (1.0 - v) + bottom * v)
