"""Ground control where no reference image is given: the shaded relief of the DEM takes its place."""

from datetime import date

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters, records, tables
from cosp.io.films import put_right
from cosp.matching.footprint import Footprint
from cosp.matching.ground import grown, map_bounds
from cosp.matching.placement import SearchLimits, locate_film
from cosp.matching.relief import convexity_reference, hillshade, relief_sigma_m, sun_at, suns
from scripts.collect_gcps import collect_gcps
from scripts.match_tiles import match_tiles

from .conftest import CRS, World, make_camera, moved, texture

POSTING = 60.0
LIMITS = SearchLimits(
    coarse_posting_m=240.0, fine_posting_m=80.0, min_score=5.5, min_margin=2.0, min_agreeing=12,
    min_agreeing_share=0.3, min_block_share=0.5, max_sigma_m=300.0,
)  # fmt: skip


def mountains(bounds, rng):
    """Rough terrain, and film that shows it under a sun that is none of the four, with ground cover of its own."""
    grid = PixelGrid.covering(bounds, POSTING)
    rough = sum(s**1.5 * gaussian_filter(rng.standard_normal(grid.shape), s, mode="wrap") for s in (2, 5, 12))
    heights = (1800 + 280 * rough / rough.std()).clip(0, 4000).astype(np.float32)
    light = hillshade(heights, POSTING, 118.0)
    cover = texture(grid.shape, rng) / 130.0
    return World(grid, (0.4 * light + 100 * cover).clip(1, 250).astype(np.float32), heights)


@pytest.mark.slow
def test_control_from_relief_lies_within_half_a_posting_and_says_so_though_the_film_is_mirrored(tmp_path):
    rng = np.random.default_rng(2)
    camera = make_camera(half_length_mm=120.0)
    world = mountains(grown(map_bounds(camera, CRS, (0.0, 3500.0)), 6000.0), rng)
    film = world.expose(camera, rng=rng)
    noisy = world.heights + 3.0 * rng.standard_normal(world.heights.shape).astype(np.float32)
    rasters.write(tmp_path / "dem.tif", noisy, grid=world.grid, crs=CRS)
    through_its_back = np.ascontiguousarray(film.read(_whole(film.grid))[::-1])
    rasters.write(tmp_path / "straight.tif", through_its_back, grid=film.grid, crs=rasters.FILM_CRS)
    put_right(tmp_path / "straight.tif", tmp_path / "film.tif", turned=False, mirrored=True)
    footprint = Footprint(
        scene=camera.scene, camera=camera, shift_east_m=0.0, shift_north_m=0.0, turned=False, score=20.0, margin=9.0,
        agreeing_share=1.0, residual_m=10.0, posting_m=POSTING, reference="relief", sun_azimuth_deg=135.0,
        corners_lonlat=((0.0, 0.0),) * 4, blocks=(), mirrored=True,
    )  # fmt: skip
    records.write(tmp_path / "footprint.json", footprint)
    match_tiles(
        tmp_path / "film.tif", tmp_path / "footprint.json", tmp_path / "dem.tif", None, tmp_path / "matches.parquet",
        scatteritem="1-of-1", reference_dem_heights="ellipsoidal", matcher="structural", template_px=65, search_px=8,
        min_score=0.3, max_ratio=0.9, max_return_px=1.0, relief_template_px=65, relief_min_score=0.3,
        relief_max_ratio=0.9, candidates=400, features="xfeat", max_features=2048, tile_width_px=1920,
        tile_height_px=1440, max_tiles=60, superglue_weights=None, threads=1,
    )  # fmt: skip
    collect_gcps(
        [tmp_path / "matches.parquet"], tmp_path / "film.tif", tmp_path / "footprint.json", tmp_path / "dem.tif", None,
        None, None, tmp_path / "gcps.parquet", tmp_path / "gcps.json", reference_dem_heights="ellipsoidal", tile_mm=40,
        gate_px=3, min_per_tile=8, trials=200, relief_min_places=4, relief_min_share=0.5, cell_mm=8,
        per_cell=2, max_slope_deg=60, white=252, scratch_grey=20, reference_sigma_m=3, dem_sigma_m=4.0,
        shift_search_m=300, correct_reference_shift=False, check_columns=10, check_rows=2, min_gcps=1000,
        relief_min_gcps=50, seed=1,
    )  # fmt: skip
    gcps = tables.read(tmp_path / "gcps.parquet")
    kept = gcps[gcps["role"] != "rejected"]
    truth = camera.project_geodetic(kept[["longitude_deg", "latitude_deg", "height_m"]].to_numpy())
    error_px = (kept[["x_mm", "y_mm"]].to_numpy() - truth) / film.pixel_mm
    rms = np.sqrt((error_px**2).mean())
    assert len(kept) > 50
    assert 0.01 < rms < 0.5
    assert 0.15 < rms / kept["sigma_px"].median() < 1.3


