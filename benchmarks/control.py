"""Learned models for control: rollouts, swing-ups by planning, and tracking with an unknown load.

    python benchmarks/control.py rollouts                    # three systems, five models, two seeds: hours of one core
    python benchmarks/control.py rollouts --models EVGP-IFG  # one model: twenty minutes
    python benchmarks/control.py rollouts --systems iiwa14 --models EVGP-IFG  # not among the three
    python benchmarks/control.py swing_up --seeds 10         # hours of one core
    python benchmarks/control.py swing_up --systems pendulum --models evgp-ifg --noises 0.01
    python benchmarks/control.py tracking                    # a quarter of an hour of one core
    python benchmarks/control.py swing_up --quick            # the pendulum, one seed: half a minute

*rollouts* compares predictions of 100 steps, from new initial states and with new inputs, to the true states.
Position errors are those of the mean fed back and of the particles' mean. CR-1 to CR-3 are shares of the true states
within 1, 2 and 3 standard deviations. The data are the paper's, or a tenth of them. They have no noise, or noise of 1 %
of each state's standard deviation. iiwa14 learns from its moves of 50 steps, and is tested on slower ones of 100.

*swing_up* has the planner of examples/mpc.py. It swings up a pole from rest, by iLQR on the model at each step (0.03
s). The limits are 100 N on the cart and 2 N m on the pendulum. The pendulum needs more than twice this torque to be
held level. A run succeeds if the pole is within 0.1 rad of upright for the last of five seconds. The model is EVGP-IFG,
or a Gaussian process of the change of state without physics. Both have sines and cosines for the kernel, and learn from
short trajectories from random states. "Without f" are the features of EVGP-IFG without a Gaussian process. "Second
order" is EVGP-IFG with one more feature, for the pendulum: q̇ cos q, by which the acceleration of gravity changes within
a step. Noise is a share of the states' standard deviation, in the data and in the states that the planner gets. "The
truth" plans on the simulated system.

*tracking* has arms with unknown loads. The iiwa14 of examples/computed_torque.py has a load and friction that its model
does not know. Its masses are 5 % off. All models learn from one log of a minute at 50 Hz. They are compared on other
references: other waves, slow ones, and quick moves. Then moves are made as fast as limits of torque allow. The mean, or
the mean and k standard deviations, must stay within 35 % of the largest torques of the motors (45 % with more than 3
kg).
"""

from __future__ import annotations

import itertools
import sys
import time
from collections import namedtuple
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))  # for the controllers

import numpy as np
import pandas as pd
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.gaussian_process.kernels import RBF, ConstantKernel
from sklearn.pipeline import make_union
from sklearn.preprocessing import FunctionTransformer
from sklearn.utils import Bunch

import computed_torque as arms
import harness
import mpc
from computed_torque import DT, ComputedTorque
from harness import figure_of, text
from paper.models import SIZES as PAPERS_SIZES
from paper.models import SYSTEMS as PAPERS_SYSTEMS
from paper.models import Fit, build, fitted_part, groups_of
from skevgp import EVGPRegressor, rollout
from skevgp.datasets import load_robot, make_dynamics
from skevgp.datasets.plant import Plant
from skevgp.features import InertiaForceGravity
from skevgp.metrics import crps
from skevgp.robots import RigidBody
from skevgp.solvers import LBFGS

# --- rollouts ------------------------------------------------------------------------------------------------------

# Numbers of inducing points of EVGP. The other models have the paper's number.
ROLLOUT_SYSTEMS = {"pendulum": (10,), "cartpole": (60, 150), "acrobot": (150,), "iiwa14": (350,)}
DEFAULT_SYSTEMS = ("pendulum", "cartpole", "acrobot")
# VGP predicts angles and not their changes, so its angles cannot be encoded.
ROLLOUT_MODELS = {
    "EVGP-IFG": "skevgp-angles",
    "EVGP-IF": "skevgp-angles",
    "RES-VGP": "skevgp-angles",
    "VGP": "skevgp",
    "RES-DBNN": "skevgp-angles",
}
MAIN = "EVGP-IFG"
ROLLOUT_NOISES, SHARES = ("0.0", "0.01"), ("1", "0.1")
HORIZONS = (1, 10, 50, 100)
TEST_TRAJECTORIES, PARTICLES, ITERATIONS = 40, 100, 300
# Of the page's lines.
ORDERS = {"system": ROLLOUT_SYSTEMS, "model": ROLLOUT_MODELS, "noise": ("none", "1 %"), "share": SHARES}
# Name of each method, and arguments of `rollout`.
METHODS: dict[str, dict[str, str]] = {
    "consistent": {},
    "consistent, no noise": {"process_noise": "none"},
    "independent": {},
    "linearized": {"method": "linearized"},
    "mean": {"method": "mean"},
}

