"""Bending of the film across its length, and the map from straight film to the joined film."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import binary_closing, binary_dilation

from cosp.arrays import ByteArray, FloatArray
from cosp.film.exposure import Exposure
from cosp.film.joining import Layout, view
from cosp.film.stripes import Trace, robust_trend
from cosp.geometry.grids import PixelGrid
from cosp.geometry.robust import tukey_weights
from cosp.geometry.statistics import nmad
from cosp.imaging.windows import Window

_LEAST_SCALE_MM = 0.005
_DISTANCE_DEGREE = 2
_WEIGHT_OF_TREND = 0.01
_LARGEST_OPENING_MM = 0.25
_LEAST_GATE_MM = 0.05
_JUMP = 6.0  # standard deviations of the traces' noise
_LEAST_JUMP_MM = 0.001
_STRETCH_MM = 15.0  # between two jumps of one disturbance
_MARGIN_MM = 4.0
_MOST_DISTURBED = 0.3


@dataclass(frozen=True)
class Bending:
    """Displacement across the film, as two curves along it, linear between them.

    Parameters
    ----------
    source : "stripes", "edges" or "none"
        What it was measured from.
    sd_mm : float
        Standard deviation of the curves; for "none" that of the straight line assumed.
    x_mm : (N,) floats
    dy_top_mm, dy_bottom_mm : (N,) floats
        Where the line lies above its straight place.
    y_top_mm, y_bottom_mm : float
        Straight places of the two lines.
    """

    KIND: ClassVar[str] = "bending"
    VERSION: ClassVar[int] = 1

    source: Literal["stripes", "edges", "none"]
    sd_mm: float
    x_mm: tuple[float, ...]
    dy_top_mm: tuple[float, ...]
    dy_bottom_mm: tuple[float, ...]
    y_top_mm: float
    y_bottom_mm: float

    def bent(self, xy_mm: FloatArray) -> FloatArray:
        """Where points (..., 2) of the straight film lie on the film as it was scanned, mm."""
        xy_mm = np.asarray(xy_mm, float)
        x, y = xy_mm[..., 0], xy_mm[..., 1]
        top = np.interp(x, self.x_mm, self.dy_top_mm)
        bottom = np.interp(x, self.x_mm, self.dy_bottom_mm)
        share = (y - self.y_bottom_mm) / (self.y_top_mm - self.y_bottom_mm)
        return np.stack([x, y + bottom + share * (top - bottom)], axis=-1)

    def straight(self, xy_mm: FloatArray) -> FloatArray:
        """Where points (..., 2) of the film as it was scanned lie on the straight film, mm: the inverse of `bent`."""
        xy_mm = np.asarray(xy_mm, float)
        x, y = xy_mm[..., 0], xy_mm[..., 1]
        top = np.interp(x, self.x_mm, self.dy_top_mm)
        bottom = np.interp(x, self.x_mm, self.dy_bottom_mm)
        opening = (top - bottom) / (self.y_top_mm - self.y_bottom_mm)
        return np.stack([x, (y - bottom + opening * self.y_bottom_mm) / (1.0 + opening)], axis=-1)


def no_bending(exposure: Exposure, *, sd_mm: float) -> Bending:
    """A film taken to be straight, with the standard deviation that this assumption deserves."""
    half, width = exposure.half_length_mm, exposure.half_width_mm
    return Bending("none", sd_mm, (-half, half), (0.0, 0.0), (0.0, 0.0), width, -width)


def choose_bending(
    exposure: Exposure,
    *,
    stripes: Sequence[Trace],
    edges: Sequence[Trace],
    min_share: float,
    max_noise_mm: float,
    step_mm: float,
    smoothing_mm: float,
    edge_smoothing_mm: float,
    single_sd_mm: float,
    none_sd_mm: float,
) -> Bending:
    """Bending from the stripes where they are usable, else from both long edges of the format, else none.

    Parameters
    ----------
    exposure : Exposure
    stripes, edges : Trace of each side that was traced
    min_share : float
        Share of the length over which a line must be seen.
    max_noise_mm : float
        Largest noise of a line's places.
    step_mm : float
        Spacing of the curves' places.
    smoothing_mm, edge_smoothing_mm : float
        Shortest wavelength that the curves follow, for stripes and for edges.
    single_sd_mm : float
        Standard deviation of the curve of a missing stripe.
    none_sd_mm : float
        Standard deviation of a film taken to be straight.
    """

    def usable(traces: Sequence[Trace], side: str) -> Trace | None:
        kept = [t for t in traces if t.side == side and t.share >= min_share and t.noise_mm <= max_noise_mm]
        return kept[0] if kept else None

    top, bottom = usable(stripes, "top"), usable(stripes, "bottom")
    if top is not None or bottom is not None:
        return bending_from_traces(
            top, bottom, source="stripes", step_mm=step_mm, smoothing_mm=smoothing_mm, single_sd_mm=single_sd_mm
        )
    top, bottom = usable(edges, "top"), usable(edges, "bottom")
    if top is not None and bottom is not None:
        measured = bending_from_traces(
            top, bottom, source="edges", step_mm=step_mm, smoothing_mm=edge_smoothing_mm, single_sd_mm=single_sd_mm
        )
        # An edge that is rougher than the film is likely to be bent says nothing.
        if measured.sd_mm < none_sd_mm:
            return measured
    return no_bending(exposure, sd_mm=none_sd_mm)


def bending_from_traces(
    top: Trace | None,
    bottom: Trace | None,
    *,
    source: Literal["stripes", "edges"],
    step_mm: float,
    smoothing_mm: float,
    single_sd_mm: float,
) -> Bending:
    """Smooth curves through the traces of one or two lines.

    The line that is seen more carries the other one: of that, only its distance from the first is smoothed, so that a
    gap is bridged by the bend of the other side and not by a guess. Tilt stays in the curves, so that both lines come
    out along the film's axis; so does the mean, where there are two lines: the axis lies midway between them. With one
    line alone the other side is given the same curve.

    Parameters
    ----------
    top, bottom : Trace or None
        At least one; None where a line is not usable.
    source : str
    step_mm : float
        Spacing of the curves' places.
    smoothing_mm : float
        Wavelength below which the curves follow nothing: that is noise of the traces.
    single_sd_mm : float
        Standard deviation of the missing curve where there is one line only.
    """
    if source == "stripes" and top is not None and bottom is not None:
        top, bottom = _undisturbed(top, bottom), _undisturbed(bottom, top)
    traces = [trace for trace in (top, bottom) if trace is not None]
    low = min(float(trace.x_mm[0]) for trace in traces)
    high = max(float(trace.x_mm[-1]) for trace in traces)
    x = np.linspace(low, high, max(2, round((high - low) / step_mm) + 1))
    carrier = max(traces, key=lambda trace: trace.share)
    spline, sd_carrier = _smooth(carrier, smoothing_mm)
    fits = {carrier.side: (spline(x), sd_carrier)}
    for other in traces:
        if other is not carrier:
            rest, sd_rest = _distance_smooth(other.raised(-spline(other.x_mm)), smoothing_mm)
            fits[other.side] = (spline(x) + rest(x), sd_rest)
    (curve_top, sd_top), (curve_bottom, sd_bottom) = (fits.get(side, fits[carrier.side]) for side in ("top", "bottom"))
    mean_top, mean_bottom = float(curve_top.mean()), float(curve_bottom.mean())
    sd = float(np.hypot(sd_top, sd_bottom) / np.sqrt(2.0))
    if len(traces) == 1:
        sd = float(np.hypot(sd, single_sd_mm))
        mean_top, mean_bottom = (mean_top, -mean_top) if top is not None else (-mean_bottom, mean_bottom)
    offset = (mean_top + mean_bottom) / 2
    return Bending(
        source=source,
        sd_mm=sd,
        x_mm=tuple(x.tolist()),
        dy_top_mm=tuple((curve_top - curve_top.mean() + offset).tolist()),
        dy_bottom_mm=tuple((curve_bottom - curve_bottom.mean() + offset).tolist()),
        y_top_mm=mean_top - offset,
        y_bottom_mm=mean_bottom - offset,
    )


def _undisturbed(trace: Trace, other: Trace) -> Trace:
    """The trace without the stretches where it jumps and the other one does not.

    There a scratch or a mark runs along the line and draws it aside; bridging such a stretch is far better than
    following it. A step of the scanner moves both lines alike.
    """

    def bends(y: FloatArray) -> FloatArray:
        inner = np.abs(y[1:-1] - (y[:-2] + y[2:]) / 2)
        return np.pad(inner, 1, constant_values=np.nan)

    least = max(_JUMP * float(np.hypot(trace.noise_mm, other.noise_mm)), _LEAST_JUMP_MM)
    jumps = (bends(trace.y_mm - other.y_mm) > least) & (bends(trace.y_mm) > bends(other.y_mm))
    spacing = float(trace.x_mm[1] - trace.x_mm[0])
    closing, margin = (np.ones(2 * round(mm / spacing / 2) + 1, bool) for mm in (_STRETCH_MM, _MARGIN_MM))
    padded = np.pad(jumps, len(closing))
    disturbed = binary_dilation(binary_closing(padded, closing), margin)[len(closing) : -len(closing)]
    if disturbed.mean() > _MOST_DISTURBED:  # a rough line, not a disturbed one
        return trace
    return replace(trace, y_mm=np.where(disturbed, np.nan, trace.y_mm))


def _distance_smooth(distance: Trace, smoothing_mm: float) -> tuple[Callable[[FloatArray], FloatArray], float]:
    """As `_smooth`, of the distance of two lines: it hardly changes along the film, which tells what is no line.

    Far from places seen it returns to its own trend, which a spline with nothing to hold it would not.
    """
    seen = distance.seen
    if seen.sum() < 4 * _DISTANCE_DEGREE:
        return _smooth(distance, smoothing_mm)
    u = np.interp(distance.x_mm, distance.x_mm[[0, -1]], [-1.0, 1.0])
    # Whole stretches of a scratch or of rail holes can stand in for a line; they would draw a polynomial to them.
    level = np.nanmedian(distance.y_mm)
    likely = np.where(np.abs(distance.y_mm - level) < _LARGEST_OPENING_MM, distance.y_mm, np.nan)
    trend = robust_trend(u, likely, _DISTANCE_DEGREE, at=u)
    off = distance.y_mm - trend
    y = np.where(np.abs(off) <= max(_LEAST_GATE_MM, 5.0 * nmad(off)), off, np.nan)
    curve, sd = _smooth(replace(distance, y_mm=y), smoothing_mm, unseen=_WEIGHT_OF_TREND)
    # Where the line is not seen, its distance may differ from the trend as it does where it is.
    sd = float(np.hypot(sd, np.sqrt(1.0 - np.isfinite(y).mean()) * nmad(y)))
    return lambda x_mm: curve(x_mm) + np.interp(x_mm, distance.x_mm, trend), sd


def _smooth(
    trace: Trace, smoothing_mm: float, *, unseen: float = 0.0
) -> tuple[Callable[[FloatArray], FloatArray], float]:
    """Curve through a trace and its standard deviation; gaps are bridged, ends continued straight.

    `unseen` is the weight with which places that were not seen draw the curve to zero.
    """
    used = trace.seen | (unseen > 0)
    x, y = trace.x_mm[used], np.nan_to_num(trace.y_mm[used])
    base = np.where(trace.seen[used], 1.0, unseen)
    centre = float(x.mean())
    # The penalised spline damps waves of angular frequency k by 1 / (1 + lam k^4 spacing): half at this wavelength.
    spacing = float(np.median(np.diff(x)))
    lam = (smoothing_mm / (2 * np.pi)) ** 4 / spacing
    weights = base
    for _ in range(4):
        spline = make_smoothing_spline(x - centre, y, w=np.maximum(weights, 1e-3), lam=lam)
        residual = y - spline(x - centre)
        # Traces come without gross errors, and a good one is far closer to the film than a stiff curve can follow:
        # what the curve misses must not be taken for an error of the trace.
        scale = max(nmad(residual[base == 1.0]), _LEAST_SCALE_MM)
        weights = base * np.where(base == 1.0, tukey_weights(residual / scale), 1.0)
    # Places within half a wavelength share one value of the curve; an edge is rough in pieces longer than the spacing,
    # and neighbours that err alike count as fewer.
    rough = np.clip(residual[base == 1.0], -3 * scale, 3 * scale)
    alike = float(np.clip((rough[1:] @ rough[:-1]) / max(rough @ rough, 1e-12), 0.0, 0.95))
    independent = max(1.0, smoothing_mm / 2 / spacing * trace.share * (1 - alike) / (1 + alike))

    def curve(x_mm: FloatArray) -> FloatArray:
        return np.asarray(spline(np.asarray(x_mm) - centre))

    return curve, float(scale / np.sqrt(independent))


def film_grid(exposure: Exposure, *, half_length_mm: float, half_width_mm: float) -> PixelGrid:
    """Grid of the straight film, centred on the format, x to the right and y up, pixels of the joined film."""
    p = exposure.pixel_mm
    columns, rows = 2 * int(half_length_mm / p), 2 * int(half_width_mm / p)
    return PixelGrid(-(columns - 1) / 2 * p, (rows - 1) / 2 * p, p, -p, (rows, columns))


def joined_pixels(
    xy_mm: FloatArray, exposure: Exposure, bending: Bending, *, turned: bool
) -> tuple[FloatArray, FloatArray]:
    """Rows and columns in the joined film of points (..., 2) of the straight film.

    `turned`: the straight film is the scanned one turned by 180 degrees, as aft films have to be.
    """
    xy_mm = np.asarray(xy_mm, float)
    return exposure.pixels(bending.bent(-xy_mm if turned else xy_mm))


def straighten(
    parts: Sequence[ByteArray],
    layout: Layout,
    grid: PixelGrid,
    window: Window,
    exposure: Exposure,
    bending: Bending,
    *,
    turned: bool,
) -> ByteArray:
    """A window of the straight film, resampled once (bicubic) from the parts; 0 outside.

    Parameters
    ----------
    parts : (rows, columns) uint8 array of each place of the layout
    layout : Layout
        Of the joined film.
    grid : PixelGrid
        Of the straight film.
    window : Window
        Of the straight film.
    exposure, bending : records
    turned : bool
        Turn by 180 degrees.
    """
    # For each column of the straight film the place is linear along the column: two of its points give the others.
    columns_here = np.arange(window.column0, window.column1)
    ends = [grid.points(np.array(row), columns_here) for row in (window.row0, window.row1 - 1)]
    places = [joined_pixels(points, exposure, bending, turned=turned) for points in ends]
    begin, end = (np.stack([columns, rows], axis=-1) for rows, columns in places)
    return view(parts, layout, begin, end, window.row1 - window.row0)
