"""The paper's Figure 5: an exact and a sparse GP on Snelson's points, without and with a line as explicit features.

The models are scikit-learn's GaussianProcessRegressor (GP), the sparse GP with ten inducing points (VGP), and both with
h(x) = (1, x): EGP and EVGP. Writes one row per model and seed to a CSV (what is there already is not run again), the
picture of seed 0 and a Markdown page. A seed draws the starts of the optimisers, the folds and, for make_toy, the data.

    python benchmarks/paper/toy.py                          # four minutes; Snelson's points are downloaded once
    python benchmarks/paper/toy.py --data-home some/folder  # that holds train_inputs, train_outputs and test_inputs
    python benchmarks/paper/toy.py --systems toy            # make_toy's points, of the same shape
    python benchmarks/paper/toy.py --quick                  # no restarts, three folds, one seed: seconds
"""

from __future__ import annotations

import sys
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
from sklearn.base import RegressorMixin, clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.model_selection import KFold
from sklearn.preprocessing import PolynomialFeatures
from sklearn.utils import Bunch
from threadpoolctl import threadpool_limits

import harness
from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import fetch_snelson, make_toy
from skevgp.metrics import negative_log_predictive_density
from skevgp.plotting import PosteriorDisplay
from skevgp.solvers import LBFGS

MODELS = ("GP", "VGP", "EGP", "EVGP")
# Of each sparse model, the exact one that it approximates.
EXACT = {"VGP": "GP", "EVGP": "EGP"}
TITLES = {
    "GP": "GP: exact, scikit-learn",
    "VGP": "VGP: 10 inducing points",
    "EGP": "EGP: exact, with h(x) = (1, x)",
    "EVGP": "EVGP: 10 inducing points, with h(x) = (1, x)",
}
EXPLICIT = ("EGP", "EVGP")
SOURCES = {
    "snelson": "Snelson's 200 points, with y ← 6y + 3x",
    "toy": "200 points of make_toy, which look like Snelson's with y ← 6y + 3x",
}
SLOPES = {"snelson": "The paper adds a line of slope 3 to Snelson's points", "toy": "The true one is 3"}
N_INDUCING = 10
GRID = np.linspace(-4.0, 10.0, 421)[:, np.newaxis]
# Three beyond the last observation.
FAR = 9.0
# Restarts of the optimisers and folds.
SIZES = {"full": (5, 10), "quick": (0, 3)}


@dataclass(frozen=True)
class Cell:
    """One model.

    Attributes
    ----------
    data : {"snelson", "toy"}
    model : str
    seed : int
    size : {"full", "quick"}
    data_home : Path or None
        Of Snelson's data.
    """

    data: str
    model: str
    seed: int
    size: str
    data_home: Path | None = field(compare=False)


def load(cell: Cell) -> Bunch:
    if cell.data == "toy":
        return make_toy(random_state=cell.seed)
    return fetch_snelson(cell.data_home, download_if_missing=False)


def build(cell: Cell) -> RegressorMixin:
    n_restarts, seed = SIZES[cell.size][0], cell.seed
    if cell.model == "GP":
        kernel = ConstantKernel(10.0) * RBF(1.0) + WhiteKernel(1.0)
        return GaussianProcessRegressor(kernel, n_restarts_optimizer=n_restarts, random_state=seed)
    if cell.model == "EGP":
        return EGPRegressor(PolynomialFeatures(1), n_restarts=n_restarts, random_state=seed)
    features = PolynomialFeatures(1) if cell.model == "EVGP" else None
    settings = {"n_inducing": N_INDUCING, "noise_cv": None, "random_state": seed}
    return EVGPRegressor(features, solver=LBFGS(n_restarts), **settings)


def line_of(model: RegressorMixin) -> np.ndarray:
    """Intercept and slope of the explicit part, each with its standard deviation; zeros without features."""
    if not hasattr(model, "coef_"):
        return np.zeros((2, 2))
    return np.column_stack([model.coef_, model.coef_std_])


def hyperparameters(model: RegressorMixin) -> dict[str, float]:
    kernel, noise = model.kernel_, getattr(model, "noise_variance_", None)
    if noise is None:  # scikit-learn has the noise in the kernel
        kernel, noise = kernel.k1, kernel.k2.noise_level
    return {
        "signal_std": np.sqrt(kernel.k1.constant_value),
        "length_scale": np.ravel(kernel.k2.length_scale)[0],
        "noise_std": np.sqrt(noise),
    }


def evidence(model: RegressorMixin) -> float:
    """The log marginal likelihood, or its lower bound."""
    return getattr(model, "lower_bound_", None) or model.log_marginal_likelihood_value_


