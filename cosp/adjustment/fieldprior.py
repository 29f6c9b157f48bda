"""What is believed of film distortion before it is measured: a smooth Gaussian process, its length and size learned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera.field import FilmField, FilmSteps

# Correlation across the film over that along it: distortion simulated at 60 by 40 mm explains published residuals.
WIDTH_OVER_LENGTH = 2.0 / 3.0
SMALLEST_MODE = 1e-4  # of the largest variance; smaller ones are left out: together a part in a thousand
# Distortion found on film is about a pixel and a half of 7 um; within a factor of three either way, two times in three.
EXPECTED_AMPLITUDE_MM = 0.01
AMPLITUDE_SPREAD = np.log(3.0)
AMPLITUDES_MM = np.geomspace(1e-4, 0.1, 61)
# Width over which pieces of film pass into each other: about that of the band in which two parts are blended.
PASSAGE_MM = 3.0
# Film bends sideways over a good part of its length, and opens across by a tenth of that. What straightening leaves
# of it is a matter of the smooth process as long as it is small.
BENDING_LENGTH_MM = 100.0
BENDING_OPENS = 0.1
LEAST_BENDING_MM = 0.02


@dataclass(frozen=True)
class Joints:
    """Where pieces of one film meet, and how far off they may lie.

    Parameters
    ----------
    x_mm : tuple of floats
        Rising.
    steps_mm : tuple of floats
        Standard deviation of the step at each of them, per axis and edge of the film, that all pieces beyond share:
        parts are laid down one after the other.
    pieces_mm : float
        Standard deviation of each piece by itself: the scanner sets down its blocks independently.
    """

    x_mm: tuple[float, ...] = ()
    steps_mm: tuple[float, ...] = ()
    pieces_mm: float = 0.0

    def root(self) -> FloatArray:
        """Patterns (pieces, Q) whose independent unit sums are the displacements of the pieces, mm."""
        pieces = len(self.x_mm) + 1
        beyond = np.tril(np.ones((pieces, len(self.x_mm))), -1) * self.steps_mm
        # What moves the whole film is the camera's.
        both = np.hstack([beyond - beyond.mean(axis=0, keepdims=True), self.pieces_mm * np.eye(pieces)])
        values, vectors = np.linalg.eigh(both @ both.T)
        kept = values > 1e-9 * max(values.max(), 1e-12)
        return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def joints_on_film(
    joints_mm: Sequence[float],
    limits_mm: Sequence[float],
    *,
    half_length_mm: float,
    joint_sigma_mm: float,
    limit_sigma_mm: float,
) -> Joints:
    """Joints of the parts of a film and limits of the scanner's blocks that lie on its format.

    Of two that are nearer to each other than pieces need to pass into each other one is kept, a joint of parts first.

    Parameters
    ----------
    joints_mm, limits_mm : sequences of float
        Where they lie, x.
    half_length_mm : float
    joint_sigma_mm, limit_sigma_mm : float
        Standard deviations of the step at a joint and of a block by itself; 0: there are none such.
    """
    found: list[tuple[float, float]] = []
    for places, step, sigma in ((joints_mm, joint_sigma_mm, joint_sigma_mm), (limits_mm, 0.0, limit_sigma_mm)):
        for x in sorted(places) if sigma > 0.0 else ():
            apart = all(abs(x - other) >= PASSAGE_MM for other, _ in found)
            if abs(x) < half_length_mm - PASSAGE_MM and apart:
                found.append((float(x), step))
    blocks = any(step == 0.0 for _, step in found)
    x_mm, steps_mm = zip(*sorted(found), strict=True) if found else ((), ())
    return Joints(x_mm, steps_mm, limit_sigma_mm if blocks else 0.0)


@dataclass(frozen=True)
class FieldBasis:
    """Patterns that the fields of all films of a block are sums of.

    Parameters
    ----------
    patterns : tuple of (F, K) arrays
        Of each film: how much of each function of its field is in a pattern, the same for both components.
    smooth, bends : int
        How many of the patterns, the first ones, are those of the smooth process, and how many of bending, which goes
        across the film alone. The others move pieces of film. Those and bending have unit variance.
    """

    patterns: tuple[FloatArray, ...]
    smooth: int
    bends: int = 0

    @classmethod
    def of(
        cls,
        fields: Sequence[FilmField],
        joints: Sequence[Joints],
        length_mm: float,
        bending_mm: Sequence[float] | None = None,
    ) -> FieldBasis:
        """Patterns for a correlation length; films with fewer pieces than others have patterns that do nothing.

        Parameters
        ----------
        fields : sequence of FilmField
            Of every film, on the same splines.
        joints : sequence of Joints
        length_mm : float
        bending_mm : sequence of float
            Standard deviation of the bending that straightening left; none if left out.
        """
        waves = modes(replace(fields[0], steps=None), length_mm)
        left_mm = np.zeros(len(fields)) if bending_mm is None else np.asarray(bending_mm)
        left_mm = np.where(left_mm >= LEAST_BENDING_MM, left_mm, 0.0)
        bends = bending_modes(fields[0]) if left_mm.any() else np.empty((len(waves), 0))
        # Both edges of a piece move by themselves.
        moves = [np.kron(own.root(), np.eye(2)) for own in joints]
        rows = max((field.functions for field in fields), default=0)
        first = waves.shape[1] + bends.shape[1]
        columns = first + max(move.shape[1] for move in moves)
        patterns = []
        for field, move, bent_mm in zip(fields, moves, left_mm, strict=True):
            pattern = np.zeros((rows, columns))
            pattern[: len(waves), :first] = np.hstack([waves, bent_mm * bends])
            if field.steps is not None:
                pattern[len(waves) : field.functions, first : first + move.shape[1]] = move
            patterns.append(pattern)
        return cls(tuple(patterns), waves.shape[1], bends.shape[1])

    @property
    def steps(self) -> int:
        """Number of patterns that move pieces of film."""
        return self.count - self.smooth - self.bends

    @property
    def functions(self) -> int:
        """Number of functions of a field."""
        return int(self.patterns[0].shape[0])

    @property
    def count(self) -> int:
        """Number of patterns."""
        return int(self.patterns[0].shape[1])

    @cached_property
    def by_component(self) -> tuple[FloatArray, ...]:
        """The patterns for amounts along and across in turns, (2 F, 2 K) for each film."""
        return tuple(np.kron(pattern, np.eye(2)) for pattern in self.patterns)

    def amounts(self, image: int, weights: FloatArray) -> FloatArray:
        """Amounts (F, 2) of the functions of a film's field from the weights (K, 2) of its patterns."""
        return np.asarray(self.patterns[image] @ weights)


