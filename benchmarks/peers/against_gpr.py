"""EVGPRegressor against scikit-learn's GaussianProcessRegressor as the number of rows grows.

The script measures time, memory, error and NLPD of fits to the first N rows of a data set, in random order. Data sets
are the paper's pendulum and cartpole without noise, where models learn the change of the state, and a smooth function
of 8 columns with noise. Each fit runs in a separate process on one thread.

    python benchmarks/peers/against_gpr.py          # half an hour to an hour of one core
    python benchmarks/peers/against_gpr.py --quick  # 50 and 150 rows: under a minute
    python benchmarks/peers/against_gpr.py --systems smooth --time-limit 1500  # an exact fit to more rows

Without features, "GPR" is scikit-learn's model, with ConstantKernel * RBF (a lengthscale per column) + WhiteKernel. It
has ``normalize_y=True`` and its own optimizer, and all columns of y share kernel and noise. "EGP" and "EVGP" (100
inducing points) are skevgp's with their defaults. The CSV also has the exact counterpart of each EVGP: GPR with the
EVGP's kernel and noise, without an optimizer. With gravity's features there are "EGP-IFG" and "EVGP-IFG" (the paper's
10 or 60 inducing points). A fit is left out if it would take longer than --time-limit, estimated from smaller ones.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections import namedtuple
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
import pandas as pd
from sklearn.base import RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

import harness
from harness import ordered
from paper.models import Fit, build
from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForceGravity
from skevgp.metrics import negative_log_predictive_density, prediction_error

SYSTEMS = ("pendulum", "cartpole", "smooth")
# The data sets of systems end before the larger sizes.
SIZES, QUICK_SIZES = (125, 250, 500, 1000, 2000, 4000, 10_000, 30_000, 100_000), (50, 150)
N_ROWS = 4800
COUNTERPART_ROWS = 2000  # up to here an EVGP is compared with its exact counterpart
# Models, the largest power of N with which the time of a fit grows, and their systems.
MODELS = {
    "GPR": (3, SYSTEMS),
    "EVGP": (1, SYSTEMS),
    "EGP": (3, ("smooth",)),
    "EGP-IFG": (3, ("pendulum", "cartpole")),
    "EVGP-IFG": (1, ("pendulum", "cartpole")),
}
MEASURES = {
    "fit_seconds": "fit, s",
    "predict_seconds": "predict 1000 rows, s",
    "memory_mb": "memory, MB",
    "error": "error",
    "nlpd": "NLPD",
    "log_likelihood": "log likelihood / N",
}
# What the picture shows, and names of its axes and lines.
DRAWN = {"cartpole": "cartpole", "smooth": "smooth function of 8 columns"}
AXES = {"fit_seconds": "time of a fit (s)", "error": "mean test error (units of y)"}
NAMES = {
    "GPR": "GaussianProcessRegressor",
    "EVGP": "EVGPRegressor",
    "EGP": "EGPRegressor",
    "EGP-IFG": "EGPRegressor, physics",
    "EVGP-IFG": "EVGPRegressor, physics",
}

Cell = namedtuple("Cell", "system model n_rows seed")


def regressor_of(cell: Cell, X: np.ndarray) -> RegressorMixin:
    """Return an unfitted model."""
    features = InertiaForceGravity(cell.system) if cell.model.endswith("IFG") else None
    if cell.model == "GPR":
        # Bounds for data without noise, of which skevgp's is the floor.
        signal = ConstantKernel(1.0, (1e-6, 1e9)) * RBF(X.std(axis=0), (1e-3, 1e6))
        return GaussianProcessRegressor(signal + WhiteKernel(1e-2, (1e-10, 10.0)), normalize_y=True)
    if cell.model.startswith("EGP"):
        return EGPRegressor(features, random_state=cell.seed)
    if cell.model == "EVGP":
        return EVGPRegressor(n_inducing=100, random_state=cell.seed)
    return build(Fit(cell.system, "EVGP-IFG", "skevgp", cell.seed, "full", None))


class Rows(NamedTuple):
    """Inputs, observations, and observations without noise."""

    X: np.ndarray
    y: np.ndarray
    truth: np.ndarray


def data(cell: Cell) -> tuple[Rows, Rows]:
    """Return training and test rows. The rows of a smaller N are among those of a larger one."""
    if cell.system == "smooth":
        pieces = harness.noisy_waves(N_ROWS, 8, np.random.RandomState(cell.seed))
        test = Rows(*next(pieces))
        train = zip(*itertools.islice(pieces, -(-cell.n_rows // N_ROWS)), strict=True)
        return Rows(*(np.concatenate(own)[: cell.n_rows] for own in train)), test
    rows = []
    for random_state in (cell.seed, 1000 + cell.seed):
        X, y = make_dynamics(cell.system, random_state=random_state, return_X_y=True)
        # The prior of features speaks of the next state, other models learn the change of the state.
        change = y if cell.model.endswith("IFG") else y - X[:, : y.shape[1]]
        rows.append(Rows(X, change, change))
    order = np.random.RandomState(cell.seed).permutation(len(rows[0].X))[: cell.n_rows]
    return Rows(*(a[order] for a in rows[0])), rows[1]


def density(test: Rows, mean: np.ndarray, std: np.ndarray) -> float:
    """Return the NLPD; NaN where GPR has rounded a negative variance up to 0."""
    return negative_log_predictive_density(test.y, mean, std) if (std > 0.0).all() else np.nan


def log_likelihood(regressor: Any, y: np.ndarray) -> float:
    """Return it in nats of the units of y, summed over outputs; of an EVGP its lower bound."""
    if isinstance(regressor, EVGPRegressor):
        return regressor.lower_bound_
    value = float(regressor.log_marginal_likelihood_value_)
    if isinstance(regressor, GaussianProcessRegressor) and regressor.normalize_y:
        value -= len(y) * float(np.log(y.std(axis=0)).sum())
    return value


def counterpart(evgp: EVGPRegressor, train: Rows, test: Rows) -> dict[str, float]:
    """Predict by the exact GP with the EVGP's kernel and noise, which are per output."""
    kernels = evgp.kernel_ if isinstance(evgp.kernel_, list) else [evgp.kernel_]
    parts, value = [], 0.0
    for kernel, noise, y in zip(kernels, np.ravel(evgp.noise_variance_), np.atleast_2d(train.y.T), strict=True):
        exact = GaussianProcessRegressor(kernel, alpha=noise, optimizer=None).fit(train.X, y)
        value += exact.log_marginal_likelihood_value_
        mean, std = exact.predict(test.X, return_std=True)
        parts.append((mean, np.sqrt(std**2 + noise)))
    mean, std = (np.column_stack(columns).reshape(test.y.shape) for columns in zip(*parts, strict=True))
    return {
        "counterpart_error": prediction_error(test.truth, mean),
        "counterpart_nlpd": density(test, mean, std),
        "counterpart_log_likelihood": value,
    }


