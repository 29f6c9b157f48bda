"""A whole block from start cameras to a summary: resections, bundle, residuals, check points."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from cosp.adjustment import precision
from cosp.adjustment.bundle import CONTROL_NEEDED, Adjustment, adjust
from cosp.adjustment.calibration import Calibration, FieldChoices, calibrate
from cosp.adjustment.carrying import carry
from cosp.adjustment.fieldprior import Joints
from cosp.adjustment.observations import (
    FIELD_PRIORS,
    PLAIN_PRIORS,
    Control,
    HeightReference,
    Ties,
    orbit_coupling,
    place_information,
)
from cosp.adjustment.posterior import place_sigma_m
from cosp.adjustment.robust import Resection, resect_control
from cosp.adjustment.solver import END_SIGMA
from cosp.adjustment.unknowns import PARAMETERS, with_focal_lengths
from cosp.arrays import BoolArray, FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import NotEnoughMatchesError
from cosp.geometry.statistics import nmad, rms, summarise

logger = logging.getLogger(__name__)

PointsT = TypeVar("PointsT", Control, Ties)

# The single images are oriented by then: wide enough for what tie points still move.
SECOND_START_SIGMA = 30.0
TIES_AT_FIRST = 4000  # of a pair, to begin with
UNTOLD = 0.5  # of what was believed of a focal length: points that leave so much of it tell nothing


@dataclass(frozen=True)
class OrientedBlock:
    """A block after its adjustment, with what was asked of every image on the way.

    Parameters
    ----------
    adjustment : Adjustment
    resections : tuple of Resection or None
        Of every image by itself; None where its own control was too little.
    calibration : Calibration or None
        Film fields with everything about them, if they were asked for.
    plain : Adjustment
        The same block without film fields.
    focal_lengths_mm : tuple of floats
        Of the cameras before the adjustment.
    """

    adjustment: Adjustment
    resections: tuple[Resection | None, ...]
    calibration: Calibration | None
    plain: Adjustment
    focal_lengths_mm: tuple[float, ...]


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
    film_distortion_mm: float,
    tie_distortion_mm: float,
    gate_sigma: float,
    field: FieldChoices | None = None,
    reference: HeightReference | None = None,
    held_out: Sequence[BoolArray] | None = None,
    film_groups: Sequence[int] | None = None,
    place_sigmas_m: Sequence[float] | None = None,
    joints: Sequence[Joints] | None = None,
    bending_mm: Sequence[float] | None = None,
    focal_sigma_mm: float | None = None,
) -> OrientedBlock:
    """Adjusted cameras of a block.

    Every image with control enough is first oriented by itself, with both scan directions tried; that finds the
    gross errors of its control and a start that tie points can be trusted with. Images without control are set up on
    the ground that their neighbours show. Then all are adjusted together. The
    cameras given stay the means of the priors. Last, if asked for, the distortion of the films joins the unknowns.

    Where an image has no control, its tie points are held to the reference's heights from the beginning, and to where
    the image was placed; so are those between neighbouring frames, whose rays alone would not say where they meet.

    Parameters
    ----------
    cameras : sequence of PanoramicCamera
        Start values in one local frame.
    control : sequence of Control
        One per image, empty where there is none.
    ties : sequence of Ties
    film_distortion_mm, tie_distortion_mm : float
        Distortion of film that the plain model must allow for in the sigmas of control and of tie points.
    gate_sigma : float
        Points beyond this many standard deviations are gross errors.
    field : FieldChoices or None
        How to describe film distortion; None for the 13 parameters alone.
    reference : HeightReference or None
        Heights to hold tie points to; only with film fields.
    held_out : sequence of (N,) arrays of bool
        Tie points whose height is kept from the adjustment.
    film_groups : sequence of int
        Which images were taken by the same camera.
    place_sigmas_m : sequence of float
        How well each image was placed on the ground; used for those without control. NaN where that is not known.
    joints : sequence of Joints
        Of every film: where pieces of it may be off; only with film fields.
    bending_mm : sequence of float
        Standard deviation of the bending that straightening left of every film; only with film fields.
    focal_sigma_mm : float or None
        Standard deviation of the focal lengths, which are then unknowns too; None: they stay.

    Raises
    ------
    NotEnoughMatchesError
        If the block has too little control, or an image without control too few tie points.
    """
    found_control = sum(len(points) for points in control)
    if found_control < CONTROL_NEEDED:
        scenes = ", ".join(camera.scene for camera in cameras)
        raise NotEnoughMatchesError(
            f"{scenes}: {found_control} of the {CONTROL_NEEDED} control points that a block needs; with no frame on "
            "known ground, none can be carried"
        )
    allowed = [_allowing(points, film_distortion_mm) for points in control]
    resections = [
        resect_control(
            camera,
            points,
            priors=PLAIN_PRIORS,
            gate_sigma=gate_sigma,
        )
        if len(points) >= CONTROL_NEEDED
        else None
        for camera, points in zip(cameras, allowed, strict=True)
    ]
    alone = np.array([resection is None for resection in resections])
    information = _information(cameras, control, film_groups, place_sigmas_m)
    tie_allowed = [_allowing(points, tie_distortion_mm) for points in ties]
    start = carry(
        cameras,
        resections,
        [_allowing(points, film_distortion_mm) for points in ties],
        reference=reference,
        priors=FIELD_PRIORS,
        gate_sigma=gate_sigma,
        information=information,
    )
    means = [replace(camera, scan_direction=found.scan_direction) for camera, found in zip(cameras, start, strict=True)]
    held = [_held(points, alone, None if held_out is None else held_out[n]) for n, points in enumerate(ties)]
    options: dict[str, Any] = {
        "priors": PLAIN_PRIORS,
        "gate_sigma": gate_sigma,
        "prior_cameras": means,
        "information": _with_lenses(
            information if alone.any() else np.zeros_like(information), film_groups, focal_sigma_mm
        ),
        "reference": reference,
    }
    # Far from the solution a part of the tie points does as well as all.
    parts = [slice(None, None, math.ceil(len(points) / TIES_AT_FIRST) or 1) for points in ties]
    thinned = [_part(points, part) for points, part in zip(tie_allowed, parts, strict=True)]
    plain = adjust(
        start,
        allowed,
        thinned,
        start_sigma=SECOND_START_SIGMA,
        to_reference=[chosen[part] for chosen, part in zip(held, parts, strict=True)],
        **options,
    )
    if sum(map(len, thinned)) < sum(map(len, ties)):
        plain = adjust(plain.cameras, allowed, tie_allowed, start_sigma=END_SIGMA, to_reference=held, **options)
    focal_lengths_mm = tuple(camera.focal_length_mm for camera in cameras)
    if field is None:
        return OrientedBlock(plain, tuple(resections), None, plain, focal_lengths_mm)
    calibration = calibrate(
        plain.cameras,
        control,
        ties,
        reference=reference,
        priors=FIELD_PRIORS,
        prior_cameras=means,
        choices=field,
        gate_sigma=gate_sigma,
        control_weights=plain.control_weights,
        tie_weights=plain.tie_weights,
        height_weights=plain.height_weights,
        held_out=held_out,
        film_groups=film_groups,
        coupling=_with_lenses(information, film_groups, focal_sigma_mm),
        joints=joints,
        bending_mm=bending_mm,
    )
    return OrientedBlock(_with_fields(calibration), tuple(resections), calibration, plain, focal_lengths_mm)


def with_checks(
    block: OrientedBlock,
    control: Sequence[Control],
    checks: Sequence[Control],
    ties: Sequence[Ties],
    *,
    prior_cameras: Sequence[PanoramicCamera],
    field: FieldChoices,
    reference: HeightReference | None,
    gate_sigma: float,
    film_groups: Sequence[int] | None = None,
    place_sigmas_m: Sequence[float] | None = None,
    joints: Sequence[Joints] | None = None,
    bending_mm: Sequence[float] | None = None,
    focal_sigma_mm: float | None = None,
) -> OrientedBlock:
    """The block adjusted once more with its check points as control and no height held out.

    What check points say of the first adjustment then holds for this one a fortiori: a film field knows less
    where it saw no control.

    Parameters
    ----------
    block : OrientedBlock
        With film fields.
    control, checks : sequences of Control
        Per image.
    ties : sequence of Ties
    prior_cameras : sequence of PanoramicCamera
    field, reference, gate_sigma, film_groups, place_sigmas_m, joints, bending_mm, focal_sigma_mm
        As for `orient_block`.
    """
    if block.calibration is None:
        return block
    cameras = block.adjustment.cameras
    means = [replace(mean, scan_direction=now.scan_direction) for mean, now in zip(prior_cameras, cameras, strict=True)]
    calibration = calibrate(
        cameras,
        [_joined(points, more) for points, more in zip(control, checks, strict=True)],
        ties,
        reference=reference,
        priors=FIELD_PRIORS,
        prior_cameras=means,
        choices=replace(field, lengths_mm=(block.calibration.prior.length_mm,)),
        gate_sigma=gate_sigma,
        film_groups=film_groups,
        coupling=_with_lenses(
            _information(prior_cameras, control, film_groups, place_sigmas_m), film_groups, focal_sigma_mm
        ),
        joints=joints,
        bending_mm=bending_mm,
        learned=block.calibration,
    )
    return replace(block, adjustment=_with_fields(calibration), calibration=calibration)


def _part(points: Ties, part: slice) -> Ties:
    """Some of the tie points."""
    return replace(
        points, first_mm=points.first_mm[part], second_mm=points.second_mm[part], sigma_mm=points.sigma_mm[part]
    )


def _held(points: Ties, alone: BoolArray, held_out: BoolArray | None) -> BoolArray:
    """Which tie points the reference's heights hold from the beginning; `alone` are the images without control."""
    wanted = points.neighbours or bool(alone[[points.first, points.second]].any())
    held: BoolArray = np.full(len(points), wanted)
    return held if held_out is None else held & ~held_out


