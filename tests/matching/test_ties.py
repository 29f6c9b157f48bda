"""What is told about tie points, and which film points two films share."""

import numpy as np
import pytest

from cosp.matching.ground import film_lattice
from cosp.matching.ties import FilmMatches, summary

from .conftest import make_camera, moved


def ties_at(points_mm):
    count = len(points_mm)
    return FilmMatches(points_mm, points_mm, points_mm, np.full(count, 0.6), np.full(count, 0.45))


def test_ties_all_over_the_overlap_cover_it_and_half_of_them_cover_half():
    fore, aft = make_camera(), make_camera("aft")
    points = film_lattice(fore.half_length_mm, fore.half_width_mm, 60, 8)
    whole = summary(ties_at(points), fore, aft, height_m=500.0)
    half = summary(ties_at(points[points[:, 0] < 0]), fore, aft, height_m=500.0)
    assert whole["count"] == 480
    assert whole["coverage"] == whole["coverage_along"] == whole["coverage_across"] == 1.0
    assert half["coverage"] == pytest.approx(0.5, abs=0.05)
    assert half["coverage_along"] == pytest.approx(0.5, abs=0.05)
    assert half["coverage_across"] == 1.0
    assert sum(half["counts_along"]) == half["count"] == 240


def test_only_ground_that_both_films_show_counts():
    fore, aft = make_camera(), moved(make_camera("aft"), 0.0, 8000.0)  # half a width along the flight
    cells = summary(ties_at(np.empty((0, 2))), fore, aft, height_m=500.0)
    assert cells["coverage"] == 0.0
    assert 30 <= cells["cells_shared"] <= 90
    assert cells["sigma_px"] is None
