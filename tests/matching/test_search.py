"""Placement of whole films: a synthetic world, coarse films, and predictions that are far off."""

import numpy as np
import pytest

from cosp.errors import NoOverlapError, PlacementError
from cosp.geometry.grids import PixelGrid
from cosp.matching.film_image import FilmImage
from cosp.matching.search import locate_film

from .conftest import CRS, FILM_PIXEL_MM, moved, texture


@pytest.fixture(scope="module")
def film(world, camera):
    return world.expose(camera, rng=np.random.default_rng(1))


def locate(film, predicted, world, *, reference=None, heights=None, search_m=8000.0, with_image=True):
    return locate_film(
        film,
        predicted,
        reference_on=world.on(world.image if reference is None else reference) if with_image else None,
        heights_on=world.on(world.heights if heights is None else heights),
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


def film_error_px(found, camera):
    points = np.stack(np.meshgrid(np.linspace(-195, 195, 9), np.linspace(-26, 26, 3)), -1)
    return np.linalg.norm(found.project(camera.locate(points, 1000.0)) - points, axis=-1) / FILM_PIXEL_MM


def test_a_film_five_kilometres_off_is_placed_to_a_fraction_of_a_pixel(film, camera, world):
    footprint = locate(film, moved(camera, 5000.0, -4000.0), world)
    assert film_error_px(footprint.camera, camera).max() < 0.3
    assert not footprint.turned
    assert abs(footprint.shift_east_m + 5000.0) < 100.0
    assert abs(footprint.shift_north_m - 4000.0) < 100.0


@pytest.mark.slow
def test_a_turned_film_thirty_kilometres_off_is_placed(film, camera, world):
    footprint = locate(film, moved(camera, -22000.0, 20000.0).turned(), world, search_m=30000.0)
    assert footprint.turned
    assert film_error_px(footprint.camera, camera).max() < 0.3


@pytest.mark.slow
def test_a_changed_negative_reference_still_places_the_film(film, camera, world):
    other = texture(world.grid.shape, np.random.default_rng(8))
    footprint = locate(film, moved(camera, 3000.0, 3000.0), world, reference=255 - 0.7 * world.image + 0.6 * other)
    assert film_error_px(footprint.camera, camera).max() < 0.5


def test_noise_is_refused(camera, world):
    rng = np.random.default_rng(4)
    columns, rows = round(2 * camera.half_length_mm / FILM_PIXEL_MM), round(2 * camera.half_width_mm / FILM_PIXEL_MM)
    film_grid = PixelGrid(-199.86, 27.6, FILM_PIXEL_MM, -FILM_PIXEL_MM, (rows, columns))
    noise = FilmImage.from_array(texture((rows, columns), rng).astype(np.uint8), film_grid)
    with pytest.raises(PlacementError, match="cannot be placed"):
        locate(noise, camera, world)


def test_a_film_far_outside_the_reference_is_refused(film, camera, world):
    with pytest.raises((NoOverlapError, PlacementError)):
        locate(film, moved(camera, 0.0, 400000.0), world)
