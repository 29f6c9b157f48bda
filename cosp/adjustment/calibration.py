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
from cosp.adjustment.fieldprior import FieldBasis, Joints
from cosp.adjustment.observations import Control, HeightReference, Priors, Ties
from cosp.adjustment.rows import Rows, control_rows, height_rows, intersections, tie_rows
from cosp.adjustment.unknowns import PARAMETERS, values_of, with_values
from cosp.arrays import BoolArray, FloatArray, IntArray
from cosp.camera.field import FilmField
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import CospError
from cosp.geometry.robust import huber_weights

logger = logging.getLogger(__name__)

KINDS = ("gcp", "tie", "dem", "step")
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
ALONG_INFORMATION = 1e8  # of patterns of bending along the film, where there is none


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
        Per kind of observation, by how much its sigmas were too small; "step": those of the pieces of film.
    prior : FieldPrior
    basis : FieldBasis
        Patterns that the fields are sums of.
    pattern_weights : (n, K, 2) array
    covariance : (n (P + 2 K),) * 2 array
        Of the P unknowns of each camera followed by the weights of its K patterns, x and y in turns.
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
    basis: FieldBasis
    pattern_weights: FloatArray
    covariance: FloatArray
    redundancy: float
    cost: float
    iterations: int
    unmodelled_mm: float

    @property
    def unknowns(self) -> int:
        """Number of unknowns of an image."""
        return len(self.covariance) // len(self.cameras)

    def camera_columns(self) -> IntArray:
        """Which of the unknowns are those of cameras, in the order of the images."""
        return _camera_columns(len(self.cameras), self.unknowns, 2 * self.basis.count)

    def step_columns(self) -> IntArray:
        """Which of the unknowns are weights of patterns that move pieces of film."""
        return _step_columns(len(self.cameras), self.unknowns, self.basis)

    def variances_of(self, rows: Rows) -> FloatArray:
        """Variances (M, K) of what equations compute."""
        return computed_variances(rows, self.covariance, self.basis, [_field_of(camera) for camera in self.cameras])

    def steps(self, image: int) -> list[FilmStep]:
        """Steps at the joints of a film, with their standard deviations."""
        field = _field_of(self.cameras[image])
        if field.steps is None:
            return []
        splines = field.shape[0] * field.shape[1]
        # Both components of both edges of every piece.
        pieces = self.basis.by_component[image][2 * splines : 2 * field.functions]
        first = self.unknowns * (image + 1) - 2 * self.basis.count
        mine = slice(first, first + 2 * self.basis.count)
        covariance = pieces @ self.covariance[mine, mine] @ pieces.T
        moves = pieces[:, 2 * (self.basis.count - self.basis.steps) :]
        given = self.scales["step"] ** 2 * moves @ moves.T
        middle = np.kron(np.array([[0.5, 0.5]]), np.eye(2))
        found = []
        for k, x_mm in enumerate(field.steps.joints_mm):
            change = np.zeros((2, len(pieces)))
            change[:, 4 * k : 4 * k + 4], change[:, 4 * k + 4 : 4 * k + 8] = -middle, middle
            step = change @ field.steps.offsets.ravel()
            known, believed = (np.diag(change @ of @ change.T) for of in (covariance, given))
            found.append(
                FilmStep(
                    x_mm,
                    (float(step[0]), float(step[1])),
                    (float(np.sqrt(known[0])), float(np.sqrt(known[1]))),
                    (float(np.sqrt(believed[0])), float(np.sqrt(believed[1]))),
                )
            )
        return found


