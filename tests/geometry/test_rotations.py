"""Rotation matrices against single-axis turns and their inverse."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.geometry.rotations import angles_from_matrix, rotation_matrix


def test_omega_alone_turns_y_towards_z():
    c, s = np.cos(0.3), np.sin(0.3)
    assert_allclose(rotation_matrix([0.3, 0, 0]), [[1, 0, 0], [0, c, s], [0, -s, c]], atol=1e-15)


def test_phi_and_kappa_alone_are_the_matrices_of_the_conventions():
    c, s = np.cos(0.2), np.sin(0.2)
    assert_allclose(rotation_matrix([0, 0.2, 0]), [[c, 0, -s], [0, 1, 0], [s, 0, c]], atol=1e-15)
    assert_allclose(rotation_matrix([0, 0, 0.2]), [[c, s, 0], [-s, c, 0], [0, 0, 1]], atol=1e-15)


def test_omega_turns_first():
    omega, phi, kappa = 0.3, -0.2, 1.1
    product = rotation_matrix([0, 0, kappa]) @ rotation_matrix([0, phi, 0]) @ rotation_matrix([omega, 0, 0])
    assert_allclose(rotation_matrix([omega, phi, kappa]), product, atol=1e-15)


@pytest.mark.parametrize("angles", [(-0.26, 0.05, 0.1), (0.26, -0.07, 3.1), (0.0, 0.0, -1.7)])
def test_angles_come_back_from_their_matrix(angles):
    assert_allclose(angles_from_matrix(rotation_matrix(angles)), angles, atol=1e-14)
