"""Gain from physics: models with and without it, all with the defaults of the library.

    python benchmarks/physics.py errors                       # hours of one core, most of them for iiwa14
    python benchmarks/physics.py errors --systems pendulum cartpole
    python benchmarks/physics.py wrong                        # half an hour of one core
    python benchmarks/physics.py rollouts                     # ten minutes of one core
    python benchmarks/physics.py curves                       # half an hour of one core
    python benchmarks/physics.py errors --quick

All models of a cell learn from the same rows, with `EVGPRegressor`'s defaults: 100 inducing points for each. VGP is the
model without features, RES-VGP learns the change of state, EVGP-IF and EVGP-IFG have the features `InertiaForce` and
`InertiaForceGravity`. Noise is a share of each target's standard deviation. Errors are means over test rows of the norm
of the error of the noise-free target. Coverage and the NLPD are those of noisy targets.

*errors* has the systems of the paper, with 4 trajectories and with the paper's number. It also has robots that the
features' default prior was not made for (a double pendulum, a UR5 and a Panda), with 4 and 40.

*curves* has the same errors of the smaller systems, with 2 to 16 trajectories.

*wrong* compares wrong features to the same model without features. "another robot" has the features of the acrobot for
the cartpole, and the reverse. "gravity upwards" has a guess of gravity with the wrong sign. "noise" adds five features
that are noise to the model of the change of state.

*rollouts* has errors of positions after 100 steps of the mean, fed back, from 40 new states. They are relative to the
standard deviation of the states, and the value is the median over rollouts.
"""

from __future__ import annotations

import itertools
from collections import namedtuple
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from sklearn.base import RegressorMixin
from sklearn.preprocessing import FunctionTransformer

import harness
from skevgp import EVGPRegressor, ResidualRegressor, rollout
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForce, InertiaForceGravity
from skevgp.metrics import containing_ratios, negative_log_predictive_density, prediction_error

SYSTEMS = ("pendulum", "cartpole", "cartpole_damped", "acrobot", "iiwa14")
UNSEEN = ("double_pendulum", "ur5", "panda")
MODELS = ("VGP", "RES-VGP", "EVGP-IF", "EVGP-IFG")
NOISES = (0.01, 0.0)
CURVE = (2, 4, 8, 16)
FEW, MANY = 4, {**dict.fromkeys(SYSTEMS, 0), **dict.fromkeys(UNSEEN, 40)}  # 0: the paper's number
TEST_TRAJECTORIES, STEPS = 40, 100
WRONG = ("another robot", "gravity upwards", "noise")
# A guess of the deceleration by gravity, rad/s² per sine of the angle. For the pendulum it is +19.6.
UPWARDS = -20.0
OTHER = {"acrobot": "cartpole", "cartpole": "acrobot"}

Errors = namedtuple("Errors", "system noise trajectories seed")
Wrong = namedtuple("Wrong", "map system noise trajectories seed")
Rollouts = namedtuple("Rollouts", "system noise trajectories seed")


def shortened(model: RegressorMixin, quick: bool) -> RegressorMixin:
    """Return the model, which has few iterations if it is quick."""
    few = {name: 3 for name in model.get_params() if name.endswith("max_iter")}
    return model.set_params(**few) if quick else model


def build(model: str, system: str, seed: int) -> RegressorMixin:
    """Return a model with the defaults of the library."""
    if model == "RES-VGP":
        return ResidualRegressor(EVGPRegressor(random_state=seed))
    features = {"VGP": None, "EVGP-IF": InertiaForce(system), "EVGP-IFG": InertiaForceGravity(system)}[model]
    return EVGPRegressor(features, random_state=seed)


def scores(model: RegressorMixin, cell: Any, quick: bool = False) -> dict[str, Any]:
    """Fit a model and return its scores on other trajectories."""
    train = make_dynamics(cell.system, cell.trajectories or None, noise=cell.noise, random_state=cell.seed)
    test = make_dynamics(cell.system, TEST_TRAJECTORIES, random_state=1000 + cell.seed)
    model = shortened(model, quick)
    seconds, _ = harness.timed(lambda: model.fit(train.data, train.target, groups=train.groups))
    mean, std = model.predict(test.data, return_std=True)
    size = cell.noise * train.trajectories[:, 1:].reshape(train.target.shape).std(axis=0)
    noisy = test.target + size * np.random.RandomState(2000 + cell.seed).standard_normal(mean.shape)
    ratios = containing_ratios(noisy, mean, std)
    fitted = getattr(model, "regressor_", model)
    return {
        "error": prediction_error(test.target, mean),
        "error_median": float(np.median(np.linalg.norm(test.target - mean, axis=1))),
        **{f"cr{k}": float(ratio) for k, ratio in enumerate(ratios, start=1)},
        "nlpd": negative_log_predictive_density(noisy, mean, std),
        "rows": len(train.data),
        "n_iter": fitted.n_iter_,
        "seconds": round(seconds, 2),
    }


def run_errors(cell: Errors, quick: bool = False) -> list[dict[str, Any]]:
    return [{"model": name, **scores(build(name, cell.system, cell.seed), cell, quick)} for name in MODELS]


