"""The sheets and the config that describe a simulated site to the workflow, as text."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import yaml
from pyproj import Transformer

from cosp.simulation.site import SitePlan, SiteSettings

_CORNERS = ("nw", "ne", "se", "sw")


def folder_of(settings: SiteSettings) -> str:
    """Where the workflow keeps a simulated site, relative to the working folder."""
    return f"resources/simulated/{settings.name}"


def scene_sheet(plan: SitePlan) -> str:
    """Text of the scene sheet."""
    corners = [f"{corner}_{axis}" for corner in _CORNERS for axis in ("lat", "lon")]
    lines = ["\t".join(["scene", "site", "parts", *corners, "date", "pixel_um", "camera", "look"])]
    settings = plan.settings
    for scene in plan.scenes:
        degrees = [f"{value:.4f}" for value in scene.corners_deg.ravel()]
        row = [scene.scene, settings.name, f"{folder_of(settings)}/parts", *degrees]
        lines.append("\t".join([*row, settings.date, f"{settings.pixel_um:g}", settings.camera, scene.look]))
    return "\n".join(lines) + "\n"


def pair_sheet(plan: SitePlan) -> str:
    """Text of the pair sheet."""
    return "\n".join(["pair\tfore\taft", *("\t".join(pair) for pair in plan.pairs)]) + "\n"


def site_config(plan: SitePlan, *, scenes: str, pairs: str, area_of_interest: str | None = None) -> dict[str, Any]:
    """Config of a workflow run over the site: paths of the sheets, the site's files, and how to simulate it."""
    settings = plan.settings
    folder = folder_of(settings)
    site: dict[str, Any] = {
        "reference_dem": f"{folder}/reference_dem.tif",
        "reference_dem_heights": "ellipsoidal",
        "reference_image": f"{folder}/reference_image.tif",
        "unstable_terrain": f"{folder}/unstable_terrain.gpkg",
        "crs": "auto",
        "dem_resolution_m": plan.dem_resolution_m,
        "check_dem": f"{folder}/truth/terrain.tif",
        "check_dem_heights": "ellipsoidal",
    }
    if area_of_interest is not None:
        site["area_of_interest"] = area_of_interest
    choices = {key: value for key, value in asdict(settings).items() if key != "name"}
    return {
        "scenes": scenes,
        "pairs": pairs,
        "sites": {settings.name: site},
        "simulate_site": {settings.name: choices},
    }


def config_text(config: dict[str, Any]) -> str:
    """A config as YAML, keys in their order."""
    return yaml.safe_dump(config, sort_keys=False, allow_unicode=True)


def square_about_centre(plan: SitePlan, side_km: float) -> dict[str, Any]:
    """GeoJSON polygon of a square of the site's map, in longitude and latitude, about the site's centre."""
    settings = plan.settings
    transformer = Transformer.from_crs("EPSG:4326", plan.crs, always_xy=True)
    east, north = transformer.transform(settings.centre_longitude_deg, settings.centre_latitude_deg)
    ring = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * side_km * 500.0 + [east, north]
    longitude, latitude = transformer.transform(ring[:, 0], ring[:, 1], direction="INVERSE")
    corners = [[round(float(x), 7), round(float(y), 7)] for x, y in zip(longitude, latitude, strict=True)]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [corners]}}
    return {"type": "FeatureCollection", "features": [feature]}
