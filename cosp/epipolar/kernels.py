"""The compiled loops: polynomials, splines, film points of a rectified image, windows of it and their correlation."""

from __future__ import annotations

import numpy as np
from numba import njit

from cosp.arrays import ByteArray, Float32Array, FloatArray, IntArray


@njit(nogil=True, cache=True)
def evaluate(coefficients: FloatArray, u: FloatArray, v: FloatArray, values: FloatArray) -> None:
    """Write sum c_ij T_i(u) T_j(v) of points (N,) into values (N,); Chebyshev recurrences."""
    count_u, count_v = coefficients.shape
    basis_v = np.empty(max(count_v, 2))
    for n in range(u.size):
        basis_v[0] = 1.0
        basis_v[1] = v[n]
        for j in range(2, count_v):
            basis_v[j] = 2.0 * v[n] * basis_v[j - 1] - basis_v[j - 2]
        # Clenshaw's sum along u
        b1 = 0.0
        b2 = 0.0
        for i in range(count_u - 1, -1, -1):
            c = 0.0
            for j in range(count_v):
                c += coefficients[i, j] * basis_v[j]
            b1, b2 = c + 2.0 * u[n] * b1 - b2, b1
        values[n] = b1 - u[n] * b2


@njit(nogil=True, cache=True)
def film_points(
    powers: FloatArray,
    rows: FloatArray,
    columns: FloatArray,
    row_scale: tuple[float, float],
    column_scale: tuple[float, float],
    limit: float,
    affine: FloatArray,
    film_mm: FloatArray,
) -> None:
    """Film points of places of a rectified image.

    The inverse polynomial is collected once per whole row into a polynomial in u and its derivative along the row
    coordinate; inside a row that leaves a few multiplications per pixel. What comes out depends on the place alone,
    not on how a picture was cut.

    powers : (m, n) coefficients of v / half_v: powers of u along the first axis, Chebyshev along the second (rows).
    rows : (H, W), or (H, 1) where a line is on one row
    columns : (H, W) places in the rectified image.
    row_scale, column_scale : (value at pixel 0, change per pixel) of the scaled row coordinate and of scaled u.
    affine : (2, 3) film coordinates of (u scaled, v scaled, 1).
    film_mm : (H, W, 2) result; NaN beyond the limit of the scaled coordinates.
    """
    count_u, count_v = powers.shape
    height, width = columns.shape
    value = np.empty(count_u)
    slope = np.empty(count_u)
    basis = np.empty(max(count_v, 2))
    change = np.empty(max(count_v, 2))
    u = np.empty(width)
    reached = np.empty(width)
    v = np.empty(width)
    dv = np.empty(width)
    a_u, a_v, a_1 = affine[0]
    b_u, b_v, b_1 = affine[1]
    collected = np.nan
    for y in range(height):
        for x in range(width):
            u[x] = column_scale[0] + column_scale[1] * columns[y, x]
        start = 0
        while start < width:
            base = np.floor(rows[y, start if rows.shape[1] > 1 else 0] + 0.5)
            if base != collected:
                _collect(powers, row_scale, base, basis, change, value, slope)
                collected = base
            stop = width
            if rows.shape[1] > 1:
                stop = start + 1
                while stop < width and abs(rows[y, stop] - base) <= 0.5:
                    stop += 1
            # Power by power over the whole run, not pixel by pixel: that is what the vector units can do.
            v[start:stop] = value[count_u - 1]
            for i in range(count_u - 2, -1, -1):
                for x in range(start, stop):
                    v[x] = v[x] * u[x] + value[i]
            if rows.shape[1] > 1 or rows[y, 0] != base:
                dv[start:stop] = slope[count_u - 1]
                for i in range(count_u - 2, -1, -1):
                    for x in range(start, stop):
                        dv[x] = dv[x] * u[x] + slope[i]
                for x in range(start, stop):
                    v[x] += dv[x] * (rows[y, x if rows.shape[1] > 1 else 0] - base)
            start = stop
        if rows.shape[1] > 1:
            for x in range(width):
                w = row_scale[0] + row_scale[1] * rows[y, x]
                reached[x] = u[x] if abs(w) <= limit else np.inf
        else:
            w = row_scale[0] + row_scale[1] * rows[y, 0]
            known = abs(w) <= limit
            for x in range(width):
                reached[x] = u[x] if known else np.inf
        for x in range(width):
            inside = abs(reached[x]) <= limit
            a = a_u * u[x] + a_v * v[x] + a_1
            b = b_u * u[x] + b_v * v[x] + b_1
            film_mm[y, x, 0] = a if inside else np.nan
            film_mm[y, x, 1] = b if inside else np.nan


