"""The first search: where on the ground a film may lie, from a prediction that may be far off in every respect.

The film is cut into blocks along its length. Each block is brought to the map through the predicted camera, in each of
the four ways that a film can be digitised, and correlated with the reference over the whole search window. The blocks'
correlation surfaces are added for every shift, rotation and scale that the prediction may be wrong by. A template bears
a rotation of a few degrees only; larger ones are searched by turning the templates themselves, coarsely first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from scipy import fft
from scipy.ndimage import maximum_filter

from cosp.arrays import BoolArray, Float32Array, FloatArray, IntArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.grids import PixelGrid
from cosp.geometry.statistics import nmad
from cosp.matching.film_image import FilmImage
from cosp.matching.structural import orientation_channels

# Blocks the film is cut into along its length.
BLOCKS = 8
# Largest errors of heading and scale that are searched, and how far one set of templates reaches.
_ROTATION_RANGE_DEG = 10.0
_SCALE_RANGE = 0.05
_ROTATION_REACH_DEG = 2.5
_SCALE_REACH = 0.025
_ROTATION_STEP_DEG = 5.0
_SCALE_STEP = 0.05
# Places that one view of the film gives, and views that the wide search hands on to the finer posting.
_PEAKS = 3
_VIEWS = 8
# Peaks closer than this are one.
_PEAK_DISTANCE_M = 6000.0
# Share of a template that must lie on the reference, and what it must hold of texture.
_MIN_COVER = 0.7
_MIN_TEXTURE = 0.02
_MIN_BLOCKS = 2
_SMOOTHING_PX = 1.5
_BINS = 5
# Surfaces are added at every second pixel, after the highest of its neighbours has been taken.
_POOL = 2
# What a grid holds beyond the window, so that one of half the posting holds that of a search at the whole one.
_SPARE_PX = 16
# Rotations and scales are so far apart that the outermost block moves by so many of these pixels.
_GUESS_STEP = 2.0
# Degree of the polynomial that takes a block's map to its film.
_DEGREE = 3


@dataclass(frozen=True)
class Way:
    """How a film was digitised: turned by 180 degrees, mirrored across its length, both or neither."""

    turned: bool = False
    mirrored: bool = False

    def __str__(self) -> str:
        return {(0, 0): "as it is", (1, 0): "turned", (0, 1): "mirrored", (1, 1): "turned and mirrored"}[
            int(self.turned), int(self.mirrored)
        ]


WAYS = (Way(), Way(turned=True), Way(mirrored=True), Way(turned=True, mirrored=True))


@dataclass(frozen=True)
class View:
    """One guess at the film: its way, and how heading (radians) and scale differ from the prediction."""

    way: Way
    rotation: float = 0.0
    scale: float = 0.0

    @property
    def matrix(self) -> FloatArray:
        """From predicted to guessed vectors on the map, (east, north)."""
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        return (1 + self.scale) * np.array([[c, -s], [s, c]])


@dataclass(frozen=True)
class Candidate:
    """One place the film may lie at.

    Parameters
    ----------
    view : View
        With the rotation and the scale found.
    score : float
        Height of the peak in standard deviations of its surroundings.
    x_mm : (N,) array
        Middle of each block along the film.
    predicted_m, found_m : (N, 2) arrays
        Where it was expected on the map, and where it was found.
    """

    view: View
    score: float
    x_mm: FloatArray
    predicted_m: FloatArray
    found_m: FloatArray

    @property
    def shift_m(self) -> FloatArray:
        """From the predicted to the found place of the film, (east, north)."""
        return np.asarray((self.found_m - self.predicted_m).mean(axis=0))

    def is_like(self, other: Candidate) -> bool:
        """Whether both are one place of a film that lies one way round."""
        return self.view.way == other.view.way and bool(np.linalg.norm(self.shift_m - other.shift_m) < _PEAK_DISTANCE_M)


@dataclass(frozen=True)
class ScoreMap:
    """Best score of every shift, for a film that lies one way round.

    Parameters
    ----------
    view : View
    scores : (rows, columns) array
        North up; NaN where too little of the film lies on the reference.
    step_m : float
    """

    view: View
    scores: Float32Array
    step_m: float


@dataclass(frozen=True)
class Found:
    """What a search found: candidates, best first, and the map of scores of each way."""

    candidates: tuple[Candidate, ...]
    maps: tuple[ScoreMap, ...]

    def rival_score(self, candidate: Candidate) -> float:
        """Score of the best other place than a candidate's."""
        return max((c.score for c in self.candidates if not c.is_like(candidate)), default=0.0)

    def and_more(self, other: Found) -> Found:
        """Both together; one candidate of each place, of each way the better map."""
        ordered = sorted([*self.candidates, *other.candidates], key=lambda candidate: -candidate.score)
        kept: list[Candidate] = []
        for candidate in ordered:
            if not any(candidate.is_like(better) for better in kept):
                kept.append(candidate)
        maps = {score_map.view.way: score_map for score_map in other.maps}
        for score_map in self.maps:
            rival = maps.get(score_map.view.way)
            if rival is None or np.nanmax(score_map.scores) >= np.nanmax(rival.scores):
                maps[score_map.view.way] = score_map
        return Found(tuple(kept), tuple(maps[way] for way in WAYS if way in maps))


