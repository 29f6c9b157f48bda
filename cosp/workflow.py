"""What the rules need to know: which library files a script rests on, how big a job is, where parts lie.

No workflow engine is imported here, so that all of it can be tested by itself.
"""

from __future__ import annotations

import ast
import hashlib
import math
import os
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from cosp.camera.missions import FILM_WIDTH_MM, mission_for
from cosp.sheets import CORNERS, Project, Scene

LIBRARY = Path(__file__).resolve().parent
SCRIPTS = LIBRARY.parent / "scripts"
PART_LETTERS = ("a", "b", "c", "d")

# Strips of a scattered rule are at most this large, so that a kill loses minutes.
LARGEST_STRIP_MPX = 100.0
# Of control, which looks at few of the pixels: less would be spent on starting jobs.
LARGEST_CONTROL_STRIP_MPX = 400.0


# Digest -------------------------------------------------------------------------------------------------------------


def _module_file(name: str, library: Path) -> Path | None:
    """File of a module of the library; None where there is no such module."""
    path = library.parent.joinpath(*name.split("."))
    candidates = (path / "__init__.py", path.with_suffix(".py"))
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _imported_names(source: str, package: str) -> set[str]:
    """Dotted names that a source imports from the library, those inside functions too."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return {name for name in names if name == package or name.startswith(f"{package}.")}


@cache
def _direct_files(path: Path, library: Path) -> frozenset[Path]:
    """Library files that one source imports, with the packages they lie in."""
    files = set()
    for name in _imported_names(path.read_text(encoding="utf-8"), library.name):
        steps = name.split(".")
        for length in range(1, len(steps) + 1):
            file = _module_file(".".join(steps[:length]), library)
            if file is not None:
                files.add(file)
    return frozenset(files)


def library_files(script: Path, library: Path = LIBRARY) -> list[Path]:
    """Every library file that a script rests on, directly or through others, sorted."""
    found: set[Path] = set()
    waiting = [script]
    while waiting:
        for file in _direct_files(waiting.pop(), library) - found:
            found.add(file)
            waiting.append(file)
    return sorted(found)


def library_digest(script: Path, library: Path = LIBRARY) -> str:
    """Short hash of the library sources a script rests on.

    Given to a rule as a parameter, it makes an edit in the library rerun those rules, and only those, that use what was
    edited. It depends on content alone, not on times.
    """
    content = hashlib.sha256()
    for file in library_files(script, library):
        content.update(file.relative_to(library).as_posix().encode())
        content.update(hashlib.sha256(file.read_bytes()).digest())
    return content.hexdigest()[:16]


def script_digest(rule: str) -> str:
    """Digest of the library files that the script of a rule rests on."""
    return library_digest(SCRIPTS / f"{rule}.py")


# Sizes --------------------------------------------------------------------------------------------------------------


def film_mpx(scene: Scene) -> float:
    """Millions of pixels of the whole film of a scene, its full width and scan."""
    length_mm = mission_for(scene.camera).scan_length_mm
    return length_mm * FILM_WIDTH_MM / (scene.pixel_um * 1e-3) ** 2 / 1e6


def memory_mb(mpx: float, *, bytes_per_px: float, base_mb: float = 600.0) -> int:
    """Memory to ask for: what the interpreter and its libraries take, and so many bytes a pixel."""
    return math.ceil(base_mb + mpx * bytes_per_px)


def machine_memory_mb() -> int:
    """Memory of this machine that jobs may ask for together: nine tenths of it."""
    return int(0.9 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e6)


def runtime_min(mpx: float, *, us_per_px: float, threads: int = 1) -> int:
    """Minutes to ask for on a cluster: four times what a quiet machine takes, and never under ten."""
    return max(10, math.ceil(4.0 * mpx * us_per_px / 60.0 / max(threads, 1)))


def strip_count(project: Project, largest_mpx: float = LARGEST_STRIP_MPX) -> int:
    """Pieces that a scattered rule cuts a film into: as the config says, or none larger than so much of the film."""
    wanted = project.settings["strips"]
    if wanted != "auto":
        return int(wanted)
    return max((math.ceil(film_mpx(scene) / largest_mpx) for scene in project.scenes.values()), default=1)


# Files --------------------------------------------------------------------------------------------------------------


def part_paths(scene: Scene, *, simulated: bool, folder: Path | None = None) -> list[str]:
    """Paths of the digitised parts of a scene: those that are there, or those that the simulator will write.

    A part that is missing is left out, so that its own job can say so while other scenes go on.
    """
    folder = Path() if folder is None else folder
    four = [f"{scene.parts}/{scene.scene}_{letter}.tif" for letter in PART_LETTERS]
    if simulated:
        return four
    there = [path for path in four if (folder / path).is_file()]
    whole = f"{scene.parts}/{scene.scene}.tif"
    return there if there or not (folder / whole).is_file() else [whole]


def missing_parts(scene: Scene, *, simulated: bool, folder: Path | None = None) -> list[str]:
    """Paths of the digitised parts of a scene that should be there and are not."""
    found = part_paths(scene, simulated=simulated, folder=folder)
    if len(found) == 1 and found[0].endswith(f"{scene.scene}.tif"):
        return []
    return [path for path in part_paths(scene, simulated=True) if path not in found]


def site_crs(project: Project, site: str) -> str:
    """Coordinate system of a site's products: as the config says, or the UTM zone of the middle of its scenes."""
    crs: str = project.settings["sites"][site]["crs"]
    if crs != "auto":
        return crs
    return utm_zone(scene.corners_deg for scene in project.scenes.values() if scene.site == site)


