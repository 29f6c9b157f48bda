"""Displacements of a model made with wrong cameras become control that is right."""

import numpy as np

from cosp.geometry.mapping import MapFrame
from cosp.matching.dem_control import control_of_displacements

from .conftest import CRS, make_camera, moved

PIXEL_MM = 0.056
GROUND = np.array([[470e3, 5.09e6, 800.0], [500e3, 5.095e6, 1500.0], [520e3, 5.1e6, 300.0]])


def on_film(camera, map_m):
    frame = MapFrame(camera.origin, CRS, (*map_m[:, :2].min(axis=0), *map_m[:, :2].max(axis=0)))
    return camera.project(frame.local_from_map(map_m))


def test_film_and_ground_points_belong_together_whatever_the_first_camera_was_wrong_by():
    true = make_camera()
    # Both cameras of a pair stand 80 m too far east and 50 m too far south: so does the model.
    first = moved(true, 80.0, -50.0)
    frame = MapFrame(true.origin, CRS, (440e3, 5.05e6, 560e3, 5.15e6))
    there = frame.map_from_geodetic(true.origin.geodetic_from_local(first.locate(on_film(true, GROUND), GROUND[:, 2])))
    model = np.column_stack([there[:, :2], GROUND[:, 2]])
    assert np.abs(model - GROUND).max() > 70.0
    table = control_of_displacements(
        first, model, GROUND - model, np.tile(np.eye(3), (3, 1, 1)), crs=CRS, pixel_mm=PIXEL_MM
    )
    assert len(table) == 3
    ground = true.origin.local_from_geodetic(table[["longitude_deg", "latitude_deg", "height_m"]].to_numpy())
    np.testing.assert_allclose(true.project(ground), table[["x_mm", "y_mm"]], atol=2e-4)
    assert np.abs(first.project(ground) - table[["x_mm", "y_mm"]]).to_numpy().max() > 0.1


def test_what_the_relief_leaves_open_is_open_on_the_film():
    camera = make_camera()
    open_north = np.diag([9.0, 1000.0**2, 4.0])
    table = control_of_displacements(
        camera, GROUND, np.zeros((3, 3)), np.tile(open_north, (3, 1, 1)), crs=CRS, pixel_mm=PIXEL_MM
    )
    sigma = table[["sigma_x_px", "sigma_y_px"]].to_numpy() * PIXEL_MM
    covariance = sigma[:, :, None] * sigma[:, None, :]
    covariance[:, [0, 1], [1, 0]] *= table["correlation_xy"].to_numpy()[:, None]
    moves = (
        np.stack([on_film(camera, GROUND + step) - on_film(camera, GROUND - step) for step in np.eye(3)], axis=-1) / 2
    )
    # Both films are told by one displacement: half each.
    np.testing.assert_allclose(covariance, 2 * moves @ open_north @ np.swapaxes(moves, 1, 2), rtol=1e-3)
    small, large = np.linalg.eigvalsh(covariance).T
    assert (np.sqrt(large) > 50 * np.sqrt(small)).all()
    assert (table["sigma_ground_m"] > 1000.0).all()


def test_places_off_the_film_are_left_out_and_none_give_none():
    camera = make_camera()
    places = np.vstack([GROUND, [[500e3, 5.3e6, 100.0]]])
    table = control_of_displacements(
        camera, places, np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1)), crs=CRS, pixel_mm=PIXEL_MM
    )
    assert len(table) == 3
    empty = control_of_displacements(
        camera, np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3)), crs=CRS, pixel_mm=1
    )
    assert len(empty) == 0
    assert set(empty.columns) == set(table.columns)
