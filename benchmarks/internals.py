"""What the benchmarks reach for inside skevgp: all of it is here, so that a change inside is one change here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from skevgp import EVGPRegressor
from skevgp.data.threads import BlockMap
from skevgp.fitting.sparse import SparseTask
from skevgp.fitting.strategy import Attempt, Fit
from skevgp.model.objectives import ElboObjective
from skevgp.model.parameters import ParameterTable
from skevgp.solvers import LBFGS, Adam
from skevgp.solvers.adam import adam
from skevgp.solvers.minimum import Minimum, Objective
from skevgp.utils.linalg import Jitter


def _task(n: int, m: int, d: int, n_outputs: int, solver: type[LBFGS] | type[Adam], **options: Any) -> SparseTask:
    """What the solver of a fit to random rows is given.

    Inducing points are drawn as the rows are, however few these may be: the cost does not depend on where they lie.
    """
    rng, given = np.random.RandomState(0), []
    X = rng.randn(n, d)
    Y = np.sin(X @ rng.randn(d, n_outputs)) + 0.01 * rng.randn(n, n_outputs)

    class Given(solver):  # type: ignore[misc, valid-type]
        def run(self, task: SparseTask, attempt: Any) -> Any:
            given.append(task)
            return super().run(task, attempt)

    EVGPRegressor(inducing_init=rng.randn(m, d), solver=Given(), max_iter=0, **options).fit(X, Y)
    return given[0]


@contextmanager
def evaluation(
    n: int, m: int, d: int, n_outputs: int, cores: int, sharing: Literal["all", "kernel"] = "all"
) -> Iterator[Callable[[], tuple[float, np.ndarray]]]:
    """Gives () -> the bound and its gradient in all parameters, of all outputs, on random rows, where a fit starts."""
    task, threads = _task(n, m, d, n_outputs, LBFGS, sharing=sharing), BlockMap(cores)
    task = replace(task, rows=replace(task.rows, threads=threads))
    objective, start = LBFGS().objective(task, task.table), task.table.start()
    try:
        yield lambda: objective(start)
    finally:
        threads.close()


def adam_step(n: int, m: int, d: int, n_outputs: int, batch_size: int) -> Callable[[], Minimum]:
    """Make () -> one step of Adam in the paper's setting, over all parameters, on random rows."""
    task = _task(n, m, d, n_outputs, Adam, sharing="kernel", posterior="diagonal")
    elbo = ElboObjective(task.model, task.table, task.blocks)
    objective = elbo.minibatch(task.rows.batches(task.model.kernel, batch_size, np.random.RandomState(0)))
    start, limits = elbo.table.start(), elbo.table.limits()
    return lambda: adam(objective, start, limits, max_iter=1, learning_rate=0.1)


class TimedLBFGS(LBFGS):
    """L-BFGS that writes down the seconds of each evaluation of the bound."""

    def __init__(self, n_restarts: int = 0, callback: object = None):
        super().__init__(n_restarts, callback)
        self.seconds_: list[float] = []

    def objective(self, task: SparseTask, table: ParameterTable, n_rows: int | None = None) -> Objective:
        evaluate = super().objective(task, table, n_rows)

        def timed(flat: np.ndarray) -> tuple[float, np.ndarray]:
            start = time.perf_counter()
            result = evaluate(flat)
            self.seconds_.append(time.perf_counter() - start)
            return result

        return timed


def with_jitter(jitter: float) -> LBFGS:
    """L-BFGS on models whose k(X_m, X_m) gets this jitter, relative to the signal variance."""
    kind = type("LBFGS", (LBFGS,), {"rules": replace(LBFGS.rules, jitter=Jitter(jitter, well_conditioned=np.inf))})
    return kind()


class ObservedLBFGS(TimedLBFGS):
    """L-BFGS that writes down how the fits from its starts ended, too."""

    def __init__(self, n_restarts: int = 0, callback: object = None):
        super().__init__(n_restarts, callback)
        self.n_starts_ = self.n_collapsed_ = 0
        self.placed_anew_, self.points_per_row_ = False, 0.0

    def run(self, task: SparseTask, attempt: Attempt) -> Fit:
        fit, strategy = super().run(task, attempt), task.strategy
        self.n_starts_ += 1
        self.n_collapsed_ += strategy.collapsed(fit)
        self.placed_anew_ |= strategy.place is not None
        self.points_per_row_ = task.n_inducing / len(task.rows)
        return fit


def ablated_default(record: str, name: str) -> Any:
    """A number of the default solver: ``name`` of its ``record``, "rules" or "descent"."""
    return getattr(getattr(LBFGS, record), name)


def ablated_field(record: str, name: str, value: Any) -> dict[str, Any]:
    """What replaces a field, or by "field.name" one of a record in it, of the default solver's ``record``."""
    outer, _, inner = name.partition(".")
    return {outer: replace(ablated_default(record, outer), **{inner: value}) if inner else value}


def ablated(rules: dict[str, Any], descent: dict[str, Any]) -> ObservedLBFGS:
    """The default solver with some of its rules and numbers replaced."""
    own = {"rules": replace(LBFGS.rules, **rules), "descent": replace(LBFGS.descent, **descent)}
    return type("LBFGS", (ObservedLBFGS,), own)()