NOTHING = Found((), ())


@dataclass(frozen=True)
class _Block:
    """A piece of the film on the map: a polynomial from offsets about its middle to film points."""

    low_mm: float
    high_mm: float
    half_width_mm: float
    middle_m: FloatArray
    reach_m: float
    coefficients: FloatArray

    def film(self, offsets_m: FloatArray) -> FloatArray:
        """Film points (..., 2) of map offsets (..., 2); NaN outside the block."""
        film_mm = _terms(offsets_m / self.reach_m) @ self.coefficients
        x, y = film_mm[..., 0], film_mm[..., 1]
        outside = (x < self.low_mm) | (x >= self.high_mm) | (np.abs(y) > self.half_width_mm)
        film_mm[outside | (np.abs(offsets_m) > self.reach_m).any(axis=-1)] = np.nan
        return np.asarray(film_mm)


class FilmSearch:
    """Searches a window of the ground for a film, at one posting.

    Parameters
    ----------
    film : FilmImage
        About as fine as the posting.
    camera : PanoramicCamera
        The prediction.
    height_m : float
        Of the ground, taken to be level.
    crs : str
        Map projection in metres.
    posting_m : float
    search_m : float
        Largest error of the predicted place, in each direction.
    threads : int
    grid : PixelGrid, optional
        Of the references, for a wide search; one that just holds the window by default.
    """

    def __init__(
        self,
        film: FilmImage,
        camera: PanoramicCamera,
        *,
        height_m: float,
        crs: str,
        posting_m: float,
        search_m: float,
        threads: int,
        grid: PixelGrid | None = None,
    ) -> None:
        self.posting_m = posting_m
        self._threads = threads
        self._films = {way: film.laid(turned=way.turned, mirrored=way.mirrored) for way in WAYS}
        self._blocks = _blocks(camera, height_m, crs)
        self._middles = np.array([block.middle_m for block in self._blocks])
        self._arms = self._middles - self._middles.mean(axis=0)
        # The same views are compared with one reference after another.
        kept = BLOCKS * len(self.narrow_views() if grid is None else self.wide_views())
        self._template = lru_cache(kept)(self._make_template)
        self._radius = _POOL * math.ceil(search_m / posting_m / _POOL)
        turning = math.hypot(math.radians(_ROTATION_RANGE_DEG + _ROTATION_REACH_DEG), _SCALE_RANGE + _SCALE_REACH)
        self._margin = math.ceil(turning * float(np.linalg.norm(self._arms, axis=1).max()) / posting_m) + 2
        largest = 1 + _SCALE_RANGE + _SCALE_REACH
        self._half = [math.ceil(block.reach_m * largest / posting_m) + 1 for block in self._blocks]
        reach = (self._radius + self._margin + max(self._half) + _SPARE_PX) * posting_m
        low, high = self._middles.min(axis=0) - reach, self._middles.max(axis=0) + reach
        self.grid = grid or PixelGrid.covering((low[0], low[1], high[0], high[1]), posting_m)
        self._pixels = np.round(np.stack(self.grid.pixels(self._middles), axis=-1)).astype(int)

    def narrow_views(self) -> list[View]:
        """The film as predicted, whichever way round."""
        return [View(way) for way in WAYS]

    def wide_views(self) -> list[View]:
        """The film in every heading and scale that it may have, whichever way round."""
        rotations = np.radians(_steps(_ROTATION_RANGE_DEG, _ROTATION_STEP_DEG))
        scales = _steps(_SCALE_RANGE, _SCALE_STEP)
        return [View(way, float(r), float(s)) for way in WAYS for r in rotations for s in scales]

    def run(self, references: Sequence[Prepared], views: Sequence[View]) -> Found:
        """The best places of some views of the film.

        Parameters
        ----------
        references : prepared references
            The evidence of several is added.
        views : View of each guess
        """

        def work(view: View) -> Found:
            return self._peaks(view, references)

        if self._threads > 1:
            with ThreadPoolExecutor(self._threads) as pool:
                results = list(pool.map(work, views))
        else:
            results = [work(view) for view in views]
        found = NOTHING
        for result in results:
            found = found.and_more(result)
        return found

    def prepared(self, reference: Float32Array) -> Prepared:
        """A reference on `grid`, NaN where there is nothing, made ready to be compared with many views."""
        channels = orientation_channels(reference, bins=_BINS, sigma_px=_SMOOTHING_PX)
        valid = np.isfinite(reference) & (channels.max(axis=0) > 0)
        if valid.any():
            channels -= channels[:, valid].mean(axis=1)[:, None, None]
        channels *= valid
        result = []
        for (row, column), half in zip(self._pixels, self._half, strict=True):
            reach = self._radius + self._margin + half
            window = (slice(row - reach, row + reach + 1), slice(column - reach, column + reach + 1))
            result.append(_BlockReference(channels[:, *window], valid[window], half))
        return result

    def _peaks(self, view: View, references: Sequence[Prepared]) -> Found:
        """Highest places of the blocks' surfaces, added for every rotation and scale near a view's."""
        moved_px = self._arms @ (view.matrix - np.eye(2)).T / self.posting_m * [1, -1]
        starts = np.round(moved_px[:, ::-1]).astype(int)  # rows, columns
        surfaces, which = [], []
        for index in range(len(self._blocks)):
            template = self._template(index, view)
            if template is None:
                continue
            channels, mask = template
            spectrum = references[0][index].spectrum(channels)
            norm = math.sqrt(float((channels**2).sum()) * float(mask.sum()))
            first = self._margin + starts[index]
            for reference in references:
                surface = reference[index].surface(spectrum, norm, first, 2 * self._radius + 1)
                if np.isfinite(surface).mean() > 0.005:
                    surfaces.append(surface)
                    which.append(index)
        chosen = np.array(which, int)
        if len(np.unique(chosen)) < _MIN_BLOCKS:
            return NOTHING
        return self._added(view, np.stack(surfaces), chosen, starts)

    def _make_template(self, index: int, view: View) -> tuple[Float32Array, BoolArray] | None:
        """Channels of a block as a view has it, and where they hold texture."""
        block, half = self._blocks[index], self._half[index]
        step = np.arange(-half, half + 1) * self.posting_m
        offsets = np.stack(np.broadcast_arrays(step[None, :], -step[:, None]), axis=-1)
        film_mm = block.film(offsets @ np.linalg.inv(view.matrix).T)
        image = self._films[view.way].sample(film_mm)
        channels = orientation_channels(image, bins=_BINS, sigma_px=_SMOOTHING_PX)
        mask = np.isfinite(image) & (channels.max(axis=0) > 0)
        if mask.sum() < max(30.0, _MIN_TEXTURE * float(np.isfinite(film_mm[..., 0]).sum())):
            return None
        channels = (channels - channels[:, mask].mean(axis=1)[:, None, None]) * mask
        return channels.astype(np.float32), mask

    def _added(self, view: View, surfaces: Float32Array, which: IntArray, starts: IntArray) -> Found:
        indices = np.unique(which)
        standard, covered = zip(*(_standardised(surfaces[which == index]) for index in indices), strict=True)
        reach = float(np.linalg.norm(self._arms, axis=1).max()) / self.posting_m / _POOL
        shape = standard[0].shape
        best = np.full(shape, -np.inf, np.float32)
        argument = np.zeros(shape, np.int32)
        guesses: list[tuple[View, IntArray]] = []
        for rotation in _steps(math.radians(_ROTATION_REACH_DEG), _GUESS_STEP / reach):
            for scale in _steps(_SCALE_REACH, _GUESS_STEP / reach):
                guess = View(view.way, view.rotation + float(rotation), view.scale + float(scale))
                moved = self._arms @ (guess.matrix - np.eye(2)).T / self.posting_m * [1, -1]
                offsets = np.round((moved[:, ::-1] - starts) / _POOL).astype(int)
                total, number = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
                for surface, cover, index in zip(standard, covered, indices, strict=True):
                    down, right = (int(v) for v in offsets[index])
                    source = (_overlap(shape[0], down), _overlap(shape[1], right))
                    target = (_overlap(shape[0], -down), _overlap(shape[1], -right))
                    total[target] += surface[source]
                    number[target] += cover[source]
                score = np.where(number >= _MIN_BLOCKS, total / np.sqrt(np.maximum(number, 1)), -np.inf)
                better = score > best
                best[better] = score[better]
                argument[better] = len(guesses)
                guesses.append((guess, offsets))
        scores = ScoreMap(view, np.where(np.isfinite(best), best, np.nan), _POOL * self.posting_m)
        candidates = []
        remaining = best.copy()
        near = round(_PEAK_DISTANCE_M / scores.step_m)
        for _ in range(_PEAKS):
            row, column = (int(v) for v in np.unravel_index(int(remaining.argmax()), shape))
            if not np.isfinite(remaining[row, column]):
                break
            guess, offsets = guesses[int(argument[row, column])]
            candidate = self._candidate(
                guess, float(best[row, column]), surfaces, which, starts, (row, column), offsets
            )
            if candidate is not None:
                candidates.append(candidate)
            remaining[max(row - near, 0) : row + near + 1, max(column - near, 0) : column + near + 1] = -np.inf
        return Found(tuple(candidates), (scores,) if np.isfinite(best).any() else ())

    def _candidate(
        self,
        guess: View,
        score: float,
        surfaces: Float32Array,
        which: IntArray,
        starts: IntArray,
        place: tuple[int, int],
        offsets: IntArray,
    ) -> Candidate | None:
        """A peak of the sum brought back to the highest place of each block's own surface near it."""
        indices = np.unique(which)
        shifts = np.full((len(indices), 2), np.nan)
        for i, index in enumerate(indices):
            together = surfaces[which == index].mean(axis=0)
            at = _POOL * (np.array(place) + offsets[index])
            shifts[i] = _top_near(together, at) - self._radius + starts[index]
        known = np.isfinite(shifts).all(axis=1)
        if known.sum() < _MIN_BLOCKS:
            return None
        predicted = self._middles[indices[known]]
        pixels = self._pixels[indices[known]] + shifts[known]
        x_mm = np.array([(self._blocks[i].low_mm + self._blocks[i].high_mm) / 2 for i in indices[known]])
        return Candidate(guess, score, x_mm, predicted, self.grid.points(pixels[:, 0], pixels[:, 1]))


