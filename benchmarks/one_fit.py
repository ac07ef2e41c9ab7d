"""One fit of `speed.py checkout`, by the skevgp that Python finds. It prints its figures as JSON.

    PYTHONPATH=../older python benchmarks/one_fit.py pendulum 0
    PYTHONPATH=../older python benchmarks/one_fit.py ur10e 0 --data ../data
    python benchmarks/one_fit.py pendulum 0 --quick

Jobs are simulated systems (with "-noise": with 1 % of noise), tables, a million rows, and torques of a real arm (see
`robots.py`).
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.datasets import load_diabetes, make_friedman1
from sklearn.model_selection import train_test_split
from sklearn.preprocessing import PolynomialFeatures

import harness
from robots import rows_of, urdf_of
from skevgp import EVGPRegressor, InverseDynamics
from skevgp.datasets import make_dynamics, make_toy
from skevgp.features import InertiaForceGravity
from skevgp.metrics import negative_log_predictive_density, prediction_error

# Numbers of inducing points, and of trajectories if they are not all of the paper's.
SYSTEMS = {"pendulum": (10, None), "cartpole": (60, None), "acrobot": (150, None), "iiwa14": (100, 100)}
TABLES = ("friedman", "diabetes", "toy")
OTHER_JOBS = ("ur10e", "million")
JOBS = (*SYSTEMS, *(f"{system}-noise" for system in SYSTEMS if system != "iiwa14"), *TABLES)

# Model, arguments of fit, X and y of new rows.
Job = tuple[Any, dict[str, Any], np.ndarray, np.ndarray]


def system(job: str, seed: int, quick: bool) -> Job:
    name, *noisy = job.split("-")
    m, n_trajectories = SYSTEMS[name]
    options = {"n_trajectories": 3 if quick else n_trajectories, "noise": 0.01 if noisy else 0.0}
    train, test = (make_dynamics(name, random_state=state, **options) for state in (seed, 1000 + seed))
    model = EVGPRegressor(InertiaForceGravity(name), n_inducing=m, random_state=seed)
    return model, {"X": train.data, "y": train.target, "groups": train.groups}, test.data, test.target


def table(job: str, seed: int) -> Job:
    features = PolynomialFeatures(1)
    if job == "friedman":
        X, y = make_friedman1(2000, noise=1.0, random_state=seed)
    elif job == "diabetes":
        X, y = load_diabetes(return_X_y=True)
    else:
        X, y = make_toy(2000, random_state=seed, return_X_y=True)
    X, X_test, y, y_test = train_test_split(X, y, random_state=seed)
    return EVGPRegressor(features, n_inducing=50, random_state=seed), {"X": X, "y": y}, X_test, y_test


def many_rows(seed: int, quick: bool) -> Job:
    """Rows of 6 columns, on all cores."""
    n = 20_000 if quick else 1_000_000
    X, y, _ = next(harness.noisy_waves(n + 10_000, 6, np.random.RandomState(seed)))
    model = EVGPRegressor(n_inducing=100, n_jobs=-1, random_state=seed)
    return model, {"X": X[:n], "y": y[:n]}, X[n:], y[n:]


def arm(seed: int, folder: Path, quick: bool) -> Job:
    """Two moves of the UR10e, and a third one."""
    size = "quick" if quick else "full"
    train = rows_of("ur10e", ("20sec_8harm", "30sec_12harm"), folder, size)
    test = rows_of("ur10e", ("40sec_12harm",), folder, size)
    model = InverseDynamics(urdf_of("ur10e", folder), random_state=seed)
    return model, {"X": train.data, "y": train.target, "groups": train.groups}, test.data, test.target


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", choices=[*JOBS, *OTHER_JOBS])
    parser.add_argument("seed", type=int)
    parser.add_argument("--data", type=Path, help="of ur10e: a folder with a folder ur10e")
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    if options.job == "million":
        model, rows, X, y = many_rows(options.seed, options.quick)
    elif options.job == "ur10e":
        model, rows, X, y = arm(options.seed, options.data, options.quick)
    elif options.job in TABLES:
        model, rows, X, y = table(options.job, options.seed)
    else:
        model, rows, X, y = system(options.job, options.seed, options.quick)
    warnings.simplefilter("ignore")
    start, cpu_start = time.perf_counter(), time.process_time()
    model.fit(**rows)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    mean, std = model.predict(X, return_std=True)
    y, mean, std = (values.reshape(len(X), -1) for values in (y, mean, std))
    figures = {
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "n_iter": int(getattr(model, "n_iter_", 0)),
        "bound": float(getattr(model, "lower_bound_", np.nan)),
        "error": float(prediction_error(y, mean)),
        "nlpd": float(negative_log_predictive_density(y, mean, std)),
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
