"""Compiled loops of the simulator: hashed ground noise, terrain, light and the exposure of film."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cosp.arrays import Float32Array

Array = NDArray[Any]

_MASK = 0xFFFFFFFF
BRIGHTEST = 1.3  # reflectance, sun-facing snow, that a radiance of 255 stands for


@njit(nogil=True, cache=True, inline="always")
def _hash(column: int, row: int, seed: int) -> int:
    """32 mixed bits of a lattice corner."""
    mixed = (column * 0x9E3779B1 + row * 0x85EBCA77 + seed * 0xC2B2AE3D) & _MASK
    mixed ^= mixed >> 15
    mixed = (mixed * 0x2C1B3C6D) & _MASK
    mixed ^= mixed >> 12
    mixed = (mixed * 0x297A2D39) & _MASK
    mixed ^= mixed >> 15
    return mixed


@njit(nogil=True, cache=True, inline="always")
def _unit(column: int, row: int, seed: int) -> float:
    """Uniform number in [-1, 1) of a lattice corner."""
    return _hash(column, row, seed) * (2.0 / 4294967296.0) - 1.0


@njit(nogil=True, cache=True, inline="always")
def _lattice_cell(x: float, y: float) -> tuple[int, int, float, float]:
    """Column and row of the lattice cell that a place lies in, and how far it lies in the cell (0 to 1)."""
    column = math.floor(x)
    row = math.floor(y)
    return column, row, x - column, y - row


@njit(nogil=True, cache=True)
def value_noise(x: float, y: float, seed: int) -> float:
    """Smooth noise in [-1, 1] with lattice spacing 1; the same number at the same place, always."""
    column, row, u, v = _lattice_cell(x, y)
    u = u * u * (3.0 - 2.0 * u)
    v = v * v * (3.0 - 2.0 * v)
    top = _unit(column, row, seed) * (1.0 - u) + _unit(column + 1, row, seed) * u
    bottom = _unit(column, row + 1, seed) * (1.0 - u) + _unit(column + 1, row + 1, seed) * u
    return top * (1.0 - v) + bottom * v


@njit(nogil=True, cache=True, inline="always")
def _gradient_dot(column: int, row: int, seed: int, dx: float, dy: float) -> float:
    """Dot product of a corner's random gradient and the way to it."""
    mixed = _hash(column, row, seed)
    return ((mixed & 0xFFFF) / 32767.5 - 1.0) * dx + ((mixed >> 16) / 32767.5 - 1.0) * dy


@njit(nogil=True, cache=True)
def gradient_noise(x: float, y: float, seed: int) -> float:
    """Gradient noise with lattice spacing 1, about -1 to 1, without the lattice pattern of value noise."""
    column, row, u, v = _lattice_cell(x, y)
    fade_u = u * u * u * (u * (u * 6.0 - 15.0) + 10.0)
    fade_v = v * v * v * (v * (v * 6.0 - 15.0) + 10.0)
    a = _gradient_dot(column, row, seed, u, v)
    b = _gradient_dot(column + 1, row, seed, u - 1.0, v)
    c = _gradient_dot(column, row + 1, seed, u, v - 1.0)
    d = _gradient_dot(column + 1, row + 1, seed, u - 1.0, v - 1.0)
    top = a + (b - a) * fade_u
    bottom = c + (d - c) * fade_u
    return 1.5 * (top + (bottom - top) * fade_v)


