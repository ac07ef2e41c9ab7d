"""Tables: EVGPRegressor beside scikit-learn's exact Gaussian process, gradient boosting and Bayesian ridge regression.

RMSE, NLPD, CRPS, coverage of 90 % intervals and time on scikit-learn's own sets and on made ones, of which two are as
trees like them: boxes, and a set like California's houses (prices that jump between districts, skewed columns; the real
one would have to be downloaded). All models have their defaults, and see columns and targets of variance one. Does
``EVGPRegressor(n_inducing="auto")`` cost accuracy against `GaussianProcessRegressor` (a lengthscale per column,
optimised), and how much of its time does it take? Models of a set and seed are fitted one after the other in one
process with one thread, so that ratios of times are of the same run. Writes a row per fit to a CSV (what is there is
not run again), from it a Markdown page, and the tables of docs/guide/boosting.md.

    python benchmarks/tabular.py            # some hours of one core
    python benchmarks/tabular.py --quick    # two small sets, one seed
    python benchmarks/tabular.py --sets diabetes friedman1-2000 --seeds 1
"""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm
from sklearn.base import RegressorMixin
from sklearn.datasets import make_friedman1, make_friedman2, make_friedman3
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.linear_model import BayesianRidge
from sklearn.model_selection import cross_val_predict
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

import harness
from auto_inducing import ENOUGH, Data, diabetes, drawn, sines, toy
from skevgp import EVGPRegressor
from skevgp.metrics import containing_ratios, crps, negative_log_predictive_density

COVERAGE = 0.9
HALF_WIDTH = float(norm.ppf(0.5 + COVERAGE / 2))
# Up to here there are the exact model and "auto".
EXACT_ROWS = 2000
# Quantiles may meet or cross: a standard deviation is at least this share of that of y.
SMALLEST_STD = 1e-3


