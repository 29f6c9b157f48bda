"""Describe a simulated site to the workflow: writes its config and sheets, makes nothing yet."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Transformer

from cosp.io import rasters
from cosp.io.heights import undulation_at
from cosp.simulation.description import config_text, pair_sheet, scene_sheet, site_config, square_about_centre
from cosp.simulation.site import SiteSettings, plan_site


def main(arguments: list[str] | None = None) -> None:
    """Read the command line, plan the site and write `config.yaml`, `scenes.tsv` and `pairs.tsv`."""
    parser = argparse.ArgumentParser(
        prog="python -m cosp.simulation",
        description="Writes config.yaml, scenes.tsv and pairs.tsv of a simulated site; "
        "snakemake --configfile DIR/config.yaml --directory DIR then makes and processes it.",
    )
    parser.add_argument("--directory", type=Path, required=True, help="working folder of the run")
    parser.add_argument(
        "--area-of-interest-km", type=float, default=None, help="limit dense products to a square about the centre"
    )
    for field in dataclasses.fields(SiteSettings):
        flag = "--" + field.name.replace("_", "-")
        default: Any = field.default
        if isinstance(default, bool):
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=None)
        else:
            kind = str if default is None else type(default)
            parser.add_argument(flag, type=kind, default=None, help=f"default {default}")
    chosen = vars(parser.parse_args(arguments))
    directory: Path = chosen.pop("directory")
    side_km = chosen.pop("area_of_interest_km")
    settings = settings_from({key: value for key, value in chosen.items() if value is not None}, directory)
    plan = plan_site(settings)

    directory.mkdir(parents=True, exist_ok=True)
    area = None
    if side_km is not None:
        area = "area_of_interest.geojson"
        (directory / area).write_text(json.dumps(square_about_centre(plan, side_km)) + "\n", encoding="utf-8")
    config = site_config(plan, scenes="scenes.tsv", pairs="pairs.tsv", area_of_interest=area)
    (directory / "config.yaml").write_text(config_text(config), encoding="utf-8")
    (directory / "scenes.tsv").write_text(scene_sheet(plan), encoding="utf-8")
    (directory / "pairs.tsv").write_text(pair_sheet(plan), encoding="utf-8")
    print(f"{directory}: config.yaml, scenes.tsv and pairs.tsv of {len(plan.scenes)} scenes of {settings.name}")


def settings_from(chosen: dict[str, Any], directory: Path) -> SiteSettings:
    """Settings with a given DEM's place and mean height filled in where they were not chosen.

    Paths are made absolute, since the workflow may run in another folder.
    """
    chosen = dict(chosen)
    for key in ("dem", "image"):
        if key in chosen:
            path = Path(chosen[key])
            chosen[key] = str(path.resolve() if path.exists() else (directory / path).resolve())
    if "dem" in chosen:
        info = rasters.info(chosen["dem"])
        xmin, ymin, xmax, ymax = info.grid.bounds
        transformer = Transformer.from_crs(info.crs, "EPSG:4326", always_xy=True)
        longitude, latitude = transformer.transform((xmin + xmax) / 2.0, (ymin + ymax) / 2.0)
        chosen.setdefault("centre_longitude_deg", round(float(longitude), 4))
        chosen.setdefault("centre_latitude_deg", round(float(latitude), 4))
        heights = rasters.read_reduced(chosen["dem"], 16).astype(float)
        if info.nodata is not None:
            heights = heights[heights != info.nodata]
        system = chosen.get("dem_heights", SiteSettings().dem_heights)
        geoid = undulation_at(np.array([longitude, latitude]), system)
        mean = float(np.nanmean(heights[heights > -500.0]) + geoid)
        chosen.setdefault("ground_height_m", round(mean, 0))
    return SiteSettings(**chosen)


if __name__ == "__main__":
    main()
