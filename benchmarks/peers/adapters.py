"""Each library as a peer: its fit of a job, and its bound and predictions at fixed hyperparameters.

`against_peers.py` runs each peer in a separate process, because the libraries need different versions of NumPy. So this
module imports only NumPy until a peer needs more. Jobs and results are .npz files.

    python benchmarks/peers/adapters.py "GPflow SGPR" job.npz result.npz

All peers get the same start: inducing points, lengthscales and signal variance. Inputs are divided by their standard
deviation and targets by their root mean square. Bounds are in the units of the original targets.
"""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

# X_test -> (mean, std), with noise
Predict = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
# X, Y, X_test, inducing_points, lengthscales, noise (first variance, share of the targets' mean square), sharing,
# max_iter (0: the library's own rule), time_limit, seed and n_checkpoints (times at which the fit is looked at)
Job = SimpleNamespace
# kernel ("rbf" or "matern52"), X, y, X_test, inducing_points, lengthscales, signal and noise
Fixed = SimpleNamespace
Said = tuple[float, np.ndarray, np.ndarray]  # bound, mean and variance with noise, at fixed hyperparameters
STEP = 1.4  # ratio of the times of two checkpoints


def load(path: Path) -> SimpleNamespace:
    """Read what `numpy.savez` wrote."""
    with np.load(path) as arrays:
        return SimpleNamespace(**{name: a if a.ndim else a.item() for name, a in arrays.items()})


class TimeUpError(Exception):
    """The time limit has passed."""


class Watch:
    """The clock of a fit of several models, and their bounds."""

    def __init__(self, time_limit: float, n_models: int):
        self.time_limit, self.n_models = time_limit, n_models
        self.records: list[tuple[float, float, int, float]] = []
        self._begin, self._begin_cpu = time.perf_counter(), time.process_time()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._begin

    @property
    def cpu_seconds(self) -> float:
        return time.process_time() - self._begin_cpu

    def deadline(self, model: int) -> float:
        """Return when a model has to end: a fair share of the remaining time."""
        return self.seconds + max(self.time_limit - self.seconds, 0.0) / (self.n_models - model)

    def record(self, model: int, bound: float) -> None:
        """Keep the bound of an evaluation."""
        self.records.append((self.seconds, self.cpu_seconds, model, bound))

    def curve(self) -> np.ndarray:
        """Return seconds, processor seconds and the sum of the best bounds so far, (3, k)."""
        best: dict[int, float] = {}
        for *_, model, bound in self.records:
            best.setdefault(model, bound)
        points = []
        for seconds, cpu_seconds, model, bound in self.records:
            best[model] = max(best[model], bound)
            points.append((seconds, cpu_seconds, sum(best.values())))
        return np.array(points).reshape(-1, 3).T


class Checkpoint(NamedTuple):
    seconds: float
    cpu_seconds: float
    bound: float
    predict: Predict


@dataclass
class Fitted:
    """A fitted peer. ``at`` returns the checkpoint at about a time; ``bounds`` has one bound per model."""

    predict: Predict
    bounds: list[float]
    stop: str
    iterations: float = np.nan
    evaluations: float = np.nan
    at: Callable[[float], Checkpoint] | None = None
    curve: np.ndarray | None = None


class Scaled:
    """A job in standard units: inputs of unit standard deviation, targets of unit root mean square."""

    def __init__(self, job: Job):
        spread = job.X.std(axis=0)
        self.spread = np.where(spread > 0.0, spread, 1.0)
        self.unit = np.sqrt(np.mean(job.Y**2, axis=0))
        self.X, self.Y, self.Z = job.X / self.spread, job.Y / self.unit, job.inducing_points / self.spread
        self.lengthscales = job.lengthscales / self.spread
        columns = list(range(job.Y.shape[1]))
        self.models = [columns] if job.sharing == "all" else [[column] for column in columns]

    def bound(self, bound: float, columns: list[int]) -> float:
        """Convert a bound to the units of the original targets."""
        return bound - len(self.X) * float(np.log(self.unit[columns]).sum())

    def predictor(self, models: list[Predict]) -> Predict:
        """Return the prediction of all outputs from those of the models."""

        def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            parts = [model(X / self.spread) for model in models]
            mean, std = (np.hstack([part[i].reshape(len(X), -1) for part in parts]) for i in (0, 1))
            return mean * self.unit, np.broadcast_to(std, mean.shape) * self.unit

        return predict

    def fitted(self, ways: list[list[tuple[float, Predict]]], watch: Watch, **said: Any) -> Fitted:
        """Return the result of models that kept their steps (seconds, prediction), the best one last."""
        curve = watch.curve()

        def at(seconds: float) -> Checkpoint:
            index = max(int(np.searchsorted(curve[0], seconds, side="right")) - 1, 0)
            steps = [max((s for s in way if s[0] <= seconds), default=way[0], key=lambda s: s[0]) for way in ways]
            return Checkpoint(*curve[:, index], self.predictor([predict for _, predict in steps]))

        return Fitted(self.predictor([way[-1][1] for way in ways]), at=at, curve=curve, **said)


