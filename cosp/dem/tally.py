"""Statistics of differences that come tile by tile, in memory that does not grow with their number."""

from __future__ import annotations

from typing import Any

import numpy as np

from cosp.arrays import BoolArray, FloatArray

_STEP_M = 0.01
_LIMIT_M = 1000.0


class Tally:
    """Histogram of differences in steps of a centimetre within a kilometre, with their exact sums.

    Differences beyond a kilometre are counted in the outermost steps; standard deviation and RMS have them as they are.
    """

    def __init__(self) -> None:
        """Nothing counted yet."""
        self.edges_m: FloatArray = np.linspace(-_LIMIT_M, _LIMIT_M, round(2 * _LIMIT_M / _STEP_M) + 1)
        self.counts = np.zeros(len(self.edges_m) - 1, np.int64)
        self.asked = 0
        self._sum = 0.0
        self._sum_of_squares = 0.0

    @property
    def count(self) -> int:
        """Differences so far."""
        return int(self.counts.sum())

    def add(self, difference_m: FloatArray, asked: BoolArray) -> None:
        """Count a tile.

        Parameters
        ----------
        difference_m : (R, C) array
            NaN where there is no difference.
        asked : (R, C) boolean array
            Cells that should have one.
        """
        values = np.asarray(difference_m, np.float64)[asked]
        self.asked += values.size
        values = values[np.isfinite(values)]
        steps = np.clip(np.floor((values + _LIMIT_M) / _STEP_M), 0, len(self.counts) - 1).astype(np.int64)
        self.counts += np.bincount(steps, minlength=len(self.counts))
        self._sum += float(values.sum())
        self._sum_of_squares += float(np.square(values).sum())

    def quantile(self, share: float) -> float:
        """Difference below which a share of them lies, to a centimetre; NaN where there are none."""
        middle = (self.edges_m[:-1] + self.edges_m[1:]) / 2
        return _quantile(middle, self.counts, share)

    def statistics(self, *, cell_area_m2: float) -> dict[str, Any]:
        """What `cosp.dem.differencing.difference_statistics` says of all cells at once, quantiles to a centimetre."""
        count = self.count
        if not count:
            names = ("median", "nmad", "sd", "rms", "le90", "p05", "p95")
            return {"count": 0, **dict.fromkeys(names, float("nan")), "area_km2": 0.0, "completeness": float("nan")}
        middle = (self.edges_m[:-1] + self.edges_m[1:]) / 2
        median = self.quantile(0.5)
        mean, square = self._sum / count, self._sum_of_squares / count
        return {
            "count": count,
            "median": median,
            "nmad": 1.4826 * _quantile(np.abs(middle - median), self.counts, 0.5),
            "sd": float(np.sqrt(max(square - mean**2, 0.0))),
            "rms": float(np.sqrt(square)),
            "le90": _quantile(np.abs(middle), self.counts, 0.9),
            "p05": self.quantile(0.05),
            "p95": self.quantile(0.95),
            "area_km2": count * cell_area_m2 / 1e6,
            "completeness": count / self.asked,
        }


def _quantile(values: FloatArray, counts: np.ndarray[Any, np.dtype[np.int64]], share: float) -> float:
    """Quantile of values that occur so many times each."""
    if not counts.any():
        return float("nan")
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(counts[order])
    return round(float(values[order][np.searchsorted(reached, share * reached[-1])]), 4)
