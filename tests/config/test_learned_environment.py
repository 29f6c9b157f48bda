"""The environment of the learned matcher is that of the workflow and the extra; constraints cover the extra."""

from __future__ import annotations

import tomllib
from pathlib import Path

import yaml
from packaging.requirements import Requirement
from packaging.version import Version

HOME = Path(__file__).resolve().parents[2]
CONDA_NAMES = {"torch": "pytorch"}


def _environment(name: str) -> tuple[set[str], set[str]]:
    """Packages of the channel and of the index, as written."""
    read = yaml.safe_load((HOME / "envs" / name).read_text(encoding="utf-8"))["dependencies"]
    of_index = [entry["pip"] for entry in read if isinstance(entry, dict)]
    return {entry for entry in read if isinstance(entry, str)}, set(sum(of_index, []))


def _extra() -> list[Requirement]:
    project = tomllib.loads((HOME / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [Requirement(text) for text in project["optional-dependencies"]["learned"]]


def test_the_learned_environment_is_the_common_one_and_the_extra() -> None:
    common, _ = _environment("cosp.yaml")
    channel, index = _environment("learned-matching.yaml")
    added = {(r.name, str(r.specifier)) for r in map(Requirement, (channel - common - {"pip"}) | index)}
    assert common <= channel
    assert added == {(CONDA_NAMES.get(r.name, r.name), str(r.specifier)) for r in _extra()}


def test_constraints_hold_what_the_extra_wants() -> None:
    lines = (HOME / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = dict(line.split("==") for line in lines)
    for requirement in _extra():
        assert Version(pinned[requirement.name]) in requirement.specifier
