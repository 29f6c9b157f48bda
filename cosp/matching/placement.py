"""Coarse to fine: where on the ground a film lies, or an error that says why this cannot be known.

The best few places of the first search are followed to finer postings, where the camera is fitted to hundreds of
independent matches; a place counts only if those agree with one camera in most blocks of the film, and no other place
does nearly as well.
"""

from __future__ import annotations

import cmath
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import date

import cv2
import numpy as np
from pyproj import Transformer

from cosp.arrays import BoolArray, FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import NoOverlapError, PlacementError
from cosp.geometry.frames import LocalFrame
from cosp.geometry.rotations import angles_from_matrix, rotation_matrix
from cosp.geometry.transforms import estimate_affine, ransac
from cosp.matching.film_image import FilmImage
from cosp.matching.filtering import consistent_by_tile
from cosp.matching.footprint import FilmBlock, Footprint
from cosp.matching.ground import (
    GroundMatches,
    OnGrid,
    Terrain,
    film_lattice,
    ground_pixel_m,
    grown,
    map_bounds,
    match_film_to_ground,
    reduction_for,
)
from cosp.matching.matchers import structural
from cosp.matching.refit import refit_camera, refit_sigma_mm
from cosp.matching.relief import Sun, convexity_reference, relief_reference, suns
from cosp.matching.search import (
    BLOCKS,
    NOTHING,
    Candidate,
    FilmSearch,
    Found,
    Prepared,
    ScoreMap,
    View,
    Way,
)

log = logging.getLogger(__name__)

# Matches are not believed to be better than this. With relief, which shows ground lit otherwise than on the film, those
# of many tiles err together: by 2.6 times what their spread says in trials, where those with an image err as they say.
_LEAST_ERROR_PX = {"image": 0.2, "relief": 0.5}
# Candidates followed to a finer posting; once one is taken, only as many as it takes to know its rivals, and only those
# that come near it.
_CANDIDATES = 5
_RIVALS = 2
_NEAR_SHARE = 0.7
_MIN_BLOCKS = 2
# The sun is chosen by every so manieth tile.
_SUN_TILES = 3
# One posting to the next.
_LEVEL_RATIO = 3.5
_STEP_PX = 20
# A camera fits any three tiles.
_MIN_PLACES = 6
_GATE_PX = 3.0
# A place is taken without further search where at least this share of the matches agrees.
_SURE_SHARE = 0.7
# Matches of a place that is known agree, within so much, with so many others in their piece of the film.
_PIECE_MM, _PIECE_GATE_PX, _PIECE_MATCHES, _PIECE_TRIALS = 40.0, 2.0, 12, 200
# A film that lies as its camera says gives so many matches a tile; with fewer it is matched again through the fit.
_MANY = 5.0
_PASSES = 3


@dataclass(frozen=True)
class Located:
    """A frame that has been placed, or why it has not, and the maps of scores of the first search.

    Parameters
    ----------
    footprint : Footprint or None
    refusal : str or None
        The evidence, where it does not place the film.
    maps : ScoreMap of each way the film may lie
    """

    footprint: Footprint | None
    refusal: str | None
    maps: tuple[ScoreMap, ...]