class _BlockReference:
    """The surroundings of one block in the reference, transformed once for many templates."""

    def __init__(self, channels: Float32Array, valid: BoolArray, half: int) -> None:
        rows, columns = valid.shape
        self._size = (fft.next_fast_len(rows), fft.next_fast_len(columns, real=True))
        self._channels = fft.rfft2(np.ascontiguousarray(channels), s=self._size)
        # Energy and cover below a template are taken to be those below its box.
        box = (2 * half + 1, 2 * half + 1)
        inside = (slice(half, rows - half), slice(half, columns - half))
        self._energy = cv2.blur(np.einsum("kij,kij->ij", channels, channels), box)[inside]
        self._cover = cv2.blur(valid.astype(np.float32), box)[inside]

    def spectrum(self, template: Float32Array) -> NDArray[np.complex64]:
        """Conjugate transform of a template, for references of one block."""
        # The template is mostly zero: transformed along its rows first, the rest costs nothing.
        rows = fft.rfft(template, self._size[1], axis=-1)
        return np.asarray(fft.fft(rows, self._size[0], axis=-2).conj())

    def surface(self, spectrum: NDArray[np.complex64], norm: float, first: IntArray, length: int) -> Float32Array:
        """Correlation of a template over a square of shifts that starts at `first`; NaN where it is not covered."""
        rows = slice(int(first[0]), int(first[0]) + length)
        columns = slice(int(first[1]), int(first[1]) + length)
        summed = np.einsum("kij,kij->ij", spectrum, self._channels)
        product = fft.irfft(fft.ifft(summed, axis=0)[rows], self._size[1], axis=-1)[:, columns]
        energy, cover = self._energy[rows, columns], self._cover[rows, columns]
        good = (cover >= _MIN_COVER) & (energy > 1e-6)
        return np.where(good, product / (norm * np.sqrt(np.where(good, energy, 1.0))), np.nan).astype(np.float32)


