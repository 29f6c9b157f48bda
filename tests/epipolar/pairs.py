"""The stereo pairs of the paper's parameter table, and pairs made from them."""

from __future__ import annotations

import functools
from dataclasses import replace

import cv2
import numpy as np

from cosp.camera.panoramic import PanoramicCamera
from cosp.epipolar.correspondences import FilmMapping, virtual_conjugates
from cosp.epipolar.polynomials import Basis
from cosp.epipolar.rectification import fit_rectification
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid

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
    """A camera as two functions, whatever lies in them; `FilmMapping.of` keeps a film field apart."""
    return FilmMapping(camera.locate, camera.project, camera.half_length_mm, camera.half_width_mm)


SEPARABLE = Basis(3, 9)
FILM_PIXEL_MM = 0.14


@functools.cache
def rectified(
    fore,
    aft,
    *,
    heights=(0.0, 1000.0, 2000.0, 3000.0),
    pixel_mm=0.007,
    basis=SEPARABLE,
    margin_px=0.0,
    film_of=mapping,
):
    """Conjugate points of a pair of cameras and their rectification."""
    films = (film_of(fore), film_of(aft))
    conjugates = virtual_conjugates(*films, np.array(heights), even=basis.total)
    return conjugates, fit_rectification(
        conjugates, films, pixel_mm=pixel_mm, basis=basis, disparity_margin_px=margin_px
    )


def film_grid(camera):
    shape = (round(2 * camera.half_width_mm / FILM_PIXEL_MM), round(2 * camera.half_length_mm / FILM_PIXEL_MM))
    return PixelGrid(
        -(shape[1] - 1) / 2 * FILM_PIXEL_MM, (shape[0] - 1) / 2 * FILM_PIXEL_MM, FILM_PIXEL_MM, -FILM_PIXEL_MM, shape
    )


def distortion_mm(film_mm):
    """What the aft film is displaced by along the scan: 1.5 px rms, changing over some centimetres."""
    x, y = film_mm[..., 0], film_mm[..., 1]
    along = 2.0 * FILM_PIXEL_MM * np.sin(x / 11.0 + 0.4) * np.cos(y / 26.0)
    return np.stack([along + 0.5 * FILM_PIXEL_MM, np.zeros_like(along)], axis=-1)


@functools.cache
def distorted_pair():
    """Cameras, rectification, and films of level textured ground at 1200 m, the aft one distorted."""
    rng = np.random.default_rng(11)
    fore, aft = (replace(camera, half_length_mm=35.0) for camera in table_pair("1112"))
    _, rectification = rectified(fore, aft, pixel_mm=FILM_PIXEL_MM)
    texture = sum(
        cv2.GaussianBlur(rng.standard_normal((1600, 1600)).astype(np.float32), (0, 0), s) * s for s in (1.2, 3.0, 9.0)
    )
    texture *= 35 / texture.std()
    middle = fore.locate(np.zeros(2), 1200.0)[:2]
    films = []
    for camera, displacement in ((fore, 0.0), (aft, distortion_mm)):
        grid = film_grid(camera)
        imaged = grid.centres() if displacement == 0.0 else grid.centres() - displacement(grid.centres())
        ground = (camera.locate(imaged, 1200.0)[..., :2] - middle) / 45.0 + 800  # texture of 45 m
        grey = cv2.remap(texture, *(ground[..., k].astype(np.float32) for k in (0, 1)), cv2.INTER_CUBIC)
        films.append(np.clip(125 + grey + rng.normal(0, 2, grid.shape), 1, 255).astype(np.uint8))
    return (fore, aft), rectification, films
