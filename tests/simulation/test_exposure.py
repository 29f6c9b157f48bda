"""Rendered film against the physics that made it, at a coarse digitisation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pyproj import Transformer

from cosp.imaging.resampling import sample
from cosp.simulation import kernels
from cosp.simulation.defects import STRIPE_MM, cut_parts, deform_film, make_film
from cosp.simulation.exposure import Ground, expose_film, film_lattice, pixel_of_film
from cosp.simulation.orbit import ecef_from_geodetic
from cosp.simulation.reference import heights_at, make_reference_dem, make_reference_image, unstable_polygons
from cosp.simulation.site import SiteSettings, plan_site, without_defects
from cosp.simulation.terrain import (
    FILM_EPOCH,
    GLACIER,
    MODERN_EPOCH,
    continue_terrain,
    light_terrain,
    make_terrain,
)
from cosp.simulation.truth import scene_truth, true_film_coordinates, true_part_pixels

SETTINGS = without_defects(SiteSettings(pixel_um=280.0, terrain_m=150.0, seed=2))


@pytest.fixture(scope="module")
def plan():
    return plan_site(SETTINGS)


@pytest.fixture(scope="module")
def terrain(plan):
    return make_terrain(plan, threads=2)


@pytest.fixture(scope="module")
def ground(plan, terrain):
    return Ground.of(terrain.film, light_terrain(plan, terrain, FILM_EPOCH, threads=2), plan.terrain_grid, plan.crs)


def render(plan, scene, ground, threads=2):
    rows = {}
    for part, _, grey in expose_film(plan, scene, ground, threads=threads):
        rows.setdefault(part.letter, []).append(grey)
    return {letter: np.vstack(strips) for letter, strips in rows.items()}


@pytest.fixture(scope="module")
def films(plan, ground):
    return {scene.look: render(plan, scene, ground) for scene in plan.scenes}


def terrain_points(plan, terrain, scene, film_mm):
    """Ground (lon, lat, height) that film points see, by plain iteration on height."""
    heights = np.full(film_mm.shape[:-1], 1500.0)
    transformer = Transformer.from_crs("EPSG:4979", plan.crs, always_xy=True)
    for _ in range(60):
        geodetic = scene.exposure.ground_at(film_mm, heights)
        xy = np.stack(transformer.transform(geodetic[..., 0], geodetic[..., 1]), axis=-1)
        heights = 0.5 * (heights + heights_at(terrain.film, plan.terrain_grid, xy))
    return geodetic, np.abs(heights - geodetic[..., 2]) < 0.01


def test_rays_between_lattice_nodes_are_straight_to_a_hundredth_of_a_pixel(plan, ground):
    for pixel_um, step in ((7.0, 32), (56.0, 16), (140.0, 6)):
        settings = replace(SiteSettings(seed=2), pixel_um=pixel_um)
        scene = plan.scenes[0]
        film = make_film(settings, scene)
        part = film.parts[0]
        rows = 0.5 * part.shape[0] + step * np.array([0.0, 0.5, 1.0])
        columns = 0.16 * part.shape[1] + step * np.array([0.0, 0.5, 1.0])
        nodes = film_lattice(scene.exposure, film, part, rows, columns, ground)
        between = nodes[::2, ::2].mean(axis=(0, 1))
        gsd = np.linalg.norm(nodes[0, 2, 4:6] - nodes[0, 0, 4:6]) / step
        assert np.abs(between[2:] - nodes[1, 1, 2:]).max() / gsd < 0.01


def test_a_ray_meets_the_first_of_two_walls():
    heights = np.zeros((200, 200), np.float32)
    heights[:, 60:64] = 1400.0
    heights[:, 90:94] = 500.0
    maxima = kernels.block_maxima(heights, 16)
    node = np.empty(8)
    node[2], node[4], node[6] = 150.0 * 10.0, 100.0 * 10.0, 50.0 * 10.0  # falls from west to east
    node[3] = node[5] = node[7] = -1000.0
    t = kernels.meet_terrain(node, heights, maxima, 16, 0.0, 0.0, 10.0, -20.0, 1500.0)
    east = node[2] + t * (node[6] - node[2])
    assert 590.0 < east < 600.0
    # Past the last wall the flat ground is met exactly where the ray is at height zero.
    node[2], node[4], node[6] = 1700.0, 1650.0, 1600.0
    t = kernels.meet_terrain(node, heights, maxima, 16, 0.0, 0.0, 10.0, -20.0, 1500.0)
    assert_allclose(t * 1520.0 - 20.0, 0.0, atol=0.5)


def test_a_bright_spot_on_the_ground_appears_where_physics_says(plan, terrain):
    """One white cell on black ground, found again on both films at the predicted pixel."""
    for scene in plan.scenes:
        film = make_film(plan.settings, scene)
        points, good = terrain_points(plan, terrain, scene, np.array([[-200.0, 10.0], [35.0, -15.0], [150.0, 20.0]]))
        transformer = Transformer.from_crs("EPSG:4979", plan.crs, always_xy=True)
        xy = np.stack(transformer.transform(points[:, 0], points[:, 1]), axis=-1)
        rows, columns = (np.round(v).astype(int) for v in plan.terrain_grid.pixels(xy))
        scenery = light_terrain(plan, terrain, FILM_EPOCH, threads=2)
        scenery.radiance[:] = 0
        scenery.strength[:] = 0
        scenery.radiance[rows, columns] = 255
        spots = Ground.of(terrain.film, scenery, plan.terrain_grid, plan.crs)
        east_north = plan.terrain_grid.points(rows, columns)
        heights = terrain.film[rows, columns]
        lon, lat, _ = transformer.transform(east_north[:, 0], east_north[:, 1], heights, direction="INVERSE")
        spot = np.stack([lon, lat, heights], axis=-1)
        parts = render(plan, scene, spots)
        found = 0
        for letter, image in parts.items():
            part = next(p for p in film.parts if p.letter == letter)
            for (row, column), sure in zip(true_part_pixels(plan, scene, letter, spot), good, strict=True):
                if not (sure and 8 < row < part.shape[0] - 8 and 8 < column < part.shape[1] - 8):
                    continue
                r, c = int(round(row)), int(round(column))
                window = image[r - 4 : r + 5, c - 4 : c + 5].astype(float)
                window -= np.median(window)
                assert window.max() > 20.0
                weights = np.where(window > 0.2 * window.max(), window, 0.0)
                offsets = np.arange(-4, 5)
                centre = np.array([(weights.sum(1) * offsets).sum(), (weights.sum(0) * offsets).sum()]) / weights.sum()
                assert_allclose(centre + [r, c], [row, column], atol=0.4)
                found += 1
        assert found >= 3


def test_fore_and_aft_see_the_same_ground(plan, terrain, films):
    """Grey of the same ground points agrees, although the aft film arrives turned."""
    fore, aft = plan.scenes
    grid = np.stack(np.meshgrid(np.linspace(-300, 300, 90), np.linspace(-18, 18, 30), indexing="ij"), axis=-1)
    points, good = terrain_points(plan, terrain, fore, grid.reshape(-1, 2))
    seen = {}
    for scene in (fore, aft):
        grey = np.full(len(points), np.nan)
        for part in make_film(plan.settings, scene).parts:
            pixels = true_part_pixels(plan, scene, part.letter, points)
            inside = ((pixels > 2) & (pixels < np.array(part.shape) - 3)).all(axis=1)
            values = sample(films[scene.look][part.letter], pixels[:, 0], pixels[:, 1], interpolation="linear")
            grey[inside] = values[inside]
        seen[scene.look] = grey
    both = good & np.isfinite(seen["fore"]) & np.isfinite(seen["aft"])
    both &= np.abs(true_film_coordinates(plan, aft, points)[:, 1]) < 26.0
    assert both.sum() > 1000
    assert np.corrcoef(seen["fore"][both], seen["aft"][both])[0, 1] > 0.85
    shuffled = np.roll(seen["aft"][both], 7)
    assert np.corrcoef(seen["fore"][both], shuffled)[0, 1] < 0.6


def test_neighbouring_parts_show_the_same_film(plan, films):
    film = make_film(plan.settings, plan.scenes[0])
    for left, right in zip(film.parts[:-1], film.parts[1:], strict=True):
        edge = left.motion.shift[0] + left.shape[1] * left.pixel_mm / 2.0
        x = np.linspace(edge - plan.settings.overlap_mm + 2.0, edge - 2.0, 40)
        points = np.stack(np.meshgrid(x, np.linspace(-25.0, 25.0, 50)), axis=-1).reshape(-1, 2)
        grey = []
        for part in (left, right):
            pixels = part.pixels(points)
            assert ((pixels >= 0) & (pixels <= np.array(part.shape) - 1)).all()
            grey.append(sample(films["fore"][part.letter], pixels[:, 0], pixels[:, 1]).astype(float))
        assert np.corrcoef(*grey)[0, 1] > 0.95


def test_the_aft_film_arrives_turned(plan):
    fore, aft = plan.scenes
    for scene, letter, half in ((fore, "d", np.less), (aft, "a", np.greater)):
        east_and_north = scene.exposure.ground_at(np.array([340.0, 20.0]), 1200.0)
        pixel = true_part_pixels(plan, scene, letter, east_and_north)
        rows, columns = make_film(plan.settings, scene).parts[0].shape
        assert 0 < pixel[0] < rows
        assert 0 < pixel[1] < columns
        assert half(pixel[0], rows / 2)


def test_threads_do_not_change_the_film(plan, ground, films):
    once = render(plan, plan.scenes[0], ground, threads=1)
    for letter, image in once.items():
        assert_array_equal(image, films["fore"][letter])


def test_without_defects_measured_film_is_ideal_film(plan):
    film = make_film(plan.settings, plan.scenes[0])
    points = np.random.default_rng(0).uniform([-370, -27], [370, 27], (100, 2))
    assert_array_equal(film.deformation.measured(points), points)
    assert film.strokes
    assert all(part.motion.rotation_rad == 0.0 for part in film.parts)


@pytest.mark.parametrize(
    ("switch", "least_px", "most_px"),
    [
        ({"distortion_px": 1.5}, 0.9, 2.4),
        ({"bending_mm": 0.6}, 15.0, 60.0),
        ({"shrinkage": 1e-3}, 20.0, 40.0),
    ],
)
def test_each_deformation_has_the_size_it_was_given(switch, least_px, most_px):
    settings = replace(SETTINGS, **switch)
    points = np.stack(np.meshgrid(np.linspace(-370, 370, 200), np.linspace(-27, 27, 20)), axis=-1)
    sizes = [deform_film(settings, np.random.default_rng(k)).displacement(points) for k in range(6)]
    rms_px = np.sqrt(np.mean(np.square(sizes), axis=(0, 1, 2)) / 1.0) / 0.007
    assert least_px < rms_px.max() < most_px


def test_deformation_and_its_inverse_cancel():
    film = deform_film(SiteSettings(distortion_px=6.0, bending_mm=1.5), np.random.default_rng(1))
    points = np.random.default_rng(0).uniform([-370, -27], [370, 27], (500, 2))
    assert_allclose(film.ideal(film.measured(points)), points, atol=1e-9)


def test_part_pixels_and_delivered_film_are_inverse():
    for part in cut_parts(SiteSettings(), np.random.default_rng(5)):
        rows, columns = np.array([0.0, 17.5, 900.0]), np.array([3.0, 2000.0, 44.25])
        assert_allclose(part.pixels(part.delivered(rows, columns)), np.stack([rows, columns], axis=-1), atol=1e-9)


def test_only_kh4b_films_carry_stripes(plan, ground, films):
    lens = plan_site(replace(SETTINGS, camera="KH-4A"))
    marked = []
    for site, image in ((plan, films["fore"]["b"]), (lens, render(lens, lens.scenes[0], ground)["b"])):
        film = make_film(site.settings, site.scenes[0])
        x = np.linspace(-150.0, -60.0, 300)
        line = pixel_of_film(film, film.parts[1], np.stack([x, np.full(300, -STRIPE_MM)], axis=-1))
        marked.append(np.median(sample(image, line[:, 0], line[:, 1], interpolation="nearest")))
    assert marked[0] > 60.0
    assert marked[1] < 40.0


def test_the_film_is_dark_around_and_bright_at_the_scanner_border(films):
    for parts in films.values():
        assert np.median(parts["a"][:, :80][20:-20]) < 40.0
        assert np.median(parts["b"][-3:]) > 240.0
        assert 50.0 < np.median(parts["b"][60:-60]) < 200.0


def test_snow_saturates_and_gamma_keeps_order(plan, ground):
    bright = plan_site(replace(SETTINGS, saturation=0.2))
    image = render(bright, bright.scenes[0], ground)["c"]
    assert (image[60:-60] > 245).mean() > 0.3


def test_the_reference_shows_the_modern_ground_near_its_true_place(plan, terrain):
    scenery = light_terrain(plan, terrain, MODERN_EPOCH, threads=2)
    settings = replace(SETTINGS, reference_image_m=60.0, reference_dem_m=90.0)
    coarse = plan_site(settings)
    image, grid = make_reference_image(coarse, scenery, np.random.default_rng(1), threads=2)
    assert image.min() > 0
    assert image.shape == grid.shape
    heights, dem_grid, crs = make_reference_dem(coarse, terrain, np.random.default_rng(1))
    assert crs == plan.crs
    xy = dem_grid.centres()[50:-50:7, 50:-50:7]
    error = heights[50:-50:7, 50:-50:7] - heights_at(terrain.modern, plan.terrain_grid, xy)
    assert 1.5 < error.std() < 4.0


def test_the_reference_dem_may_have_a_system_of_its_own(plan, terrain):
    other = plan_site(replace(SETTINGS, reference_dem_crs="EPSG:4326", reference_dem_m=90.0))
    heights, grid, crs = make_reference_dem(other, terrain, np.random.default_rng(1))
    assert crs == "EPSG:4326"
    rows, columns = np.array([grid.shape[0] // 2]), np.array([grid.shape[1] // 2])
    lonlat = grid.points(rows, columns)
    xy = np.stack(Transformer.from_crs(crs, plan.crs, always_xy=True).transform(lonlat[:, 0], lonlat[:, 1]), axis=-1)
    assert_allclose(heights[rows, columns], heights_at(terrain.modern, plan.terrain_grid, xy), atol=15.0)


def test_glaciers_are_outlined_and_thinner_today(plan, terrain):
    ice = terrain.unstable == GLACIER
    assert 0.002 < ice.mean() < 0.2
    assert (terrain.film - terrain.modern)[ice].max() > 10.0
    stable = terrain.unstable == 0
    assert np.abs(terrain.film - terrain.modern)[stable].max() < 15.0
    outlines = unstable_polygons(plan, terrain)
    assert set(outlines["kind"]) == {"glacier", "lake"}
    area = outlines.area.sum() / (terrain.unstable > 0).sum() / plan.terrain_grid.step_x**2
    assert 0.8 < area < 1.5


def test_a_given_dem_is_kept_and_goes_on_without_a_step():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:300, :400]
    procedural = (200.0 * np.sin(x / 30.0) + 3.0 * rng.standard_normal((300, 400)).cumsum(1)).astype(np.float32)
    dem = np.full((300, 400), np.nan, np.float32)
    dem[100:200, 150:250] = 1500.0 + 2.0 * x[100:200, 150:250] + y[100:200, 150:250]
    merged = continue_terrain(dem, procedural, posting_m=30.0)
    known = np.isfinite(dem)
    assert_array_equal(merged[known], dem[known])
    step = np.abs(merged[100:200, 249] - merged[100:200, 250])
    own = np.abs(np.diff(procedural, axis=1)).max() + 4.0
    assert step.max() < own + 10.0
    far = np.abs(merged - procedural)[:, 380:]
    assert np.isfinite(merged).all()
    assert far.max() < 1800.0


def test_truth_tells_the_states_of_the_camera(plan):
    scene = plan.scenes[1]
    truth = scene_truth(plan, scene)
    rotation = truth["states"]["rotation_ecef_to_camera"]
    assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-12)
    # A state is enough to image a point: the camera's own axes point at what the slit sees.
    x_mm = truth["states"]["film_x_mm"][10]
    ground = ecef_from_geodetic(scene.exposure.ground_at(np.array([x_mm, 5.0]), 800.0))
    seen = rotation[10] @ (ground - truth["states"]["position_ecef_m"][10])
    assert_allclose(np.arctan2(seen[0], -seen[2]) * 609.6, x_mm, atol=1e-9)
    assert truth["film"]["turned"] is True