def _information(
    cameras: Sequence[PanoramicCamera],
    control: Sequence[Control],
    film_groups: Sequence[int] | None,
    place_sigmas_m: Sequence[float] | None,
) -> FloatArray:
    """What is believed of the cameras together (13 n, 13 n): one orbit, and places of frames without control."""
    groups = film_groups if film_groups is not None else range(len(cameras))
    information = orbit_coupling([camera.scene for camera in cameras], list(groups))
    for i, (camera, points) in enumerate(zip(cameras, control, strict=True)):
        if place_sigmas_m is not None and len(points) < CONTROL_NEEDED and np.isfinite(place_sigmas_m[i]):
            mine = slice(13 * i, 13 * (i + 1))
            information[mine, mine] += place_information(camera, place_sigmas_m[i])
    return information


def _with_lenses(
    information: FloatArray, film_groups: Sequence[int] | None, focal_sigma_mm: float | None
) -> FloatArray:
    """Information of cameras with that of their focal lengths, if these are unknowns."""
    if focal_sigma_mm is None:
        return information
    groups = film_groups if film_groups is not None else range(len(information) // PARAMETERS)
    return with_focal_lengths(information, list(groups), focal_sigma_mm)


def _allowing(points: PointsT, distortion_mm: float) -> PointsT:
    """Points whose sigmas allow for distortion of the film."""
    return replace(points, sigma_mm=np.hypot(points.sigma_mm, distortion_mm))


def _joined(first: Control, second: Control) -> Control:
    return Control(*(np.concatenate([getattr(first, f.name), getattr(second, f.name)]) for f in fields(Control)))


def _with_fields(calibration: Calibration) -> Adjustment:
    """A calibration as an adjustment of its cameras."""
    square, images = 0.0, len(calibration.cameras)
    for rows, weights in zip(calibration.rows, calibration.weights, strict=True):
        used = weights > 0
        square += float((weights[used, None] * rows.residuals[used] ** 2).sum())
    columns = calibration.camera_columns()
    ties = sum(rows.kind == "tie" for rows in calibration.rows)
    return Adjustment(
        cameras=calibration.cameras,
        control_weights=calibration.weights[:images],
        tie_weights=calibration.weights[images : images + ties],
        height_weights=calibration.weights[images + ties :]
        or tuple(np.zeros(len(w)) for w in calibration.weights[images:]),
        covariance=calibration.covariance[np.ix_(columns, columns)],
        sigma_naught=math.sqrt(square / max(calibration.redundancy, 1.0)),
        redundancy=round(calibration.redundancy),
        cost=calibration.cost,
        iterations=calibration.iterations,
    )


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
    final: OrientedBlock,
    control: Sequence[Control],
    ties: Sequence[Ties],
    checks: Sequence[Control],
    errors: CheckErrors,
    plain_errors: CheckErrors,
    *,
    pixels_mm: Sequence[float],
    film_distortion_mm: float,
    tie_distortion_mm: float,
    correlation_limit: float,
    focal_sigma_mm: float | None = None,
) -> dict[str, Any]:
    """What is told of an adjustment: the content of adjustment.json.

    Parameters
    ----------
    block : OrientedBlock
        Adjusted without the check points: what residuals and errors are told of.
    final : OrientedBlock
        Of the cameras that are handed on; the same without film fields.
    control, checks : sequences of Control
        Per image.
    ties : sequence of Ties
    errors, plain_errors : CheckErrors
        Of `block`, and of the same block without film fields.
    pixels_mm : sequence of float
        Size of a digitised pixel per image.
    film_distortion_mm, tie_distortion_mm : float
        What the plain model allowed for.
    correlation_limit : float
        Correlations beyond this are listed.
    focal_sigma_mm : float or None
        What was believed of the focal lengths, if they were unknowns.
    """
    adjustment = block.adjustment
    cameras = adjustment.cameras
    pixel_mm = float(np.mean(pixels_mm))
    correlated = precision.correlations(final.adjustment, correlation_limit)
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
            "image_motion_compensation": asdict(precision.compensation_of(adjusted)),
            "paper_parameters": precision.paper_parameters(adjusted),
            "focal_length": _lens(final.adjustment, n, focal_sigma_mm),
            "correlations": correlation,
            "film_field": _field_size(adjusted),
            "film_steps": [] if final.calibration is None else _steps(final.calibration, n),
            "place_sigma_m": place_sigma_m(
                final.adjustment.cameras,
                n,
                covariance=final.adjustment.covariance,
                calibration=final.calibration,
                height_m=0.0,
            ),
        }
        for n, (camera, adjusted, points, weights, held_out, resection, correlation, size_mm) in enumerate(
            zip(
                cameras,
                final.adjustment.cameras,
                control,
                adjustment.control_weights,
                checks,
                block.resections,
                correlated,
                pixels_mm,
                strict=True,
            )
        )
    ]
    pairs: list[dict[str, Any]] = []
    neighbours: list[dict[str, Any]] = []
    for points, weights in zip(ties, adjustment.tie_weights, strict=True):
        ground, gap_m = precision.intersect(cameras, points)
        first, second = precision.tie_residuals(cameras, points, ground)
        kept = weights > 0
        (neighbours if points.neighbours else pairs).append(
            {
                "first": cameras[points.first].scene,
                "second": cameras[points.second].scene,
                "ties": len(points),
                "ties_rejected": int((~kept).sum()),
                "rms_px": rms(np.concatenate([first[kept] / pixel_mm, second[kept] / pixel_mm])),
                "ray_gap_m": summarise(gap_m[kept]),
            }
        )
    calibration = block.calibration
    unknowns = float(len(adjustment.covariance))
    if calibration is None:
        allowed = [_allowing(points, film_distortion_mm) for points in control]
        groups = precision.plain_groups(adjustment, allowed, [_allowing(points, tie_distortion_mm) for points in ties])
        scales = dict.fromkeys(("gcp", "tie"), 1.0)
    else:
        groups = list(calibration.rows), list(calibration.weights), list(calibration.variances)
        scales = calibration.scales
        used = sum(int((w > 0).sum()) * rows.residuals.shape[1] for rows, w in zip(*groups[:2], strict=True))
        unknowns = used - calibration.redundancy
    return {
        "kind": "adjustment",
        "version": 1,
        "model": "plain" if calibration is None else "field",
        "sigma_naught_px": precision.sigma_naught_mm(adjustment, control, ties, unknowns) / pixel_mm,
        "sigma_naught": adjustment.sigma_naught,
        "redundancy": adjustment.redundancy,
        "iterations": adjustment.iterations,
        "pixel_mm": pixel_mm,
        "film_field": None
        if calibration is None
        else {**asdict(calibration.prior), "unmodelled_mm": calibration.unmodelled_mm},
        "groups": precision.group_statistics(*groups, scales) + _beliefs(block, focal_sigma_mm),
        "check": {
            "rmse": _rmse(errors),
            "count": len(errors.kept),
            "rejected": int((~errors.kept).sum()),
            "up_count": len(errors.up_kept),
            "up_rejected": int((~errors.up_kept).sum()),
            "up": summarise(errors.up_m),
            "up_from": "tie points in the blocks held out, against the reference heights",
            "rmse_without_field": _rmse(plain_errors),
        },
        "images": images,
        "pairs": pairs,
        "neighbours": neighbours,
        "priors": asdict(PLAIN_PRIORS if calibration is None else FIELD_PRIORS),
        "origin": asdict(cameras[0].origin),
    }


