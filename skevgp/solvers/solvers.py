"""What finds a model's parameters, with the options that only it understands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from ..fitting.advice import how_it_ended
from ..fitting.rules import LOWEST_NOISE_EXACT, Rules
from ..fitting.sparse import SparseTask
from ..fitting.strategy import Attempt, Fit
from ..model.objectives import ElboObjective
from ..model.parameters import ParameterTable
from ..model.predictor import CoefficientPrior
from ..utils.linalg import NotPositiveDefiniteError
from ..utils.state import StatefulEstimator
from ..utils.validation import check_integer, check_real
from .adam import adam
from .curvature import curvature_units
from .lbfgs import DESCENT, Descent, Tolerance, lbfgs
from .minimum import Minimum, Objective

__all__ = ["LBFGS", "Adam"]

# Relative size of the rounding errors in a bound on all rows.
_ROUNDING = 1e-8
# An iteration that gains less, in nats in all, does not matter.
_LEAST_TOL = 0.01
# Length of the natural gradients' steps for q: the first, and the least.
_NATURAL_RATES = 0.3, 0.02

Callback = Callable[[int, float, Sequence[int]], object]


class LBFGS(StatefulEstimator):
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

    Attributes
    ----------
    rules : Rules
        From where fits start; a subclass may have others.
    descent : Descent
        The numbers of the optimiser; likewise.
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
    rules: ClassVar[Rules] = Rules(
        first_noise=1e-4,
        lowest_noise_exact=LOWEST_NOISE_EXACT,
        other_starts=((0.5, 1.0), (2.0, 100.0), (1.0, 1e3)),
        much_noise=1e3,
        stage=25,
        sample=(1000, 20),
    )
    descent: ClassVar[Descent] = DESCENT

    def __init__(self, n_restarts: int = 0, callback: Callback | None = None):
        self.n_restarts = n_restarts
        self.callback = callback

    def check(self, posterior: str) -> None:
        """Refuse options out of their range.

        Parameters
        ----------
        posterior : {"full", "diagonal"}
            What the solver is to be used with.
        """
        _check_common(self)

    def objective(self, task: SparseTask, table: ParameterTable, n_rows: int | None = None) -> Objective:
        """Make what is minimised; a subclass may look at each evaluation.

        Parameters
        ----------
        task : SparseTask
            The model and its rows.
        table : ParameterTable
            Its parameters.
        n_rows : int, default=None
            Of the sample that is fitted; None means all rows.

        Returns
        -------
        objective : callable
            x -> (minus the bound per row, its gradient).
        """
        return task.objective(table, n_rows)

    def run(self, task: SparseTask, attempt: Attempt) -> Fit:
        """Go from one start; called by the fit.

        Parameters
        ----------
        task : SparseTask
            What is fitted.
        attempt : Attempt
            The start.

        Returns
        -------
        fit : Fit
            Where it ended.
        """
        table = task.table.started_at(attempt.values)
        spent, n_rows = len(attempt.loss_curve), task.rows.total
        rows = "all rows" if attempt.n_rows is None else f"{attempt.n_rows:,} of {len(task.rows):,} rows"
        if task.placement.max_inducing is not None:
            rows = f"{task.n_inducing} points, {rows}"
        minimum = lbfgs(
            self.objective(task, table, attempt.n_rows),
            table.start(),
            table.limits(),
            attempt.until - spent,
            self._tolerance(task, attempt),
            task.monitor.seen_as(spent, n_rows, about=rows),
            self.descent,
            None if attempt.cold else self._units(task, table),
        )
        return Fit(
            table.values(minimum.x),
            -n_rows * minimum.loss,
            attempt.loss_curve + [n_rows * loss for loss in minimum.loss_curve],
            minimum.converged,
            how_it_ended(minimum, spent + minimum.n_iter, task.max_iter, task.tol),
            n_rows=attempt.n_rows,
        )

    def _tolerance(self, task: SparseTask, attempt: Attempt) -> Tolerance:
        n_rows = task.rows.total
        if task.tol is not None and attempt.n_rows is None:
            return Tolerance(task.tol / n_rows)
        return Tolerance(_LEAST_TOL / n_rows, self.descent.enough, -task.alone / n_rows)

    def _units(self, task: SparseTask, table: ParameterTable) -> Callable[[np.ndarray], np.ndarray]:
        """From the curvature on the smallest sample, or on the rows that are fitted."""
        objective = task.objective(table, task.samples[0] if task.samples else None)
        return lambda x: curvature_units(objective, x, table.alike(), self.descent.probes)


class Adam(StatefulEstimator):
    """The paper's solver: Adam on mini-batches, over all parameters, those of q among them.

    Parameters
    ----------
    batch_size : int, default=512
        Rows per step.
    learning_rate : float, default=0.1
        The first step size.
    natural_gradient : bool, default=False
        Only with ``posterior="full"``: whether q moves by natural gradients (Hensman et al. 2013), the last one on all
        rows, so that Adam is left with kernel, noise and inducing points. For a million rows this is the fastest way to
        a good bound: ``Adam(batch_size=2000, natural_gradient=True)`` with ``max_iter=20000``, 40 epochs.
    n_restarts : int, default=0
        As of `LBFGS`.
    callback : callable, default=None
        callback(step, lower_bound, outputs), once per step, with a mini-batch's estimate; as of `LBFGS`.
    schedule : {"cosine", "constant"}, default="cosine"
        Whether steps fall to zero along half a cosine, over ``max_iter`` steps or over the last ones, or stay as they
        are until the bound does, and only the last ones fall.

    Attributes
    ----------
    rules : Rules
        From where fits start; a subclass may have others.
    default_max_iter : int
        What ``max_iter=None`` means.

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
    >>> model = EVGPRegressor(n_inducing=10, solver=Adam(50), max_iter=500, noise_cv=None).fit(X, y)
    >>> model.get_params()["solver__batch_size"]
    50
    """

    default_max_iter: ClassVar[int] = 16_000
    # Its steps do not grow with the gradient: the noise starts nearer to the data's scatter, and points stay.
    rules: ClassVar[Rules] = Rules(first_noise=1e-2, widest_signal=None, last_start=False)

    def __init__(
        self,
        batch_size: int = 512,
        learning_rate: float = 0.1,
        natural_gradient: bool = False,
        n_restarts: int = 0,
        callback: Callback | None = None,
        schedule: Literal["cosine", "constant"] = "cosine",
    ):
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.natural_gradient = natural_gradient
        self.n_restarts = n_restarts
        self.callback = callback
        self.schedule = schedule

    def check(self, posterior: str) -> None:
        """Refuse options out of their range, or that do not go with the posterior.

        Parameters
        ----------
        posterior : {"full", "diagonal"}
            What the solver is to be used with.
        """
        _check_common(self)
        check_integer(self.batch_size, "batch_size of Adam", minimum=1)
        check_real(self.learning_rate, "learning_rate of Adam", minimum=0.0, strict=True)
        if self.schedule not in ("cosine", "constant"):
            raise ValueError(f'schedule of Adam must be "cosine" or "constant"; got {self.schedule!r}.')
        if not isinstance(self.natural_gradient, (bool, np.bool_)):
            raise TypeError(f"natural_gradient of Adam must be True or False; got {self.natural_gradient!r}.")
        if self.natural_gradient and posterior != "full":
            raise ValueError(f'natural_gradient=True of Adam needs posterior="full"; got posterior={posterior!r}.')

    def run(self, task: SparseTask, attempt: Attempt) -> Fit:
        """Go from one start; called by the fit.

        Parameters
        ----------
        task : SparseTask
            What is fitted.
        attempt : Attempt
            The start.

        Returns
        -------
        fit : Fit
            Where it ended.
        """
        n_rows, table = task.rows.total, task.table.started_at(attempt.values)
        tol = _LEAST_TOL if task.tol is None else task.tol
        elbo = ElboObjective(task.model, table, task.blocks, _NATURAL_RATES if self.natural_gradient else None)
        start = elbo.table.start()
        minimum = adam(
            elbo.minibatch(task.rows.batches(task.model.kernel, self.batch_size, task.rng)),
            start,
            elbo.table.limits(),
            attempt.until,
            self.learning_rate,
            tol / n_rows,
            task.monitor.seen_as(factor=n_rows),
            elbo.pace,
            constant=self.schedule == "constant",
        )
        # A mini-batch's loss does not tell which point is best: the bound on all rows does.
        x, (bound, predictor) = start, elbo.solution(start)
        first, reached = bound, bound if minimum.n_iter == 0 else -np.inf
        for other in (*minimum.others, minimum.x) if minimum.n_iter > 0 else ():
            try:
                solution = elbo.solution(other)
            except NotPositiveDefiniteError:
                continue
            reached = max(reached, solution[0])
            if solution[0] >= bound:
                x, (bound, predictor) = other, solution
        values = elbo.table.values(x)
        fell = not reached >= first - max(tol, _ROUNDING * abs(first))
        return Fit(
            {name: values[name] for name in attempt.values},
            bound,
            [n_rows * loss for loss in minimum.loss_curve],
            minimum.converged,
            self._how_it_ended(minimum, fell),
            predictor,
        )

    def _how_it_ended(self, minimum: Minimum, fell: bool) -> str:
        if not minimum.converged:
            return (
                f"Adam diverged after {minimum.n_iter} steps; the best parameters so far are kept. Lower learning_rate "
                f"(now {self.learning_rate}), or raise batch_size (now {self.batch_size})."
            )
        if fell:
            return (
                f"Adam ended with a bound below the first after all its {minimum.n_iter} steps; the best parameters "
                "are kept. Raise max_iter (steps become small only towards the end) or batch_size, or lower "
                f"learning_rate (now {self.learning_rate})."
            )
        return ""


# What the strings of ``solver=`` stand for.
SOLVERS: dict[str, type[LBFGS] | type[Adam]] = {"lbfgs": LBFGS, "adam": Adam}


def _check_common(solver: LBFGS | Adam) -> None:
    name = type(solver).__name__
    check_integer(solver.n_restarts, f"n_restarts of {name}", minimum=0)
    if solver.callback is not None and not callable(solver.callback):
        raise TypeError(f"callback of {name} must be None or a function; got {solver.callback!r}.")


def resolved(solver: Any, posterior: str) -> LBFGS | Adam:
    """The solver that ``solver=`` names or is, its options checked.

    Parameters
    ----------
    solver : str, LBFGS or Adam
    posterior : {"full", "diagonal"}

    Returns
    -------
    solver : LBFGS or Adam

    Raises
    ------
    ValueError, TypeError
        If it is none, or an option is out of its range.
    """
    if isinstance(solver, str) and solver in SOLVERS:
        return SOLVERS[solver]()
    kinds = tuple(SOLVERS.values())
    if not isinstance(solver, kinds):
        names = ", ".join(f'"{name}"' for name in SOLVERS)
        objects = ", ".join(f"skevgp.solvers.{kind.__name__}(...)" for kind in kinds)
        raise ValueError(f"solver must be one of {names}, {objects}; got {solver!r}.")
    solver.check(posterior)
    return solver


def check_weights(
    solver: LBFGS | Adam, posterior: str, prior: CoefficientPrior, sharing: Any, per_output: bool
) -> None:
    """Refuse what moves or restricts q in coordinates that correlated or shared weights, or split rows, do not have."""
    if isinstance(solver, Adam) and per_output and isinstance(sharing, str) and sharing == "kernel":
        raise ValueError(
            'sharing="kernel" of outputs with rows of their own needs solver="lbfgs" or an LBFGS(...); got '
            f"solver={solver!r}."
        )
    told = "share_coef=True" if prior.shared else "a covariance of the weights (coef_cov)"
    if prior.root is None and not prior.shared:
        return
    if isinstance(solver, Adam):
        raise ValueError(f'{told} needs solver="lbfgs" or an LBFGS(...); got solver={solver!r}.')
    if posterior == "diagonal":
        raise ValueError(f'{told} needs posterior="full"; got posterior={posterior!r}.')
