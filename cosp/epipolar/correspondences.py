"""Virtual conjugate points: where rays of one film, cut at known heights, meet the other film."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cosp.arrays import BoolArray, FloatArray
from cosp.camera.field import FilmField
from cosp.camera.panoramic import PanoramicCamera
from cosp.epipolar.polynomials import Basis
from cosp.errors import NoOverlapError
from cosp.geometry.robust import tukey_weights

_ROBUST_STEPS = 6


@dataclass(frozen=True)
class FilmMapping:
    """A film and the two functions that tie it to the ground; any camera that has them will do.

    Parameters
    ----------
    ground_from_film : function
        Ground points (..., 3) of film points (..., 2) in mm at ellipsoidal heights (...) in metres.
    film_from_ground : function
        Film points (..., 2) in mm of ground points (..., 3); NaN where the camera does not see the point.
    half_length_mm, half_width_mm : float
        Half the usable film, along x and along y.
    field : FilmField, optional
        Distortion that the film has besides: both functions speak of points as they were imaged.
    """

    ground_from_film: Callable[[FloatArray, FloatArray], FloatArray]
    film_from_ground: Callable[[FloatArray], FloatArray]
    half_length_mm: float
    half_width_mm: float
    field: FilmField | None = None

    @classmethod
    def of(cls, camera: PanoramicCamera) -> FilmMapping:
        """The film of a panoramic camera, its distortion kept apart: what remains is smooth."""
        imaging = camera.without_field()
        return cls(imaging.locate, imaging.project, camera.half_length_mm, camera.half_width_mm, camera.film_field)

    def holds(self, film_mm: FloatArray) -> BoolArray:
        """Whether film points (..., 2) lie on the usable film; False for NaN."""
        with np.errstate(invalid="ignore"):
            inside = (np.abs(film_mm[..., 0]) <= self.half_length_mm) & (np.abs(film_mm[..., 1]) <= self.half_width_mm)
        return np.asarray(inside, bool)

    def lattice(self, count_x: int, count_y: int) -> FloatArray:
        """Evenly spaced film points, edges included, (count_x * count_y, 2) in mm."""
        x = np.linspace(-self.half_length_mm, self.half_length_mm, count_x)
        y = np.linspace(-self.half_width_mm, self.half_width_mm, count_y)
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class ConjugatePoints:
    """Pairs of film points of the same ground, with the slope of the epipolar curve through each.

    Parameters
    ----------
    fore_mm, aft_mm : (N, 2) arrays, mm
    height_m : (N,) array, m
        Ellipsoidal height of the ground point; NaN for pairs that were measured.
    fore_directions, aft_directions : (M, 2) arrays
        Unit vectors along epipolar curves, from the lowest to the highest ground point of a ray of the other film.
        On both films they then run towards the other camera's station.
    """

    fore_mm: FloatArray
    aft_mm: FloatArray
    height_m: FloatArray
    fore_directions: FloatArray
    aft_directions: FloatArray


def height_range(
    fore: FilmMapping, aft: FilmMapping, ground_m: FloatArray, height_m: FloatArray, *, margin_m: float
) -> tuple[float, float]:
    """Lowest and highest ellipsoidal height of terrain that both films show, with a margin.

    Parameters
    ----------
    ground_m : (N, 3) array
        Points of the terrain in the frame of the films' mappings.
    height_m : (N,) array, m
        Their ellipsoidal heights; NaN where the terrain is not known.
    margin_m : float
        For what the terrain model does not know: its own errors, its posting, change since the films were taken.

    Raises
    ------
    NoOverlapError
        If no point of known height is seen by both.
    """
    known = np.flatnonzero(np.isfinite(height_m))
    seen = fore.holds(fore.film_from_ground(ground_m[known])) & aft.holds(aft.film_from_ground(ground_m[known]))
    heights = height_m[known][seen]
    if heights.size == 0:
        raise NoOverlapError(
            f"none of {known.size} points of the terrain with a known height ({height_m.size} in all) is seen by both "
            "films: they share no ground, or the terrain model does not reach it"
        )
    return float(heights.min()) - margin_m, float(heights.max()) + margin_m


def virtual_conjugates(
    fore: FilmMapping,
    aft: FilmMapping,
    heights_m: FloatArray,
    lattice: tuple[int, int] = (121, 25),
    *,
    even: bool = True,
) -> ConjugatePoints:
    """Conjugate points of rays on a lattice of each film, cut at each height and projected into the other film.

    Both ways, fore to aft and aft to fore, so that neither film is favoured and the other's edges are reached.

    Parameters
    ----------
    heights_m : (K,) array, m, rising
        Ellipsoidal heights that enclose the terrain.
    lattice : (along, across)
        Points of the lattice on each film.
    even : bool
        Else points are denser towards the edges, like Chebyshev nodes: polynomials of high degree swing between even
        ones there.

    Raises
    ------
    NoOverlapError
        If the films share no ground.

    References
    ----------
    [Deseilligny2020] section 3
    """
    heights_m = np.asarray(heights_m, float)
    if heights_m.size < 2 or np.any(np.diff(heights_m) <= 0):
        raise ValueError(f"heights must rise and be two at least, got {heights_m}")
    from_fore, to_aft, height_a, aft_directions = _transfer(fore, aft, heights_m, lattice, even)
    from_aft, to_fore, height_b, fore_directions = _transfer(aft, fore, heights_m, lattice, even)
    if len(fore_directions) == 0 or len(aft_directions) == 0:
        raise NoOverlapError(
            f"the two films share no ground between {heights_m[0]:.0f} and {heights_m[-1]:.0f} m: "
            f"0 of {lattice[0] * lattice[1]} points of either film are seen by the other"
        )
    return ConjugatePoints(
        np.concatenate([from_fore, to_fore]),
        np.concatenate([to_aft, from_aft]),
        np.concatenate([height_a, height_b]),
        fore_directions,
        aft_directions,
    )


def measured_conjugates(fore_mm: FloatArray, aft_mm: FloatArray, *, degree: int) -> ConjugatePoints:
    """Conjugate points from tie points alone, for films without cameras.

    A smooth map from one film to the other leaves what relief does to each point, and that lies along the epipolar
    direction. Whether ground is high or low is not known, but it is either on both films.

    Parameters
    ----------
    fore_mm, aft_mm : (N, 2) arrays, mm
        Some may be wrong.
    degree : int
        Total degree of the smooth map.
    """
    on_aft = _residuals_of_map(fore_mm, aft_mm, degree)
    on_fore = _residuals_of_map(aft_mm, fore_mm, degree)
    # The larger half, without the largest: the one is noise, the other is wrong.
    size = np.linalg.norm(on_aft, axis=-1)
    clear = (size > np.quantile(size, 0.5)) & (size < np.quantile(size, 0.95))
    doubled = ((on_aft[clear, 0] + 1j * on_aft[clear, 1]) ** 2).sum()
    axis = np.sqrt(doubled / np.abs(doubled))
    rises = np.sign(on_aft[clear] @ [axis.real, axis.imag])[:, None]
    directions = (rises * a[clear] / np.linalg.norm(a[clear], axis=-1, keepdims=True) for a in (on_fore, on_aft))
    return ConjugatePoints(fore_mm, aft_mm, np.full(len(fore_mm), np.nan), *directions)


def _residuals_of_map(source_mm: FloatArray, target_mm: FloatArray, degree: int) -> FloatArray:
    """Target points minus those of the smooth map from source to target that most of them follow, (N, 2) mm."""
    basis = Basis(degree, degree, total=True)
    scale = np.abs(source_mm).max(axis=0)
    design = basis.design(*(source_mm / scale).T)
    root = np.ones(len(source_mm))
    for _ in range(_ROBUST_STEPS):
        solution, *_ = np.linalg.lstsq(design * root[:, None], target_mm * root[:, None], rcond=None)
        residuals = target_mm - design @ solution
        size = np.linalg.norm(residuals, axis=-1)
        root = np.sqrt(tukey_weights(size / (1.4826 * np.median(size))))
    return np.asarray(residuals)


def _towards_edges(film_mm: FloatArray, film: FilmMapping) -> FloatArray:
    """An even lattice of film points with the spacing of Chebyshev nodes along both axes."""
    half = np.array([film.half_length_mm, film.half_width_mm])
    return np.asarray(half * np.sin(0.5 * np.pi * film_mm / half))


def _transfer(
    source: FilmMapping, target: FilmMapping, heights_m: FloatArray, lattice: tuple[int, int], even: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Points on the source film, their conjugates on the target, heights, and directions of the curves they draw."""
    points = source.lattice(*lattice) if even else _towards_edges(source.lattice(*lattice), source)
    film = np.repeat(points[:, None], heights_m.size, axis=1)
    heights = np.broadcast_to(heights_m, film.shape[:2])
    seen = target.film_from_ground(source.ground_from_film(film, heights))
    inside = target.holds(seen)
    whole = inside.all(axis=1)
    along = seen[whole, -1] - seen[whole, 0]
    return film[inside], seen[inside], heights[inside], along / np.linalg.norm(along, axis=-1, keepdims=True)