class Peer:
    """How a library is fitted. `modules` are imported before the clock starts; the first one names the package."""

    modules: tuple[str, ...]
    sharing: tuple[str, ...] = ("none",)
    own_rule = False  # whether it ends by its own rule instead of the common limit of iterations
    points = "inducing"  # or "rows" (an exact GP on a subset of the rows), or "none"
    jitter = ""
    at_fixed: Callable[[Fixed], Said] | None = None

    @property
    def package(self) -> str:
        """Name of the package that an interpreter must have."""
        return self.modules[0].partition(".")[0]

    # Each peer has fit(job, watch) -> Fitted. Some have calls(given) -> name: what is timed for control loops, of a
    # model of given.X, given.Y and given.inducing_points at rows given.ahead.


class Skevgp(Peer):
    """EVGPRegressor with its defaults, except for m, threads and, if the job says so, iterations and sharing.

    An earlier checkpoint is another fit that a callback ends then. Fits are deterministic, so it goes the same way.
    """

    modules = ("skevgp.estimators.evgp", "scipy")
    sharing = ("default", "none", "all")
    own_rule = True
    jitter = "relative 1e-12, only where a pivot is below 1e-6"

    def at_fixed(self, fixed: Fixed) -> Said:
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

        from skevgp import EVGPRegressor

        scales = fixed.lengthscales, "fixed"
        shape = RBF(*scales) if fixed.kernel == "rbf" else Matern(*scales, nu=2.5)
        kernel = ConstantKernel(fixed.signal, "fixed") * shape + WhiteKernel(fixed.noise, "fixed")
        model = EVGPRegressor(kernel=kernel, inducing_init=fixed.inducing_points, max_iter=0).fit(fixed.X, fixed.y)
        mean, std = model.predict(fixed.X_test, return_std=True)
        return model.lower_bound_, mean, std**2

    def fit(self, job: Job, watch: Watch) -> Fitted:
        model, stop, iterations = self.fit_until(job, watch, watch.time_limit)

        def predictor(model: Any) -> Predict:
            return lambda X: tuple(part.reshape(len(X), -1) for part in model.predict(X, return_std=True))

        def at(seconds: float) -> Checkpoint:
            own = Watch(watch.time_limit, 1)
            early = self.fit_until(job, own, seconds)[0]
            return Checkpoint(own.seconds, own.cpu_seconds, early.lower_bound_, predictor(early))

        return Fitted(predictor(model), [model.lower_bound_], stop, iterations, at=at)

    def fit_until(self, job: Job, watch: Watch, seconds: float) -> tuple[Any, str, int]:
        from skevgp import EVGPRegressor
        from skevgp.solvers import LBFGS

        iterations = 0

        def count(iteration: int, bound: float, outputs: Any) -> None:
            nonlocal iterations
            iterations += 1
            if watch.seconds > seconds:
                raise StopIteration

        sharing = {} if job.sharing == "default" else {"sharing": job.sharing}
        options = {"max_iter": job.max_iter or None, "n_jobs": 2, "random_state": job.seed, **sharing}
        model = EVGPRegressor(n_inducing=len(job.inducing_points), solver=LBFGS(callback=count), **options)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model.fit(job.X, job.Y if job.Y.shape[1] > 1 else np.ravel(job.Y))
        messages = " ".join(str(warning.message) for warning in caught)
        reasons = {"interrupted": "time", "max_iter=": "iterations", "rounding": "rounding"}
        stop = [reason for sign, reason in reasons.items() if sign in messages]
        return model, " ".join(stop or ["warned" if messages else "converged"]), iterations


