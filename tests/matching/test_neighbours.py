"""Frames of one pass: what the others say of one that cannot be placed by itself."""

from dataclasses import replace

import numpy as np
import pytest

from cosp.matching.footprint import Footprint
from cosp.matching.ground import ground_pixel_m
from cosp.matching.neighbours import PlacedFrame, expected_frame
from cosp.matching.placement import SearchLimits, shift_m, turned_about_centre

from .conftest import make_camera, moved

STEP_M = 0.925 * 2 * 27.7 * ground_pixel_m(make_camera(), 1.0, 0.0)


def frame(number, look="fore", *, turned=False):
    """Frame of a pass that flies south."""
    start = 92 if look == "fore" else 98
    camera = moved(make_camera(look), 0.0, -STEP_M * (number - start))
    camera = replace(camera, scene=f"DS1104-2169D{look[0].upper()}{number:03d}")
    footprint = Footprint(
        scene=camera.scene, camera=camera, shift_east_m=0.0, shift_north_m=0.0, turned=turned, score=20.0, margin=9.0,
        agreeing_share=1.0, residual_m=10.0, posting_m=60.0, reference="image", sun_azimuth_deg=135.0,
        corners_lonlat=((0.0, 0.0),) * 4, blocks=(),
    )  # fmt: skip
    return PlacedFrame(number, look, footprint)


def astray(camera):
    return moved(turned_about_centre(camera, np.radians(6.0), 1.02, 0.0), 60e3, -30e3)


@pytest.mark.parametrize(
    ("placed", "least_sigma_m", "largest_sigma_m"),
    [
        ([frame(91), frame(93)], 1000.0, 1500.0),
        ([frame(90), frame(91)], 1500.0, 3500.0),
        ([frame(91)], 1400.0, 3000.0),
        ([frame(98, "aft")], 5000.0, 10000.0),
        ([frame(97, "aft"), frame(99, "aft")], 5000.0, 10000.0),
    ],
)
def test_neighbours_place_a_frame_within_their_standard_deviation(placed, least_sigma_m, largest_sigma_m):
    truth = frame(92).footprint.camera
    predicted = astray(truth)
    expected = expected_frame(predicted, 92, "fore", placed)
    error = np.array(shift_m(truth, expected.camera, 0.0))
    assert np.abs(error).max() < expected.sigma_m
    assert least_sigma_m < expected.sigma_m < largest_sigma_m
    assert expected.camera.origin == predicted.origin
    assert set(expected.neighbours) <= {one.footprint.scene for one in placed}
    turned = expected.camera.locate(np.array([[100.0, 0.0]]), 0.0) - expected.camera.locate(np.zeros((1, 2)), 0.0)
    right = truth.locate(np.array([[100.0, 0.0]]), 0.0) - truth.locate(np.zeros((1, 2)), 0.0)
    assert abs(np.arctan2(turned[0, 1], turned[0, 0]) - np.arctan2(right[0, 1], right[0, 0])) < np.radians(1.5)


def test_without_neighbours_nothing_is_known():
    assert expected_frame(make_camera(), 92, "fore", []) is None


def test_films_of_one_camera_lie_alike_and_a_frame_known_by_them_alone_says_so():
    truth = frame(92).footprint.camera
    expected = expected_frame(astray(truth), 92, "fore", [frame(91, turned=True)])
    footprint = expected.footprint(astray(truth), 500.0)
    assert footprint.turned
    assert footprint.reference == "neighbours"
    assert footprint.agreeing_share == 0.0
    assert footprint.sigma_m == expected.sigma_m
    assert (footprint.sun_azimuth_deg, footprint.sun_elevation_deg) == (135.0, 35.0)
    assert abs(footprint.shift_east_m + 60e3) < 3000.0
    assert abs(footprint.shift_north_m - 30e3) < 3000.0


def test_a_smaller_window_needs_a_lower_score_for_the_same_chance():
    # Expected maxima of n independent normal values, n being the window's area.
    maxima = [np.sqrt(2 * np.log(area)) for area in (200.0**2, 20.0**2)]
    limits = SearchLimits(240.0, 30.0, float(maxima[0]), 2.0, 12, 0.3, 0.5, 300.0)
    assert limits.in_window(100.0, 10.0).min_score == pytest.approx(maxima[1])
    assert limits.in_window(100.0, 100.0) == limits
    assert limits.in_window(100.0, 1.0).min_score < maxima[1]
