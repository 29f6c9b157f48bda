"""Ground control: covariances against Monte Carlo, the user's own points, coverage."""

import numpy as np
import pandas as pd
import pytest
from pyproj import Transformer

from cosp.errors import NotEnoughMatchesError
from cosp.geometry.grids import PixelGrid
from cosp.matching.control import collect, coverage, film_covariance
from cosp.matching.film_image import FilmImage
from cosp.matching.ground import film_lattice

from .conftest import CRS, make_camera

HALF_LENGTH_MM, HALF_WIDTH_MM = 200.0, 27.7
POSTING = 60.0
TO_MAP = Transformer.from_crs("EPSG:4326", CRS, always_xy=True)


def height_at(east):
    """Ridges 6 km apart, at most 0.3 m per metre steep."""
    return 1000.0 + 300.0 * np.sin(np.asarray(east) / 1000.0)


def ridges(grid):
    return height_at(grid.centres()[..., 0]).astype(np.float32)


def grey_film(pixel_mm=0.14):
    shape = (round(2 * HALF_WIDTH_MM / pixel_mm), round(2 * HALF_LENGTH_MM / pixel_mm))
    pixels = np.clip(120 + 20 * np.random.default_rng(9).standard_normal(shape), 1, 250).astype(np.uint8)
    grid = PixelGrid(-(shape[1] - 1) / 2 * pixel_mm, (shape[0] - 1) / 2 * pixel_mm, pixel_mm, -pixel_mm, shape)
    return FilmImage.from_array(pixels, grid)


def ground_of(camera, film_mm):
    """Longitude, latitude, height of what film points show."""
    heights = lambda lonlat: height_at(TO_MAP.transform(lonlat[..., 0], lonlat[..., 1])[0])  # noqa: E731
    return camera.origin.geodetic_from_local(camera.locate_on(film_mm, heights, iterations=20))


def film_points(camera, rng, count):
    """Film points and where they lie on the ground."""
    film_mm = rng.uniform(-0.95, 0.95, (count, 2)) * (HALF_LENGTH_MM, HALF_WIDTH_MM)
    return film_mm, ground_of(camera, film_mm)


def matches_of(film_mm, lonlath, sigma_px=0.4, pixel_mm=0.14, rng=None):
    measured = film_mm if rng is None else film_mm + sigma_px * pixel_mm * rng.standard_normal(film_mm.shape)
    return pd.DataFrame(
        {
            "x_mm": measured[:, 0],
            "y_mm": measured[:, 1],
            "longitude_deg": lonlath[:, 0],
            "latitude_deg": lonlath[:, 1],
            "score": 0.6,
            "sigma_px": sigma_px,
            "posting_m": 40.0,
            "template_px": 25,
        }
    )


def own_points(film_mm, lonlath, **more):
    columns = {"height_m": np.nan, "sigma_px": 1.0, "sigma_ground_m": np.nan, "sigma_height_m": np.nan, **more}
    table = matches_of(film_mm, lonlath).drop(columns=["score", "posting_m", "template_px", "sigma_px"])
    return table.assign(**columns)


def gathered(matches, camera, **changes):
    settings = dict(
        heights_on=ridges, unstable_on=None, crs=CRS, dem_posting_m=POSTING, reference_shift_m=(0.0, 0.0), own=None,
        tile_mm=40, gate_px=3, min_per_tile=8, trials=100, relief=False, relief_min_places=4, relief_min_share=0.5,
        cell_mm=8, per_cell=2, max_slope_deg=40, white=252,
        scratch_grey=60, reference_sigma_m=3.0, dem_sigma_m=4.0, check_columns=10, check_rows=2, min_gcps=50,
        rng=np.random.default_rng(1),
    )  # fmt: skip
    return collect(matches, grey_film(), camera, **{**settings, **changes})


