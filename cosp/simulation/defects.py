"""What happens to a film after exposure: how it deforms, what is printed and scratched on it, how it is cut into parts.

Three systems of film coordinates, all in mm from the centre of format: *ideal* (where the lens drew a point),
*measured* (where it lies on the film of today) and *delivered* (measured, an aft film turned by half a circle).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from cosp.arrays import ByteArray, FloatArray
from cosp.geometry.transforms import Rigid
from cosp.simulation.orbit import FILM_HALF_WIDTH_MM, HALF_LENGTH_MM, HALF_WIDTH_MM
from cosp.simulation.site import ScenePlan, SiteSettings

ARCHIVE_PIXEL_MM = 0.007
GRID_STEP_MM = 2.0
LEADER_MM = 34.0
TRAILER_MM = 26.0
PART_HEIGHT_MM = 74.0
PARTS = "abcd"


@dataclass(frozen=True)
class FilmDeformation:
    """Displacement of measured against ideal film points, mm, on a regular grid of film points."""

    x_mm: FloatArray
    y_mm: FloatArray
    dx_mm: FloatArray
    dy_mm: FloatArray
    bending_mm: FloatArray  # share of dy on y = 0, along x_mm: what the stripes show

    def displacement(self, film_mm: FloatArray) -> FloatArray:
        """Displacement (..., 2) in mm at film points (..., 2), bilinear, held constant outside."""
        film_mm = np.asarray(film_mm, dtype=float)
        rows = (film_mm[..., 1].ravel() - self.y_mm[0]) / GRID_STEP_MM
        columns = (film_mm[..., 0].ravel() - self.x_mm[0]) / GRID_STEP_MM
        shifts = [map_coordinates(grid, [rows, columns], order=1, mode="nearest") for grid in (self.dx_mm, self.dy_mm)]
        return np.stack(shifts, axis=-1).reshape(film_mm.shape)

    def measured(self, ideal_mm: FloatArray) -> FloatArray:
        """Where ideal film points lie on the film of today."""
        return np.asarray(ideal_mm, dtype=float) + self.displacement(ideal_mm)

    def ideal(self, measured_mm: FloatArray) -> FloatArray:
        """Where measured film points were exposed; the deformation is gentle, so a few fixed-point steps are exact."""
        measured_mm = np.asarray(measured_mm, dtype=float)
        ideal = measured_mm
        for _ in range(6):
            ideal = measured_mm - self.displacement(ideal)
        return ideal


def deform_film(settings: SiteSettings, rng: np.random.Generator) -> FilmDeformation:
    """Bending, smooth distortion and shrinkage of one film.

    The distortion is a Gaussian random field with the settings' correlation lengths, scaled to its rms per axis.
    """
    x = np.arange(-HALF_LENGTH_MM - 46.0, HALF_LENGTH_MM + 46.0 + GRID_STEP_MM, GRID_STEP_MM)
    y = np.arange(-38.0, 38.0 + GRID_STEP_MM, GRID_STEP_MM)
    sigma = (settings.distortion_width_mm / GRID_STEP_MM / 2.0, settings.distortion_length_mm / GRID_STEP_MM / 2.0)
    halo = [int(4 * s) for s in sigma]
    fields = []
    for _ in range(2):
        white = rng.standard_normal((y.size + 2 * halo[0], x.size + 2 * halo[1]))
        smooth = gaussian_filter(white, sigma, mode="constant")[halo[0] : -halo[0], halo[1] : -halo[1]]
        # Known variance of smoothed white noise, not that of this sample: a short film may be better or worse.
        smooth *= np.sqrt(4.0 * np.pi * sigma[0] * sigma[1])
        fields.append(smooth * settings.distortion_px * ARCHIVE_PIXEL_MM)
    bending = _bending_curve(x, rng)
    opening = _bending_curve(x, rng)
    dx = fields[0] - settings.shrinkage * x
    dy = fields[1] - settings.shrinkage * y[:, None] + settings.bending_mm * bending
    dy += 0.06 * settings.bending_mm * opening * (y[:, None] / HALF_WIDTH_MM)
    return FilmDeformation(x, y, dx, dy, settings.bending_mm * bending)


def _bending_curve(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A smooth curve along the film with zero mean and an rms of one half: an arc, an S, and shorter waves."""
    u = x / HALF_LENGTH_MM
    curve = rng.standard_normal() * (u**2 - 1.0 / 3.0) * 1.5 + rng.standard_normal() * (u**3 - 0.6 * u)
    for waves in (1.5, 2.3, 3.7):
        curve += rng.standard_normal() / waves * np.sin(np.pi * waves * u + rng.uniform(0.0, 2.0 * np.pi))
    inside = np.abs(u) <= 1.0
    curve -= curve[inside].mean()
    return np.asarray(0.5 * curve / curve[inside].std())


