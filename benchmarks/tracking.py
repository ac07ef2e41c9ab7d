"""An arm with an unknown load: how well it tracks with learned torques, what a step costs, and whether limits hold.

The arm is the iiwa14 of examples/computed_torque.py: a load in the hand and friction that its model does not know, and
masses that are 5 % off. All learn from one log of a minute at 50 Hz, recorded while the arm tracked waves badly. They
are compared on references that were not in it: other waves, slow ones, where joints turn back often, and quick moves.
Torques are predicted in one batch ahead, as the reference is known; what a row costs within the loop is measured, too.

Moves are then made as fast as limits of torque allow, where the mean, or the mean and k std must stay within 35 % of
what motors can give (45 % with more than 3 kg); how many break a limit is counted.

Writes a row per number to a CSV, arm by arm, and tables beside it.

    python benchmarks/tracking.py                  # a quarter of an hour of one core
    python benchmarks/tracking.py --seeds 1
    python benchmarks/tracking.py --quick          # one load, a short log: half a minute
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))  # for the arm
sys.path.insert(0, str(Path(__file__).parent))  # for what the scripts share

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits

import computed_torque as arms
import harness
from computed_torque import DT, ComputedTorque
from harness import Row
from skevgp import EVGPRegressor
from skevgp.datasets import load_robot
from skevgp.exceptions import DependentRowsWarning
from skevgp.robots import RigidBody
from skevgp.solvers import LBFGS

PAYLOADS = (0.5, 1.0, 2.0, 3.5, 5.0)
CHANCE = 0.95
NOMINAL, WEIGHTS, BOTH, GP = "nominal model", "weights", "weights and GP", "GP without physics"
NAMES = {
    NOMINAL: "PD + nominal model",
    "integral": "PID + nominal model",
    WEIGHTS: "+ learned weights",
    BOTH: "+ learned weights and GP",
    GP: "+ GP of the residual, without physics",
}
CASES = ("waves", "slow waves", "moves")
# Of a step that waits for nothing: medians of so many.
CALLS = 1000


@dataclass(frozen=True)
class Cell:
    """An arm.

    Attributes
    ----------
    payload : float
        kg.
    seed : int
    size : {"full", "quick"}
    """

    payload: float
    seed: int
    size: str


@dataclass(frozen=True)
class Size:
    """Of the log, in runs of seconds; of models; and how many references and moves are tried."""

    n_runs: int = 6
    seconds: float = 10.0
    n_inducing: int = 40
    n_inducing_gp: int = 100
    max_iter: int | None = None
    n_references: int = 4
    n_moves: int = 100
    calls: int = CALLS


SIZES = {"full": Size(), "quick": Size(3, 4.0, 10, 20, 30, 1, 20, 50)}


class WithoutPhysics:
    """The nominal model, and a Gaussian process of all columns for what it misses of each joint."""

    def __init__(self, body: RigidBody, n_inducing: int, seed: int, max_iter: int | None):
        self._body = body
        self.model = EVGPRegressor(n_inducing=n_inducing, max_iter=max_iter, solver=LBFGS(tol=10.0), random_state=seed)

    def fit(self, X: np.ndarray, y: np.ndarray, groups: np.ndarray) -> WithoutPhysics:
        self.model.fit(X, y - self._forces(X), groups=groups)
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        return self._forces(X) + self.model.predict(X)

    def _forces(self, X: np.ndarray) -> np.ndarray:
        return self._body.forces(*np.split(X, 3, axis=1))


def learn(log: tuple[np.ndarray, ...], body: RigidBody, size: Size, seed: int) -> dict[str, Any]:
    """All that learn, from the same log."""
    X, y, groups = log
    options = {"max_rows": 1500, "max_iter": size.max_iter, "random_state": seed}
    return {
        WEIGHTS: arms.learner(n_inducing=0).fit(X, y, groups=groups),
        BOTH: arms.learner(n_inducing=size.n_inducing, **options).fit(X, y, groups=groups),
        GP: WithoutPhysics(body, size.n_inducing_gp, seed, size.max_iter).fit(X, y, groups),
    }


def references(n: int, seed: int) -> dict[str, np.ndarray]:
    """Not those of the log."""
    starts, ends = arms.positions(n, seed + 2)
    durations = np.random.RandomState(seed + 3).uniform(1.2, 2.0, n)
    return {
        "waves": arms.waves(n, 6.0, seed),
        "slow waves": arms.waves(n, 6.0, seed + 1, slower=3.0),
        "moves": arms.moves(starts, ends, durations, 2.5),
    }


def tracking_errors(
    arm: arms.Arm, body: RigidBody, models: dict[str, Any], cases: dict[str, np.ndarray]
) -> Iterator[tuple[str, str, str, float]]:
    """Rms over joints and steps, mrad."""
    for case, reference in cases.items():
        controllers = {NOMINAL: ComputedTorque(body, reference), "integral": ComputedTorque(body, reference, ki=400.0)}
        for name, model in models.items():
            controllers[name] = ComputedTorque(body, reference, arms.missed_by(body, model, reference))
        for name, controller in controllers.items():
            error = arms.track(arm, controller, seed=1).error
            yield "error", name, case, 1e3 * float(np.sqrt(np.mean(error**2)))


def step_costs(
    body: RigidBody, models: dict[str, Any], reference: np.ndarray, calls: int
) -> Iterator[tuple[str, str, str, float]]:
    """Microseconds of a step of one arm; controllers take turns, each after each, so that all see the same machine."""
    reference = reference[:, :1]
    ahead = {name: arms.missed_by(body, model, reference) for name, model in models.items()}
    known = {
        NOMINAL: ComputedTorque(body, reference),
        "integral": ComputedTorque(body, reference, ki=400.0),
        **{name: ComputedTorque(body, reference, missed) for name, missed in ahead.items()},
    }
    asked = {name: ComputedTorque(body, reference, _one_row(body, models[name])) for name in (WEIGHTS, BOTH)}
    asked[GP] = ComputedTorque(body, reference, models[GP].model.compile().predict)
    for when, controllers in (("ahead", known), ("in the loop", asked)):
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


def _one_row(body: RigidBody, model: Any) -> Callable[[np.ndarray], np.ndarray]:
    return lambda wanted: arms.missed_by(body, model, wanted)


def broken_limits(
    arm: arms.Arm, body: RigidBody, model: Any, X: np.ndarray, n_moves: int, share: float, seed: int
) -> Iterator[tuple[str, str, str, float]]:
    """How many moves break a limit: at any joint and step, and where the plan comes closest to it.

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


