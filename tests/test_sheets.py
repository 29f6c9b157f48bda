"""Whatever is wrong in config and sheets is said at once, with file, row, column, found and expected."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from cosp import sheets
from cosp.errors import InputError

HEADER = ["scene", "site", "parts", *sheets.CORNER_COLUMNS]
CORNERS = [43.95, 96.5, 43.95, 99.8, 43.75, 99.8, 43.75, 96.5]


def _row(scene: str, *, north: float = 0.0, site: str = "here", corners: list[float] | None = None) -> list[str]:
    values = list(CORNERS if corners is None else corners)
    values[::2] = [value + north for value in values[::2]]
    return [scene, site, "scans", *map(str, values)]


def _write(path: Path, rows: list[list[str]]) -> Path:
    path.write_text("".join("\t".join(row) + "\n" for row in rows), encoding="utf-8")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A site with one pair, without a fault."""
    (tmp_path / "dem.tif").touch()
    _write(tmp_path / "scenes.tsv", [HEADER, _row("DS1104-2169DF092"), _row("DS1104-2169DA098")])
    _write(tmp_path / "pairs.tsv", [["pair", "fore", "aft"], ["one", "DS1104-2169DF092", "DS1104-2169DA098"]])
    return tmp_path


SETTINGS: dict[str, Any] = {
    "scenes": "scenes.tsv",
    "pairs": "pairs.tsv",
    "sites": {"here": {"reference_dem": "dem.tif"}},
}


def _faults(folder: Path, settings: dict[str, Any]) -> tuple[sheets.Fault, ...]:
    with pytest.raises(sheets.FaultySheets) as raised:
        sheets.load(settings, file="my.yaml", folder=folder)
    return raised.value.faults


def test_a_faultless_site_loads_with_every_default_filled_in(folder: Path) -> None:
    project = sheets.load(SETTINGS, folder=folder)
    fore = project.scenes["DS1104-2169DF092"]
    assert (fore.look, fore.camera, fore.pixel_um, fore.date, fore.block) == (
        "fore",
        "KH-4B",
        7.0,
        None,
        "1104-2169_here",
    )
    site = project.settings["sites"]["here"]
    assert (site["crs"], site["dem_resolution_m"], site["reference_dem_heights"]) == ("auto", 10, "ellipsoidal")
    assert site["reference_image"] is None
    assert project.pairs["one"].aft == "DS1104-2169DA098"


def test_the_keys_of_the_contract_alone_make_a_config_that_loads(folder: Path) -> None:
    for name in ("image.tif", "glaciers.gpkg"):
        (folder / name).touch()
    site = {
        "reference_dem": "dem.tif",
        "reference_dem_heights": "egm96",
        "reference_image": "image.tif",
        "unstable_terrain": "glaciers.gpkg",
        "crs": "EPSG:32647",
        "dem_resolution_m": 25,
    }
    project = sheets.load({"scenes": "scenes.tsv", "sites": {"here": site}}, folder=folder)
    assert project.settings["sites"]["here"].items() >= site.items()
    assert list(project.pairs) == ["1104-2169_092-098"]


def test_loading_leaves_the_given_settings_as_they_were(folder: Path) -> None:
    settings = copy.deepcopy(SETTINGS)
    sheets.load(settings, folder=folder)
    assert settings == SETTINGS


@pytest.mark.parametrize(
    ("scene", "mission", "orbit", "descending", "look", "frame"),
    [
        ("DS1104-2169DF092", 1104, "2169", True, "fore", "092"),
        ("DS1117-2071DF008", 1117, "2071", True, "fore", "008"),
        ("DS1022-1024AA006", 1022, "1024", False, "aft", "006"),
        ("DS9034-1012DA017", 9034, "1012", True, "aft", "017"),
        ("DS9034A-024DF141", 9034, "024", True, "fore", "141"),
    ],
)
def test_an_archive_id_says_mission_pass_heading_look_and_frame(
    scene: str, mission: int, orbit: str, descending: bool, look: str, frame: str
) -> None:
    assert sheets.parse_scene_id(scene) == sheets.SceneId(mission, orbit, descending, look, frame)


@pytest.mark.parametrize("scene", ["", "DS1104", "DS1104-2169DX092", "DS1104-2169DF92", "ds1104-2169DF092", "D3C1216"])
def test_what_is_not_an_archive_id_is_refused(scene: str) -> None:
    with pytest.raises(ValueError, match="archive id"):
        sheets.parse_scene_id(scene)