@dataclass(frozen=True)
class Part:
    """One digitised part: where its pixels lie on the delivered film, and how the scanner rendered grey."""

    letter: str
    shape: tuple[int, int]
    pixel_mm: float
    motion: Rigid  # from mm about the part's middle (x right, y up) to delivered film
    gain: float
    offset_grey: float
    steps_mm: FloatArray  # (n, 2) displacement of each scanner block
    step_length_mm: float

    def delivered(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """Delivered film points (..., 2) of pixel positions."""
        u = (np.asarray(columns, dtype=float) - (self.shape[1] - 1) / 2.0) * self.pixel_mm
        v = ((self.shape[0] - 1) / 2.0 - np.asarray(rows, dtype=float)) * self.pixel_mm
        block = np.clip((u / self.step_length_mm + len(self.steps_mm) / 2.0).astype(int), 0, len(self.steps_mm) - 1)
        return self.motion.apply(np.stack(np.broadcast_arrays(u, v), axis=-1) + self.steps_mm[block])

    def pixels(self, delivered_mm: FloatArray) -> FloatArray:
        """Row and column (..., 2) of delivered film points, scanner steps left out."""
        uv = self.motion.inverse().apply(delivered_mm)
        return np.stack(
            [
                (self.shape[0] - 1) / 2.0 - uv[..., 1] / self.pixel_mm,
                uv[..., 0] / self.pixel_mm + (self.shape[1] - 1) / 2.0,
            ],
            axis=-1,
        )


def cut_parts(settings: SiteSettings, rng: np.random.Generator) -> tuple[Part, ...]:
    """Four parts, a to d from left to right of the delivered film, each laid down a little askew."""
    pixel_mm = settings.pixel_um * 1e-3
    length = 2.0 * HALF_LENGTH_MM + LEADER_MM + TRAILER_MM
    width = (length + 3.0 * settings.overlap_mm) / 4.0
    shape = (round(PART_HEIGHT_MM / pixel_mm), round(width / pixel_mm))
    blocks = int(np.ceil(width / settings.scanner_step_mm)) + 1
    parts = []
    for number, letter in enumerate(PARTS):
        middle = -HALF_LENGTH_MM - LEADER_MM + width / 2.0 + number * (width - settings.overlap_mm)
        shift = settings.part_shift_mm * rng.uniform(-1.0, 1.0, 2)
        rotation = np.radians(settings.part_rotation_deg) * rng.uniform(-1.0, 1.0)
        gain = 1.0 + settings.part_contrast * rng.uniform(-1.0, 1.0)
        offset = 80.0 * settings.part_contrast * rng.uniform(-1.0, 1.0)
        steps = settings.scanner_step_px * ARCHIVE_PIXEL_MM * rng.standard_normal((blocks, 2))
        motion = Rigid(float(rotation), (float(middle + shift[0]), float(shift[1] - 0.8)))
        parts.append(Part(letter, shape, pixel_mm, motion, gain, offset, steps, settings.scanner_step_mm))
    return tuple(parts)


@dataclass(frozen=True)
class Stroke:
    """A drawn line on the film: corners in delivered or measured mm, width in mm, grey, opacity."""

    points_mm: FloatArray
    width_mm: float
    grey: float
    opacity: float
    filled: bool = False


@dataclass(frozen=True)
class FilmTruth:
    """All that happened to one film."""

    turned: bool
    deformation: FilmDeformation
    parts: tuple[Part, ...]
    strokes: tuple[Stroke, ...]  # in delivered mm

    def delivered(self, measured_mm: FloatArray) -> FloatArray:
        """Delivered film points of measured ones (half a turn for aft); its own inverse."""
        return -np.asarray(measured_mm) if self.turned else np.asarray(measured_mm)


def make_film(settings: SiteSettings, scene: ScenePlan) -> FilmTruth:
    """Deformation, parts and marks of one film, the same whenever asked for the same settings."""
    turned = scene.look == "aft"
    deformation = deform_film(settings, np.random.default_rng([settings.seed, 21, scene.number]))
    parts = cut_parts(settings, np.random.default_rng([settings.seed, 22, scene.number]))
    rng = np.random.default_rng([settings.seed, 23, scene.number])
    damage = [*_scratches(settings.scratches, rng), *_dust(settings.dust, rng)]
    marks = _marks(settings, scene) if settings.marks else []
    return FilmTruth(turned, deformation, parts, (*marks, *damage))


def _scratches(count: int, rng: np.random.Generator) -> list[Stroke]:
    """Long fine lines, nearly along the film, as transport leaves them."""
    strokes = []
    for _ in range(count):
        length = rng.uniform(10.0, 160.0)
        start = rng.uniform([-HALF_LENGTH_MM, -30.0], [HALF_LENGTH_MM, 30.0])
        s = np.linspace(0.0, 1.0, 24)
        wander = np.cumsum(rng.standard_normal(24)) * 0.015 + s * length * rng.normal(0.0, 0.004)
        points = start + np.stack([s * length, wander], axis=-1)
        grey = 235.0 if rng.random() < 0.7 else 20.0
        strokes.append(Stroke(points, rng.uniform(0.010, 0.035), grey, rng.uniform(0.3, 0.9)))
    return strokes


def _dust(count: int, rng: np.random.Generator) -> list[Stroke]:
    """Specks and a few hairs."""
    strokes = []
    for _ in range(count):
        middle = rng.uniform([-HALF_LENGTH_MM - 20.0, -34.0], [HALF_LENGTH_MM + 20.0, 34.0])
        grey = 15.0 if rng.random() < 0.6 else 245.0
        if rng.random() < 0.06:
            turns = np.cumsum(rng.normal(0.0, 0.35, 14)) + rng.uniform(0.0, 2.0 * np.pi)
            points = middle + np.cumsum(0.16 * np.stack([np.cos(turns), np.sin(turns)], axis=-1), axis=0)
            strokes.append(Stroke(points, 0.025, grey, 0.7))
        else:
            size = 0.02 + rng.exponential(0.05)
            angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 7))
            spread = size * rng.uniform(0.6, 1.2, (7, 1))
            strokes.append(
                Stroke(middle + spread * np.stack([np.cos(angle), np.sin(angle)], axis=-1), 0.0, grey, 0.8, True)
            )
    return strokes


