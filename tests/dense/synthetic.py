"""Rectified pairs with known disparity, rendered from smooth random texture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates, spline_filter


@dataclass(frozen=True)
class Pair:
    """Left and right picture, disparity of the left one (right column = left column + disparity), seen in both."""

    left: np.ndarray
    right: np.ndarray
    disparity: np.ndarray
    seen: np.ndarray


def texture(shape, rng, *, finest_px=1.0):
    """Grey values about 0 with detail at every scale from `finest_px` up."""
    total = np.zeros(shape)
    for sigma in (finest_px, 2 * finest_px, 5 * finest_px, 15 * finest_px):
        layer = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma)
        total += layer / layer.std()
    return total / total.std()


def warp(ground, disparity, *, y_parallax=0.0):
    """What the right picture shows (NaN: hidden from the left), and which left pixels both see.

    The surface with the greater disparity hides the other; y_parallax is right row minus left row by right pixel.
    """
    rows, columns = disparity.shape
    fine = np.linspace(0, columns - 1, 8 * (columns - 1) + 1)
    source = np.full((rows, columns), np.nan)  # left column that each right pixel shows
    seen = np.zeros((rows, columns), bool)
    across = np.arange(columns)
    for row in range(rows):
        values = np.interp(fine, across, disparity[row])
        places = fine + values
        pixel = np.ceil(places[:-1]).astype(int)
        advance = np.diff(places)
        covers = (places[1:] >= pixel) & (pixel >= 0) & (pixel < columns) & (np.abs(advance) < 1)
        chosen = np.flatnonzero(covers)
        chosen = chosen[np.argsort(values[chosen], kind="stable")]  # the greatest is written last
        source[row, pixel[chosen]] = fine[chosen] + (pixel[chosen] - places[chosen]) / advance[chosen] / 8
        given = np.isfinite(source[row])
        if given.any():
            back = np.interp(across + disparity[row], across[given], source[row][given], left=np.inf, right=np.inf)
            seen[row] = np.abs(back - across) < 1.5
    source_rows = np.arange(rows)[:, None] - np.broadcast_to(y_parallax, disparity.shape)
    if np.any(y_parallax):  # what a right pixel shows has the disparity of the row that it comes from
        above = np.clip(np.floor(source_rows).astype(int), 0, rows - 2)
        weight = np.clip(source_rows - above, 0, 1)
        upper, lower = (np.take_along_axis(source, row, axis=0) for row in (above, above + 1))
        source = upper + weight * (lower - upper)
    coefficients = spline_filter(ground, order=5)
    right = map_coordinates(coefficients, [source_rows, np.nan_to_num(source)], order=5, mode="mirror", prefilter=False)
    right[np.isnan(source)] = np.nan
    return right, seen


def render(ground, disparity, *, y_parallax=0.0, gain=30.0, gamma=1.0, grain=1.0, rng):
    """A pair whose left picture is `ground`; `gamma` (and less contrast) is the right one's alone."""
    right, seen = warp(ground, disparity, y_parallax=y_parallax)
    hidden = np.isnan(right)
    right[hidden] = rng.standard_normal(int(hidden.sum()))

    def film(values, contrast, exponent):
        grey = 255 * (np.clip(110 + contrast * values, 1, 254) / 255) ** exponent
        return np.clip(np.rint(grey + grain * rng.standard_normal(values.shape)), 1, 255).astype(np.uint8)

    return Pair(film(ground, gain, 1.0), film(right, gain if gamma == 1.0 else 0.8 * gain, gamma), disparity, seen)


def errors(pair, found, *, border_px=8):
    """Disparity errors, of valid pixels that both pictures see, away from the frame of either; and their share."""
    columns = pair.disparity.shape[1]
    matched = np.arange(columns) + pair.disparity
    wanted = pair.seen & (matched >= border_px) & (matched < columns - border_px)
    for edge in (np.s_[:border_px], np.s_[-border_px:], np.s_[:, :border_px], np.s_[:, -border_px:]):
        wanted[edge] = False
    given = wanted & (found.validity == 0)
    return (found.disparity - pair.disparity)[given], given.sum() / wanted.sum()
