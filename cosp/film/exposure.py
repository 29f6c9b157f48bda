"""The exposed area of a film: where the format lies, how it is tilted, how sure that is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening, gaussian_filter1d, uniform_filter1d

from cosp.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from cosp.errors import InputError
from cosp.geometry.robust import tukey_weights
from cosp.geometry.statistics import nmad
from cosp.imaging.resampling import sample


@dataclass(frozen=True)
class Exposure:
    """The exposed area in the pixels of the joined film.

    Parameters
    ----------
    pixel_mm : float
        Size of a pixel of the joined film.
    centre_px : (x, y)
        Column and row of the centre of format.
    tilt_deg : float
        Direction of the format's long axis; positive turns columns towards rows.
    half_length_mm, half_width_mm : float
        Of the area found.
    centre_sd_mm : (x, y)
        Standard deviation of the centre along and across the film.
    ends_found : (left, right)
        Whether the end of the format is seen; an end that is not is taken from the other end and the nominal length.
    edges_found : (top, bottom)
        Share of the length over which each long edge is seen; none where the scan was cut to the format.
    negative : bool
        Whether the picture is darker than the bare film beside it.
    """

    KIND: ClassVar[str] = "exposure"
    VERSION: ClassVar[int] = 1

    pixel_mm: float
    centre_px: tuple[float, float]
    tilt_deg: float
    half_length_mm: float
    half_width_mm: float
    centre_sd_mm: tuple[float, float]
    ends_found: tuple[bool, bool]
    edges_found: tuple[float, float]
    negative: bool = False

    def pixels(self, xy_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rows and columns in the joined film of points (..., 2) of the film, mm, x to the right and y up."""
        xy_mm = np.asarray(xy_mm, float)
        c, s = np.cos(np.radians(self.tilt_deg)), np.sin(np.radians(self.tilt_deg))
        right, down = xy_mm[..., 0] / self.pixel_mm, -xy_mm[..., 1] / self.pixel_mm
        return self.centre_px[1] + s * right + c * down, self.centre_px[0] + c * right - s * down


# Step of grey that counts in full as the edge of a picture; brighter steps count no more, so that snow rules nothing.
_FULL_STEP = 40.0
_TILT_LIMIT_DEG = 1.0
# Lines that look so much more like the long sides, at another distance, show that the size of a pixel is wrong.
_CLEARLY = 1.25
_WRONG_SCALE = 0.3
# Lines thinner than this are no picture; stripes are a tenth of a millimetre and lie 0.6 mm and more beside it.
LINE_MM = 0.55
# Fewer bright columns than this are a scratch, a mark or the border of the scan.
_PICTURE_MM = 8.0
_LENGTH_SD = 0.0015  # of the format's length: shrinkage of the film
_FAINT_MM = 1.5  # of film whose mean grey shows a faint end
_EVEN_MM = 6.0  # of bare film before it
_FAINT_SIGNIFICANCE = 6.0
_LEAST_FAINT_GREY = 0.02
_THIRD = 1.0 / 3.0
_BARE_MM = 5.0  # of film beyond the format at least
_CUT_MM = 0.5  # how closely a scan that was cut to the format was cut


def inverted(image: ByteArray) -> ByteArray:
    """Grey values of a negative turned into those of a positive; 0, where there is no film, stays."""
    return np.where(image > 0, np.maximum(255 - image, 1), 0).astype(np.uint8)


