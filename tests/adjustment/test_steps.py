"""Steps of film that was digitised in pieces: found where they are, and not where they are not."""

from dataclasses import replace

import numpy as np
import pytest

from cosp.adjustment.blocks import CheckErrors, summary
from cosp.adjustment.fieldprior import FieldBasis, Joints, field_with_pieces, joints_on_film
from cosp.adjustment.rows import control_rows, intersections, tie_rows
from cosp.camera.field import FilmField
from cosp.geometry.rays import meet
from tests.adjustment.simulated import JOINTS_MM, conjugates, simulate_pair
from tests.adjustment.test_blocks import ALLOWED
from tests.adjustment.test_calibration import CHOICES, calibrated, standardised_heights
from tests.authorities.parameter_table import PIXEL_MM, pair

STEP_PX = 0.3
TOLD = [Joints(joints, (STEP_PX * PIXEL_MM,) * 3) for joints in JOINTS_MM]
FLAT = FilmField.flat(half_length_mm=357.4, half_width_mm=27.7, knots_along_mm=17.5, knots_across_mm=14.0)


def test_parts_are_laid_down_one_after_the_other_and_blocks_each_by_itself():
    parts = Joints((-100.0, 50.0), (0.002, 0.003)).root()
    offsets = parts @ parts.T
    steps = np.diff(np.eye(3), axis=0)
    np.testing.assert_allclose(steps @ offsets @ steps.T, np.diag([0.002**2, 0.003**2]), atol=1e-15)
    np.testing.assert_allclose(np.ones(3) @ offsets, 0.0, atol=1e-15)  # the whole film is not moved
    alone = Joints((-100.0, 50.0), (0.0, 0.0), 0.002).root()
    np.testing.assert_allclose(alone @ alone.T, 0.002**2 * np.eye(3), atol=1e-15)
    assert Joints().root().shape == (1, 0)


def test_joints_off_the_format_or_near_to_others_are_left_out():
    options = {"half_length_mm": 300.0, "joint_sigma_mm": 0.002, "limit_sigma_mm": 0.001}
    found = joints_on_film([150.0, -150.0, 299.0], [-151.0, 20.0, 22.0, -400.0], **options)
    assert found == Joints((-150.0, 20.0, 150.0), (0.002, 0.0, 0.002), 0.001)
    assert joints_on_film([150.0], [], **options) == Joints((150.0,), (0.002,))
    assert joints_on_film([150.0], [20.0], **options | {"joint_sigma_mm": 0.0}) == Joints((20.0,), (0.0,), 0.001)
    assert joints_on_film([150.0], [20.0], **options | {"joint_sigma_mm": 0.0, "limit_sigma_mm": 0.0}) == Joints()


def test_films_in_fewer_pieces_have_patterns_that_do_nothing():
    joints = [Joints((0.0,), (0.002,)), Joints(), Joints((-100.0, 50.0), (0.002, 0.002))]
    basis = FieldBasis.of([field_with_pieces(FLAT, own) for own in joints], joints, 60.0)
    splines = FLAT.shape[0] * FLAT.shape[1]
    assert [pattern.shape for pattern in basis.patterns] == [(splines + 6, basis.smooth + 4)] * 3
    moved = [np.abs(pattern[splines:]).sum(axis=1) > 0 for pattern in basis.patterns]
    assert [int(each.sum()) for each in moved] == [4, 0, 6]
    assert not any(pattern[splines:, : basis.smooth].any() for pattern in basis.patterns)


@pytest.mark.parametrize("kind", ["gcp", "tie"])
def test_equations_follow_the_steps_as_differences_do(kind):
    simulated = simulate_pair(np.random.default_rng(4), gcps=300, ties=300, noise=0.0)
    fields = [field_with_pieces(FLAT, own) for own in TOLD]
    cameras = [replace(camera, film_field=field) for camera, field in zip(pair("1112"), fields, strict=True)]

    def equations(now):
        if kind == "gcp":
            return control_rows(now[1], simulated.control[1], 1)
        return tie_rows(intersections(now, simulated.ties), simulated.ties)

    before = equations(cameras)
    functions, values = fields[1].basis(before.imaged_mm[:, -1])
    for edge in (0, 1):
        amounts = fields[1].amounts.copy()
        function = len(amounts) - 4 + edge  # of the last piece but one
        step_mm = 1e-4
        for component in (0, 1):
            amounts[:] = 0.0
            amounts[function, component] = step_mm
            moved = replace(cameras[1], film_field=fields[1].with_amounts(amounts))
            change = (before.residuals - equations([cameras[0], moved]).residuals) / step_mm
            at = (values * (functions == function)).sum(axis=1)
            expected = before.by_film[:, :, -1, component] * at[:, None]
            # Where pieces pass into each other the displacement itself moves the place it is looked up at.
            np.testing.assert_allclose(change, expected, atol=2e-3 * np.abs(before.by_film).max())
            assert (np.abs(expected).max(axis=1) > 0.0).mean() > 0.2


def standardised_steps(simulated, found):
    """Errors of the steps at the joints, along and across, in their standard deviations; and the steps found, px."""
    errors, steps = [], []
    for image, distortion in enumerate(simulated.distortions):
        for step, true in zip(found.calibration.steps(image), distortion.steps_mm.mean(axis=1), strict=True):
            errors.append((np.array(step.step_mm) - true) / step.sigma_mm)
            steps.append(np.array(step.step_mm) / PIXEL_MM)
    return np.array(errors), np.array(steps)


