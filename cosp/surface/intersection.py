"""Ground points of conjugate pixels, for every pixel of a pair."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cosp.arrays import ByteArray, Float32Array, FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.grids import PixelGrid
from cosp.geometry.lattices import between_nodes
from cosp.geometry.mapping import MapFrame
from cosp.geometry.rays import Rays
from cosp.imaging.windows import Window
from cosp.surface import kernels

_CHECKED_EVERY = 8  # cells along, at which a table is held against rays between its nodes
_MOST_BENT = 0.01  # of these cells may hold rays that the table does not: they are left out
_BLOCK_NODES = 20_000  # nodes whose rays are asked for at a time


@dataclass(frozen=True)
class RayTable:
    """The rays of a camera at nodes over its rectified image.

    Directions have the length that makes them linear along a row: their component along the middle ray of each row of
    nodes is one.

    Parameters
    ----------
    nodes : PixelGrid
        In pixels of the image, x its column and y its row.
    values : (R, C, 8) array
        Origin in metres and direction at each node, and two zeros so that nodes lie on lines of the cache; NaN outside
        the film.
    """

    nodes: PixelGrid
    values: FloatArray

    def scale(self, window: Window) -> tuple[float, float, float, float]:
        """Row of nodes of the window's first row and change per pixel; the same for columns."""
        row, column = self.nodes.pixels(np.array([window.column0, window.row0]))
        return float(row), 1 / self.nodes.step_y, float(column), 1 / self.nodes.step_x


def nodes_over(low: tuple[float, float], high: tuple[float, float], *, spacing_px: float) -> PixelGrid:
    """Nodes from a low (column, row) to a high one, both among them, at most so far apart."""
    counts = [max(2, math.ceil((b - a) / spacing_px) + 1) for a, b in zip(low, high, strict=True)]
    steps = [max(b - a, 1.0) / (n - 1) for a, b, n in zip(low, high, counts, strict=True)]
    return PixelGrid(low[0], low[1], steps[0], steps[1], (counts[1], counts[0]))


