"""Adam for the noisy loss of mini-batches: when to slow down, when to stop, which point to keep."""

from __future__ import annotations

import numpy as np

from .linalg import NotPositiveDefiniteError
from .optimize import Minimum, Objective, Report

_DECAY_FIRST, _DECAY_SECOND, _EPSILON = 0.9, 0.999, 1e-8
# The last part of the steps, in which their size falls to zero.
_ANNEALED = 1.0 / 3.0
# A plateau is looked for this often, and not before so many steps.
_WINDOW, _FEWEST = 50, 600


def adam(
    objective: Objective,
    start: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    max_iter: int,
    learning_rate: float,
    tol: float = 0.0,
    report: Report | None = None,
) -> Minimum:
    """Adam (Kingma & Ba 2015, algorithm 1), its step size constant at first, then falling to zero along half a cosine.

    The fall begins after two thirds of ``max_iter``, or when the loss no longer falls: when the mean over the last
    third of the steps is below that over the third before by less than ``tol`` or by less than its standard error. It
    takes half as many steps as came before.

    Parameters
    ----------
    objective : callable
        x -> (loss, gradient), of the next mini-batch at each call.
    start, bounds
        As in `optimize.lbfgs`; steps are clipped to the bounds.
    max_iter : int
        The most steps.
    learning_rate : float
        The first step size.
    tol : float, default=0.0
        In units of the loss.
    report : callable, default=None
        report(iteration, loss), once per step.

    Returns
    -------
    minimum : Minimum
        ``x`` is the last point, whose steps were small, if the loss stayed finite. Otherwise (the loss or its gradient
        was not finite, or Ctrl-C ended the steps) it is the best of the points kept so far, judged by the mean loss of
        the steps before each.
    """
    x = np.clip(start, *bounds)
    minimum, best = Minimum(x, np.inf), _BestSoFar(x)
    first, second = np.zeros_like(x), np.zeros_like(x)
    total = max_iter
    slow_from = max_iter - int(_ANNEALED * max_iter)
    try:
        while minimum.n_iter < total:
            loss, gradient = objective(x)
            if not (np.isfinite(loss) and np.isfinite(gradient).all()):
                break
            minimum.loss_curve.append(loss)
            best.see(x, loss)
            t = minimum.n_iter
            first += (1.0 - _DECAY_FIRST) * (gradient - first)
            second += (1.0 - _DECAY_SECOND) * (gradient**2 - second)
            step = learning_rate / (1.0 - _DECAY_FIRST**t)
            if t > slow_from:
                step *= 0.5 * (1.0 + np.cos(np.pi * (t - slow_from) / (total - slow_from)))
            x = x - step * first / (np.sqrt(second / (1.0 - _DECAY_SECOND**t)) + _EPSILON)
            x = np.clip(x, *bounds)
            if report is not None:
                report(t, loss)
            if _FEWEST <= t < slow_from and t % _WINDOW == 0 and _is_plateau(np.array(minimum.loss_curve), tol):
                slow_from, total = t, t + int(t * _ANNEALED / (1.0 - _ANNEALED))
        else:
            minimum.x, minimum.converged = x, True
            return minimum
    except NotPositiveDefiniteError:
        pass
    except KeyboardInterrupt:
        minimum.interrupted = True
    minimum.x = best.point()
    return minimum


def _is_plateau(losses: np.ndarray, tol: float) -> bool:
    """Whether the last third of the losses is no lower than the third before, up to ``tol`` and chance."""
    n = len(losses) // 3
    before, after = losses[-2 * n : -n], losses[-n:]
    standard_error = np.sqrt((before.var() + after.var()) / n)
    return bool(before.mean() - after.mean() < max(tol, standard_error))


class _BestSoFar:
    """The point that ends the window of steps with the lowest mean loss."""

    def __init__(self, start: np.ndarray):
        self._x, self._loss = start, np.inf
        self._current, self._sum, self._count = start, 0.0, 0

    def see(self, x: np.ndarray, loss: float) -> None:
        self._current, self._sum, self._count = x, self._sum + loss, self._count + 1
        if self._count == _WINDOW:
            self._x, self._loss = self._better()
            self._sum, self._count = 0.0, 0

    def point(self) -> np.ndarray:
        return self._better()[0]

    def _better(self) -> tuple[np.ndarray, float]:
        if self._count > 0 and self._sum / self._count < self._loss:
            return self._current, self._sum / self._count
        return self._x, self._loss
