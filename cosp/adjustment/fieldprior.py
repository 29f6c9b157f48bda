"""What is believed of film distortion before it is measured: a smooth Gaussian process, its length and size learned."""

from __future__ import annotations

import numpy as np

from cosp.arrays import FloatArray
from cosp.camera.field import FilmField

# Correlation across the film over that along it: distortion simulated at 60 by 40 mm explains published residuals.
WIDTH_OVER_LENGTH = 2.0 / 3.0
SMALLEST_MODE = 1e-4  # of the largest variance; smaller ones are left out: together a part in a thousand
# Distortion found on film is about a pixel and a half of 7 um; within a factor of three either way, two times in three.
EXPECTED_AMPLITUDE_MM = 0.01
AMPLITUDE_SPREAD = np.log(3.0)
AMPLITUDES_MM = np.geomspace(1e-4, 0.1, 61)


def modes(field: FilmField, length_mm: float) -> FloatArray:
    """Patterns of spline coefficients (splines, M) whose independent unit sums are the Gaussian process.

    The process has a standard deviation of 1 mm in the middle of the film and a squared exponential covariance,
    `length_mm` long and two thirds of it wide.

    References
    ----------
    [Rasmussen2006] section 4.3, "eigenfunction analysis of kernels".
    """
    parts = []
    for centres, length in zip(field.centres_mm(), (length_mm, length_mm * WIDTH_OVER_LENGTH), strict=True):
        covariance = np.exp(-0.5 * ((centres[:, None] - centres) / length) ** 2)
        values, vectors = np.linalg.eigh(covariance)
        parts.append((np.maximum(values[::-1], 0.0), vectors[:, ::-1]))
    (along, along_vectors), (across, across_vectors) = parts
    variance = np.kron(along, across)
    kept = np.flatnonzero(variance > SMALLEST_MODE * variance.max())
    patterns = np.kron(along_vectors, across_vectors)[:, kept] * np.sqrt(variance[kept])
    splines, values = field.basis(np.zeros((1, 2)))
    return np.asarray(patterns / np.linalg.norm(values[0] @ patterns[splines[0]]))


def log_evidence(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Logarithm of the marginal likelihood at each of `AMPLITUDES_MM`, up to a constant that all priors share.

    Parameters
    ----------
    normal : (M, M) array
        Normal matrix of the modes' weights, of mean zero and unit variance per mm of amplitude, with everything else
        eliminated and without their prior.
    right : (M,) array
        Its right-hand side.

    References
    ----------
    [Rasmussen2006] section 5.4.1.
    """
    information, vectors = np.linalg.eigh(normal)
    information = np.maximum(information, 0.0)
    explained = (vectors.T @ right) ** 2
    precision = 1.0 / AMPLITUDES_MM[:, None] ** 2
    fit = 0.5 * (explained / (information + precision)).sum(axis=1)
    freedom = 0.5 * np.log1p(information / precision).sum(axis=1)
    belief = 0.5 * (np.log(AMPLITUDES_MM / EXPECTED_AMPLITUDE_MM) / AMPLITUDE_SPREAD) ** 2
    return np.asarray(fit - freedom - belief)
