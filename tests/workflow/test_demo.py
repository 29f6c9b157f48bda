"""The whole workflow on a small simulated site: every product, figures against truth, nothing left to do afterwards."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import rasterio

HOME = Path(__file__).resolve().parents[2]
PAIR = "1104-2169_092-098"
SCENES = ("DS1104-2169DF092", "DS1104-2169DA098")
PIXEL_UM = 112.0


def _snakemake(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    options = ["--snakefile", str(HOME / "Snakefile"), "--configfile", str(folder / "config.yaml")]
    command = [sys.executable, "-m", "snakemake", *options, "--directory", str(folder), "--cores", "2", *arguments]
    return subprocess.run(command, cwd=folder, env=_environment(folder), capture_output=True, text=True)


def _environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "MPLBACKEND": "Agg", "NUMBA_CACHE_DIR": str(folder / "numba")}


def _compiled(folder: Path) -> list[str]:
    """Packages and functions with compiled code, once for each choice of types."""
    files = (folder / "numba").rglob("*.nbc")
    return sorted(f"{file.parent.name.split('_')[0]} {file.name}" for file in files)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a finished run over a pair digitised at 112 um."""
    folder = tmp_path_factory.mktemp("site")
    subprocess.run([sys.executable, "-m", "cosp.compiled"], check=True, env=_environment(folder))
    (folder / "compiled").write_text("\n".join(_compiled(folder)), encoding="utf-8")
    describe = [sys.executable, "-m", "cosp.simulation", "--directory", str(folder), "--name", "small"]
    subprocess.run([*describe, "--pixel-um", str(PIXEL_UM)], check=True, cwd=folder)
    done = _snakemake(folder, "--show-failed-logs")
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-8000:]
    assert "Provided resources: mem_mb=" in done.stdout + done.stderr, "jobs share the memory of the machine"
    return folder


@pytest.mark.slow
def test_a_second_run_has_nothing_to_do(site: Path) -> None:
    done = _snakemake(site, "-n")
    assert "Nothing to be done" in done.stdout + done.stderr


@pytest.mark.slow
def test_set_up_has_compiled_all_that_jobs_call(site: Path) -> None:
    """What is named here belongs into the table of `cosp.compiled`: tests/workflow/record_compiled.py writes it."""
    before = (site / "compiled").read_text(encoding="utf-8").splitlines()
    assert len(before) > 50
    assert [name for name in _compiled(site) if name not in before] == []


@pytest.mark.slow
def test_every_product_of_the_contract_is_there(site: Path) -> None:
    results = site / "results"
    products = [results / "scenes" / scene / name for scene in SCENES for name in ("film.tif", "gcps.parquet")]
    products += [results / "blocks" / "1104-2169_small" / "cameras" / f"{scene}.json" for scene in SCENES]
    products += [results / "blocks" / "1104-2169_small" / "adjustment.json"]
    maps = ("dem.tif", "dem_sigma.tif", "dem_coregistered.tif", "dem_difference.tif", "ortho.tif", "quality.json")
    products += [results / "pairs" / PAIR / name for name in maps]
    on_site = ("dem.tif", "dem_difference.tif", "ortho.tif", "quality.json", "report.html")
    products += [results / "sites" / "small" / name for name in on_site]
    assert [str(path) for path in products if not path.is_file()] == []
    assert not list(results.rglob(".*.part*")), "nothing half-written stays behind"


@pytest.mark.slow
def test_all_map_products_of_the_pair_share_one_grid_on_whole_multiples_of_the_posting(site: Path) -> None:
    grids = set()
    for name in ("dem.tif", "dem_sigma.tif", "dem_coregistered.tif", "dem_difference.tif", "ortho.tif"):
        with rasterio.open(site / "results" / "pairs" / PAIR / name) as raster:
            grids.add((raster.transform.to_gdal(), raster.shape, raster.crs.to_string()))
    assert len(grids) == 1
    ((left, step, _, top, _, down), _, crs) = next(iter(grids))
    assert crs == "EPSG:32647"
    assert step == -down
    assert left % step == top % step == 0.0


@pytest.mark.slow
def test_heights_are_within_the_figures_of_the_method(site: Path) -> None:
    quality = json.loads((site / "results" / "pairs" / PAIR / "quality.json").read_text(encoding="utf-8"))
    height_per_px_m = quality["height_per_px_m"]
    assert quality["sigma_naught_px"] < 2.0
    assert quality["y_parallax"]["sd_px"] < 1.0
    assert quality["check"]["before"]["nmad"] <= 1.2 * height_per_px_m
    assert quality["check"]["after"]["nmad"] <= 0.7 * height_per_px_m


@pytest.mark.slow
def test_the_quality_page_holds_everything_itself(site: Path) -> None:
    page = (site / "results" / "sites" / "small" / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") >= 8
    assert 'src="http' not in page
    headings = ("Site", f"Pair {PAIR}", "Epipolar geometry", "Orientation", "Ground control", "Films", "Parameters")
    for heading in headings:
        assert heading in page
