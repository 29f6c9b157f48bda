"""What a matcher is, and the choice of one by its name."""

from __future__ import annotations

from typing import Protocol

from cosp.arrays import FloatArray
from cosp.errors import InputError
from cosp.matching.correspondences import Correspondences
from cosp.matching.sift import SiftMatcher
from cosp.matching.structural import StructuralMatcher


class Matcher(Protocol):
    """Anything that finds points of one image in another one brought to the same geometry."""

    def match(self, moving: FloatArray, fixed: FloatArray, points_rc: FloatArray, *, threads: int) -> Correspondences:
        """Matches of two images (rows, columns), NaN where there is nothing, near wanted points (N, 2) of the first."""
        ...


def matcher_by_name(
    name: str, *, template_px: int, search_px: int, min_score: float, max_ratio: float, max_return_px: float
) -> Matcher:
    """The matcher of a name, "structural" or "sift".

    Raises
    ------
    InputError
        For a name that is not known, or one whose learned weights are not installed.
    """
    if name == "structural":
        return structural(template_px, search_px, min_score, max_ratio, max_return_px)
    if name == "sift":
        return SiftMatcher(search_px=search_px, max_ratio=_SIFT_RATIO, max_features=_SIFT_FEATURES)
    if name == "lightglue":
        raise InputError("matcher 'lightglue' needs learned weights, which this version cannot load; use 'structural'")
    raise InputError(f"matcher {name!r} is not one of 'structural', 'sift'")


def structural(
    template_px: int, search_px: int, min_score: float, max_ratio: float, max_return_px: float
) -> StructuralMatcher:
    """A structural matcher with the channels that the whole pipeline uses."""
    return StructuralMatcher(
        template_px=template_px,
        search_px=search_px,
        bins=_BINS,
        sigma_px=_SIGMA_PX,
        min_score=min_score,
        max_ratio=max_ratio,
        max_return_px=max_return_px,
        min_valid=_MIN_VALID,
    )


_BINS = 9  # [Ye2019] section 3
_SIGMA_PX = 1.0  # [Ye2019] uses 0.8
_MIN_VALID = 0.9
_SIFT_RATIO = 0.8  # [Lowe2004] section 7.1
_SIFT_FEATURES = 20000