@dataclass(frozen=True)
class SearchLimits:
    """Where a search begins and ends, and what a place needs to be believed.

    Parameters
    ----------
    coarse_posting_m, fine_posting_m : float
        First and last posting; the last is not finer than the film.
    min_score : float
        Least height of a place of the whole search above its surroundings, in standard deviations.
    min_margin : float
        Least ratio of agreeing matches to those of the best other candidate.
    min_agreeing, min_agreeing_share : int, float
        Least number and share of matches that agree with one camera.
    min_block_share : float
        Least share of the film's blocks with matches in which most of them agree.
    max_sigma_m : float
        While more evidence is to come, a place is not taken that is known worse than that at an end of the film.
    """

    coarse_posting_m: float
    fine_posting_m: float
    min_score: float
    min_margin: float
    min_agreeing: int
    min_agreeing_share: float
    min_block_share: float
    max_sigma_m: float

    @classmethod
    def of(cls, choices: object) -> SearchLimits:
        """Those among the attributes of something that has more."""
        return cls(**{one.name: getattr(choices, one.name) for one in fields(cls)})

    def in_window(self, search_m: float, window_m: float) -> SearchLimits:
        """The same for a smaller window: chance reaches the least score there as seldom as in the whole one.

        The highest of n independent standard normal values grows as the root of 2 log n.
        """
        gain = 4 * math.log(max(search_m / window_m, 1.0))  # twice the log of the ratio of the areas
        return replace(self, min_score=math.sqrt(max(self.min_score**2 - gain, 0.25 * self.min_score**2)))

    def fault(self, placement: _Placement) -> str | None:
        """Why the matches do not support a placement; None if they do."""
        agreeing, count = int(placement.agreeing.sum()), len(placement.agreeing)
        blocks = [block for block in placement.blocks() if block.matches >= 3]
        good = sum(block.agreeing >= max(3, 0.5 * self.min_agreeing_share * block.matches) for block in blocks)
        share = good / len(blocks) if blocks else 0.0
        if (
            agreeing >= self.min_agreeing
            and placement.share >= self.min_agreeing_share
            and share >= self.min_block_share
            and good >= _MIN_BLOCKS
            and placement.places() >= _MIN_PLACES
        ):
            return None
        return (
            f"{agreeing} of {count} matches at {placement.posting_m:.0f} m agree with one camera, at "
            f"{placement.places()} places of the film and in {good} of {len(blocks)} blocks; needed are "
            f"{self.min_agreeing} matches, {self.min_agreeing_share:.0%} of all, at {_MIN_PLACES} places and in "
            f"{self.min_block_share:.0%} of the blocks"
        )


@dataclass(frozen=True)
class _Templates:
    """How many tiles of templates are matched along and across a film, how large templates are and how far they reach.

    Parameters
    ----------
    along, across : int
        Tiles; fewer across where a tile fills the film.
    apart_px : int
        Least distance of tiles across.
    template_px, search_px, tile_px : int
    min_score : float
        Lax: agreement decides.
    """

    along: int
    across: int
    apart_px: int
    template_px: int
    search_px: int
    tile_px: int
    min_score: float


# To find a place: what is large tells right from wrong. To know it well: what is small is at all ends of the film.
_WIDE = _Templates(24, 3, 150, 81, 24, 176, 0.1)
_NEAR = _Templates(48, 4, 50, 41, 14, 96, 0.15)


@dataclass(frozen=True)
class _Evidence:
    """Something to compare the film with."""

    name: str
    on_grid: OnGrid
    sun: Sun | None = None


@dataclass(frozen=True)
class _Guess:
    """A candidate of the first search and what spoke for it."""

    candidate: Candidate
    evidence: tuple[_Evidence, ...]

    def __str__(self) -> str:
        east, north = self.candidate.shift_m / 1000
        view = self.candidate.view
        names = " and ".join(e.name for e in self.evidence)
        return (
            f"{self.candidate.score:.1f} by {names}: {east:+.1f} km east, {north:+.1f} km north, {view.way}, "
            f"{math.degrees(view.rotation):+.1f} deg, {100 * view.scale:+.1f} %"
        )