# One fit. ``n_inducing`` is 0 for a network; ``share`` is that of the paper's trajectories.
Rollout = namedtuple("Rollout", "system model n_inducing noise share seed size")


class Independent(RegressorMixin, BaseEstimator):
    """A fitted regressor without functions to follow, so that each step is an independent draw."""

    def __init__(self, regressor: Any):
        self.regressor = regressor
        self.n_features_in_ = regressor.n_features_in_

    def fit(self, X: Any, y: Any) -> Independent:
        return self

    def predict(self, X: np.ndarray, return_std: bool = False) -> Any:
        return self.regressor.predict(X, return_std=return_std)


def data(cell: Rollout) -> tuple[Bunch, Bunch]:
    """Return training data, and true trajectories from other states with other inputs."""
    n_test = 4 if cell.size == "quick" else TEST_TRAJECTORIES
    everything = make_dynamics(
        cell.system, random_state=cell.seed, noise=float(cell.noise), input_noise=float(cell.noise)
    )
    n_train = round(float(cell.share) * len(everything.trajectories))
    rows = everything.groups < (min(n_train, 6) if cell.size == "quick" else n_train)
    train = Bunch(
        data=everything.data[rows],
        target=everything.target[rows],
        groups=everything.groups[rows],
        scatter=everything.trajectories.reshape(-1, everything.target.shape[1]).std(axis=0),
    )
    return train, make_dynamics(cell.system, n_test, HORIZONS[-1], random_state=1000 + cell.seed)


def particles_of(model: str) -> str:
    """Return the method of particles. A network has no functions that particles could follow."""
    return "independent" if model == "RES-DBNN" else "consistent"