def find_exposure(
    image: ByteArray,
    *,
    pixel_mm: float,
    factor: int,
    length_mm: float,
    width_mm: float,
    length_tolerance: float,
    width_tolerance: float,
    valid: BoolArray | None = None,
) -> Exposure:
    """The exposed area, from the steps of grey at the four sides of the format.

    A side of the format is a straight line along which the picture is brighter than the film beside it. Lines are
    found as pairs at the nominal distance from each other, which leaves out the edges of the film, the scanner's
    border, marks and titling; where the picture is as dark as the film (night, sea) the rest of the line and the other
    side of the pair carry it. A film that fits such lines clearly better with light and dark exchanged is a negative.
    A scan that is no wider than the format was cut to it: its middle is the centre.

    Parameters
    ----------
    image : (rows, columns) uint8 array
        The joined film, reduced.
    pixel_mm : float
        Size of a pixel of the full joined film.
    factor : int
        Full pixels per pixel of `image`.
    length_mm, width_mm : float
        Nominal format.
    length_tolerance, width_tolerance : float
        Relative deviation from it that is possible.
    valid : (rows, columns) bool array, optional
        Pixels that may be looked at.

    Raises
    ------
    InputError
        Where nothing looks like the long sides of the format, or what does lies too far apart or too close.
    """
    step_mm = pixel_mm * factor
    valid = image > 0 if valid is None else valid
    negative = False
    top_share = bottom_share = 0.0
    scanned_mm = image.shape[0] * step_mm
    if scanned_mm < width_mm * (1 - width_tolerance):
        raise InputError(
            f"with pixels of {1000 * pixel_mm:g} um the film is {scanned_mm:.1f} mm wide; the format alone has "
            f"{width_mm:.1f} mm: is pixel_um right?"
        )
    if scanned_mm > width_mm:
        # Thin bright lines beside the picture (stripes, scratches) would look like its edge: an opening takes them out.
        positive, other = (_steps(without_lines(grey, step_mm), valid, axis=0) for grey in (image, inverted(image)))
        choices = (step_mm, width_mm, width_tolerance, length_mm)
        found, reverse = _long_sides(positive, *choices), _long_sides(other, *choices)
        negative = reverse.strength > _CLEARLY * max(found.strength, reverse.elsewhere)
        across, sides = (other, reverse) if negative else (positive, found)
        if sides.elsewhere > _CLEARLY * sides.strength:
            raise _wrong_scale(pixel_mm, sides.elsewhere_px * step_mm, width_mm)
        image = inverted(image) if negative else image
        top_line, top_share, top_sd = _fit_line(across, sides.slope, sides.top, reach=1.5 / step_mm)
        bottom_line, bottom_share, bottom_sd = _fit_line(-across, sides.slope, sides.bottom, reach=1.5 / step_mm)
    if max(top_share, bottom_share) < 0.1:
        if scanned_mm > width_mm * (1 + width_tolerance):
            raise InputError(
                f"the long sides of the format are seen over {100 * top_share:.0f} % and {100 * bottom_share:.0f} % of "
                "the film; a tenth of one of them is needed"
            )
        return _cut_to_format(image, pixel_mm, factor, length_mm, width_mm, length_tolerance)
    # Columns refer to the middle of the image; rows = line[0] + line[1] (column - middle).
    middle = (image.shape[1] - 1) / 2
    slope = float(np.average([top_line[1], bottom_line[1]], weights=[top_share + 0.01, bottom_share + 0.01]))
    upright = _upright(image, slope, top_line[0], bottom_line[0])
    upright_valid = _upright(valid.astype(np.uint8) * 255, slope, top_line[0], bottom_line[0]) > 250
    left, right, ends, end_sd = _short_sides(upright, upright_valid, step_mm, length_mm, length_tolerance)

    half_width = (bottom_line[0] - top_line[0]) / 2 * np.cos(np.arctan(slope))
    if abs(2 * half_width * step_mm / width_mm - 1) > width_tolerance:
        raise _wrong_scale(pixel_mm, 2 * half_width * step_mm, width_mm)
    along = (left + right) / 2 - middle
    c, s = np.cos(np.arctan(slope)), np.sin(np.arctan(slope))
    origin = np.array([middle, (top_line[0] + bottom_line[0]) / 2])
    centre = origin + along * np.array([c, s])
    full = (centre + 0.5) * factor - 0.5
    return Exposure(
        pixel_mm=pixel_mm,
        centre_px=(float(full[0]), float(full[1])),
        tilt_deg=float(np.degrees(np.arctan(slope))),
        half_length_mm=float((right - left) / 2 * step_mm),
        half_width_mm=float(half_width * step_mm),
        centre_sd_mm=(float(end_sd * step_mm), float(np.hypot(top_sd, bottom_sd) / 2 * step_mm)),
        ends_found=ends,
        edges_found=(top_share, bottom_share),
        negative=negative,
    )


