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
        The film raster lies turned by 180 degrees; the camera's film points are those of the raster with the signs of x
        and y changed.
    score : float
        How likely the place is by the first search, as the height of a normal variable above its surroundings.
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
        "image", "relief", or "neighbours" where nothing but the neighbours speaks for the place: score, margin and
        agreeing share are 0 then.
    sun_azimuth_deg : float
        Of the shaded relief that the film matches best; meaningless for an image.
    corners_lonlat : four (longitude, latitude), degrees
        Of the picture at the mean height: (-x, +y), (+x, +y), (+x, -y), (-x, -y).
    blocks : tuple of FilmBlock
    mirrored : bool
        The film raster lies mirrored across its length; the camera's film points are those of the raster with the sign
        of y changed, besides what `turned` says.
    rival_score : float
        That of the best other place.
    rotation_deg, scale : float
        Heading (counter-clockwise) and size on the ground of what was found, against the prediction.
    sun_elevation_deg : float
        Of the shaded relief.
    sigma_m : float
        Standard deviation of the place on the ground, per coordinate, where the film is known worst.
    neighbours : tuple of str
        Frames of the same pass that say where this one is to be looked for, where it could not be placed by itself.
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
    mirrored: bool = False
    rival_score: float = 0.0
    rotation_deg: float = 0.0
    scale: float = 1.0
    sun_elevation_deg: float = 35.0
    sigma_m: float = float("nan")
    neighbours: tuple[str, ...] = ()


@dataclass(frozen=True)
class Attempt:
    """A frame looked for by itself: where it lies, or why that is not known.

    Parameters
    ----------
    scene : str
    footprint : Footprint or None
    refusal : str or None
    """

    KIND: ClassVar[str] = "placement"
    VERSION: ClassVar[int] = 1

    scene: str
    footprint: Footprint | None
    refusal: str | None
