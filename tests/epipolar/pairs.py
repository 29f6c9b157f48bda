"""The stereo pairs of the paper's parameter table, and pairs made from them."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from cosp.camera.panoramic import PanoramicCamera
from cosp.epipolar.correspondences import FilmMapping, virtual_conjugates
from cosp.epipolar.polynomials import Basis
from cosp.epipolar.rectification import fit_rectification
from cosp.geometry.frames import LocalFrame

# [Ghuffar2022] table of estimated parameters: longitude, latitude (degrees), height (km); changes (km); angles and
# changes (degrees); IMC factor. The values are those at the start of the scan.
TABLE = {
    "1112 fore": (96.24, 44.59, 187.27, 0.06, -2.75, -0.41, -15.20, -1.56, 5.69, 0.83, -0.04, 0.00, 0.0025),
    "1112 aft": (96.39, 43.70, 186.77, 1.20, -2.86, -0.03, 15.72, 1.46, 5.74, 0.94, -0.03, -0.23, -0.0001),
    "1117 fore": (98.26, 44.31, 162.21, -1.53, -2.59, 0.15, -15.52, 3.71, -10.19, 0.76, -0.51, 0.33, -0.0002),
    "1117 aft": (98.04, 43.54, 162.89, 0.41, -3.10, -0.14, 14.68, -2.25, -10.64, 1.09, -0.23, 0.02, 0.0002),
}


def table_camera(name, scan_direction):
    """Camera of the table in the common local frame of its pair."""
    values = np.array(TABLE[name])
    mission = name.split()[0]
    middle = (np.array(TABLE[f"{mission} fore"][:2]) + np.array(TABLE[f"{mission} aft"][:2])) / 2
    origin = LocalFrame(float(middle[0]), float(middle[1]), 0.0)
    local = origin.local_from_geodetic(np.array([values[0], values[1], values[2] * 1000]))
    change = values[3:6] * 1000
    centre = local + change / 2
    angles = values[6:9] + values[9:12] / 2
    return PanoramicCamera(
        scene=name,
        focal_length_mm=609.6,
        half_length_mm=357.4,
        half_width_mm=27.7,
        scan_direction=scan_direction,
        origin=origin,
        position_m=tuple(centre.tolist()),
        position_change_m=tuple(change.tolist()),
        angles_deg=tuple(angles.tolist()),
        angles_change_deg=tuple(values[9:12].tolist()),
        imc_factor=float(values[12]),
    )


@functools.cache
def table_pair(mission):
    """Fore and aft camera of a mission; they scan in opposite directions."""
    return table_camera(f"{mission} fore", 1), table_camera(f"{mission} aft", -1)


def ascending(camera):
    """The camera on a satellite that flies north: the world turned by 180 degrees about the vertical."""
    x, y, z = camera.position_m
    dx, dy, dz = camera.position_change_m
    omega, phi, kappa = camera.angles_deg
    omega_change, phi_change, kappa_change = camera.angles_change_deg
    return replace(
        camera,
        position_m=(-x, -y, z),
        position_change_m=(-dx, -dy, dz),
        # R(omega, phi, kappa) diag(-1, -1, 1) = R(-omega, -phi, kappa + 180)
        angles_deg=(-omega, -phi, kappa + 180.0),
        angles_change_deg=(-omega_change, -phi_change, kappa_change),
    )


def mapping(camera):
    return FilmMapping(camera.locate, camera.project, camera.half_length_mm, camera.half_width_mm)


SEPARABLE = Basis(3, 9)


@functools.cache
def rectified(fore, aft, *, heights=(0.0, 1000.0, 2000.0, 3000.0), pixel_mm=0.007, basis=SEPARABLE, margin_px=0.0):
    """Conjugate points of a pair of cameras and their rectification."""
    films = (mapping(fore), mapping(aft))
    conjugates = virtual_conjugates(*films, np.array(heights))
    return conjugates, fit_rectification(
        conjugates, films, pixel_mm=pixel_mm, basis=basis, disparity_margin_px=margin_px
    )
