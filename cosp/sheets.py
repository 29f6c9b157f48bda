"""What people write (config, scene sheet, pair sheet), read and checked before any job starts.

Every fault is found in one go and named with file, row, column, what was found and what was expected.
Defaults live in the schemas under `config/schemas` and nowhere else; `fill_defaults` is what puts them in.
"""

from __future__ import annotations

import argparse
import csv
import difflib
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError

from cosp.camera.missions import camera_for, mission_for
from cosp.errors import InputError

SCHEMAS = Path(__file__).resolve().parents[1] / "config" / "schemas"
CORNERS = ("nw", "ne", "se", "sw")
CORNER_COLUMNS = tuple(f"{corner}_{axis}" for corner in CORNERS for axis in ("lat", "lon"))

# Two frames that see the same ground share nearly all of it; successive frames share 6-8 %.
LEAST_SHARED_FRACTION = 0.3
# The aft camera sees the ground of fore frame N about six frames later (092-098, 076-082, 017-023).
USUAL_FRAME_STEP = 6

_SCENE_ID = re.compile(
    r"DS0?(?P<mission>[0-9]{4})(?P<segment>[A-Z]?)-(?P<orbit>[0-9]{3,5})(?P<heading>[AD])(?P<look>[AF])(?P<frame>[0-9]{3})"
)


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong in what a person wrote."""

    file: str
    found: str
    expected: str
    row: int | None = None
    column: str | None = None

    def __str__(self) -> str:
        """One line: where, what was found, what was expected."""
        place = self.file
        if self.row is not None:
            place += f", row {self.row}"
        if self.column is not None:
            place += f", {'column' if self.row is not None else 'key'} {self.column}"
        return f"{place}: found {self.found}; expected {self.expected}"


class FaultySheets(InputError):
    """The sheets or the config cannot be used; `faults` says why, all at once."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        """Keep the faults and make the message from them."""
        self.faults = tuple(faults)
        count = f"{len(faults)} fault{'s' if len(faults) > 1 else ''} in config and sheets"
        super().__init__("\n".join([f"{count}:", *(f"  {fault}" for fault in faults)]))


@dataclass(frozen=True)
class SceneId:
    """The parts of an archive id such as `DS1104-2169DF092`."""

    mission: int
    orbit: str
    descending: bool
    look: str
    frame: str

    @property
    def flight(self) -> str:
        """Mission and pass, as in `1104-2169`."""
        return f"{self.mission}-{self.orbit}"


@dataclass(frozen=True)
class Scene:
    """One row of the scene sheet with every default filled in."""

    scene: str
    site: str
    parts: str
    corners_deg: dict[str, float]
    date: str | None
    pixel_um: float
    camera: str
    look: str
    block: str
    row: int = field(default=0, compare=False)

    @property
    def id(self) -> SceneId:
        """The parts of the archive id."""
        return parse_scene_id(self.scene)

    @property
    def has_stripes(self) -> bool:
        """Whether the camera exposed panoramic geometry stripes."""
        return mission_for(self.camera).has_stripes


@dataclass(frozen=True)
class Pair:
    """A fore and an aft scene of the same ground."""

    pair: str
    fore: str
    aft: str
    row: int = field(default=0, compare=False)


@dataclass(frozen=True)
class Project:
    """Config and sheets, checked and complete."""

    settings: dict[str, Any]
    scenes: dict[str, Scene]
    pairs: dict[str, Pair]

    def site_of(self, pair: str) -> str:
        """Site of a pair."""
        return self.scenes[self.pairs[pair].fore].site

    def block_of(self, pair: str) -> str:
        """Block that a pair is adjusted in."""
        return self.scenes[self.pairs[pair].fore].block

    def pairs_of_site(self, site: str) -> list[str]:
        """Pairs of a site, in the order of the sheet."""
        return [pair for pair in self.pairs if self.site_of(pair) == site]

    def pairs_of_block(self, block: str) -> list[str]:
        """Pairs of a block, in the order of the sheet."""
        return [pair for pair in self.pairs if self.block_of(pair) == block]

    def scenes_of_block(self, block: str) -> list[str]:
        """Scenes of a block that belong to a pair, in the order of the sheet."""
        paired = {scene for pair in self.pairs.values() for scene in (pair.fore, pair.aft)}
        return [name for name, scene in self.scenes.items() if scene.block == block and name in paired]

    def neighbours_of_block(self, block: str) -> list[tuple[str, str]]:
        """Frames of a block that follow each other on the film of one camera, two by two."""
        scenes = [self.scenes[name] for name in self.scenes_of_block(block)]
        frames = sorted((scene.id.flight, scene.look, int(scene.id.frame), scene.scene) for scene in scenes)
        return [
            (first, second)
            for (*camera, number, first), (*same, following, second) in pairwise(frames)
            if same == camera and following == number + 1
        ]

    def scenes_of_site(self, site: str) -> list[str]:
        """Scenes of a site that belong to a pair, in the order of the sheet."""
        paired = {scene for pair in self.pairs.values() for scene in (pair.fore, pair.aft)}
        return [name for name, scene in self.scenes.items() if scene.site == site and name in paired]

    def blocks_of_site(self, site: str) -> list[str]:
        """Blocks of a site, in the order of the sheet."""
        return list(dict.fromkeys(self.scenes[name].block for name in self.scenes_of_site(site)))

    @property
    def sites(self) -> list[str]:
        """Sites that have a pair, in the order of the config."""
        used = {self.site_of(pair) for pair in self.pairs}
        return [site for site in self.settings["sites"] if site in used]


def parse_scene_id(scene: str) -> SceneId:
    """Parts of an archive id.

    Raises ValueError when the text is not an id of a KH-4, KH-4A or KH-4B exposure.
    """
    found = _SCENE_ID.fullmatch(scene)
    if found is None:
        raise ValueError(f"{scene!r} is not an archive id such as DS1104-2169DF092")
    return SceneId(
        mission=int(found["mission"]),
        orbit=found["orbit"],
        descending=found["heading"] == "D",
        look={"F": "fore", "A": "aft"}[found["look"]],
        frame=found["frame"],
    )


# Schemas ------------------------------------------------------------------------------------------------------------


@cache
def schema(name: str) -> dict[str, Any]:
    """A schema by name: "config", "scenes" or "pairs"."""
    loaded: dict[str, Any] = yaml.safe_load((SCHEMAS / f"{name}.schema.yaml").read_text(encoding="utf-8"))
    return loaded


def fill_defaults(part: Mapping[str, Any], value: Mapping[str, Any] | None) -> dict[str, Any]:
    """The value with every default of its schema put in where nothing was said.

    part : the schema of this value; objects inside are filled likewise.
    """
    properties: Mapping[str, Any] = part.get("properties", {})
    filled = dict(value or {})
    for key, described in properties.items():
        is_section = "properties" in described or isinstance(described.get("additionalProperties"), dict)
        if is_section:
            filled[key] = fill_defaults(described, filled.get(key))
        elif "default" in described:
            filled.setdefault(key, described["default"])
    others = part.get("additionalProperties")
    if isinstance(others, dict):
        for key in filled.keys() - properties.keys():
            filled[key] = fill_defaults(others, filled[key])
    return filled


def described_keys(part: Mapping[str, Any] | None = None, prefix: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Every key of the config with its description, in the order of the schema; names are dotted."""
    part = schema("config") if part is None else part
    for key, described in part.get("properties", {}).items():
        yield f"{prefix}{key}", described
        yield from described_keys(described, f"{prefix}{key}.")
    others = part.get("additionalProperties")
    if isinstance(others, dict):
        yield from described_keys(others, f"{prefix}<{part.get('keys', 'name')}>.")


