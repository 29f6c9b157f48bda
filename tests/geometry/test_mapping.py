"""The fast way between local frame and map against PROJ itself."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyproj import Transformer

from cosp.geometry.frames import LocalFrame
from cosp.geometry.mapping import MapFrame, utm_crs

FRAME = LocalFrame(11.2, 47.3)
CRS = "EPSG:32632"


@pytest.fixture(scope="module")
def frame_and_points():
    easting, northing = Transformer.from_crs(4326, CRS, always_xy=True).transform(11.2, 47.3)
    frame = MapFrame(FRAME, CRS, (easting - 110e3, northing - 10e3, easting + 110e3, northing + 10e3))
    rng = np.random.default_rng(0)
    offsets = rng.uniform([-110e3, -10e3, 0], [110e3, 10e3, 8000], (5000, 3))
    return frame, offsets + [easting, northing, 0]


def test_utm_zones():
    assert utm_crs(11.2, 47.3) == "EPSG:32632"
    assert utm_crs(-70.0, -33.0) == "EPSG:32719"


def test_map_to_local_agrees_with_proj(frame_and_points):
    frame, points = frame_and_points
    exact = FRAME.local_from_geodetic(frame.geodetic_from_map(points))
    found = frame.local_from_map(points)
    assert_allclose(found[:, :2], exact[:, :2], atol=1e-3)
    assert_allclose(found[:, 2], exact[:, 2], atol=4e-3)


def test_local_to_map_agrees_with_proj(frame_and_points):
    frame, points = frame_and_points
    local = FRAME.local_from_geodetic(frame.geodetic_from_map(points))
    found = frame.map_from_local(local)
    assert_allclose(found[:, :2], points[:, :2], atol=0.06)  # heights enter linearly: 6 cm at 8 km, 110 km away
    assert_allclose(found[:, 2], points[:, 2], atol=4e-3)


def test_outside_the_area_is_nan(frame_and_points):
    frame, points = frame_and_points
    assert np.isnan(frame.local_from_map(points[:1] + [1e6, 0, 0])).all()


def test_degrees_are_refused():
    with pytest.raises(ValueError, match="metres"):
        MapFrame(FRAME, "EPSG:4326", (11, 47, 12, 48))
