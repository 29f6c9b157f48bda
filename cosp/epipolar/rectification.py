"""Two films and their common epipolar grid: how it is found, and the way from film to grid and back."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar

import numpy as np
from numpy.polynomial import chebyshev

from cosp.arrays import Float32Array, FloatArray
from cosp.camera.field import FilmField
from cosp.epipolar import kernels
from cosp.epipolar.correction import RowCorrection
from cosp.epipolar.correspondences import ConjugatePoints, FilmMapping, virtual_conjugates
from cosp.epipolar.directions import common_directions_rad
from cosp.epipolar.polynomials import Basis, Fit, evaluate, fit, fit_quality, fit_row_functions
from cosp.errors import NoOverlapError
from cosp.geometry.grids import PixelGrid
from cosp.geometry.robust import tukey_weights
from cosp.imaging.windows import Window

# Polynomials are trusted this far beyond the conjugate points they were fitted to, as a part of half their range.
_BEYOND = 0.02
# Square root of the weight of conjugate points beyond the films, which only keep polynomials from running away there.
_BEYOND_WEIGHT = 0.03
# The inverse needs more terms than the polynomial it inverts; so many give 1e-4 px on whole films.
_INVERSE_MORE = (3, 5)
# The correction of rows changes by less than a hundredth of a pixel per pixel: each step gains two digits or more.
_CORRECTION_STEPS = 4
_ROBUST_STEPS = 6
# Pixels from one place of the image to the next whose film point is worked out for a picture; straight lines between
# them are within 1e-3 px.
_NODE_PX = 8
_FAR_PX = -1e6  # stands for "nowhere"
# Nodes a side at which the extent of a window on the film is looked up.
_LATTICE = 33
# Terms of disparity at a given height as a function of the place on the fore film.
_DISPARITY_BASIS = Basis(3, 9)


@dataclass(frozen=True)
class EpipolarMap:
    """One film and its rectified image.

    The film's frame is turned about its centre: u along the epipolar direction, v across it, to the right of it. The
    row coordinate is a polynomial of both, the column coordinate is u. What was measured to be left across the rows may
    be taken out by a correction.

    A known distortion of the film is no matter of the polynomials: they speak of film points as they were imaged, and
    film points that are given and asked for are measured ones.

    Parameters
    ----------
    direction_deg : float
        Angle of u from the film's x axis.
    centre_mm : (x, y)
        Film point at u = v = 0.
    half_u_mm, half_v_mm : float
        Half the range of u and v of the points the polynomial was fitted to; they scale it to [-1, 1].
    rows : (degree_u + 1, degree_v + 1) array, mm
        Chebyshev coefficients of the row coordinate.
    row_centre_mm, row_half_mm : float
        Centre and half the range of the row coordinate, for the scale of the inverse.
    inverse : (m, n) array, mm
        Chebyshev coefficients of v as a function of u and the row coordinate.
    pixel_mm : float
    row0_mm, column0_mm : float
        Row coordinate and u of the centre of pixel (0, 0).
    correction : RowCorrection, optional
        The place (row coordinate, u) of the image shows what the polynomials put that much further along the rows'
        coordinate.
    film_field : FilmField, optional
        Distortion of the film.
    """

    direction_deg: float
    centre_mm: tuple[float, float]
    half_u_mm: float
    half_v_mm: float
    rows: FloatArray
    row_centre_mm: float
    row_half_mm: float
    inverse: FloatArray
    pixel_mm: float
    row0_mm: float
    column0_mm: float
    correction: RowCorrection | None = None
    film_field: FilmField | None = None

    @property
    def _axes(self) -> FloatArray:
        """Columns: the unit vectors of u and v on the film."""
        return film_axes(math.radians(self.direction_deg))

    def uv(self, imaged_mm: FloatArray) -> FloatArray:
        """Film points (..., 2) as they were imaged, in the turned frame, mm."""
        return np.asarray((np.asarray(imaged_mm, float) - np.array(self.centre_mm)) @ self._axes)

    def epipolar(self, film_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rows and columns (...) of film points (..., 2); NaN outside the part of the film that was rectified."""
        uv = self.uv(film_mm if self.film_field is None else self.film_field.corrected(film_mm))
        u, v = uv[..., 0] / self.half_u_mm, uv[..., 1] / self.half_v_mm
        row_mm = evaluate(self.rows, u, v)
        rows = (row_mm - self.row0_mm) / self.pixel_mm
        columns = (uv[..., 0] - self.column0_mm) / self.pixel_mm
        with np.errstate(invalid="ignore"):
            scaled_row = (row_mm - self.row_centre_mm) / self.row_half_mm
            known = (np.abs(u) <= 1 + _BEYOND) & (np.abs(scaled_row) <= 1 + _BEYOND)
        if self.correction is not None:
            uncorrected = rows
            for _ in range(_CORRECTION_STEPS):
                rows = rows + uncorrected - self._uncorrected_rows(rows, columns)
        return np.where(known, rows, np.nan), np.where(known, columns, np.nan)

    def film(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """Film points (..., 2) in mm of rows and columns (broadcast together); NaN where `epipolar` gives NaN."""
        imaged_mm = self.imaged(rows, columns)
        return imaged_mm if self.film_field is None else self.film_field.distorted(imaged_mm)

    def imaged(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """The same as `film`, of a film without distortion."""
        shape = np.broadcast_shapes(np.shape(rows), np.shape(columns))
        # Lists of points go through as one line; a copy, where one is made, is of the size of the result.
        flat = shape if len(shape) == 2 else (1, math.prod(shape))
        one_row_a_line = len(shape) == 2 and np.shape(rows) == (shape[0], 1)
        rows, columns = (np.asarray(a, float) for a in (rows, columns))
        if not one_row_a_line:
            rows = np.broadcast_to(rows, shape).reshape(flat)
        columns = np.broadcast_to(columns, shape).reshape(flat)
        imaged_mm = np.empty((*flat, 2))
        self._invert(rows, columns, imaged_mm)
        return imaged_mm.reshape(*shape, 2)

    def film_window(self, window: Window, film_grid: PixelGrid) -> Window:
        """The part of the film raster that a window of the rectified image shows; of no size where there is none."""
        rows = np.linspace(window.row0, window.row1 - 1, _LATTICE)[:, None]
        columns = np.linspace(window.column0, window.column1 - 1, _LATTICE)[None, :]
        film_rows, film_columns = film_grid.pixels(self.film(rows, columns))
        known = np.isfinite(film_rows)
        if not known.any():
            return Window(0, 0, 0, 0)
        # Between nodes the map is smooth to a fraction of a pixel, but may end anywhere.
        step = math.ceil(max(window.shape) / (_LATTICE - 1))
        return Window(
            math.floor(film_rows[known].min()),
            math.ceil(film_rows[known].max()) + 1,
            math.floor(film_columns[known].min()),
            math.ceil(film_columns[known].max()) + 1,
        ).grown(2 if known.all() else 2 * step, film_grid.shape)

    def film_pixels(
        self, window: Window, film_grid: PixelGrid, corner: tuple[int, int]
    ) -> tuple[Float32Array, Float32Array]:
        """Row and column in the film raster of each pixel of a window of the rectified image, (H, W) float32.

        Relative to a corner (row, column) near by, so that they are good to 1/1000 px; far outside (below
        -500 000) where the film is not known, or not at the nodes about the pixel.
        """
        # Nodes lie at the same pixels whatever the window, and so does what is between them.
        row0, column0 = (start // _NODE_PX * _NODE_PX for start in (window.row0, window.column0))
        rows = np.arange(row0, window.row1 + _NODE_PX, _NODE_PX, dtype=float)[:, None]
        columns = np.arange(column0, window.column1 + _NODE_PX, _NODE_PX, dtype=float)[None, :]
        nodes = film_grid.pixels(self.film(rows, columns))
        places = np.empty((2, 1, window.row1 - row0, window.column1 - column0), np.float32)
        for node, start, place in zip(nodes, corner, places, strict=True):
            kernels.within_windows((node - start)[None], _NODE_PX, _FAR_PX, place)
        film_rows, film_columns = places[:, 0, window.row0 - row0 :, window.column0 - column0 :]
        return film_rows, film_columns

    def _uncorrected_rows(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """The rows at which the polynomials alone put what places of the image show."""
        if self.correction is None:
            return rows
        return self.correction.move(
            rows, columns, pixel_mm=self.pixel_mm, row0_mm=self.row0_mm, column0_mm=self.column0_mm
        )

    def _invert(self, rows: FloatArray, columns: FloatArray, imaged_mm: FloatArray) -> None:
        """Fill (H, W, 2) with the imaged points of rows, (H, W) or (H, 1), and columns (H, W)."""
        scaled = self._axes * np.array([self.half_u_mm, self.half_v_mm])
        kernels.film_points(
            _powers_of_chebyshev(len(self.inverse)) @ (self.inverse / self.half_v_mm),
            self._uncorrected_rows(rows, columns),
            columns,
            ((self.row0_mm - self.row_centre_mm) / self.row_half_mm, self.pixel_mm / self.row_half_mm),
            (self.column0_mm / self.half_u_mm, self.pixel_mm / self.half_u_mm),
            1 + _BEYOND,
            np.column_stack([scaled, np.array(self.centre_mm)]),
            imaged_mm,
        )


@dataclass(frozen=True)
class Rectification:
    """Mapping between two films and their common epipolar grid.

    A ground point lies on the same row of both rectified images; its aft column is its fore column plus the disparity.
    Rows run along the scan, columns along the flight.

    Parameters
    ----------
    fore, aft : EpipolarMap
        On the same rows; columns are placed so that disparities lie about zero.
    shape : (rows, columns)
    heights_m : (low, high)
        Ellipsoidal heights the disparities were worked out for; NaN where no camera says.
    disparity_low, disparity_high : (4, 10) arrays, px
        Chebyshev coefficients of the disparity at the lower and at the upper height over the fore film (scaled u, v).
    disparity_shift_px : int
        Added to both; what moving an image's columns changes.
    disparity_range_px : (lowest, highest)
        Of all pixels of the grid, with a margin.
    offset : (row, column)
        Of pixel (0, 0) in the grid of the whole overlap; other than (0, 0) in an area of interest.
    model_rms_px, model_largest_px : float
        y-parallax that the polynomials leave at virtual conjugate points.
    inverse_largest_px : float
        Error of the inverse polynomials, in rows.
    """

    KIND: ClassVar[str] = "rectification"
    VERSION: ClassVar[int] = 1

    fore: EpipolarMap
    aft: EpipolarMap
    shape: tuple[int, int]
    heights_m: tuple[float, float]
    disparity_low: FloatArray
    disparity_high: FloatArray
    disparity_shift_px: int
    disparity_range_px: tuple[float, float]
    offset: tuple[int, int]
    model_rms_px: float
    model_largest_px: float
    inverse_largest_px: float

    @property
    def pixel_mm(self) -> float:
        """Side of a pixel of the epipolar grid."""
        return self.fore.pixel_mm

    @property
    def grid(self) -> PixelGrid:
        """The epipolar grid in its own pixels: x is the column, y the row."""
        return PixelGrid(0.0, 0.0, 1.0, 1.0, self.shape)

    def fore_film(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """Fore film points (..., 2) in mm of rows and columns (broadcast together)."""
        return self.fore.film(rows, columns)

    def aft_film(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """Aft film points (..., 2) in mm of rows and columns (broadcast together)."""
        return self.aft.film(rows, columns)

    def fore_epipolar(self, film_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rows and columns (...) of fore film points (..., 2)."""
        return self.fore.epipolar(film_mm)

    def aft_epipolar(self, film_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rows and columns (...) of aft film points (..., 2)."""
        return self.aft.epipolar(film_mm)

    def conjugate_points(
        self, rows: FloatArray, columns: FloatArray, disparity: FloatArray, y_parallax: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Fore and aft film points (..., 2), mm, of fore pixels with a disparity.

        Parameters
        ----------
        rows, columns : arrays, broadcast against `disparity`
            Place on the fore image. Quickest as one column of rows, (H, 1), and one line of columns, (1, W).
        disparity : (...) array, px
            Aft column minus fore column; NaN gives NaN.
        y_parallax : (...) array, px, optional
            Aft row minus fore row: what the rectification left.
        """
        shape = np.broadcast_shapes(np.shape(rows), np.shape(columns), disparity.shape)
        aft_rows = rows if y_parallax is None else rows + y_parallax
        fore_mm = self.fore.film(rows, columns)
        if fore_mm.shape[:-1] != shape:
            fore_mm = np.broadcast_to(fore_mm, (*shape, 2)).copy()
        return fore_mm, self.aft.film(aft_rows, columns + disparity)

    def disparity_bounds(self, rows: FloatArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Disparities (...) at fore pixels of ground at the lower and at the upper height, the smaller one first.

        The interval of one place is much narrower than `disparity_range_px`, which is for the whole image.
        """
        uv = self.fore.uv(self.fore.imaged(rows, columns))
        u, v = uv[..., 0] / self.fore.half_u_mm, uv[..., 1] / self.fore.half_v_mm
        low = evaluate(self.disparity_low, u, v) + self.disparity_shift_px
        high = evaluate(self.disparity_high, u, v) + self.disparity_shift_px
        return np.minimum(low, high), np.maximum(low, high)

    def cut(self, window: Window, *, margin_px: float) -> Rectification:
        """The rectification on a window of its grid, with the aft columns moved so that disparities lie about zero.

        Parameters
        ----------
        window : Window
            On the fore image; cut at the edges of the grid.
        margin_px : float
            Added to the disparity range at both ends.
        """
        window = window.grown(0, self.shape)
        if min(window.shape) <= 0:
            raise NoOverlapError(f"rows and columns {window} lie outside the epipolar grid of {self.shape}")
        low, high = _range_over(self, window)
        shift = -round((low + high) / 2)
        grow = math.ceil((high - low) / 2 + margin_px)
        # Ground seen near the edge of the fore window lies up to half the range outside it on the aft image.
        columns = (max(window.column0 - grow, 0), min(window.column1 + grow, self.shape[1]))

        def moved(film: EpipolarMap, column: float) -> EpipolarMap:
            return replace(
                film,
                row0_mm=film.row0_mm + window.row0 * film.pixel_mm,
                column0_mm=film.column0_mm + column * film.pixel_mm,
            )

        return replace(
            self,
            fore=moved(self.fore, columns[0]),
            aft=moved(self.aft, columns[0] - shift),
            shape=(window.row1 - window.row0, columns[1] - columns[0]),
            disparity_shift_px=self.disparity_shift_px + shift,
            disparity_range_px=(low + shift - margin_px, high + shift + margin_px),
            offset=(self.offset[0] + window.row0, self.offset[1] + columns[0]),
        )

    def window_of(self, fore_mm: FloatArray, *, halo_px: int) -> Window:
        """The window of the fore image that holds film points (N, 2), grown by a halo; empty if it holds none."""
        rows, columns = self.fore.epipolar(fore_mm)
        inside = np.isfinite(rows) & (rows >= -halo_px) & (rows <= self.shape[0] + halo_px)
        inside &= (columns >= -halo_px) & (columns <= self.shape[1] + halo_px)
        if not inside.any():
            return Window(0, 0, 0, 0)
        rows, columns = rows[inside], columns[inside]
        return Window(
            math.floor(rows.min()), math.ceil(rows.max()) + 1, math.floor(columns.min()), math.ceil(columns.max()) + 1
        ).grown(halo_px, self.shape)


def film_axes(direction_rad: float) -> FloatArray:
    """Unit vectors of u (along the epipolar direction) and v (to the right of it) on the film, as columns."""
    c, s = math.cos(direction_rad), math.sin(direction_rad)
    return np.array([[c, s], [s, -c]])


def fit_rectification(
    conjugates: ConjugatePoints,
    films: tuple[FilmMapping, FilmMapping],
    *,
    pixel_mm: float,
    basis: Basis,
    disparity_margin_px: float,
) -> Rectification:
    """Rectification of the whole overlap of two films from conjugate points.

    Virtual points, made of cameras, are fitted as they are; measured ones, whose heights are NaN, robustly.

    Parameters
    ----------
    conjugates : ConjugatePoints
        Spread over the overlap and over the heights of the terrain; film points as the mappings have them.
    films : fore and aft FilmMapping
        Their fields become those of the rectification. Where conjugates are virtual, they tell a little of what lies
        beyond the films' edges, too: the corners of a rectified image hold no film, and its polynomials must not run
        away there and come back.
    pixel_mm : float
        Pixel of the epipolar grid; the film's own keeps its resolution.
    basis : Basis
        Terms of the row polynomials: separable 3 x 9 on whole films; total degree 4 is the paper's.
    disparity_margin_px : float
        Added to the disparity range at both ends.

    References
    ----------
    [Deseilligny2020] section 3; [Ghuffar2022] section III-D
    """
    directions = common_directions_rad(conjugates.fore_directions, conjugates.aft_directions)
    points = (conjugates.fore_mm, conjugates.aft_mm)
    centres, uvs, halves = [], [], []
    for direction, film_mm in zip(directions, points, strict=True):
        axes = film_axes(direction)
        uv = film_mm @ axes
        centre = (uv.min(axis=0) + uv.max(axis=0)) / 2
        centres.append(centre @ axes.T)
        uvs.append(uv - centre)
        half_u, half_v = np.abs(uv - centre).max(axis=0)
        halves.append((float(half_u), float(half_v)))

    measured = bool(np.isnan(conjugates.height_m).all())
    count = len(conjugates.height_m)
    beyond = [np.empty((0, 2))] * 2 if measured else _beyond_films(conjugates, films, directions, centres, halves)
    weights = np.concatenate([np.ones(count), np.full(len(beyond[0]), _BEYOND_WEIGHT)])
    fore_uv, aft_uv = (np.concatenate([uv, more * half]) for uv, more, half in zip(uvs, beyond, halves, strict=True))
    *polynomials, residuals = fit_row_functions(fore_uv, aft_uv, halves[0], halves[1], basis, weights)
    residuals = residuals[:count]
    good = np.full(count, True)
    for _ in range(_ROBUST_STEPS if measured else 0):
        weights = tukey_weights(residuals / (1.4826 * float(np.median(np.abs(residuals)))))
        good = weights > 0
        *polynomials, residuals = fit_row_functions(uvs[0], uvs[1], halves[0], halves[1], basis, np.sqrt(weights))
    model = fit_quality(residuals[good] / pixel_mm)

    uvs = [uv[good] for uv in uvs]
    rows_mm = evaluate(polynomials[0], uvs[0][:, 0] / halves[0][0], uvs[0][:, 1] / halves[0][1])
    row_low, row_high = float(rows_mm.min()), float(rows_mm.max())
    disparity_mm = uvs[1][:, 0] - uvs[0][:, 0]
    aft_ahead = (float(disparity_mm.min()) + float(disparity_mm.max())) / 2
    column_low = min(float(uvs[0][:, 0].min()), float(uvs[1][:, 0].min()) - aft_ahead)
    column_high = max(float(uvs[0][:, 0].max()), float(uvs[1][:, 0].max()) - aft_ahead)
    shape = (math.floor((row_high - row_low) / pixel_mm) + 1, math.floor((column_high - column_low) / pixel_mm) + 1)

    maps, inverse_fits = [], []
    for k, ahead in enumerate((0.0, aft_ahead)):
        # Tie points alone are too few to be inverted at.
        scaled_uv = _film_uv(films[k], directions[k], centres[k], halves[k]) if measured else uvs[k] / halves[k]
        inverse, quality = _fit_inverse(polynomials[k], basis, halves[k], (row_low, row_high), scaled_uv, beyond[k])
        inverse_fits.append(quality)
        maps.append(
            EpipolarMap(
                direction_deg=math.degrees(directions[k]),
                centre_mm=(float(centres[k][0]), float(centres[k][1])),
                half_u_mm=halves[k][0],
                half_v_mm=halves[k][1],
                rows=polynomials[k],
                row_centre_mm=(row_low + row_high) / 2,
                row_half_mm=(row_high - row_low) / 2,
                inverse=inverse,
                pixel_mm=pixel_mm,
                row0_mm=row_low,
                column0_mm=column_low + ahead,
                film_field=films[k].field,
            )
        )

    disparity_px = (disparity_mm - aft_ahead) / pixel_mm
    u, v = (uvs[0] / halves[0]).T
    if measured:
        heights = np.full(2, np.nan)
        middle, _ = fit(_DISPARITY_BASIS, u, v, disparity_px)
        about = disparity_px - evaluate(middle, u, v)
        surfaces = [middle.copy(), middle.copy()]
        for surface, end in zip(surfaces, (about.min(), about.max()), strict=True):
            surface[0, 0] += end
    else:
        heights = np.unique(conjugates.height_m)
        surfaces = []
        for height in (heights[0], heights[-1]):
            chosen = conjugates.height_m == height
            surfaces.append(fit(_DISPARITY_BASIS, u[chosen], v[chosen], disparity_px[chosen])[0])
    return Rectification(
        fore=maps[0],
        aft=maps[1],
        shape=shape,
        heights_m=(float(heights[0]), float(heights[-1])),
        disparity_low=surfaces[0],
        disparity_high=surfaces[1],
        disparity_shift_px=0,
        disparity_range_px=(
            float(disparity_px.min()) - disparity_margin_px,
            float(disparity_px.max()) + disparity_margin_px,
        ),
        offset=(0, 0),
        model_rms_px=model.rms,
        model_largest_px=model.largest,
        inverse_largest_px=max(quality.largest for quality in inverse_fits) / pixel_mm,
    )


def _beyond_films(
    conjugates: ConjugatePoints,
    films: tuple[FilmMapping, FilmMapping],
    directions: tuple[float, float],
    centres: list[FloatArray],
    halves: list[tuple[float, float]],
) -> list[FloatArray]:
    """Conjugate points in the corners of both rectified images where there is no film, scaled to [-1, 1], (N, 2)."""
    corners = (1 + _BEYOND) * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    wider = []
    for film, direction, centre, half in zip(films, directions, centres, halves, strict=True):
        reach = np.abs(centre + corners * half @ film_axes(direction).T).max(axis=0)
        wider.append(replace(film, half_length_mm=float(reach[0]), half_width_mm=float(reach[1])))
    heights = np.unique(conjugates.height_m)[[0, -1]]
    found = virtual_conjugates(wider[0], wider[1], heights, even=False)
    points = (found.fore_mm, found.aft_mm)
    scaled = [
        (film_mm - centre) @ film_axes(direction) / np.array(half)
        for film_mm, direction, centre, half in zip(points, directions, centres, halves, strict=True)
    ]
    in_image = np.all([np.abs(uv) <= 1 + _BEYOND for uv in scaled], axis=(0, 2))
    on_film = films[0].holds(points[0]) & films[1].holds(points[1])
    return [uv[in_image & ~on_film] for uv in scaled]


def _film_uv(film: FilmMapping, direction: float, centre: FloatArray, half: tuple[float, float]) -> FloatArray:
    """Points of a film's whole extent that its polynomial reaches, scaled to [-1, 1], (N, 2)."""
    uv = (film.lattice(201, 25) - centre) @ film_axes(direction) / np.array(half)
    return np.asarray(uv[(np.abs(uv) <= 1 + _BEYOND).all(axis=1)])


def _fit_inverse(
    polynomial: FloatArray,
    basis: Basis,
    half: tuple[float, float],
    row_range: tuple[float, float],
    scaled_uv: FloatArray,
    beyond_uv: FloatArray,
) -> tuple[FloatArray, Fit]:
    """Chebyshev coefficients of v (mm) as a function of u and row, and the error in rows (mm) at points of the film."""
    u, v = np.concatenate([scaled_uv, beyond_uv]).T
    row = evaluate(polynomial, u, v)
    scaled_row = (row - sum(row_range) / 2) / (row_range[1] - row_range[0]) * 2
    wider = Basis(basis.degree_u + _INVERSE_MORE[0], basis.degree_v + _INVERSE_MORE[1])
    held = np.abs(scaled_row) <= 1 + _BEYOND
    weights = np.concatenate([np.ones(len(scaled_uv)), np.full(len(beyond_uv), _BEYOND_WEIGHT)])
    inverse, _ = fit(wider, u[held], scaled_row[held], v[held] * half[1], weights[held])
    back = evaluate(polynomial, u, evaluate(inverse, u, scaled_row) / half[1])
    return inverse, fit_quality((back - row)[: len(scaled_uv)])


def _range_over(rectification: Rectification, window: Window) -> tuple[float, float]:
    """Lowest and highest disparity of a window of the fore image."""
    rows = np.linspace(window.row0, window.row1 - 1, 65)[:, None]
    columns = np.linspace(window.column0, window.column1 - 1, 33)[None, :]
    low, high = rectification.disparity_bounds(rows, columns)
    if not np.isfinite(low).any():
        raise NoOverlapError(f"rows and columns {window} of the fore image hold no ground that the aft film sees")
    return float(np.nanmin(low)), float(np.nanmax(high))


@cache
def _powers_of_chebyshev(count: int) -> FloatArray:
    """Matrix (count, count) that makes coefficients of powers from those of a Chebyshev series."""
    columns = (chebyshev.cheb2poly(series) for series in np.eye(count))
    return np.stack([np.pad(powers, (0, count - powers.size)) for powers in columns], axis=1)
