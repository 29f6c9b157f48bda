"""Compiled loops of the camera."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cosp.arrays import FloatArray, IntArray

Domain = tuple[float, float, float, float]
Pieces = tuple[FloatArray, float, FloatArray]

MAX_SCAN_ANGLE_RAD = math.radians(40.0)  # no lens of these cameras sweeps further


@njit(nogil=True, cache=True)
def project(
    parameters: FloatArray, focal_mm: float, tau_per_mm: float, ground_m: FloatArray, film_mm: FloatArray
) -> None:
    """Film points of ground points, by fixed-point iteration over the scan angle.

    Parameters
    ----------
    parameters : (13,) array
        X Y Z, their changes, omega phi kappa, their changes, IMC factor; metres, radians, mid-scan.
    focal_mm : float
    tau_per_mm : float
        Scan fraction per millimetre of film, with the sign of the scan direction.
    ground_m : (N, 3) array
    film_mm : (N, 2) array
        Filled; NaN where the point is behind the camera or outside the sweep.
    """
    sign = 1.0 if tau_per_mm > 0 else -1.0
    imc = sign * parameters[12] * focal_mm * math.cos(parameters[6])
    x = 0.0
    for i in range(ground_m.shape[0]):
        alpha = 0.0
        ny = 0.0
        nz = 0.0
        seen = False
        # Neighbours lie close together, so the last point is a good start; each step gains two to three digits.
        for _ in range(8):
            tau = x * tau_per_mm
            omega = parameters[6] + tau * parameters[9]
            phi = parameters[7] + tau * parameters[10]
            kappa = parameters[8] + tau * parameters[11]
            so, co = math.sin(omega), math.cos(omega)
            sp, cp = math.sin(phi), math.cos(phi)
            sk, ck = math.sin(kappa), math.cos(kappa)
            dx = ground_m[i, 0] - parameters[0] - tau * parameters[3]
            dy = ground_m[i, 1] - parameters[1] - tau * parameters[4]
            dz = ground_m[i, 2] - parameters[2] - tau * parameters[5]
            nx = cp * ck * dx + (co * sk + so * sp * ck) * dy + (so * sk - co * sp * ck) * dz
            ny = -cp * sk * dx + (co * ck - so * sp * sk) * dy + (so * ck + co * sp * sk) * dz
            nz = sp * dx - so * cp * dy + co * cp * dz
            if not nz < 0.0:
                seen = False
                break
            alpha = math.atan(-nx / nz)
            seen = abs(alpha) < MAX_SCAN_ANGLE_RAD
            if not seen:
                break
            step = focal_mm * alpha - x
            x += step
            if abs(step) < 1e-11:
                break
        if seen:
            film_mm[i, 0] = x
            film_mm[i, 1] = -imc * math.sin(alpha) - focal_mm * math.cos(alpha) * ny / nz
        else:
            film_mm[i, 0] = np.nan
            film_mm[i, 1] = np.nan
            x = 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def derivatives(
    parameters: FloatArray,
    focal_mm: float,
    tau_per_mm: float,
    ground_m: FloatArray,
    imaged_mm: FloatArray,
    by_all: FloatArray,
) -> None:
    """Derivatives of film points with respect to the 13 parameters and the ground point, as imaged.

    x stands on both sides of x = f atan(-Nx/Nz), for N = R (X - C) is that of the time at which x is exposed.

    Parameters
    ----------
    parameters, focal_mm, tau_per_mm, ground_m
        As for `project`.
    imaged_mm : (N, 2) array
        What `project` fills.
    by_all : (N, 2, 16) array
        Filled; NaN where the film point is.
    """
    sign = 1.0 if tau_per_mm > 0 else -1.0
    # Filled one by one: assigning whole rows takes the compiler many times as long.
    by_n = np.empty((16, 3))
    turn = np.empty((3, 3))
    n = np.empty(3)
    for i in range(ground_m.shape[0]):
        x = imaged_mm[i, 0]
        tau = x * tau_per_mm
        omega = parameters[6] + tau * parameters[9]
        phi = parameters[7] + tau * parameters[10]
        kappa = parameters[8] + tau * parameters[11]
        so, co = math.sin(omega), math.cos(omega)
        sp, cp = math.sin(phi), math.cos(phi)
        sk, ck = math.sin(kappa), math.cos(kappa)
        turn[0, 0], turn[0, 1], turn[0, 2] = (cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck)
        turn[1, 0], turn[1, 1], turn[1, 2] = (-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk)
        turn[2, 0], turn[2, 1], turn[2, 2] = (sp, -so * cp, co * cp)
        dx = ground_m[i, 0] - parameters[0] - tau * parameters[3]
        dy = ground_m[i, 1] - parameters[1] - tau * parameters[4]
        dz = ground_m[i, 2] - parameters[2] - tau * parameters[5]
        for r in range(3):
            n[r] = turn[r, 0] * dx + turn[r, 1] * dy + turn[r, 2] * dz
        for r in range(3):
            for k in range(3):
                by_n[k, r] = -turn[r, k]
                by_n[3 + k, r] = -tau * turn[r, k]
                by_n[13 + k, r] = turn[r, k]
            # Omega turns first, about the world's x axis.
            by_n[6, r] = turn[r, 1] * dz - turn[r, 2] * dy
            by_n[12, r] = 0.0
        # Phi turns about the y axis that kappa then turns to (sin kappa, cos kappa, 0): dN = -axis x N.
        by_n[7, 0], by_n[7, 1], by_n[7, 2] = (-ck * n[2], sk * n[2], ck * n[0] - sk * n[1])
        # Kappa turns last, about the camera's z axis.
        by_n[8, 0], by_n[8, 1], by_n[8, 2] = (n[1], -n[0], 0.0)
        for r in range(3):
            for k in range(6, 9):
                by_n[k + 3, r] = tau * by_n[k, r]

        sine, cosine = math.sin(x / focal_mm), math.cos(x / focal_mm)
        slope = n[1] / n[2]
        # cos^2(alpha) = 1 / (1 + (Nx/Nz)^2)
        x_by_n0, x_by_n2 = -focal_mm * cosine**2 / n[2], focal_mm * cosine**2 * n[0] / n[2] ** 2
        y_by_n1, y_by_n2 = -focal_mm * cosine / n[2], focal_mm * cosine * slope / n[2]
        x_by_tau = y_by_tau = 0.0
        for k in range(3):
            rate, speed = parameters[9 + k], parameters[3 + k]
            x_by_tau += x_by_n0 * (rate * by_n[6 + k, 0] - speed * turn[0, k])
            x_by_tau += x_by_n2 * (rate * by_n[6 + k, 2] - speed * turn[2, k])
            y_by_tau += y_by_n1 * (rate * by_n[6 + k, 1] - speed * turn[1, k])
            y_by_tau += y_by_n2 * (rate * by_n[6 + k, 2] - speed * turn[2, k])
        motion = sign * parameters[12] * math.cos(parameters[6])
        y_by_x = sine * slope - motion * cosine + tau_per_mm * y_by_tau
        for k in range(16):
            x_by = (x_by_n0 * by_n[k, 0] + x_by_n2 * by_n[k, 2]) / (1.0 - tau_per_mm * x_by_tau)
            by_all[i, 0, k] = x_by
            by_all[i, 1, k] = y_by_n1 * by_n[k, 1] + y_by_n2 * by_n[k, 2] + y_by_x * x_by
        by_all[i, 1, 6] += sign * parameters[12] * math.sin(parameters[6]) * focal_mm * sine
        by_all[i, 1, 12] -= sign * math.cos(parameters[6]) * focal_mm * sine


@njit(nogil=True, cache=True, inline="always")
def _weights(x: float, half: float, knot: float, intervals: int, cubic: bool) -> tuple[int, float, float, float, float]:
    """First spline and the values of the three or four uniform B-splines that are not zero at x."""
    s = min(max((x + half) / knot, 0.0), float(intervals))
    i = min(int(s), intervals - 1)
    u = s - i
    v = 1.0 - u
    if cubic:
        return (
            i,
            v * v * v / 6.0,
            (u * u * (3.0 * u - 6.0) + 4.0) / 6.0,
            (v * v * (3.0 * v - 6.0) + 4.0) / 6.0,
            (u * u * u / 6.0),
        )
    return i, v * v / 2.0, 0.5 + u * v, u * u / 2.0, 0.0


@njit(nogil=True, cache=True, inline="always")
def _piece(joints: FloatArray, width: float, x: float) -> tuple[int, int, float, float]:
    """Piece of film at x, the next, how far one has passed into the other, 0 to 1, and how fast it does, per mm."""
    p = 0
    while p < joints.shape[0] and x >= joints[p] + 0.5 * width:
        p += 1
    following = min(p + 1, joints.shape[0])
    if p < joints.shape[0] and x > joints[p] - 0.5 * width:
        u = (x - joints[p]) / width + 0.5
        return p, following, u * u * u * (u * (6.0 * u - 15.0) + 10.0), 30.0 * (u * (1.0 - u)) ** 2 / width
    return p, following, 0.0, 0.0


@njit(nogil=True, cache=True, inline="always")
def _part_across(half: float, y: float) -> float:
    """Part of the way from the lower edge of the film to the upper one."""
    return min(max((y + half) / (2.0 * half), 0.0), 1.0)


@njit(nogil=True, cache=True, inline="always")
def _displacement(
    table: FloatArray,
    domain: Domain,
    pieces: Pieces,
    x: float,
    y: float,
) -> tuple[float, float]:
    half_x, half_y, knot_x, knot_y = domain
    i, a0, a1, a2, a3 = _weights(x, half_x, knot_x, table.shape[0] - 3, True)
    j, b0, b1, b2, _ = _weights(y, half_y, knot_y, table.shape[1] - 2, False)
    dx = 0.0
    dy = 0.0
    for k in range(4):
        a = a0 if k == 0 else a1 if k == 1 else a2 if k == 2 else a3
        row = table[i + k]
        dx += a * (b0 * row[j, 0] + b1 * row[j + 1, 0] + b2 * row[j + 2, 0])
        dy += a * (b0 * row[j, 1] + b1 * row[j + 1, 1] + b2 * row[j + 2, 1])
    joints, width, offsets = pieces
    if joints.shape[0] > 0:
        p, following_p, t, _ = _piece(joints, width, x)
        v = _part_across(half_y, y)
        here, following = offsets[p], offsets[following_p]
        dx += (1.0 - t) * ((1.0 - v) * here[0, 0] + v * here[1, 0])
        dy += (1.0 - t) * ((1.0 - v) * here[0, 1] + v * here[1, 1])
        dx += t * ((1.0 - v) * following[0, 0] + v * following[1, 0])
        dy += t * ((1.0 - v) * following[0, 1] + v * following[1, 1])
    return dx, dy


@njit(nogil=True, cache=True)
def distort(
    table: FloatArray,
    domain: Domain,
    pieces: Pieces,
    film_mm: FloatArray,
) -> None:
    """Add the displacement of a film field to film points (N, 2), in place; NaN stays.

    Parameters
    ----------
    table : (along, across, 2) array
        Coefficients of the splines.
    domain : (half_x, half_y, knot_x, knot_y)
        Half the film that they cover, and the distance of their knots.
    pieces : (joints, width, offsets)
        Where pieces of film meet, rising, (J,); over which one passes into the next; and of each at the lower and the
        upper edge of the film, (J + 1, 2, 2), the component last.
    film_mm : (N, 2) array
    """
    for n in range(film_mm.shape[0]):
        x, y = film_mm[n, 0], film_mm[n, 1]
        if x == x and y == y:
            dx, dy = _displacement(table, domain, pieces, x, y)
            film_mm[n, 0] = x + dx
            film_mm[n, 1] = y + dy


@njit(nogil=True, cache=True)
def correct(
    table: FloatArray,
    domain: Domain,
    pieces: Pieces,
    film_mm: FloatArray,
) -> None:
    """Undo `distort`, in place: a fixed point that gains three digits a step, for the field changes slowly."""
    for n in range(film_mm.shape[0]):
        measured_x, measured_y = film_mm[n, 0], film_mm[n, 1]
        if measured_x == measured_x and measured_y == measured_y:
            x, y = measured_x, measured_y
            for _ in range(8):
                dx, dy = _displacement(table, domain, pieces, x, y)
                change = abs(measured_x - dx - x) + abs(measured_y - dy - y)
                x = measured_x - dx
                y = measured_y - dy
                if change < 1e-8:
                    break
            film_mm[n, 0] = x
            film_mm[n, 1] = y


@njit(nogil=True, cache=True)
def splines_at(
    along: int,
    across: int,
    domain: Domain,
    pieces: Pieces,
    film_mm: FloatArray,
    splines: IntArray,
    values: FloatArray,
) -> None:
    """Numbers and values (N, 12) of the splines that are not zero at film points (N, 2); (N, 16) with joints.

    The last four are the two edges of a piece of film and of the next one, counted after the splines.
    """
    half_x, half_y, knot_x, knot_y = domain
    joints, width, _ = pieces
    for n in range(film_mm.shape[0]):
        x, y = film_mm[n, 0], film_mm[n, 1]
        if not (x == x and y == y):
            splines[n] = 0
            values[n] = np.nan
            continue
        i, a0, a1, a2, a3 = _weights(x, half_x, knot_x, along - 3, True)
        j, b0, b1, b2, _ = _weights(y, half_y, knot_y, across - 2, False)
        for k in range(4):
            a = a0 if k == 0 else a1 if k == 1 else a2 if k == 2 else a3
            for m in range(3):
                splines[n, 3 * k + m] = (i + k) * across + j + m
                values[n, 3 * k + m] = a * (b0 if m == 0 else b1 if m == 1 else b2)
        if joints.shape[0] > 0:
            p, following_p, t, _ = _piece(joints, width, x)
            v = _part_across(half_y, y)
            for k in range(2):
                piece = following_p if k == 1 else p
                share = t if k == 1 else 1.0 - t
                splines[n, 12 + 2 * k] = along * across + 2 * piece
                splines[n, 13 + 2 * k] = along * across + 2 * piece + 1
                values[n, 12 + 2 * k] = share * (1.0 - v)
                values[n, 13 + 2 * k] = share * v


@njit(nogil=True, cache=True)
def field_gradient(
    table: FloatArray,
    domain: Domain,
    pieces: Pieces,
    film_mm: FloatArray,
    gradient: FloatArray,
) -> None:
    """Derivatives (N, 2, 2) of the displacement, component and direction, at film points (N, 2)."""
    half_x, half_y, knot_x, knot_y = domain
    joints, width, offsets = pieces
    intervals_x, intervals_y = table.shape[0] - 3, table.shape[1] - 2
    da = np.empty(4)
    db = np.empty(3)
    for n in range(film_mm.shape[0]):
        x, y = film_mm[n, 0], film_mm[n, 1]
        if not (x == x and y == y):
            gradient[n] = np.nan
            continue
        i, a0, a1, a2, a3 = _weights(x, half_x, knot_x, intervals_x, True)
        j, b0, b1, b2, _ = _weights(y, half_y, knot_y, intervals_y, False)
        # Beyond its edge the field keeps its value.
        scale_x = 1.0 / knot_x if abs(x) <= half_x else 0.0
        scale_y = 1.0 / knot_y if abs(y) <= half_y else 0.0
        u = min(max((x + half_x) / knot_x, 0.0), float(intervals_x)) - i
        v = min(max((y + half_y) / knot_y, 0.0), float(intervals_y)) - j
        da[0] = -0.5 * (1.0 - u) ** 2
        da[1] = 1.5 * u * u - 2.0 * u
        da[2] = 2.0 * (1.0 - u) - 1.5 * (1.0 - u) ** 2
        da[3] = 0.5 * u * u
        db[0] = v - 1.0
        db[1] = 1.0 - 2.0 * v
        db[2] = v
        for c in range(2):
            by_x = 0.0
            by_y = 0.0
            for k in range(4):
                a = a0 if k == 0 else a1 if k == 1 else a2 if k == 2 else a3
                row = table[i + k]
                by_x += da[k] * (b0 * row[j, c] + b1 * row[j + 1, c] + b2 * row[j + 2, c])
                by_y += a * (db[0] * row[j, c] + db[1] * row[j + 1, c] + db[2] * row[j + 2, c])
            gradient[n, c, 0] = by_x * scale_x
            gradient[n, c, 1] = by_y * scale_y
        if joints.shape[0] > 0:
            p, following_p, t, slope = _piece(joints, width, x)
            share = _part_across(half_y, y)
            across = 1.0 / (2.0 * half_y) if abs(y) <= half_y else 0.0
            here, following = offsets[p], offsets[following_p]
            for c in range(2):
                change_0 = following[0, c] - here[0, c]
                change_1 = following[1, c] - here[1, c]
                gradient[n, c, 0] += slope * ((1.0 - share) * change_0 + share * change_1)
                gradient[n, c, 1] += across * ((1.0 - t) * (here[1, c] - here[0, c]))
                gradient[n, c, 1] += across * (t * (following[1, c] - following[0, c]))
