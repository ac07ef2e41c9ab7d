"""Minimise f(θ) -> (value, gradient) of all rows: L-BFGS. (Mini-batches: `adam`.)"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
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
    enough : float
        The tolerance where the user gives none, as a share of what the fit has gained over features and noise alone.
    probes : int
        Pairs of gradients from which the curvature is estimated.
    """

    memory: int = 100
    gradient: float = 1e-9
    patience: int = 3
    enough: float = 1.5e-5
    probes: int = 8


DESCENT = Descent()


@dataclass(frozen=True)
class Tolerance:
    """What an iteration has to gain: so much, or that share of what is gained already.

    Attributes
    ----------
    least : float
        In units of the loss.
    share : float
        Of the difference to ``origin``.
    origin : float
        The loss of doing nothing.
    """

    least: float
    share: float = 0.0
    origin: float = 0.0

    def at(self, loss: float) -> float:
        """In units of the loss, where that is so much."""
        return max(self.least, self.share * (self.origin - loss)) if np.isfinite(loss) else self.least


class _Guarded:
    """An objective that never raises and never returns NaN, and remembers the best point it has seen.

    A line search that stepped too far interpolates back. It takes forever from a loss of 1e10, or ends within rounding
    errors of where it began: losses far above the best are told on a logarithmic scale, with the gradient to match.

    It is asked in coordinates x / ``unit``, and has the objective's x itself.
    """

    def __init__(self, objective: Objective, start: np.ndarray):
        self._objective = objective
        self.x, self.loss, self.unit = start.copy(), np.inf, np.ones(len(start))

    def __call__(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        x = z * self.unit
        try:
            # What overflows is far off, and told from what does not by its loss.
            with np.errstate(over="ignore", invalid="ignore"):
                loss, gradient = self._objective(x)
                gradient = gradient * self.unit
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


class _Watch:
    """Writes down the losses of iterations, tells the monitor, and ends what stalls."""

    def __init__(self, minimum: Minimum, tolerance: Tolerance, patience: int, monitor: Monitor):
        self._minimum, self._monitor = minimum, monitor
        self._tolerance, self._patience = tolerance, patience
        self._stalled = 0

    def iteration(self, intermediate_result: OptimizeResult) -> None:
        # The iterate's own loss: a probe of a line search may have seen a better one by chance.
        loss, curve = float(intermediate_result.fun), self._minimum.loss_curve
        before = curve[-1] if curve else np.inf
        curve.append(loss)
        self._monitor.iteration(len(curve), loss)
        self._stalled = self._stalled + 1 if before - loss < self._tolerance.at(loss) else 0
        if self._stalled >= self._patience:
            raise StopIteration


def lbfgs(
    objective: Objective,
    start: np.ndarray,
    limits: Limits,
    max_iter: int,
    tol: float | Tolerance,
    monitor: Monitor | None = None,
    descent: Descent = DESCENT,
    units: Callable[[np.ndarray], np.ndarray] | None = None,
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
    tol : float or Tolerance
        Start anew when each of ``descent.patience`` iterations in a row lowers the loss by less than this, or a line
        search fails; stop when a start lowers it by no more.
    monitor : Monitor, default=None
    descent : Descent, default=Descent()
    units : callable, optional
        x -> the size (size,) of a step along each coordinate; asked at each start.

    Returns
    -------
    minimum : Minimum
    """
    guarded, minimum = _Guarded(objective, start), Minimum(start, np.inf)
    monitor = Monitor() if monitor is None else monitor
    tolerance = tol if isinstance(tol, Tolerance) else Tolerance(tol)
    with monitor.keeping_the_best():
        guarded(start)
        # Nothing to move, or asked not to: the start is the answer.
        minimum.converged = len(start) == 0 or max_iter == 0
        x, rng = start, np.random.RandomState(0)
        for _ in range(max_iter):  # a start whose first line search fails has no iteration
            if minimum.converged or minimum.n_iter >= max_iter:
                break
            before = guarded.loss
            if units is not None:
                guarded.unit = units(x)
            watch = _Watch(minimum, tolerance, descent.patience, monitor)
            left = max_iter - minimum.n_iter
            ends = {"maxiter": left, "maxfun": 20 * left + 100, "ftol": 0.0, "gtol": descent.gradient}
            box = np.column_stack([limit / guarded.unit for limit in limits])
            result = minimize(
                guarded,
                x / guarded.unit,
                jac=True,
                method="L-BFGS-B",
                bounds=box,
                callback=watch.iteration,
                options=ends | {"maxcor": descent.memory},
            )
            if result.status == 1:
                break
            # It stalled, or a line search failed: either it is done, or its memory led it astray.
            if not before - guarded.loss > tolerance.at(guarded.loss):
                minimum.converged = bool(np.isfinite(guarded.loss))
                break
            # A hair away, where the loss is not what rounding made of it at the best of all points.
            reach = _HAIR * np.maximum(np.abs(guarded.x), 1.0)
            x = np.clip(guarded.x + reach * rng.randn(len(x)), *limits)
    minimum.x, minimum.loss = guarded.x, guarded.loss
    return minimum