@njit(nogil=True, cache=True, inline="always")
def _smoothstep(low: float, high: float, value: float) -> float:
    """0 below `low`, 1 above `high`, smooth between."""
    t = (value - low) / (high - low)
    t = min(max(t, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@njit(nogil=True, cache=True)
def _mountains(east: float, north: float, centre_east: float, seed: int) -> float:
    """Share of mountain (1) against plain (0); the site's centre lies in mountains."""
    wave = 0.35 * math.cos((east - centre_east) * (2.0 * math.pi / 190e3))
    return _smoothstep(-0.2, 0.25, 0.55 * gradient_noise(east / 60e3, north / 60e3, seed) + wave + 0.12)


@njit(nogil=True, cache=True)
def procedural_height(
    east: float, north: float, centre_east: float, smallest_m: float, seed: int,
) -> tuple[float, float]:  # fmt: skip
    """Height of the procedural terrain in metres, and its share of valley floor (0 to 1)."""
    warped_east = east + 1800.0 * gradient_noise(east / 11e3, north / 11e3, seed + 1)
    warped_north = north + 1800.0 * gradient_noise(east / 11e3, north / 11e3, seed + 2)
    mountains = _mountains(warped_east, warped_north, centre_east, seed)
    ridges = 0.0
    amplitude = 1.0
    wavelength = 15e3
    weight = 1.0
    octave = 0
    while wavelength >= smallest_m:
        ridge = 1.0 - abs(gradient_noise(warped_east / wavelength, warped_north / wavelength, seed + 10 + octave))
        ridge *= ridge * weight
        ridges += amplitude * ridge
        weight = min(max(1.6 * ridge, 0.0), 1.0)
        amplitude *= 0.42
        wavelength *= 0.5
        octave += 1
    swell = gradient_noise(east / 45e3, north / 45e3, seed + 3)
    # Terraced floor: nearly level over kilometres, so that lakes and villages have a place.
    level = (700.0 + 260.0 * swell) / 70.0
    step = math.floor(level)
    floor = 70.0 * (step + _smoothstep(0.35, 0.65, level - step))
    hills = 25.0 * gradient_noise(east / 2.3e3, north / 2.3e3, seed + 4)
    hills += 9.0 * gradient_noise(east / 600.0, north / 600.0, seed + 5)
    relief = (250.0 + 2700.0 * mountains) * (ridges - 0.42) * (0.12 + 0.88 * mountains)
    height = 420.0 + 260.0 * swell + relief
    # A smooth maximum of mountain side and floor.
    softness = 25.0
    difference = (height - floor - 15.0) / softness
    if difference > 30.0:
        raised = height
    elif difference < -30.0:
        raised = floor + 15.0
    else:
        raised = floor + 15.0 + softness * math.log1p(math.exp(difference))
    valley = 1.0 - _smoothstep(0.0, 3.0, difference)
    return raised + hills * (1.0 - mountains) * 1.5, valley


@njit(nogil=True, cache=True)
def fill_procedural(
    heights: Array, valley: Array, x0: float, y0: float, step: float, row0: int, row1: int, centre_east: float,
    seed: int,
) -> None:  # fmt: skip
    """Fill rows of a north-up grid with procedural heights and shares of valley floor."""
    for row in range(row0, row1):
        north = y0 - row * step
        for column in range(heights.shape[1]):
            height, share = procedural_height(x0 + column * step, north, centre_east, 1.5 * step, seed)
            heights[row, column] = height
            valley[row, column] = int(255.0 * share)


@njit(nogil=True, cache=True)
def bilinear(grid: Array, row: float, column: float) -> float:
    """Value between grid points, held constant outside."""
    last_row = grid.shape[0] - 1.000001
    last_column = grid.shape[1] - 1.000001
    row = min(max(row, 0.0), last_row)
    column = min(max(column, 0.0), last_column)
    r = int(row)
    c = int(column)
    v = row - r
    u = column - c
    top = grid[r, c] * (1.0 - u) + grid[r, c + 1] * u
    bottom = grid[r + 1, c] * (1.0 - u) + grid[r + 1, c + 1] * u
    return float(top * (1.0 - v) + bottom * v)


@njit(nogil=True, cache=True)
def _field_albedo(east: float, north: float, seed: int, change_seed: int, changed_share: float) -> float:
    """Albedo of a patchwork of fields; some fields carry another crop at another epoch."""
    region_x = int(math.floor(east / 3700.0 + 0.4 * value_noise(east / 2500.0, north / 2500.0, seed)))
    region_y = int(math.floor(north / 3100.0 + 0.4 * value_noise(east / 2500.0, north / 2500.0, seed + 1)))
    angle = 1.5 * _unit(region_x, region_y, seed + 2)
    cosine = math.cos(angle)
    sine = math.sin(angle)
    u = int(math.floor((east * cosine + north * sine) / (230.0 + 90.0 * _unit(region_x, region_y, seed + 3))))
    v = int(math.floor((north * cosine - east * sine) / (130.0 + 40.0 * _unit(region_x, region_y, seed + 4))))
    crop = _unit(u, v, seed + 5)
    if _unit(u, v, seed + 6) < 2.0 * changed_share - 1.0:
        crop = _unit(u, v, change_seed)
    return 0.24 + 0.13 * crop


@njit(nogil=True, cache=True)
def fill_scenery(
    heights: Array, maxima: Array, block: int, valley: Array, unstable: Array, radiance: Array, strength: Array,
    x0: float, y0: float, step: float, row0: int, row1: int, sun_east: float, sun_north: float, sun_up: float,
    snow_line_m: float, changed_share: float, epoch_seed: int, seed: int, photo: Array, photo_weight: Array,
) -> None:  # fmt: skip
    """Light that leaves the ground (0-255 for 0 to BRIGHTEST) and the strength of fine texture, by rows.

    `unstable` marks 1 glacier and 2 lake. `photo` (0-255) replaces the albedo where `photo_weight` says so.
    """
    rows, columns = heights.shape
    top = maxima.max()
    for row in range(row0, row1):
        north = y0 - row * step
        above = max(row - 1, 0)
        below = min(row + 1, rows - 1)
        for column in range(columns):
            east = x0 + column * step
            left = max(column - 1, 0)
            right = min(column + 1, columns - 1)
            height = heights[row, column]
            slope_east = (heights[row, right] - heights[row, left]) / (step * (right - left))
            slope_north = (heights[above, column] - heights[below, column]) / (step * (below - above))
            length = math.sqrt(1.0 + slope_east * slope_east + slope_north * slope_north)
            slope = math.sqrt(slope_east * slope_east + slope_north * slope_north)
            lit = (sun_up - slope_east * sun_east - slope_north * sun_north) / length
            if lit > 0.0:
                # March towards the sun until something stands in the way or nothing higher is left.
                distance = 1.5 * step
                horizontal = math.sqrt(sun_east * sun_east + sun_north * sun_north)
                rise = sun_up / horizontal
                while True:
                    ray = height + 2.0 + distance * rise
                    if ray > top:
                        break
                    shadow_row = row - distance * sun_north / horizontal / step
                    shadow_column = column + distance * sun_east / horizontal / step
                    if not (0.0 <= shadow_row < rows - 1 and 0.0 <= shadow_column < columns - 1):
                        break
                    if ray > maxima[int(shadow_row) // block, int(shadow_column) // block]:
                        distance += (block - 1) * step
                        continue
                    if heights[int(shadow_row + 0.5), int(shadow_column + 0.5)] > ray:
                        lit = 0.0
                        break
                    distance = distance * 1.06 + 0.5 * step
            lit = max(lit, 0.0)
            broad = gradient_noise(east / 3100.0, north / 3100.0, seed + 50)
            middle = gradient_noise(east / 640.0, north / 640.0, seed + 51)
            fine = value_noise(east / 170.0, north / 170.0, seed + 52)
            patch = broad + 0.6 * middle + 0.35 * fine
            tree_line = 1850.0 + 180.0 * broad + 120.0 * fine
            texture = 0.16
            albedo = 0.25 + 0.06 * patch
            if valley[row, column] > 90 and slope < 0.12:
                if gradient_noise(east / 5200.0, north / 5200.0, seed + 56) > 0.28:
                    albedo = 0.12 + 0.03 * fine
                    texture = 0.22
                else:
                    albedo = _field_albedo(east, north, seed + 60, seed + epoch_seed, changed_share)
                    texture = 0.12
            elif height < tree_line and patch > -0.25:
                albedo = 0.11 + 0.03 * fine
                texture = 0.24
            rock = _smoothstep(0.55, 0.95, slope + 0.15 * fine) + _smoothstep(2150.0, 2500.0, height + 150.0 * patch)
            rock = min(rock, 1.0)
            albedo = albedo * (1.0 - rock) + rock * (0.30 + 0.09 * middle + 0.06 * fine)
            texture = texture * (1.0 - rock) + rock * 0.2
            snow = _smoothstep(-90.0, 90.0, height - snow_line_m - 200.0 * patch - 220.0 * slope_north)
            snow *= 1.0 - _smoothstep(0.9, 1.3, slope)
            if unstable[row, column] == 1:
                crevasses = 0.10 * value_noise(east / 60.0, north / 140.0, seed + epoch_seed + 7)
                albedo = 0.48 + crevasses + 0.08 * middle
                texture = 0.1
            albedo = albedo * (1.0 - snow) + snow * (0.84 + 0.04 * fine)
            texture = texture * (1.0 - snow) + snow * 0.035
            if unstable[row, column] == 2:
                albedo = 0.035
                texture = 0.03
            share = photo_weight[row, column]
            if share > 0.0:
                albedo = albedo * (1.0 - share) + share * (0.05 + 0.5 * photo[row, column] / 255.0)
            light = albedo * (0.22 + 0.78 * lit / max(sun_up, 0.3))
            radiance[row, column] = int(min(max(255.0 * light / BRIGHTEST + 0.5, 0.0), 255.0))
            strength[row, column] = int(min(max(500.0 * texture, 0.0), 255.0))


@njit(nogil=True, cache=True)
def ground_texture(
    east: float, north: float, gsd_m: float, changed_share: float, epoch_seed: int, seed: int,
) -> float:  # fmt: skip
    """Fine texture of the ground, about -1 to 1, without what a pixel of `gsd_m` would average away."""
    total = 0.0
    wavelength = 130.0
    octave = 0
    while wavelength > 0.7 * gsd_m and wavelength > 1.5:
        weight = _smoothstep(0.7, 1.8, wavelength / gsd_m)
        # Every second octave changes between epochs.
        if octave % 2 == 1 and changed_share > 0.0:
            passing = value_noise(east / wavelength, north / wavelength, seed + epoch_seed + 130 + octave)
            total += weight * changed_share * passing
            weight *= 1.0 - changed_share
        total += weight * value_noise(east / wavelength, north / wavelength, seed + 100 + octave)
        wavelength *= 0.53
        octave += 1
    return total


@njit(nogil=True, cache=True)
def fill_reference(
    image: Array, x0: float, y0: float, step: float, row0: int, row1: int, radiance: Array, strength: Array,
    ground_x0: float, ground_y0: float, ground_step: float, shift_east: Array, shift_north: Array, shift_step: float,
    changed_share: float, epoch_seed: int, seed: int, gain: float,
) -> None:  # fmt: skip
    """Rows of the reference image: modern ground seen from above through a smooth geolocation error."""
    for row in range(row0, row1):
        for column in range(image.shape[1]):
            shift_row = row / shift_step
            shift_column = column / shift_step
            east = x0 + column * step + bilinear(shift_east, shift_row, shift_column)
            north = y0 - row * step + bilinear(shift_north, shift_row, shift_column)
            ground_row = (ground_y0 - north) / ground_step
            ground_column = (east - ground_x0) / ground_step
            texture = ground_texture(east, north, step, changed_share, epoch_seed, seed)
            contrast = bilinear(strength, ground_row, ground_column) / 500.0
            grey = bilinear(radiance, ground_row, ground_column) * (1.0 + contrast * texture)
            root = math.sqrt(max(gain * grey, 0.0) / 255.0)
            grey = 255.0 * root * math.sqrt(root)  # a gamma of 3/4
            image[row, column] = int(min(max(grey + 0.5, 1.0), 255.0))


@njit(nogil=True, cache=True)
def block_maxima(heights: Array, block: int) -> Float32Array:
    """Greatest height within one block around each block, for skipping empty air."""
    rows = (heights.shape[0] + block - 1) // block
    columns = (heights.shape[1] + block - 1) // block
    own = np.full((rows, columns), -1e9, dtype=np.float32)
    for row in range(heights.shape[0]):
        for column in range(heights.shape[1]):
            if heights[row, column] > own[row // block, column // block]:
                own[row // block, column // block] = heights[row, column]
    wide = own.copy()
    for row in range(rows):
        for column in range(columns):
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    wide[row, column] = max(wide[row, column], own[r, c])
    return wide


@njit(nogil=True, cache=True, inline="always")
def _along(low: float, middle: float, high: float, t: float) -> float:
    """Quadratic through values at t = 0, 1/2 and 1."""
    return low + t * (4.0 * middle - 3.0 * low - high) + 2.0 * t * t * (low + high - 2.0 * middle)


@njit(nogil=True, cache=True)
def meet_terrain(
    node: Array, heights: Array, maxima: Array, block: int, x0: float, y0: float, step: float, low_m: float,
    high_m: float,
) -> float:  # fmt: skip
    """Fraction of the way from `low_m` up to `high_m` at which a falling ray first touches the terrain.

    `node` holds east and north at three heights: [2:4] low, [4:6] middle, [6:8] high.
    """
    span = high_m - low_m
    run = math.sqrt((node[6] - node[2]) ** 2 + (node[7] - node[3]) ** 2)
    fine = step / max(run, step / 8.0)  # one cell sideways, or an eighth of the whole fall
    fine = min(fine, 0.125)
    t = 1.0
    gap = 1.0
    while t > 0.0:
        row = (y0 - _along(node[3], node[5], node[7], t)) / step
        column = (_along(node[2], node[4], node[6], t) - x0) / step
        block_row = min(max(int(row) // block, 0), maxima.shape[0] - 1)
        block_column = min(max(int(column) // block, 0), maxima.shape[1] - 1)
        ceiling = (maxima[block_row, block_column] - low_m) / span
        if t > ceiling:
            t = max(ceiling, t - fine * block) - 1e-9
            gap = 1.0
            continue
        gap = t * span + low_m - bilinear(heights, row, column)
        if gap <= 0.0:
            break
        t -= fine
    below = max(t, 0.0)
    above = min(below + fine, 1.0)
    row = (y0 - _along(node[3], node[5], node[7], above)) / step
    column = (_along(node[2], node[4], node[6], above) - x0) / step
    gap_above = above * span + low_m - bilinear(heights, row, column)
    gap_below = min(gap, -1e-9)
    if gap_above <= 0.0:
        return above
    # False position, the kept end halved (Illinois): within a cell the gap is nearly linear.
    kept = 0
    middle = below
    for _ in range(8):
        middle = below + (above - below) * gap_below / (gap_below - gap_above)
        row = (y0 - _along(node[3], node[5], node[7], middle)) / step
        column = (_along(node[2], node[4], node[6], middle) - x0) / step
        gap = middle * span + low_m - bilinear(heights, row, column)
        if abs(gap) < 1e-3:
            break
        if gap > 0.0:
            above = middle
            gap_above = gap
            if kept == 1:
                gap_below *= 0.5
            kept = 1
        else:
            below = middle
            gap_below = gap
            if kept == -1:
                gap_above *= 0.5
            kept = -1
    return middle


@njit(nogil=True, cache=True, inline="always")
def _coverage(distance: float, half_width: float, pixel: float) -> float:
    """Share of a pixel that a band of `half_width` covers, by distance from its middle."""
    return min(max((half_width + 0.5 * pixel - distance) / pixel, 0.0), min(1.0, 2.0 * half_width / pixel))


@njit(nogil=True, cache=True)
def expose_rows(
    out: Array, first_row: int, nodes: Array, node_step: int, pixel_mm: float, heights: Array, maxima: Array,
    block: int, x0: float, y0: float, step: float, low_m: float, high_m: float, radiance: Array, strength: Array,
    half_length: float, half_width: float, film_half_width: float, turned: bool, stripe_mm: float,
    stripe_half: float, hole_y: float, hole_radius: float, base_grey: float, span_grey: float, saturation: float,
    gamma: float, vignetting: float, grain_grey: float, scanner_grey: float, gain: float, offset: float,
    changed_share: float, epoch_seed: int, seed: int, grain_seed: int, scanner_seed: int,
) -> None:  # fmt: skip
    """Grey values of some rows of a digitised part.

    nodes : (n, m, 8) at every `node_step` pixels: film x, y (mm, undistorted), then east and north of the ray at the
    lowest, middle and highest height. The first node lies on the first pixel of these rows.
    """
    rows, columns = out.shape
    node = np.empty(8)
    for row in range(rows):
        node_row = row // node_step
        v = row / node_step - node_row
        for column in range(columns):
            node_column = column // node_step
            u = column / node_step - node_column
            corner = nodes[node_row, node_column]
            right = nodes[node_row, node_column + 1]
            below = nodes[node_row + 1, node_column]
            opposite = nodes[node_row + 1, node_column + 1]
            a = (1.0 - u) * (1.0 - v)
            b = u * (1.0 - v)
            c = (1.0 - u) * v
            d = u * v
            x = a * corner[0] + b * right[0] + c * below[0] + d * opposite[0]
            y = a * corner[1] + b * right[1] + c * below[1] + d * opposite[1]
            side = -y if turned else y
            if abs(y) > film_half_width:
                grey = 14.0
                if side < 0.0 and abs(y) > film_half_width + 0.25:
                    grey = 252.0
                    if value_noise(x / 0.35, y / 0.15, grain_seed + 5) > 0.83:
                        grey = 120.0
            else:
                grey = base_grey
                inside = _coverage(abs(x), half_length, pixel_mm) * _coverage(abs(y), half_width, pixel_mm)
                if inside > 0.0:
                    for k in range(2, 8):
                        node[k] = a * corner[k] + b * right[k] + c * below[k] + d * opposite[k]
                    t = meet_terrain(node, heights, maxima, block, x0, y0, step, low_m, high_m)
                    east = _along(node[2], node[4], node[6], t)
                    north = _along(node[3], node[5], node[7], t)
                    across = math.sqrt((right[4] - corner[4]) ** 2 + (right[5] - corner[5]) ** 2) / node_step
                    along = math.sqrt((below[4] - corner[4]) ** 2 + (below[5] - corner[5]) ** 2) / node_step
                    gsd = max(across, along)
                    # The lens is out of focus over the last 15 mm of the scan.
                    gsd *= 1.0 + 1.5 * _smoothstep(half_length - 15.0, half_length, abs(x))
                    texture = ground_texture(east, north, gsd, changed_share, epoch_seed, seed)
                    ground_row = (y0 - north) / step
                    ground_column = (east - x0) / step
                    contrast = bilinear(strength, ground_row, ground_column) / 500.0
                    light = bilinear(radiance, ground_row, ground_column) * (BRIGHTEST / 255.0)
                    light *= 1.0 + contrast * texture
                    fall = (x / half_length) ** 2 * 0.4 + (y / half_width) ** 2 * 0.6
                    light = (light + 0.015) * (1.0 - vignetting * fall)
                    shown = min(max(light / saturation, 0.0), 1.0) ** gamma
                    grey += inside * span_grey * shown
                if stripe_half > 0.0:
                    if abs(x) < half_length + 4.0:
                        line = _coverage(abs(abs(y) - stripe_mm), stripe_half, pixel_mm)
                        grey += line * (190.0 - grey)
                    along_mm = x - 10.0 * math.floor(x / 10.0 + 0.5)
                    if abs(x) < 5.0:
                        along_mm = abs(x) - 0.9  # two holes mark the centre of format
                    if abs(x) < half_length + 8.0:
                        away = math.sqrt(along_mm * along_mm + (abs(y) - hole_y) ** 2)
                        spot = min(max((hole_radius - away) / pixel_mm + 0.5, 0.0), 1.0)
                        spot *= min(1.0, (2.0 * hole_radius / pixel_mm) ** 2)
                        grey += spot * (235.0 - grey)
                if grain_grey > 0.0:
                    cell = max(0.010, pixel_mm)
                    grain = value_noise(x / cell, y / cell, grain_seed) + value_noise(
                        x / cell + 0.5, y / cell + 0.5, grain_seed + 1
                    )
                    grey += grain * grain_grey * (0.35 + 1.3 * (grey / 255.0) * (1.0 - 0.6 * grey / 255.0))
            grey = (grey - 128.0) * gain + 128.0 + offset
            if scanner_grey > 0.0:
                grey += scanner_grey * (
                    _unit(column, first_row + row, scanner_seed) + _unit(column, first_row + row, scanner_seed + 1)
                )
            out[row, column] = int(min(max(grey + 0.5, 0.0), 255.0))