def run(cell: Cell) -> list[dict[str, Any]]:
    """Log, learn, track, and move fast: a row for each number."""
    size, seed, body = SIZES[cell.size], 1000 * cell.seed + round(10 * cell.payload), RigidBody(load_robot("iiwa14"))
    with threadpool_limits(1), warnings.catch_warnings():
        for expected in (ConvergenceWarning, DependentRowsWarning):
            warnings.simplefilter("ignore", expected)
        arm = arms.make_arm(cell.payload, seed)
        log = arms.track(arm, ComputedTorque(body, arms.waves(size.n_runs, size.seconds, seed + 100)), seed=0)
        rows = arms.log_of(log)
        models, cases = learn(rows, body, size, seed), references(size.n_references, seed + 200)
        share = 0.35 if cell.payload <= 3.0 else 0.45  # with less they can hardly be held
        found = [
            *tracking_errors(arm, body, models, cases),
            *step_costs(body, models, cases["waves"], size.calls),
            *broken_limits(arm, body, models[BOTH], rows[0], size.n_moves, share, seed + 300),
        ]
    own = {name: getattr(cell, name) for name in Cell.__dataclass_fields__}
    return [
        {**own, "measure": measure, "model": model, "case": case, "value": value, **harness.provenance()}
        for measure, model, case, value in found
    ]


def say(rows: Sequence[dict[str, Any]]) -> str:
    errors = {row["model"]: row["value"] for row in rows if row["measure"] == "error" and row["case"] == "waves"}
    return ", ".join(f"{name} {harness.figure_of(error)} mrad" for name, error in errors.items())


def values(rows: Sequence[Row], measure: str, model: str, case: str) -> np.ndarray:
    """Of a number, arm by arm."""
    wanted = (measure, model, case)
    return harness.column([row for row in rows if (row["measure"], row["model"], row["case"]) == wanted], "value")


def error_lines(rows: Sequence[Row]) -> list[list[str]]:
    """Of a table: medians over arms, and ratios to the nominal model's arm by arm."""
    found = []
    for model, name in NAMES.items():
        errors = {case: values(rows, "error", model, case) for case in CASES}
        ratios = np.concatenate([errors[case] / values(rows, "error", NOMINAL, case) for case in CASES])
        found.append(
            [
                name,
                *(harness.figure_of(float(np.median(errors[case]))) for case in CASES),
                f"{np.median(ratios):.3f} ({ratios.min():.3f} to {ratios.max():.3f})",
            ]
        )
    return found


def payload_lines(rows: Sequence[Row]) -> list[list[str]]:
    """Of a table: medians of errors over arms and references, load by load."""
    loads = sorted({row["payload"] for row in rows}, key=float)
    return [
        [
            name,
            *(
                harness.figure_of(
                    float(np.median(np.concatenate([values(own, "error", model, case) for case in CASES])))
                )
                for own in ([row for row in rows if row["payload"] == load] for load in loads)
            ),
        ]
        for model, name in NAMES.items()
    ]


