"""The script that writes cameras for other programs: what it writes is read back and sees what our camera sees."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose
from rasterio.transform import RPCTransformer

from cosp.camera.exits import film_lattice
from cosp.camera.field import FilmField
from cosp.camera.opticalbar import residuals_mm
from cosp.camera.tsai import optical_bar_from_tsai
from cosp.errors import NoOverlapError
from cosp.geometry.grids import PixelGrid
from cosp.io import rasters, records
from cosp.lint import lint
from scripts.export_cameras import export_cameras
from tests.authorities.parameter_table import pair

GRID = PixelGrid(-350.0, 27.0, 0.7, -0.7, (78, 1001))
SETTINGS = {
    "reference_dem_heights": "ellipsoidal",
    "formats": ["optical_bar", "rpc", "location_grid"],
    "height_margin_m": 300,
    "rpc_pieces": 2,
    "rpc_largest_px": 0.02,
    "grid_step_mm": 5.7,
    "grid_height_step_m": 1000,
    "threads": 2,
}


def grey(film_mm):
    """Grey values of film points as the camera images them."""
    return 128.0 + 100.0 * np.sin(film_mm[..., 0] / 9.0) * np.cos(film_mm[..., 1] / 7.0)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A fore film without and an aft film with known distortion, and their exports."""
    folder = tmp_path_factory.mktemp("block")
    fore, aft = pair("1117")
    flat = FilmField.flat(half_length_mm=360.0, half_width_mm=28.0, knots_along_mm=90.0, knots_across_mm=28.0)
    field = flat.with_coefficients(np.random.default_rng(0).normal(0.0, 0.7, (*flat.shape, 2)))
    aft = replace(aft, film_field=field)
    for camera, imaged in ((fore, GRID.centres()), (aft, field.corrected(GRID.centres()))):
        records.write(folder / "cameras" / f"{camera.scene}.json", camera)
        film = np.rint(grey(imaged)).astype(np.uint8)
        rasters.write(folder / camera.scene / "film.tif", film, grid=GRID, crs=rasters.FILM_CRS, nodata=0)
    dem = PixelGrid.covering((94.0, 42.0, 102.0, 46.0), 0.05)
    heights = np.linspace(900.0, 2600.0, dem.shape[1], dtype=np.float32) * np.ones(dem.shape, np.float32)
    rasters.write(folder / "dem.tif", heights, grid=dem, crs="EPSG:4326")
    scenes = [fore.scene, aft.scene]
    export_cameras(
        folder / "cameras",
        [folder / scene / "film.tif" for scene in scenes],
        folder / "dem.tif",
        folder / "exports",
        scenes=scenes,
        **SETTINGS,
    )
    return folder, fore, aft


def test_the_summary_names_every_file_and_what_it_leaves(exported):
    folder, fore, aft = exported
    summary = records.read_json(folder / "exports" / "exports.json")["scenes"]
    for camera, image in ((fore, ".vrt"), (aft, ".tif")):
        scene = summary[camera.scene]
        assert scene["image"] == camera.scene + image
        assert scene["film_field_removed"] == (camera is aft)
        low, high = scene["heights_m"]
        assert 600 <= low < high <= 2900
        for form in SETTINGS["formats"]:
            for entry in scene[form]:
                assert (folder / "exports" / entry["file"]).is_file()
                assert 0 < entry["rms_px"] < entry["largest_px"] < 0.02


@pytest.mark.parametrize("member", [0, 1])
def test_the_image_shows_everything_where_a_camera_without_distortion_images_it(exported, member):
    folder, *cameras = exported
    scene = cameras[member].scene
    image = rasters.read(folder / "exports" / f"{scene}{('.vrt', '.tif')[member]}").astype(float)
    inner = (slice(6, -6), slice(6, -6))
    assert np.abs(image - grey(GRID.centres()))[inner].max() < 2.0
    measured = rasters.read(folder / scene / "film.tif").astype(float)
    assert (np.abs(measured - grey(GRID.centres()))[inner].max() > 10.0) == (member == 1)


@pytest.mark.parametrize("member", [0, 1])
def test_the_optical_bar_goes_with_the_image_and_sees_the_same_ground(exported, member):
    folder, *cameras = exported
    camera = cameras[member].without_field()
    path = folder / "exports" / f"{camera.scene}.tsai"
    assert lint(path, folder / "exports" / f"{camera.scene}{('.vrt', '.tif')[member]}") == []
    bar = optical_bar_from_tsai(path.read_text(encoding="utf-8"), path.name)
    film_mm, height_m = film_lattice(GRID, (600.0, 2900.0), (20, 4, 3))
    left = residuals_mm(bar, camera, film_mm, camera.locate(film_mm, height_m))
    assert np.abs(left / GRID.step_x).max() < 0.02
    rows, columns = GRID.pixels(film_mm)
    assert_allclose(bar.pixels(film_mm), np.stack([columns, rows], -1), atol=1e-6)


@pytest.mark.parametrize("member", [0, 1])
def test_gdal_places_the_pieces_by_their_coefficients(exported, member):
    folder, *cameras = exported
    camera = cameras[member].without_field()
    entries = records.read_json(folder / "exports" / "exports.json")["scenes"][camera.scene]["rpc"]
    whole = rasters.read(folder / "exports" / f"{camera.scene}{('.vrt', '.tif')[member]}")
    for entry in entries:
        start, stop = entry["columns"]
        with rasters._quiet(), rasterio.open(folder / "exports" / entry["file"]) as piece:
            assert (piece.read(1) == whole[:, start:stop]).all()
            rpcs = piece.rpcs
        assert (folder / "exports" / entry["file"].replace(".vrt", "_RPC.TXT")).is_file()
        film_mm, height_m = film_lattice(GRID.window(0, 78, start, stop), (700.0, 2800.0), (7, 3, 2))
        longitude, latitude, _ = camera.locate_geodetic(film_mm, height_m).T
        with RPCTransformer(rpcs) as gdal:
            found = gdal.rowcol(longitude, latitude, zs=height_m, op=lambda x: x)
        rows, columns = GRID.pixels(film_mm)
        assert_allclose(np.array(found[0]) - 0.5, rows, atol=0.02)
        assert_allclose(np.array(found[1]) - 0.5, columns - start, atol=0.02)


def test_the_location_grid_has_nodes_from_the_corner_of_the_image(exported):
    folder, fore, _ = exported
    path = folder / "exports" / f"{fore.scene}_grid.tif"
    with rasters._quiet(), rasterio.open(path) as grid:
        tags, bands, transform = grid.tags(), grid.read(), grid.transform
    assert (transform.a, transform.e, transform.c, transform.f) == (8.0, 8.0, 0.0, 0.0)
    assert tags["REF"] == "EPSG:4326"
    height_m = float(tags["ALTITUDE_B2"])
    located = fore.locate_geodetic(GRID.points(32 - 0.5, 400 - 0.5), height_m)
    assert_allclose(bands[2:4, 4, 50], located[:2], atol=1e-12)


def test_a_film_off_the_reference_dem_is_said(exported, tmp_path):
    folder, fore, _ = exported
    grid = PixelGrid.covering((10.0, 42.0, 11.0, 43.0), 0.1)
    rasters.write(tmp_path / "dem.tif", np.ones(grid.shape, np.float32), grid=grid, crs="EPSG:4326")
    with pytest.raises(NoOverlapError, match=fore.scene):
        export_cameras(
            folder / "cameras",
            [folder / fore.scene / "film.tif"],
            tmp_path / "dem.tif",
            tmp_path / "exports",
            scenes=[fore.scene],
            **SETTINGS,
        )