def test_covariance_on_the_film_is_that_of_trials_and_knows_the_slope():
    camera, rng = make_camera(), np.random.default_rng(2)
    film_mm, lonlath = film_points(camera, rng, 4)
    ground = camera.origin.local_from_geodetic(lonlath)
    rise = np.array([[0.3, 0.0], [0.0, -0.5], [0.0, 0.0], [0.6, 0.6]])
    match, plan, height = (np.full(4, v) for v in (0.01, 20.0, 15.0))
    covariance = film_covariance(camera, ground, match, plan, height, rise)
    trials = 20_000
    error = rng.standard_normal((trials, 1, 2)) * 20.0 * np.ones((1, 4, 1))
    moved = np.concatenate([error, (error * rise).sum(axis=2)[..., None]], axis=2)
    moved[..., 2] += 15.0 * rng.standard_normal((trials, 1))
    seen = camera.project((ground + moved).reshape(-1, 3)).reshape(trials, 4, 2)
    seen += 0.01 * rng.standard_normal(seen.shape)
    for index in range(4):
        np.testing.assert_allclose(
            np.cov(seen[:, index].T), covariance[index], rtol=0.06, atol=0.04 * covariance[index].max()
        )


def test_good_matches_become_control_and_check_and_gross_errors_are_rejected():
    camera, rng = make_camera(), np.random.default_rng(3)
    matches = matches_of(*film_points(camera, rng, 900), rng=rng)
    wrong = rng.choice(900, 60, replace=False)
    matches.loc[wrong, "x_mm"] += rng.choice([-3.0, 3.0], 60)
    gcps, summary = gathered(matches, camera)
    kept = gcps[gcps["role"] != "rejected"]
    assert 0.4 < (kept["role"] == "check").mean() < 0.6
    assert np.abs(kept[["residual_x_px", "residual_y_px"]].to_numpy()).max() < 4
    assert set(kept["source"]) == {"match"}
    assert summary["rejected"] >= 55
    assert 0.5 < summary["residual_over_sigma"]["x"] <= 1.1
    assert (kept["sigma_x_px"] > kept["sigma_px"]).all()
    assert kept["sigma_height_m"].between(4.0, np.hypot(4.0, 0.3 * 3.0) + 0.01).all()


def test_weak_matches_with_relief_are_control_where_most_agree_and_none_where_the_film_shows_a_plain():
    camera, rng = make_camera(), np.random.default_rng(4)
    film_mm, lonlath = film_points(camera, rng, 1200)
    matches = matches_of(film_mm, lonlath, rng=rng).assign(score=0.1, template_px=65)
    plain = film_mm[:, 0] > 0
    astray = plain | (rng.random(len(matches)) < 0.3)
    chance = rng.uniform(-3.0, 3.0, (len(matches), 2))
    matches.loc[astray, ["x_mm", "y_mm"]] += chance[astray]
    gcps, summary = gathered(matches, camera, relief=True, min_gcps=20)
    kept = gcps[gcps["role"] != "rejected"]
    right = film_mm[~astray]
    distance = np.linalg.norm(kept[["x_mm", "y_mm"]].to_numpy()[:, None] - right, axis=2).min(axis=1)
    assert 0.6 * len(right) < summary["agreeing"] < 1.05 * len(right)
    assert len(kept) > 100
    assert (distance < 0.3).mean() > 0.98
    assert (kept["x_mm"] < 5.0).all()
    with pytest.raises(NotEnoughMatchesError, match="0 of the 20 ground control points"):
        gathered(matches[plain], camera, relief=True, min_gcps=20)


def test_what_a_matcher_states_is_scaled_by_what_neighbours_say():
    camera, rng = make_camera(), np.random.default_rng(9)
    matches = matches_of(*film_points(camera, rng, 1500), sigma_px=0.3, rng=rng)
    own = own_points(*film_points(camera, rng, 5))
    gcps, summary = gathered(matches.assign(sigma_px=1.5), camera, own=own)
    assert 0.9 * 0.2 < summary["sigma_factor"] < 1.25 * 0.2
    points = gcps.groupby("source")["sigma_px"]
    np.testing.assert_allclose(points.get_group("match"), 1.5 * summary["sigma_factor"])
    assert (points.get_group("own") == 1.0).all()
    alone = film_lattice(HALF_LENGTH_MM * 0.95, HALF_WIDTH_MM * 0.95, 40, 5)
    _, summary = gathered(matches_of(alone, ground_of(camera, alone)), camera)
    assert summary["sigma_factor"] is None
    assert summary["median_sigma_px"] == 0.4


