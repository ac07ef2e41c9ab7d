"""Torques of real arms: who predicts them on trajectories that were not seen, and what does the arm carry?

DATA_DIR holds a folder of logs per arm; what is there is measured, the rest is left out.

* ur10e: ur10e.urdf, and tables ur-DATE-NAME.csv.gz without a header, of time, positions, velocities and motor currents
  of six joints (columns 1, 2-7, 8-13 and 14-19). Files whose names end in "load" (not "unload") have a load, and files
  that never move are passed over; all others are tests, but for those that fits are trained on.
* ur10: ur10_exciting_trajectory.db3 (JointState) and validation_trajectory.db3 (JointTrajectory), for the URDF "ur10"
  of example-robot-data.

No row of the logs is written anywhere. Writes a row per joint and test file to a CSV as soon as a fit is done (what is
there already is not fitted again), what was found of masses and friction to another one, and a page and a picture
beside them.

    python benchmarks/real_arms.py ../data            # a quarter of an hour of one core
    python benchmarks/real_arms.py ../data --quick    # a split per arm, few rows, iterations and trees: a minute
"""

from __future__ import annotations

import re
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))  # for what the scripts share

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.ensemble import HistGradientBoostingRegressor, RandomForestRegressor
from sklearn.multioutput import MultiOutputRegressor
from sklearn.utils import Bunch
from threadpoolctl import threadpool_limits

import harness
from harness import Row
from skevgp import EVGPRegressor, InverseDynamics
from skevgp.datasets import load_log
from skevgp.features import RigidBodyRegressor
from skevgp.metrics import containing_ratios, negative_log_predictive_density

