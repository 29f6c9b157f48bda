"""Claims about slope, aspect and stable terrain."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from cosp.dem.terrain import aspect_deg, slope_deg, stable_terrain
from cosp.geometry.grids import PixelGrid

GRID = PixelGrid(15.0, -15.0, 30.0, -30.0, (20, 25))


def test_a_plane_has_the_slope_and_aspect_of_its_gradient_everywhere():
    xy = GRID.centres()
    falls_to_the_north_east = 1000 - 0.3 * xy[..., 0] - 0.3 * xy[..., 1]
    assert_allclose(slope_deg(falls_to_the_north_east, 30, -30), np.degrees(np.arctan(np.hypot(0.3, 0.3))), rtol=1e-4)
    assert_allclose(aspect_deg(falls_to_the_north_east, 30, -30), 45, atol=0.01)
    assert_allclose(aspect_deg(1000 + 0.2 * xy[..., 1], 30, -30), 180, atol=0.01)
    assert_allclose(aspect_deg(1000 + 0.2 * xy[..., 0], 30, -30), 270, atol=0.01)


def test_stable_terrain_is_known_moderate_and_outside_of_the_polygons():
    slope = np.array([[10.0, 10.0, 50.0, np.nan]])
    unstable = np.array([[False, True, False, False]])
    assert stable_terrain(slope, unstable, slope_limit_deg=40).tolist() == [[True, False, False, False]]
    assert stable_terrain(slope, None, slope_limit_deg=40).tolist() == [[True, True, False, False]]
