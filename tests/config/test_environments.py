"""Bounds are written twice, for pip and for conda, and must be the same; constraints must satisfy them."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from pathlib import Path

import yaml
from packaging.requirements import Requirement
from packaging.version import Version

from cosp import workflow

HOME = Path(__file__).resolve().parents[2]
CONDA_NAMES = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base", "snakemake": "snakemake-minimal"}
ONLY_CONDA = {"python", "gdal"}
# Modules whose name is not that of their package.
PACKAGES = {"cv2": "opencv-python-headless", "yaml": "pyyaml", "sklearn": "scikit-learn"}
PROJECT = tomllib.loads((HOME / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def _runtime() -> dict[str, Requirement]:
    return {requirement.name: requirement for requirement in map(Requirement, PROJECT["dependencies"])}


def test_the_conda_environment_has_the_bounds_of_pyproject() -> None:
    environment = yaml.safe_load((HOME / "envs" / "cosp.yaml").read_text(encoding="utf-8"))
    assert environment["channels"] == ["conda-forge", "nodefaults"]
    conda = {requirement.name: requirement.specifier for requirement in map(Requirement, environment["dependencies"])}
    wanted = {CONDA_NAMES.get(name, name): requirement.specifier for name, requirement in _runtime().items()}
    assert {name: bounds for name, bounds in conda.items() if name not in ONLY_CONDA} == wanted
    assert str(conda["python"]) == PROJECT["requires-python"]


def test_constraints_satisfy_every_bound_and_cover_every_dependency_of_set_up() -> None:
    lines = (HOME / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {
        name.lower().replace("_", "-"): Version(version) for name, version in (line.split("==") for line in lines)
    }
    extras = PROJECT["optional-dependencies"]
    for text in [*PROJECT["dependencies"], *extras["test"], *extras["dev"]]:
        requirement = Requirement(text)
        version = pinned[requirement.name.lower().replace("_", "-")]
        assert version in requirement.specifier, f"{requirement} but constraints say {version}"


def test_every_module_a_script_needs_is_a_dependency() -> None:
    allowed = {"cosp", "snakemake"} | set(sys.stdlib_module_names) | {name.replace("-", "_") for name in _runtime()}
    scripts = sorted((HOME / "scripts").glob("*.py"))
    for path in sorted({*scripts, *(file for script in scripts for file in workflow.library_files(script))}):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names.append(node.module)
            for module in {name.split(".")[0] for name in names}:
                assert PACKAGES.get(module, module).replace("-", "_") in allowed, f"{path.name} imports {module}"


def test_every_key_cited_in_the_library_is_among_the_references() -> None:
    listed = set(
        re.findall(r"^\| \[(\w+)\]", (HOME / "docs" / "references.md").read_text(encoding="utf-8"), flags=re.M)
    )
    for path in sorted((HOME / "cosp").rglob("*.py")):
        cited = set(re.findall(r"\[([A-Z][A-Za-z]+[0-9]{4}[a-z]?)[\],]", path.read_text(encoding="utf-8")))
        assert cited <= listed, f"{path.relative_to(HOME)} cites {sorted(cited - listed)}"
