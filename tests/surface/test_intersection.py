"""Claims about the intersection of conjugate rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.camera.field import FilmField
from cosp.geometry.rays import Rays, meet
from cosp.surface.intersection import (
    height_per_pixel,
    intersect_tabulated,
    miss_limit,
    pixel_on_ground,
    tabulate_rays,
)
from tests.surface.synthetic import camera

WHOLE_FILM = {"half_length_mm": 372.0, "half_width_mm": 30.0, "places": 8192}


@pytest.fixture(scope="module")
def pair():
    return camera("fore"), camera("aft")


@pytest.fixture(scope="module")
def tables(pair):
    return tuple(tabulate_rays(c.rays, **WHOLE_FILM) for c in pair)


@pytest.fixture(scope="module")
def ground_m():
    rng = np.random.default_rng(3)
    return np.stack([rng.uniform(-9e4, 9e4, 20000), rng.uniform(-6e3, 6e3, 20000), rng.uniform(0, 8e3, 20000)], axis=-1)


def test_projected_points_come_back_within_a_millimetre_over_the_whole_film(pair, tables, ground_m):
    films = [c.project(ground_m) for c in pair]
    found, miss_m = intersect_tabulated(*tables, *films)
    assert np.isfinite(found).all()
    assert_allclose(found, ground_m, atol=1e-3)
    assert miss_m.max() < 1e-3


def test_tables_give_the_closed_form_also_where_rays_miss_each_other(pair, tables, ground_m):
    rng = np.random.default_rng(4)
    films = [c.project(ground_m) + rng.normal(0, 0.02, (len(ground_m), 2)) for c in pair]
    found, miss_m = intersect_tabulated(*tables, *films)
    expected, gap_m = meet(*(c.rays(film) for c, film in zip(pair, films, strict=True)))
    assert np.median(gap_m) > 1  # metres: the rays do miss
    assert_allclose(found, expected, atol=1e-3)
    assert_allclose(miss_m, gap_m, atol=1e-3)


def test_the_meeting_point_has_the_least_sum_of_squared_distances(tables, ground_m):
    fore, aft = camera("fore"), camera("aft")
    films = [c.project(ground_m[:5]) + d for c, d in ((fore, [0, 0.05]), (aft, [0.03, 0]))]
    found, _ = intersect_tabulated(*tables, *films)
    for i in range(5):
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for c, film in zip((fore, aft), films, strict=True):
            rays = c.rays(film[i])
            across = np.eye(3) - np.outer(rays.direction, rays.direction)
            normal += across
            right += across @ rays.origin
        assert_allclose(found[i], np.linalg.solve(normal, right), atol=1e-3)


def test_missing_points_and_points_off_the_film_are_nan(tables):
    film = np.array([[0.0, 0.0], [np.nan, 0.0], [400.0, 0.0], [-400.0, 0.0]])
    found, miss_m = intersect_tabulated(*tables, film, film)
    assert np.isfinite(found).all(axis=-1).tolist() == [True, False, False, False]
    assert np.isfinite(miss_m).tolist() == [True, False, False, False]


def test_shape_is_kept_and_threads_change_nothing(pair, tables, ground_m):
    films = [c.project(ground_m).reshape(100, 200, 2) for c in pair]
    one, miss_one = intersect_tabulated(*tables, *films, threads=1)
    three, miss_three = intersect_tabulated(*tables, *films, threads=3)
    assert one.shape == (100, 200, 3)
    assert miss_one.shape == (100, 200)
    assert np.array_equal(one, three)
    assert np.array_equal(miss_one, miss_three)


def test_a_table_is_refused_for_rays_that_bend_across_the_film(pair):
    def bent(film_mm):
        moved = film_mm + 1e-3 * np.stack([np.zeros_like(film_mm[..., 0]), film_mm[..., 1] ** 2], axis=-1)
        return pair[0].rays(moved)

    with pytest.raises(ValueError, match="bend by"):
        tabulate_rays(bent, **WHOLE_FILM)


def test_a_table_takes_any_camera_whose_rays_are_straight_in_y():
    def frame_camera(film_mm):  # a frame camera: one station, central projection
        direction = np.concatenate([film_mm, np.full((*film_mm.shape[:-1], 1), -300.0)], axis=-1)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        return Rays(np.broadcast_to([0.0, 0.0, 5000.0], direction.shape), direction)

    table = tabulate_rays(frame_camera, half_length_mm=100.0, half_width_mm=100.0, places=2001)
    moved = tabulate_rays(
        lambda film: Rays(frame_camera(film).origin + [2000.0, 0, 0], frame_camera(film).direction),
        half_length_mm=100.0,
        half_width_mm=100.0,
        places=2001,
    )
    ground = np.array([500.0, 300.0, 100.0])
    fore = -300.0 * (ground - [0, 0, 5000])[:2] / (ground[2] - 5000)
    aft = -300.0 * (ground - [2000, 0, 5000])[:2] / (ground[2] - 5000)
    found, _ = intersect_tabulated(table, moved, fore, aft)
    assert_allclose(found, ground, atol=1e-3)


def test_tables_hold_distorted_film_too(pair, ground_m):
    """Distortion as of real film: 1.5 px of 7 um rms that changes over some centimetres in both directions."""
    rng = np.random.default_rng(8)
    films = [
        FilmField.flat(half_length_mm=372.0, half_width_mm=30.0, knots_along_mm=20.0, knots_across_mm=20.0)
        for _ in pair
    ]
    cameras = [
        replace(c, film_field=field.with_coefficients(rng.normal(0, 0.0105, (*field.shape, 2))))
        for c, field in zip(pair, films, strict=True)
    ]
    tables = [tabulate_rays(c.rays, **WHOLE_FILM) for c in cameras]
    film_mm = [c.project(ground_m) for c in cameras]
    assert np.abs(film_mm[0] - pair[0].project(ground_m)).max() > 0.01
    found, miss_m = intersect_tabulated(*tables, *film_mm)
    # A fiftieth of a pixel is 4 cm on the ground, 8 cm of height.
    assert np.abs(found - ground_m).max() < 0.05
    assert np.median(np.abs(found - ground_m)) < 0.002
    assert miss_m.max() < 0.05


def test_the_miss_limit_follows_the_noise_but_has_a_floor():
    gaps = np.abs(np.random.default_rng(5).normal(0, 2.0, 100_000))
    gaps[:1000] = 500.0  # a percent of gross errors
    gaps[1000:1100] = np.nan
    assert 9.5 < miss_limit(gaps, gate_sigmas=5, least_m=1.0) < 10.5
    assert miss_limit(gaps * 1e-6, gate_sigmas=5, least_m=1.0) == 1.0
    assert miss_limit(np.full(3, np.nan), gate_sigmas=5, least_m=1.0) == 1.0


def test_one_pixel_of_parallax_is_worth_the_height_that_the_geometry_says():
    pixel_mm = 0.007
    fore, aft = camera("fore"), camera("aft")
    ground = np.array([[0.0, 0.0, 1000.0], [2000.0, 100.0, 1200.0]])
    tables = [tabulate_rays(c.rays, **WHOLE_FILM) for c in (fore, aft)]
    films = [c.project(ground) for c in (fore, aft)]
    here, _ = intersect_tabulated(*tables, *films)
    there, _ = intersect_tabulated(*tables, films[0], films[1] + [0.0, pixel_mm])
    # Two rays at +-15 degrees: moving one by a ground pixel g lifts the point by g / (2 sin 15) of the other ray.
    range_m = np.linalg.norm(ground - np.array(fore.position_m), axis=-1)
    g = pixel_on_ground(range_m, fore.focal_length_mm, pixel_mm)
    assert_allclose(height_per_pixel([here], [there]), g / (2 * np.sin(np.radians(15))), rtol=0.05)
