"""Films that give no control or tie points: an error where they are alone, an empty table where others carry them."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from cosp.errors import NoOverlapError, NotEnoughMatchesError
from cosp.io import records, tables
from scripts import collect_gcps as collecting
from scripts import match_pair as matching

from .conftest import make_camera

# Numbers that the scripts only hand on.
COLLECTING = [
    *("tile_mm", "gate_px", "min_per_tile", "trials", "cell_mm", "per_cell", "max_slope_deg", "white"),
    *("scratch_grey", "reference_sigma_m", "dem_sigma_m", "check_columns", "check_rows", "min_gcps"),
    *("relief_min_places", "relief_min_share", "relief_min_gcps"),
]
MATCHING = [
    *("template_px", "search_px", "min_score", "max_ratio", "max_return_px", "candidates", "gate_px", "tile_mm"),
    *("min_per_tile", "trials", "min_ties"),
]


def footprint(path, _kind):
    look = "aft" if "aft" in str(path) else "fore"
    return SimpleNamespace(
        camera=make_camera(look), sigma_m=1200.0, reference="neighbours" if look == "aft" else "image"
    )


@pytest.fixture
def bare(monkeypatch):
    """The scripts without the files they would read."""
    for script in (collecting, matching):
        monkeypatch.setattr(script.records, "read", footprint)
        monkeypatch.setattr(script.references, "heights_on", lambda *_: lambda grid: np.zeros(grid.shape, np.float32))
        monkeypatch.setattr(script.rasters, "info", lambda _: SimpleNamespace(grid=None))
    monkeypatch.setattr(collecting.references, "posting_m", lambda _: 30.0)
    monkeypatch.setattr(collecting, "FilmImage", lambda *_: None)
    monkeypatch.setattr(matching, "FilmImage", lambda *_: None)
    return monkeypatch


def collect(folder, *, needed):
    tables.write(folder / "matches.parquet", pd.DataFrame({"x_mm": np.empty(0)}))
    collecting.collect_gcps(
        [folder / "matches.parquet"], "film", "fore", "dem", None, None, None, folder / "gcps.parquet",
        folder / "gcps.json", needed=needed, reference_dem_heights="ellipsoidal", shift_search_m=0.0,
        correct_reference_shift=False, seed=1, **dict.fromkeys(COLLECTING, 1),
    )  # fmt: skip


def match(folder, *, needed):
    matching.match_pair(
        "fore.tif", "aft.tif", "fore", "aft", "dem", folder / "ties.parquet", folder / "ties.json",
        names=["first", "second"], needed=needed, reference_dem_heights="ellipsoidal", matcher="structural", seed=1,
        threads=1, **dict.fromkeys(MATCHING, 1),
    )  # fmt: skip


def test_a_film_without_control_says_why_where_others_carry_it(bare, tmp_path):
    def too_few(*_, **__):
        raise NotEnoughMatchesError("the scene: 3 of the 50 ground control points needed remain")

    bare.setattr(collecting, "collect", too_few)
    with pytest.raises(NotEnoughMatchesError, match="3 of the 50"):
        collect(tmp_path, needed=True)
    collect(tmp_path, needed=False)
    table, said = tables.read(tmp_path / "gcps.parquet"), records.read_json(tmp_path / "gcps.json")
    assert len(table) == 0
    assert {"x_mm", "longitude_deg", "height_m", "role", "sigma_px", "sigma_ground_m"} <= set(table)
    assert (said["control"], said["reason"]) == (0, "the scene: 3 of the 50 ground control points needed remain")


def test_neighbours_that_do_not_meet_say_why_and_stop_nothing(bare, tmp_path):
    asked = {}

    def apart(*_, offset_m, **__):
        asked["offset_m"] = offset_m
        raise NoOverlapError("they show no common ground")

    bare.setattr(matching, "match_films", apart)
    with pytest.raises(NoOverlapError):
        match(tmp_path, needed=True)
    match(tmp_path, needed=False)
    table, said = tables.read(tmp_path / "ties.parquet"), records.read_json(tmp_path / "ties.json")
    assert list(table)[:4] == ["first_x_mm", "first_y_mm", "second_x_mm", "second_y_mm"]
    assert (len(table), said["count"], said["reason"]) == (0, 0, "they show no common ground")
    assert (said["first"], said["second"]) == ("DS1104-2169DF092", "DS1104-2169DA092")
    # Only the frame that its neighbours placed may be far off.
    assert asked["offset_m"] == pytest.approx(3600.0)
