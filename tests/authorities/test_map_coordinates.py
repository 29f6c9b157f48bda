"""An adjustment in map coordinates cannot succeed: the map is bent where the Earth-fixed frame is straight."""

import numpy as np
import pytest
from pyproj import Transformer

from cosp.adjustment.observations import PLAIN_PRIORS
from cosp.adjustment.robust import resect
from cosp.geometry.frames import LocalFrame
from cosp.geometry.statistics import rms
from tests.authorities.parameter_table import PIXEL_MM, film_points, pair


def refit_residuals_px(camera, film, ground):
    found = resect(
        camera,
        film,
        ground,
        sigma_px=1.0,
        pixel_mm=PIXEL_MM,
        priors=PLAIN_PRIORS,
        gate_sigma=50.0,
        directions=(camera.scan_direction,),
    )
    return found.residuals_px


@pytest.mark.parametrize("name", ["1112", "1117"])
def test_a_refit_in_the_local_frame_is_exact_and_in_map_coordinates_is_not(name):
    camera, _ = pair(name)
    film = film_points(350.0, 27.0)
    rng = np.random.default_rng(7)
    ground = camera.locate(film, rng.uniform(0.0, 3000.0, len(film)))
    local = refit_residuals_px(camera, film, ground)
    # Priors pull by less than this; without them it is zero.
    assert np.abs(local).max() < 0.01

    to_map = Transformer.from_crs("EPSG:4326", "EPSG:32647", always_xy=True)
    lonlath = camera.origin.geodetic_from_local(ground)
    east_north = np.stack(to_map.transform(lonlath[:, 0], lonlath[:, 1]), axis=-1)
    centre = np.array(to_map.transform(camera.origin.longitude_deg, camera.origin.latitude_deg))
    in_map = np.column_stack([east_north - centre, lonlath[:, 2]])
    mapped = refit_residuals_px(camera, film, in_map)
    assert rms(mapped) > 1.0
    assert np.abs(mapped).max() > 4.0


def test_the_choice_of_the_local_frame_does_not_matter():
    camera, _ = pair("1112")
    film = film_points(350.0, 27.0)
    elsewhere = LocalFrame(camera.origin.longitude_deg + 1.0, camera.origin.latitude_deg - 0.7, 1000.0)
    moved = camera.moved_to(elsewhere)
    ground = elsewhere.local_from_geodetic(camera.locate_geodetic(film, 1500.0))
    residuals = refit_residuals_px(moved, film, ground)
    assert np.abs(residuals).max() < 0.05
