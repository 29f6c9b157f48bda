"""What was measured to be left across the rows, taken out of the rectification as a smooth field."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from cosp.arrays import FloatArray
from cosp.epipolar import kernels
from cosp.epipolar.smoothing import smooth_field
from cosp.geometry.grids import PixelGrid

_RING = 12  # nodes by which a lattice is continued before its spline is found: what lies beyond counts 1e-7 there


@dataclass(frozen=True)
class RowCorrection:
    """A cubic spline over one rectified image, in millimetres so that it holds for any window of it.

    Parameters
    ----------
    row0_mm, column0_mm : float
        Row coordinate and u of node (0, 0).
    row_step_mm, column_step_mm : float
        From node to node.
    coefficients_mm : (rows + 2, columns + 2) array
        Of the nodes and of one ring about them.
    """

    row0_mm: float
    column0_mm: float
    row_step_mm: float
    column_step_mm: float
    coefficients_mm: FloatArray

    @classmethod
    def through(
        cls, values_px: FloatArray, nodes: PixelGrid, *, pixel_mm: float, row0_mm: float, column0_mm: float
    ) -> RowCorrection:
        """The spline through values at nodes of a rectified image whose first pixel and size of a pixel are given.

        Parameters
        ----------
        values_px : (rows, columns) array, at least 2 x 2
        nodes : PixelGrid
            In pixels of the image.
        """
        # Continued with its slope at the edges; a spline that is mirrored there would be level.
        continued = np.pad(values_px * pixel_mm, _RING, mode="reflect", reflect_type="odd")
        spline = ndimage.spline_filter(continued, order=3, mode="mirror")
        return cls(
            row0_mm + nodes.y0 * pixel_mm,
            column0_mm + nodes.x0 * pixel_mm,
            nodes.step_y * pixel_mm,
            nodes.step_x * pixel_mm,
            spline[_RING - 1 : 1 - _RING, _RING - 1 : 1 - _RING],
        )

    def move(
        self, rows: FloatArray, columns: FloatArray, *, pixel_mm: float, row0_mm: float, column0_mm: float
    ) -> FloatArray:
        """Rows plus the correction there, in pixels of an image whose first pixel and size of a pixel are given.

        Parameters
        ----------
        rows, columns : arrays of one shape, or (H, 1) and (H, W)
        """
        shape = columns.shape
        flat = shape if len(shape) == 2 else (1, math.prod(shape))
        moved = np.empty(flat)
        kernels.move_rows(
            np.ascontiguousarray(self.coefficients_mm) / pixel_mm,
            ((row0_mm - self.row0_mm) / self.row_step_mm, pixel_mm / self.row_step_mm),
            ((column0_mm - self.column0_mm) / self.column_step_mm, pixel_mm / self.column_step_mm),
            rows if len(shape) == 2 else rows.reshape(flat),
            columns.reshape(flat),
            moved,
        )
        return moved.reshape(shape)


def correction_field(
    rows: FloatArray,
    columns: FloatArray,
    y_parallax_px: FloatArray,
    weights: FloatArray,
    nodes: PixelGrid,
    *,
    smoothing_nodes: float,
) -> FloatArray:
    """Smooth y-parallax at nodes of the aft image from measurements anywhere on it, robustly.

    Parameters
    ----------
    rows, columns, y_parallax_px, weights : (N,) arrays
        Places on the aft image, what was measured there and its relative weight.
    nodes : PixelGrid
        In pixels of the aft image.
    smoothing_nodes : float
        Standard deviation of the smoothing window, in nodes.
    """
    node_row, node_column = (np.rint(place).astype(int) for place in nodes.pixels(np.stack([columns, rows], axis=-1)))
    inside = (node_row >= 0) & (node_row < nodes.shape[0]) & (node_column >= 0) & (node_column < nodes.shape[1])
    flat = (node_row * nodes.shape[1] + node_column)[inside]
    size = nodes.shape[0] * nodes.shape[1]
    weight = np.bincount(flat, weights[inside], minlength=size).astype(float)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(flat, (weights * y_parallax_px)[inside], minlength=size) / weight
    return smooth_field(mean.reshape(nodes.shape), weight.reshape(nodes.shape), sigma_nodes=smoothing_nodes)
