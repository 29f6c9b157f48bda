"""Robust and classical statistics of differences. NaN are left out everywhere."""

from __future__ import annotations

import numpy as np

from cosp.arrays import FloatArray


def _finite(values: FloatArray) -> FloatArray:
    values = np.asarray(values, dtype=float).ravel()
    return values[np.isfinite(values)]


def nmad(values: FloatArray) -> float:
    """Normalised median absolute deviation, 1.4826 median |v - median v|; NaN for no values.

    References
    ----------
    [Hoehle2009] table 1. It hides bias: never print it without the median.
    """
    values = _finite(values)
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if values.size else float("nan")


def rms(values: FloatArray) -> float:
    """Root of the mean square; NaN for no values."""
    values = _finite(values)
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def linear_error(values: FloatArray, share: float = 0.9) -> float:
    """Half width about zero that holds the given share of the values (LE90 by default); NaN for no values."""
    values = _finite(values)
    return float(np.quantile(np.abs(values), share)) if values.size else float("nan")


def summarise(values: FloatArray) -> dict[str, float | int]:
    """Count, median, NMAD, SD, RMS, LE90 and the 5 % and 95 % quantiles of the finite values."""
    values = _finite(values)
    if not values.size:
        names = ("median", "nmad", "sd", "rms", "le90", "p05", "p95")
        return {"count": 0, **dict.fromkeys(names, float("nan"))}
    low, high = np.quantile(values, [0.05, 0.95])
    return {
        "count": int(values.size),
        "median": float(np.median(values)),
        "nmad": nmad(values),
        "sd": float(np.std(values)),
        "rms": rms(values),
        "le90": linear_error(values),
        "p05": float(low),
        "p95": float(high),
    }
