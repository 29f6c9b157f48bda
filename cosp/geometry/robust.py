"""Weights that keep gross errors out, and a running median."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from cosp.arrays import FloatArray


def huber_weights(standardised: FloatArray, tuning: float = 1.345) -> FloatArray:
    """Huber's weights of residuals divided by their standard deviation."""
    size = np.abs(standardised)
    return np.where(size <= tuning, 1.0, tuning / np.maximum(size, tuning))


def tukey_weights(standardised: FloatArray, tuning: float = 4.685) -> FloatArray:
    """Tukey's biweight of residuals divided by their standard deviation; zero beyond `tuning`."""
    ratio = np.asarray(standardised) / tuning
    return np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)


def geman_mcclure_weights(standardised: FloatArray, convexity: float) -> FloatArray:
    """Geman-McClure weights of graduated non-convexity, (m / (m + r^2))^2.

    Parameters
    ----------
    standardised : array
        Residuals divided by their standard deviation.
    convexity : float
        m: large values make the cost convex; it is lowered from step to step.

    References
    ----------
    [Yang2020] equation 12.
    """
    return (convexity / (convexity + np.asarray(standardised) ** 2)) ** 2


def running_median(values: FloatArray, width: int) -> FloatArray:
    """Median over a window of `width` samples along a trace; the ends repeat the end values."""
    return np.asarray(median_filter(np.asarray(values, dtype=float), size=width, mode="nearest"))
