"""Frames without control of their own, set up on the ground that their neighbours show too."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from cosp.adjustment.bundle import CONTROL_NEEDED
from cosp.adjustment.observations import Control, HeightReference, Priors, Ties
from cosp.adjustment.robust import Resection, resect_control
from cosp.arrays import FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import NotEnoughMatchesError

logger = logging.getLogger(__name__)

# A ray meets terrain whose slope it exceeds in a few steps; a metre is far below what is asked of a start.
STEPS = 15


def carry(
    cameras: Sequence[PanoramicCamera],
    resections: Sequence[Resection | None],
    ties: Sequence[Ties],
    *,
    reference: HeightReference | None,
    priors: Priors,
    gate_sigma: float,
    information: FloatArray,
) -> list[PanoramicCamera]:
    """Start cameras of all images: resected ones, and the others from tie points with frames that are oriented.

    A tie point lies where the ray of the oriented frame meets the reference surface; for the other frame it is
    control. The frame with most of such points comes next, until all are oriented.

    Parameters
    ----------
    cameras : sequence of PanoramicCamera
        As they were placed; means of the priors.
    resections : sequence of Resection or None
        Of images with control.
    ties : sequence of Ties
    reference : HeightReference or None
    priors : Priors
    gate_sigma : float
    information : (13 n, 13 n) array
        What is believed of the cameras besides the priors; of each image its own block is used.

    Raises
    ------
    NotEnoughMatchesError
        Naming the frames that no tie points join to frames with control.
    """
    oriented = {i: found.camera for i, found in enumerate(resections) if found is not None}
    while len(oriented) < len(cameras):
        waiting = [i for i in range(len(cameras)) if i not in oriented]
        offered = {i: _transferred(i, oriented, ties, reference) for i in waiting}
        best = max(waiting, key=lambda i: len(offered[i]))
        points = offered[best]
        if len(points) < CONTROL_NEEDED:
            names = ", ".join(cameras[i].scene for i in waiting)
            raise NotEnoughMatchesError(
                f"{names}: no ground control, and {len(points)} of the {CONTROL_NEEDED} tie points needed with frames "
                "that have"
            )
        mine = slice(13 * best, 13 * (best + 1))
        found = resect_control(
            cameras[best],
            points,
            priors=priors,
            gate_sigma=gate_sigma,
            directions=_directions(cameras[best], list(oriented.values())),
            information=information[mine, mine],
        )
        logger.info(
            "%s has no control: set up on %d tie points with its neighbours, %d of them good",
            cameras[best].scene,
            len(points),
            int((found.weights > 0).sum()),
        )
        oriented[best] = found.camera
    return [oriented[i] for i in range(len(cameras))]


def _directions(camera: PanoramicCamera, oriented: Sequence[PanoramicCamera]) -> tuple[int]:
    """Scan direction of the frame of the same camera, told by which way it looks; the other camera scans against it."""
    alike = [other.scan_direction for other in oriented if camera.angles_deg[0] * other.angles_deg[0] > 0]
    return (alike[0] if alike else -oriented[0].scan_direction,)


def _transferred(
    image: int, oriented: dict[int, PanoramicCamera], ties: Sequence[Ties], reference: HeightReference | None
) -> Control:
    """Control of an image from its tie points with oriented ones."""
    film: list[FloatArray] = [np.empty((0, 2))]
    ground: list[FloatArray] = [np.empty((0, 3))]
    sigma: list[FloatArray] = [np.empty(0)]
    for points in ties:
        sides = (points.first, points.first_mm), (points.second, points.second_mm)
        for (own, own_mm), (other, other_mm) in (sides, sides[::-1]):
            if own == image and other in oriented and reference is not None:
                found = on_surface(oriented[other], other_mm, reference)
                known = np.isfinite(found).all(axis=1)
                film.append(own_mm[known])
                ground.append(found[known])
                sigma.append(np.sqrt(2.0) * points.sigma_mm[known])
    count = sum(len(part) for part in sigma)
    height_m = reference.sigma_m if reference is not None else np.nan
    return Control(
        film_mm=np.concatenate(film),
        ground_m=np.concatenate(ground),
        sigma_mm=np.concatenate(sigma),
        sigma_ground_m=np.zeros(count),
        sigma_height_m=np.full(count, height_m),
    )


def on_surface(camera: PanoramicCamera, film_mm: FloatArray, reference: HeightReference) -> FloatArray:
    """Ground points (N, 3), local frame, where the rays of film points meet the reference; NaN where it has none."""
    heights: FloatArray = np.zeros(len(film_mm))
    for _ in range(STEPS):
        lonlath = camera.locate_geodetic(film_mm, heights)
        heights = reference.heights_at(lonlath[:, :2])
    return np.asarray(camera.locate(film_mm, heights))
