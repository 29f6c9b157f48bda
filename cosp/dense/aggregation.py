"""Semi-global aggregation: the matching costs of a picture, made consistent along eight paths."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cosp.arrays import ByteArray
from cosp.dense import kernels
from cosp.dense.memory import Workspace

_log = logging.getLogger(__name__)

LARGEST_PENALTY = 127 - kernels.CENSUS_BITS
"""Two path costs must add up within a byte."""


@dataclass(frozen=True)
class Winners:
    """Cheapest disparity of every left pixel, counted from the lower end of the range.

    winners : (rows, columns) array
    costs : (rows, columns, 4) array, sums over the eight paths: at the lower neighbour, the winner, the upper neighbour
        (65535 // disparities beyond the range), and the least of all the others
    right_winners : (rows, columns + disparities) array, cheapest index for each right pixel
    """

    winners: ByteArray
    costs: NDArray[np.uint16]
    right_winners: ByteArray


def aggregate_costs(
    left_planes: NDArray[np.uint16],
    right_planes: NDArray[np.uint16],
    *,
    disparities: int,
    small_step: int,
    large_step: int,
    memory: Workspace | None = None,
) -> Winners:
    """Cheapest of the disparities -disparities / 2 … disparities / 2 - 1 at each pixel, after semi-global aggregation.

    Parameters
    ----------
    left_planes : (4, rows, columns) array
        Census of the left picture.
    right_planes : (4, rows, columns + 2 margin) array
        Census of the right picture, which goes on by at least disparities / 2 columns on both sides.
    disparities : int
        32 or 64 in vector form, any even number up to 256 in plain loops.
    small_step, large_step : int
        Penalty for a change of disparity by one and by more from pixel to pixel, in bits of the census.

    memory : Workspace
        Where the result lies, which then lasts until it is used for the next.

    References
    ----------
    [Hirschmuller2008] section 2.2.
    """
    if not 0 < small_step <= large_step <= LARGEST_PENALTY:
        raise ValueError(f"penalties {small_step}, {large_step}: 0 < small <= large <= {LARGEST_PENALTY} is needed")
    _, rows, columns = left_planes.shape
    margin = (right_planes.shape[2] - columns) // 2
    if margin < disparities // 2:
        raise ValueError(f"right picture goes on by {margin} columns, {disparities // 2} are needed")
    memory = memory or Workspace()
    found = Winners(
        memory.array("winners", (rows, columns), np.uint8),
        memory.array("costs", (rows, columns, 4), np.uint16),
        memory.array("right winners", (rows, columns + disparities), np.uint8),
    )
    _passes(disparities)(
        left_planes,
        right_planes,
        margin - disparities // 2,
        small_step,
        large_step,
        memory.array("volume", (2, rows, columns, disparities), np.uint8),
        memory.array("leasts", (rows, columns), np.uint32),
        found.winners,
        found.costs,
        found.right_winners,
    )
    return found


@cache
def _passes(disparities: int) -> Callable[..., None]:
    """The vector form where there is one and this machine's compiler takes it, else the plain loops."""
    if disparities not in (32, 64):
        return kernels.plain_passes
    passes = kernels.vector_passes(disparities)
    planes = np.zeros((kernels.PLANES, 1, 1), np.uint16)
    right_planes = np.zeros((kernels.PLANES, 1, 1 + disparities), np.uint16)
    try:
        passes(
            planes,
            right_planes,
            0,
            1,
            1,
            np.empty((2, 1, 1, disparities), np.uint8),
            np.empty((1, 1), np.uint32),
            np.empty((1, 1), np.uint8),
            np.empty((1, 1, 4), np.uint16),
            np.empty((1, 1 + disparities), np.uint8),
        )
    except Exception as error:  # whatever the compiler stumbles over, the loops give the same bits
        _log.warning("vector form of the matching does not compile here, plain loops are used: %s", error)
        return kernels.plain_passes
    return passes
