import numpy as np

from cosp.geometry.grids import PixelGrid
from cosp.matching.film_image import FilmImage
from cosp.matching.masks import film_faults, is_scratched, slope_deg, still_water


def film_of(pixels, pixel_mm=0.01):
    rows, columns = pixels.shape
    return FilmImage.from_array(
        pixels, PixelGrid(-columns / 2 * pixel_mm, rows / 2 * pixel_mm, pixel_mm, -pixel_mm, pixels.shape)
    )


def grain(rng, shape=(400, 1200), sigma=12.0):
    return np.clip(120 + sigma * rng.standard_normal(shape), 1, 250).astype(np.uint8)


def faults(film, points):
    return film_faults(film, np.array(points), window_mm=0.5, white=252, max_share=0.5, scratch_grey=20)


def test_slope_of_a_plane_is_its_own():
    columns = np.arange(20.0)[None, :] * np.ones((20, 1))
    np.testing.assert_allclose(slope_deg((30.0 * columns).astype(np.float32), 30.0), 45.0, atol=1e-4)


def test_overexposed_snow_is_known_and_the_rest_is_not():
    pixels = grain(np.random.default_rng(1))
    pixels[:, 600:] = 255
    overexposed, scratched = faults(film_of(pixels), [[-3.0, 0.0], [3.0, 0.0]])
    assert overexposed.tolist() == [False, True]
    assert not scratched.any()


def test_points_on_a_scratch_are_known_white_or_black():
    for grey in (235, 20):
        pixels = grain(np.random.default_rng(2))
        pixels[198:201] = grey  # 0.03 mm wide, along the whole film
        _, scratched = faults(film_of(pixels), [[0.0, 0.0], [0.0, 1.0], [-2.0, 0.1]])
        assert scratched.tolist() == [True, False, True]


def test_an_edge_or_a_road_across_the_film_is_no_scratch():
    rng = np.random.default_rng(3)
    step = grain(rng)
    step[200:] += 60
    road = grain(rng)
    road[:, 598:601] = 235
    aslant = grain(rng)
    rows = (200 + 0.2 * (np.arange(1200) - 600)).astype(int)
    aslant[rows, np.arange(1200)] = 235
    for pixels in (step, road, aslant):
        assert not faults(film_of(pixels), [[0.0, 0.0]])[1].any()


def test_a_window_too_small_for_a_line_says_nothing():
    assert not is_scratched(np.full((3, 50), 100, np.uint8), 0.01, 20)


def test_a_lake_is_water_to_its_shore_and_a_plain_is_not():
    rng = np.random.default_rng(4)
    heights = (500 + 0.5 * rng.standard_normal((80, 80))).astype(np.float32)
    heights[20:40, 30:60] = 480.0
    heights[70:, 70:] = np.nan
    water = still_water(heights)
    expected = np.zeros_like(water)
    expected[20:40, 30:60] = True
    np.testing.assert_array_equal(water, expected)
