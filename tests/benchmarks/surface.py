"""Speed of intersection and gridding beside plain numpy and scipy, in processor time of one core.

python tests/benchmarks/surface.py [points]
"""

from __future__ import annotations

import sys
import time

import numpy as np
from scipy.stats import binned_statistic_2d

from cosp.geometry.grids import PixelGrid
from cosp.geometry.rays import meet
from cosp.imaging.windows import Window
from cosp.surface.gridding import CellPoints, cells_of, grid_cells, grid_points
from cosp.surface.intersection import intersect_pixels
from cosp.surface.kernels import points_in_cells
from tests.surface.synthetic import camera, conjugate_pixels, film_of, ray_table

ROUNDS = 5
CHOICES = {"kernel_cells": 0.5, "gate_sigmas": 5.0, "point_sigma_m": 1.5, "points_per_independent": 9.0}


def normal_equations(first, second):
    """Ground points of two sets of rays by numpy's batched solver."""
    matrix, right = 0.0, 0.0
    for rays in (first, second):
        across = np.eye(3) - rays.direction[:, :, None] * rays.direction[:, None, :]
        matrix = matrix + across
        right = right + (across @ rays.origin[:, :, None])[:, :, 0]
    return np.linalg.solve(matrix, right[:, :, None])[:, :, 0]


def interleaved(functions):
    """Median of the processor seconds of each function, called in turns."""
    spent = {name: [] for name in functions}
    for _ in range(ROUNDS + 1):
        for name, function in functions.items():
            start = time.process_time()
            function()
            spent[name].append(time.process_time() - start)
    return {name: float(np.median(times[1:])) for name, times in spent.items()}


def intersection(count, rng):
    fore, aft = camera("fore"), camera("aft")
    tables = ray_table(fore), ray_table(aft, rows=(-54_000, 54_000), columns=(-9000, 9000))
    wide = 2048
    # As the rule has it: windows of some hundred thousand pixels, 6 km of relief.
    window = Window(20_000, 20_000 + min(count // wide, 512), -wide // 2, wide // 2)
    rows, columns = np.meshgrid(*(np.arange(n) for n in window.shape), indexing="ij")
    height_m = 3000 + 2900 * np.sin(rows / 300) * np.cos(columns / 410) + rng.normal(0, 20, window.shape)
    ground, disparity, y_parallax = conjugate_pixels(fore, aft, window, height_m)
    rows, columns = rows + window.row0, columns + window.column0
    worst = np.nanmax(np.abs(intersect_pixels(*tables, window, disparity, y_parallax)[0] - ground))
    disparity, y_parallax = disparity.astype(np.float32), y_parallax.astype(np.float32)
    few = slice(0, max(window.shape[0] // 20, 1))
    part = [
        film_of(np.stack([c + dc, r + dr], axis=-1)).reshape(-1, 2)
        for c, dc, r, dr in (
            (columns[few], 0, rows[few], 0),
            (columns[few], disparity[few], rows[few], y_parallax[few]),
        )
    ]
    times = interleaved(
        {
            "tables, compiled": lambda: intersect_pixels(*tables, window, disparity, y_parallax),
            "numpy, closed form": lambda: meet(fore.rays(part[0]), aft.rays(part[1])),
            "numpy, batched solve": lambda: normal_equations(fore.rays(part[0]), aft.rays(part[1])),
        }
    )
    for name, seconds in times.items():
        done = disparity.size if name.startswith("tables") else len(part[0])
        print(f"intersection  {name:24s} {done / seconds / 1e6:8.2f} Mpoints/s")
    print(f"intersection  largest error of the tables {worst * 1000:.3f} mm")


def gridding(count, rng):
    side = int(count**0.5)
    i, j = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    height = 1500 + 800 * np.sin(i / 300) * np.cos(j / 410) + 60 * np.sin(i / 31 + j / 43)
    east = 2.2 * j + 0.1 * height + rng.normal(0, 0.3, height.shape)
    north = -2.2 * i + 0.02 * height + rng.normal(0, 0.3, height.shape)
    points = np.stack([east, north, height + rng.normal(0, 2, height.shape)], axis=-1).reshape(-1, 3)
    bounds = (points[:, 0].min(), points[:, 1].min(), points[:, 0].max(), points[:, 1].max())
    for posting in (5.0, 10.0, 30.0):
        grid = PixelGrid.covering(bounds, posting)
        xmin, ymin, xmax, ymax = grid.bounds
        few = len(points) // 10
        bins = {
            "bins": [grid.shape[0] // 10 + 1, grid.shape[1]],
            "range": [[ymax - (ymax - ymin) / 10, ymax], [xmin, xmax]],
        }
        # As the rule has them: the intersection gives points in cells of the grid.
        in_cells = np.empty((len(points), 4), np.float32)
        points_in_cells(points, np.ones(len(points), np.float32), cells_of(grid), in_cells)
        pieces = [CellPoints(in_cells, 0, 0)]
        window = Window(0, grid.shape[0], 0, grid.shape[1])
        times = interleaved(
            {
                "robust planes, compiled": lambda window=window, pieces=pieces: grid_cells(pieces, window, **CHOICES),
                "robust planes, from x y z": lambda grid=grid: grid_points(points, grid, **CHOICES),
                "scipy mean of the cell": lambda bins=bins, few=few: binned_statistic_2d(
                    points[:few, 1], points[:few, 0], points[:few, 2], "mean", **bins
                ),
            }
        )
        for name, seconds in times.items():
            done = len(points) if name.startswith("robust") else few
            print(f"gridding {posting:3.0f} m  {name:24s} {done / seconds / 1e6:8.2f} Mpoints/s")


if __name__ == "__main__":
    asked = int(sys.argv[1]) if len(sys.argv) > 1 else 2_000_000
    generator = np.random.default_rng(0)
    intersection(asked, generator)
    gridding(asked, generator)
