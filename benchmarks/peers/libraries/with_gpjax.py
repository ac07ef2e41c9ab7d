"""GPJax's collapsed bound (Titsias 2009) as a peer, in double precision: its L-BFGS, that of Optax, compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from peers.jobs import Fitted, Fixed, Job, Predict, Said, Scaled, TimeUpError, Watch

MODULES = ("gpjax", "jax", "optax")
JITTER = "absolute 1e-12 where libraries are compared, 1e-6, its own, where it is timed"
# Of the gradient's norm: where `fit_lbfgs` ends by itself.
_GTOL = 1e-5


def collapsed(Z: np.ndarray, scales: np.ndarray, signal: float, noise: float, kernel: str, **options: float) -> Any:
    """The sparse model in double precision; JAX's own is single."""
    import gpjax
    import jax

    jax.config.update("jax_enable_x64", True)
    shape = {"rbf": gpjax.kernels.RBF, "matern52": gpjax.kernels.Matern52}[kernel]
    scaled = shape(lengthscale=jax.numpy.asarray(scales), variance=jax.numpy.asarray(signal, float))
    prior = gpjax.Prior(scaled, gpjax.mean_functions.Zero(), **options)
    model = prior * gpjax.likelihoods.Gaussian(jax.numpy.asarray(noise**0.5))
    return gpjax.variational_families.CollapsedVariationalGaussian(model, jax.numpy.asarray(Z))


def dataset(X: np.ndarray, y: np.ndarray) -> Any:
    import gpjax
    import jax

    return gpjax.Dataset(jax.numpy.asarray(X), jax.numpy.asarray(y).reshape(-1, 1))


def _prediction(family: Any, train: Any, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance with noise; without covariances of test rows."""
    import jax

    latent = family.condition(train)(jax.numpy.asarray(X), covariance="diagonal")
    noisy = family.model.likelihood(latent)
    return np.asarray(noisy.mean), np.asarray(noisy.variance)


def at_fixed(fixed: Fixed) -> Said:
    import gpjax

    family = collapsed(fixed.inducing_points, fixed.lengthscales, fixed.signal, fixed.noise, fixed.kernel, jitter=1e-12)
    train = dataset(fixed.X, fixed.y)
    bound = float(gpjax.objectives.collapsed_elbo(family, train))
    return Said(bound, *_prediction(family, train, fixed.X_test))


class _Way:
    """What evaluations gave, told from within the compiled fit: the best points with their times, and bounds."""

    def __init__(self, record: Callable[[float], None], watch: Watch, deadline: float):
        self.record, self.watch, self.deadline = record, watch, deadline
        self.loss, self.slope, self.time_up = np.inf, np.inf, False
        self.steps: list[tuple[float, np.ndarray]] = []

    def point(self, loss: np.ndarray, x: np.ndarray) -> None:
        if self.watch.seconds > self.deadline:
            self.time_up = True
            raise TimeUpError
        if np.isfinite(loss):  # else a Cholesky factorisation failed
            self.record(-float(loss))
        if loss < self.loss:
            self.loss = float(loss)
            self.steps.append((self.watch.seconds, np.array(x)))

    def gradient(self, norm: np.ndarray) -> None:
        self.slope = float(norm)

    def objective(self) -> Callable[[Any, Any], Any]:
        """Minus the collapsed bound, which tells."""
        import equinox
        import gpjax
        import jax
        import optax

        def backwards(_: None, slope: Any) -> tuple[Any]:
            jax.debug.callback(self.gradient, optax.tree.norm(slope))
            return (slope,)

        same = jax.custom_vjp(lambda arrays: arrays)
        same.defvjp(lambda arrays: (arrays, None), backwards)

        def objective(family: Any, train: Any) -> Any:
            arrays, rest = equinox.partition(family, equinox.is_array)
            loss = -gpjax.objectives.collapsed_elbo(equinox.combine(same(arrays), rest), train)
            jax.debug.callback(self.point, loss, jax.flatten_util.ravel_pytree(arrays)[0])
            return loss

        return objective


def fit(job: Job, watch: Watch) -> Fitted:
    """`fit_lbfgs`, with GPJax's own jitter and no floor for the noise.

    Its `fit_scipy` (GPJax 1.0) names no method to SciPy, which takes BFGS with a dense matrix of all parameters.
    """
    import gpjax
    import jax

    scaled = Scaled(job)
    ways, bounds, stops, iterations = [], [], [], 0
    for index, columns in enumerate(scaled.models):
        family = collapsed(scaled.Z, scaled.lengthscales, 1.0, job.noise, "rbf")
        train = dataset(scaled.X, scaled.Y[:, columns])

        def record(bound: float, index: int = index, columns: list[int] = columns) -> None:
            watch.record(index, scaled.bound(bound, columns))

        way = _Way(record, watch, watch.deadline(index))
        try:
            _, loss = gpjax.fit_lbfgs(
                model=family, objective=way.objective(), train_data=train, max_iters=job.max_iter, gtol=_GTOL
            )
            loss.block_until_ready()
            jax.effects_barrier()  # all has been told
            # Without a number for the gradient it ends too. Kept is the best so far, which a user would have lost.
            stops.append("iterations" if way.slope >= _GTOL else "cholesky" if np.isnan(way.slope) else "converged")
            iterations += job.max_iter if stops[-1] == "iterations" else np.nan
        except jax.errors.JaxRuntimeError:
            if not way.time_up:
                raise
            stops.append("time")
            iterations = np.nan
        if not way.steps:
            raise RuntimeError(f"no evaluation of output {columns} succeeded or fitted into the time limit")
        bounds.append(scaled.bound(-way.loss, columns))
        ways.append([(seconds, _predict(family, train, x)) for seconds, x in way.steps])
    said = {"bounds": bounds, "stop": " ".join(stops), "iterations": iterations, "evaluations": len(watch.records)}
    return scaled.fitted(ways, watch, **said)


def _predict(family: Any, train: Any, x: np.ndarray) -> Predict:
    def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        import equinox
        import jax

        arrays, rest = equinox.partition(family, equinox.is_array)
        fitted = equinox.combine(jax.flatten_util.ravel_pytree(arrays)[1](x), rest)
        mean, variance = _prediction(fitted, train, X)
        return mean, np.sqrt(variance)

    return predict
