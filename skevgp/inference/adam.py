"""Adam for the noisy loss of mini-batches: when to slow down, when to stop, which point to keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .linalg import NotPositiveDefiniteError
from .optimize import Minimum, Objective, Report

_DECAY_FIRST, _DECAY_SECOND, _EPSILON = 0.9, 0.999, 1e-8
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
    """Adam (Kingma & Ba 2015, algorithm 1) with a step size that falls to zero along half a cosine.

    The cosine is meant to take ``max_iter`` steps. When the loss is found to fall no longer (its median over the
    last third of the steps is below that over the third before by less than ``tol``, or by less than its standard
    error), a last, shorter one takes over: from the present step size to zero, in as many steps as came before.

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
        ``x`` is the last point, if the loss stayed finite and did not end above earlier ones by more than chance.
        Otherwise, and when Ctrl-C ended the steps, it is the best of the points kept on the way, judged by the
        median loss of the steps before each.
    """
    x = np.clip(start, *bounds)
    minimum, best = Minimum(x, np.inf), _BestSoFar(x)
    first, second = np.zeros_like(x), np.zeros_like(x)
    since, until, highest, plateau = 0, max_iter, learning_rate, False
    try:
        while minimum.n_iter < until:
            loss, gradient = objective(x)
            if not (np.isfinite(loss) and np.isfinite(gradient).all()):
                break
            minimum.loss_curve.append(loss)
            best.see(x, loss)
            t = minimum.n_iter
            first += (1.0 - _DECAY_FIRST) * (gradient - first)
            second += (1.0 - _DECAY_SECOND) * (gradient**2 - second)
            step = 0.5 * highest * (1.0 + np.cos(np.pi * (t - 1 - since) / (until - since)))
            scale = np.sqrt(second / (1.0 - _DECAY_SECOND**t)) + _EPSILON
            x = np.clip(x - step / (1.0 - _DECAY_FIRST**t) * first / scale, *bounds)
            if report is not None:
                report(t, loss)
            if not plateau and t >= _FEWEST and t % _WINDOW == 0 and 2 * t < until:
                plateau = _is_plateau(np.array(minimum.loss_curve), tol)
                if plateau:
                    since, until, highest = t, 2 * t, step
        minimum.converged = minimum.n_iter == until and not best.is_above()
        if minimum.converged:
            minimum.x = x
            return minimum
    except NotPositiveDefiniteError:
        pass
    except KeyboardInterrupt:
        minimum.interrupted = True
    minimum.x = best.point()
    return minimum


@dataclass(frozen=True)
class _Typical:
    """The median of losses (a few steps that went too far do not move it), and the variance of that median."""

    value: float
    variance: float

    @classmethod
    def of(cls, losses: np.ndarray) -> _Typical:
        low, median, high = np.percentile(losses, [25.0, 50.0, 75.0])
        # As for a normal distribution, whose quartiles are 1.35 standard deviations apart.
        return cls(float(median), 0.5 * np.pi * ((high - low) / 1.35) ** 2 / len(losses))


def _is_plateau(losses: np.ndarray, tol: float) -> bool:
    """Whether the last third of the losses is no lower than the third before, up to ``tol`` and chance."""
    n = len(losses) // 3
    before, after = _Typical.of(losses[-2 * n : -n]), _Typical.of(losses[-n:])
    return before.value - after.value < max(tol, np.sqrt(before.variance + after.variance))


class _BestSoFar:
    """The point that ended the window of steps with the lowest median loss."""

    def __init__(self, start: np.ndarray):
        self._best_x, self._best = start, _Typical(np.inf, 0.0)
        self._last, self._current, self._window = self._best, start, list[float]()

    def see(self, x: np.ndarray, loss: float) -> None:
        self._current = x
        self._window.append(loss)
        if len(self._window) == _WINDOW:
            self._last = _Typical.of(np.array(self._window))
            if self._last.value < self._best.value:
                self._best_x, self._best = x, self._last
            self._window.clear()

    def point(self) -> np.ndarray:
        """The best point, which may belong to a window that has just begun."""
        begun = bool(self._window) and np.median(self._window) < self._best.value
        return self._current if begun else self._best_x

    def is_above(self) -> bool:
        """Whether the last whole window is above the best one by more than chance."""
        chance = 3.0 * np.sqrt(self._last.variance + self._best.variance)
        return bool(self._last.value - self._best.value > chance)
