"""Grids: pixel centres, windows, coarser grids."""

from numpy.testing import assert_allclose

from cosp.geometry.grids import PixelGrid


def test_a_covering_grid_has_its_edges_on_multiples_of_the_posting():
    grid = PixelGrid.covering((1003.0, 2001.0, 1058.0, 2030.0), 10.0)
    assert grid.bounds == (1000.0, 2000.0, 1060.0, 2030.0)
    assert grid.shape == (3, 6)
    assert (grid.x0, grid.y0) == (1005.0, 2025.0)


def test_pixels_and_points_undo_each_other():
    grid = PixelGrid(-357.0, 27.7, 0.056, -0.056, (990, 12750))
    rows, columns = grid.pixels(grid.points([3.25, 700.0], [10.5, 12000.0]))
    assert_allclose(rows, [3.25, 700.0], atol=1e-9)
    assert_allclose(columns, [10.5, 12000.0], atol=1e-9)


def test_a_window_keeps_the_place_of_its_pixels():
    grid = PixelGrid(5.0, 50.0, 2.0, -2.0, (20, 30))
    part = grid.window(4, 8, 10, 15)
    assert part.shape == (4, 5)
    assert_allclose(part.points(0, 0), grid.points(4, 10))


def test_a_coarser_pixel_lies_in_the_middle_of_its_block():
    grid = PixelGrid(0.0, 0.0, 1.0, -1.0, (10, 10))
    coarse = grid.coarsened(4)
    assert coarse.shape == (3, 3)
    assert_allclose(coarse.points(0, 0), grid.points(1.5, 1.5))
    assert coarse.bounds[:1] == grid.bounds[:1]
