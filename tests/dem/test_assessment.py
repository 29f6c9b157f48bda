"""Claims about what is asked of a model and how it is judged."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.dem.assessment import seen_by, statistics, textured
from cosp.dem.differencing import difference_statistics, statistics_by_slope
from cosp.geometry.grids import PixelGrid


def test_statistics_of_known_differences_are_those_of_their_distribution():
    rng = np.random.default_rng(6)
    difference = rng.normal(2.0, 5.0, (400, 500))
    difference[:, 450:] = np.nan  # a tenth was not measured
    asked = np.ones(difference.shape, bool)
    asked[300:] = False
    found = difference_statistics(difference, asked, cell_area_m2=100.0)
    assert found["count"] == 300 * 450
    assert_allclose(found["area_km2"], 13.5)
    assert_allclose(found["completeness"], 0.9)
    assert_allclose([found["median"], found["nmad"], found["sd"]], [2.0, 5.0, 5.0], atol=0.06)
    # LE90 of N(2, 5) about zero
    assert_allclose(found["le90"], 8.86, atol=0.1)


def test_nothing_asked_is_said_as_nothing_not_as_perfect():
    found = difference_statistics(np.full((4, 4), np.nan), np.zeros((4, 4), bool), cell_area_m2=1.0)
    assert found["count"] == 0
    assert np.isnan(found["completeness"])


def test_bins_of_slope_part_the_cells():
    slope = np.array([[0.0, 4.9, 5.0, 12.0, 80.0, np.nan]])
    difference = np.array([[1.0, 1, 2, 3, 4, 5]])
    bins = statistics_by_slope(difference, np.ones((1, 6), bool), slope, [0, 5, 10, 90])
    assert [b["count"] for b in bins] == [2, 1, 2]
    assert [b["median"] for b in bins] == [1, 2, 3.5]


def test_cells_are_seen_where_they_fall_on_the_film():
    grid = PixelGrid.covering((0, 0, 1000, 500), 10)

    def film_mm(east, north, height):
        return np.stack([east / 100, north / 100], axis=-1) + 0 * height[..., None]

    heights = np.zeros(grid.shape)
    heights[:, :30] = np.nan
    seen = seen_by(film_mm, heights, grid, (0.0, 1.0, 8.0, 4.0))
    xy = grid.centres()
    expected = (xy[..., 0] <= 800) & (xy[..., 1] >= 100) & (xy[..., 1] <= 400) & (xy[..., 0] > 300)
    assert np.array_equal(seen, expected)


@pytest.mark.parametrize("turn_deg", [0, 7, 93])
def test_cells_are_seen_as_if_each_were_looked_up(turn_deg):
    """A film askew over steep ground that shifts it, with gaps and with cells whose ray misses it."""
    grid = PixelGrid.covering((0, 0, 6000, 3330), 10)
    xy, rng = grid.centres(), np.random.default_rng(turn_deg)
    heights = 900 * np.sin(xy[..., 0] / 300) * np.cos(xy[..., 1] / 200) + 1000
    heights[rng.random(grid.shape) < 0.2] = np.nan
    heights[40:90, 100:180] = np.nan
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    asked = []

    def film_mm(east, north, height):
        asked.append(np.broadcast(east, height).size)
        x, y = (east - 3000) * cos + (north - 1600) * sin, (north - 1600) * cos - (east - 3000) * sin
        return np.where((east > 5500)[..., None], np.nan, np.stack([x + 0.3 * height, y - 0.5 * height], axis=-1) / 100)

    bounds = (-20.0, -11.0, 21.0, 4.0)
    film = film_mm(xy[..., 0], xy[..., 1], heights)
    each = (film >= bounds[:2]).all(axis=-1) & (film <= bounds[2:]).all(axis=-1)
    asked.clear()
    assert np.array_equal(seen_by(film_mm, heights, grid, bounds), each)
    assert 0.1 < each.mean() < 0.6
    assert sum(asked) < 0.7 * each.size


def test_snow_has_no_texture_and_rock_has():
    rng = np.random.default_rng(7)
    grey = np.full((60, 90), 250.0)
    grey[:, 30:60] = rng.normal(120, 12, (60, 30))
    grey[:, 60:] = 0
    marked = textured(grey, least_grey=4, window_cells=5)
    assert marked[:, 33:57].all()
    assert not marked[:, :26].any()
    assert not marked[:, 60:].any()


def test_textured_ground_is_judged_by_itself():
    difference = np.array([[1.0, np.nan, 3.0, np.nan]])
    rocks = np.array([[True, False, True, False]])
    found = statistics(
        difference, np.ones((1, 4), bool), rocks, np.full((1, 4), 10.0), edges_deg=[0, 90], cell_area_m2=1.0
    )
    assert found["completeness"] == pytest.approx(0.5)
    assert found["textured"]["completeness"] == pytest.approx(1.0)
    assert found["by_slope"][0]["count"] == 2
