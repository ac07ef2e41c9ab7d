"""How much data a swing-up needs: successes of a controller that plans on a learned model, over seconds of data.

A pole is swung up from rest by the planner of examples/mpc.py: iLQR on the model, anew at each step of 0.03 s, with
100 N on the cartpole's cart and 2 N m, less than half of what would hold it level, on the pendulum. Success is to be
within 0.1 rad of upright for the last of five seconds. The model is EVGP-IFG, or without physics a Gaussian process of
the change of state, both with sines and cosines for the kernel, learned from short trajectories from random states with
random inputs: the fewer and longer they are, the less of the circle they see. "Firm" is EVGP-IFG whose weights of
states in states, that positions move with velocities and both last, may leave their prior means by a hundredth of what
is its default: rough physics, but exact kinematics. Noise is on the states to learn from,
before and after a step, and on those that the planner sees, as a share of the states' scatter in the data. "The truth"
is the same planner on the simulated system itself.

Writes a row per run to a CSV as soon as it is done, and a table beside it.

    python benchmarks/swing_up.py                         # hours of one core
    python benchmarks/swing_up.py --systems pendulum --seconds 1.5 3 --noises 0
    python benchmarks/swing_up.py --quick                 # the pendulum, one seed: half a minute
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))  # for the controller
sys.path.insert(0, str(Path(__file__).parent))  # for what the scripts share

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits

import harness
import mpc
from harness import Row
from skevgp import CoefPrior
from skevgp.datasets.plant import Plant
from skevgp.exceptions import DependentRowsWarning
from skevgp.features import InertiaForceGravity

SECONDS = (1.5, 3.0, 4.5, 9.0, 30.0)
NOISES = (0.0, 0.01)
LENGTHS = (10, 25)
SYSTEMS = ("cartpole", "pendulum")
TRUTHS = 3  # seeds; without data they differ in the first plans only
NAMES = {"evgp-ifg": "EVGP-IFG", "firm": "EVGP-IFG, firm", "gp": "without physics", "truth": "the truth"}


@dataclass(frozen=True)
class Cell:
    """A run.

    Attributes
    ----------
    system : str
    model : {"evgp-ifg", "firm", "gp", "truth"}
    seconds : float
        Of data; 0 of the truth.
    noise : float
        A share of the states' scatter; the truth has none.
    length : int
        Steps of a trajectory to learn from; 0 of the truth.
    seed : int
    size : {"full", "quick"}
    """

    system: str
    model: str
    seconds: float
    noise: float
    length: int
    seed: int
    size: str


class Truth:
    """The simulated system as a model of itself: four steps of Runge and Kutta's method, and differences.

    Parameters
    ----------
    system : str
    """

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


def firm(system: str) -> dict[str, np.ndarray]:
    """A prior of EVGP-IFG's weights, for `EVGPRegressor`, that hardly doubts the kinematics."""
    n_joints = Plant(system).layout.n_joints
    features = InertiaForceGravity(system, dt=mpc.DT).fit(np.zeros((1, 2 * n_joints + 1)))
    mean, scale = features.coef_prior(2 * n_joints)
    scale = np.array(scale)
    scale[:, : 2 * n_joints] *= 0.01
    return {"coef_prior": CoefPrior(mean=mean, scale=scale)}


def run(cell: Cell) -> dict[str, Any]:
    """Learn, and swing up; seconds of processor time of one thread."""
    task = mpc.TASKS[cell.system]
    with threadpool_limits(1), warnings.catch_warnings():
        for expected in (ConvergenceWarning, DependentRowsWarning):
            warnings.simplefilter("ignore", expected)
        start = time.process_time()
        if cell.model == "truth":
            model, noise = Truth(cell.system), 0.0
        else:
            prior = firm(cell.system) if cell.model == "firm" else {}
            data = (cell.seconds, cell.model != "gp", cell.noise, cell.seed, cell.length)
            learned = mpc.learn(cell.system, *data, **prior)
            model, noise = learned.model.compile(include_noise=False), learned.noise
        middle = time.process_time()
        found = mpc.swing_up(model, task, noise, cell.seed)
        end = time.process_time()
    away = np.flatnonzero(found.distance >= mpc.NEAR)
    return {
        **{name: getattr(cell, name) for name in Cell.__dataclass_fields__},
        "success": found.success,
        "last_distance": found.distance[-mpc.LAST :].max(),
        "upright_from": mpc.DT * (away[-1] + 1),
        "fit_seconds": middle - start,
        "control_seconds": end - middle,
        **harness.provenance(),
    }


