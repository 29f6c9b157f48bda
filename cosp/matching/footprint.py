"""Where a frame was found on the ground, and on what evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from cosp.camera.panoramic import PanoramicCamera


@dataclass(frozen=True)
class FilmBlock:
    """How one piece of the film, along its length, agrees with the placement.

    Parameters
    ----------
    x_mm : float
        Its centre along the film.
    matches, agreeing : int
        Matches found in it, and those within the gate of the common camera.
    """

    x_mm: float
    matches: int
    agreeing: int


@dataclass(frozen=True)
class Footprint:
    """A frame placed on the ground.

    Parameters
    ----------
    scene : str
    camera : PanoramicCamera
        The predicted camera, refitted to what was found.
    shift_east_m, shift_north_m : float
        From the predicted place of the film's centre to the found one.
    turned : bool
        The film lies turned by 180 degrees against the prediction.
    score : float
        Height of the correlation peak of the whole search, in standard deviations of its surroundings.
    margin : float
        Agreeing matches at this place, divided by those that speak for the best other candidate and against this one
        (at least one).
    agreeing_share : float
        Share of the matches of the last level that agree with the camera.
    residual_m : float
        Median distance on the ground of those, at the last level.
    posting_m : float
        Of the last level.
    reference : str
        "image" or "relief".
    sun_azimuth_deg : float
        Of the shaded relief; meaningless for an image.
    corners_lonlat : four (longitude, latitude), degrees
        Of the picture at the mean height: (-x, +y), (+x, +y), (+x, -y), (-x, -y).
    blocks : tuple of FilmBlock
    """

    KIND: ClassVar[str] = "footprint"
    VERSION: ClassVar[int] = 1

    scene: str
    camera: PanoramicCamera
    shift_east_m: float
    shift_north_m: float
    turned: bool
    score: float
    margin: float
    agreeing_share: float
    residual_m: float
    posting_m: float
    reference: str
    sun_azimuth_deg: float
    corners_lonlat: tuple[tuple[float, float], ...]
    blocks: tuple[FilmBlock, ...]
