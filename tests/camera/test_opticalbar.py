"""Sample cameras of the Ames Stereo Pipeline's documentation, and its equations written down a second time."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation, Slerp

from cosp.camera.opticalbar import (
    OpticalBar,
    optical_bar_from_panoramic,
    panoramic_from_optical_bar,
    residuals_mm,
)
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from tests.authorities.parameter_table import PIXEL_MM, film_points, pair

# Aft camera of mission 1105 from the page on camera formats; fore camera DS1105-2248DF076 at 1/8 scale, with the pitch
# that belongs to that scale.
AFT = OpticalBar(
    image_size_px=(110507, 7904),
    image_center_px=(55253.5, 3952.0),
    pitch_m=7e-6,
    focal_length_m=0.61000001430511475,
    scan_direction="left",
    position_m=(-1047140.9611702315, 5508464.4323527571, 3340425.4078937685),
    rotation=(
        *(-0.96635634448923746, -0.16918164442572045, 0.1937343197650008),
        *(-0.23427205529446918, 0.26804084264169648, -0.93448954557235941),
        *(0.10616976770014927, -0.94843643849513648, -0.29865750042675621),
    ),
    motion_compensation_factor=1.0,
    scan_time_s=0.5,
    forward_tilt_rad=-0.261799,
    speed_m_per_s=7700.0,
    mean_surface_elevation_m=4000.0,
)
FORE = OpticalBar(
    image_size_px=(13656, 1033),
    image_center_px=(6828.0, 517.0),
    pitch_m=5.6e-5,
    focal_length_m=0.61000001430511475,
    scan_direction="right",
    position_m=(-1030862.1946224371, 5468503.8842079658, 3407902.5154047827),
    rotation=(
        *(-0.95700845635275322, -0.27527006183758934, 0.091439638698163225),
        *(-0.26345593052063937, 0.69302501329766897, -0.67104940475144637),
        *(0.1213498543172795, -0.66629027007731101, -0.73575232847574434),
    ),
    motion_compensation_factor=1.0,
    scan_time_s=0.5,
    forward_tilt_rad=0.2618,
    speed_m_per_s=7700.0,
    mean_surface_elevation_m=4000.0,
)
HEIGHT_M = 4000.0
# Longitude and latitude of the pixels upper left, upper right, lower right, lower left and of the middle, from the
# program's own equations at 4000 m above the ellipsoid.
CORNERS = {
    "aft": [
        (99.54032, 31.17520),
        (101.95272, 31.50546),
        (101.93835, 31.33738),
        (99.59666, 31.01991),
        (100.74000, 31.25966),
    ],
    "fore": [
        (99.55976, 31.22045),
        (101.88410, 31.43936),
        (101.95212, 31.27309),
        (99.55034, 31.04589),
        (100.73446, 31.25419),
    ],
}
IMAGE_MOTION_AT_EDGES_MM = {"aft": (7.226, -7.231), "fore": (-7.306, 7.302)}
SAMPLES = {"aft": AFT, "fore": FORE}
ORIGIN = LocalFrame(100.7, 31.3)
# Off its centre by 40 px.
GRID = PixelGrid(-357.3, 27.699, PIXEL_MM, -PIXEL_MM, (7915, 102180))


def pixels_of(bar):
    width, height = bar.image_size_px
    right, low = width - 1.0, height - 1.0
    return np.array([[0, 0], [right, 0], [right, low], [0, low], [right / 2, low / 2]])


def newer_form_ray(bar, pixel):
    """Origin and direction in Earth-centred axes, by the program's equations of the newer form."""
    x, y = (np.asarray(pixel) - bar.image_center_px) * bar.pitch_m
    time = pixel[0] / (bar.image_size_px[0] - 1)
    alpha = x / bar.focal_length_m
    motion = bar.focal_length_m * np.sin(alpha) * bar.motion_compensation_factor
    in_camera = np.array([bar.focal_length_m * np.sin(alpha), y + motion, bar.focal_length_m * np.cos(alpha)])
    turns = Rotation.concatenate(
        [Rotation.from_matrix(np.reshape(bar.rotation, (3, 3))), Rotation.from_rotvec(bar.final_pose)]
    )
    direction = Slerp([0.0, 1.0], turns)(time).as_matrix() @ in_camera
    return np.array(bar.position_m) + time * np.array(bar.velocity_m), direction / np.linalg.norm(direction)


