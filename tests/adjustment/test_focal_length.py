"""The focal length as an unknown: its derivatives, a wrong one put right, and what is said where nothing tells it."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from cosp.adjustment import precision
from cosp.adjustment.blocks import CheckErrors, orient_block, summary
from cosp.adjustment.unknowns import NAMES, SAME_LENS_MM, values_of, with_focal_lengths, with_values
from cosp.camera.derivatives import focal_derivatives
from tests.adjustment.simulated import film_sample, on_terrain, simulate_pair
from tests.adjustment.test_calibration import CHOICES, reference
from tests.authorities.parameter_table import PIXEL_MM, pair
from tests.camera.test_field import rough_field, with_steps

SIGMA_MM = 1.0


@pytest.mark.parametrize("distorted", [False, True])
def test_derivatives_by_the_focal_length_agree_with_central_differences(distorted):
    rng = np.random.default_rng(1)
    camera = replace(pair("1112")[0], imc_factor=0.013)
    if distorted:
        camera = replace(camera, film_field=with_steps(rough_field(rng), rng))
    film = film_sample(rng, 300)
    ground = on_terrain(camera, film)
    step = 1e-3
    ahead, behind = (
        replace(camera, focal_length_mm=camera.focal_length_mm + sign * step).project(ground) for sign in (1, -1)
    )
    found = focal_derivatives(camera, camera.project(ground))
    np.testing.assert_allclose(found, (ahead - behind) / (2.0 * step), rtol=1e-6, atol=1e-8)
    assert np.abs(found).max() > 0.4


def test_unknowns_of_a_camera_are_put_back():
    camera = pair("1112")[0]
    assert len(NAMES) == 14
    changed = with_values(camera, values_of(camera, 14) + np.eye(14)[13] * 0.5)
    assert changed.focal_length_mm == camera.focal_length_mm + 0.5
    assert with_values(changed, values_of(camera)).focal_length_mm == changed.focal_length_mm
    np.testing.assert_allclose(changed.parameters(), camera.parameters(), rtol=1e-14)


def test_frames_of_one_camera_share_their_lens():
    given = np.arange(39.0**2).reshape(39, 39)
    wide = with_focal_lengths(given + given.T, [0, 1, 0], SIGMA_MM)
    assert wide.shape == (42, 42)
    np.testing.assert_array_equal(wide[14:27, :13], (given + given.T)[13:26, :13])
    focal = np.linalg.inv(wide[np.ix_([13, 27, 41], [13, 27, 41])])
    np.testing.assert_allclose(np.diag(focal), SIGMA_MM**2, rtol=1e-3)
    assert focal[0, 1] == 0.0
    assert focal[0, 0] + focal[2, 2] - 2.0 * focal[0, 2] == pytest.approx(2.0 * SAME_LENS_MM**2)


def adjusted(simulated, *, off_mm, sigma_mm, field):
    wrong = [replace(camera, focal_length_mm=camera.focal_length_mm + off_mm) for camera in simulated.start()]
    return orient_block(
        wrong,
        simulated.control,
        [simulated.ties],
        film_distortion_mm=0.0,
        tie_distortion_mm=0.0,
        gate_sigma=4.0,
        field=field,
        reference=reference(simulated),
        focal_sigma_mm=sigma_mm,
    )


@pytest.fixture(scope="module")
def simulated():
    return simulate_pair(np.random.default_rng(3), gcps=2000, ties=1500)


@pytest.mark.parametrize(
    "field", [None, pytest.param(replace(CHOICES, lengths_mm=(60.0,)), marks=pytest.mark.slow)], ids=["plain", "field"]
)
def test_a_wrong_focal_length_is_put_right(simulated, field):
    found = adjusted(simulated, off_mm=-1.2, sigma_mm=SIGMA_MM, field=field).adjustment
    off_mm = np.array(
        [now.focal_length_mm - true.focal_length_mm for now, true in zip(found.cameras, simulated.cameras, strict=True)]
    )
    sigma_mm = np.sqrt(np.diag(found.covariance)[13::14])
    assert (np.abs(off_mm) < 2.5 * sigma_mm).all()
    assert (np.abs(off_mm) < 0.5).all()
    # Relief tells it, and weakly so: 0.44 mm with 500 points at best, and hardly told from phi1, Z and X1.
    assert (sigma_mm > 0.05).all()
    assert (sigma_mm < 0.35).all()
    strongest = precision.correlations(found, 0.95)[0][0]
    assert abs(strongest["correlation"]) > 0.95
    named = [each for each in precision.correlations(found, 2.0)[0] if each["second"] == "f"]
    assert len(named) == 13  # all of them, however small
    assert {"Z", "phi1", "X1"} <= {each["first"] for each in named if abs(each["correlation"]) > 0.7}


def test_a_focal_length_that_is_not_asked_for_stays(simulated):
    found = adjusted(simulated, off_mm=1.0, sigma_mm=None, field=None).adjustment
    assert found.unknowns == 13
    assert all(camera.focal_length_mm == pytest.approx(610.6) for camera in found.cameras)


def test_a_focal_length_that_nothing_tells_is_warned_of(caplog):
    few = simulate_pair(np.random.default_rng(4), gcps=60, ties=60)
    found = adjusted(few, off_mm=0.0, sigma_mm=0.2, field=None)
    nothing = np.empty(0)
    errors = CheckErrors(nothing, nothing, nothing > 0, nothing, nothing > 0)
    with caplog.at_level(logging.INFO):
        told = summary(
            found, found, few.control, [few.ties], few.checks, errors, errors, pixels_mm=[PIXEL_MM] * 2,
            film_distortion_mm=0.0, tie_distortion_mm=0.0, correlation_limit=0.95, focal_sigma_mm=0.2,
        )  # fmt: skip
    assert "hardly tell the focal length" in caplog.text
    for image in told["images"]:
        assert 0.1 < image["focal_length"]["sigma_mm"] < 0.2
        assert image["focal_length"]["prior_sigma_mm"] == 0.2
        assert sum(each["second"] == "f" for each in image["correlations"]) == 13
    (group,) = (group for group in told["groups"] if group["kind"] == "focal length")
    assert group["count"] == 2
    assert group["w_tests"] == {"limit": 3.29, "tested": 2, "beyond": 0}
