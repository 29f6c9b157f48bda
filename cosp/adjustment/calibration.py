"""Cameras and the distortion of their films together, from control, tie points and reference heights."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

from cosp.adjustment import fieldprior, kernels
from cosp.adjustment.observations import Control, HeightReference, Priors, Ties
from cosp.adjustment.rows import Rows, control_rows, height_rows, intersections, tie_rows
from cosp.arrays import BoolArray, FloatArray, IntArray
from cosp.camera.field import FilmField
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import CospError
from cosp.geometry.robust import huber_weights

logger = logging.getLogger(__name__)

KINDS = ("gcp", "tie", "dem")
CAMERA = kernels.CAMERA
ITERATIONS = 12
LEARNING_ITERATIONS = 3  # after these the prior and the scales stay, so that the rest can settle
SETTLED = 1e-2  # rms movement of the observations, in standard deviations
HUBER_SIGMA = 2.0
# By iteration, how many times the gate heights of the reference may be off: far from all control they start far off.
WIDE_GATES = {1: 12.0, 2: 4.0}
BELIEF_IN_SIGMAS = 20.0  # observations' worth of belief that the given sigmas are right
SCALE_LIMITS = (0.05, 5.0)
CELL_MM = 10.0  # of film; errors of points within one may be alike
CELLS_NEEDED = 30
UNITS_LEARNED_FROM = 3  # pairs that tell length and amplitude of a large block
SHARES = (0.0, 0.3, 0.6, 0.85, 0.95)
FRAMES_TO_SHARE = 3  # of one camera, before a common part can be told from their own
FRAMES_COMPARED = 4  # of each camera, to tell it


@dataclass(frozen=True)
class FieldChoices:
    """How film distortion is described.

    Parameters
    ----------
    knots_along_mm, knots_across_mm : float
        Distance of the knots of its splines.
    lengths_mm : tuple of floats
        Correlation lengths to choose from.
    """

    knots_along_mm: float
    knots_across_mm: float
    lengths_mm: tuple[float, ...]


@dataclass(frozen=True)
class FieldPrior:
    """Prior of film distortion that explains the observations best.

    Parameters
    ----------
    length_mm, amplitude_mm : float
        Correlation length along the film and standard deviation per axis.
    share : float
        Part of the variance that is common to all frames of one camera.
    """

    length_mm: float
    amplitude_mm: float
    share: float


@dataclass(frozen=True)
class Calibration:
    """A block with cameras and film fields adjusted.

    Parameters
    ----------
    cameras : tuple of PanoramicCamera
        With their fields.
    rows : tuple of Rows
        All equations at the solution.
    weights : tuple of (M,) arrays
        Robust weights of the equations, without the scales; 0 marks a gross error or a height that is not used.
    variances : tuple of (M, K) arrays
        Of what the equations compute, in units of their sigmas.
    scales : dict
        Per kind of observation, by how much its sigmas were too small.
    prior : FieldPrior
    patterns : (S, M) array
        Patterns of spline coefficients that the fields are sums of.
    covariance : (n (13 + 2 M),) * 2 array
        Of the 13 parameters of each camera followed by the weights of its patterns, x and y in turns.
    redundancy : float
    cost : float
    iterations : int
    unmodelled_mm : float
        Standard deviation per film axis of what moves heights alike within a cell of film and is too short for the
        field: flutter of the scan, what is left of bending.
    """

    cameras: tuple[PanoramicCamera, ...]
    rows: tuple[Rows, ...]
    weights: tuple[FloatArray, ...]
    variances: tuple[FloatArray, ...]
    scales: dict[str, float]
    prior: FieldPrior
    patterns: FloatArray
    covariance: FloatArray
    redundancy: float
    cost: float
    iterations: int
    unmodelled_mm: float

    @property
    def unknowns(self) -> int:
        """Number of unknowns of an image."""
        return int(CAMERA + 2 * self.patterns.shape[1])

    def camera_columns(self) -> IntArray:
        """Which of the unknowns are camera parameters, in the order of the images."""
        first = self.unknowns * np.arange(len(self.cameras))
        return np.asarray((first[:, None] + np.arange(CAMERA)).ravel())


def calibrate(
    cameras: Sequence[PanoramicCamera],
    control: Sequence[Control],
    ties: Sequence[Ties],
    *,
    reference: HeightReference | None,
    priors: Priors,
    prior_cameras: Sequence[PanoramicCamera],
    choices: FieldChoices,
    gate_sigma: float,
    control_weights: Sequence[FloatArray] | None = None,
    tie_weights: Sequence[FloatArray] | None = None,
    height_weights: Sequence[FloatArray] | None = None,
    held_out: Sequence[BoolArray] | None = None,
    film_groups: Sequence[int] | None = None,
    coupling: FloatArray | None = None,
    learned: Calibration | None = None,
) -> Calibration:
    """Film fields and cameras of a block that is already adjusted without them.

    The field of each film is a sum of patterns of a Gaussian process. Its correlation length and amplitude are those
    of the largest marginal likelihood; the sigmas of each kind of observation are scaled by variance components. Both
    are learned while the equations are solved, linearised anew, and weighed anew against gross errors. Heights of the
    reference join after the first solution, when the tie points have come to within metres of theirs.

    Parameters
    ----------
    cameras : sequence of PanoramicCamera
        Adjusted cameras in one local frame, without fields; or of an earlier calibration, which is then gone on with.
    control : sequence of Control
        One per image, without any allowance for film distortion in their sigmas.
    ties : sequence of Ties
    reference : HeightReference or None
    priors : Priors
    prior_cameras : sequence of PanoramicCamera
        Means of the priors.
    choices : FieldChoices
    gate_sigma : float
        Points beyond this many standard deviations are gross errors.
    control_weights, tie_weights, height_weights : sequences of (N,) arrays
        Robust weights of the adjustment before fields; 0 marks gross errors, and heights that are not yet to be used.
        Not needed to go on with fields.
    held_out : sequence of (N,) arrays of bool
        Tie points whose height is kept from the adjustment, to be checked with.
    film_groups : sequence of int
        Which images were taken by the same camera; such frames share part of their distortion. None do if left out.
    coupling : (13 n, 13 n) array
        Information that ties the parameters of different images together, about `prior_cameras`.
    learned : Calibration
        Of much the same block: its prior and scales are taken over.

    Raises
    ------
    CospError
        If the normal equations cannot be solved.

    References
    ----------
    [Rasmussen2006] chapter 5; [Foerstner2016] section 4.2.4 for the variance components.
    """
    flat = FilmField.flat(
        half_length_mm=max(camera.half_length_mm for camera in cameras),
        half_width_mm=max(camera.half_width_mm for camera in cameras),
        knots_along_mm=choices.knots_along_mm,
        knots_across_mm=choices.knots_across_mm,
    )
    patterns = {length: fieldprior.modes(flat, length) for length in choices.lengths_mm}
    information = np.zeros((CAMERA * len(cameras),) * 2) if coupling is None else coupling.copy()
    for i, camera in enumerate(prior_cameras):
        mine = slice(CAMERA * i, CAMERA * (i + 1))
        information[mine, mine] += priors.information(camera)
    mean = np.stack([camera.parameters() for camera in prior_cameras])

    going_on = all(camera.film_field is not None for camera in cameras)
    now = list(cameras) if going_on else [replace(camera, film_field=flat) for camera in cameras]
    scales = learned.scales if learned else dict.fromkeys(KINDS, 1.0)
    prior = learned.prior if learned else FieldPrior(choices.lengths_mm[0], fieldprior.EXPECTED_AMPLITUDE_MM, 0.0)
    to_learn = 0 if learned else LEARNING_ITERATIONS
    for iteration in range(ITERATIONS):
        near = going_on or iteration > 0
        early = height_weights is not None and any(weight.any() for weight in height_weights)
        rows = _linearise(now, control, ties, reference if near or early else None, held_out)
        wide = 1.0 if going_on else WIDE_GATES.get(iteration, 1.0)
        weights = [_weights(group, scales, gate_sigma * (wide if group.kind == "dem" else 1.0)) for group in rows]
        if not near and control_weights is not None and tie_weights is not None:
            weights = [*control_weights, *tie_weights, *(height_weights or ())][: len(rows)]
        groups = [_Normal.of(group, weight, now) for group, weight in zip(rows, weights, strict=True)]
        away = mean - np.stack([camera.parameters() for camera in now])
        block = _Block(groups, scales, len(now), information, away)
        learning = iteration < to_learn
        if learning:
            prior = block.learn_prior(patterns, film_groups, ties)
        solved = block.solve(patterns[prior.length_mm], prior, film_groups, with_covariance=learning and near)
        moved = block.movement(solved, now, patterns[prior.length_mm])
        now = solved.applied(now, patterns[prior.length_mm])
        if learning and near:
            scales = block.scales_after(solved, rows, weights, patterns[prior.length_mm])
        logger.info(
            "film fields, iteration %d: length %.0f mm, amplitude %.2f um, share %.2f; scales %s; moved %.3f sigma",
            iteration + 1,
            prior.length_mm,
            1000.0 * prior.amplitude_mm,
            prior.share,
            " ".join(f"{kind} {scale:.2f}" for kind, scale in scales.items()),
            moved,
        )
        if iteration >= to_learn and moved < SETTLED:
            break
    solved = block.solve(patterns[prior.length_mm], prior, film_groups, with_covariance=True)
    return _result(now, rows, weights, scales, prior, patterns[prior.length_mm], block, solved, iteration + 1)


def _linearise(
    cameras: Sequence[PanoramicCamera],
    control: Sequence[Control],
    ties: Sequence[Ties],
    reference: HeightReference | None,
    held_out: Sequence[BoolArray] | None,
) -> list[Rows]:
    """Control of every image, then the conditions of all tie points, then their heights."""
    rows = [
        control_rows(camera, points, image) for image, (camera, points) in enumerate(zip(cameras, control, strict=True))
    ]
    at = [intersections(cameras, points) for points in ties]
    rows += [tie_rows(where, points) for where, points in zip(at, ties, strict=True)]
    if reference is not None:
        for n, (where, points) in enumerate(zip(at, ties, strict=True)):
            heights = height_rows(where, points, cameras, reference)
            if held_out is not None:
                heights.residuals[held_out[n]] = np.nan
            rows.append(heights)
    return rows


def _weights(rows: Rows, scales: dict[str, float], gate_sigma: float) -> FloatArray:
    """Huber's weights inside the gate, nothing outside."""
    size = np.sqrt(np.mean(rows.residuals**2, axis=1)) / scales[rows.kind]
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(size <= gate_sigma, huber_weights(size, HUBER_SIGMA), 0.0))


