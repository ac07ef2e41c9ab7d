"""A fit that finds the number of its inducing points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..model.parameters import Values
from ..solvers import LBFGS
from .model import Model
from .runs import Fit, Start, better
from .search import search

# Inducing points are added until this raises the bound by less than so many nats per row and output.
_GAIN = 0.01
# There are too few points if the kernel gives a sample a lower log likelihood than the kernel of an exact model does,
# by more than this, in nats per row and output.
_MISSED = 0.02
# Largest number of iterations between, and the tolerance, in nats per row and output.
_ITERATIONS, _COARSE = 60, 2e-4
# Number of rows of the exact model that checks the kernel of a sparse model.
_SAMPLE = 1000


def grown(model: Model) -> tuple[Model, Fit]:
    """The best fit, and its model with the number of inducing points that it needs.

    Half as many points again are added, the rows that are predicted worst so far, and the fit continues for a few
    iterations. This ends when it raises the bound by less than `_GAIN`. Then the last fit but one continues to its end.
    """
    # Only the last fit has `max_iter` iterations. Those of earlier fits are added to `n_iter_`. If there were too few
    # between, points would be credited with the gain of further iterations.
    #
    # With few points, the noise may explain so much that half as many again change nothing. The kernel of an exact
    # model of a sample is a second opinion. While it makes the sample more likely than the kernel of the fit does, by
    # `_MISSED`, points are added, and it is tried as a start at each step.
    nats = model.rows.total * len(model.scatter)
    iterations, tol = _ITERATIONS if model.max_iter > 0 else 0, model.tol or 0.0
    coarse = replace(model, max_iter=iterations, tol=max(tol, _COARSE * nats))
    fit = search(coarse)
    others = fit.others
    with model.monitor.keeping_the_best():
        unhindered = None if model.monitor.stopped else exact_model_of_sample(model, _ITERATIONS, _COARSE)
        while not model.monitor.stopped and (more := coarse.with_more(fit.values)) is not None:
            starts, limited = [fit.values | {"inducing_points": more.table["inducing_points"].start}], False
            if unhindered is not None and unhindered.missed_by(fit.values) > _MISSED:
                starts, limited = [*starts, more.placed_under(unhindered.fit.values)], True
            larger = more.minimise(Start(max(starts, key=more.bound_at), coarse.max_iter))
            if larger.bound - fit.bound < _GAIN * nats and not limited:
                break
            coarse, fit = more, larger
    model = replace(coarse, max_iter=model.max_iter, tol=model.tol)
    if model.max_iter > 0 and not model.monitor.stopped:
        fit = better(fit, model.minimise(Start(fit.values, model.max_iter)))
    return model, replace(fit, others=(fit.values, *others) if others else ())


@dataclass(frozen=True)
class Unhindered:
    """The fitted exact model of some rows: the kernel without the limits of inducing points."""

    model: Model
    fit: Fit

    def missed_by(self, values: Values) -> float:
        """Loss of log likelihood of the rows at other values, in nats per row and output."""
        exact = self.model.exact
        assert exact is not None
        # A fit gains about half a nat per parameter by chance.
        likelihood, by_chance = float(exact.log_likelihoods(values).sum()), 0.5 * self.model.table.size
        best = self.fit.bound - self.model.log_hyper_prior(self.fit.values)
        return (best - by_chance - likelihood) / (exact.rows.total * exact.rows.targets.shape[1])


def exact_model_of_sample(model: Model, max_iter: int, tol: float) -> Unhindered | None:
    """Fit the exact model of a sample of a model's rows. ``tol`` is in nats per row and output.

    Returns None if the kernel is fixed, or groups have their own kernels.
    """
    if model.max_iter == 0 or not model.table["hyperparameters"].free.any() or model.sparse.kernels is not None:
        return None
    rows = model.rows.subset(model.rows.chosen(_SAMPLE, model.rng))
    points = np.repeat(rows.some(np.arange(len(rows))).inputs[np.newaxis], len(model.sparse.groups), axis=0)
    sample = replace(
        model,
        problem=replace(model.problem, solver=LBFGS()),
        sparse=replace(model.sparse, complete=True),
        rows=rows,
        table=model.table.changed("inducing_points", start=points, fixed=True),
        monitor=model.monitor.silent(),
        max_iter=max_iter,
        tol=max(model.tol or 0.0, tol * rows.total * len(model.scatter)),
        warm=None,
        placed=False,
        is_exact=True,
    )
    return Unhindered(sample, search(sample))