SIGNALS: dict[str, Any] = {"dt": 0.01, "cutoff": 5.0}
COLUMNS = {"time": 0, "position": range(1, 7), "velocity": range(7, 13), "current": range(13, 19)}
# Torque per current, N m / A, of a catalogue (De Luca), as the logs' README has them.
GAINS = (14.87, 13.26, 11.13, 10.62, 11.03, 11.47)
# In which rows the arm moves along its trajectory, the first one is 1; of other files all that is not at rest.
MOVING = {
    "20sec_8harm": (320, 2310),
    "30sec_12harm": (635, 3510),
    "40sec_12harm": (500, 4460),
    "50sec_12harm": (355, 5090),
    "14harm50sec": (195, 4966),
    "14harm50secLoad": (308, 5071),
    "ptp_10_points": (700, 4200),
}
# The ur10's one recording, in thirds that are groups.
UR10 = {
    "exciting 1/3": (0.0, 9.2),
    "exciting 2/3": (9.2, 18.4),
    "exciting 3/3": (18.4, None),
    "validation": None,
}
# What each fit is trained on.
SPLITS = {
    "ur10e": {
        "three": ("20sec_8harm", "30sec_12harm", "40sec_12harm"),
        "one: 30sec_12harm": ("30sec_12harm",),
        "one: 20sec_8harm": ("20sec_8harm",),
        "one: 40sec_12harm": ("40sec_12harm",),
    },
    "ur10": {
        "whole": ("exciting 1/3", "exciting 2/3", "exciting 3/3"),
        "two thirds": ("exciting 1/3", "exciting 2/3"),
    },
}
# Tests of no fit, so that all fits of an arm are compared on the same ones.
TRAINING = {"ur10e": SPLITS["ur10e"]["three"], "ur10": ()}
# Logs with a load, without it, and the load's mass if it is known, kg.
LOADS = (("14harm50secLoad", "14harm50sec", 2.805), ("load", "unload", None))
LEAST_SQUARES, EVGP = "least squares", "EVGP"
MODELS = (
    "CAD",
    LEAST_SQUARES,
    "least squares, prior",
    "GP",
    "least squares, then GP",
    EVGP,
    "gradient boosting",
    "random forest",
)
INTERVAL = 1.959963984540054  # of 95 %, in standard deviations


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    robot, split, model : str
    size : {"full", "quick"}
    folder : Path
        With the logs.
    """

    robot: str
    split: str
    model: str
    size: str
    folder: Path = field(compare=False)


@dataclass(frozen=True)
class Question:
    """What is asked of an identified arm: its load, or with ``loaded`` empty its friction.

    Attributes
    ----------
    robot : str
    trained : str
        Names of logs, with "+" between them.
    loaded : str
        The log with the load.
    gain_scale : float
    size : {"full", "quick"}
    folder : Path
    """

    robot: str
    trained: str
    loaded: str
    gain_scale: float
    size: str
    folder: Path = field(compare=False)


def paths_of(robot: str, folder: Path) -> dict[str, Path]:
    """The logs that are there, by the names that they have here."""
    if robot == "ur10":
        files = [folder / robot / f"{name}_trajectory.db3" for name in ("ur10_exciting", "validation")]
        named = {name: files[name == "validation"] for name in UR10}
        return {name: path for name, path in named.items() if path.exists()}
    found = {}
    for path in sorted((folder / robot).glob("*.csv.gz")):
        found[re.sub(r"^ur-\d\d_\d\d_\d\d[-_]", "", path.name.removesuffix(".csv.gz"))] = path
    return found


@lru_cache
def log_of(robot: str, name: str, folder: Path) -> Bunch:
    """One log."""
    path = paths_of(robot, folder)[name]
    if robot == "ur10":
        return load_log(path, keep=UR10[name], **SIGNALS)
    first, last = MOVING.get(name, (1, None))
    return load_log(path, columns=COLUMNS, gains=GAINS, keep=slice(first - 1, last), **SIGNALS)


@lru_cache
def moving(robot: str, folder: Path) -> tuple[str, ...]:
    """Names of the logs in which the arm moves."""
    names = []
    for name in paths_of(robot, folder):
        try:
            log_of(robot, name, folder)
        except ValueError as problem:
            if "at rest" not in str(problem):
                raise
        else:
            names.append(name)
    return tuple(names)


def has_load(name: str) -> bool:
    return name.lower().endswith("load") and not name.lower().endswith("unload")


def splits_of(robot: str, folder: Path, size: str) -> dict[str, tuple[str, ...]]:
    """Those whose training logs are there; in a quick run the first."""
    there = moving(robot, folder)
    found = {split: names for split, names in SPLITS[robot].items() if set(names) <= set(there)}
    return dict(list(found.items())[: 1 if size == "quick" else None])


def tests_of(robot: str, split: str, folder: Path) -> list[str]:
    """What a fit is tested on."""
    taken = {*TRAINING[robot], *SPLITS[robot][split]}
    return [name for name in moving(robot, folder) if name not in taken and not has_load(name)]


def rows_of(robot: str, names: Sequence[str], folder: Path, size: str) -> Bunch:
    """Rows of several logs, each a group; in a quick run every tenth."""
    logs = [log_of(robot, name, folder) for name in names]
    step = 10 if size == "quick" else 1
    return Bunch(
        data=np.concatenate([log.data[::step] for log in logs]),
        target=np.concatenate([log.target[::step] for log in logs]),
        groups=np.concatenate([np.full(len(log.data[::step]), number) for number, log in enumerate(logs)]),
    )


def urdf_of(robot: str, folder: Path) -> str:
    return str(folder / robot / "ur10e.urdf") if robot == "ur10e" else robot


class LinearTorques(RegressorMixin, BaseEstimator):
    """Rigid-body features with the weights of the URDF, or those of least squares whose band is the errors' spread."""

    def __init__(self, robot: Any, least_squares: bool = True):
        self.robot = robot
        self.least_squares = least_squares

    def fit(self, X: np.ndarray, y: np.ndarray) -> LinearTorques:
        self.features_ = RigidBodyRegressor(self.robot).fit(X)
        H = self.features_.transform(X)
        self.coef_ = self.features_.coef_prior(y.shape[1])[0]
        if self.least_squares:
            self.coef_ = np.linalg.lstsq(H.reshape(y.size, -1), y.ravel(), rcond=None)[0]
        self.std_ = np.sqrt(np.mean((y - H @ self.coef_) ** 2, axis=0))
        return self

    def predict(self, X: np.ndarray, return_std: bool = False) -> Any:
        mean = self.features_.transform(X) @ self.coef_
        return (mean, np.broadcast_to(self.std_, mean.shape)) if return_std else mean