@dataclass(frozen=True)
class _Normal:
    """Normal equations of one group in parameters and spline coefficients, the latter in total, not as changes."""

    kind: str
    images: tuple[int, ...]
    normal: FloatArray
    right: FloatArray
    reduced: dict[int, tuple[FloatArray, FloatArray]] = dataclass_field(default_factory=dict)

    @classmethod
    def of(cls, rows: Rows, weights: FloatArray, cameras: Sequence[PanoramicCamera]) -> _Normal:
        field = _field_of(cameras[0])
        width = CAMERA + 2 * field.shape[0] * field.shape[1]
        size = width * len(rows.images)
        normal, right = np.zeros((size, size)), np.zeros(size)
        splines, values = spline_values(rows, field)
        kernels.accumulate(
            rows.residuals, weights, rows.by_film, rows.by_camera(), splines, values, width, normal, right
        )
        normal = np.tril(normal) + np.tril(normal, -1).T
        present = np.concatenate(
            [np.append(np.zeros(CAMERA), _field_of(cameras[image]).coefficients) for image in rows.images]
        )
        return cls(rows.kind, rows.images, normal, right + normal @ present)

    def of_patterns(self, patterns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The same in parameters and weights of patterns; kept, since it is asked for again and again."""
        if id(patterns) not in self.reduced:
            self.reduced[id(patterns)] = self._of_patterns(patterns)
        return self.reduced[id(patterns)]

    def _of_patterns(self, patterns: FloatArray) -> tuple[FloatArray, FloatArray]:
        by_pattern = np.kron(patterns, np.eye(2))
        width = CAMERA + len(by_pattern)
        blocks = self.normal.reshape(len(self.images), width, len(self.images), width)
        rows = np.concatenate([blocks[:, :CAMERA], _left(by_pattern, blocks[:, CAMERA:])], axis=1)
        both = np.concatenate([rows[..., :CAMERA], rows[..., CAMERA:] @ by_pattern], axis=-1)
        right = self.right.reshape(-1, width)
        reduced = CAMERA + by_pattern.shape[1]
        return (
            both.reshape(len(self.images) * reduced, -1),
            np.concatenate([right[:, :CAMERA], right[:, CAMERA:] @ by_pattern], axis=1).ravel(),
        )


def spline_values(rows: Rows, field: FilmField) -> tuple[IntArray, FloatArray]:
    """Numbers and values (M, I, 12) of the splines at the film points of equations."""
    splines, values = field.basis(rows.imaged_mm.reshape(-1, 2))
    shape = (*rows.imaged_mm.shape[:2], splines.shape[1])
    return splines.reshape(shape), values.reshape(shape)


def _left(by_pattern: FloatArray, blocks: FloatArray) -> FloatArray:
    """Transposed patterns times the second axis of (I, S, I, W) blocks."""
    images, splines, _, width = blocks.shape
    product = by_pattern.T @ blocks.reshape(images, splines, images * width)
    return np.asarray(product.reshape(images, -1, images, width))


def _field_of(camera: PanoramicCamera) -> FilmField:
    if camera.film_field is None:
        raise ValueError(f"{camera.scene} has no film field")
    return camera.film_field


@dataclass(frozen=True)
class _Solved:
    """Changes of the parameters (n, 13), weights of the patterns (n, M, 2), covariance and cost."""

    parameters: FloatArray
    pattern_weights: FloatArray
    covariance: FloatArray
    cost: float

    def applied(self, cameras: Sequence[PanoramicCamera], patterns: FloatArray) -> list[PanoramicCamera]:
        return [
            replace(
                camera.with_parameters(camera.parameters() + change),
                film_field=_field_of(camera).with_coefficients(patterns @ weights),
            )
            for camera, change, weights in zip(cameras, self.parameters, self.pattern_weights, strict=True)
        ]


class _Block:
    """Normal equations of all groups and what is believed of the cameras."""

    def __init__(
        self,
        groups: list[_Normal],
        scales: dict[str, float],
        images: int,
        information: FloatArray,
        away: FloatArray,
    ) -> None:
        self.groups = groups
        self.scales = scales
        self.images = images
        self.information = information
        self.away = away.ravel()

    def learn_prior(
        self, patterns: dict[float, FloatArray], film_groups: Sequence[int] | None, ties: Sequence[Ties]
    ) -> FieldPrior:
        """Length, amplitude and common part with the largest marginal likelihood."""
        pairs: list[tuple[int, ...]] = [(points.first, points.second) for points in ties if not points.neighbours]
        units = pairs or [(image,) for image in range(self.images)]
        units = sorted(set(units), key=self._control_in, reverse=True)[:UNITS_LEARNED_FROM]
        found = {
            length: np.sum([self._evidence(unit, basis) for unit in units], axis=0)
            for length, basis in patterns.items()
        }
        length = max(found, key=lambda key: float(found[key].max()))
        amplitude = float(fieldprior.AMPLITUDES_MM[int(np.argmax(found[length]))])
        prior = FieldPrior(length, amplitude, 0.0)
        if film_groups is None or max(np.bincount(film_groups)) < FRAMES_TO_SHARE:
            return prior
        images = self._frames_to_compare(film_groups)
        tried = [replace(prior, share=share) for share in SHARES]
        return max(tried, key=lambda one: self._evidence_of_share(patterns[length], one, film_groups, images))

    def _frames_to_compare(self, film_groups: Sequence[int]) -> list[int]:
        """Of each camera the frames with most control, so many as tell what they have in common."""
        images: list[int] = []
        for camera in sorted(set(film_groups)):
            mine = [image for image in range(self.images) if film_groups[image] == camera]
            images += sorted(mine, key=lambda image: self._control_in((image,)), reverse=True)[:FRAMES_COMPARED]
        return sorted(images)

    def _control_in(self, unit: tuple[int, ...]) -> float:
        """Information of control on the first film coordinates, as a measure of how much there is."""
        return float(
            sum(np.trace(group.normal) for group in self.groups if group.kind == "gcp" and group.images[0] in unit)
        )

    def assemble(self, patterns: FloatArray, images: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Normal equations of some of the images, without any prior; groups that touch others are left out."""
        width = CAMERA + 2 * patterns.shape[1]
        place = {image: n for n, image in enumerate(images)}
        normal, right = np.zeros((len(images) * width,) * 2), np.zeros(len(images) * width)
        for group in self.groups:
            if not set(group.images) <= set(images):
                continue
            columns = np.concatenate([np.arange(width) + width * place[image] for image in group.images])
            matrix, side = group.of_patterns(patterns)
            weight = 1.0 / self.scales[group.kind] ** 2
            normal[np.ix_(columns, columns)] += weight * matrix
            right[columns] += weight * side
        return normal, right

    def _evidence(self, unit: Sequence[int], patterns: FloatArray) -> FloatArray:
        normal, right = self.assemble(patterns, unit)
        cameras = _camera_columns(len(unit), normal)
        mine = np.concatenate([np.arange(CAMERA) + CAMERA * image for image in unit])
        normal[np.ix_(cameras, cameras)] += self.information[np.ix_(mine, mine)]
        right[cameras] += self.information[np.ix_(mine, mine)] @ self.away[mine]
        fields = np.setdiff1d(np.arange(len(normal)), cameras)
        inner = _solve(
            normal[np.ix_(cameras, cameras)], np.column_stack([normal[np.ix_(cameras, fields)], right[cameras]])
        )
        reduced = normal[np.ix_(fields, fields)] - normal[np.ix_(fields, cameras)] @ inner[:, :-1]
        return fieldprior.log_evidence(reduced, right[fields] - normal[np.ix_(fields, cameras)] @ inner[:, -1])

    def _with_priors(
        self, patterns: FloatArray, prior: FieldPrior, film_groups: Sequence[int] | None, images: Sequence[int]
    ) -> tuple[FloatArray, FloatArray, float]:
        """Normal equations of images with the priors, and the log determinant of the fields' prior information."""
        normal, right = self.assemble(patterns, images)
        cameras = _camera_columns(len(images), normal)
        mine = np.concatenate([np.arange(CAMERA) + CAMERA * image for image in images])
        information = self.information[np.ix_(mine, mine)]
        normal[np.ix_(cameras, cameras)] += information
        right[cameras] += information @ self.away[mine]
        correlation = np.eye(len(images))
        if film_groups is not None and prior.share > 0.0:
            camera = np.asarray(film_groups)[list(images)]
            same = np.equal.outer(camera, camera)
            correlation = np.where(same, prior.share, 0.0) + (1.0 - prior.share) * correlation
        precision = np.linalg.inv(correlation) / prior.amplitude_mm**2
        width = len(normal) // len(images)
        fields = np.arange(CAMERA, width)
        for i, j in zip(*np.nonzero(precision), strict=True):
            normal[width * i + fields, width * j + fields] += precision[i, j]
        return normal, right, len(fields) * float(np.linalg.slogdet(precision)[1])

    def _evidence_of_share(
        self, patterns: FloatArray, prior: FieldPrior, film_groups: Sequence[int], images: Sequence[int]
    ) -> float:
        normal, right, determinant = self._with_priors(patterns, prior, film_groups, images)
        factor, scale = _factor(normal)
        solution = scale * cho_solve(factor, scale * right)
        log_normal = 2.0 * float(np.log(np.diag(factor[0])).sum() - np.log(scale).sum())
        return 0.5 * (float(right @ solution) + determinant - log_normal)

    def solve(
        self, patterns: FloatArray, prior: FieldPrior, film_groups: Sequence[int] | None, with_covariance: bool
    ) -> _Solved:
        normal, right, _ = self._with_priors(patterns, prior, film_groups, range(self.images))
        factor, scale = _factor(normal)
        found = (scale * cho_solve(factor, scale * right)).reshape(self.images, -1)
        weights = found[:, CAMERA:].reshape(self.images, -1, 2)
        covariance = _inverse(factor[0], scale) if with_covariance else np.empty((0, 0))
        return _Solved(found[:, :CAMERA], weights, covariance, -float(right @ found.ravel()))

    def movement(self, solved: _Solved, cameras: Sequence[PanoramicCamera], patterns: FloatArray) -> float:
        """Rms movement of the observations by a solution, in standard deviations."""
        steps = []
        for camera, change, weights in zip(cameras, solved.parameters, solved.pattern_weights, strict=True):
            field = patterns @ weights - _field_of(camera).coefficients.reshape(-1, 2)
            steps.append(np.append(change, field))
        square = count = 0.0
        for group in self.groups:
            step = np.concatenate([steps[image] for image in group.images])
            square += float(step @ group.normal @ step) / self.scales[group.kind] ** 2
            count += len(step)
        return float(np.sqrt(square / count))

    def scales_after(
        self, solved: _Solved, rows: Sequence[Rows], weights: Sequence[FloatArray], patterns: FloatArray
    ) -> dict[str, float]:
        """Variance components: by how much the residuals of each kind exceed their sigmas.

        Where residuals of a cell of film are alike, their mean says less than its points: the scale is the larger one
        of that of single points and that of cells.
        """
        width = CAMERA + 2 * patterns.shape[1]
        square = dict.fromkeys(KINDS, BELIEF_IN_SIGMAS)
        redundancy = dict.fromkeys(KINDS, BELIEF_IN_SIGMAS)
        of_cells: dict[str, list[FloatArray]] = {kind: [] for kind in KINDS}
        for group, equations, weight in zip(self.groups, rows, weights, strict=True):
            columns = np.concatenate([np.arange(width) + width * image for image in group.images])
            taken = float((group.of_patterns(patterns)[0] * solved.covariance[np.ix_(columns, columns)]).sum())
            used = weight > 0
            residuals = equations.residuals[used]
            square[group.kind] += float((weight[used, None] * residuals**2).sum())
            redundancy[group.kind] += residuals.size - taken / self.scales[group.kind] ** 2
            of_cells[group.kind].append(_cell_sums(equations, weight))
        scales = {}
        for kind in KINDS:
            variance = square[kind] / max(redundancy[kind], 1.0)
            cells = np.concatenate([np.empty(0), *of_cells[kind]])
            if len(cells) >= CELLS_NEEDED:
                variance = max(variance, float(np.mean(cells**2)))
            scales[kind] = float(np.clip(np.sqrt(variance), *SCALE_LIMITS))
        return scales


def _cells(rows: Rows, used: BoolArray) -> IntArray:
    """Number of the cell of the first film that each used row lies in."""
    cell = np.floor(rows.imaged_mm[used, 0] / CELL_MM)
    return np.asarray(np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1))


