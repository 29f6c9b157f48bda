"""Chebyshev polynomials in two variables, and the pair of them that gives conjugate points the same row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from cosp.arrays import BoolArray, FloatArray
from cosp.epipolar import kernels


@dataclass(frozen=True)
class Basis:
    """Which products T_i(u) T_j(v) a polynomial may use.

    Parameters
    ----------
    degree_u, degree_v : int
        Highest degree along and across the epipolar direction.
    total : bool
        Keep only i + j <= the larger of the two (the polynomials of the paper); else every product (separable).
    """

    degree_u: int
    degree_v: int
    total: bool = False

    @classmethod
    def of_film(cls, *, across: int, along: int, total: int) -> Basis:
        """Of degrees across a film (as epipolar lines run) and along it; of a total degree where it is not 0."""
        return cls(total, total, total=True) if total else cls(across, along)

    @property
    def terms(self) -> BoolArray:
        """(degree_u + 1, degree_v + 1) array: True where T_i(u) T_j(v) is used."""
        order = np.add.outer(np.arange(self.degree_u + 1), np.arange(self.degree_v + 1))
        return np.asarray(order <= max(self.degree_u, self.degree_v)) if self.total else np.full(order.shape, True)

    def design(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Values of the used products at points scaled to [-1, 1], (N, number of terms)."""
        along, across = chebyshev.chebvander(u, self.degree_u), chebyshev.chebvander(v, self.degree_v)
        return np.asarray((along[:, :, None] * across[:, None, :])[:, self.terms])

    def coefficients(self, solution: FloatArray) -> FloatArray:
        """Coefficients of the used products, in the order of `design`, as a (degree_u + 1, degree_v + 1) array."""
        full = np.zeros((self.degree_u + 1, self.degree_v + 1))
        full[self.terms] = solution
        return full


@dataclass(frozen=True)
class Fit:
    """How well a fit met its points, in the unit of its values."""

    rms: float
    largest: float
    count: int


def fit(
    basis: Basis, u: FloatArray, v: FloatArray, values: FloatArray, weights: FloatArray | None = None
) -> tuple[FloatArray, Fit]:
    """Coefficients of the least-squares polynomial through values at points scaled to [-1, 1]; weights as roots."""
    design = basis.design(u, v)
    root = np.ones(len(values)) if weights is None else weights
    solution, *_ = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)
    return basis.coefficients(solution), fit_quality(design @ solution - values)


def fit_quality(residuals: FloatArray) -> Fit:
    """Summary of residuals."""
    return Fit(float(np.sqrt(np.mean(residuals**2))), float(np.abs(residuals).max()), int(residuals.size))


def evaluate(coefficients: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Values of a polynomial at points scaled to [-1, 1], any shape."""
    u, v = (np.asarray(a, float) for a in np.broadcast_arrays(u, v))
    values = np.empty(u.size)
    kernels.evaluate(np.ascontiguousarray(coefficients), np.ravel(u), np.ravel(v), values)
    return values.reshape(u.shape)


def fit_row_functions(
    fore_uv: FloatArray,
    aft_uv: FloatArray,
    half_fore: tuple[float, float],
    half_aft: tuple[float, float],
    basis: Basis,
    weights: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Polynomials P1, P2 with P1(fore) = P2(aft) for conjugate points.

    Any function of the row would do as well as the row, zero included, so the fore film sets the scale:
    P1 = v + u Q1(u, v), which is v on the line u = 0. P2 is free. Linear in the coefficients: P2 - u1 Q1 = v1.

    Parameters
    ----------
    fore_uv, aft_uv : (N, 2) arrays, mm
        Conjugate points, along and across the epipolar direction of their film, about the centre of the film's frame.
    half_fore, half_aft : (half_u, half_v), mm
        What scales the coordinates to [-1, 1].
    basis : Basis
        Of P1 and P2.
    weights : (N,) array, optional
        Square roots of the weights of measured pairs.

    Returns
    -------
    fore, aft : (degree_u + 1, degree_v + 1) arrays, mm
        Chebyshev coefficients of P1 and P2 in scaled coordinates.
    residuals : (N,) array, mm
        P2(aft) - P1(fore): the y-parallax that the model leaves.

    References
    ----------
    [Deseilligny2020] section 3.2
    """
    u1, v1 = fore_uv[:, 0] / half_fore[0], fore_uv[:, 1] / half_fore[1]
    quotient = Basis(basis.degree_u - 1, basis.degree_v - (1 if basis.total else 0), basis.total)
    q_design = quotient.design(u1, v1)
    p_design = basis.design(aft_uv[:, 0] / half_aft[0], aft_uv[:, 1] / half_aft[1])
    system = np.hstack([-u1[:, None] * q_design, p_design])
    right = fore_uv[:, 1]
    root = np.ones(len(right)) if weights is None else weights
    solution, *_ = np.linalg.lstsq(system * root[:, None], right * root, rcond=None)

    q = quotient.coefficients(solution[: q_design.shape[1]])
    fore = np.zeros((basis.degree_u + 1, basis.degree_v + 1))
    for j in range(q.shape[1]):
        product = chebyshev.chebmulx(q[:, j])
        fore[: product.size, j] = product
    fore[0, 1] += half_fore[1]
    aft = basis.coefficients(solution[q_design.shape[1] :])
    return fore, aft, system @ solution - right