@dataclass(frozen=True)
class FilmStep:
    """By how much the film steps at a joint, in the middle of its width.

    Parameters
    ----------
    x_mm : float
    step_mm : two floats
        Along and across the film, from left to right.
    sigma_mm : two floats
        Standard deviations.
    prior_sigma_mm : two floats
        Before anything was measured.
    """

    x_mm: float
    step_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    prior_sigma_mm: tuple[float, float]


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
    joints: Sequence[Joints] | None = None,
    bending_mm: Sequence[float] | None = None,
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
    coupling : (P n, P n) array
        Information that ties the unknowns of different images together, about `prior_cameras`. Its size says whether
        the focal lengths are unknowns too: P is 13 or 14.
    joints : sequence of Joints
        Of every film: where its pieces may be off. None are if left out.
    bending_mm : sequence of float
        Standard deviation of the bending that straightening left of every film; none if left out.
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
    joints = [Joints() for _ in cameras] if joints is None else joints
    fields = [fieldprior.field_with_pieces(flat, own) for own in joints]
    bases = {length: FieldBasis.of(fields, joints, length, bending_mm) for length in choices.lengths_mm}
    information = np.zeros((PARAMETERS * len(cameras),) * 2) if coupling is None else coupling.copy()
    width = len(information) // len(cameras)
    for i, camera in enumerate(prior_cameras):
        mine = slice(width * i, width * i + PARAMETERS)
        information[mine, mine] += priors.information(camera)
    mean = np.stack([values_of(camera, width) for camera in prior_cameras])

    going_on = all(camera.film_field is not None for camera in cameras)
    now = [
        camera if going_on else replace(camera, film_field=field) for camera, field in zip(cameras, fields, strict=True)
    ]
    scales = learned.scales if learned else dict.fromkeys(KINDS, 1.0)
    prior = learned.prior if learned else FieldPrior(choices.lengths_mm[0], fieldprior.EXPECTED_AMPLITUDE_MM, 0.0)
    to_learn = 0 if learned else LEARNING_ITERATIONS
    for iteration in range(ITERATIONS):
        near = going_on or iteration > 0
        early = height_weights is not None and any(weight.any() for weight in height_weights)
        rows = _linearise(now, control, ties, reference if near or early else None, held_out, width)
        wide = 1.0 if going_on else WIDE_GATES.get(iteration, 1.0)
        weights = [_weights(group, scales, gate_sigma * (wide if group.kind == "dem" else 1.0)) for group in rows]
        if not near and control_weights is not None and tie_weights is not None:
            weights = [*control_weights, *tie_weights, *(height_weights or ())][: len(rows)]
        groups = [_Normal.of(group, weight, now) for group, weight in zip(rows, weights, strict=True)]
        away = mean - np.stack([values_of(camera, width) for camera in now])
        block = _Block(groups, scales, len(now), information, away)
        learning = iteration < to_learn
        if learning:
            prior = block.learn_prior(bases, film_groups, ties)
        basis = bases[prior.length_mm]
        solved = block.solve(basis, prior, film_groups, with_covariance=learning and near)
        moved = block.movement(solved, now, basis)
        now = solved.applied(now, basis)
        if learning and near:
            scales = block.scales_after(solved, rows, weights, basis)
        logger.info(
            "film fields, iteration %d: length %.0f mm, amplitude %.2f um, share %.2f; scales %s; moved %.3f sigma",
            iteration + 1,
            prior.length_mm,
            1000.0 * prior.amplitude_mm,
            prior.share,
            " ".join(f"{kind} {scale:.2f}" for kind, scale in scales.items()),
            moved,
        )
        if (iteration >= to_learn and moved < SETTLED) or iteration + 1 == ITERATIONS:
            break
        # A gigabyte or two in large blocks, before the next ones are built.
        groups.clear()
        solved = replace(solved, covariance=np.empty((0, 0)))
    solved = block.solve(basis, prior, film_groups, with_covariance=True)
    return _result(now, rows, weights, scales, prior, basis, block, solved, iteration + 1)


