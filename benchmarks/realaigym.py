"""Acrobot and pendubot of RealAIGym: robustness of controllers that learn from seconds of data.

    python benchmarks/realaigym.py                                  # hours of one core
    python benchmarks/realaigym.py --models IFG --seeds 1           # five minutes
    python benchmarks/realaigym.py --robots acrobot --models URDF
    python benchmarks/realaigym.py --quick                          # the pendubot, 20 s of data: a quarter of a minute

The simulated double pendulum has one motor, at the elbow (acrobot) or at the shoulder (pendubot). It hangs at rest.
After 10 s it must be upright: each angle within 0.35 rad and each velocity within 1 rad/s. Robot, disturbances and
score are those of the leaderboards of RealAIGym (V2, simulation; dfki-ric-underactuated-lab/double_pendulum).

A run of the benchmark learns as in examples/double_pendulum.py. The first 10 s of data are random torques. Each
following stage is recorded with the controller that was learned from all earlier data. The controller has plans by
iLQR, time-varying LQR along the plans and LQR at the goal (examples/follow_plans.py). It gets the learned model and
measured states, and no equations of the true robot. The models are:

- IFG: EVGP with `InertiaForceGravity`. Masses, centres of mass and inertias are unknown.
- GP: a Gaussian process for the change of the state, without physics.
- URDF: EVGP with `NominalDynamics` of a robot whose masses, centres of mass and inertias are 20 % off, with random
  signs.
- parameters: the same, with learned factors on masses, inertias and the length of the second link.
- truth: the true robot as the model, a reference for the controller.
- TVLQR: feedback with the weights of the leaderboard's controller of this name, along one of our plans on the true
  robot. It checks the simulator.

Columns of the CSV: ``seconds`` of data, 0 for the true model; six shares, whose mean is ``score``; ``swings_up``, the
success without disturbances; ``both``, the share of pulses on both joints, which is not in the score; ``step_ms``,
processor time of a control step of 2 ms; ``fit_seconds``, processor time of the last fit.

A share is that of successful runs with a changed model (210 runs), torque response, delay (21 runs each) and pulses of
torque (50 runs). With noise on velocities and torques, it is the share of 21 noise levels at which more than half of
10 runs succeed. Pulses are drawn for both joints, but in the leaderboard's simulation they act on the joint with the
motor only. The torque on the other joint is multiplied by 0 there.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))  # for the robot and the controllers

import numpy as np
import pandas as pd
from sklearn.utils import Bunch

import harness
from double_pendulum import (
    DRIVEN,
    GOAL,
    N_STEPS,
    STAGES,
    STEP,
    TASK,
    Controller,
    Disturbances,
    Plants,
    Truth,
    controller_of,
    is_upright,
    plan_swing_ups,
    simulate_plants,
    study,
)
from follow_plans import Follower, Library

ROBOTS = tuple(DRIVEN)
MODELS = {
    "IFG": "EVGP-IFG, masses unknown",
    "parameters": "EVGP, URDF 20 % off, parameters learned",
    "URDF": "EVGP, URDF 20 % off",
    "GP": "GP without physics",
    "truth": "the true model",
    "TVLQR": "TVLQR on the true model",
}
TRUE = "truth", "TVLQR"
# Physics leaves less to the kernel.
N_INDUCING = {"IFG": 250, "GP": 250, "URDF": 100, "parameters": 100}
# Shares and score of the leaderboards.
PUBLISHED = {
    ("acrobot", "MC-PILCO"): (0.090, 0.095, 0.190, 0.524, 0.048, 0.50, 0.241),
    ("acrobot", "iLQR MPC, true model"): (0.067, 0.095, 0.905, 0.524, 0.048, 0.42, 0.343),
    ("acrobot", "TVLQR, true model"): (0.481, 0.190, 1.0, 0.952, 0.238, 0.78, 0.607),
    ("acrobot", "History SAC, the best"): (0.581, 0.238, 1.0, 1.0, 0.905, 0.78, 0.751),
    ("pendubot", "MC-PILCO"): (0.248, 0.762, 0.619, 0.952, 0.286, 0.82, 0.614),
    ("pendubot", "iLQR MPC, true model"): (0.319, 0.905, 1.0, 1.0, 0.381, 0.44, 0.674),
    ("pendubot", "TVLQR, true model"): (0.629, 0.905, 1.0, 1.0, 0.429, 0.64, 0.767),
    ("pendubot", "AR-EAPO, the best"): (0.876, 0.810, 1.0, 1.0, 0.810, 0.98, 0.913),
}
SECONDS = 20.0, 60.0, 180.0
SHARES = ("model", "velocity noise", "torque noise", "torque response", "delay", "pulses")
LEVELS, REPETITIONS, PULSES = 21, 10, 50

# One controller, learned from so many seconds of data. The true model has none.
Cell = namedtuple("Cell", "robot kind seed seconds size")


# --- disturbances ----------------------------------------------------------------------------------------------------


def pulses(rng: np.random.RandomState) -> np.ndarray:
    """Return torques (2, N_STEPS) of three pulses for each joint, at least 1 s apart."""
    t, n = STEP * np.arange(N_STEPS), 6
    duration = STEP * N_STEPS
    centers = np.cumsum(1.0 + rng.uniform(size=n) * (duration - n - 1.0) / n)
    centers = rng.permutation(centers).reshape(2, 3, 1)
    widths = rng.uniform(0.05, 0.1, (2, 3, 1))
    heights = rng.choice([-1.0, 1.0], (2, 3, 1)) * rng.uniform(0.5, 5.0, (2, 3, 1))
    return (heights * np.exp(-0.5 * ((t - centers) / widths) ** 2)).sum(axis=1)


def trials(robot: str, size: str = "full") -> Bunch:
    """Return all runs: the name of a ``share``, its ``level``, and the ``plants`` and ``disturbances`` of the runs."""
    rng, usual = np.random.RandomState(0), Plants(robot)
    quick = size == "quick"
    n_levels, n_repetitions, n_pulses = (3, 1, 3) if quick else (LEVELS, REPETITIONS, PULSES)
    factors = np.linspace(0.75, 1.25, n_levels)
    changes = {
        "rotor": np.linspace(0.0, 1e-4, n_levels),
        **{name: factors * getattr(usual, name) for name in ("r1", "I1", "r2", "m2", "I2")},
        **{name: np.linspace(-0.1, 0.1, n_levels) for name in ("b1", "b2")},
        **{name: np.linspace(-0.2, 0.2, n_levels) for name in ("cf1", "cf2")},
    }
    one, every = np.ones(n_levels), np.repeat(np.arange(n_levels), n_repetitions)
    # Share, level and what differs from the usual run.
    runs: list[tuple[str, float, dict[str, Any]]] = [("swings_up", 0.0, {})]
    for name, values in changes.items():
        runs += [("model", value, {name: value}) for value in values]
    for share, name, largest in (("velocity noise", "velocity_noise", 0.5), ("torque noise", "torque_noise", 1.1)):
        runs += [(share, level, {name: largest * level / (n_levels - 1)}) for level in every]
    runs += [("torque response", value, {"response": value}) for value in np.linspace(0.1, 2.0, len(one))]
    runs += [("delay", value, {"delay": int(value / STEP + 1e-9)}) for value in np.linspace(0.0, 0.04, len(one))]
    for share in ("pulses", "both"):
        for _ in range(n_pulses):
            torques = pulses(rng)
            if share == "pulses":
                torques[1 - DRIVEN[robot]] = 0.0
            runs.append((share, 0.0, {"pulses": torques}))
    usual_values = {**{name: getattr(usual, name) for name in changes}, **vars(Disturbances())}
    usual_values["pulses"] = np.zeros((2, N_STEPS))
    found = {name: np.array([own.get(name, value) for _, _, own in runs]) for name, value in usual_values.items()}
    found["pulses"] = np.moveaxis(found["pulses"], 0, -1)
    return Bunch(
        share=np.array([share for share, _, _ in runs]),
        level=np.array([level for _, level, _ in runs]),
        plants=replace(usual, **{name: found[name] for name in changes}),
        disturbances=Disturbances(**{name: found[name] for name in vars(Disturbances())}),
    )


def scores(own: Bunch, controller: Controller) -> dict[str, Any]:
    """Run all trials with a controller of so many plants."""
    n = len(own.share)
    states, _ = simulate_plants(own.plants, controller, np.zeros((n, 4)), own.disturbances)
    success = is_upright(states[-1])
    found: dict[str, Any] = {"swings_up": bool(success[own.share == "swings_up"].all())}
    for share in (*SHARES, "both"):
        some = own.share == share
        by_level = pd.Series(success[some]).groupby(own.level[some]).mean()
        found[share] = (by_level > 0.5).mean() if "noise" in share else success[some].mean()
    return {**found, "score": np.mean([found[share] for share in SHARES])}


# --- controllers -----------------------------------------------------------------------------------------------------


class LeaderboardTVLQR:
    """TVLQR along the first plan without a filter, and from close to the goal on LQR, as on the leaderboard."""

    close = np.array([0.05, 0.05, 0.1, 0.1])

    def __init__(self, library: Library, n: int):
        self.library, self.at_goal = library, np.zeros(n, dtype=bool)

    def __call__(self, count: int, measured: np.ndarray) -> np.ndarray:
        own, away = self.library, TASK.difference(measured, GOAL)
        node, share = divmod(count * STEP / TASK.dt + 1e-9, 1.0)
        if node < own.horizon:
            planned = own.Z[int(node)] + share * (own.ahead - own.Z)[int(node)]
            u = own.U[int(node)] + TASK.difference(measured, planned) @ own.gain[int(node)]
        else:
            u = away @ own.gain[own.horizon - 1]
        self.at_goal |= np.all(np.abs(away) < self.close, axis=1)
        return np.where(self.at_goal, away @ own.top_gain, u)


def step_ms(library: Library, n_calls: int = 1000) -> float:
    """Return the processor time of a control step of one plant, ms."""
    follower, start = Follower(library, 1, STEP), time.process_time()
    for count in range(n_calls):
        follower(count, library.Z[:1])
    return 1e3 * (time.process_time() - start) / n_calls


def controller(cell: Cell) -> tuple[Library, float]:
    """Return plans with feedback, and processor seconds of the last fit."""
    if cell.kind in TRUE:
        model = Truth(Plants(cell.robot))
        return controller_of(model, plan_swing_ups(model, np.random.RandomState(cell.seed))), 0.0
    stages = [seconds for seconds in STAGES if seconds <= cell.seconds]
    n_inducing = 40 if cell.size == "quick" else N_INDUCING[cell.kind]
    *_, last = study(cell.robot, cell.kind, cell.seed, stages, n_inducing)
    return last.library, last.fit_seconds


def run(cell: Cell) -> dict[str, Any]:
    """Learn, and run all trials."""
    own = trials(cell.robot, cell.size)
    n = len(own.share)
    with harness.one_thread():
        library, fit_seconds = controller(cell)
        follower = LeaderboardTVLQR(library, n) if cell.kind == "TVLQR" else Follower(library, n, STEP)
        found = scores(own, follower)
        return {**found, "step_ms": step_ms(library), "fit_seconds": fit_seconds}


def tables(rows: pd.DataFrame) -> harness.Tables:
    """Return means over seeds."""
    lines = []
    for robot, model in itertools.product(ROBOTS, MODELS):
        some = rows[(rows["robot"] == robot) & (rows["kind"] == model)]
        for seconds, own in some.groupby("seconds"):
            lines.append(
                {
                    "": f"{robot}, {MODELS[model]}",
                    "data, s": f"{seconds:.0f}" if seconds else "",
                    "seeds": len(own),
                    "score": f"{own['score'].mean():.3f}",
                    "lowest": f"{own['score'].min():.3f}",
                    "swings up": f"{own['swings_up'].sum()} of {len(own)}",
                    **{share: f"{own[share].mean():.2f}" for share in SHARES},
                    "both joints": f"{own['both'].mean():.2f}",
                    "control step, ms": f"{own['step_ms'].mean():.2f}",
                    "fit, s": f"{own['fit_seconds'].mean():.1f}" if seconds else "",
                }
            )
    published = [
        {"": f"{robot}, {name}", "score": f"{score:.3f}"}
        | {share: f"{value:.2f}" for share, value in zip(SHARES, shares, strict=True)}
        for (robot, name), (*shares, score) in PUBLISHED.items()
    ]
    return {"scores": pd.DataFrame(lines), "published": pd.DataFrame(published)}


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="the pendubot, 20 s of data, few trials", seeds=5)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS), help="default: both")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    parser.add_argument("--seconds", nargs="+", type=float, choices=SECONDS, default=SECONDS, help="default: all")
    options = harness.parse(parser)
    robots, models, durations = options.robots, options.models, options.seconds
    if options.quick:
        robots, models, durations = ["pendubot"], ["IFG", "truth"], SECONDS[:1]
    # Seed by seed, so that the page is complete after each seed.
    cells = [
        Cell(robot, kind, seed, seconds, options.size)
        for seed, kind, robot in itertools.product(options.seeds, models, robots)
        for seconds in ([0.0] if kind in TRUE else durations)
    ]
    output = harness.output_path(options, "realaigym")
    n_failures = harness.run_missing(cells, run, output, options.jobs)
    harness.write_page("Robustness on RealAIGym", tables(harness.frame(output, size=options.size)), output, n_failures)


if __name__ == "__main__":
    main()
