"""Smooth distortion of one film: how far its points lie from where the camera put them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cosp.arrays import FloatArray, IntArray
from cosp.camera import kernels

ALONG, ACROSS = 4, 3  # splines that meet in one point: cubic along the film, quadratic across


@dataclass(frozen=True)
class FilmField:
    """Displacement d of film points as a tensor product of B-splines, cubic along the film and quadratic across it.

    A point that the camera images at (x, y) is measured at (x, y) + d(x, y). Beyond the film that the splines
    cover, d keeps its value at the edge.

    Parameters
    ----------
    half_length_mm, half_width_mm : float
        Half the film that the splines cover.
    intervals : two ints
        Intervals between knots, along and across.
    coefficients_mm : tuple of floats
        ((intervals along + 3) * (intervals across + 2) * 2), the component last, then across.

    Raises
    ------
    ValueError
        If the number of coefficients is another.
    """

    half_length_mm: float
    half_width_mm: float
    intervals: tuple[int, int]
    coefficients_mm: tuple[float, ...]

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
        kernels.distort(self.coefficients, *self._domain, film.reshape(-1, 2))
        return film

    def corrected(self, film_mm: FloatArray) -> FloatArray:
        """Where the camera images film points (..., 2) in mm that were measured: the inverse of `distorted`."""
        film = np.array(film_mm, dtype=float, order="C")
        kernels.correct(self.coefficients, *self._domain, film.reshape(-1, 2))
        return film

    def basis(self, film_mm: FloatArray) -> tuple[IntArray, FloatArray]:
        """The splines that are not zero at film points, and their values there.

        Parameters
        ----------
        film_mm : (N, 2) array, mm

        Returns
        -------
        splines : (N, 12) array of int
            Numbers along * across; those of a point that is NaN are 0.
        values : (N, 12) array
        """
        film = np.ascontiguousarray(film_mm, dtype=float)
        splines = np.empty((len(film), ALONG * ACROSS), dtype=np.int64)
        values = np.empty(splines.shape)
        kernels.splines_at(self.shape[0], self.shape[1], *self._domain, film, splines, values)
        return splines, values

    def gradient(self, film_mm: FloatArray) -> FloatArray:
        """Derivatives of the displacement with respect to x and y, (N, 2, 2), the direction last."""
        film = np.ascontiguousarray(film_mm, dtype=float)
        gradient = np.empty((len(film), 2, 2))
        kernels.field_gradient(self.coefficients, *self._domain, film, gradient)
        return gradient

    def turned(self) -> FilmField:
        """The field of the same film turned by 180 degrees: d'(x, y) = -d(-x, -y)."""
        return self.with_coefficients(-self.coefficients[::-1, ::-1])

    @property
    def _knot_mm(self) -> tuple[float, float]:
        return 2.0 * self.half_length_mm / self.intervals[0], 2.0 * self.half_width_mm / self.intervals[1]

    @property
    def _domain(self) -> tuple[float, float, float, float]:
        """Half the film and the distance of knots, as the kernels take them."""
        return self.half_length_mm, self.half_width_mm, *self._knot_mm
