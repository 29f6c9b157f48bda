"""Settings and a pair that several tests share."""

import numpy as np
import pytest

from tests.dense.synthetic import render, texture


@pytest.fixture
def settings():
    return {
        "small_step": 24,
        "large_step": 64,
        "least_texture_sd": 2.0,
        "saturated_from": 250,
        "least_correlation": 0.35,
        "least_uniqueness": 0.25,
        "largest_speckle_px": 100,
        "speckle_step_px": 1.5,
        "threads": 1,
    }


@pytest.fixture(scope="session")
def ground():
    return texture((240, 420), np.random.default_rng(5), finest_px=0.7)


@pytest.fixture(scope="session")
def slope():
    """Disparity of a plane that leans in both directions."""
    rows, columns = np.mgrid[:240, :420]
    return 12 + 0.02 * columns + 0.05 * rows


@pytest.fixture(scope="session")
def pair(ground, slope):
    return render(ground, slope, rng=np.random.default_rng(1))
