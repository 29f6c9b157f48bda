"""Claims about Chebyshev polynomials in two variables and the row functions made of them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from numpy.testing import assert_allclose

from cosp.epipolar.polynomials import Basis, evaluate, fit, fit_row_functions


@pytest.mark.parametrize(("basis", "count"), [(Basis(3, 9), 40), (Basis(2, 6), 21), (Basis(4, 4, total=True), 15)])
def test_number_of_terms_is_that_of_the_literature(basis, count):
    assert basis.terms.sum() == count


@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (4, 1), (4, 10)])
def test_compiled_evaluation_equals_numpy(rng, shape):
    coefficients = rng.normal(0, 1, shape)
    u, v = rng.uniform(-1.02, 1.02, (2, 5, 7))
    assert_allclose(evaluate(coefficients, u, v), chebyshev.chebval2d(u, v, coefficients), atol=1e-12)


def test_a_polynomial_of_the_basis_is_fitted_exactly(rng):
    basis = Basis(4, 4, total=True)
    coefficients = basis.coefficients(rng.normal(0, 1, 15))
    u, v = rng.uniform(-1, 1, (2, 300))
    found, quality = fit(basis, u, v, evaluate(coefficients, u, v))
    assert_allclose(found, coefficients, atol=1e-12)
    assert quality.largest < 1e-12
    assert quality.count == 300


@pytest.mark.parametrize("basis", [Basis(3, 9), Basis(4, 4, total=True)])
def test_row_functions_agree_on_conjugates_and_keep_the_scale_of_the_fore_film(rng, basis):
    """Fore v is bent as the model can, aft is sheared: both rows must come out as v on the line u = 0."""
    half_fore, half_aft = (30.0, 350.0), (28.0, 340.0)
    u1 = rng.uniform(-30, 30, 4000)
    v1 = rng.uniform(-350, 350, 4000)
    row = v1 + u1 * (0.02 + 0.1 * v1 / 350 - 0.03 * (u1 / 30) * (v1 / 350) ** 2)
    aft = np.column_stack([rng.uniform(-28, 28, 4000), row])  # aft rows are straight
    fore_rows, aft_rows, residuals = fit_row_functions(np.column_stack([u1, v1]), aft, half_fore, half_aft, basis)
    assert np.abs(residuals).max() < 1e-8
    found = evaluate(fore_rows, u1 / 30, v1 / 350)
    assert_allclose(found, row, atol=1e-8)
    assert_allclose(evaluate(aft_rows, aft[:, 0] / 28, aft[:, 1] / 340), row, atol=1e-8)
    on_axis = np.linspace(-1, 1, 21)
    assert_allclose(evaluate(fore_rows, np.zeros(21), on_axis), 350 * on_axis, atol=1e-8)


def test_pairs_without_weight_change_nothing(rng):
    fore = rng.uniform(-1, 1, (500, 2)) * [30, 350]
    aft = fore * [0.9, 1.0]
    wrong = rng.random(500) < 0.2
    aft[wrong, 1] += 40
    weights = np.where(wrong, 0.0, 1.0)
    *_, residuals = fit_row_functions(fore, aft, (30.0, 350.0), (27.0, 350.0), Basis(2, 3), weights)
    assert np.abs(residuals[~wrong]).max() < 1e-8
    assert np.abs(residuals[wrong]).min() > 20
