"""Elevation differences and their statistics. Always ours minus theirs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cosp.arrays import BoolArray, FloatArray
from cosp.geometry.statistics import summarise


def difference_statistics(difference_m: FloatArray, asked: BoolArray, *, cell_area_m2: float) -> dict[str, Any]:
    """How a model differs from another over chosen ground.

    Parameters
    ----------
    difference_m : (R, C) array
        NaN where either model has no height.
    asked : (R, C) boolean array
        Ground that should have been measured: stable, and seen by both films.
    cell_area_m2 : float

    Returns
    -------
    dict
        count, area_km2, median, nmad, sd, rms, le90, p05, p95 (m), completeness (share of `asked` with a
        difference).
    """
    values = np.asarray(difference_m, float)[asked]
    values = values[np.isfinite(values)]
    statistics: dict[str, Any] = summarise(values)
    statistics["area_km2"] = values.size * cell_area_m2 / 1e6
    statistics["completeness"] = values.size / int(asked.sum()) if asked.any() else float("nan")
    return statistics


def statistics_by_slope(
    difference_m: FloatArray, asked: BoolArray, slope: FloatArray, edges_deg: Sequence[float]
) -> list[dict[str, Any]]:
    """Statistics of the differences in bins of slope, from edge to edge in degrees."""
    bins = []
    for low, high in zip(edges_deg[:-1], edges_deg[1:], strict=True):
        with np.errstate(invalid="ignore"):
            chosen = asked & (slope >= low) & (slope < high)
        bins.append({"slope_from_deg": low, "slope_to_deg": high, **summarise(difference_m[chosen])})
    return bins
