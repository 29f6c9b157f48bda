"""Where the pixels of a placed film lie, once it is known which way round it was digitised."""

from __future__ import annotations

from pathlib import Path

from cosp.geometry.grids import PixelGrid
from cosp.io import rasters, records


def film_grid(film_path: str | Path, footprint_path: str | Path) -> PixelGrid:
    """Grid of a film raster in the film's own millimetres.

    That a film was digitised upside down or through its back shows only against the ground. The raster keeps its own
    millimetres; where its footprint says that it is turned or mirrored, the grid that is returned has other signs.
    Camera, control and tie points are in the millimetres of this grid.

    Raises
    ------
    InputError
        If one of the files is missing or is not what it should be.
    """
    x, y = signs(footprint_path)
    return rasters.info(film_path).grid.flipped(x=x < 0, y=y < 0)


def signs(footprint_path: str | Path) -> tuple[int, int]:
    """What x and y of the film raster are multiplied by to be the film's own millimetres."""
    footprint = records.read_json(footprint_path)
    turned, mirrored = bool(footprint.get("turned", False)), bool(footprint.get("mirrored", False))
    return (-1 if turned else 1), (-1 if turned != mirrored else 1)
