"""How many inducing points does ``n_inducing="auto"`` find, and are they enough?

On twenty sets of at most 3,000 rows, which were chosen before any of them was run: the held-out NLPD of
``EVGPRegressor(n_inducing="auto")`` against that of the exact `EGPRegressor` with its own kernel, and the number of
points against the smallest of a grid (10, 15, 23, 34, ..., a factor of 1.5 each) whose fit comes within 0.02 nats per
row of the exact one. Beside them the default of 100 points. Is the upper bound above the exact log marginal likelihood
at the same parameters? Writes a row per fit to a CSV (what is there is not run again), and from it a Markdown page.

    python benchmarks/auto_inducing.py                       # hours of one core
    python benchmarks/auto_inducing.py --seeds 1 --jobs 2
    python benchmarks/auto_inducing.py --quick               # two small sets, one seed
    python benchmarks/auto_inducing.py --sets toy-200 linear-5
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import TransformerMixin
from sklearn.datasets import load_diabetes, make_friedman1, make_friedman2, make_friedman3
from threadpoolctl import threadpool_limits

import harness
from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import make_dynamics, make_toy
from skevgp.features import InertiaForceGravity
from skevgp.metrics import negative_log_predictive_density
from skevgp.noise import Gaussian

# Held-out NLPD that may be lost against the exact model, in nats per row.
ENOUGH = 0.02
N_TEST = 1000
GRID = tuple(int(np.ceil(10 * 1.5**k)) for k in range(13))


class Data(NamedTuple):
    """Rows to learn from, rows held out, and the feature map if there is one."""

    X: np.ndarray
    y: np.ndarray
    X_test: np.ndarray
    y_test: np.ndarray
    feature_map: TransformerMixin | None = None


Draw = Callable[[int, np.random.RandomState], tuple[np.ndarray, np.ndarray]]


def drawn(draw: Draw, n_rows: int, seed: int) -> Data:
    """Rows of which those that are held out follow the others."""
    X, y = draw(n_rows + N_TEST, np.random.RandomState(seed))
    # Some come in order.
    order = np.random.RandomState(1000 + seed).permutation(len(X))
    (train, test), y = (order[:n_rows], order[n_rows:]), y / y[order[:n_rows]].std(axis=0)
    return Data(X[train], y[train], X[test], y[test])


def toy(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    return make_toy(n, random_state=rng, return_X_y=True)


def sines(n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """Eight of them, one of each column, added."""
    X = rng.uniform(-2.0, 2.0, (n, 8))
    return X, np.sin(2.0 * X).sum(axis=1) + 0.3 * rng.randn(n)


def waves(n_columns: int, n: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    X, y, _ = next(harness.noisy_waves(n, n_columns, rng))
    return X, y


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
    """The change of the last velocity over a step; of other trajectories to test."""
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


# Named before any of them was run.
SETS: dict[str, Callable[[int], Data]] = {
    "toy-200": partial(drawn, toy, 200),
    "toy-1000": partial(drawn, toy, 1000),
    "friedman1": partial(drawn, lambda n, rng: make_friedman1(n, noise=1.0, random_state=rng), 800),
    "friedman1-quiet": partial(drawn, lambda n, rng: make_friedman1(n, noise=0.1, random_state=rng), 800),
    "friedman2": partial(drawn, lambda n, rng: make_friedman2(n, random_state=rng), 800),
    "friedman3": partial(drawn, lambda n, rng: make_friedman3(n, noise=0.1, random_state=rng), 800),
    "sines-8": partial(drawn, sines, 800),
    "diabetes": diabetes,
    "waves-2": partial(drawn, partial(waves, 2), 1000),
    "waves-6": partial(drawn, partial(waves, 6), 1000),
    "linear-5": partial(drawn, linear, 600),
    "nothing-3": partial(drawn, nothing, 500),
    "steps-1": partial(drawn, steps, 400),
    "chirp-1": partial(drawn, chirp, 600),
    "pendulum": partial(dynamics, "pendulum", 600, 0.0, False),
    "pendulum-ifg": partial(dynamics, "pendulum", 600, 0.01, True),
    "cartpole": partial(dynamics, "cartpole", 800, 0.01, False),
    "acrobot": partial(dynamics, "acrobot", 800, 0.0, False),
    "acrobot-ifg": partial(dynamics, "acrobot", 800, 0.01, True),
    "iiwa14": partial(dynamics, "iiwa14", 800, 0.0, False),
}
QUICK_SETS = ("linear-5", "toy-200")


@dataclass(frozen=True)
class Cell:
    """All fits to one drawing of one set."""

    name: str
    seed: int
    model: str = "auto"


def fitted(data: Data, model: str, seed: int) -> tuple[Any, dict[str, Any]]:
    """A model, and its row."""
    common = {"feature_map": data.feature_map, "normalize_y": data.feature_map is None, "random_state": seed}
    regressor: Any
    if model == "exact":
        regressor = EGPRegressor(**common)
    else:
        n_inducing: Any = "auto" if model == "auto" else int(model)
        # The exact model does not calibrate.
        regressor = EVGPRegressor(**common, n_inducing=n_inducing, noise_cv=None)
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start = time.process_time()
        regressor.fit(data.X, data.y)
        seconds = time.process_time() - start
        mean, std = regressor.predict(data.X_test, return_std=True)
    sparse = model != "exact"
    return regressor, {
        "model": model,
        "m": len(regressor.inducing_points_) if sparse else len(data.X),
        "n_iter": regressor.n_iter_,
        "seconds": round(seconds, 3),
        "nlpd": negative_log_predictive_density(data.y_test, mean, std),
        "lower": regressor.lower_bound_ if sparse else regressor.log_marginal_likelihood_value_,
        "upper": regressor.upper_bound_ if sparse else "",
    }


def likelihood_of(regressor: EVGPRegressor, data: Data) -> float:
    """The exact log marginal likelihood at a sparse model's parameters."""
    exact = EGPRegressor(
        data.feature_map,
        regressor.kernel_,
        noise=Gaussian(variance=regressor.noise_variance_),
        normalize_y=data.feature_map is None,
        max_iter=0,
    )
    return exact.fit(data.X, data.y).log_marginal_likelihood_value_


