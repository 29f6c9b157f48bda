"""The sizes that follow from the paper's own cameras, as docs/conventions.md lists them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.geometry.rays import meet
from tests.authorities.parameter_table import (
    FULL_HALF_LENGTH_MM,
    HALF_WIDTH_MM,
    PIXEL_MM,
    film_points,
    pair,
)

SIZES = {
    # swath km, width km centre and end, ground sampling m (scan, flight) centre and end, parallax px per m, convergence
    "1112": (272, (18.1, 22.4), (2.21, 2.29), (3.28, 2.84), 0.2255, (25.3, 30.9)),
    "1117": (236, (15.8, 19.8), (1.92, 2.00), (2.89, 2.50), 0.2610, (25.4, 31.1)),
}
HALF_STEP_MM = 0.05
USABLE_HALF_LENGTH_MM = FULL_HALF_LENGTH_MM - 15.0


@pytest.fixture(params=["1112", "1117"])
def name(request):
    return request.param


def on_plane(camera, film_mm):
    """Ground points of a flat Earth: the listed sizes are those of the tangent plane, 4 % less at the film's ends."""
    rays = camera.rays(film_mm)
    return rays.at(-rays.origin[..., 2] / rays.direction[..., 2])


def conjugates(name):
    """Film points of both cameras of the same ground, within both usable formats (15 mm less at each end)."""
    fore, aft = pair(name)
    first = film_points(USABLE_HALF_LENGTH_MM, HALF_WIDTH_MM)
    ground = on_plane(fore, first)
    second = aft.project(ground)
    seen = (np.abs(second) <= [USABLE_HALF_LENGTH_MM, HALF_WIDTH_MM]).all(axis=1)
    return first[seen], second[seen], ground[seen]


def test_film_to_ground_to_film_closes_within_a_millionth_of_a_pixel(name):
    film = film_points(FULL_HALF_LENGTH_MM, HALF_WIDTH_MM)
    for camera in pair(name):
        for height_m in (0.0, 4000.0):
            there_and_back = camera.project(camera.locate(film, height_m))
            assert np.abs(there_and_back - film).max() < 1e-6 * PIXEL_MM


def test_conjugate_rays_meet_where_they_came_from(name):
    fore, aft = pair(name)
    first, second, ground = conjugates(name)
    found, gap_m = meet(fore.rays(first), aft.rays(second))
    assert_allclose(found, ground, atol=1e-6)
    assert gap_m.max() < 1e-6


def test_rays_converge_by_twenty_five_to_thirty_one_degrees(name):
    fore, aft = pair(name)
    first, second, _ = conjugates(name)
    cosine = (fore.rays(first).direction * aft.rays(second).direction).sum(-1)
    angle_deg = np.degrees(np.arccos(cosine))
    # The extremes lie in the corners of the common ground, which the table's rounding moves by a kilometre.
    assert_allclose([angle_deg.min(), angle_deg.max()], SIZES[name][5], atol=0.5)


def test_base_is_just_over_half_the_height(name):
    fore, aft = (np.array(camera.position_m) for camera in pair(name))
    assert_allclose(np.linalg.norm(fore - aft) / (fore[2] + aft[2]) * 2, 0.55, atol=0.01)


def test_swath_and_width_on_the_ground(name):
    swath_km, (centre_km, end_km), *_ = SIZES[name]
    for camera in pair(name):
        ends = on_plane(camera, np.array([[-FULL_HALF_LENGTH_MM, 0.0], [FULL_HALF_LENGTH_MM, 0.0]]))
        assert_allclose(np.linalg.norm(ends[1] - ends[0]) / 1000, swath_km, rtol=0.01)
        for x_mm, expected_km in ((0.0, centre_km), (FULL_HALF_LENGTH_MM, end_km), (-FULL_HALF_LENGTH_MM, end_km)):
            edges = on_plane(camera, np.array([[x_mm, -HALF_WIDTH_MM], [x_mm, HALF_WIDTH_MM]]))
            assert_allclose(np.linalg.norm(edges[1] - edges[0]) / 1000, expected_km, rtol=0.04)


def test_ground_sampling_at_seven_micrometres(name):
    _, _, centre_m, end_m, *_ = SIZES[name]
    for camera in pair(name):
        for x_mm, expected_m in ((0.0, centre_m), (FULL_HALF_LENGTH_MM, end_m), (-FULL_HALF_LENGTH_MM, end_m)):
            steps = HALF_STEP_MM * np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
            left, right, low, high = on_plane(camera, steps + [x_mm, 0.0])
            sampling_m = np.linalg.norm([right - left, high - low], axis=1) * PIXEL_MM / (2 * HALF_STEP_MM)
            assert_allclose(sampling_m, expected_m, rtol=0.035)


def test_a_metre_of_height_is_a_quarter_of_a_pixel_of_parallax_along_the_flight(name):
    fore, aft = pair(name)
    _, _, ground = conjugates(name)
    rise = np.array([0.0, 0.0, 500.0])
    parallax_px = [(aft.project(ground + d) - fore.project(ground + d)) / PIXEL_MM for d in (-rise, rise)]
    per_metre = (parallax_px[1] - parallax_px[0]) / 1000.0
    assert_allclose(per_metre[:, 1].mean(), SIZES[name][4], rtol=0.02)
    assert abs(per_metre[:, 0].mean()) < 0.01