def _linearise(
    cameras: Sequence[PanoramicCamera],
    control: Sequence[Control],
    ties: Sequence[Ties],
    reference: HeightReference | None,
    held_out: Sequence[BoolArray] | None,
    unknowns: int,
) -> list[Rows]:
    """Control of every image, then the conditions of all tie points, then their heights."""
    rows = [
        control_rows(camera, points, image, unknowns)
        for image, (camera, points) in enumerate(zip(cameras, control, strict=True))
    ]
    at = [intersections(cameras, points, unknowns) for points in ties]
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
    """Normal equations of one group in cameras and functions of the fields, the latter in total, not as changes."""

    kind: str
    images: tuple[int, ...]
    normal: FloatArray
    right: FloatArray
    reduced: dict[int, tuple[FloatArray, FloatArray]] = dataclass_field(default_factory=dict)

    @classmethod
    def of(cls, rows: Rows, weights: FloatArray, cameras: Sequence[PanoramicCamera]) -> _Normal:
        fields = [_field_of(camera) for camera in cameras]
        functions = max(field.functions for field in fields)
        by_camera = rows.by_camera()
        unknowns = by_camera.shape[-1]
        width = unknowns + 2 * functions
        size = width * len(rows.images)
        normal, right = np.zeros((size, size)), np.zeros(size)
        kernels.accumulate(
            rows.residuals, weights, rows.by_film, by_camera, *function_values(rows, fields), width, normal, right
        )
        normal = np.tril(normal) + np.tril(normal, -1).T
        present = np.zeros((len(rows.images), width))
        for place, image in zip(present, rows.images, strict=True):
            place[unknowns : unknowns + 2 * fields[image].functions] = fields[image].amounts.ravel()
        return cls(rows.kind, rows.images, normal, right + normal @ present.ravel())

    def of_patterns(self, basis: FieldBasis) -> tuple[FloatArray, FloatArray]:
        """The same in cameras and weights of patterns; kept, since it is asked for again and again."""
        if id(basis) not in self.reduced:
            self.reduced[id(basis)] = self._of_patterns(basis)
        return self.reduced[id(basis)]

    def _of_patterns(self, basis: FieldBasis) -> tuple[FloatArray, FloatArray]:
        width = len(self.normal) // len(self.images)
        unknowns = width - 2 * basis.functions
        to_patterns = [basis.by_component[image] for image in self.images]
        return (
            _in_other_unknowns(self.normal, unknowns, to_patterns),
            np.concatenate(
                [
                    np.append(part[:unknowns], part[unknowns:] @ by_pattern)
                    for part, by_pattern in zip(self.right.reshape(-1, width), to_patterns, strict=True)
                ]
            ),
        )


def function_values(rows: Rows, fields: Sequence[FilmField]) -> tuple[IntArray, FloatArray]:
    """Numbers and values (M, I, S) of the functions of the films' fields at the film points of equations."""
    found = [fields[image].basis(rows.imaged_mm[:, n]) for n, image in enumerate(rows.images)]
    most = max(values.shape[1] for _, values in found)
    functions = np.zeros((len(rows.residuals), len(found), most), dtype=np.int64)
    values = np.zeros(functions.shape)
    for n, (which, how_much) in enumerate(found):
        functions[:, n, : which.shape[1]] = which
        values[:, n, : which.shape[1]] = how_much
    return functions, values


def _in_other_unknowns(matrix: FloatArray, unknowns: int, transforms: Sequence[FloatArray]) -> FloatArray:
    """A symmetric matrix of the cameras' and other unknowns of some images, the others transformed: T' M T.

    Parameters
    ----------
    matrix : (I (P + A), I (P + A)) array
    unknowns : int
        P, those of a camera, which stay.
    transforms : sequence of (A, B) arrays
        Of every image.
    """
    width = len(matrix) // len(transforms)
    bands = []
    for a, left in enumerate(transforms):
        band = matrix[width * a : width * (a + 1)]
        band = np.concatenate([band[:unknowns], left.T @ band[unknowns:]])
        parts = []
        for b, right in enumerate(transforms):
            part = band[:, width * b : width * (b + 1)]
            parts += [part[:, :unknowns], part[:, unknowns:] @ right]
        bands.append(np.concatenate(parts, axis=1))
    return np.concatenate(bands)


