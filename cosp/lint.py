"""Command: says what is wrong with optical bar camera files (.tsai) of KH-4, KH-4A and KH-4B films."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cosp.camera.lint import faults
from cosp.camera.tsai import optical_bar_from_tsai
from cosp.errors import InputError
from cosp.io import rasters


def lint(path: Path, image_path: Path | None = None) -> list[str]:
    """A sentence for every fault of a camera file and, where an image is given, of its size."""
    try:
        bar = optical_bar_from_tsai(path.read_text(encoding="utf-8", errors="replace"), path.name)
        rows, columns = bar.image_size_px[::-1] if image_path is None else rasters.info(image_path).shape
    except (OSError, InputError) as error:
        return [f"{error}."]
    found = faults(bar)
    if (columns, rows) != bar.image_size_px:
        width, height = bar.image_size_px
        found.insert(0, f"image_size is {width} {height}; the image has {columns} columns and {rows} rows.")
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; the exit status is 1 if there is a fault."""
    parser = argparse.ArgumentParser(prog="python -m cosp.lint", description=__doc__)
    parser.add_argument("cameras", nargs="+", type=Path, metavar="camera.tsai")
    parser.add_argument("--image", type=Path, help="the image of the camera, if one is given, to compare its size")
    options = parser.parse_args(arguments)
    if options.image is not None and len(options.cameras) > 1:
        parser.error("--image goes with one camera")
    status = 0
    for path in options.cameras:
        found = lint(path, options.image)
        status = max(status, 1 if found else 0)
        print("\n".join(f"{path}: {sentence}" for sentence in found or ["no fault found."]))
    return status


if __name__ == "__main__":
    sys.exit(main())
