import numpy as np
import pytest

from cosp.geometry.grids import PixelGrid
from cosp.io import films, rasters


@pytest.mark.parametrize(
    ("turned", "mirrored", "signs"),
    [(False, False, (1, 1)), (True, False, (-1, -1)), (False, True, (1, -1)), (True, True, (-1, 1))],
)
def test_a_film_put_right_shows_each_point_where_its_millimetres_say(tmp_path, turned, mirrored, signs):
    # Not in the middle of the millimetres, so that a shift by the flip would show.
    grid = PixelGrid(-1040.5, 3.5, 1.0, -1.0, (10, 2090))
    grey = np.random.default_rng(1).integers(1, 255, grid.shape, dtype=np.uint8)
    rasters.write(tmp_path / "straight.tif", grey, grid=grid, crs=rasters.FILM_CRS, nodata=0)
    films.put_right(tmp_path / "straight.tif", tmp_path / "film.tif", turned=turned, mirrored=mirrored)
    right = rasters.info(tmp_path / "film.tif").grid
    rows, columns = np.meshgrid(np.arange(10), np.arange(2090), indexing="ij")
    film_mm = grid.points(rows, columns) * signs
    np.testing.assert_array_equal(
        rasters.read(tmp_path / "film.tif")[tuple(np.rint(right.pixels(film_mm)).astype(int))], grey
    )
    assert right.step_x > 0 > right.step_y
