"""Compiled loops of dense matching, the only module of the package that needs a compiler.

Three of them, the census transform, the semi-global passes and the resampling, exist twice: in vector form, an
`@intrinsic` that emits LLVM vector code over many pixels or disparities at once, and as plain loops that say the same
readably. Both give the same bits. LLVM lowers the vector form to whatever the machine has, from SSE2 to AVX-512 and
NEON.

How the semi-global passes stay quick: path costs are bytes, brought to minimum zero at every pixel, so that a path
never exceeds `large_step` + 62 and two of them add up within a byte. The first of two sweeps of four paths each leaves
the costs and its sums, as bytes above their least. The second finds winner, runner-up and the best match as the right
picture sees it, by words that hold cost and disparity, so that one minimum gives both. A row is one loop of vector
code, which keeps the path along the row and the right picture's best in registers.

Numba's cache does not notice changes in other modules, so everything a kernel calls stands in this file.

References: [Hirschmuller2008] for the paths, [Zabih1994] for the census.
"""

# Compiled code has types of its own.
# mypy: disable-error-code="no-untyped-call,call-arg,arg-type,assignment,unreachable,var-annotated,no-any-return"
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
PLANES = 4  # words of 16 bits that hold the bits
CENSUS_BLOCK = 64  # pixels that the vector census takes at once
SAMPLE_BLOCK = 16  # pixels that the vector resampling takes at once
RIM = 4  # zeros around a picture that is resampled: what is read at once reaches so far
HALF_ROWS, HALF_COLUMNS = CENSUS_ROWS // 2, CENSUS_COLUMNS // 2
CENTRE = HALF_ROWS * CENSUS_COLUMNS + HALF_COLUMNS
TEXTURED = 9  # side of the window in which texture is measured
CORRELATED = 15  # side of the window in which pictures must look alike, a multiple of three
MID_GREY = 128

# No data looks equally unlike everything, itself in the other picture included: these two patterns differ in half their
# bits from each other and, on average, from any census.
LEFT_BLANK, RIGHT_BLANK = 0x5555, 0x3333

BELOW, BEST, ABOVE, RUNNER_UP = 0, 1, 2, 3  # layers of the costs that the passes leave for each pixel
UNKNOWN_COST = 65535

