"""Meaning of each bit of the validity, and the tests behind those that a picture or a disparity map decides alone."""

from __future__ import annotations

from enum import IntFlag
from typing import Any

import cv2
import numpy as np

from cosp.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from cosp.dense import kernels
from cosp.dense.census import lacks_data
from cosp.dense.memory import Workspace
from cosp.geometry.statistics import summarise

CORRELATION_WINDOW_PX = kernels.CORRELATED
"""Side of the window in which the two pictures must look alike."""

TEXTURE_WINDOW_PX = kernels.TEXTURED
"""Side of the window in which texture is measured: the census looks as far."""


CLAIM_WINDOW_PX = 31
"""Side of the window whose confident matches support a claim to a pixel of the right picture."""

SHARED_PX = 8
"""Left pixels this close may share a right pixel: a slope seen almost from the side."""


NARROWEST_TEXTURE_PX = 13
"""Texture narrower than this, measured in windows, comes from a line of two or three px, such as a scratch."""


class Validity(IntFlag):
    """Why a pixel has no disparity; 0 where it has one."""

    NO_DATA_LEFT = 1  # within the window of the census
    NO_DATA_RIGHT = 2  # the match lies outside the right picture
    INCONSISTENT = 4  # the right picture prefers another match: occluded; or others are as good
    LOW_TEXTURE = 8
    SATURATED = 16
    AT_RANGE_EDGE = 32  # the cheapest disparity was the first or last that was searched
    SPECKLE = 64
    LOW_CORRELATION = 128  # the pictures do not look alike there: grain on snow, or a match beyond the edge


def no_data(image: ByteArray, flag: Validity) -> ByteArray:
    """`flag` where the picture is 0 within the window of the census, which would see the film's edge there."""
    bits: ByteArray = lacks_data(image).view(np.uint8) * np.uint8(flag)
    return bits


def picture_validity(
    image: ByteArray, no_data_flag: Validity, *, least_texture_sd: float, saturated_from: int
) -> ByteArray:
    """Bits that one picture decides alone.

    LOW_TEXTURE where the grey values of the surrounding window scatter by less than `least_texture_sd` (standard
    deviation), and where that is more only along a line, as in a scratch over snow or water: each film has its own.
    SATURATED where most are at least `saturated_from`, and the flag given where the window of the census meets a 0.
    """
    bits = no_data(image, no_data_flag)
    kernels.flag_windows(
        image,
        least_texture_sd,
        saturated_from,
        int(Validity.LOW_TEXTURE),
        int(Validity.SATURATED),
        bits,
    )
    around = np.ones((NARROWEST_TEXTURE_PX, NARROWEST_TEXTURE_PX), np.uint8)
    flat = bits & np.uint8(Validity.LOW_TEXTURE)
    return bits | np.asarray(cv2.morphologyEx(flat, cv2.MORPH_CLOSE, around), np.uint8)


def correlation(left: ByteArray, right: ByteArray, memory: Workspace | None = None) -> Float32Array:
    """Normalised correlation of two pictures in the window about every pixel; 0 where one is flat.

    Grain and noise of two films have nothing in common, so this tells texture from what only looks like it.
    """
    found: Float32Array = (memory or Workspace()).array("correlation", left.shape, np.float32)
    # A variance of a quarter grey value squared is the rounding of a flat picture.
    kernels.correlate_windows(left, right, 0.25, found)
    return found


def uniqueness(confidence: ByteArray) -> ByteArray:
    """Mean confidence of the window about a pixel: that of one pixel is noise."""
    size = (CORRELATION_WINDOW_PX, CORRELATION_WINDOW_PX)
    return np.asarray(cv2.boxFilter(confidence, -1, size, borderType=cv2.BORDER_REFLECT), np.uint8)


def speckles(disparity: Float32Array, *, largest_speckle_px: int, speckle_step_px: float) -> BoolArray:
    """Where a disparity belongs to an island of at most `largest_speckle_px` pixels.

    An island ends where disparity changes by more than `speckle_step_px` from pixel to pixel, or is missing.
    """
    found = np.empty(disparity.shape, np.bool_)
    kernels.islands(disparity, speckle_step_px, largest_speckle_px, found)
    return found


def doubly_claimed(disparity: Float32Array, confidence: ByteArray, right_columns: int) -> BoolArray:
    """Where another match, better supported around it, has the same pixel of the right picture.

    What only the left picture shows, beyond the edge of the right one above all, finds matches too: random ones, in
    patches. The pixels they take belong to others.

    Parameters
    ----------
    disparity : (rows, columns) array, px
        NaN where there is none.
    confidence : (rows, columns) array
    right_columns : int
        Width of the right picture.
    """
    contested = np.empty(len(disparity), np.bool_)
    kernels.contested_rows(disparity, SHARED_PX, contested)
    lost = np.zeros(disparity.shape, np.bool_)
    for start in range(0, len(disparity), CLAIM_WINDOW_PX):
        rows = slice(start, start + CLAIM_WINDOW_PX)
        if not contested[rows].any():
            continue
        around = slice(max(start - CLAIM_WINDOW_PX // 2, 0), start + CLAIM_WINDOW_PX + CLAIM_WINDOW_PX // 2)
        given = np.where(np.isnan(disparity[around]), np.uint8(0), confidence[around])
        # In whole numbers, so that a strip and the whole picture round alike.
        support = cv2.boxFilter(given, -1, (CLAIM_WINDOW_PX, CLAIM_WINDOW_PX), borderType=cv2.BORDER_CONSTANT)
        support = support[start - around.start :][:CLAIM_WINDOW_PX]
        kernels.claim_columns(disparity[rows], support, contested[rows], right_columns, SHARED_PX, lost[rows])
    return lost


def summarise_disparity(validity_counts: IntArray, disparity_px: FloatArray) -> dict[str, Any]:
    """How much of a pair was matched, why the rest was not, and how disparity is distributed.

    Parameters
    ----------
    validity_counts : (256,) array
        Number of pixels with each value of validity.
    disparity_px : array
        All disparities or a fair sample of them, with NaN.

    Returns
    -------
    dict
        `density`: share of pixels with a disparity among those where both pictures have data; `share_by_bit`: share of
        all pixels in which each bit is set; `disparity_px`: robust statistics.
    """
    values = np.arange(256)
    outside = (values & (Validity.NO_DATA_LEFT | Validity.NO_DATA_RIGHT)) != 0
    total, seen = int(validity_counts.sum()), int(validity_counts[~outside].sum())
    return {
        "pixels": total,
        "density": int(validity_counts[0]) / seen if seen else float("nan"),
        "share_by_bit": {
            bit.name.lower(): int(validity_counts[(values & bit) != 0].sum()) / max(total, 1)
            for bit in Validity
            if bit.name is not None
        },
        "disparity_px": summarise(disparity_px),
    }
