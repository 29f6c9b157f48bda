"""Pictures of elevation models and their differences."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib.figure import Figure

from cosp.arrays import BoolArray, FloatArray
from cosp.geometry.grids import PixelGrid
from cosp.geometry.statistics import nmad
from cosp.io.temporary import temporary_for

_LONGEST_PX = 1600


def hillshade(target: str | Path | BinaryIO, heights_m: FloatArray, grid: PixelGrid, *, title: str) -> None:
    """Shaded relief coloured by height, as PNG; light from the north-west, as maps have it."""
    heights, extent, step = _reduced(heights_m, grid)
    dy, dx = np.gradient(heights, -step[1], step[0])  # rows run south, so dy is the rise northwards
    azimuth, elevation = np.radians([315.0, 45.0])
    sun = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    shade = (-dx * sun[0] - dy * sun[1] + sun[2]) / np.sqrt(1 + dx**2 + dy**2)
    low, high = _limits(heights, 1, 99)
    figure, axes = _map_axes(heights.shape)
    colours = axes.imshow(heights, extent=extent, cmap="gist_earth", vmin=low, vmax=high, interpolation="nearest")
    light = np.zeros((*shade.shape, 4))
    light[..., 3] = np.where(np.isfinite(shade), np.clip(0.75 - shade, 0, 0.85), 0)
    axes.imshow(light, extent=extent, interpolation="nearest")
    figure.colorbar(colours, ax=axes, label="ellipsoidal height (m)", shrink=0.8, pad=0.02)
    _finish(figure, axes, title, target)


def difference_map(
    target: str | Path | BinaryIO,
    difference_m: FloatArray,
    grid: PixelGrid,
    *,
    title: str,
    limit_m: float | None = None,
) -> None:
    """Elevation differences in red (lower) and blue (higher), as PNG; the scale is 3 NMAD unless given."""
    difference, extent, _ = _reduced(difference_m, grid)
    if limit_m is None:
        spread = 3 * nmad(difference)
        limit_m = spread if np.isfinite(spread) and spread > 0 else 1.0
    figure, axes = _map_axes(difference.shape)
    axes.set_facecolor("0.85")
    colours = axes.imshow(difference, extent=extent, cmap="RdBu", vmin=-limit_m, vmax=limit_m, interpolation="nearest")
    figure.colorbar(colours, ax=axes, label="elevation difference (m)", shrink=0.8, pad=0.02, extend="both")
    _finish(figure, axes, title, target)


def histogram(
    target: str | Path | BinaryIO, differences_m: dict[str, FloatArray], *, title: str, stable: BoolArray | None = None
) -> None:
    """Distributions of named differences in one plot, with their median and NMAD, as PNG."""
    figure = Figure(figsize=(6.4, 4), layout="constrained")
    axes = figure.add_subplot()
    values = {
        name: array[np.isfinite(array) & (True if stable is None else stable)] for name, array in differences_m.items()
    }
    reach = max((6 * nmad(v) + abs(float(np.median(v))) for v in values.values() if v.size), default=1.0)
    edges = np.linspace(-reach, reach, 121) if reach > 0 else np.linspace(-1, 1, 121)
    for name, array in values.items():
        if array.size:
            label = f"{name}: median {np.median(array):.2f} m, NMAD {nmad(array):.2f} m"
            axes.hist(array, bins=edges.tolist(), density=True, histtype="step", linewidth=1.4, label=label)
    axes.axvline(0, color="0.5", linewidth=0.8)
    axes.set(xlabel="elevation difference (m)", ylabel="density (1/m)", title=title)
    axes.set_ylim(top=1.25 * axes.get_ylim()[1])  # room for the legend
    axes.legend(fontsize="small", loc="upper right")
    save(figure, target)


def _reduced(values: FloatArray, grid: PixelGrid) -> tuple[FloatArray, tuple[float, ...], tuple[float, float]]:
    """Every n-th cell, the extent in kilometres and the steps in metres."""
    every = max(1, -(-max(values.shape) // _LONGEST_PX))
    xmin, ymin, xmax, ymax = (v / 1000 for v in grid.bounds)
    kept = np.asarray(values, float)[every // 2 :: every, every // 2 :: every]
    return kept, (xmin, xmax, ymin, ymax), (abs(grid.step_x) * every, abs(grid.step_y) * every)


def _limits(values: FloatArray, low: float, high: float) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    a, b = np.percentile(finite, [low, high])
    return float(a), float(max(b, a + 1e-3))


def _map_axes(shape: tuple[int, ...]) -> tuple[Figure, Any]:
    """A figure as wide as a page, as high as the map needs."""
    height = float(np.clip(9 * shape[0] / shape[1], 2.2, 9)) + 0.8
    figure = Figure(figsize=(10, height), layout="constrained")
    return figure, figure.add_subplot()


def _finish(figure: Figure, axes: Any, title: str, target: str | Path | BinaryIO) -> None:
    axes.set(title=title, xlabel="easting (km)", ylabel="northing (km)")
    axes.ticklabel_format(useOffset=False, style="plain")
    save(figure, target)


def save(figure: Figure, target: str | Path | BinaryIO, dpi: int = 150) -> None:
    """Into an open file, or into a file by name, whole or not at all."""
    if not isinstance(target, (str, Path)):
        figure.savefig(target, dpi=dpi, format="png")
        return
    path = Path(target)
    temporary = temporary_for(path)
    figure.savefig(temporary, dpi=dpi)
    temporary.replace(path)
