"""Compiled loops of dense matching, the only module of the package that needs a compiler.

Two of them, the census transform and the semi-global passes, exist twice: in vector form, where the work of one pixel
is an `@intrinsic` that emits LLVM vector code over all its disparities, and as plain loops that say the same readably.
Both give the same bits. LLVM lowers the vector form to whatever the machine has, from SSE2 to AVX-512 and NEON.

How the semi-global passes stay quick: path costs are bytes, brought to minimum zero at every pixel, so that a path
never exceeds `large_step` + 62 and two of them add up within a byte; two sweeps of four paths each share one volume of
sums; the second sweep also finds the winner, the runner-up and the best match as the right picture sees it.

Numba's cache does not notice changes in other modules, so everything a kernel calls stands in this file.

References: [Hirschmuller2008] for the paths, [Zabih1994] for the census.
"""

# Compiled code has types of its own.
# mypy: disable-error-code="no-untyped-call,call-arg,arg-type,assignment,unreachable,var-annotated"
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

CENSUS_ROWS, CENSUS_COLUMNS = 7, 9
CENSUS_BITS = CENSUS_ROWS * CENSUS_COLUMNS - 1
PLANES = 8  # bytes that hold the bits
CENSUS_BLOCK = 32  # pixels that the vector census takes at once
HALF_ROWS, HALF_COLUMNS = CENSUS_ROWS // 2, CENSUS_COLUMNS // 2
CENTRE = HALF_ROWS * CENSUS_COLUMNS + HALF_COLUMNS

# No data looks equally unlike everything, itself in the other picture included: these two patterns differ in half their
# bits from each other and, on average, from any census.
LEFT_BLANK, RIGHT_BLANK = 0x55, 0x33

BELOW, BEST, ABOVE, RUNNER_UP = 0, 1, 2, 3  # layers of the costs that the passes leave for each pixel
UNKNOWN_COST = 65535

_I8, _I16, _I32, _I64 = ir.IntType(8), ir.IntType(16), ir.IntType(32), ir.IntType(64)


# --- vector code ------------------------------------------------------------------------------------------------------


class _Lanes:
    """Emits LLVM instructions on vectors of `count` integers of `width` bits."""

    def __init__(self, builder: Any, count: int, width: int) -> None:
        self.builder, self.count, self.width = builder, count, width
        self.element = ir.IntType(width)
        self.type = ir.VectorType(self.element, count)

    def load(self, address: Any) -> Any:
        return self.builder.load(self.builder.inttoptr(address, self.type.as_pointer()), align=1)

    def store(self, value: Any, address: Any) -> None:
        self.builder.store(value, self.builder.inttoptr(address, self.type.as_pointer()), align=1)

    def constant(self, value: int | Sequence[int]) -> Any:
        values = [value] * self.count if isinstance(value, int) else list(value)
        return ir.Constant(self.type, [self.element(v) for v in values])

    def splat(self, scalar: Any) -> Any:
        empty = ir.Constant(self.type, ir.Undefined)
        return _permuted(self.builder, self.builder.insert_element(empty, scalar, _I32(0)), empty, [0] * self.count)

    def lesser(self, a: Any, b: Any) -> Any:
        return self._call("umin", self.type, a, b)

    def saturating_sum(self, a: Any, b: Any) -> Any:
        return self._call("uadd.sat", self.type, a, b)

    def bits_set(self, a: Any) -> Any:
        return self._call("ctpop", self.type, a)

    def least(self, a: Any) -> Any:
        return self._call("vector.reduce.umin", self.element, a)

    def _call(self, name: str, result: Any, *arguments: Any) -> Any:
        signature = ir.FunctionType(result, [self.type] * len(arguments))
        function = cgutils.get_or_insert_function(
            self.builder.module, signature, f"llvm.{name}.v{self.count}i{self.width}"
        )
        return self.builder.call(function, arguments)