def _short(value: Any) -> str:
    """A value as it goes into a message."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _expectation(error: ValidationError) -> str:
    """What the schema wanted, in words."""
    wanted: Any = error.validator_value
    note = error.schema.get("description") if isinstance(error.schema, dict) else None
    words: dict[str, Callable[[], str]] = {
        "enum": lambda: "one of " + ", ".join(map(str, wanted)),
        "const": lambda: repr(wanted),
        "type": lambda: " or ".join(wanted) if isinstance(wanted, list) else str(wanted),
        "minimum": lambda: f"at least {wanted}",
        "maximum": lambda: f"at most {wanted}",
        "exclusiveMinimum": lambda: f"more than {wanted}",
        "exclusiveMaximum": lambda: f"less than {wanted}",
        "minItems": lambda: f"at least {wanted} entries",
        "maxItems": lambda: f"at most {wanted} entries",
        "minLength": lambda: "some text",
        "pattern": lambda: f"the form {wanted}",
    }
    text = words[str(error.validator)]() if error.validator in words else str(error.message)
    return f"{text} ({note})" if note else text


def _nearest(key: str, known: Iterable[str]) -> str:
    """A known key that resembles an unknown one, as the end of a sentence."""
    close = difflib.get_close_matches(key, list(known), n=1, cutoff=0.0)
    return f"a known key, nearest is {close[0]!r}" if close else "no key here"


def check_settings(settings: Mapping[str, Any], file: str) -> list[Fault]:
    """Faults of a config against its schema."""
    faults = []
    for error in Draft202012Validator(schema("config")).iter_errors(settings):
        path = [str(step) for step in error.absolute_path]
        if error.validator == "additionalProperties":
            known = error.schema.get("properties", {})
            for key in sorted(set(error.instance) - set(known)):
                faults.append(Fault(file, f"unknown key {key!r}", _nearest(key, known), column=".".join([*path, key])))
        elif error.validator == "required":
            missing = [key for key in error.validator_value if key not in error.instance]
            for key in missing:
                wanted = error.schema["properties"][key].get("description", "a value")
                fault = Fault(file, "nothing", wanted, column=".".join([*path, key]))
                if fault not in faults:
                    faults.append(fault)
        elif error.validator == "propertyNames":
            faults.append(Fault(file, _short(error.instance), _expectation(error), column=".".join(path) or None))
        else:
            faults.append(Fault(file, _short(error.instance), _expectation(error), column=".".join(path) or None))
    return faults


# Sheets -------------------------------------------------------------------------------------------------------------


def _read_rows(path: Path, file: str, name: str) -> tuple[list[tuple[int, dict[str, str]]], list[Fault]]:
    """Rows of a sheet with their line numbers, empty cells left out, and what is wrong with its layout."""
    described = schema(name)
    known = list(described["properties"])
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        return [], [Fault(file, "no such file", f"the {name} sheet, tab separated (config key {name!r})")]
    except UnicodeDecodeError:
        return [], [Fault(file, "bytes that are not UTF-8", "a tab-separated sheet in UTF-8")]
    lines = [line.split("\t") for line in text.splitlines()]
    if not lines or not any(cell.strip() for cell in lines[0]):
        return [], [Fault(file, "an empty file", f"a header line with the columns {' '.join(described['required'])}")]

    header = [cell.strip() for cell in lines[0]]
    faults = []
    for column in header:
        if column not in known:
            hint = "tabs between columns" if len(header) == 1 else _nearest(column, known).replace("key", "column")
            faults.append(Fault(file, f"unknown column {_short(column)}", hint, row=1, column=column))
    for column in sorted({column for column in header if header.count(column) > 1}):
        faults.append(Fault(file, "the column more than once", "each column once", row=1, column=column))
    for column in described["required"]:
        if column not in header:
            faults.append(Fault(file, "no such column", described["properties"][column]["description"], 1, column))
    if faults:
        return [], faults

    rows = []
    for number, cells in enumerate(lines[1:], start=2):
        cells = [cell.strip() for cell in cells]
        if not any(cells) or cells[0].startswith("#"):
            continue
        if len(cells) > len(header):
            faults.append(Fault(file, f"{len(cells)} cells", f"{len(header)} cells as in the header", row=number))
            continue
        rows.append((number, {column: cell for column, cell in zip(header, cells, strict=False) if cell}))
    if not rows and not faults:
        faults.append(Fault(file, "no row below the header", f"one row per {name.rstrip('s')}"))
    return rows, faults


def _typed(row: Mapping[str, str], name: str) -> dict[str, Any]:
    """The row with numbers where its schema wants numbers and the text is one."""
    typed: dict[str, Any] = dict(row)
    for column, described in schema(name)["properties"].items():
        if column in typed and described.get("type") == "number":
            try:
                typed[column] = float(typed[column])
            except ValueError:
                continue
    return typed


def _check_row(row: Mapping[str, Any], number: int, file: str, name: str) -> list[Fault]:
    """Faults of one row against its schema."""
    faults = []
    for error in Draft202012Validator(schema(name)).iter_errors(row):
        if error.validator == "required":
            for column in [column for column in error.validator_value if column not in error.instance]:
                fault = Fault(file, "an empty cell", error.schema["properties"][column]["description"], number, column)
                if fault not in faults:
                    faults.append(fault)
        else:
            column = str(error.absolute_path[0]) if error.absolute_path else None
            faults.append(Fault(file, _short(error.instance), _expectation(error), number, column))
    return faults


def read_scenes(path: Path, file: str | None = None) -> tuple[list[Scene], list[Fault]]:
    """Scenes of a sheet with defaults filled in from the id, and what is wrong with the others."""
    file = str(path) if file is None else file
    rows, faults = _read_rows(path, file, "scenes")
    scenes = []
    for number, text in rows:
        row = _typed(text, "scenes")
        found = _check_row(row, number, file, "scenes")
        if not found:
            identity = parse_scene_id(row["scene"])
            try:
                camera = row.get("camera") or camera_for(identity.mission)
            except InputError:
                wanted = "a mission 9031-9062 (KH-4), 1001-1052 (KH-4A) or 1101-1117 (KH-4B), or a camera column"
                found = [Fault(file, f"{row['scene']}, mission {identity.mission}", wanted, number, "scene")]
            else:
                filled = fill_defaults(schema("scenes"), row)
                scenes.append(
                    Scene(
                        scene=row["scene"],
                        site=row["site"],
                        parts=row["parts"],
                        corners_deg={column: float(row[column]) for column in CORNER_COLUMNS},
                        date=row.get("date"),
                        pixel_um=float(filled["pixel_um"]),
                        camera=camera,
                        look=row.get("look") or identity.look,
                        block=row.get("block") or f"{identity.flight}_{row['site']}",
                        row=number,
                    )
                )
        faults += found
    return scenes, faults


def read_pairs(path: Path, file: str | None = None) -> tuple[list[Pair], list[Fault]]:
    """Pairs of a sheet, and what is wrong with the others."""
    file = str(path) if file is None else file
    rows, faults = _read_rows(path, file, "pairs")
    pairs = []
    for number, row in rows:
        found = _check_row(row, number, file, "pairs")
        if not found:
            pairs.append(Pair(pair=row["pair"], fore=row["fore"], aft=row["aft"], row=number))
        faults += found
    return pairs, faults


def pair_name(fore: str, aft: str) -> str:
    """Name of a pair that was found, such as `1104-2169_092-098`."""
    return f"{parse_scene_id(fore).flight}_{parse_scene_id(fore).frame}-{parse_scene_id(aft).frame}"


def find_pairs(scenes: Iterable[Scene]) -> list[Pair]:
    """Each fore frame with the aft frame of the same pass and site that shares most of its footprint.

    Where several share nearly the same, the one six frames later is taken: corner coordinates of one pass are wrong
    together, but each a little in its own way. A fore frame without a partner is left out.
    """
    from shapely.geometry import Polygon

    scenes = list(scenes)

    def footprint(scene: Scene) -> Polygon:
        """The corners as a polygon, unwrapped across the date line."""
        corners = scene.corners_deg
        first = corners["nw_lon"]
        points = [
            (first + (corners[f"{name}_lon"] - first + 180.0) % 360.0 - 180.0, corners[f"{name}_lat"])
            for name in CORNERS
        ]
        return Polygon(points).convex_hull

    pairs = []
    for fore in (scene for scene in scenes if scene.look == "fore"):
        partners = []
        for aft in scenes:
            if aft.look != "aft" or (aft.id.flight, aft.block) != (fore.id.flight, fore.block):
                continue
            ground = footprint(fore)
            shared = ground.intersection(footprint(aft)).area / ground.area if ground.area > 0.0 else 0.0
            if shared >= LEAST_SHARED_FRACTION:
                partners.append((shared, aft))
        if not partners:
            continue
        best = max(shared for shared, _ in partners)
        near_best = [aft for shared, aft in partners if shared > best - 0.1]
        aft = min(near_best, key=lambda aft: abs(int(aft.id.frame) - int(fore.id.frame) - USUAL_FRAME_STEP))
        pairs.append(Pair(pair=pair_name(fore.scene, aft.scene), fore=fore.scene, aft=aft.scene, row=fore.row))
    return pairs


# Cross-checks -------------------------------------------------------------------------------------------------------


def _repeated(names: Iterable[tuple[str, int]]) -> Iterator[tuple[str, int, int]]:
    """Names that came before, with both rows."""
    first: dict[str, int] = {}
    for name, row in names:
        if name in first:
            yield name, row, first[name]
        first.setdefault(name, row)


def check_scenes(scenes: Sequence[Scene], sites: Iterable[str], file: str) -> list[Fault]:
    """Faults of the scenes among themselves and against the sites of the config."""
    sites = list(sites)
    faults = [
        Fault(file, f"{name!r} again, first in row {before}", "each scene once", row, "scene")
        for name, row, before in _repeated((scene.scene, scene.row) for scene in scenes)
    ]
    site_of_block: dict[str, str] = {}
    for scene in scenes:
        if scene.site not in sites:
            known = ", ".join(sites) or "none"
            faults.append(Fault(file, repr(scene.site), f"a key under sites of the config: {known}", scene.row, "site"))
        site = site_of_block.setdefault(scene.block, scene.site)
        if site != scene.site:
            wanted = f"scenes of one site in block {scene.block!r}; it began with {site!r}"
            faults.append(Fault(file, repr(scene.site), wanted, scene.row, "block"))
        latitudes = [scene.corners_deg[f"{corner}_lat"] for corner in CORNERS]
        if not 0.0 < max(latitudes) - min(latitudes) < 6.0:
            wanted = "corners of one exposure, which spans 0.1 to 3 degrees of latitude"
            found = f"latitudes from {min(latitudes):g} to {max(latitudes):g}"
            faults.append(Fault(file, found, wanted, scene.row, "nw_lat"))
    return faults


def check_pairs(pairs: Sequence[Pair], scenes: Mapping[str, Scene], file: str) -> list[Fault]:
    """Faults of the pairs among themselves and against the scene sheet."""
    faults = [
        Fault(file, f"{name!r} again, first in row {before}", "each pair name once", row, "pair")
        for name, row, before in _repeated((pair.pair, pair.row) for pair in pairs)
    ]
    for pair in pairs:
        members = {"fore": pair.fore, "aft": pair.aft}
        for look, name in members.items():
            if name not in scenes:
                close = difflib.get_close_matches(name, scenes, n=1)
                hint = f"; nearest is {close[0]}" if close else ""
                faults.append(Fault(file, repr(name), f"a scene of the scene sheet{hint}", pair.row, look))
            elif scenes[name].look != look:
                found = f"{name}, whose look is {scenes[name].look}"
                faults.append(Fault(file, found, f"a {look} scene", pair.row, look))
        if all(name in scenes for name in members.values()):
            fore, aft = scenes[pair.fore], scenes[pair.aft]
            for what in ("site", "block"):
                ours, theirs = getattr(fore, what), getattr(aft, what)
                if ours != theirs:
                    found = f"{what}s {ours!r} and {theirs!r}"
                    faults.append(Fault(file, found, f"two scenes of one {what}", pair.row, "aft"))
    return faults


def check_sites(settings: Mapping[str, Any], file: str, folder: Path) -> list[Fault]:
    """Faults of the sites: files that are not there, coordinate systems that cannot carry a DEM."""
    faults = []
    for site, options in settings["sites"].items():
        for key in ("reference_dem", "reference_image", "unstable_terrain", "gcps", "area_of_interest", "check_dem"):
            path = options.get(key)
            if path is None or is_simulated(settings, site, path) or (folder / path).is_file():
                continue
            wanted = schema("config")["properties"]["sites"]["additionalProperties"]["properties"][key]["description"]
            found = f"{path!r}, which is not there (looked in {folder.resolve()})"
            faults.append(Fault(file, found, wanted, column=f"sites.{site}.{key}"))
        crs = options.get("crs", "auto")
        if crs != "auto":
            from pyproj import CRS
            from pyproj.exceptions import CRSError

            try:
                known = CRS.from_user_input(crs)
                usable = known.is_projected and known.axis_info[0].unit_name == "metre"
            except CRSError:
                usable = False
            if not usable:
                wanted = "auto, or a projected coordinate system in metres such as EPSG:32647"
                faults.append(Fault(file, repr(crs), wanted, column=f"sites.{site}.crs"))
    return faults


def check_own_gcps(settings: Mapping[str, Any], scenes: Sequence[Scene], file: str, folder: Path) -> list[Fault]:
    """Faults of the ground control points that people measured: what cannot be read, and what is of no scene."""
    from cosp.io import gcps

    faults = []
    for site, options in settings["sites"].items():
        if options["gcps"] is None or not (folder / options["gcps"]).is_file():
            continue
        key, ours = f"sites.{site}.gcps", {scene.scene for scene in scenes if scene.site == site}
        try:
            named = set(gcps.read(folder / options["gcps"])["scene"])
        except InputError as error:
            faults.append(Fault(file, str(error), "a table of ground control points (config/README.md)", column=key))
            continue
        if not named & ours:
            found = f"points of {', '.join(sorted(named)[:3])}"
            faults.append(Fault(file, found, f"points of scenes of this site: {', '.join(sorted(ours))}", column=key))
    return faults


def is_simulated(settings: Mapping[str, Any], site: str, path: str | None = None) -> bool:
    """Whether the site, or a file of it, is made by the simulator."""
    inside = path is None or Path(path).as_posix().startswith(f"resources/simulated/{site}/")
    return inside and site in settings.get("simulate_site", {})


def load(settings: Mapping[str, Any], *, file: str = "config", folder: Path | None = None) -> Project:
    """Config and sheets, checked and complete.

    settings : the config as it was read. file : its name for messages. folder : what relative paths in it are relative
    to, the working folder by default.

    Raises FaultySheets with every fault there is.
    """
    folder = Path() if folder is None else folder
    faults = check_settings(settings, file)
    usable = dict(settings) if not faults else {}
    complete = fill_defaults(schema("config"), usable) if usable else {}

    # A broken config must not hide what is wrong in the sheets.
    scenes_file = settings.get("scenes") if isinstance(settings.get("scenes"), str) else None
    pairs_file = settings.get("pairs") if isinstance(settings.get("pairs"), str) else None
    sites = settings.get("sites") if isinstance(settings.get("sites"), Mapping) else {}
    scenes_file = scenes_file or schema("config")["properties"]["scenes"]["default"]

    if complete:
        faults += check_sites(complete, file, folder)
    rows, found = read_scenes(folder / scenes_file, scenes_file)
    sheet_is_whole = not found
    faults += found + check_scenes(rows, sites or {}, scenes_file)
    if complete and sheet_is_whole:
        faults += check_own_gcps(complete, rows, file, folder)
    scenes = {scene.scene: scene for scene in reversed(rows)}
    scenes = {scene.scene: scenes[scene.scene] for scene in rows}

    if pairs_file is None:
        pairs = find_pairs(scenes.values()) if not faults else []
        if not pairs and not faults:
            wanted = "at least one fore and one aft scene of one pass that see the same ground, or a pair sheet"
            faults.append(Fault(scenes_file, "no pair", wanted))
    else:
        pairs, found = read_pairs(folder / pairs_file, pairs_file)
        faults += found
        if sheet_is_whole:
            faults += check_pairs(pairs, scenes, pairs_file)
    if faults:
        raise FaultySheets(faults)
    return Project(settings=complete, scenes=scenes, pairs={pair.pair: pair for pair in pairs})


# Archive ------------------------------------------------------------------------------------------------------------


def scenes_from_archive(text: str, *, site: str, parts: str, pixel_um: float | None = None) -> str:
    """A scene sheet from the CSV export of the archive's search page.

    text : the export, decoded. parts : folder of the digitised parts, the same for all scenes.

    Raises InputError when a column is missing or an id is not that of a KH-4, KH-4A or KH-4B exposure.
    """
    reader = csv.DictReader(text.splitlines())
    headings = {re.sub(r"\s+", " ", heading.strip().lower()): heading for heading in reader.fieldnames or ()}

    def heading(*patterns: str) -> str:
        """The heading that fits the first pattern which fits any."""
        for pattern in patterns:
            for plain, original in headings.items():
                if re.fullmatch(pattern, plain):
                    return original
        raise InputError(f"the archive's export has no column like {patterns[0]!r}; it has {', '.join(headings)}")

    # The archive spells one heading "NW Cormer Lat dec".
    columns = {
        f"{corner}_{axis}": heading(rf"{corner} cor[nm]er {axis}[a-z]* dec")
        for corner in CORNERS
        for axis in ("lat", "lon")
    }
    identity, date = heading("entity id", "display id"), heading("acquisition date", "date")
    header = ["scene", "site", "parts", *CORNER_COLUMNS, "date"] + (["pixel_um"] if pixel_um is not None else [])
    lines, strange = ["\t".join(header)], []
    for row in reader:
        scene = row[identity].strip()
        if _SCENE_ID.fullmatch(scene) is None:
            strange.append(scene)
            continue
        cells = [scene, site, parts, *(row[columns[column]].strip() for column in CORNER_COLUMNS)]
        cells.append(row[date].strip().replace("/", "-"))
        lines.append("\t".join(cells + ([f"{pixel_um:g}"] if pixel_um is not None else [])))
    if strange:
        raise InputError(f"not ids of KH-4, KH-4A or KH-4B exposures: {', '.join(strange)}")
    return "\n".join(lines) + "\n"


def key_table() -> str:
    """Every key of the config with unit, default and description, as a Markdown table."""
    lines = ["| key | default | unit | meaning |", "|---|---|---|---|"]
    for name, described in described_keys():
        if "properties" in described or isinstance(described.get("additionalProperties"), dict):
            lines.append(f"| **`{name}`** | | | {described['description']} |")
        else:
            text = yaml.safe_dump(described.get("default"), default_flow_style=True, width=1000).splitlines()[0]
            shown = f"`{text}`" if "default" in described else "required"
            lines.append(f"| `{name}` | {shown} | {described.get('unit', '')} | {described['description']} |")
    return "\n".join(lines) + "\n"


def column_table(name: str) -> str:
    """Every column of a sheet with its description, as a Markdown table."""
    described = schema(name)
    lines = ["| column | needed | meaning |", "|---|---|---|"]
    for column, entry in described["properties"].items():
        lines.append(f"| `{column}` | {'yes' if column in described['required'] else ''} | {entry['description']} |")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: `from-archive`, `check`, `tables`."""
    parser = argparse.ArgumentParser(prog="python -m cosp.sheets", description="Scene sheets and config.")
    commands = parser.add_subparsers(dest="command", required=True)
    archive = commands.add_parser("from-archive", help="scene sheet from the archive's CSV export, to standard output")
    archive.add_argument("export", type=Path, help="CSV export of the archive's search page (latin-1)")
    archive.add_argument("--site", required=True, help="key under sites of the config")
    archive.add_argument("--parts", required=True, help="folder of the digitised parts")
    archive.add_argument("--pixel-um", type=float, help="size of a digitised pixel, when it is not 7")
    check = commands.add_parser("check", help="say what is wrong with a config and its sheets")
    check.add_argument("config", type=Path)
    commands.add_parser("tables", help="keys and columns as Markdown, as in config/README.md")
    options = parser.parse_args(arguments)
    try:
        if options.command == "from-archive":
            text = options.export.read_text(encoding="latin-1")
            sheet = scenes_from_archive(text, site=options.site, parts=options.parts, pixel_um=options.pixel_um)
            sys.stdout.write(sheet)
        elif options.command == "tables":
            sys.stdout.write(f"{column_table('scenes')}\n{column_table('pairs')}\n{key_table()}")
        else:
            settings = yaml.safe_load(options.config.read_text(encoding="utf-8")) or {}
            project = load(settings, file=str(options.config))
            print(f"{len(project.scenes)} scenes, {len(project.pairs)} pairs: {', '.join(project.pairs)}")
    except (InputError, OSError) as problem:
        print(problem, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