def waves(X: np.ndarray) -> np.ndarray:
    """Return five features that are as good as noise."""
    return np.sin(1e4 * X @ np.arange(1.0, 1.0 + 5 * X.shape[1]).reshape(5, -1).T)


def run_wrong(cell: Wrong, quick: bool = False) -> list[dict[str, Any]]:
    """Return scores of a model with wrong features, and of one without."""
    features = {
        "another robot": InertiaForceGravity(OTHER.get(cell.system, cell.system)),
        "gravity upwards": InertiaForceGravity(cell.system, gravity_gain=UPWARDS),
        "noise": FunctionTransformer(waves),
    }[cell.map]
    models = {
        name: EVGPRegressor(chosen, random_state=cell.seed) for name, chosen in (("with", features), ("without", None))
    }
    if cell.map == "noise":
        models = {name: ResidualRegressor(model) for name, model in models.items()}
    return [{"features": name, **scores(model, cell, quick)} for name, model in models.items()]


def run_rollouts(cell: Rollouts, quick: bool = False) -> list[dict[str, Any]]:
    """Return how far the models' rollouts are from the truth after 100 steps."""
    train = make_dynamics(
        cell.system, cell.trajectories or None, noise=cell.noise, input_noise=cell.noise, random_state=cell.seed
    )
    test = make_dynamics(cell.system, TEST_TRAJECTORIES, STEPS, random_state=1000 + cell.seed)
    n_states = train.target.shape[1]
    scatter = train.trajectories.reshape(-1, n_states).std(axis=0)
    inputs = test.data[:, n_states:].reshape(TEST_TRAJECTORIES, STEPS, -1)
    rows = []
    for name in MODELS:
        model = shortened(build(name, cell.system, cell.seed), quick)
        harness.timed(lambda model=model: model.fit(train.data, train.target, groups=train.groups))
        try:
            with harness.one_thread():
                ahead = rollout(model, test.trajectories[:, 0], inputs, method="mean").mean
        except ValueError as problem:
            if "unstable" not in str(problem):
                raise
            ahead = np.full(test.trajectories[:, 1:].shape, np.inf)
        found = ((ahead[:, -1] - test.trajectories[:, -1]) / scatter)[:, : n_states // 2]
        errors = np.sqrt(np.mean(found**2, axis=1))
        rows.append({"model": name, "error": float(np.median(errors)), "error_p90": float(np.quantile(errors, 0.9))})
    return rows


def tables_of_errors(rows: pd.DataFrame) -> harness.Tables:
    """Return mean errors and coverage of each set, and how often and by how much physics wins."""
    rows = rows.assign(
        set=[f"{own.system}, {own.trajectories or 'all'}, {100 * own.noise:g} %" for own in rows.itertuples()]
    )
    order = dict.fromkeys(rows.sort_values(["trajectories", "noise"])["set"])
    wide = rows.pivot_table(index="set", columns="model", values=["error", "cr2", "seconds"], sort=False).loc[
        list(order)
    ]
    error, ratio = wide["error"], wide["error"]["EVGP-IFG"] / wide["error"]["RES-VGP"]
    systems = np.array([name.split(",")[0] in SYSTEMS for name in wide.index])
    lines = []
    for which, chosen in (("the paper's systems", systems), ("robots not seen before", ~systems)):
        if chosen.any():
            own = error[chosen]
            lines.append(
                {
                    "": which,
                    "sets": len(own),
                    "EVGP-IFG at most RES-VGP": f"{int((ratio[chosen] <= 1.0).sum())} of {len(own)}",
                    "geometric mean of the ratio": float(np.exp(np.log(ratio[chosen]).mean())),
                    "the lowest Error has IF or IFG": f"{int(own.idxmin(axis=1).isin(MODELS[2:]).sum())} of {len(own)}",
                    "EVGP-IFG at most VGP": f"{int((own['EVGP-IFG'] <= own['VGP']).sum())} of {len(own)}",
                    "least CR-2": f"{wide['cr2']['EVGP-IFG'][chosen].min():.3f}",
                    "greatest CR-2": f"{wide['cr2']['EVGP-IFG'][chosen].max():.3f}",
                    "least number of seeds": int(
                        rows[rows["set"].isin(own.index)].groupby(["set", "model"]).size().min()
                    ),
                }
            )
    of_error = error[list(MODELS)].apply(harness.best, axis=1)
    of_error["EVGP-IFG / RES-VGP"] = ratio
    of_error["CR-2 of EVGP-IFG"] = wide["cr2"]["EVGP-IFG"]
    of_error["CR-2 of RES-VGP"] = wide["cr2"]["RES-VGP"]
    of_error["× seconds"] = wide["seconds"]["EVGP-IFG"] / wide["seconds"]["RES-VGP"]
    return {"does physics win": pd.DataFrame(lines), "error": of_error.reset_index()}


def tables_of_wrong(rows: pd.DataFrame) -> harness.Tables:
    keys = ["map", "system", "noise", "trajectories"]
    wide = rows.pivot_table(index=keys, columns="features", values=["error", "nlpd", "cr2"], sort=False)
    out = pd.DataFrame(
        {
            "error with": wide["error"]["with"],
            "without": wide["error"]["without"],
            "ratio": wide["error"]["with"] / wide["error"]["without"],
            "NLPD with": wide["nlpd"]["with"],
            "NLPD without": wide["nlpd"]["without"],
            "CR-2 with": wide["cr2"]["with"],
        }
    )
    return {"wrong features": out.reset_index()}


def tables_of_rollouts(rows: pd.DataFrame) -> harness.Tables:
    keys = ["system", "noise", "trajectories"]
    rows = rows.assign(trajectories=rows["trajectories"].replace(0, "all"))
    wide = rows.pivot_table(index=keys, columns="model", values="error", sort=False, aggfunc="median")
    return {"rollouts": wide[list(MODELS)].reset_index()}


def tables_of_curves(rows: pd.DataFrame) -> harness.Tables:
    keys = ["system", "noise", "trajectories"]
    wide = rows.pivot_table(index=keys, columns="model", values="error", sort=False)[list(MODELS)]
    return {"curves": wide.apply(harness.best, axis=1).reset_index()}


def plot_curves(rows: pd.DataFrame, path: Path) -> None:
    """Draw Error over the number of trajectories: a panel for each system, lines with noise, dots without."""
    systems = harness.ordered(SYSTEMS, rows["system"])
    figure, panels = harness.pyplot().subplots(
        2, 2, figsize=(harness.WIDTH, 5.6), sharex=True, squeeze=False, layout="constrained"
    )
    for axes, system in zip(panels.flat, systems, strict=False):
        for color, model in zip(harness.PALETTE, MODELS, strict=False):
            for noise, style in zip(NOISES, ("-o", ":o"), strict=True):
                own = rows[(rows["system"] == system) & (rows["model"] == model) & (rows["noise"] == noise)]
                mean = own.groupby("trajectories")["error"].mean()
                label = f"{model}, noise {100 * noise:g} %"
                axes.plot(mean.index, mean, style, color=color, markersize=3, label=label)
        harness.logarithmic(axes)
        axes.set_xscale("log", base=2)
        axes.set(title=system, xticks=CURVE, xticklabels=CURVE)
    for axes in panels[-1]:
        axes.set_xlabel("trajectories")
    for axes in panels[:, 0]:
        axes.set_ylabel("Error, SI units")
    harness.legend(figure, ncols=4)
    harness.save_picture(figure, path)


def cells_of(part: str, options: Any) -> list[Any]:
    if part == "curves":
        systems, sizes = (SYSTEMS[:1], CURVE[:2]) if options.quick else (options.systems or SYSTEMS[:-1], CURVE)
        return [Errors(*cell) for cell in itertools.product(systems, NOISES, sizes, options.seeds)]
    systems = options.systems or ({"errors": (*SYSTEMS, *UNSEEN)}.get(part) or ("pendulum", "cartpole", "acrobot"))
    if options.quick:
        systems = systems[:1]
    sizes = [FEW] if options.quick or part == "wrong" else [FEW, None]
    cells = [
        (system, noise, MANY[system] if n is None else n, seed)
        for n, noise, seed, system in itertools.product(sizes, NOISES, options.seeds, systems)
    ]
    if part == "errors":
        return [Errors(*cell) for cell in sorted(cells, key=lambda cell: cell[0] == "iiwa14" and cell[2] != FEW)]
    if part == "rollouts":
        return [Rollouts(*cell) for cell in cells if cell[0] != "acrobot"]
    return [Wrong(name, *cell) for name in WRONG for cell in cells if name != "another robot" or cell[0] in OTHER]


JOBS = {"errors": run_errors, "curves": run_errors, "wrong": run_wrong, "rollouts": run_rollouts}
TABLES = {
    "errors": tables_of_errors,
    "curves": tables_of_curves,
    "wrong": tables_of_wrong,
    "rollouts": tables_of_rollouts,
}
FILES = {"errors": "physics", "curves": "physics_curves", "wrong": "physics_wrong", "rollouts": "physics_rollouts"}
TITLES = {
    "errors": "Gain from physics in the model",
    "curves": "Gain from physics as data grow",
    "wrong": "Wrong features",
    "rollouts": "Rollouts with equal numbers of inducing points",
}


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="one system, few iterations", seeds=4)
    parser.add_argument("part", choices=list(JOBS))
    parser.add_argument("--systems", nargs="+", choices=[*SYSTEMS, *UNSEEN], help="default: all")
    options = harness.parse(parser)
    output = harness.output_path(options, FILES[options.part])
    job = partial(JOBS[options.part], quick=options.quick)
    n_failures = harness.run_missing(cells_of(options.part, options), job, output, options.jobs)
    if options.part == "curves":
        plot_curves(harness.frame(output), output.with_suffix(".png"))
    harness.write_page(TITLES[options.part], TABLES[options.part](harness.frame(output)), output, n_failures)


if __name__ == "__main__":
    main()
