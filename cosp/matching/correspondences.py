"""Points of one image and where they lie in another one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosp.arrays import FloatArray


@dataclass(frozen=True)
class Correspondences:
    """Matched points of two images on one grid.

    Parameters
    ----------
    moving_rc, fixed_rc : (N, 2) arrays, px
        Row and column in either image.
    score : (N,) array
        Larger is better; between 0 and 1.
    sigma_px : (N,) array
        Standard deviation per coordinate, pixels of that grid.
    """

    moving_rc: FloatArray
    fixed_rc: FloatArray
    score: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        return len(self.score)

    @classmethod
    def joined(cls, parts: Sequence[Correspondences]) -> Correspondences:
        """All matches of several records, in their order; an empty record for none."""
        pairs = [p.moving_rc for p in parts], [p.fixed_rc for p in parts]
        moving, fixed = (np.concatenate([np.empty((0, 2)), *p]) for p in pairs)
        score = np.concatenate([np.empty(0), *(p.score for p in parts)])
        sigma = np.concatenate([np.empty(0), *(p.sigma_px for p in parts)])
        return cls(moving, fixed, score, sigma)
