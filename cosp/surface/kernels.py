"""The compiled loops of the surface package: two-ray intersection, gridding, occlusion."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cosp.arrays import BoolArray, FloatArray, IntArray


@njit(nogil=True, cache=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy")
def intersect_tabulated(
    fore_table: FloatArray,
    fore_scale: tuple[float, float, float, float],
    aft_table: FloatArray,
    aft_scale: tuple[float, float, float, float],
    fore: FloatArray,
    aft: FloatArray,
    ground: FloatArray,
    miss: FloatArray,
) -> None:
    """Midpoints of the common perpendiculars of tabulated rays.

    A node of a table, (N, M, 6), holds origin and direction; the scales are (place along x at x = 0, per millimetre;
    the same along y). Beyond the last node across, rays go on as between the last two. `fore` and `aft` are (N, 2)
    film points; `ground` (N, 3) and `miss` (N,) are filled.
    """
    for n in range(fore.shape[0]):
        u = fore_scale[0] + fore_scale[1] * fore[n, 0]
        v = fore_scale[2] + fore_scale[3] * fore[n, 1]
        s = aft_scale[0] + aft_scale[1] * aft[n, 0]
        t = aft_scale[2] + aft_scale[3] * aft[n, 1]
        inside = 0.0 <= u <= fore_table.shape[0] - 1 and 0.0 <= s <= aft_table.shape[0] - 1
        if not inside or np.isnan(v) or np.isnan(t):
            ground[n, 0] = np.nan
            ground[n, 1] = np.nan
            ground[n, 2] = np.nan
            miss[n] = np.nan
            continue
        c0, c1, c2, a0, a1, a2 = _tabulated(fore_table, u, v)
        w0, w1, w2, b0, b1, b2 = _tabulated(aft_table, s, t)
        w0 = c0 - w0
        w1 = c1 - w1
        w2 = c2 - w2
        aa = a0 * a0 + a1 * a1 + a2 * a2
        ab = a0 * b0 + a1 * b1 + a2 * b2
        bb = b0 * b0 + b1 * b1 + b2 * b2
        aw = a0 * w0 + a1 * w1 + a2 * w2
        bw = b0 * w0 + b1 * w1 + b2 * w2
        scale = 1.0 / (aa * bb - ab * ab)
        s = (ab * bw - bb * aw) * scale
        t = (aa * bw - ab * aw) * scale
        # Gap vector between the nearest points of both rays; half of it leads to the midpoint.
        g0 = w0 + s * a0 - t * b0
        g1 = w1 + s * a1 - t * b1
        g2 = w2 + s * a2 - t * b2
        ground[n, 0] = c0 + s * a0 - 0.5 * g0
        ground[n, 1] = c1 + s * a1 - 0.5 * g1
        ground[n, 2] = c2 + s * a2 - 0.5 * g2
        miss[n] = math.sqrt(g0 * g0 + g1 * g1 + g2 * g2)


@njit(nogil=True, cache=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy")
def _tabulated(table: FloatArray, u: float, v: float) -> tuple[float, float, float, float, float, float]:
    """Six values between the nodes of a table, bilinear."""
    i = min(int(u), table.shape[0] - 2)
    j = min(max(int(v), 0), table.shape[1] - 2)
    p = u - i
    q = v - j
    w11 = p * q
    w10 = p - w11
    w01 = q - w11
    w00 = 1.0 - p - w01
    a = table[i, j]
    b = table[i, j + 1]
    c = table[i + 1, j]
    d = table[i + 1, j + 1]
    return (
        w00 * a[0] + w01 * b[0] + w10 * c[0] + w11 * d[0],
        w00 * a[1] + w01 * b[1] + w10 * c[1] + w11 * d[1],
        w00 * a[2] + w01 * b[2] + w10 * c[2] + w11 * d[2],
        w00 * a[3] + w01 * b[3] + w10 * c[3] + w11 * d[3],
        w00 * a[4] + w01 * b[4] + w10 * c[4] + w11 * d[4],
        w00 * a[5] + w01 * b[5] + w10 * c[5] + w11 * d[5],
    )


@njit(nogil=True, cache=True)
def sort_by_cell(
    points: FloatArray,
    weights: FloatArray,
    x0: float,
    y0: float,
    step_x: float,
    step_y: float,
    rows: int,
    columns: int,
) -> tuple[FloatArray, IntArray]:
    """Points as (column, row, height, weight) in the order of their cells, and where each cell starts.

    A point belongs to the cell whose centre is nearest. Points outside the grid or without weight are left out.
    """
    count = points.shape[0]
    per_x = 1.0 / step_x
    per_y = 1.0 / step_y
    cells = np.empty(count, np.int32)
    starts = np.zeros(rows * columns + 1, np.int64)
    for n in range(count):
        u = (points[n, 0] - x0) * per_x + 0.5
        v = (points[n, 1] - y0) * per_y + 0.5
        cells[n] = -1
        if 0.0 <= u < columns and 0.0 <= v < rows and weights[n] > 0.0 and not np.isnan(points[n, 2]):
            cell = int(v) * columns + int(u)
            cells[n] = cell
            starts[cell + 1] += 1
    for cell in range(rows * columns):
        starts[cell + 1] += starts[cell]
    place = starts[:-1].copy()
    ordered = np.empty((starts[-1], 4), np.float32)
    for n in range(count):
        cell = cells[n]
        if cell >= 0:
            # Places within the grid, relative to the cell's centre: float32 keeps them to 1e-7 of a cell.
            u = (points[n, 0] - x0) * per_x
            v = (points[n, 1] - y0) * per_y
            k = place[cell]
            ordered[k, 0] = u - int(u + 0.5)
            ordered[k, 1] = v - int(v + 0.5)
            ordered[k, 2] = points[n, 2]
            ordered[k, 3] = weights[n]
            place[cell] = k + 1
    return ordered, starts


@njit(nogil=True, cache=True)
def _select(values: FloatArray, count: int, rank: int) -> float:
    """The value of this rank among the first `count`; reorders them (Hoare's selection)."""
    low = 0
    high = count - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i = low
        j = high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    result: float = values[rank]
    return result


@njit(nogil=True, cache=True)
def _median_of_nine(v: FloatArray) -> float:
    """Median of the first nine values, without branches: what each exchange orders is known beforehand."""
    a, b, c = _ordered(v[0], v[1], v[2])
    d, e, f = _ordered(v[3], v[4], v[5])
    g, h, i = _ordered(v[6], v[7], v[8])
    low = max(max(a, d), g)
    middle = _ordered(b, e, h)[1]
    high = min(min(c, f), i)
    result: float = _ordered(low, middle, high)[1]
    return result


@njit(nogil=True, cache=True)
def _ordered(a: float, b: float, c: float) -> tuple[float, float, float]:
    low = min(a, b)
    high = max(a, b)
    return min(low, c), max(low, min(high, c)), max(high, c)


@njit(nogil=True, cache=True)
def _median(values: FloatArray, count: int) -> float:
    if count == 9:
        nine: float = _median_of_nine(values)
        return nine
    upper: float = _select(values, count, count // 2)
    if count % 2:
        return upper
    lower: float = values[0]
    for i in range(1, count // 2):
        lower = max(lower, values[i])
    return 0.5 * (lower + upper)


# Points of a cell that medians are taken of: they only say what lies far off, which a sample does as well.
_MOST_SAMPLED = 9


@njit(nogil=True, cache=True)
def cell_medians(ordered: FloatArray, starts: IntArray, rows: int, columns: int) -> FloatArray:
    """Median height of the points of each cell, of an even sample where there are many; NaN where there are none."""
    values = np.empty(_MOST_SAMPLED, np.float32)
    medians = np.full((rows, columns), np.nan, np.float32)
    for cell in range(rows * columns):
        count = starts[cell + 1] - starts[cell]
        if count:
            sampled = min(count, _MOST_SAMPLED)
            for i in range(sampled):
                values[i] = ordered[starts[cell] + i * count // sampled, 2]
            medians[cell // columns, cell % columns] = _median(values, sampled)
    return medians


@njit(nogil=True, cache=True)
def neighbourhood_medians(values: FloatArray) -> FloatArray:
    """Median of the 3 x 3 cells about each, the missing ones left out."""
    rows, columns = values.shape
    result = np.full((rows, columns), np.nan, np.float32)
    around = np.empty(9, np.float32)
    for row in range(rows):
        for column in range(columns):
            count = 0
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    if not np.isnan(values[r, c]):
                        around[count] = values[r, c]
                        count += 1
            if count:
                result[row, column] = _median(around, count)
    return result


@njit(nogil=True, cache=True)
def slopes_per_cell(heights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Height change per column and per row; central where it can be, else one-sided, else zero."""
    rows, columns = heights.shape
    along_columns = np.zeros((rows, columns), np.float32)
    along_rows = np.zeros((rows, columns), np.float32)
    for row in range(rows):
        for column in range(columns):
            here = heights[row, column]
            before = heights[row, column - 1] if column > 0 else np.nan
            after = heights[row, column + 1] if column < columns - 1 else np.nan
            along_columns[row, column] = _slope(before, here, after)
            before = heights[row - 1, column] if row > 0 else np.nan
            after = heights[row + 1, column] if row < rows - 1 else np.nan
            along_rows[row, column] = _slope(before, here, after)
    return along_columns, along_rows


@njit(nogil=True, cache=True)
def _slope(before: float, here: float, after: float) -> float:
    if not np.isnan(before) and not np.isnan(after):
        return 0.5 * (after - before)
    if not np.isnan(after) and not np.isnan(here):
        return after - here
    if not np.isnan(before) and not np.isnan(here):
        return here - before
    return 0.0


@njit(nogil=True, cache=True)
def cell_scatter(
    ordered: FloatArray,
    starts: IntArray,
    seeds: FloatArray,
    along_columns: FloatArray,
    along_rows: FloatArray,
    least: float,
) -> FloatArray:
    """Median absolute distance, times 1.4826, of the points of each cell (or a sample) from its seed plane."""
    rows, columns = seeds.shape
    values = np.empty(_MOST_SAMPLED, np.float32)
    scatter = np.full((rows, columns), np.nan, np.float32)
    for row in range(rows):
        for column in range(columns):
            cell = row * columns + column
            count = starts[cell + 1] - starts[cell]
            if not count:
                continue
            sampled = min(count, _MOST_SAMPLED)
            for i in range(sampled):
                n = starts[cell] + i * count // sampled
                plane = seeds[row, column] + along_columns[row, column] * ordered[n, 0]
                values[i] = abs(ordered[n, 2] - plane - along_rows[row, column] * ordered[n, 1])
            scatter[row, column] = max(least, 1.4826 * _median(values, sampled))
    return scatter


@njit(nogil=True, cache=True)
def cell_moments(
    ordered: FloatArray,
    starts: IntArray,
    seeds: FloatArray,
    along_columns: FloatArray,
    along_rows: FloatArray,
    scatter: FloatArray,
    gate: float,
) -> FloatArray:
    """Sums over the points of each cell: w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz, wzz, 1.

    x and y in cells from the cell's centre, z in metres from its seed, w the point's weight. Points farther from the
    seed plane than `gate` scatters plus half the range of the seeds around are left out.
    """
    rows, columns = seeds.shape
    moments = np.zeros((rows, columns, 11))
    for row in range(rows):
        for column in range(columns):
            cell = row * columns + column
            if starts[cell + 1] == starts[cell]:
                continue
            seed = seeds[row, column]
            lowest = seed
            highest = seed
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    if starts[r * columns + c + 1] > starts[r * columns + c]:
                        lowest = min(lowest, seeds[r, c])
                        highest = max(highest, seeds[r, c])
            limit = gate * scatter[row, column] + 0.5 * (highest - lowest)
            slope_x = along_columns[row, column]
            slope_y = along_rows[row, column]
            sw = sx = sy = sxx = sxy = syy = sz = sxz = syz = szz = count = 0.0
            for n in range(starts[cell], starts[cell + 1]):
                x = float(ordered[n, 0])
                y = float(ordered[n, 1])
                z = float(ordered[n, 2]) - seed
                if abs(z - slope_x * x - slope_y * y) > limit:
                    continue
                w = float(ordered[n, 3])
                wx = w * x
                wy = w * y
                wz = w * z
                count += 1.0
                sw += w
                sx += wx
                sy += wy
                sxx += wx * x
                sxy += wx * y
                syy += wy * y
                sz += wz
                sxz += wz * x
                syz += wz * y
                szz += wz * z
            for k, total in enumerate((sw, sx, sy, sxx, sxy, syy, sz, sxz, syz, szz, count)):
                moments[row, column, k] = total
    return moments


@njit(nogil=True, cache=True, error_model="numpy")
def local_planes(
    moments: FloatArray,
    seeds: FloatArray,
    along_columns: FloatArray,
    along_rows: FloatArray,
    side_weight: float,
    slope_weight: float,
    neighbours_to_fill: int,
    per_independent: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Height at each cell's centre of the plane fitted to the points of its 3 x 3 cells.

    The four cells beside weigh `side_weight`, the corners its square. `slope_weight` points at the distance of a cell
    say that the slope is that of the seeds. Also returns the standard deviation of a point of weight one about the
    plane, and the number of such independent points that all amount to, where so many as `per_independent` count as
    one, but never less than a single point of theirs.
    """
    rows, columns = seeds.shape
    heights = np.full((rows, columns), np.nan, np.float32)
    deviations = np.full((rows, columns), np.nan, np.float32)
    independent = np.ones((rows, columns), np.float32)
    for row in range(rows):
        for column in range(columns):
            seed = seeds[row, column]
            if np.isnan(seed):
                continue
            filled = 0
            sw = 0.0
            sww = 0.0
            sn = 0.0
            sx = 0.0
            sy = 0.0
            sxx = 0.0
            sxy = 0.0
            syy = 0.0
            sz = 0.0
            sxz = 0.0
            syz = 0.0
            szz = 0.0
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    m = moments[r, c]
                    if m[0] == 0.0:
                        continue
                    filled += 1
                    dx = float(c - column)
                    dy = float(r - row)
                    up = seeds[r, c] - seed
                    w = 1.0 if c == column else side_weight
                    if r != row:
                        w *= side_weight
                    x = m[1] + dx * m[0]
                    y = m[2] + dy * m[0]
                    z = m[6] + up * m[0]
                    sw += w * m[0]
                    sww += w * w * m[0]
                    sn += w * m[10]
                    sx += w * x
                    sy += w * y
                    sxx += w * (m[3] + dx * (m[1] + x))
                    sxy += w * (m[4] + dx * m[2] + dy * x)
                    syy += w * (m[5] + dy * (m[2] + y))
                    sz += w * z
                    sxz += w * (m[7] + dx * m[6] + up * x)
                    syz += w * (m[8] + dy * m[6] + up * y)
                    szz += w * (m[9] + up * (m[6] + z))
            if filled == 0 or (moments[row, column, 0] == 0.0 and filled < neighbours_to_fill):
                continue
            # Cramer on the 3 x 3 normal equations of height and two slopes.
            pxx = sxx + slope_weight
            pyy = syy + slope_weight
            pxz = sxz + slope_weight * along_columns[row, column]
            pyz = syz + slope_weight * along_rows[row, column]
            k00 = pxx * pyy - sxy * sxy
            k01 = sxy * sy - sx * pyy
            k02 = sx * sxy - pxx * sy
            k11 = sw * pyy - sy * sy
            k12 = sx * sy - sw * sxy
            k22 = sw * pxx - sx * sx
            scale = 1.0 / (sw * k00 + sx * k01 + sy * k02)
            a = (k00 * sz + k01 * pxz + k02 * pyz) * scale
            b = (k01 * sz + k11 * pxz + k12 * pyz) * scale
            d = (k02 * sz + k12 * pxz + k22 * pyz) * scale
            squares = szz - 2.0 * (a * sz + b * sxz + d * syz) + a * a * sw + b * b * sxx + d * d * syy
            squares += 2.0 * (a * b * sx + a * d * sy + b * d * sxy)
            heights[row, column] = seed + a
            deviations[row, column] = math.sqrt(max(squares, 0.0) / sw)
            independent[row, column] = max(sw * sw / sww / per_independent, sw / sn)
    return heights, deviations, independent


@njit(nogil=True, cache=True)
def hidden_cells(
    heights: FloatArray,
    per_height_columns: FloatArray,
    per_height_rows: FloatArray,
    tolerance: float,
    top: float,
    row0: int,
    row1: int,
    column0: int,
    column1: int,
) -> BoolArray:
    """Cells of a window from which terrain stands between the ground and the lens.

    `per_height_columns` and `per_height_rows` (of the window's shape) are cells moved towards
    the lens per metre of height. The line of sight is followed cell by cell over `heights`
    until it is above `top`.
    """
    rows, columns = heights.shape
    hidden = np.zeros((row1 - row0, column1 - column0), np.bool_)
    for row in range(row0, row1):
        for column in range(column0, column1):
            height = heights[row, column]
            if np.isnan(height):
                continue
            move_c = per_height_columns[row - row0, column - column0]
            move_r = per_height_rows[row - row0, column - column0]
            reach = max(abs(move_c), abs(move_r))
            if reach <= 0.0:
                continue
            rise = 1.0 / reach
            step = 1
            sight = height + rise
            while sight < top:
                c = column + step * rise * move_c
                r = row + step * rise * move_r
                if not (0.0 <= c < columns - 1 and 0.0 <= r < rows - 1):
                    break
                j = int(c)
                i = int(r)
                p = c - j
                q = r - i
                upper = heights[i, j] + p * (heights[i, j + 1] - heights[i, j])
                lower = heights[i + 1, j] + p * (heights[i + 1, j + 1] - heights[i + 1, j])
                # A NaN here compares false: missing terrain hides nothing.
                if upper + q * (lower - upper) > sight + tolerance:
                    hidden[row - row0, column - column0] = True
                    break
                step += 1
                sight = height + step * rise
    return hidden