def run(cell: Cell) -> dict[str, Any]:
    """Fit and predict, and measure both."""
    train, test = data(cell)
    regressor = regressor_of(cell, train.X)
    with harness.one_thread():
        # Imports and first allocations are not measured.
        regressor_of(cell, train.X).fit(train.X[:10], train.y[:10]).predict(test.X[:10], return_std=True)
        with harness.peak_memory() as memory:
            fit_seconds, caught = harness.timed(lambda: regressor.fit(train.X, train.y))
        start = time.process_time()
        mean, std = regressor.predict(test.X, return_std=True)
        predict_seconds = time.process_time() - start
        exact = dict.fromkeys(("counterpart_error", "counterpart_nlpd", "counterpart_log_likelihood"), np.nan)
        if cell.model == "EVGP" and cell.n_rows <= COUNTERPART_ROWS:
            # With hardly any noise the matrix can be singular.
            with suppress(np.linalg.LinAlgError):
                exact = counterpart(regressor, train, test)
    convergence = [str(warning.message) for warning in caught if issubclass(warning.category, ConvergenceWarning)]
    return {
        "m": regressor.inducing_points_.shape[-2] if isinstance(regressor, EVGPRegressor) else "",
        "fit_seconds": fit_seconds,
        "predict_seconds": 1000.0 * predict_seconds / len(test.X),
        "memory_mb": memory(),
        "error": prediction_error(test.truth, mean),
        "nlpd": density(test, mean, std),
        "zero_std": np.mean(std <= 0.0),
        "log_likelihood": log_likelihood(regressor, train.y),
        **exact,
        "converged": not convergence,
        "warning": convergence[0].splitlines()[0][:120] if convergence else "",
    }


