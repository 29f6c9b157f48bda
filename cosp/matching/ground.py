"""The ground under a film: its bounds on a map, tiles about film points, matches between film and ground."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from pyproj import Transformer

from cosp.arrays import Float32Array, FloatArray
from cosp.camera.mapping import MapProjector
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import NoOverlapError
from cosp.geometry.grids import PixelGrid
from cosp.geometry.lattices import smooth_on_grid
from cosp.geometry.mapping import utm_crs
from cosp.imaging.resampling import sample
from cosp.matching.film_image import FilmImage
from cosp.matching.matchers import Matcher

log = logging.getLogger(__name__)

OnGrid = Callable[[PixelGrid], Float32Array]
"""Gives a raster on a map grid, NaN where it has nothing."""

Bounds = tuple[float, float, float, float]
Item = TypeVar("Item")
Result = TypeVar("Result")
# Highest and lowest ground on Earth in round figures; where the terrain is not known yet.
_HEIGHT_RANGE_M = (0.0, 6000.0)
_TERRAIN_POSTING_M = 200.0
# Candidates along either side of a map tile.
_TILE_SIDE = 2
# So many templates at least side by side across the film.
_WIDTH_TEMPLATES = 3
# Largest side of a grid that counts as a tile: film coordinates are then smooth to far below a pixel.
_TILE_M = 20_000.0


@dataclass(frozen=True)
class Terrain:
    """Heights about a film at a coarse posting, for finding where film points lie.

    Parameters
    ----------
    grid : PixelGrid
        On the map.
    crs : str
    heights_m : (rows, columns) array
        Ellipsoidal, without gaps.
    """

    grid: PixelGrid
    crs: str
    heights_m: Float32Array

    @classmethod
    def on(cls, heights_on: OnGrid, bounds: Bounds, crs: str, posting_m: float) -> Terrain:
        """The terrain within bounds; gaps filled by the median height.

        Raises
        ------
        NoOverlapError
            If the elevation model has no height there.
        """
        grid = PixelGrid.covering(bounds, posting_m)
        heights = heights_on(grid)
        finite = np.isfinite(heights)
        if not finite.any():
            area = ", ".join(f"{v:.0f}" for v in bounds)
            raise NoOverlapError(
                f"the reference DEM holds no height within ({area}) m of {crs}, where the film was expected"
            )
        return cls(grid, crs, np.where(finite, heights, np.median(heights[finite])).astype(np.float32))

    @property
    def mean_m(self) -> float:
        """Mean height."""
        return float(self.heights_m.mean())

    def at(self, easting_northing: FloatArray) -> FloatArray:
        """Heights at map points (..., 2); the border's height outside."""
        rows, columns = self.grid.pixels(easting_northing)
        rows = np.clip(rows, 0, self.grid.shape[0] - 1)
        columns = np.clip(columns, 0, self.grid.shape[1] - 1)
        return np.asarray(sample(self.heights_m, rows, columns, interpolation="linear"), float)

    def map_points(self, camera: PanoramicCamera, film_mm: FloatArray) -> FloatArray:
        """Easting, northing, height (N, 3) where film points meet this terrain."""
        to_map = Transformer.from_crs("EPSG:4326", self.crs, always_xy=True)

        def height_at(lonlat: FloatArray) -> FloatArray:
            return self.at(np.stack(to_map.transform(lonlat[..., 0], lonlat[..., 1]), axis=-1))

        lonlath = camera.origin.geodetic_from_local(camera.locate_on(film_mm, height_at))
        east, north = to_map.transform(lonlath[..., 0], lonlath[..., 1])
        return np.stack([east, north, lonlath[..., 2]], axis=-1)


@dataclass(frozen=True)
class GroundMatches:
    """Film points and where they lie on the map.

    Parameters
    ----------
    film_mm : (N, 2) array
    map_m : (N, 3) array
        Easting, northing, ellipsoidal height.
    score : (N,) array
    sigma_m : (N,) array
        Standard deviation of the match per coordinate, on the ground.
    """

    film_mm: FloatArray
    map_m: FloatArray
    score: FloatArray
    sigma_m: FloatArray

    def __len__(self) -> int:
        return len(self.score)

    @classmethod
    def joined(cls, parts: Sequence[GroundMatches]) -> GroundMatches:
        """All matches of several records, in their order."""
        return cls(
            np.concatenate([np.empty((0, 2)), *(p.film_mm for p in parts)]),
            np.concatenate([np.empty((0, 3)), *(p.map_m for p in parts)]),
            np.concatenate([np.empty(0), *(p.score for p in parts)]),
            np.concatenate([np.empty(0), *(p.sigma_m for p in parts)]),
        )

    def lonlath(self, crs: str) -> FloatArray:
        """Longitude, latitude (degrees), ellipsoidal height, (N, 3)."""
        to_geodetic = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        lon, lat = to_geodetic.transform(self.map_m[:, 0], self.map_m[:, 1])
        return np.column_stack([lon, lat, self.map_m[:, 2]])


