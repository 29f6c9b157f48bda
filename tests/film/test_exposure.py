from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosp.arrays import BoolArray, ByteArray
from cosp.errors import InputError
from cosp.film.exposure import Exposure, find_exposure
from cosp.imaging.resampling import block_mean
from tests.film.synthetic import LENGTH_MM, WIDTH_MM, Film, make_film

FORMAT = {"length_mm": LENGTH_MM, "width_mm": WIDTH_MM, "length_tolerance": 0.025, "width_tolerance": 0.06}


@pytest.fixture(scope="module")
def film() -> Film:
    return make_film(np.random.default_rng(7), pixel_mm=0.14, tilt_deg=0.35, bent=False)


def _found(film: Film, image: ByteArray | None = None) -> Exposure:
    return find_exposure(
        block_mean(film.image if image is None else image, 2), pixel_mm=film.pixel_mm, factor=2, **FORMAT
    )


def _centre_error_mm(found: Exposure, film: Film) -> tuple[float, float]:
    dx, dy = (f - t for f, t in zip(found.centre_px, film.centre, strict=True))
    return abs(dx) * film.pixel_mm, abs(dy) * film.pixel_mm


def test_centre_tilt_and_size_of_the_format_are_found(film):
    found = _found(film)
    x, y = _centre_error_mm(found, film)
    assert x < 0.2
    assert y < 0.02
    assert_allclose(found.tilt_deg, 0.35, atol=0.003)
    assert_allclose(found.half_length_mm, LENGTH_MM / 2, atol=0.2)
    assert_allclose(found.half_width_mm, WIDTH_MM / 2, atol=0.03)
    assert found.ends_found == (True, True)


def test_pixels_turn_film_millimetres_into_rows_and_columns(film):
    found = _found(film)
    rows, columns = found.pixels(np.array([[100.0, 0.0], [0.0, 20.0]]))
    tilt = np.radians(0.35)
    assert_allclose(columns, film.centre[0] + np.array([100 * np.cos(tilt), 20 * np.sin(tilt)]) / 0.14, atol=1.5)
    assert_allclose(rows, film.centre[1] + np.array([100 * np.sin(tilt), -20 * np.cos(tilt)]) / 0.14, atol=0.3)


def _as_dark_as_bare_film(image: ByteArray, columns: BoolArray) -> ByteArray:
    """Film of which some columns (C,) show nothing at all: not a grey level tells them from unexposed film."""
    dark = image.copy()
    bare = np.random.default_rng(8).normal(22.0, 2.0, (image.shape[0], int(columns.sum())))
    dark[:, columns] = np.where(image[:, columns] < 30, image[:, columns], np.rint(bare)).astype(np.uint8)
    return dark


@pytest.mark.parametrize("ends", [(False, True), (True, True)], ids=["one end", "both ends"])
@pytest.mark.parametrize("step", [-1.5, 0.8])
def test_a_night_that_differs_from_bare_film_by_a_grey_level_ends_where_it_does(film, ends, step):
    image = film.image.copy()
    x_mm = (np.arange(image.shape[1]) - film.centre[0]) * film.pixel_mm
    c, r = np.meshgrid(np.arange(image.shape[1]) - film.centre[0], np.arange(image.shape[0]) - film.centre[1])
    tilt = np.radians(0.35)
    x, y = (c * np.cos(tilt) + r * np.sin(tilt)) * film.pixel_mm, (r * np.cos(tilt) - c * np.sin(tilt)) * film.pixel_mm
    for side, night in zip((-1, 1), ends, strict=True):
        image = _as_dark_as_bare_film(image, night & (side * x_mm > LENGTH_MM / 2 - 40))
        here = night & (side * x > LENGTH_MM / 2 - 40) & (np.abs(x) < LENGTH_MM / 2) & (np.abs(y) < WIDTH_MM / 2)
        dim = np.random.default_rng(9).normal(22.0 + step, 2.0, image.shape)
        image[here] = np.clip(np.rint(dim), 1, 255).astype(np.uint8)[here]
    found = _found(film, image)
    error, _ = _centre_error_mm(found, film)
    assert found.ends_found == (True, True)
    assert found.centre_sd_mm[0] < 0.5
    assert error < 1.5 * found.centre_sd_mm[0]


@pytest.mark.parametrize("grey", [250, 22], ids=["snow", "night"])
def test_a_blank_end_moves_the_centre_by_less_than_its_stated_uncertainty(film, grey):
    image = film.image.copy()
    columns = np.arange(image.shape[1])
    x_mm = (columns - film.centre[0]) * film.pixel_mm
    rows, cols = np.nonzero(
        np.ones(image.shape, bool) & (x_mm > LENGTH_MM / 2 - 90)[None] & (x_mm < LENGTH_MM / 2 - 1)[None]
    )
    y_mm = -((rows - film.centre[1]) - np.tan(np.radians(0.35)) * (cols - film.centre[0])) * film.pixel_mm
    inside = np.abs(y_mm) < WIDTH_MM / 2
    image[rows[inside], cols[inside]] = grey
    if grey == 22:  # the last millimetre too
        image = _as_dark_as_bare_film(image, x_mm > LENGTH_MM / 2 - 90)
    found = _found(film, image)
    x, y = _centre_error_mm(found, film)
    assert x < max(0.3, 3 * found.centre_sd_mm[0])
    assert x < 2.0
    assert y < 0.03
    assert found.ends_found[1] is (grey == 250)


