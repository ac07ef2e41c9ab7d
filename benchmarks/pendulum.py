"""The pendulum over several seeds: error, calibration, bound and time of each model, in both solvers.

Writes one row per run to a CSV (runs that are there already are not repeated) and prints medians and maxima.

    python benchmarks/pendulum.py --seeds 10                  # skevgp's defaults
    python benchmarks/pendulum.py --seeds 10 --setting paper  # Adam, diagonal posterior, inducing points per output
"""

from __future__ import annotations

import argparse
import csv
import platform
import time
from pathlib import Path

import numpy as np
import scipy
import sklearn

import skevgp
from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForce, InertiaForceGravity
from skevgp.metrics import containing_ratios, negative_log_predictive_density, prediction_error, std_norm

# The paper's inducing points (its Table 2).
MODELS = {
    "VGP": (None, 40),
    "RES-VGP": (None, 40),
    "EVGP-IF": (InertiaForce("pendulum"), 10),
    "EVGP-IFG": (InertiaForceGravity("pendulum"), 10),
}
SETTINGS = {"skevgp": {}, "paper": {"solver": "adam", "posterior": "diagonal", "sharing": "kernel"}}
COLUMNS = [
    *("model", "setting", "seed", "error_mean", "error_median", "error_p99", "std_norm", "cr1", "cr2", "cr3", "nlpd"),
    *("bound_per_row", "noise_share", "n_parameters", "n_iter", "fit_seconds", "versions", "machine"),
]


def run(model: str, setting: str, seed: int) -> dict[str, object]:
    """Fit one model on one training set, and look at it on one test set."""
    train = make_dynamics("pendulum", random_state=seed)
    test = make_dynamics("pendulum", random_state=1000 + seed)
    features, n_inducing = MODELS[model]
    residual = model == "RES-VGP"
    evgp = EVGPRegressor(features, n_inducing=n_inducing, random_state=seed, **SETTINGS[setting])
    start = time.perf_counter()
    evgp.fit(train.data, train.target - residual * train.data[:, :2])
    seconds = time.perf_counter() - start
    mean, std = evgp.predict(test.data, return_std=True)
    mean = mean + residual * test.data[:, :2]
    errors = np.linalg.norm(test.target - mean, axis=1)
    # What the features alone leave over, of which a collapsed GP would leave all as noise.
    left_over = train.target - residual * train.data[:, :2]
    if features is not None:
        H = features.fit_transform(train.data)
        left_over = left_over - H @ np.linalg.lstsq(H, left_over, rcond=None)[0]
    values = (
        model,
        setting,
        seed,
        prediction_error(test.target, mean),
        np.median(errors),
        np.quantile(errors, 0.99),
        std_norm(std),
        *containing_ratios(test.target, mean, std),
        negative_log_predictive_density(test.target, mean, std),
        evgp.lower_bound_ / len(train.data),
        np.max(evgp.noise_variance_ / np.mean(left_over**2, axis=0)),
        evgp.n_parameters_,
        evgp.n_iter_,
        seconds,
        " ".join(f"{package.__name__} {package.__version__}" for package in (skevgp, np, scipy, sklearn)),
        platform.processor() or platform.machine(),
    )
    return dict(zip(COLUMNS, values, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="seeds 0, 1, ...; default: %(default)s")
    parser.add_argument("--setting", choices=SETTINGS, default="skevgp", help="default: %(default)s")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "pendulum.csv")
    options = parser.parse_args()

    options.output.parent.mkdir(parents=True, exist_ok=True)
    rows = list(csv.DictReader(options.output.open())) if options.output.exists() else []
    done = {(row["model"], row["setting"], int(row["seed"])) for row in rows}
    for model in options.models:
        for seed in range(options.seeds):
            if (model, options.setting, seed) in done:
                continue
            row = run(model, options.setting, seed)
            rows.append({name: str(value) for name, value in row.items()})
            with options.output.open("a", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS)
                if file.tell() == 0:
                    writer.writeheader()
                writer.writerow(row)
            print(f"{model:9s} seed {seed}: error {row['error_mean']:.5f}, {row['fit_seconds']:.2f} s", flush=True)

    print(f"{'':9s} {'Error: median':>14} {'largest':>9} {'‖STD‖':>9} {'noise share':>12} {'seconds':>8} {'param.':>7}")
    for model in options.models:
        of = [row for row in rows if (row["model"], row["setting"]) == (model, options.setting)]
        column = {name: np.array([float(row[name]) for row in of]) for name in COLUMNS[3:-2]}
        error, seconds = column["error_mean"], column["fit_seconds"]
        print(
            f"{model:9s} {np.median(error):14.6f} {error.max():9.6f} {np.median(column['std_norm']):9.5f} "
            f"{column['noise_share'].max():12.1e} {np.median(seconds):8.2f} {column['n_parameters'][0]:7.0f}"
        )


if __name__ == "__main__":
    main()
