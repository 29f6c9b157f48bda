"""The panoramic camera: inverse pairs, symmetries, the size of its motions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
from cosp.geometry.rays import meet
from cosp.io import records

PIXEL_MM = 0.007
ORIGIN = LocalFrame(96.3, 44.15)


def camera(look="fore", imc_factor=0.0025, scan_direction=1):
    sign = -1 if look == "fore" else 1
    return PanoramicCamera(
        scene="DS1112-1071DF023",
        focal_length_mm=609.6,
        half_length_mm=357.4,
        half_width_mm=27.7,
        scan_direction=scan_direction,
        origin=ORIGIN,
        position_m=(-3e3, -sign * 49e3, 187e3),
        position_change_m=(60.0, -2750.0, -41.0),
        angles_deg=(sign * 15.2, -1.5, 5.7),
        angles_change_deg=(0.83, -0.04, 0.1),
        imc_factor=imc_factor,
    )


@pytest.fixture
def film_mm():
    x, y = np.meshgrid(np.linspace(-357, 357, 31), np.linspace(-27, 27, 7))
    return np.stack([x, y], axis=-1)


@pytest.mark.parametrize("imc_factor", [0.0, 0.0145])
@pytest.mark.parametrize("scan_direction", [1, -1])
@pytest.mark.parametrize("height_m", [0.0, 6000.0])
def test_a_located_point_projects_back_to_where_it_came_from(film_mm, imc_factor, scan_direction, height_m):
    tested = camera(imc_factor=imc_factor, scan_direction=scan_direction)
    ground = tested.locate(film_mm, height_m)
    assert_allclose(tested.project(ground), film_mm, atol=1e-6 * PIXEL_MM)


def test_located_points_have_the_ellipsoidal_height_that_was_asked_for(film_mm):
    found = ORIGIN.geodetic_from_local(camera().locate(film_mm, 1500.0))
    assert_allclose(found[..., 2], 1500.0, atol=1e-5)


def test_rays_of_a_fore_and_an_aft_film_meet_in_the_point_both_see(film_mm):
    fore, aft = camera("fore"), camera("aft", scan_direction=-1)
    ground = fore.locate(film_mm, 2000.0)
    found, gap = meet(fore.rays(fore.project(ground)), aft.rays(aft.project(ground)))
    assert_allclose(found, ground, atol=1e-6)
    assert np.nanmax(gap) < 1e-6


def test_terrain_is_met_where_the_ray_enters_it():
    tested = camera()
    film = np.array([[120.0, 5.0], [-200.0, -20.0]])

    def slope(lonlat):
        return 1000.0 + 2e4 * (lonlat[..., 1] - 44.0)

    found = ORIGIN.geodetic_from_local(tested.locate_on(film, slope, iterations=30))
    assert_allclose(found[:, 2], slope(found[:, :2]), atol=0.01)


def test_a_point_behind_the_camera_or_beyond_the_sweep_is_nan():
    tested = camera()
    assert np.isnan(tested.project([0.0, 0.0, 400e3])).all()
    assert np.isnan(tested.project([300e3, 0.0, 0.0])).all()


def test_rays_about_the_format_are_those_of_the_film_and_none_far_from_it(film_mm):
    tested = camera()
    near = tested.rays_about_format(film_mm)
    assert_allclose(near.direction, tested.rays(film_mm).direction)
    assert_allclose(near.origin, tested.rays(film_mm).origin)
    beyond = [[tested.half_length_mm + 1.1, 0.0], [0.0, -tested.half_width_mm - 1.1]]
    assert np.isnan(tested.rays_about_format(beyond).direction).all()


def test_turning_the_film_changes_the_sign_of_both_coordinates(film_mm):
    tested = camera(imc_factor=0.0145)
    ground = tested.locate(film_mm, 800.0)
    assert_allclose(tested.turned().project(ground), -film_mm, atol=1e-9)


def test_another_local_frame_sees_the_same_film(film_mm):
    tested = camera()
    ground = tested.locate(film_mm, 800.0)
    near = LocalFrame(96.31, 44.16)
    moved = tested.moved_to(near).project(near.local_from_ecef(ORIGIN.ecef_from_local(ground)))
    # Angles are linear in time in one frame only; a kilometre away that is 0.01 px.
    assert_allclose(moved, film_mm, atol=0.01 * PIXEL_MM)


def test_parameters_go_in_and_out_unchanged():
    tested = camera()
    again = tested.with_parameters(tested.parameters())
    assert_allclose(again.parameters(), tested.parameters(), rtol=1e-14)


def test_the_record_survives_its_file(tmp_path):
    records.write(tmp_path / "camera.json", camera())
    assert records.read(tmp_path / "camera.json", PanoramicCamera) == camera()
