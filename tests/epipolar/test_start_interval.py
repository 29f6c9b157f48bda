import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from cosp.epipolar.start_interval import disparities_about
from cosp.imaging.windows import Window
from tests.epipolar.pairs import rectified, table_pair

SIDE = 300
MARGIN_M = 50.0
WINDOW = 700  # px a side


@pytest.fixture(scope="module")
def surface():
    """Cameras, their rectification, waves of 200 m on a grid of 20 m in the middle, and a window on them."""
    fore, aft = table_pair("1112")
    _, rectification = rectified(fore, aft, pixel_mm=0.028, margin_px=16.0)
    middle = fore.locate_geodetic(np.zeros(2), 1200.0)
    north, east = np.mgrid[:SIDE, :SIDE] * 20.0
    lon = middle[0] + (east - 10 * SIDE) / (111_200 * np.cos(np.radians(middle[1])))
    lat = middle[1] + (north - 10 * SIDE) / 111_200
    height = 1200 + 200 * np.sin(east / 900) * np.cos(north / 700)
    rows, columns = rectification.fore_epipolar(fore.project_geodetic(middle))
    row0, column0 = int(rows) - WINDOW // 4, int(columns) - WINDOW // 4
    window = Window(row0, row0 + WINDOW // 2, column0, column0 + WINDOW // 2)
    return fore, aft, rectification, np.stack([lon, lat, height], axis=-1), window


def found_about(surface, unsure):
    fore, aft, rectification, lonlath, window = surface
    return disparities_about(
        rectification,
        fore.project_geodetic,
        aft.project_geodetic,
        lonlath[..., :2],
        lonlath[..., 2],
        lonlath[..., 2],
        unsure,
        window,
        margin_m=MARGIN_M,
        least_spacing_px=16.0,
    )


def places_of(surface, shift_m, spacing_px):
    """Place among the nodes, and disparity, of the surface raised, where the window shows it."""
    fore, aft, rectification, lonlath, window = surface
    ground = (lonlath + [0, 0, shift_m]).reshape(-1, 3)
    rows, columns = rectification.fore_epipolar(fore.project_geodetic(ground))
    _, aft_columns = rectification.aft_epipolar(aft.project_geodetic(ground))
    rows, columns, disparity = rows - window.row0, columns - window.column0, aft_columns - columns
    inside = (rows >= 0) & (rows < WINDOW // 2) & (columns >= 0) & (columns < WINDOW // 2)
    return np.array([rows, columns])[:, inside] / spacing_px, disparity[inside]


def test_the_interval_holds_ground_within_the_margin_and_little_else(surface):
    unsure = np.zeros((SIDE, SIDE), bool)
    lowest, highest, spacing_px = found_about(surface, unsure)
    assert spacing_px >= 16.0
    for shift_m, least, most in ((0, 0.999, 1.0), (40, 0.999, 1.0), (-40, 0.999, 1.0), (250, 0, 0.02), (-250, 0, 0.02)):
        places, disparity = places_of(surface, shift_m, spacing_px)
        low, high = (map_coordinates(nodes, places, order=1, mode="nearest") for nodes in (lowest, highest))
        assert len(disparity) > 5000
        assert least <= ((disparity >= low) & (disparity <= high)).mean() <= most


def test_unsure_ground_and_what_no_surface_covers_keep_the_whole_range(surface):
    _, _, rectification, lonlath, _ = surface
    unsure = np.zeros((SIDE, SIDE), bool)
    unsure[SIDE // 2 - 20 : SIDE // 2 + 20, SIDE // 2 - 20 : SIDE // 2 + 20] = True
    sure, _, spacing_px = found_about(surface, np.zeros_like(unsure))
    lowest, highest, _ = found_about(surface, unsure)
    low, high = rectification.disparity_range_px
    free = (lowest == low) & (highest == high)
    assert 0.02 < free.mean() < 0.6
    np.testing.assert_array_equal(lowest[~free], sure[~free])
    places, _ = places_of((*surface[:3], lonlath[unsure], surface[4]), 0, spacing_px)
    low_there = map_coordinates(lowest, places, order=1, mode="nearest")
    np.testing.assert_allclose(low_there, low, atol=1e-6)
    lonlath = lonlath.copy()
    lonlath[: SIDE // 2, :, 2] = np.nan
    half, _, _ = found_about((*surface[:3], lonlath, surface[4]), np.zeros((SIDE, SIDE), bool))
    assert 0.3 < (half == low).mean() < 0.8
