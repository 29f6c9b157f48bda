"""Claims about the rectified image."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from cosp.epipolar.parallax import measure_y_parallax, node_grid
from cosp.epipolar.patches import image_patches
from cosp.epipolar.resampling import resample_window
from cosp.imaging.windows import Window, tiles
from tests.epipolar.pairs import FILM_PIXEL_MM, film_grid, rectified, table_pair


def rectified_image(film, grid, epipolar_map, shape, tile=100_000, interpolation="cubic"):
    image = np.empty(shape, np.uint8)
    for window in tiles(shape, tile):
        image[window.slices] = resample_window(
            lambda part: film[part.slices], grid, epipolar_map, window, interpolation=interpolation
        )
    return image


@pytest.mark.parametrize("interpolation", ["cubic", "lanczos"])
def test_grey_values_are_those_of_the_film_at_the_place_of_the_pixel(interpolation):
    fore, aft = table_pair("1112")
    _, rectification = rectified(fore, aft, pixel_mm=FILM_PIXEL_MM)
    grid = film_grid(fore)

    def grey(film_mm):
        return 128 + 60 * np.sin(film_mm[..., 0] / 0.9) * np.cos(film_mm[..., 1] / 1.1) + 20 * film_mm[..., 0] / 357

    film = np.rint(grey(grid.centres())).astype(np.uint8)
    image = rectified_image(film, grid, rectification.fore, rectification.shape, interpolation=interpolation)
    rows, columns = np.arange(float(image.shape[0]))[:, None], np.arange(float(image.shape[1]))[None, :]
    film_mm = rectification.fore_film(rows, columns)
    film_row, film_column = grid.pixels(film_mm)
    inside = (film_row > 4) & (film_row < grid.shape[0] - 5) & (film_column > 4) & (film_column < grid.shape[1] - 5)
    assert inside.mean() > 0.7
    error = image[inside] - grey(film_mm[inside])
    # A shift of 0.02 px changes these greys by up to 60 * 0.14 / 0.9 * 0.02 = 0.19: rounding is the larger part.
    assert error.std() < 0.5
    assert abs(error.mean()) < 0.02
    # Beyond the reach of the kernel there is nothing at all.
    outside = (film_row < -5) | (film_row > grid.shape[0] + 4) | (film_column < -5) | ~np.isfinite(film_row)
    assert outside.any()
    assert not image[outside].any()


def test_the_image_does_not_depend_on_how_it_is_cut(rng):
    fore, aft = table_pair("1117")
    _, rectification = rectified(fore, aft, pixel_mm=FILM_PIXEL_MM)
    grid = film_grid(fore)
    film = cv2.GaussianBlur(rng.integers(0, 255, grid.shape).astype(np.uint8), (0, 0), 1.0)
    whole = rectified_image(film, grid, rectification.fore, (1200, rectification.shape[1]))
    cut = rectified_image(film, grid, rectification.fore, (1200, rectification.shape[1]), tile=97)
    # The last bit may go the other way where a weight of the kernel (1/32 px steps) is a tie.
    different = whole.astype(int) - cut
    assert (different != 0).mean() < 1e-2
    assert np.abs(different).max() <= 8


def test_a_window_beyond_the_film_is_black():
    fore, aft = table_pair("1112")
    _, rectification = rectified(fore, aft, pixel_mm=FILM_PIXEL_MM)
    grid = film_grid(fore)
    beyond = Window(9000, 9010, 0, 5)
    black = resample_window(
        lambda part: pytest.fail("nothing to read"), grid, rectification.fore, beyond, interpolation="cubic"
    )
    assert_array_equal(black, np.zeros((10, 5)))


def test_films_of_textured_ground_come_out_without_y_parallax(rng):
    """From cameras and ground to the epipolar pair: level ground at 1200 m, seen from both stations."""
    fore, aft = (replace(camera, half_length_mm=35.0) for camera in table_pair("1112"))
    _, rectification = rectified(fore, aft, pixel_mm=FILM_PIXEL_MM)
    texture = sum(
        cv2.GaussianBlur(rng.standard_normal((1600, 1600)).astype(np.float32), (0, 0), s) * s for s in (1.2, 3.0, 9.0)
    )
    texture *= 35 / texture.std()
    middle = fore.locate(np.zeros(2), 1200.0)[:2]
    images = []
    for camera, film in ((fore, rectification.fore), (aft, rectification.aft)):
        grid = film_grid(camera)
        ground = (camera.locate(grid.centres(), 1200.0)[..., :2] - middle) / 45.0 + 800  # texture of 45 m
        grey = cv2.remap(texture, *(ground[..., k].astype(np.float32) for k in (0, 1)), cv2.INTER_CUBIC)
        noisy = np.clip(125 + grey + rng.normal(0, 2, grid.shape), 1, 255).astype(np.uint8)
        images.append(rectified_image(noisy, grid, film, rectification.shape))
    nodes = node_grid(rectification.shape, spacing_px=16, fewest_nodes=1)
    centres = nodes.centres()
    bounds = rectification.disparity_bounds(centres[..., 1], centres[..., 0])
    result = measure_y_parallax(
        *(image_patches(lambda window, image=image: image[window.slices], image.shape) for image in images),
        nodes,
        bounds,
        template_px=32,
        least_score=0.6,
        largest_ratio=0.85,
        smoothing_nodes=2.0,
        fewest_matches=100,
        threads=1,
    )
    summary = result.summary()
    assert summary["count"] > 300
    assert abs(summary["median_px"]) < 0.02
    assert summary["sd_px"] < 0.06
    assert summary["share_within_1_px"] == 1.0
    expected = bounds[0] + 0.4 * (bounds[1] - bounds[0])  # 1200 of 3000 m
    found = np.isfinite(result.raw_px)
    # Disparity is not quite linear in height, by 3000 m of 185 km; the rest are windows cut by the edge of the film.
    error = np.abs(result.disparity_px - expected)[found]
    assert np.median(error) < 0.2
    assert np.quantile(error, 0.98) < 0.5
