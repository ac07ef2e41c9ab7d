"""Adam for the noisy loss of mini-batches: when to slow down, when to stop, which point to keep."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from .minimum import Limits, Minimum, Objective

_DECAY_FIRST, _DECAY_SECOND, _EPSILON = 0.9, 0.999, 1e-8
# Of a gradient: the square of a larger one overflows, and no step moves after that.
_LARGEST = 1e150
# A plateau is looked for this often, and not before so many steps.
_WINDOW, _FEWEST = 50, 1500


def adam(
    objective: Objective,
    start: np.ndarray,
    limits: Limits,
    max_iter: int,
    learning_rate: float,
    tol: float = 0.0,
    monitor: Monitor | None = None,
    pace: Callable[[float], None] | None = None,
    stop: Callable[[np.ndarray], bool] | None = None,
    constant: bool = False,
) -> Minimum:
    """Adam (Kingma & Ba 2015, algorithm 1) with a step size that falls to zero along half a cosine.

    The cosine is meant to take ``max_iter`` steps (if steps are to be constant, there is none at first). When the loss
    stays flat, a last, shorter one takes over: from the present step size to zero, in as many steps as came before. The
    loss is flat where its median over the last third of the steps differs from that over the third before by less than
    ``tol``, or by less than twice its standard error; it stays flat if it was so throughout the last third of the
    steps. (A loss that rises is no sign of convergence, but of steps that are too large: the cosine goes on.)

    Parameters
    ----------
    objective : callable
        x -> (loss, gradient), of the next mini-batch at each call.
    start, limits
        As in `lbfgs`; steps are clipped to the limits.
    max_iter : int
        The most steps.
    learning_rate : float
        The first step size.
    tol : float, default=0.0
        In units of the loss.
    monitor : Monitor, default=None
        Told of each step.
    pace : callable, default=None
        pace(share), before each step: its size as a share of the first.
    stop : callable, default=None
        stop(x), after each step: whether it was the last.
    constant : bool, default=False
        Whether the step size stays as it is until the loss stays flat.

    Returns
    -------
    minimum : Minimum
        ``x`` is the last point, or, if the loss did not stay finite or Ctrl-C ended the steps, the best point kept on
        the way, judged by the median loss of the steps before it; ``others`` has that point anyway.
    """
    monitor = Monitor() if monitor is None else monitor
    x = np.clip(start, *limits)
    minimum, best = Minimum(x, np.inf), _BestSoFar(x)
    first, second = np.zeros_like(x), np.zeros_like(x)
    since, until, highest, flat_from = 0, max_iter, 1.0, 0
    with monitor.keeping_the_best(), suppress(NotPositiveDefiniteError):
        while minimum.n_iter < until:
            share = highest
            if since > 0 or not constant:
                share *= 0.5 * (1.0 + np.cos(np.pi * (minimum.n_iter - since) / (until - since)))
            if pace is not None:
                pace(share)
            loss, gradient = objective(x)
            if not (np.isfinite(loss) and np.abs(gradient).max(initial=0.0) <= _LARGEST):  # False if there is a NaN
                break
            minimum.loss_curve.append(loss)
            best.see(x, loss)
            t = minimum.n_iter
            first += (1.0 - _DECAY_FIRST) * (gradient - first)
            second += (1.0 - _DECAY_SECOND) * (gradient**2 - second)
            scale = np.sqrt(second / (1.0 - _DECAY_SECOND**t)) + _EPSILON
            x = np.clip(x - learning_rate * share / (1.0 - _DECAY_FIRST**t) * first / scale, *limits)
            monitor.iteration(t, loss)
            if t % _WINDOW == 0 and t >= 3 * _WINDOW:
                flat_from = (flat_from or t) if is_flat(np.array(minimum.loss_curve), tol) else 0
                if flat_from > 0 and t >= _FEWEST and t - flat_from >= t // 3 and 2 * t < until:
                    since, until, highest = t, 2 * t, share
            if stop is not None and stop(x):
                until = t
        minimum.converged = minimum.n_iter == until
    minimum.others = (best.point(),)
    minimum.x = x if minimum.converged else best.point()
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


def is_flat(losses: np.ndarray, tol: float) -> bool:
    """Whether the last third of the losses is like the third before, up to ``tol`` and chance."""
    n = len(losses) // 3
    if n == 0:
        return False
    before, after = _Typical.of(losses[-2 * n : -n]), _Typical.of(losses[-n:])
    return abs(before.value - after.value) < max(tol, 2.0 * np.sqrt(before.variance + after.variance))


class _BestSoFar:
    """The point that ended the window of steps with the lowest median loss."""

    def __init__(self, start: np.ndarray):
        self._x, self._loss = start, np.inf
        self._current, self._window = start, list[float]()

    def see(self, x: np.ndarray, loss: float) -> None:
        self._current = x
        self._window.append(loss)
        if len(self._window) == _WINDOW:
            self._x, self._loss = self._better()
            self._window.clear()

    def point(self) -> np.ndarray:
        """The best point, which may belong to a window that has just begun."""
        return self._better()[0]

    def _better(self) -> tuple[np.ndarray, float]:
        now = float(np.median(self._window)) if self._window else np.inf
        return (self._current, now) if now < self._loss else (self._x, self._loss)