def film_lattice(half_length_mm: float, half_width_mm: float, columns: int, rows: int) -> FloatArray:
    """Centres (columns * rows, 2) of equal cells of a film, column by column along the film."""
    x = (np.arange(columns) + 0.5) / columns * 2 - 1
    y = (np.arange(rows) + 0.5) / rows * 2 - 1
    grid = np.stack(np.meshgrid(x * half_length_mm, y * half_width_mm, indexing="ij"), axis=-1)
    return grid.reshape(-1, 2)


def film_outline(camera: PanoramicCamera, points_per_side: int = 33) -> FloatArray:
    """Film points (N, 2) along the border of the picture, once around."""
    t = np.linspace(-1, 1, points_per_side)
    x, y = camera.half_length_mm, camera.half_width_mm
    sides = [
        np.stack([t * x, np.full_like(t, y)], -1),
        np.stack([np.full_like(t, x), -t * y], -1),
        np.stack([-t * x, np.full_like(t, -y)], -1),
        np.stack([np.full_like(t, -x), t * y], -1),
    ]
    return np.concatenate(sides)


def map_bounds(camera: PanoramicCamera, crs: str, heights_m: tuple[float, float] = _HEIGHT_RANGE_M) -> Bounds:
    """Bounds on the map of all that a film may show between two ellipsoidal heights."""
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    outline = film_outline(camera)
    found = [camera.locate_geodetic(outline, height) for height in heights_m]
    east, north = to_map.transform(*np.concatenate(found)[:, :2].T)
    return float(np.min(east)), float(np.min(north)), float(np.max(east)), float(np.max(north))


def map_crs(camera: PanoramicCamera) -> str:
    """The UTM zone of the middle of a film."""
    lon, lat, _ = camera.locate_geodetic(np.zeros(2), 0.0)
    return utm_crs(float(lon), float(lat))


def grown(bounds: Bounds, margin: float) -> Bounds:
    """Bounds with a margin on all sides."""
    return bounds[0] - margin, bounds[1] - margin, bounds[2] + margin, bounds[3] + margin


def ground_pixel_m(camera: PanoramicCamera, pixel_mm: float, height_m: float) -> float:
    """Side of a film pixel on the ground at the centre of the film."""
    points = camera.locate(np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]]), height_m)
    along, across = np.linalg.norm(points[1] - points[0]), np.linalg.norm(points[3] - points[2])
    return float(math.sqrt(along * across) * pixel_mm)


def reduction_for(posting_m: float, pixel_m: float) -> int:
    """Pixels of a film to average so that the result is about as fine as a posting, never coarser."""
    return max(1, int(posting_m / pixel_m + 0.05))


def tile_about(easting: float, northing: float, posting_m: float, size_px: int | tuple[int, int]) -> PixelGrid:
    """North-up grid about a map point, pixel edges on whole multiples of the posting.

    size_px : side of a square, or (rows, columns)
    """
    rows, columns = (size_px, size_px) if isinstance(size_px, int) else size_px
    left = math.floor(easting / posting_m) - columns // 2
    top = math.floor(northing / posting_m) + rows // 2
    return PixelGrid((left + 0.5) * posting_m, (top + 0.5) * posting_m, posting_m, -posting_m, (rows, columns))


def project_film(film: FilmImage, projector: MapProjector, grid: PixelGrid, heights_m: FloatArray) -> Float32Array:
    """The film on a map grid, (rows, columns); NaN where it shows nothing or the height is not known."""
    return film.sample(film_coordinates(projector, grid, heights_m))


