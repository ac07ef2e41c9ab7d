"""Adam: minimise the noisy loss of mini-batches."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import ClassVar, Literal

import numpy as np

from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from ..utils.validation import check_integer, check_real
from .base import Callback, MiniBatchSolver, Minimum, Objective
from .coordinates import Limits

_DECAY_FIRST, _DECAY_SECOND, _EPSILON = 0.9, 0.999, 1e-8
# Largest entry of a gradient. The square of a larger one overflows, after which no step moves.
_LARGEST = 1e150
# Number of steps between two tests for a plateau. Fewest steps before the last steps if the loss is flat up to the
# tolerance, and if it is flat up to chance, which more steps tell from slow progress.
_WINDOW, _FEWEST, _FEWEST_BY_CHANCE = 50, 600, 1500


class Adam(MiniBatchSolver):
    """Adam on mini-batches over all parameters, including those of the approximate posterior q, as in the paper.

    Parameters
    ----------
    batch_size : int, default=512
        Number of rows per step.
    learning_rate : float, default=0.1
        First step size.
    natural_gradient : bool, default=False
        Whether to move q by natural gradients (Hensman et al. 2013), which needs ``posterior="full"``. Adam then moves
        kernel, noise and inducing points only. For millions of rows, use ``Adam(batch_size=2000,
        natural_gradient=True)``.
    n_restarts : int, default=0
        Number of further fits from other starts, as in `LBFGS`.
    callback : callable, default=None
        Function ``callback(step, lower_bound, outputs)``, called once per step with the bound of a mini-batch. See
        `LBFGS`.
    schedule : {"cosine", "constant"}, default="cosine"
        Schedule of the step size. If ``"cosine"``, it falls to zero along half a cosine. If ``"constant"``, it falls in
        the last steps only.

    posterior : {"full", "diagonal"}, default="full"
        Covariance of the approximate posterior q. If ``"full"``, q is one joint Gaussian of inducing values and
        weights. If ``"diagonal"``, its covariance is diagonal, as in the paper.
    bound : {"titsias", "tight"}, default="titsias"
        Lower bound that is maximised, of Titsias (2009) or of Titsias (2025). At the same parameters the tight bound is
        at least as high, and predictions are the same. See :doc:`/guide/bounds`.
    tol : float or "auto", default="auto"
        Tolerance in nats. Adam begins its last steps when the median loss over a third of the steps changes by less. If
        ``"auto"``, 0.005 per row, and at least 0.1.
    max_time : float, default=None
        Number of seconds until steps end, as in `LBFGS`.

    Attributes
    ----------
    default_max_iter : int
        Number of steps for ``max_iter=None``.

    Notes
    -----
    See the user guide, :doc:`/guide/solvers`.

    References
    ----------
    - D. P. Kingma, J. Ba (2015): Adam: A Method for Stochastic Optimization.
    - J. Hensman, N. Fusi, N. D. Lawrence (2013): Gaussian Processes for Big Data.

    Examples
    --------
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.solvers import Adam
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = EVGPRegressor(n_inducing=10, solver=Adam(50), max_iter=100, noise_cv=None).fit(X, y)
    >>> model.get_params()["solver__batch_size"]
    50
    """

    default_max_iter: ClassVar[int] = 16_000

    def __init__(
        self,
        batch_size: int = 512,
        learning_rate: float = 0.1,
        natural_gradient: bool = False,
        n_restarts: int = 0,
        callback: Callback | None = None,
        schedule: Literal["cosine", "constant"] = "cosine",
        *,
        posterior: Literal["full", "diagonal"] = "full",
        bound: Literal["titsias", "tight"] = "titsias",
        tol: float | Literal["auto"] = "auto",
        max_time: float | None = None,
    ):
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.natural_gradient = natural_gradient
        self.n_restarts = n_restarts
        self.callback = callback
        self.schedule = schedule
        self.posterior = posterior
        self.bound = bound
        self.tol = tol
        self.max_time = max_time

    def check(self) -> None:
        """Raise an error if an option is out of range."""
        super().check()
        check_integer(self.batch_size, "batch_size of Adam", minimum=1)
        check_real(self.learning_rate, "learning_rate of Adam", minimum=0.0, strict=True)
        if self.schedule not in ("cosine", "constant"):
            raise ValueError(f'schedule of Adam must be "cosine" or "constant"; got {self.schedule!r}.')
        if not isinstance(self.natural_gradient, (bool, np.bool_)):
            raise TypeError(f"natural_gradient of Adam must be True or False; got {self.natural_gradient!r}.")
        if self.natural_gradient and self.posterior != "full":
            raise ValueError(f'natural_gradient=True of Adam needs posterior="full"; got posterior={self.posterior!r}.')

    def minimise(
        self,
        objective: Objective,
        start: np.ndarray,
        limits: Limits,
        max_iter: int,
        tol: float,
        monitor: Monitor,
        pace: Callable[[float], None] | None = None,
    ) -> Minimum:
        """Find a minimum with steps that become small at the end.

        Parameters
        ----------
        objective : callable
            Function x -> (loss, gradient). Each call uses the next mini-batch.
        start : ndarray of shape (size,)
            Start point.
        limits : tuple of ndarray of shape (size,)
            Lower and upper limits, to which steps are clipped.
        max_iter : int
            Maximum number of steps.
        tol : float
            Tolerance in units of the loss, below which a change counts as flat.
        monitor : Monitor
            Object that is notified of each step, and may end the steps.
        pace : callable, default=None
            Function ``pace(share)``, called before each step with its size as a share of the first.

        Returns
        -------
        minimum : Minimum
            Last point, loss of each step, and other points that may be better.
        """
        constant = self.schedule == "constant"
        return adam(objective, start, limits, max_iter, self.learning_rate, tol, monitor, pace, constant=constant)


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
    """Run Adam (Kingma & Ba 2015, algorithm 1) with a step size that falls to zero along half a cosine."""
    # The cosine is planned for max_iter steps (if steps are constant, there is none at first). When the loss stays
    # flat, a last, shorter cosine begins: from the present step size to zero, in as many steps as came before. The loss
    # is flat if its median over the last third of the steps differs from that over the third before by less than tol,
    # or by less than twice its standard error. Without mini-batches, losses have no such error, so that tol decides.
    # The loss stays flat if it was so throughout the last third of the steps. A loss that rises is a sign of steps that
    # are too large, not of convergence, so that the first cosine goes on.
    #
    # objective is called with the next mini-batch each time; pace(share) before each step with its size as a share of
    # the first; stop(x) after each step returns whether it was the last. The result has the last point. If the loss did
    # not stay finite or Ctrl-C ended the steps, it has the best point so far, by the median loss of the steps before
    # it; `others` has that point anyway.
    monitor = Monitor() if monitor is None else monitor
    x = np.clip(start, *limits)
    minimum, best = Minimum(x, np.inf), _BestSoFar(x)
    first, second = np.zeros_like(x), np.zeros_like(x)
    since, until, highest = 0, max_iter, 1.0
    plateaus = _Plateau(_FEWEST, tol, chance=False), _Plateau(_FEWEST_BY_CHANCE, tol, chance=True)
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
                losses = np.array(minimum.loss_curve)
                reached = [plateau.reached(losses) for plateau in plateaus]
                if any(reached) and 2 * t < until:
                    since, until, highest = t, 2 * t, share
            if stop is not None and stop(x):
                until = t
        minimum.converged = minimum.n_iter == until
    minimum.others = (best.point(),)
    minimum.x = x if minimum.converged else best.point()
    return minimum


def _median(losses: np.ndarray) -> tuple[float, float]:
    """The median of losses (a few steps that went too far do not move it), and the variance of that median."""
    low, median, high = np.percentile(losses, [25.0, 50.0, 75.0])
    # As for a normal distribution, whose quartiles are 1.35 standard deviations apart.
    return float(median), 0.5 * np.pi * ((high - low) / 1.35) ** 2 / len(losses)


def is_flat(losses: np.ndarray, tol: float, chance: bool = True) -> bool:
    """Whether the last third of the losses equals the third before, up to ``tol`` and chance."""
    n = len(losses) // 3
    if n == 0:
        return False
    (before, before_variance), (after, after_variance) = _median(losses[-2 * n : -n]), _median(losses[-n:])
    error = np.sqrt(before_variance + after_variance) if chance else 0.0
    return abs(before - after) < max(tol, 2.0 * error)


class _Plateau:
    """Whether losses are flat, and were so throughout the last third of at least ``fewest`` steps."""

    def __init__(self, fewest: int, tol: float, chance: bool):
        self._fewest, self._tol, self._chance, self._first = fewest, tol, chance, 0

    def reached(self, losses: np.ndarray) -> bool:
        t = len(losses)
        self._first = (self._first or t) if is_flat(losses, self._tol, chance=self._chance) else 0
        return self._first > 0 and t >= self._fewest and t - self._first >= t // 3


class _BestSoFar:
    """The last point of the window of steps with the lowest median loss."""

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
        """Return the best point, which may belong to a window that has just begun."""
        return self._better()[0]

    def _better(self) -> tuple[np.ndarray, float]:
        now = float(np.median(self._window)) if self._window else np.inf
        return (self._current, now) if now < self._loss else (self._x, self._loss)