def cost_lines(rows: Sequence[Row]) -> list[list[str]]:
    """Of a table: medians over arms of microseconds, and of ratios within each run."""
    base = values(rows, "step", NOMINAL, "ahead")
    found = []
    for model, name in NAMES.items():
        cells = []
        for when in ("ahead", "in the loop"):
            costs = values(rows, "step", model, when)
            ratio = f"{np.median(costs / base):.2f}" if len(costs) else ""
            cells += [harness.figure_of(float(np.median(costs))) if len(costs) else "", ratio]
        batch = values(rows, "batch", model, "per row")
        found.append([name, *cells[:2], harness.figure_of(float(np.median(batch))) if len(batch) else "", *cells[2:]])
    return found


def limit_lines(rows: Sequence[Row]) -> list[list[str]]:
    """Of a table: moves of all arms together."""
    promised = {
        "mean": "50 % where tightest",
        "mean + 2 std": "2.3 % where tightest",
        "Boole": f"{1 - CHANCE:.0%} of moves",
    }
    found = []
    for case, said in promised.items():
        n = values(rows, "moves", BOTH, case).sum()
        counts = {
            name: values(rows, name, BOTH, case).sum()
            for name in ("broken", "broken where tightest", "broken as logged", "moves as logged")
        }
        shares = [f"{counts[name] / n:.1%}" if n else "" for name in ("broken", "broken where tightest")]
        logged = counts["moves as logged"]
        shares.append(f"{counts['broken as logged'] / logged:.1%} of {logged:.0f}" if logged else "")
        means = [values(rows, name, BOTH, case) for name in ("duration", "within 2 std")]
        weights = values(rows, "moves", BOTH, case)
        duration, within = (np.average(each, weights=weights[weights > 0.0]) if n else np.nan for each in means)
        found.append([case, f"{n:.0f}", *shares, said, f"{duration:.2f}", f"{within:.3f}"])
    return found


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page: nothing if there are no rows."""
    if not rows:
        return []
    n_arms = len({(row["payload"], row["seed"]) for row in rows})
    loads = sorted({row["payload"] for row in rows}, key=float)
    return [
        "# An arm with an unknown load",
        f"An iiwa14 with a load in the hand ({', '.join(loads)} kg), friction that its model does not know, and masses "
        f"that are 5 % off; {n_arms} arms, each with a log of its own. References are not those of the log.",
        "## Tracking errors",
        "Rms over joints and steps, mrad; medians over arms. Ratios are to PD + nominal model, of each arm and "
        "reference: median (least to largest); halved is 0.5.",
        harness.table(["", *CASES, "ratio"], error_lines(rows)),
        "Load by load, medians over arms and references:",
        harness.table(["", *(f"{load} kg" for load in loads)], payload_lines(rows)),
        "## What a step costs",
        "Microseconds of one thread, medians; ratios to PD + nominal model in the same run. The reference is known, so "
        "torques are predicted ahead, in one batch, and a step adds them; what the batch costs per row is paid before. "
        "In the loop a row is predicted at each step: by `InverseDynamics.predict`, which validates, and of the "
        "Gaussian process without physics by its `compile()`.",
        harness.table(["", "step", "ratio", "batch, per row", "in the loop", "ratio"], cost_lines(rows)),
        "## Limits",
        "Moves as fast as limits of torque allow for the mean, or the mean and k std, by weights and GP; those that "
        "torques decide. Boole: k = 4.1 promises all joints and steps of a move of up to 2 s. Shares of moves that "
        "break a limit anywhere, and at the joint and instant where the plan has the least room, for which k std is "
        "promised; the same of moves in which the joint accelerates there no more than it did in the log; how long "
        "moves are, s; "
        "and how many of the measured torques are within 2 std, predicted before the move.",
        harness.table(
            [
                *("planned with", "moves", "break a limit", "where tightest", "there as logged", "promised"),
                *("duration", "within 2 std"),
            ],
            limit_lines(rows),
        ),
        harness.provenance_text(rows),
    ]


def cells_of(options: Any) -> list[Cell]:
    if options.quick:
        return [Cell(2.0, 0, "quick")]
    return [Cell(payload, seed, "full") for seed in range(options.seeds or 2) for payload in PAYLOADS]


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="one load, a short log",
        seeds="seeds 0, 1, ...; default: 2, of a quick run 1",
        in_processes=False,
    )
    options = parser.parse_args()
    output, size = harness.output_path(options, "tracking"), "quick" if options.quick else "full"
    n_failures = harness.run_missing(cells_of(options), run, output, 1, say)
    harness.write_report(paragraphs([row for row in harness.read(output) if row["size"] == size]), output, n_failures)


if __name__ == "__main__":
    main()