def left_out(model: RegressorMixin, data: Bunch, cell: Cell) -> tuple[float, float]:
    """Error (root mean square) and negative log predictive density of rows that were left out."""
    mean, std = np.empty((2, len(data.target)))
    for train, test in KFold(SIZES[cell.size][1], shuffle=True, random_state=cell.seed).split(data.data):
        fold = clone(model).fit(data.data[train], data.target[train])
        mean[test], std[test] = fold.predict(data.data[test], return_std=True)
    rmse = np.sqrt(np.mean((data.target - mean) ** 2))
    return rmse, negative_log_predictive_density(data.target, mean, std)


def run(cell: Cell) -> dict[str, Any]:
    """Fit a model to all rows, and to all but a fold of them."""
    data, model = load(cell), build(cell)
    with threadpool_limits(1), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ConvergenceWarning)
        start = time.process_time()
        model.fit(data.data, data.target)
        seconds = time.process_time() - start
        converged = not any(issubclass(warning.category, ConvergenceWarning) for warning in caught)
        rmse, nlpd = left_out(model, data, cell)
    mean, std = model.predict([[FAR]], return_std=True)
    line = line_of(model) if cell.model in EXPLICIT else np.full((2, 2), np.nan)
    truth = data.get("mean", np.nan)
    return {
        **{name: getattr(cell, name) for name in ("data", "model", "seed", "size")},
        "log_likelihood_or_bound": evidence(model),
        **hyperparameters(model),
        **dict(zip(("intercept", "intercept_std", "slope", "slope_std"), line.flat, strict=True)),
        "far_mean": mean[0],
        "far_std": std[0],
        "rmse": rmse,
        "nlpd": nlpd,
        "rmse_of_truth": np.sqrt(np.mean((truth - model.predict(data.data)) ** 2)),
        "fit_seconds": seconds,
        "converged": converged,
        **harness.provenance(),
    }


def say(row: dict[str, Any]) -> str:
    return f"{row['log_likelihood_or_bound']:.2f} nats, RMSE {row['rmse']:.3f}, {row['fit_seconds']:.1f} s"


def plot(models: dict[str, RegressorMixin], data: Bunch, title: str, path: Path) -> dict[str, PosteriorDisplay]:
    """A panel per model: exact on the left and sparse on the right, with the line below.

    Parameters
    ----------
    models : dict
        Fitted, by name.
    data : Bunch
        What they were fitted to.
    title : str
    path : Path
        Of the PNG.

    Returns
    -------
    displays : dict of PosteriorDisplay
        By name.
    """
    figure, grid = harness.pyplot().subplots(2, 2, figsize=(harness.WIDTH, 6.0), sharex=True, sharey=True)
    displays = {}
    for axes, (name, model) in zip(grid.flat, models.items(), strict=True):
        displays[name] = PosteriorDisplay.from_estimator(
            model, GRID, x_train=data.data[:, 0], y_train=data.target, ax=axes, n_std=1.0
        )
        intercept, slope = line_of(model)[:, 0]
        axes.plot(
            GRID[:, 0],
            intercept + slope * GRID[:, 0],
            ":",
            color="black",
            linewidth=1.2,
            label="explicit part: h(x)ᵀb, or 0",
        )
        axes.set_title(TITLES[name])
        axes.margins(x=0.0)
        axes.set_xticks(range(-2, 10, 2))
    for axes in grid[-1]:
        axes.set_xlabel("x")
    for axes in grid[:, 0]:
        axes.set_ylabel("y")
    harness.legend(figure, ncols=5, title=title)
    harness.save_picture(figure, path)
    return displays