def _field_of(camera: PanoramicCamera) -> FilmField:
    if camera.film_field is None:
        raise ValueError(f"{camera.scene} has no film field")
    return camera.film_field


@dataclass(frozen=True)
class _Solved:
    """Changes of the cameras' unknowns (n, P), weights of the patterns (n, K, 2), covariance and cost."""

    parameters: FloatArray
    pattern_weights: FloatArray
    covariance: FloatArray
    cost: float

    def applied(self, cameras: Sequence[PanoramicCamera], basis: FieldBasis) -> list[PanoramicCamera]:
        width = self.parameters.shape[1]
        changed = []
        for image, camera in enumerate(cameras):
            field = _field_of(camera)
            amounts = basis.amounts(image, self.pattern_weights[image])[: field.functions]
            moved = with_values(camera, values_of(camera, width) + self.parameters[image])
            changed.append(replace(moved, film_field=field.with_amounts(amounts)))
        return changed


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
        self.unknowns = len(information) // images  # of a camera
        self.information = information
        self.away = away.ravel()

    def learn_prior(
        self, bases: dict[float, FieldBasis], film_groups: Sequence[int] | None, ties: Sequence[Ties]
    ) -> FieldPrior:
        """Length, amplitude and common part with the largest marginal likelihood."""
        pairs: list[tuple[int, ...]] = [(points.first, points.second) for points in ties if not points.neighbours]
        units = pairs or [(image,) for image in range(self.images)]
        units = sorted(set(units), key=self._control_in, reverse=True)[:UNITS_LEARNED_FROM]
        found = {
            length: np.sum([self._evidence(unit, basis) for unit in units], axis=0) for length, basis in bases.items()
        }
        length = max(found, key=lambda key: float(found[key].max()))
        amplitude = float(fieldprior.AMPLITUDES_MM[int(np.argmax(found[length]))])
        prior = FieldPrior(length, amplitude, 0.0)
        if film_groups is None or max(np.bincount(film_groups)) < FRAMES_TO_SHARE:
            return prior
        images = self._frames_to_compare(film_groups)
        tried = [replace(prior, share=share) for share in SHARES]
        return max(tried, key=lambda one: self._evidence_of_share(bases[length], one, film_groups, images))

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

    def assemble(self, basis: FieldBasis, images: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Normal equations of some of the images, without any prior; groups that touch others are left out."""
        width = self.unknowns + 2 * basis.count
        place = {image: n for n, image in enumerate(images)}
        normal, right = np.zeros((len(images) * width,) * 2), np.zeros(len(images) * width)
        for group in self.groups:
            if not set(group.images) <= set(images):
                continue
            columns = np.concatenate([np.arange(width) + width * place[image] for image in group.images])
            matrix, side = group.of_patterns(basis)
            weight = 1.0 / self.scales[group.kind] ** 2
            normal[np.ix_(columns, columns)] += weight * matrix
            right[columns] += weight * side
        return normal, right

    def _with_information(self, basis: FieldBasis, images: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Normal equations of some of the images with what is believed of cameras and pieces of film."""
        normal, right = self.assemble(basis, images)
        cameras = _camera_columns(len(images), self.unknowns + 2 * basis.count, 2 * basis.count)
        mine = np.concatenate([np.arange(self.unknowns) + self.unknowns * image for image in images])
        information = self.information[np.ix_(mine, mine)]
        normal[np.ix_(cameras, cameras)] += information
        right[cameras] += information @ self.away[mine]
        width = self.unknowns + 2 * basis.count
        steps = _step_columns(len(images), width, basis)
        normal[steps, steps] += 1.0 / self.scales["step"] ** 2
        bends = width * np.arange(len(images))[:, None] + self.unknowns + 2 * (basis.smooth + np.arange(basis.bends))
        normal[bends, bends] += ALONG_INFORMATION
        normal[bends + 1, bends + 1] += 1.0
        return normal, right

    def _evidence(self, unit: Sequence[int], basis: FieldBasis) -> FloatArray:
        normal, right = self._with_information(basis, unit)
        width = self.unknowns + 2 * basis.count
        first = width * np.arange(len(unit))[:, None] + self.unknowns
        fields = (first + np.arange(2 * basis.smooth)).ravel()
        others = np.setdiff1d(np.arange(len(normal)), fields)
        inner = _solve(normal[np.ix_(others, others)], np.column_stack([normal[np.ix_(others, fields)], right[others]]))
        reduced = normal[np.ix_(fields, fields)] - normal[np.ix_(fields, others)] @ inner[:, :-1]
        return fieldprior.log_evidence(reduced, right[fields] - normal[np.ix_(fields, others)] @ inner[:, -1])

    def _with_priors(
        self, basis: FieldBasis, prior: FieldPrior, film_groups: Sequence[int] | None, images: Sequence[int]
    ) -> tuple[FloatArray, FloatArray, float]:
        """Normal equations of images with the priors, and the log determinant of the fields' prior information."""
        normal, right = self._with_information(basis, images)
        correlation = np.eye(len(images))
        if film_groups is not None and prior.share > 0.0:
            camera = np.asarray(film_groups)[list(images)]
            same = np.equal.outer(camera, camera)
            correlation = np.where(same, prior.share, 0.0) + (1.0 - prior.share) * correlation
        precision = np.linalg.inv(correlation) / prior.amplitude_mm**2
        width = len(normal) // len(images)
        fields = self.unknowns + np.arange(2 * basis.smooth)
        for i, j in zip(*np.nonzero(precision), strict=True):
            normal[width * i + fields, width * j + fields] += precision[i, j]
        return normal, right, len(fields) * float(np.linalg.slogdet(precision)[1])

    def _evidence_of_share(
        self, basis: FieldBasis, prior: FieldPrior, film_groups: Sequence[int], images: Sequence[int]
    ) -> float:
        normal, right, determinant = self._with_priors(basis, prior, film_groups, images)
        factor, scale = _factor(normal)
        solution = scale * cho_solve(factor, scale * right)
        log_normal = 2.0 * float(np.log(np.diag(factor[0])).sum() - np.log(scale).sum())
        return 0.5 * (float(right @ solution) + determinant - log_normal)

    def solve(
        self, basis: FieldBasis, prior: FieldPrior, film_groups: Sequence[int] | None, with_covariance: bool
    ) -> _Solved:
        normal, right, _ = self._with_priors(basis, prior, film_groups, range(self.images))
        factor, scale = _factor(normal)
        found = (scale * cho_solve(factor, scale * right)).reshape(self.images, -1)
        weights = found[:, self.unknowns :].reshape(self.images, -1, 2)
        covariance = _inverse(factor[0], scale) if with_covariance else np.empty((0, 0))
        return _Solved(found[:, : self.unknowns], weights, covariance, -float(right @ found.ravel()))

    def movement(self, solved: _Solved, cameras: Sequence[PanoramicCamera], basis: FieldBasis) -> float:
        """Rms movement of the observations by a solution, in standard deviations."""
        steps = []
        for image, camera in enumerate(cameras):
            field = basis.amounts(image, solved.pattern_weights[image])
            field[: _field_of(camera).functions] -= _field_of(camera).amounts
            steps.append(np.append(solved.parameters[image], field))
        square = count = 0.0
        for group in self.groups:
            step = np.concatenate([steps[image] for image in group.images])
            square += float(step @ group.normal @ step) / self.scales[group.kind] ** 2
            count += len(step)
        return float(np.sqrt(square / count))

    def scales_after(
        self, solved: _Solved, rows: Sequence[Rows], weights: Sequence[FloatArray], basis: FieldBasis
    ) -> dict[str, float]:
        """Variance components: by how much the residuals of each kind exceed their sigmas.

        Where residuals of a cell of film are alike, their mean says less than its points: the scale is the larger one
        of that of single points and that of cells.
        """
        width = self.unknowns + 2 * basis.count
        square = dict.fromkeys(KINDS, BELIEF_IN_SIGMAS)
        redundancy = dict.fromkeys(KINDS, BELIEF_IN_SIGMAS)
        of_cells: dict[str, list[FloatArray]] = {kind: [] for kind in KINDS}
        for group, equations, weight in zip(self.groups, rows, weights, strict=True):
            columns = np.concatenate([np.arange(width) + width * image for image in group.images])
            taken = float((group.of_patterns(basis)[0] * solved.covariance[np.ix_(columns, columns)]).sum())
            used = weight > 0
            residuals = equations.residuals[used]
            square[group.kind] += float((weight[used, None] * residuals**2).sum())
            redundancy[group.kind] += residuals.size - taken / self.scales[group.kind] ** 2
            of_cells[group.kind].append(_cell_sums(equations, weight))
        steps = _step_columns(self.images, width, basis)
        square["step"] += float((solved.pattern_weights[:, basis.count - basis.steps :] ** 2).sum())
        redundancy["step"] += float((1.0 - solved.covariance[steps, steps] / self.scales["step"] ** 2).sum())
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
    basis: FieldBasis,
    block: _Block,
    solved: _Solved,
    iterations: int,
) -> Calibration:
    used = sum(int((weight > 0).sum()) * group.residuals.shape[1] for group, weight in zip(rows, weights, strict=True))
    taken = 0.0
    variances = []
    fields = [_field_of(camera) for camera in cameras]
    for group, equations in zip(block.groups, rows, strict=True):
        variances.append(computed_variances(equations, solved.covariance, basis, fields))
        width = block.unknowns + 2 * basis.count
        columns = np.concatenate([np.arange(width) + width * image for image in group.images])
        share = (group.of_patterns(basis)[0] * solved.covariance[np.ix_(columns, columns)]).sum()
        taken += float(share) / scales[group.kind] ** 2
    return Calibration(
        cameras=tuple(cameras),
        rows=tuple(rows),
        weights=tuple(weights),
        variances=tuple(variances),
        scales=scales,
        prior=prior,
        basis=basis,
        pattern_weights=solved.pattern_weights,
        covariance=solved.covariance,
        redundancy=used - taken,
        cost=solved.cost,
        iterations=iterations,
        unmodelled_mm=unmodelled_mm(rows, weights),
    )


