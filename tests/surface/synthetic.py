"""A fore and an aft camera over analytic terrain, and what they must see."""

from __future__ import annotations

import math

import numpy as np

from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame

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