def _change(**cells: str) -> list[str]:
    row = dict(zip(HEADER, _row("DS1104-2169DF092"), strict=True)) | cells
    return [row[column] for column in HEADER]


@pytest.mark.parametrize(
    ("cells", "column", "expected"),
    [
        ({"scene": "DS1104-2169XF092"}, "scene", "archive id"),
        ({"scene": "DS1204-2169DF092"}, "scene", "1101-1117 (KH-4B)"),
        ({"site": "there"}, "site", "here"),
        ({"parts": ""}, "parts", "folder"),
        ({"nw_lat": "north"}, "nw_lat", "number"),
        ({"nw_lat": "96.5"}, "nw_lat", "at most 90"),
        ({"ne_lon": "-190"}, "ne_lon", "at least -180"),
        ({"se_lat": ""}, "se_lat", "latitude of the south-east corner"),
        ({"se_lat": "23.75"}, "nw_lat", "latitude"),
    ],
)
def test_a_wrong_cell_is_named_with_file_row_column_and_what_was_expected(
    folder: Path, cells: dict[str, str], column: str, expected: str
) -> None:
    _write(folder / "scenes.tsv", [HEADER, _row("DS1104-2169DA098"), _change(**cells)])
    faults = [fault for fault in _faults(folder, SETTINGS) if fault.file == "scenes.tsv"]
    assert [(fault.row, fault.column) for fault in faults] == [(3, column)]
    assert expected in faults[0].expected
    wrong = next(iter(cells.values()))
    assert wrong in str(faults[0])
    assert str(faults[0]).startswith("scenes.tsv, row 3, column ")


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        ("pixel_um", "0", "at least 1"),
        ("pixel_um", "seven", "number"),
        ("camera", "KH-9", "KH-4A"),
        ("look", "forward", "fore, aft"),
        ("date", "12.8.1968", "1968-08-11"),
        ("block", "a/b", "form"),
    ],
)
def test_a_wrong_optional_cell_is_named(folder: Path, column: str, value: str, expected: str) -> None:
    rows = [[*HEADER, column], [*_row("DS1104-2169DF092"), value], [*_row("DS1104-2169DA098"), ""]]
    _write(folder / "scenes.tsv", rows)
    (fault,) = (fault for fault in _faults(folder, SETTINGS) if fault.file == "scenes.tsv")
    assert (fault.row, fault.column) == (2, column)
    assert expected in fault.expected
    assert value in fault.found


def test_optional_cells_override_what_the_id_says(folder: Path) -> None:
    extra = ["date", "pixel_um", "camera", "look", "block"]
    rows = [
        [*HEADER, *extra],
        [*_row("DS1104-2169DF092"), "1968-08-12", "56", "KH-4A", "fore", "mine"],
        [*_row("DS1104-2169DA098"), "", "14", "", "aft", "mine"],
    ]
    _write(folder / "scenes.tsv", rows)
    project = sheets.load(SETTINGS, folder=folder)
    fore = project.scenes["DS1104-2169DF092"]
    assert (fore.date, fore.pixel_um, fore.camera, fore.block) == ("1968-08-12", 56.0, "KH-4A", "mine")
    assert project.scenes["DS1104-2169DA098"].pixel_um == 14.0


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ([column for column in HEADER if column != "sw_lon"], "south-west"),
        ([*HEADER, "pixel_mu"], "pixel_um"),
        ([*HEADER, "nw_lat"], "each column once"),
    ],
)
def test_a_wrong_header_is_said_once_and_not_for_every_row(folder: Path, header: list[str], expected: str) -> None:
    _write(folder / "scenes.tsv", [header, *[["x"] * len(header)] * 5])
    faults = [fault for fault in _faults(folder, SETTINGS) if fault.file == "scenes.tsv"]
    assert len(faults) == 1
    assert faults[0].row == 1
    assert expected in str(faults[0])


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "header line"),
        (b"scene,site,parts\n", "tabs"),
        ("scene\tsite\n\xe9".encode("latin-1"), "UTF-8"),
    ],
)
def test_a_file_that_is_no_sheet_is_refused(folder: Path, content: bytes, expected: str) -> None:
    (folder / "scenes.tsv").write_bytes(content)
    assert any(expected in str(fault) for fault in _faults(folder, SETTINGS))


