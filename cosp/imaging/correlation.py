"""Normalised cross-correlation of many small windows at once, and its peak to a fraction of a pixel."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft

from cosp.arrays import Float32Array, FloatArray
from cosp.imaging import kernels

# Transforms are taken of so many pixels at a time: enough to keep the FFT busy, few enough to stay in the cache.
_BATCH_PIXELS = 1 << 20
# A rival peak counts only if it is more than this far from the highest one, in either direction.
_PEAK_RADIUS_PX = 3
# Windows whose variance is below this part of their mean square, or of the whole search image's, are flat.
FLAT = 1e-6


def ncc_surfaces(templates: FloatArray, searches: FloatArray) -> Float32Array:
    """Zero-mean normalised cross-correlation of each template at every place inside its search image.

    Exact at each place: mean and variance are those of the part of the search image under the template. With several
    channels each channel loses its own mean, and products and variances are summed over the channels, so a channel
    counts as much as its variance. A flat template or a flat part of the search image correlates with 0.

    Parameters
    ----------
    templates : (N, h, w) or (N, C, h, w) array
    searches : (N, H, W) or (N, C, H, W) array
        At least as large as the templates.

    Returns
    -------
    (N, H - h + 1, W - w + 1) array
        Between -1 and 1. Element (i, j) belongs to the template's first pixel on pixel (i, j) of the search image; the
        centre of the surface to template and search image sharing their centre.

    References
    ----------
    [Lewis1995]
    """
    if templates.ndim == 3 and searches.ndim == 3:
        templates, searches = templates[:, None], searches[:, None]
    if templates.ndim != 4 or searches.ndim != 4 or templates.shape[:2] != searches.shape[:2]:
        raise ValueError(f"templates {templates.shape} and searches {searches.shape} differ in count or channels")
    count, channels, height, width = templates.shape
    rows, columns = searches.shape[2] - height + 1, searches.shape[3] - width + 1
    if rows < 1 or columns < 1:
        raise ValueError(f"search image {searches.shape[2:]} is smaller than the template {templates.shape[2:]}")

    surfaces = np.empty((count, rows, columns), np.float32)
    batch = max(1, _BATCH_PIXELS // (channels * searches.shape[2] * searches.shape[3]))
    for start in range(0, count, batch):
        part = slice(start, start + batch)
        surfaces[part] = _ncc_of_batch(templates[part], searches[part])
    return surfaces


def _ncc_of_batch(templates: FloatArray, searches: FloatArray) -> Float32Array:
    """Correlation surfaces of a few (N, C, h, w) templates in (N, C, H, W) search images."""
    pixels = templates.shape[2] * templates.shape[3]
    template = np.subtract(templates, templates.mean(axis=(2, 3), keepdims=True), dtype=np.float32)
    # Without the mean of the whole search image nothing changes but the rounding of the sums.
    search = np.subtract(searches, searches.mean(axis=(2, 3), keepdims=True), dtype=np.float32)

    # The valid lags never wrap, so a circular correlation of the size of the search image is enough.
    rows = searches.shape[2] - templates.shape[2] + 1
    columns = searches.shape[3] - templates.shape[3] + 1
    size = (fft.next_fast_len(searches.shape[2], real=True), fft.next_fast_len(searches.shape[3], real=True))
    spectrum = fft.rfft2(template, s=size)
    np.conj(spectrum, out=spectrum)
    spectrum *= fft.rfft2(search, s=size)
    products = fft.irfft2(spectrum.sum(axis=1), s=size)[:, :rows, :columns]

    search_energy, template_energy = np.empty((len(search), rows, columns)), np.empty((len(search), 1, 1))
    kernels.box_energy(search, search_energy)
    kernels.box_energy(template, template_energy)
    flat_search = FLAT * _squares(search) * (pixels / (search.shape[2] * search.shape[3]))
    flat_template = FLAT * _squares(np.asarray(templates, np.float32))
    textured = (search_energy > flat_search) & (template_energy > flat_template)
    norm = np.sqrt(np.where(textured, search_energy * template_energy, 1.0))
    return np.where(textured, np.clip(products / norm, -1.0, 1.0), 0.0).astype(np.float32)


def _squares(images: Float32Array) -> Float32Array:
    """Sums of the squares of each (C, H, W) image, (N, 1, 1)."""
    return np.asarray([np.vdot(image, image) for image in images], np.float32)[:, None, None]


def subpixel_peaks(surfaces: FloatArray) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Place and height of the highest peak of each correlation surface.

    The place between pixels is the top of the quadratic surface through the peak and its eight neighbours. A peak on
    the border is no peak (the surface may go on rising outside), nor is a surface with a NaN under its top: the shift
    is then NaN, the score still that of the highest pixel.

    Parameters
    ----------
    surfaces : (N, rows, columns) array

    Returns
    -------
    shift_rc : (N, 2) array, px
        (row, column) of the peak relative to the centre of the surface, ((rows - 1) / 2, (columns - 1) / 2).
    score : (N,) array
        Value of the highest pixel.
    ratio : (N,) array
        Highest value more than 3 px away from the peak, divided by the peak: near 1 where the match is ambiguous, 0
        where there is no rival.
    """
    count, rows, columns = surfaces.shape
    if count == 0:
        return np.empty((0, 2)), np.empty(0), np.empty(0)
    filled = np.where(np.isnan(surfaces), -np.inf, surfaces)
    row, column = np.divmod(filled.reshape(count, -1).argmax(axis=1), columns)
    index = np.arange(count)
    score = surfaces[index, row, column].astype(np.float64)

    away_row = np.abs(np.arange(rows)[None] - row[:, None]) > _PEAK_RADIUS_PX
    away_column = np.abs(np.arange(columns)[None] - column[:, None]) > _PEAK_RADIUS_PX
    rival = np.where(away_row[:, :, None] | away_column[:, None, :], filled, -np.inf).max(axis=(1, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(score > 0, np.maximum(rival, 0.0) / score, 1.0)

    shift = np.full((count, 2), np.nan)
    inside = np.flatnonzero((row > 0) & (row < rows - 1) & (column > 0) & (column < columns - 1))
    if inside.size:
        patches = sliding_window_view(surfaces, (3, 3), axis=(1, 2))[inside, row[inside] - 1, column[inside] - 1]
        shift[inside, 0] = row[inside] - (rows - 1) / 2
        shift[inside, 1] = column[inside] - (columns - 1) / 2
        shift[inside] += _quadratic_top(patches.astype(np.float64))
    return shift, score, ratio


def _quadratic_top(patches: NDArray[np.float64]) -> NDArray[np.float64]:
    """(row, column) of the top of the least-squares quadratic surface of (N, 3, 3) values, NaN where it has none."""
    offset = np.array([-1.0, 0.0, 1.0])
    slope_r = np.einsum("nij,i->n", patches, offset) / 6.0
    slope_c = np.einsum("nij,j->n", patches, offset) / 6.0
    bend_r = np.einsum("nij,i->n", patches, np.array([1.0, -2.0, 1.0])) / 3.0
    bend_c = np.einsum("nij,j->n", patches, np.array([1.0, -2.0, 1.0])) / 3.0
    twist = np.einsum("nij,i,j->n", patches, offset, offset) / 4.0
    determinant = bend_r * bend_c - twist * twist
    top = (determinant > 0) & (bend_r < 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        row = (twist * slope_c - bend_c * slope_r) / determinant
        column = (twist * slope_r - bend_r * slope_c) / determinant
    shift = np.stack([row, column], axis=-1)
    # A top that lies outside the nine pixels is an extrapolation of a shape that is not a peak.
    return np.where((top & (np.abs(shift).max(axis=-1) <= 1.0))[:, None], shift, np.nan)