def _cut_to_format(
    image: ByteArray, pixel_mm: float, factor: int, length_mm: float, width_mm: float, length_tolerance: float
) -> Exposure:
    """The exposed area of a scan without the film beside the picture: the scan itself, or its ends where they show."""
    step_mm = pixel_mm * factor
    rows, columns = image.shape
    scanned_mm = columns * step_mm
    if scanned_mm > length_mm * (1 + length_tolerance):
        left, right, ends, end_sd = _short_sides(image, image > 0, step_mm, length_mm, length_tolerance)
    else:
        left, right, ends = -0.5, columns - 0.5, (False, False)
        end_sd = np.hypot(_CUT_MM, (length_mm - scanned_mm) / math.sqrt(12)) / step_mm
    sd_across_mm = float(np.hypot(_CUT_MM, (width_mm - rows * step_mm) / math.sqrt(12)))
    return Exposure(
        pixel_mm=pixel_mm,
        centre_px=(float(((left + right) / 2 + 0.5) * factor - 0.5), (rows * factor - 1) / 2),
        tilt_deg=0.0,
        half_length_mm=float((right - left) / 2 * step_mm),
        half_width_mm=min(rows * step_mm, width_mm) / 2,
        centre_sd_mm=(float(end_sd * step_mm), sd_across_mm),
        ends_found=ends,
        edges_found=(0.0, 0.0),
    )


def without_lines(image: NDArray[Any], step_mm: float) -> NDArray[Any]:
    """The image without bright lines along its rows that are thinner than `LINE_MM`, by a grey opening."""
    thickness = max(3, round(LINE_MM / step_mm))
    return np.asarray(cv2.morphologyEx(image, cv2.MORPH_OPEN, np.ones((thickness, 1), np.uint8)))


def _steps(image: ByteArray, valid: BoolArray, *, axis: int) -> Float32Array:
    """Clipped step of grey between pixel i and i + 1 along an axis, of means over two pixels; 0 where not valid."""
    values = np.moveaxis(image.astype(np.float32), axis, 0)
    good = np.moveaxis(valid, axis, 0)
    step = np.zeros_like(values)
    step[1:-2] = (values[2:-1] + values[3:] - values[1:-2] - values[:-3]) / 2
    seen = np.zeros_like(good)
    seen[1:-2] = good[2:-1] & good[3:] & good[1:-2] & good[:-3]
    return np.asarray(np.moveaxis(np.clip(np.where(seen, step, 0.0), -_FULL_STEP, _FULL_STEP), 0, axis))


@dataclass(frozen=True)
class _Sides:
    """The two lines that look most like the long sides: slope, rows at the middle column; how much they look like it.

    `elsewhere` is the same of the best lines at another distance than the nominal one, `elsewhere_px`.
    """

    strength: float
    slope: float
    top: float
    bottom: float
    elsewhere: float
    elsewhere_px: int


