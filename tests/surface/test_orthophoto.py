"""Claims about film brought onto the map."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from cosp.camera.mapping import MapProjector
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.surface.orthophoto import (
    cells_below,
    direction_to_lens,
    fill_heights,
    film_about,
    film_of_cells,
    film_window,
    heights_on,
    hidden_from_lens,
    median_shift,
    nearest_on,
    reach_of_occlusion,
    sample_film,
)
from tests.surface.synthetic import ORIGIN, camera, terrain_m, texture

CRS = "EPSG:32632"
FILM_GRID = PixelGrid(-29.96, 10.0, 0.07, -0.07, (286, 857))


@pytest.fixture
def rng():
    return np.random.default_rng(6)


@pytest.fixture(scope="module")
def fore():
    return camera("fore")


@pytest.fixture(scope="module")
def grid(fore):
    centre = fore.locate_geodetic(np.array([0.0, 0.0]), 1500.0)
    projector = MapProjector(fore, CRS, (0, 0, 1, 1))
    east, north, _ = projector.map_frame.map_from_geodetic(centre)
    return PixelGrid.covering((east - 5000, north - 2000, east + 5000, north + 2000), 25.0)


@pytest.fixture(scope="module")
def exposed(fore, grid):
    """A film of the textured terrain, by rays; and the mapping."""
    projector = MapProjector(fore, CRS, grid.bounds)
    to_map = projector.map_frame
    film_mm = FILM_GRID.centres()

    def height_at(lonlat):
        place = to_map.map_from_geodetic(np.concatenate([lonlat, np.zeros((*lonlat.shape[:-1], 1))], axis=-1))
        return terrain_m(place[..., 0], place[..., 1])

    ground = to_map.map_from_geodetic(ORIGIN.geodetic_from_local(fore.locate_on(film_mm, height_at, iterations=5)))
    return np.clip(np.rint(texture(ground[..., 0], ground[..., 1])), 1, 255).astype(np.uint8), projector


@pytest.mark.parametrize(("posting", "shape"), [(10.0, (512, 500)), (30.0, (200, 333))])
@pytest.mark.parametrize("along_mm", [0.0, -300.0])
def test_film_points_of_cells_are_those_of_the_camera(fore, posting, shape, along_mm):
    """Also far out on the film, over three kilometres of relief: to two hundredths of a 7 um pixel."""
    projector = MapProjector(fore, CRS, (0, 0, 1, 1))
    east, north, _ = projector.map_frame.map_from_geodetic(fore.locate_geodetic(np.array([along_mm, 0.0]), 1500.0))
    grid = PixelGrid(float(east), float(north), posting, -posting, shape)
    projector = MapProjector(fore, CRS, grid.bounds)
    heights_m = np.random.default_rng(3).uniform(300, 3300, shape)
    heights_m[5, 7:20] = np.nan
    found = film_of_cells(lambda xy, h: projector.film(xy[..., 0], xy[..., 1], h), grid, heights_m)
    centres = grid.centres()
    expected = projector.film(centres[..., 0], centres[..., 1], heights_m)
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert np.nanmax(np.abs(found - expected)) < 0.02 * 0.007
    nowhere = film_of_cells(lambda xy, h: pytest.fail("nothing to ask for"), grid, np.full(shape, np.nan))
    assert np.isnan(nowhere).all()


def test_the_orthophoto_shows_the_texture_of_the_ground(exposed, grid):
    film, projector = exposed
    xy = grid.centres()
    film_mm = projector.film(xy[..., 0], xy[..., 1], terrain_m(xy[..., 0], xy[..., 1]))
    ortho = sample_film(film, FILM_GRID, film_mm, np.zeros(grid.shape, bool))
    assert (ortho > 0).all()
    error = ortho.astype(float) - texture(xy[..., 0], xy[..., 1])
    assert np.sqrt(np.mean(error**2)) < 1.5  # rounding to grey values and a film pixel of 22 m
    # A height wrong by 100 m moves the ground by 27 m: the proof would notice.
    moved = projector.film(xy[..., 0], xy[..., 1], terrain_m(xy[..., 0], xy[..., 1]) + 100)
    wrong = sample_film(film, FILM_GRID, moved, np.zeros(grid.shape, bool)).astype(float) - texture(
        *np.moveaxis(xy, -1, 0)
    )
    assert np.sqrt(np.mean(wrong**2)) > 4


def test_a_window_of_the_film_gives_the_same_grey_values(exposed, grid):
    film, projector = exposed
    xy = grid.window(40, 60, 100, 150).centres()
    film_mm = projector.film(xy[..., 0], xy[..., 1], 1500.0)
    window = film_window(FILM_GRID, film_mm)
    part = FILM_GRID.window(window.row0, window.row1, window.column0, window.column1)
    shown = np.zeros((20, 50), bool)
    assert np.array_equal(
        sample_film(film[window.slices], part, film_mm, shown), sample_film(film, FILM_GRID, film_mm, shown)
    )
    assert film_window(FILM_GRID, film_mm + 500) is None
    assert film_window(FILM_GRID, np.full((3, 2), np.nan)) is None


def test_off_the_film_and_dark_leader_are_no_data(exposed):
    film, _ = exposed
    film = film.copy()
    film[:, :100] = 0
    film_mm = np.array([[-29.0, 0.0], [0.0, 0.0], [35.0, 0.0], [np.nan, 0.0]])
    grey = sample_film(film, FILM_GRID, film_mm, np.zeros(4, bool))
    assert (grey > 0).tolist() == [False, True, False, False]


def test_ground_behind_a_wall_is_hidden_as_far_as_the_shadow_reaches():
    grid = PixelGrid.covering((0, 0, 1000, 400), 10.0)
    heights = np.zeros(grid.shape, np.float32)
    heights[:, 50] = 100.0  # a wall along north, 100 m high
    # The lens stands to the east, 0.7 m of way per metre of height: the wall hides 70 m of ground to its west.
    east, north = np.full(grid.shape, 0.7), np.zeros(grid.shape)
    hidden = hidden_from_lens(heights, Window(0, *grid.shape[:1], 0, 100), grid, east, north, tolerance_m=0.5)
    assert hidden[20].nonzero()[0].tolist() == list(range(44, 50))
    part = Window(10, 20, 40, 60)
    assert np.array_equal(
        hidden_from_lens(heights, part, grid, east[part.slices], north[part.slices], tolerance_m=0.5),
        hidden[part.slices],
    )
    lower = hidden_from_lens(heights, part, grid, 0 * east[part.slices], north[part.slices], tolerance_m=0.5)
    assert not lower.any()


def test_missing_heights_hide_nothing():
    grid = PixelGrid.covering((0, 0, 500, 500), 10.0)
    heights = np.full(grid.shape, np.nan, np.float32)
    heights[:, :20] = 100
    slant = np.full(grid.shape, 0.5)
    whole = Window(0, 50, 0, 50)
    assert not hidden_from_lens(heights, whole, grid, slant, slant, tolerance_m=0.0).any()
    assert not hidden_from_lens(heights * np.nan, whole, grid, slant, slant, tolerance_m=0.0).any()


@pytest.mark.parametrize("move", [(0.04, 0.07), (-0.05, 0.02), (0.06, 0.0), (-0.03, -0.03)])
def test_lines_of_sight_that_pass_over_blocks_at_once_see_what_single_steps_see(move):
    """Lines over a rough ground of many blocks, each followed cell by cell in plain Python."""
    rng = np.random.default_rng(4)
    shape = (150, 140)
    heights = gaussian_filter(rng.normal(0, 1, shape), 6)
    heights = (800 + 700 * heights / heights.std() + rng.normal(0, 8, shape)).astype(np.float32)
    heights[70:80, 20:60] = np.nan
    grid = PixelGrid(0.0, 0.0, 10.0, -10.0, shape)
    east, north = np.full(shape, move[0] * 10.0), np.full(shape, -move[1] * 10.0)
    found = hidden_from_lens(heights, Window(0, shape[0], 0, shape[1]), grid, east, north, tolerance_m=3.0)
    step_m = 1 / max(abs(v) for v in move)
    top = np.nanmax(heights)
    expected = np.zeros(shape, bool)
    for row, column in np.argwhere(np.isfinite(heights)):
        height = float(heights[row, column])
        for n in range(1, int((top - height) / step_m) + 1):
            c, r, sight = column + n * step_m * move[0], row + n * step_m * move[1], height + n * step_m
            if not (0 <= c < shape[1] - 1 and 0 <= r < shape[0] - 1):
                break
            i, j = int(r), int(c)
            (a, b), (d, e) = heights[i : i + 2, j : j + 2].astype(float)
            upper, lower = a + (c - j) * (b - a), d + (c - j) * (e - d)
            if upper + (r - i) * (lower - upper) > sight + 3.0:
                expected[row, column] = True
                break
    assert 0.05 < expected.mean() < 0.8
    # Steps and heights are rounded otherwise.
    assert (found != expected).sum() <= 3


def test_a_tile_beside_the_film_is_known_by_a_few_of_its_cells(fore, grid):
    projector = MapProjector(fore, CRS, grid.bounds)

    def film_of(xy, h):
        return projector.film(xy[..., 0], xy[..., 1], h)

    about = film_about(film_of, grid, 400.0, 2400.0)
    rng = np.random.default_rng(2)
    film_mm = film_of(grid.centres(), rng.uniform(400.0, 2400.0, grid.shape))
    # All that can be seen of the tile lies within, but for the little that its edge is bent.
    assert (film_mm.min((0, 1)) > about.min((0, 1, 2)) - 2 * FILM_GRID.step_x).all()
    assert (film_mm.max((0, 1)) < about.max((0, 1, 2)) + 2 * FILM_GRID.step_x).all()
    assert film_window(FILM_GRID, about + 500) is None


def test_hidden_cells_are_those_whose_ray_meets_other_terrain_first(fore):
    """Cliffs far out on the scan, against a fine march along the camera's own rays."""
    place = fore.locate_geodetic(np.array([330.0, 5.0]), 1000.0)
    map_frame = MapProjector(fore, CRS, (0, 0, 1, 1)).map_frame
    east, north, _ = map_frame.map_from_geodetic(place)
    grid = PixelGrid.covering((east - 800, north - 600, east + 800, north + 600), 20.0)
    xy = grid.centres()
    heights = (1000 + 600 * (np.sin((xy[..., 0] - east) / 120) > 0.3)).astype(np.float32)
    projector = MapProjector(fore, CRS, grid.bounds)

    def film_of(points, height):
        return projector.film(points[..., 0], points[..., 1], height)

    def locate(film_mm, height):
        return projector.map_frame.map_from_local(fore.locate(film_mm, height))[..., :2]

    slant = direction_to_lens(locate, grid, film_of)
    hidden = hidden_from_lens(heights, Window(0, *grid.shape[:1], 0, grid.shape[1]), grid, *slant, tolerance_m=1.0)
    film = film_of(xy, heights)
    blocked = np.zeros(grid.shape, bool)
    for up in np.arange(5.0, 600.0, 5.0):
        rows, columns = grid.pixels(locate(film, heights + up))
        inside = (rows >= 0) & (rows <= grid.shape[0] - 1) & (columns >= 0) & (columns <= grid.shape[1] - 1)
        at = heights[
            np.clip(np.rint(rows), 0, grid.shape[0] - 1).astype(int),
            np.clip(np.rint(columns), 0, grid.shape[1] - 1).astype(int),
        ]
        blocked |= inside & (at > heights + up + 1.0)
    assert 0.05 < blocked.mean() < 0.6
    assert (hidden == blocked).mean() > 0.93  # the rest are cells at the edge of shadows


