"""Coarse to fine: where on the ground a film lies, or an error that says why this cannot be known.

The film is brought to the map through its predicted camera, cut into blocks along its length, and each block is
correlated with the reference over the whole search window. The blocks' correlation surfaces are added for every shift,
rotation and scale that the prediction may be wrong by. The best few places are then followed to finer postings, where
the camera is fitted to hundreds of independent matches; a place counts only if those agree with one camera in most
blocks of the film, and no other place does nearly as well.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from pyproj import Transformer
from scipy import fft
from scipy.ndimage import maximum_filter

from cosp.arrays import BoolArray, Float32Array, FloatArray
from cosp.camera.mapping import MapProjector
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import NoOverlapError, PlacementError
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from cosp.geometry.statistics import nmad
from cosp.geometry.transforms import estimate_affine, ransac
from cosp.matching.film_image import FilmImage
from cosp.matching.footprint import FilmBlock, Footprint
from cosp.matching.ground import (
    Bounds,
    GroundMatches,
    OnGrid,
    Terrain,
    film_lattice,
    ground_pixel_m,
    grown,
    map_bounds,
    match_film_to_ground,
    project_film,
    reduction_for,
)
from cosp.matching.matchers import structural
from cosp.matching.refit import refit_camera
from cosp.matching.relief import SUN_AZIMUTHS_DEG, relief_reference
from cosp.matching.structural import orientation_channels

log = logging.getLogger(__name__)

# Blocks the film is cut into along its length.
_BLOCKS = 8
# What the prediction may be wrong by besides its place.
_ROTATION_RANGE_DEG = 2.0
_SCALE_RANGE = 0.03
# Steps of both such that the outermost block moves by so much.
_HYPOTHESIS_STEP_PX = 2.0
# Candidates followed to a finer posting.
_CANDIDATES = 3
# Peaks of the whole search closer than this are one.
_PEAK_DISTANCE_PX = 24
# Share of a block's pixels that must lie on the reference.
_MIN_COVER = 0.7
_MIN_BLOCKS = 2
# One posting to the next.
_LEVEL_RATIO = 3.5
_TEMPLATE_PX = 81
_SEARCH_PX = 24
_TILE_PX = 176
_STEP_PX = 20
_TILES_ALONG = 24
_GATE_PX = 3.0
_SMOOTHING_PX = 1.5
_BINS = 9


@dataclass(frozen=True)
class _View:
    """The film on the map as one camera would have it, cut into blocks."""

    camera: PanoramicCamera
    turned: bool
    grid: PixelGrid
    channels: Float32Array
    film_mm: FloatArray
    height_m: float
    boxes: tuple[tuple[int, int, int, int], ...]
    masks: tuple[BoolArray, ...]

    def centres_px(self) -> FloatArray:
        """Row and column (N, 2) of the middle of each block."""
        return np.array([[(r0 + r1 - 1) / 2, (c0 + c1 - 1) / 2] for r0, r1, c0, c1 in self.boxes])


@dataclass(frozen=True)
class _Candidate:
    """One place the film may lie at, from the whole search."""

    view: _View
    reference_on: OnGrid
    sun_azimuth_deg: float
    score: float
    rival_score: float
    shifts_px: FloatArray


@dataclass(frozen=True)
class _Placement:
    """A candidate followed to a finer posting."""

    camera: PanoramicCamera
    crs: str
    matches: GroundMatches
    agreeing: BoolArray
    posting_m: float
    residual_m: float

    @property
    def share(self) -> float:
        return float(self.agreeing.mean()) if len(self.agreeing) else 0.0

    def blocks(self) -> tuple[FilmBlock, ...]:
        half = self.camera.half_length_mm
        index = np.clip(((self.matches.film_mm[:, 0] + half) / (2 * half) * _BLOCKS).astype(int), 0, _BLOCKS - 1)
        centres = film_lattice(half, 1.0, _BLOCKS, 1)[:, 0]
        return tuple(
            FilmBlock(float(x), int((index == i).sum()), int((self.agreeing & (index == i)).sum()))
            for i, x in enumerate(centres)
        )


def locate_film(
    film: FilmImage,
    predicted: PanoramicCamera,
    *,
    reference_on: OnGrid | None,
    heights_on: OnGrid,
    crs: str,
    search_m: float,
    coarse_posting_m: float,
    fine_posting_m: float,
    min_score: float,
    min_margin: float,
    min_agreeing: int,
    min_agreeing_share: float,
    min_block_share: float,
    rng: np.random.Generator,
    threads: int,
) -> Footprint:
    """The place of a film on the ground, from a prediction that may be far off.

    Parameters
    ----------
    film : FilmImage
    predicted : PanoramicCamera
    reference_on : function of a PixelGrid, or None
        Reference image on a map grid, NaN outside; without one the shaded relief of `heights_on` takes its place.
    heights_on : function of a PixelGrid
        Ellipsoidal heights, NaN outside.
    crs : str
        Map projection in metres to work in.
    search_m : float
        Largest error of the predicted place, in each direction.
    coarse_posting_m, fine_posting_m : float
        First and last posting; the last is not finer than the film.
    min_score : float
        Least height of the peak of the whole search above its surroundings, in standard deviations.
    min_margin : float
        Least ratio of agreeing matches to those of the best other candidate.
    min_agreeing, min_agreeing_share : int, float
        Least number and share of matches that agree with one camera.
    min_block_share : float
        Least share of the film's blocks with matches in which most of them agree.
    rng : numpy Generator
    threads : int

    Raises
    ------
    NoOverlapError
        If film and reference share no ground within the search window.
    PlacementError
        If no place stands out; says what was found.
    """
    scene = predicted.scene
    pixel_m = ground_pixel_m(predicted, film.pixel_mm, 0.0)
    last_m = max(fine_posting_m, pixel_m)
    finest = film.reduced(reduction_for(last_m, pixel_m))
    coarse = finest.reduced(reduction_for(coarse_posting_m, pixel_m * finest.pixel_mm / film.pixel_mm))

    references = (
        [(0.0, reference_on)]
        if reference_on is not None
        else [(azimuth, relief_reference(heights_on, azimuth)) for azimuth in SUN_AZIMUTHS_DEG]
    )
    variants = [(predicted, False), (predicted.turned(), True)]
    terrain = Terrain.on(heights_on, grown(map_bounds(predicted, crs), search_m), crs, coarse_posting_m)
    views = [_view(coarse, camera, turned, terrain.mean_m, crs, coarse_posting_m) for camera, turned in variants]
    candidates: list[_Candidate] = []
    for azimuth, reference in references:
        candidates += _search(scene, views, reference, azimuth, search_m, coarse_posting_m, threads)
    candidates.sort(key=lambda candidate: -candidate.score)
    if not candidates:
        raise PlacementError(f"{scene}: no block of the film has texture to be placed by")
    log.info("best places of the whole search: %s", ", ".join(_described(c, coarse_posting_m) for c in candidates[:6]))
    if candidates[0].score < min_score:
        raise PlacementError(
            f"{scene}: cannot be placed: the highest correlation peak stands {candidates[0].score:.1f} standard "
            f"deviations above its surroundings, {min_score:.1f} are needed"
        )

    postings = _postings(coarse_posting_m, last_m)
    tried: list[tuple[_Candidate, _Placement]] = []
    for candidate in candidates[:_CANDIDATES]:
        camera = _camera_of(candidate, terrain, predicted.origin)
        level = _level_film(finest, pixel_m * finest.pixel_mm / film.pixel_mm, postings[0])
        try:
            placement = _placed(level, camera, candidate, heights_on, crs, postings[0], rng, threads)
        except NoOverlapError:  # a wrong candidate may lead anywhere
            continue
        log.info(
            "%s: %d of %d matches agree at %.0f m",
            _described(candidate, coarse_posting_m), placement.agreeing.sum(), len(placement.agreeing), postings[0],
        )  # fmt: skip
        tried.append((candidate, placement))
    if not tried:
        raise PlacementError(f"{scene}: cannot be placed: no candidate of the search lies on the reference DEM")
    tried.sort(key=lambda pair: -int(pair[1].agreeing.sum()))
    best, placement = tried[0]
    rivals = [_against(other, placement) for _, other in tried[1:]]
    margin = float(placement.agreeing.sum() / max([1, *rivals]))
    _check(scene, placement, min_agreeing, min_agreeing_share, min_block_share)
    if margin < min_margin:
        raise PlacementError(
            f"{scene}: cannot be placed: {int(placement.agreeing.sum())} matches agree with one place and "
            f"{max(rivals)} with another; the first must have {min_margin:.1f} times as many"
        )
    for posting in postings[1:]:
        level = _level_film(finest, pixel_m * finest.pixel_mm / film.pixel_mm, posting)
        placement = _placed(level, placement.camera, best, heights_on, crs, posting, rng, threads)
        log.info("%d of %d matches agree at %.1f m", placement.agreeing.sum(), len(placement.agreeing), posting)
        _check(scene, placement, min_agreeing, min_agreeing_share, min_block_share)

    before, after = (
        c.origin.ecef_from_local(c.locate(np.zeros(2), terrain.mean_m)) for c in (predicted, placement.camera)
    )
    shift = (after - before) @ predicted.origin.axes.T
    half = np.array([placement.camera.half_length_mm, placement.camera.half_width_mm])
    corners = placement.camera.locate_geodetic(np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * half, terrain.mean_m)
    return Footprint(
        scene=scene,
        camera=placement.camera,
        shift_east_m=float(shift[0]),
        shift_north_m=float(shift[1]),
        turned=best.view.turned,
        score=float(best.score),
        margin=margin,
        agreeing_share=placement.share,
        residual_m=placement.residual_m,
        posting_m=placement.posting_m,
        reference="relief" if reference_on is None else "image",
        sun_azimuth_deg=best.sun_azimuth_deg,
        corners_lonlat=tuple((float(lon), float(lat)) for lon, lat, _ in corners),
        blocks=placement.blocks(),
    )


def _check(scene: str, placement: _Placement, min_agreeing: int, min_share: float, min_block_share: float) -> None:
    """Refuse a placement that its matches do not support."""
    agreeing, count = int(placement.agreeing.sum()), len(placement.agreeing)
    blocks = [block for block in placement.blocks() if block.matches >= 3]
    good = sum(block.agreeing >= max(3, 0.5 * min_share * block.matches) for block in blocks)
    share = good / len(blocks) if blocks else 0.0
    if agreeing < min_agreeing or placement.share < min_share or share < min_block_share or good < _MIN_BLOCKS:
        raise PlacementError(
            f"{scene}: cannot be placed: {agreeing} of {count} matches at {placement.posting_m:.0f} m agree with one "
            f"camera, in {good} of {len(blocks)} blocks; needed are {min_agreeing} matches, {min_share:.0%} of all, "
            f"in {min_block_share:.0%} of the blocks"
        )


def _postings(coarse_m: float, last_m: float) -> list[float]:
    """Postings after the first search, each finer than the last by about the same ratio."""
    count = max(1, round(math.log(max(coarse_m / last_m, 1.0)) / math.log(_LEVEL_RATIO)))
    return [float(coarse_m * (last_m / coarse_m) ** ((i + 1) / count)) for i in range(count)]


def _level_film(finest: FilmImage, pixel_m: float, posting_m: float) -> FilmImage:
    return finest.reduced(reduction_for(posting_m, pixel_m))


def _described(candidate: _Candidate, posting_m: float) -> str:
    row, column = np.nanmean(candidate.shifts_px, axis=0) * posting_m / 1000
    turned = " turned" if candidate.view.turned else ""
    place = f"{column:+.1f} km east, {-row:+.1f} km north{turned}"
    return f"({place}: {candidate.score:.1f}, rival {candidate.rival_score:.1f})"


def _against(other: _Placement, best: _Placement) -> int:
    """How many matches that agree with another placement contradict the best one.

    A candidate that is right at one end of the film agrees there with the right one, and is no rival.
    """
    chosen = other.agreeing
    if not chosen.any():
        return 0
    ground = best.camera.origin.local_from_geodetic(other.matches.lonlath(best.crs)[chosen])
    distance = np.linalg.norm(other.matches.film_mm[chosen] - best.camera.project(ground), axis=1)
    gate_mm = 2 * _GATE_PX * best.posting_m * _film_mm_per_m(best.camera, 0.0)
    return int((~(distance <= gate_mm)).sum())


def _view(film: FilmImage, camera: PanoramicCamera, turned: bool, height_m: float, crs: str, posting_m: float) -> _View:
    """The film on a map of constant height, in blocks along its length."""
    bounds: Bounds = map_bounds(camera, crs, (height_m, height_m))
    grid = PixelGrid.covering(grown(bounds, 2 * posting_m), posting_m)
    projector = MapProjector(camera, crs, grid.bounds)
    heights = np.full(grid.shape, height_m, np.float32)
    image = project_film(film, projector, grid, heights)
    centres = grid.centres()
    film_mm = projector.film(centres[..., 0], centres[..., 1], heights)
    channels = orientation_channels(image, bins=_BINS, sigma_px=_SMOOTHING_PX)
    textured = np.isfinite(image) & (channels.max(axis=0) > 0)
    edges = np.linspace(-camera.half_length_mm, camera.half_length_mm, _BLOCKS + 1)
    boxes, masks = [], []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        with np.errstate(invalid="ignore"):
            inside = textured & (film_mm[..., 0] >= low) & (film_mm[..., 0] < high)
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        if inside.sum() < 200:
            continue
        box = (int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1)
        boxes.append(box)
        masks.append(inside[box[0] : box[1], box[2] : box[3]])
    return _View(camera, turned, grid, channels, film_mm, height_m, tuple(boxes), tuple(masks))


def _search(
    scene: str,
    views: Sequence[_View],
    reference_on: OnGrid,
    azimuth_deg: float,
    search_m: float,
    posting_m: float,
    threads: int,
) -> list[_Candidate]:
    """The best places of each view over the whole search window."""
    boxes = [view.grid.bounds for view in views]
    union = (min(b[0] for b in boxes), min(b[1] for b in boxes), max(b[2] for b in boxes), max(b[3] for b in boxes))
    radius = round(search_m / posting_m)
    grid = PixelGrid.covering(grown(union, (radius + 1) * posting_m), posting_m)
    reference = reference_on(grid)
    valid = np.isfinite(reference)
    if not valid.any():
        area = ", ".join(f"{v:.0f}" for v in grid.bounds)
        raise NoOverlapError(f"{scene}: the reference holds nothing within ({area}) m, where the film was looked for")
    spectra = _ReferenceSpectra(reference, valid, threads)
    candidates: list[_Candidate] = []
    for view in views:
        row0 = round((view.grid.y0 - grid.y0) / grid.step_y)
        column0 = round((view.grid.x0 - grid.x0) / grid.step_x)
        surfaces = np.stack(
            [
                spectra.surface(
                    view.channels[:, r0:r1, c0:c1] * mask, mask, (row0 + r0, column0 + c0), radius
                )
                for (r0, r1, c0, c1), mask in zip(view.boxes, view.masks, strict=True)
            ]
        ) if view.boxes else np.empty((0, 2 * radius + 1, 2 * radius + 1), np.float32)  # fmt: skip
        usable = np.array([np.isfinite(s).mean() > 0.02 for s in surfaces], bool)
        if usable.sum() < _MIN_BLOCKS:
            continue
        candidates += _candidates(view, surfaces, usable, reference_on, azimuth_deg)
    return candidates


class _ReferenceSpectra:
    """Fourier transforms of a reference's channels, for templates with a mask."""

    def __init__(self, reference: Float32Array, valid: BoolArray, threads: int) -> None:
        channels = orientation_channels(reference, bins=_BINS, sigma_px=_SMOOTHING_PX)
        valid = valid & (channels.max(axis=0) > 0)
        mean = channels[:, valid].mean(axis=1) if valid.any() else np.zeros(len(channels), np.float32)
        centred = (channels - mean[:, None, None]) * valid
        rows, columns = reference.shape
        self.threads = threads
        self.size = (fft.next_fast_len(rows, real=True), fft.next_fast_len(columns, real=True))
        self.channels = self._transform(centred)
        self.energy = self._transform((centred**2).sum(axis=0))
        self.valid = self._transform(valid.astype(np.float32))

    def surface(self, template: Float32Array, mask: BoolArray, place: tuple[int, int], radius: int) -> Float32Array:
        """Correlation of a template about the place (row, column) of its first pixel; NaN where it is not covered."""
        count = int(mask.sum())
        centred = (template - template[:, mask].mean(axis=1)[:, None, None]) * mask
        area = self._transform(mask.astype(np.float32)).conj()
        # The shift of the place is taken out by cropping; templates lie inside the reference for every shift.
        row, column = place
        crop = (slice(row - radius, row + radius + 1), slice(column - radius, column + radius + 1))
        product = self._back((self._transform(centred.astype(np.float32)).conj() * self.channels).sum(axis=0))[crop]
        energy = self._back(area * self.energy)[crop]
        covered = self._back(area * self.valid)[crop]
        good = (covered >= _MIN_COVER * count) & (energy > 1e-6 * count)
        norm = np.sqrt(float((centred**2).sum()) * np.where(good, energy, 1.0))
        return np.where(good, product / np.maximum(norm, 1e-12), np.nan).astype(np.float32)

    def _transform(self, array: Float32Array) -> FloatArray:
        return np.asarray(fft.rfft2(array, s=self.size, workers=self.threads))

    def _back(self, spectrum: FloatArray) -> Float32Array:
        return np.asarray(fft.irfft2(spectrum, s=self.size, workers=self.threads))


