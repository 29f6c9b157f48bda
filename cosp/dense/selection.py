"""From the winners of the aggregation to disparities: sub-pixel, checked from the right, with what was known before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosp.arrays import ByteArray, Float32Array
from cosp.dense import kernels
from cosp.dense.aggregation import Winners
from cosp.dense.memory import Workspace
from cosp.dense.validity import Validity


@dataclass(frozen=True)
class DisparityMap:
    """Disparity of every left pixel, why it is missing, and how sure it is.

    disparity : (rows, columns) array, px; right column = left column + disparity; NaN where validity is not 0
    validity : (rows, columns) array of `Validity` bits
    confidence : (rows, columns) array, 0 (the runner-up costs the same) to 255 (the runner-up costs infinitely more)
    similarity : (rows, columns) array, 0 (none) to 255 (full correlation of the pictures about the pixel)
    """

    disparity: Float32Array
    validity: ByteArray
    confidence: ByteArray
    similarity: ByteArray


def select_disparities(
    found: Winners,
    prior: Float32Array,
    *,
    left_validity: ByteArray,
    right_validity: ByteArray,
    tolerated: int = 0,
    whole: bool = False,
    memory: Workspace | None = None,
) -> DisparityMap:
    """Disparities of one picture, with validity bits for the doubtful ones.

    The right picture was resampled by `prior`, so what the winners tell is the disparity k that is left over:
    d(x) = k + prior(x + k). A winner counts as inconsistent where the right pixel it points to prefers another left
    pixel, more than one px away ([Hirschmuller2008] section 2.3).

    Parameters
    ----------
    prior : (rows, columns + 2 margin) array, px
        Disparity with which the right picture was resampled, going on past the left picture's sides.
    left_validity, right_validity : arrays of the shapes of the left and of the resampled right picture
        Bits that the pictures alone decide.
    tolerated : int
        Bits in spite of which there is a disparity.
    whole : bool
        Put `prior` where there is no disparity, instead of NaN.
    memory : Workspace
        Where the result lies, which then lasts until it is used for the next.
    """
    shape = found.winners.shape
    memory = memory or Workspace()
    result = DisparityMap(
        memory.array("disparity", shape, np.float32),
        left_validity.copy(),
        memory.array("confidence", shape, np.uint8),
        memory.array("similarity", shape, np.uint8),
    )
    result.similarity[:] = 0
    kernels.select(
        found.winners,
        found.costs,
        found.right_winners,
        prior,
        right_validity,
        int(Validity.INCONSISTENT),
        int(Validity.AT_RANGE_EDGE),
        tolerated,
        whole,
        result.disparity,
        result.validity,
        result.confidence,
    )
    return result