@dataclass(frozen=True)
class _Placement:
    """A candidate followed to a finer posting.

    What is expected of its camera stays what it was before any match: were each fit the expectation of the next one, a
    wrong match at an end that shows little else would bend the film there for good.
    """

    expected: PanoramicCamera
    camera: PanoramicCamera
    crs: str
    matches: GroundMatches
    agreeing: BoolArray
    posting_m: float
    residual_m: float

    @property
    def share(self) -> float:
        return float(self.agreeing.mean()) if len(self.agreeing) else 0.0

    @property
    def support(self) -> float:
        """Sum of the scores of the matches that agree."""
        return float(self.matches.score[self.agreeing].sum())

    def places(self) -> int:
        """Tiles with matches that agree; those of one tile share most of their pixels and are one piece of evidence."""
        half = np.array([self.camera.half_length_mm, self.camera.half_width_mm])
        cells = np.floor((self.matches.film_mm[self.agreeing] / half + 1) / 2 * [_WIDE.along, _WIDE.across])
        return len(np.unique(cells, axis=0))

    def sigma_m(self, least_error_px: float) -> float:
        """Standard deviation of the place on the ground where the film is known worst: far from all that agrees."""
        if not self.agreeing.any():
            return float("nan")
        mm_per_m = _film_mm_per_m(self.camera, 0.0)
        ground = self.camera.origin.local_from_geodetic(self.matches.lonlath(self.crs)[self.agreeing])
        # Matches of one tile err together.
        per_place = len(ground) / self.places()
        error_mm = max(self.residual_m, least_error_px * self.posting_m) * mm_per_m * math.sqrt(per_place)
        film_mm = film_lattice(self.camera.half_length_mm, self.camera.half_width_mm, BLOCKS + 1, 3)
        seen = self.camera.locate(film_mm, float(self.matches.map_m[self.agreeing, 2].mean()))
        sigma_mm = refit_sigma_mm(self.camera, ground, np.full(len(ground), error_mm), seen)
        return float(sigma_mm.max() / mm_per_m)

    def blocks(self) -> tuple[FilmBlock, ...]:
        half = self.camera.half_length_mm
        index = np.clip(((self.matches.film_mm[:, 0] + half) / (2 * half) * BLOCKS).astype(int), 0, BLOCKS - 1)
        centres = film_lattice(half, 1.0, BLOCKS, 1)[:, 0]
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
    day: date | None,
    crs: str,
    search_m: float,
    limits: SearchLimits,
    rng: np.random.Generator,
    threads: int,
) -> Located:
    """The place of a film on the ground, from a prediction that may be far off, or why it cannot be known.

    Parameters
    ----------
    film : FilmImage
        Which way round it lies is found.
    predicted : PanoramicCamera
    reference_on : function of a PixelGrid, or None
        Reference image on a map grid, NaN outside. Where there is none, or it does not place the film beyond doubt, the
        shaded relief of `heights_on` is evidence too.
    heights_on : function of a PixelGrid
        Ellipsoidal heights, NaN outside.
    day : date, optional
        When the film was exposed, for the place of the sun.
    crs : str
        Map projection in metres to work in.
    search_m : float
        Largest error of the predicted place, in each direction.
    limits : SearchLimits
    rng : numpy Generator
    threads : int
    """
    pixel_m = ground_pixel_m(predicted, film.pixel_mm, 0.0)
    last_m = max(limits.fine_posting_m, pixel_m)
    finest = film.reduced(reduction_for(last_m, pixel_m))
    finest_m = pixel_m * finest.pixel_mm / film.pixel_mm
    found, refusal = NOTHING, ""
    try:
        terrain = Terrain.on(heights_on, grown(map_bounds(predicted, crs), search_m), crs, limits.coarse_posting_m)
        follower = _Follower(
            finest, finest_m, predicted, terrain, heights_on, suns(day, predicted.origin.latitude_deg),
            limits, rng, threads,
        )  # fmt: skip
        stages = _stages(
            finest.reduced(reduction_for(limits.coarse_posting_m, finest_m)),
            predicted,
            terrain,
            image=None if reference_on is None else _Evidence("image", reference_on),
            relief=_Evidence("relief", convexity_reference(heights_on)),
            search_m=search_m,
            posting_m=limits.coarse_posting_m,
            threads=threads,
        )
        for guesses, found, last in stages:
            for guess in guesses[:4]:
                log.info("place of the whole search: %s", guess)
            try:
                footprint = follower.footprint(
                    guesses, _postings(limits.coarse_posting_m, last_m), found=found, last=last
                )
            except PlacementError as doubt:
                refusal = str(doubt)
                log.info("%s", refusal)
            else:
                return Located(footprint, None, found.maps)
    except NoOverlapError as nothing:
        refusal = f"{predicted.scene}: cannot be placed: {nothing}"
    log.warning("%s", refusal)
    return Located(None, refusal, found.maps)


