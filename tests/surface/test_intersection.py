"""Claims about the intersection of conjugate rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.camera.field import FilmField
from cosp.geometry.grids import PixelGrid
from cosp.geometry.mapping import MapFrame
from cosp.geometry.rays import Rays, meet
from cosp.imaging.windows import Window
from cosp.surface.intersection import (
    PixelIntersection,
    height_per_pixel,
    intersect_pixels,
    miss_limit,
    nodes_over,
    pixel_on_ground,
    tabulate_rays,
)
from tests.surface.synthetic import LARGEST_ERROR_RAD, ORIGIN, PIXEL_MM, camera, conjugate_pixels, film_of, ray_table

# Two rows each from all over a film, wide enough for more pixels than are intersected side by side, and not a multiple.
WINDOWS = [Window(row, row + 2, -4000, 4001) for row in (-51_000, -30_011, -9_000, -1, 7, 20_333, 44_000, 50_990)]


@pytest.fixture(scope="module")
def pair():
    return camera("fore"), camera("aft")


@pytest.fixture(scope="module")
def tables(pair):
    # The aft image shows the same ground on other rows and columns of this plain grid.
    return ray_table(pair[0]), ray_table(pair[1], rows=(-54_000, 54_000), columns=(-9000, 9000))


def heights(rng, window):
    return rng.uniform(0, 8e3, window.shape)


@pytest.mark.parametrize("window", WINDOWS)
def test_conjugate_pixels_meet_within_a_millimetre_of_their_ground_over_the_whole_film(pair, tables, window):
    ground_m, disparity, y_parallax = conjugate_pixels(*pair, window, heights(np.random.default_rng(3), window))
    found, miss_m = intersect_pixels(*tables, window, disparity, y_parallax)
    known = np.isfinite(ground_m).all(-1)
    assert known.mean() > 0.9
    assert_allclose(found[known], ground_m[known], atol=1e-3)
    assert miss_m[known].max() < 1e-3


@pytest.mark.parametrize("window", WINDOWS[::3])
def test_tables_give_the_closed_form_also_where_rays_miss_each_other(pair, tables, window):
    rng = np.random.default_rng(4)
    _, disparity, y_parallax = conjugate_pixels(*pair, window, heights(rng, window))
    disparity += rng.normal(0, 3, window.shape)
    y_parallax += rng.normal(0, 3, window.shape)
    found, miss_m = intersect_pixels(*tables, window, disparity, y_parallax)
    rows, columns = np.arange(window.row0, window.row1)[:, None], np.arange(window.column0, window.column1)
    fore_film = film_of(np.stack(np.broadcast_arrays(columns, rows), axis=-1))
    aft_film = film_of(np.stack([columns + disparity, rows + y_parallax], axis=-1))
    expected, gap_m = meet(*(c.rays(film) for c, film in zip(pair, (fore_film, aft_film), strict=True)))
    known = np.isfinite(found).all(-1)
    assert known.mean() > 0.9
    assert np.median(gap_m[known]) > 1  # metres: the rays do miss
    assert_allclose(found[known], expected[known], atol=1e-3)
    assert_allclose(miss_m[known], gap_m[known], atol=1e-3)


def test_the_meeting_point_has_the_least_sum_of_squared_distances(pair, tables):
    window = Window(100, 101, -300, -295)
    _, disparity, y_parallax = conjugate_pixels(*pair, window, np.full(window.shape, 1500.0))
    disparity += 4
    y_parallax += 7
    found, _ = intersect_pixels(*tables, window, disparity, y_parallax)
    for i in range(5):
        normal, right = np.zeros((3, 3)), np.zeros(3)
        places = [-300 + i, 100], [-300 + i + disparity[0, i], 100 + y_parallax[0, i]]
        for c, place in zip(pair, places, strict=True):
            rays = c.rays(film_of(np.array(place)))
            across = np.eye(3) - np.outer(rays.direction, rays.direction)
            normal += across
            right += across @ rays.origin
        assert_allclose(found[0, i], np.linalg.solve(normal, right), atol=1e-3)


def test_pixels_without_disparity_and_pixels_off_the_film_are_nan(tables):
    window = Window(0, 1, 0, 5)
    disparity = np.array([[0.0, np.nan, 9000.0, -9100.0, 0.0]])
    y_parallax = np.array([[0.0, 0.0, 0.0, 0.0, 54_001.0]])
    found, miss_m = intersect_pixels(*tables, window, disparity, y_parallax)
    assert np.isfinite(found[0]).all(axis=-1).tolist() == [True, False, False, False, False]
    assert np.isfinite(miss_m[0]).tolist() == [True, False, False, False, False]


def test_any_cut_gives_the_same_ground(pair, tables):
    window = Window(-40, -30, -700, 1234)
    _, disparity, y_parallax = conjugate_pixels(*pair, window, heights(np.random.default_rng(6), window))
    whole, miss_m = intersect_pixels(*tables, window, disparity, y_parallax)
    part = Window(-36, -33, -101, 900)
    inner = part.inside(window).slices
    cut, miss_cut = intersect_pixels(*tables, part, disparity[inner].copy(), y_parallax[inner].copy())
    assert_allclose(cut, whole[inner], atol=1e-6)
    assert_allclose(miss_cut, miss_m[inner], atol=1e-6)


def test_a_table_is_refused_for_rays_that_bend_between_its_nodes(pair):
    def bent(place):
        film_mm = film_of(place)
        return pair[0].rays(film_mm + 1e-2 * np.stack([np.zeros(film_mm.shape[:-1]), film_mm[..., 1] ** 2], axis=-1))

    with pytest.raises(ValueError, match="bend by"):
        tabulate_rays(
            bent,
            nodes_over((-4000, -500), (4000, 500), spacing_px=50.0),
            largest_error_rad=LARGEST_ERROR_RAD,
        )


def test_a_few_cells_in_which_rays_bend_are_left_out(pair):
    def bent_at_the_end(place):
        film_mm = film_of(place)
        beyond = np.maximum(place[..., 1:] - 7950.0, 0.0) * 1e-4
        return pair[0].rays(film_mm + beyond**2)

    nodes = nodes_over((-500, -8000), (500, 8000), spacing_px=50.0)
    straight = tabulate_rays(lambda place: pair[0].rays(film_of(place)), nodes, largest_error_rad=1.0)
    table = tabulate_rays(bent_at_the_end, nodes, largest_error_rad=1e-8)
    assert np.isfinite(straight.values).all()
    assert np.isnan(table.values[-1]).all()
    assert_allclose(table.values[:-2], straight.values[:-2], atol=1e-12)


def test_a_table_takes_any_camera_whose_rays_are_smooth():
    def frame_camera(film_mm):  # a frame camera: one station, central projection
        direction = np.concatenate([film_mm, np.full((*film_mm.shape[:-1], 1), -300.0)], axis=-1)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        return Rays(np.broadcast_to([0.0, 0.0, 5000.0], direction.shape), direction)

    nodes = nodes_over((-100, -100), (100, 100), spacing_px=0.4)
    table = tabulate_rays(frame_camera, nodes, largest_error_rad=LARGEST_ERROR_RAD)
    moved = tabulate_rays(
        lambda film: Rays(frame_camera(film).origin + [2000.0, 0, 0], frame_camera(film).direction),
        nodes,
        largest_error_rad=LARGEST_ERROR_RAD,
    )
    place = np.array([30.0, 18.0])  # of the ground at 500, 300, 0 m: 300 mm over 5000 m
    aft = -300.0 * (np.array([500.0, 300.0]) - [2000, 0]) / -5000.0
    found, _ = intersect_pixels(
        table, moved, Window(18, 19, 30, 31), np.array([[aft[0] - place[0]]]), np.array([[aft[1] - place[1]]])
    )
    assert_allclose(found[0, 0], [500.0, 300.0, 0.0], atol=1e-3)


def test_tables_hold_distorted_film_too(pair):
    """Distortion as of real film: 1.5 px of 7 um rms that changes over some centimetres in both directions."""
    rng = np.random.default_rng(8)
    films = [
        FilmField.flat(half_length_mm=380.0, half_width_mm=65.0, knots_along_mm=20.0, knots_across_mm=20.0)
        for _ in pair
    ]
    cameras = [
        replace(c, film_field=field.with_coefficients(rng.normal(0, 0.0105, (*field.shape, 2))))
        for c, field in zip(pair, films, strict=True)
    ]
    tables = ray_table(cameras[0]), ray_table(cameras[1], rows=(-54_000, 54_000), columns=(-9000, 9000))
    for window in WINDOWS[::2]:
        ground_m, disparity, y_parallax = conjugate_pixels(*cameras, window, heights(rng, window))
        known = np.isfinite(ground_m).all(-1)
        plain = pair[0].rays(film_of(np.array([0.0, window.row0]))).direction
        assert np.abs(plain - cameras[0].rays(film_of(np.array([0.0, window.row0]))).direction).max() > 1e-6
        found, miss_m = intersect_pixels(*tables, window, disparity, y_parallax)
        assert_allclose(found[known], ground_m[known], atol=3e-3)
        assert miss_m[known].max() < 3e-3


def test_a_prepared_pair_leaves_out_disparities_of_ground_that_cannot_be(pair):
    class Plain:
        shape = (300, 500)
        disparity_range_px = (-400.0, 2400.0)

        @staticmethod
        def fore_film(rows, columns):
            return film_of(np.stack(np.broadcast_arrays(columns - 250.0, rows - 150.0), axis=-1))

        aft_film = fore_film

        def disparity_bounds(self, rows, columns):
            film = self.fore_film(rows, columns)
            ends = [pair[1].project(pair[0].locate(film, h))[..., 1] - film[..., 1] for h in (0.0, 2000.0)]
            return np.minimum(*ends) / PIXEL_MM, np.maximum(*ends) / PIXEL_MM

    # The rows of this plain image are no epipolar lines: what lies across them is said as y-parallax.
    window = Window(0, 300, 0, 500)
    shifted = Window(-150, 150, -250, 250)
    rng = np.random.default_rng(2)
    height_m = rng.uniform(100, 1900, window.shape)
    height_m[::7] = 5000.0
    ground_m, disparity, y_parallax = conjugate_pixels(*pair, shifted, height_m)
    middle = float(np.median(y_parallax))
    nodes = nodes_over((0, 0), (499, 299), spacing_px=50.0)
    pixels = PixelIntersection.prepare(
        Plain(),
        *(c.rays for c in pair),
        np.full(nodes.shape, middle),
        nodes,
        spacing_px=50.0,
        largest_error_rad=LARGEST_ERROR_RAD,
    )
    found, miss_m = pixels.ground(window, disparity.astype(np.float32))
    unlikely = height_m > 2000
    assert np.isnan(found[unlikely]).all()
    assert np.isnan(miss_m[unlikely]).all()
    assert np.isfinite(found[~unlikely]).all()
    # Rays miss by the y-parallax that was not said, about 2 m a pixel.
    left_px = np.abs(y_parallax - middle)[~unlikely]
    assert 0.5 < np.median(miss_m[~unlikely][left_px > 1] / left_px[left_px > 1]) < 3
    assert np.abs(found - ground_m)[~unlikely].max() < 10 * left_px.max() + 1


def test_points_on_the_map_are_those_of_the_closed_form(pair, tables):
    """The way of `grid_dem`: from pixels to cells of the map in one go, without those that are not to be used."""
    rng = np.random.default_rng(8)
    window = Window(20_333, 20_340, -500, 1001)
    ground_m, disparity, y_parallax = conjugate_pixels(*pair, window, rng.uniform(0, 3000, window.shape))
    y_parallax += rng.normal(0, 1, window.shape)
    nodes = nodes_over((window.column0, window.row0), (window.column1 - 1, window.row1 - 1), spacing_px=1.0)
    anything = np.full((2, 2), 1e4)
    pixels = PixelIntersection(*tables, -anything, anything, y_parallax, nodes)
    disparity = disparity.astype(np.float32)
    disparity[:, ::7] = np.nan
    confidence = rng.integers(0, 256, window.shape).astype(np.uint8)
    weights = np.where(np.arange(256) < 40, 0.0, np.arange(256) / 255)
    found, miss_m = pixels.ground(window, disparity)
    few, few_miss_m = pixels.ground(window, disparity[::3, ::3], every=3)
    assert_allclose(few, found[::3, ::3], atol=1e-4)
    assert_allclose(few_miss_m, miss_m[::3, ::3], atol=1e-4)

    limit_m = float(np.nanmedian(miss_m))
    to_map = MapFrame(ORIGIN, "EPSG:32632", (0.0, 0.0, 1.0, 1.0), margin_m=1.0)
    corners = to_map.map_from_geodetic(ORIGIN.geodetic_from_local(ground_m.reshape(-1, 3)))[:, :2]
    bounds = (*corners.min(axis=0), *corners.max(axis=0))
    to_map = MapFrame(ORIGIN, "EPSG:32632", bounds)
    grid = PixelGrid.covering(bounds, 10.0)
    kept = (miss_m <= limit_m) & (confidence >= 40)
    assert 0.2 < kept.mean() < 0.5
    expected = to_map.map_from_local(found[kept])
    first = (grid.shape[0] // 2, 3)
    points = pixels.cell_points(
        window,
        disparity,
        confidence,
        weights=weights,
        largest_miss_m=limit_m,
        map_frame=to_map,
        grid=grid,
        first_cell=first,
    )
    assert points.dtype == np.float32
    rows, columns = grid.pixels(expected[:, :2])
    assert_allclose(points[:, 0], columns - first[1], atol=1e-4)
    assert_allclose(points[:, 1], rows - first[0], atol=1e-4)
    assert_allclose(points[:, 2], expected[:, 2], atol=1e-3)
    assert_allclose(points[:, 3], weights[confidence[kept]], rtol=1e-6)


def test_the_miss_limit_follows_the_noise_but_has_a_floor():
    gaps = np.abs(np.random.default_rng(5).normal(0, 2.0, 100_000))
    gaps[:1000] = 500.0  # a percent of gross errors
    gaps[1000:1100] = np.nan
    assert 9.5 < miss_limit(gaps, gate_sigmas=5, least_m=1.0) < 10.5
    assert miss_limit(gaps * 1e-6, gate_sigmas=5, least_m=1.0) == 1.0
    assert miss_limit(np.full(3, np.nan), gate_sigmas=5, least_m=1.0) == 1.0


def test_one_pixel_of_parallax_is_worth_the_height_that_the_geometry_says(pair, tables):
    window = Window(-20, 20, -100, 100)
    ground_m, disparity, y_parallax = conjugate_pixels(*pair, window, np.full(window.shape, 1100.0))
    here, _ = intersect_pixels(*tables, window, disparity, y_parallax)
    there, _ = intersect_pixels(*tables, window, disparity + 1.0, y_parallax)
    # Two rays at +-15 degrees: moving one by a ground pixel g lifts the point by g / (2 sin 15) of the other ray.
    range_m = np.linalg.norm(ground_m - np.array(pair[0].position_m), axis=-1)
    g = pixel_on_ground(range_m, pair[0].focal_length_mm, PIXEL_MM)
    assert_allclose(height_per_pixel([here], [there]), g / (2 * np.sin(np.radians(15))), rtol=0.05)
