"""Rasters: half pixels, windows, reference systems, whole files or none."""

import subprocess
import sys

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose

from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters

MAP = PixelGrid(600_005.0, 5_199_995.0, 10.0, -10.0, (40, 50))


def heights():
    return np.arange(2000, dtype=np.float32).reshape(40, 50)


def test_the_geotransform_holds_the_corner_and_the_grid_the_centre(tmp_path):
    rasters.write(tmp_path / "h.tif", heights(), grid=MAP, crs="EPSG:32632")
    with rasterio.open(tmp_path / "h.tif") as dataset:
        assert (dataset.transform.c, dataset.transform.f) == (600_000.0, 5_200_000.0)
    assert rasters.info(tmp_path / "h.tif").grid == MAP
    assert rasters.info(tmp_path / "h.tif").crs == "EPSG:32632"


def test_film_keeps_its_millimetres(tmp_path):
    film = PixelGrid(-357.0, 27.0, 0.007, -0.007, (30, 60))
    rasters.write(tmp_path / "f.tif", np.zeros((30, 60), np.uint8), grid=film, crs=rasters.FILM_CRS)
    found = rasters.info(tmp_path / "f.tif").grid
    assert_allclose([found.x0, found.y0, found.step_x], [film.x0, film.y0, film.step_x], atol=1e-9)
    with rasterio.open(tmp_path / "f.tif") as dataset:
        assert 'UNIT["unknown",0.001]' in dataset.crs.to_wkt() or "millimetre" in dataset.crs.to_wkt()


def test_windows_are_the_same_pixels(tmp_path):
    with rasters.create(tmp_path / "w.tif", shape=(40, 50), dtype="float32", grid=MAP, crs=None) as writer:
        for window in (Window(0, 20, 0, 50), Window(20, 40, 0, 50)):
            writer.write(window, heights()[window.slices])
    window = Window(15, 30, 7, 12)
    assert np.array_equal(rasters.read(tmp_path / "w.tif", window=window), heights()[window.slices])


def test_threads_that_decompress_change_no_pixel(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (1300, 1700), dtype=np.uint8)
    rasters.write(tmp_path / "t.tif", pixels, grid=MAP)
    window = Window(100, 1250, 3, 1600)
    for threads in (1, 2, 5):
        assert np.array_equal(rasters.read(tmp_path / "t.tif", window=window, threads=threads), pixels[window.slices])


def test_a_failed_write_leaves_nothing(tmp_path):
    def fail():
        with rasters.create(tmp_path / "w.tif", shape=(40, 50), dtype="uint8", grid=MAP, crs=None):
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_warping_onto_the_same_grid_changes_nothing_and_outside_is_nan(tmp_path):
    rasters.write(tmp_path / "h.tif", heights(), grid=MAP, crs="EPSG:32632")
    assert np.array_equal(rasters.read_on_grid(tmp_path / "h.tif", MAP, "EPSG:32632"), heights())
    shifted = rasters.read_on_grid(tmp_path / "h.tif", MAP.window(0, 40, 25, 75), "EPSG:32632")
    assert np.array_equal(shifted[:, :24], heights()[:, 25:49])
    assert np.isnan(shifted[:, 26:]).all()


def test_a_cloud_optimised_file_is_valid_and_equal(tmp_path):
    cogeo = pytest.importorskip("rio_cogeo.cogeo")
    grid = PixelGrid(600_005.0, 5_199_995.0, 10.0, -10.0, (1500, 1300))
    values = np.random.default_rng(0).normal(size=grid.shape).astype(np.float32)
    rasters.write(tmp_path / "c.tif", values, grid=grid, crs="EPSG:32632", cog=True)
    assert cogeo.cog_validate(tmp_path / "c.tif")[0]
    assert np.array_equal(rasters.read(tmp_path / "c.tif"), values)


@pytest.mark.parametrize("compressed", [True, False])
def test_compression_changes_the_size_alone(tmp_path, compressed):
    values = np.zeros((600, 700), np.float32)
    rasters.write(tmp_path / "z.tif", values, grid=PixelGrid(0, 0, 1, 1, values.shape), compressed=compressed)
    np.testing.assert_array_equal(rasters.read(tmp_path / "z.tif"), values)
    assert ((tmp_path / "z.tif").stat().st_size < values.nbytes / 10) == compressed


