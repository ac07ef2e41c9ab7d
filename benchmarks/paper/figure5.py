"""The paper's Figure 5: an exact and a sparse GP on Snelson's points, without and with a line as explicit features.

The models are scikit-learn's GaussianProcessRegressor (GP), the sparse GP with ten inducing points (VGP), and both with
h(x) = (1, x): EGP and EVGP. A seed draws the starts of the optimisers, the folds and, for make_toy, the data. The
picture is of seed 0.

    python benchmarks/paper/figure5.py                          # four minutes; Snelson's points are downloaded once
    python benchmarks/paper/figure5.py --data-home some/folder  # that holds train_inputs, train_outputs, test_inputs
    python benchmarks/paper/figure5.py --systems toy            # make_toy's points, which look like Snelson's
    python benchmarks/paper/figure5.py --quick                  # no restarts, three folds, one seed: seconds
"""

from __future__ import annotations

import sys
from collections import namedtuple
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
import pandas as pd
from sklearn.base import RegressorMixin, clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.model_selection import KFold
from sklearn.preprocessing import PolynomialFeatures
from sklearn.utils import Bunch

import harness
from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import fetch_snelson, make_toy
from skevgp.metrics import negative_log_predictive_density
from skevgp.plotting import PosteriorDisplay
from skevgp.solvers import LBFGS

TITLES = {
    "GP": "GP: exact, scikit-learn",
    "VGP": "VGP: 10 inducing points",
    "EGP": "EGP: exact, with h(x) = (1, x)",
    "EVGP": "EVGP: 10 inducing points, with h(x) = (1, x)",
}
EXACT = {"VGP": "GP", "EVGP": "EGP"}  # what a sparse model approximates
SOURCES = {"snelson": "Snelson's 200 points, with y ← 6y + 3x", "toy": "200 points of make_toy"}
GRID = np.linspace(-4.0, 10.0, 421)[:, np.newaxis]
FAR = 9.0  # three beyond the last observation
SIZES = {"full": (5, 10), "quick": (0, 3)}  # restarts and folds

Cell = namedtuple("Cell", "data model seed size")


def load(cell: Cell, data_home: Path | None) -> Bunch:
    if cell.data == "toy":
        return make_toy(random_state=cell.seed)
    return fetch_snelson(data_home, download_if_missing=False)


def build(cell: Cell) -> RegressorMixin:
    n_restarts, seed = SIZES[cell.size][0], cell.seed
    if cell.model == "GP":
        kernel = ConstantKernel(10.0) * RBF(1.0) + WhiteKernel(1.0)
        return GaussianProcessRegressor(kernel, n_restarts_optimizer=n_restarts, random_state=seed)
    if cell.model == "EGP":
        return EGPRegressor(PolynomialFeatures(1), n_restarts=n_restarts, random_state=seed)
    features = PolynomialFeatures(1) if cell.model == "EVGP" else None
    return EVGPRegressor(features, n_inducing=10, solver=LBFGS(n_restarts), noise_cv=None, random_state=seed)


def run(cell: Cell, data_home: Path | None) -> dict[str, Any]:
    """Fit a model to all rows, and to all rows without one fold."""
    data, model = load(cell, data_home), build(cell)
    seconds, caught = harness.timed(lambda: model.fit(data.data, data.target))
    held_out = np.empty((2, len(data.target)))
    with harness.one_thread():
        for train, test in KFold(SIZES[cell.size][1], shuffle=True, random_state=cell.seed).split(data.data):
            fold = clone(model).fit(data.data[train], data.target[train])
            held_out[:, test] = fold.predict(data.data[test], return_std=True)
    far_mean, far_std = model.predict([[FAR]], return_std=True)
    line = np.column_stack([model.coef_, model.coef_std_]) if cell.model in ("EGP", "EVGP") else np.full((2, 2), np.nan)
    kernel, noise = model.kernel_, getattr(model, "noise_variance_", None)
    if noise is None:  # scikit-learn has the noise in the kernel
        kernel, noise = kernel.k1, kernel.k2.noise_level
    return {
        "log_likelihood_or_bound": getattr(model, "lower_bound_", None) or model.log_marginal_likelihood_value_,
        "signal_std": np.sqrt(kernel.k1.constant_value),
        "length_scale": np.ravel(kernel.k2.length_scale)[0],
        "noise_std": np.sqrt(noise),
        **dict(zip(("intercept", "intercept_std", "slope", "slope_std"), line.flat, strict=True)),
        "far_mean": far_mean[0],
        "far_std": far_std[0],
        "rmse": np.sqrt(np.mean((data.target - held_out[0]) ** 2)),
        "nlpd": negative_log_predictive_density(data.target, *held_out),
        "rmse_of_truth": np.sqrt(np.mean((data.get("mean", np.nan) - model.predict(data.data)) ** 2)),
        "fit_seconds": seconds,
        "converged": not any(issubclass(warning.category, ConvergenceWarning) for warning in caught),
    }