def say(row: dict[str, Any]) -> str:
    return f"{'upright' if row['success'] else 'lost'}, {row['last_distance']:.2f} rad"


def lines(rows: Sequence[Row]) -> list[list[str]]:
    """Of a table: successes of so many seeds, for each number of seconds."""
    kinds = ("system", "model", "noise", "length")
    keys = sorted({tuple(row[name] for name in kinds) for row in rows})
    seconds = sorted({row["seconds"] for row in rows if row["model"] != "truth"}, key=float)
    found = []
    for key in keys:
        system, model, noise, length = key
        own = [row for row in rows if tuple(row[name] for name in kinds) == key]
        counts = []
        for n_seconds in ["0.0"] * len(seconds) if model == "truth" else seconds:
            some = [row["success"] == "True" for row in own if row["seconds"] == n_seconds]
            counts.append(f"{sum(some)} of {len(some)}" if some else "")
        upright = [float(row["upright_from"]) for row in own if row["success"] == "True"]
        found.append(
            [
                f"{system}, {NAMES[model]}",
                f"{float(noise):.0%}",
                length if model != "truth" else "",
                *counts,
                f"{np.median(upright):.2f}" if upright else "",
                f"{np.median(harness.column(own, 'control_seconds')):.1f}",
            ]
        )
    return found


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page: nothing if there are no rows."""
    if not rows:
        return []
    seconds = sorted({row["seconds"] for row in rows if row["model"] != "truth"}, key=float)
    header = ["", "noise", "steps", *(f"{length} s" for length in seconds), "upright from, s", "processor, s"]
    return [
        "# Seconds of data that a swing-up needs",
        "Runs that end upright (within 0.1 rad for the last of five seconds), of so many seeds, over seconds of data. "
        "The controller plans by iLQR on the model, anew at each step of 0.03 s; the truth is the simulated system in "
        "the model's place, and has no data. Firm is a prior that hardly doubts the kinematics. Steps are those of a "
        "trajectory to learn from: the fewer, the more starts. Medians: since when the pole was upright, of the runs "
        "that succeed; what the control of a run costs.",
        harness.table(header, lines(rows)),
        harness.provenance_text(rows),
    ]


def cells_of(options: Any) -> list[Cell]:
    """Seed by seed, so that a page of some seeds is whole."""
    if options.quick:
        return [Cell("pendulum", model, 3.0, 0.0, mpc.LENGTH, 0, "quick") for model in ("evgp-ifg", "gp")]
    found = []
    for seed in range(options.seeds or 10):
        for system in options.systems:
            if seed < TRUTHS and "truth" in options.models:
                found.append(Cell(system, "truth", 0.0, 0.0, 0, seed, "full"))
            found += [
                Cell(system, model, seconds, noise, length, seed, "full")
                for length in options.lengths
                for noise in options.noises
                for seconds in options.seconds
                for model in options.models
                if model != "truth"
            ]
    return found


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="the pendulum, three seconds of data and one seed",
        seeds="seeds 0, 1, ...; default: 10, of a quick run 1",
        systems=SYSTEMS,
    )
    parser.add_argument("--seconds", nargs="+", type=float, default=SECONDS, help="of data; default: %(default)s")
    parser.add_argument("--noises", nargs="+", type=float, default=NOISES, help="on states; default: %(default)s")
    parser.add_argument("--lengths", nargs="+", type=int, default=LENGTHS, help="of trajectories; default: %(default)s")
    parser.add_argument("--models", nargs="+", choices=NAMES, default=list(NAMES), help="default: all")
    options = parser.parse_args()
    output, size = harness.output_path(options, "swing_up"), "quick" if options.quick else "full"
    n_failures = harness.run_missing(cells_of(options), run, output, options.jobs, say, since=options.since)
    harness.write_report(paragraphs([row for row in harness.read(output) if row["size"] == size]), output, n_failures)


if __name__ == "__main__":
    main()
