"""The simulated orbit and camera against closed forms and each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.simulation.orbit import (
    FOCAL_LENGTH_MM,
    HALF_LENGTH_MM,
    SCAN_ANGLE_RAD,
    SCAN_TIME_S,
    ecef_from_geodetic,
    geodetic_from_ecef,
)
from cosp.simulation.site import SiteSettings, plan_site

FILM = np.stack(np.meshgrid(np.linspace(-370.0, 370.0, 15), [-27.0, 0.0, 27.0], indexing="ij"), axis=-1)


@pytest.fixture(params=["KH-4A", "KH-4B"])
def plan(request):
    return plan_site(SiteSettings(camera=request.param))


def test_the_satellite_obeys_kepler_and_newton(plan):
    orbit = plan.orbit
    assert_allclose(orbit.speed_m_s, np.sqrt(3.986004418e14 / orbit.radius_m))
    assert 7.79e3 < orbit.speed_m_s < 7.82e3
    # In the turning frame the acceleration is gravity, Coriolis and centrifugal force together.
    h = 0.05
    before, now, after = (orbit.position(np.array(t)) for t in (-h, 0.0, h))
    velocity = (after - before) / (2 * h)
    spin = np.array([0.0, 0.0, 7.292115e-5])
    gravity = -3.986004418e14 * now / np.linalg.norm(now) ** 3
    expected = gravity - 2 * np.cross(spin, velocity) - np.cross(spin, np.cross(spin, now))
    assert_allclose((after - 2 * now + before) / h**2, expected, atol=2e-5)


def test_a_descending_satellite_moves_south_2_8_km_in_a_scan(plan):
    exposure = plan.scenes[0].exposure
    first, last = geodetic_from_ecef(exposure.position(np.array([-0.5, 0.5]) * SCAN_TIME_S))
    assert first[1] > last[1]
    path = exposure.position(np.array([-0.5, 0.5]) * SCAN_TIME_S)
    assert 2.75e3 < np.linalg.norm(path[1] - path[0]) < 2.86e3


def test_film_points_return_from_the_ground_to_where_they_came_from(plan):
    for scene in plan.scenes:
        ground = scene.exposure.ground_at(FILM, 1500.0)
        assert_allclose(ground[..., 2], 1500.0, atol=1e-4)
        assert_allclose(scene.exposure.film_from_ground(ecef_from_geodetic(ground)), FILM, atol=1e-8)


def test_fore_looks_ahead_and_aft_back_at_the_same_ground(plan):
    fore, aft = (scene.exposure for scene in plan.scenes)
    meeting = [e.ground_at(np.zeros(2), 1200.0) for e in (fore, aft)]
    assert np.hypot(*(ecef_from_geodetic(meeting[0]) - ecef_from_geodetic(meeting[1]))[:2]) < 8e3
    assert fore.middle_s < 0.0 < aft.middle_s
    rays = [e.rays(np.zeros(2))[1] for e in (fore, aft)]
    assert 28.0 < np.degrees(np.arccos(rays[0] @ rays[1])) < 33.0


def test_fore_film_shows_east_to_the_right_and_north_up():
    fore = plan_site(SiteSettings()).scenes[0].exposure
    left, right, up, down = fore.ground_at(np.array([[-100.0, 0], [100.0, 0], [0, 20.0], [0, -20.0]]), 1000.0)
    assert right[0] > left[0]
    assert up[1] > down[1]


def test_the_cameras_scan_in_opposite_directions(plan):
    assert [scene.exposure.scan_direction for scene in plan.scenes] == [1, -1]
    assert_allclose(plan.scenes[0].exposure.time(np.array(HALF_LENGTH_MM)), SCAN_TIME_S / 2)


def test_motion_compensation_holds_the_image_still(plan):
    for scene in plan.scenes:
        exposure = scene.exposure
        ground = ecef_from_geodetic(exposure.ground_at(FILM, 1200.0))
        time_s = exposure.time(FILM[..., 0])
        with_it = np.abs(exposure.drift_mm_s(ground, time_s))
        switched_off = replace(exposure, nodding_rad_s=0.0, lens_rate_mm_s=0.0)
        without = np.abs(switched_off.drift_mm_s(ground, time_s))
        opposite = replace(exposure, nodding_rad_s=-exposure.nodding_rad_s, lens_rate_mm_s=-exposure.lens_rate_mm_s)
        # 3.8 px of 7 µm a millisecond at 165 km without, 0.15 px with it; the wrong sign doubles it.
        assert without.min() > 15.0
        assert with_it.max() < 0.05 * without.max()
        assert_allclose(np.abs(opposite.drift_mm_s(ground, time_s)).max(), 2.0 * without.max(), rtol=0.1)


def test_each_camera_compensates_in_its_own_way():
    nodding = plan_site(SiteSettings(camera="KH-4B")).scenes
    lens = plan_site(SiteSettings(camera="KH-4A")).scenes
    for scene in nodding:
        assert scene.exposure.lens_rate_mm_s == 0.0
        assert 0.7 < np.degrees(scene.exposure.nodding_rad_s) * SCAN_TIME_S < 1.05
    for scene in lens:
        assert scene.exposure.nodding_rad_s == 0.0
        factor = scene.exposure.lens_rate_mm_s / (SCAN_ANGLE_RAD / SCAN_TIME_S) / FOCAL_LENGTH_MM / np.cos(np.pi / 12)
        assert 0.0120 < factor < 0.0145  # V / (H δ) at 170 km


def test_points_off_the_scan_are_nan(plan):
    below = np.array([plan.settings.centre_longitude_deg + 40.0, 0.0, 0.0])
    assert np.isnan(plan.scenes[0].exposure.film_from_ground(ecef_from_geodetic(below))).all()
