"""Plane transformations: estimate them from point pairs and apply them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeVar

import numpy as np

from cosp.arrays import BoolArray, FloatArray


class PlaneTransform(Protocol):
    """Anything that maps points (..., 2) to points (..., 2)."""

    def apply(self, xy: FloatArray) -> FloatArray:
        """Points (..., 2) after the transformation."""
        ...


TransformT = TypeVar("TransformT", bound=PlaneTransform)


@dataclass(frozen=True)
class Rigid:
    """Rotation about the origin, then a shift.

    Parameters
    ----------
    rotation_rad : float
        Positive turns x towards y.
    shift : (2,) floats
    """

    KIND: ClassVar[str] = "rigid_motion"
    VERSION: ClassVar[int] = 1

    rotation_rad: float
    shift: tuple[float, float]

    def apply(self, xy: FloatArray) -> FloatArray:
        """Points (..., 2) after the motion."""
        return np.asarray(np.asarray(xy, float) @ self._matrix().T + np.array(self.shift))

    def inverse(self) -> Rigid:
        """The motion that undoes this one."""
        shift = -(self._matrix().T @ np.array(self.shift))
        return Rigid(-self.rotation_rad, (float(shift[0]), float(shift[1])))

    def after(self, first: Rigid) -> Rigid:
        """Apply another motion first, then the present one."""
        shift = self.apply(np.array(first.shift))
        return Rigid(self.rotation_rad + first.rotation_rad, (float(shift[0]), float(shift[1])))

    def _matrix(self) -> FloatArray:
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        return np.array([[c, -s], [s, c]])


@dataclass(frozen=True)
class Affine:
    """x' = M [x, y, 1]: six numbers, rows of `matrix`."""

    KIND: ClassVar[str] = "affine"
    VERSION: ClassVar[int] = 1

    matrix: tuple[tuple[float, float, float], tuple[float, float, float]]

    def apply(self, xy: FloatArray) -> FloatArray:
        """Points (..., 2) after the transformation."""
        matrix = np.array(self.matrix)
        return np.asarray(np.asarray(xy, float) @ matrix[:, :2].T + matrix[:, 2])


def estimate_rigid(source: FloatArray, target: FloatArray, weights: FloatArray | None = None) -> Rigid:
    """Rigid motion from source to target points (N, 2) by weighted least squares.

    References
    ----------
    [Umeyama1991], without scale.
    """
    w = np.ones(len(source)) if weights is None else np.asarray(weights, float)
    w = w / w.sum()
    centre_source, centre_target = w @ source, w @ target
    a, b = source - centre_source, target - centre_target
    rotation = np.arctan2(w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), w @ (a * b).sum(1))
    shift = centre_target - Rigid(rotation, (0.0, 0.0)).apply(centre_source)
    return Rigid(float(rotation), (float(shift[0]), float(shift[1])))


def estimate_affine(source: FloatArray, target: FloatArray, weights: FloatArray | None = None) -> Affine:
    """Affine transformation from source to target points (N, 2), N >= 3, by weighted least squares."""
    w = np.ones(len(source)) if weights is None else np.sqrt(np.asarray(weights, float))
    centre = source.mean(0)
    design = np.column_stack([source - centre, np.ones(len(source))])
    solution = np.linalg.lstsq(design * w[:, None], target * w[:, None], rcond=None)[0].T
    solution[:, 2] -= solution[:, :2] @ centre
    first, second = ((float(r[0]), float(r[1]), float(r[2])) for r in solution)
    return Affine((first, second))


def ransac(
    estimate: Callable[[FloatArray, FloatArray], TransformT],
    source: FloatArray,
    target: FloatArray,
    *,
    minimum: int,
    gate: float,
    trials: int,
    rng: np.random.Generator,
) -> tuple[TransformT | None, BoolArray]:
    """Transformation that most point pairs agree with, and which pairs those are.

    Parameters
    ----------
    estimate : function of (source, target)
        Such as `estimate_rigid`.
    source, target : (N, 2) arrays
    minimum : int
        Points a trial is made from.
    gate : float
        Largest distance of an inlier, in the units of `target`.
    trials : int
    rng : numpy Generator

    Returns
    -------
    transform : the estimate from all inliers, or None where fewer than `minimum` agree
    inliers : (N,) bool array
    """
    best = np.zeros(len(source), bool)
    if len(source) < minimum:
        return None, best
    for _ in range(trials):
        chosen = rng.choice(len(source), minimum, replace=False)
        inliers = _within(estimate(source[chosen], target[chosen]), source, target, gate)
        if inliers.sum() > best.sum():
            best = inliers
    for _ in range(3):
        if best.sum() < minimum:
            return None, np.zeros(len(source), bool)
        transform = estimate(source[best], target[best])
        best = _within(transform, source, target, gate)
    return transform, best


def _within(transform: PlaneTransform, source: FloatArray, target: FloatArray, gate: float) -> BoolArray:
    return np.asarray(np.linalg.norm(transform.apply(source) - target, axis=1) < gate)
