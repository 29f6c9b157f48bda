"""The compiled loops of the surface package: two-ray intersection, gridding, occlusion."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cosp.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray

_CHUNK = 128  # pixels whose rays are intersected side by side
_LANES = 16  # of which so many at a time, once for each set of nodes that they lie between
_LINE = _CHUNK + _LANES  # what is written beyond a run of pixels, the next run writes again
# Lines of a chunk, one array so that the compiler sees that they do not overlap: origin and direction of the fore rays;
# part of the way between nodes, down and across, and number of the upper left node, -1 where there is none or the pixel
# is done; NaN where there is no point, else 0; ground point and gap.
_FORE, _DOWN, _ACROSS, _NODE, _NOWHERE, _GROUND, _GAP = (k * _LINE for k in (0, 6, 7, 8, 9, 10, 13))
_CHUNK_SIZE = 14 * _LINE


@njit(nogil=True, cache=True)
def intersect_pixels(
    fore_table: FloatArray,
    fore_scale: tuple[float, float, float, float],
    aft_table: FloatArray,
    aft_scale: tuple[float, float, float, float],
    every: int,
    disparity: FloatArray,
    y_parallax: FloatArray,
    ground: FloatArray,
    miss: FloatArray,
) -> None:
    """Midpoints of the common perpendiculars of the tabulated rays of conjugate pixels.

    A table, (R, C, 8), holds origin and direction at its nodes, and nothing in the last two places; the scales are
    (place among the nodes' rows of the window's first row, rows of nodes per pixel, the same along columns).
    `disparity` and `y_parallax` (H, W) are those of every so-manyth pixel of every so-manyth row; `ground`
    (H, W, 3) and `miss` (H, W) are filled, with NaN where a pixel has no disparity or lies outside a table.
    """
    height, width = disparity.shape
    line = np.empty((6, fore_table.shape[1]))
    chunk = np.zeros(_CHUNK_SIZE)
    for y in range(height):
        _line_of_nodes(fore_table, fore_scale[0] + fore_scale[1] * every * y, line)
        for start in range(0, width, _CHUNK):
            count = min(_CHUNK, width - start)
            step = fore_scale[3] * every
            _between_nodes_of_line(line, fore_scale[2] + step * start, step, count, chunk)
            _places_among_nodes(
                aft_table,
                aft_scale,
                every,
                y,
                start,
                disparity[y, start : start + count],
                y_parallax[y, start : start + count],
                chunk,
            )
            _meet(aft_table, chunk)
            for t in range(count):
                nowhere = chunk[_NOWHERE + t]
                for k in range(3):
                    ground[y, start + t, k] = chunk[_GROUND + k * _LINE + t] + nowhere
                miss[y, start + t] = chunk[_GAP + t] + nowhere


@njit(nogil=True, cache=True)
def points_of_pixels(
    fore_table: FloatArray,
    fore_scale: tuple[float, float, float, float],
    aft_table: FloatArray,
    aft_scale: tuple[float, float, float, float],
    disparity: FloatArray,
    y_parallax: FloatArray,
    confidence: ByteArray,
    weights: FloatArray,
    largest_miss: float,
    lattice: FloatArray,
    lattice_nodes: tuple[float, float, float],
    cells: tuple[float, float, float, float],
    points: Float32Array,
) -> int:
    """Ground points of conjugate pixels as (column, row, height, weight) in the cells of a map; how many there are.

    The same intersection as `intersect_pixels`, of whose points those are left out whose gap is too large, whose weight
    is zero or that lie outside the lattice. `weights` (256,) are those of each confidence; `lattice` (R, C, 6) and its
    nodes (x, y, step) lead from the local frame to the map as in `cosp.geometry.mapping.MapFrame`; `cells` are the
    map coordinates of the centre of cell (0, 0) and cells per metre, both (x, y). `points` (H W, 4) is filled.
    """
    height, width = disparity.shape
    line = np.empty((6, fore_table.shape[1]))
    chunk = np.zeros(_CHUNK_SIZE)
    found = 0
    for y in range(height):
        _line_of_nodes(fore_table, fore_scale[0] + fore_scale[1] * y, line)
        for start in range(0, width, _CHUNK):
            count = min(_CHUNK, width - start)
            _between_nodes_of_line(line, fore_scale[2] + fore_scale[3] * start, fore_scale[3], count, chunk)
            _places_among_nodes(
                aft_table,
                aft_scale,
                1,
                y,
                start,
                disparity[y, start : start + count],
                y_parallax[y, start : start + count],
                chunk,
            )
            _meet(aft_table, chunk)
            _onto_map(lattice, lattice_nodes, chunk)
            for t in range(count):
                weight = weights[confidence[y, start + t]]
                gap = chunk[_GAP + t] + chunk[_NOWHERE + t]
                # A gap of NaN compares false.
                if gap <= largest_miss and weight > 0.0:
                    points[found, 0] = (chunk[_GROUND + t] - cells[0]) * cells[2]
                    points[found, 1] = (chunk[_GROUND + _LINE + t] - cells[1]) * cells[3]
                    points[found, 2] = chunk[_GROUND + 2 * _LINE + t]
                    points[found, 3] = weight
                    found += 1
    return found


@njit(nogil=True, cache=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy")
def _places_among_nodes(
    table: FloatArray,
    scale: tuple[float, float, float, float],
    every: int,
    y: int,
    start: int,
    disparity: FloatArray,
    y_parallax: FloatArray,
    chunk: FloatArray,
) -> None:
    """Where among the nodes of the aft table the conjugates of the pixels of a chunk lie."""
    node_columns = float(table.shape[1])
    last_row, last_column = float(table.shape[0] - 1), node_columns - 1.0
    first_row, first_column = scale[0] + scale[1] * every * y, scale[2] + scale[3] * every * start
    for t in range(min(disparity.size, _CHUNK)):
        chunk[_DOWN + t] = y_parallax[t]
        chunk[_ACROSS + t] = disparity[t]
    for t in range(_CHUNK):
        row = first_row + scale[1] * chunk[_DOWN + t]
        column = first_column + scale[3] * (every * t + chunk[_ACROSS + t])
        inside = (row >= 0.0) & (row < last_row) & (column >= 0.0) & (column < last_column)
        row = row if inside else 0.0
        column = column if inside else 0.0
        i, j = np.floor(row), np.floor(column)
        chunk[_DOWN + t] = row - i
        chunk[_ACROSS + t] = column - j
        chunk[_NODE + t] = i * node_columns + j if inside else -1.0
        chunk[_NOWHERE + t] = 0.0 if inside else np.nan


@njit(nogil=True, cache=True, fastmath={"nnan", "nsz"})
def _largest_node(part: FloatArray) -> float:
    """Largest number of a node in a block; -1 where no pixel of it is left."""
    # Four at a time, which need not wait for each other.
    a = b = c = d = -1.0
    for n in range(_NODE, _NODE + _LANES, 4):
        a = part[n] if part[n] > a else a
        b = part[n + 1] if part[n + 1] > b else b
        c = part[n + 2] if part[n + 2] > c else c
        d = part[n + 3] if part[n + 3] > d else d
    return max(max(a, b), max(c, d))


@njit(nogil=True, cache=True, inline="always")
def _corners(nodes: FloatArray, upper: int, columns: int, k: int) -> tuple[float, float, float, float]:
    """What makes the k-th value between four nodes: constant, change downwards, across, and both."""
    base = nodes[upper, k]
    by_row, by_column = nodes[upper + columns, k] - base, nodes[upper + 1, k] - base
    return base, by_row, by_column, nodes[upper + columns + 1, k] - nodes[upper + columns, k] - by_column


@njit(nogil=True, cache=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy")
def _meet(table: FloatArray, chunk: FloatArray) -> None:
    """Ground points and gaps of the pixels of a chunk: where its fore rays pass the aft rays nearest."""
    columns = table.shape[1]
    nodes = table.reshape(-1, 8)
    for block in range(0, _CHUNK, _LANES):
        part = chunk[block:]
        node = _largest_node(part)
        while node >= 0.0:
            upper = int(node)
            x0, x1, x2, x3 = _corners(nodes, upper, columns, 0)
            y0, y1, y2, y3 = _corners(nodes, upper, columns, 1)
            z0, z1, z2, z3 = _corners(nodes, upper, columns, 2)
            u0, u1, u2, u3 = _corners(nodes, upper, columns, 3)
            v0, v1, v2, v3 = _corners(nodes, upper, columns, 4)
            w0, w1, w2, w3 = _corners(nodes, upper, columns, 5)
            for n in range(_LANES):
                p, q = part[_DOWN + n], part[_ACROSS + n]
                b0 = u0 + p * u1 + q * (u2 + p * u3)
                b1 = v0 + p * v1 + q * (v2 + p * v3)
                b2 = w0 + p * w1 + q * (w2 + p * w3)
                o0, o1, o2 = part[_FORE + n], part[_FORE + _LINE + n], part[_FORE + 2 * _LINE + n]
                a0, a1, a2 = part[_FORE + 3 * _LINE + n], part[_FORE + 4 * _LINE + n], part[_FORE + 5 * _LINE + n]
                d0 = o0 - (x0 + p * x1 + q * (x2 + p * x3))
                d1 = o1 - (y0 + p * y1 + q * (y2 + p * y3))
                d2 = o2 - (z0 + p * z1 + q * (z2 + p * z3))
                aa = a0 * a0 + a1 * a1 + a2 * a2
                ab = a0 * b0 + a1 * b1 + a2 * b2
                bb = b0 * b0 + b1 * b1 + b2 * b2
                ad = a0 * d0 + a1 * d1 + a2 * d2
                bd = b0 * d0 + b1 * d1 + b2 * d2
                scale = 1.0 / (aa * bb - ab * ab)
                along_a = (ab * bd - bb * ad) * scale
                along_b = (aa * bd - ab * ad) * scale
                # Gap vector between the nearest points of both rays; half of it leads to the midpoint.
                g0 = d0 + along_a * a0 - along_b * b0
                g1 = d1 + along_a * a1 - along_b * b1
                g2 = d2 + along_a * a2 - along_b * b2
                e0 = o0 + along_a * a0 - 0.5 * g0
                e1 = o1 + along_a * a1 - 0.5 * g1
                e2 = o2 + along_a * a2 - 0.5 * g2
                gap = math.sqrt(g0 * g0 + g1 * g1 + g2 * g2)
                mine = part[_NODE + n] == node
                part[_GROUND + n] = e0 if mine else part[_GROUND + n]
                part[_GROUND + _LINE + n] = e1 if mine else part[_GROUND + _LINE + n]
                part[_GROUND + 2 * _LINE + n] = e2 if mine else part[_GROUND + 2 * _LINE + n]
                part[_GAP + n] = gap if mine else part[_GAP + n]
                part[_NODE + n] = -1.0 if mine else part[_NODE + n]
            node = _largest_node(part)


@njit(nogil=True, cache=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy")
def _onto_map(lattice: FloatArray, lattice_nodes: tuple[float, float, float], chunk: FloatArray) -> None:
    """Replace the ground points of a chunk by map coordinates and heights; off the lattice is nowhere."""
    columns = lattice.shape[1]
    nodes = lattice.reshape(-1, 6)
    last_u, last_v = float(columns - 1), float(lattice.shape[0] - 1)
    per_step = 1.0 / lattice_nodes[2]
    for t in range(_CHUNK):
        u = (chunk[_GROUND + t] - lattice_nodes[0]) * per_step
        v = (chunk[_GROUND + _LINE + t] - lattice_nodes[1]) * per_step
        inside = (u >= 0.0) & (v >= 0.0) & (u < last_u) & (v < last_v)
        u = u if inside else 0.0
        v = v if inside else 0.0
        i, j = np.floor(v), np.floor(u)
        chunk[_DOWN + t] = v - i
        chunk[_ACROSS + t] = u - j
        chunk[_NODE + t] = i * columns + j if inside else -1.0
        chunk[_NOWHERE + t] += 0.0 if inside else np.nan
    for block in range(0, _CHUNK, _LANES):
        part = chunk[block:]
        node = _largest_node(part)
        while node >= 0.0:
            upper = int(node)
            x0, x1, x2, x3 = _corners(nodes, upper, columns, 0)
            y0, y1, y2, y3 = _corners(nodes, upper, columns, 1)
            z0, z1, z2, z3 = _corners(nodes, upper, columns, 2)
            u0, u1, u2, u3 = _corners(nodes, upper, columns, 3)
            v0, v1, v2, v3 = _corners(nodes, upper, columns, 4)
            w0, w1, w2, w3 = _corners(nodes, upper, columns, 5)
            for n in range(_LANES):
                p, q, h = part[_DOWN + n], part[_ACROSS + n], part[_GROUND + 2 * _LINE + n]
                x = x0 + p * x1 + q * (x2 + p * x3) + h * (u0 + p * u1 + q * (u2 + p * u3))
                y = y0 + p * y1 + q * (y2 + p * y3) + h * (v0 + p * v1 + q * (v2 + p * v3))
                z = z0 + p * z1 + q * (z2 + p * z3) + h * (w0 + p * w1 + q * (w2 + p * w3))
                mine = part[_NODE + n] == node
                part[_GROUND + n] = x if mine else part[_GROUND + n]
                part[_GROUND + _LINE + n] = y if mine else part[_GROUND + _LINE + n]
                part[_GROUND + 2 * _LINE + n] = z if mine else h
                part[_NODE + n] = -1.0 if mine else part[_NODE + n]
            node = _largest_node(part)


@njit(nogil=True, cache=True)
def _line_of_nodes(table: FloatArray, row: float, line: FloatArray) -> None:
    """Values (6, C) of a table (R, C, 8) on a row between its rows of nodes."""
    i = min(max(int(row), 0), table.shape[0] - 2)
    part = row - i
    for k in range(6):
        for j in range(line.shape[1]):
            line[k, j] = table[i, j, k] + part * (table[i + 1, j, k] - table[i, j, k])


@njit(nogil=True, cache=True, inline="always")
def _ramp(values: FloatArray, j: int, first: float, step: float) -> tuple[float, float]:
    """Value at place 0, and change from place to place, of the line between two nodes."""
    slope = values[j + 1] - values[j]
    return values[j] + slope * (first - j), slope * step


@njit(nogil=True, cache=True, fastmath={"contract"})
def _between_nodes_of_line(line: FloatArray, first: float, step: float, count: int, chunk: FloatArray) -> None:
    """Fore rays of a chunk: values between the nodes of a line at places `step` apart."""
    t = 0
    while t < count:
        j = min(int(first + t * step), line.shape[1] - 2)
        stop = count
        if j < line.shape[1] - 2:
            stop = min(max(int(math.ceil((j + 1 - first) / step)), t + 1), count)
        o0, d0 = _ramp(line[0], j, first, step)
        o1, d1 = _ramp(line[1], j, first, step)
        o2, d2 = _ramp(line[2], j, first, step)
        o3, d3 = _ramp(line[3], j, first, step)
        o4, d4 = _ramp(line[4], j, first, step)
        o5, d5 = _ramp(line[5], j, first, step)
        for block in range(t, stop, _LANES):
            part = chunk[block:]
            for n in range(_LANES):
                u = float(block + n)
                part[_FORE + n] = o0 + d0 * u
                part[_FORE + _LINE + n] = o1 + d1 * u
                part[_FORE + 2 * _LINE + n] = o2 + d2 * u
                part[_FORE + 3 * _LINE + n] = o3 + d3 * u
                part[_FORE + 4 * _LINE + n] = o4 + d4 * u
                part[_FORE + 5 * _LINE + n] = o5 + d5 * u
        t = stop


@njit(nogil=True, cache=True)
def points_in_cells(
    points: FloatArray, weights: Float32Array, cells: tuple[float, float, float, float], result: Float32Array
) -> None:
    """Fill `result`, (N, 4), with (column, row, height, weight) of points (N, 3); `cells` as of `points_of_pixels`."""
    for n in range(points.shape[0]):
        result[n, 0] = (points[n, 0] - cells[0]) * cells[2]
        result[n, 1] = (points[n, 1] - cells[1]) * cells[3]
        result[n, 2] = points[n, 2]
        result[n, 3] = weights[n]


_BLOCK = 32  # cells a side, of which the highest is known beforehand
_LEAST_MOVE = 1e-12  # cells per metre of height, for what does not move at all

# Points that are added up side by side: so many may be read beyond the last, which must be numbers.
MORE_POINTS = 8

# Places in the lines of points, four numbers each: with a distance from point to point that the compiler knows, and
# unsigned, for what cannot be negative need not be looked at as counted from the end.
_ONE, _TWO, _THREE, _FOUR = (np.uint64(k) for k in (1, 2, 3, 4))


@njit(nogil=True, cache=True)
def count_by_cell(
    points: Float32Array, row0: int, column0: int, shape: tuple[int, int], cells: IntArray, counts: IntArray
) -> None:
    """Write the cell of each of the points (N, 4) into `cells` and add one to its count.

    A point belongs to the cell whose centre is nearest. Points outside the grid or without weight belong to one more
    cell after the others. `row0` and `column0` are the cell of the grid that the points' cell (0, 0) is.
    """
    rows, columns = np.float32(shape[0]), np.float32(shape[1])
    more_rows, more_columns = np.float32(row0) + np.float32(0.5), np.float32(column0) + np.float32(0.5)
    zero = np.float32(0)
    wide, nowhere = np.int32(shape[1]), np.int32(shape[0] * shape[1])
    flat = points.reshape(-1)
    for n in range(points.shape[0]):
        k = _FOUR * np.uint64(n)
        u = flat[k] + more_columns
        v = flat[k + _ONE] + more_rows
        z = flat[k + _TWO]
        inside = (u >= zero) & (u < columns) & (v >= zero) & (v < rows) & (flat[k + _THREE] > zero) & (z == z)
        u = u if inside else zero
        v = v if inside else zero
        cell = np.int32(np.int32(v) * wide + np.int32(u))
        cells[n] = cell if inside else nowhere
    # By itself, so that the loop above is worked on in vectors.
    for n in range(points.shape[0]):
        counts[cells[n]] += np.uint32(1)


@njit(nogil=True, cache=True)
def place_by_cell(points: Float32Array, cells: IntArray, place: IntArray, ordered: Float32Array) -> None:
    """Copy points to where the next ones of their cells go, with columns and rows from the cell's centre."""
    half = np.float32(0.5)
    for n in range(points.shape[0]):
        cell = cells[n]
        if cell < place.size:
            k = place[cell]
            place[cell] = k + np.uint32(1)
            u, v, z, w = points[n, 0], points[n, 1], points[n, 2], points[n, 3]
            ordered[k, 0] = u - np.floor(u + half)
            ordered[k, 1] = v - np.floor(v + half)
            ordered[k, 2] = z
            ordered[k, 3] = w


