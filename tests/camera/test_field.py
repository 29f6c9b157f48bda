"""The distortion of a film: its splines, its inverse, and a camera that carries it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import BSpline

from cosp.camera.derivatives import PARAMETER_NAMES, film_derivatives
from cosp.camera.field import FilmField, FilmSteps
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
from cosp.io import records
from tests.authorities.parameter_table import PIXEL_MM, pair
from tests.camera.test_derivatives import STEPS

HALF_LENGTH_MM, HALF_WIDTH_MM = 357.4, 27.7


def rough_field(rng, size_mm=0.02):
    """Splines without any relation between neighbours: steeper than film ever is."""
    flat = FilmField.flat(
        half_length_mm=HALF_LENGTH_MM, half_width_mm=HALF_WIDTH_MM, knots_along_mm=17.5, knots_across_mm=14.0
    )
    return flat.with_coefficients(rng.normal(0.0, size_mm, (*flat.shape, 2)))


def with_steps(field, rng, size_mm=0.01):
    """The field of a film whose pieces were set down by hundredths of a millimetre off."""
    steps = FilmSteps.none_at((-180.0, 3.0, 170.0), width_mm=3.0)
    return replace(field, steps=steps.with_offsets(rng.normal(0.0, size_mm, (4, 2, 2))))


@pytest.fixture
def smooth():
    return rough_field(np.random.default_rng(1))


@pytest.fixture(params=["smooth", "stepped"])
def field(smooth, request):
    return smooth if request.param == "smooth" else with_steps(smooth, np.random.default_rng(4))


@pytest.fixture
def film_mm():
    return np.random.default_rng(2).uniform(
        [-HALF_LENGTH_MM, -HALF_WIDTH_MM], [HALF_LENGTH_MM, HALF_WIDTH_MM], (500, 2)
    )


def test_the_splines_are_those_of_scipy(smooth, film_mm):
    field = smooth
    along, across = (2 * half / n for half, n in zip((HALF_LENGTH_MM, HALF_WIDTH_MM), field.intervals, strict=True))
    knots_x = along * np.arange(-3, field.intervals[0] + 4) - HALF_LENGTH_MM
    knots_y = across * np.arange(-2, field.intervals[1] + 3) - HALF_WIDTH_MM
    by_x = BSpline.design_matrix(film_mm[:, 0], knots_x, 3).toarray()
    by_y = BSpline.design_matrix(film_mm[:, 1], knots_y, 2).toarray()
    expected = np.einsum("ni,nj,ijc->nc", by_x, by_y, field.coefficients)
    assert_allclose(field.displacement(film_mm), expected, atol=1e-13)
    splines, values = field.basis(film_mm)
    assert_allclose(values.sum(1), 1.0)
    assert_allclose((values[..., None] * field.coefficients.reshape(-1, 2)[splines]).sum(1), expected, atol=1e-15)


def test_pieces_are_off_by_their_offsets_and_pass_into_each_other(smooth, film_mm):
    stepped = with_steps(smooth, np.random.default_rng(4))
    steps = stepped.steps

    def off(film):
        return stepped.displacement(film) - smooth.displacement(film)

    middle, lower = (np.array([[-181.5, y], [-178.5, y], [169.0, y]]) for y in (0.0, -HALF_WIDTH_MM))
    u = (169.0 - 170.0) / 3.0 + 0.5
    t = u**3 * (6.0 * u**2 - 15.0 * u + 10.0)
    for film, offsets in ((lower, steps.offsets[:, 0]), (middle, steps.offsets.mean(axis=1))):
        expected = [offsets[0], offsets[1], (1.0 - t) * offsets[2] + t * offsets[3]]
        assert_allclose(off(film), expected, atol=1e-13)
    # Beyond the edges across and the ends along they keep their values.
    assert_allclose(off(np.array([[400.0, -40.0]])), [steps.offsets[3, 0]], atol=1e-13)
    functions, values = stepped.basis(film_mm)
    assert functions.max() < stepped.functions == len(stepped.amounts)
    assert_allclose((values[..., None] * stepped.amounts[functions]).sum(1), stepped.displacement(film_mm), atol=1e-13)
    assert stepped.with_amounts(stepped.amounts) == stepped
    assert np.abs(stepped.displacement(film_mm)).max() < stepped.largest_mm


def test_joints_nearer_than_their_passage_and_offsets_of_another_number_are_refused():
    with pytest.raises(ValueError, match="for a transition of 3"):
        FilmSteps.none_at((10.0, 12.0), width_mm=3.0)
    with pytest.raises(ValueError, match="4 offsets for 2 pieces"):
        FilmSteps((0.0,), 3.0, (0.0,) * 4)


def test_splines_are_centred_where_they_say(smooth):
    field = smooth
    x, y = field.centres_mm()
    # A spline surface whose coefficients lie on a plane is that plane.
    plane = field.with_coefficients(np.stack(np.meshgrid(0.01 * x, 0.02 * y, indexing="ij"), axis=-1))
    film = np.array([[-300.0, 20.0], [0.0, 0.0], [123.4, -27.0]])
    assert_allclose(plane.displacement(film), film * [0.01, 0.02], atol=1e-12)


def test_the_gradient_is_that_of_the_displacement(field, film_mm):
    gradient = field.gradient(film_mm)
    for k, step in enumerate(np.eye(2) * 1e-4):
        expected = (field.displacement(film_mm + step) - field.displacement(film_mm - step)) / 2e-4
        assert_allclose(gradient[..., k], expected, atol=1e-8)


def test_correcting_undoes_distorting(field, film_mm):
    assert np.abs(field.displacement(film_mm)).max() > 0.02
    assert_allclose(field.corrected(field.distorted(film_mm)), film_mm, atol=1e-6 * PIXEL_MM)


def test_beyond_the_film_the_field_keeps_its_value(field):
    edge = np.array([[HALF_LENGTH_MM, 5.0], [10.0, -HALF_WIDTH_MM]])
    assert_allclose(field.displacement(edge + [[40.0, 0.0], [0.0, -8.0]]), field.displacement(edge), atol=1e-14)
    assert_allclose(field.gradient(edge + [[40.0, 0.0], [0.0, -8.0]])[[0, 1], :, [0, 1]], 0.0)


def test_a_point_that_is_nan_stays_nan_and_leaves_the_others_alone(field):
    film = np.array([[1.0, 2.0], [np.nan, np.nan], [3.0, 4.0]])
    for change in (field.distorted, field.corrected):
        assert np.isnan(change(film)).any(axis=1).tolist() == [False, True, False]


def test_coefficients_of_another_number_are_refused(field):
    with pytest.raises(ValueError, match=r"coefficients for splines of shape \(44, 6\)"):
        replace(field, coefficients_mm=(0.0, 1.0))


@pytest.fixture
def camera(field):
    return replace(pair("1117")[1], film_field=field, imc_factor=0.012)


def test_a_camera_with_a_field_closes_within_a_millionth_of_a_pixel(camera, film_mm):
    ground = camera.locate(film_mm, 1500.0)
    assert_allclose(camera.project(ground), film_mm, atol=1e-6 * PIXEL_MM)
    # Without it the same ground lies elsewhere on the film, by the displacement.
    off = film_mm - camera.without_field().project(ground)
    assert_allclose(off, camera.film_field.displacement(camera.imaged(film_mm)), atol=1e-6 * PIXEL_MM)


def test_derivatives_with_a_field_agree_with_central_differences(camera, film_mm):
    ground = camera.locate(film_mm, np.random.default_rng(3).uniform(0.0, 5000.0, len(film_mm)))
    by_parameters, by_ground = film_derivatives(camera, ground, camera.project(ground))
    p = camera.parameters()
    for k, name in enumerate(PARAMETER_NAMES):
        step = np.eye(13)[k] * STEPS[k]
        ahead, behind = (camera.with_parameters(p + sign * step).project(ground) for sign in (1, -1))
        expected = (ahead - behind) / (2 * STEPS[k])
        assert_allclose(by_parameters[:, :, k], expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max(), err_msg=name)
    for k in range(3):
        step = np.eye(3)[k]
        expected = (camera.project(ground + step) - camera.project(ground - step)) / 2.0
        assert_allclose(by_ground[:, :, k], expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


def test_turning_the_film_turns_its_field(camera, film_mm):
    ground = camera.locate(film_mm, 800.0)
    assert_allclose(camera.turned().project(ground), -film_mm, atol=1e-9)


def test_the_field_belongs_to_the_film_not_to_the_frame(camera):
    assert camera.moved_to(LocalFrame(98.3, 44.0)).film_field == camera.film_field


def test_the_record_with_a_field_survives_its_file(camera, tmp_path):
    records.write(tmp_path / "camera.json", camera)
    assert records.read(tmp_path / "camera.json", PanoramicCamera) == camera


def test_a_record_from_before_there_were_fields_is_read(camera, tmp_path):
    plain = records.as_plain(camera)
    del plain["film_field"]
    assert records.from_plain(plain, PanoramicCamera, "here").film_field is None
