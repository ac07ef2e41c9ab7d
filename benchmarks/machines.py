"""Torques, motion and contact of real and simulated machines, on new moves.

    python benchmarks/machines.py inverse --data ../data           # a quarter of an hour of one core
    python benchmarks/machines.py forward --data ../data           # five minutes of one core
    python benchmarks/machines.py acrobot --data ../data           # a minute of one core
    python benchmarks/machines.py contact --data ../data           # five minutes of one core
    python benchmarks/machines.py check --data ../data             # three minutes of one core
    python benchmarks/machines.py inverse --quick                  # simulated machines only, few rows: a minute

The data folder has the folders real (acrobot, double_pendulum, simple_pendulum, kr300, panda), ur10e and ur10, or some
of them. Machines without logs are left out, and simulated machines need none. No row of the logs is written anywhere.
benchmarks/README.md says where logs come from, and how to add a machine.

*inverse* compares models of joint torques. Each split has whole moves for training and other whole moves for tests.
Least squares has the rigid-body features with friction, fitted by `numpy.linalg.lstsq`. "updated" is `InverseDynamics`
after `update` with the first five seconds of each test move, or with a third of a shorter one. Its scores, and those of
least squares that it is compared with, are of the rest. It needs three training moves.

If there is a CSV of the same name with the ending "_before", made by the same command with another version of skevgp,
a table compares both.

*forward* compares models of the state after 20 ms, with `EVGPRegressor`'s defaults. Signals are filtered with 15 Hz.
Rollouts are of a second, with the recorded torques, from 20 states of each test move.

*acrobot* compares models of the state after about 26 ms. They are trained on two swing-ups of a real acrobot by one
controller (TVLQR), and tested on a third one and on two swing-ups by another controller (MC-PILCO). Their rows are from
`log_transitions`, with its defaults and an estimated delay of efforts, or as recorded.

*contact* fits `ContactMonitor` to clean moves that the model was not fitted to, and tests it on another one. Simulated
pushes are twice as large as ``detectable_`` and last 0.4 s. A push counts as found if there is an alarm, and none
without the push.

*check* runs `InverseDynamics.check_log` on moves that the model was not trained on, and on logs with a load.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.multioutput import MultiOutputRegressor
from sklearn.pipeline import make_union
from sklearn.utils import Bunch

import harness
import robots
from robots import LinearThenGP, LinearTorques, geometric
from skevgp import ContactMonitor, EVGPRegressor, InverseDynamics, ResidualRegressor, rollout
from skevgp.datasets import load_log, load_robot, log_transitions, perturb_robot
from skevgp.features import (
    AngleEncoder,
    Friction,
    InertiaForce,
    InertiaForceGravity,
    LogNormal,
    NominalDynamics,
    RigidBodyRegressor,
)
from skevgp.metrics import containing_ratios, crps, negative_log_predictive_density

# --- machines ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Machine:
    """A machine: its URDF, a function that reads a move, and splits into moves to train on and to test on."""

    robot: Callable[[Path], Any]
    read: Callable[[str, Path, dict[str, Any]], Bunch]
    splits: dict[str, tuple[tuple[str, ...], tuple[str, ...]]]
    signals: dict[str, Any] = field(default_factory=lambda: {"dt": 0.01, "cutoff": 5.0})


def each_left_out(moves: tuple[str, ...]) -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
    return {f"without {move}": (tuple(other for other in moves if other != move), (move,)) for move in moves}


def of_table(folder: str, columns: dict[str, Any]) -> Callable[[str, Path, dict[str, Any]], Bunch]:
    def read(move: str, data: Path, signals: dict[str, Any]) -> Bunch:
        return load_log(data / "real" / folder / f"{move}.csv.gz", columns=columns, **signals)

    return read


def columns_of(n_joints: int) -> dict[str, Any]:
    names = {"position": "q", "velocity": "dq", "effort": "tau"}
    return {"time": "time"} | {key: [f"{name}{j}" for j in range(1, n_joints + 1)] for key, name in names.items()}


def own_urdf(folder: str) -> Callable[[Path], str]:
    return lambda data: str(data / "real" / folder / "robot.urdf")


PANDA = {
    "0 to 4.2 s": (0.0, 4.2),
    "4.2 to 8.4 s": (4.2, 8.4),
    "8.4 to 12.6 s": (8.4, 12.6),
    "13 s to the end": (13.0, None),
}


def of_panda(move: str, data: Path, signals: dict[str, Any]) -> Bunch:
    """Return a part of the only log of the Panda."""
    return load_log(data / "real" / "panda" / "panda.csv.gz", columns=columns_of(7), keep=PANDA[move], **signals)


@lru_cache
def panda_without_fingers(_: Path) -> Any:
    return load_robot("panda", joints=[f"panda_joint{number}" for number in range(1, 8)])


def of_ur(robot: str) -> Callable[[str, Path, dict[str, Any]], Bunch]:
    def read(move: str, data: Path, _: dict[str, Any]) -> Bunch:
        name, _, part = move.partition(", part ")
        log = robots.log_of(robot, name, data)
        if not part:
            return log
        first, last = (len(log.data) * number // 3 for number in (int(part) - 1, int(part)))
        return Bunch(data=log.data[first:last], target=log.target[first:last], pieces=log.pieces[first:last])

    return read


PANDA_SPLIT = {"first 12.6 s": (tuple(PANDA)[:3], tuple(PANDA)[3:])}
UR10E = ("20sec_8harm", "30sec_12harm", "40sec_12harm")
UR10E_TESTS = ("20sec_7harm", "50sec_12harm", "14harm50sec", "ptp_10_points", "unload")
UR10E_DAY = tuple(f"50sec_12harm, part {number}" for number in (1, 2, 3))
UR10E_DAYS = ("20sec_8harm", "20sec_7harm", "30sec_12harm", "14harm50sec", "ptp_10_points", "unload")
DOUBLE = tuple(f"trajectory_{number}" for number in range(1, 7))
SIMPLE = ("energy_shaping", "ilqr", "pd_system_identification", "sac")
KR300 = {"A": (("A",), ("B",)), "B": (("B",), ("A",))}
SIMULATED = {
    "three moves": (("move 1", "move 2", "move 3"), ("move 4", "faster", "one joint at a time", "another day"))
}


@lru_cache
def simulated(robot: str, move: str) -> Bunch:
    """Return a move of a simulated arm whose friction depends on the load, and differs from move to move by 10 %."""
    kinds = {"faster": 4, "one joint at a time": 5, "another day": 6}
    number = kinds.get(move) or int(move.split()[1])
    rng, n = np.random.default_rng(number), load_robot(robot).nv
    X = robots.trajectory(rng, n, "full")
    if move == "faster":
        X = X * np.repeat([1.0, 1.5, 2.25], n)  # as if time ran faster
    if move == "one joint at a time":
        X = X.reshape(len(X), 3, n) * (np.arange(len(X)) * n // len(X) == np.arange(n)[:, np.newaxis]).T[:, np.newaxis]
        X = X.reshape(len(X), 3 * n)
    body = RigidBodyRegressor(perturb_robot(robot, 0.2, random_state=1)).fit(X)
    links = body.coef_prior(n)[0][: 10 * n]
    usual = robots.trajectory(np.random.default_rng(0), n, "full")
    torque, largest = body.transform(X)[:, :, : 10 * n] @ links, body.transform(usual)[:, :, : 10 * n] @ links
    largest = np.abs(largest).max(axis=0) + 1.0
    speed = np.tanh(X[:, n : 2 * n] / 0.02)
    day = 1.0 + 0.1 * rng.normal(size=n) + (0.15 if move == "another day" else 0.0)
    friction = day * speed * (0.05 * largest + 0.1 * np.abs(torque)) + 0.05 * largest * X[:, n : 2 * n]
    noise = 0.01 * largest * rng.normal(size=torque.shape)
    return Bunch(data=X, target=torque + friction + noise + 0.01 * largest * rng.normal(size=n))


def of_simulated(robot: str) -> Callable[[str, Path, dict[str, Any]], Bunch]:
    return lambda move, _, __: simulated(robot, move)


MACHINES = {
    "UR10e": Machine(
        lambda data: robots.urdf_of("ur10e", data),
        of_ur("ur10e"),
        {"three moves": (UR10E, UR10E_TESTS), "one move": (UR10E[1:2], UR10E_TESTS)},
    ),
    "UR10e, another day": Machine(
        lambda data: robots.urdf_of("ur10e", data), of_ur("ur10e"), {"February 12": (UR10E_DAY, UR10E_DAYS)}
    ),
    "UR10": Machine(
        lambda _: "ur10",
        of_ur("ur10"),
        {"two thirds": (("exciting 1/3", "exciting 2/3"), ("exciting 3/3", "validation"))},
    ),
    "KR300": Machine(own_urdf("kr300"), of_table("kr300", columns_of(6)), KR300),
    "double pendulum, 5 Hz": Machine(
        own_urdf("double_pendulum"), of_table("double_pendulum", columns_of(2)), each_left_out(DOUBLE)
    ),
    "double pendulum, 15 Hz": Machine(
        own_urdf("double_pendulum"),
        of_table("double_pendulum", columns_of(2)),
        each_left_out(DOUBLE),
        {"dt": 0.01, "cutoff": 15.0},
    ),
    "simple pendulum": Machine(
        own_urdf("simple_pendulum"),
        of_table(
            "simple_pendulum", {"time": "time", "position": "position", "velocity": "velocity", "effort": "torque"}
        ),
        each_left_out(SIMPLE),
        {"dt": 0.01, "cutoff": 15.0},
    ),
    **{
        f"Panda, {cutoff:g} Hz": Machine(panda_without_fingers, of_panda, PANDA_SPLIT, {"dt": 0.01, "cutoff": cutoff})
        for cutoff in (2.5, 5.0, 20.0)
    },
    "ur5, simulated": Machine(lambda _: "ur5", of_simulated("ur5"), SIMULATED),
    "iiwa14, simulated": Machine(lambda _: "iiwa14", of_simulated("iiwa14"), SIMULATED),
}


def there(machine: str, data: Path | None) -> bool:
    """Return whether there are logs of a machine."""
    if machine.endswith("simulated") or data is None:
        return machine.endswith("simulated")
    trained, _ = next(iter(MACHINES[machine].splits.values()))
    try:
        MACHINES[machine].read(trained[0], data, MACHINES[machine].signals)
    except (OSError, KeyError):
        return False
    return True


def rows_of(machine: str, moves: tuple[str, ...], data: Path | None, size: str, **signals: Any) -> Bunch:
    """Return rows of some moves, each of which is a group, in pieces without gaps. A quick run takes every tenth."""
    own, step = MACHINES[machine], 10 if size == "quick" else 1
    logs = [own.read(move, data or Path(), own.signals | signals) for move in moves]
    sizes = [len(log.data[::step]) for log in logs]
    groups = np.repeat(np.arange(len(logs)), sizes)
    pieces = [log.get("pieces", np.zeros(len(log.data), dtype=int))[::step] for log in logs]
    return Bunch(
        data=np.concatenate([log.data[::step] for log in logs]),
        target=np.concatenate([log.target[::step].reshape(n, -1) for log, n in zip(logs, sizes, strict=True)]),
        groups=groups,
        pieces=np.unique(np.column_stack([groups, np.concatenate(pieces)]), axis=0, return_inverse=True)[1].ravel(),
    )


def one_dimensional(target: np.ndarray) -> np.ndarray:
    """Return the torques of a single joint as (n,)."""
    return target.ravel() if target.shape[1] == 1 else target


# --- inverse dynamics ----------------------------------------------------------------------------------------------

Inverse = namedtuple("Inverse", "robot split model size")

UPDATE_ROWS = 500  # five seconds
LEAST_SQUARES, OURS, UPDATED = "least squares", "InverseDynamics", "InverseDynamics, updated"
INVERSE = (
    "URDF",
    LEAST_SQUARES,
    "least squares, then GP",
    "GP",
    "gradient boosting",
    "InverseDynamics without GP",
    OURS,
    UPDATED,
)


def inverse_model(name: str, robot: Any, quick: bool) -> tuple[Any, bool, bool]:
    """Return a regressor with its defaults, whether it has a std, and whether its fit takes groups."""
    short = {"max_iter": 5} if quick else {}
    gp = EVGPRegressor(n_inducing=10 if quick else 100, random_state=0, **short)
    ours = InverseDynamics(robot, random_state=0, **short)
    boosting = HistGradientBoostingRegressor(random_state=0, **short)
    return {
        "URDF": (LinearTorques(robot, least_squares=False), True, False),
        LEAST_SQUARES: (LinearTorques(robot), True, False),
        "least squares, then GP": (LinearThenGP(LinearTorques(robot), gp), True, True),
        "GP": (gp, True, True),
        "gradient boosting": (MultiOutputRegressor(boosting), False, False),
        "InverseDynamics without GP": (InverseDynamics(robot, n_inducing=0), True, True),
        OURS: (ours, True, True),
        UPDATED: (ours, True, True),
    }[name]


def run_inverse(cell: Inverse, data: Path | None) -> list[dict[str, Any]]:
    """Fit a model and judge each joint on each test move."""
    machine = MACHINES[cell.robot]
    robot, (trained, tested) = machine.robot(data or Path()), machine.splits[cell.split]
    train = rows_of(cell.robot, trained, data, cell.size)
    model, has_std, by_groups = inverse_model(cell.model, robot, cell.size == "quick")
    groups = {"groups": train.groups} if by_groups else {}
    takes_columns = cell.model in ("URDF", LEAST_SQUARES, "least squares, then GP", "gradient boosting")
    y = train.target if takes_columns else one_dimensional(train.target)
    seconds, _ = harness.timed(lambda: model.fit(train.data, y, **groups))
    base, found = LinearTorques(robot).fit(train.data, train.target), []
    for move in tested:
        test = rows_of(cell.robot, (move,), data, cell.size)
        X, truth = test.data, test.target
        if cell.model == UPDATED:
            first = min(UPDATE_ROWS, len(X) // 3)
            model.update(X[:first], one_dimensional(truth[:first]))
            X, truth = X[first:], truth[first:]
        least = np.mean((base.predict(X) - truth) ** 2, axis=0)
        mean, std = model.predict(X, return_std=True) if has_std else (model.predict(X), None)
        mean = np.reshape(mean, truth.shape)
        errors, variance = np.mean((mean - truth) ** 2, axis=0), truth.var(axis=0)
        for joint in range(truth.shape[1]):
            row = {"test": move, "joint": joint + 1}
            row |= {"nmse": errors[joint] / variance[joint], "least": least[joint] / variance[joint]}
            row |= dict.fromkeys(("cr1", "cr2", "cr3", "nlpd", "crps", "interval"), "")
            if std is not None:
                own = truth[:, [joint]], mean[:, [joint]], np.reshape(std, truth.shape)[:, [joint]]
                row |= dict(zip(("cr1", "cr2", "cr3"), containing_ratios(*own), strict=True))
                row |= {"nlpd": negative_log_predictive_density(*own) - 0.5 * np.log(variance[joint])}
                row["crps"] = crps(*own) / np.sqrt(variance[joint])
                row["interval"] = interval_score(*own) / np.sqrt(variance[joint])
            found.append({**row, "n_train": len(train.data), "n_test": len(truth), "fit_seconds": seconds})
    return found


def interval_score(truth: np.ndarray, mean: np.ndarray, std: np.ndarray) -> float:
    """Return the interval score of 95 % intervals (Gneiting & Raftery 2007, eq. 43)."""
    low, high = mean - robots.INTERVAL * std, mean + robots.INTERVAL * std
    return float(np.mean(high - low + 40.0 * (np.maximum(low - truth, 0.0) + np.maximum(truth - high, 0.0))))


def inverse_tables(rows: pd.DataFrame) -> harness.Tables:
    """Return a line for each machine, then for each test move, and errors of all models."""
    rows = rows.assign(ratio=rows["nmse"] / rows["least"])
    moves = rows.groupby(["robot", "split", "test", "model"], sort=False).agg(
        ratio=("ratio", geometric), nmse=("nmse", geometric), cr2=("cr2", "mean"), least_cr2=("cr2", "min")
    )
    moves = moves.reset_index()
    names = [name for name in MACHINES if (rows["robot"] == name).any()]
    lines = []
    for machine in names:
        own = moves[(moves["robot"] == machine) & (moves["model"] == OURS)]
        joints = rows[(rows["robot"] == machine) & (rows["model"] == OURS)]
        updated = moves[(moves["robot"] == machine) & (moves["model"] == UPDATED)]
        lines.append(
            {
                "machine": machine,
                "test moves": len(own),
                "error / least squares": geometric(own["ratio"]),
                "largest": own["ratio"].max(),
                "CR-2": f"{own['cr2'].mean():.3f}",
                "least of a joint": f"{joints.groupby('joint')['cr2'].mean().min():.3f}",
                "CRPS": geometric(joints["crps"].astype(float)),
                "interval score": geometric(joints["interval"].astype(float)),
                "updated: error / least squares": geometric(updated["ratio"]) if len(updated) else np.nan,
                "updated: CR-2": f"{updated['cr2'].mean():.3f}" if len(updated) else "",
                "seconds": joints.groupby("split")["fit_seconds"].first().mean(),
            }
        )
    models = moves.groupby(["model", "robot"], sort=False)["ratio"].agg(geometric).unstack()
    models = models.reindex(index=harness.ordered(INVERSE, moves["model"]), columns=names)
    ours = moves[moves["model"] == OURS]
    table = ours.assign(cr2=harness.text(ours["cr2"], 3), least_cr2=harness.text(ours["least_cr2"], 3))
    names = {"robot": "machine", "split": "trained on", "test": "move", "ratio": "error / least squares"}
    names |= {"nmse": "nMSE", "cr2": "CR-2", "least_cr2": "least of a joint"}
    table = table.drop(columns="model").rename(columns=names)
    return {"machines": pd.DataFrame(lines), "models": models.reset_index(names=""), "moves": table}


def against(rows: pd.DataFrame, before: pd.DataFrame) -> pd.DataFrame:
    """Compare `InverseDynamics` with an earlier version: geometric means of ratios over joints and test moves."""
    keys = ["robot", "split", "test", "joint"]
    now, then = (one[one["model"] == OURS].set_index(keys) for one in (rows, before))
    both = now.join(then.add_suffix("_before"), how="inner")
    lines = []
    for machine in [name for name in MACHINES if name in both.index.get_level_values("robot")]:
        own = both.xs(machine, level="robot")
        line: dict[str, Any] = {"machine": machine}
        for name, title in {"nmse": "error", "crps": "CRPS", "interval": "interval score"}.items():
            line[title] = geometric(own[name].astype(float) / own[f"{name}_before"].astype(float))
        line |= {"CR-2 before": f"{own['cr2_before'].mean():.3f}", "now": f"{own['cr2'].mean():.3f}"}
        lines.append(line | {"seconds": geometric(own["fit_seconds"] / own["fit_seconds_before"])})
    return pd.DataFrame(lines)


# --- forward dynamics ----------------------------------------------------------------------------------------------

Forward = namedtuple("Forward", "robot split model size")

STEP, ROLLOUT_STEPS, STARTS, PARTICLES = 0.02, 50, 20, 50
FORWARD = ("plain", "RES", "IF", "IFG", "IF and nominal")


def transitions(rows: Bunch) -> Bunch:
    """Return [q, q̇, u] and the next [q, q̇] of rows that follow each other."""
    states = rows.data[:, : 2 * rows.target.shape[1]]
    follows = rows.pieces[1:] == rows.pieces[:-1]
    X = np.column_stack([states, rows.target])[:-1]
    return Bunch(
        data=X[follows], target=states[1:][follows], groups=rows.groups[:-1][follows], pieces=rows.pieces[:-1][follows]
    )


def forward_model(name: str, robot: Any, quick: bool) -> Any:
    short = {"max_iter": 5, "n_inducing": 10} if quick else {}
    features = {
        "plain": None,
        "RES": None,
        "IF": InertiaForce(robot, dt=STEP),
        "IFG": InertiaForceGravity(robot, dt=STEP),
        "IF and nominal": make_union(InertiaForce(robot, dt=STEP), NominalDynamics(robot, dt=STEP)),
    }[name]
    model = EVGPRegressor(features, random_state=0, **short)
    return ResidualRegressor(model) if name == "RES" else model


def run_forward(cell: Forward, data: Path | None) -> list[dict[str, Any]]:
    """Fit a model of the next state, and judge one step and rollouts of each test move."""
    machine = MACHINES[cell.robot]
    robot, (trained, tested) = machine.robot(data or Path()), machine.splits[cell.split]
    train = transitions(rows_of(cell.robot, trained, data, "full", dt=STEP))
    model = forward_model(cell.model, robot, cell.size == "quick")
    seconds, _ = harness.timed(lambda: model.fit(train.data, train.target, groups=train.groups))
    found = []
    for move in tested:
        test = transitions(rows_of(cell.robot, (move,), data, "full", dt=STEP))
        n = test.target.shape[1]
        mean, std = model.predict(test.data, return_std=True)
        change = test.target - test.data[:, :n]
        error = np.mean((mean - test.target) ** 2, axis=0) / change.var(axis=0)
        row = {
            "test": move,
            "nmse": float(np.exp(np.mean(np.log(error)))),
            "cr2": containing_ratios(test.target, mean, std)[1],
        }
        row |= covered(model, test, n)
        found.append({**row, "n_train": len(train.data), "n_test": len(test.data), "fit_seconds": seconds})
    return found


def covered(model: Any, test: Bunch, n: int) -> dict[str, float]:
    """Return shares of states within two standard deviations of rollouts, and the error of positions at the end."""
    steps = min(ROLLOUT_STEPS, len(test.data) // 4)
    pieces, first = test.pieces, np.linspace(0, len(test.data) - steps - 1, STARTS).astype(int)
    first = first[pieces[first] == pieces[first + steps - 1]]
    states = np.stack([test.target[start : start + steps] for start in first])
    inputs = np.stack([test.data[start : start + steps, n:] for start in first])
    shares: dict[str, float] = {}
    for method, options in (("sample", {"n_samples": PARTICLES, "random_state": 0}), ("linearized", {})):
        path = rollout(model, test.data[first, :n], inputs, method=method, **options)
        inside = np.abs(path.mean - states) <= 2.0 * path.std
        shares[f"covered_{method}"] = float(inside.mean())
        scatter = test.data[:, : n // 2].std(axis=0)
        shares[f"rollout_{method}"] = float(
            np.median(np.linalg.norm((path.mean[:, -1] - states[:, -1])[:, : n // 2] / scatter, axis=1))
        )
    return shares


def forward_tables(rows: pd.DataFrame) -> harness.Tables:
    groups = rows.groupby(["robot", "model"], sort=False)
    table = groups.agg(
        nmse=("nmse", geometric),
        cr2=("cr2", "mean"),
        sample=("covered_sample", "mean"),
        linearized=("covered_linearized", "mean"),
        error=("rollout_sample", geometric),
        seconds=("fit_seconds", "mean"),
    ).reset_index()
    table["nmse"] = table.groupby("robot")["nmse"].transform(harness.best)
    for name in ("cr2", "sample", "linearized"):
        table[name] = harness.text(table[name], 3)
    names = {"nmse": "nMSE of the change", "cr2": "CR-2", "sample": "rollouts within 2 std", "linearized": "linearized"}
    return {"forward": table.rename(columns=names | {"robot": "machine", "error": "error of rollouts"})}


# --- the next state under another controller ----------------------------------------------------------------------

Acrobot = namedtuple("Acrobot", "rows left_out model size")

ROWS, CONTROLLERS = ("aligned", "as recorded"), ("same controller", "another controller")
ACROBOT = ("RES", "IFG", "IF, nominal, friction", "IF, nominal with parameters, friction")
STRIDE = 13  # rows of TVLQR, which are 2 ms apart. Those of MC-PILCO are 30 ms apart


def acrobot_rows(names: list[str], stride: int, how: str, data: Path) -> Bunch:
    folder = data / "real"
    options = {"delay": "auto", "robot": str(folder / "double_pendulum" / "robot.urdf")} if how == "aligned" else {}
    files = [folder / "acrobot" / f"{name}.csv.gz" for name in names]
    return log_transitions(load_log(files, columns=columns_of(2), **options), stride=stride, align=how == "aligned")


def acrobot_model(name: str, robot: Any, quick: bool) -> Any:
    short = {"max_iter": 5, "n_inducing": 10} if quick else {}
    options = {"kernel_map": AngleEncoder(robot, dt="column"), "random_state": 0, **short}
    wide = {f"inertia(Joint{j})": LogNormal(1.0, 1.0) for j in (1, 2)}
    parameters = wide | {f"mass(Joint{j})": LogNormal(1.0, 0.3) for j in (1, 2)}

    def union(**own: Any) -> Any:
        maps = InertiaForce(robot, dt="column"), NominalDynamics(robot, dt="column", **own)
        return make_union(*maps, Friction(robot, dt="column"))

    if name == "RES":
        return ResidualRegressor(EVGPRegressor(**options))
    features = {
        "IFG": InertiaForceGravity(robot, dt="column"),
        "IF, nominal, friction": union(),
        "IF, nominal with parameters, friction": union(parameters=parameters),
    }[name]
    return EVGPRegressor(features, **options)


def run_acrobot(cell: Acrobot, data: Path | None) -> list[dict[str, Any]]:
    """Fit a model to two runs, and judge each column of the state on the third one and on the other controller's."""
    folder = data or Path()
    runs = [f"tvlqr_{number}" for number in (1, 2, 3)]
    train = acrobot_rows([run for run in runs if run != cell.left_out], STRIDE, cell.rows, folder)
    tests = {
        CONTROLLERS[0]: acrobot_rows([cell.left_out], STRIDE, cell.rows, folder),
        CONTROLLERS[1]: acrobot_rows(["mcpilco_1", "mcpilco_2"], 1, cell.rows, folder),
    }
    model = acrobot_model(cell.model, load_robot(str(folder / "real/double_pendulum/robot.urdf")), cell.size == "quick")
    seconds, _ = harness.timed(lambda: model.fit(train.data, train.target, groups=train.groups))
    found = []
    for test, rows in tests.items():
        mean, std = model.predict(rows.data, return_std=True)
        change = (rows.target - rows.data[:, : rows.target.shape[1]]).var(axis=0)
        for number, column in enumerate(rows.target_names):
            own = rows.target[:, [number]], mean[:, [number]], std[:, [number]]
            score = {"nmse": np.mean((own[1] - own[0]) ** 2) / change[number], "cr2": containing_ratios(*own)[1]}
            sizes = {"n_train": len(train.data), "n_test": len(rows.data), "fit_seconds": seconds}
            found.append({"test": test, "column": column, **score, **sizes})
    return found


