"""Figure of a pair's dense matching: what was found, and how sure it is."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from cosp.arrays import ByteArray, Float32Array

_WIDTH_INCH = 10.0


def draw_disparity(disparity_px: Float32Array, confidence: ByteArray, similarity: ByteArray, *, title: str) -> Figure:
    """Disparity, confidence and similarity of a pair, one panel each; grey where there is no disparity.

    Parameters
    ----------
    disparity_px : (rows, columns) array, NaN where there is none
    confidence, similarity : arrays of the same shape, 0 to 255
    """
    missing = np.isnan(disparity_px)
    panels = [
        (np.asarray(disparity_px), "disparity (px)", "viridis", _limits(disparity_px)),
        (np.where(missing, np.nan, confidence / 255), "confidence", "magma", (0.0, 1.0)),
        (np.where(missing, np.nan, similarity / 255), "similarity", "magma", (0.0, 1.0)),
    ]
    tall = disparity_px.shape[0] > disparity_px.shape[1]
    long_side, short_side = sorted(disparity_px.shape, reverse=True)
    height = float(np.clip(_WIDTH_INCH * short_side / long_side, 1.2, 7.0))
    figure = Figure(figsize=(_WIDTH_INCH, 3 * height + 0.8), layout="constrained")
    for axes, (values, label, colours, (low, high)) in zip(figure.subplots(3, 1), panels, strict=True):
        # A film is much longer than wide: the long side goes along the page.
        drawn = axes.imshow(
            values.T if tall else values,
            cmap=mpl.colormaps[colours],
            vmin=low,
            vmax=high,
            aspect="auto",
            interpolation="nearest",
        )
        axes.set_facecolor("0.8")
        axes.set_xticks([])
        axes.set_yticks([])
        figure.colorbar(drawn, ax=axes, label=label)
    figure.suptitle(title)
    return figure


def _limits(values: Float32Array) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = np.quantile(finite, [0.02, 0.98])
    return float(low), float(max(high, low + 1.0))