def _candidates(
    view: _View, surfaces: Float32Array, usable: BoolArray, reference_on: OnGrid, azimuth_deg: float
) -> list[_Candidate]:
    """Highest places of the blocks' surfaces, added for every rotation and scale."""
    indices = np.flatnonzero(usable)
    centres = view.centres_px()
    about = centres.mean(axis=0)
    arms = centres[indices] - about
    reach = float(np.linalg.norm(arms, axis=1).max())
    standard = np.stack([_standardised(surfaces[i]) for i in indices])
    covered = np.isfinite(surfaces[indices])
    rows, columns = standard.shape[1:]
    best = np.full((rows, columns), -np.inf, np.float32)
    argument = np.zeros((rows, columns), np.int32)
    offsets: list[FloatArray] = []
    for rotation in _steps(np.radians(_ROTATION_RANGE_DEG), _HYPOTHESIS_STEP_PX / reach):
        for scale in _steps(_SCALE_RANGE, _HYPOTHESIS_STEP_PX / reach):
            c, s = (1 + scale) * math.cos(rotation) - 1, (1 + scale) * math.sin(rotation)
            offset = np.round(arms @ np.array([[c, s], [-s, c]])).astype(np.intp)
            total = np.zeros((rows, columns), np.float32)
            number = np.zeros((rows, columns), np.float32)
            for surface, cover, (down, right) in zip(standard, covered, offset, strict=True):
                target, source = _overlap(rows, int(down)), _overlap(rows, -int(down))
                target_c, source_c = _overlap(columns, int(right)), _overlap(columns, -int(right))
                total[source, source_c] += surface[target, target_c]
                number[source, source_c] += cover[target, target_c]
            score = np.where(number >= _MIN_BLOCKS, total / np.sqrt(np.maximum(number, 1)), -np.inf)
            better = score > best
            best[better] = score[better]
            argument[better] = len(offsets)
            offsets.append(offset)
    found: list[_Candidate] = []
    remaining = best.copy()
    centre = np.array([(rows - 1) // 2, (columns - 1) // 2])
    peaks: list[tuple[float, FloatArray]] = []
    for _ in range(_CANDIDATES + 1):
        row, column = np.unravel_index(int(remaining.argmax()), remaining.shape)
        if not np.isfinite(remaining[row, column]):
            break
        shift = np.full((len(view.boxes), 2), np.nan)
        for i, offset in zip(indices, offsets[int(argument[row, column])], strict=True):
            place = np.array([row, column]) + offset
            shift[i] = _top_near(surfaces[i], place) - centre
        peaks.append((float(remaining[row, column]), shift))
        near = _PEAK_DISTANCE_PX
        remaining[max(row - near, 0) : row + near + 1, max(column - near, 0) : column + near + 1] = -np.inf
    for index, (height, shift) in enumerate(peaks):
        rivals = [other for i, (other, _) in enumerate(peaks) if i != index]
        known = np.where(np.isfinite(shift), shift, np.nan)
        if np.isfinite(known).all(axis=1).sum() >= _MIN_BLOCKS:
            found.append(_Candidate(view, reference_on, azimuth_deg, height, max(rivals, default=0.0), known[indices]))
            # Blocks without a surface take no part from here on.
            boxes = tuple(view.boxes[i] for i in indices)
            masks = tuple(view.masks[i] for i in indices)
            found[-1] = replace(found[-1], view=replace(view, boxes=boxes, masks=masks))
    return found


def _standardised(surface: Float32Array) -> Float32Array:
    """A surface with near-by maxima spread, in standard deviations about its median; 0 where there is none."""
    finite = np.isfinite(surface)
    spread = maximum_filter(np.where(finite, surface, -1.0), size=3)
    values = spread[finite]
    return np.where(finite, (spread - np.median(values)) / max(nmad(values), 1e-6), 0.0).astype(np.float32)


def _steps(limit: float, step: float) -> FloatArray:
    count = math.ceil(limit / step)
    return np.arange(-count, count + 1) * step


def _overlap(length: int, shift: int) -> slice:
    return slice(max(shift, 0), length + min(shift, 0))


def _top_near(surface: Float32Array, place: FloatArray, reach: int = 2) -> FloatArray:
    """Highest pixel near a place of a surface; NaN outside."""
    row, column = (int(v) for v in place)
    row0, column0 = max(row - reach, 0), max(column - reach, 0)
    part = surface[row0 : max(row + reach + 1, 0), column0 : max(column + reach + 1, 0)]
    if part.size == 0 or not np.isfinite(part).any():
        return np.array([np.nan, np.nan])
    top = np.unravel_index(int(np.nanargmax(part)), part.shape)
    return np.array([row0 + top[0], column0 + top[1]], float)


def _camera_of(candidate: _Candidate, terrain: Terrain, origin: LocalFrame) -> PanoramicCamera:
    """The view's camera moved to a candidate's place and fitted to its blocks, in the given frame."""
    view = candidate.view
    known = np.isfinite(candidate.shifts_px).all(axis=1)
    centres = view.centres_px()[known]
    shifts = candidate.shifts_px[known]
    pixels = np.round(centres).astype(int)
    film_mm = view.film_mm[pixels[:, 0], pixels[:, 1]]
    found = np.round(centres) + shifts
    east_north = view.grid.points(found[:, 0], found[:, 1])
    smooth = replace(
        terrain,
        heights_m=np.asarray(cv2.blur(terrain.heights_m, (41, 41), borderType=cv2.BORDER_REPLICATE), np.float32),
    )
    height = smooth.at(east_north)
    to_geodetic = Transformer.from_crs(terrain.crs, "EPSG:4326", always_xy=True)
    lon, lat = to_geodetic.transform(east_north[:, 0], east_north[:, 1])

    # The whole camera is carried over the ellipsoid, so that it keeps its height and its tilt.
    start = view.grid.points(centres[:, 0], centres[:, 1]).mean(axis=0)
    end = start + np.array([1.0, -1.0]) * shifts[:, ::-1].mean(axis=0) * view.grid.step_x
    lon_change, lat_change = np.subtract(to_geodetic.transform(*end), to_geodetic.transform(*start))
    moved = replace(
        view.camera,
        origin=replace(
            view.camera.origin,
            longitude_deg=view.camera.origin.longitude_deg + float(lon_change),
            latitude_deg=view.camera.origin.latitude_deg + float(lat_change),
        ),
    )
    ground = moved.origin.local_from_geodetic(np.column_stack([lon, lat, height]))
    # A block is one template, so its place is known to about a pixel of the coarse posting.
    sigma_mm = np.full(len(film_mm), _film_mm_per_m(moved, terrain.mean_m) * view.grid.step_x * 1.5)
    return refit_camera(moved, film_mm, ground, sigma_mm).camera.moved_to(origin)


def _film_mm_per_m(camera: PanoramicCamera, height_m: float) -> float:
    return 1.0 / ground_pixel_m(camera, 1.0, height_m)


def _placed(
    film: FilmImage,
    camera: PanoramicCamera,
    candidate: _Candidate,
    heights_on: OnGrid,
    crs: str,
    posting_m: float,
    rng: np.random.Generator,
    threads: int,
) -> _Placement:
    """A camera fitted to matches at a posting, and which of them agree with it."""
    mm_per_m = _film_mm_per_m(camera, 0.0)
    rows = int(np.clip(round(2 * camera.half_width_mm / mm_per_m / posting_m / 150), 1, 3))
    terrain = Terrain.on(heights_on, map_bounds(camera, crs), crs, max(posting_m, 200.0))
    matches = match_film_to_ground(
        film,
        camera,
        film_lattice(camera.half_length_mm, camera.half_width_mm, _TILES_ALONG, rows),
        reference_on=candidate.reference_on,
        heights_on=heights_on,
        terrain=terrain,
        # Scores and ratios are lax here: agreement with one camera decides.
        matcher=structural(_TEMPLATE_PX, _SEARCH_PX, 0.1, 0.97, 1.5),
        posting_m=posting_m,
        tile_px=_TILE_PX,
        step_px=_STEP_PX,
        margin_px=_TEMPLATE_PX // 2 + _SEARCH_PX,
        threads=threads,
    )
    nothing = np.zeros(len(matches), bool)
    if len(matches) < 6:
        return _Placement(camera, crs, matches, nothing, posting_m, float("nan"))
    ground = camera.origin.local_from_geodetic(matches.lonlath(crs))
    pixel_mm = mm_per_m * posting_m
    predicted = camera.project(ground)
    seen = np.isfinite(predicted).all(axis=1)
    _, first = ransac(
        estimate_affine,
        predicted[seen],
        matches.film_mm[seen],
        minimum=3,
        gate=2 * _GATE_PX * pixel_mm,
        trials=400,
        rng=rng,
    )
    agreeing = nothing.copy()
    agreeing[seen] = first
    if agreeing.sum() < 6:
        return _Placement(camera, crs, matches, nothing, posting_m, float("nan"))
    fitted = camera
    for _ in range(2):
        sigma = np.full(int(agreeing.sum()), pixel_mm)
        fitted = refit_camera(fitted, matches.film_mm[agreeing], ground[agreeing], sigma, prior=camera).camera
        distance = np.linalg.norm(matches.film_mm - fitted.project(ground), axis=1)
        agreeing = np.nan_to_num(distance, nan=np.inf) <= _GATE_PX * pixel_mm
        if agreeing.sum() < 6:
            return _Placement(camera, crs, matches, agreeing, posting_m, float("nan"))
    return _Placement(fitted, crs, matches, agreeing, posting_m, float(np.median(distance[agreeing]) / mm_per_m))
