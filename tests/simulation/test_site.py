"""The plan of a simulated site."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from cosp.errors import InputError
from cosp.simulation.description import pair_sheet, scene_sheet, site_config, square_about_centre
from cosp.simulation.orbit import HALF_LENGTH_MM, HALF_WIDTH_MM, geodetic_from_ecef
from cosp.simulation.site import SiteSettings, plan_site

CORNERS = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * [HALF_LENGTH_MM, HALF_WIDTH_MM]


def test_the_same_seed_gives_the_same_site_and_another_one_another():
    first, again, other = (plan_site(SiteSettings(seed=seed)) for seed in (3, 3, 4))
    assert_array_equal(first.scenes[0].exposure.offsets_rad, again.scenes[0].exposure.offsets_rad)
    assert first.terrain_grid == again.terrain_grid
    assert not np.array_equal(first.scenes[0].exposure.offsets_rad, other.scenes[0].exposure.offsets_rad)


def test_successive_frames_overlap_by_what_was_asked():
    plan = plan_site(SiteSettings(pairs=3, frame_overlap=0.07, attitude_error_deg=0.0, attitude_rate_deg_s=0.0))
    fore = [scene.exposure for scene in plan.scenes if scene.look == "fore"]
    for first, second in zip(fore[:-1], fore[1:], strict=True):
        trailing = first.ground_at(np.array([0.0, -HALF_WIDTH_MM]), 1200.0)[1]
        leading = second.ground_at(np.array([0.0, HALF_WIDTH_MM]), 1200.0)[1]
        width = first.ground_at(np.array([0.0, HALF_WIDTH_MM]), 1200.0)[1] - trailing
        assert 0.05 < (leading - trailing) / width < 0.09


def test_scenes_and_pairs_are_named_as_the_archive_names_them():
    plan = plan_site(SiteSettings(pairs=2))
    assert [scene.scene for scene in plan.scenes] == [
        "DS1104-2169DF092", "DS1104-2169DA098", "DS1104-2169DF093", "DS1104-2169DA099",
    ]  # fmt: skip
    assert plan.pairs[1] == ("1104-2169_093-099", "DS1104-2169DF093", "DS1104-2169DA099")


@pytest.mark.parametrize("descending", [True, False])
def test_sheet_corners_lie_where_their_names_say_and_off_by_the_chosen_error(descending):
    plan = plan_site(SiteSettings(corner_error_km=5.0, descending=descending))
    for scene in plan.scenes:
        nw, ne, se, sw = scene.corners_deg
        assert min(nw[0] - sw[0], ne[0] - se[0], ne[1] - nw[1], se[1] - sw[1]) > 0.0
        film = CORNERS if descending else -CORNERS
        true = scene.exposure.ground_at(film, plan.settings.ground_height_m)[:, 1::-1]
        metres = (scene.corners_deg - true) * 111.2e3 * [1.0, np.cos(np.radians(44.0))]
        off = np.hypot(*metres.T)
        assert ((off > 3.4e3) & (off < 6.6e3)).all()  # rounding to minutes takes up to 1.4 km


def test_an_ascending_satellite_moves_north():
    exposure = plan_site(SiteSettings(descending=False)).scenes[0].exposure
    first, last = geodetic_from_ecef(exposure.position(np.array([-0.1, 0.1])))
    assert last[1] > first[1]


def test_the_swath_is_as_wide_as_70_degrees_make_it():
    plan = plan_site(SiteSettings(altitude_km=163.0, ground_height_m=0.0))
    ends = plan.scenes[0].exposure.ground_at(np.array([[-HALF_LENGTH_MM, 0.0], [HALF_LENGTH_MM, 0.0]]), 0.0)
    east = (ends[1, 0] - ends[0, 0]) * 111.32e3 * np.cos(np.radians(44.0))
    assert 230e3 < east < 250e3


def test_wrong_settings_are_named():
    with pytest.raises(InputError, match="KH-9"):
        plan_site(SiteSettings(camera="KH-9"))
    with pytest.raises(InputError, match="DS0000"):
        plan_site(SiteSettings()).scene("DS0000-0000DF000")


def test_sheets_and_config_have_the_workflow_s_columns_and_keys():
    plan = plan_site(SiteSettings(name="alps"))
    header, first, *_ = scene_sheet(plan).splitlines()
    assert header.split("\t")[:5] == ["scene", "site", "parts", "nw_lat", "nw_lon"]
    assert first.split("\t")[2] == "resources/simulated/alps/parts"
    assert pair_sheet(plan).splitlines()[0] == "pair\tfore\taft"
    config = site_config(plan, scenes="scenes.tsv", pairs="pairs.tsv")
    assert config["sites"]["alps"]["check_dem"] == "resources/simulated/alps/truth/terrain.tif"
    assert SiteSettings(name="alps", **config["simulate_site"]["alps"]) == plan.settings


def test_the_area_of_interest_is_a_square_about_the_centre():
    plan = plan_site(SiteSettings())
    ring = np.array(square_about_centre(plan, 20.0)["features"][0]["geometry"]["coordinates"][0])
    assert_allclose(ring[:4].mean(axis=0), [98.0, 44.0], atol=1e-3)
    assert 0.17 < np.ptp(ring[:, 1]) < 0.20
