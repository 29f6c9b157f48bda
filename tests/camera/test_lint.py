"""The linter: silent about cameras that can be, one sentence for each fault put in."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.camera.lint import faults, image_motion_mm
from cosp.camera.opticalbar import optical_bar_from_panoramic
from cosp.geometry.grids import PixelGrid
from tests.authorities.parameter_table import pair
from tests.authorities.test_image_motion import drift_mm_per_scan, predicted
from tests.camera.test_opticalbar import AFT, FORE

GRID = PixelGrid(-357.3, 27.6, 0.07, -0.07, (790, 10200))
# The documented sample with what is wrong in it put right: the sign of the compensation, the time of the scan.
MENDED = replace(AFT, motion_compensation_factor=-1.0, scan_time_s=0.378)


NEWER = optical_bar_from_panoramic(replace(pair("1117")[0], imc_factor=0.0), GRID, heights_m=(0.0, 3000.0))


@pytest.mark.parametrize("name", ["1112", "1117"])
@pytest.mark.parametrize("member", [0, 1])
def test_cameras_of_published_adjustments_have_no_fault(name, member):
    bar = optical_bar_from_panoramic(pair(name)[member], GRID, heights_m=(0.0, 3000.0))
    assert faults(bar) == []


@pytest.mark.parametrize("name", ["KH-4A", "KH-4B"])
@pytest.mark.parametrize("look", ["fore", "aft"])
@pytest.mark.parametrize("direction", [1, -1])
def test_predicted_cameras_have_no_fault_whichever_way_they_scan(name, look, direction):
    camera = replace(predicted(name, look), scan_direction=direction)
    assert faults(optical_bar_from_panoramic(camera, GRID, heights_m=(0.0, 3000.0))) == []


def test_the_mended_sample_has_no_fault():
    assert faults(MENDED) == []


def test_the_documented_sample_has_the_wrong_sign_and_the_wrong_time():
    found = faults(AFT)
    assert len(found) == 2
    assert "145 degrees a second" in found[0]
    assert "0.379 s" in found[0]
    assert "motion_compensation_factor has the wrong sign" in found[1]


def test_the_documented_sample_at_an_eighth_keeps_the_pitch_of_the_whole():
    along, across = faults(replace(FORE, pitch_m=7e-6))[:2]
    assert "scan of 9.0 degrees" in along
    assert "pitch of about 5.5e-05 m" in along
    assert "7.2 mm across the film" in across


@pytest.mark.parametrize(
    ("bar", "said"),
    [
        (replace(MENDED, motion_compensation_factor=0.014), "0.014 is as good as none"),
        (replace(MENDED, motion_compensation_factor=-2.0), "compensated more than once"),
        (replace(MENDED, forward_tilt_rad=0.2618), "forward_tilt does not go with iR"),
        (replace(MENDED, focal_length_m=0.304), "f is 0.304 m"),
        (
            replace(MENDED, image_center_px=(6828.0, 3952.0)),
            "image_center 6828 is far from the middle of 110507 columns",
        ),
        (replace(MENDED, position_m=(0.0, 0.0, 7.4e6)), "above the ellipsoid"),
        (replace(MENDED, rotation=(*MENDED.rotation[:8], 0.29865750042675621)), "iR is not a rotation"),
        (replace(MENDED, speed_m_per_s=0.0), "speed is zero"),
        (replace(NEWER, scan_direction="left"), "scan_dir is left"),
        (replace(NEWER, velocity_m=(0.0, 0.0, 0.0)), "velocity is 0 0 0"),
        (
            replace(NEWER, motion_compensation_factor=0.0),
            "motion_compensation_factor is zero: bundle_adjust solves for a factor",
        ),
        (replace(NEWER, motion_compensation_factor=0.015), "compensat"),
        (replace(NEWER, final_pose=None), "final_pose is missing"),
    ],
)
def test_a_fault_is_said(bar, said):
    assert any(said in sentence for sentence in faults(bar))


def test_a_camera_that_nods_the_wrong_way_is_found():
    camera = pair("1117")[0]
    omega, phi, kappa = camera.angles_change_deg
    bar = optical_bar_from_panoramic(
        replace(camera, angles_change_deg=(-omega, phi, kappa)), GRID, heights_m=(0.0, 3000.0)
    )
    assert [sentence.split(":")[0] for sentence in faults(bar)] == ["final_pose turns the camera the wrong way"]


@pytest.mark.parametrize("name", ["KH-4A", "KH-4B"])
def test_flight_nodding_and_lens_add_up_to_the_drift_of_the_smear_test(name):
    camera = predicted(name)
    parts = np.array(image_motion_mm(camera))
    assert_allclose(parts.sum(), drift_mm_per_scan(camera), atol=0.01)
    assert abs(parts[0]) > 7.0
    # One of the two compensates, as the mission has it.
    assert (np.abs(parts[1:]) > 5.0).tolist() == [name == "KH-4B", name == "KH-4A"]