def expected_seconds(path: Path, cell: Cell) -> float:
    """Return what a fit takes at most, judged by the largest smaller one in the CSV."""
    if not path.exists():
        return 0.0
    rows = harness.frame(path, system=cell.system, model=cell.model, seed=cell.seed)
    smaller = rows[rows["n_rows"] < cell.n_rows].sort_values("n_rows").tail(1)
    return sum(smaller["fit_seconds"] * (cell.n_rows / smaller["n_rows"]) ** MODELS[cell.model][0])


def tables_of(rows: pd.DataFrame) -> harness.Tables:
    """Return exponents over the four largest sizes, and a table of all measures per data set."""
    means = rows.groupby(["system", "model", "n_rows"]).mean(numeric_only=True)
    for name in ("log_likelihood", "counterpart_log_likelihood"):
        means[name] = means[name] / means.index.get_level_values("n_rows")
    exponents, tables = [], {}
    for system in ordered(SYSTEMS, rows["system"]):
        own, parts = means.loc[system], []
        models = ordered(MODELS, own.index.get_level_values("model"))
        for name, measure in MEASURES.items():
            parts += [own.loc[model, name].rename((measure, model)) for model in models]
            if f"counterpart_{name}" in own and "EVGP" in models:
                exact = own.loc["EVGP", f"counterpart_{name}"].dropna()
                parts.append(exact.rename((measure, "EVGP, made exact")))
        table = pd.DataFrame(parts).rename(columns=str)
        table.insert(0, "", [measure for measure, _ in table.index])
        table.insert(1, "model", [model for _, model in table.index])
        tables[system] = table
        for model in models:
            last = own.loc[model].tail(4)
            line = {"data": system, "model": model, "largest N": str(last.index[-1]), "time": "", "memory": ""}
            if len(last) > 1:
                y = np.log(last[["fit_seconds", "memory_mb"]].clip(lower=1e-9))
                line["time"], line["memory"] = map("{:.2f}".format, np.polyfit(np.log(last.index), y, 1)[0])
            exponents.append(line)
    return {"exponents": pd.DataFrame(exponents), **tables}


def plot(rows: pd.DataFrame, path: Path) -> None:
    """Draw time and error over N; a column of panels for each of two data sets."""
    systems = ordered(DRAWN, rows["system"]) or ordered(SYSTEMS, rows["system"])[:2]
    options = {"figsize": (harness.WIDTH, 5.8), "squeeze": False, "sharex": "col"}
    figure, grid = harness.pyplot().subplots(len(AXES), len(systems), **options)
    for panels, system in zip(grid.T, systems, strict=True):
        panels[0].set_title(DRAWN.get(system, system))
        panels[-1].set_xlabel("training rows, N")
        for axes, name in zip(panels, AXES, strict=True):
            for model, colour, marker in zip(MODELS, harness.PALETTE, "sDov^", strict=False):
                own = rows[(rows["system"] == system) & (rows["model"] == model)].groupby("n_rows")[name].mean()
                if len(own):
                    axes.plot(own, f"{marker}-", color=colour, label=NAMES[model])
            harness.logarithmic(axes)
        harness.logarithmic(panels[-1], "x")
    for axes, label in zip(grid[:, 0], AXES.values(), strict=True):
        axes.set_ylabel(label)
    harness.legend(figure, ncols=3)
    harness.save_picture(figure, path)


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="50 and 150 rows", seeds=1, systems=SYSTEMS)
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    parser.add_argument("--sizes", nargs="+", type=int, help="rows; default: 125 to 4000, smooth to 100,000")
    said = "seconds a fit may be expected to take; default: %(default)g"
    parser.add_argument("--time-limit", type=float, default=300.0, help=said)
    options = harness.parse(parser)
    output, n_failures = harness.output_path(options, "against_gpr"), 0
    # One size after the other, since the time of a size tells that of the next.
    for n_rows in sorted(options.sizes or (QUICK_SIZES if options.quick else SIZES)):
        cells = [
            cell
            for seed in options.seeds
            for system in options.systems
            for model in options.models
            if system in MODELS[model][1] and (system == "smooth" or n_rows <= N_ROWS)
            if expected_seconds(output, cell := Cell(system, model, n_rows, seed)) <= options.time_limit
        ]
        n_failures += harness.run_missing(cells, run, output, options.jobs, fresh=True)
    rows = harness.frame(output)
    plot(rows, output.with_suffix(".png"))
    harness.write_page("EVGPRegressor and GaussianProcessRegressor as N grows", tables_of(rows), output, n_failures)


if __name__ == "__main__":
    main()
