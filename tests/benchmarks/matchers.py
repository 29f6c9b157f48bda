"""Matchers side by side: on a simulated site against its truth, and on two real images of one place.

    python tests/benchmarks/matchers.py --make NEW_FOLDER [--pixel-um 56] [--matchers structural,sift,lightglue:xfeat]
    python tests/benchmarks/matchers.py --folder SITE [--reference relief]
    python tests/benchmarks/matchers.py --folder SITE --reference-m 3 [--stretch-mm 40] [--reference-error-m 0.6]
    COSP_TEST_DATA=... python tests/benchmarks/matchers.py --real

--make simulates a site in a new folder and takes it as far as placed films; --folder takes one that has come so far,
and only reads it. Each matcher runs in a process of its own, through the scripts of the rules match_tiles and
collect_gcps, so that its time and memory are those of the workflow. The true residual of a point is where it was
measured on the film, taken back to the digitised part it came from, less where the simulator drew its ground point in
that part. --reference relief leaves the reference image out; --reference-m makes one of another posting for the
middle of the film.

On the real images (Landsat 7, 20 July and 25 November 2002) a match is right within 3 px of where it should be; the
two images themselves lie 0.9 px apart.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

HOME = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(HOME))

from cosp import sheets  # noqa: E402
from cosp.errors import CospError  # noqa: E402
from cosp.film.bending import Bending  # noqa: E402
from cosp.film.exposure import Exposure  # noqa: E402
from cosp.film.joining import Layout  # noqa: E402
from cosp.imaging.windows import Window  # noqa: E402
from cosp.io import rasters, records, tables  # noqa: E402
from cosp.io.heights import ellipsoidal_heights  # noqa: E402
from cosp.matching.footprint import Footprint  # noqa: E402
from cosp.matching.ground import ground_pixel_m, grown, lattice_rc, map_bounds  # noqa: E402
from cosp.matching.matchers import matcher_by_name  # noqa: E402
from cosp.simulation.reference import make_reference_image  # noqa: E402
from cosp.simulation.site import SiteSettings, plan_site  # noqa: E402
from cosp.simulation.terrain import MODERN_EPOCH, light_terrain, make_terrain  # noqa: E402
from cosp.simulation.truth import true_part_pixels  # noqa: E402
from scripts.collect_gcps import collect_gcps  # noqa: E402
from scripts.match_tiles import match_tiles  # noqa: E402

MATCHERS = "structural,sift,lightglue:xfeat,lightglue:disk"
RIGHT_PX = 3.0
REFERENCE_ERROR_M = 3.0  # of the simulator's reference images, per axis
SUN_ERROR_DEG = 12.0
BANDS = (3, 4)


def make_site(folder: Path, options: argparse.Namespace) -> None:
    """A site of the simulator, taken as far as its placed films."""
    command = [sys.executable, "-m", "cosp.simulation", "--directory", str(folder), "--name", "bench"]
    command += ["--pixel-um", str(options.pixel_um), "--seed", str(options.seed)]
    subprocess.run(command, check=True, cwd=HOME)
    scenes = [line.split("\t")[0] for line in (folder / "scenes.tsv").read_text("utf-8").splitlines()[1:]]
    wanted = [f"results/scenes/{scene}/footprint.json" for scene in scenes]
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(HOME / "Snakefile"), "--cores", "2", *wanted]
    subprocess.run([*command, "--configfile", str(folder / "config.yaml"), "--directory", str(folder)], check=True)


def settings_of(folder: Path) -> tuple[dict, str]:
    """The config of a site with all defaults, and the site's name."""
    written = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    known = sheets.schema("config")["properties"]
    written = {key: value for key, value in written.items() if key in known}
    return sheets.fill_defaults(sheets.schema("config"), written), next(iter(written["sites"]))


