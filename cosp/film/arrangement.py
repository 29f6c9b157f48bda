"""Order, turn and mirror of the digitised parts, inferred from their overlaps."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosp.arrays import ByteArray
from cosp.errors import StitchingError
from cosp.film.stitching import CoarseSeam, Features, find_features, match_features, turned_features

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, order=True)
class Pose:
    """How a part has to be laid: mirrored top to bottom first, then turned by 180 degrees."""

    turned: bool = False
    mirrored: bool = False


@dataclass(frozen=True)
class Arrangement:
    """Parts from left to right.

    Parameters
    ----------
    order : int of each place
        Index of the part that lies there.
    poses : Pose of each place
    seams : CoarseSeam between each two places
    margin : float
        Agreeing keypoints of the weakest seam over the votes of its best rival shift.
    """

    order: tuple[int, ...]
    poses: tuple[Pose, ...]
    seams: tuple[CoarseSeam, ...]
    margin: float


@dataclass(frozen=True)
class SeamLimits:
    """What a seam between two parts can look like.

    Parameters
    ----------
    overlap_mm : (least, most)
        Width of the overlap.
    offset_mm : float
        Largest offset across the film.
    feature_pixel_mm : float
        Size of the pixels the keypoints are found in.
    ratio : float
        Largest ratio of the distances to the nearest and the second nearest descriptor.
    min_features : int
        Keypoints that must agree.
    min_margin : float
        Least ratio of agreeing keypoints to the votes of the best rival shift.
    """

    overlap_mm: tuple[float, float]
    offset_mm: float
    feature_pixel_mm: float
    ratio: float
    min_features: int
    min_margin: float

    def accepts(self, seam: CoarseSeam | None) -> bool:
        """Whether a seam is beyond doubt."""
        return seam is not None and seam.inliers >= self.min_features and _margin(seam) >= self.min_margin


def posed(part: ByteArray, pose: Pose) -> ByteArray:
    """View of a part laid as its pose says."""
    if pose.mirrored:
        part = part[::-1]
    return part[::-1, ::-1] if pose.turned else part


def arrange(
    parts: Sequence[ByteArray],
    *,
    names: Sequence[str],
    pixel_mm: float,
    limits: SeamLimits,
    rng: np.random.Generator,
) -> Arrangement:
    """Order and pose of the parts that their overlaps agree on.

    The order given is tried first, as it stands and back to front; only where that leaves a seam in doubt are all
    orders, turns and mirrors compared. Turning or mirroring all parts together changes no overlap: the arrangement that
    leaves most parts as they came is returned.

    Raises
    ------
    StitchingError
        Where a seam stays in doubt; it is named, with what was found and needed.
    """
    if len(parts) == 1:
        return Arrangement((0,), (Pose(),), (), float("inf"))
    evidence = _Evidence(parts, pixel_mm=pixel_mm, limits=limits, rng=rng)
    plain = tuple(Pose() for _ in parts)
    given = tuple(range(len(parts)))
    for order in (given, given[::-1]):
        seams = [evidence.seam(left, right) for left, right in itertools.pairwise(zip(order, plain, strict=True))]
        if all(limits.accepts(seam) for seam in seams):
            return _arrangement(order, plain, seams)
    _LOG.info("the order of the parts as given leaves a seam in doubt; comparing all orders, turns and mirrors")
    order, poses = _best_chain(evidence, len(parts))
    seams = [evidence.seam(left, right) for left, right in itertools.pairwise(zip(order, poses, strict=True))]
    for k, seam in enumerate(seams):
        if not limits.accepts(seam):
            # More pixels show what a nearly blank overlap has.
            seam = evidence.closer((order[k], poses[k]), (order[k + 1], poses[k + 1]))
            seams[k] = seam
        if not limits.accepts(seam):
            found = (
                "no plausible motion" if seam is None else f"{seam.inliers} agreeing keypoints against {seam.rivals}"
            )
            raise StitchingError(
                f"seam {names[order[k]]} - {names[order[k + 1]]}: {found} of the best other shift; "
                f"{limits.min_features} and a margin of {limits.min_margin:g} are needed. "
                "The parts may not belong to one film, one may be missing or given twice, or the overlap is blank"
            )
    return _arrangement(order, poses, seams)


def _arrangement(order: Sequence[int], poses: Sequence[Pose], seams: Sequence[CoarseSeam | None]) -> Arrangement:
    sure = tuple(seam for seam in seams if seam is not None)
    return Arrangement(tuple(order), tuple(poses), sure, min(_margin(seam) for seam in sure))


def _margin(seam: CoarseSeam) -> float:
    return seam.inliers / max(seam.rivals, 1)


_Placed = tuple[int, Pose]
_Chain = tuple[_Placed, ...]
# Keypoints per part while all orders and poses are compared.
_SKETCH_KEYPOINTS = 3000


class _Evidence:
    """Keypoints and seams of parts in every pose, each computed when first asked for."""

    def __init__(
        self, parts: Sequence[ByteArray], *, pixel_mm: float, limits: SeamLimits, rng: np.random.Generator
    ) -> None:
        self._parts, self._pixel_mm, self._limits, self._rng = parts, pixel_mm, limits, rng
        self._factor = max(1, round(limits.feature_pixel_mm / pixel_mm))
        self._features: dict[tuple[int, Pose, int], Features] = {}
        self._seams: dict[_Chain, CoarseSeam | None] = {}
        self._sketches: dict[_Chain, CoarseSeam | None] = {}

    def features(self, index: int, pose: Pose, factor: int) -> Features:
        key = (index, pose, factor)
        if key not in self._features:
            if pose.turned:
                upright = self.features(index, Pose(False, pose.mirrored), factor)
                rows, columns = self._parts[index].shape
                self._features[key] = turned_features(upright, (rows, columns))
            else:
                self._features[key] = find_features(posed(self._parts[index], pose), factor=factor)
        return self._features[key]

    def seam(self, left: _Placed, right: _Placed) -> CoarseSeam | None:
        if (left, right) not in self._seams:
            self._seams[left, right] = self._match(left, right, self._factor)
        return self._seams[left, right]

    def sketch(self, left: _Placed, right: _Placed) -> CoarseSeam | None:
        """The seam from the strongest keypoints only."""
        if (left, right) not in self._sketches:
            self._sketches[left, right] = self._match(left, right, self._factor, _SKETCH_KEYPOINTS)
        return self._sketches[left, right]

    def closer(self, left: _Placed, right: _Placed) -> CoarseSeam | None:
        """The seam from keypoints of half the size, then of a quarter."""
        best = self.seam(left, right)
        factor = self._factor
        while factor > max(1, self._factor // 4):
            factor = max(1, factor // 2)
            finer = self._match(left, right, factor)
            if finer is not None and (best is None or finer.inliers > best.inliers):
                best = finer
            if self._limits.accepts(best):
                break
        return best

    def _match(self, left: _Placed, right: _Placed, factor: int, strongest: int | None = None) -> CoarseSeam | None:
        low, high = self._limits.overlap_mm
        return match_features(
            self.features(*left, factor).strongest(strongest),
            self.features(*right, factor).strongest(strongest),
            left_width_px=self._parts[left[0]].shape[1],
            overlap_px=(low / self._pixel_mm, high / self._pixel_mm),
            offset_px=self._limits.offset_mm / self._pixel_mm,
            gate_px=2.0 * factor,
            ratio=self._limits.ratio,
            rng=self._rng,
        )


def _best_chain(evidence: _Evidence, count: int) -> tuple[tuple[int, ...], tuple[Pose, ...]]:
    """Order and poses whose seams have most agreeing keypoints, as little changed as possible."""
    poses = [Pose(turned, mirrored) for mirrored in (False, True) for turned in (False, True)]
    totals: dict[_Chain, float] = {}
    for order in itertools.permutations(range(count)):
        for laid in itertools.product(poses, repeat=count):
            chain = tuple(zip(order, laid, strict=True))
            total = 0.0
            for left, right in itertools.pairwise(chain):
                seam = evidence.sketch(*min(_same((left, right))))
                total += 0.0 if seam is None else float(np.log1p(max(seam.inliers - seam.rivals, 0)))
            totals[chain] = total
    best = max(totals, key=lambda chain: totals[chain])
    chain = min(
        _same(best),
        key=lambda same: (sum(p.mirrored for _, p in same), sum(p.turned for _, p in same), [i for i, _ in same]),
    )
    return tuple(i for i, _ in chain), tuple(p for _, p in chain)


def _same(chain: _Chain) -> list[_Chain]:
    """The chains whose overlaps look alike: as it is, turned as a whole (back to front), mirrored as a whole, both."""
    turned = tuple((i, Pose(not p.turned, p.mirrored)) for i, p in reversed(chain))
    return [
        *(chain, turned),
        *(tuple((i, Pose(p.turned, not p.mirrored)) for i, p in same) for same in (chain, turned)),
    ]
