"""Reference rasters as functions of a map grid: the same values, whichever way they are read."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.io import heights, rasters, references

CRS = "EPSG:32632"


def terrain(shape, sigma=6.0):
    rough = gaussian_filter(np.random.default_rng(3).standard_normal(shape), sigma)
    return (1500 + 300 * rough / rough.std()).astype(np.float32)


@pytest.fixture(scope="module")
def dem_path(tmp_path_factory):
    """A DEM of 30 m in the map projection, with a gap, larger than a block."""
    path = tmp_path_factory.mktemp("dem") / "dem.tif"
    values = terrain((700, 800))
    values[100:130, 200:240] = np.nan
    rasters.write(path, values, grid=PixelGrid.covering((600_000, 5_180_000, 624_000, 5_201_000), 30.0), crs=CRS)
    return path


@pytest.fixture(scope="module")
def geographic_path(tmp_path_factory):
    """A DEM of one arc second."""
    path = tmp_path_factory.mktemp("dem") / "geographic.tif"
    grid = PixelGrid(10.3, 47.0, 1 / 3600, -1 / 3600, (800, 900))
    rasters.write(path, terrain(grid.shape), grid=grid, crs="EPSG:4326")
    return path


def grid_of(posting, east=606_000.0, north=5_190_000.0, side=120):
    left, top = round(east / posting), round(north / posting)
    return PixelGrid((left + 0.5) * posting, (top - 0.5) * posting, posting, -posting, (side, side))


@pytest.mark.parametrize("posting", [4.0, 17.0, 30.0, 85.0])
def test_heights_on_a_tile_are_those_of_a_warp(dem_path, posting):
    grid = grid_of(posting, east=615_000.0, north=5_186_000.0)
    found = references.heights_on(dem_path, CRS, "ellipsoidal")(grid)
    np.testing.assert_allclose(found, rasters.read_on_grid(dem_path, grid, CRS), atol=2e-2)


def test_heights_of_a_geographic_dem_are_those_of_a_warp(geographic_path):
    grid = grid_of(12.0, east=607_000.0, north=5_195_000.0)
    found = references.heights_on(geographic_path, CRS, "ellipsoidal")(grid)
    expected = rasters.read_on_grid(geographic_path, grid, CRS)
    assert np.isfinite(expected).all()
    # A warp may place its pixels by an eighth of a pixel anyhow.
    slope_m = np.abs(np.gradient(expected)).max() * 30.0 / 12.0
    assert np.abs(found - expected).max() < 0.15 * slope_m
    assert np.abs(found - expected).mean() < 0.02 * slope_m


def test_the_geoid_is_added_wherever_heights_are_read(geographic_path):
    grid = grid_of(12.0, east=607_000.0, north=5_195_000.0, side=40)
    above = references.heights_on(geographic_path, CRS, "egm96")(grid)
    plain = references.heights_on(geographic_path, CRS, "ellipsoidal")(grid)
    np.testing.assert_allclose(above - plain, heights.undulation(grid, CRS, "egm96"), atol=0.02)


def test_gaps_and_the_outside_stay_gaps(dem_path):
    on_grid = references.heights_on(dem_path, CRS, "ellipsoidal")
    gap = PixelGrid(600_000 + 210.5 * 30, 5_201_000 - 110.5 * 30, 10.0, -10.0, (10, 10))
    assert np.isnan(on_grid(gap)).all()
    west = grid_of(15.0, east=600_000.0 - 60 * 15.0, north=5_190_000.0)
    values = on_grid(west)
    assert np.isnan(values[:, :59]).all()
    assert np.isfinite(values[:, 61:]).all()
    assert np.isnan(on_grid(grid_of(15.0, east=700_000.0))).all()


@pytest.mark.parametrize("posting", [15.0, 17.3, 60.0])
def test_an_image_read_by_blocks_is_the_image_read_at_once(tmp_path, posting):
    image = gaussian_filter(np.random.default_rng(1).uniform(0, 255, (900, 900)), 1.0).clip(1, 255).astype(np.uint8)
    image[:40] = 0
    path = tmp_path / "image.tif"
    rasters.write(path, image, grid=PixelGrid.covering((600_000, 5_180_000, 613_500, 5_193_500), 15.0), crs=CRS)
    on_grid = references.image_on(path, CRS)
    resampling = "average" if posting > 22.5 else "cubic"
    for east, north in ((604_000.0, 5_190_000.0), (607_000.0, 5_187_000.0), (611_800.0, 5_192_500.0)):
        grid = grid_of(posting, east, north, side=90)
        expected = rasters.read_on_grid(path, grid, CRS, resampling=resampling)
        expected = np.where(expected == 0, np.nan, expected)
        # The width of a warp's averaging kernel depends a little on the window that it is asked for.
        np.testing.assert_allclose(on_grid(grid), expected, atol=1.5 if posting == 17.3 else 1e-3)


def test_grids_between_whole_postings_are_read_by_themselves(dem_path):
    grid = PixelGrid(610_007.0, 5_190_003.0, 60.0, -60.0, (50, 50))
    found = references.heights_on(dem_path, CRS, "ellipsoidal")(grid)
    np.testing.assert_allclose(found, rasters.read_on_grid(dem_path, grid, CRS), atol=1e-3)


def test_posting_is_in_metres_for_degrees_too(geographic_path, dem_path):
    assert references.posting_m(dem_path) == pytest.approx(30.0)
    assert references.posting_m(geographic_path) == pytest.approx(30.9 * np.sqrt(np.cos(np.radians(46.9))), rel=0.01)


def test_a_raster_without_a_reference_system_is_refused(tmp_path):
    rasters.write(tmp_path / "bare.tif", np.ones((4, 4), np.float32), grid=PixelGrid(0.5, 3.5, 1.0, -1.0, (4, 4)))
    with pytest.raises(InputError, match=r"bare\.tif"):
        references.posting_m(tmp_path / "bare.tif")