def field_with_pieces(flat: FilmField, joints: Joints) -> FilmField:
    """A field without displacement for a film with joints."""
    return replace(flat, steps=FilmSteps.none_at(joints.x_mm, width_mm=PASSAGE_MM)) if joints.x_mm else flat


def modes(field: FilmField, length_mm: float) -> FloatArray:
    """Patterns of spline coefficients (splines, M) whose independent unit sums are the Gaussian process.

    The process has a standard deviation of 1 mm in the middle of the film and a squared exponential covariance,
    `length_mm` long and two thirds of it wide.

    References
    ----------
    [Rasmussen2006] section 4.3, "eigenfunction analysis of kernels".
    """
    parts = []
    for centres, length in zip(field.centres_mm(), (length_mm, length_mm * WIDTH_OVER_LENGTH), strict=True):
        covariance = np.exp(-0.5 * ((centres[:, None] - centres) / length) ** 2)
        values, vectors = np.linalg.eigh(covariance)
        parts.append((np.maximum(values[::-1], 0.0), vectors[:, ::-1]))
    (along, along_vectors), (across, across_vectors) = parts
    variance = np.kron(along, across)
    kept = np.flatnonzero(variance > SMALLEST_MODE * variance.max())
    patterns = np.kron(along_vectors, across_vectors)[:, kept] * np.sqrt(variance[kept])
    splines, values = field.basis(np.zeros((1, 2)))
    return np.asarray(patterns / np.linalg.norm(values[0] @ patterns[splines[0]]))


def bending_modes(field: FilmField) -> FloatArray:
    """Patterns of spline coefficients (splines, M) of bending with a standard deviation of 1 mm."""
    x, y = field.centres_mm()
    covariance = np.exp(-0.5 * ((x[:, None] - x) / BENDING_LENGTH_MM) ** 2)
    values, vectors = np.linalg.eigh(covariance)
    kept = values > SMALLEST_MODE * values.max()
    along = vectors[:, kept] * np.sqrt(values[kept])
    across = np.column_stack([np.ones(len(y)), BENDING_OPENS * y / field.half_width_mm])
    return np.kron(along, across)


def log_evidence(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Logarithm of the marginal likelihood at each of `AMPLITUDES_MM`, up to a constant that all priors share.

    Parameters
    ----------
    normal : (M, M) array
        Normal matrix of the modes' weights, of mean zero and unit variance per mm of amplitude, with everything else
        eliminated and without their prior.
    right : (M,) array
        Its right-hand side.

    References
    ----------
    [Rasmussen2006] section 5.4.1.
    """
    information, vectors = np.linalg.eigh(normal)
    information = np.maximum(information, 0.0)
    explained = (vectors.T @ right) ** 2
    precision = 1.0 / AMPLITUDES_MM[:, None] ** 2
    fit = 0.5 * (explained / (information + precision)).sum(axis=1)
    freedom = 0.5 * np.log1p(information / precision).sum(axis=1)
    belief = 0.5 * (np.log(AMPLITUDES_MM / EXPECTED_AMPLITUDE_MM) / AMPLITUDE_SPREAD) ** 2
    return np.asarray(fit - freedom - belief)