def houses(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """Like California's: prices jump between districts, people and rooms are skewed; few are cut off at 5."""
    place, age = rng.uniform(0.0, 6.0, (n, 2)), rng.randint(1, 53, n)
    income, people = np.exp(1.2 + 0.45 * rng.randn(n)), np.exp(7.0 + 0.7 * rng.randn(n))
    rooms = np.exp(1.6 + 0.1 * income / 3 + 0.3 * rng.randn(n))
    bedrooms, household = rooms / 5.0 * np.exp(0.1 * rng.randn(n)), np.exp(1.0 + 0.3 * rng.randn(n))
    district = rng.randn(6, 6)[*place.astype(int).T]
    price = 0.4 * income - 0.3 * np.log(household) + 0.6 * district + 0.01 * age * (place[:, 0] < 2.0)
    price = np.minimum(price * np.exp(0.15 * rng.randn(n)), 5.0)
    return np.column_stack([income, age, rooms, bedrooms, people, household, place]), price


def boxes(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """Ten columns; inside each of forty boxes, of three columns each, y is higher or lower by a constant."""
    X, y = rng.uniform(0.0, 1.0, (n, 10)), 0.3 * rng.randn(n)
    for _ in range(40):
        columns = rng.choice(10, 3, replace=False)
        y += rng.randn() * ((X[:, columns] > rng.uniform(0.2, 0.8, 3)) == (rng.rand(3) > 0.5)).all(axis=1)
    return X, y


def friedman(make: Callable[..., Any], noise: float, n: int, rng: np.random.RandomState) -> tuple[Any, Any]:
    return make(n, noise=noise, random_state=rng)


# Friedman's own standard deviations of the noise (1991); the quiet one has none.
FRIEDMAN = {
    "friedman1": partial(friedman, make_friedman1, 1.0),
    "friedman2": partial(friedman, make_friedman2, 125.0),
    "friedman3": partial(friedman, make_friedman3, 0.1),
}
SETS: dict[str, Callable[[int], Data]] = {
    "diabetes": diabetes,
    "toy-200": partial(drawn, toy, 200),
    **{f"{name}-{n}": partial(drawn, draw, n) for n in (800, 2000) for name, draw in FRIEDMAN.items()},
    "friedman2-quiet-800": partial(drawn, partial(friedman, make_friedman2, 0.0), 800),
    "sines-800": partial(drawn, sines, 800),
    "sines-2000": partial(drawn, sines, 2000),
    "houses-2000": partial(drawn, houses, 2000),
    "houses-20000": partial(drawn, houses, 20_000),
    "boxes-2000": partial(drawn, boxes, 2000),
}
QUICK_SETS = ("diabetes", "toy-200")
# In which the two Gaussian processes are compared.
COMPARED = tuple(name for name in SETS if not name.startswith(("houses", "boxes")))


@dataclass(frozen=True)
class Cell:
    """All models of a drawing of a set."""

    name: str
    seed: int


class Predicted(NamedTuple):
    """A mean, a standard deviation, and an interval."""

    mean: np.ndarray
    std: np.ndarray
    low: np.ndarray
    high: np.ndarray


def gaussian(regressor: Any, data: Data) -> tuple[Any, Callable[[], Predicted]]:
    """Of a regressor with ``return_std``."""
    regressor.fit(data.X, data.y)

    def predict() -> Predicted:
        mean, std = regressor.predict(data.X_test, return_std=True)
        return Predicted(mean, std, mean - HALF_WIDTH * std, mean + HALF_WIDTH * std)

    return regressor, predict


def boosted(data: Data, seed: int, folds: bool) -> tuple[None, Callable[[], Predicted]]:
    """A fit for the mean, and for the std two quantiles, or the errors of five folds that were left out."""
    make = partial(HistGradientBoostingRegressor, random_state=seed)
    mean_model = make().fit(data.X, data.y)
    if folds:
        std = np.sqrt(np.mean((data.y - cross_val_predict(make(), data.X, data.y, cv=5)) ** 2))
    else:
        levels = (0.5 - COVERAGE / 2, 0.5 + COVERAGE / 2)
        ends = [make(loss="quantile", quantile=level).fit(data.X, data.y) for level in levels]

    def predict() -> Predicted:
        mean = mean_model.predict(data.X_test)
        if folds:
            return Predicted(mean, np.full(len(mean), std), mean - HALF_WIDTH * std, mean + HALF_WIDTH * std)
        low, high = (end.predict(data.X_test) for end in ends)
        return Predicted(mean, np.maximum((high - low) / (2 * HALF_WIDTH), SMALLEST_STD), low, high)

    return None, predict


def exact(n_columns: int) -> RegressorMixin:
    """Bounds for data without noise too, and a start at little noise, as skevgp has it."""
    signal = ConstantKernel(1.0, (1e-6, 1e9)) * RBF(np.ones(n_columns), (1e-3, 1e6))
    return GaussianProcessRegressor(signal + WhiteKernel(1e-2, (1e-10, 10.0)), normalize_y=True, random_state=0)


Fitting = Callable[[Data, int], tuple[Any, Callable[[], Predicted]]]
MODELS: dict[str, Fitting] = {
    "EVGP, auto": lambda data, seed: gaussian(
        EVGPRegressor(n_inducing="auto", normalize_y=True, random_state=seed), data
    ),
    "EVGP, 100": lambda data, seed: gaussian(EVGPRegressor(normalize_y=True, random_state=seed), data),
    "GPR": lambda data, seed: gaussian(exact(data.X.shape[1]), data),
    "boosting, quantiles": lambda data, seed: boosted(data, seed, folds=False),
    "boosting, folds": lambda data, seed: boosted(data, seed, folds=True),
    "BayesianRidge": lambda data, seed: gaussian(BayesianRidge(), data),
}
# Of more rows than EXACT_ROWS; points that are added until they cost nothing would take hours too.
LARGE = tuple(name for name in MODELS if name not in ("GPR", "EVGP, auto"))


def standardised(data: Data) -> Data:
    """With columns of mean 0 and variance 1 among the rows of the fit."""
    scaler = StandardScaler().fit(data.X)
    return data._replace(X=scaler.transform(data.X), X_test=scaler.transform(data.X_test))


def measured(model: str, data: Data, seed: int) -> dict[str, Any]:
    """A model's row."""
    with threadpool_limits(1), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        wall, start = time.perf_counter(), time.process_time()
        regressor, predict = MODELS[model](data, seed)
        seconds, wall_seconds = time.process_time() - start, time.perf_counter() - wall
        start = time.process_time()
        mean, std, low, high = predict()
        predict_seconds = time.process_time() - start
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


def run(cell: Cell) -> list[dict[str, Any]]:
    data = standardised(SETS[cell.name](cell.seed))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for model in MODELS:  # what is imported and allocated once is not a fit's
            MODELS[model](data._replace(X=data.X[:30], y=data.y[:30]), 0)[1]()
    own = {"name": cell.name, "seed": cell.seed, "n_rows": len(data.X)}
    models = MODELS if len(data.X) <= EXACT_ROWS else LARGE
    return [{**own, **measured(model, data, cell.seed), **harness.provenance()} for model in models]


def say(rows: list[dict[str, Any]]) -> str:
    return "; ".join(f"{row['model']} NLPD {row['nlpd']:.3f} in {row['seconds']:.1f} s" for row in rows)


SCORES = ("set", "model", "RMSE", "NLPD", "CRPS", "coverage", "width", "seconds")
AGAINST_EXACT = (
    *("set", "NLPD of GPR", "auto's, more", f"within {ENOUGH}"),
    *("points", "s, GPR", "s, auto", "ratio", "ratio on the wall"),
)
# Its tables are these.
PAGE = Path(__file__).parents[1] / "docs" / "guide" / "boosting.md"


def mean_of(rows: Sequence[harness.Row], name: str, model: str, value: str) -> float:
    """Over seeds; not a number where there is none."""
    own = [row for row in rows if (row["name"], row["model"]) == (name, model)]
    return float(np.mean(harness.column(own, value))) if own else np.nan


def names_in(rows: Sequence[harness.Row]) -> list[str]:
    return [name for name in SETS if any(row["name"] == name for row in rows)]


def scores(rows: Sequence[harness.Row], names: Sequence[str]) -> Iterator[list[str]]:
    """Lines of all models of some sets."""
    for name in names:
        models = [model for model in MODELS if np.isfinite(mean_of(rows, name, model, "nlpd"))]
        for model in models:
            of = partial(mean_of, rows, name, model)
            best = {
                value: of(value) <= min(mean_of(rows, name, other, value) for other in models) + 5e-4
                for value in ("rmse", "nlpd", "crps")
            }
            numbers = [f"**{of(value):.3f}**" if best[value] else f"{of(value):.3f}" for value in best]
            times = [f"{of('coverage'):.3f}", f"{of('width'):.2f}", harness.figure_of(of("seconds"))]
            yield [name, model, *numbers, *times]


def against_exact(rows: Sequence[harness.Row]) -> Iterator[list[str]]:
    """What "auto" loses against GPR, and the share of its time."""
    for name in names_in(rows):
        if name in COMPARED:
            exact, auto = (partial(mean_of, rows, name, model) for model in ("GPR", "EVGP, auto"))
            lost = auto("nlpd") - exact("nlpd")
            times = [harness.figure_of(of("seconds")) for of in (exact, auto)]
            ratios = [f"{auto(time) / exact(time):.2f}" for time in ("seconds", "wall_seconds")]
            points = f"{auto('m'):.0f}"
            near = "yes" if lost <= ENOUGH else "no"
            yield [name, f"{exact('nlpd'):.3f}", f"{lost:+.3f}", near, points, *times, *ratios]


def report(rows: Sequence[harness.Row]) -> Iterator[str]:
    """The page's paragraphs."""
    if not rows:
        return
    seeds = sorted({int(row["seed"]) for row in rows})
    yield (
        "# Tables of data\n\nWritten by `benchmarks/tabular.py`; its docstring says what sets and models are. Numbers "
        f"are means over seeds {', '.join(map(str, seeds))}, of y with variance one; best ones in bold. Coverage and "
        "width are those of 90 % intervals. *boosting, quantiles*: a fit for the mean and one for each end of the "
        "interval, whose width is the standard deviation's; *boosting, folds*: one standard deviation, of the errors "
        "of five folds. Seconds: of the processor, one thread."
    )
    counts = {name: len({row["seed"] for row in rows if row["name"] == name}) for name in names_in(rows)}
    fewer = [f"{name} ({count})" for name, count in counts.items() if count < len(seeds)]
    if fewer:
        yield f"Fewer seeds, the first ones: {', '.join(fewer)}."
    yield harness.table(SCORES, scores(rows, names_in(rows)))
    lines = list(against_exact(rows))
    if lines:
        near = sum(line[3] == "yes" for line in lines)
        yield '## `n_inducing="auto"` against the exact model'
        yield harness.table(AGAINST_EXACT, lines)
        yield f"Within {ENOUGH} nats per row of GPR: {near} of {len(lines)}."
    yield harness.provenance_text(rows)


def with_tables(page: str, rows: Sequence[harness.Row]) -> str:
    """A page with, below each line ``<!-- table: SETS -->``, the table of these sets or, of "auto", against GPR."""

    def filled(match: re.Match[str]) -> str:
        names = match[1].split()
        if names == ["auto"]:
            return match[0].partition("\n")[0] + "\n" + harness.table(AGAINST_EXACT, against_exact(rows))
        return match[0].partition("\n")[0] + "\n" + harness.table(SCORES, scores(rows, names))

    return re.sub(r"<!-- table: (.*) -->\n(?:\|.*\n)*", filled, page)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = harness.argument_parser(__doc__, quick="two small sets, one seed", seeds="seeds 0, 1, ...; default: 3")
    parser.add_argument("--sets", nargs="+", choices=SETS, help="default: all")
    options = parser.parse_args(arguments)
    output = harness.output_path(options, "tabular")
    names = options.sets or (QUICK_SETS if options.quick else SETS)
    seeds = range(options.seeds or (1 if options.quick else 3))
    cells = [Cell(name, seed) for seed in seeds for name in names]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say)
    rows = harness.read(output)
    if rows and options.output is None and not options.quick:
        PAGE.write_text(with_tables(PAGE.read_text(), rows))
    harness.write_report(report(rows), output, n_failures)


if __name__ == "__main__":
    main()
