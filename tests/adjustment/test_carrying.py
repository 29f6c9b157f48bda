"""Frames without control: carried by their neighbours, and honest about it."""

from dataclasses import replace

import numpy as np
import pytest

from cosp.adjustment.blocks import orient_block
from cosp.adjustment.carrying import on_surface
from cosp.adjustment.observations import place_information
from cosp.adjustment.posterior import height_sigma, place_sigma_m
from cosp.errors import NotEnoughMatchesError
from tests.adjustment.simulated import film_sample, on_terrain, simulate_block
from tests.adjustment.test_calibration import CHOICES, reference

OPTIONS = {"film_distortion_mm": 0.010, "tie_distortion_mm": 0.005, "gate_sigma": 4.0}


@pytest.fixture(scope="module")
def block():
    return simulate_block(np.random.default_rng(1), pairs=3, gcps=300, ties=1500, neighbour_ties=200)


def oriented(block, rng, off_m=1000.0, **choices):
    return orient_block(
        block.start(rng, off_m),
        block.control,
        block.ties,
        reference=reference(block),
        film_groups=block.film_groups,
        place_sigmas_m=[off_m] * len(block.cameras),
        **OPTIONS | choices,
    )


def sigmas_and_errors(block, found, pair):
    """Standard deviations of heights and the errors (N, 3) of a pair."""
    sigma = height_sigma(
        found.adjustment.cameras,
        2 * pair,
        2 * pair + 1,
        covariance=found.adjustment.covariance,
        calibration=found.calibration,
        film_sigma_mm=0.0,
        height_m=1500.0,
        step_mm=10.0,
    )
    errors, film = block.errors_m(found.adjustment.cameras, pair)
    return sigma.at(film), errors


def test_rays_of_film_points_meet_the_reference(block):
    camera = block.cameras[0]
    film = film_sample(np.random.default_rng(3), 200)
    found = on_surface(camera, film, reference(block, noise_m=0.0))
    np.testing.assert_allclose(found, on_terrain(camera, film), atol=0.5)


def test_a_place_that_is_a_standard_deviation_off_costs_one(block):
    camera = block.cameras[1]
    information = place_information(camera, 500.0)
    east = np.concatenate([[500.0], np.zeros(12)])
    assert east @ information @ east == pytest.approx(1.0, rel=1e-6)
    # Where it looks is what counts: a turn that moves the middle as far costs as much.
    turn = np.zeros(13)
    turn[7] = 1e-5
    before, after = (c.locate(np.zeros(2), 0.0) for c in (camera, camera.with_parameters(camera.parameters() + turn)))
    turn *= 500.0 / np.linalg.norm((after - before)[:2])
    assert turn @ information @ turn == pytest.approx(1.0, rel=1e-2)


@pytest.mark.slow
def test_a_pair_without_control_is_carried_and_its_covariance_says_so(block):
    carried = oriented(block.without_control([2, 3]), np.random.default_rng(4), field=CHOICES)
    assert carried.resections[2] is carried.resections[3] is None
    sigma, error = sigmas_and_errors(block, carried, 1)
    beside, error_beside = sigmas_and_errors(block, carried, 0)
    rms = np.sqrt((error**2).mean(axis=0))
    assert rms[2] < 1.5
    assert (rms[:2] < 8.0).all()
    assert np.sqrt((error_beside**2).mean(axis=0)).max() < 1.5
    # Heights come from the reference with or without control.
    assert np.median(sigma) < 1.2 * np.median(beside)
    place = place_sigma_m(
        carried.adjustment.cameras,
        2,
        covariance=carried.adjustment.covariance,
        calibration=carried.calibration,
        height_m=1500.0,
    )
    assert (rms[:2] / place > 0.5).all()
    assert (rms[:2] / place < 2.0).all()
    assert 0.5 < np.sqrt(np.mean((error[:, 2] / sigma) ** 2)) < 1.5


def test_a_frame_that_nothing_joins_to_control_is_named(block):
    lost = block.without_control([2, 3])
    alone = [points for points in lost.ties if not points.neighbours]
    with pytest.raises(NotEnoughMatchesError, match="DS1112-DF001, DS1112-DA001: no ground control, and 0 of the 7"):
        oriented(replace(lost, ties=alone), np.random.default_rng(5))


def test_a_block_without_any_control_is_refused(block):
    with pytest.raises(NotEnoughMatchesError, match="with no frame on known ground, none can be carried"):
        oriented(block.without_control(range(6)), np.random.default_rng(5))


def test_a_fore_film_without_control_is_carried_by_its_aft(block):
    first = replace(block, cameras=block.cameras[:2], control=block.control[:2], ties=block.ties[:1])
    found = oriented(first.without_control([0]), np.random.default_rng(6))
    # The plain model does not follow distortion of 1.5 px; without control of its own it does so no worse by much.
    error, _ = block.errors_m(found.adjustment.cameras, 0)
    assert np.sqrt((error**2).mean(axis=0)).max() < 10.0
