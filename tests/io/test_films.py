import numpy as np
import pytest

from cosp.geometry.grids import PixelGrid
from cosp.io import films, rasters, records


@pytest.mark.parametrize(
    ("turned", "mirrored", "signs"),
    [(False, False, (1, 1)), (True, False, (-1, -1)), (False, True, (1, -1)), (True, True, (-1, 1))],
)
def test_film_points_of_a_pixel_are_those_of_the_raster_with_other_signs(tmp_path, turned, mirrored, signs):
    grid = PixelGrid(-9.5, 4.5, 1.0, -1.0, (10, 20))
    rasters.write(tmp_path / "film.tif", np.ones(grid.shape, np.uint8), grid=grid, crs=rasters.FILM_CRS)
    records.write(tmp_path / "footprint.json", {"turned": turned, "mirrored": mirrored})
    own = films.film_grid(tmp_path / "film.tif", tmp_path / "footprint.json")
    np.testing.assert_allclose(own.points(2, 3), grid.points(2, 3) * signs)
    rows, columns = own.pixels(own.points(7.5, 1.25))
    assert (rows, columns) == (7.5, 1.25)
    assert films.signs(tmp_path / "footprint.json") == signs
