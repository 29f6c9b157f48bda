"""Meeting rays, worked by hand."""

import numpy as np
from numpy.testing import assert_allclose

from cosp.geometry.rays import Rays, meet


def test_crossing_rays_meet_without_a_gap():
    first = Rays(np.array([0.0, 0.0, 10.0]), np.array([0.6, 0.0, -0.8]))
    second = Rays(np.array([15.0, 0.0, 10.0]), np.array([-0.6, 0.0, -0.8]))
    ground, gap = meet(first, second)
    assert_allclose(ground, [7.5, 0.0, 0.0], atol=1e-12)
    assert_allclose(gap, 0.0, atol=1e-12)


def test_skew_rays_meet_halfway_along_their_common_perpendicular():
    first = Rays(np.array([0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    second = Rays(np.array([5.0, 2.0, -3.0]), np.array([0.0, 0.0, 1.0]))
    ground, gap = meet(first, second)
    assert_allclose(ground, [5.0, 1.0, 0.0], atol=1e-12)
    assert_allclose(gap, 2.0)


def test_parallel_rays_do_not_meet():
    down = np.array([0.0, 0.0, -1.0])
    ground, gap = meet(Rays(np.zeros(3), down), Rays(np.ones(3), down))
    assert np.isnan(ground).all()
    assert np.isnan(gap)
