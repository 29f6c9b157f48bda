"""How good an adjustment is: residuals, check points, correlations, and what the parameters say of the mission."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cosp.adjustment.bundle import Adjustment
from cosp.adjustment.observations import Control, Ties
from cosp.adjustment.rows import Rows, control_rows, intersections, tie_rows
from cosp.adjustment.unknowns import NAMES
from cosp.arrays import BoolArray, FloatArray
from cosp.camera.missions import GROUND_SPEED_KM_PER_SCAN, TILT_DEG
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.rays import meet
from cosp.geometry.rotations import rotation_matrix
from cosp.geometry.statistics import rms

BAARDA_LIMIT = 3.29  # a thousandth of the normal distribution lies beyond


def film_residuals(camera: PanoramicCamera, film_mm: FloatArray, ground_m: FloatArray) -> FloatArray:
    """Measured minus projected film points, (N, 2) in mm; NaN where a point falls outside the sweep."""
    return np.asarray(film_mm - camera.project(ground_m))


def horizontal_errors(camera: PanoramicCamera, film_mm: FloatArray, ground_m: FloatArray) -> FloatArray:
    """Where film points lie on the ground at the known heights, minus where they should, (N, 2) east and north in m."""
    heights = camera.origin.geodetic_from_local(ground_m)[:, 2]
    return np.asarray((camera.locate(film_mm, heights) - ground_m)[:, :2])


def intersect(cameras: Sequence[PanoramicCamera], ties: Ties) -> tuple[FloatArray, FloatArray]:
    """Ground points (N, 3) of tie points and the gap between their rays (N,), m."""
    return meet(cameras[ties.first].rays(ties.first_mm), cameras[ties.second].rays(ties.second_mm))


def tie_residuals(
    cameras: Sequence[PanoramicCamera], ties: Ties, ground_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (N, 2) in mm of tie points in their first and second image, against their intersected ground points."""
    return (
        film_residuals(cameras[ties.first], ties.first_mm, ground_m),
        film_residuals(cameras[ties.second], ties.second_mm, ground_m),
    )


def in_held_out_blocks(film_mm: FloatArray, control_mm: FloatArray, check_mm: FloatArray) -> BoolArray:
    """Which film points lie nearer to a check point than to any control point, (N,).

    Where check points are held out in whole blocks, these points lie in the blocks that the control did not see.
    """
    if not len(check_mm):
        return np.zeros(len(film_mm), dtype=bool)
    if not len(control_mm):
        return np.ones(len(film_mm), dtype=bool)
    return np.asarray(cKDTree(check_mm).query(film_mm)[0] < cKDTree(control_mm).query(film_mm)[0])


def sigma_naught_mm(adjustment: Adjustment, control: Sequence[Control], ties: Sequence[Ties], unknowns: float) -> float:
    """Standard deviation of a film coordinate from the residuals of all points kept, mm, with so many unknowns.

    Residuals of control stand as they are, of tie points as the one condition each of them gives.

    References
    ----------
    [Ghuffar2022] table III gives this number in pixels.
    """
    square, count = 0.0, 0
    for camera, points, weights in zip(adjustment.cameras, control, adjustment.control_weights, strict=True):
        kept = weights > 0
        residual = film_residuals(camera, points.film_mm, points.ground_m)[kept]
        square += float((weights[kept, None] * residual**2).sum())
        count += 2 * int(kept.sum())
    for conjugates, weights in zip(ties, adjustment.tie_weights, strict=True):
        kept = weights > 0
        ground, _ = intersect(adjustment.cameras, conjugates)
        first, second = tie_residuals(adjustment.cameras, conjugates, ground)
        residual = np.concatenate([first, second], axis=1)[kept]
        square += float((weights[kept, None] * residual**2).sum())
        count += int(kept.sum())
    return math.sqrt(square / (count - unknowns)) if count > unknowns else math.nan


