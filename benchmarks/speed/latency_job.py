"""One library's part of latency.py, in a process of its own, perhaps with another Python.

The job is a JSON object of the arguments of `measured`, and the last line that is printed the result: the median
microseconds of each call.

    python benchmarks/speed/latency_job.py '{"library": "skevgp", "n_inducing": 100, "seconds": 0.5}'
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

N_COLUMNS, N_OUTPUTS, HORIZON, N_ROWS = 6, 4, 50, 2000
Calls = dict[str, Callable[[], Any]]


def data(n_inducing: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rows, targets, inducing points and a horizon's rows."""
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (N_ROWS, N_COLUMNS))
    Y = np.sin(X @ rng.randn(N_COLUMNS, N_OUTPUTS)) + 0.05 * rng.randn(N_ROWS, N_OUTPUTS)
    return X, Y, X[rng.permutation(N_ROWS)[:n_inducing]], rng.uniform(-2.0, 2.0, (HORIZON, N_COLUMNS))


def compiled_calls(model: Any, X: np.ndarray, name: str) -> Calls:
    fast, row = model.compile(), X[0]
    return {
        f"{name}: row, mean": lambda: fast.predict(row),
        f"{name}: row, mean and std": lambda: fast.predict(row, return_std=True),
        f"{name}: row, mean and Jacobian": lambda: fast.value_and_jacobian(row),
        f"{name}: row, mean, std and both Jacobians": lambda: fast.value_and_jacobian(row, return_std=True),
        f"{name}: horizon, mean and std": lambda: fast.predict(X, return_std=True),
        f"{name}: horizon, mean and Jacobian": lambda: fast.value_and_jacobian(X),
    }


def with_skevgp(n_inducing: int) -> Calls:
    from sklearn.gaussian_process.kernels import RBF

    from skevgp import EVGPRegressor
    from skevgp.datasets import make_dynamics
    from skevgp.features import AngleEncoder, InertiaForceGravity

    X, Y, Z, ahead = data(n_inducing)
    options: dict[str, Any] = {"kernel": RBF(np.full(N_COLUMNS, 1.5)), "inducing_init": Z, "max_iter": 0}
    one, four = (EVGPRegressor(sharing=sharing, **options).fit(X, Y) for sharing in ("all", "none"))
    train = make_dynamics("cartpole", 10, random_state=0)
    system = EVGPRegressor(
        InertiaForceGravity("cartpole"),
        kernel_map=AngleEncoder("cartpole"),
        n_inducing=n_inducing,
        sharing="all",
        max_iter=0,
        random_state=0,
    ).fit(train.data, train.target)
    row, new = ahead[:1], slice(HORIZON)
    calls = {"predict: row, mean and std": lambda: one.predict(row, return_std=True)}
    calls |= compiled_calls(one, ahead, "compiled")
    calls |= compiled_calls(four, ahead, "compiled, four groups")
    calls |= compiled_calls(system, train.data[new], "compiled, cartpole with features")
    fast = system.compile()
    calls["partial_fit of 10 rows"] = lambda: system.partial_fit(train.data[:10], train.target[:10])
    calls["new weights into the compiled predictor"] = lambda: fast.update(system)
    return calls


def with_sklearn(n_inducing: int) -> Calls:
    """An exact model of as many rows as there are inducing points."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF

    X, Y, _, ahead = data(n_inducing)
    kernel = RBF(np.full(N_COLUMNS, 1.5))
    model = GaussianProcessRegressor(kernel, alpha=0.01, optimizer=None).fit(X[:n_inducing], Y[:n_inducing])
    return {
        "row, mean and std": lambda: model.predict(ahead[:1], return_std=True),
        "horizon, mean and std": lambda: model.predict(ahead, return_std=True),
    }


def with_gpflow(n_inducing: int) -> Calls:
    """The posterior with everything cached, compiled, as its guide to fast predictions says."""
    import gpflow
    import tensorflow as tf

    X, Y, Z, ahead = data(n_inducing)
    kernel = gpflow.kernels.SquaredExponential(lengthscales=np.full(N_COLUMNS, 1.5))
    posterior = gpflow.models.SGPR((X, Y), kernel, Z, noise_variance=0.01).posterior(
        gpflow.posteriors.PrecomputeCacheType.TENSOR
    )

    @tf.function
    def moments(rows: Any) -> Any:
        return posterior.predict_f(rows)

    @tf.function
    def with_jacobian(rows: Any) -> Any:
        with tf.GradientTape() as tape:
            tape.watch(rows)
            mean, _ = posterior.predict_f(rows)
        return mean, tape.batch_jacobian(mean, rows)

    row, rows = tf.constant(ahead[:1]), tf.constant(ahead)
    return {
        "row, mean and std": lambda: moments(row),
        "row, mean and Jacobian": lambda: with_jacobian(row),
        "horizon, mean and std": lambda: moments(rows),
        "horizon, mean and Jacobian": lambda: with_jacobian(rows),
    }


def with_gpytorch(n_inducing: int) -> Calls:
    """Of one output: an exact model of as many rows as there are inducing points, with fast predictive variances."""
    import gpytorch
    import torch

    X, Y, _, ahead = data(n_inducing)
    rows, targets = (torch.tensor(values[:n_inducing]) for values in (X, Y[:, 0]))

    class Exact(gpytorch.models.ExactGP):
        def __init__(self) -> None:
            super().__init__(rows, targets, likelihood)
            self.mean, self.covariance = gpytorch.means.ZeroMean(), gpytorch.kernels.RBFKernel(ard_num_dims=N_COLUMNS)

        def forward(self, x: Any) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean(x), self.covariance(x))

    likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
    model = Exact().double()
    model.covariance.lengthscale, likelihood.noise = torch.full((1, N_COLUMNS), 1.5), 0.01
    model.eval()

    def moments(x: Any) -> Any:
        with torch.no_grad(), gpytorch.settings.fast_pred_var():
            said = model(x)
            return said.mean, said.variance

    row, horizon = torch.tensor(ahead[:1]), torch.tensor(ahead)
    return {"row, mean and std": lambda: moments(row), "horizon, mean and std": lambda: moments(horizon)}


LIBRARIES: dict[str, Callable[[int], Calls]] = {
    "skevgp": with_skevgp,
    "scikit-learn": with_sklearn,
    "GPflow": with_gpflow,
    "GPyTorch": with_gpytorch,
}


def median(call: Callable[[], Any], seconds: float) -> float:
    """Microseconds of a call, the median of as many as fit into the time, at least 20."""
    for _ in range(5):
        call()
    each: list[float] = []
    end = time.perf_counter() + seconds
    while len(each) < 20 or time.perf_counter() < end:
        start = time.perf_counter()
        call()
        each.append(time.perf_counter() - start)
    return 1e6 * float(np.median(each))


def measured(library: str, n_inducing: int, seconds: float) -> dict[str, float]:
    """The median microseconds of each call of a library."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return {name: median(call, seconds) for name, call in LIBRARIES[library](n_inducing).items()}


if __name__ == "__main__":
    print(json.dumps(measured(**json.loads(sys.argv[1]))))
