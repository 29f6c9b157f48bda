"""The panoramic camera: film to ground in closed form, ground to film by iteration."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera import kernels
from cosp.camera.field import FilmField
from cosp.camera.missions import SCAN_DEG
from cosp.geometry.frames import LocalFrame
from cosp.geometry.rays import Rays
from cosp.geometry.rotations import angles_from_matrix, rotation_matrix

Triple = tuple[float, float, float]
_BEYOND_FORMAT_MM = 1.0


@dataclass(frozen=True)
class PanoramicCamera:
    """One panoramic exposure: 13 parameters about mid-scan in a local frame.

    Parameters
    ----------
    scene : str
        Archive id.
    focal_length_mm : float
    half_length_mm, half_width_mm : float
        Half the usable film, along and across.
    scan_direction : +1 or -1
        Whether time runs with or against x of the film.
    origin : LocalFrame
        Frame of everything below.
    position_m, position_change_m : three floats
        Perspective centre at mid-scan and its change over one scan.
    angles_deg, angles_change_deg : three floats
        Omega, phi, kappa at mid-scan and their change over one scan.
    imc_factor : float
        V / (H delta) of image motion compensation by a moved lens.
    film_field : FilmField or None
        Distortion of this film: measured is imaged plus displacement. Added after a projection and taken off before a
        ray is built, so that film points are measured ones everywhere outside.

    References
    ----------
    [Ghuffar2022] equations 1 to 12; signs and epoch as in docs/conventions.md.
    """

    KIND: ClassVar[str] = "panoramic_camera"
    VERSION: ClassVar[int] = 1

    scene: str
    focal_length_mm: float
    half_length_mm: float
    half_width_mm: float
    scan_direction: int
    origin: LocalFrame
    position_m: Triple
    position_change_m: Triple
    angles_deg: Triple
    angles_change_deg: Triple
    imc_factor: float
    film_field: FilmField | None = None

    @property
    def scan_length_mm(self) -> float:
        """Film length of the full sweep; scan fraction one. Not the length of what was digitised."""
        return math.radians(SCAN_DEG) * self.focal_length_mm

    def parameters(self) -> FloatArray:
        """X Y Z, their changes, omega phi kappa, their changes, IMC factor: (13,), metres and radians."""
        return np.array(
            [
                *self.position_m,
                *self.position_change_m,
                *np.radians(self.angles_deg),
                *np.radians(self.angles_change_deg),
                self.imc_factor,
            ]
        )

    def with_parameters(self, parameters: FloatArray, scan_direction: int | None = None) -> PanoramicCamera:
        """The same camera with other values of the 13 parameters (order of `parameters`)."""
        p = [float(v) for v in parameters]
        degrees = [math.degrees(v) for v in p[6:12]]
        return replace(
            self,
            position_m=(p[0], p[1], p[2]),
            position_change_m=(p[3], p[4], p[5]),
            angles_deg=(degrees[0], degrees[1], degrees[2]),
            angles_change_deg=(degrees[3], degrees[4], degrees[5]),
            imc_factor=p[12],
            scan_direction=self.scan_direction if scan_direction is None else scan_direction,
        )

    def scan_fraction(self, x_mm: FloatArray) -> FloatArray:
        """Time within the scan, -1/2 to 1/2, at which the slit passes x."""
        return np.asarray(self.scan_direction * np.asarray(x_mm, float) / self.scan_length_mm)

    def image_motion_mm(self, x_mm: FloatArray) -> FloatArray:
        """Displacement along y that image motion compensation adds, y_imc = s P f sin(alpha) cos(omega).

        References
        ----------
        [Ghuffar2022] equation 10; the sign follows from the smear test in docs/conventions.md.
        """
        size = self.scan_direction * self.imc_factor * self.focal_length_mm * math.cos(math.radians(self.angles_deg[0]))
        return np.asarray(size * np.sin(np.asarray(x_mm, float) / self.focal_length_mm))

    def imaged(self, film_mm: FloatArray) -> FloatArray:
        """Where the camera images film points (..., 2) in mm: measured ones without the distortion of the film."""
        film_mm = np.asarray(film_mm, dtype=float)
        return film_mm if self.film_field is None else self.film_field.corrected(film_mm)

    def without_field(self) -> PanoramicCamera:
        """The same camera on a film without distortion."""
        return replace(self, film_field=None)

    def project(self, ground_m: FloatArray) -> FloatArray:
        """Film points (..., 2) in mm of ground points (..., 3) in the camera's local frame.

        NaN where the point is behind the camera or outside the sweep of the lens.
        """
        ground_m = np.asarray(ground_m, dtype=float)
        film = np.empty((*ground_m.shape[:-1], 2))
        kernels.project(
            self.parameters(),
            self.focal_length_mm,
            self.scan_direction / self.scan_length_mm,
            np.ascontiguousarray(ground_m.reshape(-1, 3)),
            film.reshape(-1, 2),
        )
        return film if self.film_field is None else self.film_field.distorted(film)

    def rays(self, film_mm: FloatArray) -> Rays:
        """Rays of film points (..., 2) in mm, in the camera's local frame.

        References
        ----------
        [Ghuffar2022] equation 9, solved for the direction.
        """
        imaged_mm = self.imaged(film_mm)
        x, y = imaged_mm[..., 0], imaged_mm[..., 1]
        tau = self.scan_fraction(x)[..., None]
        alpha = x / self.focal_length_mm
        in_camera = np.stack(
            [
                self.focal_length_mm * np.sin(alpha),
                y + self.image_motion_mm(x),
                -self.focal_length_mm * np.cos(alpha),
            ],
            axis=-1,
        )
        p = self.parameters()
        rotation = rotation_matrix(p[6:9] + tau * p[9:12])
        direction = (rotation * in_camera[..., :, None]).sum(-2)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        return Rays(p[0:3] + tau * p[3:6], direction)

    def rays_about_format(self, film_mm: FloatArray) -> Rays:
        """Rays as of `rays`, NaN for points more than a millimetre outside the format.

        Rectified images have corners that are far from any film; what the rays of such places are is arbitrary.
        """
        film_mm = np.asarray(film_mm, dtype=float)
        format_mm = np.array([self.half_length_mm, self.half_width_mm])
        near = np.all(np.abs(film_mm) <= format_mm + _BEYOND_FORMAT_MM, axis=-1, keepdims=True)
        return self.rays(np.where(near, film_mm, np.nan))

    def locate(self, film_mm: FloatArray, height_m: FloatArray | float) -> FloatArray:
        """Ground points (..., 3), local frame, where rays reach an ellipsoidal height.

        Parameters
        ----------
        film_mm : (..., 2) array, mm
        height_m : float or (...) array, m
            Ellipsoidal height, not height in the local frame.
        """
        rays = self.rays(film_mm)
        height_m = np.broadcast_to(np.asarray(height_m, float), rays.direction.shape[:-1])
        up = rays.direction[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (height_m - rays.origin[..., 2]) / up
        # The ellipsoid curves away by metres to a kilometre: a few Newton steps along the ray settle it.
        for _ in range(6):
            found = self.origin.geodetic_from_local(rays.at(distance))
            step = (height_m - found[..., 2]) / (rays.direction * self._upward(found)).sum(-1)
            distance = distance + step
            if not np.any(np.abs(step) > 1e-6):
                break
        return rays.at(distance)

    def locate_on(
        self, film_mm: FloatArray, height_at: Callable[[FloatArray], FloatArray], iterations: int = 10
    ) -> FloatArray:
        """Ground points (..., 3), local frame, where rays meet a terrain.

        Parameters
        ----------
        film_mm : (..., 2) array, mm
        height_at : function
            Ellipsoidal heights (...) of longitudes and latitudes (..., 2) in degrees; NaN outside the terrain.
        iterations : int
            Each step gains a factor of cot(tilt) over the terrain slope.
        """
        film_mm = np.asarray(film_mm, float)
        ground = self.locate(film_mm, 0.0)
        for _ in range(iterations):
            lonlat = self.origin.geodetic_from_local(ground)[..., :2]
            ground = self.locate(film_mm, height_at(lonlat))
        return ground

    def locate_geodetic(self, film_mm: FloatArray, height_m: FloatArray | float) -> FloatArray:
        """Longitude, latitude (degrees) and height of film points at an ellipsoidal height, (..., 3)."""
        return self.origin.geodetic_from_local(self.locate(film_mm, height_m))

    def project_geodetic(self, lonlath: FloatArray) -> FloatArray:
        """Film points (..., 2) in mm of longitude, latitude (degrees), ellipsoidal height (m)."""
        return self.project(self.origin.local_from_geodetic(lonlath))

    def turned(self) -> PanoramicCamera:
        """The camera whose film is this one's turned by 180 degrees: x and y change sign."""
        p = self.parameters()
        # A half turn about the optical axis: R' = diag(-1, -1, 1) R. Angles along the scan are turned one by one,
        # so that the linear change in time is kept to second order.
        ends = [
            angles_from_matrix(np.diag([-1.0, -1.0, 1.0]) @ rotation_matrix(p[6:9] + tau * p[9:12]))
            for tau in (-0.5, 0.0, 0.5)
        ]
        change = np.angle(np.exp(1j * (ends[2] - ends[0])))
        p[6:9], p[9:12] = ends[1], change
        # y_imc must change sign with y; sin(alpha) and the scan direction both do, cos(omega) does not.
        p[12] = -p[12]
        turned = self.with_parameters(p, scan_direction=-self.scan_direction)
        return replace(turned, film_field=None if self.film_field is None else self.film_field.turned())

    def moved_to(self, origin: LocalFrame) -> PanoramicCamera:
        """The same camera described in another local frame."""
        if origin == self.origin:
            return self
        p = self.parameters()
        turn = self.origin.axes @ origin.axes.T  # old local axes expressed in the new frame, as rows
        position = origin.local_from_ecef(self.origin.ecef_from_local(p[0:3]))
        change = p[3:6] @ turn
        angles = [angles_from_matrix(rotation_matrix(p[6:9] + tau * p[9:12]) @ turn) for tau in (-0.5, 0.0, 0.5)]
        rate = np.angle(np.exp(1j * (angles[2] - angles[0])))
        moved = np.concatenate([position, change, angles[1], rate, p[12:]])
        return replace(self.with_parameters(moved), origin=origin)

    def _upward(self, lonlath: FloatArray) -> FloatArray:
        """Normals of the ellipsoid in the local frame."""
        lon, lat = np.radians(lonlath[..., 0]), np.radians(lonlath[..., 1])
        normal = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
        return np.asarray(normal @ self.origin.axes.T)