def plot(models: dict[str, RegressorMixin], data: Bunch, path: Path) -> pd.DataFrame:
    """Draw a panel per model; return the largest differences between sparse and exact models."""
    figure, grid = harness.pyplot().subplots(2, 2, figsize=(harness.WIDTH, 6.0), sharex=True, sharey=True)
    displays, options = {}, {"x_train": data.data[:, 0], "y_train": data.target, "n_std": 1.0}
    for axes, (name, model) in zip(grid.flat, models.items(), strict=True):
        displays[name] = PosteriorDisplay.from_estimator(model, GRID, ax=axes, **options)
        intercept, slope = getattr(model, "coef_", (0.0, 0.0))
        axes.plot(GRID, intercept + slope * GRID, ":", color="black", label="explicit part: h(x)ᵀb, or 0")
        axes.set(title=TITLES[name], xlabel="x", ylabel="y", xticks=range(-2, 10, 2))
        axes.margins(x=0.0)
        axes.label_outer()
    harness.legend(figure, ncols=5)
    harness.save_picture(figure, path)
    inside = (GRID[:, 0] >= data.data.min()) & (GRID[:, 0] <= data.data.max())
    lines = []
    for name, exact in EXACT.items():
        line = {"": name}
        for part in ("mean", "std"):
            gap = np.abs(getattr(displays[name], part) - getattr(displays[exact], part))
            beyond = np.argmax(np.where(inside, 0.0, gap))
            line[f"{part}, inside"] = f"{gap[inside].max():.2f}"
            line[f"{part}, outside"] = f"{gap[beyond]:.2f} (x = {GRID[beyond, 0]:.1f})"
        lines.append(line)
    return pd.DataFrame(lines)


def table_of(data: pd.DataFrame) -> pd.DataFrame:
    """Return means over seeds."""
    means = data.groupby("model").mean(numeric_only=True).loc[list(TITLES)]

    def text(*columns: str) -> list[str]:
        texts = (means[list(columns)].round(2) + 0.0).map("{:.2f}".format)  # plus zero: no minus in front of zeros
        return texts.agg(" ± ".join, axis=1).where(means[columns[0]].notna(), "").tolist()

    columns = {"log likelihood or bound": ["log_likelihood_or_bound"], "signal std": ["signal_std"]}
    columns |= {"length scale": ["length_scale"], "noise std": ["noise_std"], "slope": ["slope", "slope_std"]}
    columns |= {f"y at x = {FAR:g}": ["far_mean", "far_std"], "RMSE": ["rmse"], "NLPD": ["nlpd"]}
    texts = {header: text(*names) for header, names in columns.items()}
    return pd.DataFrame({"model": means.index, **texts, "seconds": text("fit_seconds")})


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="no restarts, three folds, one seed",
        seeds=4,
        systems=SOURCES,
        default_systems=["snelson"],
    )
    parser.add_argument("--data-home", type=Path, help="a folder with Snelson's files; default: scikit-learn's")
    options = harness.parse(parser)
    if "snelson" in options.systems:
        fetch_snelson(options.data_home, n_retries=1)
    output = harness.output_path(options, "toy")
    cells = [
        Cell(source, name, seed, options.size)
        for source in options.systems
        for seed in options.seeds
        for name in TITLES
    ]
    n_failures = harness.run_missing(cells, partial(run, data_home=options.data_home), output, options.jobs)
    tables = {}
    for source in options.systems:
        first = [cell for cell in cells if (cell.data, cell.seed) == (source, 0)]
        rows = load(first[0], options.data_home)
        with harness.one_thread():
            models = {cell.model: build(cell).fit(rows.data, rows.target) for cell in first}
        stem = output.stem if source == options.systems[0] else f"{output.stem}_{source}"
        tables[f"{source}, models"] = table_of(harness.frame(output, data=source, size=options.size))
        tables[f"{source}, sparse from exact"] = plot(models, rows, output.with_name(f"{stem}.png"))
    harness.write_page("The toy data: Figure 5 of the paper, and ours", tables, output, n_failures)


if __name__ == "__main__":
    main()
