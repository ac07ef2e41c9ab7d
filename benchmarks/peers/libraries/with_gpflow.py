"""GPflow's SGPR (Titsias 2009) as a peer: L-BFGS-B through SciPy, compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from peers.jobs import Fitted, Fixed, Job, Predict, Said, Scaled, TimeUpError, Watch

MODULES = ("gpflow", "tensorflow", "scipy")
JITTER = "absolute 1e-12 where libraries are compared, 1e-6, its own, where it is timed"


def sgpr(
    X: np.ndarray, Y: np.ndarray, Z: np.ndarray, scales: np.ndarray, signal: float, noise: float, kernel: str
) -> Any:
    import gpflow

    shape = {"rbf": gpflow.kernels.SquaredExponential, "matern52": gpflow.kernels.Matern52}[kernel]
    return gpflow.models.SGPR((X, Y), shape(variance=signal, lengthscales=scales), Z.copy(), noise_variance=noise)


def at_fixed(fixed: Fixed) -> Said:
    import gpflow

    gpflow.config.set_default_jitter(1e-12)
    model = sgpr(
        fixed.X,
        fixed.y[:, np.newaxis],
        fixed.inducing_points,
        fixed.lengthscales,
        fixed.signal,
        fixed.noise,
        fixed.kernel,
    )
    mean, variance = model.predict_y(fixed.X_test)
    return Said(float(model.elbo()), mean.numpy()[:, 0], variance.numpy()[:, 0])


def _recorded_optimizer(watch: Watch, scaled: Scaled, index: int) -> Any:
    """SciPy's L-BFGS-B as GPflow calls it; keeps the best point of each iteration, and the bound at each evaluation."""
    import gpflow

    class Recorded(gpflow.optimizers.Scipy):
        def __init__(self) -> None:
            super().__init__()
            self.deadline = watch.deadline(index)
            self.loss, self.x = np.inf, None
            self.steps: list[tuple[float, np.ndarray]] = []

        def eval_func(self, *args: Any, **kwargs: Any) -> Callable[..., Any]:
            evaluate = super().eval_func(*args, **kwargs)

            def recorded(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                if watch.seconds > self.deadline:
                    raise TimeUpError
                loss, gradient = evaluate(x)
                if loss < self.loss:
                    self.loss, self.x = float(loss), x.copy()
                watch.record(index, scaled.bound(-float(loss), scaled.models[index]))
                if not self.steps:
                    self.callback()
                return loss, gradient

            return recorded

        def callback(self, *_: Any) -> None:
            self.steps.append((watch.seconds, self.x))

    return Recorded()


def fit(job: Job, watch: Watch) -> Fitted:
    """GPflow's own noise floor and jitter (both 1e-6)."""
    import tensorflow as tf

    scaled = Scaled(job)
    ways, bounds, stops, iterations = [], [], [], 0
    for index, columns in enumerate(scaled.models):
        model = sgpr(scaled.X, scaled.Y[:, columns], scaled.Z, scaled.lengthscales, 1.0, job.noise, "rbf")
        optimizer, variables = _recorded_optimizer(watch, scaled, index), model.trainable_variables
        try:
            minimum = optimizer.minimize(
                model.training_loss, variables, step_callback=optimizer.callback, options={"maxiter": job.max_iter}
            )
            stops.append({0: "converged", 1: "iterations"}.get(minimum.status, "line-search"))
        except (TimeUpError, tf.errors.InvalidArgumentError) as error:
            # A Cholesky failure is InvalidArgumentError. Kept is the best so far, which a user would have lost.
            stops.append("time" if isinstance(error, TimeUpError) else "cholesky")
        if optimizer.x is None:
            raise RuntimeError(f"no evaluation of output {columns} succeeded or fitted into the time limit")
        iterations += len(optimizer.steps) - 1
        optimizer.callback()
        bounds.append(scaled.bound(-optimizer.loss, columns))
        ways.append([(seconds, _predict(model, optimizer, x)) for seconds, x in optimizer.steps])
    said = {"bounds": bounds, "stop": " ".join(stops), "iterations": iterations, "evaluations": len(watch.records)}
    return scaled.fitted(ways, watch, **said)


def _predict(model: Any, optimizer: Any, x: np.ndarray) -> Predict:
    def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        import tensorflow as tf

        variables = model.trainable_variables
        optimizer.assign_tensors(variables, optimizer.unpack_tensors(variables, tf.convert_to_tensor(x)))
        mean, variance = model.predict_y(X)
        return mean.numpy(), np.sqrt(variance.numpy())

    return predict