Prepared = list[_BlockReference]
"""A reference made ready for a search: the surroundings of each block of the film."""


def _blocks(camera: PanoramicCamera, height_m: float, crs: str) -> list[_Block]:
    """The film in equal pieces along its length, each with its map."""
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    edges = np.linspace(-camera.half_length_mm, camera.half_length_mm, BLOCKS + 1)
    y = np.linspace(-camera.half_width_mm, camera.half_width_mm, 7)
    blocks = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        x = np.linspace(low, high, 13)
        film_mm = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        points = np.concatenate([[[(low + high) / 2, 0.0]], film_mm])
        east_north = np.stack(to_map.transform(*camera.locate_geodetic(points, height_m)[:, :2].T), axis=-1)
        offsets = east_north[1:] - east_north[0]
        reach = float(np.linalg.norm(offsets, axis=1).max())
        coefficients = np.linalg.lstsq(_terms(offsets / reach), film_mm, rcond=None)[0]
        blocks.append(_Block(float(low), float(high), camera.half_width_mm, east_north[0], reach, coefficients))
    return blocks


def _terms(places: FloatArray) -> FloatArray:
    x, y = places[..., 0], places[..., 1]
    return np.stack([x**i * y**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)], axis=-1)


def _standardised(surfaces: Float32Array) -> tuple[Float32Array, BoolArray]:
    """Surfaces of one block together: every second pixel, in standard deviations about the median, maxima spread.

    Image and relief show the same mountains, so that chance favours a place in both: what they say together is brought
    to one standard deviation again.
    """
    covered: BoolArray = np.asarray(np.isfinite(surfaces[:, ::_POOL, ::_POOL]).all(axis=0))
    total = np.zeros(covered.shape, np.float32)
    for surface in surfaces:
        spread = maximum_filter(np.where(np.isfinite(surface), surface, -1.0), size=3)[::_POOL, ::_POOL]
        total += _in_deviations(spread, covered)
    return _in_deviations(total, covered) if len(surfaces) > 1 else total, covered


