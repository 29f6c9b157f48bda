"""What the page of a site says in one sentence, on which grid its pairs meet, and with which libraries it was made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from cosp.geometry.grids import PixelGrid
from cosp.report.page import readable

_SHOWN_PACKAGES = (
    "cosp",
    "snakemake",
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "rasterio",
    "pyproj",
    "xdem",
    "matplotlib",
)


def common_grid(grids: Sequence[PixelGrid]) -> PixelGrid:
    """Smallest grid that covers all of some grids of one posting.

    Raises ValueError when the postings differ.
    """
    steps = {(grid.step_x, grid.step_y) for grid in grids}
    if len(steps) != 1:
        raise ValueError(f"the grids have different postings: {sorted(steps)}")
    bounds = [grid.bounds for grid in grids]
    lows, highs = zip(*bounds, strict=True), zip(*bounds, strict=True)
    xmin, ymin = [min(values) for values in lows][:2]
    xmax, ymax = [max(values) for values in highs][2:]
    return PixelGrid.covering((xmin, ymin, xmax, ymax), grids[0].step_x)


def library_versions() -> dict[str, str]:
    """Versions of the packages that shape the products."""
    versions = {}
    for name in _SHOWN_PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def summary_sentence(quality: Mapping[str, Any]) -> str:
    """The site in one sentence: pairs, and differences of the mosaic on stable terrain."""
    stable = quality["mosaic"]["stable"]
    pairs = len(quality["pairs"])
    return (
        f"{pairs} {'pair' if pairs == 1 else 'pairs'}; on stable terrain the mosaic differs from the reference DEM by "
        f"{readable(stable.get('median'))} m in the median with an NMAD of {readable(stable.get('nmad'))} m "
        f"({quality['crs']}, heights above the WGS 84 ellipsoid)."
    )