def _marks(settings: SiteSettings, scene: ScenePlan) -> list[Stroke]:
    """Titling, frame number, binary data block, end blocks and the archive's sign, in delivered mm."""
    side = HALF_WIDTH_MM + 2.6
    year, month, day = settings.date.split("-")
    months = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")
    look = "FWD" if scene.look == "fore" else "AFT"
    title = f"{scene.scene[2:6]}-{settings.pass_number} {look} {day} {months[int(month) - 1]} {year[2:]}"
    marks = _text(f"D{settings.pass_number % 1000:03d} {scene.scene[-3:]}", -85.0, side + 0.1, 3.0)
    marks += _text(title, -52.0, side + 0.3, 2.2)
    marks += _text(scene.scene[-3:], 152.0, side, 3.4)
    bits = np.random.default_rng([settings.seed, 24, scene.number]).random((2, 16)) < 0.5
    for row, column in zip(*np.nonzero(bits), strict=True):
        centre = np.array([170.0 + 2.4 * column, HALF_WIDTH_MM + 3.0 + 2.0 * row])
        marks.append(_rectangle(centre - 0.35, centre + 0.35, 225.0))
    end = HALF_LENGTH_MM
    marks.append(
        _rectangle(np.array([end - 14.0, HALF_WIDTH_MM + 1.2]), np.array([end - 0.5, HALF_WIDTH_MM + 2.6]), 230.0)
    )
    marks.append(
        _rectangle(np.array([-end + 0.5, HALF_WIDTH_MM + 1.4]), np.array([-end + 6.0, HALF_WIDTH_MM + 2.2]), 120.0)
    )
    angle = np.linspace(-np.pi / 2.0, np.pi / 2.0, 20)
    marks.append(
        Stroke(np.stack([end + 3.0 + 2.6 * np.cos(angle), 2.6 * np.sin(angle)], axis=-1), 0.0, 170.0, 1.0, True)
    )
    left = -end - 31.0
    for wave in range(3):
        s = np.linspace(0.0, 1.0, 12)
        line = np.stack([left + 4.0 * s, -29.0 + wave * 1.1 + 0.4 * np.sin(5.0 * s)], axis=-1)
        marks.append(Stroke(line, 0.5, 240.0, 1.0))
    return marks + _text("ARCHIVE", left + 4.6, -29.2, 2.6)


def _rectangle(low: FloatArray, high: FloatArray, grey: float) -> Stroke:
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return Stroke(corners, 0.0, grey, 1.0, True)


