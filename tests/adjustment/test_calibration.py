"""Film fields: found where they are, silent where nothing tells of them, and honest about how well they are known."""

from dataclasses import replace

import numpy as np
import pytest

from cosp.adjustment import fieldprior
from cosp.adjustment.blocks import orient_block
from cosp.adjustment.calibration import CELL_MM, FieldChoices, _cell_sums, calibrate, unmodelled_mm
from cosp.adjustment.observations import FIELD_PRIORS, HeightReference, orbit_coupling
from cosp.adjustment.posterior import HeightSigma, height_sigma
from cosp.adjustment.rows import Rows, height_rows, intersections
from cosp.camera.field import FilmField
from cosp.geometry.rays import meet
from tests.adjustment.simulated import (
    HALF_LENGTH_MM,
    HEIGHT_M,
    conjugates,
    on_terrain,
    simulate_pair,
    terrain_m,
)
from tests.authorities.parameter_table import PIXEL_MM

CHOICES = FieldChoices(knots_along_mm=17.5, knots_across_mm=14.0, lengths_mm=(40.0, 60.0))


def reference(simulated, noise_m=HEIGHT_M, seed=5):
    """The terrain with white noise in cells of 300 m."""
    origin = simulated.cameras[0].origin
    noise = np.random.default_rng(seed).normal(0.0, noise_m, (1200, 1200))

    def heights_at(lonlat):
        local = origin.local_from_geodetic(np.column_stack([lonlat, np.full(len(lonlat), 1500.0)]))
        cells = np.floor(local[:, :2] / 300.0).astype(int) % 1200
        return terrain_m(local) + noise[cells[:, 0], cells[:, 1]]

    return HeightReference(heights_at, sigma_m=HEIGHT_M, sigma_horizontal_m=0.0, largest_slope_deg=40.0)


def calibrated(simulated, choices=CHOICES, **more):
    options = {"film_distortion_mm": 0.010, "tie_distortion_mm": 0.005, "gate_sigma": 4.0} | more
    return orient_block(
        simulated.start(),
        simulated.control,
        [simulated.ties],
        field=choices,
        reference=reference(simulated),
        **options,
    )


@pytest.fixture(scope="module")
def distorted():
    return simulate_pair(np.random.default_rng(1), gcps=2000, ties=4000, distortion_px=1.5)


@pytest.fixture(scope="module")
def block(distorted):
    return calibrated(distorted)


def test_heights_are_right_where_the_plain_model_is_metres_off(distorted, block):
    plain = distorted.model_errors_m(block.plain.cameras)
    east, north, up = distorted.model_errors_m(block.adjustment.cameras)
    assert 3.0 < plain[2] < 8.0
    assert max(east, north) < 1.0
    assert up < 1.0


def test_the_prior_that_is_learned_is_the_one_the_films_were_made_with(block):
    prior = block.calibration.prior
    assert prior.length_mm == 60.0
    assert 0.7 < prior.amplitude_mm / (1.5 * PIXEL_MM) < 1.5
    assert all(0.9 < scale < 1.1 for scale in block.calibration.scales.values())


def test_rays_meet(distorted, block):
    first, second, _ = conjugates(distorted.cameras, np.random.default_rng(7), 1000)
    rays = [
        camera.rays(film + distortion(film))
        for camera, film, distortion in zip(
            block.adjustment.cameras, (first, second), distorted.distortions, strict=True
        )
    ]
    _, gap_m = meet(*rays)
    # A gap of a metre across rays of 200 km is 3 um of film, shared by two films.
    gap_px = gap_m / 200e3 * 609.6 / PIXEL_MM / np.sqrt(2.0)
    assert np.sqrt(np.mean(gap_px**2)) < 0.35


@pytest.mark.slow
def test_standard_deviations_of_heights_say_how_large_the_errors_are():
    standardised = []
    for seed, gcps in ((11, 1000), (12, 300), (13, 1000), (14, 300)):
        simulated = simulate_pair(np.random.default_rng(seed), gcps=gcps, ties=2000, distortion_px=1.5)
        found = calibrated(simulated)
        standardised.append(standardised_heights(simulated, found))
    assert 0.8 < np.sqrt(np.mean(np.concatenate(standardised) ** 2)) < 1.25


def standardised_heights(simulated, found):
    """Errors of heights at noise-free points, divided by their standard deviations."""
    cameras = found.adjustment.cameras
    sigma = height_sigma(
        cameras,
        0,
        1,
        covariance=found.adjustment.covariance,
        calibration=found.calibration,
        film_sigma_mm=0.0,
        height_m=1500.0,
        step_mm=10.0,
    )
    first, second, ground = conjugates(simulated.cameras, np.random.default_rng(8), 2000)
    measured = [
        film + distortion(film) for film, distortion in zip((first, second), simulated.distortions, strict=True)
    ]
    intersected, _ = meet(*(camera.rays(film) for camera, film in zip(cameras, measured, strict=True)))
    return (intersected - ground)[:, 2] / sigma.at(measured[0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 6])
