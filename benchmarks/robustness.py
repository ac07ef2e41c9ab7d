"""Does a fit ever fail, and does its result depend on the random state?

    python benchmarks/robustness.py          # an hour on one core
    python benchmarks/robustness.py --quick  # a few of each part

The part "nasty" fits 500 random data sets. A fit fails if it raises an error, or gives NaN or a standard deviation of
0. "seeds" fits the same data with ten random states, and measures the spread of the bounds. The CSV also has the
finished parts "jitter" (the noise-free nasty sets with fixed jitters) and "inducing" (k-means against greedy inducing
points). Their script is that of commit 36f3be5.
"""

from __future__ import annotations

import time
import traceback
import warnings
from collections import namedtuple
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from sklearn.exceptions import ConvergenceWarning
from sklearn.preprocessing import PolynomialFeatures

import harness
from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.exceptions import DependentRowsWarning
from skevgp.features import InertiaForce, InertiaForceGravity
from skevgp.solvers import LBFGS

# One fit. Of the part "nasty" the seed is also that of the data.
Cell = namedtuple("Cell", "part case variant seed")


class Data(NamedTuple):
    """A training and a test set, the arguments of EVGPRegressor, and what is special about a nasty set."""

    X: np.ndarray
    Y: np.ndarray
    X_test: np.ndarray
    Y_test: np.ndarray
    arguments: dict[str, Any]
    case: str = ""


