"""Robust least squares by graduated non-convexity, for any set of linearised equations."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from cosp.arrays import FloatArray, IntArray
from cosp.errors import CospError
from cosp.geometry.robust import geman_mcclure_weights, huber_weights

logger = logging.getLogger(__name__)

# Shape of the graduated non-convexity, found by trials with 50 to 70 % of gross errors: coarser steps lose starts.
START_SIGMA = 300.0
END_SIGMA = 3.0
COOLING = 1.6
HUBER_SIGMA = 2.0
GEMAN_MCCLURE_SCALE = 0.9  # weighted rms of normal residuals of unit scale under the last weights
WORST_SCALE = 3.0  # how many times worse than its sigmas a film may be
DAMPING_START, DAMPING_END = 1e-3, 1e-13


@dataclass(frozen=True)
class Equations:
    """Observation equations that share their unknowns, whitened: every residual has standard deviation one.

    Parameters
    ----------
    columns : (U,) array of int
        Which unknowns.
    residuals : (M, K) array
        Observed minus computed; the K residuals of a row share one robust weight. NaN rows count for nothing.
    jacobian : (M, K, U) array
        Derivatives of the computed values.
    """

    columns: IntArray
    residuals: FloatArray
    jacobian: FloatArray


@dataclass(frozen=True)
class Solution:
    """Where the iteration ended.

    Parameters
    ----------
    unknowns : (U,) array
    weights : list of (M,) arrays
        Robust weight of every row of every group; 0 marks a gross error.
    equations : list of Equations
        At the solution.
    normal : (U, U) array
        Normal matrix with the prior, at the final weights.
    cost : float
        Weighted sum of squares with the prior's share.
    iterations : int
    """

    unknowns: FloatArray
    weights: list[FloatArray]
    equations: list[Equations]
    normal: FloatArray
    cost: float
    iterations: int


def minimise(
    linearise: Callable[[FloatArray], list[Equations]],
    start: FloatArray,
    prior_information: FloatArray,
    *,
    gate_sigma: float,
    prior_mean: FloatArray | None = None,
    start_sigma: float = START_SIGMA,
    iterations: int = 100,
) -> Solution:
    """Robust solution of a set of equations with a Gaussian prior.

    Geman-McClure weights whose width shrinks step by step find the points that agree; then Huber's weights on
    these alone give the solution. Columns are scaled to unit diagonal. The damping is relative to that diagonal and
    decays to nothing: a fixed one would leave tens of pixels in what the data hardly tell apart.

    Parameters
    ----------
    linearise : function
        Equations at given unknowns, always the same groups of the same size.
    start : (U,) array
    prior_information : (U, U) array
        Inverse covariance of the prior.
    gate_sigma : float
        Rows beyond this many standard deviations (times the scale found, if larger than one) are gross errors.
    prior_mean : (U,) array
        `start` if left out.
    start_sigma : float
        First width of the weights; what most rows are off at the start, if that is more, is taken instead.
    iterations : int
        Limit of each of the two phases.

    Raises
    ------
    CospError
        If the normal matrix cannot be solved.

    References
    ----------
    [Yang2020] section III; docs/conventions.md, "Priors".
    """
    prior_mean = start if prior_mean is None else prior_mean
    equations = linearise(start)
    state = _State(linearise, start, equations, prior_information, prior_mean)

    convexity = max(start_sigma, 2.0 * float(np.median(_sizes(equations)))) ** 2
    weights = [geman_mcclure_weights(size, convexity) for size in map(_size, equations)]
    end = END_SIGMA**2
    count = 0
    for _ in range(iterations):
        state.step(_finite(weights))
        count += 1
        narrow = convexity <= end
        if narrow and state.settled(1e-3):
            break
        if narrow:
            # Film that is worse than its sigmas say must not lose its good points. Only now: while the weights are
            # still wide, gross errors would speak here too.
            scale = _scale(state.equations, weights) / GEMAN_MCCLURE_SCALE
            end = (END_SIGMA * float(np.clip(scale, 1.0, WORST_SCALE))) ** 2
        convexity = max(convexity / COOLING, end)
        weights = [geman_mcclure_weights(size, convexity) for size in map(_size, state.equations)]

    for _ in range(iterations):
        weights = _final_weights(state.equations, weights, gate_sigma)
        state.step(_finite(weights))
        count += 1
        if state.settled(1e-4):
            break
    weights = _finite(_final_weights(state.equations, weights, gate_sigma))
    normal, _, cost = state.assemble(state.unknowns, state.equations, weights)
    logger.info("adjusted %d unknowns in %d iterations", len(start), count)
    return Solution(state.unknowns, weights, state.equations, normal, cost, count)


def _size(equations: Equations) -> FloatArray:
    """Length of each row's residual per degree of freedom, (M,)."""
    return np.asarray(np.sqrt(np.mean(equations.residuals**2, axis=1)))


