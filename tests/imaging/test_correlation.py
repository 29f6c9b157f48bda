"""Claims about normalised cross-correlation and its sub-pixel peak."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import ndimage

from cosp.imaging.correlation import ncc_surfaces, subpixel_peaks


@pytest.fixture
def rng():
    return np.random.default_rng(1970)


def smooth_texture(rng, shape, sigma_px):
    """Texture with its exact translation: a function that samples it anywhere (a band-limited sum by spectrum)."""
    spectrum = np.fft.rfft2(rng.standard_normal(shape))
    frequency_r = np.fft.fftfreq(shape[0])[:, None]
    frequency_c = np.fft.rfftfreq(shape[1])[None]
    spectrum *= np.exp(-2 * (np.pi * sigma_px) ** 2 * (frequency_r**2 + frequency_c**2))

    def shifted_by(rows, columns):
        return np.fft.irfft2(spectrum * np.exp(-2j * np.pi * (frequency_r * rows + frequency_c * columns)), s=shape)

    return shifted_by


def plain_ncc(template, search):
    """Zero-mean NCC, written as its definition; (C, h, w) in (C, H, W)."""
    _, h, w = template.shape
    rows, columns = search.shape[1] - h + 1, search.shape[2] - w + 1
    surface = np.zeros((rows, columns))
    a = template - template.mean(axis=(1, 2), keepdims=True)
    for i in range(rows):
        for j in range(columns):
            b = search[:, i : i + h, j : j + w]
            b = b - b.mean(axis=(1, 2), keepdims=True)
            surface[i, j] = (a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum())
    return surface


@pytest.mark.parametrize("channels", [1, 3])
def test_surfaces_equal_the_definition_of_ncc_at_every_lag(rng, channels):
    templates = rng.normal(120, 30, (4, channels, 9, 11)).astype(np.float32)
    searches = rng.normal(90, 50, (4, channels, 17, 23)).astype(np.float32)
    surfaces = ncc_surfaces(templates, searches)
    assert surfaces.dtype == np.float32
    assert surfaces.shape == (4, 9, 13)
    for surface, template, search in zip(surfaces, templates.astype(float), searches.astype(float), strict=True):
        assert_allclose(surface, plain_ncc(template, search), atol=2e-6)


def test_one_channel_may_be_left_out(rng):
    templates, searches = rng.random((3, 8, 8)), rng.random((3, 20, 20))
    assert_allclose(ncc_surfaces(templates, searches), ncc_surfaces(templates[:, None], searches[:, None]), atol=0)


def test_the_result_does_not_depend_on_the_batch(rng):
    templates, searches = rng.random((40, 64, 64)), rng.random((40, 200, 200))
    many = ncc_surfaces(templates, searches)
    assert_allclose(many[17], ncc_surfaces(templates[17:18], searches[17:18])[0], atol=0)


def test_gain_and_offset_of_grey_values_change_nothing(rng):
    templates, searches = rng.random((5, 16, 16)), rng.random((5, 40, 40))
    gain = rng.uniform(0.2, 4, (5, 1, 1))
    offset = rng.uniform(0, 200, (5, 1, 1))
    assert_allclose(ncc_surfaces(templates * gain + offset, searches), ncc_surfaces(templates, searches), atol=1e-4)


def test_flat_ground_correlates_with_nothing(rng):
    searches = np.full((2, 40, 40), 255.0)
    searches[1, :, 24:] = rng.normal(120, 20, (40, 16))
    surfaces = ncc_surfaces(rng.normal(120, 20, (2, 16, 16)), searches)
    assert not surfaces[0].any()
    assert not surfaces[1, :, :9].any()
    assert surfaces[1, :, 10:].any()
    assert not ncc_surfaces(np.full((1, 16, 16), 93.0), rng.random((1, 40, 40))).any()


def test_known_shifts_come_back_to_a_few_hundredths_of_a_pixel_under_change_of_contrast(rng):
    shifts = rng.uniform(-6, 6, (60, 2))
    templates, searches = [], []
    for shift in shifts:
        shifted_by = smooth_texture(rng, (64, 64), sigma_px=1.2)
        still, moved = shifted_by(0, 0), shifted_by(*shift)
        templates.append(still[16:48, 16:48])
        searches.append(120 + 0.4 * moved / still.std() * 40 + rng.normal(0, 0.5, moved.shape))
    measured, score, ratio = subpixel_peaks(ncc_surfaces(np.array(templates), np.array(searches)))
    error = measured - shifts
    assert np.abs(error).max() < 0.1
    assert 0.002 < np.sqrt(np.mean(error**2)) < 0.035  # exactly zero would mean that the shifts were not sub-pixel
    assert score.min() > 0.9
    assert ratio.max() < 0.6


def test_even_surfaces_are_measured_from_their_centre_between_pixels(rng):
    texture = ndimage.gaussian_filter(rng.standard_normal((32, 33)), 1.5)
    shift, _, _ = subpixel_peaks(ncc_surfaces(texture[None, 8:24, 8:24], texture[None]))
    # The template begins at (8, 8); the surface of 17 x 18 places has its centre at (8, 8.5).
    assert_allclose(shift, [[0.0, -0.5]], atol=0.05)


def test_a_quadratic_top_is_found_exactly():
    row, column = np.mgrid[-4:5, -4:5]
    shift = np.array([0.31, -0.22])
    r, c = row - 1 - shift[0], column + 2 - shift[1]
    surface = 0.9 - 0.03 * r**2 - 0.05 * c**2 + 0.02 * r * c
    measured, _, _ = subpixel_peaks(surface[None])
    assert_allclose(measured, [[1.31, -2.22]], atol=1e-12)


def test_repetitive_ground_has_a_ratio_near_one(rng):
    tile = ndimage.gaussian_filter(rng.standard_normal((12, 12)), 1.2, mode="wrap")
    repeated = np.tile(tile, (4, 4))
    _, _, ratio = subpixel_peaks(ncc_surfaces(repeated[None, 10:34, 10:34], repeated[None]))
    assert ratio[0] > 0.999
    unique = ndimage.gaussian_filter(rng.standard_normal((48, 48)), 1.2)
    _, _, ratio = subpixel_peaks(ncc_surfaces(unique[None, 10:34, 10:34], unique[None]))
    assert ratio[0] < 0.6


def test_a_peak_on_the_border_is_not_a_peak():
    row, column = np.mgrid[:9, :9]
    shift, score, _ = subpixel_peaks((0.5 - 0.001 * ((row - 0) ** 2 + (column - 4) ** 2))[None])
    assert np.isnan(shift).all()
    assert score[0] == 0.5


def test_windows_that_do_not_belong_together_are_refused(rng):
    with pytest.raises(ValueError, match="smaller than the template"):
        ncc_surfaces(rng.random((2, 9, 9)), rng.random((2, 8, 20)))
    with pytest.raises(ValueError, match="differ in count"):
        ncc_surfaces(rng.random((2, 9, 9)), rng.random((3, 20, 20)))