_REGISTER = 64  # bytes of the vectors in which paths are carried
_I8, _I16, _I32, _I64 = ir.IntType(8), ir.IntType(16), ir.IntType(32), ir.IntType(64)
_F32 = ir.FloatType()


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
    """Hamming distances between one left pixel, its words doubled, and `count` neighbouring right pixels."""
    lanes, pairs = _Lanes(builder, count, 16), _Lanes(builder, count // 2, 32)
    total = None
    for plane in range(PLANES):
        address = builder.add(left, builder.mul(left_plane, _I64(plane)))
        code = builder.load(builder.inttoptr(address, _I32.as_pointer()), align=4)
        codes = lanes.load(builder.add(right, builder.mul(right_plane, _I64(plane))))
        distances = lanes.bits_set(builder.xor(builder.bitcast(pairs.splat(code), lanes.type), codes))
        total = distances if total is None else builder.add(total, distances)
    return builder.trunc(total, ir.VectorType(_I8, count))


def _emit_least(builder: Any, count: int, paths: Sequence[Any]) -> tuple[Any, list[Any]]:
    """Least value of each of four paths: in the four quarters of one vector, and spread like the paths."""
    lanes = _Lanes(builder, _REGISTER, 8)
    half = _REGISTER // 2
    if count == _REGISTER:
        paths = [
            lanes.lesser(
                _permuted(builder, a, b, [*range(half), *range(2 * half, 3 * half)]),
                _permuted(builder, a, b, [*range(half, 2 * half), *range(3 * half, 4 * half)]),
            )
            for a, b in (paths[:2], paths[2:])
        ]
    folded = [
        _permuted(builder, *paths, [32 * path + 16 * part + i for path in range(4) for i in range(16)])
        for part in range(2)
    ]
    least = lanes.lesser(*folded)
    least = lanes.lesser(least, _permuted(builder, least, least, [i ^ 8 for i in range(_REGISTER)]))
    for width, places in ((64, 32), (32, 16), (32, 8)):  # turning words is cheaper than moving bytes
        least = lanes.lesser(least, builder.bitcast(_turned(builder, least, width, places), lanes.type))
    quarters = [[path] * (count // 16) for path in range(4)]
    order = [quarter for path in quarters for quarter in path]
    lanes_of = [[16 * quarter + i for i in range(16)] for quarter in order]
    per_vector = _REGISTER // 16
    spread = [
        _permuted(builder, least, least, sum(lanes_of[start : start + per_vector], []))
        for start in range(0, len(order), per_vector)
    ]
    return least, spread


def _turned(builder: Any, vector: Any, width: int, places: int) -> Any:
    """The words of `width` bits of a vector, each turned left."""
    words = _Lanes(builder, 8 * _REGISTER // width, width)
    signature = ir.FunctionType(words.type, [words.type] * 3)
    turn = cgutils.get_or_insert_function(builder.module, signature, f"llvm.fshl.v{words.count}i{width}")
    whole = builder.bitcast(vector, words.type)
    return builder.call(turn, [whole, whole, words.constant(places)])


def _emit_paths(
    builder: Any, count: int, paths: Sequence[Any], costs: Any, small: Any, large: Any, above: Any
) -> list[Any]:
    """Carry four paths over one pixel; `costs` and paths lie in vectors of _REGISTER bytes.

    above : what the last vector is to be taken down by, so that the least of each of its paths is 0
    """
    lanes = _Lanes(builder, _REGISTER, 8)
    places = range(_REGISTER)
    carried = []
    for path in paths:
        # At either end of the range a disparity is its own neighbour, a step from which never pays.
        lower = _permuted(builder, path, path, [i if i % count == 0 else i - 1 for i in places])
        upper = _permuted(builder, path, path, [i if i % count == count - 1 else i + 1 for i in places])
        stepped = builder.add(lanes.lesser(lower, upper), lanes.splat(small))  # at most 127 + 65
        reached = lanes.lesser(path, stepped)
        if path is paths[-1]:
            reached = builder.sub(reached, above)
        carried.append(builder.add(lanes.lesser(reached, lanes.splat(large)), costs))
    return carried


def _emit_row(
    builder: Any, count: int, columns: Any, states: Any, down: bool, small: Any, large: Any, pixel: Any
) -> None:
    """Loop over a row, carrying four paths: beside, kept in registers, and three from the row before.

    `states` is the address of slots of four paths for each column and one more at both ends. A slot holds what the row
    before sends to its pixel: the state is put into the slot of the pixel that it goes to. pixel(column) gives the
    costs and takes carried, normalised and least.
    """
    lanes = _Lanes(builder, _REGISTER, 8)
    half = _REGISTER // 2
    vectors = 4 * count // _REGISTER
    step = 1 if down else -1
    waiting = cgutils.alloca_once_value(builder, lanes.constant(0))  # goes into the next slot once that is read
    # The last vector of the pixel before, and by how much its path beside lies above 0. It is taken down late, when the
    # least of it is known: nothing else waits for what is found out from pixel to pixel.
    beside = cgutils.alloca_once_value(builder, lanes.constant(0))
    above = cgutils.alloca_once_value(builder, lanes.constant(0))
    with cgutils.for_range(builder, columns) as loop:
        column = loop.index if down else builder.sub(builder.sub(columns, _I64(1)), loop.index)
        slot = builder.add(states, builder.mul(builder.add(column, _I64(1)), _I64(4 * count)))
        paths = [lanes.load(builder.add(slot, _I64(i * _REGISTER))) for i in range(vectors - 1)]
        if count == _REGISTER:
            paths.append(builder.load(beside))
        else:
            third = _Lanes(builder, half, 8).load(builder.add(slot, _I64(_REGISTER)))
            third = _permuted(builder, third, third, range(_REGISTER))
            paths.append(_permuted(builder, third, builder.load(beside), [*range(half), *range(3 * half, 4 * half)]))
        costs, finish = pixel(column)
        carried = _emit_paths(builder, count, paths, costs, small, large, builder.load(above))
        least, spread = _emit_least(builder, count, carried)
        normalised = [builder.sub(a, b) for a, b in zip(carried, spread, strict=True)]
        one = _Lanes(builder, count, 8)

        def path(vectors: Sequence[Any], i: int) -> Any:
            at = i * count
            vector = vectors[at // _REGISTER]
            return _permuted(builder, vector, vector, range(at % _REGISTER, at % _REGISTER + count))

        one.store(path([builder.load(waiting)], 0), slot)
        builder.store(normalised[0], waiting)
        one.store(path(normalised, 1), builder.add(slot, _I64(count)))
        one.store(path(normalised, 2), builder.add(slot, _I64(2 * count - step * 4 * count)))
        builder.store(carried[-1], beside)
        mine = range(_REGISTER, 2 * _REGISTER) if count == _REGISTER else [*range(half), *range(3 * half, 4 * half)]
        builder.store(_permuted(builder, lanes.constant(0), spread[-1], mine), above)
        finish(carried, normalised, least)


def _halves(builder: Any, vector: Any) -> tuple[Any, Any]:
    half = _REGISTER // 2
    return _permuted(builder, vector, vector, range(half)), _permuted(builder, vector, vector, range(half, 2 * half))


@intrinsic(prefer_literal=True)
def _sweep_down(
    _context: Any,
    count: Any,
    columns: Any,
    left: Any,
    left_plane: Any,
    right: Any,
    right_plane: Any,
    states: Any,
    costs: Any,
    sums: Any,
    leasts: Any,
    small: Any,
    large: Any,
) -> Any:
    """One row of the first sweep: costs, sums of the four paths above their least, and the sum of the four leasts.

    All but the numbers of disparities and columns and the steps are addresses, or bytes from plane to plane.
    """
    disparities = count.literal_value
    signature = types.void(count, *([types.int64] * 9), types.uint8, types.uint8)

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        _, columns, left, left_plane, right, right_plane, states, costs, sums, leasts, small, large = arguments
        one = _Lanes(builder, disparities, 8)

        def pixel(column: Any) -> Any:
            cost = _emit_costs(
                builder,
                disparities,
                builder.add(left, builder.mul(column, _I64(4))),
                left_plane,
                builder.add(right, builder.mul(column, _I64(2))),
                right_plane,
            )
            at = builder.mul(column, _I64(disparities))
            one.store(cost, builder.add(costs, at))
            repeated = _permuted(builder, cost, cost, [i % disparities for i in range(_REGISTER)])

            def finish(_carried: Any, normalised: Any, least: Any) -> None:
                if disparities == _REGISTER:
                    parts = builder.add(normalised[0], normalised[1]), builder.add(normalised[2], normalised[3])
                else:
                    parts = _halves(builder, builder.add(*normalised))
                one.store(one.saturating_sum(*parts), builder.add(sums, at))
                four = builder.bitcast(_permuted(builder, least, least, [0, 16, 32, 48]), _I32)
                even = builder.and_(four, _I32(0x00FF00FF))
                odd = builder.and_(builder.lshr(four, _I32(8)), _I32(0x00FF00FF))
                pairs = builder.add(even, odd)
                both = builder.add(pairs, builder.or_(builder.lshr(pairs, _I32(16)), builder.shl(pairs, _I32(16))))
                address = builder.add(leasts, builder.mul(column, _I64(4)))
                builder.store(both, builder.inttoptr(address, _I32.as_pointer()), align=4)

            return repeated, finish

        _emit_row(builder, disparities, columns, states, True, small, large, pixel)
        return context.get_dummy_value()

    return signature, generate


@intrinsic(prefer_literal=True)
def _sweep_up(
    _context: Any,
    count: Any,
    columns: Any,
    states: Any,
    costs: Any,
    sums: Any,
    leasts: Any,
    masks: Any,
    keys: Any,
    right_keys: Any,
    winners: Any,
    found: Any,
    small: Any,
    large: Any,
) -> Any:
    """One row of the second sweep: winners, their costs and those around them, keys of the right pixels.

    A key is a cost times the number of disparities, plus the disparity: the least key tells both.
    """
    disparities = count.literal_value
    bits = disparities.bit_length() - 1
    signature = types.void(count, *([types.int64] * 10), types.uint8, types.uint8)

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        _, columns, states, costs, sums, leasts, masks, keys, right_keys, winners, found, small, large = arguments
        one, wide = _Lanes(builder, disparities, 8), _Lanes(builder, disparities, 16)
        pairs = _Lanes(builder, disparities // 2, 32)
        best_right = cgutils.alloca_once_value(builder, wide.constant(UNKNOWN_COST))

        def pixel(column: Any) -> Any:
            at = builder.mul(column, _I64(disparities))
            cost = one.load(builder.add(costs, at))
            repeated = _permuted(builder, cost, cost, [i % disparities for i in range(_REGISTER)])

            def finish(carried: Any, _normalised: Any, _least: Any) -> None:
                if disparities == _REGISTER:
                    parts = builder.add(carried[0], carried[1]), builder.add(carried[2], carried[3])
                else:
                    parts = _halves(builder, builder.add(*carried))  # at most 2 (large + 62) <= 254
                total = builder.add(*(builder.zext(part, wide.type) for part in parts))
                total = builder.add(total, builder.zext(one.load(builder.add(sums, at)), wide.type))
                address = builder.add(leasts, builder.mul(column, _I64(4)))
                both = builder.load(builder.inttoptr(address, _I32.as_pointer()), align=4)
                total = builder.add(total, builder.bitcast(pairs.splat(both), wide.type))
                key = builder.or_(builder.shl(total, wide.constant(bits)), wide.constant(range(disparities)))
                wide.store(key, keys)
                lowest = builder.zext(wide.least(key), _I64)
                winner = builder.and_(lowest, _I64(disparities - 1))
                mask = wide.load(builder.add(masks, builder.mul(_I64(2), builder.sub(_I64(disparities), winner))))
                runner_up = builder.zext(wide.least(builder.or_(key, mask)), _I64)

                shifted = builder.load(best_right)
                shifted = _permuted(builder, shifted, shifted, [max(i - 1, 0) for i in range(disparities)])
                fresh = wide.constant([UNKNOWN_COST] + [0] * (disparities - 1))
                best = wide.lesser(builder.or_(shifted, fresh), key)
                builder.store(best, best_right)
                wide.store(best, builder.add(right_keys, builder.mul(column, _I64(2))))

                address = builder.add(winners, column)
                builder.store(builder.trunc(winner, _I8), builder.inttoptr(address, _I8.as_pointer()))
                place = builder.add(keys, builder.mul(winner, _I64(2)))
                addresses = [builder.add(place, _I64(2 * i)) for i in (-1, 1)]
                words = [builder.load(builder.inttoptr(a, _I16.as_pointer()), align=2) for a in addresses]
                around = [builder.zext(word, _I64) for word in words]
                packed = builder.lshr(lowest, _I64(bits))
                packed = builder.shl(packed, _I64(16 * BEST))
                for value, layer in ((around[0], BELOW), (around[1], ABOVE), (runner_up, RUNNER_UP)):
                    value = builder.lshr(value, _I64(bits))
                    packed = builder.or_(packed, builder.shl(value, _I64(16 * layer)))
                address = builder.add(found, builder.mul(column, _I64(8)))
                builder.store(packed, builder.inttoptr(address, _I64.as_pointer()), align=2)

            return repeated, finish

        _emit_row(builder, disparities, columns, states, False, small, large, pixel)
        return context.get_dummy_value()

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
        wide = _Lanes(builder, CENSUS_BLOCK, 16)
        for plane in range(PLANES):
            word = wide.constant(0)
            for part in range(2):
                code = lanes.constant(0)
                first = 16 * plane + 8 * part
                for bit, place in enumerate(places[first : first + 8]):
                    darker = builder.sext(builder.icmp_unsigned("<", pixels(place), centre), lanes.type)
                    code = builder.or_(code, builder.and_(darker, lanes.constant(1 << bit)))
                word = builder.or_(word, builder.shl(builder.zext(code, wide.type), wide.constant(8 * part)))
            wide.store(word, builder.add(target, builder.mul(target_plane, _I64(plane))))
        return context.get_dummy_value()

    return signature, generate


def _gathered(builder: Any, addresses: Any, element: Any) -> Any:
    """The 32-bit elements at a vector of addresses."""
    count = addresses.type.count
    pointers, mask = ir.VectorType(element.as_pointer(), count), ir.VectorType(ir.IntType(1), count)
    vector = ir.VectorType(element, count)
    kind = "f32" if element is _F32 else "i32"
    signature = ir.FunctionType(vector, [pointers, _I32, mask, vector])
    gather = cgutils.get_or_insert_function(builder.module, signature, f"llvm.masked.gather.v{count}{kind}.v{count}p0")
    every, empty = ir.Constant(mask, [ir.IntType(1)(1)] * count), ir.Constant(vector, ir.Undefined)
    return builder.call(gather, [builder.inttoptr(addresses, pointers), _I32(1), every, empty])


@intrinsic(prefer_literal=True)
def _sample_block(_context: Any, source: Any, width: Any, across: Any, down: Any, target: Any) -> Any:
    """SAMPLE_BLOCK pixels between four pixels each, by places in 32nds; all but the width are addresses."""
    signature = types.void(*([types.int64] * 5))

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        source, width, across, down, target = arguments
        lanes, far = _Lanes(builder, SAMPLE_BLOCK, 32), _Lanes(builder, SAMPLE_BLOCK, 64)
        x, y = lanes.load(across), lanes.load(down)
        stride = lanes.splat(builder.trunc(width, _I32))
        five, parts, low = lanes.constant(5), lanes.constant(32), lanes.constant(255)
        index = builder.add(builder.mul(builder.ashr(y, five), stride), builder.ashr(x, five))
        right, below = builder.and_(x, lanes.constant(31)), builder.and_(y, lanes.constant(31))
        rows = []
        for place in (index, builder.add(index, stride)):
            word = _gathered(builder, builder.add(far.splat(source), builder.zext(place, far.type)), _I32)
            one = builder.and_(word, low)
            other = builder.and_(builder.lshr(word, lanes.constant(8)), low)
            rows.append(builder.add(builder.mul(one, parts), builder.mul(right, builder.sub(other, one))))
        upper, lower = rows
        value = builder.add(builder.mul(upper, parts), builder.mul(below, builder.sub(lower, upper)))
        value = builder.lshr(builder.add(value, lanes.constant(512)), lanes.constant(10))
        _Lanes(builder, SAMPLE_BLOCK, 8).store(builder.trunc(value, ir.VectorType(_I8, SAMPLE_BLOCK)), target)
        return context.get_dummy_value()

    return signature, generate


@intrinsic(prefer_literal=True)
def _select_block(
    _context: Any,
    disparities: Any,
    winners: Any,
    costs: Any,
    right_winners: Any,
    prior: Any,
    right: Any,
    right_flags: Any,
    inconsistent: Any,
    at_edge: Any,
    fatal: Any,
    whole: Any,
    disparity: Any,
    flags: Any,
    confidence: Any,
    matched: Any,
) -> Any:
    """SAMPLE_BLOCK pixels from winners to disparities; all but the number of disparities and the bytes are addresses.

    Those on the right are of what belongs to the first pixel and the first disparity.
    """
    signature = types.void(*([types.int64] * 7), *([types.uint8] * 4), *([types.int64] * 4))
    count = SAMPLE_BLOCK

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        disparities, winners, costs, right_winners, prior, right, right_flags = arguments[:7]
        inconsistent, at_edge, fatal, whole, disparity, flags, confidence, matched = arguments[7:]
        bytes_, lanes, far = _Lanes(builder, count, 8), _Lanes(builder, count, 32), _Lanes(builder, count, 64)
        floats = ir.VectorType(_F32, count)

        def number(value: float) -> Any:
            return ir.Constant(floats, [_F32(value)] * count)

        def as_float(values: Any) -> Any:
            return builder.sitofp(values, floats)

        def where(condition: Any, value: Any) -> Any:
            return builder.select(condition, value, bytes_.constant(0))

        def bytes_at(address: Any, places: Any) -> Any:
            # Whole words, aligned, lie on the same page as the byte.
            addresses = builder.add(far.splat(address), builder.sext(places, far.type))
            words = _gathered(builder, builder.and_(addresses, far.constant(-4)), _I32)
            turns = builder.shl(
                builder.and_(builder.trunc(addresses, lanes.type), lanes.constant(3)), lanes.constant(3)
            )
            return builder.and_(builder.lshr(words, turns), lanes.constant(255))

        winner = builder.zext(bytes_.load(winners), lanes.type)
        place = builder.add(winner, lanes.constant(range(count)))
        last = lanes.splat(builder.trunc(builder.sub(disparities, _I64(1)), _I32))
        outermost = builder.or_(
            builder.icmp_signed("==", winner, lanes.constant(0)), builder.icmp_signed("==", winner, last)
        )
        packed = _Lanes(builder, 2 * count, 32).load(costs)
        low, high = (_permuted(builder, packed, packed, range(first, 2 * count, 2)) for first in (0, 1))
        sixteen, word = lanes.constant(16), lanes.constant(0xFFFF)
        best, runner_up = builder.lshr(low, sixteen), builder.lshr(high, sixteen)
        below = as_float(builder.sub(builder.and_(low, word), best))
        above = as_float(builder.sub(builder.and_(high, word), best))
        steeper = builder.select(builder.fcmp_ordered(">", above, below), above, below)
        steeper = builder.select(builder.fcmp_ordered(">", steeper, number(0)), steeper, number(1))
        fraction = builder.fdiv(builder.fmul(number(0.5), builder.fsub(below, above)), steeper)
        fraction = builder.select(outermost, number(0), fraction)
        share = builder.fmul(number(255), as_float(builder.sub(runner_up, best)))
        share = builder.fdiv(share, builder.fadd(as_float(runner_up), number(float(np.float32(0.001)))))
        bytes_.store(builder.trunc(builder.fptosi(share, lanes.type), bytes_.type), confidence)

        up = builder.sext(builder.fcmp_ordered(">=", fraction, number(0.5)), lanes.type)
        down = builder.sext(builder.fcmp_ordered("<", fraction, number(-0.5)), lanes.type)
        flag = bytes_at(right_flags, builder.add(builder.sub(place, up), down))
        flag = builder.or_(bytes_.load(flags), builder.trunc(flag, bytes_.type))
        apart = builder.add(builder.sub(bytes_at(right_winners, place), winner), lanes.constant(1))
        disagree = builder.icmp_unsigned(">", apart, lanes.constant(2))
        flag = builder.or_(flag, where(disagree, bytes_.splat(inconsistent)))
        flag = builder.or_(flag, where(outermost, bytes_.splat(at_edge)))
        bytes_.store(flag, flags)

        negative = builder.fcmp_ordered("<", fraction, number(0))
        start = builder.add(place, builder.sext(negative, lanes.type))
        weight = builder.fadd(fraction, builder.select(negative, number(1), number(0)))
        addresses = builder.add(far.splat(prior), builder.shl(builder.sext(start, far.type), far.constant(2)))
        before = _gathered(builder, addresses, _F32)
        after = _gathered(builder, builder.add(addresses, far.constant(4)), _F32)
        half = builder.trunc(builder.lshr(disparities, _I64(1)), _I32)
        value = builder.fadd(as_float(builder.sub(winner, lanes.splat(half))), fraction)
        value = builder.fadd(builder.fadd(value, before), builder.fmul(weight, builder.fsub(after, before)))
        words = _gathered(builder, builder.add(far.splat(right), builder.sext(start, far.type)), _I32)
        one = as_float(builder.and_(words, lanes.constant(255)))
        other = as_float(builder.and_(builder.lshr(words, lanes.constant(8)), lanes.constant(255)))
        grey = builder.fadd(builder.fadd(one, builder.fmul(weight, builder.fsub(other, one))), number(0.5))
        grey = builder.trunc(builder.fptosi(grey, lanes.type), bytes_.type)

        half = builder.lshr(disparities, _I64(1))
        known = builder.inttoptr(builder.add(prior, builder.shl(half, _I64(2))), floats.as_pointer())
        some = builder.icmp_unsigned("!=", whole, _I8(0))
        otherwise = builder.select(some, builder.load(known, align=4), number(float("nan")))
        fine = builder.icmp_unsigned("==", builder.and_(flag, bytes_.splat(fatal)), bytes_.constant(0))
        target = builder.inttoptr(disparity, floats.as_pointer())
        builder.store(builder.select(fine, value, otherwise), target, align=4)
        bytes_.store(builder.select(fine, grey, bytes_.load(builder.add(right, half))), matched)
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
        pattern = np.uint16(blank & ((1 << min(16, CENSUS_BITS - 16 * plane)) - 1))
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
            _census_block(source + place, columns, target + 2 * place, 2 * rows * columns)
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
                        code |= 1 << (bit % 16)
                    bit += 1
                    if bit % 16 == 0 or bit == CENSUS_BITS:
                        planes[(bit - 1) // 16, row, column] = code
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
    volume : (2, rows, columns, disparities) uint8, overwritten: costs; sums of the first sweep, less their leasts
    leasts : (rows, columns) uint32, overwritten: what was taken off those sums, in both halves of the word

    and fills

    winners : (rows, columns) uint8, index of the cheapest disparity
    costs : (rows, columns, 4) uint16, at the winner's lower neighbour, at the winner, at its upper neighbour
        (65535 // disparities beyond the range), and the least of all the others
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
        leasts: Any,
        winners: Any,
        costs: Any,
        right_winners: Any,
    ) -> None:
        _, rows, columns = left_planes.shape
        right_columns = right_planes.shape[2]
        states = np.empty((columns + 2, 4, disparities), np.uint8)
        doubled = np.empty((PLANES, columns), np.uint32)
        keys = np.full(disparities + 2, UNKNOWN_COST, np.uint16)
        masks = np.zeros(2 * disparities + 1, np.uint16)
        masks[disparities - 1 : disparities + 2] = UNKNOWN_COST
        right_keys = np.zeros(columns + disparities, np.uint16)
        small, large = np.uint8(small_step), np.uint8(large_step)
        line = columns * disparities
        costs_address = volume.ctypes.data
        sums_address = costs_address + rows * line
        leasts_address, states_address = leasts.ctypes.data, states.ctypes.data
        states[:] = 0
        for row in range(rows):
            for plane in range(PLANES):
                for column in range(columns):
                    doubled[plane, column] = np.uint32(left_planes[plane, row, column]) * np.uint32(0x00010001)
            _sweep_down(
                disparities,
                columns,
                doubled.ctypes.data,
                4 * columns,
                right_planes.ctypes.data + 2 * (row * right_columns + offset),
                2 * rows * right_columns,
                states_address,
                costs_address + row * line,
                sums_address + row * line,
                leasts_address + row * columns * 4,
                small,
                large,
            )
        states[:] = 0
        for row in range(rows - 1, -1, -1):
            _sweep_up(
                disparities,
                columns,
                states_address,
                costs_address + row * line,
                sums_address + row * line,
                leasts_address + row * columns * 4,
                masks.ctypes.data,
                keys.ctypes.data + 2,
                right_keys.ctypes.data,
                winners.ctypes.data + row * columns,
                costs.ctypes.data + row * columns * 8,
                small,
                large,
            )
            for j in range(columns + disparities):
                right_winners[row, j] = right_keys[j] & np.uint16(disparities - 1)

    return passes


@njit(nogil=True, cache=True, inline="always")
def _bits_set(word: int) -> int:
    word = word - ((word >> 1) & 0x5555)
    word = (word & 0x3333) + ((word >> 2) & 0x3333)
    word = (word + (word >> 4)) & 0x0F0F
    return (word + (word >> 8)) & 0x1F


@njit(nogil=True, cache=True)
def _carry_path(before: Any, costs: Any, small: int, large: int, after: Any, carried: Any) -> int:
    """One path over one pixel ([Hirschmuller2008] eq. 13); returns its least. `after` may be `before`."""
    disparities = len(costs)
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
    return least


@njit(nogil=True, cache=True)
def plain_passes(
    left_planes: Any,
    right_planes: Any,
    offset: int,
    small_step: int,
    large_step: int,
    volume: Any,
    leasts: Any,
    winners: Any,
    costs: Any,
    right_winners: Any,
) -> None:
    """The same as `vector_passes` in plain loops, for any number of disparities."""
    _, rows, columns, disparities = volume.shape
    states = np.zeros((2, columns + 2, 3, disparities), np.uint8)
    beside = np.zeros(disparities, np.uint8)
    carried = np.empty(disparities, np.int64)
    sums = np.empty(disparities, np.int64)
    right_costs = np.empty(columns + disparities, np.uint16)
    unknown = UNKNOWN_COST // disparities
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
                cost = volume[0, row, column]
                if sweep == 0:
                    cost[:] = 0
                    for plane in range(PLANES):
                        code = left_planes[plane, row, column]
                        for d in range(disparities):
                            cost[d] += _bits_set(np.int64(code ^ right_planes[plane, row, offset + column + d]))
                least = _carry_path(beside, cost, small_step, large_step, beside, carried)
                sums[:] = carried
                for path in range(3):
                    neighbour = last[column + 1 + (path - 1) * step, path]
                    least += _carry_path(neighbour, cost, small_step, large_step, this[column + 1, path], carried)
                    sums += carried
                if sweep == 0:
                    leasts[row, column] = least * 65537
                    for d in range(disparities):
                        volume[1, row, column, d] = min(sums[d] - least, 255)
                    continue
                for d in range(disparities):
                    sums[d] += np.int64(volume[1, row, column, d]) + np.int64(leasts[row, column] & 0xFFFF)
                winner = sums.argmin()
                runner_up = unknown
                for d in range(disparities):
                    if abs(d - winner) > 1:
                        runner_up = min(runner_up, sums[d])
                winners[row, column] = winner
                costs[row, column, BELOW] = sums[winner - 1] if winner > 0 else unknown
                costs[row, column, BEST] = sums[winner]
                costs[row, column, ABOVE] = sums[winner + 1] if winner < disparities - 1 else unknown
                costs[row, column, RUNNER_UP] = runner_up
                for d in range(disparities):
                    if sums[d] < right_costs[column + d]:
                        right_costs[column + d] = sums[d]
                        right_winners[row, column + d] = d


# --- from winners to disparities --------------------------------------------------------------------------------------


@njit(nogil=True, cache=True)
def select_vector(
    winners: Any,
    costs: Any,
    right_winners: Any,
    prior: Any,
    right: Any,
    right_flags: Any,
    inconsistent_flag: int,
    edge_flag: int,
    tolerated: int,
    whole: bool,
    disparity: Any,
    flags: Any,
    confidence: Any,
    matched: Any,
) -> None:
    """Sub-pixel winner, left-right check, flags and grey value of the matched right pixel, and the prior put back.

    prior, right and right_flags are wider than the left picture, of at least SAMPLE_BLOCK columns, by the same number
    of columns on both sides, two more than half the disparities or more. With k the disparity that was left over,
    d(x) = k + prior(x + k). Between whole disparities the cost is taken to fall and rise with equal slopes, as sums of
    Hamming distances do; a parabola more than doubles the noise of smooth ground. Where there is a flag beyond the
    tolerated ones, disparity is NaN or, if `whole`, what was known before.
    """
    rows, columns = winners.shape
    wide = prior.shape[1]
    margin = (wide - columns) // 2
    disparities = right_winners.shape[1] - columns
    shift = margin - disparities // 2
    for row in range(rows):
        column = 0
        while column < columns:
            start = min(column, columns - SAMPLE_BLOCK)
            pixel, beyond = row * columns + start, row * wide + start
            _select_block(
                disparities,
                winners.ctypes.data + pixel,
                costs.ctypes.data + 8 * pixel,
                right_winners.ctypes.data + row * right_winners.shape[1] + start,
                prior.ctypes.data + 4 * (beyond + shift),
                right.ctypes.data + beyond + shift,
                right_flags.ctypes.data + beyond + shift,
                np.uint8(inconsistent_flag),
                np.uint8(edge_flag),
                np.uint8(~tolerated & 0xFF),
                np.uint8(whole),
                disparity.ctypes.data + 4 * pixel,
                flags.ctypes.data + pixel,
                confidence.ctypes.data + pixel,
                matched.ctypes.data + pixel,
            )
            column += SAMPLE_BLOCK


@njit(nogil=True, cache=True, error_model="numpy")
def select_plain(
    winners: Any,
    costs: Any,
    right_winners: Any,
    prior: Any,
    right: Any,
    right_flags: Any,
    inconsistent_flag: int,
    edge_flag: int,
    tolerated: int,
    whole: bool,
    disparity: Any,
    flags: Any,
    confidence: Any,
    matched: Any,
) -> None:
    """The same as `select_vector` in plain loops, for pictures and margins of any width."""
    rows, columns = winners.shape
    margin = (prior.shape[1] - columns) // 2
    disparities = right_winners.shape[1] - columns
    shift = margin - disparities // 2
    half = np.float32(0.5)
    for row in range(rows):
        for column in range(columns):
            winner = np.int64(winners[row, column])
            best, runner_up = np.int64(costs[row, column, BEST]), np.int64(costs[row, column, RUNNER_UP])
            below = np.float32(np.int64(costs[row, column, BELOW]) - best)
            above = np.float32(np.int64(costs[row, column, ABOVE]) - best)
            at_edge = winner == 0 or winner == disparities - 1
            steeper = max(below, above)
            fraction = half * (below - above) / (steeper if steeper > 0 else np.float32(1))
            fraction = np.float32(0) if at_edge else fraction
            share = np.float32(255) * np.float32(runner_up - best) / (np.float32(runner_up) + np.float32(0.001))
            confidence[row, column] = np.uint8(np.int32(share))

            nearest = column + shift + winner
            flag = flags[row, column] | right_flags[row, nearest + (fraction >= half) - (fraction < -half)]
            if abs(np.int64(right_winners[row, column + winner]) - winner) > 1:
                flag |= np.uint8(inconsistent_flag)
            if at_edge:
                flag |= np.uint8(edge_flag)
            flags[row, column] = flag

            start = nearest - (fraction < 0)
            weight = fraction + (np.float32(1) if fraction < 0 else np.float32(0))
            before, after = prior[row, start], prior[row, start + 1]
            value = np.float32(winner - disparities // 2) + fraction + before + weight * (after - before)
            one, other = np.float32(right[row, start]), np.float32(right[row, start + 1])
            grey = np.uint8(np.int32(one + weight * (other - one) + half))
            if flag & np.uint8(~tolerated & 0xFF) != 0:
                value = prior[row, column + margin] if whole else np.float32(np.nan)
                grey = right[row, column + margin]
            disparity[row, column] = value
            matched[row, column] = grey


# --- what pictures and disparity maps decide alone -------------------------------------------------------------------


@njit(nogil=True, cache=True)
def flag_windows(
    image: Any, least_sd: float, saturated_from: int, flat_flag: int, saturated_flag: int, flags: Any
) -> None:
    """Add the flags of windows of TEXTURED pixels a side with little texture, and of mostly saturated ones.

    Windows are cut at the picture's edges. Integers of 32 bits hold windows of up to 11 pixels a side.
    """
    rows, columns = image.shape
    half = TEXTURED // 2
    # Sums down the window's height, with nothing beside the picture; then of three such side by side, three of which
    # are a window. The count of saturated pixels rides on the sum of grey values, 65536 times.
    sums, threes = np.zeros(columns + TEXTURED, np.int32), np.zeros(columns + TEXTURED, np.int32)
    squares, three_squares = np.zeros(columns + TEXTURED, np.int32), np.zeros(columns + TEXTURED, np.int32)
    inner, inner_squares = sums[half:], squares[half:]
    nothing = np.zeros(columns, np.uint8)
    sizes = np.empty(columns, np.int32)
    least_variance = np.float32(least_sd * least_sd)
    for row in range(-half, rows):
        below, above = row + half, row - half - 1
        entering, leaving = image[below] if below < rows else nothing, image[above] if above >= 0 else nothing
        for column in range(columns):
            new, old = np.int32(entering[column]), np.int32(leaving[column])
            new_bright = np.int32(65536) if new >= saturated_from else np.int32(0)
            old_bright = np.int32(65536) if old >= saturated_from else np.int32(0)
            inner[column] = np.int32(inner[column] + np.int32(np.int32(new + new_bright) - np.int32(old + old_bright)))
        for column in range(columns):
            new, old = np.int32(entering[column]), np.int32(leaving[column])
            inner_squares[column] = np.int32(
                inner_squares[column] + np.int32(np.int32(new * new) - np.int32(old * old))
            )
        if row < 0:
            continue
        _add_threes(sums, threes)
        _add_threes(squares, three_squares)
        height = min(row + half, rows - 1) - max(row - half, 0) + 1
        for column in range(columns):
            sizes[column] = height * (min(column + half, columns - 1) - max(column - half, 0) + 1)
        line = flags[row]
        for column in range(columns):
            size = sizes[column]
            total = np.int32(np.int32(threes[column] + threes[column + 3]) + threes[column + 6])
            square = np.int32(np.int32(three_squares[column] + three_squares[column + 3]) + three_squares[column + 6])
            bright = np.int32(total >> np.int32(16))
            grey = np.int32(total & np.int32(0xFFFF))
            scatter = np.int32(np.int32(square * size) - np.int32(grey * grey))  # size^2 times the variance
            is_flat = np.float32(scatter) < least_variance * np.float32(np.int32(size * size))
            is_bright = np.int32(bright + bright) > size
            flag = (np.uint8(flat_flag) if is_flat else np.uint8(0)) | (
                np.uint8(saturated_flag) if is_bright else np.uint8(0)
            )
            line[column] |= flag


@njit(nogil=True, cache=True, error_model="numpy")
def correlate_windows(left: Any, right: Any, least_variance: float, found: Any) -> None:
    """Normalised correlation of two pictures in the windows of CORRELATED pixels a side about every pixel.

    Windows are cut at the picture's edges. Grey values are counted from mid-grey, so that integers of 16 and 32 bits
    hold windows of 15 pixels a side exactly. least_variance: geometric mean of the variances from which it counts.
    """
    rows, columns = left.shape
    half = CORRELATED // 2
    # Sums down the window's height, with nothing beside the picture: a, b; a^2, b^2, ab. Then of three such side by
    # side, five of which are a window.
    sums, threes = np.zeros((2, columns + CORRELATED), np.int16), np.zeros((2, columns + CORRELATED), np.int16)
    squares, three_squares = (
        np.zeros((3, columns + CORRELATED), np.int32),
        np.zeros((3, columns + CORRELATED), np.int32),
    )
    a_sums, b_sums, aa_sums, bb_sums, ab_sums = sums[0], sums[1], squares[0], squares[1], squares[2]
    a_threes, b_threes = threes[0], threes[1]
    aa_threes, bb_threes, ab_threes = three_squares[0], three_squares[1], three_squares[2]
    beyond = np.full(columns, MID_GREY, np.uint8)
    sizes = np.empty(columns, np.float32)
    least = np.float32(least_variance * least_variance)
    for row in range(-half, rows):
        below, above = row + half, row - half - 1
        a_new, a_old = left[below] if below < rows else beyond, left[above] if above >= 0 else beyond
        b_new, b_old = right[below] if below < rows else beyond, right[above] if above >= 0 else beyond
        _shift_sums(a_new, a_old, a_sums[half:])
        _shift_sums(b_new, b_old, b_sums[half:])
        _shift_products(a_new, a_new, a_old, a_old, aa_sums[half:])
        _shift_products(b_new, b_new, b_old, b_old, bb_sums[half:])
        _shift_products(a_new, b_new, a_old, b_old, ab_sums[half:])
        if row < 0:
            continue
        _add_threes(a_sums, a_threes)
        _add_threes(b_sums, b_threes)
        _add_threes(aa_sums, aa_threes)
        _add_threes(bb_sums, bb_threes)
        _add_threes(ab_sums, ab_threes)
        height = min(row + half, rows - 1) - max(row - half, 0) + 1
        for column in range(columns):
            width = min(column + half, columns - 1) - max(column - half, 0) + 1
            sizes[column] = np.float32(height * width)
        target = found[row]
        for column in range(columns):
            a, b = _window(a_threes, column), _window(b_threes, column)
            aa, bb, ab = _window(aa_threes, column), _window(bb_threes, column), _window(ab_threes, column)
            area = sizes[column]
            size = np.int32(area)
            covariance = np.int32(np.int32(size * ab) - np.int32(a * b))  # size^2 times it
            one = np.int32(np.int32(size * aa) - np.int32(a * a))
            other = np.int32(np.int32(size * bb) - np.int32(b * b))
            variances = max(np.float32(one) * np.float32(other), least * (area * area) * (area * area))
            target[column] = np.float32(covariance) / np.sqrt(variances)


@njit(nogil=True, cache=True, inline="always")
def _shift_sums(entering: Any, leaving: Any, sums: Any) -> None:
    for column in range(len(entering)):
        change = np.int16(np.int16(entering[column]) - np.int16(leaving[column]))
        sums[column] = np.int16(sums[column] + change)


@njit(nogil=True, cache=True, inline="always")
def _shift_products(a_entering: Any, b_entering: Any, a_leaving: Any, b_leaving: Any, sums: Any) -> None:
    """Add the products of two lines of grey values, counted from mid-grey, and take away those of two others."""
    for column in range(len(a_entering)):
        a, b = np.int32(a_entering[column]) - MID_GREY, np.int32(b_entering[column]) - MID_GREY
        c, d = np.int32(a_leaving[column]) - MID_GREY, np.int32(b_leaving[column]) - MID_GREY
        sums[column] = np.int32(sums[column] + np.int32(np.int32(a * b) - np.int32(c * d)))


@njit(nogil=True, cache=True, inline="always")
def _add_threes(sums: Any, threes: Any) -> None:
    for column in range(len(sums) - 2):
        threes[column] = sums[column] + sums[column + 1] + sums[column + 2]


@njit(nogil=True, cache=True, inline="always")
def _window(threes: Any, column: int) -> Any:
    total = np.int32(0)
    for third in range(0, CORRELATED, 3):
        total = np.int32(total + np.int32(threes[column + third]))
    return total


@njit(nogil=True, cache=True, error_model="numpy")
def clean(
    disparity: Any,
    alike: Any,
    uniqueness: Any,
    least_correlation: float,
    least_uniqueness: float,
    unlike_flag: int,
    ambiguous_flag: int,
    fractions: int,
    flags: Any,
    similarity: Any,
) -> None:
    """Take out what is flagged, does not look alike or does not stand out; correlation as a byte.

    Disparities are rounded to so many fractions of a pixel, a power of two.
    """
    rows, columns = disparity.shape
    least_correlation, least_uniqueness = np.float32(least_correlation), np.float32(least_uniqueness)
    unlike, ambiguous = np.uint8(unlike_flag), np.uint8(ambiguous_flag)
    zero, one, parts = np.float32(0), np.float32(1), np.float32(fractions)
    for row in range(rows):
        for column in range(columns):
            value = alike[row, column]
            flag = flags[row, column]
            doubts = unlike if value < least_correlation else np.uint8(0)
            doubts |= ambiguous if np.float32(uniqueness[row, column]) < least_uniqueness else np.uint8(0)
            flag |= doubts if flag == 0 else np.uint8(0)
            flags[row, column] = flag
            rounded = np.float32(np.rint(disparity[row, column] * parts)) / parts
            disparity[row, column] = rounded if flag == 0 else np.float32(np.nan)
            similarity[row, column] = np.uint8(np.int32(np.float32(255) * min(max(value, zero), one)))


@njit(nogil=True, cache=True)
def take_out(where: Any, flag: int, disparity: Any, flags: Any) -> None:
    """Give the flag to pixels, in place of their disparity."""
    rows, columns = where.shape
    flag = np.uint8(flag)
    for row in range(rows):
        for column in range(columns):
            flags[row, column] |= flag if where[row, column] else np.uint8(0)
            disparity[row, column] = np.float32(np.nan) if where[row, column] else disparity[row, column]


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
    joined, so that smooth ground costs two comparisons a pixel, in vector code.
    """
    rows, columns = disparity.shape
    step = np.float32(step)
    # Only what runs there are is ever touched.
    starts, ends = np.empty(rows * columns, np.int32), np.empty(rows * columns, np.int32)
    parents, sizes = np.empty(rows * columns, np.int32), np.empty(rows * columns, np.int32)
    first_runs = np.empty(rows + 1, np.int64)
    words = (columns + 8) // 8
    place = np.zeros(8 * words, np.uint8)  # 0: no disparity (also beyond the row), 1: goes on from the left, 2: starts
    linked = np.empty(columns, np.bool_)
    eight = place.view(np.uint64)
    count = 0
    for row in range(rows):
        first_runs[row] = count
        place[0] = 0 if np.isnan(disparity[row, 0]) else 2
        for column in range(1, columns):
            value = disparity[row, column]
            goes_on = abs(value - disparity[row, column - 1]) <= step
            place[column] = np.uint8(1) if goes_on else (np.uint8(2) if value == value else np.uint8(0))
        within = False
        for word in range(words):
            if eight[word] == (0x0101010101010101 if within else 0):
                continue
            for column in range(8 * word, 8 * word + 8):
                if place[column] == 1:
                    continue
                if within:
                    ends[count - 1] = column
                within = place[column] == 2
                if within:
                    starts[count] = column
                    parents[count] = count
                    count += 1
        for run in range(first_runs[row], count):
            sizes[run] = ends[run] - starts[run]
        if row == 0:
            continue
        for column in range(columns):
            linked[column] = abs(disparity[row, column] - disparity[row - 1, column]) <= step
        above = first_runs[row - 1]
        for run in range(first_runs[row], count):
            while above < first_runs[row] and ends[above] <= starts[run]:
                above += 1
            other = above
            while other < first_runs[row] and starts[other] < ends[run]:
                for column in range(max(starts[other], starts[run]), min(ends[other], ends[run])):
                    if linked[column]:
                        one, another = _root(parents, run), _root(parents, other)
                        parents[max(one, another)] = min(one, another)
                        break
                other += 1
    first_runs[rows] = count
    for run in range(count - 1, -1, -1):  # a root is the first run of its island
        root = _root(parents, run)
        if root != run:
            sizes[root] += sizes[run]
    for row in range(rows):
        found[row] = False
        for run in range(first_runs[row], first_runs[row + 1]):
            if sizes[_root(parents, run)] <= largest:
                found[row, starts[run] : ends[run]] = True


# --- resampling and filling -------------------------------------------------------------------------------------------


@njit(nogil=True, cache=True)
def resample_vector(
    source: Any, prior: Any, field: Any, field_place: Any, scale: float, offset_x: float, offset_y: float, target: Any
) -> None:
    """Read each pixel of the target one prior aside and one field value down, between pixels bilinearly.

    source : (rows + 2 RIM, columns + 2 RIM) uint8, with zeros around
    prior, target : (rows, columns), of at least SAMPLE_BLOCK columns
    field, field_place : nodes; node row and column of pixel (0, 0), then nodes per row and per column; between nodes
        the field is bilinear, beyond them constant
    scale : pixels of this level in one of the field's
    offset_x, offset_y : place in the source, without its rim, of a pixel whose prior and field are zero
    """
    rows, columns = prior.shape
    across, down = np.empty(columns, np.int32), np.empty(columns, np.int32)
    width = source.shape[1]
    for row in range(rows):
        _places_read(row, source, prior, field, field_place, scale, offset_x, offset_y, across, down)
        column = 0
        while column < columns:
            start = min(column, columns - SAMPLE_BLOCK)
            _sample_block(
                source.ctypes.data,
                width,
                across.ctypes.data + 4 * start,
                down.ctypes.data + 4 * start,
                target.ctypes.data + row * columns + start,
            )
            column += SAMPLE_BLOCK


@njit(nogil=True, cache=True)
def resample_plain(
    source: Any, prior: Any, field: Any, field_place: Any, scale: float, offset_x: float, offset_y: float, target: Any
) -> None:
    """The same as `resample_vector` in plain loops, for any number of columns."""
    rows, columns = prior.shape
    across, down = np.empty(columns, np.int32), np.empty(columns, np.int32)
    for row in range(rows):
        _places_read(row, source, prior, field, field_place, scale, offset_x, offset_y, across, down)
        for column in range(columns):
            x, y = across[column] >> 5, down[column] >> 5
            right, below = across[column] & 31, down[column] & 31
            upper = 32 * source[y, x] + right * (np.int32(source[y, x + 1]) - np.int32(source[y, x]))
            lower = 32 * source[y + 1, x] + right * (np.int32(source[y + 1, x + 1]) - np.int32(source[y + 1, x]))
            target[row, column] = (32 * upper + below * (lower - upper) + 512) >> 10


@njit(nogil=True, cache=True, inline="always")
def _places_read(
    row: int,
    source: Any,
    prior: Any,
    field: Any,
    field_place: Any,
    scale: float,
    offset_x: float,
    offset_y: float,
    across: Any,
    down: Any,
) -> None:
    """Where the pixels of a row are read, in 32nds of a pixel of the source; beyond the source, on its rim."""
    row_start, column_start, row_step, column_step = field_place
    columns = prior.shape[1]
    field_rows, field_columns = field.shape
    parts, zero = np.float32(32), np.float32(0)
    line = prior[row]
    x, highest = np.float32(offset_x + RIM), np.float32(32 * (source.shape[1] - RIM))
    for column in range(columns):
        across[column] = np.int32(np.rint(min(max(parts * ((x + np.float32(column)) + line[column]), zero), highest)))
    highest = np.float32(32 * (source.shape[0] - RIM))
    y = np.float32(offset_y + RIM + row)
    first, weight = _node(row_start + row * row_step, field_rows)
    second = min(first + 1, field_rows - 1)
    start = 0
    for node in range(field_columns):  # the pixels from each node to the next
        stop = columns
        if node < field_columns - 2:
            stop = min(max(int(np.ceil((node + 1 - column_start) / column_step)), start), columns)
        elif node == field_columns - 1 and node > 0:
            break
        beyond = min(node + 1, field_columns - 1)
        here = field[first, node] + weight * (field[second, node] - field[first, node])
        there = field[first, beyond] + weight * (field[second, beyond] - field[first, beyond])
        here, there = y + np.float32(scale) * here, y + np.float32(scale) * there
        for column in range(start, stop):
            along = np.float32(column_start + column * column_step - node)
            value = here + min(max(along, zero), np.float32(1)) * (there - here)
            down[column] = np.int32(np.rint(min(max(parts * value, zero), highest)))
        start = stop


@njit(nogil=True, cache=True, inline="always")
def _node(place: float, count: int) -> tuple[int, np.float32]:
    """Node before a place among `count` nodes, and how far on the way to the next it lies; constant beyond the ends."""
    place = min(max(place, 0.0), count - 1.0)
    first = min(int(place), max(count - 2, 0))
    return first, np.float32(place - first)


@njit(nogil=True, cache=True, error_model="numpy")
def weigh_means(means: Any, seen: Any) -> None:
    """Turn means over zeros, too, into means of what was seen (of 255), and into 0 where that is less than half."""
    for row in range(means.shape[0]):
        for column in range(means.shape[1]):
            share = np.float32(seen[row, column])
            value = np.rint(np.float32(means[row, column]) * (np.float32(255) / share))
            value = min(max(value, np.float32(1)), np.float32(255))
            means[row, column] = np.uint8(np.int32(value)) if share >= 128 else np.uint8(0)


@njit(nogil=True, cache=True, error_model="numpy")
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
def enlarge(coarse: Any, first_row: int, first_column: int, fine: Any) -> None:
    """Twice the values of `coarse` at twice its size, pixel i on pixel 2 i, bilinear between, constant beyond.

    fine : (rows, columns), filled; its first pixel lies at (first_row, first_column) of the whole doubled picture.
    """
    rows, columns = fine.shape
    coarse_rows, coarse_columns = coarse.shape
    line = np.empty(columns // 2 + 2, np.float32)  # half of what is to come, at every coarse column
    start = first_column >> 1
    odd = first_column & 1
    for row in range(rows):
        above = (first_row + row) >> 1
        below = above + ((first_row + row) & 1)
        upper = coarse[min(max(above, 0), coarse_rows - 1)]
        lower = coarse[min(max(below, 0), coarse_rows - 1)]
        first, last = min(max(-start, 0), len(line)), min(max(coarse_columns - start, 0), len(line))
        line[:first] = np.float32(0.5) * (upper[0] + lower[0])
        line[last:] = np.float32(0.5) * (upper[coarse_columns - 1] + lower[coarse_columns - 1])
        for column in range(first, last):
            line[column] = np.float32(0.5) * (upper[start + column] + lower[start + column])
        target = fine[row]
        for column in range((columns + odd + 1) // 2):
            if 2 * column - odd >= 0:
                target[2 * column - odd] = line[column] + line[column]
            if 2 * column + 1 - odd < columns:
                target[2 * column + 1 - odd] = line[column] + line[column + 1]


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
def continue_rows(values: Any, reach: int, base: int, steepest: float) -> None:
    """Go on in a straight line from the first and the last value of every row into what is NaN beyond, in place.

    The line is that of the outermost `base` columns, rises by at most `steepest` a column and is level from `reach`
    columns on; rows that know less than half of these columns stay as they are.
    """
    rows, columns = values.shape
    for row in range(rows):
        for step in (1, -1):
            first = 0 if step == 1 else columns - 1
            while 0 <= first < columns and np.isnan(values[row, first]):
                first += step
            count, sum_t, sum_v, sum_tt, sum_tv = 0, 0.0, 0.0, 0.0, 0.0
            for t in range(base):
                column = first + step * t
                if not 0 <= column < columns:
                    break
                value = values[row, column]
                if not np.isnan(value):
                    count += 1
                    sum_t += t
                    sum_v += value
                    sum_tt += t * t
                    sum_tv += t * value
            if count < 2 or 2 * count < base:
                continue
            slope = (count * sum_tv - sum_t * sum_v) / (count * sum_tt - sum_t * sum_t)
            slope = min(max(slope, -steepest), steepest)
            start = (sum_v - slope * sum_t) / count
            column = first - step
            while 0 <= column < columns:
                values[row, column] = start - slope * min(step * (first - column), reach)
                column -= step


@njit(nogil=True, cache=True)
def contested_rows(disparity: Any, apart: int, contested: Any) -> None:
    """Mark rows in which two left pixels, more than `apart` apart, share a pixel of the right picture or neighbours."""
    rows, columns = disparity.shape
    places = np.empty(columns, np.int32)
    for row in range(rows):
        _places(disparity[row], places)
        furthest = np.int32(-(2**30))
        found = False
        for column in range(apart + 1, columns):
            furthest = max(furthest, places[column - apart - 1])
            found |= (places[column] <= furthest + 1) & (places[column] > -(2**30))
        contested[row] = found


@njit(nogil=True, cache=True, inline="always")
def _places(disparity: Any, places: Any) -> None:
    """Column of the right picture for each left pixel of a row, far to the left where there is no disparity."""
    for column in range(len(disparity)):
        value = disparity[column]
        place = np.int32(np.rint(np.float32(column) + (value if value == value else np.float32(0))))
        places[column] = place if value == value else np.int32(-(2**30))


@njit(nogil=True, cache=True)
def claim_columns(disparity: Any, support: Any, contested: Any, width: int, apart: int, lost: Any) -> None:
    """Mark matches whose right pixel is better matched with a left pixel that lies elsewhere.

    disparity : (rows, columns), NaN where there is none
    support : (rows, columns) uint8, the weight of each claim
    contested : (rows,) bool, rows to look at
    width : columns of the right picture
    apart : two left pixels at most so far apart may share a right one, as foreshortened slopes do
    lost : (rows, columns) bool, filled
    """
    rows, columns = disparity.shape
    best = np.empty(width + 2, np.uint8)
    claimant = np.empty(width + 2, np.int32)
    places = np.empty(columns, np.int32)
    for row in range(rows):
        lost[row] = False
        if not contested[row]:
            continue
        best[:] = 0
        _places(disparity[row], places)
        for column in range(columns):
            place = places[column] + 1
            if 0 < place <= width and support[row, column] > best[place]:
                best[place] = support[row, column]
                claimant[place] = column
        for column in range(columns):
            if places[column] == -(2**30):
                continue
            place = min(max(places[column] + 1, 1), width)
            for near in range(place - 1, place + 2):
                if best[near] > support[row, column] and abs(claimant[near] - column) > apart:
                    lost[row, column] = True