@dataclass(frozen=True)
class _Follower:
    """Follows places of the first search to finer postings."""

    film: FilmImage
    pixel_m: float
    predicted: PanoramicCamera
    terrain: Terrain
    heights_on: OnGrid
    suns: Sequence[Sun]
    limits: SearchLimits
    rng: np.random.Generator
    threads: int
    followed: dict[tuple[int, int], _Placement | None] = field(default_factory=dict)

    def footprint(
        self,
        guesses: Sequence[_Guess],
        postings: Sequence[float],
        *,
        found: Found,
        last: bool,
    ) -> Footprint:
        """The one place that the film's own matches agree on.

        While more evidence is to come (`last` is not set) only a place is taken on which most of them agree, and which
        they tell all over the film.

        Raises
        ------
        PlacementError
            If no place stands out; says what was found.
        """
        head = f"{self.predicted.scene}: cannot be placed: "
        if not guesses:
            raise PlacementError(
                f"{head}fewer than {_MIN_BLOCKS} blocks of the film hold texture and find ground to compare with"
            )
        limits = self.limits
        likely = [guess for guess in guesses if guess.candidate.score >= limits.min_score]
        if not likely:
            raise PlacementError(
                f"{head}the likeliest place stands {guesses[0].candidate.score:.1f} standard deviations above its "
                f"surroundings, {limits.min_score:.1f} are needed"
            )
        tried = self._tried(likely, postings[0])
        if not tried:
            raise PlacementError(f"{head}no candidate of the search lies on the reference DEM")
        best, evidence, placement = tried[0]
        way = best.candidate.view.way
        rivals = [_against(other, placement, same_way=guess.candidate.view.way == way) for guess, _, other in tried[1:]]
        margin = float(placement.agreeing.sum() / max([1, *rivals]))
        placement = self._settled(way, evidence, placement)
        if not last:
            limits = replace(limits, min_agreeing_share=max(limits.min_agreeing_share, _SURE_SHARE))
        fault = limits.fault(placement)
        if fault is not None:
            raise PlacementError(head + fault)
        if margin < limits.min_margin:
            raise PlacementError(
                f"{head}{int(placement.agreeing.sum())} matches agree with one place and {max(rivals)} with another; "
                f"the first must have {limits.min_margin:.1f} times as many"
            )
        evidence, placement = self._under_the_best_sun(way, evidence, placement)
        for posting in postings[1:]:
            finer = self._placed(way, placement.expected, placement.camera, evidence, posting)
            log.info("%d of %d matches agree at %.1f m", finer.agreeing.sum(), len(finer.agreeing), posting)
            fault = self.limits.fault(finer)
            if fault is not None:  # the place is known; how well is what the last posting says
                log.warning("the film stays as it was placed at %.0f m: %s", placement.posting_m, fault)
                break
            placement = finer
        if evidence.name == "relief":
            placement = self._sharpened(way, evidence, placement)
        footprint = self._record(best.candidate, evidence, placement, found.rival_score(best.candidate), margin)
        if not last and footprint.sigma_m > limits.max_sigma_m:
            raise PlacementError(
                f"{head}{int(placement.agreeing.sum())} matches agree with one place, but leave an end of the film "
                f"open by {footprint.sigma_m:.0f} m; {limits.max_sigma_m:.0f} m are needed before all is searched"
            )
        return footprint

    def _tried(self, guesses: Sequence[_Guess], posting_m: float) -> list[tuple[_Guess, _Evidence, _Placement]]:
        """The best few places at the next posting, the one with most agreeing matches first."""
        tried: list[tuple[_Guess, _Evidence, _Placement]] = []
        taken = False
        for number, guess in enumerate(guesses[:_CANDIDATES]):
            if taken and (number >= _RIVALS or guess.candidate.score < _NEAR_SHARE * guesses[0].candidate.score):
                break
            for evidence in guess.evidence:
                placement = self._followed(guess, evidence, posting_m)
                if placement is not None:
                    tried.append((guess, evidence, placement))
                    if self.limits.fault(placement) is None:
                        taken = True
                        break
        return sorted(tried, key=lambda one: -int(one[2].agreeing.sum()))

    def _followed(self, guess: _Guess, evidence: _Evidence, posting_m: float) -> _Placement | None:
        """One place at the next posting; None where there is no ground."""
        key = (id(guess.candidate), id(evidence))
        if key not in self.followed:  # a place may come up again after the next stage
            placement: _Placement | None = None
            try:
                expected, camera = _cameras_of(guess.candidate, self.predicted, self.terrain)
                placement = self._placed(guess.candidate.view.way, expected, camera, evidence, posting_m)
                log.info(
                    "%s: %d of %d matches with the %s agree at %.0f m",
                    guess, placement.agreeing.sum(), len(placement.agreeing), evidence.name, posting_m,
                )  # fmt: skip
            except NoOverlapError:  # a wrong candidate may lead anywhere
                log.info("%s: no ground there", guess)
            self.followed[key] = placement
        return self.followed[key]

    def _settled(self, way: Way, evidence: _Evidence, placement: _Placement) -> _Placement:
        """The same place matched again through its fitted camera, while that brings matches that agree."""
        for _ in range(_PASSES):
            if placement.agreeing.sum() > _MANY * len(_tiles(placement.camera, placement.posting_m, _WIDE)):
                break
            again = self._placed(way, placement.expected, placement.camera, evidence, placement.posting_m)
            if again.support <= 1.05 * placement.support:
                break
            placement = again
        return placement

    def _under_the_best_sun(self, way: Way, evidence: _Evidence, placement: _Placement) -> tuple[_Evidence, _Placement]:
        """The relief under the sun of the day that the film matches best, where it was the relief that placed it."""
        if evidence.name != "relief":
            return evidence, placement
        best: tuple[_Evidence, float] | None = None
        for sun in self.suns:
            lit = _Evidence("relief", relief_reference(self.heights_on, *sun), sun)
            found = self._placed(way, placement.expected, placement.camera, lit, placement.posting_m, every=_SUN_TILES)
            if best is None or found.support > best[1]:
                best = lit, found.support
        if best is not None:
            found = self._placed(way, placement.expected, placement.camera, best[0], placement.posting_m)
            if self.limits.fault(found) is None:
                return best[0], found
        return evidence, placement

    def _sharpened(self, way: Way, evidence: _Evidence, placement: _Placement) -> _Placement:
        """The same place by small templates near where its camera says, that agree with their neighbours.

        Relief shows so little of what film does that a large template at the foot of the mountains matches anywhere: a
        few of these, all within the gate, bend an end of the film by kilometres.
        """
        near = self._placed(way, placement.expected, placement.camera, evidence, placement.posting_m, templates=_NEAR)
        blocks = sum(block.agreeing > 0 for block in near.blocks())
        enough = near.agreeing.sum() >= self.limits.min_agreeing and near.places() >= _MIN_PLACES
        log.info("%d of %d matches near the place agree", near.agreeing.sum(), len(near.agreeing))
        return near if enough and blocks >= _MIN_BLOCKS else placement

    def _placed(
        self,
        way: Way,
        expected: PanoramicCamera,
        camera: PanoramicCamera,
        evidence: _Evidence,
        posting_m: float,
        *,
        every: int = 1,
        templates: _Templates = _WIDE,
    ) -> _Placement:
        laid = self.film.laid(turned=way.turned, mirrored=way.mirrored)
        level = laid.reduced(reduction_for(posting_m, self.pixel_m))
        return _placed(
            level, expected, camera, _tiles(camera, posting_m, templates)[::every], templates, evidence.on_grid,
            self.heights_on, self.terrain.crs, posting_m, self.rng, self.threads,
        )  # fmt: skip

    def _record(
        self, candidate: Candidate, evidence: _Evidence, placement: _Placement, rival_score: float, margin: float
    ) -> Footprint:
        camera, height = placement.camera, self.terrain.mean_m
        shift = shift_m(self.predicted, camera, height)
        before, after = (
            complex(*(c.locate(np.array([50.0, 0.0]), height) - c.locate(np.array([-50.0, 0.0]), height))[:2])
            for c in (self.predicted, camera)
        )
        turn_deg, scale = math.degrees(cmath.phase(after / before)), abs(after / before)
        sun = evidence.sun or self.suns[0]  # an image has none
        return Footprint(
            scene=self.predicted.scene,
            camera=camera,
            shift_east_m=shift[0],
            shift_north_m=shift[1],
            turned=candidate.view.way.turned,
            mirrored=candidate.view.way.mirrored,
            rotation_deg=turn_deg,
            scale=scale,
            score=float(candidate.score),
            rival_score=float(rival_score),
            margin=margin,
            agreeing_share=placement.share,
            residual_m=placement.residual_m,
            sigma_m=placement.sigma_m(_LEAST_ERROR_PX[evidence.name]),
            posting_m=placement.posting_m,
            reference=evidence.name,
            sun_azimuth_deg=sun.azimuth_deg,
            sun_elevation_deg=sun.elevation_deg,
            corners_lonlat=corners_lonlat(camera, height),
            blocks=placement.blocks(),
        )