def test_a_sheet_that_is_not_there_is_said(folder: Path) -> None:
    (folder / "scenes.tsv").unlink()
    assert any("no such file" in fault.found for fault in _faults(folder, SETTINGS))


def test_a_scene_given_twice_names_both_rows(folder: Path) -> None:
    _write(folder / "scenes.tsv", [HEADER, *[_row("DS1104-2169DF092")] * 2, _row("DS1104-2169DA098")])
    (fault,) = _faults(folder, SETTINGS)
    assert (fault.row, fault.column) == (3, "scene")
    assert "row 2" in fault.found


@pytest.mark.parametrize(
    ("row", "column", "expected"),
    [
        (["one", "DS1104-2169DF093", "DS1104-2169DA098"], "fore", "DS1104-2169DF092"),
        (["one", "DS1104-2169DA098", "DS1104-2169DF092"], "fore", "a fore scene"),
        (["a b", "DS1104-2169DF092", "DS1104-2169DA098"], "pair", "form"),
        (["one", "DS1104-2169DF092", ""], "aft", "aft scene"),
        (["one", "DS1104-2169DF092", "DS1105-1001DA098"], "aft", "one block"),
    ],
)
def test_a_wrong_pair_is_named(folder: Path, row: list[str], column: str, expected: str) -> None:
    scenes = [_row("DS1104-2169DF092"), _row("DS1104-2169DA098"), _row("DS1105-1001DA098")]
    _write(folder / "scenes.tsv", [HEADER, *scenes])
    _write(folder / "pairs.tsv", [["pair", "fore", "aft"], row])
    faults = _faults(folder, SETTINGS)
    assert (faults[0].file, faults[0].row, faults[0].column) == ("pairs.tsv", 2, column)
    assert expected in faults[0].expected


@pytest.mark.parametrize(
    ("change", "key", "nearest"),
    [
        ({"scens": "x"}, "scens", "scenes"),
        ({"sites": {"here": {"reference_dem": "dem.tif", "refrence_image": "x"}}}, "refrence_image", "reference_image"),
        ({"stich": {}}, "stich", "stitch"),
        ({"coregister": {"tile_kn": 3}}, "coregister.tile_kn", "tile_km"),
    ],
)
def test_an_unknown_key_is_named_with_its_nearest_known_one(
    folder: Path, change: dict[str, Any], key: str, nearest: str
) -> None:
    (fault,) = _faults(folder, SETTINGS | change)
    assert fault.column is not None
    assert fault.column.endswith(key)
    assert repr(nearest) in fault.expected
    assert fault.file == "my.yaml"


@pytest.mark.parametrize(
    ("site", "key", "expected"),
    [
        ({}, "reference_dem", "elevation model"),
        ({"reference_dem": "dem.tif", "reference_dem_heights": "geoid"}, "reference_dem_heights", "egm2008"),
        ({"reference_dem": "dem.tif", "dem_resolution_m": 0}, "dem_resolution_m", "more than 0"),
        ({"reference_dem": "dem.tif", "dem_resolution_m": "ten"}, "dem_resolution_m", "number"),
        ({"reference_dem": "nowhere.tif"}, "reference_dem", "elevation model"),
        ({"reference_dem": "dem.tif", "crs": "EPSG:4326"}, "crs", "projected"),
        ({"reference_dem": "dem.tif", "crs": "UTM 33"}, "crs", "EPSG:32647"),
    ],
)
def test_a_wrong_site_is_named(folder: Path, site: dict[str, Any], key: str, expected: str) -> None:
    (fault,) = _faults(folder, SETTINGS | {"sites": {"here": site}})
    assert fault.column == f"sites.here.{key}"
    assert expected in fault.expected


def test_all_faults_of_all_files_come_in_one_message(folder: Path) -> None:
    bad = _change(nw_lat="north", ne_lon="999")
    _write(folder / "scenes.tsv", [HEADER, bad, _row("DS1104-2169DA098", site="there")])
    _write(folder / "pairs.tsv", [["pair", "fore", "aft"], ["a b", "DS1104-2169DF092", "DS1104-2169DA098"]])
    settings = SETTINGS | {"sites": {"here": {"reference_dem": "dem.tif", "crss": 1}}, "strips": 0}
    faults = _faults(folder, settings)
    assert {fault.file for fault in faults} == {"my.yaml", "scenes.tsv", "pairs.tsv"}
    assert len(faults) == 6
    message = str(sheets.FaultySheets(faults))
    assert all(str(fault) in message for fault in faults)


