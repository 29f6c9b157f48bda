"""Weights at the places where their formulas are known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.geometry.robust import geman_mcclure_weights, huber_weights, running_median, tukey_weights


def test_weights_of_a_zero_residual_are_one():
    for weights in (huber_weights(np.zeros(1)), tukey_weights(np.zeros(1)), geman_mcclure_weights(np.zeros(1), 9.0)):
        assert weights == pytest.approx(1.0)


def test_known_values():
    assert huber_weights(np.array([2.69]))[0] == pytest.approx(0.5)
    assert tukey_weights(np.array([4.7, -5.0])).max() == 0
    assert geman_mcclure_weights(np.array([3.0]), 9.0)[0] == pytest.approx(0.25)


def test_a_running_median_removes_a_spike_and_keeps_a_step():
    trace = np.array([0, 0, 0, 50, 0, 0, 0, 9, 9, 9, 9, 9.0])
    assert_allclose(running_median(trace, 5), [0, 0, 0, 0, 0, 0, 0, 9, 9, 9, 9, 9])
