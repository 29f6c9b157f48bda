import numpy as np
import pytest

from cosp.geometry.grids import PixelGrid
from cosp.geometry.lattices import smooth_on_grid

GRID = PixelGrid(1000.0, 5000.0, 10.0, -10.0, (41, 67))


def test_cubics_come_back_exactly():
    def cubic(xy):
        x, y = xy[..., 0] / 1000.0, xy[..., 1] / 1000.0
        return np.stack([x**3 - 2 * x * y**3 + 4, y**2 - x], axis=-1)

    found = smooth_on_grid(cubic, GRID)
    assert found.shape == (2, 41, 67)
    np.testing.assert_allclose(found, np.moveaxis(cubic(GRID.centres()), -1, 0), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(("degree", "bound"), [(2, 8e-3), (3, 8e-4), (5, 4e-6)])
def test_smooth_functions_come_back_better_with_the_degree(degree, bound):
    def wave(xy):
        return np.sin(xy[..., :1] / 600.0) * np.cos(xy[..., 1:] / 700.0)

    error = np.abs(smooth_on_grid(wave, GRID, degree)[0] - wave(GRID.centres())[..., 0]).max()
    assert bound / 1000 < error < bound


def test_a_grid_of_one_pixel_has_the_value_of_its_middle():
    found = smooth_on_grid(lambda xy: xy, PixelGrid(3.0, 7.0, 1.0, -1.0, (1, 1)))
    np.testing.assert_allclose(found[:, 0, 0], [3.0, 7.0])