def film_errors_mm(folder: Path, site: str, scene: str, xy_mm: np.ndarray, lonlath: np.ndarray) -> np.ndarray:
    """Film points less where the simulator drew their ground points, (N, 2) mm: both taken to pixels of the parts."""
    results = folder / "results" / "scenes" / scene
    film, seams = (records.read_json(results / name) for name in ("film.json", "seams.json"))
    if any(seams["turned"]) or any(seams["mirrored"]):
        raise SystemExit(f"{scene}: parts that are turned or mirrored are not provided for")
    bending = records.from_plain(film["bending"], Bending, "film.json")
    exposure = records.from_plain(film["exposure"], Exposure, "film.json")
    layout = records.from_plain(seams["layout"], Layout, "seams.json")
    truth = records.read_json(folder / f"resources/simulated/{site}/truth/site.json")
    plan = plan_site(SiteSettings(**truth["settings"]))
    # The record is that of the film as it was delivered: an aft film was turned afterwards.
    through_its_back = records.read(results / "footprint.json", Footprint).mirrored
    sign = np.array([1, -1 if through_its_back else 1]) * (-1 if film["turned"] else 1)
    rows, columns = exposure.pixels(bending.bent(xy_mm * sign))
    of_part = np.searchsorted(layout.joints_px, columns)
    error = np.empty_like(xy_mm)
    for number, (name, motion) in enumerate(zip(seams["part_order"], layout.motions, strict=True)):
        mine = of_part == number
        column, row = motion.inverse().apply(np.column_stack([columns[mine], rows[mine]])).T
        true = true_part_pixels(plan, plan.scene(scene), name[-1], lonlath[mine])
        error[mine] = np.column_stack([column - true[:, 1], true[:, 0] - row]) * exposure.pixel_mm
    return error * sign


def make_reference(folder: Path, scene: str, target: Path, posting_m: float, error_m: float, stretch_mm: float) -> None:
    """A reference image of another posting, of what the middle of a film shows, as the simulator makes them."""
    settings, site = settings_of(folder)
    truth = records.read_json(folder / f"resources/simulated/{site}/truth/site.json")["settings"]
    if truth["dem"] is None:
        raise SystemExit(f"{site}: made-up terrain cannot be made in parts; a site on a real DEM is needed")
    plan = plan_site(SiteSettings(**{**truth, "reference_image_m": posting_m, "reference_image_error_m": error_m}))
    camera = records.read(folder / "results" / "scenes" / scene / "footprint.json", Footprint).camera
    middle = replace(camera, half_length_mm=stretch_mm / 2)
    # What casts shadows into it lies within some kilometres.
    xmin, ymin, xmax, ymax = grown(map_bounds(middle, plan.crs, (0.0, 3000.0)), 5000.0)
    rows, columns = plan.terrain_grid.pixels(np.array([[xmin, ymax], [xmax, ymin]]))
    part = replace(plan, terrain_grid=plan.terrain_grid.window(*rows.astype(int), *columns.astype(int)))
    dem = ellipsoidal_heights(truth["dem"], part.terrain_grid, plan.crs, truth["dem_heights"])
    scenery = light_terrain(part, make_terrain(part, dem, threads=1), MODERN_EPOCH, threads=1)
    image, grid = make_reference_image(part, scenery, np.random.default_rng([truth["seed"], 42]), threads=1)
    inside = grid.pixels(np.array([[xmin + 5000.0, ymax - 5000.0], [xmax - 5000.0, ymin + 5000.0]]))
    window = Window(*inside[0].astype(int), *inside[1].astype(int))
    grid = grid.window(window.row0, window.row1, window.column0, window.column1)
    rasters.write(target, image[window.slices], grid=grid, crs=plan.crs, nodata=0)


