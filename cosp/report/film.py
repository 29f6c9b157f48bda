"""Figures of films: how they were bent, where control lies on them, what y-parallax is left between two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from cosp.arrays import FloatArray

_WIDTH_INCH = 10.0
_ROLES = {"control": ("tab:blue", "o"), "check": ("tab:orange", "^"), "rejected": ("0.6", "x")}
# A map of a film is 13 times as long as wide; more columns than a page has pixels would be lost.
_MOST_COLUMNS = 2000


@dataclass(frozen=True)
class Bending:
    """Across-film displacement that made a film straight.

    Parameters
    ----------
    scene : str
    source : str
        What the film was straightened by: "stripes", "edges" or "none".
    x_mm, top_mm, bottom_mm : (N,) arrays, mm
        Place along the film; displacement of its upper and its lower edge there.
    """

    scene: str
    source: str
    x_mm: FloatArray
    top_mm: FloatArray
    bottom_mm: FloatArray


def draw_bending(films: Sequence[Bending]) -> Figure:
    """One panel per film with the displacement of both edges along the film, in micrometres."""
    figure = Figure(figsize=(_WIDTH_INCH, 0.6 + 1.6 * max(len(films), 1)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(max(len(films), 1), 1, sharex=True))
    for panel, film in zip(panels, films, strict=False):
        panel.plot(film.x_mm, 1e3 * np.asarray(film.top_mm, float), label="upper edge")
        panel.plot(film.x_mm, 1e3 * np.asarray(film.bottom_mm, float), label="lower edge")
        panel.axhline(0.0, color="0.7", linewidth=0.8)
        panel.set_title(f"{film.scene}, by {film.source}", fontsize=9, loc="left")
        panel.set_ylabel("µm")
    if films:
        panels[0].legend(fontsize=8, loc="upper right")
    panels[-1].set_xlabel("along the film (mm)")
    return figure


def draw_control(points: Mapping[str, Mapping[str, FloatArray]], *, half_width_mm: float) -> Figure:
    """One panel per film with its ground control in the colours of its role.

    points : by scene, by role, (N, 2) arrays of film points in mm.
    """
    figure = Figure(figsize=(_WIDTH_INCH, 0.6 + 1.4 * max(len(points), 1)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(max(len(points), 1), 1, sharex=True))
    for panel, (scene, by_role) in zip(panels, points.items(), strict=False):
        for role, (colour, marker) in _ROLES.items():
            xy = np.asarray(by_role.get(role, np.empty((0, 2))), float)
            panel.plot(xy[:, 0], xy[:, 1], marker, color=colour, markersize=3, label=f"{role}: {len(xy)}")
        panel.set_ylim(-half_width_mm, half_width_mm)
        panel.set_ylabel("mm")
        panel.set_title(scene, fontsize=9, loc="left")
        panel.legend(fontsize=7, loc="upper right", ncols=3)
    panels[-1].set_xlabel("along the film (mm)")
    return figure


def draw_y_parallax(y_parallax_px: Mapping[str, FloatArray]) -> Figure:
    """One panel per pair with the measured y-parallax over the epipolar image, in pixels.

    y_parallax_px : by pair, (R, C) arrays; NaN where nothing was measured.
    """
    figure = Figure(figsize=(_WIDTH_INCH, 0.6 + 1.8 * max(len(y_parallax_px), 1)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(max(len(y_parallax_px), 1), 1))
    finite = np.concatenate([values[np.isfinite(values)] for values in y_parallax_px.values()] or [np.empty(0)])
    limit = max(float(np.quantile(np.abs(finite), 0.98)), 0.1) if finite.size else 1.0
    for panel, (pair, values) in zip(panels, y_parallax_px.items(), strict=False):
        every = max(1, values.shape[1] // _MOST_COLUMNS)
        drawn = panel.imshow(
            values[:, ::every], cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto", interpolation="nearest"
        )
        panel.set_title(pair, fontsize=9, loc="left")
        panel.set_xticks([])
        panel.set_yticks([])
        panel.set_facecolor("0.85")
        figure.colorbar(drawn, ax=panel, label="px", extend="both")
    return figure
