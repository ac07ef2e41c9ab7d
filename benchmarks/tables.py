"""Tables of data: comparison to other models, and the number of inducing points of n_inducing="auto".

    python benchmarks/tables.py models      # some hours of one core
    python benchmarks/tables.py models --sets diabetes friedman1-2000 --seeds 1
    python benchmarks/tables.py inducing    # hours of one core
    python benchmarks/tables.py inducing --sets toy-200 linear-5 --jobs 2
    python benchmarks/tables.py models --quick  # two small sets, one seed

*models* compares EVGPRegressor, scikit-learn's exact Gaussian process, gradient boosting and Bayesian ridge regression.
It measures RMSE, NLPD, CRPS, coverage of 90 % intervals and time, on scikit-learn's own sets and on simulated ones.
"boxes" and "houses" are functions with jumps, which suit trees. "houses" is similar to California's houses, with prices
that jump between districts. All models have their defaults, and columns and targets have variance one. Models of a set
and seed are fitted one after the other in one process with one thread, so that ratios of times are of the same run.
This part also fills the tables of docs/guide/boosting.md.

*inducing* compares the held-out NLPD of ``n_inducing="auto"`` to that of the exact `EGPRegressor` with its own kernel.
There are twenty sets of at most 3,000 rows, which were chosen before any of them was run. The number of points is
compared with the smallest of a grid (10, 15, 23, 34, ...) whose fit is within 0.02 nats per row of the exact one. The
default of 100 points is also measured. Another column tests whether the upper bound is above the exact log marginal
likelihood at the same parameters.
"""

from __future__ import annotations

import re
import time
from collections import namedtuple
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import norm
from sklearn.base import RegressorMixin, TransformerMixin
from sklearn.datasets import load_diabetes, make_friedman1, make_friedman2, make_friedman3
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.linear_model import BayesianRidge
from sklearn.model_selection import cross_val_predict
from sklearn.preprocessing import StandardScaler

import harness
from harness import ordered
from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import make_dynamics, make_toy
from skevgp.features import InertiaForceGravity
from skevgp.metrics import containing_ratios, crps, negative_log_predictive_density
from skevgp.noise import Gaussian

PAGE = Path(__file__).parents[1] / "docs" / "guide" / "boosting.md"
COVERAGE = 0.9
HALF_WIDTH = float(norm.ppf(0.5 + COVERAGE / 2))
EXACT_ROWS = 2000  # up to here there are the exact model and "auto"
SMALLEST_STD = 1e-3  # of predictions by quantiles, which may meet or cross, as a share of that of y
ENOUGH = 0.02  # nats per row of held-out NLPD that may be lost against the exact model
N_TEST = 1000
GRID = tuple(int(np.ceil(10 * 1.5**k)) for k in range(13))


# --- data ----------------------------------------------------------------------------------------------------------


class Data(NamedTuple):
    """Training rows, held-out rows, and the feature map if there is one."""

    X: np.ndarray
    y: np.ndarray
    X_test: np.ndarray
    y_test: np.ndarray
    feature_map: TransformerMixin | None = None


Draw = Callable[[int, np.random.RandomState], Any]  # to X and y


def drawn(draw: Draw, n_rows: int, seed: int) -> Data:
    """Draw training rows and held-out rows."""
    X, y = draw(n_rows + N_TEST, np.random.RandomState(seed))
    # Some sets are sorted.
    order = np.random.RandomState(1000 + seed).permutation(len(X))
    (train, test), y = (order[:n_rows], order[n_rows:]), y / y[order[:n_rows]].std(axis=0)
    return Data(X[train], y[train], X[test], y[test])


