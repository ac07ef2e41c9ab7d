"""Learned parameters of physics: lengths, friction, and the best fit of a wrong simulator.

    python benchmarks/parameters.py pendulum                       # four minutes of one core
    python benchmarks/parameters.py misfit                         # a quarter of an hour of one core
    python benchmarks/parameters.py real --data ../data            # three minutes of one core
    python benchmarks/parameters.py cost                           # two minutes of one core
    python benchmarks/parameters.py pendulum --quick               # one seed, few rows: seconds

*pendulum* has a simulated pendulum of 1 kg with viscous and Stribeck friction. Data are four trajectories of 100 steps
of 0.03 s, and targets are changes of the velocity with 1 % noise. Medians of the priors are 20 % off. "learned" has a
`ParametricFeatures` of four steps of Runge and Kutta's rule with four parameters. "fixed, 20 % off" has the same
function with all parameters too large by 20 %, and "fixed, right" with the true ones. With a ripple, the motor has a
torque that depends on the angle, which the function does not know. Errors are those of four other trajectories.

*misfit* has wrong simulators of one parameter. "line" is that of Plumlee (2017): 4 x + x sin(5 x) on [0, 1], simulated
by θ x. "decay" is that of Bayarri et al. (2007): 3.5 exp(-1.7 x) + 1.5 on [0, 3], simulated by 5 exp(-θ x). The true
value is the best fit in least squares to the noise-free function on the rows. "projection" fits the simulator to 200
samples of the posterior of "free" (Xie & Xu 2021).

*real* has a pendulum (logs of the folder real/simple_pendulum), with one step of 0.02 s and rollouts of a second. Each
run is left out once.

*cost* has processor seconds of fits with parameters, and with the same function at fixed parameters. These fits
alternate.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import autograd.numpy as anp
import numpy as np
import pandas as pd
from scipy.optimize import least_squares, minimize_scalar
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.preprocessing import FunctionTransformer

import harness
import machines
from robots import geometric
from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.features import LogNormal, Normal, ParametricFeatures

GRAVITY = 9.81
ONE = CoefPrior(mean=1.0, scale=0.0)

# --- the pendulum --------------------------------------------------------------------------------------------------

Pendulum = namedtuple("Pendulum", "ripple model seed size")

TRUE = {"length": 0.5, "damping": 0.1, "coulomb": 0.2, "stribeck_velocity": 0.5}
PRIORS = {
    "length": LogNormal(0.6, 0.3),
    "damping": LogNormal(0.12, 0.5),
    "coulomb": LogNormal(0.24, 0.5),
    "stribeck_velocity": LogNormal(0.6, 0.5),
}
MODELS = ("learned", "learned, orthogonal", "fixed, 20 % off", "fixed, right", "no physics")
RIPPLES, STEP, MASS, SPEED = (0.0, 0.1), 0.03, 1.0, 0.1


def change(acceleration: Callable[..., Any], X: Any, dt: float, n_steps: int = 1) -> tuple[Any, Any]:
    """Return the changes of q and q̇ of rows [q, q̇, u] by steps of Runge and Kutta's rule."""
    q, v, u = X[:, 0], X[:, 1], X[:, 2]
    start, h = (q, v), dt / n_steps
    for _ in range(n_steps):
        v1, a1 = v, acceleration(q, v, u)
        v2, a2 = v + h / 2 * a1, acceleration(q + h / 2 * v1, v + h / 2 * a1, u)
        v3, a3 = v + h / 2 * a2, acceleration(q + h / 2 * v2, v + h / 2 * a2, u)
        v4, a4 = v + h * a3, acceleration(q + h * v3, v + h * a3, u)
        q, v = q + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return q - start[0], v - start[1]


