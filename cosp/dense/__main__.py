"""Compile what dense matching needs, so that no job has to: `python -m cosp.dense`."""

from __future__ import annotations

import numpy as np

from cosp.dense.coarse_to_fine import match

if __name__ == "__main__":
    noise = np.random.default_rng(0).integers(1, 256, (120, 200), dtype=np.uint8)
    noise[:20] = 0  # what only film edges need, too
    match(
        noise,
        noise,
        (-20, 20),
        small_step=24,
        large_step=64,
        least_texture_sd=2.0,
        saturated_from=250,
        least_correlation=0.35,
        least_uniqueness=0.25,
        largest_speckle_px=100,
        speckle_step_px=1.5,
        threads=1,
    )
