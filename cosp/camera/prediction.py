"""First camera of a scene, from its archive corners and the facts of its mission."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares

from cosp.arrays import FloatArray
from cosp.camera.missions import (
    FOCAL_LENGTH_MM,
    GROUND_SPEED_KM_PER_SCAN,
    SCAN_DEG,
    SCAN_SECONDS,
    TILT_DEG,
    Mission,
)
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
from cosp.geometry.rotations import angles_from_matrix, rotation_matrix

EARTH_RADIUS_M = 6_371_000.0
EARTH_ROTATION_RAD_PER_S = 7.292115e-5
# What separates a corner of the archive from where the film really ends, once the common shift is gone, and how far a
# mission's height is from its nominal one. Only their ratio matters: corners correct the height, but not beyond belief.
CORNER_SIGMA_MM = 15.0
HEIGHT_SIGMA_M = 10_000.0
HEIGHT_LIMITS_M = (120_000.0, 400_000.0)


@dataclass(frozen=True)
class Corners:
    """Archive corners of a scene: longitude and latitude in degrees.

    Parameters
    ----------
    nw, ne, se, sw : two floats each
    """

    nw: tuple[float, float]
    ne: tuple[float, float]
    se: tuple[float, float]
    sw: tuple[float, float]

    def lonlat(self) -> FloatArray:
        """The corners in the order NW, NE, SE, SW, (4, 2) in degrees."""
        return np.array([self.nw, self.ne, self.se, self.sw], dtype=float)


def block_origin(corners: list[Corners]) -> LocalFrame:
    """Local frame at the middle of the corners of one or several scenes, on the ellipsoid.

    The mean is taken of directions, so that it holds across the date line too.
    """
    lon, lat = np.radians(np.concatenate([scene.lonlat() for scene in corners])).T
    x, y, z = np.mean([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    return LocalFrame(math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y))))


def predict_camera(
    scene: str,
    corners: Corners,
    *,
    mission: Mission,
    look: Literal["fore", "aft"],
    descending: bool,
    half_length_mm: float,
    half_width_mm: float,
    ground_height_m: float = 0.0,
) -> PanoramicCamera:
    """Camera with the mission's nominal attitude and motion, placed so that it sees the archive corners.

    Position, kappa and, within belief, the height are fitted to the four corners; tilt, velocity, attitude rates and
    image motion compensation are the mission's. Time is taken to run with x in the fore and against x in the
    aft camera, which scan in opposite directions; the adjustment tries both.

    Parameters
    ----------
    scene : str
    corners : Corners
    mission : Mission
    look : "fore" or "aft"
        The fore camera looks along the flight.
    descending : bool
        Flight towards the south: x of the film points to the east.
    half_length_mm, half_width_mm : float
        Half the usable film, to whose corners the archive's are taken to belong.
    ground_height_m : float
        Ellipsoidal height of the ground at the corners.

    Returns
    -------
    PanoramicCamera
        In the local frame of `block_origin([corners])`.

    References
    ----------
    [Ghuffar2022] section III.B; nominal rates as in docs/conventions.md.
    """
    origin = block_origin([corners])
    lonlath = np.column_stack([corners.lonlat(), np.full(4, ground_height_m)])
    ground = origin.local_from_geodetic(lonlath)
    # NW, NE, SE, SW on the film of a descending pass; an ascending one flies the other way and turns the film.
    film = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * [half_length_mm, half_width_mm]
    if not descending:
        film = -film
    nominal_height_m = mission.nominal_height_km * 1000.0
    along_film = ground[np.argsort(film[:, 0])]
    east, north, _ = along_film[2:].mean(0) - along_film[:2].mean(0)
    kappa = math.atan2(north, east)

    def camera_of(unknowns: FloatArray) -> PanoramicCamera:
        shift_east_m, shift_north_m, height_m, kappa = (float(value) for value in unknowns)
        camera = _nominal_camera(
            scene, origin, (half_length_mm, half_width_mm), mission=mission, look=look, kappa=kappa, height_m=height_m
        )
        p = camera.parameters()
        p[0:2] += [shift_east_m, shift_north_m]
        return camera.with_parameters(p)

    def misfit(unknowns: FloatArray) -> FloatArray:
        # Compared on the ground at the corner heights: there every film point has an answer, wherever the camera is.
        camera = camera_of(unknowns)
        metres_per_mm = unknowns[2] / FOCAL_LENGTH_MM
        seen = camera.locate(film, ground_height_m)[:, :2]
        height = (unknowns[2] - nominal_height_m) / HEIGHT_SIGMA_M
        return np.append(((seen - ground[:, :2]) / (metres_per_mm * CORNER_SIGMA_MM)).ravel(), height)

    fit = least_squares(
        misfit,
        [0.0, 0.0, nominal_height_m, kappa],
        x_scale=[1e4, 1e4, 1e4, 0.1],
        bounds=([-np.inf, -np.inf, HEIGHT_LIMITS_M[0], -np.inf], [np.inf, np.inf, HEIGHT_LIMITS_M[1], np.inf]),
    )
    return camera_of(fit.x)


def _nominal_camera(
    scene: str,
    origin: LocalFrame,
    half_size_mm: tuple[float, float],
    *,
    mission: Mission,
    look: Literal["fore", "aft"],
    kappa: float,
    height_m: float,
) -> PanoramicCamera:
    """Camera whose middle ray meets the origin, flying along -y of a film turned by kappa."""
    tilt = math.radians(TILT_DEG)
    forward = 1.0 if look == "fore" else -1.0
    flight = np.array([math.sin(kappa), -math.cos(kappa), 0.0])
    distance = height_m * math.tan(tilt)
    # The camera's own vertical is not the origin's: the Earth has curved away below it.
    looking = -forward * (tilt + distance / EARTH_RADIUS_M)
    motion_m = GROUND_SPEED_KM_PER_SCAN * 1000.0
    radius = EARTH_RADIUS_M + height_m
    turning_m = EARTH_ROTATION_RAD_PER_S * radius * math.cos(math.radians(origin.latitude_deg)) * SCAN_SECONDS
    nodding = mission.compensation == "nodding"
    pitch_rate = motion_m * math.cos(tilt) ** 2 / height_m
    # The tilt is about the camera's own x axis, after kappa: omega, phi, kappa of the product carry a phi too.
    heading = rotation_matrix(np.array([0.0, 0.0, kappa]))
    nod = pitch_rate * np.array([-0.5, 0.0, 0.5]) if nodding else np.zeros(3)
    pitch = np.stack([looking + nod, np.zeros(3), np.zeros(3)], axis=1)
    angles = angles_from_matrix(rotation_matrix(pitch) @ heading)
    angles_change = np.angle(np.exp(1j * (angles[2] - angles[0])))
    position = -forward * distance * flight + [0.0, 0.0, height_m]
    change = motion_m * flight - [turning_m, 0.0, 0.0]
    return PanoramicCamera(
        scene=scene,
        focal_length_mm=FOCAL_LENGTH_MM,
        half_length_mm=half_size_mm[0],
        half_width_mm=half_size_mm[1],
        scan_direction=1 if look == "fore" else -1,
        origin=origin,
        position_m=(float(position[0]), float(position[1]), float(position[2])),
        position_change_m=(float(change[0]), float(change[1]), float(change[2])),
        angles_deg=_degrees(angles[1]),
        angles_change_deg=_degrees(angles_change),
        imc_factor=0.0 if nodding else motion_m / (height_m * math.radians(SCAN_DEG)),
    )


def _degrees(angles_rad: FloatArray) -> tuple[float, float, float]:
    omega, phi, kappa = np.degrees(angles_rad)
    return float(omega), float(phi), float(kappa)
