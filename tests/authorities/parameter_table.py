"""Camera parameters printed in table IV of [Ghuffar2022]: two KH-4B pairs over Mongolia."""

import numpy as np

from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame

# Longitude, latitude (degrees), height (km); their change (km); omega, phi, kappa; their change (degrees); V/(H delta).
# The epoch is the start of the scan. Scan direction: fore with x, aft against it.
TABLE = {
    "DS1112-1071DF023": (96.24, 44.59, 187.27, 0.06, -2.75, -0.41, -15.20, -1.56, 5.69, 0.83, -0.04, 0.00, 0.0025),
    "DS1112-1071DA029": (96.39, 43.70, 186.77, 1.20, -2.86, -0.03, 15.72, 1.46, 5.74, 0.94, -0.03, -0.23, -0.0001),
    "DS1117-2071DF008": (98.26, 44.31, 162.21, -1.53, -2.59, 0.15, -15.52, 3.71, -10.19, 0.76, -0.51, 0.33, -0.0002),
    "DS1117-2071DA014": (98.04, 43.54, 162.89, 0.41, -3.10, -0.14, 14.68, -2.25, -10.64, 1.09, -0.23, 0.02, 0.0002),
}
PAIRS = {
    "1112": ("DS1112-1071DF023", "DS1112-1071DA029"),
    "1117": ("DS1117-2071DF008", "DS1117-2071DA014"),
}
FULL_HALF_LENGTH_MM = 372.4
HALF_WIDTH_MM = 27.7
PIXEL_MM = 0.007


def camera(scene: str, origin: LocalFrame) -> PanoramicCamera:
    """A camera of the table, brought to mid-scan in a local frame."""
    row = TABLE[scene]
    change = np.array(row[3:6]) * 1000.0
    angles_change = np.array(row[9:12])
    start = origin.local_from_geodetic(np.array([row[0], row[1], row[2] * 1000.0]))
    return PanoramicCamera(
        scene=scene,
        focal_length_mm=609.6,
        half_length_mm=FULL_HALF_LENGTH_MM,
        half_width_mm=HALF_WIDTH_MM,
        scan_direction=1 if scene[12] == "F" else -1,
        origin=origin,
        position_m=tuple((start + change / 2).tolist()),
        position_change_m=tuple(change.tolist()),
        angles_deg=tuple((np.array(row[6:9]) + angles_change / 2).tolist()),
        angles_change_deg=tuple(angles_change.tolist()),
        imc_factor=row[12],
    )


def pair(name: str) -> tuple[PanoramicCamera, PanoramicCamera]:
    """Fore and aft camera of a pair in a frame between them."""
    fore, aft = PAIRS[name]
    origin = LocalFrame((TABLE[fore][0] + TABLE[aft][0]) / 2, (TABLE[fore][1] + TABLE[aft][1]) / 2)
    return camera(fore, origin), camera(aft, origin)


def film_points(half_length_mm: float, half_width_mm: float, columns: int = 41, rows: int = 7) -> np.ndarray:
    """A lattice over a film, (columns * rows, 2) in mm."""
    x, y = np.meshgrid(
        np.linspace(-half_length_mm, half_length_mm, columns), np.linspace(-half_width_mm, half_width_mm, rows)
    )
    return np.column_stack([x.ravel(), y.ravel()])
