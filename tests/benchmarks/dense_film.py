"""Dense matching of a whole film, strip by strip as the workflow does: processor time per pixel and peak memory.

    python -m tests.benchmarks.dense_film results/pairs/PAIR --folder SCRATCH
    python -m tests.benchmarks.dense_film results/pairs/PAIR --folder SCRATCH --rows 20000 --strips 1

The rectified images of a finished pair are repeated, every other copy upside down, to the size of two whole films. The
disparity range is widened to the span wanted, which costs nothing that a film with as much relief would not cost. The
pair's own rows hold less data than a film does; `--columns` and what is printed about data say how much.
"""

import argparse
import resource
import time
from pathlib import Path

import numpy as np

from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters, records
from scripts.match_dense import match_dense
from tests.benchmarks.dense_matching import OURS

CHUNK_ROWS = 4096


def repeat(source_path, target_path, shape, first_column):
    """Write an image of the shape wanted; returns the share of it that has data."""
    header = rasters.info(source_path)
    picture = rasters.read(source_path)[:, first_column : first_column + shape[1]]
    picture = picture[(picture > 0).mean(axis=1) > 0.5]
    # Blocks upside down in turn, so that rows go on where one ends.
    order = np.concatenate([np.arange(len(picture)), np.arange(len(picture))[::-1]])
    grid = PixelGrid(header.grid.x0, header.grid.y0, header.grid.step_x, header.grid.step_y, shape)
    given = 0
    with rasters.create(target_path, shape=shape, dtype=np.uint8, grid=grid, crs=header.crs) as target:
        for start in range(0, shape[0], CHUNK_ROWS):
            stop = min(start + CHUNK_ROWS, shape[0])
            rows = picture[order[np.arange(start, stop) % len(order)]]
            given += np.count_nonzero(rows)
            target.write(Window(start, stop, 0, shape[1]), rows)
    return given / (shape[0] * shape[1])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pair", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--rows", type=int, default=106_000)
    parser.add_argument("--columns", type=int, default=8000)
    parser.add_argument("--first-column", type=int, default=1600)
    parser.add_argument("--span", type=float, default=1400.0)
    parser.add_argument("--strips", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    chosen = parser.parse_args()
    chosen.folder.mkdir(parents=True, exist_ok=True)
    rows, columns = chosen.rows, chosen.columns
    paths = {name: chosen.folder / f"{name}_epipolar.tif" for name in ("fore", "aft")}
    for name, path in paths.items():
        share = repeat(chosen.pair / path.name, path, (rows, columns), chosen.first_column)
        print(f"{name}: {rows} x {columns} px, {100 * share:.0f} % data", flush=True)
    middle = np.mean(records.read_json(chosen.pair / "rectification.json")["disparity_range_px"])
    limits = [float(middle - chosen.span / 2), float(middle + chosen.span / 2)]
    records.write(chosen.folder / "range.json", {"kind": "range", "version": 1, "disparity_range_px": limits})

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    used, wall = time.process_time(), time.perf_counter()
    for strip in range(1, chosen.strips + 1):
        started = time.process_time()
        match_dense(
            paths["fore"],
            paths["aft"],
            chosen.pair / "y_parallax.tif",
            chosen.folder / "range.json",
            chosen.folder / "disparity" / f"{strip}.npy",
            chosen.folder / "validity" / f"{strip}.npy",
            strip=f"{strip}-of-{chosen.strips}",
            **{**OURS, "threads": chosen.threads},
        )
        part = time.process_time() - started
        print(f"strip {strip}: {1e9 * part * chosen.strips / (rows * columns):.0f} ns/px", flush=True)
    used, wall = time.process_time() - used, time.perf_counter() - wall
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    pixels = rows * columns
    print(f"{1e9 * used / pixels:.0f} ns/px of one core with reading, halos and writing; {wall / 60:.1f} min")
    print(f"peak {peak:.0f} MB, {before:.0f} MB before matching")