def _sizes(equations: list[Equations]) -> FloatArray:
    sizes = np.concatenate([_size(group) for group in equations])
    return np.asarray(sizes[np.isfinite(sizes)])


def _finite(weights: list[FloatArray]) -> list[FloatArray]:
    return [np.nan_to_num(weight, nan=0.0) for weight in weights]


def _scale(equations: list[Equations], weights: list[FloatArray]) -> float:
    """Weighted rms of the whitened residuals: one where the sigmas are right."""
    square = count = 0.0
    for group, weight in zip(equations, _finite(weights), strict=True):
        square += float(np.nansum(weight * _size(group) ** 2))
        count += float(weight.sum())
    return float(np.sqrt(square / count)) if count else 1.0


def _final_weights(equations: list[Equations], weights: list[FloatArray], gate_sigma: float) -> list[FloatArray]:
    """Huber's weights inside the gate, nothing outside; a scale per group of equations."""
    final = []
    for group, weight in zip(equations, weights, strict=True):
        size = _size(group)
        scale = max(1.0, _scale([group], [weight]))
        final.append(np.where(size <= gate_sigma * scale, huber_weights(size / scale, HUBER_SIGMA), 0.0))
    return final


class _State:
    """Unknowns, their equations and the damping, moved one step at a time."""

    def __init__(
        self,
        linearise: Callable[[FloatArray], list[Equations]],
        unknowns: FloatArray,
        equations: list[Equations],
        prior_information: FloatArray,
        prior_mean: FloatArray,
    ) -> None:
        self.linearise = linearise
        self.unknowns = unknowns
        self.equations = equations
        self.prior_information = prior_information
        self.prior_mean = prior_mean
        self.damping = DAMPING_START
        self.change = np.inf

    def assemble(
        self, unknowns: FloatArray, equations: list[Equations], weights: list[FloatArray]
    ) -> tuple[FloatArray, FloatArray, float]:
        """Normal matrix, right-hand side and cost."""
        away = self.prior_mean - unknowns
        normal = self.prior_information.copy()
        right = self.prior_information @ away
        cost = float(away @ right)
        for group, weight in zip(equations, weights, strict=True):
            use = weight > 0
            width = len(group.columns)
            jacobian = group.jacobian[use].reshape(-1, width)
            residual = group.residuals[use].ravel()
            weighted = np.repeat(weight[use], group.residuals.shape[1])
            scaled = jacobian * weighted[:, None]
            normal[np.ix_(group.columns, group.columns)] += scaled.T @ jacobian
            right[group.columns] += scaled.T @ residual
            cost += float(weighted @ residual**2)
        return normal, right, cost

    def step(self, weights: list[FloatArray]) -> None:
        """One damped Gauss-Newton step at fixed weights, retried with more damping until the cost falls."""
        normal, right, cost = self.assemble(self.unknowns, self.equations, weights)
        scale: FloatArray = 1.0 / np.sqrt(np.diag(normal))
        scaled = normal * scale[:, None] * scale
        for _ in range(12):
            try:
                factor = cho_factor(scaled + self.damping * np.eye(len(scale)))
            except LinAlgError:
                self.damping = max(self.damping * 10.0, 1e-12)
                continue
            step = scale * cho_solve(factor, scale * right)
            unknowns = self.unknowns + step
            equations = self.linearise(unknowns)
            # A row that the step throws out of view is no gain.
            lost = any(
                (np.isnan(_size(new)) & (weight > 0)).sum() > 0.5 * (weight > 0).sum()
                for new, weight in zip(equations, weights, strict=True)
            )
            kept = [
                np.where(np.isfinite(_size(new)), weight, 0.0) for new, weight in zip(equations, weights, strict=True)
            ]
            new_cost = self.assemble(unknowns, equations, kept)[2]
            if not lost and new_cost <= cost * (1.0 + 1e-12):
                # In standard deviations of the unknowns, whatever their correlation.
                self.change = float(np.sqrt(max(float(step @ normal @ step), 0.0)))
                self.unknowns, self.equations = unknowns, equations
                self.damping = max(self.damping / 10.0, DAMPING_END)
                return
            self.damping = max(self.damping * 10.0, 1e-12)
            if self.damping > 1e6:
                break
        # Nothing near is better: the minimum at these weights.
        if not np.isfinite(cost):
            raise CospError("the normal equations of the adjustment cannot be solved")
        self.change = 0.0
        self.damping = DAMPING_START

    def settled(self, limit: float) -> bool:
        """Whether the last step moved less than this many standard deviations."""
        return self.change < limit
