"""Ground control where no reference image is given: the shaded relief of the DEM takes its place."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters, records, tables
from cosp.matching.footprint import Footprint
from cosp.matching.ground import grown, map_bounds
from cosp.matching.relief import hillshade, relief_sigma_m
from scripts.collect_gcps import collect_gcps
from scripts.match_tiles import match_tiles

from .conftest import CRS, World, make_camera, texture

POSTING = 60.0


def mountains(bounds, rng):
    """Rough terrain, and film that shows it under a sun that is none of the four, with ground cover of its own."""
    grid = PixelGrid.covering(bounds, POSTING)
    rough = sum(s**1.5 * gaussian_filter(rng.standard_normal(grid.shape), s, mode="wrap") for s in (2, 5, 12))
    heights = (1800 + 280 * rough / rough.std()).clip(0, 4000).astype(np.float32)
    light = hillshade(heights, POSTING, 118.0)
    cover = texture(grid.shape, rng) / 130.0
    return World(grid, (0.4 * light + 100 * cover).clip(1, 250).astype(np.float32), heights)


@pytest.mark.slow
def test_control_from_relief_lies_within_half_a_posting_and_says_so(tmp_path):
    rng = np.random.default_rng(2)
    camera = make_camera(half_length_mm=120.0)
    world = mountains(grown(map_bounds(camera, CRS, (0.0, 3500.0)), 6000.0), rng)
    film = world.expose(camera, rng=rng)
    noisy = world.heights + 3.0 * rng.standard_normal(world.heights.shape).astype(np.float32)
    rasters.write(tmp_path / "dem.tif", noisy, grid=world.grid, crs=CRS)
    rasters.write(tmp_path / "film.tif", film.read(_whole(film.grid)), grid=film.grid, crs=rasters.FILM_CRS)
    footprint = Footprint(
        scene=camera.scene, camera=camera, shift_east_m=0.0, shift_north_m=0.0, turned=False, score=20.0, margin=9.0,
        agreeing_share=1.0, residual_m=10.0, posting_m=POSTING, reference="relief", sun_azimuth_deg=135.0,
        corners_lonlat=((0.0, 0.0),) * 4, blocks=(),
    )  # fmt: skip
    records.write(tmp_path / "footprint.json", footprint)
    match_tiles(
        tmp_path / "film.tif", tmp_path / "footprint.json", tmp_path / "dem.tif", None, tmp_path / "matches.parquet",
        scatteritem="1-of-1", reference_dem_heights="ellipsoidal", matcher="structural", template_px=65, search_px=8,
        min_score=0.3, max_ratio=0.9, max_return_px=1.0, candidates=400, threads=1,
    )  # fmt: skip
    collect_gcps(
        [tmp_path / "matches.parquet"], tmp_path / "film.tif", tmp_path / "footprint.json", tmp_path / "dem.tif", None,
        tmp_path / "gcps.parquet", tmp_path / "gcps.json", reference_dem_heights="ellipsoidal", tile_mm=40, gate_px=3,
        min_per_tile=8, trials=200, cell_mm=8, per_cell=2, max_slope_deg=60, white=252, reference_sigma_m=3,
        dem_sigma_m=4.0, check_columns=10, check_rows=2, min_gcps=50, seed=1,
    )  # fmt: skip
    gcps = tables.read(tmp_path / "gcps.parquet")
    kept = gcps[gcps["role"] != "rejected"]
    truth = camera.project_geodetic(kept[["longitude_deg", "latitude_deg", "height_m"]].to_numpy())
    error_px = (kept[["x_mm", "y_mm"]].to_numpy() - truth) / film.pixel_mm
    rms = np.sqrt((error_px**2).mean())
    assert len(kept) > 50
    assert 0.01 < rms < 0.5
    assert 0.15 < rms / kept["sigma_px"].median() < 1.3


def test_sigma_of_relief_stays_between_a_third_and_half_a_posting():
    np.testing.assert_allclose(relief_sigma_m(np.array([1.0, 12.0, 40.0]), 30.0), [9.0, 12.0, 15.0])


def _whole(grid):
    return Window(0, grid.shape[0], 0, grid.shape[1])
