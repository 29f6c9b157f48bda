"""Statistics that are counted tile by tile are those of all cells at once."""

from __future__ import annotations

import numpy as np
import pytest

from cosp.dem.differencing import difference_statistics
from cosp.dem.tally import Tally


def _differences():
    rng = np.random.default_rng(4)
    difference = rng.normal(-0.7, 3.0, (300, 200))
    difference[rng.random(difference.shape) < 0.1] = np.nan
    difference[:3, :5] = -2500.0  # blunders
    return difference, rng.random(difference.shape) < 0.8


def test_tiles_give_the_statistics_of_the_whole():
    difference, asked = _differences()
    tally = Tally()
    for start in range(0, 300, 70):
        tally.add(difference[start : start + 70], asked[start : start + 70])
    whole = difference_statistics(difference, asked, cell_area_m2=100.0)
    counted = tally.statistics(cell_area_m2=100.0)
    assert counted.keys() == whole.keys()
    assert counted["count"] == whole["count"]
    for name in ("completeness", "area_km2", "sd", "rms"):
        assert counted[name] == pytest.approx(whole[name], rel=1e-9)
    for name in ("median", "nmad", "le90", "p05", "p95"):
        assert counted[name] == pytest.approx(whole[name], abs=0.02)


def test_nothing_counted_is_said_as_nothing():
    said = Tally().statistics(cell_area_m2=1.0)
    assert said["count"] == 0
    assert np.isnan(said["median"])
    assert np.isnan(said["completeness"])
