"""What a test may ask for afterwards: where a ground point truly lies on a film, and how the film came about."""

from __future__ import annotations

from typing import Any

import numpy as np

from cosp.arrays import FloatArray
from cosp.geometry.grids import PixelGrid
from cosp.simulation.defects import PARTS, film_sizes, make_film
from cosp.simulation.orbit import SCAN_TIME_S, ecef_from_geodetic
from cosp.simulation.site import ScenePlan, SitePlan

SAMPLES = 41


def ideal_film_coordinates(scene: ScenePlan, lonlath: FloatArray) -> FloatArray:
    """Where the lens drew ground points, mm in the fore sense, (..., 2); NaN off the scan.

    lonlath : (..., 3) longitude, latitude (degrees) and ellipsoidal height (m)
    """
    return scene.exposure.film_from_ground(ecef_from_geodetic(lonlath))


def true_film_coordinates(plan: SitePlan, scene: ScenePlan, lonlath: FloatArray) -> FloatArray:
    """Where ground points lie on the deformed film, mm from the centre of format in the fore sense, (..., 2).

    As `ideal_film_coordinates`, then bending, distortion and shrinkage of the film.
    """
    return make_film(plan.settings, scene).deformation.measured(ideal_film_coordinates(scene, lonlath))


def true_part_pixels(plan: SitePlan, scene: ScenePlan, letter: str, lonlath: FloatArray) -> FloatArray:
    """Row and column (..., 2) of ground points in a digitised part as delivered; may lie outside of it."""
    film = make_film(plan.settings, scene)
    part = film.parts[PARTS.index(letter)]
    return part.pixels(film.delivered(true_film_coordinates(plan, scene, lonlath)))


def scene_truth(plan: SitePlan, scene: ScenePlan) -> dict[str, Any]:
    """States of the camera through the scan and all that happened to the film, ready to be written as JSON."""
    exposure = scene.exposure
    film = make_film(plan.settings, scene)
    time_s = np.linspace(-SCAN_TIME_S / 2.0, SCAN_TIME_S / 2.0, SAMPLES)
    deformation = film.deformation
    return {
        "kind": "simulated_scene",
        "version": 1,
        "scene": scene.scene,
        "look": scene.look,
        "camera": plan.settings.camera,
        "scan_direction": exposure.scan_direction,
        "scan_time_s": SCAN_TIME_S,
        "nodding_rad_s": exposure.nodding_rad_s,
        "lens_rate_mm_s": exposure.lens_rate_mm_s,
        "states": {
            "time_s": time_s,
            "film_x_mm": exposure.scan_direction * time_s / SCAN_TIME_S * 2.0 * film_sizes()["half_length_mm"],
            "position_ecef_m": exposure.position(time_s),
            "rotation_ecef_to_camera": exposure.rotation(time_s),
            "lens_shift_mm": exposure.lens_shift_mm(time_s),
        },
        "film": {
            "turned": film.turned,
            "sizes": film_sizes(),
            "bending": {"x_mm": deformation.x_mm, "dy_mm": deformation.bending_mm.round(6)},
            "deformation": {
                "x_mm": deformation.x_mm,
                "y_mm": deformation.y_mm,
                "dx_mm": deformation.dx_mm.round(6),
                "dy_mm": deformation.dy_mm.round(6),
            },
            "parts": [
                {
                    "letter": part.letter,
                    "shape": part.shape,
                    "pixel_mm": part.pixel_mm,
                    "motion": part.motion,
                    "format_centre_row_column": part.pixels(film.delivered(deformation.measured(np.zeros(2)))),
                    "gain": part.gain,
                    "offset_grey": part.offset_grey,
                    "steps_mm": part.steps_mm,
                }
                for part in film.parts
            ],
        },
    }


def site_truth(plan: SitePlan) -> dict[str, Any]:
    """Settings, grid, scenes and pairs of a site, ready to be written as JSON; the plan follows from the settings."""
    grid: PixelGrid = plan.terrain_grid
    return {
        "kind": "simulated_site",
        "version": 1,
        "settings": plan.settings,
        "crs": plan.crs,
        "terrain_grid": grid,
        "dem_resolution_m": plan.dem_resolution_m,
        "scenes": [
            {"scene": s.scene, "look": s.look, "middle_s": s.exposure.middle_s, "corners_lat_lon_deg": s.corners_deg}
            for s in plan.scenes
        ],
        "pairs": [list(pair) for pair in plan.pairs],
    }
