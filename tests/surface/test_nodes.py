"""Claims about values between nodes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import RegularGridInterpolator

from cosp.surface.nodes import between_nodes


@pytest.mark.parametrize("shape", [(6, 5), (2, 2), (1, 4), (3, 1)])
def test_values_are_bilinear_and_go_on_beyond_the_edge(shape):
    rng = np.random.default_rng(2)
    values = rng.normal(0, 3, shape)
    rows, columns = (np.linspace(-1.5, n + 0.5, 40) for n in shape)
    # A single row or column of nodes is what two equal ones are.
    whole = np.repeat(np.repeat(values, 2 if shape[0] == 1 else 1, axis=0), 2 if shape[1] == 1 else 1, axis=1)
    plain = RegularGridInterpolator([np.arange(n) for n in whole.shape], whole)
    inside = [np.clip(a, 0, n - 1) for a, n in zip((rows, columns), shape, strict=True)]
    expected = plain(np.stack(np.meshgrid(*inside, indexing="ij"), axis=-1))
    assert_allclose(between_nodes(values, rows, columns), expected, atol=1e-5)


def test_a_part_is_that_of_the_whole_and_missing_nodes_are_missing_about_them():
    values = np.random.default_rng(3).normal(0, 1, (9, 9))
    values[4, 4] = np.nan
    places = np.linspace(0, 8, 33)
    whole = between_nodes(values, places, places)
    assert np.array_equal(between_nodes(values, places[20:], places), whole[20:], equal_nan=True)
    assert np.isnan(whole[14:19, 14:19]).all()
    assert np.isfinite(whole[:12]).all()