class LinearThenGP(RegressorMixin, BaseEstimator):
    """Least squares, and a Gaussian process of all columns on what they leave: its band is the whole one."""

    def __init__(self, linear: LinearTorques, regressor: EVGPRegressor):
        self.linear = linear
        self.regressor = regressor

    def fit(self, X: np.ndarray, y: np.ndarray, groups: np.ndarray | None = None) -> LinearThenGP:
        self.linear.fit(X, y)
        self.regressor.fit(X, y - self.linear.predict(X), groups=groups)
        return self

    def predict(self, X: np.ndarray, return_std: bool = False) -> Any:
        mean = self.linear.predict(X)
        if not return_std:
            return mean + self.regressor.predict(X)
        more, std = self.regressor.predict(X, return_std=True)
        return mean + more, std


def model_of(name: str, robot: str, quick: bool) -> tuple[Any, bool, bool]:
    """A regressor as it comes, whether it has a band, and whether it is told which rows are one trajectory."""
    short = {"max_iter": 5} if quick else {}
    gp = EVGPRegressor(n_inducing=10 if quick else 100, random_state=0, **short)
    if name == "CAD":
        return LinearTorques(robot, least_squares=False), False, False
    if name == LEAST_SQUARES:
        return LinearTorques(robot), True, False
    if name == "least squares, prior":
        return InverseDynamics(robot, n_inducing=0), True, True
    if name == "GP":
        return gp, True, True
    if name == "least squares, then GP":
        return LinearThenGP(LinearTorques(robot), gp), True, True
    if name == EVGP:
        return arm_of(robot, quick), True, True
    if name == "gradient boosting":
        return MultiOutputRegressor(HistGradientBoostingRegressor(random_state=0, **short)), False, False
    trees = {"n_estimators": 5} if quick else {}
    return MultiOutputRegressor(RandomForestRegressor(random_state=0, **trees)), False, False


def arm_of(robot: str, quick: bool, gain_scale: float = 0.0) -> InverseDynamics:
    short = {"max_iter": 5, "n_inducing": 10} if quick else {}
    return InverseDynamics(robot, gain_scale=gain_scale, random_state=0, **short)


def run(cell: Cell) -> list[dict[str, Any]]:
    """Fit a model, and look at each joint of each test file; ``fit_seconds`` is processor time of one thread."""
    robot = urdf_of(cell.robot, cell.folder)
    train = rows_of(cell.robot, SPLITS[cell.robot][cell.split], cell.folder, cell.size)
    model, has_band, by_groups = model_of(cell.model, robot, cell.size == "quick")
    reference = LinearTorques(robot).fit(train.data, train.target)
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start = time.process_time()
        model.fit(train.data, train.target, **({"groups": train.groups} if by_groups else {}))
        seconds = time.process_time() - start
        rows = []
        for name in tests_of(cell.robot, cell.split, cell.folder):
            test = rows_of(cell.robot, [name], cell.folder, cell.size)
            base = np.mean((reference.predict(test.data) - test.target) ** 2, axis=0)
            mean, std = model.predict(test.data, return_std=True) if has_band else (model.predict(test.data), None)
            for joint in range(test.target.shape[1]):
                rows.append(
                    {
                        **{key: getattr(cell, key) for key in ("robot", "split", "model", "size")},
                        "test": name,
                        "joint": joint + 1,
                        **measures(test.target[:, [joint]], mean[:, [joint]], None if std is None else std[:, [joint]]),
                        "ratio": np.mean((mean - test.target)[:, joint] ** 2) / base[joint],
                        "n_train": len(train.data),
                        "n_test": len(test.data),
                        "fit_seconds": seconds,
                        **harness.provenance(),
                    }
                )
    return rows