def tabulate_rays(rays: Callable[[FloatArray], Rays], nodes: PixelGrid, *, largest_error_rad: float) -> RayTable:
    """Table of the rays of one camera, whatever camera.

    Parameters
    ----------
    rays : function
        Rays of places (..., 2) of the rectified image: column, row. NaN outside the film.
    nodes : PixelGrid
        Bilinear between them. 0.3 mm of film apart they leave less than a millimetre on the ground
        where the film is without distortion.
    largest_error_rad : float
        Angle between a ray and what the nodes about it say that is let pass. The few nodes about cells where it is
        more, in the last rows of an image, become NaN.

    Raises
    ------
    ValueError
        The rays between the nodes are not those that the nodes say in more than one cell of a hundred: such a table
        cannot stand for them.
    """
    rows, columns = nodes.shape
    values = np.zeros((rows, columns, 8))
    bent = np.zeros((rows, columns), bool)
    worst, known = 0.0, 0
    height = max(1, _BLOCK_NODES // columns)
    for row in range(0, rows, height):
        # One more row of nodes than are written, so that every cell is looked into.
        part = nodes.window(row, min(row + height + 1, rows), 0, columns)
        sampled = rays(part.centres())
        middle = sampled.direction[:, columns // 2, :, None]
        node = np.concatenate([sampled.origin, sampled.direction / (sampled.direction @ middle)], axis=-1)
        values[row : row + part.shape[0], :, :6] = node
        error = _error_between(rays, part, node[..., 3:])
        with np.errstate(invalid="ignore"):
            bent[row : row + error.shape[0], : columns - 1 : _CHECKED_EVERY] |= error >= largest_error_rad
        worst = max(worst, float(np.nanmax(error, initial=0.0)))
        known += int(np.isfinite(error).sum())
    if bent.sum() > _MOST_BENT * known:
        raise ValueError(
            f"rays bend by up to {worst:.1e} rad between {rows} x {columns} nodes of the image, in {bent.sum()} of "
            f"{known} cells by more than {largest_error_rad:.1e}: no such table holds them"
        )
    for row, column in zip(*np.nonzero(bent), strict=True):
        # Also what lies between the cells that were looked into.
        values[row : row + 2, max(column - _CHECKED_EVERY, 0) : column + _CHECKED_EVERY + 2] = np.nan
    return RayTable(nodes, values)


def _error_between(rays: Callable[[FloatArray], Rays], nodes: PixelGrid, directions: FloatArray) -> FloatArray:
    """Angles, in radians, between rays in the middle of some cells and what the nodes say of them; NaN off the film."""
    chosen = slice(None, None, _CHECKED_EVERY)
    expected = directions[:-1, :-1] + directions[1:, :-1] + directions[:-1, 1:] + directions[1:, 1:]
    expected = expected[:, chosen]
    expected = expected / np.linalg.norm(expected, axis=-1, keepdims=True)
    places = nodes.centres()[:-1, :-1][:, chosen] + np.array([nodes.step_x, nodes.step_y]) / 2
    return np.asarray(np.linalg.norm(expected - rays(places).direction, axis=-1))


def intersect_pixels(
    fore: RayTable, aft: RayTable, window: Window, disparity: FloatArray, y_parallax: FloatArray, *, every: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Ground points of the pixels of a window, and the gap their rays leave.

    The same least-squares point as `cosp.geometry.rays.meet`, from tables.

    Parameters
    ----------
    fore, aft : RayTable
        In one local frame.
    window : Window
        Of the fore image.
    disparity, y_parallax : (H, W) arrays, px
        Aft column minus fore column, NaN for no correspondence; aft row minus fore row.
    every : int
        The arrays hold every so-manyth pixel of every so-manyth row of the window.

    Returns
    -------
    ground : (H, W, 3) float64 array, m
        NaN outside the tables.
    miss_m : (H, W) float32 array
        Length of the common perpendicular.

    References
    ----------
    [Ghuffar2022] equation 13, in closed form.
    """
    ground, miss = np.empty((*disparity.shape, 3)), np.empty(disparity.shape, np.float32)
    kernels.intersect_pixels(
        fore.values, fore.scale(window), aft.values, aft.scale(window), every, disparity, y_parallax, ground, miss
    )
    return ground, miss


class RectifiedPair(Protocol):
    """What is asked of a rectification (`cosp.epipolar.rectification.Rectification`)."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the fore image."""

    @property
    def pixel_mm(self) -> float:
        """Size of a pixel of both images on the film."""

    @property
    def disparity_range_px(self) -> tuple[float, float]:
        """Lowest and highest disparity of all pixels."""

    def fore_film(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """Fore film points (..., 2) of places of the fore image."""

    def aft_film(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """Aft film points (..., 2) of places of the aft image."""

    def disparity_bounds(self, rows: FloatArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Disparities of the lowest and the highest ground expected at fore pixels."""


@dataclass(frozen=True)
class PixelIntersection:
    """Ground points of any window of a rectified pair, from its disparity.

    Parameters
    ----------
    fore, aft : RayTable
        In one local frame.
    lowest, highest : (R, C) arrays, px
        Disparities of the lowest and the highest ground expected, at the nodes of the fore rays; other ones are left
        out.
    y_parallax, y_parallax_nodes : (R, C) array, px, and PixelGrid
        Aft row minus fore row at nodes of the fore image: what the rectification left.
    """

    fore: RayTable
    aft: RayTable
    lowest: FloatArray
    highest: FloatArray
    y_parallax: FloatArray
    y_parallax_nodes: PixelGrid

    @classmethod
    def of_films(
        cls,
        pair: RectifiedPair,
        fore: PanoramicCamera,
        aft: PanoramicCamera,
        y_parallax: FloatArray,
        y_parallax_nodes: PixelGrid,
        *,
        ray_spacing_mm: float,
        ray_error_px: float,
    ) -> PixelIntersection:
        """The same as `prepare` for two panoramic cameras, in the local frame of the fore one.

        Parameters
        ----------
        pair : RectifiedPair
        fore, aft : PanoramicCamera
        y_parallax, y_parallax_nodes
            As of the class; NaN is taken as none.
        ray_spacing_mm : float
            Largest distance of nodes on the film.
        ray_error_px : float
            How far off rays between the nodes may be.
        """
        return cls.prepare(
            pair,
            fore.rays_about_format,
            aft.moved_to(fore.origin).rays_about_format,
            y_parallax,
            y_parallax_nodes,
            spacing_px=ray_spacing_mm / pair.pixel_mm,
            largest_error_rad=ray_error_px * pair.pixel_mm / fore.focal_length_mm,
        )

    @classmethod
    def prepare(
        cls,
        pair: RectifiedPair,
        fore_rays: Callable[[FloatArray], Rays],
        aft_rays: Callable[[FloatArray], Rays],
        y_parallax: FloatArray,
        y_parallax_nodes: PixelGrid,
        *,
        spacing_px: float,
        largest_error_rad: float,
    ) -> PixelIntersection:
        """Tabulate the rays of both films over their rectified images.

        Parameters
        ----------
        pair : RectifiedPair
        fore_rays, aft_rays : functions
            Rays of film points (..., 2) in mm, in one local frame; NaN outside the film.
        y_parallax, y_parallax_nodes
            As of the class; NaN is taken as none.
        spacing_px : float
            Largest distance of nodes.
        largest_error_rad : float
            See `tabulate_rays`.
        """
        rows, columns = pair.shape
        y_parallax = np.nan_to_num(y_parallax)
        slack = math.ceil(float(np.abs(y_parallax).max(initial=0.0))) + 1
        low, high = pair.disparity_range_px
        nodes = nodes_over((0, 0), (columns - 1, rows - 1), spacing_px=spacing_px)
        centres = nodes.centres()
        lowest, highest = pair.disparity_bounds(centres[..., 1], centres[..., 0])
        return cls(
            tabulate_rays(
                lambda place: fore_rays(pair.fore_film(place[..., 1], place[..., 0])),
                nodes,
                largest_error_rad=largest_error_rad,
            ),
            tabulate_rays(
                lambda place: aft_rays(pair.aft_film(place[..., 1], place[..., 0])),
                nodes_over((low - 1, -slack), (columns + high, rows - 1 + slack), spacing_px=spacing_px),
                largest_error_rad=largest_error_rad,
            ),
            lowest,
            highest,
            y_parallax,
            y_parallax_nodes,
        )

    def ground(self, window: Window, disparity: FloatArray, *, every: int = 1) -> tuple[FloatArray, Float32Array]:
        """Ground points (H, W, 3) in the local frame and gaps (H, W) of a window of the fore image, in metres.

        With `every`, of every so-manyth pixel of every so-manyth row of it, to which `disparity` belongs.
        """
        likely, smooth = self._likely(window, disparity, every)
        return intersect_pixels(self.fore, self.aft, window, likely, smooth, every=every)

    def cell_points(
        self,
        window: Window,
        disparity: FloatArray,
        confidence: ByteArray,
        *,
        weights: FloatArray,
        largest_miss_m: float,
        map_frame: MapFrame,
        grid: PixelGrid,
        first_cell: tuple[int, int],
    ) -> Float32Array:
        """Points of a window on the map, in cells of a grid: (N, 4) of column, row, height, weight.

        Parameters
        ----------
        window : Window
            Of the fore image.
        disparity, confidence : (H, W) arrays
        weights : (256,) array
            Of points of each confidence; those of weight 0 are left out.
        largest_miss_m : float
            Rays may miss each other by no more.
        map_frame : MapFrame
            From the local frame to the map.
        grid : PixelGrid
        first_cell : (row, column)
            Cell at which rows and columns are 0; near by, for they are float32.
        """
        likely, smooth = self._likely(window, disparity, 1)
        part = grid.window(first_cell[0], first_cell[0], first_cell[1], first_cell[1])
        points = np.empty((likely.size, 4), np.float32)
        count = kernels.points_of_pixels(
            self.fore.values,
            self.fore.scale(window),
            self.aft.values,
            self.aft.scale(window),
            likely,
            smooth,
            confidence,
            np.asarray(weights, float),
            largest_miss_m,
            *map_frame.lattice_to_map,
            (part.x0, part.y0, 1 / part.step_x, 1 / part.step_y),
            points,
        )
        return points[:count].copy()

    def _likely(self, window: Window, disparity: FloatArray, every: int) -> tuple[Float32Array, Float32Array]:
        """Disparities of ground at heights that are expected, NaN in place of others, and y-parallax."""
        low, high, smooth = (
            between_nodes(
                values,
                ((window.row0 - nodes.y0) / nodes.step_y, (window.column0 - nodes.x0) / nodes.step_x),
                (every / nodes.step_y, every / nodes.step_x),
                disparity.shape,
            )
            for values, nodes in (
                (self.lowest, self.fore.nodes),
                (self.highest, self.fore.nodes),
                (self.y_parallax, self.y_parallax_nodes),
            )
        )
        with np.errstate(invalid="ignore"):
            likely = np.where((disparity >= low) & (disparity <= high), disparity, np.float32(np.nan))
        return np.asarray(likely, np.float32), smooth


def miss_limit(miss_m: FloatArray, *, gate_sigmas: float, least_m: float) -> float:
    """Largest gap between two rays that still counts as a meeting.

    Gaps are distances: their median times 1.4826 is the standard deviation of the signed gap about zero.

    Parameters
    ----------
    miss_m : array
        A fair sample of gaps; NaN are left out.
    gate_sigmas : float
    least_m : float
        The limit is never below this, so that a near-perfect pair loses nothing.
    """
    finite = miss_m[np.isfinite(miss_m)]
    if not finite.size:
        return least_m
    return max(least_m, gate_sigmas * 1.4826 * float(np.median(finite)))


def height_per_pixel(ground: Sequence[FloatArray], one_more: Sequence[FloatArray]) -> float:
    """Height that one pixel of parallax is worth, in metres: median over samples of ground points.

    Parameters
    ----------
    ground, one_more : arrays (..., 3), m
        Points of some disparities, and of the same disparities plus one pixel.
    """
    steps = np.concatenate([(b - a)[..., 2].ravel() for a, b in zip(ground, one_more, strict=True)])
    return float(abs(np.nanmedian(steps))) if np.isfinite(steps).any() else float("nan")


def pixel_on_ground(range_m: FloatArray, focal_length_mm: float, pixel_mm: float) -> float:
    """Side of a film pixel on the ground across the ray, in metres, at the median of the given ranges."""
    finite = range_m[np.isfinite(range_m)]
    return float(np.median(finite)) * pixel_mm / focal_length_mm if finite.size else float("nan")
