"""A whole block from start cameras to a summary: resections, bundle, residuals, check points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from cosp.adjustment import precision
from cosp.adjustment.bundle import CONTROL_NEEDED, Adjustment, adjust
from cosp.adjustment.observations import Control, Priors, Ties
from cosp.adjustment.robust import Resection, resect
from cosp.arrays import BoolArray, FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.statistics import nmad, rms, summarise

# The single images are oriented by then: wide enough for what tie points still move.
SECOND_START_SIGMA = 30.0


@dataclass(frozen=True)
class OrientedBlock:
    """A block after its adjustment, with what was asked of every image on the way.

    Parameters
    ----------
    adjustment : Adjustment
    resections : tuple of Resection or None
        Of every image by itself; None where its own control was too little.
    """

    adjustment: Adjustment
    resections: tuple[Resection | None, ...]


@dataclass(frozen=True)
class CheckErrors:
    """Errors at points that took no part in the adjustment.

    Parameters
    ----------
    east_m, north_m : (N,) arrays
        Check points of all images: where their film point lies at the known height, minus where it should.
    kept : (N,) array of bool
        Check points that are no gross errors themselves.
    up_m : (M,) array
        Tie points in the blocks held out: intersected height minus that of the reference.
    up_kept : (M,) array of bool
    """

    east_m: FloatArray
    north_m: FloatArray
    kept: BoolArray
    up_m: FloatArray
    up_kept: BoolArray


def orient_block(
    cameras: Sequence[PanoramicCamera],
    control: Sequence[Control],
    ties: Sequence[Ties],
    *,
    priors: Priors,
    gate_sigma: float,
) -> OrientedBlock:
    """Adjusted cameras of a block.

    Every image with control enough is first oriented by itself, with both scan directions tried; that finds the
    gross errors of its control and a start that tie points can be trusted with. Then all are adjusted together. The
    cameras given stay the means of the priors.

    Parameters
    ----------
    cameras : sequence of PanoramicCamera
        Start values in one local frame.
    control : sequence of Control
        One per image, empty where there is none.
    ties : sequence of Ties
    priors : Priors
    gate_sigma : float
        Points beyond this many standard deviations are gross errors.

    Raises
    ------
    NotEnoughMatchesError
        If the block has too little control.
    """
    resections = [
        resect(
            camera,
            points.film_mm,
            points.ground_m,
            sigma_px=points.sigma_mm,
            pixel_mm=1.0,
            priors=priors,
            gate_sigma=gate_sigma,
            sigma_ground_m=points.sigma_ground_m,
            sigma_height_m=points.sigma_height_m,
        )
        if len(points) >= CONTROL_NEEDED
        else None
        for camera, points in zip(cameras, control, strict=True)
    ]
    start = [resection.camera if resection else camera for camera, resection in zip(cameras, resections, strict=True)]
    means = [replace(camera, scan_direction=found.scan_direction) for camera, found in zip(cameras, start, strict=True)]
    adjustment = adjust(
        start,
        control,
        ties,
        priors=priors,
        gate_sigma=gate_sigma,
        prior_cameras=means,
        start_sigma=SECOND_START_SIGMA,
    )
    return OrientedBlock(adjustment, tuple(resections))


def check_errors(
    cameras: Sequence[PanoramicCamera],
    checks: Sequence[Control],
    *,
    tie_heights_m: FloatArray,
    reference_heights_m: FloatArray,
    gate_sigma: float,
) -> CheckErrors:
    """Errors east and north at check points, and up at tie points of the blocks held out.

    A ground point measured in one image only has no height of its own to check. Tie points have; in the blocks that the
    control did not see, the reference's height there is independent of the adjustment.

    Parameters
    ----------
    cameras : sequence of PanoramicCamera
    checks : sequence of Control
        Check points, one set per image.
    tie_heights_m, reference_heights_m : (M,) arrays, m
        Ellipsoidal heights at tie points of the blocks held out; NaN where the reference has none.
    gate_sigma : float
        Check points farther off than this many robust standard deviations are gross errors of their own.
    """
    errors = np.concatenate(
        [np.empty((0, 2))]
        + [
            precision.horizontal_errors(camera, points.film_mm, points.ground_m)
            for camera, points in zip(cameras, checks, strict=True)
        ]
    )
    up = np.asarray(tie_heights_m - reference_heights_m)
    up = up[np.isfinite(up)]
    return CheckErrors(
        east_m=errors[:, 0],
        north_m=errors[:, 1],
        kept=_within(errors[:, 0], gate_sigma) & _within(errors[:, 1], gate_sigma),
        up_m=up,
        up_kept=_within(up, gate_sigma),
    )


def summary(
    block: OrientedBlock,
    control: Sequence[Control],
    ties: Sequence[Ties],
    checks: Sequence[Control],
    errors: CheckErrors,
    *,
    pixels_mm: Sequence[float],
    priors: Priors,
    correlation_limit: float,
) -> dict[str, Any]:
    """What is told of an adjustment: the content of adjustment.json.

    Parameters
    ----------
    block : OrientedBlock
    control, checks : sequences of Control
        Per image.
    ties : sequence of Ties
    errors : CheckErrors
    pixels_mm : sequence of float
        Size of a digitised pixel per image.
    priors : Priors
    correlation_limit : float
        Correlations beyond this are listed.
    """
    adjustment = block.adjustment
    cameras = adjustment.cameras
    pixel_mm = float(np.mean(pixels_mm))
    correlated = precision.correlations(adjustment, correlation_limit)
    images = [
        {
            "scene": camera.scene,
            "control": len(points),
            "control_rejected": int((weights == 0).sum()),
            "check": len(held_out),
            "control_rms_px": _kept_rms(camera, points, weights > 0, size_mm),
            "check_rms_px": _kept_rms(camera, held_out, np.ones(len(held_out), dtype=bool), size_mm),
            "scan_direction": camera.scan_direction,
            "other_direction_cost": resection.other_direction_cost if resection else None,
            "image_motion_compensation": asdict(precision.compensation_of(camera)),
            "paper_parameters": precision.paper_parameters(camera),
            "correlations": correlation,
        }
        for camera, points, weights, held_out, resection, correlation, size_mm in zip(
            cameras,
            control,
            adjustment.control_weights,
            checks,
            block.resections,
            correlated,
            pixels_mm,
            strict=True,
        )
    ]
    pairs = []
    for points, weights in zip(ties, adjustment.tie_weights, strict=True):
        ground, gap_m = precision.intersect(cameras, points)
        first, second = precision.tie_residuals(cameras, points, ground)
        kept = weights > 0
        pairs.append(
            {
                "first": cameras[points.first].scene,
                "second": cameras[points.second].scene,
                "ties": len(points),
                "ties_rejected": int((~kept).sum()),
                "rms_px": rms(np.concatenate([first[kept] / pixel_mm, second[kept] / pixel_mm])),
                "ray_gap_m": summarise(gap_m[kept]),
            }
        )
    return {
        "kind": "adjustment",
        "version": 1,
        "sigma_naught_px": precision.sigma_naught_mm(adjustment, control, ties) / pixel_mm,
        "sigma_naught": adjustment.sigma_naught,
        "redundancy": adjustment.redundancy,
        "iterations": adjustment.iterations,
        "pixel_mm": pixel_mm,
        "check": {
            "rmse": {
                "east_m": rms(errors.east_m[errors.kept]),
                "north_m": rms(errors.north_m[errors.kept]),
                "up_m": rms(errors.up_m[errors.up_kept]),
            },
            "count": len(errors.kept),
            "rejected": int((~errors.kept).sum()),
            "up_count": len(errors.up_kept),
            "up_rejected": int((~errors.up_kept).sum()),
            "up": summarise(errors.up_m),
            "up_from": "tie points in the blocks held out, against the reference heights",
        },
        "images": images,
        "pairs": pairs,
        "priors": asdict(priors),
        "origin": asdict(cameras[0].origin),
    }


def _within(values: FloatArray, gate_sigma: float) -> BoolArray:
    if not values.size:
        return np.zeros(0, dtype=bool)
    return np.asarray(np.abs(values - np.nanmedian(values)) <= gate_sigma * max(nmad(values), 1e-9))


def _kept_rms(camera: PanoramicCamera, points: Control, kept: BoolArray, pixel_mm: float) -> tuple[float, ...]:
    if not kept.any():
        return (math.nan, math.nan)
    residuals = precision.film_residuals(camera, points.film_mm, points.ground_m)
    return precision.rms_per_axis(residuals[kept] / pixel_mm)