def film_coordinates(projector: MapProjector, grid: PixelGrid, heights_m: FloatArray) -> FloatArray:
    """Film points (rows, columns, 2) in mm of every pixel of a map grid; NaN where the height is not known.

    Over a tile they are a polynomial of low degree in easting, northing and height, to 1e-5 mm; a grid larger than a
    tile, or one that leaves the sweep of the camera, is projected pixel by pixel.
    """
    known = np.isfinite(heights_m)
    if known.any() and max(grid.shape) * abs(grid.step_x) <= _TILE_M:
        low, high = float(heights_m[known].min()), float(heights_m[known].max())
        middle, half = (low + high) / 2, max((high - low) / 2, 1.0)
        levels = middle + half * np.array([-1.0, 0.0, 1.0])

        def terms(xy: FloatArray) -> FloatArray:
            below, at, above = (projector.film(xy[..., 0], xy[..., 1], level) for level in levels)
            return np.concatenate([at, (above - below) / 2, (above + below) / 2 - at], axis=-1)

        planes = smooth_on_grid(terms, grid)
        if np.isfinite(planes).all():
            height = (np.asarray(heights_m, float) - middle) / half
            return np.stack([planes[i] + height * (planes[i + 2] + height * planes[i + 4]) for i in (0, 1)], axis=-1)
    centres = grid.centres()
    return projector.film(centres[..., 0], centres[..., 1], heights_m)


