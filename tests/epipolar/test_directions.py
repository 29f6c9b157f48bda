"""Claims about the epipolar direction of a film."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cosp.epipolar.directions import common_directions_rad, mean_direction_rad
from tests.epipolar.pairs import mapping, rectified, table_pair


def unit(angles_deg):
    angles = np.radians(angles_deg)
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def test_a_vector_and_its_opposite_are_the_same_line():
    angles = np.array([88.0, 92.0, 269.0, 271.0])
    assert math.degrees(mean_direction_rad(unit(angles))) == pytest.approx(90.0, abs=1e-9)
    # The plain mean of these vectors is nothing at all.
    assert np.abs(unit(angles).mean(axis=0)).max() < 1e-3


@pytest.mark.parametrize("fore_deg", [91.0, -89.0, 5.0, 175.0, -100.0])
@pytest.mark.parametrize("aft_deg", [93.0, -87.0, 10.0, -170.0])
def test_low_to_high_runs_one_way_on_one_film_and_the_other_way_on_the_other(fore_deg, aft_deg):
    fore, aft = common_directions_rad(unit([fore_deg] * 3), unit([aft_deg] * 3))
    fore_along = math.cos(fore - math.radians(fore_deg))
    aft_along = math.cos(aft - math.radians(aft_deg))
    assert abs(fore_along) == pytest.approx(1.0)
    assert aft_along == pytest.approx(-fore_along)


def test_rows_of_a_film_run_along_its_scan_and_columns_up_its_width():
    _, rectification = rectified(*table_pair("1112"))
    assert rectification.fore.direction_deg == pytest.approx(91.1, abs=0.5)  # -88.9 degrees, the same line
    centre = np.zeros(2)
    for film in (rectification.fore, rectification.aft):
        (row, row_x, row_y), (column, column_x, column_y) = film.epipolar(
            np.array([centre, centre + [1, 0], centre + [0, 1]])
        )
        assert row_x - row == pytest.approx(1 / 0.007, rel=0.02)
        assert column_y - column == pytest.approx(1 / 0.007, rel=0.02)
        assert abs(column_x - column) < 0.05 / 0.007
        assert abs(row_y - row) < 0.05 / 0.007


def test_local_directions_differ_by_degrees_over_the_film():
    """So one rotation is not enough and the row polynomials are needed."""
    conjugates, rectification = rectified(*table_pair("1112"))
    u = unit([rectification.fore.direction_deg])[0]
    away = np.degrees(np.arcsin(np.abs(conjugates.fore_directions @ np.array([u[1], -u[0]]))))
    assert 5 < away.max() < 12
    assert mapping(table_pair("1112")[0]).half_length_mm > 350