def measure(folder: Path, scene: str, name: str, reference: str, reference_sigma_m: float, target: Path) -> dict:
    """One matcher on one film, with the scripts of the workflow; what came out, against the truth.

    reference : "image" of the site, "relief" of its DEM, or the path of another image
    reference_sigma_m : what its places are said to be good for
    """
    settings, site = settings_of(folder)
    matcher, _, features = name.partition(":")
    chosen = {**settings["match_tiles"], "matcher": matcher}
    if features:
        chosen["features"] = features
    sites = {key: settings["sites"][site][key] for key in ("reference_dem", "reference_image", "unstable_terrain")}
    paths = {key: None if path is None else folder / path for key, path in sites.items()}
    if reference != "image":
        paths["reference_image"] = None if reference == "relief" else Path(reference)
    results = folder / "results" / "scenes" / scene
    footprint_path = results / "footprint.json"
    if reference == "relief":
        # A film placed by imagery says nothing about the sun; one placed by relief finds it to some degrees.
        azimuth = records.read_json(folder / f"resources/simulated/{site}/truth/site.json")["settings"][
            "sun_azimuth_deg"
        ]
        footprint_path = target / "footprint.json"
        placed = records.read(results / "footprint.json", Footprint)
        records.write(footprint_path, replace(placed, sun_azimuth_deg=azimuth + SUN_ERROR_DEG))
    heights = {"reference_dem_heights": settings["sites"][site]["reference_dem_heights"]}
    matches_path, gcps_path, summary_path = (target / n for n in ("matches.parquet", "gcps.parquet", "gcps.json"))
    common = (results / "film.tif", footprint_path, paths["reference_dem"])
    began = time.process_time()
    match_tiles(
        *common, paths["reference_image"], matches_path, scatteritem="1-of-1", **heights, **chosen, threads=1
    )  # fmt: skip
    taken = time.process_time() - began
    said = {**settings["collect_gcps"], "reference_sigma_m": reference_sigma_m}
    collect(matches_path, results, paths, gcps_path, summary_path, heights, said)

    matches = tables.read(matches_path)
    posting_m = float(matches["posting_m"].iloc[0])
    camera = records.read(results / "footprint.json", Footprint).camera
    film_mm = abs(rasters.info(results / "film.tif").grid.step_x)
    px_mm = film_mm * posting_m / ground_pixel_m(camera, film_mm, 1000.0)
    gcps, summary = tables.read(gcps_path), records.read_json(summary_path)
    kept = gcps[gcps["role"] != "rejected"]
    xy = kept[["x_mm", "y_mm"]].to_numpy()
    lonlath = kept[["longitude_deg", "latitude_deg", "height_m"]].to_numpy()
    error_mm = film_errors_mm(folder, site, scene, xy, lonlath)
    error_px = np.linalg.norm(error_mm, axis=1) / px_mm
    claimed_mm = kept[["sigma_x_px", "sigma_y_px"]].to_numpy() * film_mm
    return {
        "scene": scene,
        "matcher": name,
        "reference": Path(reference).stem,
        "px": f"{posting_m:.1f} m",
        "matches": len(matches),
        "gcps": len(kept),
        "median_px": float(np.median(error_px)),
        "beyond_3_px": float((error_px > RIGHT_PX).mean()),
        "error/sigma": float(np.sqrt(np.mean(np.clip(error_mm / claimed_mm, -5, 5) ** 2))),
        "sigma_factor": summary["sigma_factor"],
        "cells": summary["coverage"]["cells"],
        "seconds": taken,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def collect(matches_path, results, paths, gcps_path, summary_path, heights, chosen):
    """The rule collect_gcps."""
    collect_gcps(
        [matches_path], results / "film.tif", results / "footprint.json", paths["reference_dem"],
        paths["reference_image"], paths["unstable_terrain"], None, gcps_path, summary_path, **heights, **chosen,
    )  # fmt: skip


def real_images(names: list[str], data: Path) -> list[dict]:
    """Matches of two real images of one place and grid, right and wrong, band by band."""
    rows = []
    chosen = sheets.fill_defaults(sheets.schema("config")["properties"]["match_tiles"], {})
    keys = ("template_px", "search_px", "min_score", "max_ratio", "max_return_px", "max_features", "superglue_weights")
    for band in BANDS:
        july, november = (
            rasters.read(data / "pennsylvania" / f"landsat7_2002{day}_b123457.tif", band).astype(np.float32)
            for day in ("0720", "1125")
        )
        for name in names:
            kind, _, features = name.partition(":")
            try:
                matcher = matcher_by_name(
                    kind, features=features or chosen["features"], **{key: chosen[key] for key in keys}
                )
            except CospError as error:
                print(f"skipped {name}: {error}")
                continue
            points = lattice_rc(july.shape, 8, chosen["template_px"] // 2 + chosen["search_px"])
            began = time.process_time()
            found = matcher.match(july, november, points, threads=1)
            taken = time.process_time() - began
            off = found.fixed_rc - found.moving_rc
            right = np.linalg.norm(off, axis=1) <= RIGHT_PX
            rows.append(
                {
                    "band": band,
                    "matcher": name,
                    "right": int(right.sum()),
                    "wrong": int((~right).sum()),
                    "shift_px": " ".join(f"{v:+.2f}" for v in np.median(off[right], axis=0)) if right.any() else "",
                    "seconds": taken,
                }
            )
    return rows


def show(rows: list[dict]) -> None:
    """Rows as a Markdown table."""
    if not rows:
        return
    print("| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()) + " |")


def main() -> int:
    """Read the command line, measure, print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="a site of the simulator with placed films; only read")
    parser.add_argument("--make", type=Path, help="a new folder, to make such a site in")
    parser.add_argument("--pixel-um", type=float, default=56.0)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--matchers", default=MATCHERS)
    parser.add_argument("--scenes", type=int, default=1, help="films to match")
    parser.add_argument("--real", action="store_true", help="the real images instead of a site")
    parser.add_argument("--reference", default="image", help="image of the site, relief of its DEM, or an image file")
    parser.add_argument("--reference-m", type=float, help="make a reference image of this posting, of --stretch-mm")
    parser.add_argument("--reference-error-m", type=float, default=0.6, help="m, per axis")
    parser.add_argument("--stretch-mm", type=float, default=40.0, help="of the film about its middle")
    parser.add_argument("--one", nargs=4, metavar=("SCENE", "MATCHER", "REFERENCE", "SIGMA"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    names = options.matchers.split(",")
    if options.real:
        data = Path(os.environ.get("COSP_TEST_DATA", ""))
        if not (data / "pennsylvania").is_dir():
            print("skipped: COSP_TEST_DATA does not hold pennsylvania")
            return 0
        show(real_images(names, data))
        return 0
    if options.one:
        with tempfile.TemporaryDirectory() as target:
            print(json.dumps(measure(options.folder, *options.one[:3], float(options.one[3]), Path(target))))
        return 0
    if options.make:
        if options.make.exists():
            parser.error(f"{options.make} is there already; a site is made in a new folder only")
        make_site(options.make, options)
    folder = options.make or options.folder
    scenes = sorted(path.parent.name for path in folder.glob("results/scenes/*/footprint.json")) if folder else []
    if not scenes:
        parser.error("no placed film; name a site by --folder, or a new folder by --make")
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for scene in scenes[: options.scenes]:
            reference, sigma_m = options.reference, REFERENCE_ERROR_M
            if options.reference_m:
                reference, sigma_m = f"{scratch}/{options.reference_m:g} m.tif", options.reference_error_m
                made = (options.reference_m, options.reference_error_m, options.stretch_mm)
                make_reference(folder, scene, Path(reference), *made)
            for name in names:
                command = [sys.executable, str(Path(__file__)), "--folder", str(folder)]
                command += ["--one", scene, name, reference, str(sigma_m)]
                done = subprocess.run(command, capture_output=True, text=True)
                if done.returncode:
                    print(f"skipped {name}: {done.stderr.strip().splitlines()[-1]}")
                    continue
                rows.append(json.loads(done.stdout.splitlines()[-1]))
    show(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
