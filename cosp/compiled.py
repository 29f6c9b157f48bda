"""Compile what jobs call, so that none of them waits for it: `python -m cosp.compiled`.

Numba compiles a function for the types that it is called with, and keeps the result beside the source or where
NUMBA_CACHE_DIR says. `compiled.txt` names the functions and types of a usual run: a line holds a package, a function of
its kernels, and the types as Numba evaluates them. A line too few costs the first job seconds, one too many costs them
here.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numba.core import sigutils

from cosp.dense.coarse_to_fine import match
from cosp.dense.validity import doubly_claimed

TABLE = Path(__file__).with_suffix(".txt")


def functions_by_package() -> dict[str, list[tuple[str, str]]]:
    """Functions and types of the table."""
    found: dict[str, list[tuple[str, str]]] = {}
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        package, function, types = line.split(" ", 2)
        found.setdefault(package, []).append((function, types))
    return found


def compile_kernels() -> None:
    """Compile all of the table, and dense matching in its vector form, or find them compiled; a package a process."""
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        dense = pool.submit(_compile_dense)
        tables = functions_by_package()
        longest_first = sorted(tables, key=lambda package: -len(tables[package]))
        for _ in pool.map(_compile_package, longest_first, (tables[package] for package in longest_first)):
            pass
        dense.result()


def _compile_package(package: str, functions: list[tuple[str, str]]) -> None:
    kernels = import_module(f"cosp.{package}.kernels")
    for function, types in functions:
        # What a call looks for is kept under the types, not under the words for them.
        arguments, _ = sigutils.normalize_signature(types)  # type: ignore[no-untyped-call]
        getattr(kernels, function).compile(arguments)


def _compile_dense() -> None:
    """The functions of dense matching choose among forms and sizes when they are called."""
    noise = np.random.default_rng(0).integers(1, 256, (120, 200), dtype=np.uint8)
    noise[:20] = 0  # what only film edges need, too
    match(
        noise,
        noise,
        (-20, 20),
        small_step=24,
        large_step=64,
        least_texture_sd=2.0,
        saturated_from=250,
        least_correlation=0.35,
        least_uniqueness=0.25,
        largest_speckle_px=100,
        speckle_step_px=1.5,
        threads=1,
    )
    contested = np.zeros((1, 40), np.float32)
    contested[0, 30] = -25.0
    doubly_claimed(contested, np.ones((1, 40), np.uint8), 40)


if __name__ == "__main__":
    compile_kernels()
