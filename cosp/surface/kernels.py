"""The compiled loops of the surface package: two-ray intersection, gridding, occlusion."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cosp.arrays import BoolArray, FloatArray, IntArray


@njit(nogil=True, cache=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy")
def intersect_tabulated(
    fore_table: FloatArray,
    fore_start: float,
    fore_step: float,
    aft_table: FloatArray,
    aft_start: float,
    aft_step: float,
    fore: FloatArray,
    aft: FloatArray,
    ground: FloatArray,
    miss: FloatArray,
) -> None:
    """Midpoints of the common perpendiculars of tabulated rays.

    A row of a table holds origin c, and a and b of the direction a + y b, at one x.
    `fore` and `aft` are (N, 2) film points; `ground` (N, 3) and `miss` (N,) are filled.
    """
    fore_last = fore_table.shape[0] - 2
    aft_last = aft_table.shape[0] - 2
    fore_scale = 1.0 / fore_step
    aft_scale = 1.0 / aft_step
    for n in range(fore.shape[0]):
        u = (fore[n, 0] - fore_start) * fore_scale
        v = (aft[n, 0] - aft_start) * aft_scale
        if not (0.0 <= u <= fore_last + 1 and 0.0 <= v <= aft_last + 1):
            ground[n, 0] = np.nan
            ground[n, 1] = np.nan
            ground[n, 2] = np.nan
            miss[n] = np.nan
            continue
        i = min(int(u), fore_last)
        j = min(int(v), aft_last)
        p = u - i
        q = v - j
        y = fore[n, 1]
        c0 = fore_table[i, 0] + p * (fore_table[i + 1, 0] - fore_table[i, 0])
        c1 = fore_table[i, 1] + p * (fore_table[i + 1, 1] - fore_table[i, 1])
        c2 = fore_table[i, 2] + p * (fore_table[i + 1, 2] - fore_table[i, 2])
        a0 = fore_table[i, 3] + p * (fore_table[i + 1, 3] - fore_table[i, 3])
        a1 = fore_table[i, 4] + p * (fore_table[i + 1, 4] - fore_table[i, 4])
        a2 = fore_table[i, 5] + p * (fore_table[i + 1, 5] - fore_table[i, 5])
        a0 += y * (fore_table[i, 6] + p * (fore_table[i + 1, 6] - fore_table[i, 6]))
        a1 += y * (fore_table[i, 7] + p * (fore_table[i + 1, 7] - fore_table[i, 7]))
        a2 += y * (fore_table[i, 8] + p * (fore_table[i + 1, 8] - fore_table[i, 8]))
        y = aft[n, 1]
        w0 = c0 - (aft_table[j, 0] + q * (aft_table[j + 1, 0] - aft_table[j, 0]))
        w1 = c1 - (aft_table[j, 1] + q * (aft_table[j + 1, 1] - aft_table[j, 1]))
        w2 = c2 - (aft_table[j, 2] + q * (aft_table[j + 1, 2] - aft_table[j, 2]))
        b0 = aft_table[j, 3] + q * (aft_table[j + 1, 3] - aft_table[j, 3])
        b1 = aft_table[j, 4] + q * (aft_table[j + 1, 4] - aft_table[j, 4])
        b2 = aft_table[j, 5] + q * (aft_table[j + 1, 5] - aft_table[j, 5])
        b0 += y * (aft_table[j, 6] + q * (aft_table[j + 1, 6] - aft_table[j, 6]))
        b1 += y * (aft_table[j, 7] + q * (aft_table[j + 1, 7] - aft_table[j, 7]))
        b2 += y * (aft_table[j, 8] + q * (aft_table[j + 1, 8] - aft_table[j, 8]))
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


@njit(nogil=True, cache=True)
def sort_by_cell(
    points: FloatArray, x0: float, y0: float, step_x: float, step_y: float, rows: int, columns: int
) -> tuple[FloatArray, IntArray]:
    """Points as (column, row, height) in the order of their cells, and where each cell starts.

    A point belongs to the cell whose centre is nearest. Points outside the grid are left out.
    """
    count = points.shape[0]
    cells = np.empty(count, np.int32)
    starts = np.zeros(rows * columns + 1, np.int64)
    for n in range(count):
        u = (points[n, 0] - x0) / step_x + 0.5
        v = (points[n, 1] - y0) / step_y + 0.5
        cells[n] = -1
        if 0.0 <= u < columns and 0.0 <= v < rows and not np.isnan(points[n, 2]):
            cell = int(v) * columns + int(u)
            cells[n] = cell
            starts[cell + 1] += 1
    for cell in range(rows * columns):
        starts[cell + 1] += starts[cell]
    place = starts[:-1].copy()
    ordered = np.empty((starts[-1], 3), np.float32)
    for n in range(count):
        cell = cells[n]
        if cell >= 0:
            # Places within the grid, relative to the cell's centre: float32 keeps them to 1e-7 of a cell.
            ordered[place[cell], 0] = (points[n, 0] - x0) / step_x - cell % columns
            ordered[place[cell], 1] = (points[n, 1] - y0) / step_y - cell // columns
            ordered[place[cell], 2] = points[n, 2]
            place[cell] += 1
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
def _median(values: FloatArray, count: int) -> float:
    upper: float = _select(values, count, count // 2)
    if count % 2:
        return upper
    lower: float = values[0]
    for i in range(1, count // 2):
        lower = max(lower, values[i])
    return 0.5 * (lower + upper)


@njit(nogil=True, cache=True)
def cell_medians(ordered: FloatArray, starts: IntArray, rows: int, columns: int) -> FloatArray:
    """Median height of the points of each cell; NaN where there are none."""
    most = 1
    for cell in range(rows * columns):
        most = max(most, starts[cell + 1] - starts[cell])
    values = np.empty(most, np.float32)
    medians = np.full((rows, columns), np.nan, np.float32)
    for cell in range(rows * columns):
        count = starts[cell + 1] - starts[cell]
        if count:
            for i in range(count):
                values[i] = ordered[starts[cell] + i, 2]
            medians[cell // columns, cell % columns] = _median(values, count)
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
    """Median absolute distance, times 1.4826, of the points of each cell from its seed plane."""
    rows, columns = seeds.shape
    most = 1
    for cell in range(rows * columns):
        most = max(most, starts[cell + 1] - starts[cell])
    values = np.empty(most, np.float32)
    scatter = np.full((rows, columns), np.nan, np.float32)
    for row in range(rows):
        for column in range(columns):
            cell = row * columns + column
            count = starts[cell + 1] - starts[cell]
            if not count:
                continue
            for i in range(count):
                n = starts[cell] + i
                plane = seeds[row, column] + along_columns[row, column] * ordered[n, 0]
                values[i] = abs(ordered[n, 2] - plane - along_rows[row, column] * ordered[n, 1])
            scatter[row, column] = max(least, 1.4826 * _median(values, count))
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
    """Sums over the points of each cell: 1, x, y, xx, xy, yy, z, xz, yz, zz.

    x and y in cells from the cell's centre, z in metres from its seed. Points farther from the seed plane than `gate`
    scatters plus half the range of the seeds around are left out.
    """
    rows, columns = seeds.shape
    moments = np.zeros((rows, columns, 10))
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
            m = moments[row, column]
            for n in range(starts[cell], starts[cell + 1]):
                x = ordered[n, 0]
                y = ordered[n, 1]
                z = ordered[n, 2] - seed
                if abs(z - slope_x * x - slope_y * y) > limit:
                    continue
                m[0] += 1.0
                m[1] += x
                m[2] += y
                m[3] += x * x
                m[4] += x * y
                m[5] += y * y
                m[6] += z
                m[7] += x * z
                m[8] += y * z
                m[9] += z * z
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
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Height at each cell's centre of the plane fitted to the points of its 3 x 3 cells.

    The four cells beside weigh `side_weight`, the corners its square. `slope_weight` points at the distance of a cell
    say that the slope is that of the seeds. Also returns the standard deviation of one point about the plane and the
    number of points that the weights amount to.
    """
    rows, columns = seeds.shape
    heights = np.full((rows, columns), np.nan, np.float32)
    deviations = np.full((rows, columns), np.nan, np.float32)
    effective = np.zeros((rows, columns), np.float32)
    for row in range(rows):
        for column in range(columns):
            seed = seeds[row, column]
            if np.isnan(seed):
                continue
            filled = 0
            sw = 0.0
            sww = 0.0
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
            effective[row, column] = sw * sw / sww
    return heights, deviations, effective


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
