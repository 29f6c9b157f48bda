"""The film stages over simulated films with defects drawn at random, and their speed beside a plain copy.

    python -m tests.benchmarks.film table results.jsonl [films of each camera] [pixel_um]
    python -m tests.benchmarks.film speed <parts of one film, KH-4B, fore> [--pixel-um 7] [--threads 2]

The first prints docs/film.md's table; films whose result is in the file already are not made again. The second prints
megabytes of parts per second of wall time, and what copying the same files takes in the same run.
"""

from __future__ import annotations

import json
import resource
import runpy
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from cosp import sheets
from cosp.errors import CospError
from cosp.film.arrangement import Pose
from cosp.film.bending import Bending
from cosp.film.exposure import Exposure
from cosp.film.joining import Layout
from cosp.geometry.grids import PixelGrid
from cosp.io import rasters, records
from cosp.simulation.site import SiteSettings
from tests.film.delivered import Wishes, deliver, errors

HOME = Path(__file__).resolve().parents[2]
CAMERAS = ("KH-4", "KH-4A", "KH-4B")
SCENE = "DS1104-2169DF092"


def run_stages(parts, folder, *, camera, look, pixel_um, threads):
    """The three scripts as the workflow runs them, with the choices of the schema."""
    choices = sheets.fill_defaults(sheets.schema("config"), {"sites": {}})
    scripts = {name: runpy.run_path(str(HOME / "scripts" / f"{name}.py"))[name] for name in STAGES}
    seams, exposure, stripes = (folder / name for name in ("seams.json", "exposure.json", "stripes.parquet"))
    scripts["stitch"](
        parts,
        seams,
        folder / "seams.png",
        scene=SCENE,
        missing=[],
        pixel_um=pixel_um,
        threads=threads,
        **choices["stitch"],
    )
    traced = choices["trace_stripes"]
    scripts["trace_stripes"](parts, seams, exposure, stripes, camera=camera, pixel_um=pixel_um, **traced)
    outputs = [folder / name for name in ("film.tif", "film.json", "bending.png")]
    scripts["correct_bending"](
        parts,
        seams,
        exposure,
        stripes,
        *outputs,
        scene=SCENE,
        camera=camera,
        look=look,
        threads=threads,
        **choices["correct_bending"],
    )


STAGES = ("stitch", "trace_stripes", "correct_bending")


def draw(camera, number, pixel_um):
    """Settings, look and wishes of a film, drawn within what archives deliver."""
    rng = np.random.default_rng([CAMERAS.index(camera), number])
    stepped = rng.random() < 1 / 3
    settings = SiteSettings(
        seed=1000 + number,
        camera=camera,
        pixel_um=pixel_um,
        overlap_mm=float(10 ** rng.uniform(1, 2)),
        part_rotation_deg=0.5,
        part_shift_mm=float(rng.uniform(0.3, 1.5)),
        part_contrast=float(rng.uniform(0.02, 0.15)),
        bending_mm=float(rng.uniform(0.1, 1.0)),
        distortion_px=float(rng.uniform(0.5, 2.0)),
        shrinkage=float(rng.uniform(0.0, 0.002)),
        scratches=int(rng.integers(10, 60)),
        dust=int(rng.integers(100, 800)),
        # Blocks displaced by 0.3 to 0.8 of this digitisation's pixels rms: the largest steps reach two.
        scanner_step_px=float(rng.uniform(0.3, 0.8)) * pixel_um / 7 if stepped else 0.0,
        scanner_step_mm=float(rng.uniform(12, 35)),
    )
    order = [(0, 1, 2, 3), (0, 1, 2, 3), (3, 2, 1, 0), tuple(int(i) for i in rng.permutation(4))][rng.integers(4)]
    poses = [Pose()] * 4
    if rng.random() < 0.25:
        turned, mirrored = rng.choice(4, 2, replace=False)
        poses[turned], poses[mirrored] = Pose(turned=True), Pose(mirrored=True)
    ends = tuple(str(rng.choice(["", "", "", "", "night", "snow"])) for _ in range(2))
    weak = int(rng.integers(3)) if rng.random() < 0.25 else None
    wishes = Wishes(weak, ends, float(rng.uniform(0.0, 0.6)), order, tuple(poses))
    return settings, str(rng.choice(["fore", "aft"])), wishes