def _long_sides(across: Float32Array, step_mm: float, width_mm: float, tolerance: float, length_mm: float) -> _Sides:
    """The two lines that look most like the long sides, in steps of grey across the film."""
    rows, columns = across.shape
    block = max(1, round(5.0 / step_mm))
    count = columns // block
    blocks = across[:, : count * block].reshape(rows, count, block).mean(axis=2)
    # A block counts with the square root of its step: many weak places outweigh a few strong ones.
    blocks = np.sign(blocks) * np.sqrt(np.abs(blocks))
    x = (np.arange(count) + 0.5) * block - 0.5 - (columns - 1) / 2
    best, other = (-np.inf, 0.0, 0.0, 0.0), (-np.inf, 0)
    limit = np.tan(np.radians(_TILT_LIMIT_DEG))
    low, high = (int(width_mm * (1 + sign * tolerance) / step_mm) for sign in (-1, 1))
    least, most = int(low * (1 - _WRONG_SCALE)), min(int(high * (1 + _WRONG_SCALE)), rows - 1)
    high = min(high, rows - 1)
    for slope in np.arange(-limit, limit, 0.5 * step_mm / (length_mm / 2)):
        shift = np.rint(slope * x).astype(int)
        source = np.arange(rows)[:, None] + shift
        inside = (source >= 0) & (source < rows)
        profile = np.where(inside, blocks[np.clip(source, 0, rows - 1), np.arange(count)], 0).sum(axis=1)
        profile = gaussian_filter1d(profile, 0.7)
        for distance in range(low, high + 1):
            pair = profile[: rows - distance] - profile[distance:]
            row = int(pair.argmax())
            if pair[row] > best[0]:
                best = (float(pair[row]), float(slope), float(row), float(row + distance))
        for distance in (*range(least, low), *range(high + 1, most + 1)):
            height = float((profile[: rows - distance] - profile[distance:]).max())
            if height > other[0]:
                other = (height, distance)
    # The step at index i lies between rows i and i + 1.
    return _Sides(best[0], best[1], best[2] + 0.5, best[3] + 0.5, *other)


def _wrong_scale(pixel_mm: float, found_mm: float, width_mm: float) -> InputError:
    return InputError(
        f"with pixels of {1000 * pixel_mm:g} um the long sides of the format are {found_mm:.1f} mm apart; "
        f"{width_mm:.1f} mm are needed: is pixel_um right?"
    )