def test_heights_at_a_finer_posting_lie_on_the_model(grid):
    xy = grid.centres()
    tilted = (0.1 * (xy[..., 0] - grid.x0) + 0.2 * (xy[..., 1] - grid.y0)).astype(np.float32)
    fine = PixelGrid.covering((*xy[30, 40], *(xy[30, 40] + 300)), 5.0)
    below = cells_below(grid, fine)
    ground = grid.window(below.row0, below.row1, below.column0, below.column1)
    heights = heights_on(tilted[below.slices], ground, fine)
    at = fine.centres()
    assert_allclose(heights, 0.1 * (at[..., 0] - grid.x0) + 0.2 * (at[..., 1] - grid.y0), atol=0.2)
    marks = np.zeros(below.shape, bool)
    assert not nearest_on(marks, ground, fine).any()
    assert_allclose(heights_on(tilted, grid, grid), tilted, atol=1e-3)
    assert cells_below(grid, grid).shape == grid.shape


def test_holes_are_filled_at_the_level_of_their_surroundings():
    reference = np.arange(100.0).reshape(10, 10)
    ours = (reference + 7).astype(np.float32)
    ours[4:6, 4:6] = np.nan
    shift_m = median_shift(ours, reference)
    assert_allclose(fill_heights(ours, reference, shift_m), reference + 7)
    assert median_shift(ours[4:6, 4:6], reference[4:6, 4:6]) == 0.0


def test_what_lies_within_reach_hides_what_the_whole_terrain_hides(grid, rng):
    """A part with all that can stand before it gives the marks of the whole."""
    heights = np.float32(800) * rng.random(grid.shape, np.float32)
    east, north = np.full(grid.shape, -0.3), np.full(grid.shape, 0.8)
    whole = hidden_from_lens(heights, Window(0, *grid.shape[:1], 0, grid.shape[1]), grid, east, north, tolerance_m=5.0)
    part = Window(100, 130, 120, 160)
    reach = reach_of_occlusion(float(heights[part.slices].min()), float(heights.max()), east, north, grid)
    assert 20 < reach < 50  # 800 m at 0.8 m per metre, in cells of 25 m
    around = part.grown(reach, grid.shape)
    directions = (east[part.slices], north[part.slices])
    found = hidden_from_lens(heights[around.slices], part.inside(around), grid, *directions, tolerance_m=5.0)
    assert 0.05 < found.mean() < 0.999
    assert np.array_equal(found, whole[part.slices])
