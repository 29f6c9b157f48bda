"""Mission numbers and the sizes of the format."""

import pytest

from cosp.camera.missions import camera_for, mission_for
from cosp.errors import InputError


@pytest.mark.parametrize(
    ("number", "name"),
    [(9031, "KH-4"), (9062, "KH-4"), (1001, "KH-4A"), (1052, "KH-4A"), (1101, "KH-4B"), (1117, "KH-4B")],
)
def test_first_and_last_missions(number, name):
    assert camera_for(number) == name


@pytest.mark.parametrize("number", [9030, 1053, 1100, 1118, 1201])
def test_other_missions_are_refused(number):
    with pytest.raises(InputError, match=str(number)):
        camera_for(number)


def test_the_scan_is_106395_pixels_of_seven_micrometres():
    assert mission_for("KH-4B").scan_length_mm / 0.007 == pytest.approx(106395, abs=5)
