"""Views show what they say they show, wherever the folder goes."""

import shutil

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_array_equal

from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters, views


def test_a_view_is_a_window_without_georeference_and_moves_with_its_folder(tmp_path):
    film = np.random.default_rng(0).integers(1, 255, (40, 60)).astype(np.uint8)
    grid = PixelGrid(-3.0, 2.0, 0.1, -0.1, film.shape)
    here = tmp_path / "here"
    rasters.write(here / "films" / "film.tif", film, grid=grid, crs=rasters.FILM_CRS, nodata=0)
    window = Window(5, 30, 20, 50)
    views.write(
        here / "exports" / "a.vrt", here / "films" / "film.tif", window, metadata={"": {"NOTE": "a < b"}, "RPC": {}}
    )
    shutil.move(here, tmp_path / "there")
    path = tmp_path / "there" / "exports" / "a.vrt"
    assert_array_equal(rasters.read(path), film[window.slices])
    with rasters._quiet(), rasterio.open(path) as view:
        assert view.crs is None
        assert view.transform.is_identity
        assert view.nodata == 0
        assert view.tags()["NOTE"] == "a < b"


def test_a_raster_that_is_not_there_leaves_no_view(tmp_path):
    with pytest.raises(InputError, match=r"film.tif: no such file"):
        views.write(tmp_path / "a.vrt", tmp_path / "film.tif", Window(0, 1, 0, 1))
    assert list(tmp_path.iterdir()) == []