def acrobot_tables(rows: pd.DataFrame) -> harness.Tables:
    means = rows.groupby(["rows", "model", "test", "left_out"], sort=False)
    means = means.agg(nmse=("nmse", geometric)).groupby(["rows", "model", "test"], sort=False)["nmse"].agg(geometric)
    errors = means.unstack()[list(CONTROLLERS)].reset_index()
    shares = rows[rows["rows"] == ROWS[0]].groupby(["model", "test", "column"], sort=False)["cr2"].mean().unstack()
    shares = shares.map("{:.3f}".format).reset_index()
    return {"errors": errors, "shares": shares}


def plot_acrobot(rows: pd.DataFrame, path: Path) -> None:
    """Draw the error of each model on both controllers, with aligned rows and with rows as recorded."""
    figure, axes = harness.pyplot().subplots(
        1, 2, figsize=(harness.WIDTH, 2.4), sharey=True, sharex=True, layout="constrained"
    )
    for axis, test in zip(axes, CONTROLLERS, strict=True):
        for number, how in enumerate(ROWS):
            for place, model in enumerate(ACROBOT):
                own = rows[(rows["rows"] == how) & (rows["model"] == model) & (rows["test"] == test)]
                values = own.groupby("left_out")["nmse"].agg(geometric)
                height = np.full(len(values), place + 0.14 * (2 * number - 1))
                label = how if place == 0 and axis is axes[0] else None
                axis.plot(values, height, "o", markersize=5, color=harness.PALETTE[number], alpha=0.8, label=label)
        axis.set(title=test, xlabel="error / variance of the change", yticks=range(len(ACROBOT)), yticklabels=ACROBOT)
        harness.logarithmic(axis, "x")
    axes[0].invert_yaxis()
    harness.legend(figure, ncols=2)
    harness.save_picture(figure, path)


