"""Shaded relief: what stands in for a reference image where there is none."""

from __future__ import annotations

import math
from datetime import date
from typing import NamedTuple

import cv2
import numpy as np

from cosp.arrays import Float32Array, FloatArray
from cosp.geometry.grids import PixelGrid
from cosp.matching.ground import OnGrid

_SUN_ELEVATION_DEG = 35.0
# Suns closer than this show much the same relief; a camera takes no pictures of ground on which the sun stands lower.
_SUN_STEP_DEG = 30.0
_LOWEST_SUN_DEG = 8.0
_HOUR_STEP = 0.25
_OBLIQUITY_DEG = 23.44
# What matches with relief are good for, in pixels of the relief, once their neighbours agree: low scores come of ground
# cover that the relief does not hold, which lowers the peak more than it moves it.
_SIGMA_LIMITS_PX = (0.3, 0.5)


class Sun(NamedTuple):
    """Where the sun stands, degrees; the azimuth from north over east."""

    azimuth_deg: float
    elevation_deg: float


def hillshade(
    heights_m: Float32Array, posting_m: float, azimuth_deg: float, elevation_deg: float = _SUN_ELEVATION_DEG
) -> Float32Array:
    """Brightness of a north-up height grid under the sun, 0 to 255; NaN beside gaps."""
    north_slope, east_slope = np.gradient(heights_m.astype(np.float32), posting_m)
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    towards_east, towards_north = np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation)
    # Rows run south, so the gradient along rows is minus the slope towards north.
    light = np.sin(elevation) - east_slope * towards_east + north_slope * towards_north
    light /= np.sqrt(1 + north_slope**2 + east_slope**2)
    return np.asarray(255 * np.maximum(light, 0), np.float32)


def relief_reference(heights_on: OnGrid, azimuth_deg: float, elevation_deg: float = _SUN_ELEVATION_DEG) -> OnGrid:
    """A reference that is the shaded relief of an elevation model."""

    def on_grid(grid: PixelGrid) -> Float32Array:
        rows, columns = grid.shape
        heights = heights_on(grid.window(-1, rows + 1, -1, columns + 1))
        return hillshade(heights, grid.step_x, azimuth_deg, elevation_deg)[1:-1, 1:-1]

    return on_grid


def convexity_reference(heights_on: OnGrid) -> OnGrid:
    """A reference that is bright on the crests of an elevation model and dark in its valleys, whatever the sun.

    Light changes where the slope does, so that the lines of shaded relief under any sun run along crests and valleys:
    what places a film before its sun is known.
    """

    def on_grid(grid: PixelGrid) -> Float32Array:
        smooth = cv2.GaussianBlur(heights_on(grid), (0, 0), 1.0)
        return np.asarray(-cv2.Laplacian(smooth, cv2.CV_32F), np.float32)

    return on_grid


def suns(day: date | None, latitude_deg: float) -> list[Sun]:
    """Suns whose relief has to be tried: those of the day's arc, or of every direction where the day is not known.

    Opposite suns at some height give near negatives of one another, which gradient orientation modulo 180 degrees does
    not tell apart, so that half the circle is enough.
    """
    if day is None:
        steps = round(180.0 / _SUN_STEP_DEG)
        return [Sun(180.0 - i * _SUN_STEP_DEG, _SUN_ELEVATION_DEG) for i in range(steps)]
    found: list[Sun] = []
    # From noon outwards, as most pictures were taken near it.
    for hour in sorted(np.arange(4.0, 20.0 + _HOUR_STEP, _HOUR_STEP), key=lambda h: abs(h - 12.0)):
        sun = sun_at(day, float(hour), latitude_deg)
        apart = [abs((sun.azimuth_deg - other.azimuth_deg + 90.0) % 180.0 - 90.0) for other in found]
        if sun.elevation_deg >= _LOWEST_SUN_DEG and min(apart, default=180.0) >= _SUN_STEP_DEG - 1e-9:
            found.append(sun)
    return found or suns(None, latitude_deg)


def sun_at(day: date, solar_hour: float, latitude_deg: float) -> Sun:
    """Where the sun stands at a local solar time, to about half a degree: declination of a circular orbit."""
    since_equinox = (day - date(day.year, 3, 21)).days
    longitude = math.radians(since_equinox * 360.0 / 365.25)
    polar = math.sin(math.radians(_OBLIQUITY_DEG)) * math.sin(longitude)  # sine of the declination
    equatorial = math.sqrt(1 - polar**2)
    hour_angle = math.radians(15.0 * (solar_hour - 12.0))
    latitude = math.radians(latitude_deg)
    outward = equatorial * math.cos(hour_angle)
    east = -equatorial * math.sin(hour_angle)
    north = math.cos(latitude) * polar - math.sin(latitude) * outward
    up = math.sin(latitude) * polar + math.cos(latitude) * outward
    return Sun(math.degrees(math.atan2(east, north)) % 360.0, math.degrees(math.asin(up)))


def relief_sigma_m(sigma_m: FloatArray, posting_m: float) -> FloatArray:
    """Standard deviations of matches with shaded relief of a posting, from those that their scores alone say."""
    low, high = _SIGMA_LIMITS_PX
    return np.asarray(np.clip(sigma_m, low * posting_m, high * posting_m))
