"""Where the satellite is and how the camera points through a scan, from physics.

A circular orbit in an inertial frame that coincides with the Earth-fixed one at time zero; the Earth turns below.
The camera hangs in the orbital frame (flight, nadir), tilted forwards or backwards, with small errors and rates.
Axes of the camera: x along the scan, y against the flight, z away from the ground.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pyproj import Transformer

from cosp.arrays import FloatArray

GRAVITY_M3_S2 = 3.986004418e14
EARTH_RATE_RAD_S = 7.292115e-5
FOCAL_LENGTH_MM = 609.6
SCAN_ANGLE_RAD = float(np.radians(70.0))
SCAN_TIME_S = 0.365
HALF_LENGTH_MM = FOCAL_LENGTH_MM * SCAN_ANGLE_RAD / 2.0
HALF_WIDTH_MM = 55.4 / 2.0
FILM_HALF_WIDTH_MM = 35.0
TILT_RAD = float(np.radians(15.0))

_ECEF_FROM_GEODETIC = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def ecef_from_geodetic(lonlath: FloatArray) -> FloatArray:
    """Earth-centred coordinates in metres of longitude, latitude (degrees) and ellipsoidal height, shape (..., 3)."""
    lonlath = np.asarray(lonlath, dtype=float)
    return np.stack(_ECEF_FROM_GEODETIC.transform(lonlath[..., 0], lonlath[..., 1], lonlath[..., 2]), axis=-1)


def geodetic_from_ecef(xyz: FloatArray) -> FloatArray:
    """Longitude, latitude (degrees) and ellipsoidal height of Earth-centred points, shape (..., 3)."""
    xyz = np.asarray(xyz, dtype=float)
    return np.stack(_ECEF_FROM_GEODETIC.transform(xyz[..., 0], xyz[..., 1], xyz[..., 2], direction="INVERSE"), axis=-1)


def _about(axis: int, angle: FloatArray) -> FloatArray:
    """Matrices that turn the frame (not the vector) by `angle` about one of its axes, shape (..., 3, 3)."""
    angle = np.asarray(angle, dtype=float)
    c, s = np.cos(angle), np.sin(angle)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((*angle.shape, 3, 3))
    matrix[..., axis, axis] = 1.0
    matrix[..., first, first] = c
    matrix[..., second, second] = c
    matrix[..., first, second] = s
    matrix[..., second, first] = -s
    return matrix


@dataclass(frozen=True)
class Orbit:
    """A circular orbit: radius, two inertial unit vectors (to the satellite at time zero, and of its motion)."""

    radius_m: float
    radial: FloatArray
    forward: FloatArray

    @property
    def rate_rad_s(self) -> float:
        """Angular rate in inertial space."""
        return float(np.sqrt(GRAVITY_M3_S2 / self.radius_m**3))

    @property
    def speed_m_s(self) -> float:
        """Speed in inertial space, about 7.8 km/s."""
        return self.rate_rad_s * self.radius_m

    def position(self, time_s: FloatArray) -> FloatArray:
        """Earth-fixed position in metres, shape (..., 3)."""
        angle = self.rate_rad_s * np.asarray(time_s)[..., None]
        inertial = self.radius_m * (np.cos(angle) * self.radial + np.sin(angle) * self.forward)
        turn = _about(2, EARTH_RATE_RAD_S * np.asarray(time_s))
        return np.asarray(np.einsum("...ij,...j->...i", turn, inertial))

    def axes(self, time_s: FloatArray) -> FloatArray:
        """Rows x, y, z of the orbital frame (right-hand side, against the flight, up) in Earth-fixed axes."""
        angle = self.rate_rad_s * np.asarray(time_s)[..., None]
        up = np.cos(angle) * self.radial + np.sin(angle) * self.forward
        backwards = np.sin(angle) * self.radial - np.cos(angle) * self.forward
        inertial = np.stack([np.cross(backwards, up), backwards, up], axis=-2)
        turn = _about(2, EARTH_RATE_RAD_S * np.asarray(time_s))
        return np.asarray(np.einsum("...ij,...kj->...ki", turn, inertial))


def orbit_over(
    longitude_deg: float, latitude_deg: float, *, altitude_m: float, inclination_deg: float, descending: bool
) -> Orbit:
    """Circular orbit whose satellite stands above a place at time zero."""
    place = ecef_from_geodetic(np.array([longitude_deg, latitude_deg, altitude_m]))
    radius = float(np.linalg.norm(place))
    radial = place / radius
    latitude = np.arcsin(radial[2])
    azimuth = np.arcsin(np.clip(np.cos(np.radians(inclination_deg)) / np.cos(latitude), -1.0, 1.0))
    if descending:
        azimuth = np.pi - azimuth
    east = np.cross([0.0, 0.0, 1.0], radial)
    east /= np.linalg.norm(east)
    north = np.cross(radial, east)
    return Orbit(radius, radial, np.sin(azimuth) * east + np.cos(azimuth) * north)


@dataclass(frozen=True)
class Exposure:
    """One panoramic exposure in the making: what moves, and how, around the middle of the scan.

    Angles about the camera's x, y and z axes. `wobble_rad` (3, n) are amplitudes of n harmonics and `wobble_phase`
    their phases: what no linear time model can follow.
    """

    orbit: Orbit
    middle_s: float
    scan_direction: int
    tilt_rad: float
    offsets_rad: FloatArray
    rates_rad_s: FloatArray
    wobble_rad: FloatArray
    wobble_phase: FloatArray
    nodding_rad_s: float
    lens_rate_mm_s: float

    def angles(self, time_s: FloatArray) -> FloatArray:
        """Attitude about x, y, z relative to the orbital frame, time from mid-scan, shape (..., 3)."""
        time_s = np.asarray(time_s, dtype=float)
        angles = self.offsets_rad + time_s[..., None] * self.rates_rad_s
        for harmonic in range(self.wobble_rad.shape[1]):
            phase = (harmonic + 1.5) * 2.0 * np.pi * time_s[..., None] / SCAN_TIME_S + self.wobble_phase[:, harmonic]
            angles = angles + self.wobble_rad[:, harmonic] * np.sin(phase)
        angles[..., 0] += self.tilt_rad + self.nodding_rad_s * time_s
        return angles

    def position(self, time_s: FloatArray) -> FloatArray:
        """Earth-fixed position of the lens in metres, time from mid-scan."""
        return self.orbit.position(self.middle_s + np.asarray(time_s))

    def rotation(self, time_s: FloatArray) -> FloatArray:
        """Rotation from Earth-fixed axes to those of the camera, shape (..., 3, 3)."""
        angles = self.angles(time_s)
        attitude = _about(2, angles[..., 2]) @ _about(1, angles[..., 1]) @ _about(0, angles[..., 0])
        return attitude @ self.orbit.axes(self.middle_s + np.asarray(time_s))

    def time(self, x_mm: FloatArray) -> FloatArray:
        """Seconds from mid-scan at which a film column is exposed."""
        return self.scan_direction * np.asarray(x_mm) / (2.0 * HALF_LENGTH_MM) * SCAN_TIME_S

    def lens_shift_mm(self, time_s: FloatArray) -> FloatArray:
        """Displacement of the lens against the film along y, driven by a cam on the scan arm."""
        rate = SCAN_ANGLE_RAD / SCAN_TIME_S
        return np.asarray(self.lens_rate_mm_s / rate * np.sin(rate * np.asarray(time_s)))

    def rays(self, film_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Origins (m) and unit directions, Earth-fixed, of the rays through ideal film points (..., 2) in mm."""
        film_mm = np.asarray(film_mm, dtype=float)
        time_s = self.time(film_mm[..., 0])
        alpha = film_mm[..., 0] / FOCAL_LENGTH_MM
        inner = np.stack(
            [
                FOCAL_LENGTH_MM * np.sin(alpha),
                film_mm[..., 1] + self.lens_shift_mm(time_s),
                -FOCAL_LENGTH_MM * np.cos(alpha),
            ],
            axis=-1,
        )
        outer = np.einsum("...ji,...j->...i", self.rotation(time_s), inner)
        return self.position(time_s), outer / np.linalg.norm(outer, axis=-1, keepdims=True)

    def _image(self, ground: FloatArray, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scan angle and y (mm) at which an open camera would see Earth-fixed points at given times."""
        seen = np.einsum("...ij,...j->...i", self.rotation(time_s), ground - self.position(time_s))
        seen[..., 2] = np.where(seen[..., 2] < 0.0, seen[..., 2], np.nan)
        alpha = np.arctan2(seen[..., 0], -seen[..., 2])
        height = -seen[..., 2] / np.cos(alpha)
        return alpha, FOCAL_LENGTH_MM * seen[..., 1] / height - self.lens_shift_mm(time_s)

    def drift_mm_s(self, ground: FloatArray, time_s: FloatArray) -> FloatArray:
        """Motion along y of ground points on the film while the slit is open at `time_s`; what compensation cancels."""
        step = 1e-4
        time_s = np.asarray(time_s, dtype=float)
        return (self._image(ground, time_s + step)[1] - self._image(ground, time_s - step)[1]) / (2.0 * step)

    def film_from_ground(self, ground: FloatArray) -> FloatArray:
        """Ideal film point (..., 2) in mm of Earth-fixed points (..., 3); NaN behind the camera or off the scan.

        The moment at which the sweeping slit meets the point is a root (secant) of scan angle minus slit angle.
        """
        ground = np.asarray(ground, dtype=float)
        rate = self.scan_direction * SCAN_ANGLE_RAD / SCAN_TIME_S
        earlier: FloatArray = np.zeros(ground.shape[:-1])
        earlier_miss = self._image(ground, earlier)[0]
        time_s = earlier_miss / rate
        for _ in range(12):
            miss = self._image(ground, time_s)[0] - rate * time_s
            change = np.where(miss == earlier_miss, 1.0, miss - earlier_miss)
            following = time_s - np.where(miss == earlier_miss, 0.0, miss * (time_s - earlier) / change)
            earlier, earlier_miss, time_s = time_s, miss, following
            if np.nan_to_num(np.abs(miss)).max(initial=0.0) < 1e-14:
                break
        alpha, y_mm = self._image(ground, time_s)
        film = np.stack([FOCAL_LENGTH_MM * alpha, y_mm], axis=-1)
        # Beyond these the numbers are those of another revolution of the lens, not of this film.
        seen = (np.abs(film[..., 0]) < 1.15 * HALF_LENGTH_MM) & (np.abs(film[..., 1]) < 4.0 * HALF_WIDTH_MM)
        return np.where(seen[..., None], film, np.nan)

    def ground_at(self, film_mm: FloatArray, height_m: FloatArray | float) -> FloatArray:
        """Longitude, latitude, height (..., 3) where rays fall to an ellipsoidal height; accurate to 0.1 mm."""
        origin, direction = self.rays(film_mm)
        height = np.broadcast_to(np.asarray(height_m, dtype=float), origin.shape[:-1])
        axes = np.stack([6378137.0 + height, 6378137.0 + height, 6356752.314245 + height], axis=-1)
        o, d = origin / axes, direction / axes
        a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1.0
        inside = b * b - a * c
        distance = (-b - np.sqrt(np.where(inside >= 0.0, inside, np.nan))) / a
        # A blown-up ellipsoid is not quite one of equal height: one Newton step along the ray mends it.
        geodetic = geodetic_from_ecef(origin + distance[..., None] * direction)
        longitude, latitude = np.radians(geodetic[..., 0]), np.radians(geodetic[..., 1])
        up = np.stack(
            [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=-1
        )
        distance = distance + (height - geodetic[..., 2]) / (direction * up).sum(-1)
        return geodetic_from_ecef(origin + distance[..., None] * direction)


def compensated(exposure: Exposure, ground_height_m: float, *, lens: bool, relative_error: float) -> Exposure:
    """The same exposure with its image motion compensation set so that the ground stands still at mid-scan.

    lens : whether the lens is moved (KH-4, KH-4A) instead of the camera nodded (KH-4B).
    relative_error : share by which the compensation is wrong, since height and speed were only forecast.
    """
    centre = ecef_from_geodetic(exposure.ground_at(np.zeros(2), ground_height_m))
    still = replace(exposure, nodding_rad_s=0.0, lens_rate_mm_s=0.0)
    drift = float(still.drift_mm_s(centre, np.zeros(())))
    if lens:
        return replace(still, lens_rate_mm_s=drift * (1.0 + relative_error))
    nudge = 1e-3
    nodding = replace(still, nodding_rad_s=nudge)
    response = (float(nodding.drift_mm_s(centre, np.zeros(()))) - drift) / nudge
    return replace(still, nodding_rad_s=-drift / response * (1.0 + relative_error))
