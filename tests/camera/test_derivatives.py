from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.camera.derivatives import PARAMETER_NAMES, film_derivatives
from tests.authorities.parameter_table import pair

STEPS = np.array([1.0] * 6 + [1e-5] * 6 + [1e-4])  # metres, radians, -: a few micrometres of film each


@pytest.fixture(params=[(1, -0.0002), (-1, -0.0002), (1, 0.014), (-1, 0.014)])
def camera(request):
    direction, imc_factor = request.param
    return replace(pair("1117")[0], scan_direction=direction, imc_factor=imc_factor)


@pytest.fixture
def ground(camera):
    rng = np.random.default_rng(3)
    film = rng.uniform([-370, -27], [370, 27], (300, 2))
    return camera.locate(film, rng.uniform(0.0, 5000.0, 300))


def test_derivatives_by_parameters_agree_with_central_differences(camera, ground):
    by_parameters, _ = film_derivatives(camera, ground, camera.project(ground))
    p = camera.parameters()
    for k, name in enumerate(PARAMETER_NAMES):
        step = np.zeros(13)
        step[k] = STEPS[k]
        ahead, behind = (camera.with_parameters(p + sign * step).project(ground) for sign in (1, -1))
        expected = (ahead - behind) / (2 * STEPS[k])
        # Rounding of a 1e-11 mm projection over the step, and the third derivative of the largest step.
        assert_allclose(by_parameters[:, :, k], expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max(), err_msg=name)


def test_derivatives_by_ground_agree_with_central_differences(camera, ground):
    _, by_ground = film_derivatives(camera, ground, camera.project(ground))
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1.0
        expected = (camera.project(ground + step) - camera.project(ground - step)) / 2.0
        assert_allclose(by_ground[:, :, k], expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())


def test_points_that_are_not_seen_give_nan_and_leave_the_others_alone(camera, ground):
    ground = ground.copy()
    ground[5] = [1e6, 0.0, 0.0]
    by_parameters, by_ground = film_derivatives(camera, ground, camera.project(ground))
    unseen = np.isnan(by_parameters).any(axis=(1, 2))
    assert unseen.nonzero()[0].tolist() == [5]
    assert np.isnan(by_ground).any(axis=(1, 2)).nonzero()[0].tolist() == [5]
