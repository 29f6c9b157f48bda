"""Camera files of the Ames Stereo Pipeline, there and back."""

from dataclasses import replace

import pytest

from cosp.camera.opticalbar import optical_bar_from_panoramic
from cosp.camera.tsai import optical_bar_from_tsai, tsai_text
from cosp.errors import InputError
from tests.authorities.parameter_table import pair
from tests.camera.test_opticalbar import AFT, GRID

# The page on camera formats, as printed.
DOCUMENTED = """VERSION_4
OPTICAL_BAR
image_size = 110507 7904
image_center = 55253.5 3952
pitch = 7.0e-06
f = 0.61000001430511475
scan_time = 0.5
forward_tilt = -0.261799
iC = -1047140.9611702315 5508464.4323527571 3340425.4078937685
iR = -0.96635634448923746 -0.16918164442572045 0.1937343197650008 -0.23427205529446918 0.26804084264169648 \
-0.93448954557235941 0.10616976770014927 -0.94843643849513648 -0.29865750042675621
speed = 7700
mean_earth_radius = 6371000
mean_surface_elevation = 4000
motion_compensation_factor = 1.0
scan_dir = left
"""


def test_the_documented_file_is_read():
    assert optical_bar_from_tsai(DOCUMENTED, "aft.tsai") == AFT


@pytest.mark.parametrize("newer", [False, True])
def test_a_written_camera_is_read_back_to_the_last_digit(newer):
    bar = optical_bar_from_panoramic(pair("1117")[1], GRID, heights_m=(0.0, 3000.0)) if newer else AFT
    assert (bar.velocity_m is not None) == newer
    assert optical_bar_from_tsai(tsai_text(bar), "camera.tsai") == bar


def test_a_newer_form_without_final_pose_is_read():
    bar = replace(AFT, scan_direction="right", velocity_m=(1.0, 2.0, 3.0))
    assert optical_bar_from_tsai(tsai_text(bar), "camera.tsai") == bar


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("VERSION_4", "VERSION_3", "line 1: found 'VERSION_3', needed VERSION_4"),
        ("OPTICAL_BAR", "PINHOLE", "line 2"),
        ("pitch = 7.0e-06\nf = ", "f = 0.61\npitch = 7e-6\n# ", "line 5: found 'f = 0.61', needed pitch = one number"),
        ("speed = 7700", "speed = fast", "line 11: found 'speed = fast'"),
        ("3340425.4078937685", "", "line 9: .* needed iC = 3 numbers"),
        ("scan_dir = left", "scan_dir = up", "line 15"),
        ("scan_dir = left\n", "", "line 15: found the end of the file"),
        ("scan_dir = left", "scan_dir = left\nfinal_pose = 1 2 3", "line 16: .* needed velocity = 3 numbers"),
        ("left\n", "left\nvelocity = 1 2 3\nfinal_pose = 1 2 3\nmore = 1\n", "line 18: .* after the last line"),
    ],
)
def test_a_line_that_the_program_would_not_read_is_named(old, new, said):
    with pytest.raises(InputError, match=f"aft.tsai, {said}"):
        optical_bar_from_tsai(DOCUMENTED.replace(old, new), "aft.tsai")
