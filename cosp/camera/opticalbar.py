"""The optical bar camera of the Ames Stereo Pipeline, to and from the panoramic camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from cosp.arrays import FloatArray
from cosp.camera.missions import SCAN_DEG
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
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
        """Time at which the image centre is exposed, in scans of the image from its first column."""
        along = self.image_center_px[0] / (self.image_size_px[0] - 1)
        return along if self.sign > 0 else 1.0 - along

    def film_mm(self, pixels: FloatArray) -> FloatArray:
        """Film points (..., 2) in mm of columns and rows (..., 2)."""
        return (np.asarray(pixels, float) - self.image_center_px) * [1.0, -1.0] * self.pitch_m * 1000.0


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
    turn = np.array(bar.rotation).reshape(3, 3)
    if bar.velocity_m is None:
        forward = Rotation.from_euler("x", bar.forward_tilt_rad).as_matrix() @ [0.0, bar.speed_m_per_s, 0.0]
        motion = turn @ forward * bar.scan_time_s
        turns = Rotation.from_matrix(np.stack([turn, turn]))
    else:
        motion = np.array(bar.velocity_m)
        end = Rotation.from_matrix(turn) if bar.final_pose is None else Rotation.from_rotvec(bar.final_pose)
        turns = Rotation.concatenate([Rotation.from_matrix(turn), end])

    scan_length_m = math.radians(SCAN_DEG) * bar.focal_length_m
    full_scan = scan_length_m / bar.length_m
    middle = np.array(bar.position_m) + bar.middle_fraction * motion
    slerp = Slerp([0.0, 1.0], turns)
    # Clipped, for the image may be off its centre; the turn is extended to the full sweep.
    times = np.clip(bar.middle_fraction + np.array([-0.5, 0.0, 0.5]), 0.0, 1.0)
    angles = angles_from_matrix(FLIP @ slerp(times).as_matrix().transpose(0, 2, 1) @ origin.axes.T)
    rate = np.angle(np.exp(1j * (angles[2] - angles[0]))) / (times[2] - times[0]) * full_scan

    if bar.velocity_m is None:
        height_m = float(np.linalg.norm(middle)) - bar.mean_earth_radius_m - bar.mean_surface_elevation_m
        scan_rate = bar.image_size_px[0] * bar.pitch_m / bar.focal_length_m / bar.scan_time_s
        compensation = bar.sign * bar.motion_compensation_factor * bar.speed_m_per_s / (height_m * scan_rate)
    else:
        compensation = bar.motion_compensation_factor
    # Their y runs down the rows: y_imc = -f sin(alpha) compensation = s P f sin(alpha) cos(omega).
    imc_factor = -bar.sign * compensation / math.cos(angles[1, 0])

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
    change = origin.axes @ motion * full_scan
    return blank.with_parameters(
        np.concatenate([origin.local_from_ecef(middle), change, angles[1], rate, [imc_factor]])
    )


def optical_bar_from_panoramic(
    camera: PanoramicCamera, *, image_size_px: tuple[int, int], image_center_px: tuple[float, float], pixel_mm: float
) -> OpticalBar:
    """The optical bar camera, newer form, of a panoramic camera and an image of its film.

    The newer form knows time along the columns only. Where time runs against them it is told backwards, which changes
    the sign of every rate and of the image motion and nothing else.

    Parameters
    ----------
    camera : PanoramicCamera
    image_size_px : width and height
    image_center_px : column and row of the centre of format
    pixel_mm : float
    """
    p = camera.parameters()
    if camera.scan_direction < 0:
        p[3:6], p[9:12], p[12] = -p[3:6], -p[9:12], -p[12]
    forward = replace(camera, scan_direction=1).with_parameters(p)
    columns = np.array([0.0, image_size_px[0] - 1.0])
    tau = forward.scan_fraction((columns - image_center_px[0]) * pixel_mm)
    position = camera.origin.ecef_from_local(p[0:3] + tau[:, None] * p[3:6])
    world_to_camera = rotation_matrix(p[6:9] + tau[:, None] * p[9:12]) @ camera.origin.axes
    turns = (FLIP @ world_to_camera).transpose(0, 2, 1)
    pose = Rotation.from_matrix(turns[1]).as_rotvec()
    start, end = position.tolist()
    return OpticalBar(
        image_size_px=image_size_px,
        image_center_px=image_center_px,
        pitch_m=pixel_mm / 1000.0,
        focal_length_m=camera.focal_length_mm / 1000.0,
        scan_direction="right",
        position_m=(start[0], start[1], start[2]),
        rotation=tuple(turns[0].ravel().tolist()),
        motion_compensation_factor=-float(p[12]) * math.cos(p[6]),
        velocity_m=(end[0] - start[0], end[1] - start[1], end[2] - start[2]),
        final_pose=(float(pose[0]), float(pose[1]), float(pose[2])),
    )
