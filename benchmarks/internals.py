"""What the benchmarks reach for inside skevgp: all of it is here, so that a change inside is one change here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import Any, Literal
from unittest.mock import patch

import numpy as np

from skevgp import EVGPRegressor
from skevgp.inference import statistics
from skevgp.inference.objectives import BoundObjective, ElboObjective
from skevgp.optimizers.adam import adam
from skevgp.rows.threads import BlockMap
from skevgp.solvers import LBFGS, Adam


def _task(n: int, m: int, d: int, n_outputs: int, solver: type[LBFGS] | type[Adam], **options: Any) -> Any:
    """What the solver of a fit to random rows is given.

    Inducing points are drawn as the rows are, however few these may be: the cost does not depend on where they lie.
    """
    rng, given = np.random.RandomState(0), []
    X = rng.randn(n, d)
    Y = np.sin(X @ rng.randn(d, n_outputs)) + 0.01 * rng.randn(n, n_outputs)

    class Given(solver):  # type: ignore[misc, valid-type]
        def run(self, task: Any, attempt: Any) -> Any:
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
    blocks = replace(task.rows, threads=threads).blocks(task.model.kernel, m)
    objective, start = BoundObjective(task.model, task.table, blocks), task.table.start()
    try:
        yield lambda: objective(start)
    finally:
        threads.close()


def adam_step(n: int, m: int, d: int, n_outputs: int, batch_size: int, **options: Any) -> Callable[[], Any]:
    """Make () -> one step of Adam over all parameters, on random rows."""
    task = _task(n, m, d, n_outputs, Adam, **options)
    elbo = ElboObjective(task.model, task.table, task.blocks)
    objective = elbo.minibatch(task.rows.batches(task.model.kernel, batch_size, np.random.RandomState(0)))
    start, limits = elbo.table.start(), elbo.table.limits()
    return lambda: adam(objective, start, limits, max_iter=1, learning_rate=0.1)


def fixed_jitter(jitter: float) -> AbstractContextManager[object]:
    """Inside the ``with``, k(X_m, X_m) gets this jitter, relative to the signal variance."""
    return patch.object(statistics, "JITTER", jitter)
