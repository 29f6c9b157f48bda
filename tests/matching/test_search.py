"""Placement of whole films: a synthetic world, coarse films, and predictions that are far off."""

from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from cosp.errors import PlacementError
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.matching.film_image import FilmImage
from cosp.matching.ground import ground_pixel_m
from cosp.matching.placement import _NEAR, _WIDE, SearchLimits, _placed, _tiles, locate_film, turned_about_centre
from cosp.matching.search import Candidate, Found, View, Way, _between, _evidence, _standardised

from .conftest import CRS, FILM_PIXEL_MM, moved, texture


@pytest.fixture(scope="module")
def film(world, camera):
    return world.expose(camera, rng=np.random.default_rng(1))


LIMITS = SearchLimits(
    coarse_posting_m=240.0, fine_posting_m=80.0, min_score=5.5, min_margin=3.0, min_agreeing=20,
    min_agreeing_share=0.3, min_block_share=0.5, max_sigma_m=300.0,
)  # fmt: skip


def locate(
    film, predicted, world, *, reference=None, heights=None, search_m=8000.0, with_image=True, day=None, limits=LIMITS
):
    located = locate_film(
        film,
        predicted,
        reference_on=world.on(world.image if reference is None else reference) if with_image else None,
        heights_on=world.on(world.heights if heights is None else heights),
        day=day,
        crs=CRS,
        search_m=search_m,
        limits=limits,
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
@pytest.mark.slow
def test_a_place_that_leaves_an_end_of_the_film_open_is_taken_after_a_search_of_everything(camera, world, film, caplog):
    pixels = film.read(Window(0, film.grid.shape[0], 0, film.grid.shape[1])).copy()
    pixels[:, : round(0.6 * pixels.shape[1])] = 0
    half, predicted = FilmImage.from_array(pixels, film.grid), moved(camera, -1000.0, 800.0)
    found = []
    caplog.set_level("INFO")
    for max_sigma_m in (1000.0, 30.0):
        caplog.clear()
        limits = replace(LIMITS, max_sigma_m=max_sigma_m)
        found.append(locate(half, predicted, world, search_m=4000.0, limits=limits))
        assert ("leave an end of the film open by" in caplog.text) == (max_sigma_m == 30.0)
    assert found[0].sigma_m > 100.0
    assert found[1].sigma_m <= found[0].sigma_m
    for footprint in found:
        error_m = film_error_px(footprint.camera, camera).max() * ground_pixel_m(camera, FILM_PIXEL_MM, 0.0)
        assert error_m < 3 * footprint.sigma_m


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
    found = Found.best_of([Found((best,), ()), Found((mirrored, near, far), ())])
    assert found.candidates == (best, mirrored, far)
    assert found.rival_score(best) == 7.0
    assert found.rival_score(mirrored) == 12.0


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


def test_a_block_that_shows_cloud_says_nothing_and_one_that_shows_ground_decides():
    noise = np.random.default_rng(2).standard_normal((1, 300, 300)).astype(np.float32)
    at_ground = noise.copy()
    at_ground[0, 100, 200] = 9.0 * noise.std()
    cloud, _ = _evidence(noise)
    ground, _ = _evidence(at_ground)
    assert cloud.min() > -0.7  # the log of a half
    assert cloud[100, 200] + ground[100, 200] > 10.0
    assert np.unravel_index(ground.argmax(), ground.shape)[0] in range(99, 102)
    assert np.delete(np.sort(ground.ravel()), np.s_[-9:]).max() < 9.0


def test_heavy_tails_count_as_much_as_those_of_a_normal_distribution():
    rng = np.random.default_rng(3)
    normal = rng.standard_normal((1, 400, 400))
    heavy = rng.standard_t(4, (1, 400, 400))
    highest = [float(_standardised(surface.astype(np.float32))[0].max()) for surface in (normal, heavy)]
    assert highest[1] < 3 * highest[0]
    thousandth = [float(np.quantile(_standardised(s.astype(np.float32))[0], 0.999)) for s in (normal, heavy)]
    assert thousandth[1] == pytest.approx(3.09, abs=0.15)


def test_views_reach_every_heading_and_scale():
    middles = _between(10.0, 2.5)
    assert len(middles) == 4
    wanted = np.linspace(-10.0, 10.0, 81)
    assert np.abs(wanted[:, None] - middles).min(axis=1).max() <= 2.5


def one_end(film, shown):
    """The film with something else beyond its middle."""
    pixels = film.read(Window(0, film.grid.shape[0], 0, film.grid.shape[1])).copy()
    columns = np.arange(film.grid.shape[1])
    beyond = film.grid.points(np.zeros(len(columns)), columns)[:, 0] > 0
    pixels[:, beyond] = np.broadcast_to(shown, pixels.shape)[:, beyond]
    return FilmImage.from_array(pixels, film.grid)


def placed_by(film, expected, camera, world, templates):
    """A camera fitted to the matches of a film."""
    return _placed(
        film,
        expected,
        camera,
        _tiles(camera, 80.0, templates),
        templates,
        world.on(world.image),
        world.on(world.heights),
        CRS,
        80.0,
        np.random.default_rng(0),
        1,
    )


def test_an_end_that_shows_nothing_lies_where_the_prediction_says_whatever_an_earlier_fit_made_of_it(
    camera, world, film
):
    parameters = camera.parameters()
    parameters[[3, 4, 11]] += [1500.0, 1500.0, np.radians(0.9)]
    bent = camera.with_parameters(parameters)
    placed = placed_by(one_end(film, 200), camera, bent, world, _WIDE)
    assert placed.agreeing.sum() > 12
    assert film_error_px(bent, camera).max() > 5
    assert film_error_px(placed.camera, camera).max() < 1


def test_near_matches_count_where_their_neighbours_agree_and_not_by_chance(camera, world, film):
    pixels = texture((film.grid.shape), np.random.default_rng(3)).astype(np.uint8)
    placed = placed_by(one_end(film, pixels), camera, camera, world, _NEAR)
    x_mm = placed.matches.film_mm[:, 0]
    assert (x_mm > 20).sum() > 5
    assert not placed.agreeing[x_mm > 20].any()
    assert placed.agreeing[x_mm < -20].mean() > 0.9
    assert film_error_px(placed.camera, camera).max() < 0.5


@pytest.mark.slow
def test_a_film_of_which_clouds_leave_three_tenths_is_placed(camera, world, film):
    pixels = film.read(Window(0, film.grid.shape[0], 0, film.grid.shape[1])).copy()
    rng = np.random.default_rng(6)
    where = gaussian_filter(rng.standard_normal(pixels.shape), 18.0 / FILM_PIXEL_MM)
    hidden = where > np.quantile(where, 0.3)
    pixels[hidden] = texture(pixels.shape, rng)[hidden] / 4 + 180
    predicted = moved(camera, -7000.0, 5000.0)
    footprint = locate(FilmImage.from_array(pixels, film.grid), predicted, world, search_m=12000.0)
    points = np.stack(np.meshgrid(np.linspace(-195, 195, 79), np.linspace(-26, 26, 9)), -1)
    rows, columns = film.grid.pixels(points)
    seen = ~hidden[np.round(rows).astype(int), np.round(columns).astype(int)]
    error_px = np.linalg.norm(footprint.camera.project(camera.locate(points, 1000.0)) - points, axis=-1) / FILM_PIXEL_MM
    assert error_px[seen].max() < 2.0
    error_m = error_px * ground_pixel_m(camera, FILM_PIXEL_MM, 0.0)
    assert footprint.sigma_m / 10 < error_m.max() < 3 * footprint.sigma_m
