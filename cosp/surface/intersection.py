"""Ground points of conjugate film points, for every pixel of a pair."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from cosp.arrays import FloatArray
from cosp.geometry.rays import Rays
from cosp.imaging.windows import strips
from cosp.surface import kernels

# Nodes across the film. Rays of a camera without distortion are exact between any; smooth distortion that changes over
# some centimetres leaves less than a thousandth of a pixel between so many.
_ACROSS = 65
_LARGEST_ERROR_RAD = 2e-7  # a fiftieth of the pixel of a film digitised at 7 um
_CHECKED_EVERY = 16  # places along, at which the table is held against rays between its nodes


@dataclass(frozen=True)
class RayTable:
    """The rays of a camera at the nodes of a lattice over its film.

    Directions have the length that makes them linear along y: their component along the middle ray of their x is one.

    Parameters
    ----------
    start_mm, step_mm : (x, y)
        First node and distance of nodes.
    values : (N, M, 6) array
        Origin in metres and direction at each x and y.
    """

    start_mm: tuple[float, float]
    step_mm: tuple[float, float]
    values: FloatArray

    @property
    def scale(self) -> tuple[float, float, float, float]:
        """Place among the nodes along x of x = 0 and its change per millimetre; the same along y."""
        (x, y), (step_x, step_y) = self.start_mm, self.step_mm
        return -x / step_x, 1 / step_x, -y / step_y, 1 / step_y


def tabulate_rays(
    rays: Callable[[FloatArray], Rays], *, half_length_mm: float, half_width_mm: float, places: int
) -> RayTable:
    """Table of the rays of one camera, whatever camera.

    Parameters
    ----------
    rays : function
        Rays of film points (..., 2) in mm.
    half_length_mm, half_width_mm : float
        Half the film that will be asked for.
    places : int
        Number of x; linear between them. With 8192 on a whole film the error is below 0.1 mm on the ground.

    Raises
    ------
    ValueError
        The rays between the nodes are not those that the nodes say: such a table cannot stand for them.
    """
    x = np.linspace(-half_length_mm, half_length_mm, places)
    y = np.linspace(-half_width_mm, half_width_mm, _ACROSS)
    sampled = rays(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1))
    middle = sampled.direction[:, _ACROSS // 2, :, None]
    table = RayTable(
        (-half_length_mm, -half_width_mm),
        (2 * half_length_mm / (places - 1), 2 * half_width_mm / (_ACROSS - 1)),
        np.concatenate([sampled.origin, sampled.direction / (sampled.direction @ middle)], axis=-1),
    )

    chosen = slice(None, -1, _CHECKED_EVERY)
    node = table.values[..., 3:]
    expected = node[:-1, :-1] + node[1:, :-1] + node[:-1, 1:] + node[1:, 1:]
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    between = rays(
        np.stack(np.meshgrid(x[chosen] + table.step_mm[0] / 2, y[:-1] + table.step_mm[1] / 2, indexing="ij"), -1)
    )
    worst = float(np.linalg.norm(expected[chosen] - between.direction, axis=-1).max())
    if not worst < _LARGEST_ERROR_RAD:
        raise ValueError(
            f"rays bend by {worst:.1e} rad between {places} x {_ACROSS} nodes of the film: no such table holds them"
        )
    return table


def intersect_tabulated(
    fore: RayTable, aft: RayTable, fore_mm: FloatArray, aft_mm: FloatArray, *, threads: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Ground points of conjugate film points, and the gap their rays leave.

    The same least-squares point as `cosp.geometry.rays.meet`, from tables.

    Parameters
    ----------
    fore, aft : RayTable
        In one local frame.
    fore_mm, aft_mm : (..., 2) arrays, mm
        NaN for no correspondence.
    threads : int

    Returns
    -------
    ground : (..., 3) float64 array, m
        NaN outside the tables.
    miss_m : (...) float64 array
        Length of the common perpendicular.

    References
    ----------
    [Ghuffar2022] equation 13, in closed form.
    """
    shape = fore_mm.shape[:-1]
    fore_flat = np.ascontiguousarray(fore_mm, dtype=float).reshape(-1, 2)
    aft_flat = np.ascontiguousarray(aft_mm, dtype=float).reshape(-1, 2)
    ground, miss = np.empty((len(fore_flat), 3)), np.empty(len(fore_flat))

    def intersect(piece: tuple[int, int]) -> None:
        part = slice(*piece)
        kernels.intersect_tabulated(
            fore.values,
            fore.scale,
            aft.values,
            aft.scale,
            fore_flat[part],
            aft_flat[part],
            ground[part],
            miss[part],
        )

    pieces = strips(len(fore_flat), threads)
    if threads == 1:
        intersect(pieces[0])
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(intersect, pieces))
    return ground.reshape(*shape, 3), miss.reshape(shape)


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
