"""Control that is known better in some directions than in others, and where it comes into an adjustment."""

from dataclasses import replace

import numpy as np
import pandas as pd

from cosp.adjustment.observations import PLAIN_PRIORS, Control
from cosp.adjustment.robust import resect_control
from cosp.adjustment.rows import control_rows
from scripts.adjust_bundle import WITHHELD, control_points, with_dem_control
from tests.adjustment.simulated import simulate_pair
from tests.authorities.parameter_table import PIXEL_MM


def table(film_mm, roles, source, lonlath):
    return pd.DataFrame(
        {
            "x_mm": film_mm[:, 0],
            "y_mm": film_mm[:, 1],
            **dict(zip(("longitude_deg", "latitude_deg", "height_m"), lonlath.T, strict=True)),
            "role": roles,
            "source": source,
            "sigma_px": 0.5,
            "sigma_ground_m": 3.0,
            "sigma_height_m": 4.0,
            "sigma_x_px": 8.0,
            "sigma_y_px": 2.0,
            "correlation_xy": 0.7,
        }
    )


def test_equations_have_the_covariance_that_is_said():
    simulated = simulate_pair(np.random.default_rng(1), gcps=40, ties=10)
    camera, points = simulated.cameras[0], simulated.control[0]
    said = np.array([[4.0, 1.5], [1.5, 1.0]]) * 1e-4
    without = control_rows(camera, points)
    assert np.all(without.residuals == control_rows(camera, replace(points, covariance_mm2=np.empty(0))).residuals)
    exact = replace(
        points,
        sigma_mm=np.zeros(len(points)),
        sigma_ground_m=np.zeros(len(points)),
        sigma_height_m=np.zeros(len(points)),
        covariance_mm2=np.tile(said, (len(points), 1, 1)),
    )
    off = points.film_mm - camera.project(points.ground_m)
    squares = (control_rows(camera, exact).residuals ** 2).sum(axis=1)
    np.testing.assert_allclose(squares, np.einsum("ni,ij,nj->n", off, np.linalg.inv(said), off), rtol=1e-6)


def test_points_that_are_wrong_where_they_say_so_do_not_move_the_camera():
    simulated = simulate_pair(np.random.default_rng(2), gcps=300, ties=10, distortion_px=0.0)
    start, points = simulated.start()[0], simulated.control[0]
    # Wrong by four pixels along x, each by itself too small to be called an error.
    film = points.film_mm + [4 * PIXEL_MM, 0.0]
    open_along = np.tile(np.diag([1.0, 0.0]), (len(points), 1, 1))
    other = replace(points, film_mm=film, covariance_mm2=open_along)

    def error_px(control: Control) -> float:
        found = resect_control(start, control, priors=PLAIN_PRIORS, gate_sigma=4.0)
        return float(np.abs(simulated.film_errors_px(0, found.camera)).max())

    def both(first: Control, second: Control) -> Control:
        return Control(
            *(np.concatenate([getattr(first, name), getattr(second, name)]) for name in Control.__dataclass_fields__)
        )

    alone = error_px(points)
    assert error_px(both(points, other)) < 1.1 * alone + 0.1
    assert error_px(both(points, replace(other, covariance_mm2=np.empty(0)))) > alone + 1.0


def test_control_by_elevation_models_stays_out_of_blocks_that_are_held_out():
    film = np.array([[-300.0, 0.0], [-100.0, 0.0], [100.0, 0.0], [300.0, 0.0]])
    lonlath = np.column_stack([np.linspace(95, 98, 4), np.full(4, 44.0), np.full(4, 500.0)])
    gcps = table(film, ["control", "check", "control", "check"], "match", lonlath)
    of_dems = table(film + 10.0, "control", "dem", lonlath).assign(scene="DS1")
    joined = with_dem_control(gcps, of_dems)
    assert joined.role.tolist() == ["control", "check", "control", "check", *["control", WITHHELD] * 2]
    assert with_dem_control(gcps, of_dems[:0]).equals(gcps)
    points = control_points(
        joined, simulate_pair(np.random.default_rng(1), gcps=10, ties=10).cameras[0].origin, PIXEL_MM
    )
    assert not points.covariance_mm2[:4].any()
    np.testing.assert_allclose(points.sigma_ground_m, [3.0] * 4 + [0.0] * 4)
    np.testing.assert_allclose(
        points.covariance_mm2[4:], np.tile(PIXEL_MM**2 * np.array([[64.0, 11.2], [11.2, 4.0]]), (4, 1, 1))
    )
    # The film point of such control is exact: its covariance holds all that is not known.
    assert np.all(points.sigma_mm[:4] == 0.5 * PIXEL_MM)