def measures(truth: np.ndarray, mean: np.ndarray, std: np.ndarray | None) -> dict[str, Any]:
    """Of one joint (n, 1); nothing of bands where there are none."""
    error = {"nmse": np.mean((mean - truth) ** 2) / truth.var()}
    if std is None:
        return {**error, **dict.fromkeys(("nlpd", "cr1", "cr2", "cr3"), "")}
    shares = containing_ratios(truth, mean, std)
    bands = dict(zip(("cr1", "cr2", "cr3"), shares, strict=True))
    return {**error, "nlpd": negative_log_predictive_density(truth, mean, std), **bands}


def ask(question: Question) -> list[dict[str, Any]]:
    """What is found, with its standard deviation."""
    train = rows_of(question.robot, question.trained.split("+"), question.folder, question.size)
    arm = arm_of(urdf_of(question.robot, question.folder), question.size == "quick", question.gain_scale)
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        arm.fit(train.data, train.target, groups=train.groups)
        if question.loaded:
            loaded = rows_of(question.robot, [question.loaded], question.folder, question.size)
            load = arm.estimate_payload(loaded.data, loaded.target)
            names = ["mass", *(f"com {axis}" for axis in "xyz")]
            values, stds = np.r_[load.mass, load.com], np.r_[load.mass_std, load.com_std]
        else:
            keep = [name.startswith(("viscous", "coulomb")) for name in arm.coef_names_]
            names, values, stds = arm.coef_names_[keep], arm.coef_[keep], arm.coef_std_[keep]
    return [
        {
            **{key: getattr(question, key) for key in ("robot", "trained", "loaded", "gain_scale", "size")},
            "name": name,
            "value": value,
            "std": std,
            **harness.provenance(),
        }
        for name, value, std in zip(names, values, stds, strict=True)
    ]


def questions_of(folder: Path, size: str) -> list[Question]:
    """Loads, by what the same arm did without them, alone and with the training files; and friction by each split."""
    there = moving("ur10e", folder)
    splits = splits_of("ur10e", folder, size)
    questions = []
    for loaded, empty, _ in LOADS:
        if {loaded, empty} <= set(there):
            more = splits.get("three", ()) if size == "full" else ()
            sets = [(empty,), (empty, *more)] if more else [(empty,)]
            questions += [
                Question("ur10e", "+".join(names), loaded, scale, size, folder)
                for names in sets
                for scale in (0.0, 0.1)
            ]
    return questions + [Question("ur10e", "+".join(names), "", 0.0, size, folder) for names in splits.values()]


# --- the page ----------------------------------------------------------------------------------------------------


def geometric(values: np.ndarray) -> float:
    return float(np.exp(np.mean(np.log(values))))


def of(rows: Sequence[Row], **wanted: str) -> list[Row]:
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def models_in(rows: Sequence[Row]) -> list[str]:
    return [model for model in MODELS if any(row["model"] == model for row in rows)]


def joints_in(rows: Sequence[Row]) -> list[str]:
    return sorted({row["joint"] for row in rows}, key=int)


def pooled(rows: Sequence[Row], name: str) -> float | None:
    """The mean over all test rows of all files, of a model with bands."""
    if any(row[name] == "" for row in rows):
        return None
    return float(np.average(harness.column(rows, name), weights=harness.column(rows, "n_test")))


