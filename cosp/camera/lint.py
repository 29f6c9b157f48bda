"""What is wrong with an optical bar camera that is meant for a KH-4, KH-4A or KH-4B film."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera.missions import (
    FILM_WIDTH_MM,
    FOCAL_LENGTH_MM,
    GROUND_SPEED_KM_PER_SCAN,
    SCAN_DEG,
    SCAN_SECONDS,
    TILT_DEG,
    WIDTH_MM,
)
from cosp.camera.opticalbar import OpticalBar, panoramic_from_optical_bar
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame

# What is let pass, wide enough for real films and orbits.
SCAN_RANGE_DEG = (60.0, 75.0)
WIDTH_RANGE_MM = (45.0, FILM_WIDTH_MM + 5.0)
HEIGHT_RANGE_KM = (100.0, 500.0)
CENTRE_SHARE = 0.02  # of the image, by which its centre may be off
FOCAL_SHARE = 0.01
RATE_SHARE = 0.10  # of the scan rate
MOTION_SHARE = 0.20  # of the way flown during a scan
TILT_TOLERANCE_DEG = 7.0
CLIMB_LIMIT_DEG = 15.0  # a tilt of the wrong sign makes 30
LEFT_SHARE = 0.4  # of the image motion that may be left; published parameters leave up to 0.31


def faults(bar: OpticalBar) -> list[str]:
    """A sentence for every fault of a camera, none if there is nothing to say."""
    found = [*_image_faults(bar), *_lens_faults(bar), *_form_faults(bar)]
    turn = np.reshape(bar.rotation, (3, 3))
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-6 or np.linalg.det(turn) < 0:
        return [*found, "iR is not a rotation: its rows are not of length one, perpendicular and right-handed."]
    earth = LocalFrame(0.0, 0.0)
    longitude, latitude, height_m = earth.geodetic_from_local(earth.local_from_ecef(np.array(bar.position_m)))
    low, high = HEIGHT_RANGE_KM
    if not low * 1000.0 < height_m < high * 1000.0:
        return [*found, f"iC is {height_m / 1000:.0f} km above the ellipsoid; these satellites flew at 150 to 250 km."]
    below = LocalFrame(float(longitude), float(latitude))
    return [*found, *_attitude_faults(bar, below), *_motion_faults(bar, below)]


def image_motion_mm(camera: PanoramicCamera) -> tuple[float, float, float]:
    """How flight, nodding and lens each move the image of ground in mid-scan across the film, mm per full scan.

    Where image motion is compensated the three add up to nearly nothing.
    """
    ground = camera.locate(np.zeros(2), 0.0)
    step = 0.01

    def y_mm(tau: float, flying: bool, nodding: bool) -> float:
        p = camera.parameters()
        p[0:3] += tau * p[3:6] * flying
        p[6:9] += tau * p[9:12] * nodding
        p[3:6] = p[9:12] = p[12] = 0.0
        return float(camera.with_parameters(p).project(ground)[1])

    flight, nodding = (
        (y_mm(step, flying, not flying) - y_mm(-step, flying, not flying)) / (2 * step) for flying in (True, False)
    )
    lens = -camera.imc_factor * camera.scan_length_mm * math.cos(math.radians(camera.angles_deg[0]))
    return flight, nodding, lens


def _image_faults(bar: OpticalBar) -> Iterator[str]:
    """Size, scale and centre of the image."""
    columns, rows = bar.image_size_px
    scan_deg = math.degrees(bar.length_m / bar.focal_length_m)
    if not SCAN_RANGE_DEG[0] <= scan_deg <= SCAN_RANGE_DEG[1]:
        scan_m = math.radians(SCAN_DEG) * FOCAL_LENGTH_MM / 1000.0
        yield (
            f"pitch {bar.pitch_m:g} m times {columns} columns is {bar.length_m * 1000:.0f} mm of film and a scan of "
            f"{scan_deg:.1f} degrees; a film of {scan_m * 1000:.0f} mm and {SCAN_DEG:.0f} degrees would have a pitch "
            f"of about {scan_m / columns:.2g} m at this size."
        )
    width_mm = rows * bar.pitch_m * 1000.0
    if not WIDTH_RANGE_MM[0] <= width_mm <= WIDTH_RANGE_MM[1]:
        yield (
            f"pitch {bar.pitch_m:g} m times {rows} rows is {width_mm:.1f} mm across the film; the picture is "
            f"{WIDTH_MM:g} mm wide, on film of {FILM_WIDTH_MM:g} mm."
        )
    for name, size, centre in zip(("columns", "rows"), bar.image_size_px, bar.image_center_px, strict=True):
        if abs(centre - (size - 1) / 2) > CENTRE_SHARE * size:
            yield f"image_center {centre:g} is far from the middle of {size} {name}, {(size - 1) / 2:g}."


def _lens_faults(bar: OpticalBar) -> Iterator[str]:
    """Focal length and, where it matters, the speed of the scan."""
    if abs(bar.focal_length_m * 1000.0 / FOCAL_LENGTH_MM - 1.0) > FOCAL_SHARE:
        yield f"f is {bar.focal_length_m:g} m; these cameras have {FOCAL_LENGTH_MM / 1000:g} m."
    if bar.velocity_m is None and bar.scan_time_s > 0:
        rate = math.degrees(bar.length_m / bar.focal_length_m) / bar.scan_time_s
        usual = SCAN_DEG / SCAN_SECONDS
        if abs(rate / usual - 1.0) > RATE_SHARE and SCAN_RANGE_DEG[0] < rate * bar.scan_time_s < SCAN_RANGE_DEG[1]:
            yield (
                f"scan_time {bar.scan_time_s:g} s makes the lens turn by {rate:.0f} degrees a second; it turns by "
                f"{usual:.0f}, which is {rate * bar.scan_time_s / usual:.3f} s for this image."
            )


def _form_faults(bar: OpticalBar) -> Iterator[str]:
    """What the two forms of the file do not go together with."""
    factors: dict[str, tuple[float, ...]] = {"motion_compensation_factor": (bar.motion_compensation_factor,)}
    if bar.velocity_m is None:
        factors |= {"speed": (bar.speed_m_per_s,), "scan_time": (bar.scan_time_s,)}
    else:
        factors["velocity"] = bar.velocity_m
        if bar.scan_direction == "left":
            yield "scan_dir is left, which is not allowed in a file with velocity: tell time backwards instead."
        if not any(bar.velocity_m):
            yield "velocity is 0 0 0, with which some versions read the file as one without velocity."
        if bar.final_pose is None:
            yield "final_pose is missing: the attitude is held still during the scan, in which KH-4B nods by a degree."
        else:
            factors["final_pose"] = bar.final_pose
    for key, numbers in factors.items():
        if 0.0 in numbers:
            yield (
                f"{key} is zero: bundle_adjust solves for a factor of the value in the file and can never move it "
                "from there."
            )


def _attitude_faults(bar: OpticalBar, below: LocalFrame) -> Iterator[str]:
    """Where the camera looks, and whether it flies level."""
    down = -(below.axes @ bar.attitude(0.5).apply([0.0, 0.0, 1.0]))[2]
    tilt_deg = math.degrees(math.acos(np.clip(down, -1.0, 1.0)))
    if abs(tilt_deg - TILT_DEG) > TILT_TOLERANCE_DEG:
        yield (
            f"In mid-scan the camera looks {tilt_deg:.0f} degrees off the vertical; these cameras look {TILT_DEG:.0f} "
            "degrees to the fore or aft."
        )
    motion: FloatArray = below.axes @ bar.motion_m
    climb_deg = math.degrees(math.atan2(motion[2], math.hypot(motion[0], motion[1])))
    if abs(climb_deg) > CLIMB_LIMIT_DEG:
        blame = (
            "forward_tilt does not go with iR, perhaps by its sign" if bar.velocity_m is None else "velocity is wrong"
        )
        yield f"The camera climbs at {climb_deg:.0f} degrees, so that {blame}."
    usual_m = GROUND_SPEED_KM_PER_SCAN * 1000.0 * math.degrees(bar.length_m / bar.focal_length_m) / SCAN_DEG
    flown_m = float(np.linalg.norm(motion))
    if bar.velocity_m is not None and flown_m > 0 and abs(flown_m / usual_m - 1.0) > MOTION_SHARE:
        yield f"velocity is {flown_m:.0f} m over the scan; about {usual_m:.0f} m are flown in that time."


def _motion_faults(bar: OpticalBar, below: LocalFrame) -> Iterator[str]:
    """Compensation of image motion, by a moved lens or a nodding camera."""
    flight, nodding, lens = image_motion_mm(panoramic_from_optical_bar(bar, "", below))
    if not flight:
        return
    left = (flight + nodding + lens) / flight
    if abs(left) <= LEFT_SHARE:
        return
    sizes = f"flight moves the image by {flight:.1f} mm per full scan, nodding by {nodding:.1f}, the lens by {lens:.1f}"
    if left > 1.0 + LEFT_SHARE and lens / flight > nodding / flight:
        yield f"motion_compensation_factor has the wrong sign: {sizes}, which adds up instead of cancelling."
    elif left > 1.0 + LEFT_SHARE:
        yield f"final_pose turns the camera the wrong way: {sizes}, which adds up instead of cancelling."
    elif left < 0:
        yield f"Image motion is compensated more than once: {sizes}."
    else:
        hint = ""
        if bar.velocity_m is None and 0 < abs(bar.motion_compensation_factor) < 0.5:
            hint = (
                f"; in a file without velocity the factor is a share of the nominal compensation, and "
                f"{bar.motion_compensation_factor:g} is as good as none"
            )
        yield f"Image motion is not compensated: {sizes}{hint}."
