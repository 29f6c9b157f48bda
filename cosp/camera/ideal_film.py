"""The image of a film as the camera would have made it on film that does not change."""

from __future__ import annotations

import math

from cosp.arrays import ByteArray
from cosp.camera.field import FilmField
from cosp.geometry.grids import PixelGrid
from cosp.imaging.resampling import sample
from cosp.imaging.windows import Window

_KERNEL_PX = 4  # that cubic interpolation reaches, and some for rounding


def measured_window(field: FilmField, grid: PixelGrid, window: Window) -> Window:
    """Window of the measured image that a window of the ideal one is made from, both on one grid."""
    return window.grown(_KERNEL_PX + math.ceil(field.largest_mm / abs(grid.step_x)), grid.shape)


def without_field(field: FilmField, grid: PixelGrid, window: Window, measured: ByteArray) -> ByteArray:
    """Grey values of a window of the ideal image: those of the points at which film shows what the camera imaged.

    Parameters
    ----------
    field : FilmField
    grid : PixelGrid
        Of the whole image, mm.
    window : Window
    measured : 2-D uint8 array
        The measured image in `measured_window`.
    """
    source = measured_window(field, grid, window)
    places = grid.window(window.row0, window.row1, window.column0, window.column1).centres()
    rows, columns = grid.pixels(field.distorted(places))
    return sample(measured, rows - source.row0, columns - source.column0)
