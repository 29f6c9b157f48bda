"""Compiled loops of the film stages."""

# Compiled code has types of its own.
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(nogil=True, cache=True)
def add_products(steps: Any, reach: int, products: Any) -> None:
    """Add up the products of each column with its neighbours to the right, at shifts across.

    Parameters
    ----------
    steps : (R, C) int16 array
        Small numbers: sums of products must stay within 32 bits.
    reach : int
        Largest shift, rows.
    products : (gaps + 1, 2 reach + 1, C) int32 array
        Element (g, s, c) grows by the sum over rows r of steps[r, c] * steps[r + s - reach, c + g].
    """
    rows, columns = steps.shape
    for r in range(reach, rows - reach):
        for g in range(products.shape[0]):
            for s in range(products.shape[1]):
                for c in range(columns - g):
                    products[g, s, c] += np.int32(steps[r, c]) * np.int32(steps[r + s - reach, c + g])