def _fit_line(
    across: Float32Array, slope: float, row: float, *, reach: float
) -> tuple[tuple[float, float], float, float]:
    """Line row = p0 + p1 (column - middle) through the steps near a first line, share of columns with one, sd of p0."""
    rows, columns = across.shape
    width = max(2, round(reach))
    block = max(1, columns // 400)
    count = columns // block
    x = (np.arange(count) + 0.5) * block - 0.5 - (columns - 1) / 2
    line = np.array([row, slope])
    offsets = np.arange(-width, width + 1)
    found, weight = np.full(count, np.nan), np.zeros(count)
    smooth = across[:, : count * block].reshape(rows, count, block).mean(axis=2)
    for k in range(count):
        expected = line[0] + line[1] * x[k] - 0.5
        picked = np.rint(expected).astype(int) + offsets
        picked = picked[(picked >= 0) & (picked < rows)]
        step = np.maximum(smooth[picked, k], 0.0) if picked.size else np.zeros(1)
        if step.max() > 6.0:
            peak = int(step.argmax())
            near = slice(max(peak - 2, 0), peak + 3)
            found[k] = (step[near] * picked[near]).sum() / step[near].sum() + 0.5
            weight[k] = min(float(step.max()), _FULL_STEP)
    seen = np.isfinite(found)
    if seen.sum() < 10:
        return (row, slope), float(seen.mean()), width / 2
    design = np.column_stack([np.ones(count), x])[seen]
    target, weights = found[seen], weight[seen]
    robust = np.ones_like(weights)
    for _ in range(8):
        total = np.sqrt(weights * robust)
        line = np.linalg.lstsq(design * total[:, None], target * total, rcond=None)[0]
        residual = target - design @ line
        scale = max(nmad(residual[robust > 0]), 0.1)
        robust = tukey_weights(residual / scale)
    share = float((robust > 0.1).sum() / count)
    return (float(line[0]), float(line[1])), share, float(scale / np.sqrt(max((robust > 0.1).sum(), 1)))


def _upright(image: ByteArray, slope: float, top: float, bottom: float) -> ByteArray:
    """The picture between its long sides, tilt taken out; columns stay distances from the middle column."""
    c, s = np.cos(np.arctan(slope)), np.sin(np.arctan(slope))
    right = np.arange(image.shape[1]) - (image.shape[1] - 1) / 2
    half = (bottom - top) / 2 - 2.0
    down = np.arange(-half, half + 1e-9)
    rows = (top + bottom) / 2 + s * right[None] + c * down[:, None]
    columns = (image.shape[1] - 1) / 2 + c * right[None] - s * down[:, None]
    return np.asarray(sample(image, rows, columns, interpolation="linear"), np.uint8)


def _short_sides(
    upright: ByteArray, valid: BoolArray, step_mm: float, length_mm: float, tolerance: float
) -> tuple[float, float, tuple[bool, bool], float]:
    """Columns of the left and right ends, whether each was seen, standard deviation of their mean."""
    along = _steps(upright, valid, axis=1)
    rows, columns = along.shape
    strength = np.sign(along) * np.sqrt(np.abs(along))
    # An end is a step at every row: the mean over rows of the clipped step; texture inside the picture averages out.
    profile = gaussian_filter1d(strength.mean(axis=0), 0.7)
    low, high = (int(length_mm * (1 + sign * tolerance) / step_mm) for sign in (-1, 1))
    high = min(high, columns - 1)
    best = (-np.inf, 0.0, 0.0)
    nominal = length_mm / step_mm
    for distance in range(low, high + 1):
        pair = np.maximum(profile[: columns - distance], 0) + np.maximum(-profile[distance:], 0)
        # A weak pull to the nominal length decides where one end is not seen.
        pair = pair - 0.3 * ((distance - nominal) / (tolerance * nominal)) ** 2
        column = int(pair.argmax())
        if pair[column] > best[0]:
            best = (float(pair[column]), float(column), float(column + distance))
    if not np.isfinite(best[0]):
        raise InputError(
            f"the joined film is {columns * step_mm:.0f} mm long; the format of {length_mm:.0f} mm does not fit into it"
        )
    ends = [_refine_end(profile, best[1]), _refine_end(-profile, best[2])]
    seen = (ends[0][1] > 1.5, ends[1][1] > 1.5)
    left, right = ends[0][0], ends[1][0]
    if all(seen):
        return left, right, seen, 0.3
    faint = _faint_ends(upright, valid, step_mm, nominal)
    if faint is not None:
        # Where the end is plain to see as well it is known better.
        near = 2.0 * _FAINT_MM / step_mm
        left, right = (
            end if sure and abs(end - dim) < near else dim
            for end, dim, sure in zip((left, right), faint, seen, strict=True)
        )
        return left, right, (True, True), 1.0
    # The dark side of a picture that ends in the night looks like the end of the format. The format must hold the
    # picture that is seen, and lie on the film that was scanned.
    scanned = np.flatnonzero(valid.mean(axis=0) > 0.9)
    grey = np.median(upright[:, scanned], axis=0)
    # Parts differ in brightness by a few grey levels: film without a picture is what each end of the scan shows.
    end = max(2, round(_BARE_MM / step_mm))
    dark = np.linspace(np.median(grey[:end]), np.median(grey[-end:]), len(grey))
    bright = grey > dark + 6.0
    shown = scanned[binary_opening(bright, np.ones(max(2, round(_PICTURE_MM / step_mm)), bool))]
    earliest = max(shown[-1] - nominal if shown.size else 0.0, float(scanned[0]))
    latest = min(float(shown[0]) if shown.size else np.inf, scanned[-1] - nominal)
    slack, sd = tolerance * nominal, _LENGTH_SD * nominal / 2
    if earliest > latest:  # something bright beside the film: it bounds nothing
        earliest, latest = -np.inf, np.inf
    spread = (latest - earliest) / np.sqrt(12.0) if np.isfinite(latest) else 0.0
    for k, place in enumerate((left, right - nominal)):
        if seen[k] and earliest - slack / 4 <= place <= latest + slack / 4:
            return place, place + nominal, seen, float(np.hypot(sd, spread))
    middle = (earliest + latest) / 2 if np.isfinite(latest) else (left + right - nominal) / 2
    return middle, middle + nominal, (False, False), float(max(slack, spread))


def _faint_ends(upright: ByteArray, valid: BoolArray, step_mm: float, nominal: float) -> tuple[float, float] | None:
    """Columns of two ends the nominal length apart, each a step that may be less than a grey level; None without.

    Even the night is not quite as dark as bare film, and over the whole width: bare film is even, and the mean over the
    rows shows a tenth of a grey level.
    """
    scanned = np.flatnonzero(valid.mean(axis=0) > 0.9)
    columns = slice(int(scanned[0]), int(scanned[-1]) + 1)
    ordered = np.sort(upright[:, columns], axis=0)
    fifth = len(ordered) // 5
    # Marks and scratches take up some rows only.
    grey = ordered[fifth : len(ordered) - fifth].mean(axis=0)
    count = len(grey)
    width, beside = (max(2, round(mm / step_mm)) for mm in (_FAINT_MM, _EVEN_MM))
    total = np.r_[0.0, np.cumsum(grey)]
    means = (total[width:] - total[:-width]) / width
    rise = np.full(count, np.nan)  # from before column c to after it
    rise[width : count - width + 1] = means[width:] - means[:-width]
    with np.errstate(invalid="ignore"):
        scatter = np.stack([_scatter_before(side, beside, 2 * width) for side in (rise, rise[::-1])])
    significance = np.abs(rise) / np.maximum(np.stack([scatter[0], scatter[1][::-1]]), _LEAST_FAINT_GREY)
    significance = np.nan_to_num(significance, nan=0.0)
    worth = np.where(significance >= _FAINT_SIGNIFICANCE, np.log(np.maximum(significance, 1.0)), -np.inf)
    slack = round(2.5 * _LENGTH_SD * nominal)
    best = (-np.inf, 0, 0)
    for distance in range(round(nominal) - slack, round(nominal) + slack + 1):
        if distance < count:
            both = worth[0, : count - distance] + worth[1, distance:]
            both = both - 0.5 * ((distance - nominal) / (_LENGTH_SD * nominal)) ** 2
            if both.max() > best[0]:
                best = (float(both.max()), int(both.argmax()), int(both.argmax()) + distance)
    if best[2] == 0:
        return None
    ends = []
    for at, inwards in zip(best[1:], (1, -1), strict=True):
        # From outside, where grey has gone a third of the way.
        near = at + inwards * np.arange(-width, width + 1)
        near = near[(near >= 0) & (near < count)]
        outside, inside = np.median(grey[near[: width // 2]]), np.median(grey[near[-width // 2 :]])
        passed = (uniform_filter1d(grey, 3)[near] - outside) / (inside - outside) > _THIRD
        ends.append(float(near[int(passed.argmax())]) - inwards * 0.5)
    return columns.start + ends[0], columns.start + ends[1]


def _scatter_before(values: FloatArray, count: int, gap: int) -> FloatArray:
    """Scatter about zero of the `count` values that end `gap` before each place; NaN where there are fewer."""
    out = np.full(len(values), np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(np.abs(values), count)
    scatter = 1.4826 * np.median(windows, axis=1)
    out[count + gap - 1 :] = scatter[: len(values) - count - gap + 1]
    return out


def _refine_end(profile: FloatArray, column: float) -> tuple[float, float]:
    """Column of the step to a part of a pixel and its height, sqrt of grey levels."""
    c = int(column)
    near = np.arange(max(c - 2, 0), min(c + 3, len(profile)))
    weight = np.maximum(profile[near], 0)
    height = float(weight.max())
    return (float((near * weight).sum() / weight.sum()) + 0.5 if height > 0 else column + 0.5), height