def test_nothing_runs_away_where_there_is_no_control(seed):
    simulated = simulate_pair(np.random.default_rng(seed), gcps=2000, ties=4000, distortion_px=1.5)
    # Two fifths of both films, in the middle.
    gap = 0.4 * HALF_LENGTH_MM
    control = [part_of(points, np.abs(points.film_mm[:, 0]) > gap) for points in simulated.control]
    found = calibrated(replace(simulated, control=control))
    first, second, ground = conjugates(simulated.cameras, np.random.default_rng(8), 3000)
    measured = [
        film + distortion(film) for film, distortion in zip((first, second), simulated.distortions, strict=True)
    ]
    cameras = found.adjustment.cameras
    intersected, _ = meet(*(camera.rays(film) for camera, film in zip(cameras, measured, strict=True)))
    inside = np.abs(first[:, 0]) <= gap
    size = np.linalg.norm(intersected - ground, axis=1)
    assert 1.0 < size[inside].max() / size[~inside].max() < 3.0
    # In plan the gap is felt, for only the rays' meeting tells of it there; heights keep to the reference.
    within, beyond = (np.sqrt(((intersected - ground)[part] ** 2).mean(axis=0)) for part in (inside, ~inside))
    assert 1.5 < np.hypot(*within[:2]) / np.hypot(*beyond[:2]) < 8.0
    assert 0.4 < within[2] / beyond[2] < 1.5
    for camera, distortion in zip(cameras, simulated.distortions, strict=True):
        largest = np.abs(camera.film_field.displacement(first[inside])).max() / np.abs(distortion(first)).max()
        assert 0.1 < largest < 1.3


@pytest.mark.slow
@pytest.mark.parametrize("seed", [21, 22])
def test_heights_far_off_far_from_control_are_drawn_to_the_reference(seed):
    """Coarse films, a pixel of which is worth sixty metres of height, with control in their middle third alone."""
    simulated = simulate_pair(
        np.random.default_rng(seed), gcps=120, ties=2000, distortion_px=20.0, pixel_mm=16 * PIXEL_MM
    )
    control = [part_of(points, np.abs(points.film_mm[:, 0]) < HALF_LENGTH_MM / 3) for points in simulated.control]
    found = calibrated(replace(simulated, control=control))
    assert simulated.model_errors_m(found.plain.cameras)[2] > 100.0
    assert simulated.model_errors_m(found.adjustment.cameras)[2] < 10.0


def part_of(points, chosen):
    return replace(points, **{name: getattr(points, name)[chosen] for name in points.__dataclass_fields__})


def test_a_film_without_distortion_gets_no_field():
    simulated = simulate_pair(np.random.default_rng(3), gcps=600, ties=1500)
    found = calibrated(simulated)
    assert found.calibration.prior.amplitude_mm < 0.25 * PIXEL_MM
    assert simulated.model_errors_m(found.adjustment.cameras)[2] < 1.0


@pytest.mark.slow
def test_film_digitised_sixteen_times_as_coarsely_is_not_harmed():
    simulated = simulate_pair(np.random.default_rng(4), gcps=600, ties=1500, distortion_px=1.5, pixel_mm=16 * PIXEL_MM)
    found = calibrated(simulated)
    plain, field = (simulated.model_errors_m(each.cameras) for each in (found.plain, found.adjustment))
    assert field[2] < plain[2]
    assert (field < 1.2 * plain).all()


@pytest.mark.slow
def test_film_that_was_not_straightened_is_told_as_well_as_any_once_that_is_known():
    choices = replace(CHOICES, lengths_mm=(25.0, 40.0, 60.0, 100.0))
    standardised = []
    for seed in (1, 2):
        simulated = simulate_pair(np.random.default_rng(seed), gcps=1000, ties=4000, distortion_px=1.5, bending_mm=0.2)
        known, unknown = (calibrated(simulated, choices, bending_mm=given) for given in ((0.3, 0.3), None))
        assert simulated.model_errors_m(known.plain.cameras)[2] > 50.0
        errors = [simulated.model_errors_m(found.adjustment.cameras) for found in (known, unknown)]
        assert errors[0][2] < 0.75
        assert (errors[0] < errors[1]).all()
        # Bending is none of the smooth process, which is found as if there were none.
        assert known.calibration.prior.length_mm == 60.0
        assert 0.6 < known.calibration.prior.amplitude_mm / (1.5 * PIXEL_MM) < 1.5
        assert unknown.calibration.prior.amplitude_mm > 5.0 * 1.5 * PIXEL_MM
        standardised.append(standardised_heights(simulated, known))
    assert 0.8 < np.sqrt(np.mean(np.square(standardised))) < 1.25