@njit(nogil=True, cache=True)
def _collect(
    powers: FloatArray,
    row_scale: tuple[float, float],
    row: float,
    basis: FloatArray,
    change: FloatArray,
    value: FloatArray,
    slope: FloatArray,
) -> None:
    """Write the polynomial in u that holds on one row, and its derivative per row, into value and slope."""
    w = row_scale[0] + row_scale[1] * row
    basis[0] = 1.0
    basis[1] = w
    change[0] = 0.0
    change[1] = 1.0
    for j in range(2, powers.shape[1]):
        basis[j] = 2.0 * w * basis[j - 1] - basis[j - 2]
        change[j] = 2.0 * basis[j - 1] + 2.0 * w * change[j - 1] - change[j - 2]
    for i in range(powers.shape[0]):
        a = 0.0
        b = 0.0
        for j in range(powers.shape[1]):
            a += powers[i, j] * basis[j]
            b += powers[i, j] * change[j]
        value[i] = a
        slope[i] = b * row_scale[1]


@njit(nogil=True, cache=True)
def move_rows(
    coefficients: FloatArray,
    row_scale: tuple[float, float],
    column_scale: tuple[float, float],
    rows: FloatArray,
    columns: FloatArray,
    moved: FloatArray,
) -> None:
    """Rows plus the value of a cubic B-spline at (row, column).

    coefficients : (R + 2, C + 2), of a lattice of R x C nodes and one ring about it; beyond the lattice the values of
        its edge go on.
    row_scale, column_scale : (place in the lattice of row or column 0, change per row or column).
    rows : (H, W), or (H, 1) where a line is on one row
    columns, moved : (H, W)
    """
    last_r = coefficients.shape[0] - 3
    last_c = coefficients.shape[1] - 3
    line = np.empty(last_c + 3)
    collected = np.nan
    for y in range(columns.shape[0]):
        for x in range(columns.shape[1]):
            row = rows[y, x if rows.shape[1] > 1 else 0]
            q = column_scale[0] + column_scale[1] * columns[y, x]
            p = row_scale[0] + row_scale[1] * row
            if np.isnan(p + q):
                moved[y, x] = np.nan
                continue
            q = min(max(q, 0.0), float(last_c))
            j = min(int(q), last_c - 1)
            if row != collected:
                p = min(max(p, 0.0), float(last_r))
                i = min(int(p), last_r - 1)
                a, b, c, d = _spline_weights(p - i)
                # The whole line where it serves the next pixels too, else what this one needs.
                first, stop = (0, last_c + 3) if rows.shape[1] == 1 else (j, j + 4)
                for k in range(first, stop):
                    line[k] = (
                        a * coefficients[i, k]
                        + b * coefficients[i + 1, k]
                        + c * coefficients[i + 2, k]
                        + d * coefficients[i + 3, k]
                    )
                if rows.shape[1] == 1:
                    collected = row
            a, b, c, d = _spline_weights(q - j)
            moved[y, x] = row + (a * line[j] + b * line[j + 1] + c * line[j + 2] + d * line[j + 3])


@njit(nogil=True, cache=True)
def _spline_weights(t: float) -> tuple[float, float, float, float]:
    """Weights of the four coefficients about a place that lies a part t after the second of them."""
    s = 1.0 - t
    return s * s * s / 6.0, 2.0 / 3.0 - t * t * (1.0 - 0.5 * t), 2.0 / 3.0 - s * s * (1.0 - 0.5 * s), t * t * t / 6.0


@njit(nogil=True, cache=True)
def cut(picture: ByteArray, row: IntArray, column: IntArray, windows: ByteArray) -> None:
    """Copy windows with the given first rows and columns (N,), which lie in the picture, into (N, h, w)."""
    height, width = windows.shape[1:]
    for n in range(row.size):
        for y in range(height):
            line = picture[row[n] + y, column[n] : column[n] + width]
            for x in range(width):
                windows[n, y, x] = line[x]


