"""Models of neighbors.py: each fits, predicts, and measures time and memory in a process of its own.

The libraries need different environments. So this module imports only NumPy until a model needs more. Jobs and results
are .npz files.

    python benchmarks/peers/local_models.py neighbors job.npz result.npz

Columns and targets come in units of the training rows' standard deviation. Kernels are squared exponentials with a
length scale for each column.
"""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

N_INDUCING, N_NEIGHBORS = 200, 60
BLOCK = 1000  # rows of a call of predict
LEVEL = 0.95  # of intervals
Predict = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # rows -> mean and std, with noise


class Fitted(NamedTuple):
    """Predictions, the number of training rows, and half of an interval's width where it is not that of a normal."""

    predict: Predict
    n_train: int
    half_width: float = np.nan


class Model(NamedTuple):
    """How a model is fitted, with the modules to import before the clock starts. The first one names the package."""

    fit: Callable[[SimpleNamespace], Fitted]
    modules: tuple[str, ...]

    @property
    def package(self) -> str:
        return self.modules[0].partition(".")[0]


# --- skevgp and scikit-learn ---------------------------------------------------------------------------------------


def evgp(n_neighbors: int, job: SimpleNamespace) -> Fitted:
    """Fit EVGPRegressor with its defaults, except for the number of points, neighbours and threads."""
    from skevgp import EVGPRegressor

    n_inducing = min(N_INDUCING, len(job.X) // 2)
    model = EVGPRegressor(n_inducing=n_inducing, n_neighbors=n_neighbors, n_jobs=2, random_state=job.seed)
    model.fit(job.X, job.y)
    return Fitted(partial(model.predict, return_std=True), len(job.X))


def exact(n_rows: int, job: SimpleNamespace) -> Fitted:
    """Fit the exact Gaussian process to some of the rows."""
    from skevgp import EGPRegressor

    rows = np.random.RandomState(job.seed).permutation(len(job.X))[:n_rows]
    model = EGPRegressor(random_state=job.seed).fit(job.X[rows], job.y[rows])
    return Fitted(partial(model.predict, return_std=True), len(rows))


def gpr(job: SimpleNamespace) -> Fitted:
    """Fit scikit-learn's exact Gaussian process, with a length scale for each column and learned noise."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    kernel = ConstantKernel() * RBF(np.ones(job.X.shape[1])) + WhiteKernel()
    model = GaussianProcessRegressor(kernel, normalize_y=True).fit(job.X, job.y)
    return Fitted(partial(model.predict, return_std=True), len(job.X))


def boosting(job: SimpleNamespace) -> Fitted:
    """Fit boosting to all rows. Std and interval come from errors on a fifth of the rows, of a fit to the others."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    order = np.random.RandomState(job.seed).permutation(len(job.X))
    held, others = np.split(order, [len(order) // 5])
    model = HistGradientBoostingRegressor(max_iter=2000, early_stopping=True, random_state=job.seed)
    errors = np.abs(job.y[held] - model.fit(job.X[others], job.y[others]).predict(job.X[held]))
    std = np.sqrt(np.mean(errors**2))
    level = min(LEVEL * (1.0 + 1.0 / len(held)), 1.0)  # split conformal
    model.fit(job.X, job.y)
    return Fitted(lambda X: (model.predict(X), np.full(len(X), std)), len(job.X), float(np.quantile(errors, level)))


# --- other libraries -----------------------------------------------------------------------------------------------


def gpboost(approximation: str, job: SimpleNamespace) -> Fitted:
    """Fit GPBoost with 30 neighbours. Predictions have 60, its default."""
    import gpboost

    points = {} if approximation == "vecchia" else {"num_ind_points": min(N_INDUCING, len(job.X) // 2)}
    options = {"num_neighbors": 30, "num_parallel_threads": 2, "seed": job.seed, **points}
    model = gpboost.GPModel(gp_coords=job.X, cov_function="gaussian_ard", gp_approx=approximation, **options)
    model.fit(y=job.y)

    def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = model.predict(gp_coords_pred=X, predict_var=True, predict_response=True)
        return found["mu"], np.sqrt(found["var"])

    return Fitted(predict, len(job.X))


def muygps(job: SimpleNamespace) -> Fitted:
    """Fit MuyGPyS with 60 neighbours, by L-BFGS-B on 200 random rows, its default."""
    from MuyGPyS.examples.regress import make_regressor
    from MuyGPyS.gp.deformation import F2, Anisotropy
    from MuyGPyS.gp.hyperparameter import AnalyticScale, Parameter, VectorParameter
    from MuyGPyS.gp.kernels import RBF
    from MuyGPyS.gp.noise import HomoscedasticNoise
    from MuyGPyS.optimize import L_BFGS_B_optimize

    np.random.seed(job.seed)  # noqa: NPY002  # its batches come from NumPy's global state
    scales = VectorParameter(*(Parameter(1.0, (0.05, 50.0)) for _ in range(job.X.shape[1])))
    model, lookup = make_regressor(
        job.X,
        job.y,
        nn_count=min(N_NEIGHBORS, len(job.X) // 2),
        batch_count=min(200, len(job.X) // 2),
        opt_fn=L_BFGS_B_optimize,
        k_kwargs={
            "kernel": RBF(deformation=Anisotropy(F2, scales)),
            "noise": HomoscedasticNoise(1e-2, (1e-5, 1.0)),
            "scale": AnalyticScale(),
        },
        nn_kwargs={"nn_method": "exact", "algorithm": "kd_tree", "n_jobs": 2},
    )

    def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nearest, _ = lookup.get_nns(X)
        crosswise, pairwise, targets = model.make_predict_tensors(np.arange(len(X)), nearest, X, job.X, job.y)
        covariance, between = model.kernel(pairwise), model.kernel(crosswise)
        mean = model.posterior_mean(covariance, between, targets)
        variance = model.posterior_variance(covariance, between)  # of the function, without noise
        return np.ravel(mean), np.sqrt(np.ravel(variance) + float(model.noise()) * float(np.ravel(model.scale())[0]))

    return Fitted(predict, len(job.X))


def svgp(job: SimpleNamespace) -> Fitted:
    """Fit GPyTorch's SVGP: 512 points, 30 epochs of Adam of 0.01 on batches of 1,024 rows."""
    import gpytorch
    import torch

    torch.set_default_dtype(torch.float64)
    torch.manual_seed(job.seed)
    torch.set_num_threads(2)
    X, y = torch.tensor(job.X), torch.tensor(job.y)
    points = X[torch.randperm(len(X))[: min(512, len(X) // 2)]].clone()

    class Sparse(gpytorch.models.ApproximateGP):
        def __init__(self) -> None:
            q = gpytorch.variational.CholeskyVariationalDistribution(len(points))
            super().__init__(gpytorch.variational.VariationalStrategy(self, points, q))
            self.mean = gpytorch.means.ConstantMean()
            self.covariance = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=X.shape[1]))

        def forward(self, x: Any) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean(x), self.covariance(x))

    model, likelihood = Sparse(), gpytorch.likelihoods.GaussianLikelihood()
    objective = gpytorch.mlls.VariationalELBO(likelihood, model, len(X))
    adam = torch.optim.Adam([*model.parameters(), *likelihood.parameters()], lr=0.01)
    model.train(), likelihood.train()
    for _ in range(30):
        for rows in torch.randperm(len(X)).split(1024):
            adam.zero_grad()
            loss = -objective(model(X[rows]), y[rows])
            loss.backward()
            adam.step()
    model.eval(), likelihood.eval()

    def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with torch.no_grad():
            found = likelihood(model(torch.tensor(X)))
            return found.mean.numpy(), found.stddev.numpy()

    return Fitted(predict, len(job.X))


# --- one job -------------------------------------------------------------------------------------------------------

MODELS = {
    "sparse": Model(partial(evgp, 0), ("skevgp.estimators.evgp",)),
    "neighbors": Model(partial(evgp, N_NEIGHBORS), ("skevgp.estimators.evgp",)),
    "neighbors-80": Model(partial(evgp, 80), ("skevgp.estimators.evgp",)),
    "exact-2000": Model(partial(exact, 2000), ("skevgp.estimators.egp",)),
    "exact-5000": Model(partial(exact, 5000), ("skevgp.estimators.egp",)),
    "GPR": Model(gpr, ("sklearn.gaussian_process",)),
    "boosting": Model(boosting, ("sklearn.ensemble",)),
    "GPBoost-VIF": Model(partial(gpboost, "full_scale_vecchia"), ("gpboost",)),
    "GPBoost-Vecchia": Model(partial(gpboost, "vecchia"), ("gpboost",)),
    "MuyGPyS": Model(muygps, ("MuyGPyS.examples.regress", "MuyGPyS.optimize")),
    "GPyTorch-SVGP": Model(svgp, ("gpytorch", "torch")),
}


def memory(name: str) -> float:
    """Return "VmRSS", memory of this process, or "VmHWM", its highest value, in MB; NaN without Linux."""
    try:
        return float(Path("/proc/self/status").read_text().split(f"{name}:")[1].split()[0]) / 1024
    except (OSError, IndexError):
        return np.nan


def forget_peak() -> None:
    """Let the highest value begin again at the present one."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def run(model: Model, job: SimpleNamespace) -> dict[str, Any]:
    """Fit and predict. The clock runs from the arrays in memory to the fitted model."""
    for name in model.modules:
        import_module(name)
    forget_peak()
    before, start, cpu_start = memory("VmRSS"), time.perf_counter(), time.process_time()
    fitted = model.fit(job)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    blocks = np.split(job.X_test, range(BLOCK, len(job.X_test), BLOCK))
    mean, std = (np.concatenate(part) for part in zip(*map(fitted.predict, blocks), strict=True))
    rows, each = job.X_test[np.arange(BLOCK) % len(job.X_test)], []
    for _ in range(3):
        start = time.perf_counter()
        fitted.predict(rows)
        each.append(time.perf_counter() - start)
    package = import_module(model.package)
    return {
        "mean": mean,
        "std": std,
        "half_width": fitted.half_width,
        "n_train": fitted.n_train,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "us_per_prediction": 1e6 * float(np.median(each)) / BLOCK,
        "peak_mb": memory("VmHWM") - before,
        "package": f"{package.__name__} {getattr(package, '__version__', '')}".strip(),
    }


def load(path: str) -> SimpleNamespace:
    """Read what `numpy.savez` wrote."""
    with np.load(path) as arrays:
        return SimpleNamespace(**{name: a if a.ndim else a.item() for name, a in arrays.items()})


def main() -> None:
    """Run a job on two cores."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        np.savez(sys.argv[3], **run(MODELS[sys.argv[1]], load(sys.argv[2])))


if __name__ == "__main__":
    main()