def test_bending_goes_across_the_film_and_is_left_out_where_it_is_small():
    flat = FilmField.flat(half_length_mm=357.4, half_width_mm=27.7, knots_along_mm=17.5, knots_across_mm=14.0)
    joints = [fieldprior.Joints(), fieldprior.Joints((0.0,), (0.002,))]
    fields = [fieldprior.field_with_pieces(flat, own) for own in joints]
    none = fieldprior.FieldBasis.of(fields, joints, 60.0, (0.004, 0.012))
    assert (none.bends, none.steps) == (0, 2)
    basis = fieldprior.FieldBasis.of(fields, joints, 60.0, (0.3, 0.004))
    assert (basis.smooth, basis.steps) == (none.smooth, none.steps)
    bends = [pattern[:, basis.smooth : basis.smooth + basis.bends] for pattern in basis.patterns]
    assert not bends[1].any()
    film = np.array([[0.0, 0.0], [100.0, 0.0], [-200.0, 27.7], [-200.0, -27.7]])
    splines, values = flat.basis(film)
    at = (values[..., None] * bends[0][splines]).sum(axis=1) / 0.3
    covariance = at @ at.T
    np.testing.assert_allclose(np.diag(covariance), [1.0, 1.0, 1.01, 1.01], atol=0.02)
    np.testing.assert_allclose(covariance[0, 1], np.exp(-0.5), atol=0.01)
    np.testing.assert_allclose(covariance[2, 3], 0.99, atol=0.02)


def test_modes_of_the_prior_have_its_covariance():
    flat = FilmField.flat(half_length_mm=357.4, half_width_mm=27.7, knots_along_mm=17.5, knots_across_mm=14.0)
    patterns = fieldprior.modes(flat, 60.0)
    film = np.array([[0.0, 0.0], [60.0, 0.0], [0.0, 20.0], [-250.0, 10.0]])
    splines, values = flat.basis(film)
    at = (values[..., None] * patterns[splines]).sum(axis=1)
    covariance = at @ at.T
    np.testing.assert_allclose(np.diag(covariance), 1.0, atol=0.05)
    np.testing.assert_allclose(covariance[0, 1], np.exp(-0.5), atol=0.03)
    np.testing.assert_allclose(covariance[0, 2], np.exp(-0.5 * (20.0 / 40.0) ** 2), atol=0.03)


def test_the_evidence_is_that_of_the_closed_form():
    # One mode seen n times with unit noise: y ~ N(0, I + a^2 1 1').
    rng = np.random.default_rng(6)
    y = 0.02 + rng.normal(size=50)
    log = fieldprior.log_evidence(np.array([[50.0]]), np.array([y.sum()]))
    a = fieldprior.AMPLITUDES_MM
    variance = 1.0 + 50.0 * a**2
    expected = 0.5 * a**2 * y.sum() ** 2 / variance - 0.5 * np.log(variance)
    belief = 0.5 * (np.log(a / fieldprior.EXPECTED_AMPLITUDE_MM) / fieldprior.AMPLITUDE_SPREAD) ** 2
    np.testing.assert_allclose(log, expected - belief, atol=1e-12)


def test_height_equations_are_differences_of_heights(distorted):
    # Shifting one film by a known displacement must change the heights as the equations say.
    ties = replace(distorted.ties, first_mm=distorted.ties.first_mm[:50], second_mm=distorted.ties.second_mm[:50])
    ties = replace(ties, sigma_mm=ties.sigma_mm[:50])
    exact = reference(distorted, noise_m=0.0)
    cameras = list(distorted.cameras)
    rows = height_rows(intersections(cameras, ties), ties, cameras, exact)
    sigma = HEIGHT_M  # nearly: the noise of the film adds to it
    step = 0.001
    flat = FilmField.flat(half_length_mm=372.4, half_width_mm=27.7, knots_along_mm=17.5, knots_across_mm=14.0)
    for image in (0, 1):
        for axis in (0, 1):
            shift = np.zeros((*flat.shape, 2))
            shift[..., axis] = step
            moved = [
                replace(c, film_field=flat.with_coefficients(shift)) if i == image else c for i, c in enumerate(cameras)
            ]
            after = height_rows(intersections(moved, ties), ties, moved, exact)
            change = (rows.residuals - after.residuals)[:, 0] / step
            # Across the epipolar planes the ray distances' least squares are not quite the film's.
            np.testing.assert_allclose(rows.by_film[:, 0, image, axis], change, rtol=0.03, atol=4.0 / sigma)


