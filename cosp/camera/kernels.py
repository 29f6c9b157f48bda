"""Compiled loops of the camera."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cosp.arrays import FloatArray

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
