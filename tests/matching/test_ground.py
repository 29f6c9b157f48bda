import numpy as np
import pytest
from pyproj import Transformer

from cosp.camera.mapping import MapProjector
from cosp.errors import NoOverlapError
from cosp.geometry.grids import PixelGrid
from cosp.geometry.rays import meet
from cosp.matching.film_image import FilmImage
from cosp.matching.ground import (
    PlacedFilm,
    Terrain,
    control_tiles,
    film_coordinates,
    film_lattice,
    ground_pixel_m,
    grown,
    lattice_rc,
    map_bounds,
    match_control,
    reduction_for,
    tile_about,
)
from cosp.matching.matchers import structural
from cosp.matching.relief import hillshade, relief_reference
from cosp.matching.structural import orientation_channels
from cosp.matching.ties import match_films

from .conftest import CRS, make_camera


def film_of(pixels, step=0.1):
    return FilmImage.from_array(pixels, PixelGrid(-10.0, 5.0, step, -step, pixels.shape))


def ramp(rows=101, columns=201):
    return (40 + np.arange(columns)[None, :] * 0.5 + np.arange(rows)[:, None] * 0.25).astype(np.uint8)


def test_a_reduced_film_keeps_its_place():
    film = film_of(ramp())
    points = np.array([[0.0, 0.0], [3.3, -2.1], [-6.0, 4.0]])
    np.testing.assert_allclose(film.reduced(4).sample(points), film.sample(points), atol=1.5)


def test_a_part_of_a_film_shows_the_same_as_the_whole():
    film = film_of(ramp())
    points = np.array([[0.5, 0.0], [1.3, -2.1]])
    np.testing.assert_array_equal(film.part(-1.0, 3.0).sample(points), film.sample(points))
    assert film.part(-1.0, 3.0).grid.shape[1] < 50


def test_film_is_nan_outside_and_where_it_holds_no_picture():
    pixels = ramp()
    pixels[:, :50] = 0
    values = film_of(pixels).sample(np.array([[-8.0, 0.0], [0.0, 0.0], [30.0, 0.0], [np.nan, 0.0]]))
    assert np.isnan(values).tolist() == [True, False, True, True]


def test_reduction_is_never_coarser_than_the_posting():
    assert [reduction_for(m, 2.2) for m in (1.0, 2.2, 4.3, 15.0)] == [1, 1, 2, 6]


def test_lattice_points_keep_their_margin_and_lie_about_the_middle():
    points = lattice_rc((121, 141), 24, 34)
    assert len(points) == 3 * 4
    assert points.min(axis=0)[0] >= 34
    np.testing.assert_allclose(points.mean(axis=0), [60, 70], atol=0.5)


def test_a_tile_lies_about_its_point_on_whole_postings():
    grid = tile_about(1234.0, 5678.0, 15.0, 100)
    assert abs((grid.bounds[0] + grid.bounds[2]) / 2 - 1234.0) < 15.0
    assert grid.bounds[0] % 15.0 == 0.0
    wide = tile_about(1234.0, 5678.0, 15.0, (80, 120))
    assert wide.shape == (80, 120)
    assert abs((wide.bounds[0] + wide.bounds[2]) / 2 - 1234.0) < 15.0
    assert abs((wide.bounds[1] + wide.bounds[3]) / 2 - 5678.0) < 15.0


def test_terrain_outside_the_elevation_model_is_an_error():
    with pytest.raises(NoOverlapError, match="no height"):
        Terrain.on(lambda grid: np.full(grid.shape, np.nan, np.float32), (0.0, 0.0, 100.0, 100.0), CRS, 10.0)


def test_opposite_suns_look_the_same_to_the_channels():
    rows, columns = np.mgrid[0:80, 0:80]
    heights = (100 * np.sin(rows / 9) * np.cos(columns / 13)).astype(np.float32)
    east, west = (orientation_channels(hillshade(heights, 90.0, a), bins=9, sigma_px=1.0) for a in (90.0, 270.0))
    correlation = np.corrcoef(east.ravel(), west.ravel())[0, 1]
    assert correlation > 0.9


def test_a_slope_towards_the_sun_is_the_brighter_one():
    eastings = np.arange(40.0)[None, :] * np.ones((40, 1)) * 30.0
    facing_west, facing_east = (0.3 * eastings).astype(np.float32), (-0.3 * eastings).astype(np.float32)
    assert hillshade(facing_east, 30.0, 90.0).mean() > hillshade(facing_west, 30.0, 90.0).mean() + 50


def test_relief_covers_its_whole_grid():
    shade = relief_reference(lambda grid: np.zeros(grid.shape, np.float32), 45.0)
    grid = PixelGrid.covering((0.0, 0.0, 900.0, 600.0), 30.0)
    assert np.isfinite(shade(grid)).all()
    assert shade(grid).shape == grid.shape


@pytest.mark.slow
def test_control_matches_lie_where_the_true_camera_shows_them(world, camera):
    film = world.expose(camera, rng=np.random.default_rng(1))
    reference = world.on(255 - world.image)
    matcher = structural(49, 8, 0.3, 0.9, 1.0)
    placed = PlacedFilm.of(
        film, camera, reference_on=reference, heights_on=world.on(world.heights), crs=CRS, reference_posting_m=60.0
    )
    tiles_mm = control_tiles(camera, 300)
    matches = match_control(placed, tiles_mm, matcher=matcher, template_px=49, search_px=8, threads=1)
    assert placed.posting_m == pytest.approx(max(60.0, placed.pixel_m))
    error = np.linalg.norm(camera.project_geodetic(matches.lonlath(CRS)) - matches.film_mm, axis=1) / film.pixel_mm
    assert len(matches) > 150
    assert np.median(error) < 0.2
    assert (error > 3).mean() < 0.02
    assert np.ptp(matches.film_mm[:, 0]) > 1.6 * camera.half_length_mm