def _in_deviations(values: Float32Array, covered: BoolArray) -> Float32Array:
    """Values in standard deviations about the median of those that are covered; 0 elsewhere."""
    known = values[covered]
    if not len(known):
        return np.zeros(values.shape, np.float32)
    return np.where(covered, (values - np.median(known)) / max(nmad(known), 1e-6), 0.0).astype(np.float32)


def halved(raster: Float32Array) -> Float32Array:
    """Means of two by two pixels of a raster, of those that are not NaN."""
    known = np.isfinite(raster)
    size = (-(-raster.shape[1] // 2), -(-raster.shape[0] // 2))
    border = ((0, raster.shape[0] % 2), (0, raster.shape[1] % 2))
    filled, weight = (np.pad(a, border) for a in (np.where(known, raster, 0).astype(np.float32), known))
    total = cv2.resize(filled, size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(weight.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.where(share > 0.4, total / np.maximum(share, 0.1), np.nan).astype(np.float32)


def search_widely(
    fine: FilmSearch, coarse: FilmSearch, references: Sequence[Prepared], rough: Sequence[Prepared]
) -> Found:
    """The film in all headings and scales: roughly first, the best of it again at the finer posting.

    Parameters
    ----------
    fine, coarse : FilmSearch
        The second at twice the posting of the first, on its coarsened grid.
    references, rough : prepared references of either
    """
    found = coarse.run(rough, coarse.wide_views())
    views = [_within_range(candidate.view) for candidate in found.candidates[:_VIEWS]]
    return fine.run(references, views) if views else NOTHING


def _within_range(view: View) -> View:
    most = math.radians(_ROTATION_RANGE_DEG)
    return View(view.way, min(max(view.rotation, -most), most), min(max(view.scale, -_SCALE_RANGE), _SCALE_RANGE))


def is_clear(found: Found, clear: float) -> bool:
    """Whether the best place stands far above the ground and above all other places."""
    return bool(found.candidates) and found.candidates[0].score >= max(
        clear, 1.3 * found.rival_score(found.candidates[0])
    )


def _steps(limit: float, step: float) -> FloatArray:
    count = math.ceil(limit / step - 1e-9)
    return np.arange(-count, count + 1) * step


def _overlap(length: int, shift: int) -> slice:
    return slice(max(shift, 0), max(length + min(shift, 0), 0))


def _top_near(surface: Float32Array, place: FloatArray, reach: int = 4) -> FloatArray:
    """Highest pixel near a place of a surface; NaN outside."""
    row, column = (int(v) for v in place)
    row0, column0 = max(row - reach, 0), max(column - reach, 0)
    part = surface[row0 : max(row + reach + 1, 0), column0 : max(column + reach + 1, 0)]
    if part.size == 0 or not np.isfinite(part).any():
        return np.array([np.nan, np.nan])
    top = np.unravel_index(int(np.nanargmax(part)), part.shape)
    return np.array([row0 + top[0], column0 + top[1]], float)
