"""A reference image that lies off the reference DEM is found out, and one that does not is left alone."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from cosp.geometry.grids import PixelGrid
from cosp.io import rasters
from cosp.matching.consistency import reference_shift, robust_shift
from cosp.matching.relief import hillshade

from .conftest import World, texture

POSTING = 30.0
GRID = PixelGrid.covering((500_000.0, 5_000_000.0, 530_000.0, 5_030_000.0), POSTING)
PLACES = np.stack(np.meshgrid(np.linspace(506e3, 524e3, 3), np.linspace(5006e3, 5024e3, 3)), -1).reshape(-1, 2)


def shifted(world, east_m, north_m):
    """The image of a world, which lies east and north of where it should."""
    image_on = world.on(world.image)

    def on_grid(grid):
        return image_on(PixelGrid(grid.x0 - east_m, grid.y0 - north_m, grid.step_x, grid.step_y, grid.shape))

    return on_grid


@pytest.fixture(scope="module")
def world():
    return lit_world(3, 148.0, 48.0)


def lit_world(seed, azimuth_deg, elevation_deg):
    """A world under a sun, half of whose brightness is cover; and its DEM."""
    rng = np.random.default_rng(seed)
    rough = sum(s**1.5 * gaussian_filter(rng.standard_normal(GRID.shape), s, mode="wrap") for s in (3, 7, 16))
    heights = (1500 + 250 * rough / rough.std()).astype(np.float32)
    cover = texture(GRID.shape, rng) / 130.0
    image = 0.6 * hillshade(heights, POSTING, azimuth_deg, elevation_deg) + 60 * cover
    return World(GRID, image.astype(np.float32), heights + 2 * rng.standard_normal(GRID.shape).astype(np.float32))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (-135.0, 70.0)])
def test_the_shift_of_an_image_is_found_and_its_significance_known(world, shift):
    found = reference_shift(
        shifted(world, *shift), world.on(world.heights), PLACES, posting_m=POSTING, search_m=250.0, threads=1
    )
    assert found.significant == any(shift)
    np.testing.assert_allclose((found.east_m, found.north_m), (-shift[0], -shift[1]), atol=0.25 * POSTING)
    assert 0.1 < found.sigma_m < 0.2 * POSTING


@pytest.mark.slow
def test_the_standard_deviation_of_the_shift_is_what_it_is_wrong_by():
    # Suns that are none of the four tried, and cover that is no relief.
    ratios = []
    for seed, sun in ((3, (148.0, 48.0)), (4, (245.0, 22.0)), (5, (20.0, 35.0)), (6, (148.0, 48.0))):
        world = lit_world(seed, *sun)
        shift = np.random.default_rng(seed).uniform(-150.0, 150.0, 2)
        found = reference_shift(
            shifted(world, *shift), world.on(world.heights), PLACES, posting_m=POSTING, search_m=250.0, threads=1
        )
        ratios.append((np.array([found.east_m, found.north_m]) + shift) / found.sigma_m)
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.5


@pytest.mark.slow
def test_ground_without_relief_says_nothing(world):
    level = World(GRID, world.image, np.full(GRID.shape, 800.0, np.float32))
    found = reference_shift(
        shifted(world, 90.0, 0.0), level.on(level.heights), PLACES, posting_m=POSTING, search_m=250.0, threads=1
    )
    assert not found.significant
    assert np.isnan(found.east_m)


def test_the_mode_is_found_among_wrong_matches_and_chance_is_not_called_a_shift():
    rng = np.random.default_rng(4)
    tile = np.repeat(np.arange(40), 5)
    right = np.array([75.0, -40.0]) + 10 * rng.standard_normal((200, 2))
    wrong = rng.random(200) < 0.4
    right[wrong] = rng.uniform(-400, 400, (wrong.sum(), 2))
    found = robust_shift(right, tile, POSTING)
    assert found.significant
    np.testing.assert_allclose((found.east_m, found.north_m), (75.0, -40.0), atol=4 * found.sigma_m)
    assert not robust_shift(rng.uniform(-400, 400, (200, 2)), tile, POSTING).significant


def test_real_images_of_two_seasons_lie_on_their_dem_to_a_posting():
    folder = Path(os.environ.get("COSP_TEST_DATA", "")) / "pennsylvania"
    if not folder.is_dir():
        pytest.skip("COSP_TEST_DATA does not hold pennsylvania")
    dem = rasters.read(folder / "dem30.tif").astype(np.float32)
    november = rasters.read(folder / "landsat7_20021125_b123457.tif", 4).astype(np.float32)
    grid = rasters.info(folder / "dem30.tif").grid
    world = World(grid, november, dem)
    centre = np.mean(np.reshape(grid.bounds, (2, 2)), axis=0)
    places = centre + 1500.0 * np.stack(np.meshgrid(np.arange(-1, 2), np.arange(-1, 2)), -1).reshape(-1, 2)
    found = reference_shift(world.on(november), world.on(dem), places, posting_m=POSTING, search_m=150.0, threads=1)
    assert found.tiles >= 8
    assert np.hypot(found.east_m, found.north_m) < 1.5 * POSTING
