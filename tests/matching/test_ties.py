"""What is told about tie points, and which film points two films share."""

import numpy as np
import pytest

from cosp.matching.ground import film_lattice
from cosp.matching.ties import FilmMatches, _passes, _Shared, summary

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


@pytest.mark.parametrize(
    ("breadth_px", "offset_px", "expected"),
    [
        (7900.0, 0.0, [(4, 49, 10), (1, 49, 10)]),  # a pair, well placed
        (550.0, 0.0, [(4, 49, 10), (1, 49, 10)]),  # neighbours at 7 um
        (28.0, 0.0, [(1, 16, 10)]),  # neighbours at 140 um: no room for a coarser level
        (7900.0, 1700.0, [(64, 49, 27), (16, 49, 10), (4, 49, 10), (1, 49, 10)]),  # a pair placed by its neighbours
        (550.0, 1700.0, [(16, 20, 100), (4, 49, 10), (1, 49, 10)]),
    ],
)
def test_levels_fit_into_what_is_shared_and_reach_as_far_as_frames_may_be_misplaced(breadth_px, offset_px, expected):
    assert _passes(breadth_px, offset_px, 49, 10) == expected


def test_the_shared_piece_of_neighbours_is_a_strip_and_its_points_fill_it():
    first = make_camera()
    second = moved(make_camera(), 0.0, 13500.0)  # most of a width along the flight
    shared = _Shared.of(first, second, 500.0)
    assert shared is not None
    assert shared.breadth_mm < 0.35 * 2 * first.half_width_mm
    points = shared.points(first, second, 200)
    assert 100 <= len(points) <= 300
    assert np.ptp(points[:, 0]) > 1.8 * first.half_length_mm
    assert np.ptp(points[:, 1]) > 0.4 * shared.breadth_mm
    assert _Shared.of(first, moved(make_camera(), 0.0, 60000.0), 500.0) is None
