"""Film exposed ray by ray, and digitised: from the plan of a scene to the pixels of its four parts."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from pyproj import Transformer

from cosp.arrays import ByteArray, Float32Array, FloatArray
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.simulation import kernels
from cosp.simulation.defects import (
    RAIL_HOLE_MM,
    RAIL_HOLE_RADIUS_MM,
    STRIPE_HALF_WIDTH_MM,
    STRIPE_MM,
    FilmTruth,
    Part,
    draw_strokes,
    make_film,
)
from cosp.simulation.orbit import FILM_HALF_WIDTH_MM, HALF_LENGTH_MM, HALF_WIDTH_MM, Exposure
from cosp.simulation.site import ScenePlan, SitePlan
from cosp.simulation.terrain import FILM_EPOCH, Scenery

BASE_GREY = 26.0
BLOCK_CELLS = 24
LATTICE_MM = 0.95
LATTICE_PX = 32
STRIP_ROWS = 256

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Ground:
    """What film looks at: heights on a north-up grid, brightness, texture, and block maxima to skip air."""

    heights: Float32Array
    scenery: Scenery
    maxima: Float32Array
    grid: PixelGrid
    crs: str

    @classmethod
    def of(cls, heights: Float32Array, scenery: Scenery, grid: PixelGrid, crs: str) -> Ground:
        """Ground with its block maxima."""
        return cls(heights, scenery, kernels.block_maxima(heights, BLOCK_CELLS), grid, crs)

    @property
    def levels_m(self) -> tuple[float, float, float]:
        """Three heights that enclose the terrain."""
        low = float(self.heights.min()) - 20.0
        high = float(self.heights.max()) + 20.0
        return low, (low + high) / 2.0, high


def expose_film(
    plan: SitePlan, scene: ScenePlan, ground: Ground, *, threads: int
) -> Iterator[tuple[Part, Window, ByteArray]]:
    """Digitised rows of the four parts of a film, one strip after another, part by part.

    Yields
    ------
    part, window of the part that these rows fill, (rows, columns) uint8 grey values
    """
    film = make_film(plan.settings, scene)
    jobs = [
        (part, row, min(row + STRIP_ROWS, part.shape[0]))
        for part in film.parts
        for row in range(0, part.shape[0], STRIP_ROWS)
    ]
    waiting: deque[tuple[Part, Window, Future[ByteArray]]] = deque()
    done = 0
    with ThreadPoolExecutor(threads) as pool:
        while jobs or waiting:
            while jobs and len(waiting) < 2 * threads:
                part, row0, row1 = jobs.pop(0)
                window = Window(row0, row1, 0, part.shape[1])
                waiting.append((part, window, pool.submit(_expose_rows, plan, scene, film, part, row0, row1, ground)))
            part, window, future = waiting.popleft()
            yield part, window, future.result()
            done += 1
            if done % 20 == 0:
                _log.info("%s: %d/%d strips exposed", scene.scene, done, done + len(jobs) + len(waiting))


def film_lattice(
    exposure: Exposure, film: FilmTruth, part: Part, rows: FloatArray, columns: FloatArray, ground: Ground
) -> FloatArray:
    """Exact rays at lattice points of a part.

    Returns
    -------
    (n, m, 8) ideal film x, y (mm), then map east and north where the ray passes the lowest, middle and highest level
    """
    delivered = part.delivered(rows[:, None], columns[None, :])
    ideal = film.deformation.ideal(film.delivered(delivered))
    # Beyond the film there is no ray; the last one stands in.
    inside = np.clip(ideal, [-HALF_LENGTH_MM - 3.0, -HALF_WIDTH_MM - 3.0], [HALF_LENGTH_MM + 3.0, HALF_WIDTH_MM + 3.0])
    nodes = np.empty((*ideal.shape[:2], 8))
    nodes[..., :2] = ideal
    transformer = Transformer.from_crs("EPSG:4979", ground.crs, always_xy=True)
    for level, height in enumerate(ground.levels_m):
        geodetic = exposure.ground_at(inside, height)
        east, north = transformer.transform(geodetic[..., 0], geodetic[..., 1])
        nodes[..., 2 + 2 * level] = east
        nodes[..., 3 + 2 * level] = north
    return nodes


def _expose_rows(
    plan: SitePlan, scene: ScenePlan, film: FilmTruth, part: Part, row0: int, row1: int, ground: Ground
) -> ByteArray:
    """Grey values of rows `row0` to `row1` of a part."""
    settings = plan.settings
    step = max(2, min(LATTICE_PX, int(LATTICE_MM / part.pixel_mm)))
    rows = row0 + step * np.arange((row1 - row0 - 1) // step + 2, dtype=float)
    columns = step * np.arange((part.shape[1] - 1) // step + 2, dtype=float)
    nodes = film_lattice(scene.exposure, film, part, rows, columns, ground)
    out = np.empty((row1 - row0, part.shape[1]), np.uint8)
    low, _, high = ground.levels_m
    stripes = settings.camera == "KH-4B" and settings.marks
    # Grain of 10 µm averages out in a coarse pixel; the rms of value noise is about 0.55 of what is wanted.
    grain = settings.grain_grey * 1.2 * min(1.0, (0.010 / part.pixel_mm)) ** 0.8
    number = settings.seed * 100 + scene.number
    kernels.expose_rows(
        out, row0, nodes, step, part.pixel_mm, ground.heights, ground.maxima, BLOCK_CELLS,
        ground.grid.x0, ground.grid.y0, ground.grid.step_x, low, high,
        ground.scenery.radiance, ground.scenery.strength,
        HALF_LENGTH_MM, HALF_WIDTH_MM, FILM_HALF_WIDTH_MM, film.turned,
        STRIPE_MM, STRIPE_HALF_WIDTH_MM if stripes else 0.0, RAIL_HOLE_MM, RAIL_HOLE_RADIUS_MM,
        BASE_GREY, 226.0, settings.saturation, settings.gamma, settings.vignetting, grain,
        settings.scanner_noise_grey, part.gain, part.offset_grey,
        settings.changed_share, 300 * FILM_EPOCH, settings.seed * 7919, number * 31, number * 37 + ord(part.letter),
    )  # fmt: skip
    draw_strokes(out, part, row0, film.strokes)
    return out


def pixel_of_film(film: FilmTruth, part: Part, ideal_mm: FloatArray) -> FloatArray:
    """Row and column (..., 2) in a part of ideal film points."""
    return part.pixels(film.delivered(film.deformation.measured(ideal_mm)))