class GPflow(Peer):
    """GPflow's SGPR (Titsias 2009): SciPy's L-BFGS-B, compiled, with GPflow's floor of the noise and jitter (1e-6)."""

    modules = ("gpflow", "tensorflow", "scipy")
    sharing = ("none", "all")
    jitter = "absolute 1e-12 where libraries are compared, 1e-6, its own, where it is timed"

    def model(self, X: Any, Y: Any, Z: Any, scales: Any, signal: float, noise: float, kernel: str = "rbf") -> Any:
        import gpflow

        shape = {"rbf": gpflow.kernels.SquaredExponential, "matern52": gpflow.kernels.Matern52}[kernel]
        return gpflow.models.SGPR((X, Y), shape(variance=signal, lengthscales=scales), Z.copy(), noise_variance=noise)

    def at_fixed(self, fixed: Fixed) -> Said:
        import gpflow

        gpflow.config.set_default_jitter(1e-12)
        points, scales = fixed.inducing_points, fixed.lengthscales
        model = self.model(fixed.X, fixed.y[:, np.newaxis], points, scales, fixed.signal, fixed.noise, fixed.kernel)
        mean, variance = model.predict_y(fixed.X_test)
        return float(model.elbo()), mean.numpy()[:, 0], variance.numpy()[:, 0]

    def optimizer(self, watch: Watch, scaled: Scaled, index: int) -> Any:
        """SciPy's L-BFGS-B that keeps the best point of each iteration, and the bound of each evaluation."""
        import gpflow

        class Recorded(gpflow.optimizers.Scipy):
            def __init__(self) -> None:
                super().__init__()
                self.deadline = watch.deadline(index)
                self.loss, self.x = np.inf, None
                self.steps: list[tuple[float, np.ndarray]] = []

            def eval_func(self, *args: Any, **kwargs: Any) -> Callable[..., Any]:
                evaluate = super().eval_func(*args, **kwargs)

                def recorded(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                    if watch.seconds > self.deadline:
                        raise TimeUpError
                    loss, gradient = evaluate(x)
                    if loss < self.loss:
                        self.loss, self.x = float(loss), x.copy()
                    watch.record(index, scaled.bound(-float(loss), scaled.models[index]))
                    if not self.steps:
                        self.callback()
                    return loss, gradient

                return recorded

            def callback(self, *_: Any) -> None:
                self.steps.append((watch.seconds, self.x))

        return Recorded()

    def fit(self, job: Job, watch: Watch) -> Fitted:
        import tensorflow as tf

        scaled = Scaled(job)
        ways, bounds, stops, iterations = [], [], [], 0
        for index, columns in enumerate(scaled.models):
            model = self.model(scaled.X, scaled.Y[:, columns], scaled.Z, scaled.lengthscales, 1.0, job.noise)
            optimizer, variables = self.optimizer(watch, scaled, index), model.trainable_variables
            try:
                minimum = optimizer.minimize(
                    model.training_loss, variables, step_callback=optimizer.callback, options={"maxiter": job.max_iter}
                )
                stops.append({0: "converged", 1: "iterations"}.get(minimum.status, "line-search"))
            except (TimeUpError, tf.errors.InvalidArgumentError) as error:
                # A Cholesky failure is an InvalidArgumentError. The best point so far counts.
                stops.append("time" if isinstance(error, TimeUpError) else "cholesky")
            if optimizer.x is None:
                raise RuntimeError(f"no evaluation of output {columns} succeeded or fitted into the time limit")
            iterations += len(optimizer.steps) - 1
            optimizer.callback()
            bounds.append(scaled.bound(-optimizer.loss, columns))
            ways.append([(seconds, self.predictor(model, optimizer, x)) for seconds, x in optimizer.steps])
        said = {"bounds": bounds, "stop": " ".join(stops), "iterations": iterations, "evaluations": len(watch.records)}
        return scaled.fitted(ways, watch, **said)

    def predictor(self, model: Any, optimizer: Any, x: np.ndarray) -> Predict:
        def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            import tensorflow as tf

            variables = model.trainable_variables
            optimizer.assign_tensors(variables, optimizer.unpack_tensors(variables, tf.convert_to_tensor(x)))
            mean, variance = model.predict_y(X)
            return mean.numpy(), np.sqrt(variance.numpy())

        return predict

    def calls(self, given: SimpleNamespace) -> dict[str, Callable[[], object]]:
        """The posterior is cached and compiled, as GPflow's guide to fast predictions says."""
        import gpflow
        import tensorflow as tf

        scales = np.full(given.X.shape[1], 1.5)
        model = self.model(given.X, given.Y, given.inducing_points, scales, 1.0, 0.01)
        posterior = model.posterior(gpflow.posteriors.PrecomputeCacheType.TENSOR)

        @tf.function
        def moments(rows: Any) -> Any:
            return posterior.predict_f(rows)

        @tf.function
        def with_jacobian(rows: Any) -> Any:
            with tf.GradientTape() as tape:
                tape.watch(rows)
                mean, _ = posterior.predict_f(rows)
            return mean, tape.batch_jacobian(mean, rows)

        row, rows = tf.constant(given.ahead[:1]), tf.constant(given.ahead)
        return {
            "row, mean and std": lambda: moments(row),
            "row, mean and Jacobian": lambda: with_jacobian(row),
            "horizon, mean and std": lambda: moments(rows),
            "horizon, mean and Jacobian": lambda: with_jacobian(rows),
        }


class GPJax(Peer):
    """GPJax's collapsed bound in double precision: its `fit_lbfgs`, that of Optax, compiled.

    It has GPJax's own jitter and no floor for the noise. (`fit_scipy` of GPJax 1.0 names no method to SciPy, which
    takes BFGS with a dense matrix of all parameters.)
    """

    modules = ("gpjax", "jax", "optax")
    jitter = "absolute 1e-12 where libraries are compared, 1e-6, its own, where it is timed"
    gtol = 1e-5  # norm of the gradient at which `fit_lbfgs` ends

    def family(self, Z: Any, scales: Any, signal: float, noise: float, kernel: str = "rbf", **options: float) -> Any:
        import gpjax
        import jax

        jax.config.update("jax_enable_x64", True)
        shape = {"rbf": gpjax.kernels.RBF, "matern52": gpjax.kernels.Matern52}[kernel]
        scaled = shape(lengthscale=jax.numpy.asarray(scales), variance=jax.numpy.asarray(signal, float))
        prior = gpjax.Prior(scaled, gpjax.mean_functions.Zero(), **options)
        model = prior * gpjax.likelihoods.Gaussian(jax.numpy.asarray(noise**0.5))
        return gpjax.variational_families.CollapsedVariationalGaussian(model, jax.numpy.asarray(Z))

    def dataset(self, X: np.ndarray, y: np.ndarray) -> Any:
        import gpjax
        import jax

        return gpjax.Dataset(jax.numpy.asarray(X), jax.numpy.asarray(y).reshape(-1, 1))

    def prediction(self, family: Any, train: Any, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance with noise."""
        import jax

        latent = family.condition(train)(jax.numpy.asarray(X), covariance="diagonal")
        noisy = family.model.likelihood(latent)
        return np.asarray(noisy.mean), np.asarray(noisy.variance)

    def at_fixed(self, fixed: Fixed) -> Said:
        import gpjax

        points, scales = fixed.inducing_points, fixed.lengthscales
        family = self.family(points, scales, fixed.signal, fixed.noise, fixed.kernel, jitter=1e-12)
        train = self.dataset(fixed.X, fixed.y)
        bound = float(gpjax.objectives.collapsed_elbo(family, train))
        return bound, *self.prediction(family, train, fixed.X_test)

    def fit(self, job: Job, watch: Watch) -> Fitted:
        import gpjax
        import jax

        scaled = Scaled(job)
        ways, bounds, stops, iterations = [], [], [], 0
        for index, columns in enumerate(scaled.models):
            family = self.family(scaled.Z, scaled.lengthscales, 1.0, job.noise)
            train = self.dataset(scaled.X, scaled.Y[:, columns])

            def record(bound: float, index: int = index, columns: list[int] = columns) -> None:
                watch.record(index, scaled.bound(bound, columns))

            way = GPJaxWay(record, watch, watch.deadline(index))
            try:
                _, loss = gpjax.fit_lbfgs(
                    model=family, objective=way.objective(), train_data=train, max_iters=job.max_iter, gtol=self.gtol
                )
                loss.block_until_ready()
                jax.effects_barrier()  # all callbacks have run
                # It also ends if the gradient is NaN. The best point so far counts.
                ended = "cholesky" if np.isnan(way.slope) else "converged"
                stops.append("iterations" if way.slope >= self.gtol else ended)
                iterations += job.max_iter if stops[-1] == "iterations" else np.nan
            except jax.errors.JaxRuntimeError:
                if not way.time_up:
                    raise
                stops.append("time")
                iterations = np.nan
            if not way.steps:
                raise RuntimeError(f"no evaluation of output {columns} succeeded or fitted into the time limit")
            bounds.append(scaled.bound(-way.loss, columns))
            ways.append([(seconds, self.predictor(family, train, x)) for seconds, x in way.steps])
        said = {"bounds": bounds, "stop": " ".join(stops), "iterations": iterations, "evaluations": len(watch.records)}
        return scaled.fitted(ways, watch, **said)

    def predictor(self, family: Any, train: Any, x: np.ndarray) -> Predict:
        def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            import equinox
            import jax

            arrays, rest = equinox.partition(family, equinox.is_array)
            fitted = equinox.combine(jax.flatten_util.ravel_pytree(arrays)[1](x), rest)
            mean, variance = self.prediction(fitted, train, X)
            return mean, np.sqrt(variance)

        return predict


class GPJaxWay:
    """Evaluations inside the compiled fit: the best points with their times, and bounds."""

    def __init__(self, record: Callable[[float], None], watch: Watch, deadline: float):
        self.record, self.watch, self.deadline = record, watch, deadline
        self.loss, self.slope, self.time_up = np.inf, np.inf, False
        self.steps: list[tuple[float, np.ndarray]] = []

    def point(self, loss: np.ndarray, x: np.ndarray) -> None:
        if self.watch.seconds > self.deadline:
            self.time_up = True
            raise TimeUpError
        if np.isfinite(loss):  # else a Cholesky factorisation failed
            self.record(-float(loss))
        if loss < self.loss:
            self.loss = float(loss)
            self.steps.append((self.watch.seconds, np.array(x)))

    def gradient(self, norm: np.ndarray) -> None:
        self.slope = float(norm)

    def objective(self) -> Callable[[Any, Any], Any]:
        """Minus the collapsed bound, with callbacks."""
        import equinox
        import gpjax
        import jax
        import optax

        def backwards(_: None, slope: Any) -> tuple[Any]:
            jax.debug.callback(self.gradient, optax.tree.norm(slope))
            return (slope,)

        same = jax.custom_vjp(lambda arrays: arrays)
        same.defvjp(lambda arrays: (arrays, None), backwards)

        def objective(family: Any, train: Any) -> Any:
            arrays, rest = equinox.partition(family, equinox.is_array)
            loss = -gpjax.objectives.collapsed_elbo(equinox.combine(same(arrays), rest), train)
            jax.debug.callback(self.point, loss, jax.flatten_util.ravel_pytree(arrays)[0])
            return loss

        return objective


class GPyTorch(Peer):
    """GPyTorch's SGPR in double precision: 300 steps of Adam of 0.1 (its tutorial's 0.01 gets nowhere in as many)."""

    modules = ("gpytorch", "torch")
    jitter = "none, but 1e-8 and more where a Cholesky factorisation fails"

    def models(self, X: Any, y: Any, Z: Any, scales: Any, signal: float, noise: float, kernel: str) -> tuple[Any, Any]:
        """The model and its likelihood, whose default floor of the noise, 1e-4, is above the noise of dynamics."""
        import gpytorch
        import torch

        shape = gpytorch.kernels.RBFKernel(ard_num_dims=len(scales))
        if kernel == "matern52":
            shape = gpytorch.kernels.MaternKernel(nu=2.5, ard_num_dims=len(scales))
        covariance = gpytorch.kernels.ScaleKernel(shape)
        covariance.outputscale, shape.lengthscale = signal, torch.tensor(scales)
        floor = gpytorch.constraints.GreaterThan(1e-6)
        likelihood = gpytorch.likelihoods.GaussianLikelihood(noise_constraint=floor)
        likelihood.noise = noise

        class Collapsed(gpytorch.models.ExactGP):
            def __init__(self) -> None:
                super().__init__(X, y, likelihood)
                self.mean_module = gpytorch.means.ZeroMean()
                self.covar_module = gpytorch.kernels.InducingPointKernel(covariance, Z.clone(), likelihood)

            def forward(self, x: Any) -> Any:
                return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

        return Collapsed(), likelihood

    def prediction(self, model: Any, likelihood: Any, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance with noise, of Titsias's posterior.

        By default GPyTorch 1.15 takes the exact diagonal of the prior covariance in test rows, which is right, and in
        training rows, which makes it a FITC posterior and not that of the bound. What depends on training rows is
        cached at the first prediction, so that one is made without the correction.
        """
        import gpytorch
        import torch

        model.eval(), likelihood.eval()
        with torch.no_grad():
            with gpytorch.settings.sgpr_diagonal_correction(False):
                _ = model(torch.tensor(X[:1])).variance
            parts = [likelihood(model(torch.tensor(rows))) for rows in np.array_split(X, -(-len(X) // 1000))]
            mean, variance = (torch.cat([getattr(part, name) for part in parts]) for name in ("mean", "variance"))
        return mean.numpy(), variance.numpy()

    def at_fixed(self, fixed: Fixed) -> Said:
        import gpytorch
        import torch

        torch.set_default_dtype(torch.float64)
        X, y, Z = (torch.tensor(array) for array in (fixed.X, fixed.y, fixed.inducing_points))
        model, likelihood = self.models(X, y, Z, fixed.lengthscales, fixed.signal, fixed.noise, fixed.kernel)
        model.train(), likelihood.train()
        with torch.no_grad():
            bound = len(X) * gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)(model(X), y).item()
        return bound, *self.prediction(model, likelihood, fixed.X_test)

    def fit(self, job: Job, watch: Watch) -> Fitted:
        import gpytorch
        import torch

        torch.set_default_dtype(torch.float64)
        torch.manual_seed(job.seed)
        scaled = Scaled(job)
        X, Z = torch.tensor(scaled.X), torch.tensor(scaled.Z)
        ways, bounds, stops, n_done = [], [], [], 0
        for index, columns in enumerate(scaled.models):
            deadline, y, stop = watch.deadline(index), torch.tensor(scaled.Y[:, columns[0]]), "steps"
            model, likelihood = self.models(X, y, Z, scaled.lengthscales, 1.0, job.noise, "rbf")
            objective = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
            whole = torch.nn.ModuleList([model, likelihood])
            whole.train()
            adam, best = torch.optim.Adam(model.parameters(), lr=0.1), -np.inf
            steps = [(watch.seconds, self.state(whole))]
            for _ in range(300):
                if watch.seconds > deadline:
                    stop = "time"
                    break
                adam.zero_grad()
                loss = -objective(model(X), y)
                loss.backward()
                bound = -len(X) * loss.item()
                watch.record(index, scaled.bound(bound, columns))
                if bound > best:
                    best = bound
                    steps.append((watch.seconds, self.state(whole)))
                adam.step()
                n_done += 1
            bounds.append(scaled.bound(best, columns))
            stops.append(stop)
            ways.append([(seconds, self.predictor(whole, state)) for seconds, state in steps])
        said = {"bounds": bounds, "stop": " ".join(stops), "iterations": n_done, "evaluations": n_done}
        return scaled.fitted(ways, watch, **said)

    def state(self, whole: Any) -> dict[str, Any]:
        return {name: value.detach().clone() for name, value in whole.state_dict().items()}

    def predictor(self, whole: Any, state: dict[str, Any]) -> Predict:
        def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            whole.train()  # forgets what was cached for predictions
            whole.load_state_dict(state)
            mean, variance = self.prediction(*whole, X)
            return mean, np.sqrt(variance)

        return predict

    def calls(self, given: SimpleNamespace) -> dict[str, Callable[[], object]]:
        """An exact model of one output, of as many rows as inducing points, with fast predictive variances."""
        import gpytorch
        import torch

        n = len(given.inducing_points)
        rows, targets = (torch.tensor(values[:n]) for values in (given.X, given.Y[:, 0]))

        class Exact(gpytorch.models.ExactGP):
            def __init__(self) -> None:
                super().__init__(rows, targets, likelihood)
                self.mean = gpytorch.means.ZeroMean()
                self.covariance = gpytorch.kernels.RBFKernel(ard_num_dims=rows.shape[1])

            def forward(self, x: Any) -> Any:
                return gpytorch.distributions.MultivariateNormal(self.mean(x), self.covariance(x))

        likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
        model = Exact().double()
        model.covariance.lengthscale, likelihood.noise = torch.full((1, rows.shape[1]), 1.5), 0.01
        model.eval()

        def moments(x: Any) -> Any:
            with torch.no_grad(), gpytorch.settings.fast_pred_var():
                said = model(x)
                return said.mean, said.variance

        row, horizon = torch.tensor(given.ahead[:1]), torch.tensor(given.ahead)
        return {"row, mean and std": lambda: moments(row), "horizon, mean and std": lambda: moments(horizon)}


class ExactGP(Peer):
    """scikit-learn's GaussianProcessRegressor. Its default floor of the noise, 1e-5, is above the noise of dynamics."""

    modules = ("sklearn.gaussian_process", "scipy")
    sharing = ("none", "all")
    points = "rows"
    jitter = "none (alpha=0)"

    def at_fixed(self, fixed: Fixed) -> Said:
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

        shape = RBF(fixed.lengthscales) if fixed.kernel == "rbf" else Matern(fixed.lengthscales, nu=2.5)
        kernel = ConstantKernel(fixed.signal) * shape + WhiteKernel(fixed.noise)
        model = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=None).fit(fixed.X, fixed.y)
        mean, std = model.predict(fixed.X_test, return_std=True)
        return model.log_marginal_likelihood_value_, mean, std**2

    def fit(self, job: Job, watch: Watch) -> Fitted:
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

        scaled = Scaled(job)
        kernel = ConstantKernel() * RBF(scaled.lengthscales) + WhiteKernel(job.noise, (1e-10, 10.0))
        gps = [
            GaussianProcessRegressor(kernel, random_state=job.seed).fit(scaled.X, scaled.Y[:, columns])
            for columns in scaled.models
        ]
        return Fitted(scaled.predictor([partial(gp.predict, return_std=True) for gp in gps]), [], "converged")

    def calls(self, given: SimpleNamespace) -> dict[str, Callable[[], object]]:
        """An exact model of as many rows as inducing points."""
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF

        n, kernel = len(given.inducing_points), RBF(np.full(given.X.shape[1], 1.5))
        model = GaussianProcessRegressor(kernel, alpha=0.01, optimizer=None).fit(given.X[:n], given.Y[:n])
        return {
            "row, mean and std": lambda: model.predict(given.ahead[:1], return_std=True),
            "horizon, mean and std": lambda: model.predict(given.ahead, return_std=True),
        }


class Line(Peer):
    """Bayesian ridge regression: what a straight line can do."""

    modules = ("sklearn.linear_model", "scipy")
    points = "none"

    def fit(self, job: Job, watch: Watch) -> Fitted:
        from sklearn.linear_model import BayesianRidge

        scaled = Scaled(job)
        lines = [BayesianRidge().fit(scaled.X, scaled.Y[:, columns[0]]) for columns in scaled.models]
        return Fitted(scaled.predictor([partial(line.predict, return_std=True) for line in lines]), [], "converged")


class Trees(Peer):
    """Gradient boosting with a constant variance: the mean square error of 5-fold cross-validation, not timed."""

    modules = ("sklearn.ensemble", "scipy")
    points = "none"

    def fit(self, job: Job, watch: Watch) -> Fitted:
        from sklearn.ensemble import HistGradientBoostingRegressor
        from sklearn.model_selection import KFold, cross_val_predict

        scaled = Scaled(job)
        models = []
        for columns in scaled.models:
            y = scaled.Y[:, columns[0]]
            trees = HistGradientBoostingRegressor(random_state=job.seed).fit(scaled.X, y)

            def predict(X: np.ndarray, trees: Any = trees, y: np.ndarray = y) -> tuple[np.ndarray, np.ndarray]:
                folds = KFold(5, shuffle=True, random_state=job.seed)
                error = y - cross_val_predict(trees, scaled.X, y, cv=folds)
                return trees.predict(X), np.full(len(X), np.sqrt(np.mean(error**2)))

            models.append(predict)
        return Fitted(scaled.predictor(models), [], "converged")


PEERS: dict[str, Peer] = {
    "skevgp": Skevgp(),
    "GPflow SGPR": GPflow(),
    "GPJax SGPR": GPJax(),
    "GPyTorch SGPR": GPyTorch(),
    "scikit-learn GPR": ExactGP(),
    "scikit-learn HistGradientBoosting": Trees(),
    "scikit-learn BayesianRidge": Line(),
}


def run(peer: Peer, job: Job) -> dict[str, Any]:
    """Fit and predict. The clock runs from the arrays in memory to the fitted model.

    ``mean``, ``std``, ``seconds``, ``cpu_seconds`` and ``bound`` are those of the end, then of the checkpoints before.
    """
    for name in peer.modules:
        import_module(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        watch = Watch(job.time_limit, 1 if job.sharing == "all" else job.Y.shape[1])
        fitted = peer.fit(job, watch)
        bound = sum(fitted.bounds) if fitted.bounds else np.nan
        points = [Checkpoint(watch.seconds, watch.cpu_seconds, bound, fitted.predict)]
        begin = time.perf_counter()
        predictions = [fitted.predict(job.X_test)]
        predict_seconds = time.perf_counter() - begin
        for k in range(job.n_checkpoints if fitted.at else 0):
            point = fitted.at(points[0].seconds / STEP ** (k + 1))
            if point.seconds == points[-1].seconds:  # there was nothing before
                break
            if point.seconds < points[-1].seconds:  # not delayed by other work on the machine
                points.append(point)
                predictions.append(point.predict(job.X_test))
    packages = [import_module(name.partition(".")[0]) for name in (*peer.modules, "numpy")]
    mean, std = (np.array(part) for part in zip(*predictions, strict=True))
    return {
        "mean": mean,
        "std": std,
        **{name: np.array([getattr(p, name) for p in points]) for name in ("seconds", "cpu_seconds", "bound")},
        "predict_seconds": predict_seconds,
        "iterations": fitted.iterations,
        "evaluations": fitted.evaluations,
        "bounds": np.array(fitted.bounds),
        "stop": fitted.stop,
        "curve": np.empty((3, 0)) if fitted.curve is None else fitted.curve,
        "versions": " ".join(f"{package.__name__} {package.__version__}" for package in packages),
    }


def microseconds(call: Callable[[], object], seconds: float) -> float:
    """Return the median of as many calls as fit into the time, at least 20."""
    for _ in range(5):
        call()
    each: list[float] = []
    end = time.perf_counter() + seconds
    while len(each) < 20 or time.perf_counter() < end:
        start = time.perf_counter()
        call()
        each.append(time.perf_counter() - start)
    return 1e6 * float(np.median(each))


def main() -> None:
    """Run a job, answer at fixed hyperparameters, or time predictions, on two cores."""
    peer, given, result = PEERS[sys.argv[1]], load(Path(sys.argv[2])), sys.argv[3]
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    if hasattr(given, "ahead"):
        timed = {name: microseconds(call, given.seconds) for name, call in peer.calls(given).items()}
        np.savez(result, calls=list(timed), microseconds=list(timed.values()))
    elif hasattr(given, "kernel"):
        bound, mean, variance = peer.at_fixed(given)
        np.savez(result, bound=bound, mean=mean, variance=variance)
    else:
        np.savez(result, **run(peer, given))


if __name__ == "__main__":
    main()