def shift_m(before: PanoramicCamera, after: PanoramicCamera, height_m: float) -> tuple[float, float]:
    """East and north from the middle of one film on the ground to that of another."""
    first, second = (c.origin.ecef_from_local(c.locate(np.zeros(2), height_m)) for c in (before, after))
    moved = (second - first) @ before.origin.axes.T
    return float(moved[0]), float(moved[1])


def corners_lonlat(camera: PanoramicCamera, height_m: float) -> tuple[tuple[float, float], ...]:
    """Longitude and latitude of a picture's corners: (-x, +y), (+x, +y), (+x, -y), (-x, -y)."""
    half = np.array([camera.half_length_mm, camera.half_width_mm])
    corners = camera.locate_geodetic(np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * half, height_m)
    return tuple((float(lon), float(lat)) for lon, lat, _ in corners)


def _stages(
    film: FilmImage,
    predicted: PanoramicCamera,
    terrain: Terrain,
    *,
    image: _Evidence | None,
    relief: _Evidence,
    search_m: float,
    posting_m: float,
    threads: int,
) -> Iterator[tuple[list[_Guess], Found, bool]]:
    """Places of the first search, best first, after each stage, and whether it was the last: cheap stages come first.

    The image in about the predicted heading, in every heading and scale; the relief, alone and together with the image,
    likewise.

    Raises
    ------
    NoOverlapError
        If there is nothing to compare with within the search window.
    """
    search = FilmSearch(
        film, predicted, height_m=terrain.mean_m, crs=terrain.crs, posting_m=posting_m, search_m=search_m,
        threads=threads,
    )  # fmt: skip
    guesses: list[_Guess] = []
    everything = NOTHING

    def seen_by(evidence: _Evidence) -> tuple[_Evidence, Prepared]:
        raster = evidence.on_grid(search.grid)
        if not np.isfinite(raster).any():
            area = ", ".join(f"{v:.0f}" for v in search.grid.bounds)
            raise NoOverlapError(
                f"{predicted.scene}: the reference {evidence.name} holds nothing within ({area}) m of {terrain.crs}, "
                "where the film was looked for"
            )
        return evidence, search.prepared(raster)

    def look(
        views: Sequence[View], *choices: Sequence[tuple[_Evidence, Prepared]], last: bool = False
    ) -> tuple[list[_Guess], Found, bool]:
        nonlocal everything
        for choice, found in zip(
            choices, search.run([[p for _, p in choice] for choice in choices], views), strict=True
        ):
            guesses.extend(_Guess(candidate, tuple(e for e, _ in choice)) for candidate in found.candidates)
            everything = Found.best_of([everything, found])
        kept: list[_Guess] = []
        for guess in sorted(guesses, key=lambda guess: -guess.candidate.score):
            if not any(guess.candidate.is_like(other.candidate) for other in kept):
                kept.append(guess)
        return kept, everything, last

    picture = None
    if image is not None:
        try:
            picture = seen_by(image)
        except NoOverlapError as nothing:
            log.warning("%s; the relief remains", nothing)
    if picture is None:
        shape = seen_by(relief)
        yield look(search.narrow_views(), [shape])
        yield look(search.wide_views(), [shape], last=True)
    else:
        yield look(search.narrow_views(), [picture])
        yield look(search.wide_views(), [picture])
        shape = seen_by(relief)
        yield look(search.narrow_views(), [shape], [picture, shape])
        yield look(search.wide_views(), [shape], [picture, shape], last=True)


