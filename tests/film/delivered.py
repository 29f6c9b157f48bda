"""Films as an archive delivers them: the simulator's defects over made-up texture, which needs no ray casting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from cosp.arrays import ByteArray, FloatArray
from cosp.film.arrangement import Pose, posed
from cosp.film.bending import Bending
from cosp.film.exposure import Exposure
from cosp.film.joining import Layout
from cosp.imaging.resampling import sample
from cosp.simulation import defects
from cosp.simulation.orbit import FILM_HALF_WIDTH_MM, HALF_LENGTH_MM, HALF_WIDTH_MM
from cosp.simulation.site import ScenePlan, SiteSettings
from tests.film.synthetic import texture

_LATTICE_MM = 1.0
_CONTRAST_OF_SEA = 0.06


@dataclass(frozen=True)
class Wishes:
    """What happens to a film besides the settings of the simulator.

    Parameters
    ----------
    weak_overlap : int or None
        Overlap, counted from 0, under which the ground has almost no texture.
    ends : ("night", "snow" or "", the same)
        What the last 40 mm of the format show, left and right.
    stripe_gaps : float
        Share of the upper stripe that is missing.
    order : indices of the parts a to d in the order of their names
    poses : Pose of each part, by its place in the film
    """

    weak_overlap: int | None = None
    ends: tuple[str, str] = ("", "")
    stripe_gaps: float = 0.0
    order: tuple[int, ...] = (0, 1, 2, 3)
    poses: tuple[Pose, ...] = (Pose(),) * 4


@dataclass(frozen=True)
class Delivered:
    """A film in parts, and all that is true of it.

    Parameters
    ----------
    parts : arrays by the place of the part in the film
    """

    settings: SiteSettings
    look: str
    truth: defects.FilmTruth
    wishes: Wishes
    parts: tuple[ByteArray, ...]

    def by_letter(self) -> list[ByteArray]:
        """Parts as they are named: a to d."""
        return [self.parts[k] for k in self.wishes.order]


def deliver(settings: SiteSettings, look: str, wishes: Wishes, *, number: int = 0) -> Delivered:
    """Expose, deform, digitise and muddle a film; the same for the same arguments."""
    scene = ScenePlan(f"DS1104-2169D{look[0].upper()}{92 + number:03d}", look, number, None, None, settings.seed)  # type: ignore[arg-type]
    truth = defects.make_film(settings, scene)
    rng = np.random.default_rng([settings.seed, 77, number])
    pixel_mm = settings.pixel_um / 1000
    ground = _ground(pixel_mm, truth, wishes, rng)
    gaps = rng.permutation(38) < round(38 * wishes.stripe_gaps)
    parts = []
    for part, pose in zip(truth.parts, wishes.poses, strict=True):
        image = _digitise(part, truth, settings, ground, gaps, rng)
        defects.draw_strokes(image, part, 0, truth.strokes)
        parts.append(np.ascontiguousarray(posed(image, pose)))
    return Delivered(settings, look, truth, wishes, tuple(parts))


def _ground(
    pixel_mm: float, truth: defects.FilmTruth, wishes: Wishes, rng: np.random.Generator
) -> np.ndarray[Any, Any]:
    """Grey values over the format, in the fore sense, at the pixels of the digitisation."""
    shape = (round(2 * HALF_WIDTH_MM / pixel_mm), round(2 * HALF_LENGTH_MM / pixel_mm))
    grey = 30.0 + 190.0 * texture(shape, rng)
    x = np.linspace(-HALF_LENGTH_MM, HALF_LENGTH_MM, shape[1])
    if wishes.weak_overlap is not None:
        left, right = truth.parts[wishes.weak_overlap], truth.parts[wishes.weak_overlap + 1]
        ends = [left.delivered(600.0, left.shape[1] - 1.0), right.delivered(600.0, 0.0)]
        low, high = sorted(float(truth.delivered(end)[0]) for end in ends)
        sea = (x > low - 6) & (x < high + 6)
        grey[:, sea] = 90.0 + _CONTRAST_OF_SEA * (grey[:, sea] - 125.0)
    for side, what in zip((-1, 1), wishes.ends, strict=True):
        here = side * x > HALF_LENGTH_MM - 40.0
        if what == "night":
            grey[:, here] = 26.0 + 0.01 * grey[:, here]
        if what == "snow":
            grey[:, here] = 246.0 + 0.03 * grey[:, here]
    return np.asarray(grey, np.float32)


def _digitise(
    part: defects.Part,
    truth: defects.FilmTruth,
    settings: SiteSettings,
    ground: Any,
    gaps: Any,
    rng: np.random.Generator,
) -> ByteArray:
    pixel_mm = part.pixel_mm
    rows, columns = part.shape
    step = max(1, round(_LATTICE_MM / pixel_mm))
    node_rows, node_columns = (step * np.arange(-1, n // step + 3, dtype=float) for n in (rows, columns))
    u = (node_columns - (columns - 1) / 2) * pixel_mm
    v = ((rows - 1) / 2 - node_rows) * pixel_mm
    delivered = part.motion.apply(np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1))
    ideal = truth.deformation.ideal(truth.delivered(delivered))
    # The blocks of the scanner are shifted as a whole: places between nodes are taken where each block lies.
    here = (np.arange(columns) - (columns - 1) / 2) * pixel_mm
    block = np.clip((here / part.step_length_mm + len(part.steps_mm) / 2).astype(int), 0, len(part.steps_mm) - 1)
    shift = part.steps_mm[block]
    at_columns = (np.arange(columns) + shift[:, 0] / pixel_mm) / step + 1
    at_rows = (np.arange(rows)[:, None] - shift[:, 1] / pixel_mm) / step + 1
    x, y = (
        cv2.remap(
            ideal[..., axis].astype(np.float32),
            np.broadcast_to(at_columns, part.shape).astype(np.float32),
            at_rows.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for axis in (0, 1)
    )

    def cover(inside_mm: FloatArray) -> FloatArray:
        return np.clip(inside_mm / pixel_mm + 0.5, 0.0, 1.0)

    grey = np.full(part.shape, 26.0, np.float32)
    picture = sample(ground, (HALF_WIDTH_MM - y) / pixel_mm - 0.5, (x + HALF_LENGTH_MM) / pixel_mm - 0.5)
    picture = picture * (1.0 - settings.vignetting * (0.4 * (x / HALF_LENGTH_MM) ** 2 + 0.6 * (y / HALF_WIDTH_MM) ** 2))
    grey += cover(HALF_LENGTH_MM - np.abs(x)) * cover(HALF_WIDTH_MM - np.abs(y)) * (picture - 26.0)
    if settings.camera == "KH-4B":
        seen = (np.abs(x) < HALF_LENGTH_MM + 4) & ~((y > 0) & gaps[np.clip((x // 20 + 19).astype(int), 0, 37)])
        share = min(1.0, 2 * defects.STRIPE_HALF_WIDTH_MM / pixel_mm)
        line = np.clip(
            (defects.STRIPE_HALF_WIDTH_MM - np.abs(np.abs(y) - defects.STRIPE_MM)) / pixel_mm + 0.5, 0, share
        )
        grey += seen * line * (190.0 - grey)
        along = x - 10.0 * np.floor(x / 10.0 + 0.5)
        spot = cover(defects.RAIL_HOLE_RADIUS_MM - np.hypot(along, np.abs(y) - defects.RAIL_HOLE_MM))
        grey += (np.abs(x) < HALF_LENGTH_MM + 8) * spot * (235.0 - grey)
    side = -y if truth.turned else y
    grey = np.where(np.abs(y) > FILM_HALF_WIDTH_MM, np.where(side < 0, 252.0, 14.0), grey)
    grey = (grey - 128.0) * part.gain + 128.0 + part.offset_grey
    grey += rng.normal(0.0, settings.scanner_noise_grey + 0.3 * settings.grain_grey * (0.010 / pixel_mm), part.shape)
    return np.asarray(np.clip(np.rint(grey), 1, 255), np.uint8)


@dataclass(frozen=True)
class Errors:
    """How far a found film is from the true one.

    Parameters
    ----------
    seam_px : (S,) array
        Root mean square over each overlap of the distance at which its two parts show one place of the film.
    straightness_um : float
        Of both stripes' places on the straight film, rms about one line each.
    parallel_um : float
        Change of their distance along the film, end to end.
    scale_ppm : float
    centre_mm : (x, y)
    step_overlap_px, step_elsewhere_px : (N,) arrays
        What is left of each step of the scanner, or was made where there is none, rms of its two coordinates: of the
        parts' overlaps and between them.
    """

    seam_px: FloatArray
    straightness_um: float
    parallel_um: float
    scale_ppm: float
    centre_mm: tuple[float, float]
    step_overlap_px: FloatArray
    step_elsewhere_px: FloatArray


def errors(
    film: Delivered, seams: dict[str, Any], layout: Layout, exposure: Exposure, bending: Bending, turned: bool
) -> Errors:
    """Errors of what the film stages found, from their maps alone."""
    letters = [name[-1] for name in seams["part_order"]]
    places = [film.wishes.order["abcd".index(letter)] for letter in letters]
    laid = [Pose(*pose) for pose in zip(seams["turned"], seams["mirrored"], strict=True)]

    def laid_pixels(k: int, rows_columns: FloatArray) -> FloatArray:
        """Pixels (x, y) of the part at place k of the layout, as it lies there, of its pixels as it was digitised."""
        part = film.truth.parts[places[k]]
        xy = rows_columns[..., ::-1]
        for pose in (film.wishes.poses[places[k]], laid[k]):
            size = np.array([part.shape[1] - 1.0, part.shape[0] - 1.0])
            if pose.mirrored:
                xy = np.stack([xy[..., 0], size[1] - xy[..., 1]], axis=-1)
            if pose.turned:
                xy = size - xy
        return xy

    def joined(k: int, delivered: FloatArray, *, steps: bool = True) -> FloatArray:
        """Place in the joined film (x, y) of delivered film points, by the part at place k of the layout."""
        part = film.truth.parts[places[k]]
        rows_columns = part.pixels(delivered)
        for _ in range(4 if steps else 0):
            off = part.delivered(rows_columns[..., 0], rows_columns[..., 1]) - delivered
            rows_columns = rows_columns - (part.pixels(delivered + off) - part.pixels(delivered))
        xy = laid_pixels(k, rows_columns)
        return layout.motions[k].apply(xy - layout.steps[k].at(xy[..., 0]))

    def ends_of(k: int) -> float:
        """Last column of the joined film that the part at place k reaches."""
        rows, columns = film.truth.parts[places[k]].shape
        return float(layout.motions[k].apply(np.array([columns - 1.0, rows / 2]))[0])

    seam_px = []
    for k in range(len(letters) - 1):
        first, second = (film.truth.parts[places[i]] for i in (k, k + 1))
        rows, columns = np.meshgrid(np.linspace(0.1, 0.9, 25), np.linspace(0.0, 1.0, 400), indexing="ij")
        points = first.delivered(rows * first.shape[0], columns * first.shape[1])
        there = second.pixels(points)
        both = (there[..., 1] > 3) & (there[..., 1] < second.shape[1] - 4) & (there[..., 0] > 3)
        away = joined(k, points[both]) - joined(k + 1, points[both])
        seam_px.append(np.sqrt(np.mean(away**2)))

    step_px: tuple[list[float], list[float]] = ([], [])  # elsewhere, in overlaps
    for k, place in enumerate(places):
        part = film.truth.parts[place]
        middle = part.shape[0] / 2
        columns = np.arange(part.shape[1], dtype=float)
        off = part.pixels(part.delivered(middle, columns)) - np.stack(np.broadcast_arrays(middle, columns), axis=-1)
        # Displacement of what a pixel shows, before and after the stages took out what they found.
        shown = laid_pixels(k, np.stack(np.broadcast_arrays(middle, columns), axis=-1) + off)
        here = laid_pixels(k, np.stack(np.broadcast_arrays(middle, columns), axis=-1))
        left_over = here - layout.steps[k].at(here[:, 0]) - shown
        true = np.flatnonzero(np.abs(np.diff(off, axis=0)).max(axis=1) > 1e-6)
        made = [int(np.abs(here[:, 0] - column).argmin()) for column in layout.steps[k].columns_px]
        reach = 12
        for column in np.union1d(true, [m for m in made if not np.any(np.abs(true - m) <= reach)]).astype(int):
            if not reach <= column < part.shape[1] - reach - 1:
                continue
            left = float(np.sqrt(np.mean((left_over[column + reach] - left_over[column - reach]) ** 2)))
            x = float(layout.motions[k].apply(here[column])[0])
            seen = any(
                layout.motions[j].apply(np.array([0.0, middle]))[0] < x < ends_of(j)
                for j in (k - 1, k + 1)
                if 0 <= j < len(places)
            )
            step_px[seen].append(left)

    def straight(ideal: FloatArray) -> FloatArray:
        """Places on the straight film, mm, of ideal film points."""
        delivered = film.truth.delivered(film.truth.deformation.measured(ideal))
        out = joined(0, delivered)
        for k, joint in enumerate(layout.joints_px, 1):
            xy = joined(k, delivered)
            out = np.where((xy[..., 0] >= joint)[..., None], xy, out)
        c, s = np.cos(np.radians(exposure.tilt_deg)), np.sin(np.radians(exposure.tilt_deg))
        right, down = np.moveaxis(out - exposure.centre_px, -1, 0) * exposure.pixel_mm
        found = bending.straight(np.stack([c * right + s * down, s * right - c * down], axis=-1))
        return -found if turned else found

    x = np.linspace(-355.0, 355.0, 1421)
    stripes = np.stack([straight(np.stack([x, np.full_like(x, s * defects.STRIPE_MM)], axis=-1)) for s in (1, -1)])
    middle = straight(np.stack([x, np.zeros_like(x)], axis=-1))
    sense = np.sign([np.ptp(middle[:, 0]) and middle[-1, 0] - middle[0, 0], stripes[0, 0, 1] - stripes[1, 0, 1]])
    rest = stripes[..., 1] - stripes[..., 1].mean(axis=1, keepdims=True)
    slope = [np.polyfit(x, r, 1)[0] for r in rest]
    scale = abs(np.polyfit(x, middle[:, 0], 1)[0]) / (1.0 - film.settings.shrinkage) - 1.0
    centre = straight(np.zeros((1, 2)))[0] * sense
    return Errors(
        np.array(seam_px),
        float(1000 * np.sqrt(np.mean(rest**2))),
        float(1000 * abs(slope[0] - slope[1]) * 710),
        float(1e6 * scale),
        (float(centre[0]), float(centre[1])),
        np.array(step_px[True]),
        np.array(step_px[False]),
    )