def _lens(adjustment: Adjustment, image: int, focal_sigma_mm: float | None) -> dict[str, float | None]:
    """Focal length of an image, with its standard deviation if it was an unknown; a warning where that says nothing."""
    camera = adjustment.cameras[image]
    if focal_sigma_mm is None:
        return {"mm": camera.focal_length_mm, "sigma_mm": None, "prior_sigma_mm": None}
    sigma_mm = math.sqrt(adjustment.covariance.diagonal()[adjustment.unknowns * (image + 1) - 1])
    logger.info("%s: focal length %.3f mm, standard deviation %.3f mm", camera.scene, camera.focal_length_mm, sigma_mm)
    if sigma_mm > UNTOLD * focal_sigma_mm:
        logger.warning(
            "%s: the points hardly tell the focal length: its standard deviation is %.2f mm after %.2f mm before",
            camera.scene,
            sigma_mm,
            focal_sigma_mm,
        )
    return {"mm": camera.focal_length_mm, "sigma_mm": sigma_mm, "prior_sigma_mm": focal_sigma_mm}


def _steps(calibration: Calibration, image: int) -> list[dict[str, Any]]:
    """Steps of a film at its joints, with what w-tests say of each being none."""
    found = []
    for step in calibration.steps(image):
        free = np.square(step.prior_sigma_mm) - np.square(step.sigma_mm)
        told = {"w_test": np.array(step.step_mm) / np.sqrt(np.maximum(free, 1e-12))} if min(step.prior_sigma_mm) else {}
        found.append({**asdict(step), **told})
    return found