# Letters as strokes on a 4 x 6 raster: each digit pair is a corner, blanks lift the pen.
_LETTERS = {
    "A": "00 26 40|12 32", "B": "00 06 36 43 33 03|33 41 30 00", "C": "45 36 16 05 01 10 30 41",
    "D": "00 06 26 44 42 20 00", "E": "46 06 00 40|03 33", "F": "46 06 00|03 33", "G": "45 36 16 05 01 10 30 42 32",
    "H": "00 06|40 46|03 43", "I": "20 26", "J": "46 41 30 10 01", "K": "00 06|46 03 40", "L": "06 00 40",
    "M": "00 06 23 46 40", "N": "00 06 40 46", "O": "10 01 05 16 36 45 41 30 10", "P": "00 06 36 45 44 33 03",
    "R": "00 06 36 45 44 33 03|23 40", "S": "45 36 16 05 14 32 41 30 10 01", "T": "06 46|20 26",
    "U": "06 01 10 30 41 46", "V": "06 20 46", "W": "06 10 23 30 46", "Y": "06 23 46|23 20",
    "0": "10 01 05 16 36 45 41 30 10", "1": "15 26 20", "2": "05 16 36 45 44 00 40",
    "3": "05 16 36 45 44 33 23|33 42 41 30 10 01", "4": "30 36 02 42", "5": "46 06 03 33 42 41 30 10 01",
    "6": "45 36 16 05 01 10 30 41 42 33 03", "7": "06 46 10",
    "8": "13 04 05 16 36 45 44 33 13 02 01 10 30 41 42 33", "9": "01 10 30 41 45 36 16 05 04 13 43", "-": "03 43",
}  # fmt: skip


def _text(text: str, left_mm: float, bottom_mm: float, height_mm: float) -> list[Stroke]:
    """Strokes of a line of titling."""
    unit = height_mm / 6.0
    strokes = []
    for place, letter in enumerate(text):
        for line in filter(None, _LETTERS.get(letter, "").split("|")):
            corners = np.array([[int(pair[0]), int(pair[1])] for pair in line.split()], dtype=float)
            points = corners * unit + [left_mm + place * 6.0 * unit, bottom_mm]
            strokes.append(Stroke(points, 0.12 * height_mm, 215.0, 1.0))
    return strokes


def draw_strokes(image: ByteArray, part: Part, first_row: int, strokes: tuple[Stroke, ...]) -> None:
    """Draw marks into rows of a part, in place, finer than a pixel: thin lines turn faint, not wide."""
    rows, columns = image.shape
    bits = 4
    for stroke in strokes:
        pixels = part.pixels(stroke.points_mm) - [first_row, 0.0]
        reach = 2.0 + stroke.width_mm / part.pixel_mm
        low, high = pixels.min(axis=0) - reach, pixels.max(axis=0) + reach
        if high[0] < 0 or low[0] >= rows or high[1] < 0 or low[1] >= columns:
            continue
        row0, column0 = max(int(low[0]), 0), max(int(low[1]), 0)
        row1, column1 = min(int(high[0]) + 2, rows), min(int(high[1]) + 2, columns)
        cover = np.zeros((row1 - row0, column1 - column0), np.uint8)
        corners = np.round((pixels[:, ::-1] - [column0, row0]) * 2**bits).astype(np.int32)
        opacity = stroke.opacity
        if stroke.filled:
            area = abs(cv2.contourArea(corners.astype(np.float32))) / 4.0**bits
            opacity *= min(1.0, area)
            cv2.fillPoly(cover, [corners], 255, cv2.LINE_AA, bits)
        else:
            width = stroke.width_mm / part.pixel_mm
            opacity *= min(1.0, width)
            cv2.polylines(cover, [corners], False, 255, max(1, round(width)), cv2.LINE_AA, bits)
        share = cover.astype(np.float32) * np.float32(opacity / 255.0)
        view = image[row0:row1, column0:column1]
        view[:] = np.rint(view + share * (stroke.grey - view)).astype(np.uint8)


def film_sizes() -> dict[str, float]:
    """Where things lie across the film, mm: image, stripes, rail holes and the film's own edge."""
    return {
        "half_length_mm": HALF_LENGTH_MM,
        "half_width_mm": HALF_WIDTH_MM,
        "stripe_mm": STRIPE_MM,
        "stripe_half_width_mm": STRIPE_HALF_WIDTH_MM,
        "rail_hole_mm": RAIL_HOLE_MM,
        "rail_hole_radius_mm": RAIL_HOLE_RADIUS_MM,
        "film_half_width_mm": FILM_HALF_WIDTH_MM,
    }


STRIPE_MM = HALF_WIDTH_MM + 0.7
STRIPE_HALF_WIDTH_MM = 0.06
RAIL_HOLE_MM = HALF_WIDTH_MM + 2.1
RAIL_HOLE_RADIUS_MM = 0.3