@pytest.mark.parametrize(("posting_m", "expected_mm"), [(60.0, 25 * 0.28), (270.0, 2 * 27.7 / 3)])
def test_templates_leave_room_for_three_across_the_film(world, camera, posting_m, expected_mm):
    placed = PlacedFilm.of(
        world.expose(camera, pixel_mm=0.28), camera, reference_on=world.on(world.image),
        heights_on=world.on(world.heights), crs=CRS, reference_posting_m=posting_m,
    )  # fmt: skip
    template_px = placed.template_within_px(25)
    assert template_px <= 25
    assert placed.on_film_mm(template_px) == pytest.approx(expected_mm, abs=placed.on_film_mm(1.0))
    assert placed.on_film_mm(template_px) <= 2 * camera.half_width_mm / 3


@pytest.mark.slow
def test_tie_points_are_the_same_ground_in_both_films(world):
    cameras = [make_camera(look) for look in ("fore", "aft")]
    films = [world.expose(c, rng=np.random.default_rng(i)) for i, c in enumerate(cameras)]
    ties = match_films(
        *films, *cameras,
        heights_on=world.on(world.heights), crs=CRS, matcher_of=lambda *sizes: structural(*sizes, 0.3, 0.9, 1.0),
        candidates=800, template_px=41, search_px=8, gate_px=2.0, tile_mm=60.0, min_per_tile=6, min_ties=50,
        trials=100, rng=np.random.default_rng(0), threads=1,
    )  # fmt: skip
    _, gap_m = meet(cameras[0].rays(ties.first_mm), cameras[1].rays(ties.second_mm))
    pixel_m = ground_pixel_m(cameras[0], films[0].pixel_mm, 1000.0)
    assert len(ties) > 200
    assert ties.sigma_px.min() >= 0.3
    assert np.median(np.abs(gap_m)) < 0.2 * pixel_m
    assert np.abs(gap_m).max() < 1.5 * pixel_m


@pytest.mark.parametrize("posting", [2.0, 15.0, 85.0])
def test_film_coordinates_of_a_tile_are_those_of_its_pixels(camera, posting):
    east, north = (float(v) for v in Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(10.2, 46.1))
    grid = tile_about(east, north, posting, 131)
    rows, columns = np.mgrid[0:131, 0:131]
    heights = (1500 + 700 * np.sin(rows / 9) * np.cos(columns / 13)).astype(np.float32)
    heights[40:50, 60:70] = np.nan
    projector = MapProjector(camera, CRS, grid.bounds)
    centres = grid.centres()
    exact = projector.film(centres[..., 0], centres[..., 1], heights)
    found = film_coordinates(projector, grid, heights)
    # 7e-5 mm is a hundredth of a pixel of 7 um; what is left are the seams of the map's own lattice.
    np.testing.assert_allclose(found, exact, atol=max(7e-5, posting * 2e-6))
    assert np.isnan(found[45, 65]).all()


def test_a_buffered_film_shows_the_same_and_reads_each_piece_once():
    pixels = np.random.default_rng(0).integers(1, 255, (40, 3000)).astype(np.uint8)
    film, windows = film_of(pixels), []

    def read(window):
        windows.append(window)
        return film.read(window)

    buffered = FilmImage(film.grid, read).buffered()
    for x in (80.0, 90.0, 92.2, 100.0):
        points = np.array([[x, 3.0], [x + 2.0, 2.0]])
        np.testing.assert_array_equal(buffered.sample(points), film.sample(points))
    assert len(windows) == 2


@pytest.mark.parametrize(
    ("turned", "mirrored", "laid"),
    [(True, False, np.s_[::-1, ::-1]), (False, True, np.s_[::-1, :]), (True, True, np.s_[:, ::-1])],
)
def test_a_film_digitised_the_wrong_way_round_shows_the_same_once_it_is_laid_right(turned, mirrored, laid):
    pixels = np.random.default_rng(0).integers(1, 255, (41, 301)).astype(np.uint8)
    right = FilmImage.from_array(pixels, PixelGrid(-15.0, 2.0, 0.1, -0.1, pixels.shape))
    wrong = FilmImage.from_array(np.ascontiguousarray(pixels[laid]), right.grid)
    points = np.random.default_rng(1).uniform([-14, -1.5], [14, 1.5], (50, 2))
    film = wrong.laid(turned=turned, mirrored=mirrored)
    np.testing.assert_allclose(film.sample(points), right.sample(points), atol=0.02)
    near = points[(points[:, 0] > 2) & (points[:, 0] < 9)]
    np.testing.assert_allclose(film.part(1.0, 10.0).sample(near), right.sample(near), atol=0.02)
    assert film.part(1.0, 10.0).grid.shape[1] < 100
    assert np.nanmax(np.abs(wrong.sample(points) - right.sample(points))) > 10.0


def test_film_lattice_runs_along_the_film():
    points = film_lattice(100.0, 20.0, 5, 2)
    assert points.shape == (10, 2)
    assert (np.diff(points[:, 0]) >= 0).all()


def test_map_bounds_hold_the_whole_film(camera):
    xmin, ymin, xmax, ymax = grown(map_bounds(camera, CRS, (0.0, 3000.0)), 1.0)
    assert xmin < xmax
    assert ymin < ymax
    points = camera.locate_geodetic(film_lattice(camera.half_length_mm, camera.half_width_mm, 9, 3), 1500.0)
    east, north = Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(points[:, 0], points[:, 1])
    assert ((east > xmin) & (east < xmax) & (north > ymin) & (north < ymax)).all()
