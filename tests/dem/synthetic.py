"""Two models of one rough ground, one of them moved."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from cosp.geometry.grids import PixelGrid

CRS = "EPSG:32632"
GRID = PixelGrid(600_015.0, 5_209_985.0, 30.0, -30.0, (300, 320))
_MARGIN = 20


def ground(rng, *, relief_m=250.0, grain_cells=14.0):
    """Rough ground on the grid with a margin around."""
    shape = tuple(n + 2 * _MARGIN for n in GRID.shape)
    rough = gaussian_filter(rng.standard_normal(shape), grain_cells)
    return 2000 + relief_m * rough / rough.std()


def reference(rough):
    return rough[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN].astype(np.float32)


def moved(rough, displacement_m):
    """The model that a displacement (R, C, 3) or (3,), in metres east, north, up, brings onto the reference.

    Exact where the displacement is constant; for changes of 1e-3 the error is a thousandth of the displacement.
    """
    displacement_m = np.broadcast_to(displacement_m, (*GRID.shape, 3))
    rows, columns = np.meshgrid(*(np.arange(n) for n in GRID.shape), indexing="ij")
    at = [
        rows + _MARGIN + displacement_m[..., 1] / GRID.step_y,
        columns + _MARGIN + displacement_m[..., 0] / GRID.step_x,
    ]
    return (map_coordinates(rough, at, order=3) - displacement_m[..., 2]).astype(np.float32)