def toy(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    return make_toy(n, random_state=rng, return_X_y=True)


def sines(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """Return a sum of eight sines, one of each column, with noise."""
    X = rng.uniform(-2.0, 2.0, (n, 8))
    return X, np.sin(2.0 * X).sum(axis=1) + 0.3 * rng.randn(n)


def linear(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    X = rng.randn(n, 5)
    return X, X @ rng.randn(5) + 0.5 * rng.randn(n)


def nothing(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    return rng.randn(n, 3), rng.randn(n)


def steps(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    X = rng.uniform(0.0, 10.0, (n, 1))
    return X, np.floor(X[:, 0]) % 3.0 + 0.1 * rng.randn(n)


def chirp(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    X = rng.uniform(0.0, 6.0, (n, 1))
    return X, np.sin(X[:, 0] ** 2) + 0.1 * rng.randn(n)


def diabetes(seed: int) -> Data:
    X, y = load_diabetes(return_X_y=True)
    order = np.random.RandomState(seed).permutation(len(X))
    train, test = order[:300], order[300:]
    y = y / y[train].std()
    return Data(X[train], y[train], X[test], y[test])


def dynamics(system: str, n_rows: int, noise: float, with_features: bool, seed: int) -> Data:
    """Return the change of the last velocity over a step. Held-out rows are of other trajectories."""
    parts: list[np.ndarray] = []
    for random_state, n in ((seed, n_rows), (1000 + seed, N_TEST)):
        bunch = make_dynamics(system, -(-n // 25), 25, noise=noise, random_state=random_state)
        last = bunch.target.shape[1] - 1
        y = bunch.target[:, last] if with_features else bunch.target[:, last] - bunch.data[:, last]
        chosen = np.sort(np.random.RandomState(seed).permutation(len(y))[:n])
        parts += [bunch.data[chosen], y[chosen]]
    unit = parts[1].std() if not with_features else 1.0
    feature_map = InertiaForceGravity(system, outputs=[last]) if with_features else None
    return Data(parts[0], parts[1] / unit, parts[2], parts[3] / unit, feature_map)


def houses(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """Return houses like California's: prices jump between districts, columns are skewed, few prices reach 5."""
    place, age = rng.uniform(0.0, 6.0, (n, 2)), rng.randint(1, 53, n)
    income, people = np.exp(1.2 + 0.45 * rng.randn(n)), np.exp(7.0 + 0.7 * rng.randn(n))
    rooms = np.exp(1.6 + 0.1 * income / 3 + 0.3 * rng.randn(n))
    bedrooms, household = rooms / 5.0 * np.exp(0.1 * rng.randn(n)), np.exp(1.0 + 0.3 * rng.randn(n))
    district = rng.randn(6, 6)[*place.astype(int).T]
    price = 0.4 * income - 0.3 * np.log(household) + 0.6 * district + 0.01 * age * (place[:, 0] < 2.0)
    price = np.minimum(price * np.exp(0.15 * rng.randn(n)), 5.0)
    return np.column_stack([income, age, rooms, bedrooms, people, household, place]), price


def boxes(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """Return ten columns. Inside each of forty boxes of three columns, y is higher or lower by a constant."""
    X, y = rng.uniform(0.0, 1.0, (n, 10)), 0.3 * rng.randn(n)
    for _ in range(40):
        columns = rng.choice(10, 3, replace=False)
        y += rng.randn() * ((X[:, columns] > rng.uniform(0.2, 0.8, 3)) == (rng.rand(3) > 0.5)).all(axis=1)
    return X, y


def friedman(make: Callable[..., Any], noise: float) -> Draw:
    return lambda n, rng: make(n, noise=noise, random_state=rng)


def waves(n_columns: int) -> Draw:
    return lambda n, rng: next(harness.noisy_waves(n, n_columns, rng))[:2]


def sampled(n_rows: int, draw: Draw) -> Callable[[int], Data]:
    return partial(drawn, draw, n_rows)


INDUCING_SETS: dict[str, Callable[[int], Data]] = {
    "toy-200": sampled(200, toy),
    "toy-1000": sampled(1000, toy),
    "friedman1": sampled(800, friedman(make_friedman1, 1.0)),
    "friedman1-quiet": sampled(800, friedman(make_friedman1, 0.1)),
    "friedman2": sampled(800, friedman(make_friedman2, 0.0)),
    "friedman3": sampled(800, friedman(make_friedman3, 0.1)),
    "sines-8": sampled(800, sines),
    "diabetes": diabetes,
    "waves-2": sampled(1000, waves(2)),
    "waves-6": sampled(1000, waves(6)),
    "linear-5": sampled(600, linear),
    "nothing-3": sampled(500, nothing),
    "steps-1": sampled(400, steps),
    "chirp-1": sampled(600, chirp),
    "pendulum": partial(dynamics, "pendulum", 600, 0.0, False),
    "pendulum-ifg": partial(dynamics, "pendulum", 600, 0.01, True),
    "cartpole": partial(dynamics, "cartpole", 800, 0.01, False),
    "acrobot": partial(dynamics, "acrobot", 800, 0.0, False),
    "acrobot-ifg": partial(dynamics, "acrobot", 800, 0.01, True),
    "iiwa14": partial(dynamics, "iiwa14", 800, 0.0, False),
}
# Friedman's own standard deviations of the noise (1991); the quiet one has none.
FRIEDMAN = {
    "friedman1": friedman(make_friedman1, 1.0),
    "friedman2": friedman(make_friedman2, 125.0),
    "friedman3": friedman(make_friedman3, 0.1),
}
MODEL_SETS: dict[str, Callable[[int], Data]] = {
    "diabetes": diabetes,
    "toy-200": sampled(200, toy),
    **{f"{name}-{n}": sampled(n, draw) for n in (800, 2000) for name, draw in FRIEDMAN.items()},
    "friedman2-quiet-800": sampled(800, friedman(make_friedman2, 0.0)),
    "sines-800": sampled(800, sines),
    "sines-2000": sampled(2000, sines),
    "houses-2000": sampled(2000, houses),
    "houses-20000": sampled(20_000, houses),
    "boxes-2000": sampled(2000, boxes),
}


# --- other models --------------------------------------------------------------------------------------------------

Drawing = namedtuple("Drawing", "name seed")


class Predicted(NamedTuple):
    """Mean, standard deviation, and interval."""

    mean: np.ndarray
    std: np.ndarray
    low: np.ndarray
    high: np.ndarray


def around(mean: np.ndarray, std: np.ndarray) -> Predicted:
    """Return normal distributions with their intervals."""
    return Predicted(mean, std, mean - HALF_WIDTH * std, mean + HALF_WIDTH * std)


def gaussian(regressor: Any, data: Data) -> tuple[Any, Callable[[], Predicted]]:
    """Fit a regressor with ``return_std``."""
    regressor.fit(data.X, data.y)
    return regressor, lambda: around(*regressor.predict(data.X_test, return_std=True))


def boosted_by_folds(data: Data, seed: int) -> tuple[Any, Callable[[], Predicted]]:
    """Fit boosting; std comes from the errors of five folds."""
    model = HistGradientBoostingRegressor(random_state=seed).fit(data.X, data.y)
    folds = cross_val_predict(HistGradientBoostingRegressor(random_state=seed), data.X, data.y, cv=5)
    std = np.sqrt(np.mean((data.y - folds) ** 2))
    return model, lambda: around(mean := model.predict(data.X_test), np.full(len(mean), std))


def boosted_quantiles(data: Data, seed: int) -> tuple[Any, Callable[[], Predicted]]:
    """Fit boosting for the mean and two quantiles, from which std comes."""
    levels = ({}, *({"loss": "quantile", "quantile": 0.5 + sign * COVERAGE / 2} for sign in (-1.0, 1.0)))
    models = [HistGradientBoostingRegressor(random_state=seed, **level).fit(data.X, data.y) for level in levels]

    def predict() -> Predicted:
        mean, low, high = (model.predict(data.X_test) for model in models)
        return Predicted(mean, np.maximum((high - low) / (2 * HALF_WIDTH), SMALLEST_STD), low, high)

    return models[0], predict


def exact(n_columns: int) -> RegressorMixin:
    """Return an exact GP with bounds for data without noise, which starts at little noise as skevgp does."""
    signal = ConstantKernel(1.0, (1e-6, 1e9)) * RBF(np.ones(n_columns), (1e-3, 1e6))
    return GaussianProcessRegressor(signal + WhiteKernel(1e-2, (1e-10, 10.0)), normalize_y=True, random_state=0)


Fitting = Callable[[Data, int], tuple[Any, Callable[[], Predicted]]]
MODELS: dict[str, Fitting] = {
    "EVGP, auto": lambda data, seed: gaussian(
        EVGPRegressor(n_inducing="auto", normalize_y=True, random_state=seed), data
    ),
    "EVGP, 100": lambda data, seed: gaussian(EVGPRegressor(normalize_y=True, random_state=seed), data),
    "GPR": lambda data, seed: gaussian(exact(data.X.shape[1]), data),
    "boosting, quantiles": boosted_quantiles,
    "boosting, folds": boosted_by_folds,
    "BayesianRidge": lambda data, seed: gaussian(BayesianRidge(), data),
}
# With more rows than EXACT_ROWS the others would take hours.
LARGE = tuple(name for name in MODELS if name not in ("GPR", "EVGP, auto"))


def measured(model: str, data: Data, seed: int) -> dict[str, Any]:
    found: list[Any] = []
    wall = time.perf_counter()
    seconds, caught = harness.timed(lambda: found.extend(MODELS[model](data, seed)))
    wall_seconds, (regressor, predict) = time.perf_counter() - wall, found
    predict_seconds, _ = harness.timed(lambda: found.extend(predict()))
    mean, std, low, high = found[2:]
    return {
        "model": model,
        "m": len(regressor.inducing_points_) if isinstance(regressor, EVGPRegressor) else "",
        "rmse": float(np.sqrt(np.mean((data.y_test - mean) ** 2))),
        "nlpd": negative_log_predictive_density(data.y_test, mean, std),
        "crps": crps(data.y_test, mean, std),
        "coverage": float(np.mean((low <= data.y_test) & (data.y_test <= high))),
        "width": float(np.mean(high - low)),
        "within_2_std": float(containing_ratios(data.y_test, mean, std, k=2)[0]),
        "seconds": round(seconds, 3),
        "wall_seconds": round(wall_seconds, 3),
        "predict_seconds": round(predict_seconds, 4),
        "warning": str(caught[0].message).splitlines()[0][:120] if caught else "",
    }


def run_models(cell: Drawing) -> list[dict[str, Any]]:
    """Fit all models to columns of mean 0 and variance 1."""
    data = MODEL_SETS[cell.name](cell.seed)
    scaler = StandardScaler().fit(data.X)
    data = data._replace(X=scaler.transform(data.X), X_test=scaler.transform(data.X_test))
    with harness.one_thread():
        for model in MODELS:  # imports and first allocations are not timed
            MODELS[model](data._replace(X=data.X[:30], y=data.y[:30]), 0)[1]()
    models = MODELS if len(data.X) <= EXACT_ROWS else LARGE
    return [{"n_rows": len(data.X), **measured(model, data, cell.seed)} for model in models]


def scores(rows: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    """Return means over seeds of all models of some sets; the best ones in bold."""
    rows = rows[rows["name"].isin(names)]
    rows = rows.assign(set=pd.Categorical(rows["name"], names), model=pd.Categorical(rows["model"], MODELS))
    means = rows.groupby(["set", "model"], observed=True).mean(numeric_only=True)
    texts = means.map("{:.3f}".format)
    for name in (names := ["rmse", "nlpd", "crps"]):
        won = means[name] <= means.groupby("set", observed=True)[name].transform("min") + 5e-4
        texts[name] = texts[name].mask(won, "**" + texts[name] + "**")
    texts["width"], texts["seconds"] = means["width"].map("{:.2f}".format), means["seconds"]
    found = texts[[*names, "coverage", "width", "seconds"]]
    return found.rename(columns={name: name.upper() for name in names}).reset_index()


def against_exact(rows: pd.DataFrame) -> pd.DataFrame:
    """Return what "auto" loses against GPR, and the share of its time."""
    means = rows.groupby(["model", "name"]).mean(numeric_only=True)
    of_model = means.index.get_level_values("model")
    exact, auto = (means[of_model == model].droplevel("model") for model in ("GPR", "EVGP, auto"))
    names = [name for name in ordered(MODEL_SETS, exact.index) if not name.startswith(("houses", "boxes"))]
    exact, auto = exact.loc[names], auto.loc[names]
    lost, ratio = auto["nlpd"] - exact["nlpd"], auto / exact
    columns = {
        "NLPD of GPR": exact["nlpd"].map("{:.3f}".format),
        "auto's, more": lost.map("{:+.3f}".format),
        f"within {ENOUGH}": np.where(lost <= ENOUGH, "yes", "no"),
        "points": auto["m"].map("{:.0f}".format),
        "s, GPR": exact["seconds"],
        "s, auto": auto["seconds"],
        "ratio": ratio["seconds"].map("{:.2f}".format),
        "ratio on the wall": ratio["wall_seconds"].map("{:.2f}".format),
    }
    return pd.DataFrame(columns).reset_index(names="set")


def tables_of_models(rows: pd.DataFrame) -> harness.Tables:
    return {"models": scores(rows, ordered(MODEL_SETS, rows["name"])), "auto": against_exact(rows)}


def guide(page: str, rows: pd.DataFrame) -> str:
    """Fill the tables of the guide's page: "auto", or the names of sets."""
    marked = re.findall("<!-- table: (.*) -->", page)
    tables = {name: against_exact(rows) if name == "auto" else scores(rows, name.split()) for name in marked}
    return harness.filled(page, tables)


# --- inducing points -----------------------------------------------------------------------------------------------

FITS = ("exact", "100", "auto", "grid")

Fit = namedtuple("Fit", "name seed model")


def fitted(data: Data, model: str, seed: int) -> tuple[Any, dict[str, Any]]:
    """Fit a model; return it with its scores."""
    common = {"feature_map": data.feature_map, "normalize_y": data.feature_map is None, "random_state": seed}
    sparse = model != "exact"
    regressor: Any = EGPRegressor(**common)
    if sparse:  # without calibration, as the exact model
        n_inducing: Any = "auto" if model == "auto" else int(model)
        regressor = EVGPRegressor(**common, n_inducing=n_inducing, noise_cv=None)
    seconds, _ = harness.timed(lambda: regressor.fit(data.X, data.y))
    mean, std = regressor.predict(data.X_test, return_std=True)
    return regressor, {
        "m": len(regressor.inducing_points_) if sparse else len(data.X),
        "n_iter": regressor.n_iter_,
        "seconds": round(seconds, 3),
        "nlpd": negative_log_predictive_density(data.y_test, mean, std),
        "lower": regressor.lower_bound_ if sparse else regressor.log_marginal_likelihood_value_,
        "upper": regressor.upper_bound_ if sparse else "",
    }


def likelihood_of(regressor: EVGPRegressor, data: Data) -> float:
    """Return the exact log marginal likelihood at a sparse model's parameters."""
    exact = EGPRegressor(
        data.feature_map,
        regressor.kernel_,
        noise=Gaussian(variance=regressor.noise_variance_),
        normalize_y=data.feature_map is None,
        max_iter=0,
    )
    return exact.fit(data.X, data.y).log_marginal_likelihood_value_


def run_inducing(cell: Fit) -> dict[str, Any]:
    """Fit one model. "grid" is the smallest of the grid that is good enough."""
    data = INDUCING_SETS[cell.name](cell.seed)
    if cell.model == "grid":
        _, exact = fitted(data, "exact", cell.seed)
        seconds = 0.0
        for m in GRID:
            regressor, row = fitted(data, str(m), cell.seed)
            seconds += row["seconds"]
            if m >= len(data.X) or row["nlpd"] <= exact["nlpd"] + ENOUGH:
                break
        row |= {"seconds": seconds}
    else:
        regressor, row = fitted(data, cell.model, cell.seed)
    with harness.one_thread():
        likelihood = row["lower"] if cell.model == "exact" else likelihood_of(regressor, data)
    return {"n_rows": len(data.X), **row, "likelihood": likelihood}


def tables_of_inducing(rows: pd.DataFrame) -> harness.Tables:
    """Return NLPD lost against the exact model, numbers of points and times, and counts of sets."""
    means = rows.groupby(["model", "name"]).mean(numeric_only=True)
    names = ordered(INDUCING_SETS, means.loc["auto"].index)
    exact, hundred, auto, grid = (means.loc[model].loc[names] for model in FITS)
    ratio, lost = auto["m"] / grid["m"], auto["nlpd"] - exact["nlpd"]
    columns = {
        "rows": exact["m"].map("{:.0f}".format),
        "NLPD, exact": exact["nlpd"].map("{:.3f}".format),
        "lost, m = 100": (hundred["nlpd"] - exact["nlpd"]).map("{:.3f}".format),
        "lost, auto": lost.map("{:.3f}".format),
        "smallest m": grid["m"].map("{:.0f}".format),
        "auto's m": auto["m"].map("{:.0f}".format),
        "ratio": ratio.map("{:.2f}".format),
    }
    for header, own in {"s, exact": exact, "s, m = 100": hundred, "s, auto": auto}.items():
        columns[header] = own["seconds"].map("{:.1f}".format)
    sparse = rows.dropna(subset="upper")
    covered = sparse["upper"] >= sparse["likelihood"] - 1e-6 * sparse["likelihood"].abs()
    counts = {
        f"sets within {ENOUGH} nats per row of the exact model": lost <= ENOUGH,
        "sets where auto's m is at most twice the smallest m": ratio <= 2.0,
        "fits whose upper bound covers the exact log marginal likelihood": covered,
    }
    lines = [(name, f"{held.sum()} of {len(held)}") for name, held in counts.items()]
    return {
        "inducing": pd.DataFrame(columns).reset_index(names="set"),
        "counts": pd.DataFrame(lines, columns=["", "count"]),
    }


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="two small sets, one seed", seeds=3)
    parser.add_argument("part", choices=("models", "inducing"))
    known = sorted({*MODEL_SETS, *INDUCING_SETS})
    parser.add_argument("--sets", nargs="+", choices=known, metavar="SET", help=f"of {', '.join(known)}; default: all")
    options = harness.parse(parser)
    if options.part == "models":
        output, sets, quick = harness.output_path(options, "tabular"), MODEL_SETS, ("diabetes", "toy-200")
    else:
        output, sets, quick = harness.output_path(options, "auto_inducing"), INDUCING_SETS, ("linear-5", "toy-200")
    names = [name for name in options.sets or (quick if options.quick else sets) if name in sets]
    if options.part == "models":
        cells = [Drawing(name, seed) for seed in options.seeds for name in names]
        n_failures = harness.run_missing(cells, run_models, output, options.jobs)
        rows = harness.frame(output)
        if options.output is None and not options.quick:
            PAGE.write_text(guide(PAGE.read_text(), rows))
        harness.write_page("Tables of data", tables_of_models(rows), output, n_failures)
    else:
        fits = [Fit(name, seed, model) for seed in options.seeds for model in FITS for name in names]
        n_failures = harness.run_missing(fits, run_inducing, output, options.jobs)
        tables = tables_of_inducing(harness.frame(output))
        harness.write_page("Automatic number of inducing points", tables, output, n_failures)


if __name__ == "__main__":
    main()
