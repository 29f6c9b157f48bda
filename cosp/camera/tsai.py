"""Optical bar cameras as text: the camera files of the Ames Stereo Pipeline."""

from __future__ import annotations

from cosp.camera.opticalbar import OpticalBar, Triple
from cosp.errors import InputError

HEAD = ("VERSION_4", "OPTICAL_BAR")
# Lines come in this order, each with so many numbers; the program reads them by their place.
LINES = {
    "image_size": 2,
    "image_center": 2,
    "pitch": 1,
    "f": 1,
    "scan_time": 1,
    "forward_tilt": 1,
    "iC": 3,
    "iR": 9,
    "speed": 1,
    "mean_earth_radius": 1,
    "mean_surface_elevation": 1,
    "motion_compensation_factor": 1,
}
NEWER_LINES = {"velocity": 3, "final_pose": 3}


def tsai_text(bar: OpticalBar) -> str:
    """The text of a camera file, with every digit that counts."""
    values: dict[str, tuple[float, ...]] = {
        "image_size": bar.image_size_px,
        "image_center": bar.image_center_px,
        "pitch": (bar.pitch_m,),
        "f": (bar.focal_length_m,),
        "scan_time": (bar.scan_time_s,),
        "forward_tilt": (bar.forward_tilt_rad,),
        "iC": bar.position_m,
        "iR": bar.rotation,
        "speed": (bar.speed_m_per_s,),
        "mean_earth_radius": (bar.mean_earth_radius_m,),
        "mean_surface_elevation": (bar.mean_surface_elevation_m,),
        "motion_compensation_factor": (bar.motion_compensation_factor,),
    }
    newer = {"velocity": bar.velocity_m, "final_pose": bar.final_pose}
    lines = [*HEAD, *(_line(key, numbers) for key, numbers in values.items()), f"scan_dir = {bar.scan_direction}"]
    lines += [_line(key, numbers) for key, numbers in newer.items() if numbers is not None]
    return "\n".join(lines) + "\n"


def optical_bar_from_tsai(text: str, name: str) -> OpticalBar:
    """The camera of a file's text.

    Parameters
    ----------
    text : str
    name : str
        Of the file, for messages.

    Raises
    ------
    InputError
        If a line is missing, in another place than the program reads it from, or not to be understood.
    """
    lines = [line.strip() for line in text.splitlines()]
    while lines and not lines[-1]:
        lines.pop()
    for number, wanted in enumerate(HEAD):
        if number >= len(lines) or lines[number] != wanted:
            found = repr(lines[number]) if number < len(lines) else "the end of the file"
            raise InputError(f"{name}, line {number + 1}: found {found}, needed {wanted}")
    place = len(HEAD)
    values: dict[str, list[float]] = {}
    for key, count in LINES.items():
        values[key] = _numbers(lines, place, key, count, name)
        place += 1
    if place >= len(lines) or lines[place] not in ("scan_dir = left", "scan_dir = right"):
        found = repr(lines[place]) if place < len(lines) else "the end of the file"
        raise InputError(f"{name}, line {place + 1}: found {found}, needed scan_dir = left or scan_dir = right")
    direction = lines[place].removeprefix("scan_dir = ")
    newer: dict[str, Triple | None] = dict.fromkeys(NEWER_LINES)
    for key, count in NEWER_LINES.items():
        place += 1
        if place < len(lines):
            x, y, z = _numbers(lines, place, key, count, name)
            newer[key] = (x, y, z)
    if place + 1 < len(lines):
        raise InputError(f"{name}, line {place + 2}: found {lines[place + 1]!r} after the last line that is read")

    return OpticalBar(
        image_size_px=(int(values["image_size"][0]), int(values["image_size"][1])),
        image_center_px=(values["image_center"][0], values["image_center"][1]),
        pitch_m=values["pitch"][0],
        focal_length_m=values["f"][0],
        scan_direction="left" if direction == "left" else "right",
        position_m=(values["iC"][0], values["iC"][1], values["iC"][2]),
        rotation=tuple(values["iR"]),
        motion_compensation_factor=values["motion_compensation_factor"][0],
        scan_time_s=values["scan_time"][0],
        forward_tilt_rad=values["forward_tilt"][0],
        speed_m_per_s=values["speed"][0],
        mean_earth_radius_m=values["mean_earth_radius"][0],
        mean_surface_elevation_m=values["mean_surface_elevation"][0],
        velocity_m=newer["velocity"],
        final_pose=newer["final_pose"],
    )


def _line(key: str, numbers: tuple[float, ...]) -> str:
    return f"{key} = {' '.join(repr(number) for number in numbers)}"


def _numbers(lines: list[str], place: int, key: str, count: int, name: str) -> list[float]:
    """Numbers of the line at a place, which must be that of a key."""
    needed = f"{key} = {'one number' if count == 1 else f'{count} numbers'}"
    if place >= len(lines):
        raise InputError(f"{name}, line {place + 1}: found the end of the file, needed {needed}")
    found, _, text = lines[place].partition(" = ")
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if found != key or len(numbers) != count:
        raise InputError(f"{name}, line {place + 1}: found {lines[place]!r}, needed {needed}")
    return numbers
