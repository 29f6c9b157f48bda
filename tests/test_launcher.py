"""The launcher says what is missing, knows when it has nothing to do, and leaves nothing foreign in the environment."""

from __future__ import annotations

import ast
import importlib.machinery
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

HOME = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def launcher() -> ModuleType:
    loader = importlib.machinery.SourceFileLoader("launcher", str(HOME / "run"))
    spec = importlib.util.spec_from_loader("launcher", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.dont_write_bytecode, before = True, sys.dont_write_bytecode
    try:
        loader.exec_module(module)
    finally:
        sys.dont_write_bytecode = before
    return module


def test_the_launcher_needs_nothing_but_the_standard_library() -> None:
    tree = ast.parse((HOME / "run").read_text(encoding="utf-8"))
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    assert {name.split(".")[0] for name in names} <= sys.stdlib_module_names


def test_the_launcher_is_executable() -> None:
    assert os.access(HOME / "run", os.X_OK)
    assert os.access(HOME / ".ci" / "run", os.X_OK)


@pytest.mark.parametrize(
    ("has_ensurepip", "tools", "packages"),
    [
        (True, ["gdalinfo", "gdaldem", "gdalbuildvrt"], []),
        (False, ["gdalinfo", "gdaldem", "gdalbuildvrt"], ["python3.11-venv"]),
        (True, ["gdalinfo", "gdaldem"], ["gdal-bin"]),
        (False, [], ["python3.11-venv", "gdal-bin"]),
    ],
)
def test_what_is_missing_is_named_in_one_line(
    launcher: ModuleType, has_ensurepip: bool, tools: list[str], packages: list[str]
) -> None:
    assert launcher.missing_debian_packages((3, 11), has_ensurepip, tools) == packages
    line = launcher.apt_line(packages)
    assert "\n" not in line
    assert all(package in line for package in packages)


def test_a_changed_request_gives_another_stamp_and_the_same_request_the_same(launcher: ModuleType) -> None:
    stamp = launcher.stamp_of("project", "constraints", ["test", "dev"])
    assert stamp == launcher.stamp_of("project", "constraints", ["dev", "test", "dev"])
    others = [
        ("project ", "constraints", ["test", "dev"]),
        ("project", "c", ["test", "dev"]),
        ("project", "constraints", []),
    ]
    assert stamp not in [launcher.stamp_of(*other) for other in others]


def test_setting_up_again_does_nothing(launcher: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).write_text(name, encoding="utf-8")
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "python").touch()
    stamp = tmp_path / ".venv" / "cosp-installed"
    stamp.write_text(launcher.stamp_of("pyproject.toml", "constraints.txt", ["dev", "test"]), encoding="utf-8")
    monkeypatch.setattr(launcher, "HOME", tmp_path)
    monkeypatch.setattr(launcher, "VENV", tmp_path / ".venv")
    monkeypatch.setattr(launcher, "STAMP", stamp)
    monkeypatch.setattr(launcher, "check_machine", lambda: None)
    calls: list[list[str]] = []

    def install(command: list[str], **_: object) -> None:
        calls.append(command)

    monkeypatch.setattr(launcher.subprocess, "run", install)
    launcher.set_up([])
    launcher.set_up(["test"])
    assert calls == []

    (tmp_path / "constraints.txt").write_text("another", encoding="utf-8")
    launcher.set_up([])
    assert "--editable" in calls[-1]
    assert calls[-1][-1].endswith("[dev,test]"), "extras that were there stay"
    assert stamp.read_text(encoding="utf-8").strip() == launcher.stamp_of("pyproject.toml", "another", ["dev", "test"])


def test_foreign_projection_data_and_threads_are_cleared(launcher: ModuleType) -> None:
    foreign = {"PROJ_LIB": "x", "PROJ_DATA": "x", "GDAL_DATA": "x", "PYTHONPATH": "x", "OMP_NUM_THREADS": "8"}
    clean = launcher.clean_environment({**foreign, "PATH": "/usr/bin", "NUMBA_CACHE_DIR": "mine"})
    assert not {"PROJ_LIB", "PROJ_DATA", "GDAL_DATA", "PYTHONPATH"} & clean.keys()
    assert {clean[name] for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")} == {"1"}
    assert clean["PATH"].split(os.pathsep) == [str(launcher.VENV / "bin"), "/usr/bin"]
    assert clean["NUMBA_CACHE_DIR"] == "mine"


def test_the_snakefile_is_named_only_where_it_must_be(launcher: ModuleType, tmp_path: Path) -> None:
    assert launcher.snakefile_options(["-n"], HOME) == []
    assert launcher.snakefile_options(["-s", "x"], tmp_path) == []
    assert launcher.snakefile_options(["-n"], tmp_path) == ["--snakefile", str(HOME / "Snakefile")]


def test_help_needs_no_environment() -> None:
    done = subprocess.run([sys.executable, str(HOME / "run"), "--help"], capture_output=True, text=True, check=True)
    assert all(command in done.stdout for command in ("demo", "test", "check", "snakemake", "setup"))


def test_an_unknown_command_is_refused() -> None:
    done = subprocess.run([sys.executable, str(HOME / "run"), "dmeo"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "dmeo" in done.stderr


def test_constraints_are_bare_names_and_versions() -> None:
    lines = (HOME / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert lines
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[0-9A-Za-z.+!]+", line) for line in lines)
    assert not any(line.startswith("cosp==") for line in lines)
