"""
A function with details, and many rows
======================================

Inducing points explain the slow part of a function. With ``n_neighbors``, what they leave out is predicted from the
nearest training rows. The first picture shows both parts in one dimension. A table with many rows then compares the
sparse model, the model with nearest rows, and gradient boosting.
"""

# %%
# Simulate a function with details
# --------------------------------

import argparse
import os
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor

from skevgp import EVGPRegressor

parser = argparse.ArgumentParser(description="Compare a sparse model with one that conditions on the nearest rows.")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
plt.style.use("skevgp.plotting.page")
rng = np.random.default_rng(0)


def details(x):
    return np.sin(x) + 0.3 * np.sin(9.0 * x)


x = np.sort(rng.uniform(0.0, 10.0, 300))[:, np.newaxis]
y = details(x[:, 0]) + 0.05 * rng.standard_normal(len(x))
grid = np.linspace(0.0, 10.0, 500)[:, np.newaxis]

# %%
# Look at both parts in one dimension
# -----------------------------------
# Eight inducing points cannot follow the details. They take them for noise. Ten nearest rows add them.

models = {k: EVGPRegressor(n_inducing=8, n_neighbors=k, random_state=0).fit(x, y) for k in (0, 10)}
figure, axes = plt.subplots(1, 2, figsize=(8, 3.1), sharey=True)
for ax, (k, model) in zip(axes, models.items(), strict=True):
    mean, std = model.predict(grid, return_std=True)
    ax.plot(x[:, 0], y, ".", color="0.75", markersize=3, label="data")
    ax.plot(grid[:, 0], mean, color="#0072B2", label="mean")
    ax.fill_between(grid[:, 0], mean - 2 * std, mean + 2 * std, color="#0072B2", alpha=0.2, linewidth=0, label="±2 std")
    ax.plot(
        model.inducing_points_[:, 0],
        np.full(len(model.inducing_points_), 0.04),
        "x",
        color="#009E73",
        transform=ax.get_xaxis_transform(),
        label="inducing points",
    )
    ax.set_title(f"n_neighbors={k}: noise {np.sqrt(model.noise_variance_):.2f} (true: 0.05)")
    ax.set_xlabel("x")
axes[0].set_ylabel("y")
axes[0].set_ylim(-1.7, 2.3)
axes[1].legend(loc="upper right", ncols=2)
options.output.mkdir(parents=True, exist_ok=True)
figure.savefig(options.output / "many_rows.png")

# %%
# Compare on a table
# ------------------
# A function of four columns is drawn at random. Errors are those of new rows, in standard deviations of y.

n_rows, n_inducing, n_neighbors = (1500, 20, 15) if quick else (20_000, 100, 60)
frequencies, phases = 1.5 * rng.standard_normal((4, 300)), rng.uniform(0.0, 2.0 * np.pi, 300)
X, X_new = rng.uniform(-1.5, 1.5, (2, n_rows, 4))
f, f_new = (np.sqrt(2.0 / 300) * np.cos(rows @ frequencies + phases).sum(axis=1) for rows in (X, X_new[:2000]))
targets, X_new = f + 0.02 * rng.standard_normal(n_rows), X_new[:2000]
compared = {
    "sparse": EVGPRegressor(n_inducing=n_inducing, random_state=0, n_jobs=2),
    "nearest rows": EVGPRegressor(n_inducing=n_inducing, n_neighbors=n_neighbors, random_state=0, n_jobs=2),
    "boosting": HistGradientBoostingRegressor(random_state=0),
}
print(f"{n_rows} rows of 4 columns, {n_inducing} inducing points, {n_neighbors} neighbours")
print(f"{'':12s} {'error':>7s} {'within 2 std':>13s} {'seconds':>8s}")
for name, model in compared.items():
    start = time.perf_counter()
    model.fit(X, targets)
    seconds = time.perf_counter() - start
    within = ""
    if name == "boosting":
        mean = model.predict(X_new)
    else:
        mean, std = model.predict(X_new, return_std=True, include_noise=False)
        within = f"{np.mean(np.abs(mean - f_new) < 2 * std):.3f}"
    error = np.sqrt(np.mean((mean - f_new) ** 2)) / np.std(f_new)
    print(f"{name:12s} {error:7.4f} {within:>13s} {seconds:8.1f}")
plt.show()