@njit(nogil=True, cache=True)
def within_windows(nodes: FloatArray, spacing: int, unknown: float, values: Float32Array) -> None:
    """Fill windows, (N, h, w), with values bilinear between those of every `spacing`-th pixel of lines and columns.

    nodes : (N, a, b), the first pixel and one beyond the last among them.
    unknown : stands for NaN.
    """
    for n in range(len(values)):
        for y in range(values.shape[1]):
            i = y // spacing
            t = (y - i * spacing) / spacing
            for j in range((values.shape[2] - 1) // spacing + 1):
                value = (1.0 - t) * nodes[n, i, j] + t * nodes[n, i + 1, j]
                step = ((1.0 - t) * nodes[n, i, j + 1] + t * nodes[n, i + 1, j + 1] - value) / spacing
                if np.isnan(value + step):
                    value, step = unknown, 0.0
                for x in range(j * spacing, min((j + 1) * spacing, values.shape[2])):
                    values[n, y, x] = value + step * (x - j * spacing)


# Sums may be taken in any order: they are of whole numbers that float32 holds exactly.
@njit(nogil=True, cache=True, fastmath={"reassoc", "contract"})
def correlate(templates: ByteArray, searches: ByteArray, flat: float, surfaces: Float32Array) -> None:
    """Zero-mean normalised cross-correlation of each template at every place inside its search image.

    The same as `cosp.imaging.correlation.ncc_surfaces` of one channel, from exact sums; for small windows several times
    quicker than by transforms.

    templates : (N, h, w)
    searches : (N, H, W)
    flat : a window whose variance is below this part of its mean square, or of the search image's variance, gives 0.
    surfaces : (N, H - h + 1, W - w + 1)
    """
    height, width = templates.shape[1:]
    pixels = height * width
    template = np.empty((height, width), np.float32)
    search = np.empty((searches.shape[1], searches.shape[2]), np.float32)
    # Of the columns of the lines under the template.
    sums = np.empty(searches.shape[2])
    squares = np.empty(searches.shape[2])
    for n in range(len(templates)):
        t_sum, t_square = _as_floats(templates[n], template)
        t_energy = t_square - t_sum * t_sum / pixels
        s_sum, s_square = _as_floats(searches[n], search)
        least = flat * (s_square - s_sum * s_sum / search.size) / search.size * pixels
        sums[:] = 0.0
        squares[:] = 0.0
        for y in range(height - 1):
            for x in range(search.shape[1]):
                sums[x] += search[y, x]
                squares[x] += search[y, x] * search[y, x]
        for i in range(surfaces.shape[1]):
            entering = search[i + height - 1]
            for x in range(search.shape[1]):
                sums[x] += entering[x]
                squares[x] += entering[x] * entering[x]
            s_sum = sums[: width - 1].sum()
            s_square = squares[: width - 1].sum()
            for j in range(surfaces.shape[2]):
                s_sum += sums[j + width - 1]
                s_square += squares[j + width - 1]
                energy = s_square - s_sum * s_sum / pixels
                surfaces[n, i, j] = 0.0
                if energy > least and t_energy > flat * t_square:
                    product = 0.0
                    for y in range(height):
                        a = template[y]
                        b = search[i + y, j : j + width]
                        line = np.float32(0.0)
                        for x in range(width):
                            line += a[x] * b[x]
                        product += float(line)
                    value = (product - t_sum * s_sum / pixels) / np.sqrt(energy * t_energy)
                    surfaces[n, i, j] = min(max(value, -1.0), 1.0)
                s_sum -= sums[j]
                s_square -= squares[j]
            leaving = search[i]
            for x in range(search.shape[1]):
                sums[x] -= leaving[x]
                squares[x] -= leaving[x] * leaving[x]


@njit(nogil=True, cache=True)
def _as_floats(window: ByteArray, floats: Float32Array) -> tuple[float, float]:
    """Fill floats with the pixels of a window; their sum and the sum of their squares."""
    total = 0.0
    square = 0.0
    # One by one: assigning whole arrays takes the compiler many times as long.
    for y in range(window.shape[0]):
        for x in range(window.shape[1]):
            value = float(window[y, x])
            floats[y, x] = value
            total += value
            square += value * value
    return total, square