def test_crests_are_bright_and_valleys_dark_whatever_the_sun():
    grid = PixelGrid(30.0, -30.0, POSTING, -POSTING, (40, 80))
    wave = np.cos(2 * np.pi * np.arange(80) / 20.0)
    convexity = convexity_reference(lambda _: np.broadcast_to(100 * wave, grid.shape).astype(np.float32))(grid)
    inside = convexity[5:-5, 5:-5] / convexity[5:-5, 5:-5].max()
    np.testing.assert_allclose(inside, np.broadcast_to(wave[5:-5], inside.shape), atol=0.03)


def test_sigma_of_relief_stays_between_a_third_and_half_a_posting():
    np.testing.assert_allclose(relief_sigma_m(np.array([1.0, 12.0, 40.0]), 30.0), [9.0, 12.0, 15.0])


@pytest.mark.parametrize(
    ("day", "hour", "latitude", "azimuth", "elevation"),
    [
        (date(1968, 6, 21), 12.0, 45.0, 180.0, 68.4),
        (date(1968, 12, 21), 12.0, 45.0, 180.0, 21.6),
        (date(1968, 3, 21), 6.0, 30.0, 90.0, 0.0),
        (date(1968, 9, 23), 15.0, 0.0, 270.0, 45.0),
        (date(1968, 12, 21), 12.0, -45.0, 0.0, 68.4),
    ],
)
def test_the_sun_stands_where_it_stands(day, hour, latitude, azimuth, elevation):
    sun = sun_at(day, hour, latitude)
    assert abs((sun.azimuth_deg - azimuth + 180) % 360 - 180) < 2.0
    assert abs(sun.elevation_deg - elevation) < 2.0


def test_suns_of_a_day_are_above_the_horizon_and_apart_and_leave_no_gap_in_their_arc():
    found = suns(date(1968, 12, 21), 47.0)
    azimuths = np.sort([sun.azimuth_deg for sun in found])
    assert len(found) == 3
    assert min(sun.elevation_deg for sun in found) > 5.0
    assert (np.diff(azimuths) >= 29.0).all()
    assert (np.diff(azimuths) < 36.0).all()
    assert len(suns(None, 47.0)) == 6


@pytest.mark.slow
def test_a_film_is_placed_by_relief_alone_under_a_sun_that_is_not_known():
    rng = np.random.default_rng(3)
    camera = make_camera(half_length_mm=150.0)
    world = mountains(grown(map_bounds(camera, CRS, (0.0, 3500.0)), 12000.0), rng)
    located = locate_film(
        world.expose(camera, rng=rng), moved(camera, 6000.0, -4000.0), reference_on=None, day=None,
        heights_on=world.on(world.heights), crs=CRS, search_m=9000.0, limits=LIMITS,
        rng=np.random.default_rng(0), threads=1,
    )  # fmt: skip
    points = np.stack(np.meshgrid(np.linspace(-145, 145, 7), np.linspace(-26, 26, 3)), -1)
    error_mm = np.linalg.norm(located.footprint.camera.project(camera.locate(points, 1800.0)) - points, axis=-1)
    assert located.footprint.reference == "relief"
    assert abs((located.footprint.sun_azimuth_deg - 118.0 + 90.0) % 180.0 - 90.0) < 20.0
    assert error_mm.max() < 0.3  # 80 m


def _whole(grid):
    return Window(0, grid.shape[0], 0, grid.shape[1])
