"""How good matches are, told by how well neighbours agree."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from cosp.arrays import FloatArray

# Pairs whose templates share more than this say little: their common error is most of it.
_MOST_SHARED = 0.6
# Fewer pairs do not make a median worth trusting.
_LEAST_PAIRS = 100
# Points looked at: enough for a median good to a per cent.
_MOST_POINTS = 5000
_FACTOR_LIMITS = (0.1, 4.0)


def sigma_factor(
    film_mm: FloatArray, residuals_mm: FloatArray, sigma_mm: FloatArray, template_mm: float
) -> float | None:
    """Ratio of the spread of matches to the standard deviations stated for them; None where too few lie close together.

    The residuals of two matches less than a template apart differ by the errors of the matches alone: camera, film,
    reference and elevation model are the same for both. Where the templates overlap by a share s of their area, that
    share of the variance is common, so that the difference has the variance 2 sigma^2 (1 - s). The median keeps single
    errors out of it.

    Parameters
    ----------
    film_mm, residuals_mm : (N, 2) arrays
        Film points, and measured less predicted ones.
    sigma_mm : (N,) array
        Stated standard deviations per coordinate.
    template_mm : float
        Side of the templates on the film.
    """
    step = math.ceil(len(film_mm) / _MOST_POINTS) if len(film_mm) else 1
    film_mm, residuals_mm, sigma_mm = film_mm[::step], residuals_mm[::step], sigma_mm[::step]
    if len(film_mm) < 2:
        return None
    first, second = cKDTree(film_mm).query_pairs(math.sqrt(2) * template_mm, output_type="ndarray").T
    apart = np.abs(film_mm[first] - film_mm[second]) / template_mm
    common = np.clip(1 - apart, 0, 1).prod(axis=1)
    used = common < _MOST_SHARED
    if used.sum() < _LEAST_PAIRS:
        return None
    first, second = first[used], second[used]
    spread = np.sqrt((sigma_mm[first] ** 2 + sigma_mm[second] ** 2) * (1 - common[used]))
    ratio = 1.4826 * np.median(np.abs(residuals_mm[first] - residuals_mm[second]) / spread[:, None])
    return float(np.clip(ratio, *_FACTOR_LIMITS))
