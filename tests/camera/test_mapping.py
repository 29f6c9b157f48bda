"""Projection of map points against the slow, exact way."""

import numpy as np
from numpy.testing import assert_allclose
from pyproj import Transformer

from cosp.camera.mapping import MapProjector
from tests.camera.test_panoramic import ORIGIN, camera


def test_map_points_fall_where_their_geodetic_twins_do():
    tested = camera()
    crs = "EPSG:32647"
    to_map = Transformer.from_crs("EPSG:4979", crs, always_xy=True)
    film = np.random.default_rng(0).uniform([-350, -27], [350, 27], (500, 2))
    geodetic = ORIGIN.geodetic_from_local(tested.locate(film, np.linspace(0, 4000, 500)))
    easting, northing, height = to_map.transform(*geodetic.T)
    bounds = (easting.min(), northing.min(), easting.max(), northing.max())
    found = MapProjector(tested, crs, bounds).film(easting, northing, height)
    assert_allclose(found, film, atol=1e-3 * 0.007)  # a thousandth of a pixel


def test_no_height_gives_no_film_point():
    assert np.isnan(MapProjector(camera(), "EPSG:32647", (0, 4.8e6, 1e4, 4.9e6)).film(5e3, 4.85e6, np.nan)).all()