def height_rms_near_joints_m(simulated, found, within_mm=12.0):
    first, second, ground = conjugates(simulated.cameras, np.random.default_rng(8), 8000)
    near = np.min(
        [np.abs(film[:, :1] - joints) for film, joints in zip((first, second), JOINTS_MM, strict=True)], axis=0
    )
    chosen = near.min(axis=1) < within_mm
    measured = [film + off(film) for film, off in zip((first, second), simulated.distortions, strict=True)]
    rays = [camera.rays(film[chosen]) for camera, film in zip(found.adjustment.cameras, measured, strict=True)]
    return np.sqrt(np.mean((meet(*rays)[0] - ground[chosen])[:, 2] ** 2))


@pytest.mark.slow
@pytest.mark.parametrize(("joint_px", "least_m"), [(0.3, 0.55), (1.0, 1.2)])
def test_steps_at_joints_are_recovered_within_their_standard_deviations(joint_px, least_m):
    standardised = []
    for seed in (1, 2):
        simulated = simulate_pair(
            np.random.default_rng(seed), gcps=1000, ties=6000, distortion_px=1.5, joint_px=joint_px
        )
        told, untold = calibrated(simulated, joints=TOLD), calibrated(simulated)
        standardised.append(standardised_steps(simulated, told)[0])
        heights = [height_rms_near_joints_m(simulated, found) for found in (told, untold)]
        # The field without steps smears them over its knots.
        assert heights[1] > least_m
        assert heights[0] < (0.85 if joint_px < 0.5 else 0.6) * heights[1]
        assert simulated.model_errors_m(told.adjustment.cameras)[2] < 0.65
    assert 0.6 < np.sqrt(np.mean(np.square(standardised))) < 1.4


@pytest.mark.slow
def test_no_steps_are_invented():
    simulated = simulate_pair(np.random.default_rng(1), gcps=1000, ties=6000, distortion_px=1.5, joint_px=1e-9)
    told, untold = calibrated(simulated, joints=TOLD), calibrated(simulated)
    standardised, steps_px = standardised_steps(simulated, told)
    assert np.abs(steps_px).max() < STEP_PX
    assert np.sqrt(np.mean(standardised**2)) < 1.2
    plain, stepped = (simulated.model_errors_m(found.adjustment.cameras) for found in (untold, told))
    assert (stepped < 1.1 * plain).all()
    assert 0.8 < np.sqrt(np.mean(standardised_heights(simulated, told) ** 2)) < 1.25


@pytest.mark.slow
def test_blocks_of_the_scanner_are_found_where_their_limits_are_known():
    simulated = simulate_pair(np.random.default_rng(1), gcps=1000, ties=6000, distortion_px=1.5, step_px=0.3)
    limits = tuple(np.arange(-320.0, 321.0, 20.0))
    # The scale of the blocks' sigma is found: half of what the films were made with is given.
    blocks = [Joints(limits, (0.0,) * len(limits), 0.1 * PIXEL_MM)] * 2
    told, untold = calibrated(simulated, joints=blocks), calibrated(simulated)
    up = [simulated.model_errors_m(found.adjustment.cameras)[2] for found in (told, untold)]
    assert up[1] > 0.85
    assert up[0] < 0.75 * up[1]
    assert 1.4 < told.calibration.scales["step"] < 2.6
    assert told.calibration.prior.length_mm == 60.0


def test_the_summary_tells_steps_with_their_tests():
    rng = np.random.default_rng(5)
    simulated = simulate_pair(rng, gcps=300, ties=600, distortion_px=1.0, joint_px=1.0)
    found = calibrated(simulated, joints=[TOLD[0], Joints()], choices=replace(CHOICES, lengths_mm=(60.0,)))
    nothing = np.empty(0)
    errors = CheckErrors(nothing, nothing, nothing > 0, nothing, nothing > 0)
    told = summary(
        found, found, simulated.control, [simulated.ties], simulated.checks, errors, errors,
        pixels_mm=[PIXEL_MM] * 2, correlation_limit=0.95, **ALLOWED,
    )  # fmt: skip
    fore, aft = (image["film_steps"] for image in told["images"])
    assert aft == []
    assert [step["x_mm"] for step in fore] == list(JOINTS_MM[0])
    scale = found.calibration.scales["step"]
    for step in fore:
        # The mean of two edges that step independently.
        np.testing.assert_allclose(step["prior_sigma_mm"], scale * STEP_PX * PIXEL_MM / np.sqrt(2.0), rtol=1e-6)
        assert (np.array(step["sigma_mm"]) < step["prior_sigma_mm"]).all()
        free = np.sqrt(np.square(step["prior_sigma_mm"]) - np.square(step["sigma_mm"]))
        np.testing.assert_allclose(step["w_test"], step["step_mm"] / free)
    (group,) = (group for group in told["groups"] if group["kind"] == "step")
    assert group["count"] == 12  # two components of two edges at three joints
    assert 0.0 < group["redundancy"] < 12.0
    assert group["sigmas_scaled_by"] == scale
    assert group["w_tests"]["tested"] == 12