def swing(
    q: Any, v: Any, u: Any, length: Any, damping: Any, coulomb: Any, stribeck_velocity: Any, ripple: float
) -> Any:
    """Return accelerations under viscous and Stribeck friction."""
    dry = coulomb * (1.0 + 0.5 * anp.exp(-((v / stribeck_velocity) ** 2))) * anp.tanh(v / SPEED)
    torque = u - damping * v - dry - MASS * GRAVITY * length * anp.sin(q) + ripple * anp.sin(6 * q)
    return torque / (MASS * length**2)


def velocity_change(X: Any, **theta: Any) -> Any:
    """Return the physics of the models: the change of q̇ in a step, (n, 1)."""
    return change(partial(swing, ripple=0.0, **theta), X, STEP, n_steps=4)[1].reshape(-1, 1)


def trajectories(rng: np.random.Generator, ripple: float, n: int, n_steps: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """Return rows [q, q̇, u] and changes of q̇ of some trajectories under random torques."""
    X, y = np.empty((n, n_steps, 3)), np.empty((n, n_steps))
    state = np.column_stack([rng.uniform(-np.pi, np.pi, n), rng.uniform(-1.0, 1.0, n)])
    torques = np.repeat(rng.uniform(-4.0, 4.0, (-(-n_steps // 5), n)), 5, axis=0)
    for step in range(n_steps):
        X[:, step] = np.column_stack([state, torques[step]])
        moved, y[:, step] = change(partial(swing, ripple=ripple, **TRUE), X[:, step], STEP, n_steps=30)
        state = state + np.column_stack([moved, y[:, step]])
    return X.reshape(-1, 3), y.ravel()


def pendulum_model(name: str, **options: Any) -> EVGPRegressor:
    """Return a model of the change of q̇."""
    if name.startswith("learned"):
        features = ParametricFeatures(velocity_change, PRIORS, units={"length": "m", "stribeck_velocity": "rad/s"})
        discrepancy = "orthogonal" if name.endswith("orthogonal") else "free"
        return EVGPRegressor(features, coef_prior=ONE, discrepancy=discrepancy, random_state=0, **options)
    if name == "no physics":
        return EVGPRegressor(random_state=0, **options)
    theta = {key: value * (1.2 if "off" in name else 1.0) for key, value in TRUE.items()}
    features = FunctionTransformer(velocity_change, kw_args=theta)
    return EVGPRegressor(features, coef_prior=ONE, random_state=0, **options)


def intervals_of(model: EVGPRegressor | EGPRegressor) -> dict[str, tuple[float, float]]:
    """Return the 95 % intervals of the parameters of a fitted model's features."""
    found = [one for one in model.summary().parameters if one.part == "parameter"]
    return {one.name.partition(" [")[0]: (one.low, one.high) for one in found}  # "length [m]"


def run_pendulum(cell: Pendulum) -> dict[str, Any]:
    """Fit a model, and compare its parameters with the true ones."""
    rng, short = np.random.default_rng(cell.seed), cell.size == "quick"
    X, y = trajectories(rng, cell.ripple, 4, 30 if short else 100)
    X_test, y_test = trajectories(rng, cell.ripple, 4)
    noisy = y + 0.01 * y.std() * rng.standard_normal(len(y))
    model = pendulum_model(cell.model, **({"max_iter": 10, "n_inducing": 10} if short else {}))
    seconds, _ = harness.timed(lambda: model.fit(X, noisy, groups=np.repeat(range(4), len(X) // 4)))
    mean, std = model.predict(X_test, return_std=True, include_noise=False)
    row = {"rmse": float(np.sqrt(np.mean((mean - y_test) ** 2))), "seconds": seconds}
    row["cr2"] = float(np.mean(np.abs(mean - y_test) < 2.0 * std))
    intervals = intervals_of(model) if cell.model.startswith("learned") else {}
    for name, value in TRUE.items():
        low, high = intervals.get(name, (np.nan, np.nan))
        row |= {f"low_{name}": low, f"high_{name}": high, f"true_{name}": value}
    return row


def pendulum_tables(rows: pd.DataFrame) -> harness.Tables:
    learned = rows[rows["model"].str.startswith("learned")]
    coverage = []
    for (ripple, model), own in learned.groupby(["ripple", "model"], sort=False):
        row = {"ripple, N m": ripple, "model": model, "seeds": own["seed"].nunique()}
        for name in TRUE:
            inside = (own[f"low_{name}"] <= own[f"true_{name}"]) & (own[f"true_{name}"] <= own[f"high_{name}"])
            row[name.replace("_", " ")] = f"{inside.mean():.3f}"
        coverage.append(row)
    wrong = rows[rows["model"] == "fixed, 20 % off"].set_index(["ripple", "seed"])["rmse"]
    rows = rows.assign(ratio=rows["rmse"] / rows.set_index(["ripple", "seed"]).index.map(wrong))
    errors = rows.groupby(["ripple", "model"], sort=False).agg(
        rmse=("rmse", geometric), ratio=("ratio", geometric), cr2=("cr2", "mean"), seconds=("seconds", "median")
    )
    errors = errors.reset_index().rename(
        columns={"ripple": "ripple, N m", "rmse": "RMSE, rad/s", "ratio": "over 20 % off", "cr2": "CR-2"}
    )
    return {"coverage": pd.DataFrame(coverage), "errors": errors}


# --- a simulator that is wrong -------------------------------------------------------------------------------------

Misfit = namedtuple("Misfit", "problem n_rows model seed size")


def line(X: Any, slope: Any) -> Any:
    """Return the simulator of Plumlee (2017)."""
    return slope * X


def decay(X: Any, rate: Any) -> Any:
    """Return the simulator of Bayarri et al. (2007)."""
    return 5.0 * anp.exp(-rate * X)


# The true function, the simulator, its prior, the largest x, and the standard deviation of the noise.
PROBLEMS: dict[str, Any] = {
    "line": (lambda x: 4.0 * x + x * np.sin(5.0 * x), line, {"slope": Normal(3.0, 1.0)}, 1.0, 0.02),
    "decay": (lambda x: 3.5 * np.exp(-1.7 * x) + 1.5, decay, {"rate": LogNormal(1.0, 0.7)}, 3.0, 0.3),
}
MISFITS, ROWS, SAMPLES = ("free", "projection", "orthogonal"), (30, 100), 200


def best_fit(simulator: Callable[..., Any], name: str, X: np.ndarray, values: np.ndarray) -> float:
    """Return the parameter of least squares."""

    def loss(theta: float) -> float:
        return float(np.mean((values - simulator(X, **{name: theta})[:, 0]) ** 2))

    return float(minimize_scalar(loss, bounds=(0.05, 8.0), method="bounded", options={"xatol": 1e-9}).x)


def run_misfit(cell: Misfit) -> dict[str, Any]:
    """Fit a wrong simulator, and compare its parameter with the best fit to the noise-free function."""
    function, simulator, prior, most, noise = PROBLEMS[cell.problem]
    (name,), rng = prior, np.random.default_rng(cell.seed)
    X = most * ((np.arange(cell.n_rows) + 0.5) / cell.n_rows).reshape(-1, 1)
    y = function(X[:, 0]) + noise * rng.standard_normal(cell.n_rows)
    discrepancy = "orthogonal" if cell.model == "orthogonal" else "free"
    features = ParametricFeatures(simulator, prior)
    model = EGPRegressor(features, coef_prior=ONE, discrepancy=discrepancy, random_state=0).fit(X, y)
    low, high = intervals_of(model)[name]
    if cell.model == "projection":
        samples = model.sample_y(X, 20 if cell.size == "quick" else SAMPLES, 0, include_noise=False)
        low, high = np.quantile([best_fit(simulator, name, X, own) for own in samples.T], [0.025, 0.975])
    true = best_fit(simulator, name, X, function(X[:, 0]))
    error = float(np.sqrt(np.mean((model.predict(X) - function(X[:, 0])) ** 2)))
    return {"low": low, "high": high, "true": true, "inside": float(low <= true <= high), "rmse": error}


def misfit_tables(rows: pd.DataFrame) -> harness.Tables:
    rows = rows.assign(width=rows["high"] - rows["low"], off=0.5 * (rows["high"] + rows["low"]) - rows["true"])
    found = rows.groupby(["problem", "n_rows", "model"], sort=False).agg(
        seeds=("seed", "nunique"),
        inside=("inside", "mean"),
        width=("width", "mean"),
        off=("off", "mean"),
        rmse=("rmse", geometric),
    )
    found = found.reset_index()
    found["inside"] = harness.text(found["inside"], 3)
    names = {"n_rows": "rows", "inside": "coverage", "width": "mean width", "off": "mean error of centre"}
    return {"misfit": found.rename(columns=names | {"rmse": "RMSE of g on the rows"})}


# --- a real pendulum -----------------------------------------------------------------------------------------------

Real = namedtuple("Real", "split model size")

# Of the authors' repository, dfki-ric-underactuated-lab/torque_limited_simple_pendulum, data/models/sp_parameters.yaml.
AUTHORS = {"length": 0.5, "mass": 0.6755, "damping": 0.1, "coulomb": 1.3}
REAL_PRIORS = {
    "length": LogNormal(0.5, 0.3),
    "mass": LogNormal(0.6, 0.5),
    "damping": LogNormal(0.1, 1.0),
    "coulomb": LogNormal(0.1, 1.5),
}
UNITS = {"length": "m", "mass": "kg", "damping": "N m s/rad", "coulomb": "N m"}
REAL = ("learned", "learned, orthogonal", "least squares", "authors' numbers", "authors' numbers with GP", "no physics")


def driven(q: Any, v: Any, u: Any, length: Any, mass: Any, damping: Any, coulomb: Any) -> Any:
    """Return accelerations of a point mass under viscous and dry friction."""
    torque = u - damping * v - coulomb * anp.tanh(v / SPEED) - mass * GRAVITY * length * anp.sin(q)
    return torque / (mass * length**2)


def state_change(X: Any, **theta: Any) -> Any:
    """Return the changes of q and q̇ in a step, as a row of features for each output, (n, 2, 1)."""
    return anp.stack(change(partial(driven, **theta), X, machines.STEP, n_steps=2), axis=1)[:, :, anp.newaxis]


class Physics(RegressorMixin, BaseEstimator):
    """The function alone, with given parameters or those of least squares, and independent errors."""

    def __init__(self, theta: dict[str, float] | None = None):
        self.theta = theta

    def fit(self, X: np.ndarray, Y: np.ndarray, groups: Any = None) -> Physics:
        """Find the parameters and the noise."""
        change_of, names = Y - X[:, :2], list(REAL_PRIORS)

        def residuals(logs: np.ndarray) -> np.ndarray:
            found = state_change(X, **dict(zip(names, np.exp(logs), strict=True)))[:, :, 0]
            return ((found - change_of) / change_of.std(axis=0)).ravel()

        self.theta_ = self.theta
        if self.theta is None:
            start = np.log([prior.value(0.0) for prior in REAL_PRIORS.values()])
            self.theta_ = dict(zip(names, np.exp(least_squares(residuals, start).x).tolist(), strict=True))
        self.std_ = np.sqrt(np.mean((self.predict(X) - Y) ** 2, axis=0))
        return self

    def predict(self, X: np.ndarray, return_std: bool = False) -> Any:
        """Predict the next state."""
        mean = X[:, :2] + state_change(X, **self.theta_)[:, :, 0]
        return (mean, np.tile(self.std_, (len(X), 1))) if return_std else mean


class NextState(RegressorMixin, BaseEstimator):
    """A model of the change of state, as a model of the next state."""

    def __init__(self, model: Any):
        self.model = model

    def fit(self, X: np.ndarray, Y: np.ndarray, groups: Any = None) -> NextState:
        """Fit the model."""
        self.model.fit(X, Y - X[:, :2], groups=groups)
        return self

    def predict(self, X: np.ndarray, return_std: bool = False) -> Any:
        """Predict the next state."""
        found = self.model.predict(X, return_std=return_std)
        return (X[:, :2] + found[0], found[1]) if return_std else X[:, :2] + found


def real_model(name: str, quick: bool) -> Any:
    """Return a model of the next state."""
    options: dict[str, Any] = {"random_state": 0, **({"max_iter": 5, "n_inducing": 10} if quick else {})}
    if name in ("least squares", "authors' numbers"):
        return Physics(AUTHORS if name.startswith("authors") else None)
    if name == "no physics":
        return NextState(EVGPRegressor(**options))
    if name.startswith("learned"):
        features: Any = ParametricFeatures(state_change, REAL_PRIORS, UNITS)
        options["discrepancy"] = "orthogonal" if name.endswith("orthogonal") else "free"
    else:
        features = FunctionTransformer(state_change, kw_args=AUTHORS)
    return NextState(EVGPRegressor(features, coef_prior=ONE, **options))


def run_real(cell: Real, data: Path | None) -> dict[str, Any]:
    """Fit a model to three runs, and judge one step and rollouts of the run that is left out."""
    trained, (tested,) = machines.MACHINES["simple pendulum"].splits[cell.split]
    train, test = (
        machines.transitions(machines.rows_of("simple pendulum", moves, data, "full", dt=machines.STEP))
        for moves in (trained, (tested,))
    )
    model = real_model(cell.model, cell.size == "quick")
    seconds, _ = harness.timed(lambda: model.fit(train.data, train.target, groups=train.groups))
    mean, std = model.predict(test.data, return_std=True)
    change_of = test.target - test.data[:, :2]
    error = np.mean((mean - test.target) ** 2, axis=0) / change_of.var(axis=0)
    row = {"nmse": float(np.exp(np.mean(np.log(error)))), "cr2": float(np.mean(np.abs(mean - test.target) < 2.0 * std))}
    row |= rollouts(model, test) | {"seconds": seconds}
    intervals: dict[str, tuple[float, float]] = {}
    if cell.model.startswith("learned"):
        intervals = intervals_of(model.model)
    elif cell.model == "least squares":
        intervals = {name: (value, value) for name, value in model.theta_.items()}
    for name in REAL_PRIORS:
        row[f"low_{name}"], row[f"high_{name}"] = intervals.get(name, (np.nan, np.nan))
    return row


def rollouts(model: Any, test: Any) -> dict[str, float]:
    """Return the median error of angles after a second, from 20 states, of rollouts of the mean, over their scatter."""
    steps = machines.ROLLOUT_STEPS
    first = np.linspace(0, len(test.data) - steps - 1, machines.STARTS).astype(int)
    first = first[test.pieces[first] == test.pieces[first + steps - 1]]
    state = test.data[first, :2]
    for step in range(steps):
        state = model.predict(np.column_stack([state, test.data[first + step, 2]]))
    error = np.abs(state[:, 0] - test.target[first + steps - 1, 0])
    return {"rollout": float(np.median(error) / test.data[:, 0].std())}


def real_tables(rows: pd.DataFrame) -> harness.Tables:
    found = rows.groupby("model", sort=False).agg(
        nmse=("nmse", geometric), cr2=("cr2", "mean"), rollout=("rollout", geometric), seconds=("seconds", "mean")
    )
    found = found.reindex(harness.ordered(REAL, found.index)).reset_index()
    found["cr2"] = harness.text(found["cr2"], 3)
    errors = found.rename(columns={"nmse": "nMSE of the change", "cr2": "CR-2", "rollout": "error of rollouts"})
    parameters = []
    for name, author in AUTHORS.items():
        row: dict[str, Any] = {"parameter": f"{name}, {UNITS[name]}", "authors": author}
        for model, own in rows[rows["model"].isin(REAL[:3])].groupby("model", sort=False):
            low, high = own[f"low_{name}"], own[f"high_{name}"]
            row[model] = (
                f"{low.min():.3g} to {high.max():.3g}"
                if model == "least squares"
                else "; ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(low, high, strict=True))
            )
        parameters.append(row)
    return {"errors": errors, "parameters": pd.DataFrame(parameters)}


# --- cost ----------------------------------------------------------------------------------------------------------

Cost = namedtuple("Cost", "n_trajectories ripple seed size")

COSTS = {"learned": "learned", "right": "fixed, right", "off": "fixed, 20 % off", "none": "no physics"}


def run_cost(cell: Cost) -> dict[str, Any]:
    """Time fits with and without parameters, in turns."""
    rng, short = np.random.default_rng(cell.seed), cell.size == "quick"
    X, y = trajectories(rng, cell.ripple, cell.n_trajectories, 20 if short else 100)
    y = y + 0.01 * y.std() * rng.standard_normal(len(y))
    groups = np.repeat(range(cell.n_trajectories), len(X) // cell.n_trajectories)
    found: dict[str, list[float]] = {}
    for _ in range(1 if short else 3):
        for name, model_name in COSTS.items():
            model = pendulum_model(model_name, **({"max_iter": 5, "n_inducing": 10} if short else {}))
            seconds, _ = harness.timed(partial(model.fit, X, y, groups=groups))
            found.setdefault(name, []).append(seconds)
    return {name: float(np.median(seconds)) for name, seconds in found.items()}


def cost_tables(rows: pd.DataFrame) -> harness.Tables:
    rows = rows.assign(
        right=rows["learned"] / rows["right"],
        off=rows["learned"] / rows["off"],
        none=rows["learned"] / rows["none"],
    )
    found = rows.groupby(["n_trajectories", "ripple"], sort=False).agg(
        seconds=("learned", "median"), right=("right", geometric), off=("off", geometric), none=("none", geometric)
    )
    names = {
        "n_trajectories": "trajectories",
        "ripple": "ripple, N m",
        "right": "over fixed, right",
        "off": "over fixed, 20 % off",
        "none": "over no physics",
    }
    return {"cost": found.reset_index().rename(columns=names)}


# --- command -------------------------------------------------------------------------------------------------------


def cells_of(options: Any) -> list[Any]:
    """Return the cells of a part."""
    if options.part == "pendulum":
        return [Pendulum(r, m, s, options.size) for r in RIPPLES for m in MODELS for s in options.seeds]
    if options.part == "misfit":
        return [
            Misfit(p, n, m, s, options.size) for p in PROBLEMS for n in ROWS for m in MISFITS for s in options.seeds
        ]
    if options.part == "cost":
        seeds = options.seeds[:5]
        return [Cost(n, r, s, options.size) for n in (4, 40) for r in RIPPLES for s in seeds]
    splits = machines.MACHINES["simple pendulum"].splits
    return [Real(split, model, options.size) for split in splits for model in REAL]


PARTS = {  # CSV, function, tables, title
    "pendulum": ("parameters", run_pendulum, pendulum_tables, "Parameters of a pendulum"),
    "misfit": ("parameters_misfit", run_misfit, misfit_tables, "Wrong simulators"),
    "real": ("parameters_real", run_real, real_tables, "Parameters of a real pendulum"),
    "cost": ("parameters_cost", run_cost, cost_tables, "Cost of parameters"),
}


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="one seed, few rows and iterations", seeds=100)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--data", type=Path, help="the folder of logs, for real")
    options = harness.parse(parser)
    name, run, tables_of, title = PARTS[options.part]
    output = harness.output_path(options, name)
    if options.part == "real":
        if options.data is None:
            parser.error("real needs --data")
        run = partial(run_real, data=options.data.resolve())
    n_failures = harness.run_missing(cells_of(options), run, output, options.jobs)
    harness.write_page(title, tables_of(harness.frame(output, size=options.size)), output, n_failures)


if __name__ == "__main__":
    main()
