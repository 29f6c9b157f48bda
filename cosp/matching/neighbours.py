"""Where a frame must lie that shows too little to be placed by itself: its neighbours leave it little room.

The satellite flies on evenly and keeps its attitude to a third of a degree, so that the middles of the frames of one
camera lie evenly spaced along a line. The other camera of a pair looks at the same ground six frames before or after.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
from cosp.matching.footprint import Footprint
from cosp.matching.ground import ground_pixel_m
from cosp.matching.placement import corners_lonlat, shift_m, turned_about_centre
from cosp.matching.relief import Sun

# What 0.3 degrees of attitude move the middle of a frame.
_ATTITUDE_SIGMA_M = 1000.0
# Frames follow each other by this share of their width; how far that may be wrong.
_ADVANCE = 0.925
_ADVANCE_SIGMA = 0.1
# The partner of a pair is so many frames away, give or take.
_PARTNER_FRAMES = 6
_PARTNER_SIGMA = 0.5


@dataclass(frozen=True)
class PlacedFrame:
    """A frame of the pass that has been placed.

    Parameters
    ----------
    frame : int
        Its number.
    look : "fore" or "aft"
    footprint : Footprint
    """

    frame: int
    look: str
    footprint: Footprint

    @property
    def middle(self) -> FloatArray:
        """Longitude and latitude of the middle of the frame."""
        return np.asarray(self.footprint.camera.locate_geodetic(np.zeros(2), 0.0)[:2])


@dataclass(frozen=True)
class Expected:
    """Where neighbours say a frame lies.

    Parameters
    ----------
    camera : PanoramicCamera
    sigma_m : float
        Of its place on the ground, per coordinate.
    turned, mirrored : bool
        How the films of the same camera were digitised.
    sun : Sun
        Of a frame of the pass: they are exposed within minutes.
    neighbours : tuple of str
    """

    camera: PanoramicCamera
    sigma_m: float
    turned: bool
    mirrored: bool
    sun: Sun
    neighbours: tuple[str, ...]

    def footprint(self, predicted: PanoramicCamera, height_m: float) -> Footprint:
        """What is known of a frame of which nothing but this is known."""
        east, north = shift_m(predicted, self.camera, height_m)
        return Footprint(
            scene=self.camera.scene,
            camera=self.camera,
            shift_east_m=east,
            shift_north_m=north,
            turned=self.turned,
            mirrored=self.mirrored,
            score=0.0,
            margin=0.0,
            agreeing_share=0.0,
            residual_m=float("nan"),
            sigma_m=self.sigma_m,
            posting_m=float("nan"),
            reference="neighbours",
            sun_azimuth_deg=self.sun.azimuth_deg,
            sun_elevation_deg=self.sun.elevation_deg,
            corners_lonlat=corners_lonlat(self.camera, height_m),
            blocks=(),
            neighbours=self.neighbours,
        )


def expected_frame(predicted: PanoramicCamera, frame: int, look: str, placed: Sequence[PlacedFrame]) -> Expected | None:
    """Where a frame must lie between or beside the placed frames of its pass; None if there are none.

    Parameters
    ----------
    predicted : PanoramicCamera
        From the archive's corners; gives the frame's size and the local frame.
    frame : int
    look : "fore" or "aft"
    placed : PlacedFrame of others of the pass
    """
    alike = sorted((p for p in placed if p.look == look), key=lambda p: abs(p.frame - frame))
    others = sorted((p for p in placed if p.look != look), key=lambda p: abs(_partner(p) - frame))
    used: tuple[PlacedFrame, ...]
    if len(alike) >= 2:
        first, second = alike[:2]
        share = (frame - first.frame) / (second.frame - first.frame)
        middle = first.middle + share * _difference(second.middle, first.middle)
        sigma = _ATTITUDE_SIGMA_M * math.sqrt(1 + share**2 + (1 - share) ** 2)
        camera, used = _carried(first.footprint.camera, middle - first.middle), (first, second)
    elif alike:
        first = alike[0]
        east_north = _advance_m(first.footprint.camera) * (frame - first.frame)
        sigma = math.hypot(_ATTITUDE_SIGMA_M * math.sqrt(2), _ADVANCE_SIGMA * float(np.linalg.norm(east_north)))
        camera, used = _carried(first.footprint.camera, _degrees(east_north, first.middle[1])), (first,)
    elif others:
        partner = others[0]
        step = _advance_m(partner.footprint.camera)
        frames = frame - _partner(partner)
        sigma = math.hypot(
            _ATTITUDE_SIGMA_M * math.sqrt(2),
            math.hypot(_PARTNER_SIGMA, _ADVANCE_SIGMA * frames) * float(np.linalg.norm(step)),
        )
        rotation = _heading(partner.footprint.camera) - _heading(predicted)
        turned = turned_about_centre(predicted, math.remainder(rotation, math.tau), 1.0, 0.0)
        target = partner.middle + _degrees(step * frames, partner.middle[1])
        camera, used = _carried(turned, _difference(target, turned.locate_geodetic(np.zeros(2), 0.0)[:2])), (partner,)
    else:
        return None
    camera = replace(
        camera.moved_to(predicted.origin),
        scene=predicted.scene,
        half_length_mm=predicted.half_length_mm,
        half_width_mm=predicted.half_width_mm,
    )
    nearest = used[0].footprint
    like = nearest if alike else None
    return Expected(
        camera,
        sigma,
        turned=like is not None and like.turned,
        mirrored=like is not None and like.mirrored,
        sun=Sun(nearest.sun_azimuth_deg, nearest.sun_elevation_deg),
        neighbours=tuple(p.footprint.scene for p in used),
    )


def _partner(placed: PlacedFrame) -> int:
    """Number of the frame of the other camera that shows the same ground."""
    return placed.frame + (_PARTNER_FRAMES if placed.look == "fore" else -_PARTNER_FRAMES)


def _difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """From b to a, longitude and latitude in degrees, the short way round."""
    change = np.asarray(a) - np.asarray(b)
    return np.array([math.remainder(float(change[0]), 360.0), change[1]])


def _degrees(east_north_m: FloatArray, latitude_deg: float) -> FloatArray:
    """Metres on the ground as changes of longitude and latitude, to a few parts in a thousand."""
    degree_m = 111_200.0
    return np.array([east_north_m[0] / math.cos(math.radians(latitude_deg)), east_north_m[1]]) / degree_m


def _advance_m(camera: PanoramicCamera) -> FloatArray:
    """From one frame to the next, (east, north)."""
    width_m = 2 * camera.half_width_mm * ground_pixel_m(camera, 1.0, 0.0)
    heading = _heading(camera)
    return _ADVANCE * width_m * np.array([math.cos(heading), math.sin(heading)])


def _heading(camera: PanoramicCamera) -> float:
    """Direction of flight, radians counter-clockwise from east."""
    return math.atan2(camera.position_change_m[1], camera.position_change_m[0])


def _carried(camera: PanoramicCamera, lonlat_change: FloatArray) -> PanoramicCamera:
    """The camera carried over the ellipsoid with its height and its tilt."""
    origin = camera.origin
    return replace(
        camera,
        origin=LocalFrame(
            origin.longitude_deg + float(lonlat_change[0]), origin.latitude_deg + float(lonlat_change[1])
        ),
    )
