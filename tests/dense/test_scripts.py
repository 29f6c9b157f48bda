import importlib.util
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from cosp.dense.coarse_to_fine import match
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import arrays, rasters, records
from tests.dense.synthetic import render, texture

SCRIPTS = Path(__file__).parents[2] / "scripts"


def function_of(name):
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return getattr(module, name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An epipolar pair of 700 rows, its y-parallax of two px at the top and none at the bottom, its rectification."""
    folder = tmp_path_factory.mktemp("pair")
    rng = np.random.default_rng(9)
    rows, columns = np.mgrid[:700, :140]
    y_parallax = 2 - 2 * rows / 699
    pair = render(texture(rows.shape, rng), 6 + 0.03 * columns + 0.01 * rows, y_parallax=y_parallax, rng=rng)
    grid = PixelGrid(0, 0, 1, 1, rows.shape)
    rasters.write(folder / "fore.tif", pair.left, grid=grid, crs=rasters.PIXEL_CRS, nodata=0)
    rasters.write(folder / "aft.tif", pair.right, grid=grid, crs=rasters.PIXEL_CRS, nodata=0)
    coarse = np.full((2, 8, 3), np.nan, np.float32)
    coarse[1] = 2 - 2 * (100 * np.arange(8)[:, None]) / 699
    coarse[1, 7, 2] = np.nan
    rasters.write(folder / "y.tif", coarse, grid=PixelGrid(0, 0, 70, 100, (8, 3)), crs=rasters.PIXEL_CRS)
    records.write(folder / "rectification.json", {"disparity_range_px": [0.0, 24.0]})
    return folder, pair


def test_strips_join_to_what_the_whole_gives(folder, settings):
    folder, pair = folder
    strips = []
    for strip in ("1-of-2", "2-of-2"):
        strips.append(folder / "disparity" / f"{strip}.npy")
        function_of("match_dense")(
            folder / "fore.tif",
            folder / "aft.tif",
            folder / "y.tif",
            folder / "rectification.json",
            strips[-1],
            folder / "validity" / f"{strip}.npy",
            strip=strip,
            **settings,
        )
    function_of("merge_disparity")(
        folder / "fore.tif",
        strips[::-1],
        [folder / "validity" / path.name for path in strips[::-1]],
        folder / "disparity.tif",
        folder / "validity.tif",
        folder / "disparity.json",
        folder / "disparity.png",
        title="a pair",
    )
    assert cv2.imread(str(folder / "disparity.png")).std() > 10
    disparity = rasters.read(folder / "disparity.tif")
    validity, confidence, similarity = rasters.read(folder / "validity.tif", band=None)
    assert disparity.shape == pair.left.shape
    assert_array_equal(np.isnan(disparity), validity != 0)
    assert confidence.dtype == np.uint8
    assert np.median(similarity[validity == 0]) > 200
    inner = pair.seen.copy()
    inner[:, :20] = inner[:, -30:] = False
    error = (disparity - pair.disparity)[inner & (validity == 0)]
    assert (validity[inner] == 0).mean() > 0.98
    assert (np.abs(error) > 1).mean() < 0.01
    # Two px of y-parallax at the top would have ruined this half.
    assert (validity[:300][inner[:300]] == 0).mean() > 0.98
    assert not (match(pair.left, pair.right, (0, 24), **settings).validity[:100][inner[:100]] == 0).mean() > 0.98
    summary = records.read_json(folder / "disparity.json")
    assert_allclose(summary["density"], (validity == 0).sum() / ((validity & 3) == 0).sum())
    assert_allclose(summary["disparity_px"]["median"], np.nanmedian(disparity), atol=0.3)


def test_joining_strips_of_a_long_film_takes_no_more_memory_than_a_few_of_their_rows(tmp_path):
    grid, rows = PixelGrid(0, 0, 1, 1, (16384, 1500)), np.arange(16384, dtype=np.float32)[:, None]
    disparity = np.broadcast_to(rows % 50, grid.shape).astype(np.float32)
    validity = np.full((3, *grid.shape), 200, np.uint8)
    for name, bands in (("disparity", [disparity]), ("validity", validity)):
        arrays.write(tmp_path / name / "1-of-1.npy", bands)
    rasters.write(tmp_path / "fore.tif", validity[0], grid=grid, crs=rasters.PIXEL_CRS)
    whole = disparity.nbytes + validity.nbytes
    del disparity, validity
    merge = function_of("merge_disparity")
    drawn = []
    merge.__globals__.update(
        draw_disparity=lambda *rasters, title: rasters, save=lambda picture, path: drawn.extend(picture)
    )
    tracemalloc.start()
    merge(
        tmp_path / "fore.tif",
        *([tmp_path / name / "1-of-1.npy"] for name in ("disparity", "validity")),
        *(tmp_path / name for name in ("disparity.tif", "validity.tif", "disparity.json", "disparity.png")),
        title="long",
    )
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 0 < peak < whole / 5
    assert [one.shape for one in drawn] == [(2048, 188)] * 3
    assert_array_equal(rasters.read(tmp_path / "disparity.tif", window=Window(5000, 5001, 0, 1500))[0], 0.0)
