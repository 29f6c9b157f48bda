"""Traces of the panoramic geometry stripes, and of the format's long edges where there are no stripes.

Both are lines that ought to be straight and parallel to the film. A trace is where a line lies, in the millimetres of
the exposed area (x along the film, y up), at many x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosp.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from cosp.film.exposure import LINE_MM, Exposure, without_lines
from cosp.film.joining import Layout, view
from cosp.geometry.robust import running_median, tukey_weights
from cosp.geometry.statistics import nmad


@dataclass(frozen=True)
class Trace:
    """One line traced along the film.

    Parameters
    ----------
    side : "top" or "bottom"
    x_mm : (N,) array
    y_mm : (N,) array
        NaN where the line was not seen or was an outlier.
    strength : (N,) array
        Grey levels by which the line stands out.
    """

    side: Literal["top", "bottom"]
    x_mm: FloatArray
    y_mm: FloatArray
    strength: FloatArray

    def raised(self, base_mm: FloatArray) -> Trace:
        """The trace with a curve (N,) added to its places: from above a base to above the film's axis."""
        return replace(self, y_mm=self.y_mm + base_mm)

    @property
    def seen(self) -> BoolArray:
        """Where the line was seen."""
        return np.isfinite(self.y_mm)

    @property
    def share(self) -> float:
        """Share of the length over which the line was seen."""
        return float(self.seen.mean())

    @property
    def noise_mm(self) -> float:
        """Standard deviation of one place, from its differences to the neighbours' mean; NaN for too few."""
        y = self.y_mm
        bend = y[1:-1] - (y[:-2] + y[2:]) / 2
        return float(nmad(bend) / np.sqrt(1.5))