def measure(camera, number, pixel_um):
    """What happened to one film."""
    settings, look, wishes = draw(camera, number, pixel_um)
    film = deliver(settings, look, wishes, number=number)
    told = {
        "camera": camera,
        "number": number,
        "pixel_um": pixel_um,
        "weak": wishes.weak_overlap,
        "steps": settings.scanner_step_px > 0,
        "ends": wishes.ends,
        "overlap_mm": settings.overlap_mm,
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        parts = []
        for letter, image in zip("abcd", film.by_letter(), strict=True):
            parts.append(str(folder / f"{SCENE}_{letter}.tif"))
            rasters.write(parts[-1], image, grid=PixelGrid(0.5, 0.5, 1.0, 1.0, image.shape))
        begin = time.process_time()
        try:
            run_stages(parts, folder, camera=camera, look=look, pixel_um=pixel_um, threads=1)
        except CospError as problem:
            return told | {"refused": str(problem)}
        told["seconds"] = time.process_time() - begin
        seams, summary = (records.read_json(folder / file) for file in ("seams.json", "film.json"))
        layout = records.from_plain(seams["layout"], Layout, "layout")
        bending = records.from_plain(summary["bending"], Bending, "bending")
        exposure = records.from_plain(summary["exposure"], Exposure, "exposure")
        found = errors(film, seams, layout, exposure, bending, summary["turned"])
    letters = [name[-1] for name in seams["part_order"]]
    places = [wishes.order["abcd".index(letter)] for letter in letters]
    return told | {
        "source": bending.source,
        "bending_sd_um": 1000 * bending.sd_mm,
        "centre_sd_mm": summary["centre_sd_mm"],
        "seam_px": found.seam_px.tolist(),
        "seam_weak": [wishes.weak_overlap == min(places[k : k + 2]) for k in range(len(letters) - 1)],
        "seam_steps": [len(seam["steps"]) for seam in seams["seams"]],
        "step_overlap_px": found.step_overlap_px.tolist(),
        "step_elsewhere_px": found.step_elsewhere_px.tolist(),
        "straightness_um": found.straightness_um,
        "parallel_um": found.parallel_um,
        "scale_ppm": found.scale_ppm,
        "centre_mm": found.centre_mm,
    }


def silent(film):
    """Whether a film that was not refused is wrong beyond what is said of it."""
    if "refused" in film:
        return False
    along, across = (abs(e) > max(4 * sd, 0.1) for e, sd in zip(film["centre_mm"], film["centre_sd_mm"], strict=True))
    return max(film["seam_px"]) > 2.0 or along or across


def table(path, count, pixel_um):
    """Make the films that are missing, print the table."""
    done = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    made = {(film["camera"], film["number"]) for film in done if film["pixel_um"] == pixel_um}
    for number in range(count):
        for camera in CAMERAS:
            if (camera, number) not in made:
                done.append(records.as_plain(measure(camera, number, pixel_um)))
                with path.open("a") as file:
                    file.write(json.dumps(done[-1]) + "\n")
    done = [film for film in done if film["pixel_um"] == pixel_um and film["number"] < count]
    print(f"{len(done)} films digitised at {pixel_um:g} µm.\n")
    print("| | " + " | ".join(CAMERAS) + " |")
    print("|---|" + "---|" * len(CAMERAS))

    def row(name, values, form="{:.2f}"):
        cells = []
        for camera in CAMERAS:
            all_of = [v for film in done if film["camera"] == camera and "refused" not in film for v in values(film)]
            three = (np.median(all_of), np.quantile(all_of, 0.9), np.max(all_of)) if all_of else ()
            cells.append(" / ".join(form.format(v) for v in three) or "–")
        print(f"| {name} | " + " | ".join(cells) + " |")

    def counted(name, holds):
        print(f"| {name} | " + " | ".join(str(sum(holds(f) for f in done if f["camera"] == c)) for c in CAMERAS) + " |")

    counted("films", lambda film: True)
    counted("refused", lambda film: "refused" in film)
    counted("wrong and not refused", silent)
    for by in ("stripes", "edges", "none"):
        counted(f"straightened by {by}", lambda film, by=by: film.get("source") == by)
    # Seams: (weak, stepped).
    kinds = {"textured": (0, 0), "weak": (1, 0), "with scanner steps": (0, 1), "weak, with scanner steps": (1, 1)}
    for name, kind in kinds.items():
        row(
            f"seam, {name} (px)",
            lambda film, kind=kind: [
                e for e, w in zip(film["seam_px"], film["seam_weak"], strict=True) if (w, film["steps"]) == kind
            ],
            "{:.3f}",
        )
    for where in ("overlap", "elsewhere"):
        row(f"scanner step left, {where} (px)", lambda f, key=f"step_{where}_px": f[key] if f["steps"] else [])
        row(f"false step, {where} (px)", lambda f, key=f"step_{where}_px": [] if f["steps"] else [0.0, *f[key]])
    still = lambda key, factor: lambda film: [] if film["steps"] else [abs(film[key]) * factor]  # noqa: E731
    row("straightness (px)", still("straightness_um", 1 / pixel_um))
    row("straightness (µm)", still("straightness_um", 1.0), "{:.1f}")
    row("straightness with scanner steps (px)", lambda f: [f["straightness_um"] / pixel_um] if f["steps"] else [])
    row("scale (ppm)", still("scale_ppm", 1.0), "{:.0f}")
    row("centre along (mm)", lambda film: [abs(film["centre_mm"][0])], "{:.3f}")
    row("centre across (mm)", lambda film: [abs(film["centre_mm"][1])], "{:.3f}")
    row("centre along / its sd", lambda film: [abs(film["centre_mm"][0]) / film["centre_sd_mm"][0]])
    row("centre across / its sd", lambda film: [abs(film["centre_mm"][1]) / film["centre_sd_mm"][1]])


def speed(parts, pixel_um, threads):
    """Time the stages and a plain copy of the same parts, in turns."""
    megabytes = sum(rasters.info(part).shape[0] * rasters.info(part).shape[1] for part in parts) / 1e6
    with tempfile.TemporaryDirectory(dir=Path(parts[0]).parent) as name:
        folder = Path(name)
        spent = {}
        for what, work in {
            "plain copy": lambda: [
                rasters.write(folder / "copy.tif", rasters.read(p), grid=PixelGrid(0, 0, 1, 1, (1, 1))) for p in parts
            ],
            "file copy": lambda: [shutil.copy(part, folder / "copy.tif") for part in parts],
            "film stages": lambda: run_stages(
                parts, folder, camera="KH-4B", look="fore", pixel_um=pixel_um, threads=threads
            ),
        }.items():
            begin = time.perf_counter(), time.process_time()
            work()
            spent[what] = time.perf_counter() - begin[0], time.process_time() - begin[1]
    for what, (wall, processor) in spent.items():
        print(f"{what}: {wall:.1f} s, {processor:.1f} s of processor time, {megabytes / wall:.0f} MB/s")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    import argparse

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    films = commands.add_parser("table")
    films.add_argument("results", type=Path)
    films.add_argument("count", type=int, nargs="?", default=10)
    films.add_argument("pixel_um", type=float, nargs="?", default=56.0)
    scans = commands.add_parser("speed")
    scans.add_argument("parts", nargs="+")
    scans.add_argument("--pixel-um", type=float, default=7.0)
    scans.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    if given.command == "table":
        table(given.results, given.count, given.pixel_um)
    else:
        speed(given.parts, given.pixel_um, given.threads)
    sys.exit(0)
