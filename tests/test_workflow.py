"""A job is asked for by the size of its film, and a changed library file reruns just the rules that use it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from cosp import sheets, workflow


def _scene(pixel_um: float = 7.0, **changes: str) -> sheets.Scene:
    values = {"scene": "DS1104-2169DF092", "site": "here", "parts": "scans", "camera": "KH-4B", "look": "fore"}
    values |= {"block": "b"} | changes
    corners = dict(zip(sheets.CORNER_COLUMNS, [44, 96, 44, 99, 43.8, 99, 43.8, 96], strict=True))
    return sheets.Scene(**values, corners_deg=corners, date=None, pixel_um=pixel_um)  # type: ignore[arg-type]


def _project(*scenes: sheets.Scene, strips: object = "auto") -> sheets.Project:
    site = {"crs": "auto", "reference_image": None, "reference_dem": "dem.tif"}
    settings = {"strips": strips, "sites": {"here": site}, "simulate_site": {}}
    return sheets.Project(settings, {scene.scene: scene for scene in scenes}, {})


@pytest.fixture
def library(tmp_path: Path) -> Path:
    """A small library: `a` uses `b` inside a function, `c` stands alone."""
    package = tmp_path / "lib"
    for name, text in {
        "__init__.py": "",
        "stage/__init__.py": "",
        "stage/a.py": "def f():\n    from lib.floor.b import g\n    return g()\n",
        "stage/c.py": "x = 1\n",
        "floor/__init__.py": "",
        "floor/b.py": "import math\nfrom lib.floor import base\n",
        "floor/base.py": "y = 1\n",
    }.items():
        path = package / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    (tmp_path / "uses_a.py").write_text("from lib.stage import a\n", encoding="utf-8")
    (tmp_path / "uses_c.py").write_text("import numpy\nimport lib.stage.c\n", encoding="utf-8")
    return package


def _digests(library: Path) -> tuple[str, str]:
    workflow._direct_files.cache_clear()
    return tuple(workflow.library_digest(library.parent / f"uses_{name}.py", library) for name in "ac")  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("changed", "a_changes", "c_changes"),
    [
        ("stage/a.py", True, False),
        ("floor/b.py", True, False),
        ("floor/base.py", True, False),
        ("stage/c.py", False, True),
        ("stage/__init__.py", True, True),
        ("__init__.py", True, True),
    ],
)
def test_an_edit_changes_the_digest_of_the_scripts_that_use_the_file_and_of_no_other(
    library: Path, changed: str, a_changes: bool, c_changes: bool
) -> None:
    before = _digests(library)
    with (library / changed).open("a", encoding="utf-8") as file:
        file.write("# edited\n")
    after = _digests(library)
    assert (before[0] != after[0], before[1] != after[1]) == (a_changes, c_changes)


def test_a_touched_file_does_not_change_the_digest(library: Path) -> None:
    before = _digests(library)
    (library / "floor" / "b.py").touch()
    assert _digests(library) == before


def test_a_moved_project_keeps_its_digests(library: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    before = _digests(library)
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "there"
    library.parent.rename(elsewhere)
    assert _digests(elsewhere / "lib") == before


def test_every_script_of_the_project_has_a_digest_and_uses_its_stage() -> None:
    files = {
        path.relative_to(workflow.LIBRARY).as_posix() for path in workflow.library_files(workflow.SCRIPTS / "stitch.py")
    }
    assert {"film/stitching.py", "io/rasters.py", "errors.py"} <= files
    assert not any(file.startswith(("dense/", "dem/")) for file in files)
    assert len({workflow.script_digest(path.stem) for path in workflow.SCRIPTS.glob("*.py")}) > 5


def test_a_full_film_has_the_pixels_of_the_archive() -> None:
    # 744.8 mm by 70 mm of film at 7 um
    assert workflow.film_mpx(_scene()) == pytest.approx(1064, rel=1e-3)
    assert workflow.film_mpx(_scene(56.0)) == pytest.approx(1064 / 64, rel=1e-3)


@pytest.mark.parametrize(("pixel_um", "strips"), [(7.0, 11), (14.0, 3), (28.0, 1), (140.0, 1)])
def test_a_film_is_cut_into_strips_of_at_most_100_million_pixels(pixel_um: float, strips: int) -> None:
    assert workflow.strip_count(_project(_scene(pixel_um))) == strips


@pytest.mark.parametrize(("pixel_um", "strips"), [(7.0, 3), (14.0, 1)])
def test_control_takes_larger_strips(pixel_um: float, strips: int) -> None:
    assert workflow.strip_count(_project(_scene(pixel_um)), workflow.LARGEST_CONTROL_STRIP_MPX) == strips


def test_a_chosen_number_of_strips_is_taken() -> None:
    project = _project(_scene(), strips=16)
    assert workflow.strip_count(project) == workflow.strip_count(project, workflow.LARGEST_CONTROL_STRIP_MPX) == 16


def test_memory_and_time_grow_with_the_film_and_never_vanish() -> None:
    assert workflow.memory_mb(1000, bytes_per_px=4) == 4600
    assert workflow.memory_mb(0, bytes_per_px=4) == 600
    assert workflow.runtime_min(1000, us_per_px=1.0) > workflow.runtime_min(1000, us_per_px=1.0, threads=2) > 10
    assert workflow.runtime_min(1, us_per_px=0.1) == 10


def test_jobs_share_most_of_the_memory_there_is() -> None:
    total_mb = psutil.virtual_memory().total / 1e6
    assert 0.8 * total_mb < workflow.machine_memory_mb() < total_mb


def test_parts_that_are_there_are_named_and_a_joined_film_stands_for_them(tmp_path: Path) -> None:
    scans = tmp_path / "scans"
    scans.mkdir()
    scene = _scene()
    assert workflow.part_paths(scene, simulated=False, folder=tmp_path) == []
    (scans / "DS1104-2169DF092.tif").touch()
    assert workflow.part_paths(scene, simulated=False, folder=tmp_path) == ["scans/DS1104-2169DF092.tif"]
    for letter in ("a", "d", "b"):
        (scans / f"DS1104-2169DF092_{letter}.tif").touch()
    found = workflow.part_paths(scene, simulated=False, folder=tmp_path)
    assert found == [f"scans/DS1104-2169DF092_{letter}.tif" for letter in ("a", "b", "d")]
    assert len(workflow.part_paths(scene, simulated=True, folder=tmp_path)) == 4
    missing = workflow.missing_parts(scene, simulated=False, folder=tmp_path)
    assert missing == ["scans/DS1104-2169DF092_c.tif"]


def test_a_joined_film_lacks_no_part_and_an_empty_folder_lacks_all(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    assert len(workflow.missing_parts(_scene(), simulated=False, folder=tmp_path)) == 4
    (tmp_path / "scans" / "DS1104-2169DF092.tif").touch()
    assert workflow.missing_parts(_scene(), simulated=False, folder=tmp_path) == []
    assert workflow.missing_parts(_scene(), simulated=True, folder=tmp_path) == []


@pytest.mark.parametrize(
    ("longitude", "latitude", "crs"),
    [
        (98.0, 44.0, "EPSG:32647"),
        (-70.0, -20.0, "EPSG:32719"),
        (179.9, 60.0, "EPSG:32660"),
        (-179.9, 60.0, "EPSG:32601"),
    ],
)
def test_auto_is_the_utm_zone_of_the_site(longitude: float, latitude: float, crs: str) -> None:
    around = {"nw": (-1, 1), "ne": (1, 1), "se": (1, -1), "sw": (-1, -1)}
    corners = {}
    for name, (east, north) in around.items():
        corners[f"{name}_lon"] = (longitude + 0.5 * east + 180.0) % 360.0 - 180.0
        corners[f"{name}_lat"] = latitude + 0.1 * north
    assert workflow.utm_zone([corners]) == crs


def test_a_file_that_the_site_does_not_have_is_no_input() -> None:
    project = _project(_scene())
    assert workflow.site_file(project, "here", "reference_image") == []
    assert workflow.site_file(project, "here", "reference_dem") == "dem.tif"


def test_names_with_signs_are_taken_literally_by_the_wildcards() -> None:
    import re

    pattern = workflow.any_of(["a-b", "a.c"])
    assert re.fullmatch(pattern, "a.c")
    assert not re.fullmatch(pattern, "axc")
    assert not re.match(workflow.any_of([]), "")


@pytest.mark.parametrize(("formats", "blocks"), [([], []), (["rpc"], ["a", "b"])])
def test_blocks_are_exported_where_a_form_is_asked_for(formats: list[str], blocks: list[str]) -> None:
    fore = [replace(_scene(), scene=f"DS1104-2169DF09{i}", block=block) for i, block in enumerate("bab")]
    aft = [replace(_scene(), scene=f"DS1104-2169DA09{i}", block=block) for i, block in enumerate("bab")]
    pairs = {f"p{i}": sheets.Pair(f"p{i}", fore[i].scene, aft[i].scene) for i in range(3)}
    scenes = {scene.scene: scene for scene in (*fore, *aft)}
    project = sheets.Project({"export_cameras": {"formats": formats}}, scenes, pairs)
    assert workflow.blocks_to_export(project) == blocks


def test_a_pair_is_alone_where_no_other_pair_is_in_its_block() -> None:
    fore = [replace(_scene(), scene=f"DS1104-2169DF09{i}", block=block) for i, block in enumerate("aab")]
    aft = [replace(_scene(), scene=f"DS1104-2169DA09{i}", block=block) for i, block in enumerate("aab")]
    pairs = {f"p{i}": sheets.Pair(f"p{i}", fore[i].scene, aft[i].scene) for i in range(3)}
    project = sheets.Project({}, {scene.scene: scene for scene in (*fore, *aft)}, pairs)
    assert [workflow.is_alone(project, {"pair": pair}) for pair in pairs] == [False, False, True]
    assert [workflow.is_alone(project, {"scene": scene.scene}) for scene in aft] == [False, False, True]