def _postings(coarse_m: float, last_m: float) -> list[float]:
    """Postings after the first search, each finer than the last by about the same ratio."""
    count = max(1, round(math.log(max(coarse_m / last_m, 1.0)) / math.log(_LEVEL_RATIO)))
    return [float(coarse_m * (last_m / coarse_m) ** ((i + 1) / count)) for i in range(count)]


def _against(other: _Placement, best: _Placement, *, same_way: bool) -> int:
    """How many matches that agree with another placement contradict the best one.

    A candidate that is right at one end of the film agrees there with the right one, and is no rival.
    """
    chosen = other.agreeing
    if not chosen.any() or not same_way:
        return int(chosen.sum())
    ground = best.camera.origin.local_from_geodetic(other.matches.lonlath(best.crs)[chosen])
    distance = np.linalg.norm(other.matches.film_mm[chosen] - best.camera.project(ground), axis=1)
    gate_mm = 2 * _GATE_PX * best.posting_m * _film_mm_per_m(best.camera, 0.0)
    return int((~(distance <= gate_mm)).sum())


def _cameras_of(
    candidate: Candidate, predicted: PanoramicCamera, terrain: Terrain
) -> tuple[PanoramicCamera, PanoramicCamera]:
    """The predicted camera turned, scaled and moved to a candidate's place, and fitted to its blocks, in its frame."""
    film_mm = np.column_stack([candidate.x_mm, np.zeros_like(candidate.x_mm)])
    smooth = replace(
        terrain,
        heights_m=np.asarray(cv2.blur(terrain.heights_m, (41, 41), borderType=cv2.BORDER_REPLICATE), np.float32),
    )
    height = smooth.at(candidate.found_m)
    to_geodetic = Transformer.from_crs(terrain.crs, "EPSG:4326", always_xy=True)
    lon, lat = to_geodetic.transform(candidate.found_m[:, 0], candidate.found_m[:, 1])

    turned = turned_about_centre(predicted, candidate.view.rotation, 1 + candidate.view.scale, terrain.mean_m)
    # The whole camera is carried over the ellipsoid, so that it keeps its height and its tilt.
    start, end = candidate.predicted_m.mean(axis=0), candidate.found_m.mean(axis=0)
    lon_change, lat_change = np.subtract(to_geodetic.transform(*end), to_geodetic.transform(*start))
    moved = replace(
        turned,
        origin=LocalFrame(
            turned.origin.longitude_deg + float(lon_change), turned.origin.latitude_deg + float(lat_change)
        ),
    )
    ground = moved.origin.local_from_geodetic(np.column_stack([lon, lat, height]))
    # A block is one template, so its place is known to about a pixel of the coarse posting.
    sigma_mm = np.full(len(film_mm), _film_mm_per_m(moved, terrain.mean_m) * terrain.grid.step_x * 1.5)
    fitted = refit_camera(moved, film_mm, ground, sigma_mm).camera
    return moved.moved_to(predicted.origin), fitted.moved_to(predicted.origin)