def test_reduced_reading_is_the_block_mean(tmp_path):
    rasters.write(tmp_path / "h.tif", heights(), grid=MAP, crs="EPSG:32632")
    expected = heights().reshape(10, 4, 25, 2).mean((1, 3))[:, ::1]
    reduced = rasters.read_reduced(tmp_path / "h.tif", 2)
    assert_allclose(reduced.reshape(10, 2, 25).mean(1), expected)


def test_missing_wrong_and_truncated_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.tif: no such file"):
        rasters.read(tmp_path / "none.tif")
    (tmp_path / "text.tif").write_text("this is no picture")
    with pytest.raises(InputError, match=r"text\.tif: not a raster"):
        rasters.info(tmp_path / "text.tif")
    noise = np.random.default_rng(0).integers(0, 255, (2000, 2000), np.uint8)
    rasters.write(tmp_path / "cut.tif", noise, grid=MAP)
    whole = (tmp_path / "cut.tif").read_bytes()
    (tmp_path / "cut.tif").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.tif"):
        rasters.read(tmp_path / "cut.tif")


def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path):
    finished = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    for ending in (".tif", ".cog.tif", ".tif.ovr", ".tif.ovr.ovr"):
        (tmp_path / f".h.{finished.stdout.strip()}.part{ending}").write_text("half a raster")
    other = tmp_path / f".other.{finished.stdout.strip()}.part.tif"
    other.write_text("of another file")
    rasters.write(tmp_path / "h.tif", heights(), grid=MAP, crs="EPSG:32632")
    assert sorted(path.name for path in tmp_path.iterdir()) == [other.name, "h.tif"]


@pytest.mark.parametrize(("dtype", "nodata"), [(np.float32, np.nan), (np.uint8, 0)])
def test_overviews_hold_the_means_of_known_pixels_whatever_their_number(tmp_path, dtype, nodata):
    """Odd sides and gaps, two levels; a whole block without values stays without."""
    rng = np.random.default_rng(3)
    values = rng.uniform(1, 255, (2, 1301, 1799)).astype(dtype)
    values[rng.random(values.shape) < 0.4] = nodata
    values[:, 40:90, 100:200] = nodata
    values[:, 512:1024, 512:1024] = nodata
    path = tmp_path / "c.tif"
    rasters.write(path, values, grid=PixelGrid.covering((0, 0, 17990, 13010), 10.0), nodata=nodata, cog=True)
    assert np.array_equal(rasters.read(path, None), values, equal_nan=dtype == np.float32)
    finer = np.where(values == nodata, np.nan, values).astype(float)
    for level in range(2):
        padded = np.pad(finer, [(0, 0), *((0, n % 2) for n in finer.shape[1:])], constant_values=np.nan)
        blocks = np.stack([padded[:, i::2, j::2] for i in range(2) for j in range(2)])
        known = np.isfinite(blocks).sum(0)
        means = np.where(known, np.nansum(blocks, 0) / np.maximum(known, 1), np.nan)
        with rasterio.open(path, overview_level=level) as dataset:
            found = dataset.read().astype(float)
        finer = np.where(found == nodata, np.nan, found)
        np.testing.assert_allclose(finer, means, atol=0.5 if dtype == np.uint8 else 1e-4)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.tif"]


@pytest.mark.parametrize("cog", [False, True])
def test_threads_that_compress_change_no_byte(tmp_path, cog):
    values = np.random.default_rng(3).normal(0, 1, (1200, 1300)).astype(np.float32).round(2)
    grid = PixelGrid(600000, 5200000, 10, -10, values.shape)
    for threads in (1, 2):
        path = tmp_path / f"{threads}.tif"
        with rasters.create(
            path, shape=values.shape, dtype=np.float32, grid=grid, crs="EPSG:32632", cog=cog, threads=threads
        ) as file:
            file.write(None, values)
    assert (tmp_path / "1.tif").read_bytes() == (tmp_path / "2.tif").read_bytes()
