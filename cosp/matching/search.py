"""The first search: where on the ground a film may lie, from a prediction that may be far off in every respect.

The film is cut into blocks along its length. Each block is brought to the map through the predicted camera, in each of
the four ways that a film can be digitised, and correlated with the reference over the whole search window. What the
blocks' correlation surfaces say for a place, as logs of odds, is added for every shift, rotation and scale that the
prediction may be wrong by. A template bears a rotation of a few degrees only; larger ones are searched by turning the
templates themselves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from scipy import fft
from scipy.special import ndtri

from cosp.arrays import BoolArray, Float32Array, FloatArray, IntArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.grids import PixelGrid
from cosp.geometry.statistics import nmad
from cosp.matching.film_image import FilmImage
from cosp.matching.kernels import highest_sums
from cosp.matching.structural import orientation_channels

# Blocks the film is cut into along its length.
BLOCKS = 8
# Largest errors of heading and scale that are searched, and how far one set of templates reaches.
_ROTATION_RANGE_DEG = 10.0
_SCALE_RANGE = 0.05
_ROTATION_REACH_DEG = 2.5
_SCALE_REACH = 0.025
# Places that one view of the film gives.
_PEAKS = 3
# Peaks closer than this are one.
_PEAK_DISTANCE_M = 6000.0
# What is expected of a block: that it shows ground, and how many deviations its right place then stands out by.
_SHOWS_GROUND = 0.5
_STANDS_OUT = 3.0
# The highest part of a surface that says how far out chance reaches, and the fewest cells of it.
_TAIL, _TAIL_CELLS = 1e-3, 100
# Share of a template that must lie on the reference, and what it must hold of texture.
_MIN_COVER = 0.7
_MIN_TEXTURE = 0.02
_MIN_CELLS = 8.0
_MIN_BLOCKS = 2
_SMOOTHING_PX = 1.5
_BINS = 5
# The smoothed channels are correlated in cells of two by two pixels, which hold all of them but 0.4 per cent.
_CELL = 2
# Of the orientations, nothing but their mean and their first harmonic is left after smoothing across them.
_ORIENTATIONS = np.pi * np.arange(_BINS) / _BINS
_HARMONICS = np.sqrt(2 / _BINS) * np.stack(
    [np.full(_BINS, np.sqrt(0.5)), np.cos(2 * _ORIENTATIONS), np.sin(2 * _ORIENTATIONS)]
).astype(np.float32)
# Rotations and scales are so far apart that the outermost block moves by so many cells.
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
        How likely the place is, as the height of a normal variable.
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

    @classmethod
    def best_of(cls, parts: Iterable[Found]) -> Found:
        """Several together: one candidate of each place, of each way the map with the highest place."""
        parts = list(parts)
        candidates = sorted((c for part in parts for c in part.candidates), key=lambda candidate: -candidate.score)
        kept: list[Candidate] = []
        for candidate in candidates:
            if not any(candidate.is_like(better) for better in kept):
                kept.append(candidate)
        maps: dict[Way, ScoreMap] = {}
        for score_map in sorted((m for part in parts for m in part.maps), key=lambda m: -np.nanmax(m.scores)):
            maps.setdefault(score_map.view.way, score_map)
        return cls(tuple(kept), tuple(maps[way] for way in WAYS if way in maps))


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
    ) -> None:
        self.posting_m = posting_m
        self._threads = threads
        self._films = {way: film.laid(turned=way.turned, mirrored=way.mirrored) for way in WAYS}
        self._blocks = _blocks(camera, height_m, crs)
        self._middles = np.array([block.middle_m for block in self._blocks])
        self._arms = self._middles - self._middles.mean(axis=0)
        cell_m = self._cell_m = _CELL * posting_m
        self._radius = math.ceil(search_m / cell_m)
        turning = math.hypot(math.radians(_ROTATION_RANGE_DEG + _ROTATION_REACH_DEG), _SCALE_RANGE + _SCALE_REACH)
        self._margin = math.ceil(turning * float(np.linalg.norm(self._arms, axis=1).max()) / cell_m) + 2
        largest = 1 + _SCALE_RANGE + _SCALE_REACH
        self._half = [math.ceil(block.reach_m * largest / cell_m) + 1 for block in self._blocks]
        reach = (self._radius + self._margin + max(self._half) + 1) * cell_m
        low, high = self._middles.min(axis=0) - reach, self._middles.max(axis=0) + reach
        cells = PixelGrid.covering((low[0], low[1], high[0], high[1]), cell_m)
        self.grid = PixelGrid.covering(cells.bounds, posting_m)
        self._places = np.round(np.stack(cells.pixels(self._middles), axis=-1)).astype(int)

    def narrow_views(self) -> list[View]:
        """The film as predicted, whichever way round."""
        return [View(way) for way in WAYS]

    def wide_views(self) -> list[View]:
        """The film in every heading and scale that it may have, whichever way round."""
        rotations = np.radians(_between(_ROTATION_RANGE_DEG, _ROTATION_REACH_DEG))
        scales = _between(_SCALE_RANGE, _SCALE_REACH)
        return [View(way, float(r), float(s)) for way in WAYS for r in rotations for s in scales]

    def run(self, choices: Sequence[Sequence[Prepared]], views: Sequence[View]) -> list[Found]:
        """The best places of some views of the film, for each choice of references.

        Parameters
        ----------
        choices : lists of prepared references
            The evidence of those in one list is taken together.
        views : View of each guess
        """

        def work(view: View) -> list[Found]:
            return self._peaks(view, choices)

        if self._threads > 1:
            with ThreadPoolExecutor(self._threads) as pool:
                results = list(pool.map(work, views))
        else:
            results = [work(view) for view in views]
        return [Found.best_of(parts) for parts in zip(*results, strict=True)]

    def prepared(self, reference: Float32Array) -> Prepared:
        """A reference on `grid`, NaN where there is nothing, made ready to be compared with many views."""
        channels, valid = _cells(reference)
        result = []
        for (row, column), half in zip(self._places, self._half, strict=True):
            reach = self._radius + self._margin + half
            window = (slice(row - reach, row + reach + 1), slice(column - reach, column + reach + 1))
            result.append(_BlockReference(channels[:, *window], valid[window], half))
        return result

    def _peaks(self, view: View, choices: Sequence[Sequence[Prepared]]) -> list[Found]:
        """Highest places of the blocks' surfaces, added for every rotation and scale near a view's."""
        starts = np.round(self._moved(view)).astype(int)
        references = {id(reference): reference for choice in choices for reference in choice}
        surfaces: dict[int, dict[int, Float32Array]] = {key: {} for key in references}
        for index in range(len(self._blocks)):
            template = self._template(index, view)
            if template is None:
                continue
            channels, weights = template
            norm = math.sqrt(float((channels**2).sum()) * float(weights.sum()))
            first = self._margin + starts[index]
            spectrum = next(iter(references.values()))[index].spectrum(channels)
            for key, reference in references.items():
                surface = reference[index].surface(spectrum, norm, first, 2 * self._radius + 1)
                if np.isfinite(surface).mean() > 0.005:
                    surfaces[key][index] = surface
        results = []
        for choice in choices:
            kept = [surfaces[id(reference)] for reference in choice]
            together = {
                index: np.stack([one[index] for one in kept if index in one]) for index in sorted(set().union(*kept))
            }
            results.append(self._added(view, together, starts) if len(together) >= _MIN_BLOCKS else NOTHING)
        return results

    def _moved(self, view: View) -> FloatArray:
        """Rows and columns that the blocks move by from the prediction to a view, in cells."""
        moved_m = self._arms @ (view.matrix - np.eye(2)).T
        return np.asarray(moved_m[:, ::-1] / self._cell_m * [-1, 1])

    def _template(self, index: int, view: View) -> tuple[Float32Array, Float32Array] | None:
        """Channels of a block as a view has it, and how much of each cell holds texture."""
        block, half = self._blocks[index], self._half[index]
        reach = _CELL * (2 * half + 1) / 2 - 0.5
        step = np.arange(-reach, reach + 1) * self.posting_m
        offsets = np.stack(np.broadcast_arrays(step[None, :], -step[:, None]), axis=-1)
        film_mm = block.film(offsets @ np.linalg.inv(view.matrix).T)
        channels, weights = _cells(self._films[view.way].sample(film_mm))
        inside = float(np.isfinite(film_mm[..., 0]).sum()) / _CELL**2
        return (channels, weights) if weights.sum() >= max(_MIN_CELLS, _MIN_TEXTURE * inside) else None

    def _added(self, view: View, surfaces: dict[int, Float32Array], starts: IntArray) -> Found:
        indices = np.array(list(surfaces))
        standard, covered = zip(*(_evidence(surface) for surface in surfaces.values()), strict=True)
        reach = float(np.linalg.norm(self._arms, axis=1).max()) / self._cell_m
        guesses = [
            View(view.way, view.rotation + float(rotation), view.scale + float(scale))
            for rotation in _steps(math.radians(_ROTATION_REACH_DEG), _GUESS_STEP / reach)
            for scale in _steps(_SCALE_REACH, _GUESS_STEP / reach)
        ]
        offsets = np.stack([np.round(self._moved(guess) - starts).astype(int)[indices] for guess in guesses])
        evidence, argument = highest_sums(np.stack(standard), offsets)
        known = np.sum(covered, axis=0) >= _MIN_BLOCKS
        best = np.where(known, np.sqrt(2 * np.maximum(evidence, 0)), -np.inf).astype(np.float32)
        scores = ScoreMap(view, np.where(np.isfinite(best), best, np.nan), self._cell_m)
        candidates = []
        remaining = best.copy()
        near = round(_PEAK_DISTANCE_M / self._cell_m)
        for _ in range(_PEAKS):
            row, column = (int(v) for v in np.unravel_index(int(remaining.argmax()), best.shape))
            if not np.isfinite(remaining[row, column]):
                break
            number = int(argument[row, column])
            places = np.array([row, column]) + offsets[number]
            candidate = self._candidate(guesses[number], float(best[row, column]), surfaces, starts, places)
            if candidate is not None:
                candidates.append(candidate)
            remaining[max(row - near, 0) : row + near + 1, max(column - near, 0) : column + near + 1] = -np.inf
        return Found(tuple(candidates), (scores,) if np.isfinite(best).any() else ())

    def _candidate(
        self, guess: View, score: float, surfaces: dict[int, Float32Array], starts: IntArray, places: IntArray
    ) -> Candidate | None:
        """A peak of the sum brought back to the highest place of each block's own surface near it."""
        indices = np.array(list(surfaces))
        tops = [
            _top_near(surface.mean(axis=0), place) for surface, place in zip(surfaces.values(), places, strict=True)
        ]
        shifts = np.array(tops) - self._radius + starts[indices]
        known = np.isfinite(shifts).all(axis=1)
        if known.sum() < _MIN_BLOCKS:
            return None
        predicted = self._middles[indices[known]]
        x_mm = np.array([(self._blocks[i].low_mm + self._blocks[i].high_mm) / 2 for i in indices[known]])
        found = predicted + shifts[known][:, ::-1] * [self._cell_m, -self._cell_m]
        return Candidate(guess, score, x_mm, predicted, found)


