"""Figure of how a draft model lies against the reference, and what its tiles say of that."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from cosp.arrays import FloatArray
from cosp.dem.displacement import Displacement
from cosp.geometry.grids import PixelGrid
from cosp.geometry.statistics import nmad

_LONGEST_PX = 1200
_WIDTH_INCH = 11.0


def draw_displacements(
    difference_m: FloatArray, grid: PixelGrid, found: Sequence[Displacement], *, title: str
) -> Figure:
    """Differences of height as colour, displacements of tiles in plan as arrows; dots and crosses for what they lack.

    Parameters
    ----------
    difference_m : (R, C) array
        Model less reference; NaN where they were not compared.
    grid : PixelGrid
    found : sequence of Displacement
        Dots where the relief leaves plan open, crosses where the displacement is not believed.
    """
    every = max(1, -(-max(grid.shape) // _LONGEST_PX))
    drawn = np.asarray(difference_m, float)[::every, ::every]
    xmin, ymin, xmax, ymax = (value / 1000 for value in grid.bounds)
    middle = float(np.nanmedian(drawn)) if np.isfinite(drawn).any() else 0.0
    spread = 3 * nmad(drawn)
    limit = spread if np.isfinite(spread) and spread > 0 else 1.0
    height = float(np.clip(_WIDTH_INCH * (ymax - ymin) / (xmax - xmin), 2.5, 9.0))
    figure = Figure(figsize=(_WIDTH_INCH, height + 0.8), layout="constrained")
    axes = figure.add_subplot()
    axes.set_facecolor("0.85")
    colours = axes.imshow(
        drawn,
        extent=(xmin, xmax, ymin, ymax),
        cmap="RdBu",
        vmin=middle - limit,
        vmax=middle + limit,
        interpolation="nearest",
    )
    figure.colorbar(colours, ax=axes, label="draft less reference (m)", shrink=0.8, pad=0.02, extend="both")
    places = np.array([one.place_m[:2] for one in found]).reshape(-1, 2) / 1000
    shifts = np.array([one.shift_m[:2] for one in found]).reshape(-1, 2)
    verdict = np.array([one.verdict for one in found], dtype="U8")
    axes.plot(*places[verdict == "open"].T, ".", color="black", markersize=4)
    axes.plot(*places[np.isin(verdict, ("far", "worse"))].T, "x", color="black", markersize=5)
    kept = verdict == "kept"
    if kept.any():
        longest = max(float(np.quantile(np.hypot(*shifts[kept].T), 0.9)), 1.0)
        arrows = axes.quiver(*places[kept].T, *shifts[kept].T, units="inches", scale=longest / 0.4, width=0.015)
        axes.quiverkey(arrows, 0.9, 1.04, longest, f"{longest:.0f} m", labelpos="E")
    axes.set(title=title, xlabel="easting (km)", ylabel="northing (km)")
    axes.ticklabel_format(useOffset=False, style="plain")
    return figure
