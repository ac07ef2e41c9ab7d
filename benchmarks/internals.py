"""What the benchmarks reach for inside skevgp: all of it is here, so that a change inside is one change here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Literal

import numpy as np

from skevgp.fitting.sparse import SparseTask
from skevgp.fitting.start import starting_table
from skevgp.fitting.units import Units
from skevgp.inference.bounds import PosteriorFamily
from skevgp.inference.model import SparseModel
from skevgp.inference.objectives import BoundObjective, ElboObjective
from skevgp.kernels.parse import Start, Starts
from skevgp.kernels.stationary import SquaredExponential
from skevgp.optimizers.adam import adam
from skevgp.optimizers.minimum import Minimum, Objective
from skevgp.optimizers.parameters import ParameterTable
from skevgp.rows.internal import Rows
from skevgp.rows.source import LocalSource, moments_of_rows
from skevgp.rows.threads import BlockMap
from skevgp.solvers import LBFGS, SOLVERS


def _problem(
    n: int,
    m: int,
    d: int,
    n_outputs: int,
    sharing: Literal["all", "kernel"],
    posterior: PosteriorFamily,
    solver: Literal["lbfgs", "adam"],
) -> tuple[SparseModel, ParameterTable, Rows]:
    """What a fit minimises over, where it starts.

    Inducing points are drawn as the rows are, however few these may be: the cost does not depend on where they lie.
    """
    rng = np.random.RandomState(0)
    X = rng.randn(n, d)
    Y = np.sin(X @ rng.randn(d, n_outputs)) + 0.01 * rng.randn(n, n_outputs)
    source = LocalSource.of(X, np.empty((n, 0)), Y)
    _, _, targets = source.sum(moments_of_rows)
    nothing = np.zeros((n_outputs, 0))
    units = Units.of(source, targets, np.zeros(n_outputs), nothing, nothing)
    each = tuple(slice(o, o + 1) for o in range(n_outputs))
    groups = (slice(0, n_outputs),) if sharing == "all" else each
    model, rows = SparseModel(SquaredExponential(d), units.internal_prior(), posterior, groups), units.rows(source)
    points = np.repeat(rng.randn(1, m, d), len(groups), axis=0)
    starts, noise = Starts(Start(), Start(), Start()), SOLVERS[solver].rules.first_noise
    table = starting_table(rows.inputs, points, units.target_unit, starts, rows.scatter(), noise, d)
    return model, table, rows


@contextmanager
def evaluation(
    n: int, m: int, d: int, n_outputs: int, cores: int, sharing: Literal["all", "kernel"] = "all"
) -> Iterator[Callable[[], tuple[float, np.ndarray]]]:
    """Gives () -> the bound and its gradient in all parameters, of all outputs, on random rows."""
    model, table, rows = _problem(n, m, d, n_outputs, sharing, "full", "lbfgs")
    threads = BlockMap(cores)
    rows = replace(rows, threads=threads)
    objective, start = BoundObjective(model, table, rows.blocks(model.kernel, m)), table.start()
    try:
        yield lambda: objective(start)
    finally:
        threads.close()


def adam_step(n: int, m: int, d: int, n_outputs: int, batch_size: int) -> Callable[[], Minimum]:
    """Make () -> one step of Adam in the paper's setting, over all parameters, on random rows."""
    model, table, rows = _problem(n, m, d, n_outputs, "kernel", "diagonal", "adam")
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, m))
    objective = elbo.minibatch(rows.batches(model.kernel, batch_size, np.random.RandomState(0)))
    start, limits = elbo.table.start(), elbo.table.limits()
    return lambda: adam(objective, start, limits, max_iter=1, learning_rate=0.1)


class TimedLBFGS(LBFGS):
    """L-BFGS that writes down the seconds of each evaluation of the bound."""

    def __init__(self, n_restarts: int = 0, callback: object = None):
        super().__init__(n_restarts, callback)
        self.seconds_: list[float] = []

    def objective(self, task: SparseTask, table: ParameterTable) -> Objective:
        evaluate = super().objective(task, table)

        def timed(flat: np.ndarray) -> tuple[float, np.ndarray]:
            start = time.perf_counter()
            result = evaluate(flat)
            self.seconds_.append(time.perf_counter() - start)
            return result

        return timed


def with_jitter(jitter: float) -> LBFGS:
    """L-BFGS on models whose k(X_m, X_m) gets this jitter, relative to the signal variance."""
    kind = type("LBFGS", (LBFGS,), {"rules": replace(LBFGS.rules, jitter=jitter)})
    return kind()
