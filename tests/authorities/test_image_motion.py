"""Smear test: with the right sign, image motion compensation holds a ground point still on the moving film."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cosp.camera.missions import mission_for
from cosp.camera.panoramic import PanoramicCamera
from cosp.camera.prediction import Corners, predict_camera

CORNERS = Corners(nw=(97.0, 44.2), ne=(99.3, 44.2), se=(99.3, 44.0), sw=(97.0, 44.0))


def predicted(camera, look="fore"):
    return predict_camera(
        "DS1024-1038DF096",
        CORNERS,
        mission=mission_for(camera),
        look=look,
        descending=True,
        half_length_mm=357.4,
        half_width_mm=27.7,
    )


def drift_mm_per_scan(camera: PanoramicCamera) -> float:
    """How fast a nadir-side ground point moves across the film while the slit passes it, as mm per full scan.

    The film point of fixed ground is followed through an interval of time about mid-scan: at a given time the camera
    stands still and the image motion compensation has moved by so much. Only the motion along the flight counts, for
    the slit is narrow along the scan.
    """
    ground = camera.locate(np.zeros(2), 0.0)
    step = 0.01
    y_mm = []
    for tau in (-step, step):
        p = camera.parameters()
        p[0:3] += tau * p[3:6]
        p[6:9] += tau * p[9:12]
        p[3:6] = p[9:12] = 0.0
        p[12] = 0.0
        standing = camera.with_parameters(p)
        # What the moved lens adds at this time, whatever part of the film the point is on: y_imc(tau).
        alpha = tau * camera.scan_length_mm / camera.focal_length_mm
        motion = camera.imc_factor * camera.focal_length_mm * math.sin(alpha) * math.cos(p[6])
        y_mm.append(standing.project(ground)[1] - motion)
    return (y_mm[1] - y_mm[0]) / (2 * step)


@pytest.mark.parametrize("look", ["fore", "aft"])
@pytest.mark.parametrize("name", ["KH-4A", "KH-4B"])
def test_the_mission_compensates_the_motion_of_the_image(name, look):
    camera = predicted(name, look)
    p = camera.parameters()
    p[9:13] = 0.0
    uncompensated = abs(drift_mm_per_scan(camera.with_parameters(p)))
    assert 7.0 < uncompensated < 12.0
    assert abs(drift_mm_per_scan(camera)) < 0.1 * uncompensated


def test_the_opposite_sign_of_the_lens_motion_doubles_the_smear():
    camera = predicted("KH-4A")
    p = camera.parameters()
    p[12] = 0.0
    uncompensated = abs(drift_mm_per_scan(camera.with_parameters(p)))
    wrong = abs(drift_mm_per_scan(replace(camera, imc_factor=-camera.imc_factor)))
    assert 1.8 * uncompensated < wrong < 2.2 * uncompensated


def test_the_camera_moves_the_image_as_the_scan_angle_says_in_both_scan_directions():
    # The camera's own image motion is a function of x; over time it must not depend on the scan direction.
    camera = predicted("KH-4A")
    for direction in (1, -1):
        turned = replace(camera, scan_direction=direction)
        x_at_quarter_scan = direction * 0.25 * camera.scan_length_mm
        assert turned.image_motion_mm(np.array(x_at_quarter_scan)) > 0
