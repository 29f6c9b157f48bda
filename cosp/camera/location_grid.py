"""Location grids: where points of an image lie on the ground, tabulated at several heights."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from cosp.arrays import FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.grids import PixelGrid


@dataclass(frozen=True)
class LocationGrid:
    """Longitudes and latitudes at nodes every so many pixels and every so many metres of height.

    Between nodes programs interpolate linearly. Image positions are counted from the outer corner of the first pixel,
    whose centre is at one half; node (0, 0) is that corner.

    Parameters
    ----------
    step_px : two ints
        Between nodes, along columns and along rows.
    heights_m : (K,) array, m
        Ellipsoidal heights, rising.
    lonlat_deg : (K, 2, R, C) array, degrees
    """

    step_px: tuple[int, int]
    heights_m: FloatArray
    lonlat_deg: FloatArray

    def locate(self, pixels: FloatArray, height_m: FloatArray) -> FloatArray:
        """Longitude, latitude and height (N, 3) of columns and rows (N, 2), counted from the first pixel's centre.

        Linear between nodes and beyond them.
        """
        _, _, rows, columns = self.lonlat_deg.shape
        nodes = (self.heights_m, np.arange(rows) * self.step_px[1], np.arange(columns) * self.step_px[0])
        table = RegularGridInterpolator(nodes, np.moveaxis(self.lonlat_deg, 1, -1), bounds_error=False, fill_value=None)
        corner = np.asarray(pixels) + 0.5
        return np.column_stack([table(np.column_stack([height_m, corner[:, 1], corner[:, 0]])), height_m])

    def bands(self) -> FloatArray:
        """Longitudes and latitudes of one height after the other, (2 K, R, C)."""
        return self.lonlat_deg.reshape(-1, *self.lonlat_deg.shape[2:])

    def tags(self) -> dict[str, str]:
        """The height of every band and the reference system, as its readers look for them."""
        heights = {f"ALTITUDE_B{band}": repr(float(self.heights_m[band // 2])) for band in range(len(self.bands()))}
        return {**heights, "REF": "EPSG:4326"}


def location_grid(
    camera: PanoramicCamera,
    grid: PixelGrid,
    *,
    heights_m: tuple[float, float],
    step_mm: float,
    height_step_m: float,
) -> LocationGrid:
    """The location grid of an image of a film.

    Linear interpolation leaves an error that grows with the square of a step.

    Parameters
    ----------
    camera : PanoramicCamera
    grid : PixelGrid
        Image of the film, mm.
    heights_m : lowest and highest
        Ellipsoidal heights that the grid encloses.
    step_mm : float
        Largest distance of nodes on the film.
    height_step_m : float
        Largest distance of nodes in height.
    """
    step_px = (max(1, int(step_mm / abs(grid.step_x))), max(1, int(step_mm / abs(grid.step_y))))
    levels = max(2, 1 + math.ceil((heights_m[1] - heights_m[0]) / height_step_m))
    rows, columns = (
        np.arange(1 + math.ceil(size / step)) * step - 0.5 for size, step in zip(grid.shape, step_px[::-1], strict=True)
    )
    film_mm = grid.points(rows[:, None], columns[None, :])
    heights = np.linspace(*heights_m, levels)
    lonlat = np.stack([camera.locate_geodetic(film_mm, float(height))[..., :2] for height in heights])
    # No jump of a turn inside, which interpolation would smear.
    lonlat[..., 0] -= 360.0 * np.round((lonlat[..., 0] - lonlat[0, 0, 0, 0]) / 360.0)
    return LocationGrid(step_px, heights, np.moveaxis(lonlat, -1, 1))


def residuals_px(
    located: LocationGrid, camera: PanoramicCamera, grid: PixelGrid, film_mm: FloatArray, height_m: FloatArray
) -> FloatArray:
    """Columns and rows at which the camera sees what the grid locates, minus those asked for, (N, 2).

    Parameters
    ----------
    located, camera : LocationGrid, PanoramicCamera
    grid : PixelGrid
        Image of the film, mm.
    film_mm, height_m : (N, 2) array, mm; (N,) array, m
    """
    rows, columns = grid.pixels(film_mm)
    lonlath = located.locate(np.stack([columns, rows], axis=-1), height_m)
    return (camera.project_geodetic(lonlath) - film_mm) / [grid.step_x, grid.step_y]