def _permuted(builder: Any, a: Any, b: Any, lanes: Sequence[int]) -> Any:
    """Lanes of a and b, counted through, in the order given."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, len(lanes)), [_I32(i) for i in lanes]))


def _emit_costs(builder: Any, count: int, left: Any, left_plane: Any, right: Any, right_plane: Any) -> Any:
    """Hamming distances between one left pixel and `count` neighbouring right pixels."""
    lanes = _Lanes(builder, count, 8)
    total = None
    for plane in range(PLANES):
        address = builder.add(left, builder.mul(left_plane, _I64(plane)))
        code = lanes.splat(builder.load(builder.inttoptr(address, _I8.as_pointer())))
        codes = lanes.load(builder.add(right, builder.mul(right_plane, _I64(plane))))
        distances = lanes.bits_set(builder.xor(code, codes))
        total = distances if total is None else builder.add(total, distances)
    return total


def _emit_paths(
    builder: Any, count: int, costs: Any, beside: Any, before: Sequence[Any], after: Any, small: Any, large: Any
) -> Any:
    """Carry four paths over one pixel, packed in one vector; returns their sum in 16 bits."""
    one, four, wide = _Lanes(builder, count, 8), _Lanes(builder, 4 * count, 8), _Lanes(builder, count, 16)
    total = 4 * count
    paths = [one.load(address) for address in (beside, *before)]
    pairs = [_permuted(builder, paths[i], paths[i + 1], range(2 * count)) for i in (0, 2)]
    packed = _permuted(builder, pairs[0], pairs[1], range(total))
    wall = four.constant(255)
    lower = _permuted(builder, packed, wall, [total if i % count == 0 else i - 1 for i in range(total)])
    upper = _permuted(builder, packed, wall, [total if i % count == count - 1 else i + 1 for i in range(total)])
    stepped = four.saturating_sum(four.lesser(lower, upper), four.splat(small))
    reached = four.lesser(four.lesser(packed, four.splat(large)), stepped)
    carried = builder.add(reached, _permuted(builder, costs, costs, list(range(count)) * 4))
    least, turn = carried, count // 2
    while turn:  # the minimum of each path ends up in all of its lanes
        turned = [(i // count) * count + (i % count + turn) % count for i in range(total)]
        least = four.lesser(least, _permuted(builder, least, least, turned))
        turn //= 2
    normalised = builder.sub(carried, least)
    targets = [beside, *(builder.add(after, _I64(i * count)) for i in range(3))]
    for i, address in enumerate(targets):
        one.store(_permuted(builder, normalised, normalised, range(i * count, (i + 1) * count)), address)
    halves = [_permuted(builder, carried, carried, range(i * 2 * count, (i + 1) * 2 * count)) for i in (0, 1)]
    summed = builder.add(*halves)  # at most 2 (large + 62) <= 254
    quarters = [_permuted(builder, summed, summed, range(i * count, (i + 1) * count)) for i in (0, 1)]
    return builder.add(*(builder.zext(quarter, wide.type) for quarter in quarters))


@intrinsic(prefer_literal=True)
def _carry_paths(
    _context: Any,
    count: Any,
    left: Any,
    left_plane: Any,
    right: Any,
    right_plane: Any,
    beside: Any,
    before_0: Any,
    before_1: Any,
    before_2: Any,
    after: Any,
    sums: Any,
    small: Any,
    large: Any,
) -> Any:
    """Carry four paths over one pixel; their sum goes to `sums`. All but the steps are addresses."""
    disparities = count.literal_value
    signature = types.void(count, *([types.int64] * 10), types.uint8, types.uint8)

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        _, left, left_plane, right, right_plane, beside, b0, b1, b2, after, sums, small, large = arguments
        costs = _emit_costs(builder, disparities, left, left_plane, right, right_plane)
        total = _emit_paths(builder, disparities, costs, beside, (b0, b1, b2), after, small, large)
        _Lanes(builder, disparities, 16).store(total, sums)
        return context.get_dummy_value()

    return signature, generate


@intrinsic(prefer_literal=True)
def _choose(
    _context: Any,
    count: Any,
    forward: Any,
    backward: Any,
    masks: Any,
    right_costs: Any,
    right_indices: Any,
) -> Any:
    """Winner + 65536 * cost of the runner-up at one pixel, whose `backward` sums become those of all eight paths.

    Lowers the costs of the right pixels that it could be matched with.
    """
    disparities = count.literal_value
    signature = types.int64(count, *([types.int64] * 5))

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        _, forward, backward, masks, right_costs, right_indices = arguments
        lanes = _Lanes(builder, disparities, 16)
        total = builder.add(lanes.load(forward), lanes.load(backward))
        lanes.store(total, backward)
        is_least = builder.icmp_unsigned("==", total, lanes.splat(lanes.least(total)))
        bits = ir.IntType(disparities)
        first_set = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(bits, [bits, ir.IntType(1)]), f"llvm.cttz.i{disparities}"
        )
        winner = builder.call(first_set, [builder.bitcast(is_least, bits), ir.IntType(1)(1)])
        if disparities < 64:
            winner = builder.zext(winner, _I64)
        mask = lanes.load(builder.add(masks, builder.mul(_I64(2), builder.sub(_I64(disparities), winner))))
        runner_up = builder.zext(lanes.least(builder.or_(total, mask)), _I64)
        old_costs, old_indices = lanes.load(right_costs), lanes.load(right_indices)
        is_lower = builder.icmp_unsigned("<", total, old_costs)
        lanes.store(lanes.lesser(total, old_costs), right_costs)
        lanes.store(builder.select(is_lower, lanes.constant(range(disparities)), old_indices), right_indices)
        return builder.or_(winner, builder.shl(runner_up, _I64(16)))

    return signature, generate


@intrinsic(prefer_literal=True)
def _census_block(_context: Any, source: Any, source_row: Any, target: Any, target_plane: Any) -> Any:
    """All planes of CENSUS_BLOCK pixels; `source` and `target` are the addresses of the first."""
    signature = types.void(*([types.int64] * 4))

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        source, source_row, target, target_plane = arguments
        lanes = _Lanes(builder, CENSUS_BLOCK, 8)

        def pixels(place: int) -> Any:
            row, column = divmod(place, CENSUS_COLUMNS)
            offset = builder.add(builder.mul(source_row, _I64(row - HALF_ROWS)), _I64(column - HALF_COLUMNS))
            return lanes.load(builder.add(source, offset))

        centre = pixels(CENTRE)
        places = [place for place in range(CENSUS_BITS + 1) if place != CENTRE]
        for plane in range(PLANES):
            code = lanes.constant(0)
            for bit, place in enumerate(places[8 * plane : 8 * plane + 8]):
                darker = builder.sext(builder.icmp_unsigned("<", pixels(place), centre), lanes.type)
                code = builder.or_(code, builder.and_(darker, lanes.constant(1 << bit)))
            lanes.store(code, builder.add(target, builder.mul(target_plane, _I64(plane))))
        return context.get_dummy_value()

    return signature, generate


# --- census -----------------------------------------------------------------------------------------------------------


@njit(nogil=True, cache=True)
def _clear_frame(planes: Any) -> None:
    """Zero where the window leaves the picture."""
    _, rows, columns = planes.shape
    planes[:, :HALF_ROWS] = 0
    planes[:, max(rows - HALF_ROWS, 0) :] = 0
    planes[:, :, :HALF_COLUMNS] = 0
    planes[:, :, max(columns - HALF_COLUMNS, 0) :] = 0


@njit(nogil=True, cache=True)
def blank_census(planes: Any, missing: Any, blank: int) -> None:
    """Put the blank pattern, cut to the bits that each plane really has, where data are missing."""
    _, rows, columns = planes.shape
    for plane in range(PLANES):
        pattern = np.uint8(blank & ((1 << min(8, CENSUS_BITS - 8 * plane)) - 1))
        for row in range(rows):
            for column in range(columns):
                if missing[row, column]:
                    planes[plane, row, column] = pattern


@njit(nogil=True, cache=True)
def census_vector(image: Any, planes: Any) -> None:
    """Census of a picture of at least CENSUS_BLOCK + 8 columns into planes (PLANES, rows, columns)."""
    rows, columns = image.shape
    source, target = image.ctypes.data, planes.ctypes.data
    last = columns - HALF_COLUMNS - CENSUS_BLOCK
    for row in range(HALF_ROWS, rows - HALF_ROWS):
        column = HALF_COLUMNS
        while column < columns - HALF_COLUMNS:
            place = row * columns + min(column, last)
            _census_block(source + place, columns, target + place, rows * columns)
            column += CENSUS_BLOCK
    _clear_frame(planes)


@njit(nogil=True, cache=True)
def census_plain(image: Any, planes: Any) -> None:
    """The same as `census_vector` in plain loops, for pictures of any size."""
    rows, columns = image.shape
    for row in range(HALF_ROWS, rows - HALF_ROWS):
        for column in range(HALF_COLUMNS, columns - HALF_COLUMNS):
            bit = 0
            code = 0
            for i in range(-HALF_ROWS, HALF_ROWS + 1):
                for j in range(-HALF_COLUMNS, HALF_COLUMNS + 1):
                    if i == 0 and j == 0:
                        continue
                    if image[row + i, column + j] < image[row, column]:
                        code |= 1 << (bit % 8)
                    bit += 1
                    if bit % 8 == 0 or bit == CENSUS_BITS:
                        planes[(bit - 1) // 8, row, column] = code
                        code = 0
    _clear_frame(planes)


# --- semi-global passes -----------------------------------------------------------------------------------------------


def vector_passes(disparities: int) -> Callable[..., None]:
    """Both semi-global sweeps for 32 or 64 disparities, in vector form.

    The function returned takes

    left_planes : (PLANES, rows, columns) census
    right_planes : (PLANES, rows, wider) census of a picture that goes on past the left one's sides
    offset : column of the right picture that belongs to left column 0 and the first disparity
    small_step, large_step : penalties of a change by one and by more; large_step + 62 <= 127
    volume : (rows, columns, disparities) uint16, overwritten

    and fills

    winners : (rows, columns) uint8, index of the cheapest disparity
    costs : (rows, columns, 4) uint16, at the winner's lower neighbour, at the winner, at its upper neighbour
        (UNKNOWN_COST beyond the range), and the least of all the others
    right_winners : (rows, columns + disparities) uint8, cheapest index for right column offset + j
    """

    @njit(nogil=True, cache=True, boundscheck=False)
    def passes(
        left_planes: Any,
        right_planes: Any,
        offset: int,
        small_step: int,
        large_step: int,
        volume: Any,
        winners: Any,
        costs: Any,
        right_winners: Any,
    ) -> None:
        _, rows, columns = left_planes.shape
        right_columns = right_planes.shape[2]
        states = np.empty((2, columns + 2, 3 * disparities), np.uint8)
        beside = np.empty(disparities, np.uint8)
        totals = np.full(disparities + 2, UNKNOWN_COST, np.uint16)
        masks = np.zeros(2 * disparities + 1, np.uint16)
        masks[disparities - 1 : disparities + 2] = UNKNOWN_COST
        right_costs = np.empty(columns + disparities, np.uint16)
        right_indices = np.empty(columns + disparities, np.uint16)
        left_address, right_address = left_planes.ctypes.data, right_planes.ctypes.data
        states_address, beside_address, volume_address = states.ctypes.data, beside.ctypes.data, volume.ctypes.data
        totals_address, masks_address = totals.ctypes.data + 2, masks.ctypes.data
        right_costs_address, right_indices_address = right_costs.ctypes.data, right_indices.ctypes.data
        small, large = np.uint8(small_step), np.uint8(large_step)
        entry = 3 * disparities
        line = (columns + 2) * entry
        for sweep in range(2):
            step = 1 - 2 * sweep
            states[:] = 0
            for i in range(rows):
                row = i if sweep == 0 else rows - 1 - i
                beside[:] = 0
                right_costs[:] = UNKNOWN_COST
                right_indices[:] = 0
                last = states_address + (i & 1) * line
                this = states_address + (1 - (i & 1)) * line
                for j in range(columns):
                    column = j if sweep == 0 else columns - 1 - j
                    state = (column + 1) * entry
                    sums = volume_address + (row * columns + column) * 2 * disparities
                    _carry_paths(
                        disparities,
                        left_address + row * columns + column,
                        rows * columns,
                        right_address + row * right_columns + offset + column,
                        rows * right_columns,
                        beside_address,
                        last + state - step * entry,
                        last + state + disparities,
                        last + state + 2 * disparities + step * entry,
                        this + state,
                        sums if sweep == 0 else totals_address,
                        small,
                        large,
                    )
                    if sweep == 0:
                        continue
                    found = _choose(
                        disparities,
                        sums,
                        totals_address,
                        masks_address,
                        right_costs_address + 2 * column,
                        right_indices_address + 2 * column,
                    )
                    winner = found & 0xFFFF
                    winners[row, column] = winner
                    costs[row, column, BELOW] = totals[winner]
                    costs[row, column, BEST] = totals[winner + 1]
                    costs[row, column, ABOVE] = totals[winner + 2]
                    costs[row, column, RUNNER_UP] = found >> 16
                if sweep == 1:
                    for j in range(columns + disparities):
                        right_winners[row, j] = right_indices[j]

    return passes


@njit(nogil=True, cache=True, inline="always")
def _bits_set(byte: int) -> int:
    byte = byte - ((byte >> 1) & 0x55)
    byte = (byte & 0x33) + ((byte >> 2) & 0x33)
    return (byte + (byte >> 4)) & 0x0F


@njit(nogil=True, cache=True)
def _carry_path(before: Any, costs: Any, small: int, large: int, after: Any, sums: Any) -> None:
    """One path over one pixel ([Hirschmuller2008] eq. 13); `after` may be `before`."""
    disparities = len(costs)
    carried = np.empty(disparities, np.int64)
    for d in range(disparities):
        reached = min(np.int64(before[d]), large)
        if d > 0:
            reached = min(reached, np.int64(before[d - 1]) + small)
        if d < disparities - 1:
            reached = min(reached, np.int64(before[d + 1]) + small)
        carried[d] = reached + costs[d]
    least = carried.min()
    for d in range(disparities):
        after[d] = carried[d] - least
        sums[d] += carried[d]


@njit(nogil=True, cache=True)
def plain_passes(
    left_planes: Any,
    right_planes: Any,
    offset: int,
    small_step: int,
    large_step: int,
    volume: Any,
    winners: Any,
    costs: Any,
    right_winners: Any,
) -> None:
    """The same as `vector_passes` in plain loops, for any number of disparities."""
    _, rows, columns = left_planes.shape
    disparities = volume.shape[2]
    states = np.zeros((2, columns + 2, 3, disparities), np.uint8)
    beside = np.zeros(disparities, np.uint8)
    cost = np.empty(disparities, np.int64)
    right_costs = np.empty(columns + disparities, np.uint16)
    for sweep in range(2):
        step = 1 - 2 * sweep
        states[:] = 0
        for i in range(rows):
            row = i if sweep == 0 else rows - 1 - i
            beside[:] = 0
            if sweep == 1:
                right_costs[:] = UNKNOWN_COST
                right_winners[row] = 0
            last, this = states[i & 1], states[1 - (i & 1)]
            for j in range(columns):
                column = j if sweep == 0 else columns - 1 - j
                cost[:] = 0
                for plane in range(PLANES):
                    code = left_planes[plane, row, column]
                    for d in range(disparities):
                        cost[d] += _bits_set(np.int64(code ^ right_planes[plane, row, offset + column + d]))
                sums = volume[row, column]
                if sweep == 0:
                    sums[:] = 0
                _carry_path(beside, cost, small_step, large_step, beside, sums)
                for path in range(3):
                    neighbour = last[column + 1 + (path - 1) * step, path]
                    _carry_path(neighbour, cost, small_step, large_step, this[column + 1, path], sums)
                if sweep == 0:
                    continue
                winner = 0
                for d in range(disparities):
                    if sums[d] < sums[winner]:
                        winner = d
                runner_up = UNKNOWN_COST
                for d in range(disparities):
                    if abs(d - winner) > 1:
                        runner_up = min(runner_up, np.int64(sums[d]))
                winners[row, column] = winner
                costs[row, column, BELOW] = sums[winner - 1] if winner > 0 else UNKNOWN_COST
                costs[row, column, BEST] = sums[winner]
                costs[row, column, ABOVE] = sums[winner + 1] if winner < disparities - 1 else UNKNOWN_COST
                costs[row, column, RUNNER_UP] = runner_up
                for d in range(disparities):
                    if sums[d] < right_costs[column + d]:
                        right_costs[column + d] = sums[d]
                        right_winners[row, column + d] = d


# --- from winners to disparities --------------------------------------------------------------------------------------


@njit(nogil=True, cache=True)
def select(
    winners: Any,
    costs: Any,
    right_winners: Any,
    prior: Any,
    right_flags: Any,
    inconsistent_flag: int,
    edge_flag: int,
    disparity: Any,
    flags: Any,
    confidence: Any,
) -> None:
    """Sub-pixel winner, left-right check, flags of the matched right pixel, and the prior put back.

    prior and right_flags are wider than the left picture by the same number of columns on both sides. With k the
    disparity that was left over, d(x) = k + prior(x + k). Between whole disparities the cost is taken to fall and rise
    with equal slopes, as sums of Hamming distances do; a parabola more than doubles the noise of smooth ground.
    """
    rows, columns = winners.shape
    margin = (prior.shape[1] - columns) // 2
    disparities = right_winners.shape[1] - columns
    half = disparities // 2
    for row in range(rows):
        for column in range(columns):
            winner = np.int64(winners[row, column])
            best = np.float32(costs[row, column, BEST])
            flag = flags[row, column]
            fraction = np.float32(0)
            if winner == 0 or winner == disparities - 1:
                flag |= edge_flag
            else:
                below = np.float32(costs[row, column, BELOW]) - best
                above = np.float32(costs[row, column, ABOVE]) - best
                steeper = max(below, above)
                if steeper > 0:
                    fraction = np.float32(0.5) * (below - above) / steeper
            if abs(np.int64(right_winners[row, column + winner]) - winner) > 1:
                flag |= inconsistent_flag
            is_before = int(fraction < 0)
            start = column + margin + winner - half - is_before
            weight = fraction + np.float32(is_before)
            before, after = prior[row, start], prior[row, start + 1]
            nearest = start + int(weight >= np.float32(0.5))
            flags[row, column] = flag | right_flags[row, nearest]
            disparity[row, column] = np.float32(winner - half) + fraction + before + weight * (after - before)
            runner_up = np.float32(costs[row, column, RUNNER_UP])
            confidence[row, column] = np.uint8(np.float32(255) * (runner_up - best) / (runner_up + np.float32(0.001)))


# --- what pictures and disparity maps decide alone -------------------------------------------------------------------


@njit(nogil=True, cache=True)
def flag_windows(
    image: Any, half: int, least_sd: float, saturated_from: int, flat_flag: int, saturated_flag: int, flags: Any
) -> None:
    """Add the flags of windows of 2 half + 1 pixels a side with little texture, and of mostly saturated ones.

    Windows are cut at the picture's edges. Integers of 32 bits hold windows of up to 11 pixels a side.
    """
    rows, columns = image.shape
    # Sums down the window's height, with nothing beside the picture. The count of saturated pixels rides on the sum of
    # grey values, 65536 times.
    sums = np.zeros(columns + 2 * half, np.int32)
    squares = np.zeros(columns + 2 * half, np.int32)
    total = np.empty(columns, np.int32)
    square = np.empty(columns, np.int32)
    widths = np.empty(columns, np.int32)
    for column in range(columns):
        widths[column] = min(column + half, columns - 1) - max(column - half, 0) + 1
    least_variance = np.float32(least_sd * least_sd)
    for row in range(-half, rows):
        if row + half < rows:
            _add_line(image[row + half], np.int32(1), saturated_from, sums[half:], squares[half:])
        if row - half - 1 >= 0:
            _add_line(image[row - half - 1], np.int32(-1), saturated_from, sums[half:], squares[half:])
        if row < 0:
            continue
        total[:] = 0
        square[:] = 0
        for shift in range(2 * half + 1):
            for column in range(columns):
                total[column] += sums[column + shift]
            for column in range(columns):
                square[column] += squares[column + shift]
        height = np.int32(min(row + half, rows - 1) - max(row - half, 0) + 1)
        for column in range(columns):
            size = np.int32(height * widths[column])
            bright = np.int32(total[column] >> np.int32(16))
            grey = np.int32(total[column] & np.int32(0xFFFF))
            scatter = np.int32(np.int32(square[column] * size) - np.int32(grey * grey))  # size^2 times the variance
            is_flat = np.float32(scatter) < least_variance * np.float32(np.int32(size * size))
            is_bright = np.int32(bright + bright) > size
            flag = (np.uint8(flat_flag) if is_flat else np.uint8(0)) | (
                np.uint8(saturated_flag) if is_bright else np.uint8(0)
            )
            flags[row, column] |= flag


@njit(nogil=True, cache=True, inline="always")
def _add_line(line: Any, sign: int, saturated_from: int, sums: Any, squares: Any) -> None:
    """Add (or take away) a line of grey values, and their squares."""
    for column in range(len(line)):
        value = np.int32(line[column])
        bright = np.int32(65536) if line[column] >= saturated_from else np.int32(0)
        sums[column] += np.int32(sign * np.int32(value + bright))
        squares[column] += np.int32(sign * np.int32(value * value))


@njit(nogil=True, cache=True)
def correlate_windows(left: Any, right: Any, half: int, least_variance: float, found: Any) -> None:
    """Normalised correlation of two pictures in the windows of 2 half + 1 pixels a side about every pixel.

    Windows are cut at the picture's edges. Grey values are counted from mid-grey, so that integers of 32 bits hold
    windows of up to 15 pixels a side exactly. least_variance: geometric mean of the variances from which it counts.
    """
    rows, columns = left.shape
    sums = np.zeros((5, columns + 2 * half), np.int32)  # down the window's height, with nothing beside the picture
    totals = np.empty((5, columns), np.int32)
    widths = np.empty(columns, np.int32)
    for column in range(columns):
        widths[column] = min(column + half, columns - 1) - max(column - half, 0) + 1
    least = np.float32(least_variance * least_variance)
    for row in range(-half, rows):
        if row + half < rows:
            _add_products(left[row + half], right[row + half], np.int32(1), sums[:, half:])
        if row - half - 1 >= 0:
            _add_products(left[row - half - 1], right[row - half - 1], np.int32(-1), sums[:, half:])
        if row < 0:
            continue
        for i in range(5):
            line, total = sums[i], np.int32(0)
            for column in range(2 * half):
                total = np.int32(total + line[column])
            for column in range(columns):
                total = np.int32(total + line[column + 2 * half])
                totals[i, column] = total
                total = np.int32(total - line[column])
        height = np.int32(min(row + half, rows - 1) - max(row - half, 0) + 1)
        a, b, aa, bb, ab = totals[0], totals[1], totals[2], totals[3], totals[4]
        for column in range(columns):
            size = np.int32(height * widths[column])
            covariance = np.int32(np.int32(size * ab[column]) - np.int32(a[column] * b[column]))  # size^2 times it
            one = np.int32(np.int32(size * aa[column]) - np.int32(a[column] * a[column]))
            other = np.int32(np.int32(size * bb[column]) - np.int32(b[column] * b[column]))
            area = np.float32(np.int32(size * size))
            variances = max(np.float32(one) * np.float32(other), least * area * area)
            found[row, column] = np.float32(covariance) / np.sqrt(variances)


@njit(nogil=True, cache=True, inline="always")
def _add_products(left: Any, right: Any, sign: int, sums: Any) -> None:
    """Add (or take away) a line of grey values, their squares and their products."""
    for column in range(len(left)):
        a = np.int32(np.int32(left[column]) - np.int32(128))
        b = np.int32(np.int32(right[column]) - np.int32(128))
        sums[0, column] += np.int32(sign * a)
        sums[1, column] += np.int32(sign * b)
        sums[2, column] += np.int32(sign * np.int32(a * a))
        sums[3, column] += np.int32(sign * np.int32(b * b))
        sums[4, column] += np.int32(sign * np.int32(a * b))


@njit(nogil=True, cache=True)
def _root(parents: Any, run: int) -> int:
    """Representative of the island that a run belongs to; shortens the way there."""
    while parents[run] != run:
        parents[run] = parents[parents[run]]
        run = parents[run]
    return run


@njit(nogil=True, cache=True)
def islands(disparity: Any, step: float, largest: int, found: Any) -> None:
    """Set `found` where a disparity belongs to an island of at most `largest` pixels.

    Neighbours left, right, above and below hang together where they differ by at most `step`. Runs along rows are
    joined, which takes one look at each pixel and few joins.
    """
    rows, columns = disparity.shape
    step = np.float32(step)
    runs = np.empty((rows, columns), np.int32)
    parents = np.empty(rows * columns, np.int32)
    sizes = np.empty(rows * columns, np.int32)
    count = 0
    for row in range(rows):
        joined = -1  # the run above that this run was joined with last
        for column in range(columns):
            value = disparity[row, column]
            if np.isnan(value):
                runs[row, column] = -1
                continue
            if column > 0 and abs(value - disparity[row, column - 1]) <= step:
                run = runs[row, column - 1]
                sizes[run] += 1
            else:
                run = count
                parents[run] = run
                sizes[run] = 1
                count += 1
                joined = -1
            runs[row, column] = run
            if row > 0 and abs(value - disparity[row - 1, column]) <= step and runs[row - 1, column] != joined:
                joined = runs[row - 1, column]
                one, other = _root(parents, run), _root(parents, joined)
                parents[max(one, other)] = min(one, other)
    for run in range(count - 1, -1, -1):  # a root is the first run of its island
        root = _root(parents, run)
        if root != run:
            sizes[root] += sizes[run]
    for run in range(count):
        sizes[run] = sizes[parents[run]] if parents[run] != run else sizes[run]
    for row in range(rows):
        for column in range(columns):
            run = runs[row, column]
            found[row, column] = run >= 0 and sizes[run] <= largest


# --- resampling and filling -------------------------------------------------------------------------------------------


@njit(nogil=True, cache=True)
def warp_maps(
    prior: Any,
    field: Any,
    field_place: Any,
    scale: float,
    offset_x: float,
    offset_y: float,
    map_x: Any,
    map_y: Any,
) -> None:
    """Where each pixel of the resampled right picture is read: one prior aside and one field value down.

    field_place: node row and column of pixel (0, 0), then nodes per row and per column; between nodes the field is
    bilinear, beyond them constant. scale: pixels of this level in one of the field's.
    """
    row_start, column_start, row_step, column_step = field_place
    rows, columns = prior.shape
    field_rows, field_columns = field.shape
    line = np.empty(field_columns, np.float32)
    for row in range(rows):
        x = np.float32(offset_x)
        for column in range(columns):
            map_x[row, column] = (x + np.float32(column)) + prior[row, column]
        y = np.float32(offset_y + row)
        first, weight = _node(row_start + row * row_step, field_rows)
        second = min(first + 1, field_rows - 1)
        for j in range(field_columns):
            line[j] = y + np.float32(scale) * (field[first, j] + weight * (field[second, j] - field[first, j]))
        if field_columns == 1:
            map_y[row] = line[0]
            continue
        for column in range(columns):
            first, weight = _node(column_start + column * column_step, field_columns)
            map_y[row, column] = line[first] + weight * (line[first + 1] - line[first])


@njit(nogil=True, cache=True, inline="always")
def _node(place: float, count: int) -> tuple[int, np.float32]:
    """Node before a place among `count` nodes, and how far on the way to the next it lies; constant beyond the ends."""
    place = min(max(place, 0.0), count - 1.0)
    first = min(int(place), max(count - 2, 0))
    return first, np.float32(place - first)


@njit(nogil=True, cache=True)
def halve(values: Any) -> tuple[Any, int]:
    """Means of the finite values of every 2 x 2 block, NaN where there is none, and how many are NaN."""
    rows, columns = values.shape
    coarse = np.empty(((rows + 1) // 2, (columns + 1) // 2), np.float32)
    totals = np.empty(columns + 1, np.float32)
    counts = np.empty(columns + 1, np.float32)
    missing = 0
    for i in range(coarse.shape[0]):
        totals[:] = 0
        counts[:] = 0
        for row in range(2 * i, min(2 * i + 2, rows)):
            for column in range(columns):
                value = values[row, column]
                given = value == value
                totals[column] += value if given else np.float32(0)
                counts[column] += np.float32(1) if given else np.float32(0)
        for j in range(coarse.shape[1]):
            count = counts[2 * j] + counts[2 * j + 1]
            missing += count == 0
            coarse[i, j] = (totals[2 * j] + totals[2 * j + 1]) / count if count > 0 else np.float32(np.nan)
    return coarse, missing


@njit(nogil=True, cache=True)
def fill_from(values: Any, coarse: Any) -> None:
    """Put the bilinear value of the half-size `coarse` where `values` is NaN, in place."""
    rows, columns = values.shape
    coarse_rows, coarse_columns = coarse.shape
    half, one = np.float32(0.5), np.float32(1)
    for row in range(rows):
        y = (row - half) * half
        top = int(np.floor(y))
        v = np.float32(y - top)
        bottom = min(top + 1, coarse_rows - 1)
        top = max(top, 0)
        for column in range(columns):
            if not np.isnan(values[row, column]):
                continue
            x = (column - half) * half
            left = int(np.floor(x))
            u = np.float32(x - left)
            right = min(left + 1, coarse_columns - 1)
            left = max(left, 0)
            values[row, column] = (one - v) * ((one - u) * coarse[top, left] + u * coarse[top, right]) + v * (
                (one - u) * coarse[bottom, left] + u * coarse[bottom, right]
            )


@njit(nogil=True, cache=True)
def claim_columns(disparity: Any, support: Any, width: int, apart: int, lost: Any) -> None:
    """Mark matches whose right pixel is better matched with a left pixel that lies elsewhere.

    disparity : (rows, columns), NaN where there is none
    support : (rows, columns) uint8, the weight of each claim
    width : columns of the right picture
    apart : two left pixels at most so far apart may share a right one, as foreshortened slopes do
    lost : (rows, columns) bool, filled
    """
    rows, columns = disparity.shape
    best = np.empty(width + 2, np.uint8)
    claimant = np.empty(width + 2, np.int64)
    for row in range(rows):
        best[:] = 0
        for column in range(columns):
            value = disparity[row, column]
            lost[row, column] = False
            if np.isnan(value):
                continue
            place = int(np.rint(column + value)) + 1
            if 0 < place <= width and support[row, column] > best[place]:
                best[place] = support[row, column]
                claimant[place] = column
        for column in range(columns):
            value = disparity[row, column]
            if np.isnan(value):
                continue
            place = min(max(int(np.rint(column + value)) + 1, 1), width)
            for near in range(place - 1, place + 2):
                if best[near] > support[row, column] and abs(claimant[near] - column) > apart:
                    lost[row, column] = True
