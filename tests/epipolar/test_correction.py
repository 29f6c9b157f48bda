"""Claims about the correction of rows by measured y-parallax."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import ndimage

from cosp.epipolar.correction import RowCorrection, correction_field
from cosp.epipolar.parallax import fold_y_parallax, measure_y_parallax, node_grid
from cosp.epipolar.patches import film_patches, image_patches
from cosp.epipolar.resampling import resample_window
from cosp.geometry.grids import PixelGrid
from cosp.geometry.rays import meet
from cosp.imaging.windows import Window
from cosp.io import records
from tests.epipolar.pairs import distorted_pair, distortion_mm, film_grid

CHOICES = {
    "template_px": 32,
    "least_score": 0.6,
    "largest_ratio": 0.85,
    "smoothing_nodes": 2.0,
    "fewest_matches": 100,
    "threads": 1,
}


def measured(rectification, films, spacing_px=16):
    grids = [film_grid(camera) for camera in distorted_pair()[0]]
    patches = [
        film_patches(lambda window, film=film: film[window.slices], grid, epipolar_map)
        for film, grid, epipolar_map in zip(films, grids, (rectification.fore, rectification.aft), strict=True)
    ]
    nodes = node_grid(rectification.shape, spacing_px=spacing_px, fewest_nodes=1)
    centres = nodes.centres()
    bounds = rectification.disparity_bounds(centres[..., 1], centres[..., 0])
    return measure_y_parallax(*patches, nodes, bounds, **CHOICES)


@functools.cache
def folded():
    _, rectification, films = distorted_pair()
    before = measured(rectification, films)
    corrected = fold_y_parallax(rectification, before, smoothing_nodes=2.0)
    return before, corrected, measured(corrected, films)


def test_distortion_of_a_film_is_folded_into_the_rows():
    before, _, after = folded()
    assert before.summary()["sd_px"] > 1.0
    summary = after.summary()
    assert summary["count"] > 300
    assert abs(summary["median_px"]) < 0.03
    left = np.abs(after.raw_px[np.isfinite(after.raw_px)])
    assert (left < 0.3).mean() > 0.97
    assert left[left < 0.6].std() < 0.1


def test_matched_film_points_stay_true_and_their_rays_show_the_distortion():
    """The correction changes where a point lies in the image, never what film point it is."""
    (fore, aft), rectification, _ = distorted_pair()
    _, corrected, after = folded()
    assert corrected.fore == rectification.fore
    found = np.isfinite(after.raw_px)
    place = after.grid.centres()[found]
    fore_mm, aft_mm = corrected.conjugate_points(
        place[:, 1], place[:, 0], after.disparity_px[found], after.raw_px[found]
    )
    undistorted = aft_mm - distortion_mm(aft_mm)
    _, gap_m = meet(fore.rays(fore_mm), aft.rays(aft_mm))
    _, true_gap_m = meet(fore.rays(fore_mm), aft.rays(undistorted))
    pixel_m = 45.0  # of these films on the ground
    assert np.median(gap_m) > 0.5 * pixel_m
    assert np.median(true_gap_m) < 0.1 * pixel_m


def test_film_to_grid_and_back_is_the_identity_with_a_correction(rng):
    _, corrected, _ = folded()
    rows, columns = rng.uniform(20, corrected.shape[0] - 20, (2, 300))[0], rng.uniform(60, 300, 300)
    film_mm = corrected.aft_film(rows, columns)
    known = np.isfinite(film_mm).all(-1)
    assert known.mean() > 0.9
    back = corrected.aft_epipolar(film_mm[known])
    assert_allclose(np.stack(back), [rows[known], columns[known]], atol=1e-6)


def test_a_part_of_the_image_and_its_file_keep_the_correction(tmp_path):
    _, corrected, _ = folded()
    window = Window(100, 300, 50, 250)
    part = corrected.cut(window, margin_px=2.0)
    records.write(tmp_path / "part.json", part)
    part = records.read(tmp_path / "part.json", type(part))
    rows, columns = np.arange(20.0, 150.0)[:, None], np.arange(30.0, 120.0)[None, :]
    fore_row, fore_column = part.offset
    shift = part.disparity_shift_px
    assert_allclose(
        part.aft_film(rows, columns), corrected.aft_film(rows + fore_row, columns + fore_column - shift), atol=1e-9
    )


def test_places_get_the_same_correction_however_they_are_asked_for(rng):
    _, corrected, _ = folded()
    rows, columns = np.arange(100.0, 140.0)[:, None], np.arange(60.0, 150.0)[None, :]
    picture = corrected.aft_film(rows, columns)
    mesh = np.broadcast_arrays(rows, columns)
    order = rng.permutation(picture[..., 0].size)
    assert_array_equal(
        corrected.aft_film(mesh[0].ravel()[order], mesh[1].ravel()[order]), picture.reshape(-1, 2)[order]
    )


def test_the_compiled_spline_is_that_of_scipy(rng):
    values = rng.normal(0, 2.0, (12, 9))
    nodes = PixelGrid(7.0, 5.0, 16.0, 20.0, values.shape)
    correction = RowCorrection.through(values, nodes, pixel_mm=0.01, row0_mm=3.0, column0_mm=-2.0)
    x, y = rng.uniform(7 + 4 * 16, 7 + 4.5 * 16, 50), rng.uniform(5 + 5 * 20, 5 + 6 * 20, 50)
    place = {"pixel_mm": 0.01, "row0_mm": 3.0, "column0_mm": -2.0}
    expected = ndimage.map_coordinates(
        np.pad(values, 30, mode="reflect", reflect_type="odd"), [(y - 5) / 20 + 30, (x - 7) / 16 + 30], order=3
    )
    assert_allclose(correction.move(y, x, **place) - y, expected, atol=1e-6)
    at_nodes = nodes.centres()
    assert_allclose(correction.move(at_nodes[..., 1], at_nodes[..., 0], **place) - at_nodes[..., 1], values, atol=2e-2)
    # Beyond its nodes it goes on with what it has at the edge.
    far = correction.move(np.array([-500.0]), np.array([-300.0]), **place) + 500.0
    assert_allclose(far, values[0, 0], atol=1e-6)
    assert np.isnan(correction.move(np.array([10.0, np.nan]), np.array([np.nan, 3.0]), **place)).all()


def test_a_field_is_drawn_at_the_aft_place_without_blunders(rng):
    nodes = PixelGrid(0.0, 0.0, 32.0, 32.0, (30, 20))
    columns, rows = rng.uniform(0, 600, 3000), rng.uniform(0, 920, 3000)
    truth = 1.5 * np.sin(rows / 200) + 0.002 * columns
    values = truth + rng.normal(0, 0.1, 3000)
    values[::20] += 8.0
    field = correction_field(rows, columns, values, np.ones(3000), nodes, smoothing_nodes=1.5)
    at = nodes.centres()
    assert np.std(field - 1.5 * np.sin(at[..., 1] / 200) - 0.002 * at[..., 0]) < 0.1


@pytest.mark.parametrize("factor", [1, 4])
def test_patches_of_the_film_are_those_of_the_image(factor):
    cameras, rectification, films = distorted_pair()
    grid = film_grid(cameras[0])

    def read(window):
        return films[0][window.slices]

    image = resample_window(
        read,
        grid,
        rectification.fore,
        Window(0, *rectification.shape[:1], 0, rectification.shape[1]),
        interpolation="cubic",
    )
    row, column = np.array([120, 150, 200]) // factor, np.array([90, 100, 160]) // factor
    direct = film_patches(read, grid, rectification.fore)(row, column, (12, 16), factor)
    by_image = image_patches(lambda window: image[window.slices], image.shape)(row, column, (12, 16), factor)
    assert direct.shape == by_image.shape == (3, 12, 16)
    # Reduced, the means are of other blocks of pixels.
    assert np.corrcoef(direct.ravel(), by_image.ravel())[0, 1] > (0.99 if factor == 1 else 0.95)
    assert np.abs(direct.astype(float) - by_image).mean() < (1.0 if factor == 1 else 8.0)


@pytest.mark.parametrize("factor", [1, 8])
def test_patches_show_the_places_that_the_map_gives_each_pixel(factor):
    cameras, rectification, _ = distorted_pair()
    grid = film_grid(cameras[0])
    rows, columns = np.mgrid[: grid.shape[0], : grid.shape[1]]

    def waves(rows, columns):
        return 128 + 60 * np.sin(rows / (9.0 * factor)) + 60 * np.cos(columns / (11.0 * factor))

    film = np.rint(waves(rows, columns)).astype(np.uint8)
    row, column, size = np.array([120, 150, 200]) // factor, np.array([90, 100, 160]) // factor, (13, 22)
    patches = film_patches(lambda window: film[window.slices], grid, rectification.fore)(row, column, size, factor)
    places = (
        factor * (first[:, None] + np.arange(n) + 0.5) - 0.5 for first, n in zip((row, column), size, strict=True)
    )
    down, along = places
    film_mm = rectification.fore.film(down[:, :, None], along[:, None, :])
    film_rows, film_columns = grid.pixels(film_mm)
    on_film = (
        (film_rows > factor)
        & (film_rows < grid.shape[0] - 1 - factor)
        & (film_columns > factor)
        & (film_columns < grid.shape[1] - 1 - factor)
    )
    assert on_film.mean() > 0.8
    # Rounded at every halving, and the mean of a block is a little flatter than the wave.
    error = (patches - waves(film_rows, film_columns))[on_film]
    assert np.abs(error).max() < (1.5 if factor == 1 else 3.0)
    assert error.std() < 1.0
