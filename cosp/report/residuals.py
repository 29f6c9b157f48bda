"""Figure of the residuals of an adjustment over the films."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from cosp.arrays import FloatArray

_WIDTH_INCH = 12.0
_PANEL_INCH = 2.0


@dataclass(frozen=True)
class FilmResiduals:
    """Residuals of one film on a grid.

    Parameters
    ----------
    scene : str
    nodes_mm : (rows, columns, 2) array, mm
    smoothed_px : (rows, columns, 2) array, px
        NaN where no point is near.
    points_mm : (N, 2) array, mm
        Where points were measured.
    caption : str
    """

    scene: str
    nodes_mm: FloatArray
    smoothed_px: FloatArray
    points_mm: FloatArray
    caption: str


def draw_residuals(films: Sequence[FilmResiduals], *, label: str = "smoothed residual, px") -> Figure:
    """One panel per film: size of the smoothed residuals as colour, residuals as arrows, points as dots.

    The film is stretched across, being 13 times as long as wide; an arrow's x and y are those of the film.

    References
    ----------
    [Ghuffar2022] figure 12.
    """
    figure = Figure(figsize=(_WIDTH_INCH, 0.6 + _PANEL_INCH * len(films)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(len(films), 1, sharex=True))
    sizes = [np.hypot(film.smoothed_px[..., 0], film.smoothed_px[..., 1]) for film in films]
    finite = np.concatenate([size[np.isfinite(size)] for size in sizes])
    top = max(float(np.quantile(finite, 0.98)), 0.1) if finite.size else 1.0
    for panel, film, size in zip(panels, films, sizes, strict=True):
        x, y = film.nodes_mm[..., 0], film.nodes_mm[..., 1]
        colours = panel.pcolormesh(x, y, np.ma.masked_invalid(size), cmap="viridis", vmin=0.0, vmax=top)
        panel.plot(*film.points_mm.T, ".", color="white", markersize=1, alpha=0.4)
        seen = np.isfinite(size)
        arrows = panel.quiver(
            x[seen],
            y[seen],
            film.smoothed_px[seen][:, 0],
            film.smoothed_px[seen][:, 1],
            color="black",
            units="inches",
            scale=top / 0.35,
            width=0.012,
        )
        panel.quiverkey(arrows, 0.94, 1.08, top, f"{top:.2g} px", labelpos="E")
        panel.set_title(f"{film.scene}: {film.caption}", fontsize=9, loc="left")
        panel.set_ylabel("y, mm")
    panels[-1].set_xlabel("x along the film, mm")
    figure.colorbar(colours, ax=list(panels), label=label, shrink=0.8)
    return figure
