"""The demo's sheets are what the simulator would write, and the schema knows the simulator's own defaults."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import yaml

from cosp import sheets
from cosp.simulation.__main__ import main as describe
from cosp.simulation.site import SiteSettings

CONFIG = Path(__file__).resolve().parents[2] / "config"


def test_the_sheets_of_the_demo_are_those_of_the_simulator(tmp_path: Path) -> None:
    settings = yaml.safe_load((CONFIG / "config.yaml").read_text(encoding="utf-8"))
    chosen = settings["simulate_site"]["demo"]
    options = [part for key, value in chosen.items() for part in (f"--{key.replace('_', '-')}", str(value))]
    describe(["--directory", str(tmp_path), "--name", "demo", *options])
    for name in ("scenes.tsv", "pairs.tsv"):
        assert (tmp_path / name).read_text(encoding="utf-8") == (CONFIG / name).read_text(encoding="utf-8"), name


def test_the_simulators_config_loads_and_says_the_same_of_the_demo(tmp_path: Path) -> None:
    describe(["--directory", str(tmp_path), "--name", "demo"])
    written = yaml.safe_load((tmp_path / "config.yaml").read_text(encoding="utf-8"))
    ours = yaml.safe_load((CONFIG / "config.yaml").read_text(encoding="utf-8"))
    simulated = sheets.load(written, folder=tmp_path).settings
    default = sheets.load(ours, folder=CONFIG.parent).settings
    assert simulated["sites"] == default["sites"]
    assert simulated["simulate_site"] == default["simulate_site"]


def test_the_schema_has_the_simulators_defaults() -> None:
    described = sheets.schema("config")["properties"]["simulate_site"]["additionalProperties"]["properties"]
    defaults = {field.name: field.default for field in dataclasses.fields(SiteSettings) if field.name != "name"}
    assert {key: entry["default"] for key, entry in described.items()} == defaults