def _cell_sums(rows: Rows, weights: FloatArray) -> FloatArray:
    """Sums of residuals over cells of two or more, divided so that independent residuals keep their variance."""
    used = weights > 0
    cell = _cells(rows, used)
    length = np.sqrt(np.bincount(cell, weights[used] ** 2))
    several = np.bincount(cell) >= 2
    sums = [
        np.bincount(cell, weights[used] * residual)[several] / length[several] for residual in rows.residuals[used].T
    ]
    return np.concatenate([np.empty(0), *sums])


def unmodelled_mm(rows: Sequence[Rows], weights: Sequence[FloatArray]) -> float:
    """What residual heights of cells of film have in common, as a displacement on the films, per axis.

    The variance of the means of cells is that of single residuals over their number, and this.
    """
    excess = []
    for group, weight in zip(rows, weights, strict=True):
        used = weight > 0
        if group.kind != "dem" or not used.any():
            continue
        cell = _cells(group, used)
        displacement = group.residuals[used, 0] / np.linalg.norm(group.by_film[used, 0].reshape(-1, 4), axis=1)
        count = np.bincount(cell)
        mean = np.bincount(cell, displacement) / count
        inside = (displacement - mean[cell]) ** 2
        variance = float(inside.sum()) / max(len(cell) - len(count), 1)
        several = count >= 2
        excess.append(mean[several] ** 2 - variance / count[several])
    found = np.concatenate([np.empty(0), *excess])
    return float(np.sqrt(max(found.mean(), 0.0))) if len(found) >= CELLS_NEEDED else 0.0


