"""Plane transformations come back from the points they moved."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.geometry.transforms import Affine, Rigid, estimate_affine, estimate_rigid, ransac


@pytest.fixture
def points():
    return np.random.default_rng(2).uniform(-500, 500, (60, 2))


def test_a_positive_rotation_turns_x_towards_y():
    assert_allclose(Rigid(np.pi / 2, (0.0, 0.0)).apply([[1.0, 0.0]]), [[0.0, 1.0]], atol=1e-15)


def test_rigid_motion_is_recovered(points):
    truth = Rigid(0.0087, (120.3, -4.5))
    found = estimate_rigid(points, truth.apply(points))
    assert found.rotation_rad == pytest.approx(truth.rotation_rad, abs=1e-12)
    assert_allclose(found.shift, truth.shift, atol=1e-9)


def test_inverse_and_composition_of_motions(points):
    first, second = Rigid(0.3, (5.0, 2.0)), Rigid(-0.1, (-7.0, 1.0))
    assert_allclose(first.inverse().apply(first.apply(points)), points, atol=1e-10)
    assert_allclose(second.after(first).apply(points), second.apply(first.apply(points)), atol=1e-10)


def test_affine_is_recovered(points):
    truth = Affine(((1.01, 0.002, 30.0), (-0.003, 0.99, -8.0)))
    assert_allclose(estimate_affine(points, truth.apply(points)).matrix, truth.matrix, atol=1e-9)


def test_ransac_finds_the_motion_among_forty_percent_gross_errors(points):
    truth = Rigid(0.004, (33.0, -2.0))
    rng = np.random.default_rng(3)
    moved = truth.apply(points) + rng.normal(0, 0.2, points.shape)
    wrong = rng.permutation(60)[:24]
    moved[wrong] += rng.uniform(20, 200, (24, 2))
    found, inliers = ransac(estimate_rigid, points, moved, minimum=2, gate=1.0, trials=200, rng=rng)
    assert not inliers[wrong].any()
    assert inliers.sum() >= 34
    assert_allclose(found.shift, truth.shift, atol=0.2)


def test_ransac_says_no_when_there_are_too_few_points():
    found, inliers = ransac(
        estimate_rigid, np.zeros((1, 2)), np.zeros((1, 2)), minimum=2, gate=1, trials=3, rng=np.random.default_rng(0)
    )
    assert found is None
    assert not inliers.any()
