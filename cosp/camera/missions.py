"""Facts of the KH-4, KH-4A and KH-4B missions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from cosp.errors import InputError

CameraName = Literal["KH-4", "KH-4A", "KH-4B"]

FOCAL_LENGTH_MM = 609.6  # 24 inch, all three cameras [Ghuffar2022, table I]
SCAN_DEG = 70.0  # full sweep of the lens [Ghuffar2022, table I]
SCAN_SECONDS = 0.365  # 70 degrees at 192 degrees per second, KH-4B
WIDTH_MM = 55.4  # image across the 70 mm film
FILM_WIDTH_MM = 70.0
TILT_DEG = 15.0  # fore and aft camera against the vertical [Ghuffar2022, table I]
GROUND_SPEED_KM_PER_SCAN = 2.77  # along the track, relative to the turning Earth


@dataclass(frozen=True)
class Mission:
    """What is known of a camera before any picture is looked at.

    Parameters
    ----------
    camera : str
    nominal_height_km : float
        Height the adjustment starts from.
    has_stripes : bool
        Panoramic geometry stripes and rail holes are exposed beside the picture.
    compensation : "nodding" or "lens"
        How image motion is compensated: the camera nods (KH-4B) or the lens moves (KH-4, KH-4A).
    """

    camera: CameraName
    nominal_height_km: float
    has_stripes: bool
    compensation: Literal["nodding", "lens"]

    @property
    def scan_length_mm(self) -> float:
        """Length of film that the full sweep covers, 744.8 mm."""
        return math.radians(SCAN_DEG) * FOCAL_LENGTH_MM


_MISSIONS: dict[CameraName, Mission] = {
    "KH-4": Mission("KH-4", 210.0, has_stripes=False, compensation="lens"),
    "KH-4A": Mission("KH-4A", 185.0, has_stripes=False, compensation="lens"),
    "KH-4B": Mission("KH-4B", 170.0, has_stripes=True, compensation="nodding"),
}

# First and last mission number of each camera.
_NUMBERS: tuple[tuple[int, int, CameraName], ...] = (
    (9031, 9062, "KH-4"),
    (1001, 1052, "KH-4A"),
    (1101, 1117, "KH-4B"),
)


def camera_for(mission: int) -> CameraName:
    """Camera that flew on a mission.

    Raises
    ------
    InputError
        If the number is none of a KH-4, KH-4A or KH-4B mission.
    """
    for first, last, camera in _NUMBERS:
        if first <= mission <= last:
            return camera
    known = ", ".join(f"{first}-{last} ({camera})" for first, last, camera in _NUMBERS)
    raise InputError(f"mission {mission} is not one this pipeline knows; known are {known}")


def mission_for(camera: str) -> Mission:
    """Facts of a camera by its name ("KH-4", "KH-4A", "KH-4B").

    Raises
    ------
    InputError
        If there is no such camera.
    """
    for name, mission in _MISSIONS.items():
        if name == camera:
            return mission
    raise InputError(f"camera {camera!r} is not one of {', '.join(_MISSIONS)}")