def _beliefs(block: OrientedBlock, focal_sigma_mm: float | None) -> list[dict[str, Any]]:
    """Statistics of what was believed of steps of film and of focal lengths."""
    found = []
    calibration, adjustment = block.calibration, block.adjustment
    if calibration is not None:
        steps = calibration.step_columns()
        variances = calibration.covariance[steps, steps]
        moves = calibration.pattern_weights[:, calibration.basis.count - calibration.basis.steps :].ravel()
        found.append(precision.belief_statistics("step", moves, variances, calibration.scales["step"]))
    if focal_sigma_mm is not None:
        # Those of one lens are one belief: each is told by itself here.
        focal = adjustment.unknowns * np.arange(1, len(adjustment.cameras) + 1) - 1
        off = [now.focal_length_mm - then for now, then in zip(adjustment.cameras, block.focal_lengths_mm, strict=True)]
        found.append(
            precision.belief_statistics(
                "focal length",
                np.array(off) / focal_sigma_mm,
                adjustment.covariance[focal, focal] / focal_sigma_mm**2,
            )
        )
    return [statistics for statistics in found if statistics is not None]


def _rmse(errors: CheckErrors) -> dict[str, float]:
    return {
        "east_m": rms(errors.east_m[errors.kept]),
        "north_m": rms(errors.north_m[errors.kept]),
        "up_m": rms(errors.up_m[errors.up_kept]),
    }


