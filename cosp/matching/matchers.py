"""What a matcher is, and the choice of one by its name."""

from __future__ import annotations

from typing import Protocol

from cosp.arrays import FloatArray
from cosp.errors import InputError
from cosp.matching.correspondences import Correspondences
from cosp.matching.lightglue import LearnedMatcher, lightglue, superglue
from cosp.matching.sift import SiftMatcher
from cosp.matching.structural import StructuralMatcher

LEARNED = ("lightglue", "superglue")
"""Matchers that look for features of their own in large tiles."""


class Matcher(Protocol):
    """Anything that finds points of one image in another one brought to the same geometry."""

    def match(self, moving: FloatArray, fixed: FloatArray, points_rc: FloatArray, *, threads: int) -> Correspondences:
        """Matches of two images (rows, columns), NaN where there is nothing, near wanted points (N, 2) of the first."""
        ...


def matcher_by_name(
    name: str,
    *,
    template_px: int,
    search_px: int,
    min_score: float,
    max_ratio: float,
    max_return_px: float,
    features: str | None = None,
    max_features: int | None = None,
    superglue_weights: str | None = None,
) -> Matcher:
    """The matcher of a name, "structural", "sift", "lightglue" or "superglue".

    Parameters
    ----------
    template_px, search_px, min_score, max_ratio, max_return_px
        See `StructuralMatcher`, which also refines what the learned matchers find.
    features, max_features
        See `lightglue`.
    superglue_weights : str
        See `superglue`.

    Raises
    ------
    InputError
        For a name that is not known, or one whose packages or weights are not there.
    """
    precise = structural(template_px, search_px, min_score, max_ratio, max_return_px)
    if name == "structural":
        return precise
    if name == "sift":
        return SiftMatcher(search_px=search_px, max_ratio=_SIFT_RATIO, max_features=_SIFT_FEATURES)
    if name == "lightglue" and features is not None and max_features is not None:
        return LearnedMatcher(lightglue(features, max_features), precise, search_px)
    if name == "superglue":
        if superglue_weights is None:
            raise InputError("matcher 'superglue' needs weights of your own; name their folder by superglue_weights")
        return LearnedMatcher(superglue(superglue_weights), precise, search_px)
    raise InputError(f"matcher {name!r} is not one of 'structural', 'sift', 'lightglue', 'superglue'")


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
