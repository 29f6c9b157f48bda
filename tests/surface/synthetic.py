"""A fore and an aft camera over analytic terrain, and what they must see."""

from __future__ import annotations

import math

import numpy as np

from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
from cosp.imaging.windows import Window
from cosp.surface.intersection import RayTable, nodes_over, tabulate_rays

ORIGIN = LocalFrame(11.2, 47.3)
HEIGHT_M = 170e3
BASE_M = HEIGHT_M * math.tan(math.radians(15))


def camera(look: str, *, half_length_mm: float = 357.5, half_width_mm: float = 27.7) -> PanoramicCamera:
    sign = 1 if look == "fore" else -1
    return PanoramicCamera(
        scene="DS1104-2169DF092" if look == "fore" else "DS1104-2169DA098",
        focal_length_mm=609.6,
        half_length_mm=half_length_mm,
        half_width_mm=half_width_mm,
        scan_direction=sign,
        origin=ORIGIN,
        position_m=(sign * 250.0, sign * BASE_M, HEIGHT_M),
        position_change_m=(100.0, -2770.0, -50.0),
        angles_deg=(-15.0 * sign, 0.5, 0.3 * sign),
        angles_change_deg=(0.85, -0.05, 0.01),
        imc_factor=2e-4,
    )


def terrain_m(easting, northing):
    """Hills of a few hundred metres over some kilometres, in any frame whose x and y are metres."""
    return (
        1500.0
        + 300.0 * np.sin(easting / 1900.0) * np.cos(northing / 1500.0)
        + 150.0 * np.sin(easting / 800.0 + northing / 700.0)
    )


def texture(easting, northing):
    """Grey values of the ground, smooth over some hundred metres."""
    return 128 + 50 * np.sin(easting / 130.0) * np.sin(northing / 150.0) + 30 * np.cos((easting - northing) / 310.0)


PIXEL_MM = 0.007
LARGEST_ERROR_RAD = 2e-7  # a fiftieth of that pixel


def film_of(place):
    """Film points in mm of (column, row) of an image whose rows run across the film and whose row 0 is mid-scan."""
    return place[..., ::-1] * PIXEL_MM


def ray_table(seen_by, *, rows=(-52_000, 52_000), columns=(-4200, 4200), spacing_px=42.0) -> RayTable:
    """Rays of a camera over such an image of its film."""
    nodes = nodes_over((columns[0], rows[0]), (columns[1], rows[1]), spacing_px=spacing_px)
    return tabulate_rays(lambda place: seen_by.rays(film_of(place)), nodes, largest_error_rad=LARGEST_ERROR_RAD)


def conjugate_pixels(fore, aft, window: Window, height_m):
    """Ground points of the fore pixels of a window at heights, and the disparity and y-parallax of the aft pixels."""
    place = np.stack(
        np.meshgrid(
            np.arange(window.column0, window.column1, dtype=float), np.arange(window.row0, window.row1, dtype=float)
        ),
        axis=-1,
    )
    ground_m = fore.locate(film_of(place), height_m)
    moved = aft.project(ground_m)[..., ::-1] / PIXEL_MM - place
    return ground_m, moved[..., 0], moved[..., 1]
