import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.camera.missions import mission_for
from cosp.camera.prediction import Corners, block_origin, predict_camera
from tests.authorities.parameter_table import TABLE, pair

HALF_LENGTH_MM, HALF_WIDTH_MM = 357.4, 27.7
FILM_CORNERS = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * [HALF_LENGTH_MM, HALF_WIDTH_MM]


def corners_of(camera, film=FILM_CORNERS):
    return Corners(*(tuple(corner) for corner in camera.locate_geodetic(film, 0.0)[:, :2].tolist()))


def predict(corners, *, camera="KH-4B", look="fore", descending=True):
    return predict_camera(
        "DS1117-2071DF008",
        corners,
        mission=mission_for(camera),
        look=look,
        descending=descending,
        half_length_mm=HALF_LENGTH_MM,
        half_width_mm=HALF_WIDTH_MM,
    )


def ground_distance_m(camera, lonlat, film):
    lonlath = np.column_stack([lonlat, np.zeros(len(lonlat))])
    return np.linalg.norm((camera.locate(film, 0.0) - camera.origin.local_from_geodetic(lonlath))[:, :2], axis=1)


@pytest.mark.parametrize("name", ["1112", "1117"])
@pytest.mark.parametrize("look", ["fore", "aft"])
def test_true_corners_give_the_papers_camera_back_within_its_nominal_motion(name, look):
    truth = pair(name)[["fore", "aft"].index(look)]
    camera = predict(corners_of(truth), look=look)
    truth = truth.moved_to(camera.origin)
    # Velocity and rates are nominal, so the ends of the film may be off by what they differ from the true ones.
    assert ground_distance_m(camera, corners_of(truth).lonlat(), FILM_CORNERS).max() < 2000.0
    assert_allclose(camera.position_m[:2], truth.position_m[:2], atol=6000.0)
    assert_allclose(camera.position_m[2], truth.position_m[2], atol=4000.0)
    assert_allclose(camera.angles_deg, truth.angles_deg, atol=2.0)
    assert_allclose(camera.angles_change_deg, truth.angles_change_deg, atol=0.5)
    assert_allclose(camera.position_change_m, truth.position_change_m, atol=1300.0)
    assert camera.scan_direction == truth.scan_direction


def test_a_camera_flies_along_its_heading_and_looks_fore_or_aft():
    north, south = (98.0, 45.0), (98.0, 44.85)
    corners = Corners(nw=(96.6, north[1]), ne=(99.4, north[1]), se=(99.4, south[1]), sw=(96.6, south[1]))
    for descending in (True, False):
        for look in ("fore", "aft"):
            camera = predict(corners, look=look, descending=descending)
            heading = -1.0 if descending else 1.0
            assert np.sign(camera.position_change_m[1]) == heading
            # The fore camera has not yet reached what it sees.
            behind = -heading if look == "fore" else heading
            assert_allclose(
                camera.position_m[1], behind * camera.position_m[2] * math.tan(math.radians(15)), atol=2500.0
            )


def test_an_ascending_pass_sees_the_same_corners_on_a_turned_film():
    truth = pair("1117")[0]
    corners = corners_of(truth)
    camera = predict(corners, look="aft", descending=False)
    assert ground_distance_m(camera, corners.lonlat(), -FILM_CORNERS).max() < 3000.0
    assert abs(camera.angles_deg[2]) > 160.0


@pytest.mark.parametrize(("name", "has_lens"), [("KH-4", True), ("KH-4A", True), ("KH-4B", False)])
def test_the_mission_decides_how_image_motion_is_compensated(name, has_lens):
    camera = predict(corners_of(pair("1112")[0]), camera=name)
    expected = 2770.0 / (camera.position_m[2] * math.radians(70.0))
    assert_allclose(camera.imc_factor, expected if has_lens else 0.0, atol=2e-4)
    pitch_rate_deg = math.degrees(2770.0 * math.cos(math.radians(15)) ** 2 / camera.position_m[2])
    assert_allclose(camera.angles_change_deg[0], 0.0 if has_lens else pitch_rate_deg, atol=0.02)


def test_corners_shrunken_beyond_belief_do_not_drag_the_height_along():
    truth = pair("1112")[0]
    lonlat = corners_of(truth).lonlat()
    shrunken = lonlat.mean(0) + 0.5 * (lonlat - lonlat.mean(0))
    camera = predict(Corners(*(tuple(corner) for corner in shrunken.tolist())))
    assert 120_000.0 <= camera.position_m[2] < 187_000.0


def test_corners_across_the_date_line_are_one_scene():
    corners = Corners(nw=(178.9, 60.2), ne=(-177.9, 60.2), se=(-177.9, 60.0), sw=(178.9, 60.0))
    origin = block_origin([corners])
    assert abs(abs(origin.longitude_deg) - 179.5) < 1e-6
    camera = predict(corners)
    assert ground_distance_m(camera, corners.lonlat(), FILM_CORNERS).max() < 30_000.0


def test_the_block_origin_is_the_middle_of_all_corners():
    fore, aft = (corners_of(camera) for camera in pair("1112"))
    origin = block_origin([fore, aft])
    assert_allclose(origin.latitude_deg, np.mean([TABLE[scene][1] for scene in list(TABLE)[:2]]), atol=0.1)