@njit(nogil=True, cache=True)
def _ordered(a: float, b: float, c: float) -> tuple[float, float, float]:
    low = min(a, b)
    high = max(a, b)
    return min(low, c), max(low, min(high, c)), max(high, c)


# Medians without branches: what each exchange orders is known beforehand, so that many are taken side by side.
@njit(nogil=True, cache=True)
def _median_of_five(a: float, b: float, c: float, d: float, e: float) -> float:
    result: float = _ordered(max(min(a, b), min(c, d)), min(max(a, b), max(c, d)), e)[1]
    return result


@njit(nogil=True, cache=True)
def _median_of_nine(a: float, b: float, c: float, d: float, e: float, f: float, g: float, h: float, i: float) -> float:
    a, b, c = _ordered(a, b, c)
    d, e, f = _ordered(d, e, f)
    g, h, i = _ordered(g, h, i)
    middle = _ordered(b, e, h)[1]
    result: float = _ordered(max(max(a, d), g), middle, min(min(c, f), i))[1]
    return result


@njit(nogil=True, cache=True, inline="always")
def _points_of(starts: IntArray, cell: int) -> tuple[np.uint64, np.uint64]:
    """First point of a cell and how many there are, unsigned."""
    return np.uint64(starts[cell]), np.uint64(starts[cell + 1] - starts[cell])


