"""Placement of films whose prediction is wrong in every respect: how many are placed, refused, placed wrongly.

python tests/benchmarks/placement.py [trials] [first] [table.tsv]

Whole films are exposed over made-up mountains of two epochs (other sun, snow line, fields and forests). Each trial
hides a share of the film under clouds, lays it one of four ways round, and predicts it up to 100 km, 10 degrees and
5 per cent wrong, with the errors of velocity and rates that are expected of a prediction. Ground is usable where it is
seen and, if there is nothing but relief to compare with, not flat. A film is placed right if its usable ground is; the
rest follows from that, and its error is a figure of its own. The last posting is the first at which places are checked.
With a table, trials are added to it, those that it holds are not run again, and the tables of all of them are printed.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from pyproj import Transformer
from scipy.ndimage import gaussian_filter

from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.matching.film_image import FilmImage
from cosp.matching.ground import grown, map_bounds
from cosp.matching.placement import SearchLimits, locate_film, turned_about_centre
from cosp.simulation.site import SiteSettings, plan_site
from cosp.simulation.terrain import FILM_EPOCH, MODERN_EPOCH, light_terrain, make_terrain
from tests.matching.conftest import CRS, World, make_camera, moved

WORLD_POSTING_M = 120.0
LIMITS = SearchLimits(
    coarse_posting_m=240.0, fine_posting_m=85.0, min_score=5.0, min_margin=2.0, min_agreeing=12,
    min_agreeing_share=0.3, min_block_share=0.5, max_sigma_m=300.0,
)  # fmt: skip
PIXEL_MM = 0.3
# A film whose usable ground is placed within this of the truth, in millimetres of film, is placed right: five pixels of
# the last level, well within what the next posting searches.
RIGHT_MM = 1.5
TRIALS_PER_WORLD = 20
# How wrong the prediction's velocity (m a scan), rates (radians a scan) and image motion compensation are: the narrow
# set of docs/conventions.md.
SHAPE_SIGMA = np.array([0, 0, 0, 80, 50, 30, 0, 0, 0, *np.radians([0.1, 0.5, 0.1]), 0.002])
# Share of the film that must show usable ground for it to be placed.
ENOUGH = 0.3
# Ground is flat where heights within so far differ by less than this standard deviation.
FLAT_REACH_M, FLAT_M = 3000.0, 40.0
WAYS = {
    (False, False): np.s_[:, :],
    (True, False): np.s_[::-1, ::-1],
    (False, True): np.s_[::-1],
    (True, True): np.s_[:, ::-1],
}


def world_of(seed, camera):
    """Ground, film and what the film hides nothing of."""
    settings = SiteSettings(
        seed=seed, centre_longitude_deg=9.0, centre_latitude_deg=46.0, snow_line_m=2600.0, modern_snow_line_m=3100.0
    )
    grid = PixelGrid.covering(grown(map_bounds(camera, CRS, (0.0, 3000.0)), 60e3), WORLD_POSTING_M)
    plan = replace(plan_site(settings), crs=CRS, terrain_grid=grid)
    terrain = make_terrain(plan, threads=1)
    epochs = [light_terrain(plan, terrain, epoch, threads=1).radiance for epoch in (FILM_EPOCH, MODERN_EPOCH)]
    pictures = [np.maximum(picture, 1).astype(np.float32) for picture in epochs]
    world = World(grid, pictures[1], terrain.modern)
    film = world.expose(camera, image=pictures[0], rng=np.random.default_rng([seed, 1]), pixel_mm=PIXEL_MM)
    return world, film


def clouded(pixels, share, rng):
    """A film of which clouds leave only a share to be seen; clouds have a texture of their own."""
    where = gaussian_filter(rng.standard_normal(pixels.shape), 20.0 / PIXEL_MM)
    hidden = where > np.quantile(where, share)
    billows = sum(s * gaussian_filter(rng.standard_normal(pixels.shape), s) for s in (1.0, 4.0, 16.0))
    white = np.clip(215 + 15 * billows / billows.std(), 1, 255)
    return np.where(hidden, white, pixels).astype(np.uint8), hidden


def usable(world, camera, points, seen, *, relief):
    """Which film points show ground to compare with."""
    if not relief:
        return seen
    reach = FLAT_REACH_M / WORLD_POSTING_M / 2
    mean, square = (gaussian_filter(world.heights.astype(float) ** power, reach) for power in (1, 2))
    rough = np.sqrt(np.maximum(square - mean**2, 0)) > FLAT_M
    lonlat = camera.locate_geodetic(points, 1500.0)[..., :2]
    place = np.stack(Transformer.from_crs("EPSG:4326", CRS, always_xy=True).transform(*np.moveaxis(lonlat, -1, 0)), -1)
    rows, columns = (np.round(v).astype(int) for v in world.grid.pixels(place))
    return seen & rough[rows, columns]


def trial(number, world, film, camera):
    """One film placed, and how."""
    rng = np.random.default_rng([77, number])
    share = float(rng.choice([0.1, 0.2, 0.3, 0.5, 0.75, 1.0], p=[0.1, 0.1, 0.2, 0.2, 0.2, 0.2]))
    way = list(WAYS)[int(rng.integers(4))]
    shift_m, bearing = rng.uniform(0, 100e3), rng.uniform(0, 2 * np.pi)
    turn_deg, scale = rng.uniform(-10, 10), rng.uniform(-0.05, 0.05)
    if rng.random() < 0.5:  # corners that are merely moved, as most are
        turn_deg, scale = turn_deg / 10, scale / 5
    pixels = film.read(Window(0, film.grid.shape[0], 0, film.grid.shape[1]))
    shown, hidden = clouded(pixels, share, rng)
    laid = FilmImage.from_array(np.ascontiguousarray(shown[WAYS[way]]), film.grid)
    points = np.stack(np.meshgrid(np.linspace(-340, 340, 69), np.linspace(-26, 26, 7)), -1)
    rows, columns = (np.round(v).astype(int) for v in film.grid.pixels(points))
    useful = usable(world, camera, points, ~hidden[rows, columns], relief=number % 5 == 0)
    predicted = turned_about_centre(camera, np.radians(turn_deg), 1 + scale, 1500.0)
    predicted = moved(predicted, shift_m * np.cos(bearing), shift_m * np.sin(bearing))
    shape = SHAPE_SIGMA * np.random.default_rng([78, number]).standard_normal(13)
    predicted = predicted.with_parameters(predicted.parameters() + shape)
    start = time.process_time()
    row = {"trial": number, "share": share, "turned": way[0], "mirrored": way[1], "shift_km": shift_m / 1e3,
           "turn_deg": turn_deg, "scale": 100 * scale, "relief": number % 5 == 0,
           "usable": useful.mean()}  # fmt: skip
    located = locate_film(
        laid, predicted, reference_on=None if row["relief"] else world.on(world.image),
        heights_on=world.on(world.heights), day=None, crs=CRS, search_m=100e3, limits=LIMITS,
        rng=np.random.default_rng(0), threads=1,
    )  # fmt: skip
    found = located.footprint
    if found is None:
        return {**row, "outcome": "refused", "cpu_s": time.process_time() - start, "why": located.refusal}
    errors_mm = np.linalg.norm(found.camera.project(camera.locate(points, 1500.0)) - points, axis=-1)
    error_mm = errors_mm[useful].max()
    right = (found.turned, found.mirrored) == way and error_mm < RIGHT_MM
    return {
        **row, "outcome": "right" if right else "wrong", "cpu_s": time.process_time() - start, "error_mm": error_mm,
        "elsewhere_mm": errors_mm.max(), "sigma_m": found.sigma_m,
        "score": found.score, "rival": found.rival_score, "margin": found.margin, "by": found.reference,
    }  # fmt: skip


def table_of(trials, *by):
    """Outcomes by some properties of the trials."""
    groups = []
    for key, rows in trials.groupby(list(by), observed=True):
        counts = rows["outcome"].value_counts()
        placed = rows[rows["outcome"] == "right"]
        groups.append(
            {
                **dict(zip(by, key, strict=True)),
                "trials": len(rows),
                "placed": counts.get("right", 0),
                "refused": counts.get("refused", 0),
                "wrong": counts.get("wrong", 0),
                "median error (mm of film)": f"{placed['error_mm'].median():.2f}",
                "median score": f"{placed['score'].median():.1f}",
                "median CPU (s)": f"{rows['cpu_s'].median():.0f}",
            }  # fmt: skip
        )
    return pd.DataFrame(groups)


def with_groups(trials):
    """Trials and the groups that their tables are of."""
    way = trials["turned"].astype(int) + 2 * trials["mirrored"].astype(int)
    return trials.assign(
        **{
            "evidence": np.where(trials["relief"], "relief alone", "image and relief"),
            "usable ground": pd.cut(trials["usable"], [0, 0.15, 0.3, 0.5, 0.75, 1], include_lowest=True).map(
                lambda interval: f"{max(interval.left, 0):.0%} to {interval.right:.0%}"
            ),
            "enough": np.where(trials["usable"] >= ENOUGH, f"at least {ENOUGH:.0%} usable", "less"),
            "shift": pd.cut(trials["shift_km"], [0, 25, 50, 75, 100]).map(
                lambda interval: f"{interval.left} to {interval.right} km"
            ),
            "way round": way.map(dict(enumerate(["as it is", "turned", "mirrored", "turned and mirrored"]))),
            "heading": np.where(
                (trials["turn_deg"].abs() <= 2.5) & (trials["scale"].abs() <= 2.5),
                "within 2.5 degrees and 2.5 %",
                "up to 10 degrees and 5 %",
            ),  # fmt: skip
        }
    )


def as_markdown(table):
    lines = ["| " + " | ".join(table.columns) + " |", "|" + "---|" * len(table.columns)]
    rows = [
        "| " + " | ".join("–" if v == "nan" else str(v) for v in row) + " |" for row in table.itertuples(index=False)
    ]
    return "\n".join(lines + rows)


def main(count=200, first=0, path=None):
    """Run trials and print their table."""
    camera = make_camera(half_length_mm=357.0)
    rows, here = [], None
    known = set(pd.read_csv(path, sep="\t")["trial"]) if path and Path(path).exists() else set()
    for number in sorted(set(range(first, first + count)) - known):
        if here is None or number // TRIALS_PER_WORLD != here[0]:
            here = (number // TRIALS_PER_WORLD, *world_of(100 + number // TRIALS_PER_WORLD, camera))
        rows.append(trial(number, *here[1:], camera))
        print({k: round(v, 2) if isinstance(v, float) else v for k, v in rows[-1].items()}, flush=True)
        if path:
            pd.DataFrame(rows[-1:]).reindex(columns=COLUMNS).to_csv(
                path, sep="\t", mode="a", index=False, header=not Path(path).exists()
            )
    trials = with_groups(pd.read_csv(path, sep="\t") if path else pd.DataFrame(rows).reindex(columns=COLUMNS))
    for by in (["evidence", "usable ground"], ["evidence", "enough"], ["shift"], ["way round"], ["heading"]):
        print(as_markdown(table_of(trials, *by)), end="\n\n")


COLUMNS = ["trial", "share", "turned", "mirrored", "shift_km", "turn_deg", "scale", "relief", "usable", "outcome",
           "cpu_s", "error_mm", "elsewhere_mm", "sigma_m", "score", "rival", "margin", "by", "why"]  # fmt: skip

if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:3]), *sys.argv[3:4])
