"""Placement of whole films: a synthetic world, coarse films, and predictions that are far off."""

from datetime import date

import numpy as np
import pytest

from cosp.errors import PlacementError
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.matching.film_image import FilmImage
from cosp.matching.placement import locate_film, turned_about_centre
from cosp.matching.search import Candidate, Found, View, Way, _standardised, halved

from .conftest import CRS, FILM_PIXEL_MM, moved, texture


@pytest.fixture(scope="module")
def film(world, camera):
    return world.expose(camera, rng=np.random.default_rng(1))


def locate(film, predicted, world, *, reference=None, heights=None, search_m=8000.0, with_image=True, day=None):
    located = locate_film(
        film,
        predicted,
        reference_on=world.on(world.image if reference is None else reference) if with_image else None,
        heights_on=world.on(world.heights if heights is None else heights),
        day=day,
        crs=CRS,
        search_m=search_m,
        coarse_posting_m=240.0,
        fine_posting_m=80.0,
        min_score=7.0,
        min_margin=3.0,
        min_agreeing=20,
        min_agreeing_share=0.3,
        min_block_share=0.5,
        rng=np.random.default_rng(0),
        threads=1,
    )
    if located.footprint is None:
        raise PlacementError(located.refusal)
    return located.footprint


def film_error_px(found, camera):
    points = np.stack(np.meshgrid(np.linspace(-195, 195, 9), np.linspace(-26, 26, 3)), -1)
    return np.linalg.norm(found.project(camera.locate(points, 1000.0)) - points, axis=-1) / FILM_PIXEL_MM


def test_a_film_five_kilometres_off_is_placed_to_a_fraction_of_a_pixel(film, camera, world):
    footprint = locate(film, moved(camera, 5000.0, -4000.0), world)
    assert film_error_px(footprint.camera, camera).max() < 0.3
    assert not footprint.turned
    assert abs(footprint.shift_east_m + 5000.0) < 100.0
    assert abs(footprint.shift_north_m - 4000.0) < 100.0


WAYS = {
    (True, False): np.s_[::-1, ::-1],
    (False, True): np.s_[::-1, :],
    (True, True): np.s_[:, ::-1],
}


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_a_film_that_lies_the_wrong_way_round_is_placed_and_says_so(film, camera, world, way):
    pixels = film.read(Window(0, film.grid.shape[0], 0, film.grid.shape[1]))[WAYS[way]]
    footprint = locate(FilmImage.from_array(pixels, film.grid), moved(camera, -12000.0, 9000.0), world, search_m=15000)
    assert (footprint.turned, footprint.mirrored) == way
    assert film_error_px(footprint.camera, camera).max() < 0.3


@pytest.mark.slow
def test_heading_and_scale_may_be_wrong_by_ten_degrees_and_five_per_cent(film, camera, world):
    predicted = moved(turned_about_centre(camera, np.radians(9.0), 0.955, 900.0), 4000.0, 3000.0)
    footprint = locate(film, predicted, world)
    assert film_error_px(footprint.camera, camera).max() < 0.3
    assert abs(footprint.rotation_deg + 9.0) < 0.2
    assert abs(footprint.scale - 1 / 0.955) < 0.01


def test_a_camera_turned_about_its_centre_shows_turned_ground(camera):
    angle, scale = np.radians(7.0), 1.03
    other = turned_about_centre(camera, angle, scale, 900.0)
    points = np.array([[0.0, 0.0], [30.0, 10.0], [-60.0, -20.0]])
    ground, turned = camera.locate(points, 900.0)[:, :2], other.locate(points, 900.0)[:, :2]
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    expected = ground[0] + (ground - ground[0]) @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(turned, expected, atol=40.0)  # the Earth is round
    assert np.linalg.norm(turned[2] - ground[2]) > 2000.0


@pytest.mark.slow
def test_a_changed_negative_reference_still_places_the_film(film, camera, world):
    other = texture(world.grid.shape, np.random.default_rng(8))
    footprint = locate(film, moved(camera, 3000.0, 3000.0), world, reference=255 - 0.7 * world.image + 0.6 * other)
    assert film_error_px(footprint.camera, camera).max() < 0.5


@pytest.mark.slow
def test_noise_is_refused(camera, world):
    rng = np.random.default_rng(4)
    columns, rows = round(2 * camera.half_length_mm / FILM_PIXEL_MM), round(2 * camera.half_width_mm / FILM_PIXEL_MM)
    film_grid = PixelGrid(-199.86, 27.6, FILM_PIXEL_MM, -FILM_PIXEL_MM, (rows, columns))
    noise = FilmImage.from_array(texture((rows, columns), rng).astype(np.uint8), film_grid)
    with pytest.raises(PlacementError, match="cannot be placed"):
        locate(noise, camera, world, search_m=4000.0, day=date(1968, 12, 21))


def test_a_film_far_outside_the_reference_is_refused(film, camera, world):
    with pytest.raises(PlacementError, match=f"{camera.scene}: cannot be placed: the reference DEM holds no height"):
        locate(film, moved(camera, 0.0, 400000.0), world)


def candidate(score, east_m, way):
    places = np.array([[0.0, 0.0], [1e4, 0.0]])
    return Candidate(View(way), score, np.array([-10.0, 10.0]), places, places + [east_m, 0.0])


def test_a_rival_is_another_place_or_another_way_round():
    best = candidate(12.0, 0.0, Way())
    near, far, mirrored = (
        candidate(11.0, 500.0, Way()),
        candidate(6.0, 3e4, Way()),
        candidate(7.0, 0.0, Way(False, True)),
    )
    found = Found((best,), ()).and_more(Found((mirrored, near, far), ()))
    assert found.candidates == (best, mirrored, far)
    assert found.rival_score(best) == 7.0
    assert found.rival_score(mirrored) == 12.0


def test_halving_a_raster_takes_the_mean_of_what_is_known():
    raster = np.array([[1.0, 3.0, np.nan, np.nan, 5.0], [5.0, np.nan, np.nan, 2.0, 7.0]], np.float32)
    np.testing.assert_allclose(halved(raster), [[3.0, np.nan, 6.0]])


def test_evidence_that_agrees_by_chance_counts_once():
    rng = np.random.default_rng(0)
    common = rng.standard_normal((200, 200))
    surfaces = np.stack([common + 0.3 * rng.standard_normal(common.shape) for _ in range(2)]).astype(np.float32)
    surfaces[1, :, :20] = np.nan
    (alone, _), (together, covered) = _standardised(surfaces[:1]), _standardised(surfaces)
    assert abs(together[covered].std() - alone.std()) < 0.1
    assert np.abs(np.median(together[covered])) < 0.05
    assert not covered[:, :10].any()
    assert (together[:, :10] == 0).all()
