"""Distortion of one film: how far its points lie from where the camera put them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cosp.arrays import FloatArray, IntArray
from cosp.camera import kernels

ALONG, ACROSS = 4, 3  # splines that meet in one point: cubic along the film, quadratic across


@dataclass(frozen=True)
class FilmSteps:
    """Displacement of film that was digitised in pieces: constant along each of them, linear across.

    Parameters
    ----------
    joints_mm : tuple of floats
        Where pieces meet, x rising.
    width_mm : float
        Over which one piece passes smoothly into the next.
    offsets_mm : tuple of floats
        (pieces * 2 * 2): of each piece at the lower and at the upper edge of the film, the component last.

    Raises
    ------
    ValueError
        If joints are nearer to each other than the width, or the number of offsets is another.
    """

    joints_mm: tuple[float, ...]
    width_mm: float
    offsets_mm: tuple[float, ...]

    def __post_init__(self) -> None:
        if not self.width_mm > 0.0 or (np.diff(self.joints_mm) < self.width_mm).any():
            raise ValueError(f"joints at {self.joints_mm} mm for a transition of {self.width_mm} mm")
        if len(self.offsets_mm) != 4 * self.pieces:
            raise ValueError(f"{len(self.offsets_mm)} offsets for {self.pieces} pieces times 4")

    @classmethod
    def none_at(cls, joints_mm: Sequence[float], *, width_mm: float) -> FilmSteps:
        """Pieces that lie where they should."""
        return cls(tuple(float(x) for x in joints_mm), width_mm, (0.0,) * (4 * len(joints_mm) + 4))

    @property
    def pieces(self) -> int:
        """Number of pieces."""
        return len(self.joints_mm) + 1

    @cached_property
    def offsets(self) -> FloatArray:
        """The offsets as an array (pieces, 2, 2) in mm: lower and upper edge, then the component."""
        return np.array(self.offsets_mm, dtype=float).reshape(-1, 2, 2)

    def with_offsets(self, offsets: FloatArray) -> FilmSteps:
        """The same pieces with other offsets, any array of (pieces, 2, 2) values in mm."""
        return replace(self, offsets_mm=tuple(np.asarray(offsets, float).ravel().tolist()))

    def turned(self) -> FilmSteps:
        """The pieces of the same film turned by 180 degrees."""
        joints = tuple(-x for x in reversed(self.joints_mm))
        return replace(self, joints_mm=joints).with_offsets(-self.offsets[::-1, ::-1])


@dataclass(frozen=True)
class FilmField:
    """Displacement d of film points as a tensor product of B-splines, cubic along the film and quadratic across it.

    A point that the camera images at (x, y) is measured at (x, y) + d(x, y). Beyond the film that the splines
    cover, d keeps its value at the edge. Where pieces of the film were joined, steps are added.

    Parameters
    ----------
    half_length_mm, half_width_mm : float
        Half the film that the splines cover.
    intervals : two ints
        Intervals between knots, along and across.
    coefficients_mm : tuple of floats
        ((intervals along + 3) * (intervals across + 2) * 2), the component last, then across.
    steps : FilmSteps or None
        What the pieces of the film are off besides.

    Raises
    ------
    ValueError
        If the number of coefficients is another.
    """

    half_length_mm: float
    half_width_mm: float
    intervals: tuple[int, int]
    coefficients_mm: tuple[float, ...]
    steps: FilmSteps | None = None

    def __post_init__(self) -> None:
        if len(self.coefficients_mm) != 2 * self.shape[0] * self.shape[1]:
            raise ValueError(f"{len(self.coefficients_mm)} coefficients for splines of shape {self.shape} times 2")

    @classmethod
    def flat(
        cls, *, half_length_mm: float, half_width_mm: float, knots_along_mm: float, knots_across_mm: float
    ) -> FilmField:
        """No displacement, with knots about as far apart as asked for."""
        intervals = (
            max(1, round(2.0 * half_length_mm / knots_along_mm)),
            max(1, round(2.0 * half_width_mm / knots_across_mm)),
        )
        count = 2 * (intervals[0] + ALONG - 1) * (intervals[1] + ACROSS - 1)
        return cls(half_length_mm, half_width_mm, intervals, (0.0,) * count)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of splines along and across."""
        return self.intervals[0] + ALONG - 1, self.intervals[1] + ACROSS - 1

    @cached_property
    def coefficients(self) -> FloatArray:
        """The coefficients as an array (along, across, 2) in mm."""
        return np.array(self.coefficients_mm, dtype=float).reshape(*self.shape, 2)

    def with_coefficients(self, coefficients: FloatArray) -> FilmField:
        """The same splines with other coefficients, any array of (along, across, 2) values in mm."""
        return replace(self, coefficients_mm=tuple(np.asarray(coefficients, float).ravel().tolist()))

    @property
    def functions(self) -> int:
        """Number of functions that the displacement is a sum of: the splines and two edges of every piece."""
        return self.shape[0] * self.shape[1] + (2 * self.steps.pieces if self.steps else 0)

    @property
    def amounts(self) -> FloatArray:
        """How much of each function there is, (functions, 2) in mm: the splines first."""
        splines = self.coefficients.reshape(-1, 2)
        return np.concatenate([splines, self.steps.offsets.reshape(-1, 2)]) if self.steps else splines

    def with_amounts(self, amounts: FloatArray) -> FilmField:
        """The same functions with other amounts (functions, 2), in mm."""
        splines = self.shape[0] * self.shape[1]
        changed = self.with_coefficients(amounts[:splines])
        return replace(changed, steps=self.steps.with_offsets(amounts[splines:])) if self.steps else changed

    @property
    def largest_mm(self) -> float:
        """A bound of the displacement in a coordinate."""
        # Splines never exceed their largest coefficient.
        steps = float(np.abs(self.steps.offsets).max()) if self.steps else 0.0
        return float(np.abs(self.coefficients).max()) + steps

    def centres_mm(self) -> tuple[FloatArray, FloatArray]:
        """Where each spline is centred along x and along y: its Greville abscissae, in mm."""
        along, across = self._knot_mm
        x = along * (np.arange(self.shape[0]) - (ALONG - 2) / 2.0) - self.half_length_mm
        y = across * (np.arange(self.shape[1]) - (ACROSS - 2) / 2.0) - self.half_width_mm
        return x, y

    def displacement(self, film_mm: FloatArray) -> FloatArray:
        """Displacement (..., 2) in mm at film points (..., 2) as the camera images them."""
        return np.asarray(self.distorted(film_mm) - film_mm)

    def distorted(self, film_mm: FloatArray) -> FloatArray:
        """Where film points (..., 2) in mm that the camera images are measured."""
        film = np.array(film_mm, dtype=float, order="C")
        kernels.distort(self.coefficients, self._domain, self._pieces, film.reshape(-1, 2))
        return film

    def corrected(self, film_mm: FloatArray) -> FloatArray:
        """Where the camera images film points (..., 2) in mm that were measured: the inverse of `distorted`."""
        film = np.array(film_mm, dtype=float, order="C")
        kernels.correct(self.coefficients, self._domain, self._pieces, film.reshape(-1, 2))
        return film

    def basis(self, film_mm: FloatArray) -> tuple[IntArray, FloatArray]:
        """The functions that are not zero at film points, and their values there.

        Parameters
        ----------
        film_mm : (N, 2) array, mm

        Returns
        -------
        functions : (N, 12) array of int
            Numbers in the order of `amounts`; those of a point that is NaN are 0. (N, 16) where there are steps.
        values : (N, 12) or (N, 16) array
        """
        film = np.ascontiguousarray(film_mm, dtype=float)
        functions = np.empty((len(film), ALONG * ACROSS + (4 if self.steps else 0)), dtype=np.int64)
        values = np.empty(functions.shape)
        kernels.splines_at(*self.shape, self._domain, self._pieces, film, functions, values)
        return functions, values

    def gradient(self, film_mm: FloatArray) -> FloatArray:
        """Derivatives of the displacement with respect to x and y, (N, 2, 2), the direction last."""
        film = np.ascontiguousarray(film_mm, dtype=float)
        gradient = np.empty((len(film), 2, 2))
        kernels.field_gradient(self.coefficients, self._domain, self._pieces, film, gradient)
        return gradient

    def turned(self) -> FilmField:
        """The field of the same film turned by 180 degrees: d'(x, y) = -d(-x, -y)."""
        turned = self.with_coefficients(-self.coefficients[::-1, ::-1])
        return replace(turned, steps=self.steps.turned() if self.steps else None)

    @property
    def _knot_mm(self) -> tuple[float, float]:
        return 2.0 * self.half_length_mm / self.intervals[0], 2.0 * self.half_width_mm / self.intervals[1]

    @property
    def _domain(self) -> kernels.Domain:
        """Half the film and the distance of knots, as the kernels take them."""
        return self.half_length_mm, self.half_width_mm, *self._knot_mm

    @cached_property
    def _pieces(self) -> kernels.Pieces:
        """Joints, width of the passage and offsets, as the kernels take them; no joints where there are no steps."""
        if self.steps is None:
            return np.empty(0), 1.0, np.zeros((1, 2, 2))
        return np.array(self.steps.joints_mm), self.steps.width_mm, self.steps.offsets