@pytest.mark.parametrize("look", ["fore", "aft"])
def test_the_sample_cameras_see_their_expected_corners(look):
    bar = SAMPLES[look]
    camera = panoramic_from_optical_bar(bar, look, ORIGIN)
    found = camera.locate_geodetic(bar.film_mm(pixels_of(bar)), HEIGHT_M)[:, :2]
    # A few units of the last printed digit; their height above ground drifts by 50 m within the scan, which moves the
    # compensated ends by a metre.
    assert_allclose(found, CORNERS[look], atol=3e-5)


@pytest.mark.parametrize("look", ["fore", "aft"])
def test_image_motion_at_the_ends_of_the_samples(look):
    bar = SAMPLES[look]
    camera = panoramic_from_optical_bar(bar, look, ORIGIN)
    ends_mm = bar.film_mm(pixels_of(bar))[[0, 1], 0]
    # Their y runs down the rows.
    assert_allclose(-camera.image_motion_mm(ends_mm), IMAGE_MOTION_AT_EDGES_MM[look], atol=0.004)


@pytest.mark.parametrize("look", ["fore", "aft"])
def test_the_samples_move_the_image_the_wrong_way(look):
    # Their factor of +1 doubles the smear; the physical sign is positive in our form whatever the scan direction.
    assert panoramic_from_optical_bar(SAMPLES[look], look, ORIGIN).imc_factor < -0.015


@pytest.mark.parametrize("look", ["fore", "aft"])
def test_rays_of_the_sample_cameras_pass_through_their_expected_corners(look):
    bar = SAMPLES[look]
    rays = bar.rays(pixels_of(bar), ORIGIN)
    corners = np.column_stack([CORNERS[look], np.full(5, HEIGHT_M)])
    found = rays.at(((ORIGIN.local_from_geodetic(corners) - rays.origin) * rays.direction).sum(-1))
    # Five decimals of a degree are printed, which is half a metre.
    assert_allclose(ORIGIN.geodetic_from_local(found)[:, :2], CORNERS[look], atol=1e-5)


@pytest.mark.parametrize("imc_factor", [0.0, 0.014])
@pytest.mark.parametrize("member", [0, 1])
def test_the_newer_form_of_a_panoramic_camera_sees_the_same_ground(member, imc_factor):
    camera = replace(pair("1117")[member], imc_factor=imc_factor)
    bar = optical_bar_from_panoramic(camera, GRID, heights_m=(0.0, 4000.0))
    rng = np.random.default_rng(4)
    pixels = rng.uniform(0, 1, (40, 2)) * [GRID.shape[1] - 1, GRID.shape[0] - 1]
    film = bar.film_mm(pixels)
    assert_allclose(film, GRID.points(pixels[:, 1], pixels[:, 0]), atol=1e-9)
    for height_m in (0.0, 1700.0, 4000.0):
        ground = camera.locate(film, height_m)
        seen = residuals_mm(bar, camera, film, ground)
        # Turning about one axis instead of three differs by up to a pixel, of which the fit leaves a tenth.
        assert 0.001 < np.abs(seen).max() / PIXEL_MM < 0.15
        for pixel, point in zip(pixels[:5], ground, strict=False):
            origin, direction = newer_form_ray(bar, pixel)
            away = camera.origin.ecef_from_local(point) - origin
            missed_m = np.linalg.norm(away - (away @ direction) * direction)
            assert missed_m < 0.5  # a pixel shows two metres and more


@pytest.mark.parametrize("member", [0, 1])
def test_there_and_back_sees_the_same_ground(member):
    camera = replace(pair("1112")[member], imc_factor=0.014)
    bar = optical_bar_from_panoramic(camera, GRID, heights_m=(0.0, 3000.0))
    back = panoramic_from_optical_bar(bar, camera.scene, camera.origin)
    film = film_points(357.0, 27.0)
    assert_allclose(back.project(camera.locate(film, 1500.0)), film, atol=0.8 * PIXEL_MM)
