"""SIFT features as a baseline behind the same protocol."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cosp.arrays import FloatArray
from cosp.imaging.contrast import percentile_stretch
from cosp.matching.correspondences import Correspondences

# Spread of a SIFT position, in pixels of the image it was found in [Lowe2004, section 4 and common practice].
_SIGMA_PX = 0.5


@dataclass(frozen=True)
class SiftMatcher:
    """SIFT features with ratio test and cross-check, kept where the shift between both images is small.

    Parameters
    ----------
    search_px : int
        Largest shift between the images, in each direction.
    max_ratio : float
        Largest ratio of the distance of the nearest descriptor to that of the second nearest.
    max_features : int
        Features kept per image, the strongest first.
    """

    search_px: int
    max_ratio: float
    max_features: int

    def match(self, moving: FloatArray, fixed: FloatArray, points_rc: FloatArray, *, threads: int) -> Correspondences:
        """Features that both images share; where is up to the features, not to `points_rc`."""
        del points_rc, threads
        detector = cv2.SIFT.create(nfeatures=self.max_features)
        found = [
            detector.detectAndCompute(percentile_stretch(image), np.isfinite(image).astype(np.uint8))
            for image in (moving, fixed)
        ]
        (keys_a, descriptors_a), (keys_b, descriptors_b) = found
        if min(len(keys_a), len(keys_b)) < 2:
            return Correspondences.joined([])
        matcher = cv2.BFMatcher(cv2.NORM_L2)
        forward = matcher.knnMatch(descriptors_a, descriptors_b, k=2)
        backward = {m.queryIdx: m.trainIdx for m in matcher.match(descriptors_b, descriptors_a)}
        good = [
            (m.queryIdx, m.trainIdx, 1 - m.distance / max(n.distance, 1e-6))
            for m, n in forward
            if m.distance < self.max_ratio * n.distance and backward.get(m.trainIdx) == m.queryIdx
        ]
        if not good:
            return Correspondences.joined([])
        a = np.array([keys_a[i].pt[::-1] for i, _, _ in good], float)
        b = np.array([keys_b[j].pt[::-1] for _, j, _ in good], float)
        near = np.abs(a - b).max(axis=1) <= self.search_px
        score = np.array([s for _, _, s in good], float)[near]
        return Correspondences(a[near], b[near], score, np.full(len(score), _SIGMA_PX))