def lattice_rc(shape: tuple[int, int], step_px: int, margin_px: int) -> FloatArray:
    """Points (N, 2), rows and columns, every `step_px` pixels, as many as fit about the middle within a margin."""
    axes = []
    for length in shape:
        steps = max(length - 1 - 2 * margin_px, 0) // step_px
        axes.append((length - 1 - steps * step_px) // 2 + np.arange(steps + 1) * step_px)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2).astype(float)


def match_film_to_ground(
    film: FilmImage,
    camera: PanoramicCamera,
    film_points_mm: FloatArray,
    *,
    reference_on: OnGrid,
    heights_on: OnGrid,
    terrain: Terrain,
    matcher: Matcher,
    posting_m: float,
    tile_px: int | tuple[int, int],
    step_px: int,
    margin_px: int,
    threads: int,
) -> GroundMatches:
    """Matches of map tiles about film points: what the film shows there against the reference.

    Parameters
    ----------
    film : FilmImage
        About as fine as the posting.
    film_points_mm : (N, 2) array
        Centres of the tiles.
    reference_on, heights_on : functions of a PixelGrid
        Reference image and ellipsoidal heights on a map grid.
    posting_m : float
        Of the map tiles.
    tile_px : int or (rows, columns)
        Side of a tile, or both.
    step_px : int
        Distance of the points that are asked of the matcher.
    margin_px : int
        What the matcher needs about a point: half a template and its search.
    threads : int
        Tiles worked on at once.
    """
    projector = MapProjector(camera, terrain.crs, grown(terrain.grid.bounds, 0.6 * np.max(tile_px) * posting_m))
    places = terrain.map_points(camera, film_points_mm)
    places = places[np.isfinite(places).all(axis=1)]

    def work(place: FloatArray) -> GroundMatches:
        grid = tile_about(place[0], place[1], posting_m, tile_px)
        reference = reference_on(grid)
        if not np.isfinite(reference).any():
            return GroundMatches.joined([])
        heights = heights_on(grid)
        seen = project_film(film, projector, grid, heights)
        found = matcher.match(seen, reference, lattice_rc(grid.shape, step_px, margin_px), threads=1)
        if not len(found):
            return GroundMatches.joined([])
        film_mm = film_points_at(projector, grid, heights, found.moving_rc)
        map_m = map_points_at(grid, heights, found.fixed_rc)
        whole = np.isfinite(film_mm).all(axis=1) & np.isfinite(map_m).all(axis=1)
        return GroundMatches(film_mm[whole], map_m[whole], found.score[whole], found.sigma_px[whole] * posting_m)

    return GroundMatches.joined(in_threads(work, list(places), threads))


def in_threads(work: Callable[[Item], Result], items: Sequence[Item], threads: int) -> list[Result]:
    """Results of a function for each item, in their order, with progress in the log."""
    results: list[Result] = []

    def gather(found: Iterable[Result]) -> None:
        for result in found:
            results.append(result)
            if len(results) % 100 == 0:
                log.info("%d/%d tiles", len(results), len(items))

    if threads <= 1:
        gather(map(work, items))
    else:
        with ThreadPoolExecutor(threads) as pool:
            gather(pool.map(work, items))
    return results


def map_points_at(grid: PixelGrid, heights_m: Float32Array, points_rc: FloatArray) -> FloatArray:
    """Easting, northing, height (N, 3) of places (N, 2) of a map grid; NaN height in a gap."""
    height = sample(
        np.asarray(heights_m, np.float32), points_rc[:, 0], points_rc[:, 1], interpolation="linear", border=float("nan")
    )
    return np.column_stack([grid.points(points_rc[:, 0], points_rc[:, 1]), height])


def film_points_at(
    projector: MapProjector, grid: PixelGrid, heights_m: Float32Array, points_rc: FloatArray
) -> FloatArray:
    """Film points (N, 2) in mm that show places (N, 2) of a map grid."""
    return projector.film(*map_points_at(grid, heights_m, points_rc).T)


def control_tiles(camera: PanoramicCamera, candidates: int) -> FloatArray:
    """Film points (N, 2), evenly spread and in order along the film, for tiles of four candidates each."""
    count = max(1, candidates // _TILE_SIDE**2)
    rows = max(1, round(math.sqrt(count * camera.half_width_mm / camera.half_length_mm)))
    return film_lattice(camera.half_length_mm, camera.half_width_mm, max(1, round(count / rows)), rows)


@dataclass(frozen=True)
class PlacedFilm:
    """A placed film and the ground it shows, to be matched at the coarser of film and reference.

    Parameters
    ----------
    film : FilmImage
        At full resolution; only what is matched is read.
    camera : PanoramicCamera
        Good to a few pixels.
    reference_on, heights_on : functions of a PixelGrid
    terrain : Terrain
        Of the whole film.
    posting_m, pixel_m : float
        What is matched at, and the side of a film pixel on the ground.
    """

    film: FilmImage
    camera: PanoramicCamera
    reference_on: OnGrid
    heights_on: OnGrid
    terrain: Terrain
    posting_m: float
    pixel_m: float

    @classmethod
    def of(
        cls,
        film: FilmImage,
        camera: PanoramicCamera,
        *,
        reference_on: OnGrid,
        heights_on: OnGrid,
        crs: str,
        reference_posting_m: float,
    ) -> PlacedFilm:
        """A film on its ground, `reference_posting_m` being what the reference can show."""
        terrain = Terrain.on(heights_on, grown(map_bounds(camera, crs), 2000.0), crs, _TERRAIN_POSTING_M)
        pixel_m = ground_pixel_m(camera, film.pixel_mm, terrain.mean_m)
        posting_m = max(reference_posting_m, pixel_m)
        return cls(film, camera, reference_on, heights_on, terrain, posting_m, pixel_m)

    def on_film_mm(self, count_px: float) -> float:
        """Length on the film of so many pixels of what is matched."""
        return count_px * self.posting_m / self.pixel_m * self.film.pixel_mm

    def template_within_px(self, template_px: int) -> int:
        """The side of a template, or what a third of the film's width is long: control ends half a template within."""
        return min(template_px, int(2 * self.camera.half_width_mm / _WIDTH_TEMPLATES / self.on_film_mm(1.0)))

    def match(
        self,
        tiles_mm: FloatArray,
        *,
        matcher: Matcher,
        tile_px: int | tuple[int, int],
        step_px: int,
        margin_px: int,
        threads: int,
    ) -> GroundMatches:
        """Matches of tiles about film points, as `match_film_to_ground` gives them; none for no tile."""
        if not len(tiles_mm):
            return GroundMatches.joined([])
        reach_mm = self.on_film_mm(np.max(tile_px))  # half a tile and the slant of a map square on the film
        part = self.film.part(float(tiles_mm[:, 0].min()) - reach_mm, float(tiles_mm[:, 0].max()) + reach_mm)
        matches = match_film_to_ground(
            part.reduced(reduction_for(self.posting_m, self.pixel_m)),
            self.camera,
            tiles_mm,
            reference_on=self.reference_on,
            heights_on=self.heights_on,
            terrain=self.terrain,
            matcher=matcher,
            posting_m=self.posting_m,
            tile_px=tile_px,
            step_px=step_px,
            margin_px=margin_px,
            threads=threads,
        )
        log.info("%d matches in %d tiles of %s px at %.1f m", len(matches), len(tiles_mm), tile_px, self.posting_m)
        return matches


def match_control(
    placed: PlacedFilm, tiles_mm: FloatArray, *, matcher: Matcher, template_px: int, search_px: int, threads: int
) -> GroundMatches:
    """Matches of templates in small tiles about film points, such as those of `control_tiles`."""
    step_px = max(template_px // 2, 1)
    return placed.match(
        tiles_mm,
        matcher=matcher,
        tile_px=template_px + 2 * search_px + (_TILE_SIDE - 1) * step_px + 6,
        step_px=step_px,
        margin_px=template_px // 2 + search_px,
        threads=threads,
    )