def utm_zone(corners_deg: Iterable[Mapping[str, float]]) -> str:
    """UTM zone of the middle of some footprints, such as `EPSG:32647`."""
    corners = [(scene[f"{name}_lon"], scene[f"{name}_lat"]) for scene in corners_deg for name in CORNERS]
    first = corners[0][0]
    longitudes = [first + (longitude - first + 180.0) % 360.0 - 180.0 for longitude, _ in corners]
    longitude = sum(longitudes) / len(corners)
    latitude = sum(latitude for _, latitude in corners) / len(corners)
    zone = int((longitude + 180.0) % 360.0 // 6.0) + 1
    return f"EPSG:{(32600 if latitude >= 0.0 else 32700) + zone}"


def corners_lonlat(scene: Scene) -> dict[str, list[float]]:
    """Corners of a scene by name, each as longitude and latitude in degrees."""
    return {name: [scene.corners_deg[f"{name}_lon"], scene.corners_deg[f"{name}_lat"]] for name in CORNERS}


def site_file(project: Project, site: str, key: str) -> str | list[str]:
    """Path of a file of a site; an empty list, which is no input, where the config names none."""
    path: str | None = project.settings["sites"][site][key]
    return [] if path is None else path


def wants_dem_control(project: Project, site: str) -> bool:
    """Whether a site takes control from a draft of its own elevation model laid against the reference."""
    options = project.settings["sites"][site]
    wanted: str = options["dem_control"]
    return wanted == "always" or (wanted == "without_reference_image" and options["reference_image"] is None)


# What a rule's wildcards stand for ----------------------------------------------------------------------------------


def config_name(paths: Iterable[str | Path]) -> str:
    """Name of the config for messages: the file that was read last."""
    names = [str(path) for path in paths]
    return names[-1] if names else "config"


def any_of(names: Iterable[str]) -> str:
    """Regular expression that fits just these names; nothing where there are none."""
    return "|".join(sorted(map(re.escape, names))) or "(?!)"


def scenes_of(project: Project, wildcards: Mapping[str, str] | Any) -> list[Scene]:
    """Scenes that a job with these wildcards touches."""
    named = dict(wildcards.items())
    if "scene" in named:
        return [project.scenes[named["scene"]]]
    if "pair" in named:
        pair = project.pairs[named["pair"]]
        return [project.scenes[pair.fore], project.scenes[pair.aft]]
    if "block" in named:
        return [project.scenes[name] for name in project.scenes_of_block(named["block"])]
    return [scene for scene in project.scenes.values() if scene.site == named.get("site", scene.site)]


def site_of(project: Project, wildcards: Mapping[str, str] | Any) -> str:
    """Site of a job's scene, pair, block or site wildcard."""
    named = dict(wildcards.items())
    return named["site"] if "site" in named else scenes_of(project, wildcards)[0].site


def is_alone(project: Project, wildcards: Mapping[str, str] | Any) -> bool:
    """Whether the pair of a job's scene has no other pair in its block, whose frames could carry it."""
    return len(project.pairs_of_block(scenes_of(project, wildcards)[0].block)) < 2


def largest_film_mpx(project: Project, wildcards: Mapping[str, str] | Any) -> float:
    """Size of the largest film that a job touches, millions of pixels."""
    return max(film_mpx(scene) for scene in scenes_of(project, wildcards))


def settings_for_page(project: Project, site: str) -> dict[str, Any]:
    """Sections of the config that shaped a site's products, for its quality page."""
    general = ("scenes", "pairs", "sites", "simulate_site", "export_cameras")
    sections = {key: value for key, value in project.settings.items() if key not in general}
    return {"site": project.settings["sites"][site], **sections}


def blocks_to_export(project: Project) -> list[str]:
    """Blocks whose cameras the config wants in the forms of other programs."""
    wanted = bool(project.settings["export_cameras"]["formats"])
    return sorted({project.block_of(pair) for pair in project.pairs}) if wanted else []