def group_statistics(
    rows: Sequence[Rows], weights: Sequence[FloatArray], variances: Sequence[FloatArray], scales: Mapping[str, float]
) -> list[dict[str, Any]]:
    """Per kind of observation: variance component, redundancy and Baarda's tests of the single observations.

    Parameters
    ----------
    rows : sequence of Rows
    weights : sequence of (M,) arrays
    variances : sequence of (M, K) arrays
        Of what the rows compute, in units of their sigmas.
    scales : mapping
        By how much the sigmas of each kind were scaled.

    References
    ----------
    [Baarda1968]; a good observation exceeds 3.29 in one of a thousand cases.
    """
    found = []
    for kind in dict.fromkeys(group.kind for group in rows):
        square = redundancy = 0.0
        rejected = total = 0
        tests = []
        for group, weight, variance in zip(rows, weights, variances, strict=True):
            if group.kind != kind:
                continue
            used = weight > 0
            finite = np.isfinite(group.residuals).all(axis=1)
            total += int(finite.sum())
            rejected += int((finite & ~used).sum())
            residuals, scale = group.residuals[used], scales[kind]
            square += float((weight[used, None] * residuals**2).sum())
            redundancy += residuals.size - float((weight[used, None] * variance[used]).sum()) / scale**2
            tests.append((residuals / np.sqrt(np.maximum(scale**2 - variance[used], 1e-6 * scale**2))).ravel())
        size = np.abs(np.concatenate(tests))
        found.append(
            {
                "kind": kind,
                "count": total,
                "rejected": rejected,
                "sigma_naught": math.sqrt(square / redundancy) if redundancy > 0 else math.nan,
                "sigmas_scaled_by": scales[kind],
                "redundancy": redundancy,
                "w_tests": {"limit": BAARDA_LIMIT, "tested": size.size, "beyond": int((size > BAARDA_LIMIT).sum())},
            }
        )
    return found


def belief_statistics(
    kind: str, residuals: FloatArray, variances: FloatArray, scale: float = 1.0
) -> dict[str, Any] | None:
    """The same for what was believed of unknowns before anything was measured; None where there are no such unknowns.

    Parameters
    ----------
    kind : str
    residuals : (N,) array
        Unknowns minus what was believed, over its standard deviations.
    variances : (N,) array
        Of the unknowns, in the same units.
    scale : float
        By how much the standard deviations were scaled.
    """
    # What no observation touches keeps its belief and says nothing.
    free = scale**2 - variances
    told = free > 1e-6 * scale**2
    if not told.any():
        return None
    size = np.abs(residuals[told]) / np.sqrt(free[told])
    redundancy = float(free[told].sum()) / scale**2
    return {
        "kind": kind,
        "count": int(told.sum()),
        "rejected": 0,
        "sigma_naught": math.sqrt(float((residuals[told] ** 2).sum()) / redundancy),
        "sigmas_scaled_by": scale,
        "redundancy": redundancy,
        "w_tests": {"limit": BAARDA_LIMIT, "tested": size.size, "beyond": int((size > BAARDA_LIMIT).sum())},
    }


def plain_groups(
    adjustment: Adjustment, control: Sequence[Control], ties: Sequence[Ties]
) -> tuple[list[Rows], list[FloatArray], list[FloatArray]]:
    """Equations, weights and variances of what is computed, of an adjustment without film fields."""
    width = adjustment.unknowns
    rows = [control_rows(adjustment.cameras[i], points, i, width) for i, points in enumerate(control)]
    rows += [tie_rows(intersections(adjustment.cameras, points, width), points) for points in ties]
    variances = []
    for group in rows:
        jacobian = group.by_camera().reshape(*group.residuals.shape, width * len(group.images))
        columns = np.concatenate([np.arange(width) + width * image for image in group.images])
        variances.append(
            np.einsum("mka,ab,mkb->mk", jacobian, adjustment.covariance[np.ix_(columns, columns)], jacobian)
        )
    return rows, [*adjustment.control_weights, *adjustment.tie_weights], variances


def correlations(adjustment: Adjustment, limit: float) -> list[list[dict[str, Any]]]:
    """Pairs of unknowns correlated beyond a limit, a list per image, strongest first; all those of a focal length."""
    found = []
    width = adjustment.unknowns
    for i in range(len(adjustment.cameras)):
        block = slice(width * i, width * (i + 1))
        covariance = adjustment.covariance[block, block]
        sigma = np.sqrt(np.diag(covariance))
        correlation = covariance / sigma[:, None] / sigma
        pairs = [
            {"first": NAMES[a], "second": NAMES[b], "correlation": float(correlation[a, b])}
            for a in range(width)
            for b in range(a + 1, width)
            if abs(correlation[a, b]) > limit or NAMES[b] == "f"
        ]
        found.append(sorted(pairs, key=_strength, reverse=True))
    return found


def _strength(pair: dict[str, Any]) -> float:
    return abs(float(pair["correlation"]))