def test_two_dark_ends_are_not_taken_for_the_ends_of_the_format(film):
    """45 mm of night left, 25 mm right: the picture is too short, and a format from its edge lies off the film."""
    x_mm = (np.arange(film.image.shape[1]) - film.centre[0]) * film.pixel_mm
    night = (x_mm < -LENGTH_MM / 2 + 45) | (x_mm > LENGTH_MM / 2 - 25)
    found = _found(film, _as_dark_as_bare_film(film.image, night))
    assert found.ends_found == (False, False)
    x, _ = _centre_error_mm(found, film)
    assert x < 2.5 * found.centre_sd_mm[0]
    assert 5.0 < found.centre_sd_mm[0] < 30.0


@pytest.mark.parametrize("wrong", [0.85, 0.93, 1.08, 1.2])
def test_a_wrong_size_of_pixels_is_asked_about(film, wrong):
    with pytest.raises(InputError, match="is pixel_um right"):
        find_exposure(block_mean(film.image, 2), pixel_mm=film.pixel_mm * wrong, factor=2, **FORMAT)


def test_a_negative_is_known_for_one_and_measured_alike(film):
    positive = _found(film)
    negative = _found(film, np.where(film.image > 0, 255 - film.image, 0).astype(np.uint8))
    assert not positive.negative
    assert negative.negative
    assert_allclose(negative.centre_px, positive.centre_px, atol=0.5)
    assert_allclose(negative.half_width_mm, positive.half_width_mm, atol=0.02)


def test_a_scan_cut_to_the_format_has_its_centre_in_the_middle():
    film = make_film(np.random.default_rng(7), pixel_mm=0.14, tilt_deg=0.0, bent=False)
    column, row = film.centre
    half = [round(side / 2 / film.pixel_mm) for side in (WIDTH_MM - 0.6, LENGTH_MM - 0.6)]
    cut = film.image[round(row) - half[0] : round(row) + half[0], round(column) - half[1] : round(column) + half[1]]
    found = _found(film, cut)
    assert found.edges_found == (0.0, 0.0)
    assert found.ends_found == (False, False)
    assert_allclose(found.centre_px, [half[1] - 0.5, half[0] - 0.5], atol=3.0)
    assert 0.1 < found.centre_sd_mm[1] < 1.0
    assert 2 * found.half_width_mm <= WIDTH_MM


def test_a_scan_narrower_than_the_format_is_refused(film):
    with pytest.raises(InputError, match="the format alone has"):
        _found(film, film.image[: round(0.8 * WIDTH_MM / film.pixel_mm)])


def test_a_film_without_a_format_is_refused():
    noise = np.random.default_rng(0).integers(18, 26, (280, 2900)).astype(np.uint8)
    with pytest.raises(InputError, match="long sides of the format"):
        find_exposure(noise, pixel_mm=0.28, factor=1, **FORMAT)


def _real_frame() -> tuple[ByteArray, BoolArray]:
    folder = os.environ.get("COSP_TEST_DATA")
    if not folder:
        pytest.skip("COSP_TEST_DATA is not set: no real film")
    path = Path(folder) / "film" / "kh4a_1040-2_fwd_frame_lowres.png"
    if not path.exists():
        pytest.skip(f"{path} is not there: no real film")
    figure = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    red = figure[..., 2].astype(int) - figure[..., 1] > 60
    return figure[..., 1].copy(), red


def test_the_exposed_area_of_a_real_frame_is_found():
    grey, red = _real_frame()
    rows, columns = np.nonzero(red)
    # The rectangle is four pixels wide; its middle is the answer.
    truth = np.array([columns.min(), columns.max(), rows.min(), rows.max()]) + [1.5, -1.5, 1.5, -1.5]
    margin = np.ones(grey.shape, bool)
    margin[22:275, 32:2930] = False
    hidden = margin | cv2.dilate(red.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    filled = cv2.inpaint(grey, hidden.astype(np.uint8), 3, cv2.INPAINT_TELEA)
    found = find_exposure(filled, pixel_mm=0.28, factor=1, valid=~margin, **FORMAT)
    half = np.array([found.half_length_mm, found.half_width_mm])
    left, right = (found.pixels(np.array([s * half[0], 0.0]))[1] for s in (-1, 1))
    top, bottom = (found.pixels(np.array([0.0, s * half[1]]))[0] for s in (1, -1))
    length, width = truth[1] - truth[0], truth[3] - truth[2]
    assert_allclose([left, right], truth[:2], atol=0.005 * length)
    assert_allclose([top, bottom], truth[2:], atol=0.02 * width)
