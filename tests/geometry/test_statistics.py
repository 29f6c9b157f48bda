"""Statistics on numbers worked by hand and on the normal distribution."""

import numpy as np
import pytest

from cosp.geometry.statistics import linear_error, nmad, rms, summarise


def test_nmad_of_a_hand_worked_list():
    assert nmad([1.0, 2.0, 3.0, 4.0, 100.0]) == pytest.approx(1.4826)


def test_nmad_is_the_standard_deviation_of_normal_values():
    values = np.random.default_rng(0).normal(5.0, 2.0, 200_000)
    assert nmad(values) == pytest.approx(2.0, rel=0.01)


def test_le90_of_normal_values_is_the_published_multiple():
    values = np.random.default_rng(0).normal(0.0, 1.0, 200_000)
    assert linear_error(values) == pytest.approx(1.6449, rel=0.01)


def test_nan_is_left_out_and_nothing_gives_nan():
    assert rms([3.0, np.nan, -4.0]) == pytest.approx(np.sqrt(12.5))
    assert np.isnan(nmad([np.nan]))
    assert summarise([np.nan])["count"] == 0


def test_a_shift_changes_the_median_alone():
    values = np.random.default_rng(0).normal(0.0, 1.0, 1000)
    here, there = summarise(values), summarise(values + 7)
    assert there["median"] - here["median"] == pytest.approx(7)
    assert there["nmad"] == pytest.approx(here["nmad"])