def _result(
    cameras: list[PanoramicCamera],
    rows: list[Rows],
    weights: list[FloatArray],
    scales: dict[str, float],
    prior: FieldPrior,
    patterns: FloatArray,
    block: _Block,
    solved: _Solved,
    iterations: int,
) -> Calibration:
    used = sum(int((weight > 0).sum()) * group.residuals.shape[1] for group, weight in zip(rows, weights, strict=True))
    taken = 0.0
    variances = []
    for group, equations in zip(block.groups, rows, strict=True):
        variance = computed_variances(equations, solved.covariance, patterns, _field_of(cameras[0]))
        variances.append(variance)
        width = CAMERA + 2 * patterns.shape[1]
        columns = np.concatenate([np.arange(width) + width * image for image in group.images])
        share = (group.of_patterns(patterns)[0] * solved.covariance[np.ix_(columns, columns)]).sum()
        taken += float(share) / scales[group.kind] ** 2
    return Calibration(
        cameras=tuple(cameras),
        rows=tuple(rows),
        weights=tuple(weights),
        variances=tuple(variances),
        scales=scales,
        prior=prior,
        patterns=patterns,
        covariance=solved.covariance,
        redundancy=used - taken,
        cost=solved.cost,
        iterations=iterations,
        unmodelled_mm=unmodelled_mm(rows, weights),
    )


