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

_STRAIGHT_RAD = 1e-9  # rays this near to the tabulated ones meet the ground within 0.3 mm


@dataclass(frozen=True)
class RayTable:
    """The rays of a camera whose slit sweeps along x: everything that depends on x alone.

    The ray of film point (x, y) starts at c(x) and runs along a(x) + y b(x).

    Parameters
    ----------
    start_mm, step_mm : float
        x of the first place and distance between places.
    values : (N, 9) array
        c in metres, a without unit, b per millimetre, in this order.
    """

    start_mm: float
    step_mm: float
    values: FloatArray


def tabulate_rays(
    rays: Callable[[FloatArray], Rays], *, half_length_mm: float, half_width_mm: float, places: int
) -> RayTable:
    """Table of the rays of one camera, from three rays at each x.

    The three directions at y = -w, 0 and w span a plane; a is the middle one, and b follows from where
    the outer ones cut the line a + y b.

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
        The directions are not linear in y, so that such a table cannot stand for them.
    """
    x = np.linspace(-half_length_mm, half_length_mm, places)
    across = np.array([-1.0, 0.0, 1.0, 0.5]) * half_width_mm
    film = np.stack(np.broadcast_arrays(x[:, None], across[None, :]), axis=-1)
    sampled = rays(film)
    low, middle, high, between = (sampled.direction[:, i] for i in range(4))
    # 2 a = p low + q high: least squares for p and q, exact as the three lie in a plane.
    cosine = (low * high).sum(-1)
    low_middle, high_middle = 2 * (low * middle).sum(-1), 2 * (high * middle).sum(-1)
    determinant = 1 - cosine**2
    p = (low_middle - cosine * high_middle) / determinant
    q = (high_middle - cosine * low_middle) / determinant
    slope = (q[:, None] * high - p[:, None] * low) / (2 * half_width_mm)
    expected = middle + across[3] * slope
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    worst = float(np.abs(expected - between).max())
    if not worst < _STRAIGHT_RAD:
        raise ValueError(f"rays bend across the film by {worst:.1e} rad: no table of x alone holds them")
    origin = sampled.origin[:, 1]
    values = np.ascontiguousarray(np.concatenate([origin, middle, slope], axis=-1))
    return RayTable(-half_length_mm, 2 * half_length_mm / (places - 1), values)


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
            fore.start_mm,
            fore.step_mm,
            aft.values,
            aft.start_mm,
            aft.step_mm,
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