def _field_size(camera: PanoramicCamera) -> dict[str, float] | None:
    """Root mean square and largest displacement of a film field along and across the film, mm."""
    if camera.film_field is None:
        return None
    displacement = field_grid(camera, 5.0)[1]
    return {
        "rms_x_mm": rms(displacement[..., 0]),
        "rms_y_mm": rms(displacement[..., 1]),
        "largest_mm": float(np.hypot(displacement[..., 0], displacement[..., 1]).max()),
    }


def field_grid(camera: PanoramicCamera, step_mm: float) -> tuple[FloatArray, FloatArray]:
    """The field of a film on a grid: places (rows, columns, 2) and displacements, both in mm; rows run down."""
    x = np.arange(-np.floor(camera.half_length_mm / step_mm), np.floor(camera.half_length_mm / step_mm) + 1) * step_mm
    y = np.arange(np.floor(camera.half_width_mm / step_mm), -np.floor(camera.half_width_mm / step_mm) - 1, -1) * step_mm
    places = np.stack(np.meshgrid(x, y), axis=-1)
    return places, np.zeros_like(places) if camera.film_field is None else camera.film_field.displacement(places)


def _within(values: FloatArray, gate_sigma: float) -> BoolArray:
    if not values.size:
        return np.zeros(0, dtype=bool)
    return np.asarray(np.abs(values - np.nanmedian(values)) <= gate_sigma * max(nmad(values), 1e-9))


def _kept_rms(camera: PanoramicCamera, points: Control, kept: BoolArray, pixel_mm: float) -> tuple[float, ...]:
    if not kept.any():
        return (math.nan, math.nan)
    residuals = precision.film_residuals(camera, points.film_mm, points.ground_m)
    return precision.rms_per_axis(residuals[kept] / pixel_mm)