def computed_variances(rows: Rows, covariance: FloatArray, patterns: FloatArray, field: FilmField) -> FloatArray:
    """Variances (M, K) of what equations compute, from the covariance of cameras and patterns of all images."""
    by_pattern = np.kron(patterns, np.eye(2))
    width = CAMERA + by_pattern.shape[1]
    columns = np.concatenate([np.arange(width) + width * image for image in rows.images])
    mine = covariance[np.ix_(columns, columns)].reshape(len(rows.images), width, len(rows.images), width)
    # Back from patterns to splines, so that a row touches few of them.
    left = np.concatenate([mine[:, :CAMERA], _left(by_pattern.T, mine[:, CAMERA:])], axis=1)
    whole = np.concatenate([left[..., :CAMERA], left[..., CAMERA:] @ by_pattern.T], axis=-1)
    splines, values = spline_values(rows, field)
    variance = np.empty(rows.by_film.shape[:2])
    size = len(rows.images) * (CAMERA + len(by_pattern))
    kernels.variances(
        rows.by_film,
        rows.by_camera(),
        splines,
        values,
        CAMERA + len(by_pattern),
        np.ascontiguousarray(whole.reshape(size, size)),
        variance,
    )
    return variance


def _camera_columns(images: int, normal: FloatArray) -> IntArray:
    width = len(normal) // images
    return np.asarray((width * np.arange(images)[:, None] + np.arange(CAMERA)).ravel())


def _factor(normal: FloatArray) -> tuple[tuple[FloatArray, bool], FloatArray]:
    """Cholesky factor of a normal matrix scaled to unit diagonal, and the scale; the matrix is used up."""
    scale: FloatArray = 1.0 / np.sqrt(np.diag(normal))
    # In place and by columns, as the factorisation wants it: large blocks have matrices of a gigabyte.
    normal *= scale[:, None]
    normal *= scale
    try:
        return cho_factor(normal.T, lower=True, overwrite_a=True), scale
    except LinAlgError as error:
        raise CospError("the normal equations of cameras and film fields cannot be solved") from error


def _inverse(factor: FloatArray, scale: FloatArray) -> FloatArray:
    """Inverse of a normal matrix from its factor, which is used up."""
    covariance, _ = dpotri(factor, lower=1, overwrite_c=1)
    for column in range(len(covariance)):
        covariance[column, column:] = covariance[column:, column]
    covariance *= scale[:, None]
    covariance *= scale
    return np.asarray(covariance)


def _solve(normal: FloatArray, right: FloatArray) -> FloatArray:
    factor, scale = _factor(normal)
    return np.asarray(scale[:, None] * cho_solve(factor, scale[:, None] * right))
