"""Figures of films: how they were bent, where control lies on them, what y-parallax is left between two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from cosp.arrays import FloatArray
from cosp.geometry.statistics import nmad

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


@dataclass(frozen=True)
class SeamProfile:
    """Residuals of two parts along their overlap.

    Parameters
    ----------
    seam : str
    x_mm : (N,) array
        Along the overlap.
    residual_px : (N, 2) array
        Mean residual x and y of each column.
    steps_px : (N, 2) array
        The steps of the scanner that were found in them.
    """

    seam: str
    x_mm: FloatArray
    residual_px: FloatArray
    steps_px: FloatArray


def draw_seams(seams: Sequence[SeamProfile], *, title: str) -> Figure:
    """One panel per seam: residuals of the two parts along the overlap, and the scanner's steps taken out of them."""
    count = max(len(seams), 1)
    figure = Figure(figsize=(_WIDTH_INCH, 0.8 + 1.8 * count), layout="constrained")
    figure.suptitle(title, fontsize=10)
    panels = np.atleast_1d(figure.subplots(count, 1))
    for panel, seam in zip(panels, seams, strict=False):
        for axis, (name, colour) in enumerate((("along the film", "tab:blue"), ("across it", "tab:orange"))):
            level = np.median(seam.residual_px[:, axis] - seam.steps_px[:, axis]) if len(seam.x_mm) else 0.0
            panel.plot(seam.x_mm, seam.residual_px[:, axis] - level, ".", color=colour, markersize=3, label=name)
            panel.plot(seam.x_mm, seam.steps_px[:, axis], color=colour, linewidth=1.0)
        panel.axhline(0.0, color="0.7", linewidth=0.8)
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, -0.5), max(high, 0.5))
        panel.set_title(seam.seam, fontsize=9, loc="left")
        panel.set_ylabel("px")
    if seams:
        panels[0].legend(fontsize=8, loc="upper right")
    panels[-1].set_xlabel("along the overlap (mm)")
    return figure


def draw_straightness(lines: Mapping[str, FloatArray], holes: Mapping[str, FloatArray], *, title: str) -> Figure:
    """One panel per side of a film: how far lines that straightened it, and rail holes, lie off a straight line.

    lines, holes : by side, (N, 2) arrays of places on the straight film, x and the height above their median, mm.
    """
    figure = Figure(figsize=(_WIDTH_INCH, 4.4), layout="constrained")
    figure.suptitle(title, fontsize=10)
    panels = np.atleast_1d(figure.subplots(2, 1, sharex=True))
    heights = np.concatenate(
        [1e3 * np.asarray(v, float)[:, 1] for v in (*lines.values(), *holes.values())] or [np.zeros(1)]
    )
    # A mark that was taken for a hole must not hide the rest.
    limit = max(10.0, 1.5 * float(np.nan_to_num(np.nanquantile(np.abs(heights), 0.95))))
    for panel, side in zip(panels, ("top", "bottom"), strict=True):
        for what, by_side, colour in (("line", lines, "tab:blue"), ("rail holes", holes, "tab:red")):
            if side in by_side:
                places = np.asarray(by_side[side], float)
                label = f"{what}, NMAD {1e3 * nmad(places[:, 1]):.1f} µm"
                panel.plot(places[:, 0], 1e3 * places[:, 1], ".", color=colour, markersize=3, label=label)
        panel.axhline(0.0, color="0.7", linewidth=0.8)
        panel.set_ylim(-limit, limit)
        panel.set_title(side, fontsize=9, loc="left")
        panel.set_ylabel("µm")
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=8, loc="upper right")
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