def nasty(seed: int) -> Data:
    """Make a random data set that may break Cholesky factorisations in several ways."""
    rng = np.random.RandomState(seed)
    n, d, o = int(rng.choice([1, 2, 3, 7, 20, 60, 150, 300])), rng.randint(1, 6), rng.randint(1, 4)
    notes, n_all = [f"n{n}", f"d{d}", f"o{o}"], n + 100

    def sometimes(note: str, probability: float) -> bool:
        happens = bool(rng.rand() < probability)
        if happens:
            notes.append(note)
        return happens

    latent = rng.randn(n_all, d)
    if sometimes("heavy-tails", 0.15):
        latent = rng.standard_t(1.5, (n_all, d))
    if sometimes("integers", 0.15):
        latent = np.round(2.0 * latent)
    if sometimes("constant-column", 0.15):
        latent[:, 0] = latent[0, 0]
    if sometimes("copied-column", 0.15):
        latent[:, -1] = latent[:, 0]
    if sometimes("copied-rows", 0.2):
        latent[:n] = latent[rng.randint(0, max(1, n // 4), n)]
    scale = 10.0 ** rng.uniform(-12, 12, d) if sometimes("X-scales", 0.3) else np.ones(d)
    offset = 1e8 if sometimes("X-offset", 0.15) else 0.0
    X = scale * latent + offset
    # The latent inputs after rounding, so that targets are functions of X.
    latent = (X - offset) / scale
    kind = ("waves", "linear", "bump", "constant", "nothing")[rng.choice(5, p=[0.4, 0.2, 0.2, 0.1, 0.1])]
    notes.append(kind)
    direction = rng.randn(d, o) / np.sqrt(d)
    Y = {
        "waves": np.sin(1.5 * latent @ direction),
        "linear": latent @ direction,
        "bump": np.exp(-0.5 * (latent @ direction) ** 2),
        "constant": np.full((n_all, o), 5.0),
        "nothing": rng.randn(n_all, o),
    }[kind]
    noisy = kind != "nothing" and sometimes("noise", 0.4)
    outliers = sometimes("outliers", 0.1)
    if noisy:
        Y[:n] += 0.1 * rng.randn(n, o)
    if outliers:
        Y[rng.randint(n, size=max(1, n // 50))] += 1e3
    if sometimes("Y-scales", 0.3):
        Y = Y * 10.0 ** rng.uniform(-12, 12, o)
    if sometimes("Y-offset", 0.1):
        Y = Y + 1e8
    arguments = {
        "feature_map": [None, PolynomialFeatures(1), PolynomialFeatures(2)][rng.randint(3)],
        "n_inducing": int(rng.choice([1, 5, 10, 20])),
        "inducing_init": str(rng.choice(["k-means", "greedy"])),
        "sharing": str(rng.choice(["all", "kernel", "none"])),
        "solver": LBFGS(posterior=str(rng.choice(["full", "diagonal"]))),
        "normalize_y": bool(rng.rand() < 0.5),
    }
    notes += [str(getattr(value, "posterior", value)) for value in arguments.values()]
    return Data(X[:n], Y[:n], X[n:], Y[n:], arguments, " ".join(notes))


def smooth(dimension: int, noise: float) -> Data:
    """Make 1000 rows of a smooth function of 1 to 10 columns, of unit variance."""
    rng = np.random.RandomState(dimension)
    X = rng.uniform(-1, 1, (2000, dimension))
    directions, phases = rng.randn(20, dimension) * 2.0 / np.sqrt(dimension), rng.uniform(0, 2 * np.pi, 20)
    y = np.sin(X @ directions.T + phases) @ rng.randn(20)
    y = (y - y.mean()) / y.std()
    return Data(X[:1000], y[:1000] + noise * rng.randn(1000), X[1000:], y[1000:], {"n_inducing": 50})


def pendulum(name: str) -> Data:
    """Simulate a training and a test set, with the paper's inducing points (its Table 2)."""
    train, test = make_dynamics("pendulum", random_state=0), make_dynamics("pendulum", random_state=1000)
    features = {"IF": InertiaForce("pendulum"), "IFG": InertiaForceGravity("pendulum")}.get(name)
    arguments = {"feature_map": features, "n_inducing": 40 if features is None else 10, "noise_cv": None}
    states = (float(name == "RES-VGP") * rows.data[:, :2] for rows in (train, test))
    Y, Y_test = (rows.target - own for rows, own in zip((train, test), states, strict=True))
    return Data(train.data, Y, test.data, Y_test, arguments)


def noise_alone(data: Data, target: np.ndarray) -> np.ndarray:
    """Return the noise variance of each output if features and noise explain everything."""
    features, left_over = data.arguments.get("feature_map"), target - target.mean(axis=0)
    if features is not None:
        H = features.fit_transform(data.X, target)
        left_over = left_over - H @ np.linalg.lstsq(H, left_over, rcond=None)[0]
    # No better than the rounding of the target.
    return np.maximum(left_over.var(axis=0), 1e-30 * np.maximum(np.abs(target).max(axis=0), 1e-12) ** 2)


def fit(data: Data, seed: int, **arguments: Any) -> dict[str, Any]:
    """Fit and check the predictions. An error is an outcome."""
    start = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for category in (ConvergenceWarning, DependentRowsWarning):
                warnings.simplefilter("ignore", category)
            model = EVGPRegressor(random_state=seed, **{**data.arguments, **arguments}).fit(data.X, data.Y)
            seconds = time.perf_counter() - start
            mean, std = model.predict(data.X_test, return_std=True)
    except Exception as problem:  # the outcome
        where = traceback.extract_tb(problem.__traceback__)[-1]
        return {"outcome": f"{type(problem).__name__} in {Path(where.filename).name}:{where.lineno}: {problem}"[:200]}
    finite = np.isfinite(mean).all() and np.isfinite(std).all() and np.isfinite(model.lower_bound_)
    outcome = "not finite" if not finite else "ok" if (std > 0.0).all() else "std of 0"
    target = data.Y.reshape(len(data.Y), -1)
    # Of a target that does not vary, rounding is the unit.
    unit = np.maximum(target.std(axis=0), 1e-14 * np.abs(target).max(axis=0))
    errors = (data.Y_test.reshape(-1, len(unit)) - mean.reshape(-1, len(unit))) / np.where(unit > 0.0, unit, 1.0)
    left_over = noise_alone(data, target)
    bound = model.lower_bound_ / len(data.X)
    return {
        "outcome": outcome,
        "bound_per_row": bound,
        "gain_per_row": bound + 0.5 * (1.0 + np.log(2.0 * np.pi * left_over)).sum(),
        "error": np.linalg.norm(errors, axis=1).mean(),
        "noise_share": np.max(model.noise_variance_ / left_over),
        "n_iter": model.n_iter_,
        "seconds": seconds,
    }


COLUMNS = ("outcome", "bound_per_row", "gain_per_row", "error", "noise_share", "n_iter", "seconds")


def run(cell: Cell) -> dict[str, Any]:
    if cell.part == "nasty":
        found = fit(nasty(cell.seed), cell.seed, max_iter=100)
    elif cell.case.startswith("pendulum"):
        found = fit(pendulum(cell.case.partition("-")[2]), cell.seed)
    else:
        _, dimension, _, noise = cell.case.split("-", 3)
        found = fit(smooth(int(dimension[:-1]), float(noise)), cell.seed)
    return {name: found.get(name, "") for name in COLUMNS}


def cells_of(quick: bool) -> list[Cell]:
    cells = [Cell("nasty", nasty(seed).case, "max_iter=100", seed) for seed in range(6 if quick else 500)]
    cases = [] if quick else [f"pendulum-{name}" for name in ("VGP", "RES-VGP", "IF", "IFG")]
    dimensions, noises = (range(1, 3), (1e-3,)) if quick else (range(1, 11), (0.0, 1e-3, 0.1))
    cases += [f"smooth-{dimension}d-noise-{noise:g}" for dimension in dimensions for noise in noises]
    return cells + [Cell("seeds", case, "n_restarts=0", seed) for case in cases for seed in range(2 if quick else 10)]


def tables_of(rows: pd.DataFrame) -> harness.Tables:
    """Return failures of each part, and the spread of bounds over random states."""
    failed = rows["outcome"] != "ok"
    counts = failed.groupby(rows["part"]).agg(["size", "sum"]).set_axis(["fits", "failed"], axis=1)
    seeds = rows[~failed & (rows["part"] == "seeds") & (rows["variant"] == "n_restarts=0")].groupby("case", sort=False)
    spread = seeds["gain_per_row"].agg(lambda gains: np.ptp(gains) / abs(np.median(gains)))
    columns = {
        "least bound per row": seeds["bound_per_row"].min(),
        "median": seeds["bound_per_row"].median(),
        "largest": seeds["bound_per_row"].max(),
        "spread": spread.map("{:.2%}".format),
        "error": seeds["error"].median(),
        "noise / noise alone": seeds["noise_share"].max(),
    }
    return {"fits": counts.reset_index(), "seeds": pd.DataFrame(columns).reset_index()}


def main() -> None:
    options = harness.parse(harness.argument_parser(__doc__, quick="a few fits of each part"))
    output = harness.output_path(options, "robustness")
    n_failures = harness.run_missing(cells_of(options.quick), run, output, options.jobs)
    title = "Fits to difficult data, and with other random states"
    harness.write_page(title, tables_of(harness.frame(output)), output, n_failures)


if __name__ == "__main__":
    main()
