"""From the winners of the aggregation to disparities: sub-pixel, checked from the right, with what was known before."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from cosp.arrays import ByteArray, Float32Array
from cosp.dense import kernels
from cosp.dense.aggregation import Winners
from cosp.dense.memory import Workspace
from cosp.dense.validity import Validity

_log = logging.getLogger(__name__)


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
    right: ByteArray,
    *,
    left_validity: ByteArray,
    right_validity: ByteArray,
    tolerated: int = 0,
    whole: bool = False,
    memory: Workspace | None = None,
) -> tuple[DisparityMap, ByteArray]:
    """Disparities of one picture, with validity bits for the doubtful ones.

    The right picture was resampled by `prior`, so what the winners tell is the disparity k that is left over:
    d(x) = k + prior(x + k). A winner counts as inconsistent where the right pixel it points to prefers another left
    pixel, more than one px away ([Hirschmuller2008] section 2.3).

    Parameters
    ----------
    prior : (rows, columns + 2 margin) array, px
        Disparity with which the right picture was resampled, going on past the left picture's sides.
    right : array of the shape of `prior`
        The right picture, resampled.
    left_validity, right_validity : arrays of the shapes of the left and of the resampled right picture
        Bits that the pictures alone decide.
    tolerated : int
        Bits in spite of which there is a disparity.
    whole : bool
        Put `prior` where there is no disparity, instead of NaN.
    memory : Workspace
        Where the result lies, which then lasts until it is used for the next.

    Returns
    -------
    DisparityMap
    (rows, columns) array
        The right picture as it is where each left pixel is matched, or by `prior` where it is not.
    """
    rows, columns = found.winners.shape
    memory = memory or Workspace()
    result = DisparityMap(
        memory.array("disparity", (rows, columns), np.float32),
        left_validity.copy(),
        memory.array("confidence", (rows, columns), np.uint8),
        memory.array("similarity", (rows, columns), np.uint8),
    )
    result.similarity[:] = 0
    matched: ByteArray = memory.array("matched", (rows, columns), np.uint8)
    wide_enough = columns >= kernels.SAMPLE_BLOCK and prior.shape[1] >= found.right_winners.shape[1] + 4
    select = _select() if wide_enough else kernels.select_plain
    select(
        found.winners,
        found.costs,
        found.right_winners,
        prior,
        right,
        right_validity,
        int(Validity.INCONSISTENT),
        int(Validity.AT_RANGE_EDGE),
        tolerated,
        whole,
        result.disparity,
        result.validity,
        result.confidence,
        matched,
    )
    return result, matched


@cache
def _select() -> Callable[..., None]:
    """The vector form where this machine's compiler takes it, else the plain loops."""
    narrow, wide = (1, kernels.SAMPLE_BLOCK), (1, kernels.SAMPLE_BLOCK + 6)
    narrow_byte, wide_byte = np.zeros(narrow, np.uint8), np.zeros(wide, np.uint8)
    try:
        kernels.select_vector(
            narrow_byte,
            np.ones((*narrow, 4), np.uint16),
            np.zeros((1, kernels.SAMPLE_BLOCK + 2), np.uint8),
            np.zeros(wide, np.float32),
            wide_byte,
            wide_byte,
            0,
            0,
            0,
            True,
            np.zeros(narrow, np.float32),
            narrow_byte.copy(),
            narrow_byte.copy(),
            narrow_byte.copy(),
        )
    except Exception as error:  # whatever the compiler stumbles over, the loops give the same bits
        _log.warning("vector form of the selection does not compile here, plain loops are used: %s", error)
        return kernels.select_plain
    return kernels.select_vector
