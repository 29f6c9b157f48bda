"""Claims about the rectification of whole films, with the cameras of the paper's table."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from numpy.testing import assert_allclose, assert_array_equal

from cosp.camera.field import FilmField, FilmSteps
from cosp.epipolar import kernels
from cosp.epipolar.correspondences import FilmMapping, height_range, measured_conjugates, virtual_conjugates
from cosp.epipolar.polynomials import Basis, evaluate
from cosp.epipolar.rectification import fit_rectification
from cosp.errors import NoOverlapError
from cosp.geometry.grids import PixelGrid
from cosp.geometry.rays import meet
from cosp.imaging.windows import Window
from cosp.io import records
from tests.epipolar.pairs import ascending, mapping, rectified, table_pair

MISSIONS = ("1112", "1117")


def fresh_conjugates(fore, aft, rng, count=4000, heights=(0.0, 3000.0)):
    """Conjugate points that no fit has seen, with their heights."""
    film = rng.uniform(-1, 1, (count, 2)) * [fore.half_length_mm, fore.half_width_mm]
    height = rng.uniform(*heights, count)
    seen = aft.project(fore.locate(film, height))
    inside = mapping(aft).holds(seen)
    return film[inside], seen[inside], height[inside]


@pytest.mark.parametrize("mission", MISSIONS)
def test_whole_films_share_rows_to_a_thousandth_of_a_pixel(mission, rng):
    fore, aft = table_pair(mission)
    _, rectification = rectified(fore, aft)
    fore_mm, aft_mm, _ = fresh_conjugates(fore, aft, rng)
    assert len(fore_mm) > 3000
    y_parallax = rectification.aft_epipolar(aft_mm)[0] - rectification.fore_epipolar(fore_mm)[0]
    assert np.abs(y_parallax).max() < 1e-3
    assert rectification.model_largest_px < 1e-3
    assert rectification.model_rms_px < 2e-4


@pytest.mark.parametrize("mission", MISSIONS)
def test_six_kilometres_of_relief_are_within_a_hundredth_of_a_pixel(mission):
    _, rectification = rectified(*table_pair(mission), heights=(0.0, 2000.0, 4000.0, 6000.0))
    assert rectification.model_largest_px < 0.01


@pytest.mark.parametrize(
    ("mission", "degree", "rms_px", "largest_px"),
    [("1112", 4, 0.14, 0.86), ("1117", 4, 0.08, 0.60), ("1112", 6, 0.002, 0.012), ("1117", 5, 0.034, 0.19)],
)
def test_total_degree_polynomials_leave_what_was_published_for_them(mission, degree, rms_px, largest_px):
    _, rectification = rectified(*table_pair(mission), basis=Basis(degree, degree, total=True))
    assert rectification.model_rms_px == pytest.approx(rms_px, rel=0.2)
    assert rectification.model_largest_px == pytest.approx(largest_px, rel=0.3)


def test_film_moved_by_the_lens_is_rectified_as_well():
    """KH-4A: image motion compensation by the lens draws lines into an S."""
    fore, aft = (replace(camera, imc_factor=0.014) for camera in table_pair("1112"))
    _, rectification = rectified(fore, aft)
    assert rectification.model_largest_px < 1e-3


@pytest.mark.parametrize("mission", MISSIONS)
def test_film_to_grid_and_back_is_the_identity(mission, rng):
    fore, aft = table_pair(mission)
    _, rectification = rectified(fore, aft)
    fore_mm, aft_mm, _ = fresh_conjugates(fore, aft, rng, count=1000)
    assert rectification.inverse_largest_px < 1e-5
    for film, film_mm in ((rectification.fore, fore_mm), (rectification.aft, aft_mm)):
        rows, columns = film.epipolar(film_mm)
        assert np.isfinite(rows).all()
        assert_allclose(film.film(rows, columns), film_mm, atol=1e-5 * 0.007)
        again = film.epipolar(film.film(np.rint(rows), np.rint(columns)))
        assert_allclose(np.stack(again), np.rint([rows, columns]), atol=1e-5)


def test_the_grid_holds_the_overlap_and_disparities_lie_about_zero(rng):
    fore, aft = table_pair("1112")
    _, rectification = rectified(fore, aft)
    fore_mm, aft_mm, height = fresh_conjugates(fore, aft, rng)
    rows, columns = rectification.fore_epipolar(fore_mm)
    aft_rows, aft_columns = rectification.aft_epipolar(aft_mm)
    assert 100_000 < rectification.shape[0] < 107_000
    assert 7_000 < rectification.shape[1] < 11_000
    for r, c in ((rows, columns), (aft_rows, aft_columns)):
        assert r.min() > -0.5
        assert r.max() < rectification.shape[0] - 0.5
        assert c.min() > -0.5
        assert c.max() < rectification.shape[1] - 0.5
    disparity = aft_columns - columns
    low, high = rectification.disparity_range_px
    assert low + high == pytest.approx(0.0, abs=1e-6)
    assert disparity.min() > low
    assert disparity.max() < high
    # 3 km of relief at 0.2255 px per metre of height is 680 px at one place
    at_low, at_high = rectification.disparity_bounds(rows, columns)
    assert np.median(at_high - at_low) == pytest.approx(680, rel=0.03)
    assert (at_high - at_low).max() < 760
    inside = (disparity > at_low - 0.1) & (disparity < at_high + 0.1)
    assert inside.all()
    lowest = height < 30
    assert np.abs(disparity - at_low)[lowest].max() < 0.3 * 30  # higher ground has the larger disparity


def test_conjugate_points_meet_at_the_ground_they_came_from(rng):
    fore, aft = table_pair("1117")
    _, rectification = rectified(fore, aft)
    fore_mm, aft_mm, height = fresh_conjugates(fore, aft, rng, count=500)
    rows, columns = rectification.fore_epipolar(fore_mm)
    disparity = rectification.aft_epipolar(aft_mm)[1] - columns
    found_fore, found_aft = rectification.conjugate_points(rows, columns, disparity)
    ground, gap_m = meet(fore.rays(found_fore), aft.rays(found_aft))
    assert gap_m.max() < 0.01
    assert_allclose(fore.origin.geodetic_from_local(ground)[:, 2], height, atol=0.01)


def test_y_parallax_moves_the_aft_row(rng):
    _, rectification = rectified(*table_pair("1112"))
    rows, columns = rng.uniform(2e4, 8e4, 100), rng.uniform(2000, 6000, 100)
    shift = rng.uniform(-3, 3, 100)
    _, aft_mm = rectification.conjugate_points(rows, columns, np.full(100, 20.0), shift)
    found_rows, found_columns = rectification.aft_epipolar(aft_mm)
    assert_allclose(found_rows, rows + shift, atol=1e-5)
    assert_allclose(found_columns, columns + 20.0, atol=1e-5)
    nothing, aft_nothing = rectification.conjugate_points(rows, columns, np.full(100, np.nan))
    assert np.isfinite(nothing).all()
    assert np.isnan(aft_nothing).all()


def test_swapping_fore_and_aft_only_changes_the_sign_of_disparity(rng):
    fore, aft = table_pair("1112")
    _, one = rectified(fore, aft)
    _, other = rectified(aft, fore)
    fore_mm, aft_mm, _ = fresh_conjugates(fore, aft, rng)
    disparity = one.aft_epipolar(aft_mm)[1] - one.fore_epipolar(fore_mm)[1]
    swapped = other.aft_epipolar(fore_mm)[1] - other.fore_epipolar(aft_mm)[1]
    assert np.ptp(disparity) > 600
    assert_allclose(swapped, -disparity, atol=1e-6)
    assert_allclose(other.disparity_range_px, [-d for d in one.disparity_range_px[::-1]], atol=1e-6)
    assert abs(other.shape[0] - one.shape[0]) < 0.01 * one.shape[0]
    assert other.shape[1] == one.shape[1]
    # rows keep their order too: the same sense along the scan
    rows, swapped_rows = one.fore_epipolar(fore_mm)[0], other.aft_epipolar(fore_mm)[0]
    assert np.corrcoef(rows, swapped_rows)[0, 1] > 0.9999


def test_ascending_passes_are_rectified_like_descending_ones(rng):
    fore, aft = (ascending(camera) for camera in table_pair("1112"))
    assert fore.angles_deg[2] == pytest.approx(185.7, abs=0.1)
    _, rectification = rectified(fore, aft)
    _, descending = rectified(*table_pair("1112"))
    fore_mm, aft_mm, _ = fresh_conjugates(fore, aft, rng, count=1000)
    y_parallax = rectification.aft_epipolar(aft_mm)[0] - rectification.fore_epipolar(fore_mm)[0]
    assert np.abs(y_parallax).max() < 1e-3
    assert rectification.shape == pytest.approx(descending.shape, abs=3)
    assert rectification.fore.direction_deg == pytest.approx(descending.fore.direction_deg, abs=0.05)


def with_fields(cameras, rng):
    """The cameras on films with a smooth distortion of 1.5 px rms per axis at 7 um, changing over 60 x 40 mm."""
    distorted = []
    for camera in cameras:
        size = {"half_length_mm": camera.half_length_mm, "half_width_mm": camera.half_width_mm}
        field = FilmField.flat(**size, knots_along_mm=20.0, knots_across_mm=18.0)
        x, y = (a.ravel() for a in np.meshgrid(*field.centres_mm(), indexing="ij"))
        apart = ((x[:, None] - x) / 60.0) ** 2 + ((y[:, None] - y) / 40.0) ** 2
        root = np.linalg.cholesky(np.exp(-apart / 2) + 1e-8 * np.eye(len(x)))
        values = 1.5 * 0.007 * root @ rng.standard_normal((len(x), 2))
        distorted.append(replace(camera, film_field=field.with_coefficients(values.reshape(*field.shape, 2))))
    return distorted


@pytest.mark.slow
def test_polynomials_of_high_degree_do_not_run_away_where_the_images_hold_no_film(rng):
    _, rectification = rectified(*with_fields(table_pair("1112"), rng), basis=Basis(10, 48))
    rows, columns = (
        np.linspace(0, size - 1, count) for size, count in zip(rectification.shape, (301, 41), strict=True)
    )
    low, high = rectification.disparity_bounds(rows[:, None], columns[None, :])
    assert np.isfinite(low).all()
    range_px = np.ptp(rectification.disparity_range_px)
    assert (high - low).max() < 1.2 * range_px
    for film in (rectification.fore, rectification.aft):
        film_mm = film.film(rows[:, None], columns[None, :])
        known = np.isfinite(film_mm[..., 0])
        assert known.mean() > 0.8
        back_rows, _ = film.epipolar(film_mm)
        away = np.abs(back_rows - rows[:, None])[known & np.isfinite(back_rows)]
        assert (away > 0.2).mean() < 0.002
        # Places a row apart on the image lie as far apart on the film everywhere.
        step = np.linalg.norm(np.diff(film_mm, axis=0), axis=-1)
        assert 0.9 * np.nanmedian(step) < np.nanmin(step)
        assert np.nanmax(step) < 1.1 * np.nanmedian(step)


@pytest.mark.slow
def test_a_film_field_of_the_cameras_is_followed_by_higher_degrees(rng):
    pair = with_fields(table_pair("1112"), rng)
    heights = (0.0, 2000.0, 4000.0, 6000.0)
    _, low = rectified(*pair, heights=heights)
    assert low.model_rms_px > 0.1
    _, high = rectified(*pair, heights=heights, basis=Basis(10, 48))
    assert high.model_rms_px < 0.002
    assert high.model_largest_px < 0.01
    assert high.inverse_largest_px < 0.002
    fore_mm, aft_mm, _ = fresh_conjugates(*pair, rng, heights=(0.0, 6000.0))
    rows, columns = high.aft_epipolar(aft_mm)
    y_parallax = rows - high.fore_epipolar(fore_mm)[0]
    assert np.isfinite(y_parallax).mean() > 0.99
    assert np.nanstd(y_parallax) < 0.002
    assert np.nanmax(np.abs(y_parallax)) < 0.01
    # And back: what the image shows there is what the film shows.
    error_px = np.linalg.norm(high.aft.film(rows, columns) - aft_mm, axis=-1) / high.pixel_mm
    assert np.nanmax(error_px) < 0.005


def with_rough_fields(cameras, rng):
    """The cameras on films as an adjustment finds them at 7 um: 1.5 px at knots free of each other, in four scans."""
    distorted = []
    for camera in cameras:
        size = {"half_length_mm": camera.half_length_mm, "half_width_mm": camera.half_width_mm}
        field = FilmField.flat(**size, knots_along_mm=17.4, knots_across_mm=13.9)
        steps = FilmSteps.none_at(np.array([-190.0, 2.0, 195.0]) + rng.normal(0, 4, 3), width_mm=3.0)
        steps = steps.with_offsets(0.007 * rng.normal(0, 1, (4, 2, 2)))
        field = replace(field, steps=steps).with_coefficients(1.5 * 0.007 * rng.standard_normal((*field.shape, 2)))
        distorted.append(replace(camera, film_field=field))
    return distorted


@pytest.mark.parametrize("mission", MISSIONS)
def test_rough_fields_of_the_cameras_leave_nothing_in_six_kilometres_of_relief(mission, rng):
    pair = with_rough_fields(table_pair(mission), rng)
    choices = {"heights": (0.0, 2000.0, 4000.0, 6000.0)}
    _, followed = rectified(*pair, **choices)
    assert followed.model_rms_px > 0.5
    _, rectification = rectified(*pair, film_of=FilmMapping.of, **choices)
    assert rectification.model_largest_px < 2e-3
    assert rectification.inverse_largest_px < 1e-4
    # Film points are measured ones all the same, both ways.
    fore_mm, aft_mm, height = fresh_conjugates(*pair, rng, heights=(0.0, 6000.0))
    rows, columns = rectification.fore_epipolar(fore_mm)
    aft_rows, aft_columns = rectification.aft_epipolar(aft_mm)
    assert np.isfinite(rows).mean() > 0.999
    assert np.nanmax(np.abs(aft_rows - rows)) < 2e-3
    for film, places, film_mm in (
        (rectification.fore, (rows, columns), fore_mm),
        (rectification.aft, (aft_rows, aft_columns), aft_mm),
    ):
        error_px = np.linalg.norm(film.film(*places) - film_mm, axis=-1) / rectification.pixel_mm
        assert np.nanmax(error_px) < 1e-3
    low, high = rectification.disparity_bounds(rows, columns)
    part = (aft_columns - columns - low) / (high - low)
    assert_allclose(part, height / 6000.0, atol=0.02)


def test_a_field_goes_with_the_rectification_into_its_file(tmp_path, rng):
    pair = with_rough_fields(table_pair("1112"), rng)
    _, rectification = rectified(*pair, film_of=FilmMapping.of)
    records.write(tmp_path / "rectification.json", rectification)
    back = records.read(tmp_path / "rectification.json", type(rectification))
    assert back.fore.film_field == pair[0].film_field
    rows, columns = rng.uniform(0, 9e4, 50), rng.uniform(500, 7000, 50)
    assert_array_equal(back.aft_film(rows, columns), rectification.aft_film(rows, columns))


@pytest.mark.parametrize(("basis", "least_px", "most_px"), [(Basis(2, 12), 0.0, 0.35), (Basis(4, 4, True), 0.8, 3.0)])
def test_tie_points_alone_rectify_distorted_films(basis, least_px, most_px, rng):
    """No cameras: 3000 tie points with 0.3 px of noise, one in twenty wrong."""
    pair = with_fields(table_pair("1112"), rng)
    fore_mm, aft_mm, _ = fresh_conjugates(*pair, rng, count=3200)
    measured = aft_mm + rng.normal(0, 0.3 * 0.007, aft_mm.shape)
    wrong = rng.random(len(measured)) < 0.05
    measured[wrong] += rng.uniform(-0.5, 0.5, (wrong.sum(), 2))
    conjugates = measured_conjugates(fore_mm, measured, degree=4)
    rectification = fit_rectification(
        conjugates, tuple(mapping(c) for c in pair), pixel_mm=0.007, basis=basis, disparity_margin_px=8.0
    )
    _, by_cameras = rectified(*table_pair("1112"))
    assert rectification.fore.direction_deg == pytest.approx(by_cameras.fore.direction_deg, abs=1.0)
    assert rectification.aft.direction_deg == pytest.approx(by_cameras.aft.direction_deg, abs=1.0)
    fore_mm, aft_mm, _ = fresh_conjugates(*pair, rng)
    rows, columns = rectification.fore_epipolar(fore_mm)
    aft_rows, aft_columns = rectification.aft_epipolar(aft_mm)
    y_parallax = aft_rows - rows
    assert np.isfinite(y_parallax).mean() > 0.97
    assert least_px < np.nanstd(y_parallax) < most_px
    low, high = rectification.disparity_bounds(rows, columns)
    disparity = aft_columns - columns
    assert np.nanmean((disparity > low - 4) & (disparity < high + 4)) > 0.96


def test_the_pixel_is_free(rng):
    fore, aft = table_pair("1112")
    _, fine = rectified(fore, aft)
    _, coarse = rectified(fore, aft, pixel_mm=0.056)
    assert np.array(coarse.shape) == pytest.approx(np.array(fine.shape) / 8, abs=1.5)
    assert coarse.disparity_range_px[1] == pytest.approx(fine.disparity_range_px[1] / 8, abs=1e-6)


def test_the_margin_widens_the_disparity_range():
    pair = table_pair("1112")
    _, plain = rectified(*pair)
    _, wide = rectified(*pair, margin_px=12.0)
    assert np.array(wide.disparity_range_px) - plain.disparity_range_px == pytest.approx([-12.0, 12.0])


def test_an_area_of_interest_is_a_window_with_a_narrower_range(rng):
    fore, aft = table_pair("1117")
    _, whole = rectified(fore, aft)
    corner = fore.locate(np.array([60.0, -5.0]), 1500.0)
    area = corner + np.array([[e, n, 0.0] for e in (0, 20e3) for n in (0, 12e3)])
    ground = fore.origin.geodetic_from_local(area)
    at_heights = np.concatenate([np.column_stack([ground[:, :2], np.full(4, h)]) for h in (0.0, 3000.0)])
    window = whole.window_of(fore.project_geodetic(at_heights), halo_px=40)
    part = whole.cut(window, margin_px=4.0)
    assert 9_000 < part.shape[0] < 14_000
    assert np.diff(part.disparity_range_px) < 0.85 * np.diff(whole.disparity_range_px)
    assert abs(sum(part.disparity_range_px)) < 2
    assert part.offset == (window.row0, window.column0 - (window.column0 - part.offset[1]))

    fore_mm, aft_mm, _ = fresh_conjugates(fore, aft, rng, count=20_000)
    rows, columns = whole.fore_epipolar(fore_mm)
    inside = (rows >= window.row0) & (rows < window.row1) & (columns >= window.column0) & (columns < window.column1)
    assert inside.sum() > 300
    part_rows, part_columns = part.fore_epipolar(fore_mm[inside])
    assert_allclose(part_rows, rows[inside] - part.offset[0], atol=1e-6)
    assert_allclose(part_columns, columns[inside] - part.offset[1], atol=1e-6)
    aft_rows, aft_columns = part.aft_epipolar(aft_mm[inside])
    assert_allclose(aft_rows, part_rows, atol=1e-3)
    disparity = aft_columns - part_columns
    assert disparity.min() > part.disparity_range_px[0]
    assert disparity.max() < part.disparity_range_px[1]
    low, high = part.disparity_bounds(part_rows, part_columns)
    assert (disparity > low - 0.1).all()
    assert (disparity < high + 0.1).all()
    # all of the window's ground lies on both images
    assert aft_columns.min() > -0.5
    assert aft_columns.max() < part.shape[1] - 0.5


def test_an_area_elsewhere_is_an_error():
    fore, aft = table_pair("1117")
    _, whole = rectified(fore, aft)
    elsewhere = fore.project(np.array([[9e5, 9e5, 0.0], [9.2e5, 9e5, 0.0]]))
    with pytest.raises(NoOverlapError, match="outside the epipolar grid"):
        whole.cut(whole.window_of(elsewhere, halo_px=10), margin_px=4.0)


def test_films_that_share_no_ground_are_an_error():
    fore, aft = table_pair("1112")
    away = replace(aft, position_m=(aft.position_m[0], aft.position_m[1] + 400e3, aft.position_m[2]))
    with pytest.raises(NoOverlapError, match="share no ground"):
        virtual_conjugates(mapping(fore), mapping(away), np.array([0.0, 3000.0]))


def test_heights_count_only_where_both_films_see_the_ground():
    fore, aft = table_pair("1112")
    film = np.array([[0.0, 0.0], [100.0, 5.0], [-200.0, 0.0]])
    height = np.array([500.0, 1700.0, np.nan])
    ground = fore.locate(film, np.nan_to_num(height))
    unseen = np.array([[9e5, 9e5, 8000.0]])
    found = height_range(
        mapping(fore), mapping(aft), np.vstack([ground, unseen]), np.append(height, 8000.0), margin_m=100.0
    )
    assert found == (400.0, 1800.0)
    with pytest.raises(NoOverlapError, match="none of 1 points"):
        height_range(mapping(fore), mapping(aft), unseen, np.array([8000.0]), margin_m=100.0)


def test_a_rectification_survives_its_file(tmp_path, rng):
    fore, aft = table_pair("1112")
    _, rectification = rectified(fore, aft)
    records.write(tmp_path / "rectification.json", rectification)
    back = records.read(tmp_path / "rectification.json", type(rectification))
    rows, columns = rng.uniform(0, 9e4, 50), rng.uniform(500, 7000, 50)
    assert_array_equal(back.fore_film(rows, columns), rectification.fore_film(rows, columns))
    assert_array_equal(back.aft_film(rows, columns), rectification.aft_film(rows, columns))
    assert back.shape == rectification.shape


def test_film_points_do_not_depend_on_how_they_are_asked_for(rng):
    """One by one, as a list, as a picture: the same bits, whatever was collected before."""
    _, rectification = rectified(*table_pair("1112"))
    rows, columns = np.arange(30_000.0, 30_040.0)[:, None], np.arange(100.0, 190.0)[None, :]
    picture = rectification.fore_film(rows, columns)
    mesh = np.broadcast_arrays(rows, columns)
    order = rng.permutation(picture[..., 0].size)
    listed = rectification.fore_film(mesh[0].ravel()[order], mesh[1].ravel()[order])
    assert_array_equal(listed, picture.reshape(-1, 2)[order])
    assert_array_equal(rectification.fore_film(30_017.0, 133.0), picture[17, 33])


def test_film_pixels_are_film_points_in_pixels_of_the_raster():
    _, rectification = rectified(*table_pair("1117"))
    grid = PixelGrid(-357.0, 27.7, 0.007, -0.007, (7914, 102_000))
    window = Window(90_000, 90_200, 3000, 3300)
    shown = rectification.aft.film_window(window, grid)
    corner = (shown.row0, shown.column0)
    rows, columns = rectification.aft.film_pixels(window, grid, corner)
    assert rows.dtype == columns.dtype == np.float32
    # Nothing is needed outside what is shown, and not much is shown that is not needed.
    assert rows.min() >= 1
    assert columns.min() >= 1
    assert rows.max() <= shown.shape[0] - 2
    assert columns.max() <= shown.shape[1] - 2
    assert shown.shape[0] < rows.max() - rows.min() + 8
    assert shown.shape[1] < columns.max() - columns.min() + 8
    film_mm = rectification.aft_film(np.arange(90_000.0, 90_200)[:, None], np.arange(3000.0, 3300)[None, :])
    expected = grid.pixels(film_mm)
    assert_allclose(rows + float(corner[0]), expected[0], atol=1e-3)
    assert_allclose(columns + float(corner[1]), expected[1], atol=1e-3)


def test_compiled_inverse_equals_its_plain_twin(rng):
    """Sum over powers and Chebyshev terms at each point, without runs and without the expansion along the row."""
    _, rectification = rectified(*table_pair("1112"))
    film = rectification.fore
    rows, columns = rng.uniform(1e3, 1e5, 200), rng.uniform(600, 9000, 200)
    row_mm = film.row0_mm + rows * film.pixel_mm
    u = (film.column0_mm + columns * film.pixel_mm) / film.half_u_mm
    v_mm = chebyshev.chebval2d(u, (row_mm - film.row_centre_mm) / film.row_half_mm, film.inverse)
    c, s = math.cos(math.radians(film.direction_deg)), math.sin(math.radians(film.direction_deg))
    x = film.centre_mm[0] + c * u * film.half_u_mm + s * v_mm
    y = film.centre_mm[1] + s * u * film.half_u_mm - c * v_mm
    assert_allclose(film.film(rows, columns), np.stack([x, y], axis=-1), atol=1e-9)


def test_nothing_is_said_beyond_the_overlap():
    """Polynomials run away beyond their points: NaN there, both ways."""
    _, rectification = rectified(*table_pair("1112"))
    rows, columns = np.array([-4000.0, 5e4, 1.06e5]), np.array([4000.0, 20_000.0, 4000.0])
    assert np.isnan(rectification.fore_film(rows, columns)).all()
    film_mm = np.array([[390.0, 0.0], [0.0, 45.0], [np.nan, 0.0]])
    assert np.isnan(rectification.fore_epipolar(film_mm)).all()


def test_kernels_evaluate_at_nan_give_nan():
    values = np.empty(1)
    kernels.evaluate(np.ones((4, 5)), np.array([np.nan]), np.array([0.2]), values)
    assert np.isnan(values[0])
    assert np.isnan(evaluate(np.ones((4, 5)), np.array([0.1]), np.array([np.nan]))).all()
