"""L-BFGS: minimise a function of all rows, whose gradient is exact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from ..utils.validation import check_integer
from .base import Callback, Limits, Minimum, Objective, Solver

# In units of the best loss's size plus one: what is so far above it is out of the way.
_FAR = 10.0
# Relative size of a step that changes the loss by its rounding error only.
_HAIR = 1e-10
# Of a step between two gradients, in the coordinates of a `ParameterTable`.
_STEP = 1e-3
# A unit is the size of a step while the curvature stays what it is, and no longer.
_SHORTEST, _LONGEST = 0.1, 100.0


@dataclass(frozen=True)
class Descent:
    """The numbers of L-BFGS."""

    # Pairs of steps and gradients from which the curvature is known.
    memory: int = 100
    # Where no gradient is larger, a line search has nowhere to go.
    gradient: float = 1e-9
    # So many iterations in a row that gain less than the tolerance are a stall.
    patience: int = 3
    # Pairs of gradients from which the units of the coordinates are estimated.
    probes: int = 8


@dataclass(frozen=True)
class Tolerance:
    """What an iteration has to gain: ``least``, or a ``share`` of what is gained already over a loss ``origin``."""

    least: float
    share: float = 0.0
    origin: float = 0.0

    def at(self, loss: float) -> float:
        """In units of the loss, where that is so much."""
        return max(self.least, self.share * (self.origin - loss)) if np.isfinite(loss) else self.least


class LBFGS(Solver):
    """L-BFGS on the bound with q at its optimum: the solver that serves most fits best.

    Parameters
    ----------
    n_restarts : int, default=0
        Further fits from other starts, of which the one with the best bound is kept: other inducing points (unless
        ``inducing_init`` gives them) and, within their bounds, kernel and noise drawn log-uniformly around the first
        start. Each takes the time of a fit.
    callback : callable, default=None
        callback(iteration, lower_bound, outputs), once per iteration; on a sample of the rows the bound is that of the
        sample, times the number of rows over its size. ``outputs`` are the columns of y that the bound is of, a range
        or, of a group with gaps, a tuple: where outputs share nothing, each has fits of its own, and with groups each
        group. A StopIteration or KeyboardInterrupt that it raises ends the fit with the best parameters so far, as
        Ctrl-C does. ``clone`` copies a callable object, and leaves a function what it is.

    posterior : {"full", "diagonal"}, default="full"
        q as one joint Gaussian of inducing values and weights, or the paper's, diagonal in both.
    tol : float or "auto", default="auto"
        Tolerance in nats. L-BFGS starts again from its best point when each of three iterations in a row raises the
        bound by less, and stops when a fresh start gains no more. ``"auto"`` is 0.0015 % of what the fit has gained
        over features and noise alone, and at least 0.01.
    max_time : float, default=None
        Seconds until iterations end, for each independent model when its share is over. The best parameters so far are
        kept, with a ConvergenceWarning, and calibration by ``noise_cv`` is left out. Finding groups of outputs
        (``sharing="auto"``) takes at most half of the time. Passes over the rows before and after the iterations are
        not cut short.
    max_inducing : int, default=1000
        Maximum number of inducing points of ``n_inducing="auto"``.

    Attributes
    ----------
    descent : Descent
        The numbers of the optimiser. A subclass may have others.
    default_max_iter : int
        What ``max_iter=None`` means.

    Examples
    --------
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> from skevgp.solvers import LBFGS
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> bounds = []
    >>> solver = LBFGS(callback=lambda iteration, bound, outputs: bounds.append(bound))
    >>> model = EVGPRegressor(n_inducing=10, solver=solver, random_state=0).fit(X, y)
    >>> len(bounds) >= model.n_iter_
    True
    """

    default_max_iter: ClassVar[int] = 1000
    stochastic: ClassVar[bool] = False
    descent: ClassVar[Descent] = Descent()

    def __init__(
        self,
        n_restarts: int = 0,
        callback: Callback | None = None,
        *,
        posterior: Literal["full", "diagonal"] = "full",
        tol: float | Literal["auto"] = "auto",
        max_time: float | None = None,
        max_inducing: int = 1000,
    ):
        self.n_restarts = n_restarts
        self.callback = callback
        self.posterior = posterior
        self.tol = tol
        self.max_time = max_time
        self.max_inducing = max_inducing

    def check(self) -> None:
        """Refuse options that are out of range."""
        super().check()
        check_integer(self.max_inducing, "max_inducing of LBFGS", minimum=1)

    def minimise(
        self,
        objective: Objective,
        start: np.ndarray,
        limits: Limits,
        max_iter: int,
        tolerance: Tolerance,
        monitor: Monitor,
        curvature: tuple[Objective, np.ndarray] | None = None,
    ) -> Minimum:
        """Find a minimum by SciPy's L-BFGS-B, started again from the best point when it stalls.

        Parameters
        ----------
        objective : callable
            x -> (loss, gradient). It may raise `NotPositiveDefiniteError` or return NaN away from the start.
        start : ndarray of shape (size,)
            Where to start.
        limits : tuple of ndarray of shape (size,)
            Lower and upper limits.
        max_iter : int
            The most iterations in all.
        tolerance : Tolerance
            A start ends when each of ``descent.patience`` iterations in a row gains less. The solver ends when a whole
            start gains no more.
        monitor : Monitor
            It is told of each iteration, and may end them.
        curvature : tuple, default=None
            A function as ``objective``, by whose curvature at the start steps are scaled, and an integer for each
            coordinate, equal for those that share a scale. None leaves the scale of x.

        Returns
        -------
        minimum : Minimum
            The best point, its loss and the loss of each iteration.
        """
        guarded, minimum = _Guarded(objective, start), Minimum(start, np.inf)
        stalled = 0

        def seen(intermediate_result: OptimizeResult) -> None:
            # The iterate's own loss: a probe of a line search may have seen a better one by chance.
            nonlocal stalled
            loss, curve = float(intermediate_result.fun), minimum.loss_curve
            before = curve[-1] if curve else np.inf
            curve.append(loss)
            enough = tolerance.at(loss)
            monitor.iteration(len(curve), loss)
            stalled = stalled + 1 if before - loss < enough else 0
            if stalled >= self.descent.patience:
                raise StopIteration

        with monitor.keeping_the_best():
            guarded(start)
            # Nothing to move, or asked not to: the start is the answer.
            minimum.converged = len(start) == 0 or max_iter == 0
            x, rng = start, np.random.RandomState(0)
            for _ in range(max_iter):  # a start whose first line search fails has no iteration
                if minimum.converged or minimum.n_iter >= max_iter:
                    break
                before, stalled = guarded.loss, 0
                if curvature is not None:
                    guarded.unit = curvature_units(curvature[0], x, curvature[1], self.descent.probes)
                left = max_iter - minimum.n_iter
                result = minimize(
                    guarded,
                    x / guarded.unit,
                    jac=True,
                    method="L-BFGS-B",
                    bounds=np.column_stack([limit / guarded.unit for limit in limits]),
                    callback=seen,
                    options={
                        "maxiter": left,
                        "maxfun": 20 * left + 100,
                        "ftol": 0.0,
                        "gtol": self.descent.gradient,
                        "maxcor": self.descent.memory,
                    },
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


def curvature_units(objective: Objective, x: np.ndarray, alike: np.ndarray, n_probes: int) -> np.ndarray:
    """Size of a step along each coordinate, 1 / √|∂²loss/∂x²|; equal integers in ``alike`` share one, of their mean."""
    # The diagonal of the Hessian from differences of gradients along random signs v: the mean of
    # v (∇(x + εv) - ∇(x)) / ε (Bekas, Kokiopoulou & Saad 2007, "An estimator for the diagonal of a matrix"). The other
    # entries add to it by chance, which makes the units smaller and never larger.
    rng, total = np.random.RandomState(0), np.zeros(len(x))
    try:
        here = objective(x)[1]
        for _ in range(n_probes):
            signs = rng.choice([-1.0, 1.0], len(x))
            there = objective(x + _STEP * signs)[1]
            with np.errstate(invalid="ignore"):
                total += signs * (there - here) / _STEP
    except NotPositiveDefiniteError:
        return np.ones(len(x))
    kinds, kind = np.unique(alike, return_inverse=True)
    if len(kinds) == 0 or not np.isfinite(total).all():
        return np.ones(len(x))
    curvature = np.bincount(kind, np.abs(total) / n_probes) / np.bincount(kind)
    return np.clip(1.0 / np.sqrt(np.maximum(curvature, _LONGEST**-2)), _SHORTEST, _LONGEST)[kind]
