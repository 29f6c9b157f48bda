import numpy as np
import pytest

from cosp.adjustment.observations import PLAIN_PRIORS
from cosp.adjustment.robust import resect
from cosp.camera.missions import mission_for
from cosp.camera.prediction import Corners, predict_camera
from cosp.errors import NotEnoughMatchesError
from tests.authorities.parameter_table import PIXEL_MM, pair

NOISE_PX = 1.0
FILM_CORNERS = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * [357.4, 27.7]


def observations(truth, rng, count=400, gross_share=0.0):
    film = rng.uniform([-350, -27], [350, 27], (count, 2))
    ground = truth.locate(film, rng.uniform(0.0, 3000.0, count))
    film = film + rng.normal(0.0, NOISE_PX * PIXEL_MM, film.shape)
    wrong = rng.random(count) < gross_share
    film[wrong] += rng.uniform(-150.0, 150.0, (wrong.sum(), 2)) * PIXEL_MM
    return film, ground, wrong


def start_from_corners(truth, *, off_m, rng, look="fore", mission="KH-4B"):
    """The mission's nominal camera at corners that are wrong by a distance in some direction."""
    corners = Corners(*(tuple(corner) for corner in truth.locate_geodetic(FILM_CORNERS, 0.0)[:, :2].tolist()))
    camera = predict_camera(
        truth.scene,
        corners,
        mission=mission_for(mission),
        look=look,
        descending=True,
        half_length_mm=357.4,
        half_width_mm=27.7,
    ).moved_to(truth.origin)
    p = camera.parameters()
    direction = rng.uniform(0.0, 2.0 * np.pi)
    p[0:2] += off_m * np.array([np.cos(direction), np.sin(direction)])
    return camera.with_parameters(p)


def model_error_px(truth, camera):
    film = np.random.default_rng(0).uniform([-350, -27], [350, 27], (500, 2))
    off = (camera.project(truth.locate(film, 1500.0)) - film) / PIXEL_MM
    return np.sqrt((off**2).sum(1).mean())


def resected(camera, film, ground, **choices):
    options = {"sigma_px": NOISE_PX, "pixel_mm": PIXEL_MM, "priors": PLAIN_PRIORS, "gate_sigma": 4.0}
    return resect(camera, film, ground, **options | choices)


@pytest.mark.parametrize("off_m", [10_000.0, 50_000.0])
@pytest.mark.parametrize("gross_share", [0.0, 0.5, 0.7])
def test_resection_survives_gross_errors_and_a_far_start(gross_share, off_m):
    rng = np.random.default_rng(int(off_m + 10 * gross_share))
    truth = pair("1117")[0]
    film, ground, wrong = observations(truth, rng, gross_share=gross_share)
    found = resected(start_from_corners(truth, off_m=off_m, rng=rng), film, ground)
    assert model_error_px(truth, found.camera) < 0.5
    # Of the gross errors, about a thousandth falls inside four sigma; of the good points, fewer than that outside.
    assert ((found.weights == 0) != wrong).sum() <= 4
    assert 0.85 < found.sigma0 < 1.15


def test_without_robust_weights_the_same_start_would_fail():
    # What the test above is worth: least squares on half wrong points is off by pixels.
    rng = np.random.default_rng(5)
    truth = pair("1117")[0]
    film, ground, _ = observations(truth, rng, gross_share=0.5)
    found = resected(start_from_corners(truth, off_m=1000.0, rng=rng), film, ground, sigma_px=150.0, gate_sigma=1000.0)
    assert model_error_px(truth, found.camera) > 3.0


@pytest.mark.parametrize("start_direction", [1, -1])
@pytest.mark.parametrize("member", [0, 1])
def test_the_priors_tell_the_scan_direction_whatever_the_start(member, start_direction):
    rng = np.random.default_rng(11)
    truth = pair("1112")[member]
    film, ground, _ = observations(truth, rng)
    start = start_from_corners(truth, off_m=5000.0, rng=rng, look=["fore", "aft"][member])
    start = start.with_parameters(start.parameters(), scan_direction=start_direction)
    found = resected(start, film, ground)
    assert found.scan_direction == truth.scan_direction
    assert found.other_direction_cost > 10.0


def test_a_lens_compensated_camera_is_recovered_with_its_factor():
    rng = np.random.default_rng(12)
    nodding = pair("1112")[0]
    p = nodding.parameters()
    p[9], p[12] = 0.0, 0.0135
    truth = nodding.with_parameters(p)
    film, ground, _ = observations(truth, rng)
    found = resected(start_from_corners(truth, off_m=5000.0, rng=rng, mission="KH-4A"), film, ground)
    sigma = np.sqrt(found.covariance[12, 12])
    assert abs(found.camera.imc_factor - truth.imc_factor) < 4.0 * sigma
    assert sigma < 0.001


def test_the_digitisation_does_not_matter():
    truth = pair("1117")[0]
    film, ground, _ = observations(truth, np.random.default_rng(13))
    start = start_from_corners(truth, off_m=5000.0, rng=np.random.default_rng(14))
    fine = resected(start, film, ground)
    coarse = resected(start, film, ground, pixel_mm=4 * PIXEL_MM, sigma_px=NOISE_PX / 4)
    np.testing.assert_allclose(coarse.camera.parameters(), fine.camera.parameters(), rtol=1e-9)
    np.testing.assert_allclose(coarse.residuals_px * 4, fine.residuals_px, atol=1e-6)


def test_film_thrice_as_bad_as_its_sigma_keeps_its_good_points():
    rng = np.random.default_rng(15)
    truth = pair("1117")[0]
    film, ground, wrong = observations(truth, rng, gross_share=0.2)
    found = resected(start_from_corners(truth, off_m=5000.0, rng=rng), film, ground, sigma_px=NOISE_PX / 3)
    assert (found.weights[~wrong] == 0).mean() < 0.02
    assert 2.5 < found.sigma0 < 3.5


def test_too_few_points_are_an_error_that_names_the_scene():
    truth = pair("1117")[0]
    film, ground, _ = observations(truth, np.random.default_rng(16), count=6)
    with pytest.raises(NotEnoughMatchesError, match="DS1117-2071DF008: 6 of the 7"):
        resected(truth, film, ground)
