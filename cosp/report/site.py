"""What the page of a site says in one sentence, on which grid its pairs meet, and with which libraries it was made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cosp.dem.tally import Tally
from cosp.geometry.grids import PixelGrid
from cosp.report.page import Table, readable

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


_STATISTICS = {
    "count": "cells compared",
    "area_km2": "area (km²)",
    "completeness": "share of the ground seen",
    "median": "median (m)",
    "nmad": "NMAD (m)",
    "sd": "standard deviation (m)",
    "rms": "RMS (m)",
    "le90": "LE90 (m)",
    "p05": "5 % quantile (m)",
    "p95": "95 % quantile (m)",
}


def statistics_table(caption: str, columns: Mapping[str, Mapping[str, Any]]) -> Table:
    """Statistics of differences side by side, in words."""
    rows = tuple((text, *(each.get(key) for each in columns.values())) for key, text in _STATISTICS.items())
    return Table(caption, ("", *columns), rows)


def pair_table(quality: Mapping[str, Any]) -> Table:
    """What a pair's `quality.json` says of its DEM before and after coregistration, against each model it knows."""
    columns = {}
    for model, holder in (("reference", quality), ("check", quality.get("check", {}))):
        for when in ("before", "after"):
            if when in holder:
                columns[f"{when}, {model} DEM"] = holder[when]
                columns[f"{when}, {model} DEM, textured"] = holder[when].get("textured", {})
    return statistics_table("Differences on stable terrain that both films see", columns)


def facts_table(quality: Mapping[str, Any], settings: Mapping[str, Any]) -> Table:
    """The site in a few lines: where, what from, on which grid."""
    pairs = quality["pairs"]
    sigma = ", ".join(dict.fromkeys(readable(each.get("sigma_naught_px")) for each in pairs.values()))
    rows = (
        ("pairs", ", ".join(pairs)),
        ("coordinate system", quality["crs"]),
        ("posting (m)", settings["site"]["dem_resolution_m"]),
        ("reference DEM", settings["site"]["reference_dem"]),
        ("reference image", settings["site"]["reference_image"] or "none: control from relief alone"),
        ("sigma naught of the adjustment (px)", sigma),
    )
    return Table("Site", ("", ""), rows)


def draw_tally(tally: Tally, *, title: str, bars: int = 120) -> Figure:
    """Distribution of counted differences, with median and NMAD, out to six NMAD."""
    figure = Figure(figsize=(6.4, 4), layout="constrained")
    axes = figure.add_subplot()
    said = tally.statistics(cell_area_m2=1.0)
    if said["count"]:
        step = float(tally.edges_m[1] - tally.edges_m[0])
        reach = max(6 * said["nmad"] + abs(said["median"]), 10 * step)
        merged = max(1, round(2 * reach / bars / step))
        middle = len(tally.counts) // 2
        side = min(-(-round(reach / step) // merged) * merged, middle // merged * merged)
        counts = tally.counts[middle - side : middle + side].reshape(-1, merged).sum(axis=1)
        edges = np.arange(-side, side + 1, merged) * step
        label = f"median {said['median']:.2f} m, NMAD {said['nmad']:.2f} m"
        axes.stairs(counts / said["count"] / (merged * step), edges, linewidth=1.4, label=label)
        axes.set_ylim(bottom=0.0, top=1.25 * axes.get_ylim()[1])
        axes.legend(fontsize="small", loc="upper right")
    axes.axvline(0, color="0.5", linewidth=0.8)
    axes.set(xlabel="elevation difference (m)", ylabel="density (1/m)", title=title)
    return figure