def computed_variances(
    rows: Rows, covariance: FloatArray, basis: FieldBasis, fields: Sequence[FilmField]
) -> FloatArray:
    """Variances (M, K) of what equations compute, from the covariance of cameras and patterns of all images."""
    by_camera = rows.by_camera()
    unknowns = by_camera.shape[-1]
    width = unknowns + 2 * basis.count
    columns = np.concatenate([np.arange(width) + width * image for image in rows.images])
    # Back from patterns to functions, so that a row touches few of them.
    whole = _in_other_unknowns(
        covariance[np.ix_(columns, columns)], unknowns, [basis.by_component[image].T for image in rows.images]
    )
    variance = np.empty(rows.by_film.shape[:2])
    kernels.variances(
        rows.by_film,
        by_camera,
        *function_values(rows, fields),
        unknowns + 2 * basis.functions,
        whole,
        variance,
    )
    return variance


def _camera_columns(images: int, width: int, of_field: int) -> IntArray:
    """Which unknowns are those of cameras, where every image has so many and the last ones are its field's."""
    return np.asarray((width * np.arange(images)[:, None] + np.arange(width - of_field)).ravel())


def _step_columns(images: int, width: int, basis: FieldBasis) -> IntArray:
    """Which unknowns are weights of patterns that move pieces of film; they come last of an image."""
    last = width * np.arange(1, images + 1)[:, None]
    return np.asarray((last - 2 * basis.steps + np.arange(2 * basis.steps)).ravel())


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