def turned_about_centre(camera: PanoramicCamera, rotation: float, scale: float, height_m: float) -> PanoramicCamera:
    """The camera whose film shows the ground turned (radians, counter-clockwise) and scaled about its middle."""
    p = camera.parameters()
    c, s = math.cos(rotation), math.sin(rotation)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    middle = camera.locate(np.zeros(2), height_m)
    angles = [angles_from_matrix(rotation_matrix(p[6:9] + tau * p[9:12]) @ turn.T) for tau in (-0.5, 0.0, 0.5)]
    position = middle + scale * turn @ (p[0:3] - middle)
    change = np.angle(np.exp(1j * (angles[2] - angles[0])))
    return camera.with_parameters(np.concatenate([position, scale * turn @ p[3:6], angles[1], change, p[12:]]))


def _film_mm_per_m(camera: PanoramicCamera, height_m: float) -> float:
    return 1.0 / ground_pixel_m(camera, 1.0, height_m)


def _tiles(camera: PanoramicCamera, posting_m: float, templates: _Templates) -> FloatArray:
    """Film points about which tiles of a posting are matched."""
    width_m = 2 * camera.half_width_mm / _film_mm_per_m(camera, 0.0)
    rows = int(np.clip(round(width_m / posting_m / templates.apart_px), 1, templates.across))
    return film_lattice(camera.half_length_mm, camera.half_width_mm, templates.along, rows)