def test_points_on_a_lake_are_left_out_but_not_those_of_a_plain_in_whole_metres():
    camera, rng = make_camera(), np.random.default_rng(8)
    film_mm, lonlath = film_points(camera, rng, 600)
    east = np.asarray(TO_MAP.transform(lonlath[:, 0], lonlath[:, 1])[0])

    def level_within(half_m):
        def heights_on(grid):
            inside = np.abs(grid.centres()[..., 0] - 5e5) < half_m
            return np.where(inside, np.float32(1000.0), ridges(grid)).astype(np.float32)

        return heights_on

    _, lake = gathered(matches_of(film_mm, lonlath), camera, heights_on=level_within(4000.0))
    assert abs(lake["water"] - (np.abs(east - 5e5) < 4000.0).sum()) <= 6
    assert lake["water"] > 10
    _, plain = gathered(matches_of(film_mm, lonlath), camera, heights_on=level_within(1e6), min_gcps=0)
    assert plain["water"] == 0


def test_a_shift_of_the_reference_is_taken_out_of_place_and_height():
    camera, rng = make_camera(), np.random.default_rng(4)
    film_mm, lonlath = film_points(camera, rng, 500)
    east, north = TO_MAP.transform(lonlath[:, 0], lonlath[:, 1])
    off = lonlath.copy()
    off[:, 0], off[:, 1] = TO_MAP.transform(east - 120.0, north + 80.0, direction="INVERSE")
    gcps, _ = gathered(matches_of(film_mm, off), camera, reference_shift_m=(120.0, -80.0))
    back = camera.project_geodetic(gcps[["longitude_deg", "latitude_deg", "height_m"]].to_numpy())
    np.testing.assert_allclose(back, gcps[["x_mm", "y_mm"]].to_numpy(), atol=0.004)


def test_points_of_the_users_own_are_control_whatever_they_say(caplog):
    camera, rng = make_camera(), np.random.default_rng(5)
    matches = matches_of(*film_points(camera, rng, 500), rng=rng)
    film_mm, lonlath = film_points(camera, rng, 5)
    film_mm[0] += 2.0
    own = own_points(film_mm, lonlath, height_m=lonlath[:, 2], sigma_ground_m=0.5, sigma_height_m=0.7)
    gcps, summary = gathered(matches, camera, own=own)
    mine = gcps[gcps["source"] == "own"]
    assert (mine["role"] == "control").all()
    assert (summary["own"], summary["own_disagreeing"]) == (5, 1)
    np.testing.assert_allclose(mine["height_m"], lonlath[:, 2])
    np.testing.assert_allclose(mine["sigma_height_m"], 0.7)
    assert "disagree" in caplog.text


def test_twelve_points_of_the_users_own_are_enough_without_a_match():
    camera, rng = make_camera(), np.random.default_rng(6)
    none = matches_of(*film_points(camera, rng, 1)).iloc[:0]
    film_mm = film_lattice(HALF_LENGTH_MM * 0.9, HALF_WIDTH_MM * 0.9, 6, 2)
    lonlath = ground_of(camera, film_mm)
    gcps, _ = gathered(none, camera, own=own_points(film_mm, lonlath))
    assert len(gcps) == 12
    np.testing.assert_allclose(gcps["height_m"], lonlath[:, 2], atol=2.0)
    with pytest.raises(NotEnoughMatchesError, match="0 of the 50"):
        gathered(none, camera, own=own_points(film_mm, lonlath).iloc[:11])


def test_coverage_tells_a_full_film_from_one_end():
    rng = np.random.default_rng(7)
    film_mm = rng.uniform(-1, 1, (4000, 2)) * (357.4, HALF_WIDTH_MM)
    whole = coverage(film_mm, 357.4, HALF_WIDTH_MM, 20, 3)
    end = coverage(film_mm[film_mm[:, 0] > 286], 357.4, HALF_WIDTH_MM, 20, 3)
    assert (whole["cells"], whole["along"], whole["across"]) == (1.0, 1.0, 1.0)
    assert (end["along"], end["across"]) == (0.1, 1.0)
    assert np.sum(whole["counts"]) == 4000
    assert whole["evenness"] > 0.95
    assert end["evenness"] < 0.11
    assert whole["longest_gap_along_mm"] < 3
    assert 643 < end["longest_gap_along_mm"] < 647