@pytest.mark.slow
def test_frames_of_one_camera_share_what_they_have_in_common():
    simulated = [simulate_pair(np.random.default_rng(20), gcps=400, ties=10, distortion_px=1.5)]
    fore = simulated[0].cameras[0]
    common, rng = simulated[0].distortions[0], np.random.default_rng(21)
    control = []
    for count in (300, 300, 12):
        film = rng.uniform([-340, -26], [340, 26], (count, 2))
        measured = film + common(film) + rng.normal(0.0, 0.7 * PIXEL_MM, film.shape)
        part = {"sigma_mm": 0.7 * PIXEL_MM, "sigma_ground_m": 0.5, "sigma_height_m": 0.5}
        ground, nothing = on_terrain(fore, film), np.empty(0)
        points = replace(simulated[0].control[0], film_mm=measured, ground_m=ground, covariance_mm2=nothing)
        control.append(replace(points, **{name: np.full(count, value) for name, value in part.items()}))
    cameras = [replace(fore, scene=f"frame {n}") for n in range(3)]

    def errors_px(groups):
        found = calibrate(
            cameras, control, [], reference=None, priors=FIELD_PRIORS, prior_cameras=cameras, choices=CHOICES,
            gate_sigma=4.0, film_groups=groups,
        )  # fmt: skip
        film = rng.uniform([-340, -26], [340, 26], (500, 2))
        off = found.cameras[2].project(on_terrain(fore, film)) - film - common(film)
        return found.prior.share, np.sqrt(np.mean(off**2)) / PIXEL_MM

    share, with_others = errors_px([0, 0, 0])
    none, alone = errors_px(None)
    assert share > 0.5
    assert none == 0.0
    assert with_others < 0.75 * alone


def test_successive_frames_of_one_camera_move_alike():
    coupling = orbit_coupling(["DF018", "DA024", "DF017", "DF019"], [0, 1, 0, 0])
    same = np.tile(np.arange(13.0), 4)
    assert same @ coupling @ same == 0.0
    assert not coupling[13:26].any()  # the only frame of its camera
    faster = same.copy()
    faster[13 * 3 + 4] += 20.0  # the last frame, which follows the first in the list
    assert faster @ coupling @ faster == pytest.approx(1.0)
    assert np.linalg.eigvalsh(coupling).min() > -1e-9 * coupling.max()


def test_sigmas_between_their_places_are_linear():
    sigma = HeightSigma("film", np.array([0.0, 10.0]), np.array([0.0, 10.0]), np.array([[1.0, 2.0], [3.0, 4.0]]), 0.0)
    np.testing.assert_allclose(sigma.at(np.array([[5.0, 5.0], [-9.0, 0.0], [10.0, 99.0]])), [2.5, 1.0, 4.0])


def heights_of_cells(rng, common_mm, *, cells=400, points=20, noise_mm=0.01):
    """Height equations of points in cells of film, whose errors are alike by `common_mm`, with sigmas of 5 m."""
    metres_per_mm, sigma_m = 300.0, 5.0
    corner = CELL_MM * np.stack(np.divmod(np.arange(cells), 5), axis=-1)
    film = np.repeat(corner, points, axis=0) + rng.uniform(0.0, CELL_MM, (cells * points, 2))
    error_mm = np.repeat(rng.normal(0.0, common_mm, cells), points) + rng.normal(0.0, noise_mm, len(film))
    by_film = np.full((len(film), 1, 2, 2), 0.5 * metres_per_mm / sigma_m)  # four displacements: a length of one
    return Rows(
        kind="dem",
        images=(0, 1),
        residuals=(metres_per_mm * error_mm / sigma_m)[:, None],
        by_film=by_film,
        film_by_camera=np.zeros((len(film), 2, 2, 13)),
        imaged_mm=np.stack([film, film], axis=1),
    )


@pytest.mark.parametrize("common_mm", [0.0, 0.002, 0.008])
def test_what_cells_have_in_common_is_told_from_the_noise_of_their_points(common_mm):
    rows = heights_of_cells(np.random.default_rng(30), common_mm)
    found = unmodelled_mm([rows], [np.ones(len(rows.residuals))])
    # Means of twenty points have 0.0022 mm of noise, whose variance is known to a fourteenth.
    assert found == pytest.approx(common_mm, abs=0.0009)


def test_sums_over_cells_keep_the_variance_of_independent_residuals_and_show_common_ones():
    weights = np.ones(400 * 20)
    alone = heights_of_cells(np.random.default_rng(31), 0.0)
    alike = heights_of_cells(np.random.default_rng(31), 0.01)
    single = np.var(alone.residuals)
    assert np.var(_cell_sums(alone, weights)) / single == pytest.approx(1.0, abs=0.2)
    assert np.var(_cell_sums(alike, weights)) / single == pytest.approx(21.0, rel=0.2)
