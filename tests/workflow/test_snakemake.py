"""The workflow as a whole: linted, planned in seconds for many pairs, stopped by faults before any job starts."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import yaml

from cosp import sheets

HOME = Path(__file__).resolve().parents[2]


def _snakemake(*arguments: str, folder: Path = HOME) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(HOME / "Snakefile"), *arguments]
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / ".cache")} if folder != HOME else dict(os.environ)
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


def _site(folder: Path, *, pairs: int, parts: str = "abcd", pixel_um: int = 7) -> dict[str, Any]:
    """A site of touched files: pairs in sequence, no pair sheet."""
    (folder / "scans").mkdir(parents=True)
    for name in ("dem.tif", "image.tif"):
        (folder / name).touch()
    rows = ["\t".join(["scene", "site", "parts", *sheets.CORNER_COLUMNS, "pixel_um"])]
    for pair in range(pairs):
        north = 44.0 - 0.135 * pair
        corners = [north, 96.5, north, 99.8, north - 0.2, 99.8, north - 0.2, 96.5]
        for scene in (f"DS1104-2169DF{17 + pair:03d}", f"DS1104-2169DA{23 + pair:03d}"):
            rows.append("\t".join([scene, "here", "scans", *map(str, corners), str(pixel_um)]))
            for letter in parts:
                (folder / "scans" / f"{scene}_{letter}.tif").touch()
    (folder / "scenes.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return {"scenes": "scenes.tsv", "sites": {"here": {"reference_dem": "dem.tif", "reference_image": "image.tif"}}}


def _write(folder: Path, settings: dict[str, Any]) -> str:
    path = folder / "my.yaml"
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return str(path)


def _jobs(output: str) -> dict[str, int]:
    table = output.split("Job stats:")[1]
    return {name: int(count) for name, count in re.findall(r"^(\w+)\s+(\d+)$", table, flags=re.M)}


def test_lint_finds_nothing() -> None:
    done = _snakemake("--lint")
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_demo_has_fewer_than_forty_jobs(tmp_path: Path) -> None:
    config = HOME / "config" / "config.yaml"
    (tmp_path / "config").mkdir()
    for name in ("scenes.tsv", "pairs.tsv"):
        (tmp_path / "config" / name).write_text((config.parent / name).read_text(encoding="utf-8"), encoding="utf-8")
    done = _snakemake("-n", "--configfile", str(config), "--directory", str(tmp_path), folder=tmp_path)
    assert done.returncode == 0, done.stderr
    jobs = _jobs(done.stdout + done.stderr)
    assert jobs["simulate_site"] == 1
    assert jobs["stitch"] == 2
    assert jobs["total"] < 40


def test_twelve_pairs_are_planned_in_seconds(tmp_path: Path) -> None:
    config = _write(tmp_path, _site(tmp_path, pairs=12))
    began = time.monotonic()
    done = _snakemake("-n", "--configfile", config, "--directory", str(tmp_path), folder=tmp_path)
    seconds = time.monotonic() - began
    assert done.returncode == 0, done.stderr
    jobs = _jobs(done.stdout + done.stderr)
    assert (jobs["stitch"], jobs["match_pair"], jobs["adjust_bundle"], jobs["mosaic_site"]) == (24, 12, 1, 1)
    # Full films are cut into 3 strips each for control, of 24 films, and 11 for disparity, of 12 pairs.
    assert (jobs["match_tiles"], jobs["match_dense"]) == (24 * 3, 12 * 11)
    assert "simulate_site" not in jobs
    assert seconds < 60.0, "four seconds on a quiet machine"


def test_a_scene_without_its_parts_does_not_stop_the_plan_of_the_others(tmp_path: Path) -> None:
    settings = _site(tmp_path, pairs=2, pixel_um=140)
    for path in (tmp_path / "scans").glob("DS1104-2169DF017_*"):
        path.unlink()
    done = _snakemake("-n", "--configfile", _write(tmp_path, settings), "--directory", str(tmp_path), folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert _jobs(done.stdout + done.stderr)["stitch"] == 4


def test_every_fault_is_said_before_any_job_starts(tmp_path: Path) -> None:
    settings = _site(tmp_path, pairs=1)
    sheet = tmp_path / "scenes.tsv"
    sheet.write_text(sheet.read_text(encoding="utf-8").replace("\t7\n", "\t0\n", 1), encoding="utf-8")
    settings["stich"] = {}
    settings["sites"]["here"]["crs"] = "EPSG:4326"
    done = _snakemake(
        "--cores", "1", "--configfile", _write(tmp_path, settings), "--directory", str(tmp_path), folder=tmp_path
    )
    said = done.stdout + done.stderr
    assert done.returncode != 0
    assert "scenes.tsv, row 2, column pixel_um" in said
    assert "nearest is 'stitch'" in said
    assert "Traceback" not in said
    assert not (tmp_path / "results").exists()


def test_a_given_config_is_not_mixed_with_the_demos(tmp_path: Path) -> None:
    settings = _site(tmp_path, pairs=1, pixel_um=140)
    # From the project's own folder, where config/config.yaml lies.
    done = _snakemake("-n", "--configfile", _write(tmp_path, settings), "--directory", str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "simulate_site" not in _jobs(done.stdout + done.stderr)
    assert "1104-2169_017-023" in done.stdout + done.stderr


def test_files_of_a_site_that_is_not_simulated_are_the_users_wherever_they_lie(tmp_path: Path) -> None:
    settings = _site(tmp_path, pairs=1, pixel_um=140)
    folder = tmp_path / "resources" / "simulated" / "here"
    folder.mkdir(parents=True)
    (tmp_path / "dem.tif").rename(folder / "reference_dem.tif")
    settings["sites"]["here"]["reference_dem"] = "resources/simulated/here/reference_dem.tif"
    done = _snakemake("-n", "--configfile", _write(tmp_path, settings), "--directory", str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "simulate_site" not in _jobs(done.stdout + done.stderr)


def test_control_from_elevation_models_is_planned_where_it_is_chosen_alone(tmp_path: Path) -> None:
    settings = _site(tmp_path, pairs=2, pixel_um=140)
    here = settings["sites"]["here"]

    def planned(wanted: str) -> tuple[int, int, int]:
        here["dem_control"] = wanted
        arguments = ["-n", "--configfile", _write(tmp_path, settings), "--directory", str(tmp_path)]
        done = _snakemake(*arguments, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        jobs = _jobs(done.stdout + done.stderr)
        return jobs["adjust_bundle"], jobs.get("adjust_draft", 0), jobs.get("match_dem", 0)

    assert planned("always") == (1, 1, 2)
    assert planned("without_reference_image") == planned("never") == (1, 0, 0)
    del here["reference_image"]
    assert planned("without_reference_image") == (1, 1, 2)


def test_the_catalogs_snakefile_is_the_same_workflow(tmp_path: Path) -> None:
    settings = _site(tmp_path, pairs=1, pixel_um=140)
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(HOME / "workflow" / "Snakefile"), "-n"]
    done = subprocess.run(
        [*command, "--configfile", _write(tmp_path, settings), "--directory", str(tmp_path)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert _jobs(done.stdout + done.stderr)["mosaic_site"] == 1
