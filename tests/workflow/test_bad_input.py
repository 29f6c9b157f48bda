"""Bad input stops with one sentence that names the file, what was found and what is needed; nothing half-written stays.

The script of the first rule runs here as the workflow runs it, on parts of a few pixels; whole sites through the
workflow are slow and marked so.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from cosp import sheets
from cosp.errors import InputError, StitchingError
from cosp.geometry.grids import PixelGrid
from cosp.io import rasters

HOME = Path(__file__).resolve().parents[2]
SCENE = "DS1104-2169DF092"
PIXEL_UM = 500.0
SHAPE = (140, 400)


def _write(path: Path, values: NDArray[np.generic]) -> None:
    rows, columns = values.shape[-2:]
    rasters.write(path, values, grid=PixelGrid(0.0, 0.0, 1.0, -1.0, (rows, columns)))


def _parts(folder: Path) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(3)
    paths = [folder / f"{SCENE}_{letter}.tif" for letter in "abcd"]
    for path in paths:
        _write(path, rng.integers(1, 255, SHAPE, dtype=np.uint8))
    return paths


def _stitch(folder: Path, paths: list[Path], missing: list[str] | None = None, pixel_um: float = PIXEL_UM) -> None:
    settings = sheets.fill_defaults(sheets.schema("config"), {"sites": {}})["stitch"]
    script = runpy.run_path(str(HOME / "scripts" / "stitch.py"))
    script["stitch"](
        [str(path) for path in paths],
        folder / "results" / "seams.json",
        folder / "results" / "seams.png",
        scene=SCENE,
        missing=missing or [],
        pixel_um=pixel_um,
        threads=1,
        **settings,
    )


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _sixteen_bits(path: Path) -> None:
    _write(path, np.full(SHAPE, 300, np.uint16))


def _colour(path: Path) -> None:
    _write(path, np.full((3, *SHAPE), 100, np.uint8))


def _upright(path: Path) -> None:
    _write(path, np.full(SHAPE[::-1], 100, np.uint8))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (_truncate, "truncated"),
        (lambda path: path.write_bytes(b""), "not a raster"),
        (lambda path: path.write_text("no picture"), "not a raster"),
        (_sixteen_bits, "uint16.*uint8"),
        (_colour, "3 band.*one band"),
        (_upright, "longer along its columns"),
    ],
    ids=["truncated", "empty", "text", "sixteen bits", "colour", "upright"],
)
def test_a_part_that_cannot_be_used_is_named_with_what_is_wrong(
    tmp_path: Path, spoil: Callable[[Path], None], said: str
) -> None:
    paths = _parts(tmp_path / "scans")
    spoil(paths[1])
    with pytest.raises(InputError, match=said) as problem:
        _stitch(tmp_path, paths)
    sentence = str(problem.value)
    assert str(paths[1]) in sentence
    assert "\n" not in sentence
    assert "previous exception" not in sentence
    assert not list((tmp_path / "results").glob("**/*.tif*"))


def test_a_missing_part_is_named_with_its_scene(tmp_path: Path) -> None:
    paths = _parts(tmp_path / "scans")
    with pytest.raises(InputError, match=rf"{SCENE}: no such file: .*_b\.tif; needed are parts a to d"):
        _stitch(tmp_path, [paths[0], *paths[2:]], missing=[str(paths[1])])


def test_a_wrong_pixel_size_is_asked_about(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is pixel_um right"):
        _stitch(tmp_path, _parts(tmp_path / "scans"), pixel_um=7.0)


def test_four_copies_of_one_part_are_named(tmp_path: Path) -> None:
    paths = _parts(tmp_path / "scans")
    for path in paths[1:]:
        path.write_bytes(paths[0].read_bytes())
    with pytest.raises(StitchingError, match=rf"{SCENE}_a\.tif and {SCENE}_b\.tif are the same picture"):
        _stitch(tmp_path, paths)


def test_parts_that_do_not_join_are_named(tmp_path: Path) -> None:
    seam = rf"seam {SCENE}_[a-d]\.tif - {SCENE}_[a-d]\.tif: .*may not belong to one film"
    with pytest.raises(StitchingError, match=seam) as problem:
        _stitch(tmp_path, _parts(tmp_path / "scans"))
    assert "\n" not in str(problem.value)


@pytest.mark.slow
def test_one_bad_scene_leaves_the_others_running_and_nothing_half_written(tmp_path: Path) -> None:
    paths = _parts(tmp_path / "scans")
    other = "DS1104-2169DA098"
    whole = np.random.default_rng(1).integers(1, 255, (SHAPE[0], 1600), dtype=np.uint8)
    _write(tmp_path / "scans" / f"{other}.tif", whole)
    _truncate(paths[2])
    (tmp_path / "dem.tif").touch()
    corners = {"nw_lat": 44, "nw_lon": 96.5, "ne_lat": 44.3, "ne_lon": 99.5}
    corners |= {"se_lat": 44.1, "se_lon": 99.5, "sw_lat": 43.8, "sw_lon": 96.5}
    rows = ["\t".join(["scene", "site", "parts", *corners, "pixel_um"])]
    rows += ["\t".join([scene, "s", "scans", *map(str, corners.values()), f"{PIXEL_UM:g}"]) for scene in (SCENE, other)]
    (tmp_path / "scenes.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    settings = {"scenes": "scenes.tsv", "sites": {"s": {"reference_dem": "dem.tif"}}}
    (tmp_path / "my.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    targets = [f"results/scenes/{scene}/seams.json" for scene in (SCENE, other)]
    command = [sys.executable, "-m", "snakemake", "-s", str(HOME / "Snakefile"), "--cores", "1", "--keep-going"]
    done = subprocess.run(
        [*command, "--configfile", str(tmp_path / "my.yaml"), "--directory", str(tmp_path), *targets],
        cwd=tmp_path,
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / ".cache")},
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert f"scans/{SCENE}_c.tif: " in done.stdout + done.stderr
    assert f"scans/{SCENE}_c.tif: " in (tmp_path / "logs" / "stitch" / f"{SCENE}.log").read_text(encoding="utf-8")
    assert (tmp_path / targets[1]).is_file()
    assert not [path for path in (tmp_path / "results" / "scenes" / SCENE).glob("**/*") if path.is_file()]
