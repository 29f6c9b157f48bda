"""Census transform: each pixel as the list of its neighbours that are darker, blind to brightness and contrast."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cosp.arrays import BoolArray, ByteArray
from cosp.dense import kernels
from cosp.dense.memory import Workspace

_log = logging.getLogger(__name__)


def left_census(image: ByteArray, memory: Workspace | None = None) -> NDArray[np.uint16]:
    """Census of the left picture, 7 x 9 neighbours in planes of words.

    Parameters
    ----------
    image : (rows, columns) array, contiguous
        Grey values; 0 is no data. Where the window reaches it, the pixel becomes a pattern that is equally unlike
        everything: the edges of two films look like each other, wherever they lie on the ground.
    memory : Workspace
        Where the result lies, which then lasts until it is used for the next.

    Returns
    -------
    (4, rows, columns) array
        Hamming distance between the four words of two pixels is their matching cost, 0 to 62.

    References
    ----------
    [Zabih1994].
    """
    return _census(image, kernels.LEFT_BLANK, "left census", memory or Workspace())


def right_census(image: ByteArray, memory: Workspace | None = None) -> NDArray[np.uint16]:
    """Census of the right picture; see `left_census`."""
    return _census(image, kernels.RIGHT_BLANK, "right census", memory or Workspace())


def lacks_data(image: ByteArray) -> BoolArray:
    """Where the window of the census reaches no data (0)."""
    if image.all():
        return np.zeros(image.shape, np.bool_)
    least = cv2.erode(image, np.ones((kernels.CENSUS_ROWS, kernels.CENSUS_COLUMNS), np.uint8))
    return np.asarray(least == 0)


def _census(image: ByteArray, blank: int, name: str, memory: Workspace) -> NDArray[np.uint16]:
    planes: NDArray[np.uint16] = memory.array(name, (kernels.PLANES, *image.shape), np.uint16)
    wide_enough = image.shape[1] >= kernels.CENSUS_BLOCK + kernels.CENSUS_COLUMNS - 1
    transform = _transform() if wide_enough else kernels.census_plain
    transform(image, planes)
    missing = lacks_data(image)
    if missing.any():
        kernels.blank_census(planes, missing, blank)
    return planes


@cache
def _transform() -> Callable[[ByteArray, NDArray[np.uint16]], None]:
    """The vector form where this machine's compiler takes it, else the plain loops."""
    try:
        image = np.zeros((8, 64), np.uint8)
        kernels.census_vector(image, np.empty((kernels.PLANES, 8, 64), np.uint16))
    except Exception as error:  # whatever the compiler stumbles over, the loops give the same bits
        _log.warning("vector form of the census does not compile here, plain loops are used: %s", error)
        return kernels.census_plain
    return kernels.census_vector