def _placed(
    film: FilmImage,
    expected: PanoramicCamera,
    camera: PanoramicCamera,
    tiles_mm: FloatArray,
    templates: _Templates,
    reference_on: OnGrid,
    heights_on: OnGrid,
    crs: str,
    posting_m: float,
    rng: np.random.Generator,
    threads: int,
) -> _Placement:
    """A camera fitted to matches at a posting, and which of them agree with it."""
    mm_per_m = _film_mm_per_m(camera, 0.0)
    terrain = Terrain.on(heights_on, map_bounds(camera, crs), crs, max(posting_m, 200.0))
    matches = match_film_to_ground(
        film,
        camera,
        tiles_mm,
        reference_on=reference_on,
        heights_on=heights_on,
        terrain=terrain,
        matcher=structural(templates.template_px, templates.search_px, templates.min_score, 0.97, 1.5),
        posting_m=posting_m,
        tile_px=templates.tile_px,
        step_px=_STEP_PX,
        margin_px=templates.template_px // 2 + templates.search_px,
        threads=threads,
    )
    nothing = np.zeros(len(matches), bool)
    if len(matches) < 6:
        return _Placement(expected, camera, crs, matches, nothing, posting_m, float("nan"))
    ground = camera.origin.local_from_geodetic(matches.lonlath(crs))
    pixel_mm = mm_per_m * posting_m
    predicted = camera.project(ground)
    seen = np.isfinite(predicted).all(axis=1)
    eligible = seen
    if templates is _NEAR:
        agreeing = eligible = consistent_by_tile(
            predicted,
            matches.film_mm,
            tile_mm=_PIECE_MM,
            gate_mm=_PIECE_GATE_PX * pixel_mm,
            minimum=_PIECE_MATCHES,
            trials=_PIECE_TRIALS,
            rng=rng,
        )
    else:
        agreeing = nothing.copy()
        _, agreeing[seen] = ransac(
            estimate_affine,
            predicted[seen],
            matches.film_mm[seen],
            minimum=3,
            gate=2 * _GATE_PX * pixel_mm,
            trials=400,
            rng=rng,
        )
    if agreeing.sum() < 6:
        return _Placement(expected, camera, crs, matches, nothing, posting_m, float("nan"))
    fitted = camera
    distance = np.full(len(matches), np.inf)
    for _ in range(3):
        sigma = np.full(int(agreeing.sum()), pixel_mm)
        fitted = refit_camera(fitted, matches.film_mm[agreeing], ground[agreeing], sigma, prior=expected).camera
        distance = np.nan_to_num(np.linalg.norm(matches.film_mm - fitted.project(ground), axis=1), nan=np.inf)
        agreeing = eligible & (distance <= _GATE_PX * pixel_mm)
        if agreeing.sum() < 6:
            return _Placement(expected, camera, crs, matches, agreeing, posting_m, float("nan"))
    residual_m = float(np.median(distance[agreeing]) / mm_per_m)
    return _Placement(expected, fitted, crs, matches, agreeing, posting_m, residual_m)