@pytest.mark.parametrize("settings", [{}, {"sites": None}, {"sites": []}, {"sites": {}}, {"scenes": 3, "sites": "x"}])
def test_a_config_of_any_wrong_shape_gives_faults_and_not_a_traceback(folder: Path, settings: dict[str, Any]) -> None:
    assert _faults(folder, settings)


# Pairing


def test_each_fore_frame_pairs_with_the_aft_frame_six_later() -> None:
    step = 0.135  # degrees of latitude: 15 km, 93 % of a frame's width
    rows = [HEADER]
    for frame in range(4):
        rows.append(_row(f"DS1104-2169DF{92 + frame:03d}", north=-step * frame))
        rows.append(_row(f"DS1104-2169DA{98 + frame:03d}", north=-step * frame))
    scenes = _scenes(rows)
    assert [pair.pair for pair in sheets.find_pairs(scenes)] == [
        f"1104-2169_{92 + frame:03d}-{98 + frame:03d}" for frame in range(4)
    ]


def test_neighbours_follow_each_other_in_one_camera_and_one_block() -> None:
    frames = ["DF093", "DF092", "DA098", "DF095", "DA099", "DA100", "DA101", "DF094"]
    rows = [HEADER, *(_row(f"DS1104-2169{frame}") for frame in frames)]
    scenes = {scene.scene: scene for scene in _scenes(rows)}
    elsewhere = "DS1104-2169DF095"
    scenes[elsewhere] = replace(scenes[elsewhere], block="other")
    pairs = {pair.pair: pair for pair in sheets.find_pairs(list(scenes.values()))}
    fore = [f"DS1104-2169DF09{n}" for n in (2, 3, 4)]
    aft = [f"DS1104-2169DA{n:03d}" for n in (98, 99, 100)]
    project = sheets.Project({}, scenes, {name: pair for name, pair in pairs.items() if pair.fore != elsewhere})
    assert project.neighbours_of_block("1104-2169") == [
        *((aft[n], aft[n + 1]) for n in range(2)),
        *((fore[n], fore[n + 1]) for n in range(2)),
    ]
    assert project.neighbours_of_block("other") == []


def test_overlap_decides_where_the_frames_are_not_six_apart() -> None:
    rows = [HEADER, _row("DS1104-2169DF092"), _row("DS1104-2169DA097"), _row("DS1104-2169DA098", north=-0.14)]
    assert [pair.aft for pair in sheets.find_pairs(_scenes(rows))] == ["DS1104-2169DA097"]


def test_frames_of_other_passes_or_far_away_do_not_pair() -> None:
    rows = [HEADER, _row("DS1104-2169DF092"), _row("DS1104-2170DA098"), _row("DS1104-2169DA098", north=2.0)]
    assert sheets.find_pairs(_scenes(rows)) == []


def test_pairs_are_found_across_the_date_line() -> None:
    across = [60.2, 178.5, 60.2, -178.5, 60.0, -178.5, 60.0, 178.5]
    shifted = [60.2, 178.4, 60.2, 181.4, 60.0, 181.4, 60.0, 178.4]
    rows = [HEADER, _row("DS1104-2169DF092", corners=across), _row("DS1104-2169DA098", corners=shifted)]
    assert len(sheets.find_pairs(_scenes(rows))) == 1


def test_a_sheet_without_any_pair_is_refused(folder: Path) -> None:
    _write(folder / "scenes.tsv", [HEADER, _row("DS1104-2169DF092")])
    (fault,) = _faults(folder, {key: value for key, value in SETTINGS.items() if key != "pairs"})
    assert "no pair" in fault.found


def _scenes(rows: list[list[str]]) -> list[sheets.Scene]:
    return [
        sheets.Scene(
            scene=row[0],
            site=row[1],
            parts=row[2],
            corners_deg=dict(zip(sheets.CORNER_COLUMNS, map(float, row[3:]), strict=True)),
            date=None,
            pixel_um=7.0,
            camera="KH-4B",
            look=sheets.parse_scene_id(row[0]).look,
            block=sheets.parse_scene_id(row[0]).flight,
        )
        for row in rows[1:]
    ]


# Archive export