def band_profiles(
    parts: Sequence[ByteArray],
    layout: Layout,
    exposure: Exposure,
    *,
    x_mm: FloatArray,
    y_mm: FloatArray,
    base_mm: FloatArray,
    samples: int,
) -> Float32Array:
    """Profiles across the film, each a mean of `samples` of them spread over the spacing of `x_mm`.

    Parameters
    ----------
    parts : (rows, columns) uint8 array of each place of the layout
    layout : Layout
        Of the joined film.
    exposure : Exposure
    x_mm : (N,) array, evenly spaced
    y_mm : (rows,) array, evenly spaced
        Above the base.
    base_mm : (N,) array
        Height of the line that the profiles are taken along.
    samples : int

    Returns
    -------
    (rows, N) float32 array
        0 outside the joined film.
    """
    spacing = float(x_mm[1] - x_mm[0])
    within = ((np.arange(samples) + 0.5) / samples - 0.5) * spacing
    profiles = np.empty((len(y_mm), len(x_mm)), np.float32)
    chunk = max(1, 1024 // samples)
    for start in range(0, len(x_mm), chunk):
        x = (x_mm[start : start + chunk, None] + within).ravel()
        base = np.interp(x, x_mm, base_mm)
        begin, end = (np.stack(exposure.pixels(np.stack([x, base + y], axis=-1))[::-1], axis=-1) for y in y_mm[[0, -1]])
        grey = view(parts, layout, begin, end, len(y_mm))
        profiles[:, start : start + chunk] = grey.reshape(len(y_mm), -1, samples).mean(axis=2, dtype=np.float32)
    return profiles


def trace_ridge(
    band: Float32Array,
    y_mm: FloatArray,
    x_mm: FloatArray,
    *,
    side: Literal["top", "bottom"],
    slope_mm: float,
    min_contrast: float,
    outlier_mm: float,
) -> Trace:
    """The thin bright line that runs along a band of film beside the picture.

    The line is the path through the band that collects most ridge strength while it moves by at most `slope_mm` from
    one column to the next (dynamic programming); its places are then refined to a part of a pixel, and those that are
    weak or far from the running median of their neighbours are left out.

    Parameters
    ----------
    band : (rows, N) float32 array
        Grey values; each column is a mean along the film.
    y_mm : (rows,) array
        Of the band's rows, descending.
    x_mm : (N,) array
    side : str
    slope_mm : float
        Largest change of the line's place from column to column.
    min_contrast : float
        Least ridge strength, in standard deviations of the band's own ridge noise.
    outlier_mm : float
        Largest distance from the running median.

    Returns
    -------
    Trace
        All NaN where no line stands out.
    """
    pixel = float(abs(y_mm[1] - y_mm[0]))
    best: tuple[float, Float32Array, float, float] | None = None
    # The width of the line is not known: the scale at which it stands out most is taken.
    for width in _widths_px(pixel):
        ridge = _ridge(band, width)
        noise = max(nmad(ridge[ridge != 0]), 0.05)
        score = _path_mean(ridge / noise, max(1, round(slope_mm / pixel)))
        if best is None or score > best[0]:
            best = (score, ridge, noise, width)
    assert best is not None
    _, ridge, noise, width = best
    path = _best_path(np.clip(ridge / noise, -3.0, 12.0), max(1, round(slope_mm / pixel)))
    columns = np.arange(band.shape[1])
    strength = ridge[path, columns]
    if width < _NARROW_PX:
        # A wide ridge feels the picture on one side of the line; the narrowest one does not.
        rows = _refined(_ridge(band, _widths_px(pixel)[0]), path, reach=max(1, round(width)))
    else:
        rows = _centroids(band, path, min(3.0 * width, _CLEAR_MM / pixel))
    place = np.interp(rows, np.arange(len(y_mm)), y_mm)
    y = np.where(strength > min_contrast * noise, place, np.nan)
    return Trace(side, x_mm, _without_outliers(y, outlier_mm), strength)


def trace_edge(
    band: Float32Array,
    y_mm: FloatArray,
    x_mm: FloatArray,
    *,
    side: Literal["top", "bottom"],
    min_step: float,
    outlier_mm: float,
) -> Trace:
    """The edge of the picture: where each column crosses half way from the film's darkness to the picture.

    Parameters are those of `trace_ridge`; `min_step` is in grey levels.
    """
    inward = band if side == "top" else band[::-1]
    y_inward = y_mm if side == "top" else y_mm[::-1]
    pixel = float(abs(y_mm[1] - y_mm[0]))
    # A strongly bent edge leaves little picture in the band; repeated inwards, it is not taken for a thin line.
    padding = round(2 * LINE_MM / pixel)
    whole = np.pad(inward, ((0, padding), (0, 0)), mode="edge")
    smooth = gaussian_filter1d(without_lines(whole, pixel)[: len(inward)], 0.7, axis=0)
    step = np.diff(smooth, axis=0)
    # Steps of the picture's own texture are as large as its edge: the first large one from outside counts.
    strength = step.max(axis=0)
    large = step >= np.maximum(0.5 * strength, 1e-6)
    first = large.argmax(axis=0)
    rows, columns = np.arange(step.shape[0])[:, None], np.arange(step.shape[1])
    near = np.abs(rows - first - 1) <= 2
    weight = np.where(near, np.maximum(step, 0.0), 0.0)
    total = weight.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        place = (weight * rows).sum(axis=0) / total + 0.5
    y = np.where(strength > min_step, np.interp(place, np.arange(len(y_inward)), y_inward), np.nan)
    return Trace(side, x_mm, _without_outliers(y, outlier_mm), step[first, columns])


def smooth_base(edge: Trace, *, straight_mm: float, min_share: float) -> FloatArray:
    """Smooth height (N,) of the picture's edge, to look for the stripe along it; straight where the edge is not seen.

    Parameters
    ----------
    edge : Trace
    straight_mm : float
        Height of a straight edge.
    min_share : float
        Share of the length over which the edge must be seen.
    """
    if edge.share < min_share:
        return np.full(len(edge.x_mm), straight_mm)
    u = np.linspace(-1.0, 1.0, len(edge.x_mm))
    seen = edge.seen
    trend = robust_trend(u[seen], edge.y_mm[seen])
    # Between and beyond the places seen the polynomial may run away: the straight line between them does not.
    return np.interp(u, u[seen], trend)


_CLEAR_MM = 0.45  # nothing else lies so close to a line
_NARROW_PX = 4.0  # a line narrower than this has a top that a parabola fits


def _widths_px(pixel_mm: float) -> list[float]:
    """Widths of a line to look for, px: from a pixel and a half, and 0.04 to 0.4 mm."""
    return sorted({max(1.5, width / pixel_mm) for width in (0.04, 0.08, 0.16, 0.32)})


def _ridge(band: Float32Array, width_px: float) -> Float32Array:
    """How far each place is brighter than both sides of it: an edge is bright on one side only and gives nothing."""
    smooth = gaussian_filter1d(band, width_px / 2.355, axis=0)
    reach = max(2, round(1.5 * width_px))
    ridge = np.zeros_like(smooth)
    middle = smooth[reach:-reach]
    ridge[reach:-reach] = middle - np.maximum(smooth[: -2 * reach], smooth[2 * reach :])
    return np.asarray(ridge, np.float32)


def _best_path(gain: Float32Array, reach: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Row of each column on the path of largest sum that moves by at most `reach` rows a column."""
    rows, columns = gain.shape
    total = gain[:, 0].astype(np.float64)
    source = np.zeros((columns, rows), np.int16)
    padded = np.full(rows + 2 * reach, -np.inf)
    penalty = 0.3 * np.abs(np.arange(-reach, reach + 1)) / reach
    for k in range(1, columns):
        padded[reach:-reach] = total
        options = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1) - penalty
        chosen = options.argmax(axis=1)
        source[k] = chosen - reach
        total = options[np.arange(rows), chosen] + gain[:, k]
    path = np.zeros(columns, np.int64)
    path[-1] = int(total.argmax())
    for k in range(columns - 1, 0, -1):
        path[k - 1] = path[k] + source[k, path[k]]
    return path


def _path_mean(gain: Float32Array, reach: int) -> float:
    """Mean gain along the best path; limited, or a row of bright holes would outweigh a line seen everywhere."""
    limited = np.clip(gain, -3.0, 12.0)
    path = _best_path(limited, reach)
    return float(limited[path, np.arange(gain.shape[1])].mean())


def _refined(ridge: Float32Array, path: np.ndarray[tuple[int], np.dtype[np.int64]], *, reach: int) -> FloatArray:
    """Row of the ridge's top within some rows of a path, from the parabola through three places."""
    columns = np.arange(len(path))
    last = ridge.shape[0] - 1
    offsets = np.arange(-reach, reach + 1)
    around = np.stack([ridge[np.clip(path + d, 0, last), columns] for d in offsets])
    inner = np.clip(path + offsets[around.argmax(axis=0)], 1, last - 1)
    a, b, c = (ridge[inner + d, columns].astype(np.float64) for d in (-1, 0, 1))
    curve = a - 2 * b + c
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.where(curve < 0, 0.5 * (a - c) / curve, 0.0)
    return np.asarray(inner + np.clip(part, -0.5, 0.5))


def _centroids(band: Float32Array, path: np.ndarray[tuple[int], np.dtype[np.int64]], reach_px: float) -> FloatArray:
    """Row of the middle of a line whose ridge has a flat top: the centroid of what stands above its sides."""
    reach = int(np.ceil(reach_px))
    columns = np.arange(len(path))
    centre = path.astype(float)
    for _ in range(5):
        middle = np.clip(np.rint(centre).astype(np.int64), reach, band.shape[0] - 1 - reach)
        rows = middle + np.arange(-reach, reach + 1)[:, None]
        grey = band[rows, columns].astype(np.float64)
        sides = np.maximum(grey[: reach // 3 + 1].mean(axis=0), grey[-(reach // 3 + 1) :].mean(axis=0))
        # Half way up, grain beside the line has no say.
        excess = np.maximum(grey - (sides + grey.max(axis=0)) / 2, 0.0)
        total = excess.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            centre = np.where(total > 0, (excess * rows).sum(axis=0) / total, path)
    return centre


def _without_outliers(y_mm: FloatArray, limit_mm: float) -> FloatArray:
    """The places that lie near the running median of those seen around them.

    The median is that of the departures from a smooth robust curve: on a slope a running median fails at the ends.
    """
    y = np.array(y_mm, float)
    u = np.linspace(-1.0, 1.0, len(y))
    for width in (61, 21):
        seen = np.flatnonzero(np.isfinite(y))
        if seen.size < 4 * _TREND_DEGREE:
            return np.full_like(y, np.nan)
        departure = y[seen] - robust_trend(u[seen], y[seen])
        departure -= running_median(departure, width)
        y[seen[np.abs(departure) > max(limit_mm, 3.0 * nmad(departure))]] = np.nan
    return y


# Legendre polynomials follow the arcs and waves of a bent film; a trace with fewer places than four a degree is none.
_TREND_DEGREE = 9


def robust_trend(
    u: FloatArray, y: FloatArray, degree: int = _TREND_DEGREE, *, at: FloatArray | None = None
) -> FloatArray:
    """Polynomial through most of the places that are finite, at the places `at` (None: at all); -1 to 1."""
    at = u if at is None else at
    u, y = u[np.isfinite(y)], y[np.isfinite(y)]
    weights = np.ones_like(y)
    for _ in range(10):
        trend = np.polynomial.Legendre.fit(u, y, degree, w=np.sqrt(np.maximum(weights, 1e-6)), domain=[-1, 1])
        weights = tukey_weights((y - trend(u)) / max(nmad(y - trend(u)), 1e-4))
    return np.asarray(trend(at))
