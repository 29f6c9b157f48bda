import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from cosp.geometry.grids import PixelGrid
from cosp.geometry.lattices import between_nodes, smooth_on_grid

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


@pytest.mark.parametrize("shape", [(6, 5), (2, 2), (1, 4), (3, 1)])
def test_values_are_bilinear_and_go_on_beyond_the_edge(shape):
    rng = np.random.default_rng(2)
    values = rng.normal(0, 3, shape)
    first, size = (-1.5, -1.5), (40, 57)
    step = tuple((n + 2.0) / (k - 1) for n, k in zip(shape, size, strict=True))
    places = [a + s * np.arange(k) for a, s, k in zip(first, step, size, strict=True)]
    # A single row or column of nodes is what two equal ones are.
    whole = np.repeat(np.repeat(values, 2 if shape[0] == 1 else 1, axis=0), 2 if shape[1] == 1 else 1, axis=1)
    plain = RegularGridInterpolator([np.arange(n) for n in whole.shape], whole)
    inside = [np.clip(a, 0, n - 1) for a, n in zip(places, shape, strict=True)]
    expected = plain(np.stack(np.meshgrid(*inside, indexing="ij"), axis=-1))
    np.testing.assert_allclose(between_nodes(values, first, step, size), expected, atol=1e-5)


@pytest.mark.parametrize("first", [(-7.0, -9.0), (11.0, 12.0), (3.0, 4.0)])
def test_all_of_a_picture_may_lie_beyond_the_nodes(first):
    values = np.arange(20.0).reshape(4, 5)
    found = between_nodes(values, first, (0.1, 0.2), (3, 4))
    np.testing.assert_allclose(found, values[0, 0] if first[0] < 0 else values[-1, -1])


def test_a_part_is_that_of_the_whole_and_missing_nodes_are_missing_about_them():
    values = np.random.default_rng(3).normal(0, 1, (9, 9))
    values[4, 4] = np.nan
    whole = between_nodes(values, (0.0, 0.0), (0.25, 0.25), (33, 33))
    part = between_nodes(values, (5.0, 2.5), (0.25, 0.25), (13, 20))
    np.testing.assert_allclose(part, whole[20:, 10:30], atol=1e-6)
    assert np.isnan(whole[14:19, 14:19]).all()
    assert np.isfinite(whole[:12]).all()
