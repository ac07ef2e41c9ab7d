"""skevgp as a peer."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from peers.jobs import Checkpoint, Fitted, Fixed, Job, Said, Watch

MODULES = ("skevgp.estimators.evgp", "scipy")
JITTER = "relative 1e-12, only where a pivot is below 1e-6"


def at_fixed(fixed: Fixed) -> Said:
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

    from skevgp import EVGPRegressor

    scales = fixed.lengthscales, "fixed"
    shape = RBF(*scales) if fixed.kernel == "rbf" else Matern(*scales, nu=2.5)
    kernel = ConstantKernel(fixed.signal, "fixed") * shape + WhiteKernel(fixed.noise, "fixed")
    model = EVGPRegressor(kernel=kernel, inducing_init=fixed.inducing_points, max_iter=0).fit(fixed.X, fixed.y)
    mean, std = model.predict(fixed.X_test, return_std=True)
    return Said(model.lower_bound_, mean, std**2)


def fit(job: Job, watch: Watch) -> Fitted:
    """With its defaults but for m, threads and, if the job says so, iterations and sharing.

    What there was at an earlier time is what a fit gives that a callback ends then: the same way again, as fits are
    deterministic, and with a bound on all rows, which the callback's need not be.
    """
    model, stop, iterations = _fit_until(job, watch, watch.time_limit)

    def at(seconds: float) -> Checkpoint:
        own = Watch(watch.time_limit, 1)
        early, _, _ = _fit_until(job, own, seconds)
        return Checkpoint(own.seconds, own.cpu_seconds, early.lower_bound_, _predict(early))

    return Fitted(_predict(model), [model.lower_bound_], stop, iterations, at=at)


def _predict(model: Any) -> Any:
    return lambda X: tuple(part.reshape(len(X), -1) for part in model.predict(X, return_std=True))


def _fit_until(job: Job, watch: Watch, seconds: float) -> tuple[Any, str, int]:
    """A model, why its fit ended, and its iterations, those of all starts."""
    from skevgp import EVGPRegressor
    from skevgp.solvers import LBFGS

    iterations = 0

    def count(iteration: int, bound: float, outputs: Any) -> None:
        nonlocal iterations
        iterations += 1
        if watch.seconds > seconds:
            raise StopIteration

    sharing = {} if job.sharing == "default" else {"sharing": job.sharing}
    model = EVGPRegressor(
        n_inducing=len(job.inducing_points),
        max_iter=job.max_iter or None,
        n_jobs=2,
        random_state=job.seed,
        solver=LBFGS(callback=count),
        **sharing,
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.fit(job.X, job.Y if job.Y.shape[1] > 1 else np.ravel(job.Y))
    messages = " ".join(str(warning.message) for warning in caught)
    reasons = {"interrupted": "time", "max_iter=": "iterations", "rounding": "rounding"}
    stop = [reason for sign, reason in reasons.items() if sign in messages] or ["warned" if messages else "converged"]
    return model, " ".join(stop), iterations
