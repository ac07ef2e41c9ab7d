"""One run of against_checkout.py, in a process of its own, with the skevgp that PYTHONPATH finds.

Checkouts may be old: nothing is used of them but what all have, EVGPRegressor, make_dynamics, features and metrics.
The job is a JSON object of the arguments of `dynamics`, `cost` or `call`. The last line that is printed is the result.

    python benchmarks/speed/checkout_job.py '{"system": "pendulum", "n_inducing": 10, "seed": 0}'
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import warnings
from typing import Any

import numpy as np
import scipy
import sklearn

import skevgp
from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForceGravity
from skevgp.metrics import negative_log_predictive_density, prediction_error

N_COLUMNS, N_OUTPUTS = 8, 4


def fit(X: np.ndarray, Y: np.ndarray, *arguments: Any, **options: Any) -> tuple[EVGPRegressor, dict[str, Any]]:
    """A fitted regressor, and how long that took and where it ended."""
    # What is imported and allocated once is not the fit's.
    EVGPRegressor(n_inducing=2, max_iter=1, random_state=0).fit(X[:20], Y[:20])
    model = EVGPRegressor(*arguments, random_state=0, **options)
    start, cpu_start = time.perf_counter(), time.process_time()
    model.fit(X, Y)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    # Before noise and signal were calibrated.
    bound = -model.loss_curve_[-1] if model.n_iter_ else model.lower_bound_
    result = {"seconds": seconds, "cpu_seconds": cpu_seconds, "n_iter": model.n_iter_, "bound": bound}
    return model, result


def dynamics(system: str, seed: int, n_trajectories: int | None = None, **options: Any) -> dict[str, Any]:
    """Fit the paper's EVGP-IFG to a training set, and look at it on a test set."""
    train, test = (make_dynamics(system, n_trajectories, random_state=state) for state in (seed, 1000 + seed))
    model, result = fit(train.data, train.target, InertiaForceGravity(system), **options)
    mean, std = model.predict(test.data, return_std=True)
    scores = {
        "error": prediction_error(test.target, mean),
        "nlpd": negative_log_predictive_density(test.target, mean, std),
    }
    return result | scores


def cost(n_rows: int, n_inducing: int, max_iter: int, seed: int) -> dict[str, Any]:
    """Seconds of an iteration on random rows: of a fit, less those of one without iterations."""
    rng = np.random.RandomState(seed)
    X = rng.randn(n_rows, N_COLUMNS)
    Y = np.sin(X @ rng.randn(N_COLUMNS, N_OUTPUTS)) + 0.01 * rng.randn(n_rows, N_OUTPUTS)
    _, start = fit(X, Y, n_inducing=n_inducing, max_iter=0)
    _, result = fit(X, Y, n_inducing=n_inducing, max_iter=max_iter)
    return result | {name: (result[name] - start[name]) / result["n_iter"] for name in ("seconds", "cpu_seconds")}


CALLS = 2000
IMPORT = "import time; t = time.perf_counter(); from skevgp import EVGPRegressor; print(time.perf_counter() - t)"


def call(what: str, seed: int) -> dict[str, Any]:
    """Seconds of the import in a fresh process, or the median time to predict one row, plain or compiled."""
    if what == "import":
        done = subprocess.run([sys.executable, "-c", IMPORT], capture_output=True, text=True, check=True)
        return {"seconds": float(done.stdout), "cpu_seconds": float(done.stdout)}
    train = make_dynamics("cartpole", 10, random_state=seed)
    features = InertiaForceGravity("cartpole")
    model = EVGPRegressor(features, n_inducing=60, max_iter=5, random_state=0).fit(train.data, train.target)
    predict = model.compile().predict if what == "compiled row" else model.predict
    row, times = train.data[:1], np.empty((CALLS, 2))
    for i in range(CALLS):
        start, cpu_start = time.perf_counter(), time.process_time()
        predict(row, return_std=True)
        times[i] = time.perf_counter() - start, time.process_time() - cpu_start
    seconds, cpu_seconds = np.median(times, axis=0)
    return {"seconds": seconds, "cpu_seconds": cpu_seconds}


def main() -> None:
    job = json.loads(sys.argv[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = (call if "what" in job else dynamics if "system" in job else cost)(**job)
    packages = " ".join(f"{package.__name__} {package.__version__}" for package in (skevgp, np, scipy, sklearn))
    numbers = {name: np.asarray(value).item() for name, value in result.items()}
    print(json.dumps({**numbers, "versions": packages, "package": skevgp.__file__}))


if __name__ == "__main__":
    main()
