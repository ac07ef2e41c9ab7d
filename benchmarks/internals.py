"""What the benchmarks reach for inside skevgp: all of it is here, so that a change inside is one change here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any, Literal
from unittest.mock import patch

import numpy as np

from skevgp import EVGPRegressor
from skevgp.data.threads import BlockMap
from skevgp.fitting import model as fitting_model
from skevgp.fitting import search
from skevgp.fitting.model import Model
from skevgp.fitting.search import Fit, Search, Start
from skevgp.model.objectives import ElboObjective
from skevgp.solvers import LBFGS, Adam
from skevgp.solvers.adam import adam
from skevgp.solvers.base import Minimum, Objective
from skevgp.utils.linalg import Jitter


@contextmanager
def watched(see: Callable[[Model, Start, Fit], object]) -> Iterator[None]:
    """Tell a function of each start of a fit, and where it ended."""
    minimise = Model.minimise

    def told(self: Model, start: Start) -> Fit:
        fit = minimise(self, start)
        see(self, start, fit)
        return fit

    with patch.object(Model, "minimise", told):
        yield


@contextmanager
def rules(**changes: Any) -> Iterator[None]:
    """Fits by all rows go by these rules in place of the default's."""
    with patch.object(search, "RULES", replace(search.RULES, **changes)):
        yield


def _model(n: int, m: int, d: int, n_outputs: int, solver: LBFGS | Adam, **options: Any) -> Model:
    """What a fit to random rows searches over.

    Inducing points are drawn as the rows are, however few these may be: the cost does not depend on where they lie.
    """
    rng, found = np.random.RandomState(0), list[Model]()
    X = rng.randn(n, d)
    Y = np.sin(X @ rng.randn(d, n_outputs)) + 0.01 * rng.randn(n, n_outputs)
    with watched(lambda model, start, fit: found.append(model)):
        EVGPRegressor(inducing_init=rng.randn(m, d), solver=solver, max_iter=0, **options).fit(X, Y)
    return found[0]


@contextmanager
def evaluation(
    n: int, m: int, d: int, n_outputs: int, cores: int, sharing: Literal["all", "kernel"] = "all"
) -> Iterator[Callable[[], tuple[float, np.ndarray]]]:
    """Gives () -> the bound and its gradient in all parameters, of all outputs, on random rows, where a fit starts."""
    model, threads = _model(n, m, d, n_outputs, LBFGS(), sharing=sharing), BlockMap(cores)
    model = replace(model, rows=replace(model.rows, threads=threads))
    objective, start = model.objective(model.table), model.table.start()
    try:
        yield lambda: objective(start)
    finally:
        threads.close()


def adam_step(n: int, m: int, d: int, n_outputs: int, batch_size: int) -> Callable[[], Minimum]:
    """Make () -> one step of Adam in the paper's setting, over all parameters, on random rows."""
    model = _model(n, m, d, n_outputs, Adam(), sharing="kernel", posterior="diagonal")
    elbo = ElboObjective(model.sparse, model.table, model.blocks)
    objective = elbo.minibatch(model.rows.batches(model.sparse.kernel, batch_size, np.random.RandomState(0)))
    start, limits = elbo.table.start(), elbo.table.limits()
    return lambda: adam(objective, start, limits, max_iter=1, learning_rate=0.1)


class TimedLBFGS(LBFGS):
    """L-BFGS that writes down the seconds of each evaluation of the bound."""

    def __init__(self, n_restarts: int = 0, callback: Any = None):
        super().__init__(n_restarts, callback)
        self.seconds_: list[float] = []

    def minimise(self, objective: Objective, *others: Any, **options: Any) -> Minimum:
        def timed(x: np.ndarray) -> tuple[float, np.ndarray]:
            start = time.perf_counter()
            result = objective(x)
            self.seconds_.append(time.perf_counter() - start)
            return result

        return super().minimise(timed, *others, **options)


def with_jitter(jitter: float) -> Any:
    """A context in which k(X_m, X_m) gets this jitter, relative to the signal variance."""
    return rules(jitter=Jitter(jitter, well_conditioned=np.inf))


class ObservedLBFGS(TimedLBFGS):
    """L-BFGS that writes down how the fits from its starts ended, too."""

    def __init__(self, n_restarts: int = 0, callback: Any = None):
        super().__init__(n_restarts, callback)
        self.n_starts_ = self.n_collapsed_ = 0
        self.placed_anew_, self.points_per_row_ = False, 0.0

    def see(self, model: Model, start: Start, fit: Fit) -> None:
        """Where a start of a fit ended."""
        self.n_starts_ += 1
        self.n_collapsed_ += Search(model).collapsed(fit)
        self.placed_anew_ |= model.place is not None
        self.points_per_row_ = model.n_inducing / len(model.rows)


def ablated_default(record: str, name: str) -> Any:
    """A number of a default fit: ``name`` of its ``record``, "rules" or "descent"."""
    return getattr({"rules": search.RULES, "descent": LBFGS.descent}[record], name)


def ablated_field(record: str, name: str, value: Any) -> dict[str, Any]:
    """What replaces a field, or by "field.name" one of a record in it, of a default fit's ``record``."""
    outer, _, inner = name.partition(".")
    return {outer: replace(ablated_default(record, outer), **{inner: value}) if inner else value}


@contextmanager
def ablated(own_rules: dict[str, Any], descent: dict[str, Any], enough: float | None) -> Iterator[ObservedLBFGS]:
    """Gives the default solver with some of its numbers replaced, in a context with other rules.

    ``enough`` is the share of its gain that an iteration has to gain; None leaves it.
    """
    solver: ObservedLBFGS = type("LBFGS", (ObservedLBFGS,), {"descent": replace(LBFGS.descent, **descent)})()
    with ExitStack() as stack:
        stack.enter_context(rules(**own_rules))
        stack.enter_context(watched(solver.see))
        if enough is not None:
            stack.enter_context(patch.object(fitting_model, "ENOUGH", enough))
        yield solver