def crps_of_samples(truth: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the CRPS of samples (n, ...), whose mean does not depend on n (Ferro 2014)."""
    n = len(samples)
    ranks = 2.0 * np.arange(n) - n + 1.0
    spread = np.tensordot(ranks, np.sort(samples, axis=0), axes=1) / (n * (n - 1))
    return np.abs(samples - truth).mean(axis=0) - spread


def measures(truth: np.ndarray, ahead: Bunch, step: int, scatter: np.ndarray) -> dict[str, float]:
    """Return scores after some steps, of states (n, steps, 2 n_joints) with this scatter, positions first."""
    true, mean, std = (values[:, step - 1] / scatter for values in (truth, ahead.mean, ahead.std))
    errors, n_joints = np.abs(true - mean), len(scatter) // 2
    positions = np.sqrt(np.mean(errors[:, :n_joints] ** 2, axis=1))
    score = np.nan  # of an unstable system
    if "samples" in ahead:
        score = crps_of_samples(true, np.moveaxis(ahead.samples[:, :, step - 1], 1, 0) / scatter).mean()
    elif np.isfinite(mean).all():
        score = crps(true, mean, std) / len(scatter)
    return {
        "error_median": np.median(positions),
        "error_p90": np.quantile(positions, 0.9),
        **{f"cr{k}": np.mean(errors <= k * std) for k in (1, 2, 3)},
        "crps": score,
        # 0.674 if standard deviations are calibrated.
        "errors_in_std": np.median(errors / std),
    }


def run_rollouts(cell: Rollout) -> list[dict[str, Any]]:
    """Fit one model and roll it out by all methods. ``fit_seconds`` is processor time of one thread."""
    train, test = data(cell)
    max_iter = 20 if cell.size == "quick" else ITERATIONS
    model = build(Fit(cell.system, cell.model, ROLLOUT_MODELS[cell.model], cell.seed, cell.size, max_iter))
    if cell.n_inducing:
        model.set_params(**{"regressor__n_inducing" if cell.model == "RES-VGP" else "n_inducing": cell.n_inducing})
    seconds, _ = harness.timed(lambda: model.fit(train.data, train.target, **groups_of(model, train)))
    fitted, rows = fitted_part(model), []
    common = {
        "n_rows": len(train.data),
        "n_iter": fitted.n_iter_,
        "noise_std": np.median(np.sqrt(fitted.noise_variance_) / train.scatter),
        "fit_seconds": seconds,
        "max_iter": max_iter,
    }
    for method in METHODS if cell.model == MAIN else (particles_of(cell.model), "mean"):
        ahead, taken = rolled_out(model, method, test, cell)
        for step in HORIZONS:
            found = measures(test.trajectories[:, 1:], ahead, step, train.scatter)
            rows.append({"method": method, "steps": step, **found, **common, "rollout_seconds": taken})
    return rows


def rolled_out(model: Any, method: str, test: Bunch, cell: Rollout) -> tuple[Bunch, float]:
    """Return the rollout, NaN if the learned system is unstable, and processor seconds of one thread."""
    n, n_states = len(test.trajectories), test.target.shape[1]
    inputs = test.data[:, n_states:].reshape(n, -1, test.data.shape[1] - n_states)
    options = {"n_samples": 10 if cell.size == "quick" else PARTICLES, "random_state": cell.seed, **METHODS[method]}
    nothing = np.full(test.trajectories[:, 1:].shape, np.nan)
    ahead = Bunch(mean=nothing, std=nothing)
    model = Independent(model) if method == "independent" else model

    def roll() -> None:
        try:
            ahead.update(rollout(model, test.trajectories[:, 0], inputs, **options))
        except ValueError as problem:
            if "unstable" not in str(problem):
                raise

    seconds, _ = harness.timed(roll)
    return ahead, seconds


def sizes(system: str, model: str) -> tuple[int, ...]:
    if model == "RES-DBNN":
        return (0,)
    return ROLLOUT_SYSTEMS[system] if model.startswith("EVGP") else (PAPERS_SIZES[model][PAPERS_SYSTEMS.index(system)],)


def rollout_cells(options: Any) -> list[Rollout]:
    """Return the cells. The largest models come last, and other seeds after all systems."""
    systems = ("pendulum",) if options.quick else options.systems or DEFAULT_SYSTEMS
    return [
        Rollout(system, model, m, noise, share, seed, options.size)
        for seed, model, number in itertools.product(options.seeds, options.models or ROLLOUT_MODELS, (0, 1))
        for system in systems
        for m in sizes(system, model)[number : number + 1]
        for noise, share in itertools.product(ROLLOUT_NOISES, SHARES)
    ]


def rollout_tables(rows: pd.DataFrame) -> harness.Tables:
    """Return position errors, calibration, and in how many fits of the main model intervals are calibrated."""
    rows = rows.assign(noise=rows["noise"].map(lambda noise: f"{100 * noise:g} %" if noise else "none"))
    rows["share"] = rows["share"].map("{:g}".format)
    rows = rows.assign(
        size=rows["n_inducing"].replace(0, sys.maxsize),  # networks after all numbers of points
        **{name: pd.Categorical(rows[name], order) for name, order in ORDERS.items()},
    )
    errors, bands, promises = [], [], []
    for found, own in rows.groupby(["system", "size", "model", "noise", "share"], observed=True):
        system, _, model, noise, share = found
        m = own["n_inducing"].iloc[0]
        line = {"": f"{system} m={m}" if m else system, "model": model, "noise": noise, "share": share}
        means = own.groupby(["method", "steps"]).mean(numeric_only=True)
        fed_back, particles = means.loc["mean"], means.loc[particles_of(model)]["error_median"]
        texts = fed_back["error_median"].map(figure_of) + fed_back["error_p90"].map(lambda p90: f" ({figure_of(p90)})")
        last = {"particles' mean: 1": particles.iloc[0], "100": particles.iloc[-1]}
        errors.append({**line, "seeds": own["seed"].nunique(), **texts.rename("after {}".format), **last})
        for method in list(METHODS)[:-1] if model == MAIN else [particles_of(model)]:
            cr2, scores = (means.loc[method][name] for name in ("cr2", "crps"))
            columns = {**cr2.map("{:.2f}".format).rename("CR-2: {}".format), **scores.rename("CRPS: {}".format)}
            bands.append({**line, "particles": method, **columns})
    cells = ["system", "n_inducing", "seed", "steps"]
    for (noise, share), own in rows[rows["model"] == MAIN].groupby(["noise", "share"], observed=True):
        by_method = own.set_index(["method", *cells])
        for method in ("consistent", "consistent, no noise"):
            particles, others = by_method.loc[method], by_method.loc["independent"]
            most = 1.0 if noise == "none" else 0.99
            tests = {f"CR-2 from 0.9 to {most:g}": particles["cr2"].between(0.9, most)}
            tests["CRPS no worse than independent"] = particles["crps"] <= others["crps"].loc[particles.index]
            for name, held in tests.items():
                counts = held.groupby("steps").agg(["sum", "size"]).astype(str)
                columns = (counts["sum"] + " of " + counts["size"]).rename("after {}".format)
                promises.append({"noise": noise, "share": share, "particles": method, "": name, **columns})
    tables = {"position errors": errors, "intervals": bands, "fits": promises}
    return {name: pd.DataFrame(lines) for name, lines in tables.items()}


# --- swing-ups -----------------------------------------------------------------------------------------------------

SECONDS = (1.5, 3.0, 4.5, 9.0, 30.0)
NOISES = (0.0, 0.01)
LENGTHS = (10, 25)
SYSTEMS = ("cartpole", "pendulum")
SWING_UPS = {
    "evgp-ifg": "EVGP-IFG",
    "second": "EVGP-IFG, second order",
    "weights": "EVGP-IFG without f",
    "gp": "without physics",
    "truth": "the truth",
}
# Systems of the model "second".
SECOND_ORDER = ("pendulum",)

# One run. The truth has no data, and seeds differ in the first plans and in the noise.
SwingUp = namedtuple("SwingUp", "system model seconds noise length seed size")


class Truth:
    """The simulated system as a model: four Runge-Kutta steps, and finite differences."""

    def __init__(self, system: str, n_steps: int = 4):
        self._plant, self._n_steps = Plant(system), n_steps

    def predict(self, X: np.ndarray, return_std: bool = False) -> Any:
        rows, n, h = np.atleast_2d(X), self._plant.layout.n_joints, mpc.DT / self._n_steps
        z, u = rows[:, : 2 * n], rows[:, 2 * n :]

        def rate(z: np.ndarray) -> np.ndarray:
            return np.hstack([z[:, n:], self._plant.accelerations(z[:, :n], z[:, n:], u)])

        for _ in range(self._n_steps):
            first = rate(z)
            second = rate(z + h / 2.0 * first)
            third = rate(z + h / 2.0 * second)
            z = z + h / 6.0 * (first + 2.0 * second + 2.0 * third + rate(z + h * third))
        z = z.reshape(*X.shape[:-1], -1)
        return (z, np.zeros_like(z)) if return_std else z

    def value_and_jacobian(self, X: np.ndarray, return_std: bool = False) -> Any:
        steps = 1e-5 * np.eye(X.shape[1])
        slopes = np.stack([(self.predict(X + step) - self.predict(X - step)) / 2e-5 for step in steps], axis=-1)
        mean = self.predict(X)
        return (mean, slopes, np.zeros_like(mean), np.zeros_like(slopes)) if return_std else (mean, slopes)


def rate_of_gravity(X: np.ndarray) -> np.ndarray:
    """Return q̇ cos q of a pendulum, the derivative of the feature sin q with respect to time."""
    return X[:, 1:2] * np.cos(X[:, :1])


def settings_of(model: str, system: str) -> dict[str, Any]:
    """Return arguments of `EVGPRegressor` that are not those of EVGP-IFG."""
    if model == "weights":
        return {"kernel": ConstantKernel(1e-10, "fixed") * RBF(1.0, "fixed")}
    if model == "second":
        gravity = InertiaForceGravity(system, dt=mpc.DT)
        return {"feature_map": make_union(gravity, FunctionTransformer(rate_of_gravity))}
    return {}


def scatter(system: str, seed: int) -> np.ndarray:
    """Return the standard deviation of each state in the largest data, of which the noise is a share."""
    n_trajectories = round(SECONDS[-1] / (mpc.LENGTH * mpc.DT))
    return make_dynamics(system, n_trajectories, mpc.LENGTH, dt=mpc.DT, random_state=seed).target.std(axis=0)


def run_swing_up(cell: SwingUp) -> dict[str, Any]:
    """Learn, and swing up. Seconds are processor time of one thread."""
    task = mpc.TASKS[cell.system]
    with harness.one_thread():
        start = time.process_time()
        if cell.model == "truth":
            model, noise = Truth(cell.system), cell.noise * scatter(cell.system, cell.seed)
        else:
            data = (cell.seconds, cell.model != "gp", cell.noise, cell.seed, cell.length)
            learned = mpc.learn(cell.system, *data, **settings_of(cell.model, cell.system))
            model, noise = learned.model.compile(include_noise=False), learned.noise
        middle = time.process_time()
        found = mpc.swing_up(model, task, noise, cell.seed)
        end = time.process_time()
    away = np.flatnonzero(found.distance >= mpc.NEAR)
    return {
        "success": found.success,
        "last_distance": found.distance[-mpc.LAST :].max(),
        "upright_from": mpc.DT * (away[-1] + 1),
        "fit_seconds": middle - start,
        "control_seconds": end - middle,
    }


def swing_up_cells(options: Any) -> list[SwingUp]:
    """Return the cells, seed by seed, so that the page is complete after each seed."""
    if options.quick:
        return [SwingUp("pendulum", model, 3.0, 0.0, mpc.LENGTH, 0, "quick") for model in ("evgp-ifg", "gp")]
    cells = []
    for seed, system in itertools.product(options.seeds, options.systems or SYSTEMS):
        for model in options.models or SWING_UPS:
            if model == "second" and system not in SECOND_ORDER:
                continue
            sizes = itertools.product(SECONDS, options.noises or NOISES, LENGTHS)
            if model == "truth":
                sizes = [(0.0, noise, 0) for noise in options.noises or NOISES]
            cells += [SwingUp(system, model, *size, seed, "full") for size in sizes]
    return cells


def swing_up_tables(rows: pd.DataFrame) -> harness.Tables:
    """Return successes of so many seeds, for each number of seconds of data."""
    seconds, lines = sorted(rows.loc[rows["model"] != "truth", "seconds"].unique()), []
    for (system, model, noise, length), own in rows.groupby(["system", "model", "noise", "length"]):
        line = {"": f"{system}, {SWING_UPS[model]}", "noise": f"{noise:.0%}"}
        line["steps"] = "" if model == "truth" else str(length)
        for n_seconds in seconds:
            some = own["success"] if model == "truth" else own.loc[own["seconds"] == n_seconds, "success"]
            line[f"{n_seconds} s"] = f"{some.sum()} of {len(some)}" if len(some) else ""
        upright = own.loc[own["success"], "upright_from"]
        line["upright from, s"] = f"{upright.median():.2f}" if len(upright) else ""
        line["processor, s"] = f"{own['control_seconds'].median():.1f}"
        lines.append(line)
    return {"swing-ups": pd.DataFrame(lines)}


# --- tracking ------------------------------------------------------------------------------------------------------

PAYLOADS = (0.5, 1.0, 2.0, 3.5, 5.0)
CHANCE = 0.95
NOMINAL, WEIGHTS, BOTH, GP = "nominal model", "weights", "weights and GP", "GP without physics"
CONTROLLERS = {
    NOMINAL: "PD + nominal model",
    "integral": "PID + nominal model",
    WEIGHTS: "+ learned weights",
    BOTH: "+ learned weights and GP",
    GP: "+ GP of the residual, without physics",
}
CASES = ("waves", "slow waves", "moves")

# One arm, with its payload in kg.
Tracking = namedtuple("Tracking", "payload seed size")


# Size of the log and of models, and numbers of references, moves and timed steps.
SIZES = {
    "full": Bunch(runs=6, seconds=10.0, m=40, m_gp=100, max_iter=None, references=4, moves=100, calls=1000),
    "quick": Bunch(runs=3, seconds=4.0, m=10, m_gp=20, max_iter=30, references=1, moves=20, calls=50),
}


class WithoutPhysics:
    """The nominal model, and a Gaussian process of all columns for the residual torque of each joint."""

    def __init__(self, body: RigidBody, log: tuple[np.ndarray, ...], **options: Any):
        self.forces = lambda X: body.forces(*np.split(X, 3, axis=1))
        X, y, groups = log
        self.model = EVGPRegressor(solver=LBFGS(tol=10.0), **options).fit(X, y - self.forces(X), groups=groups)

    def predict(self, X: np.ndarray) -> np.ndarray:
        return self.forces(X) + self.model.predict(X)


def learn(log: tuple[np.ndarray, ...], body: RigidBody, size: Bunch, seed: int) -> dict[str, Any]:
    X, y, groups = log
    options = {"max_iter": size.max_iter, "random_state": seed}
    return {
        WEIGHTS: arms.learner(n_inducing=0).fit(X, y, groups=groups),
        BOTH: arms.learner(n_inducing=size.m, max_rows=1500, **options).fit(X, y, groups=groups),
        GP: WithoutPhysics(body, log, n_inducing=size.m_gp, **options),
    }


def references(n: int, seed: int) -> dict[str, np.ndarray]:
    """Return references that are not in the log."""
    starts, ends = arms.positions(n, seed + 2)
    durations = np.random.RandomState(seed + 3).uniform(1.2, 2.0, n)
    return {
        "waves": arms.waves(n, 6.0, seed),
        "slow waves": arms.waves(n, 6.0, seed + 1, slower=3.0),
        "moves": arms.moves(starts, ends, durations, 2.5),
    }


Numbers = Iterator[tuple[str, str, str, float]]  # measure, model, case, value


def controllers_of(body: RigidBody, models: dict[str, Any], reference: np.ndarray) -> dict[str, ComputedTorque]:
    """Return a controller per model, which knows its torques along the reference in advance."""
    integral = ComputedTorque(body, reference, ki=400.0)
    ahead = {name: arms.missed_by(body, model, reference) for name, model in models.items()}
    learned = {name: ComputedTorque(body, reference, missed) for name, missed in ahead.items()}
    return {NOMINAL: ComputedTorque(body, reference), "integral": integral, **learned}


def tracking_errors(arm: arms.Arm, body: RigidBody, models: dict[str, Any], cases: dict[str, np.ndarray]) -> Numbers:
    """Yield root mean square errors over joints and steps, mrad."""
    for case, reference in cases.items():
        for name, controller in controllers_of(body, models, reference).items():
            error = arms.track(arm, controller, seed=1).error
            yield "error", name, case, 1e3 * float(np.sqrt(np.mean(error**2)))


def step_costs(body: RigidBody, models: dict[str, Any], reference: np.ndarray, calls: int) -> Numbers:
    """Yield microseconds of a step of one arm. Controllers alternate, so that all run under the same load."""
    reference = reference[:, :1]
    asked = {
        name: ComputedTorque(body, reference, partial(arms.missed_by, body, models[name])) for name in (WEIGHTS, BOTH)
    }
    asked[GP] = ComputedTorque(body, reference, models[GP].model.compile().predict)
    for when, controllers in (("ahead", controllers_of(body, models, reference)), ("in the loop", asked)):
        names, taken = list(controllers), {name: [] for name in controllers}
        for call in range(calls):
            step = call % len(reference)
            q, v = reference[step, :, :7] + 1e-3, reference[step, :, 7:14]
            for turn in range(len(names)):
                name = names[(call + turn) % len(names)]
                start = time.perf_counter()
                controllers[name](step, q, v)
                taken[name].append(time.perf_counter() - start)
        for name, seconds in taken.items():
            yield "step", name, when, 1e6 * float(np.median(seconds))
    for name, model in models.items():
        seconds = []
        for _ in range(5):
            start = time.perf_counter()
            arms.missed_by(body, model, reference)
            seconds.append(time.perf_counter() - start)
        yield "batch", name, "per row", 1e6 * float(np.median(seconds)) / len(reference)


def broken_limits(
    arm: arms.Arm, body: RigidBody, model: Any, X: np.ndarray, n_moves: int, share: float, seed: int
) -> Numbers:
    """Yield how many moves break a limit: at any joint and step, and where the plan comes closest to it.

    The latter also of those only in which the joint accelerates there no more than it did in the log, of rows X.
    """
    limits = share * arm.effort
    widths = {"mean": 0.0, "mean + 2 std": 2.0, "Boole": arms.cautious(CHANCE, len(limits), n_steps=400)}
    starts, ends = arms.positions(n_moves, seed)
    planned = {name: arms.fastest(model, starts, ends, limits, k) for name, k in widths.items()}
    decided = np.logical_and.reduce([each for _, each in planned.values()])
    starts, ends = starts[decided], ends[decided]
    for name, k in widths.items():
        yield "moves", BOTH, name, float(len(starts))
        if not len(starts):
            continue
        durations = planned[name][0][decided]
        path = arms.moves(starts, ends, durations, durations.max() + DT)
        run = arms.track(arm, ComputedTorque(body, path, arms.missed_by(body, model, path)), seed=2)
        moving = DT * np.arange(len(path))[:, np.newaxis] < durations
        mean, std = (
            part.reshape(run.torque.shape) for part in model.predict(path.reshape(-1, path.shape[2]), return_std=True)
        )
        over = (np.abs(run.torque) > limits) & moving[:, :, np.newaxis]
        room = np.where(moving[:, :, np.newaxis], limits - np.abs(mean) - k * std, np.inf)
        tightest = np.arange(len(starts)), room.swapaxes(0, 1).reshape(len(starts), -1).argmin(axis=1)
        seen = np.abs(path[:, :, 14:]) <= np.abs(X[:, 14:]).max(axis=0)
        there, seen = (each.swapaxes(0, 1).reshape(len(starts), -1)[tightest] for each in (over, seen))
        yield "broken", BOTH, name, float(over.any(axis=(0, 2)).sum())
        yield "broken where tightest", BOTH, name, float(there.sum())
        yield "moves as logged", BOTH, name, float(seen.sum())
        yield "broken as logged", BOTH, name, float((there & seen).sum())
        yield "duration", BOTH, name, float(durations.mean())
        yield "within 2 std", BOTH, name, float(np.mean(np.abs(run.torque - mean)[moving] < 2.0 * std[moving]))


def run_tracking(cell: Tracking) -> list[dict[str, Any]]:
    """Log, learn, track, and move fast. Return a row for each number."""
    size, seed, body = SIZES[cell.size], 1000 * cell.seed + round(10 * cell.payload), RigidBody(load_robot("iiwa14"))
    with harness.one_thread():
        arm = arms.make_arm(cell.payload, seed)
        log = arms.track(arm, ComputedTorque(body, arms.waves(size.runs, size.seconds, seed + 100)), seed=0)
        rows = arms.log_of(log)
        models, cases = learn(rows, body, size, seed), references(size.references, seed + 200)
        share = 0.35 if cell.payload <= 3.0 else 0.45  # with less the arm can hardly hold them
        found = [
            *tracking_errors(arm, body, models, cases),
            *step_costs(body, models, cases["waves"], size.calls),
            *broken_limits(arm, body, models[BOTH], rows[0], size.moves, share, seed + 300),
        ]
    return [dict(zip(("measure", "model", "case", "value"), one, strict=True)) for one in found]


def tracking_cells(options: Any) -> list[Tracking]:
    if options.quick:
        return [Tracking(2.0, 0, "quick")]
    return [Tracking(payload, seed, "full") for seed in options.seeds for payload in PAYLOADS]


def tracking_tables(rows: pd.DataFrame) -> harness.Tables:
    """Return errors (mrad), errors by load, microseconds of a step, and broken limits."""
    values = rows.set_index(["measure", "case", "payload", "seed", "model"])["value"]
    errors, steps = (values[measure].unstack()[list(CONTROLLERS)] for measure in ("error", "step"))
    ratios = errors.div(errors[NOMINAL], axis=0)
    table = errors.groupby("case").median().T[list(CASES)]
    table["ratio"] = ratios.median().map("{:.3f} (".format)
    table["ratio"] += ratios.min().map("{:.3f} to ".format) + ratios.max().map("{:.3f})".format)
    loads = errors.groupby("payload").median().T.rename(columns="{} kg".format)
    ahead, loop = steps.loc["ahead"], steps.loc["in the loop"]
    ratios = loop.div(ahead[NOMINAL], axis=0).median()
    columns = {
        "step": ahead.median(),
        "ratio": ahead.div(ahead[NOMINAL], axis=0).median().map("{:.2f}".format),
        "batch, per row": values["batch"].groupby("model").median(),
        "in the loop": loop.median(),
        "ratio in the loop": text(ratios, 2),
    }
    costs = pd.DataFrame(columns).loc[list(CONTROLLERS)]
    found = {"errors": table, "errors by load": loads, "steps": costs}
    tables = {name: own.rename(CONTROLLERS).reset_index(names="") for name, own in found.items()}

    promised = {"mean": "50 % where tightest", "mean + 2 std": "2.3 % where tightest"}
    promised["Boole"] = f"{1 - CHANCE:.0%} of moves"
    limits = rows[(rows["model"] == BOTH) & rows["case"].isin(promised)]
    limits = limits.pivot(index=["case", "payload", "seed"], columns="measure", values="value")
    sums = limits.groupby("case").sum().loc[list(promised)]
    means = limits.mul(limits["moves"], axis=0).groupby("case").sum().div(sums["moves"], axis=0)
    n, logged = sums["moves"], sums["moves as logged"]
    columns = {
        "moves": n.map("{:.0f}".format),
        "break a limit": (sums["broken"] / n).map("{:.1%}".format),
        "where tightest": (sums["broken where tightest"] / n).map("{:.1%}".format),
        "there as logged": (sums["broken as logged"] / logged).map("{:.1%} of ".format) + logged.map("{:.0f}".format),
        "promised": pd.Series(promised),
        "duration": means["duration"].map("{:.2f}".format),
        "within 2 std": means["within 2 std"].map("{:.3f}".format),
    }
    tables["limits"] = pd.DataFrame(columns).loc[list(promised)].reset_index(names="planned with")
    return tables


PARTS: dict[str, tuple[Any, ...]] = {  # cells, run, tables, title
    "rollouts": (rollout_cells, run_rollouts, rollout_tables, "Predictions of many steps"),
    "swing_up": (swing_up_cells, run_swing_up, swing_up_tables, "Seconds of data that a swing-up needs"),
    "tracking": (tracking_cells, run_tracking, tracking_tables, "An arm with an unknown load"),
}


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="one system, little data, one seed", seeds=2)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--systems", nargs="+", choices=ROLLOUT_SYSTEMS, help="default: all, of rollouts the first 3")
    models = [*ROLLOUT_MODELS, *SWING_UPS]
    parser.add_argument("--models", nargs="+", choices=models, help="default: all")
    parser.add_argument("--noises", nargs="+", type=float, choices=NOISES, help="of swing-ups; default: both")
    options = harness.parse(parser)
    cells, run, tables_of, title = PARTS[options.part]
    output = harness.output_path(options, options.part)
    jobs = 1 if options.part == "tracking" else options.jobs  # it measures wall time
    n_failures = harness.run_missing(cells(options), run, output, jobs)
    harness.write_page(title, tables_of(harness.frame(output, size=options.size)), output, n_failures)


if __name__ == "__main__":
    main()
