from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.adjustment.bundle import adjust, control_equations, tie_equations
from cosp.adjustment.observations import PLAIN_PRIORS, Control, Ties
from cosp.errors import NotEnoughMatchesError
from cosp.geometry.frames import LocalFrame
from cosp.geometry.rays import meet
from tests.adjustment.simulated import simulate_pair
from tests.authorities.parameter_table import PIXEL_MM

STEPS = np.array([1.0] * 6 + [1e-5] * 6 + [1e-4])


@pytest.fixture(scope="module")
def noisy():
    return simulate_pair(np.random.default_rng(1), gcps=600, ties=1500)


@pytest.fixture(scope="module")
def adjusted(noisy):
    return adjust(noisy.start(), noisy.control, [noisy.ties], priors=PLAIN_PRIORS, gate_sigma=4.0)


def tie_part(ties, count):
    return replace(
        ties, first_mm=ties.first_mm[:count], second_mm=ties.second_mm[:count], sigma_mm=ties.sigma_mm[:count]
    )


def test_noise_free_points_give_the_true_mapping_back():
    simulated = simulate_pair(np.random.default_rng(2), gcps=300, ties=300, noise=0.0)
    found = adjust(simulated.start(), simulated.control, [simulated.ties], priors=PLAIN_PRIORS, gate_sigma=4.0)
    for index, camera in enumerate(found.cameras):
        # The priors pull by this much.
        assert np.abs(simulated.film_errors_px(index, camera)).max() < 0.05


def test_parameters_are_recovered_within_their_standard_deviations(noisy, adjusted):
    truth = np.concatenate([camera.parameters() for camera in noisy.cameras])
    found = np.concatenate([camera.parameters() for camera in adjusted.cameras])
    off = found - truth
    # chi-square of 26 unknowns, correlations and all: mean 26, 99.9 % below 54. The priors take part of it away.
    chi_square = off @ np.linalg.solve(adjusted.covariance, off)
    assert 8.0 < chi_square < 54.0


def test_sigma_naught_is_one_where_the_sigmas_are_right(adjusted, noisy):
    # Standard deviation of the estimate: 1 / sqrt(2 * redundancy) = 0.014; Huber's weights take two per cent.
    assert 0.93 < adjusted.sigma_naught < 1.05
    equations = 2 * sum(len(points) for points in noisy.control) + len(noisy.ties)
    # Up to 26 unknowns, less what the priors settle; a few points beyond four sigma.
    assert equations - 45 <= adjusted.redundancy <= equations - 13


def test_tie_points_bring_the_rays_together(noisy, adjusted):
    alone = adjust(noisy.start(), noisy.control, [], priors=PLAIN_PRIORS, gate_sigma=4.0)
    gaps = []
    for cameras in (alone.cameras, adjusted.cameras):
        equations = tie_equations(cameras, noisy.ties)
        gaps.append(float(np.sqrt(np.mean(equations.residuals**2))))
    assert gaps[1] < gaps[0]
    assert 0.9 < gaps[1] < 1.1


def test_eliminating_ground_points_equals_solving_for_them(noisy):
    # Full normal equations of a few tie points with their ground points as unknowns, against the condition equations.
    ties = tie_part(noisy.ties, 6)
    cameras = noisy.start()
    equations = tie_equations(cameras, ties)
    eliminated = np.einsum("mku,mkv->uv", equations.jacobian, equations.jacobian)
    right = np.einsum("mku,mk->u", equations.jacobian, equations.residuals)

    ground, _ = meet(cameras[0].rays(ties.first_mm), cameras[1].rays(ties.second_mm))
    full = np.zeros((26 + 18, 26 + 18))
    full_right = np.zeros(26 + 18)
    for side, film in ((0, ties.first_mm), (1, ties.second_mm)):
        p = cameras[side].parameters()
        for n in range(6):
            columns = [*range(13 * side, 13 * side + 13), *range(26 + 3 * n, 29 + 3 * n)]
            jacobian = np.empty((2, 16))
            for k in range(13):
                step = np.zeros(13)
                step[k] = STEPS[k]
                ahead, behind = (cameras[side].with_parameters(p + s * step).project(ground[n]) for s in (1, -1))
                jacobian[:, k] = (ahead - behind) / (2 * STEPS[k])
            for k in range(3):
                step = np.eye(3)[k]
                jacobian[:, 13 + k] = (
                    cameras[side].project(ground[n] + step) - cameras[side].project(ground[n] - step)
                ) / 2
            jacobian /= ties.sigma_mm[n]
            residual = (film[n] - cameras[side].project(ground[n])) / ties.sigma_mm[n]
            full[np.ix_(columns, columns)] += jacobian.T @ jacobian
            full_right[columns] += jacobian.T @ residual
    inner = np.linalg.solve(full[26:, 26:], np.column_stack([full[26:, :26], full_right[26:]]))
    scale = np.sqrt(np.diag(eliminated))
    assert_allclose(
        (full[:26, :26] - full[:26, 26:] @ inner[:, :26]) / scale / scale[:, None],
        eliminated / scale / scale[:, None],
        atol=1e-6,
    )
    assert_allclose((full_right[:26] - full[:26, 26:] @ inner[:, 26]) / scale, right / scale, rtol=1e-5, atol=1e-4)