def test_the_archives_export_becomes_a_scene_sheet(tmp_path: Path) -> None:
    heading = "Entity ID,Acquisition Date,NW Cormer Lat dec,NW Corner Long dec,NE Corner Lat dec,NE Corner Long dec,"
    heading += "SE Corner Lat dec,SE Corner Long dec,SW Corner Lat dec,SW Corner Long dec,NW Corner Lat"
    text = f"{heading}\nDS1104-2169DF092,1968/08/12,43.95,96.5,43.95,99.8,43.75,99.8,43.75,96.5,43°57'00\"N\n"
    sheet = sheets.scenes_from_archive(text, site="here", parts="scans", pixel_um=14)
    path = tmp_path / "scenes.tsv"
    path.write_text(sheet, encoding="utf-8")
    scenes, faults = sheets.read_scenes(path)
    assert faults == []
    assert scenes[0].corners_deg == dict(zip(sheets.CORNER_COLUMNS, CORNERS, strict=True))
    assert (scenes[0].date, scenes[0].pixel_um, scenes[0].site) == ("1968-08-12", 14.0, "here")


def test_an_export_without_corners_names_the_missing_column() -> None:
    with pytest.raises(InputError, match="nw cor"):
        sheets.scenes_from_archive("Entity ID,Acquisition Date\n", site="here", parts="scans")


def test_a_real_export_becomes_a_sheet_without_a_fault(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export = real_data / "film" / "corona2_metadata_35frames.csv"
    assert sheets.main(["from-archive", str(export), "--site", "gulf", "--parts", "scans"]) == 0
    path = tmp_path / "scenes.tsv"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    scenes, faults = sheets.read_scenes(path)
    assert faults == []
    assert len(scenes) == 35
    assert {scene.camera for scene in scenes} == {"KH-4A", "KH-4B"}
    # Mission 1104 pass 1057: fore 016-023 with aft 022-029, always six frames later.
    found = {pair.pair for pair in sheets.find_pairs(scenes) if pair.pair.startswith("1104-1057")}
    assert found == {f"1104-1057_{frame:03d}-{frame + 6:03d}" for frame in range(16, 24)}


# Schema and its documentation


def test_every_key_of_the_schema_has_default_unit_and_description() -> None:
    for name, described in sheets.described_keys():
        assert described.get("description"), name
        if "properties" in described or isinstance(described.get("additionalProperties"), dict):
            assert described.get("additionalProperties") is not True, name
        else:
            assert "unit" in described, name
            assert "default" in described or name == "sites.<site>.reference_dem", name


def _objects(part: dict[str, Any]) -> list[dict[str, Any]]:
    inner = [*part.get("properties", {}).values()]
    if isinstance(part.get("additionalProperties"), dict):
        inner.append(part["additionalProperties"])
    found = [each for described in inner for each in _objects(described)]
    return [part, *found] if part.get("type") == "object" else found


@pytest.mark.parametrize("name", ["config", "scenes", "pairs"])
def test_schemas_are_valid_and_closed_at_every_level(name: str) -> None:
    schema = sheets.schema(name)
    sheets.Draft202012Validator.check_schema(schema)
    assert all("additionalProperties" in part and part["additionalProperties"] is not True for part in _objects(schema))


def test_defaults_of_the_schema_pass_the_schema() -> None:
    filled = sheets.fill_defaults(sheets.schema("config"), {"sites": {"here": {"reference_dem": "dem.tif"}}})
    assert sheets.check_settings(filled, "defaults") == []


def test_the_manual_describes_every_key_and_column() -> None:
    manual = (sheets.SCHEMAS.parent / "README.md").read_text(encoding="utf-8")
    for table in (sheets.column_table("scenes"), sheets.column_table("pairs"), sheets.key_table()):
        assert table in manual, "config/README.md is out of step; `python -m cosp.sheets tables` prints the tables"


def test_the_default_config_and_its_sheets_have_no_fault() -> None:
    home = sheets.SCHEMAS.parents[1]
    settings = yaml.safe_load((home / "config" / "config.yaml").read_text(encoding="utf-8"))
    project = sheets.load(settings, folder=home)
    assert list(project.sites) == ["demo"]


def test_the_check_command_says_what_is_wrong(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = folder / "my.yaml"
    config.write_text(yaml.safe_dump({"sites": {"here": {}}}), encoding="utf-8")
    assert sheets.main(["check", str(config)]) == 1
    assert "sites.here.reference_dem" in capsys.readouterr().err