def paper_parameters(camera: PanoramicCamera) -> dict[str, float]:
    """The 13 parameters as the paper prints them: at the start of the scan, q0 = q - q1/2, km and degrees.

    References
    ----------
    [Ghuffar2022] table IV.
    """
    p = camera.parameters()
    start_position = p[0:3] - p[3:6] / 2
    start_angles = np.degrees(p[6:9] - p[9:12] / 2)
    longitude, latitude, height = camera.origin.geodetic_from_local(start_position)
    return {
        "X0_longitude_deg": float(longitude),
        "Y0_latitude_deg": float(latitude),
        "Z0_km": float(height) / 1000.0,
        "X01_km": p[3] / 1000.0,
        "Y01_km": p[4] / 1000.0,
        "Z01_km": p[5] / 1000.0,
        "omega0_deg": float(start_angles[0]),
        "phi0_deg": float(start_angles[1]),
        "kappa0_deg": float(start_angles[2]),
        "omega01_deg": camera.angles_change_deg[0],
        "phi01_deg": camera.angles_change_deg[1],
        "kappa01_deg": camera.angles_change_deg[2],
        "V_over_H_delta": camera.imc_factor,
    }


@dataclass(frozen=True)
class Compensation:
    """How the image motion of a frame was compensated, as its adjusted parameters tell.

    Parameters
    ----------
    kind : "lens", "nodding", "reversed" or "unclear"
        "lens": the lens moved (KH-4, KH-4A); "nodding": the camera nodded (KH-4B); "reversed": the parameters drive the
        image the wrong way, so that scan direction or signs are wrong; "unclear": none of them.
    lens_share, nodding_share : float
        Share of the image motion that the moved lens and the nodding each take.
    """

    kind: str
    lens_share: float
    nodding_share: float


def compensation_of(camera: PanoramicCamera) -> Compensation:
    """Verdict on image motion compensation: the lens term against V/(H delta), the nodding against V cos^2(tilt)/H.

    References
    ----------
    [Ghuffar2022] section IV.A, "Camera parameters".
    """
    height_m = float(camera.origin.geodetic_from_local(np.array(camera.position_m))[2])
    motion = GROUND_SPEED_KM_PER_SCAN * 1000.0 / height_m
    lens = camera.imc_factor / (motion * camera.focal_length_mm / camera.scan_length_mm)
    # The turn about the camera's own x axis, which the omega rate is not once kappa is large.
    p = camera.parameters()
    start, end = (rotation_matrix(p[6:9] + tau * p[9:12]) for tau in (-0.5, 0.5))
    nod = (end @ start.T)[1, 2]
    nodding = nod / (motion * math.cos(math.radians(TILT_DEG)) ** 2)
    total = lens + nodding
    if total < -0.5:
        kind = "reversed"
    elif abs(total - 1.0) > 0.5:
        kind = "unclear"
    else:
        kind = "lens" if lens > nodding else "nodding"
    return Compensation(kind, float(lens), float(nodding))


def residual_grid(
    film_mm: FloatArray,
    residuals: FloatArray,
    *,
    half_size_mm: tuple[float, float],
    step_mm: float,
    radius_mm: float,
) -> tuple[FloatArray, FloatArray]:
    """Residuals smoothed onto a regular grid of the film, by a Gaussian-weighted mean.

    Parameters
    ----------
    film_mm : (N, 2) array, mm
    residuals : (N, 2) array
    half_size_mm : half length and half width of the film
    step_mm : float
        Spacing of the grid.
    radius_mm : float
        Standard deviation of the Gaussian; a node with no point within twice that is NaN.

    Returns
    -------
    nodes_mm : (rows, columns, 2) array, mm
    smoothed : (rows, columns, 2) array
    """
    x, y = (np.linspace(-half, half, max(2, round(2 * half / step_mm) + 1)) for half in half_size_mm)
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    good = np.isfinite(residuals).all(axis=1)
    smoothed = np.full(nodes.shape, np.nan)
    if not good.any():
        return nodes, smoothed
    tree = cKDTree(film_mm[good])
    values = residuals[good]
    for index in np.ndindex(nodes.shape[:2]):
        near = tree.query_ball_point(nodes[index], 2.0 * radius_mm)
        if near:
            distance = np.linalg.norm(film_mm[good][near] - nodes[index], axis=1)
            weight = np.exp(-0.5 * (distance / radius_mm) ** 2)
            smoothed[index] = weight @ values[near] / weight.sum()
    return nodes, smoothed


def rms_per_axis(values: FloatArray) -> tuple[float, ...]:
    """Root mean square of each column; NaN left out."""
    return tuple(rms(column) for column in np.asarray(values).T)