@njit(nogil=True, cache=True)
def _spans_of_rows(starts: IntArray, rows: int, columns: int) -> IntArray:
    """First column with points and one after the last, of each row (rows, 2); both 0 where a row has none."""
    spans = np.zeros((rows, 2), np.int64)
    for row in range(rows):
        cell = row * columns
        low, high = 0, columns
        if starts[cell] == starts[cell + columns]:
            continue
        while starts[cell + low + 1] == starts[cell]:
            low += 1
        while starts[cell + high - 1] == starts[cell + columns]:
            high -= 1
        spans[row] = low, high
    return spans


@njit(nogil=True, cache=True)
def _span_about(spans: IntArray, row: int, columns: int) -> tuple[int, int]:
    """Columns of a row that have points or lie beside cells that have some."""
    low, high = columns, 0
    for r in range(max(row - 1, 0), min(row + 2, spans.shape[0])):
        if spans[r, 1] > 0:
            low = min(low, max(spans[r, 0] - 1, 0))
            high = max(high, min(spans[r, 1] + 1, columns))
    return min(low, high), high


@njit(nogil=True, cache=True)
def _medians_of_row(
    flat: FloatArray, starts: IntArray, row: int, low: int, high: int, taken: FloatArray, medians: FloatArray
) -> None:
    """Median height of nine points of each cell of a row, evenly taken; NaN where there are none.

    Medians here only say what lies far off, which a sample does as well. Of fewer points some count twice.
    """
    # First the nine of each, then the medians of many cells side by side.
    columns = medians.shape[1]
    of_row, part = starts[row * columns + low : row * columns + high + 1], taken[:, low:high]
    # Counted from zero, so that no place need be looked at as one from the end.
    for column in range(high - low):
        start, count = _points_of(of_row, column)
        for n in range(9):
            k = _FOUR * (start + np.uint64(n) * count // np.uint64(9))
            part[n, column] = flat[k + _TWO] if count else np.float32(np.nan)
    a, b, c, d, e, f, g, h, i = part
    found = medians[row, low:high]
    for n in range(found.size):
        missing = np.float32(0) * a[n]
        found[n] = _median_of_nine(a[n], b[n], c[n], d[n], e[n], f[n], g[n], h[n], i[n]) + missing


@njit(nogil=True, cache=True)
def _smooth_row(values: FloatArray, row: int, low: int, high: int, around: FloatArray, result: FloatArray) -> None:
    """Medians of the 3 x 3 cells about those of a row, the missing ones left out."""
    rows, columns = values.shape
    found = result[row]
    found[low:high] = np.nan
    if 0 < row < rows - 1:
        first, last = max(low, 1), min(high, columns - 1)
        above = values[row - 1, first - 1 : last + 1]
        here = values[row, first - 1 : last + 1]
        below = values[row + 1, first - 1 : last + 1]
        inner = found[first:last]
        for c in range(inner.size):
            a, b, d = above[c], above[c + 1], above[c + 2]
            e, f, g = here[c], here[c + 1], here[c + 2]
            h, i, j = below[c], below[c + 1], below[c + 2]
            # The sum times zero: NaN where one of the nine is.
            missing = np.float32(0) * (a + b + d + e + f + g + h + i + j)
            inner[c] = _median_of_nine(a, b, d, e, f, g, h, i, j) + missing
    for column in range(low, high):
        if np.isnan(found[column]):
            found[column] = _median_of_known(values, row, column, around)


@njit(nogil=True, cache=True)
def _median_of_known(values: FloatArray, row: int, column: int, around: FloatArray) -> float:
    """Median of those of the 3 x 3 cells about one that have a value; NaN if none has."""
    count = 0
    for r in range(max(row - 1, 0), min(row + 2, values.shape[0])):
        for c in range(max(column - 1, 0), min(column + 2, values.shape[1])):
            value = values[r, c]
            if not np.isnan(value):
                k = count
                while k > 0 and around[k - 1] > value:
                    around[k] = around[k - 1]
                    k -= 1
                around[k] = value
                count += 1
    if count == 0:
        return np.nan
    middle: float = 0.5 * (around[(count - 1) // 2] + around[count // 2])
    return middle


@njit(nogil=True, cache=True)
def _slopes_of_row(
    heights: FloatArray, row: int, low: int, high: int, along_columns: FloatArray, along_rows: FloatArray
) -> None:
    """Height change per column and per row; central where it can be, else one-sided, else zero."""
    rows, columns = heights.shape
    for column in range(low, high):
        here = heights[row, column]
        before = heights[row, column - 1] if column > 0 else np.nan
        after = heights[row, column + 1] if column < columns - 1 else np.nan
        along_columns[row, column] = _slope(before, here, after)
        before = heights[row - 1, column] if row > 0 else np.nan
        after = heights[row + 1, column] if row < rows - 1 else np.nan
        along_rows[row, column] = _slope(before, here, after)


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
def _scatter_of_row(
    flat: FloatArray,
    starts: IntArray,
    row: int,
    low: int,
    high: int,
    surface: tuple[FloatArray, FloatArray, FloatArray],
    least: float,
    taken: FloatArray,
    scatter: FloatArray,
) -> None:
    """Median absolute distance, times 1.4826, of five points of each cell from its seed plane; NaN without points."""
    columns = scatter.shape[1]
    of_row, part = starts[row * columns + low : row * columns + high + 1], taken[:5, low:high]
    seeds, along_columns, along_rows = surface[0][row, low:], surface[1][row, low:], surface[2][row, low:]
    for column in range(high - low):
        start, count = _points_of(of_row, column)
        seed, slope_x, slope_y = seeds[column], along_columns[column], along_rows[column]
        for n in range(5):
            k = _FOUR * (start + np.uint64(n) * count // np.uint64(5))
            above = np.float32(np.nan)
            if count:
                above = flat[k + _TWO] - seed - slope_x * flat[k] - slope_y * flat[k + _ONE]
            part[n, column] = abs(above)
    a, b, c, d, e = part
    found = scatter[row, low:high]
    for n in range(found.size):
        missing = np.float32(0) * a[n]
        found[n] = max(least, 1.4826 * _median_of_five(a[n], b[n], c[n], d[n], e[n])) + missing


@njit(nogil=True, cache=True)
def _limits_of_row(
    seeds: FloatArray,
    medians: FloatArray,
    row: int,
    low: int,
    high: int,
    scatter: FloatArray,
    gate: float,
    extremes: FloatArray,
    limits: FloatArray,
) -> None:
    """How far from its seed plane a point may lie: `gate` scatters plus half the range of the seeds around.

    Only seeds of cells that have points of their own count, which are those with a median.
    """
    rows, columns = seeds.shape
    # With an empty cell on either side.
    lowest, highest = extremes[0, low : high + 2], extremes[1, low : high + 2]
    lowest[:] = np.inf
    highest[:] = -np.inf
    first, last = max(low - 1, 0), min(high + 1, columns)
    lower, higher = lowest[first + 1 - low :], highest[first + 1 - low :]
    for r in range(max(row - 1, 0), min(row + 2, rows)):
        seeds_here, medians_here = seeds[r, first:last], medians[r, first:last]
        for c in range(last - first):
            # NaN, of a cell without points, compares false and changes nothing.
            seed = seeds_here[c] + np.float32(0) * medians_here[c]
            lower[c] = seed if seed < lower[c] else lower[c]
            higher[c] = seed if seed > higher[c] else higher[c]
    found, spread = limits[low:high], scatter[row, low:high]
    for c in range(high - low):
        span = max(max(highest[c], highest[c + 1]), highest[c + 2])
        span -= min(min(lowest[c], lowest[c + 1]), lowest[c + 2])
        found[c] = gate * spread[c] + 0.5 * span


# Sums over the points of a cell, in this order: w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz, wzz, points, and whether there
# are any; w is the weight of a point, x and y its place in cells from the cell's centre, z its height.
_W, _X, _Y, _XX, _XY, _YY, _Z, _XZ, _YZ, _ZZ, _POINTS, _ANY, _WW = range(13)
_SUMS = 12
_RUN = 64  # cells of a row whose planes are fitted side by side
_WIDE = _RUN + 2


@njit(nogil=True, cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
def _sum_points(
    flat: FloatArray,
    starts: IntArray,
    row: int,
    low: int,
    high: int,
    surface: tuple[FloatArray, FloatArray, FloatArray],
    limits: FloatArray,
    sums: FloatArray,
) -> None:
    """Write into sums (12, columns + 2 and more), which are zero, those of cells of a row; cell c stands at c + 1."""
    columns = surface[0].shape[1]
    of_row, limits, sums = starts[row * columns + low :], limits[low:], sums[:, low + 1 :]
    seeds, along_columns, along_rows = surface[0][row, low:], surface[1][row, low:], surface[2][row, low:]
    for column in range(high - low):
        first, count = _points_of(of_row, column)
        if count == np.uint64(0):
            continue
        seed = seeds[column]
        slope_x = along_columns[column]
        slope_y = along_rows[column]
        limit = limits[column]
        zero, one = np.float32(0), np.float32(1)
        sw = sx = sy = sxx = sxy = syy = sz = sxz = syz = szz = points = zero
        # By whole vectors, where there is more than one: what lies beyond the cell's last point is not kept.
        points_here = np.int64(count)
        reach = points_here
        if points_here > MORE_POINTS:
            reach = MORE_POINTS * ((points_here + MORE_POINTS - 1) // MORE_POINTS)
        for n in range(reach):
            k = _FOUR * (first + np.uint64(n))
            x = flat[k]
            y = flat[k + _ONE]
            z = flat[k + _TWO] - seed - slope_x * x - slope_y * y
            # One or nothing, and no branch: so that all is loaded side by side.
            kept = one if (abs(z) <= limit) & (n < points_here) else zero
            w = kept * flat[k + _THREE]
            z = kept * z
            wx = w * x
            wy = w * y
            wz = w * z
            points += kept
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
        # So far z is the distance from the seed plane, which keeps float32 exact enough.
        up = np.float64(seed)  # float() would leave it as it is
        a = np.float64(slope_x)
        b = np.float64(slope_y)
        squares = szz + 2.0 * (up * sz + a * sxz + b * syz) + up * up * sw + a * a * sxx + b * b * syy
        sums[_W, column] = sw
        sums[_X, column] = sx
        sums[_Y, column] = sy
        sums[_XX, column] = sxx
        sums[_XY, column] = sxy
        sums[_YY, column] = syy
        sums[_Z, column] = sz + up * sw + a * sx + b * sy
        sums[_XZ, column] = sxz + up * sx + a * sxx + b * sxy
        sums[_YZ, column] = syz + up * sy + a * sxy + b * syy
        sums[_ZZ, column] = squares + 2.0 * (up * (a * sx + b * sy) + a * b * sxy)
        sums[_POINTS, column] = points
        sums[_ANY, column] = 1.0 if sw > zero else 0.0


@njit(nogil=True, cache=True)
def _add_rows(above: FloatArray, here: FloatArray, below: FloatArray, start: int, side: float, to: FloatArray) -> None:
    """Sums of three rows of cells as seen from the middle one, the others with less weight, for a run of columns."""
    for k in range(_SUMS):
        first = above[k, start : start + _WIDE]
        second = here[k, start : start + _WIDE]
        third = below[k, start : start + _WIDE]
        weight = 1.0 if k == _ANY else side
        for t in range(_WIDE):
            to[k * _WIDE + t] = second[t] + weight * (first[t] + third[t])
    for t in range(_WIDE):
        to[_WW * _WIDE + t] = here[_W, start + t] + side * side * (above[_W, start + t] + below[_W, start + t])
    # y counts from the middle row: one less above, one more below.
    for k, lower in ((_Y, _W), (_XY, _X), (_YZ, _Z)):
        first = above[lower, start : start + _WIDE]
        third = below[lower, start : start + _WIDE]
        for t in range(_WIDE):
            to[k * _WIDE + t] += side * (third[t] - first[t])
    for t in range(_WIDE):
        first_y = above[_W, start + t] - 2.0 * above[_Y, start + t]
        third_y = below[_W, start + t] + 2.0 * below[_Y, start + t]
        to[_YY * _WIDE + t] += side * (first_y + third_y)


@njit(nogil=True, cache=True)
def planes_of_cells(
    ordered: FloatArray,
    starts: IntArray,
    shape: tuple[int, int],
    least_scatter: float,
    gate: float,
    side_weight: float,
    slope_weight: float,
    neighbours_to_fill: int,
    per_independent: float,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Height at each cell's centre of the plane fitted to the points of its 3 x 3 cells.

    `ordered` holds points (N, 4) in the order of the cells: place from the cell's centre, height, weight; `MORE_POINTS`
    follow the last. Those farther from the seed plane of their cell, which is made of medians, than its limit are left
    out. The four cells beside weigh `side_weight`, the corners its square. `slope_weight` points at the distance of a
    cell say that the slope is that of the seeds. Also returns the standard deviation of the height, where so many
    points as `per_independent` count as one, but all of them never for less than a single one, and the points of the
    cell itself.
    """
    rows, columns = shape
    flat = ordered.reshape(-1)
    heights = np.full(shape, np.nan, np.float32)
    sigmas = np.full(shape, np.nan, np.float32)
    counts = np.zeros(shape, np.int32)
    # What lies beside the cells with points is looked at, too, and must be missing there.
    medians, seeds, scatter, smooth = (
        np.full(shape, np.nan, np.float32),
        np.full(shape, np.nan, np.float32),
        np.full(shape, np.nan, np.float32),
        np.empty(shape, np.float32),
    )
    along_columns, along_rows = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    surface = (seeds, along_columns, along_rows)
    spans = _spans_of_rows(starts, rows, columns)
    taken, around = np.empty((9, columns), np.float32), np.empty(9, np.float32)
    limits, extremes = np.empty(columns, np.float32), np.empty((2, columns + 2), np.float32)
    # Sums of three rows at a time, with an empty cell on either side.
    ring = np.zeros((3, _SUMS, (columns + _RUN - 1) // _RUN * _RUN + 2))
    room = (np.zeros((_WW + 1) * _WIDE), np.zeros(2 * _RUN), np.zeros(2 * _RUN))
    choices = (side_weight, slope_weight, neighbours_to_fill, per_independent)
    # Each step needs the one before of the next row: so the points of a row are still at hand when all steps have come.
    for last in range(rows + 4):
        row = last
        if row < rows and spans[row, 1] > 0:
            _medians_of_row(flat, starts, row, spans[row, 0], spans[row, 1], taken, medians)
        row = last - 1
        if 0 <= row < rows:
            low, high = _span_about(spans, row, columns)
            _smooth_row(medians, row, low, high, around, seeds)
        row = last - 2
        if 0 <= row < rows:
            low, high = _span_about(spans, row, columns)
            _slopes_of_row(seeds, row, low, high, along_columns, along_rows)
            low, high = spans[row, 0], spans[row, 1]
            _scatter_of_row(flat, starts, row, low, high, surface, least_scatter, taken, scatter)
        row = last - 3
        if 0 <= row <= rows:
            sums = ring[row % 3]
            sums[:] = 0.0
            if row < rows and spans[row, 1] > 0:
                low, high = spans[row, 0], spans[row, 1]
                _smooth_row(scatter, row, low, high, around, smooth)
                _limits_of_row(seeds, medians, row, low, high, smooth, gate, extremes, limits)
                _sum_points(flat, starts, row, low, high, surface, limits, sums)
        row = last - 4
        if row >= 0:
            low, high = _span_about(spans, row, columns)
            _planes_of_row(ring, row, low, high, surface, least_scatter, choices, room, (heights, sigmas, counts))
    return heights, sigmas, counts


@njit(nogil=True, cache=True, error_model="numpy")
def _planes_of_row(
    ring: FloatArray,
    row: int,
    low: int,
    high: int,
    surface: tuple[FloatArray, FloatArray, FloatArray],
    least: float,
    choices: tuple[float, float, int, float],
    room: tuple[FloatArray, FloatArray, FloatArray],
    results: tuple[FloatArray, FloatArray, IntArray],
) -> None:
    """Planes of the cells of a row, from the sums over the points of it and the rows above and below."""
    _, along_columns, along_rows = surface
    side_weight, slope_weight, neighbours_to_fill, per_independent = choices
    lines, slopes, solved = room
    heights, sigmas, counts = results
    above, here, below = ring[(row + 2) % 3], ring[row % 3], ring[(row + 1) % 3]
    for start in range(low // _RUN * _RUN, high, _RUN):
        count = min(_RUN, heights.shape[1] - start)
        _add_rows(above, here, below, start, side_weight, lines)
        for t in range(count):
            slopes[t] = along_columns[row, start + t]
            slopes[_RUN + t] = along_rows[row, start + t]
        _solve_run(lines, slopes, side_weight, slope_weight, least, per_independent, solved)
        for t in range(count):
            own = here[_ANY, start + 1 + t] > 0.0
            around = (_ANY * _WIDE) + t
            filled = lines[around] + lines[around + 1] + lines[around + 2]
            if own or filled >= neighbours_to_fill:
                heights[row, start + t] = solved[t]
                sigmas[row, start + t] = solved[_RUN + t]
                counts[row, start + t] = int(here[_POINTS, start + 1 + t])


@njit(nogil=True, cache=True)
def _sum_columns(lines: FloatArray, k: int, t: int, side: float) -> float:
    """Sum over the three columns about the t-th cell of a run, of sums over three rows."""
    total: float = lines[k * _WIDE + t + 1] + side * (lines[k * _WIDE + t] + lines[k * _WIDE + t + 2])
    return total


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _solve_run(
    lines: FloatArray,
    slopes: FloatArray,
    side: float,
    slope_weight: float,
    least: float,
    per_independent: float,
    solved: FloatArray,
) -> None:
    """Fit the planes of a run of cells: height and its standard deviation, a line of `_RUN` each."""
    for t in range(_RUN):
        sw = _sum_columns(lines, _W, t, side)
        sww = _sum_columns(lines, _WW, t, side * side)
        syy = _sum_columns(lines, _YY, t, side)
        sy = _sum_columns(lines, _Y, t, side)
        sz = _sum_columns(lines, _Z, t, side)
        syz = _sum_columns(lines, _YZ, t, side)
        szz = _sum_columns(lines, _ZZ, t, side)
        # x counts from the middle column: one less before, one more after.
        sx = _sum_columns(lines, _X, t, side) + side * (lines[_W * _WIDE + t + 2] - lines[_W * _WIDE + t])
        sxy = _sum_columns(lines, _XY, t, side) + side * (lines[_Y * _WIDE + t + 2] - lines[_Y * _WIDE + t])
        sxz = _sum_columns(lines, _XZ, t, side) + side * (lines[_Z * _WIDE + t + 2] - lines[_Z * _WIDE + t])
        sxx = _sum_columns(lines, _XX, t, side) + side * (lines[_W * _WIDE + t + 2] + lines[_W * _WIDE + t])
        sxx += 2.0 * side * (lines[_X * _WIDE + t + 2] - lines[_X * _WIDE + t])
        # Cramer on the 3 x 3 normal equations of height and two slopes.
        pxx = sxx + slope_weight
        pyy = syy + slope_weight
        pxz = sxz + slope_weight * slopes[t]
        pyz = syz + slope_weight * slopes[_RUN + t]
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
        solved[t] = a
        deviation = math.sqrt(max(squares, 0.0) / sw)
        independent = max(sw * sw / (sww * per_independent), sw / _sum_columns(lines, _POINTS, t, side))
        solved[_RUN + t] = max(deviation, least) / math.sqrt(independent)


@njit(nogil=True, cache=True)
def highest_of_blocks(heights: FloatArray) -> FloatArray:
    """Highest of the cells of each block of `_BLOCK` a side and of the cells around it; -inf where all are missing."""
    rows, columns = heights.shape
    highest = np.full(((rows + _BLOCK - 1) // _BLOCK, (columns + _BLOCK - 1) // _BLOCK), -np.inf, np.float32)
    for i in range(highest.shape[0]):
        for j in range(highest.shape[1]):
            largest = np.float32(-np.inf)
            for row in range(max(i * _BLOCK - 1, 0), min((i + 1) * _BLOCK + 1, rows)):
                for column in range(max(j * _BLOCK - 1, 0), min((j + 1) * _BLOCK + 1, columns)):
                    # A NaN here compares false.
                    if heights[row, column] > largest:
                        largest = heights[row, column]
            highest[i, j] = largest
    return highest


@njit(nogil=True, cache=True, inline="always")
def _steps_to_leave(place: float, cell: int, forward: bool, steps_per_cell: float) -> float:
    """Steps that a place in a cell needs to leave the block of cells."""
    inside = place - cell // _BLOCK * _BLOCK
    return (_BLOCK - inside if forward else inside) * steps_per_cell


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
    until it is above `top`; blocks of cells that lie below it are passed at once.
    """
    rows, columns = heights.shape
    highest = highest_of_blocks(heights)
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
            steps_c = reach / max(abs(move_c), _LEAST_MOVE)
            steps_r = reach / max(abs(move_r), _LEAST_MOVE)
            step = 1
            sight = height + rise
            while sight < top:
                c = column + step * rise * move_c
                r = row + step * rise * move_r
                if not (0.0 <= c < columns - 1 and 0.0 <= r < rows - 1):
                    break
                j = int(c)
                i = int(r)
                if highest[i // _BLOCK, j // _BLOCK] <= sight + tolerance:
                    stay = _steps_to_leave(c, j, move_c > 0.0, steps_c)
                    stay = min(stay, _steps_to_leave(r, i, move_r > 0.0, steps_r))
                    step += max(int(stay), 1)
                    sight = height + step * rise
                    continue
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
