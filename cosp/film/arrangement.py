"""Order, turn and mirror of the digitised parts, inferred from their overlaps."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cosp.arrays import ByteArray
from cosp.errors import StitchingError
from cosp.film.stitching import CoarseSeam, Features, find_features, match_features, match_patches, turned_features

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, order=True)
class Pose:
    """How a part has to be laid: mirrored top to bottom first, then turned by 180 degrees."""

    turned: bool = False
    mirrored: bool = False


_Placed = tuple[int, Pose]
_Chain = tuple[_Placed, ...]


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


def laid(
    parts: Mapping[str, ByteArray], *, order: Sequence[str], turned: Sequence[bool], mirrored: Sequence[bool]
) -> list[ByteArray]:
    """Parts by their names as they lie in the joined film, left to right, as `seams.json` says it."""
    poses = [Pose(*pose) for pose in zip(turned, mirrored, strict=True)]
    return [posed(parts[name], pose) for name, pose in zip(order, poses, strict=True)]


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
        Where two parts are the same picture, or a seam stays in doubt; the files are named, with what was found and
        what is needed.
    """
    for k, first in enumerate(parts):
        for j in range(k):
            if np.array_equal(first, parts[j]):
                raise StitchingError(f"{names[j]} and {names[k]} are the same picture; each part is needed once")
    if len(parts) == 1:
        return Arrangement((0,), (Pose(),), (), float("inf"))
    evidence = _Evidence(parts, pixel_mm=pixel_mm, limits=limits, rng=rng)
    plain = tuple((i, Pose()) for i in range(len(parts)))
    for chain in (plain, plain[::-1]):
        seams = evidence.seams(chain)
        doubtful = [seam for seam in seams if not limits.accepts(seam)]
        # One overlap may be nearly blank: more pixels show what it has.
        if len(doubtful) == 1 < len(seams):
            seams = evidence.closer_seams(chain)
        if all(limits.accepts(seam) for seam in seams):
            return _arrangement(chain, seams)
    _LOG.info("the order of the parts as given leaves a seam in doubt; comparing all orders, turns and mirrors")
    best: tuple[int, _Chain, list[CoarseSeam | None]] | None = None
    for chain in _best_chains(evidence, len(parts), slack=float(np.log1p(limits.min_features))):
        seams = evidence.closer_seams(chain)
        agreeing = min(seam.inliers if limits.accepts(seam) and seam is not None else -1 for seam in seams)
        if best is None or agreeing > best[0]:
            best = agreeing, chain, seams
    assert best is not None
    _, chain, seams = best
    for k, seam in enumerate(seams):
        if not limits.accepts(seam):
            found = "no shift that keypoints agree on"
            if seam is not None:
                found = f"{seam.inliers} agreeing keypoints against {seam.rivals} of the best other shift"
            raise StitchingError(
                f"seam {names[chain[k][0]]} - {names[chain[k + 1][0]]}: {found}; "
                f"{limits.min_features} and a margin of {limits.min_margin:g} are needed. "
                "The parts may not belong to one film, one may be missing or given twice, or the overlap is blank"
            )
    return _arrangement(chain, seams)


def _arrangement(chain: _Chain, seams: Sequence[CoarseSeam | None]) -> Arrangement:
    sure = tuple(seam for seam in seams if seam is not None)
    margin = min(_margin(seam) for seam in sure)
    return Arrangement(tuple(i for i, _ in chain), tuple(pose for _, pose in chain), sure, margin)


def _margin(seam: CoarseSeam) -> float:
    return seam.inliers / max(seam.rivals, 1)


# Keypoints per part while all orders and poses are compared.
_SKETCH_KEYPOINTS = 3000
# Side of a patch that looks for its place in the other part.
_PATCH_MM = 4.0
# Two pieces of film can be joined in eight ways.
_MOST_CHAINS = 12


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

    def seams(self, chain: _Chain) -> list[CoarseSeam | None]:
        """The seams of parts laid side by side."""
        return [self.seam(left, right) for left, right in itertools.pairwise(chain)]

    def closer_seams(self, chain: _Chain) -> list[CoarseSeam | None]:
        """The seams of parts laid side by side; one that is in doubt is looked at closer, two show a wrong chain."""
        seams = self.seams(chain)
        doubtful = [k for k, seam in enumerate(seams) if not self._limits.accepts(seam)]
        if len(doubtful) == 1:
            k = doubtful[0]
            seams[k] = self.closer(chain[k], chain[k + 1])
        return seams

    def sketch(self, left: _Placed, right: _Placed) -> CoarseSeam | None:
        """The seam from the strongest keypoints only."""
        if (left, right) not in self._sketches:
            self._sketches[left, right] = self._match(left, right, self._factor, _SKETCH_KEYPOINTS)
        return self._sketches[left, right]

    def closer(self, left: _Placed, right: _Placed) -> CoarseSeam | None:
        """The seam from keypoints of half the size, then of a quarter, then from patches all over the overlap."""
        best = self.seam(left, right)
        factor = self._factor
        while factor > max(1, self._factor // 4):
            factor = max(1, factor // 2)
            finer = self._match(left, right, factor)
            if finer is not None and (best is None or finer.inliers > best.inliers):
                best = finer
            if self._limits.accepts(best):
                return best
        low, high = self._limits.overlap_mm
        by_patches = match_patches(
            *(posed(self._parts[index], pose) for index, pose in (left, right)),
            factor=self._factor,
            patch_px=round(_PATCH_MM / self._pixel_mm),
            overlap_px=(low / self._pixel_mm, high / self._pixel_mm),
            offset_px=self._limits.offset_mm / self._pixel_mm,
            gate_px=2.0 * self._factor,
            rng=self._rng,
        )
        return by_patches if self._limits.accepts(by_patches) else best

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


def _best_chains(evidence: _Evidence, count: int, *, slack: float) -> list[_Chain]:
    """Chains whose seams have most agreeing keypoints, the best first, each as little changed as possible.

    A chain that lacks no more than `slack` of the best sum stays: where one overlap is nearly blank, the two pieces
    that it joins can lie in several ways. Of chains that look alike only one is returned.
    """
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
    enough = max(totals.values()) - slack
    kept: dict[_Chain, float] = {}
    for chain, total in totals.items():
        if total >= enough:
            kept[min(_same(chain), key=_changes)] = total
    return sorted(kept, key=lambda chain: -kept[chain])[:_MOST_CHAINS]


def _changes(chain: _Chain) -> tuple[int, int, list[int]]:
    """How much a chain changes: parts mirrored, parts turned, and their order."""
    return sum(p.mirrored for _, p in chain), sum(p.turned for _, p in chain), [i for i, _ in chain]


def _same(chain: _Chain) -> list[_Chain]:
    """The chains whose overlaps look alike: as it is, turned as a whole (back to front), mirrored as a whole, both."""
    turned = tuple((i, Pose(not p.turned, p.mirrored)) for i, p in reversed(chain))
    return [
        *(chain, turned),
        *(tuple((i, Pose(p.turned, not p.mirrored)) for i, p in same) for same in (chain, turned)),
    ]
