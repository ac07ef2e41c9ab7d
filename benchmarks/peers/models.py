"""One fit of one peer: reads a job from an .npz, fits, predicts, writes the result to another.

`against_peers.py` runs it, each fit in a process of its own, as the peers need another interpreter: GPflow asks for
NumPy 1, skevgp for NumPy 2. So nothing but NumPy is imported here until a peer asks for it.

    python benchmarks/peers/models.py "GPflow SGPR" job.npz result.npz

All peers get the same start: inducing points, lengthscales, signal variance. Their inputs are divided by their standard
deviation and their targets by their root mean square (no mean is subtracted: the prior mean is 0 for all), and bounds
are given in the units of the targets as they were.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

from peers.jobs import Fitted, Job, Result, Scaled, TimeUpError, Watch


def fit_skevgp(job: Job, watch: Watch) -> Fitted:
    from skevgp import EVGPRegressor
    from skevgp.solvers import LBFGS

    def record(iteration: int, bound: float, outputs: range) -> None:
        watch.record(outputs.start, bound)
        if watch.seconds > watch.time_limit:
            raise KeyboardInterrupt  # as a user would end a fit early

    model = EVGPRegressor(
        n_inducing=len(job.inducing_points),
        sharing=job.sharing,
        max_iter=job.max_iter or None,
        n_jobs=-1,
        random_state=job.seed,
        solver=LBFGS(callback=record),
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.fit(job.X, job.Y)
    messages = " ".join(str(warning.message) for warning in caught)
    reasons = {"interrupted": "time", "max_iter=": "iterations", "rounding": "rounding"}
    stop = [reason for sign, reason in reasons.items() if sign in messages] or ["converged"]
    return Fitted(lambda X: model.predict(X, return_std=True), [model.lower_bound_], " ".join(stop), len(watch.records))


def fit_gpflow(job: Job, watch: Watch, noise_start: float = 0.01) -> Fitted:
    """SGPR (Titsias 2009), L-BFGS-B through SciPy, compiled; GPflow's own noise floor and jitter (both 1e-6)."""
    import gpflow
    import tensorflow as tf

    scaled = Scaled(job)
    models, bounds, stops, iterations = [], [], [], 0

    class Recorded(gpflow.optimizers.Scipy):
        """Keeps the best point, and the bound at each evaluation."""

        def __init__(self, model: int, columns: list[int]):
            super().__init__()
            self.model, self.columns, self.deadline = model, columns, watch.deadline(model)
            self.loss, self.x = np.inf, None

        def eval_func(self, *args: Any, **kwargs: Any) -> Callable[..., Any]:
            evaluate = super().eval_func(*args, **kwargs)

            def recorded(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                if watch.seconds > self.deadline:
                    raise TimeUpError
                loss, gradient = evaluate(x)
                if loss < self.loss:
                    self.loss, self.x = float(loss), x.copy()
                watch.record(self.model, scaled.bound(-float(loss), self.columns))
                return loss, gradient

            return recorded

        def callback(self, step: int, *_: Any) -> None:
            nonlocal iterations
            iterations += 1

    for index, columns in enumerate(scaled.models):
        model = gpflow.models.SGPR(
            (scaled.X, scaled.Y[:, columns]),
            gpflow.kernels.SquaredExponential(variance=1.0, lengthscales=scaled.lengthscales),
            scaled.Z.copy(),
            noise_variance=noise_start,
        )
        optimizer, variables = Recorded(index, columns), model.trainable_variables
        options = {"maxiter": job.max_iter}
        try:
            minimum = optimizer.minimize(
                model.training_loss, variables, step_callback=optimizer.callback, options=options
            )
            stops.append({0: "converged", 1: "iterations"}.get(minimum.status, "line-search"))
        except (TimeUpError, tf.errors.InvalidArgumentError) as error:
            # A Cholesky failure is InvalidArgumentError. Kept is the best so far, which a user would have lost.
            stops.append("time" if isinstance(error, TimeUpError) else "cholesky")
        if optimizer.x is None:
            raise RuntimeError(f"no evaluation of output {columns} succeeded or fitted into the time limit")
        optimizer.assign_tensors(variables, optimizer.unpack_tensors(variables, tf.convert_to_tensor(optimizer.x)))
        bounds.append(scaled.bound(-optimizer.loss, columns))

        def predict(X: np.ndarray, model: Any = model) -> tuple[np.ndarray, np.ndarray]:
            mean, variance = model.predict_y(X)
            return mean.numpy(), np.sqrt(variance.numpy())

        models.append(predict)
    return Fitted(scaled.predictor(models), bounds, " ".join(stops), iterations, len(watch.records))


def fit_gpytorch(job: Job, watch: Watch, variational: bool) -> Fitted:
    """SGPR with Adam on all rows, or SVGP with Adam on mini-batches, in double precision."""
    import gpytorch
    import torch

    torch.set_default_dtype(torch.float64)
    torch.manual_seed(job.seed)
    scaled = Scaled(job)
    X, Z = torch.tensor(scaled.X), torch.tensor(scaled.Z)
    # SVGP: 3000 steps of 0.01 on 256 rows; SGPR: 300 of 0.1 (0.01 of its tutorial gets nowhere in as many).
    learning_rate, n_steps, n_batch = (0.01, 3000, 256) if variational else (0.1, 300, len(X))
    models, bounds, stops, n_done = [], [], [], 0

    def covariance() -> Any:
        kernel = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=X.shape[1]))
        kernel.outputscale = 1.0
        kernel.base_kernel.lengthscale = torch.tensor(scaled.lengthscales)
        return kernel

    class Collapsed(gpytorch.models.ExactGP):
        def __init__(self, y: Any, likelihood: Any):
            super().__init__(X, y, likelihood)
            self.mean_module = gpytorch.means.ZeroMean()
            self.covar_module = gpytorch.kernels.InducingPointKernel(covariance(), Z.clone(), likelihood)

        def forward(self, x: Any) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    class Variational(gpytorch.models.ApproximateGP):
        def __init__(self) -> None:
            q = gpytorch.variational.CholeskyVariationalDistribution(len(Z))
            super().__init__(gpytorch.variational.VariationalStrategy(self, Z.clone(), q))
            self.mean_module, self.covar_module = gpytorch.means.ZeroMean(), covariance()

        def forward(self, x: Any) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    for index, columns in enumerate(scaled.models):
        deadline, y = watch.deadline(index), torch.tensor(scaled.Y[:, columns[0]])
        # Its default floor of 1e-4 is above the noise of these data.
        likelihood = gpytorch.likelihoods.GaussianLikelihood(noise_constraint=gpytorch.constraints.GreaterThan(1e-6))
        likelihood.noise = 0.01
        if variational:
            model = Variational()
            objective = gpytorch.mlls.VariationalELBO(likelihood, model, num_data=len(X))
            parameters = [*model.parameters(), *likelihood.parameters()]
        else:
            model = Collapsed(y, likelihood)
            objective = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
            parameters = list(model.parameters())
        model.train(), likelihood.train()
        adam, stop = torch.optim.Adam(parameters, lr=learning_rate), "steps"
        best, best_state = -np.inf, None
        for _ in range(n_steps):
            if watch.seconds > deadline:
                stop = "time"
                break
            rows = torch.randint(len(X), (n_batch,)) if variational else slice(None)
            adam.zero_grad()
            loss = -objective(model(X[rows]), y[rows])
            loss.backward()
            bound = -len(X) * loss.item()
            if not variational:
                watch.record(index, scaled.bound(bound, columns))
                if bound > best:
                    best = bound
                    best_state = {name: value.clone() for name, value in model.state_dict().items()}
            adam.step()
            n_done += 1
        if variational:
            with torch.no_grad():
                best = len(X) * objective(model(X), y).item()
            watch.record(index, scaled.bound(best, columns))
        elif best_state is not None:
            model.load_state_dict(best_state)
        bounds.append(scaled.bound(best, columns))
        stops.append(stop)
        model.eval(), likelihood.eval()

        def predict(X: np.ndarray, model: Any = model, likelihood: Any = likelihood) -> tuple[np.ndarray, np.ndarray]:
            with torch.no_grad():
                parts = [likelihood(model(torch.tensor(rows))) for rows in np.array_split(X, -(-len(X) // 1000))]
                mean, variance = (torch.cat([getattr(part, n) for part in parts]) for n in ("mean", "variance"))
            return mean.numpy(), np.sqrt(variance.numpy())

        models.append(predict)
    return Fitted(scaled.predictor(models), bounds, " ".join(stops), n_done, n_done)


def fit_exact(job: Job, watch: Watch) -> Fitted:
    """The exact GP of scikit-learn; the job brings as many rows as it can take."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    scaled = Scaled(job)
    # The default floor of the noise, 1e-5, is above the noise of these data.
    kernel = ConstantKernel() * RBF(scaled.lengthscales) + WhiteKernel(0.01, (1e-10, 10.0))
    models = []
    for columns in scaled.models:
        gp = GaussianProcessRegressor(kernel, random_state=job.seed).fit(scaled.X, scaled.Y[:, columns])
        models.append(lambda X, gp=gp: gp.predict(X, return_std=True))
    return Fitted(scaled.predictor(models), [], "converged")


def fit_linear(job: Job, watch: Watch) -> Fitted:
    """What a straight line can do."""
    from sklearn.linear_model import BayesianRidge

    scaled = Scaled(job)
    models = []
    for columns in scaled.models:
        line = BayesianRidge().fit(scaled.X, scaled.Y[:, columns[0]])
        models.append(lambda X, line=line: line.predict(X, return_std=True))
    return Fitted(scaled.predictor(models), [], "converged")


@dataclass(frozen=True)
class Peer:
    """How a peer is fitted.

    Attributes
    ----------
    modules : tuple of str
        Imported before the clock starts; the first one is the peer's.
    fit : callable
        (Job, Watch) -> Fitted
    sharing : tuple of str
        What it can do.
    own_rule : bool
        Whether it ends by its own rule in place of the common limit on iterations.
    subset : bool
        Whether it gets a random subset of the rows.
    """

    modules: tuple[str, ...]
    fit: Callable[[Job, Watch], Fitted]
    sharing: tuple[str, ...] = ("none",)
    own_rule: bool = False
    subset: bool = False

    @property
    def package(self) -> str:
        """An interpreter that has it can run the peer."""
        return self.modules[0].partition(".")[0]


_SKEVGP, _GPFLOW, _GPYTORCH = ("skevgp.regressor", "scipy"), ("gpflow", "tensorflow", "scipy"), ("gpytorch", "torch")
PEERS = {
    "skevgp": Peer(_SKEVGP, fit_skevgp, ("all", "none"), own_rule=True),
    "skevgp, same limit": Peer(_SKEVGP, fit_skevgp, ("all", "none")),
    "GPflow SGPR": Peer(_GPFLOW, fit_gpflow, ("none", "all")),
    "GPflow SGPR, noise 1e-4": Peer(_GPFLOW, lambda job, watch: fit_gpflow(job, watch, 1e-4)),
    "GPyTorch SGPR": Peer(_GPYTORCH, lambda job, watch: fit_gpytorch(job, watch, False)),
    "GPyTorch SVGP": Peer(_GPYTORCH, lambda job, watch: fit_gpytorch(job, watch, True)),
    "scikit-learn GPR": Peer(("sklearn.gaussian_process", "scipy"), fit_exact, ("none", "all"), subset=True),
    "scikit-learn BayesianRidge": Peer(("sklearn.linear_model", "scipy"), fit_linear),
}


def run(peer: str, job: Job) -> Result:
    """Fit and predict; the clock runs from handing over the arrays to the fitted model."""
    for name in PEERS[peer].modules:
        import_module(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        watch = Watch(job.time_limit, 1 if job.sharing == "all" else job.Y.shape[1])
        fitted = PEERS[peer].fit(job, watch)
        seconds, cpu_seconds = watch.seconds, watch.cpu_seconds
        begin = time.perf_counter()
        mean, std = fitted.predict(job.X_test)
        predict_seconds = time.perf_counter() - begin
    packages = [import_module(name.partition(".")[0]) for name in (*PEERS[peer].modules, "numpy")]
    versions = " ".join(f"{package.__name__} {package.__version__}" for package in packages)
    return Result(
        mean,
        std,
        seconds,
        cpu_seconds,
        predict_seconds,
        fitted.iterations,
        fitted.evaluations,
        np.array(fitted.bounds),
        fitted.stop,
        *watch.curve(),
        versions,
    )


def main() -> None:
    if len(sys.argv) != 4:
        raise SystemExit(f"usage: {Path(__file__).name} PEER JOB RESULT (started by against_peers.py)")
    name, job, result = sys.argv[1:]
    if name not in PEERS:
        raise SystemExit(f"error: unknown peer {name!r}; known: {', '.join(PEERS)}.")
    run(name, Job.load(Path(job))).save(Path(result))


if __name__ == "__main__":
    main()
