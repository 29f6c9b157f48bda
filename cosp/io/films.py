"""The film the right way round, once it is known which way it was digitised."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window, tiles
from cosp.io import rasters
from cosp.io.temporary import temporary_for

_TILE_PX = 2048


def put_right(straight_path: str | Path, film_path: str | Path, *, turned: bool, mirrored: bool) -> None:
    """Write a film the right way round.

    That a film was digitised upside down or through its back shows only against the ground.

    Parameters
    ----------
    straight_path, film_path : paths
        The film as it was digitised, and where to write it.
    turned : bool
        Turned by 180 degrees.
    mirrored : bool
        Seen through its back: y of the film runs the other way. A film that is both is mirrored, then turned.

    Raises
    ------
    InputError
        If the film cannot be read.
    """
    back, down = turned, turned != mirrored  # x and y that run the other way
    if not (back or down):
        temporary = temporary_for(Path(film_path))
        shutil.copyfile(straight_path, temporary)
        temporary.replace(film_path)
        return
    grid = rasters.info(straight_path).grid
    rows, columns = grid.shape
    right = PixelGrid(
        -(grid.x0 + (columns - 1) * grid.step_x) if back else grid.x0,
        -(grid.y0 + (rows - 1) * grid.step_y) if down else grid.y0,
        grid.step_x,
        grid.step_y,
        grid.shape,
    )
    with rasters.create(
        film_path, shape=grid.shape, dtype="uint8", grid=right, crs=rasters.FILM_CRS, nodata=0
    ) as writer:
        for window in tiles(grid.shape, _TILE_PX):
            shown = Window(
                *((rows - window.row1, rows - window.row0) if down else (window.row0, window.row1)),
                *((columns - window.column1, columns - window.column0) if back else (window.column0, window.column1)),
            )
            grey = rasters.read(straight_path, window=shown)
            writer.write(window, np.ascontiguousarray(grey[:: -1 if down else 1, :: -1 if back else 1]))
