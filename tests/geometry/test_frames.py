"""Local frames against geodesy worked by hand and against their inverse."""

import numpy as np
from numpy.testing import assert_allclose

from cosp.geometry.frames import LocalFrame

SEMI_MAJOR_M = 6378137.0
SEMI_MINOR_M = 6356752.314245


def test_the_origin_lies_on_the_equator_where_the_ellipsoid_does():
    assert_allclose(LocalFrame(0.0, 0.0).origin_ecef_m, [SEMI_MAJOR_M, 0, 0], atol=1e-6)
    assert_allclose(LocalFrame(0.0, 90.0, 100.0).origin_ecef_m, [0, 0, SEMI_MINOR_M + 100], atol=1e-6)


def test_east_north_up_point_where_they_should():
    assert_allclose(LocalFrame(90.0, 0.0).axes, [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-15)


def test_height_is_up_at_the_origin():
    frame = LocalFrame(98.15, 43.9)
    assert_allclose(frame.local_from_geodetic([98.15, 43.9, 1234.5]), [0, 0, 1234.5], atol=1e-8)


def test_geodetic_and_local_undo_each_other():
    frame = LocalFrame(98.15, 43.9)
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(96, 100, 100), rng.uniform(43, 45, 100), rng.uniform(0, 6000, 100)])
    back = frame.geodetic_from_local(frame.local_from_geodetic(points))
    assert_allclose(back[:, :2], points[:, :2], atol=1e-12)
    assert_allclose(back[:, 2], points[:, 2], atol=1e-6)


def test_the_way_through_the_earth_centred_frame_is_the_same():
    frame = LocalFrame(98.15, 43.9)
    elsewhere = LocalFrame(97.0, 44.5, 300.0)
    point = np.array([97.4, 44.2, 1800.0])
    through_ecef = elsewhere.local_from_ecef(frame.ecef_from_local(frame.local_from_geodetic(point)))
    assert_allclose(through_ecef, elsewhere.local_from_geodetic(point), atol=1e-6)


def test_what_is_not_finite_stays_nan():
    assert np.isnan(LocalFrame(98.15, 43.9).geodetic_from_local([np.nan, 0.0, 0.0])).all()