def shown(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def wins(rows: Sequence[Row], model: str) -> int:
    """In how many (test file, joint) its error is the least of all models."""
    least: dict[tuple[str, str], Row] = {}
    for row in rows:
        key = row["test"], row["joint"]
        if key not in least or float(row["nmse"]) < float(least[key]["nmse"]):
            least[key] = row
    return sum(row["model"] == model for row in least.values())


def summary_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Per model: errors over those of least squares, bands and time."""
    pairs = len({(row["test"], row["joint"]) for row in rows})
    for model in models_in(rows):
        own = of(rows, model=model)
        means = [harness.column(of(own, joint=joint), "ratio").mean() for joint in joints_in(own)]
        yield [
            model,
            harness.figure_of(geometric(harness.column(own, "ratio"))),
            *map(harness.figure_of, means),
            f"{wins(rows, model)} of {pairs}",
            shown(pooled(own, "nlpd"), 2),
            *(shown(pooled(own, name), 3) for name in ("cr1", "cr2", "cr3")),
            f"{float(own[0]['fit_seconds']):.1f}",
        ]


def band_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Per model with bands: the share of test rows within two standard deviations, of each joint."""
    for model in models_in(rows):
        own = of(rows, model=model)
        shares = [pooled(of(own, joint=joint), "cr2") for joint in joints_in(own)]
        if None not in shares:
            yield [model, *(shown(share, 3) for share in shares)]


def error_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Per test file and model: nMSE of each joint, the least of each in bold."""
    for test in dict.fromkeys(row["test"] for row in rows):
        here = of(rows, test=test)
        least = {joint: harness.column(of(here, joint=joint), "nmse").min() for joint in joints_in(here)}
        for model in models_in(here):
            own = {row["joint"]: float(row["nmse"]) for row in of(here, model=model)}
            texts = {joint: harness.figure_of(value) for joint, value in own.items()}
            best = {joint: f"**{text}**" if own[joint] == least[joint] else text for joint, text in texts.items()}
            yield [test, model, *(best[joint] for joint in joints_in(here))]


def lost_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Per test file and joint in which another model errs less than the EVGP: which, and both errors."""
    for row in of(rows, model=EVGP):
        others = of(rows, test=row["test"], joint=row["joint"])
        best = min(others, key=lambda other: float(other["nmse"]))
        if best["model"] != EVGP:
            errors = [harness.figure_of(float(one["nmse"])) for one in (best, row)]
            yield [row["test"], row["joint"], best["model"], *errors, f"{float(row['ratio']):.2f}"]


def arm_parts(robot: str, rows: Sequence[Row]) -> Iterator[str]:
    """The page's part on one arm; of its first split with the errors in each file, of others where the EVGP lost."""
    yield f"## {robot}"
    joints = [f"joint {joint}" for joint in joints_in(rows)]
    for number, split in enumerate(split for split in SPLITS[robot] if of(rows, split=split)):
        own = of(rows, split=split)
        tests = ", ".join(dict.fromkeys(row["test"] for row in own))
        yield f"### Trained on {split}"
        yield f"{' + '.join(SPLITS[robot][split])}: {own[0]['n_train']} rows; tests: {tests}."
        header = ["", "ratio", *joints, "best of all", "NLPD", "CR-1", "CR-2", "CR-3", "seconds"]
        yield harness.table(header, summary_lines(own))
        yield "CR-2 of each joint, all test rows together:"
        yield harness.table(["", *joints], band_lines(own))
        if number == 0:
            yield "nMSE of each test file, the least of each joint in bold:"
            yield harness.table(["test", "", *joints], error_lines(own))
        else:
            yield "Where another model errs less than the EVGP (nMSE; ratio of the EVGP's to least squares'):"
            yield harness.table(["test", "joint", "least", "its nMSE", "EVGP's", "ratio"], lost_lines(own))


def interval_of(row: Row) -> tuple[float, float]:
    value, half = float(row["value"]), INTERVAL * float(row["std"])
    return value - half, value + half


def load_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Per load and training set: its mass, and whether the interval holds what it weighs."""
    known = {loaded: mass for loaded, _, mass in LOADS}
    for row in of(rows, name="mass"):
        low, high = interval_of(row)
        mass = known[row["loaded"]]
        yield [
            row["loaded"],
            row["trained"].replace("+", " + "),
            row["gain_scale"],
            f"{float(row['value']):.3f}",
            f"{float(row['std']):.3f}",
            f"{low:.3f} to {high:.3f}",
            f"{high - low:.3f}",
            "" if mass is None else f"{mass:.3f}",
            "" if mass is None else ("yes" if low <= mass <= high else "no"),
        ]


def friction_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    own = of(rows, loaded="")
    for trained in dict.fromkeys(row["trained"] for row in own):
        for term in ("coulomb", "viscous"):
            values = [row for row in of(own, trained=trained) if row["name"].startswith(term)]
            texts = [f"{float(row['value']):.2f} ± {INTERVAL * float(row['std']):.2f}" for row in values]
            yield [term, trained.replace("+", " + "), *texts]


def sides_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Per split: how the asked figures came out, of the EVGP."""
    for robot, splits in SPLITS.items():
        for split in splits:
            own = of(rows, robot=robot, split=split, model=EVGP)
            if own:
                ratios = [harness.column(of(own, joint=joint), "ratio").mean() for joint in joints_in(own)]
                shares = [pooled(of(own, joint=joint), "cr2") or 0.0 for joint in joints_in(own)]
                yield [
                    robot,
                    split,
                    f"{geometric(harness.column(own, 'ratio')):.3f}",
                    f"{max(ratios):.2f}",
                    f"{min(shares):.3f} to {max(shares):.3f}",
                    f"{float(own[0]['fit_seconds']):.0f}",
                ]


def paragraphs(rows: Sequence[Row], found: Sequence[Row], picture: str) -> list[str]:
    """The page, which shows a picture: nothing if there are no rows."""
    if not rows:
        return []
    parts = [
        "# Torques of real arms",
        "Measured on logs of a real UR10e (github.com/shamilmamedov/dynamic_calibration; without a licence, so nothing "
        "of them is in this project: this page has results only) and of a real UR10 (github.com/unisa-acg/"
        "inverse-dynamics-solver, BSD-3-Clause). Signals: `load_log` on a grid of 10 ms with a zero-phase filter of "
        "5 Hz; the UR10e's torques are currents times a catalogue's gains, the UR10's are those of its messages. "
        "Splits are by trajectory: no test file is of a training one, but that of the UR10's one recording, cut in "
        "thirds, the last is a test where the others are trained on. Its validation trajectory is another one.",
        "Errors are mean squares: nMSE is relative to the torque's variance, ratio to plain least squares on the same "
        "training rows (`RigidBodyRegressor`'s features, numpy's lstsq), a geometric mean over joints and test files; "
        "of a joint the mean over test files. CAD is the URDF without friction; least squares, prior is "
        "`InverseDynamics(n_inducing=0)`; GP is `EVGPRegressor(n_inducing=100)` of [q, q̇, q̈], told the groups, and so "
        "is the one on least squares' residuals; EVGP is `InverseDynamics` as it comes; gradient boosting and random "
        "forest are scikit-learn's, a model per joint. The band of least squares is the spread of its errors in "
        "training. CR-2 should be .954. Best of all: in how many pairs of a test file and a joint it errs least. "
        "NLPD is per joint and row. Seconds of one core.",
        f"![Ratios and bands]({picture})",
        "## In short: the EVGP",
        harness.table(["arm", "trained on", "ratio", "worst joint", "CR-2 of joints", "seconds"], sides_lines(rows)),
    ]
    for robot in SPLITS:
        own = of(rows, robot=robot)
        if own:
            parts += list(arm_parts(robot, own))
    loads, frictions = list(load_lines(found)), list(friction_lines(found))
    if loads:
        header = ["log", "arm known from", "gain_scale", "mass, kg", "std", "95 %", "width", "true", "inside"]
        parts += [
            "## What the UR10e carries",
            "`InverseDynamics(gain_scale=...)` fitted without the load, then `estimate_payload`. With `gain_scale` 0 "
            "the catalogue's gains are taken for exact.",
            harness.table(header, loads),
        ]
    if frictions:
        joints = [f"joint {number}" for number in range(1, len(frictions[0]) - 1)]
        parts += [
            "## Friction of the UR10e",
            "Coulomb, N m, and viscous, N m s/rad, with the half width of 95 % intervals, from different trajectories.",
            harness.table(["", "known from", *joints], frictions),
        ]
    return [*parts, harness.provenance_text([*rows, *found])]


def draw(rows: Sequence[Row], path: Path) -> None:
    """Ratios of each joint and test file, and shares within two standard deviations, a panel per split."""
    plt = harness.pyplot()
    splits = [(robot, split) for robot in SPLITS for split in SPLITS[robot] if of(rows, robot=robot, split=split)]
    models = [model for model in models_in(rows) if model != LEAST_SQUARES]
    size = (harness.WIDTH, 0.9 + 1.7 * len(splits))
    figure, axes = plt.subplots(len(splits), 2, figsize=size, sharex="col", squeeze=False)
    for (ratios, shares), (robot, split) in zip(axes, splits, strict=True):
        own = of(rows, robot=robot, split=split)
        for place, model in enumerate(models):
            values = harness.column(of(own, model=model), "ratio")
            color = harness.PALETTE[1] if model == EVGP else harness.PALETTE[0]
            jitter = np.linspace(-0.25, 0.25, len(values))
            ratios.plot(values, place + jitter, ".", color=color, markersize=4, alpha=0.6)
            ratios.plot([geometric(values)], [place], "|", color="black", markersize=14, markeredgewidth=2)
        ratios.axvline(1.0, color="0.5", linewidth=0.8)
        ratios.set(xscale="log", yticks=range(len(models)), yticklabels=models, ylim=(len(models) - 0.5, -0.5))
        banded = [model for model in models_in(own) if of(own, model=model)[0]["cr2"] != ""]
        for place, model in enumerate(banded):
            mine = of(own, model=model)
            values = [pooled(of(mine, joint=joint), "cr2") for joint in joints_in(mine)]
            color = harness.PALETTE[1] if model == EVGP else harness.PALETTE[0]
            shares.plot(values, place + np.linspace(-0.25, 0.25, len(values)), ".", color=color, markersize=6)
        shares.axvspan(0.9, 0.99, color="0.9", zorder=0)
        shares.axvline(0.954, color="0.5", linewidth=0.8)
        shares.set(yticks=range(len(banded)), yticklabels=banded, ylim=(len(banded) - 0.5, -0.5))
        ratios.set_title(f"{robot}, trained on {split}", loc="left")
    axes[-1, 0].set_xticks([0.1, 1.0, 10.0, 100.0, 1000.0], ["0.1", "1", "10", "100", "1000"])
    axes[-1, 0].set_xlabel("error / least squares'\n(each file and joint; bar: geometric mean)")
    axes[-1, 1].set_xlabel("share of rows within ± 2 std\n(each joint; gray: 90 to 99 %)")
    harness.save_picture(figure, path)


def main() -> None:
    parser = harness.argument_parser(
        __doc__, quick="a split per arm, every tenth row, few points, iterations and trees"
    )
    parser.add_argument("data_dir", type=Path, help="with the folders ur10e and ur10, or one of them")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    options = parser.parse_args()
    output, size = harness.output_path(options, "real_arms"), "quick" if options.quick else "full"
    folder = options.data_dir.resolve()
    cells = [
        Cell(robot, split, model, size, folder)
        for robot in SPLITS
        for split in splits_of(robot, folder, size)
        if tests_of(robot, split, folder)
        for model in options.models
    ]
    if not cells:
        raise SystemExit(f"{options.data_dir} has no logs of {' or '.join(SPLITS)}: python {sys.argv[0]} --help")
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    second = output.with_name(f"{output.stem}_parameters.csv")
    questions = questions_of(folder, size)
    n_failures += harness.run_missing(questions, ask, second, options.jobs, say_found, since=options.since)
    rows, found = (of(harness.read(path), size=size) for path in (output, second))
    picture = output.with_suffix(".png")
    if rows:
        draw(rows, picture)
    harness.write_report(paragraphs(rows, found, picture.name), output, n_failures)


def say(rows: list[dict[str, Any]]) -> str:
    ratio = geometric(np.array([row["ratio"] for row in rows]))
    return f"{ratio:.3f} of least squares' error, {rows[0]['fit_seconds']:.1f} s"


def say_found(rows: list[dict[str, Any]]) -> str:
    return f"{rows[0]['name']} {rows[0]['value']:.3f} ± {rows[0]['std']:.3f}"


if __name__ == "__main__":
    main()