def test_the_uncertainty_of_the_ground_enters_the_film_through_the_scale(noisy):
    camera = noisy.cameras[0]
    points = noisy.control[0]
    exact = replace(points, sigma_mm=np.full(len(points), 1e-6), sigma_height_m=np.full(len(points), 1e-3))
    equations = control_equations(camera, exact)
    in_film = (points.film_mm - camera.project(points.ground_m)) / equations.residuals
    # 3 m at 2.2 to 3.3 m per pixel are about one to one and a half pixels; the axes are nearly independent.
    assert 0.8 < np.median(np.abs(in_film[:, 0])) / PIXEL_MM < 1.5


def test_swapping_the_images_changes_nothing(noisy, adjusted):
    ties = noisy.ties
    swapped = Ties(0, 1, ties.second_mm, ties.first_mm, ties.sigma_mm)
    found = adjust(noisy.start()[::-1], noisy.control[::-1], [swapped], priors=PLAIN_PRIORS, gate_sigma=4.0).cameras
    for first, second in zip(found[::-1], adjusted.cameras, strict=True):
        film = np.array([[-300.0, 20.0], [0.0, 0.0], [300.0, -20.0]])
        assert_allclose(first.project(second.locate(film, 1500.0)), film, atol=1e-5)


def test_wrong_ties_and_control_are_found():
    rng = np.random.default_rng(4)
    simulated = simulate_pair(rng, gcps=600, ties=1500, gross_share=0.3)
    ties = simulated.ties
    wrong = rng.random(len(ties)) < 0.2
    second = ties.second_mm.copy()
    second[wrong, 0] += rng.choice([-1, 1], wrong.sum()) * rng.uniform(8.0, 100.0, wrong.sum()) * PIXEL_MM
    found = adjust(
        simulated.start(), simulated.control, [replace(ties, second_mm=second)], priors=PLAIN_PRIORS, gate_sigma=4.0
    )
    assert ((found.tie_weights[0] == 0) != wrong).mean() < 0.01
    for weights, gross in zip(found.control_weights, simulated.gross, strict=True):
        assert ((weights == 0) != gross).mean() < 0.02
    assert simulated.model_errors_m(found.cameras)[2] < 2.5


def test_an_image_without_control_is_carried_by_its_ties(noisy):
    nothing = Control(np.empty((0, 2)), np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0))
    found = adjust(noisy.start(), [noisy.control[0], nothing], [noisy.ties], priors=PLAIN_PRIORS, gate_sigma=4.0)
    # Its rays meet those of the other image; where along them it cannot know, and its covariance says so.
    equations = tie_equations(found.cameras, noisy.ties)
    assert 0.9 < float(np.sqrt(np.mean(equations.residuals**2))) < 1.1
    sigma = np.sqrt(np.diag(found.covariance))
    assert sigma[13] > 5.0 * sigma[0]


def test_cameras_in_different_frames_are_refused(noisy):
    elsewhere = noisy.cameras[1].moved_to(LocalFrame(97.0, 44.0))
    with pytest.raises(ValueError, match="share one local frame"):
        adjust([noisy.cameras[0], elsewhere], noisy.control, [], priors=PLAIN_PRIORS, gate_sigma=4.0)


def test_a_block_without_control_is_an_error(noisy):
    nothing = Control(np.empty((0, 2)), np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0))
    with pytest.raises(NotEnoughMatchesError, match="0 of the 7 control points"):
        adjust(noisy.start(), [nothing, nothing], [noisy.ties], priors=PLAIN_PRIORS, gate_sigma=4.0)
