"""The optical bar camera of the Ames Stereo Pipeline, to and from the panoramic camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from cosp.arrays import FloatArray
from cosp.camera.exits import film_lattice
from cosp.camera.missions import SCAN_DEG
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from cosp.geometry.rays import Rays
from cosp.geometry.rotations import angles_from_matrix, rotation_matrix

Triple = tuple[float, float, float]

# Its camera looks along +z with y down the rows, ours along -z with y up the film.
FLIP = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class OpticalBar:
    """An optical bar camera as its file holds it. Earth-centred metres; the rotation takes camera to Earth.

    Without `velocity` the legacy form: the camera moves at `speed_m_per_s` along its rows, tilted forward, without
    turning, and the compensation factor multiplies the nominal compensation. With it the newer form: `velocity_m` and
    `final_pose` are the motion over one scan of the image, the factor is V/(H delta) cos(omega) itself.

    Parameters
    ----------
    image_size_px, image_center_px : width and height; column and row
    pitch_m, focal_length_m : float
    scan_direction : "left" or "right"
        Towards which columns time runs.
    position_m : three floats
        At the first exposed column.
    rotation : nine floats, by rows
        Camera to Earth, at the first exposed column.
    motion_compensation_factor : float
    scan_time_s, forward_tilt_rad, speed_m_per_s, mean_earth_radius_m, mean_surface_elevation_m : float
        Used by the legacy form only.
    velocity_m, final_pose : three floats or None
        Motion over the scan; rotation vector (axis times angle) of the camera at its end.

    References
    ----------
    Ames Stereo Pipeline, documentation of the optical bar camera format.
    """

    image_size_px: tuple[int, int]
    image_center_px: tuple[float, float]
    pitch_m: float
    focal_length_m: float
    scan_direction: Literal["left", "right"]
    position_m: Triple
    rotation: tuple[float, ...]
    motion_compensation_factor: float
    scan_time_s: float = 0.0
    forward_tilt_rad: float = 0.0
    speed_m_per_s: float = 0.0
    mean_earth_radius_m: float = 6_371_000.0
    mean_surface_elevation_m: float = 0.0
    velocity_m: Triple | None = None
    final_pose: Triple | None = None

    @property
    def sign(self) -> int:
        """+1 if time runs with the columns."""
        return 1 if self.scan_direction == "right" else -1

    @property
    def length_m(self) -> float:
        """Length of the image that one scan covers."""
        return (self.image_size_px[0] - 1) * self.pitch_m

    @property
    def middle_fraction(self) -> float:
        """Time at which the image centre is exposed, in scans of the image from its first exposed column."""
        return float(self.fraction(np.array(self.image_center_px[0])))

    @property
    def motion_m(self) -> FloatArray:
        """Motion during one scan of the image, Earth-centred."""
        if self.velocity_m is not None:
            return np.array(self.velocity_m)
        forward = Rotation.from_euler("x", self.forward_tilt_rad).as_matrix() @ [0.0, self.speed_m_per_s, 0.0]
        return np.asarray(np.reshape(self.rotation, (3, 3)) @ forward * self.scan_time_s)

    @property
    def attitude(self) -> Slerp:
        """Camera to Earth over the time of `fraction`."""
        start = end = Rotation.from_matrix(np.reshape(self.rotation, (3, 3)))
        if self.velocity_m is not None and self.final_pose is not None:
            end = Rotation.from_rotvec(self.final_pose)
        return Slerp([0.0, 1.0], Rotation.concatenate([start, end]))

    def fraction(self, columns: FloatArray) -> FloatArray:
        """Times at which columns are exposed, 0 to 1 from the first to the last."""
        along = np.asarray(columns, float) / (self.image_size_px[0] - 1)
        return along if self.sign > 0 else 1.0 - along

    def film_mm(self, pixels: FloatArray) -> FloatArray:
        """Film points (..., 2) in mm of columns and rows (..., 2)."""
        return (np.asarray(pixels, float) - self.image_center_px) * [1.0, -1.0] * self.pitch_m * 1000.0

    def pixels(self, film_mm: FloatArray) -> FloatArray:
        """Columns and rows (..., 2) of film points (..., 2) in mm."""
        return np.asarray(film_mm, float) * [1.0, -1.0] / (self.pitch_m * 1000.0) + self.image_center_px

    def rays(self, pixels: FloatArray, frame: LocalFrame) -> Rays:
        """Rays of columns and rows (N, 2), in a local frame.

        References
        ----------
        Vision Workbench, OpticalBarModel.
        """
        x, y = np.moveaxis((np.asarray(pixels, float) - self.image_center_px) * self.pitch_m, -1, 0)
        time = self.fraction(np.asarray(pixels)[..., 0])
        place = np.array(self.position_m) + time[:, None] * self.motion_m
        alpha = x / self.focal_length_m
        lens = self.focal_length_m * np.sin(alpha) * self.compensation(place)
        in_camera = np.stack([self.focal_length_m * np.sin(alpha), y + lens, self.focal_length_m * np.cos(alpha)], -1)
        direction = self.attitude(np.clip(time, 0.0, 1.0)).apply(in_camera)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        return Rays(frame.local_from_ecef(place), direction @ frame.axes.T)

    def compensation(self, place_m: FloatArray) -> FloatArray:
        """Shift of the lens over f sin(alpha), down the rows, from Earth-centred places (..., 3)."""
        if self.velocity_m is not None:
            return np.full(place_m.shape[:-1], self.sign * self.motion_compensation_factor)
        height_m = np.linalg.norm(place_m, axis=-1) - self.mean_earth_radius_m - self.mean_surface_elevation_m
        scan_rate = self.length_m / self.focal_length_m / self.scan_time_s
        nominal = self.speed_m_per_s / (height_m * scan_rate)
        return np.asarray(self.sign * self.motion_compensation_factor * nominal)


def panoramic_from_optical_bar(bar: OpticalBar, scene: str, origin: LocalFrame) -> PanoramicCamera:
    """The panoramic camera that sees what an optical bar camera sees.

    Exact for the legacy form but for the height in its motion compensation, taken at mid-scan; for the newer form
    attitude turns about omega, phi, kappa instead of one axis, which differs at second order in the turn.

    Parameters
    ----------
    bar : OpticalBar
    scene : str
    origin : LocalFrame
        Frame of the result.
    """
    scan_length_m = math.radians(SCAN_DEG) * bar.focal_length_m
    full_scan = scan_length_m / bar.length_m
    middle = np.array(bar.position_m) + bar.middle_fraction * bar.motion_m
    # Clipped, for the image may be off its centre; the turn is extended to the full sweep.
    times = np.clip(bar.middle_fraction + np.array([-0.5, 0.0, 0.5]), 0.0, 1.0)
    angles = angles_from_matrix(FLIP @ bar.attitude(times).as_matrix().transpose(0, 2, 1) @ origin.axes.T)
    rate = np.angle(np.exp(1j * (angles[2] - angles[0]))) / (times[2] - times[0]) * full_scan

    # Their y runs down the rows: y_imc = -f sin(alpha) compensation = s P f sin(alpha) cos(omega).
    imc_factor = -bar.sign * float(bar.compensation(middle)) / math.cos(angles[1, 0])

    half_size_mm = np.array(bar.image_size_px) * bar.pitch_m * 1000.0 / 2.0
    blank = PanoramicCamera(
        scene=scene,
        focal_length_mm=bar.focal_length_m * 1000.0,
        half_length_mm=float(half_size_mm[0]),
        half_width_mm=float(half_size_mm[1]),
        scan_direction=bar.sign,
        origin=origin,
        position_m=(0.0, 0.0, 0.0),
        position_change_m=(0.0, 0.0, 0.0),
        angles_deg=(0.0, 0.0, 0.0),
        angles_change_deg=(0.0, 0.0, 0.0),
        imc_factor=0.0,
    )
    change = origin.axes @ bar.motion_m * full_scan
    return blank.with_parameters(
        np.concatenate([origin.local_from_ecef(middle), change, angles[1], rate, [imc_factor]])
    )


def optical_bar_from_panoramic(
    camera: PanoramicCamera, grid: PixelGrid, *, heights_m: tuple[float, float]
) -> OpticalBar:
    """The optical bar camera, newer form, that sees most nearly what a panoramic camera sees.

    Its attitude turns about one axis where ours turns about three, which differs by up to a pixel. Position, motion,
    attitude and compensation are therefore fitted to the panoramic camera, which leaves a tenth of that.

    Parameters
    ----------
    camera : PanoramicCamera
    grid : PixelGrid
        Image of the film, mm, square pixels.
    heights_m : lowest and highest
        Ellipsoidal heights between which both are to agree.
    """
    start = _same_ends(camera, grid)
    film_mm, height_m = film_lattice(grid, heights_m, (21, 5, 3))
    ground_m = camera.locate(film_mm, height_m)
    first, last = start.attitude([0.0, 1.0])

    def changed(p: FloatArray) -> OpticalBar:
        """Changes in units of 100 m and of a milliradian, which move the image about as far."""
        pose = (last * Rotation.from_rotvec(p[9:12] * 1e-3)).as_rotvec()
        return replace(
            start,
            position_m=_triple(start.position_m + p[0:3] * 100.0),
            velocity_m=_triple(start.motion_m + p[3:6] * 100.0),
            rotation=tuple((first * Rotation.from_rotvec(p[6:9] * 1e-3)).as_matrix().ravel().tolist()),
            final_pose=_triple(pose),
            motion_compensation_factor=start.motion_compensation_factor + float(p[12]) * 1e-3,
        )

    def misfit(p: FloatArray) -> FloatArray:
        return residuals_mm(changed(p), camera, film_mm, ground_m).ravel()

    return changed(least_squares(misfit, np.zeros(13), x_scale=0.1, xtol=1e-5).x)


def residuals_mm(bar: OpticalBar, camera: PanoramicCamera, film_mm: FloatArray, ground_m: FloatArray) -> FloatArray:
    """Where a panoramic camera sees the rays of an optical bar camera, minus where they start on the film.

    Parameters
    ----------
    bar, camera : OpticalBar, PanoramicCamera
    film_mm : (N, 2) array, mm
    ground_m : (N, 3) array, m
        What the panoramic camera sees there, in its local frame: rays are followed to the point nearest to it.

    Returns
    -------
    (N, 2) array, mm
    """
    rays = bar.rays(bar.pixels(film_mm), camera.origin)
    nearest = rays.at(((ground_m - rays.origin) * rays.direction).sum(-1))
    return camera.project(nearest) - film_mm


def _same_ends(camera: PanoramicCamera, grid: PixelGrid) -> OpticalBar:
    """The optical bar camera that agrees with a panoramic one at the first and last column.

    The newer form knows time along the columns only. Where time runs against them it is told backwards, which changes
    the sign of every rate and of the image motion and nothing else.
    """
    p = camera.parameters()
    if camera.scan_direction < 0:
        p[3:6], p[9:12], p[12] = -p[3:6], -p[9:12], -p[12]
    forward = replace(camera, scan_direction=1).with_parameters(p)
    rows, columns = grid.shape
    centre_row, centre_column = grid.pixels(np.zeros(2))
    tau = forward.scan_fraction(grid.points(0.0, np.array([0.0, columns - 1.0]))[:, 0])
    position = camera.origin.ecef_from_local(p[0:3] + tau[:, None] * p[3:6])
    world_to_camera = rotation_matrix(p[6:9] + tau[:, None] * p[9:12]) @ camera.origin.axes
    turns = (FLIP @ world_to_camera).transpose(0, 2, 1)
    return OpticalBar(
        image_size_px=(columns, rows),
        image_center_px=(float(centre_column), float(centre_row)),
        pitch_m=grid.step_x / 1000.0,
        focal_length_m=camera.focal_length_mm / 1000.0,
        scan_direction="right",
        position_m=_triple(position[0]),
        rotation=tuple(turns[0].ravel().tolist()),
        motion_compensation_factor=-float(p[12]) * math.cos(p[6]),
        scan_time_s=1.0,  # in this form time is counted in scans of the image
        velocity_m=_triple(position[1] - position[0]),
        final_pose=_triple(Rotation.from_matrix(turns[1]).as_rotvec()),
    )


def _triple(values: FloatArray) -> Triple:
    x, y, z = values.tolist()
    return (x, y, z)
