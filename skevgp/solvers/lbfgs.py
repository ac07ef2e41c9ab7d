"""L-BFGS: minimise a function of all rows, whose gradient is exact."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from ..utils.linalg import NotPositiveDefiniteError
from ..utils.monitor import Monitor
from ..utils.validation import check_integer
from .base import Callback, Guarded, Minimum, Objective, Point, Solver, Tolerance
from .coordinates import Coordinates, Limits, Metric, Pair, Scaled

# Relative size of a step that changes the loss by its rounding error only.
_HAIR = 1e-10
# Step between two gradients for the curvature, in the coordinates of a `ParameterTable`.
_STEP = 1e-3
# Limits of units. A unit is the size of a step over which the curvature hardly changes.
_SHORTEST, _LONGEST = 0.1, 100.0


@dataclass(frozen=True)
class Descent:
    """Options of L-BFGS."""

    memory: int = 100  # number of pairs of steps and gradients for the curvature
    gradient: float = 1e-9  # a start ends if no entry of the gradient is larger
    patience: int = 3  # number of iterations in a row with less gain than the tolerance that count as a stall
    probes: int = 3  # number of pairs of gradients for the units of the coordinates


class LBFGS(Solver):
    """L-BFGS on the lower bound, with the approximate posterior at its optimum. Use it for most fits.

    Parameters
    ----------
    n_restarts : int, default=0
        Number of further fits from random starts of inducing points, kernel and noise. The fit with the best bound is
        kept. Inducing points that ``inducing_init`` gives stay the same.
    callback : callable, default=None
        Function ``callback(iteration, lower_bound, outputs)``, called once per iteration. ``outputs`` are the columns
        of y that the bound belongs to. Raise StopIteration to end the fit with the best parameters so far. With few
        rows, the log prior of kernel and noise is added to the bound. See :doc:`/guide/few_rows`.

    posterior : {"full", "diagonal"}, default="full"
        Covariance of the approximate posterior q. If ``"full"``, q is one joint Gaussian of inducing values and
        weights. If ``"diagonal"``, its covariance is diagonal, as in the paper.
    bound : {"titsias", "tight"}, default="titsias"
        Lower bound that is maximised, of Titsias (2009) or of Titsias (2025). At the same parameters the tight bound is
        at least as high, and predictions are the same. See :doc:`/guide/bounds`.
    tol : float or "auto", default="auto"
        Tolerance in nats. L-BFGS restarts from its best point when three iterations in a row gain less, and stops when
        a restart gains no more. If ``"auto"``, 0.0015 % of the gain over features and noise alone, and at least 0.01.
        It is three times as much in a fit that continues from a sample, see :doc:`/guide/solvers`.
    max_time : float, default=None
        Number of seconds until iterations end. The best parameters so far are kept, with a ConvergenceWarning, and the
        calibration by ``noise_cv`` is skipped, as is the average over kernels of a fit to few rows. If None, there is
        no limit.
    max_inducing : int, default=1000
        Maximum number of inducing points of ``n_inducing="auto"``.

    Attributes
    ----------
    descent : Descent
        Options of the optimiser, which a subclass may change.
    default_max_iter : int
        Number of iterations for ``max_iter=None``.

    Notes
    -----
    See the user guide, :doc:`/guide/solvers`.

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
    descent: ClassVar[Descent] = Descent()

    def __init__(
        self,
        n_restarts: int = 0,
        callback: Callback | None = None,
        *,
        posterior: Literal["full", "diagonal"] = "full",
        bound: Literal["titsias", "tight"] = "titsias",
        tol: float | Literal["auto"] = "auto",
        max_time: float | None = None,
        max_inducing: int = 1000,
    ):
        self.n_restarts = n_restarts
        self.callback = callback
        self.posterior = posterior
        self.bound = bound
        self.tol = tol
        self.max_time = max_time
        self.max_inducing = max_inducing

    def check(self) -> None:
        """Raise an error if an option is out of range."""
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
        metric: Metric | None = None,
    ) -> Minimum:
        """Find a minimum by SciPy's L-BFGS-B, started again from the best point when it stalls.

        Parameters
        ----------
        objective : callable
            Function x -> (loss, gradient). It may raise `NotPositiveDefiniteError` or return NaN away from the start.
        start : ndarray of shape (size,)
            Start point.
        limits : tuple of ndarray of shape (size,)
            Lower and upper limits.
        max_iter : int
            Maximum number of iterations over all starts.
        tolerance : Tolerance
            Tolerance of the loss. A start ends when ``descent.patience`` iterations in a row gain less. The solver ends
            when a whole start gains no more, or when the loss next to the best point is worse by more.
        monitor : Monitor
            Object that is notified of each iteration, and may end the iterations.
        curvature : tuple, default=None
            Function like ``objective``, whose curvature at the start gives the scale of steps, and an integer for each
            coordinate. Coordinates with the same integer have the same scale. If None, x is not scaled.
        metric : Metric, default=None
            Curvature of a similar function near the start. The first start moves along it. The search ends when an
            iteration gains less than the tolerance, and a Newton step promises less.

        Returns
        -------
        minimum : Minimum
            Best point, its loss and the loss of each iteration.
        """
        guarded, minimum = Guarded(objective, start), Minimum(start, np.inf)
        pairs: deque[Pair] = deque(() if metric is None else metric.pairs, maxlen=self.descent.memory)
        coordinates: Coordinates = Scaled(np.ones(len(start)), limits)
        stalled, at = 0, Point(start, np.inf, np.zeros(len(start)))

        def seen(intermediate_result: OptimizeResult) -> None:
            # The loss of the iterate. A point of the line search may have a lower one by chance.
            nonlocal stalled, at
            loss, curve = float(intermediate_result.fun), minimum.loss_curve
            before = curve[-1] if curve else np.inf
            curve.append(loss)
            enough = tolerance.at(loss)
            monitor.iteration(len(curve), loss)
            here = guarded.at(intermediate_result.x)
            pairs.append((here.x - at.x, here.gradient - at.gradient))
            at = here
            stalled = stalled + 1 if before - loss < enough else 0
            minimum.converged = stalled > 0 and coordinates.promised(at.x, at.gradient) < enough
            if stalled >= self.descent.patience or minimum.converged:
                raise StopIteration

        with monitor.keeping_the_best():
            at = guarded.at(start)
            # Without coordinates or iterations the start is the result.
            minimum.converged = len(start) == 0 or max_iter == 0
            x, rng = start, np.random.RandomState(0)
            for number in range(max_iter):  # at most: a start whose first line search fails has no iteration
                if minimum.converged or minimum.n_iter >= max_iter:
                    break
                before, stalled = guarded.loss, 0
                if curvature is not None:
                    function, alike = curvature
                    here = at.gradient if function is objective and np.array_equal(at.x, x) else None
                    unit = curvature_units(function, x, alike, self.descent.probes, here)
                    coordinates = Scaled(unit, limits)
                    if number == 0 and metric is not None:
                        coordinates = metric.coordinates(unit, limits, at.x, at.gradient)
                guarded.coordinates = coordinates
                at = guarded.at(coordinates.of(x))
                if number > 0 and at.loss - before > tolerance.at(before):
                    # A hair away, the loss is worse by more than the tolerance, because of the rounding errors or the
                    # jitter of a covariance almost without noise. Another start would gain by chance only.
                    minimum.converged = True
                    break
                left = max_iter - minimum.n_iter
                result = minimize(
                    guarded,
                    coordinates.of(x),
                    jac=True,
                    method="L-BFGS-B",
                    bounds=coordinates.bounds,
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
                # It stalled, or a line search failed. Either it has converged, or its memory is misleading.
                enough = tolerance.at(guarded.loss)
                ended = isinstance(coordinates, Scaled) or coordinates.promised(at.x, at.gradient) < enough
                if ended and not before - guarded.loss > enough:
                    minimum.converged = bool(np.isfinite(guarded.loss))
                    break
                # Start slightly away, because the loss of the best of all points is low by a rounding error too.
                reach = _HAIR * np.maximum(np.abs(guarded.x), 1.0)
                x = np.clip(guarded.x + reach * rng.randn(len(x)), *limits)
        minimum.x, minimum.loss = guarded.x, guarded.loss
        minimum.metric = Metric(tuple(pairs), guarded.x)
        return minimum


def curvature_units(
    objective: Objective, x: np.ndarray, alike: np.ndarray, n_probes: int, here: np.ndarray | None = None
) -> np.ndarray:
    """Return a step size for each coordinate, 1 / √|∂²loss/∂x²|, averaged over equal integers in ``alike``.

    ``here`` is the gradient at x if it is known.
    """
    try:
        here = objective(x)[1] if here is None else here
        along_axes = curvature_along_axes(lambda x: objective(x)[1], x, here, n_probes, np.random.RandomState(0))
    except NotPositiveDefiniteError:
        return np.ones(len(x))
    kinds, kind = np.unique(alike, return_inverse=True)
    if len(kinds) == 0 or not np.isfinite(along_axes).all():
        return np.ones(len(x))
    curvature = np.bincount(kind, along_axes) / np.bincount(kind)
    return np.clip(1.0 / np.sqrt(np.maximum(curvature, _LONGEST**-2)), _SHORTEST, _LONGEST)[kind]


def curvature_along_axes(
    gradient: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    here: np.ndarray,
    n_probes: int,
    rng: np.random.RandomState,
) -> np.ndarray:
    """Estimate |∂²loss/∂x²| of each coordinate from differences of gradients."""
    # The diagonal of the Hessian from differences of gradients along random signs v: the mean of
    # v (∇(x + εv) - ∇(x)) / ε (Bekas, Kokiopoulou & Saad 2007, "An estimator for the diagonal of a matrix"). Entries
    # off the diagonal add to its size by chance.
    total = np.zeros(len(x))
    for _ in range(n_probes):
        signs = rng.choice([-1.0, 1.0], len(x))
        there = gradient(x + _STEP * signs)
        with np.errstate(invalid="ignore"):
            total += signs * (there - here) / _STEP
    return np.abs(total) / n_probes