class _BlockReference:
    """The surroundings of one block in the reference, transformed once for many templates."""

    def __init__(self, channels: Float32Array, valid: Float32Array, half: int) -> None:
        rows, columns = valid.shape
        self._size = (fft.next_fast_len(rows), fft.next_fast_len(columns, real=True))
        self._channels = fft.rfft2(np.ascontiguousarray(channels), s=self._size)
        # Energy and cover below a template are taken to be those below its box.
        box = (2 * half + 1, 2 * half + 1)
        inside = (slice(half, rows - half), slice(half, columns - half))
        self._energy = cv2.blur(np.einsum("kij,kij->ij", channels, channels), box)[inside]
        self._cover = cv2.blur(valid, box)[inside]

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
    x, y = (np.vander(places[..., axis].ravel(), _DEGREE + 1, increasing=True).T for axis in (0, 1))
    terms = np.stack([x[i] * y[j] for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)], axis=-1)
    return terms.reshape(*places.shape[:-1], -1)


def _cells(image: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Harmonics of the orientations of an image in cells, about their mean, and how much of each cell is textured."""
    channels = np.tensordot(_HARMONICS, orientation_channels(image, bins=_BINS, sigma_px=_SMOOTHING_PX), 1)
    textured = np.isfinite(image) & (channels[0] > 0)
    if textured.any():
        channels -= channels[:, textured].mean(axis=1)[:, None, None]
    channels *= textured
    return _by_cells(channels), _by_cells(textured[None].astype(np.float32))[0]


def _by_cells(layers: Float32Array) -> Float32Array:
    """Means of the pixels of each cell; pixels of a ragged edge are left out."""
    rows, columns = (n // _CELL * _CELL for n in layers.shape[1:])
    parts = [layers[:, i:rows:_CELL, j:columns:_CELL] for i in range(_CELL) for j in range(_CELL)]
    return np.asarray(sum(parts[1:], parts[0]) / len(parts), np.float32)


def _evidence(surfaces: Float32Array) -> tuple[Float32Array, BoolArray]:
    """How much the surfaces of one block speak for each place: log of its odds to nothing lying there, 0 where unknown.

    A block may show nothing but cloud: then its surface says nothing. If it shows ground, the right place stands a few
    standard deviations out.
    """
    standard, covered = _standardised(surfaces)
    ground = _SHOWS_GROUND * np.exp(np.minimum(_STANDS_OUT * (standard - _STANDS_OUT / 2), 80.0))
    return np.where(covered, np.log(1 - _SHOWS_GROUND + ground), 0.0).astype(np.float32), covered


def _standardised(surfaces: Float32Array) -> tuple[Float32Array, BoolArray]:
    """Surfaces of one block together, in standard deviations about the median, maxima spread.

    Image and relief show the same mountains, so that chance favours a place in both: what they say together is brought
    to one standard deviation again.
    """
    covered: BoolArray = np.asarray(np.isfinite(surfaces).all(axis=0))
    total = np.zeros(covered.shape, np.float32)
    for surface in surfaces:
        known = np.where(np.isfinite(surface), surface, np.float32(-1.0))
        total += _in_deviations(np.asarray(cv2.dilate(known, np.ones((3, 3))), np.float32), covered)
    return _in_deviations(total, covered) if len(surfaces) > 1 else total, covered


def _in_deviations(values: Float32Array, covered: BoolArray) -> Float32Array:
    """Values in standard deviations about the median of those that are covered; 0 elsewhere.

    The highest thousandth says what a deviation is where it lies further out than that of a normal distribution: more
    of a small surface, which one right place must not fill.
    """
    known = values[covered]
    if not len(known):
        return np.zeros(values.shape, np.float32)
    share = float(np.clip(_TAIL_CELLS / len(known), _TAIL, 0.1))
    middle, high = np.quantile(known, [0.5, 1 - share])
    deviation = max(nmad(known), (high - middle) / ndtri(1 - share), 1e-6)
    return np.where(covered, (values - middle) / deviation, 0.0).astype(np.float32)


def _between(limit: float, reach: float) -> FloatArray:
    """Middles of the fewest intervals of so much reach to either side that cover -limit to limit."""
    count = math.ceil(limit / reach - 1e-9)
    return (np.arange(count) - (count - 1) / 2) * 2 * limit / count


def _steps(limit: float, step: float) -> FloatArray:
    count = math.ceil(limit / step - 1e-9)
    return np.arange(-count, count + 1) * step


def _top_near(surface: Float32Array, place: FloatArray, reach: int = 2) -> FloatArray:
    """Highest pixel near a place of a surface; NaN outside."""
    row, column = (int(v) for v in place)
    row0, column0 = max(row - reach, 0), max(column - reach, 0)
    part = surface[row0 : max(row + reach + 1, 0), column0 : max(column + reach + 1, 0)]
    if part.size == 0 or not np.isfinite(part).any():
        return np.array([np.nan, np.nan])
    top = np.unravel_index(int(np.nanargmax(part)), part.shape)
    return np.array([row0 + top[0], column0 + top[1]], float)