def run(cell: Cell) -> dict[str, Any]:
    """One model on one drawing; "grid" is the smallest of the grid that is good enough."""
    data = SETS[cell.name](cell.seed)
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        likelihood = row["lower"] if cell.model == "exact" else likelihood_of(regressor, data)
    own = {"name": cell.name, "seed": cell.seed, "n_rows": len(data.X)}
    return {**own, **row, "model": cell.model, "likelihood": likelihood, **harness.provenance()}


def say(row: dict[str, Any]) -> str:
    return f"m = {row['m']}, NLPD {row['nlpd']:.3f}, {row['n_iter']} iterations, {row['seconds']:.1f} s"


MODELS = ("exact", "100", "auto", "grid")


def mean_of(rows: Sequence[harness.Row], name: str, model: str, value: str, beside: str = "auto") -> float:
    """Over the seeds that another model has too; not a number where there is none."""
    seeds = {row["seed"] for row in rows if (row["name"], row["model"]) == (name, beside)}
    own = [row for row in rows if (row["name"], row["model"]) == (name, model) and row["seed"] in seeds]
    return float(np.mean(harness.column(own, value))) if own else np.nan


def report(rows: Sequence[harness.Row]) -> Iterator[str]:
    """The page's paragraphs."""
    names = [name for name in SETS if any((row["name"], row["model"]) == (name, "auto") for row in rows)]
    if not names:
        return
    lines, near, lean = [], 0, 0
    for name in names:
        of = partial(mean_of, rows, name)
        lost = {model: of(model, "nlpd") - of("exact", "nlpd", model) for model in ("100", "auto")}
        ratio = of("auto", "m", "grid") / of("grid", "m")
        near, lean = near + bool(lost["auto"] <= ENOUGH), lean + bool(ratio <= 2.0)
        seconds = (f"{of(model, 'seconds'):.1f}" for model in ("exact", "100", "auto"))
        numbers = (of("exact", "nlpd"), lost["100"], lost["auto"])
        points = (f"{of('grid', 'm'):.0f}", f"{of('auto', 'm'):.0f}", f"{ratio:.2f}")
        lines.append([name, f"{of('exact', 'm'):.0f}", *(f"{number:.3f}" for number in numbers), *points, *seconds])
    sparse = [row for row in rows if row["upper"]]
    covered = sum(
        float(row["upper"]) >= float(row["likelihood"]) - 1e-6 * abs(float(row["likelihood"])) for row in sparse
    )
    seeds = sorted({int(row["seed"]) for row in rows})
    yield f"# Inducing points that are chosen\n\nMeans over seeds {', '.join(map(str, seeds))}."
    header = ["set", "rows", "NLPD, exact", "lost, m = 100", "lost, auto", "smallest m", "auto's m", "ratio"]
    yield harness.table([*header, "s, exact", "s, m = 100", "s, auto"], lines)
    yield f"Within {ENOUGH} nats per row of the exact model: {near} of {len(names)}."
    yield f"At most twice the smallest number of the grid that is: {lean} of {len(names)}."
    yield f"The upper bound covers the exact log marginal likelihood in {covered} of {len(sparse)} fits."
    yield harness.provenance_text(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = harness.argument_parser(__doc__, quick="two small sets, one seed", seeds="seeds 0, 1, ...; default: 3")
    parser.add_argument("--sets", nargs="+", choices=SETS, help="default: all")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    options = parser.parse_args(arguments)
    output = harness.output_path(options, "auto_inducing")
    names = options.sets or (QUICK_SETS if options.quick else SETS)
    seeds = range(options.seeds or (1 if options.quick else 3))
    cells = [Cell(name, seed, model) for seed in seeds for model in options.models for name in names]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    harness.write_report(report(harness.read(output)), output, n_failures)


if __name__ == "__main__":
    main()
