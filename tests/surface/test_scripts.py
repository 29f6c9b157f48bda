"""Claims about the scripts from disparity to quality, on a small pair whose truth is a formula."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.adjustment.posterior import HeightSigma
from cosp.camera.mapping import MapProjector
from cosp.epipolar.correspondences import FilmMapping, virtual_conjugates
from cosp.epipolar.polynomials import Basis
from cosp.epipolar.rectification import fit_rectification
from cosp.geometry.grids import PixelGrid
from cosp.io import rasters, records
from tests.surface.synthetic import ORIGIN, camera, terrain_m, texture

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
CRS = "EPSG:32632"
PIXEL_MM = 0.14
FILM = {"half_length_mm": 28.0, "half_width_mm": 27.0}
RESOLUTION_M = 80.0
GRIDDING = {
    "crs": "auto",
    "resolution_m": RESOLUTION_M,
    "ray_spacing_mm": 0.3,
    "ray_error_px": 0.02,
    "kernel_cells": 0.5,
    "gate_sigmas": 5.0,
    "least_confidence": 40,
    "point_sigma_px": 0.1,
    "points_per_independent": 1.0,
}
COREGISTRATION = {
    "reference_dem_heights": "ellipsoidal",
    "slope_limit_deg": 40.0,
    "outlier_m": 150.0,
    "least_cells": 2000,
    "most_cells": 100_000,
    "tile_km": 20.0,
    "overlap_km": 4.0,
    "least_share": 0.3,
    "sigma_matrix": 5e-4,
    "sigma_shift_m": 20.0,
    "cells_per_independent": 9.0,
    "seed": 1,
}
SHIFT_M = np.array([60.0, -35.0, 12.0])  # of the reference against the truth


def function(name):
    return runpy.run_path(str(SCRIPTS / f"{name}.py"))[name]


def inputs_of_gridding(folder):
    names = "disparity.tif", "validity.tif", "y_parallax.tif", "rectification.json"
    cameras = [f"{camera(look, **FILM).scene}.json" for look in ("fore", "aft")]
    return [folder / name for name in (*names, *cameras, "points.json")]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Disparity, cameras, film and reference of a pair over analytic terrain, as files; then all scripts in turn."""
    folder = tmp_path_factory.mktemp("pair")
    cameras = {look: camera(look, **FILM) for look in ("fore", "aft")}
    for c in cameras.values():
        records.write(folder / f"{c.scene}.json", c)
    fore, aft = cameras.values()
    to_map = MapProjector(fore, CRS, (600_000, 5_200_000, 600_001, 5_200_001)).map_frame

    def height_at(lonlat):
        place = to_map.map_from_geodetic(np.concatenate([lonlat, np.zeros((*lonlat.shape[:-1], 1))], axis=-1))
        return terrain_m(place[..., 0], place[..., 1])

    films = tuple(FilmMapping(c.locate, c.project, c.half_length_mm, c.half_width_mm) for c in (fore, aft))
    rectification = fit_rectification(
        virtual_conjugates(*films, np.linspace(800.0, 2200.0, 4)),
        films,
        pixel_mm=PIXEL_MM,
        basis=Basis(3, 9),
        disparity_margin_px=5.0,
    )
    records.write(folder / "rectification.json", rectification)
    rows, columns = np.meshgrid(*(np.arange(n) for n in rectification.shape), indexing="ij")
    ground = fore.locate_on(rectification.fore_film(rows, columns), height_at, iterations=5)
    aft_rows, aft_columns = rectification.aft_epipolar(aft.project(ground))
    disparity = (aft_columns - columns).astype(np.float32)
    y_parallax = np.nanmedian(aft_rows - rows)
    disparity += np.random.default_rng(1).normal(0, 0.1, disparity.shape).astype(np.float32)
    disparity[100:103, 200:260] = np.nan
    # Where matching is unsure it is wrong here, and says so.
    unsure = np.zeros(disparity.shape, bool)
    unsure[150:160, 100:250] = True
    disparity[unsure] += 30.0
    confidence = np.where(unsure, 20, 255).astype(np.uint8)
    rasters.write(
        folder / "validity.tif",
        np.stack([np.zeros_like(confidence), confidence]),
        grid=rectification.grid,
        crs=rasters.PIXEL_CRS,
    )
    rasters.write(folder / "disparity.tif", disparity, grid=rectification.grid, crs=rasters.PIXEL_CRS)
    nodes = PixelGrid(32.0, 32.0, 64.0, 64.0, tuple(-(-n // 64) for n in rectification.shape))
    bands = np.stack([np.full(nodes.shape, v, np.float32) for v in (0.3, y_parallax, 0.9)])
    rasters.write(folder / "y_parallax.tif", bands, grid=nodes, crs=rasters.PIXEL_CRS)
    records.write(folder / "y_parallax.json", {"kind": "y_parallax", "version": 1, "median_px": 0.01, "sd_px": 0.2})
    records.write(folder / "adjustment.json", {"kind": "adjustment", "version": 1, "sigma_naught_px": 1.1})

    film_grid = PixelGrid(-28.0 + PIXEL_MM / 2, 27.0 - PIXEL_MM / 2, PIXEL_MM, -PIXEL_MM, (386, 400))
    for look, c in cameras.items():
        seen = to_map.map_from_geodetic(
            ORIGIN.geodetic_from_local(c.locate_on(film_grid.centres(), height_at, iterations=5))
        )
        grey = np.clip(np.rint(texture(seen[..., 0] / 4, seen[..., 1] / 4)), 1, 255).astype(np.uint8)
        rasters.write(folder / f"{look}.tif", grey, grid=film_grid, crs=rasters.FILM_CRS)

    middle = to_map.map_from_geodetic(ORIGIN.geodetic_from_local(ground[~np.isnan(ground).any(-1)].mean(0)))
    wide = PixelGrid.covering((*(middle[:2] - 30_000), *(middle[:2] + 30_000)), RESOLUTION_M)
    xy = wide.centres()
    rasters.write(folder / "truth.tif", terrain_m(xy[..., 0], xy[..., 1]).astype(np.float32), grid=wide, crs=CRS)
    moved = terrain_m(xy[..., 0] - SHIFT_M[0], xy[..., 1] - SHIFT_M[1]) + SHIFT_M[2]
    rasters.write(folder / "reference.tif", moved.astype(np.float32), grid=wide, crs=CRS)

    function("triangulate")(
        folder / "disparity.tif",
        folder / "y_parallax.tif",
        folder / "rectification.json",
        folder / f"{fore.scene}.json",
        folder / f"{aft.scene}.json",
        folder / "ray_gap.tif",
        folder / "points.json",
        ray_spacing_mm=0.3,
        ray_error_px=0.02,
        gate_sigmas=6.0,
        gate_px=1.0,
        threads=2,
    )
    function("grid_dem")(
        *inputs_of_gridding(folder), folder / "dem.tif", folder / "dem_sigma.tif", **GRIDDING, threads=2
    )
    function("orthorectify")(
        folder / "fore.tif",
        folder / f"{fore.scene}.json",
        folder / "dem.tif",
        folder / "truth.tif",
        folder / "ortho.tif",
        reference_dem_heights="ellipsoidal",
        resolution_m=40.0,
        tolerance_m=10.0,
        threads=2,
    )
    function("coregister")(
        folder / "dem.tif",
        folder / "reference.tif",
        None,
        folder / "dem_coregistered.tif",
        folder / "coregistration.json",
        **COREGISTRATION,
        threads=2,
    )
    function("assess_dem")(
        folder / "dem.tif",
        folder / "dem_coregistered.tif",
        folder / "reference.tif",
        folder / "ortho.tif",
        [folder / "fore.tif", folder / "aft.tif"],
        [folder / f"{c.scene}.json" for c in (fore, aft)],
        folder / "y_parallax.json",
        folder / "adjustment.json",
        folder / "points.json",
        None,
        None,
        folder / "truth.tif",
        folder / "dem_difference.tif",
        folder / "quality.json",
        folder / "hillshade.png",
        folder / "dem_difference.png",
        folder / "histogram.png",
        pair="1104-2169_092-098",
        reference_dem_heights="ellipsoidal",
        check_dem_heights="ellipsoidal",
        slope_limit_deg=40.0,
        slope_edges_deg=[0, 5, 10, 20, 30, 90],
        texture_grey=2.0,
        texture_cells=5,
    )
    return folder


def test_the_standard_deviation_of_the_cameras_joins_that_of_matching(site):
    places = HeightSigma("film", np.array([-30.0, 30.0]), np.array([-30.0, 30.0]), np.array([[2.0, 4.0]] * 2), 1500.0)
    records.write(site / "height_sigma.json", places)
    function("grid_dem")(
        *inputs_of_gridding(site),
        site / "dem_again.tif",
        site / "dem_sigma_again.tif",
        **GRIDDING,
        threads=1,
        height_sigma_path=site / "height_sigma.json",
    )
    matching = rasters.read(site / "dem_sigma.tif")
    both, _, cameras = rasters.read(site / "dem_sigma_again.tif", band=None)
    assert_allclose(both, np.hypot(matching, cameras), rtol=1e-6)
    # It grows along the film, which lies nearly along the rows of the map.
    found = np.nanmedian(cameras[:, np.isfinite(cameras).any(axis=0)], axis=0)
    assert 2.0 <= found.min() < 2.4
    assert 3.6 < found.max() <= 4.0


def test_the_dem_is_the_terrain_within_its_own_standard_deviation(site):
    info = rasters.info(site / "dem.tif")
    assert info.crs == CRS
    assert info.tags["heights"].startswith("ellipsoidal")
    xy = info.grid.centres()
    error = rasters.read(site / "dem.tif") - terrain_m(xy[..., 0], xy[..., 1])
    sigma = rasters.read(site / "dem_sigma.tif")
    assert np.isfinite(error).sum() > 12_000
    # A tenth of a pixel is 8 m of height; some ten points make a cell.
    assert 1.5 < 1.4826 * np.nanmedian(np.abs(error)) < 4
    assert 0.8 < 1.4826 * np.nanmedian(np.abs(error / sigma)) < 1.3
    # What matching was unsure of would be 2 km off.
    assert np.nanmax(np.abs(error)) < 100
    assert np.array_equal(np.isnan(error), np.isnan(sigma))


def test_the_product_grid_lies_on_whole_multiples_of_the_posting(site):
    for name in ("dem.tif", "dem_coregistered.tif", "dem_difference.tif"):
        grid = rasters.info(site / name).grid
        assert grid == rasters.info(site / "dem.tif").grid
        assert all(v % RESOLUTION_M == 0 for v in grid.bounds)


def test_points_say_what_a_pixel_is_worth_and_how_well_rays_meet(site):
    summary = records.read_json(site / "points.json")
    assert 60 < summary["height_per_px_m"] < 90  # 4.0 m at 7 um and 170 km, 20 times as much at 140 um
    assert summary["rejected"] == 0
    assert summary["miss_m"]["median"] < 1.0
    disparity = rasters.read(site / "disparity.tif")
    # All but those at the rim of the films, and a percent that the noise put outside the heights expected.
    every = summary["sampled_every_px"]
    assert 0.98 < summary["count"] / np.isfinite(disparity[::every, ::every]).sum() <= 1
    gap_m = rasters.read(site / "ray_gap.tif")
    assert np.isnan(gap_m[np.isnan(disparity[::16, ::16])]).all()
    assert np.isfinite(gap_m).sum() > 0.98 * summary["count"] / (16 / every) ** 2
    assert np.nanmedian(gap_m) == pytest.approx(summary["miss_m"]["median"], rel=0.05)


def test_the_orthophoto_shows_the_ground(site):
    grid = rasters.info(site / "ortho.tif").grid
    grey = rasters.read(site / "ortho.tif")
    xy = grid.centres()
    error = (grey - texture(xy[..., 0] / 4, xy[..., 1] / 4))[grey > 0]
    assert error.size > 50_000
    assert np.sqrt(np.mean(error**2)) < 4


def test_coregistration_finds_how_the_reference_lies(site):
    found = records.read_json(site / "coregistration.json")
    assert found["shift_method"] == "nuth_kaab"
    assert_allclose(found["shift_m"], SHIFT_M, atol=4)
    assert found["after_m"]["nmad"] < 0.6 * found["before_m"]["nmad"]


def test_a_large_model_is_matched_by_some_of_its_cells_and_moved_whole(site):
    size = np.prod(rasters.info(site / "dem.tif").shape)
    function("coregister")(
        site / "dem.tif",
        site / "reference.tif",
        None,
        site / "dem_coregistered_thinned.tif",
        site / "coregistration_thinned.json",
        **COREGISTRATION,
        threads=1,
        cells_at_once=size // 3,
    )
    found = records.read_json(site / "coregistration_thinned.json")
    assert found["shift_method"] == "nuth_kaab"
    assert_allclose(found["shift_m"], SHIFT_M, atol=6)
    assert rasters.info(site / "dem_coregistered_thinned.tif").grid == rasters.info(site / "dem.tif").grid
    moved, expected = (rasters.read(site / f"dem_coregistered{name}.tif") for name in ("_thinned", ""))
    assert np.isfinite(moved).sum() > 0.99 * np.isfinite(expected).sum()
    assert np.nanmedian(np.abs(moved - expected)) < 1.0


def test_quality_tells_before_and_after_and_against_the_independent_model(site):
    quality = records.read_json(site / "quality.json")
    assert quality["sigma_naught_px"] == 1.1
    assert quality["y_parallax"] == {"median_px": 0.01, "sd_px": 0.2}
    for name in ("before", "after"):
        assert {"count", "area_km2", "median", "nmad", "sd", "le90", "completeness", "by_slope"} <= set(quality[name])
    assert quality["after"]["nmad"] < quality["before"]["nmad"]
    # Against the truth it is the other way round: what was shifted is no longer there.
    assert quality["check"]["before"]["nmad"] < quality["check"]["after"]["nmad"]
    assert 0.95 < quality["before"]["completeness"] <= 1
    assert 0.95 < quality["before"]["textured"]["completeness"] <= 1


def test_figures_are_pictures(site):
    for name in ("hillshade.png", "dem_difference.png", "histogram.png"):
        assert (site / name).read_bytes().startswith(b"\x89PNG")
