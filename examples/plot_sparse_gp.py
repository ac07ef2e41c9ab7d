"""
A sparse Gaussian process in scikit-learn
=========================================

`GaussianProcessRegressor` needs a matrix of all rows against all rows, so it works for a few thousand rows only.
`EVGPRegressor` represents the same data by a few *inducing points*. Here both learn a wave on a linear trend. The trend
is an explicit feature, so the model continues it beyond the data.
"""

# %%
# Simulate a wave on a line of slope 3
# ------------------------------------

import os
import sys
import time

import matplotlib.pyplot as plt
import numpy as np
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EVGPRegressor
from skevgp.datasets import make_toy

plt.style.use("skevgp.plotting.page")
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
X, y = make_toy(200 if quick else 1000, random_state=0, return_X_y=True)
x_grid = np.linspace(-3.0, 9.0, 400)[:, np.newaxis]

# %%
# Fit scikit-learn's exact Gaussian process
# -----------------------------------------

start = time.perf_counter()
kernel = ConstantKernel(10.0) * RBF(1.0) + WhiteKernel(1.0)
exact = GaussianProcessRegressor(kernel, normalize_y=True, random_state=0).fit(X, y)
exact_seconds = time.perf_counter() - start
exact_mean, exact_std = exact.predict(x_grid, return_std=True)

# %%
# Fit a sparse Gaussian process with an explicit trend
# ----------------------------------------------------
# ``PolynomialFeatures(1)`` is h(x) = (1, x). Twenty inducing points are enough for the wave.

start = time.perf_counter()
sparse = EVGPRegressor(PolynomialFeatures(1), n_inducing=20, random_state=0).fit(X, y)
sparse_seconds = time.perf_counter() - start
sparse_mean, sparse_std = sparse.predict(x_grid, return_std=True)

inside = (x_grid[:, 0] > X.min()) & (x_grid[:, 0] < X.max())
difference = np.abs(sparse_mean - exact_mean)[inside].max()
slope, slope_std = sparse.coef_[1], sparse.coef_std_[1]
print(f"{'':26s} {'points':>6s} {'seconds':>8s} {'noise std':>9s}")
print(f"{'GaussianProcessRegressor':26s} {len(X):6d} {exact_seconds:8.2f} {'':>9s}")
noise = np.sqrt(sparse.noise_variance_)
print(f"{'EVGPRegressor':26s} {len(sparse.inducing_points_):6d} {sparse_seconds:8.2f} {noise:9.3f}   (true: 1.7)")
print(
    f"largest difference of the means inside the data: {difference:.3f}; slope {slope:.2f} ± {slope_std:.2f} (true: 3)"
)

# %%
# Compare both inside and outside the data
# ----------------------------------------

figure, axes = plt.subplots(1, 2, figsize=(8, 3.1), sharey=True)
for ax, title, mean, std in (
    (axes[0], f"GaussianProcessRegressor: {len(X)} points, {exact_seconds:.1f} s", exact_mean, exact_std),
    (
        axes[1],
        f"EVGPRegressor + trend: {len(sparse.inducing_points_)} inducing points, {sparse_seconds:.2f} s",
        sparse_mean,
        sparse_std,
    ),
):
    ax.plot(X[:, 0], y, ".", color="0.75", markersize=2, zorder=0, label="data")
    ax.plot(x_grid[:, 0], mean, color="#0072B2", label="mean")
    ax.fill_between(
        x_grid[:, 0], mean - 2 * std, mean + 2 * std, color="#0072B2", alpha=0.2, linewidth=0, label="±2 std"
    )
    ax.set_title(title)
    ax.set_xlabel("x")
axes[0].set_ylabel("y")
axes[1].plot(
    sparse.inducing_points_[:, 0],
    np.full(len(sparse.inducing_points_), 0.04),
    "x",
    color="#009E73",
    transform=axes[1].get_xaxis_transform(),
    label="inducing points",
)
axes[1].legend(loc="upper left")
if len(sys.argv) > 1 and not sys.argv[1].startswith("-"):
    figure.savefig(sys.argv[1])
plt.show()