def paragraphs(rows: list[harness.Row], displays: dict[str, PosteriorDisplay], data: Bunch) -> list[str]:
    """What the picture shows, with numbers.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one data set and size.
    displays : dict of PosteriorDisplay
        Of each model.
    data : Bunch
        Of the picture.

    Returns
    -------
    parts : list of str
    """
    own = {name: [row for row in rows if row["model"] == name] for name in MODELS}
    x, known = data.data[:, 0], rows[0]["data"] == "toy"
    inside = (GRID[:, 0] >= x.min()) & (GRID[:, 0] <= x.max())

    def mean(name: str, *columns: str) -> str:
        """Over seeds, of a value or of one ± its standard deviation."""
        values = (harness.column(own[name], column).mean() for column in columns)
        return " ± ".join(f"{round(value, 2) + 0.0:.2f}" for value in values)  # no minus in front of zeros

    def differences(name: str) -> list[str]:
        """Between a sparse model and the exact one, the largest where there are data and beyond."""
        texts = [name]
        for part in ("mean", "std"):
            gap = np.abs(getattr(displays[name], part) - getattr(displays[EXACT[name]], part))
            beyond = np.argmax(np.where(inside, 0.0, gap))
            texts += [f"{gap[inside].max():.2f}", f"{gap[beyond]:.2f} (x = {GRID[beyond, 0]:.1f})"]
        return texts

    columns = {
        "log likelihood or bound": ("log_likelihood_or_bound",),
        "signal std": ("signal_std",),
        "length scale": ("length_scale",),
        "noise std": ("noise_std",),
        "slope": ("slope", "slope_std"),
        f"y at x = {FAR:g}": ("far_mean", "far_std"),
        "RMSE": ("rmse",),
        "NLPD": ("nlpd",),
        **({"RMSE of the truth": ("rmse_of_truth",)} if known else {}),
        "seconds": ("fit_seconds",),
    }
    lines = [
        [name, *("" if "slope" in of and name not in EXPLICIT else mean(name, *of) for of in columns.values())]
        for name in MODELS
    ]
    header = ["", *(f"{part}, {where}" for part in ("mean", "std") for where in ("inside", "outside"))]
    far = {name: mean(name, "far_mean", "far_std") for name in MODELS}
    bounds = {name: np.ptp(harness.column(own[name], "log_likelihood_or_bound")) for name in EXACT}
    seeds = sorted({int(row["seed"]) for row in rows})
    parts = [
        "# The toy data: Figure 5 of the paper, and ours",
        f"Written by `benchmarks/paper/toy.py`. Data: {SOURCES[rows[0]['data']]}. Values are means over seeds "
        f"{', '.join(map(str, seeds))}; the picture and the differences are of seed 0. {harness.provenance_text(rows)}",
    ]
    if rows[0]["size"] == "quick":
        parts.append("**A quick run**: no restarts, and three folds.")
    parts += [
        harness.table(["model", *columns], lines),
        "Log likelihoods and bounds are in nats, of all points; the NLPD of one. RMSE and NLPD are of "
        f"{SIZES[rows[0]['size']][1]} folds, each left out of a fit. Standard deviations of y include the noise. "
        "Seconds are those of the processor for a fit.",
        "**Ten inducing points.** The largest differences of VGP from GP and of EVGP from EGP, inside the range of the "
        f"data and outside it; the noise has a standard deviation of {mean('GP', 'noise_std')}:",
        harness.table(header, [differences(name) for name in EXACT]),
        f"**Far from the data.** At x = {FAR:g}, {FAR - x.max():.1f} beyond the last point, GP and VGP are back at "
        f"their prior mean, 0: they predict {far['GP']} and {far['VGP']}. EGP and EVGP go on with the line: "
        f"{far['EGP']} and {far['EVGP']}.",
        f"**The line.** Its slope is {mean('EGP', 'slope', 'slope_std')} (EGP) and "
        f"{mean('EVGP', 'slope', 'slope_std')} (EVGP). {SLOPES[rows[0]['data']]}; a straight line through the points, "
        f"by least squares, has {np.polyfit(x, data.target, 1)[0]:.2f}.",
    ]
    if not known and len(seeds) > 1:
        parts.append(
            f"Over seeds, bounds differ by up to {bounds['VGP']:.2g} (VGP) and {bounds['EVGP']:.2g} nats (EVGP)."
        )
    stopped = [f"{row['model']} seed {row['seed']}" for row in rows if row["converged"] == "False"]
    if stopped:
        parts.append(f"Fits that ended with a ConvergenceWarning: {', '.join(stopped)}.")
    return parts


def main() -> None:
    parser = harness.argument_parser(
        __doc__, quick="no restarts, three folds and one seed", seeds="seeds 0, 1, ...; default: 4, of a quick run 1"
    )
    parser.add_argument(
        *("--systems", "--data"),
        nargs="+",
        choices=SOURCES,
        help="data; default: Snelson's points, or make_toy's if they cannot be had",
    )
    parser.add_argument("--data-home", type=Path, help="a folder with Snelson's files; default: scikit-learn's")
    options = parser.parse_args()
    sources = list(dict.fromkeys(options.systems or ["snelson"]))
    if "snelson" in sources:
        try:
            fetch_snelson(options.data_home, n_retries=1)
        except OSError as problem:
            if options.systems:
                raise SystemExit(str(problem)) from problem
            print(f"{problem}\nIn their place: {SOURCES['toy']}.", flush=True)
            sources = ["toy"]
    size = "quick" if options.quick else "full"
    n_seeds = (1 if options.quick else 4) if options.seeds is None else options.seeds
    output = harness.output_path(options, "toy")
    cells = [
        Cell(which, name, seed, size, options.data_home)
        for which in sources
        for seed in range(n_seeds)
        for name in MODELS
    ]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    if n_failures:
        harness.write_report([], output, n_failures)

    parts = []
    for which in sources:
        rows = [row for row in harness.read(output) if (row["data"], row["size"]) == (which, size)]
        if not rows:
            continue
        first = [cell for cell in cells if (cell.data, cell.seed) == (which, 0)]
        data = load(first[0])
        with threadpool_limits(1), warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # in the CSV
            models = {cell.model: build(cell).fit(data.data, data.target) for cell in first}
        stem = output.stem if len(sources) == 1 else f"{output.stem}_{which}"
        displays = plot(models, data, SOURCES[which], output.with_name(f"{stem}.png"))
        parts += paragraphs(rows, displays, data)
    harness.write_report(parts, output)


if __name__ == "__main__":
    main()