# --- contact -------------------------------------------------------------------------------------------------------

Contact = namedtuple("Contact", "robot move size")

RATES, PUSHES, PUSH_ROWS, BEFORE, APART = (6.0, 20.0, 60.0), 20, 40, 150, 100


def contact_split(machine: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return moves to train the model on, and moves to fit and judge monitors on."""
    trained, tested = next(iter(MACHINES[machine].splits.values()))
    if len(tested) > 1:
        return trained, tested
    half = len(trained) // 2
    return trained[:half], trained[half:] + tested


def run_contact(cell: Contact, data: Path | None) -> list[dict[str, Any]]:
    """Judge monitors on a clean move, and on pushes in it. They are fitted to the other clean moves."""
    machine, (trained, tested) = MACHINES[cell.robot], contact_split(cell.robot)
    others = tuple(move for move in tested if move != cell.move)
    train, clean, test = (rows_of(cell.robot, moves, data, "full") for moves in (trained, others, (cell.move,)))
    with harness.one_thread():
        model = InverseDynamics(machine.robot(data or Path()), random_state=0)
        model.fit(train.data, train.target, groups=train.groups)
        return [judged(model, rate, clean, test) for rate in (RATES[-1:] if cell.size == "quick" else RATES)]


def judged(model: InverseDynamics, rate: float, clean: Bunch, test: Bunch) -> dict[str, Any]:
    """Return false alarms and pushes found at a rate."""
    monitor = ContactMonitor(model, false_alarms_per_hour=rate)
    monitor.fit(clean.data, clean.target, pieces=clean.pieces)
    alarms = np.flatnonzero(monitor.predict(test.data, test.target, pieces=test.pieces))
    found, rng = 0, np.random.default_rng(0)
    for _ in range(PUSHES):
        joint, start = rng.integers(test.target.shape[1]), rng.integers(BEFORE, len(test.data) - PUSH_ROWS - 20)
        rows = slice(start - BEFORE, start + PUSH_ROWS + 20)
        free = test.target[rows]
        pushed = free.copy()
        pushed[BEFORE : BEFORE + PUSH_ROWS, joint] += 2.0 * monitor.detectable_[joint] * rng.choice([-1.0, 1.0])
        alarmed, anyway = (monitor.predict(test.data[rows], torque)[BEFORE:] for torque in (pushed, free))
        found += bool((alarmed & ~anyway).any())
    return {
        "rate": rate,
        "hours": len(test.data) * monitor.dt / 3600.0,
        "false_alarms": 0 if len(alarms) == 0 else 1 + int(np.sum(np.diff(alarms) > APART)),
        "pushes": PUSHES,
        "found": found,
        "threshold": monitor.threshold_,
        "detectable": " ".join(f"{value:.3g}" for value in monitor.detectable_),
        "hours_seen": monitor.hours_,
    }


def contact_tables(rows: pd.DataFrame) -> harness.Tables:
    sums = rows.groupby(["robot", "rate"], sort=False)[["hours", "false_alarms", "pushes", "found"]].sum()
    rate = sums.index.get_level_values("rate").to_numpy()
    table = pd.DataFrame(
        {
            "minutes": 60.0 * sums["hours"],
            "false alarms expected": sums["hours"] * rate,
            "seen": sums["false_alarms"],
            "pushes found": (sums["found"] / sums["pushes"]).map("{:.2f}".format),
        }
    ).reset_index(names=["machine", "per hour"])
    # The monitors of a machine differ by the move that they are not fitted to. The first one stands for all.
    first = rows.groupby(["robot", "rate"], sort=False)["detectable"].first()
    joints = [[float(value) for value in str(values).split()] for values in first]
    named = {"detectable, N m: least": [min(each) for each in joints], "greatest": [max(each) for each in joints]}
    return {"contact": table.assign(**named)}


# --- logs that do not fit ------------------------------------------------------------------------------------------

Check = namedtuple("Check", "robot split move size")

LOADED = {"UR10e": ("14harm50secLoad", "load")}


def run_check(cell: Check, data: Path | None) -> dict[str, Any]:
    """Test whether a move fits a model."""
    machine = MACHINES[cell.robot]
    train = rows_of(cell.robot, machine.splits[cell.split][0], data, "full")
    test = rows_of(cell.robot, (cell.move,), data, "full")
    with harness.one_thread():
        model = InverseDynamics(machine.robot(data or Path()), random_state=0)
        model.fit(train.data, one_dimensional(train.target), groups=train.groups)
        found = model.check_log(test.data, one_dimensional(test.target))
    loaded = cell.move in LOADED.get(cell.robot, ())
    return {"loaded": loaded, "fits": found.fits, "p_value": found.p_value, "joints": " ".join(found.joints)}


def check_tables(rows: pd.DataFrame) -> harness.Tables:
    text = {True: "yes", False: "no"}
    table = rows.assign(loaded=rows["loaded"].map(text), fits=rows["fits"].map(text), joints=rows["joints"].fillna(""))
    names = {"robot": "machine", "split": "trained on", "loaded": "has a load", "p_value": "p", "joints": "do not fit"}
    return {"check": table[["robot", "split", "move", "loaded", "fits", "p_value", "joints"]].rename(columns=names)}


# --- the command ---------------------------------------------------------------------------------------------------


def cells_of(part: str, machines: list[str], size: str) -> list[Any]:
    if part == "contact":
        # The UR10, the KR300 and the Panda have too few moves to fit and to judge monitors on.
        machines = [name for name in machines if name.split(",")[0] not in ("UR10", "KR300", "Panda")]
        machines = [name for name in machines if name != "double pendulum, 15 Hz"]
        last = 1 if size == "quick" else None
        return [Contact(machine, move, size) for machine in machines for move in contact_split(machine)[1][:last]]
    if part == "check":
        return [
            Check(machine, split, move, size)
            for machine in machines
            for split, (trained, tested) in MACHINES[machine].splits.items()
            if len(trained) > 2
            for move in (*tested, *LOADED.get(machine, ()))
        ]
    if part == "acrobot":
        lefts = [f"tvlqr_{number}" for number in ((1,) if size == "quick" else (1, 2, 3))]
        return [Acrobot(how, left, model, size) for how in ROWS for left in lefts for model in ACROBOT]
    if part == "forward":
        machines = [machine for machine in machines if machine in ("double pendulum, 15 Hz", "simple pendulum")]
        return [Forward(m, split, model, size) for m in machines for split in MACHINES[m].splits for model in FORWARD]
    cells = [Inverse(m, split, model, size) for m in machines for split in MACHINES[m].splits for model in INVERSE]
    # Updates need three moves to train on.
    return [cell for cell in cells if cell.model != UPDATED or len(MACHINES[cell.robot].splits[cell.split][0]) > 2]


PARTS = {  # CSV, function, tables, title
    "inverse": ("machines", run_inverse, inverse_tables, "Torques of machines on new moves"),
    "forward": ("machines_forward", run_forward, forward_tables, "Motion of machines"),
    "acrobot": ("machines_acrobot", run_acrobot, acrobot_tables, "Motion of an acrobot under another controller"),
    "contact": ("machines_contact", run_contact, contact_tables, "Detection of contact"),
    "check": ("machines_check", run_check, check_tables, "Logs that do not fit the model"),
}


def plot(rows: pd.DataFrame, path: Path) -> None:
    """Draw errors over those of least squares, and shares within two standard deviations, of each test move."""
    rows = rows.assign(ratio=rows["nmse"] / rows["least"])
    moves = rows.groupby(["robot", "split", "test", "model"], sort=False)
    moves = moves.agg(ratio=("ratio", geometric), cr2=("cr2", "mean")).reset_index()
    names = [name for name in MACHINES if (moves["robot"] == name).any()]
    figure, (errors, shares) = harness.pyplot().subplots(
        1, 2, figsize=(harness.WIDTH, 0.9 + 0.42 * len(names)), sharey=True, layout="constrained"
    )
    for number, model in enumerate(("InverseDynamics without GP", OURS)):
        for place, machine in enumerate(names):
            own = moves[(moves["robot"] == machine) & (moves["model"] == model)]
            height = np.full(len(own), place + 0.18 * (2 * number - 1))
            options = {"color": harness.PALETTE[number], "alpha": 0.7, "label": model if place == 0 else None}
            errors.plot(own["ratio"], height, "o", markersize=4, **options)
            shares.plot(own["cr2"], height, "o", markersize=4, **options)
    errors.set(yticks=range(len(names)), yticklabels=names, xlabel="error / least squares', each test move")
    errors.invert_yaxis()
    errors.axvline(1.0, color="0.5", linewidth=0.8)
    harness.logarithmic(errors, "x")
    shares.axvspan(0.92, 0.98, color="0.9", zorder=0)
    shares.axvline(0.954, color="0.5", linewidth=0.8)
    shares.set_xlabel("share of rows within ± 2 std")
    harness.legend(figure, ncols=2)
    harness.save_picture(figure, path)


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="simulated machines, every tenth row, few iterations")
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--data", type=Path, help="the folder of logs; default: simulated machines only")
    parser.add_argument("--machines", nargs="+", choices=MACHINES, default=list(MACHINES), help="default: all")
    parser.add_argument("--models", nargs="+", choices=INVERSE, default=INVERSE, help="models of inverse; default: all")
    options = harness.parse(parser)
    name, run, tables_of, title = PARTS[options.part]
    output = harness.output_path(options, name)
    data = options.data.resolve() if options.data else None
    machines = [machine for machine in options.machines if there(machine, data)]
    cells = [
        cell
        for cell in cells_of(options.part, machines, options.size)
        if options.part != "inverse" or cell.model in options.models
    ]
    n_failures = harness.run_missing(cells, partial(run, data=data), output, options.jobs) if cells else 0
    rows = harness.frame(output, size=options.size)
    if not len(rows):
        raise SystemExit(f"There are no logs for {options.part} in {options.data}.")
    if options.part == "inverse":
        plot(rows, output.with_suffix(".png"))
    if options.part == "acrobot":
        plot_acrobot(rows, output.with_suffix(".png"))
    tables, before = tables_of(rows), output.with_name(f"{output.stem}_before.csv")
    if options.part == "inverse" and before.exists():
        tables["before"] = against(rows, harness.frame(before, size=options.size))
    harness.write_page(title, tables, output, n_failures)


if __name__ == "__main__":
    main()
