"""Write the table of what is to be compiled at set-up from what a run has compiled.

    NUMBA_CACHE_DIR=CACHE snakemake ...
    python tests/workflow/record_compiled.py CACHE [CACHE ...] > cosp/compiled.txt

Start with an empty CACHE, and let it serve one checkout alone.
"""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

from numba import types


def written(given: types.Type) -> str | None:
    """A type as `numba.types` evaluates it; None where a function was called by a compiled one alone."""
    if isinstance(given, types.Array):
        dtype = written(given.dtype)
        return f"Array({dtype}, {given.ndim}, '{given.layout}'{'' if given.mutable else ', readonly=True'})"
    if isinstance(given, types.UniTuple):
        return f"UniTuple({written(given.dtype)}, {given.count})"
    if isinstance(given, types.Tuple):
        return f"Tuple(({', '.join(str(written(one)) for one in given.types)},))"
    if isinstance(given, types.Boolean | types.Integer | types.Float):
        return given.name if not isinstance(given, types.Boolean) else "boolean"
    return None


def recorded(cache: Path) -> set[str]:
    """Lines of the table that a cache of Numba holds."""
    found = set()
    for path in cache.rglob("kernels.*.nbi"):
        package = path.parent.name.split("_")[0]
        function = path.name.removeprefix("kernels.").rsplit("-", 1)[0]
        if function.startswith("_") or "." in function or package == "dense":
            continue
        with path.open("rb") as file:
            pickle.load(file)  # version
            _, overloads = pickle.loads(file.read())
        for key in overloads:
            names = [written(one) for one in key[0]]
            if None not in names:
                found.add(f"{package} {function} ({', '.join(str(name) for name in names)},)")
    return found


if __name__ == "__main__":
    print("\n".join(sorted(set().union(*(recorded(Path(one)) for one in sys.argv[1:])))))
