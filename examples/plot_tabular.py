"""
Compare with scikit-learn's regressors on tables
================================================

A Gaussian process predicts a standard deviation for each row, and learns smooth functions from few rows. Trees learn
jumps, from any number of rows. This example compares `EVGPRegressor` with the exact `GaussianProcessRegressor`,
`HistGradientBoostingRegressor` with quantiles, and `BayesianRidge`. The data are scikit-learn's diabetes data,
Friedman's three functions, and simulated house prices, on which trees are better. Run ``python examples/plot_tabular.py
--help`` for options. ``benchmarks/tables.py`` has more data sets and seeds.
"""

# %%
# Options
# -------

import argparse
import os
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.datasets import load_diabetes, make_friedman1, make_friedman2, make_friedman3
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.linear_model import BayesianRidge
from sklearn.metrics import root_mean_squared_error
from sklearn.model_selection import train_test_split
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from skevgp import EVGPRegressor
from skevgp.metrics import containing_ratios, negative_log_predictive_density

parser = argparse.ArgumentParser(description="Compare regressors on tables of data.")
parser.add_argument("--rows", type=int, default=800, help="to learn from, of the made sets; default: %(default)s")
parser.add_argument("--seed", type=int, default=0, help="of data and models; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
n_rows, n_test = (80, 200) if quick else (options.rows, 1000)

# %%
# Make the data
# -------------
# Friedman's functions have the noise of his paper (1991). The houses are like California's, but need no download.
# Prices jump at the borders of districts, and columns are skewed.


def make_houses(n_samples, random_state):
    rng = np.random.RandomState(random_state)
    place, age = rng.uniform(0.0, 6.0, (n_samples, 2)), rng.randint(1, 53, n_samples)
    income, people = np.exp(1.2 + 0.45 * rng.randn(n_samples)), np.exp(7.0 + 0.7 * rng.randn(n_samples))
    household = np.exp(1.0 + 0.3 * rng.randn(n_samples))
    district = rng.randn(6, 6)[*place.astype(int).T]
    price = 0.4 * income - 0.3 * np.log(household) + 0.6 * district + 0.01 * age * (place[:, 0] < 2.0)
    price = np.minimum(price * np.exp(0.15 * rng.randn(n_samples)), 5.0)
    return np.column_stack([income, age, people, household, place]), price


made = {"n_samples": n_rows + n_test, "random_state": options.seed}
sets = {
    "diabetes": load_diabetes(return_X_y=True),
    "friedman1": make_friedman1(noise=1.0, **made),
    "friedman2": make_friedman2(noise=125.0, **made),
    "friedman3": make_friedman3(noise=0.1, **made),
    "houses": make_houses(**made),
}

# %%
# Define the models
# -----------------
# All models have their defaults. Trees have no standard deviation. Two more fits predict the quantiles of 5 % and 95 %,
# and the standard deviation is that of the normal distribution with these quantiles.

try:
    import matplotlib.pyplot as plt

    from skevgp.plotting import CalibrationDisplay

    plt.style.use("skevgp.plotting.page")
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs matplotlib: pip install matplotlib")


class QuantileBoosting(RegressorMixin, BaseEstimator):
    """Three fits: for the mean, and for two quantiles."""

    def __init__(self, random_state=None):
        self.random_state = random_state

    def fit(self, X, y):
        losses = {"loss": "squared_error"}, *({"loss": "quantile", "quantile": level} for level in (0.05, 0.95))
        boost = HistGradientBoostingRegressor(random_state=self.random_state)
        self.fits_ = [clone(boost).set_params(**loss).fit(X, y) for loss in losses]
        self.smallest_ = 1e-3 * np.std(y)  # where the quantiles meet, or cross
        return self

    def predict(self, X, return_std=False):
        mean, low, high = (fit.predict(X) for fit in self.fits_)
        return (mean, np.maximum((high - low) / 3.29, self.smallest_)) if return_std else mean


def models(n_columns):
    kernel = ConstantKernel() * RBF(np.ones(n_columns)) + WhiteKernel(1e-2, (1e-8, 10.0))
    return {
        "EVGPRegressor": EVGPRegressor(n_inducing="auto", normalize_y=True, random_state=options.seed),
        "GaussianProcessRegressor": GaussianProcessRegressor(kernel, normalize_y=True),
        "boosting, quantiles": QuantileBoosting(options.seed),
        "BayesianRidge": BayesianRidge(),
    }


# %%
# Measure errors, densities, intervals and time
# ---------------------------------------------
# NLPD is minus the log density of the test values, in nats per row, for y with variance one. Lower is better. Large
# errors with a small standard deviation cost most. Nine of ten values should be within the 90 % interval.

results, fitted, tests = {}, {}, {}
print(f"{'':12s} {'':26s} {'RMSE':>7s} {'NLPD':>7s} {'within 90 %':>12s} {'seconds':>8s}")
for name, (X, y) in sets.items():
    X, X_test, y, y_test = train_test_split(
        X, y / y.std(), test_size=min(n_test, len(y) // 3), random_state=options.seed
    )
    tests[name] = X_test, y_test
    for label, model in models(X.shape[1]).items():
        model = make_pipeline(StandardScaler(), model)
        start = time.perf_counter()
        with threadpool_limits(1), warnings.catch_warnings():  # one thread each: times can be compared
            warnings.simplefilter("ignore", ConvergenceWarning)  # GaussianProcessRegressor's, at a bound
            model.fit(X, y)
        seconds = time.perf_counter() - start
        mean, std = model.predict(X_test, return_std=True)
        row = (
            root_mean_squared_error(y_test, mean),
            negative_log_predictive_density(y_test, mean, std),
            containing_ratios(y_test, mean, std, k=1.645)[0],
            seconds,
        )
        results[name, label], fitted[name, label] = row, model
        print(f"{name:12s} {label:26s} {row[0]:7.3f} {row[1]:7.2f} {row[2]:12.3f} {row[3]:8.2f}")

# %%
# Look at the length scales
# -------------------------
# Five of the ten columns of Friedman's first function are irrelevant. Their length scales are large.

print(fitted["friedman1", "EVGPRegressor"][-1].summary())

# %%
# Plot coverage and scores
# ------------------------
# The left panel shows the coverage of intervals for the houses. The others show error and density, relative to the best
# model for each data set.

figure, axes = plt.subplots(1, 3, figsize=(8, 3.4))
labels = list(models(1))
colors = dict(zip(labels, ("#0072B2", "#D55E00", "#009E73", "#CC79A7"), strict=True))
for label, color in colors.items():
    CalibrationDisplay.from_estimator(fitted["houses", label], *tests["houses"], ax=axes[0], label=label, color=color)
axes[0].set_title("houses; grey: chance")
for ax, column, title in ((axes[1], 0, "RMSE / the best"), (axes[2], 1, "NLPD, above the best (nats)")):
    for place, label in enumerate(labels):
        values = [results[name, label][column] for name in sets]
        best = [min(results[name, other][column] for other in labels) for name in sets]
        values = np.divide(values, best) if column == 0 else np.subtract(values, best)
        ax.plot(values, np.arange(len(sets)) + 0.15 * (place - 1.5), "o", color=colors[label], label=label)
    ax.set_yticks(range(len(sets)), sets)
    ax.invert_yaxis()
    ax.set_title(title)
axes[2].set_xscale("symlog", linthresh=0.1)
axes[2].set_xlim(-0.02, 2.0 * axes[2].get_xlim()[1])
figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=4)
options.output.mkdir(parents=True, exist_ok=True)
figure.savefig(options.output / "tabular.png")
plt.show()
