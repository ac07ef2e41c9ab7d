"""What the benchmarks reach for inside skevgp: all of it is here, so that a change inside is one change here."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Literal
from unittest.mock import patch

import numpy as np

from skevgp.fitting.start import FIRST_NOISE, spread_of, starting_table
from skevgp.fitting.units import Frame
from skevgp.inference import model as sparse_model
from skevgp.inference.bounds import PosteriorFamily
from skevgp.inference.elbo import ElboObjective
from skevgp.inference.model import SparseModel
from skevgp.inference.objectives import BoundObjective
from skevgp.kernels.parse import Start, Starts
from skevgp.kernels.stationary import SquaredExponential
from skevgp.optimizers.adam import adam
from skevgp.optimizers.lbfgs import Minimum
from skevgp.optimizers.parameters import ParameterTable
from skevgp.rows.internal import Rows
from skevgp.rows.source import LocalSource, moments_of_rows
from skevgp.rows.threads import BlockMap


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
    inputs, _, targets = source.sum(moments_of_rows)
    nothing = np.zeros((n_outputs, 0))
    frame = Frame.of(source, inputs, targets, np.zeros(n_outputs), nothing, nothing)
    each = tuple(slice(o, o + 1) for o in range(n_outputs))
    groups = (slice(0, n_outputs),) if sharing == "all" else each
    model, rows = SparseModel(SquaredExponential(d), frame.internal_prior(), posterior, groups), frame.rows(source)
    points = np.repeat(rng.randn(1, m, d), len(groups), axis=0)
    starts, spread = Starts(Start(), Start(), Start()), spread_of(rows.inputs)
    table = starting_table(spread, points, frame.target_unit, starts, rows.scatter(), FIRST_NOISE[solver], d)
    return model, table, rows


@contextmanager
def evaluation(
    n: int, m: int, d: int, n_outputs: int, cores: int, sharing: Literal["all", "kernel"] = "all"
) -> Iterator[Callable[[], tuple[float, np.ndarray]]]:
    """Gives () -> the bound and its gradient in all parameters, of all outputs, on random rows."""
    model, table, rows = _problem(n, m, d, n_outputs, sharing, "full", "lbfgs")
    threads = BlockMap(cores)
    objective, start = BoundObjective(model, table, rows.blocks(model.kernel, m, threads)), table.start()
    try:
        yield lambda: objective(start)
    finally:
        threads.close()


def adam_step(n: int, m: int, d: int, n_outputs: int, batch_size: int) -> Callable[[], Minimum]:
    """Make () -> one step of Adam in the paper's setting, over all parameters, on random rows."""
    model, table, rows = _problem(n, m, d, n_outputs, "kernel", "diagonal", "adam")
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, m))
    objective = elbo.minibatch(rows.batches(model.kernel, batch_size, np.random.RandomState(0)))
    start, bounds = elbo.table.start(), elbo.table.bounds()
    return lambda: adam(objective, start, bounds, max_iter=1, learning_rate=0.1)


@contextmanager
def timed_evaluations() -> Iterator[list[float]]:
    """Gives a list that gets the seconds of each evaluation of the bound inside the ``with``."""
    seconds: list[float] = []
    evaluate = BoundObjective.__call__

    def timed(self: BoundObjective, flat: np.ndarray) -> tuple[float, np.ndarray]:
        start = time.perf_counter()
        result = evaluate(self, flat)
        seconds.append(time.perf_counter() - start)
        return result

    with patch.object(BoundObjective, "__call__", timed):
        yield seconds


def bounds_on_the_way(record: Callable[[int, float], None]) -> AbstractContextManager[object]:
    """Inside the ``with``, fits of EVGPRegressor(verbose=2) call ``record(model, bound)`` at each iteration.

    Models are counted from 0, in the order in which they begin; outputs that share nothing have one each. Where
    ``record`` raises a KeyboardInterrupt, the fit ends with what it has.
    """
    begun = itertools.count()

    class Recorder:
        """Stands in for what prints the progress of one model."""

        def __init__(self, verbose: int, shift: float):
            self.shift, self.model = shift, next(begun)

        def __call__(self, iteration: int, loss: float) -> None:
            record(self.model, -loss - self.shift)

    return patch("skevgp.regressor.Progress", Recorder)


def fixed_jitter(jitter: float) -> AbstractContextManager[object]:
    """Inside the ``with``, k(X_m, X_m) gets this jitter, relative to the signal variance."""
    return patch.object(sparse_model, "JITTER", jitter)
