"""Minimise f(θ) -> (value, gradient) of all rows: L-BFGS. (Mini-batches: `adam`.)"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from .._linalg import NotPositiveDefiniteError
from .._progress import Monitor
from .minimum import Limits, Minimum, Objective

# In units of the best loss's size plus one: what is so far above it is out of the way.
_FAR = 10.0
# Relative size of a step that changes the loss by its rounding error only.
_HAIR = 1e-10


@dataclass(frozen=True)
class Descent:
    """The numbers of L-BFGS.

    Attributes
    ----------
    memory : int
        Pairs of steps and gradients from which the curvature is known.
    gradient : float
        Where no gradient is larger, a line search has nowhere to go.
    patience : int
        So many iterations in a row that gain less than the tolerance are a stall.
    """

    memory: int = 30
    gradient: float = 1e-9
    patience: int = 3


DESCENT = Descent()


class _Guarded:
    """An objective that never raises and never returns NaN, and remembers the best point it has seen.

    A line search that stepped too far interpolates back. It takes forever from a loss of 1e10, or ends within rounding
    errors of where it began: losses far above the best are told on a logarithmic scale, with the gradient to match.
    """

    def __init__(self, objective: Objective, start: np.ndarray):
        self._objective = objective
        self.x, self.loss = start.copy(), np.inf

    def __call__(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        try:
            loss, gradient = self._objective(x)
        except NotPositiveDefiniteError:
            loss, gradient = np.nan, np.full_like(x, np.nan)
        far = _FAR * (1.0 + abs(self.loss))
        if not (np.isfinite(loss) and np.isfinite(gradient).all()):
            return (self.loss + far if np.isfinite(far) else 1e100), np.zeros_like(x)
        if loss < self.loss:
            self.x, self.loss = x.copy(), loss
        ratio = (loss - self.loss) / far
        if ratio > 1.0:
            return self.loss + far * (1.0 + np.log(ratio)), gradient / ratio
        return loss, gradient


def lbfgs(
    objective: Objective,
    start: np.ndarray,
    limits: Limits,
    max_iter: int,
    tol: float,
    monitor: Monitor | None = None,
    descent: Descent = DESCENT,
) -> Minimum:
    """L-BFGS-B (SciPy), started anew from the best point when it stalls or a line search fails.

    Parameters
    ----------
    objective : callable
        x -> (loss, gradient); may raise `NotPositiveDefiniteError` or return NaN away from the start.
    start : ndarray of shape (size,)
    limits : (lower, upper), each of shape (size,)
    max_iter : int
        Iterations in all.
    tol : float
        Start anew when each of ``descent.patience`` iterations in a row lowers the loss by less than this, or a line
        search fails; stop when a start lowers it by no more.
    monitor : Monitor, default=None
    descent : Descent, default=Descent()

    Returns
    -------
    minimum : Minimum
    """
    monitor = Monitor() if monitor is None else monitor
    guarded = _Guarded(objective, start)
    minimum = Minimum(start, np.inf)
    stalled = 0

    def callback(intermediate_result: OptimizeResult) -> None:
        # The iterate's own loss: a probe of a line search may have seen a better one by chance.
        nonlocal stalled
        loss = float(intermediate_result.fun)
        before = minimum.loss_curve[-1] if minimum.loss_curve else np.inf
        minimum.loss_curve.append(loss)
        monitor.iteration(minimum.n_iter, loss)
        stalled = stalled + 1 if before - loss < tol else 0
        if stalled >= descent.patience:
            raise StopIteration

    with monitor.keeping_the_best():
        guarded(start)
        # Nothing to move, or asked not to: the start is the answer.
        minimum.converged = len(start) == 0 or max_iter == 0
        x, rng = start, np.random.RandomState(0)
        for _ in range(max_iter):  # a start whose first line search fails has no iteration
            if minimum.converged or minimum.n_iter >= max_iter:
                break
            remaining, before, stalled = max_iter - minimum.n_iter, guarded.loss, 0
            result = minimize(
                guarded,
                x,
                jac=True,
                method="L-BFGS-B",
                bounds=np.column_stack(limits),
                callback=callback,
                options={
                    "maxiter": remaining,
                    "maxfun": 20 * remaining + 100,
                    "maxcor": descent.memory,
                    "ftol": 0.0,
                    "gtol": descent.gradient,
                },
            )
            if result.status == 1:
                break
            # It stalled, or a line search failed: either it is done, or its memory led it astray.
            if not before - guarded.loss > tol:
                minimum.converged = bool(np.isfinite(guarded.loss))
                break
            # A hair away, where the loss is not what rounding made of it at the best of all points.
            reach = _HAIR * np.maximum(np.abs(guarded.x), 1.0)
            x = np.clip(guarded.x + reach * rng.randn(len(x)), *limits)
    minimum.x, minimum.loss = guarded.x, guarded.loss
    return minimum
