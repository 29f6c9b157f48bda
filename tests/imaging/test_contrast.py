"""Contrast: what a linear change of grey values must not change."""

import numpy as np
from numpy.testing import assert_allclose

from cosp.imaging.contrast import local_normalise, percentile_stretch


def test_gain_and_offset_do_not_matter():
    image = np.random.default_rng(0).normal(120, 20, (60, 70))
    assert_allclose(local_normalise(image, 8), local_normalise(2 * image + 30, 8), atol=2e-2)


def test_flat_areas_stay_flat():
    assert np.abs(local_normalise(np.full((40, 40), 200.0), 5)).max() < 0.01


def test_no_data_is_zero_and_data_never():
    image = np.linspace(0, 1, 100).reshape(10, 10)
    image[0, 0] = np.nan
    stretched = percentile_stretch(image)
    assert stretched[0, 0] == 0
    assert stretched.ravel()[1:].min() == 1
