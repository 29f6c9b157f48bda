"""Functions that set-up compiles: those that there are, for the arguments that they take."""

from __future__ import annotations

import inspect
from importlib import import_module

import pytest
from numba.core import sigutils

from cosp.compiled import functions_by_package

LINES = [(package, *line) for package, lines in functions_by_package().items() for line in lines]


@pytest.mark.parametrize(("package", "function", "types"), LINES)
def test_a_line_names_a_kernel_and_a_type_for_each_of_its_arguments(package: str, function: str, types: str) -> None:
    kernel = getattr(import_module(f"cosp.{package}.kernels"), function)
    arguments, _ = sigutils.normalize_signature(types)
    assert len(arguments) == len(inspect.signature(kernel.py_func).parameters)
