"""Torques of robots: real arms on new trajectories, and identification of simulated arms.

    python benchmarks/robots.py real --data ../data            # a quarter of an hour of one core
    python benchmarks/robots.py real --data ../data --quick    # a split per arm, few rows and iterations: a minute
    python benchmarks/robots.py identification                 # 50 runs, each without and with a filter: minutes
    python benchmarks/robots.py identification --quick         # one run of few rows: seconds
    python benchmarks/robots.py payload --data ../data         # an hour of one core; without --data only simulated arms

*real* compares models of the torques of real arms. The data folder has a folder of logs per arm. Arms without logs are
left out. No row of the logs is written anywhere.

- ur10e: ur10e.urdf, and tables ur-DATE-NAME.csv.gz without a header. They have time, positions, velocities and motor
  currents of six joints (columns 1, 2-7, 8-13 and 14-19). Files whose names end in "load" (not "unload") have a load.
  Files that never move are skipped. All others are tests, except those that a fit is trained on.
- ur10: ur10_exciting_trajectory.db3 (JointState) and validation_trajectory.db3 (JointTrajectory), for the URDF "ur10"
  of example-robot-data.

A second CSV has the identified load and friction.

*identification* has a simulated arm with Coulomb and viscous friction. Its masses, centres of mass and inertias differ
from the model's by up to 20 % (`perturb_robot`). It follows two trajectories of half a minute at 100 Hz. Torques have
noise of 2 % of their standard deviation. The data are used directly, or written to a file that `load_log` reads with a
filter of 5 Hz. A combination of weights counts as identified if its posterior variance is below a quarter of the
prior's. Combinations are eigenvectors of the posterior covariance, in units of the prior. Torques are predicted on
other trajectories.

*payload* measures intervals of payloads. Simulated arms like those of *identification* have unknown velocities of
friction, and gains with errors. Three moves are without a payload, and a fourth one with it. Moves are alike, or differ
in friction and gains. The load of the UR10e is estimated from a whole log and from its fifths, with models that are
fitted to different logs.
"""

from __future__ import annotations

import re
import tempfile
from collections import namedtuple
from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pinocchio
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.ensemble import HistGradientBoostingRegressor, RandomForestRegressor
from sklearn.multioutput import MultiOutputRegressor
from sklearn.utils import Bunch

import harness
from harness import best, ordered, text
from skevgp import EVGPRegressor, InverseDynamics
from skevgp.datasets import load_log, load_robot, perturb_robot
from skevgp.features import RigidBodyRegressor
from skevgp.metrics import containing_ratios, negative_log_predictive_density

INTERVAL = 1.959963984540054  # of 95 %, in standard deviations


# --- real arms -----------------------------------------------------------------------------------------------------

SIGNALS: dict[str, Any] = {"dt": 0.01, "cutoff": 5.0}
COLUMNS = {"time": 0, "position": range(1, 7), "velocity": range(7, 13), "current": range(13, 19)}
# Torque per current, N m / A, of a catalogue (De Luca), as the logs' README has them.
GAINS = (14.87, 13.26, 11.13, 10.62, 11.03, 11.47)
# First and last row, from 1, in which the arm moves along its trajectory. Other files: all rows not at rest.
MOVING = {
    "20sec_8harm": (320, 2310),
    "30sec_12harm": (635, 3510),
    "40sec_12harm": (500, 4460),
    "50sec_12harm": (355, 5090),
    "14harm50sec": (195, 4966),
    "14harm50secLoad": (308, 5071),
    "ptp_10_points": (700, 4200),
}
# The only recording of the ur10, in thirds that are groups.
UR10 = {
    "exciting 1/3": (0.0, 9.2),
    "exciting 2/3": (9.2, 18.4),
    "exciting 3/3": (18.4, None),
    "validation": None,
}
# Training logs of each fit.
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
# Logs that no fit is tested on, so that all fits of an arm have the same tests.
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

# What pictures call the models of the CSV and of the tables.
TODAY = {
    "CAD": "URDF",
    "least squares, prior": "InverseDynamics without GP",
    "GP": "GP without physics",
    EVGP: "InverseDynamics",
}
# In two colours: an arm's first split, and its others.
SHARES = ("all training data", "less: one of three logs, or two thirds of one")

Real = namedtuple("Real", "robot split model size")

# The load of an identified arm, or its friction if ``loaded`` is empty. ``trained`` has logs joined by "+".
Question = namedtuple("Question", "robot trained loaded gain_scale size")


def paths_of(robot: str, folder: Path) -> dict[str, Path]:
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
    path = paths_of(robot, folder)[name]
    if robot == "ur10":
        return load_log(path, keep=UR10[name], **SIGNALS)
    first, last = MOVING.get(name, (1, None))
    return load_log(path, columns=COLUMNS, gains=GAINS, keep=slice(first - 1, last), **SIGNALS)


@lru_cache
def moving(robot: str, folder: Path) -> tuple[str, ...]:
    """Return names of the logs in which the arm moves."""

    def moves(name: str) -> bool:
        try:
            log_of(robot, name, folder)
        except ValueError as problem:
            if "at rest" not in str(problem):
                raise
            return False
        return True

    return tuple(filter(moves, paths_of(robot, folder)))


def has_load(name: str) -> bool:
    return name.lower().endswith("load") and not name.lower().endswith("unload")


def splits_of(robot: str, folder: Path, size: str) -> dict[str, tuple[str, ...]]:
    """Return the splits whose training logs exist; in a quick run only the first."""
    there = moving(robot, folder)
    found = {split: names for split, names in SPLITS[robot].items() if set(names) <= set(there)}
    return dict(list(found.items())[: 1 if size == "quick" else None])


def tests_of(robot: str, split: str, folder: Path) -> list[str]:
    taken = {*TRAINING[robot], *SPLITS[robot][split]}
    return [name for name in moving(robot, folder) if name not in taken and not has_load(name)]


def rows_of(robot: str, names: Sequence[str], folder: Path, size: str) -> Bunch:
    """Return rows of several logs. Each log is a group. A quick run takes every tenth row."""
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
    """Rigid-body features with the weights of the URDF or of least squares; std is that of the training errors."""

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
    """Least squares, and a Gaussian process of all columns on the residual, which gives the std."""

    def __init__(self, linear: LinearTorques, regressor: EVGPRegressor):
        self.linear = linear
        self.regressor = regressor

    def fit(self, X: np.ndarray, y: np.ndarray, groups: np.ndarray | None = None) -> LinearThenGP:
        self.linear.fit(X, y)
        self.regressor.fit(X, y - self.linear.predict(X), groups=groups)
        return self

    def predict(self, X: np.ndarray, return_std: bool = False) -> Any:
        linear = self.linear.predict(X)
        mean, std = (values.reshape(linear.shape) for values in self.regressor.predict(X, return_std=True))
        mean = mean + linear
        return (mean, std) if return_std else mean


def model_of(name: str, robot: str, quick: bool) -> tuple[Any, bool, bool]:
    """Return a regressor with its defaults, whether it has a std, and whether its fit takes groups."""
    short, trees = ({"max_iter": 5}, {"n_estimators": 5}) if quick else ({}, {})
    gp = EVGPRegressor(n_inducing=10 if quick else 100, random_state=0, **short)
    boosting = HistGradientBoostingRegressor(random_state=0, **short)
    return {
        "CAD": (LinearTorques(robot, least_squares=False), False, False),
        LEAST_SQUARES: (LinearTorques(robot), True, False),
        "least squares, prior": (InverseDynamics(robot, n_inducing=0), True, True),
        "GP": (gp, True, True),
        "least squares, then GP": (LinearThenGP(LinearTorques(robot), gp), True, True),
        EVGP: (arm_of(robot, quick), True, True),
        "gradient boosting": (MultiOutputRegressor(boosting), False, False),
        "random forest": (MultiOutputRegressor(RandomForestRegressor(random_state=0, **trees)), False, False),
    }[name]


def arm_of(robot: str, quick: bool, gain_scale: float = 0.0) -> InverseDynamics:
    short = {"max_iter": 5, "n_inducing": 10} if quick else {}
    return InverseDynamics(robot, gain_scale=gain_scale, random_state=0, **short)


def run_real(cell: Real, folder: Path) -> list[dict[str, Any]]:
    """Fit a model and evaluate each joint on each test file. ``fit_seconds`` is processor time of one thread."""
    robot = urdf_of(cell.robot, folder)
    train = rows_of(cell.robot, SPLITS[cell.robot][cell.split], folder, cell.size)
    model, has_band, by_groups = model_of(cell.model, robot, cell.size == "quick")
    reference = LinearTorques(robot).fit(train.data, train.target)
    groups = {"groups": train.groups} if by_groups else {}
    seconds, _ = harness.timed(lambda: model.fit(train.data, train.target, **groups))
    rows = []
    for name in tests_of(cell.robot, cell.split, folder):
        test = rows_of(cell.robot, [name], folder, cell.size)
        base = np.mean((reference.predict(test.data) - test.target) ** 2, axis=0)
        mean, std = model.predict(test.data, return_std=True) if has_band else (model.predict(test.data), None)
        for joint, least in enumerate(base):
            own = [None if values is None else values[:, [joint]] for values in (test.target, mean, std)]
            row = {"test": name, "joint": joint + 1, **measures(*own)}
            row["ratio"] = np.mean((mean - test.target)[:, joint] ** 2) / least
            rows.append({**row, "n_train": len(train.data), "n_test": len(test.data), "fit_seconds": seconds})
    return rows


def measures(truth: np.ndarray, mean: np.ndarray, std: np.ndarray | None) -> dict[str, Any]:
    """Return scores of one joint (n, 1); empty without a std."""
    found = dict.fromkeys(("nlpd", "cr1", "cr2", "cr3"), "")
    if std is not None:
        found = {"nlpd": negative_log_predictive_density(truth, mean, std)}
        found |= dict(zip(("cr1", "cr2", "cr3"), containing_ratios(truth, mean, std), strict=True))
    return {"nmse": np.mean((mean - truth) ** 2) / truth.var(), **found}


def ask(question: Question, folder: Path) -> list[dict[str, Any]]:
    """Return what was identified, with standard deviations."""
    train = rows_of(question.robot, question.trained.split("+"), folder, question.size)
    arm = arm_of(urdf_of(question.robot, folder), question.size == "quick", question.gain_scale)
    with harness.one_thread():
        arm.fit(train.data, train.target, groups=train.groups)
        if question.loaded:
            loaded = rows_of(question.robot, [question.loaded], folder, question.size)
            load = arm.estimate_payload(loaded.data, loaded.target)
            names = ["mass", *(f"com {axis}" for axis in "xyz")]
            values, stds = np.r_[load.mass, load.com], np.r_[load.mass_std, load.com_std]
        else:
            keep = [name.startswith(("viscous", "coulomb")) for name in arm.coef_names_]
            names, values, stds = arm.coef_names_[keep], arm.coef_[keep], arm.coef_std_[keep]
    found = zip(names, values, stds, strict=True)
    return [{"name": name, "value": value, "std": std} for name, value, std in found]


def questions_of(folder: Path, size: str) -> list[Question]:
    """Return questions of loads, from the log without the load alone and with training logs, and of friction."""
    splits, questions = splits_of("ur10e", folder, size), []
    for loaded, empty, _ in LOADS:
        if {loaded, empty} <= set(moving("ur10e", folder)):
            more = splits.get("three", ()) if size == "full" else ()
            for trained in dict.fromkeys([(empty,), (empty, *more)]):
                questions += [Question("ur10e", "+".join(trained), loaded, scale, size) for scale in (0.0, 0.1)]
    return questions + [Question("ur10e", "+".join(names), "", 0.0, size) for names in splits.values()]


def geometric(values: pd.Series) -> float:
    return float(np.exp(np.mean(np.log(values))))


def pooled(rows: pd.DataFrame, name: str) -> float:
    """Return the mean over all test rows of all files; NaN without intervals."""
    return float(np.average(rows[name], weights=rows["n_test"]))


def split_tables(rows: pd.DataFrame, first: bool) -> harness.Tables:
    """Return errors over those of least squares, CR-2 of each joint, and nMSE of each test file, or lost ones."""
    rows = rows.assign(model=pd.Categorical(rows["model"], MODELS), joint="joint " + rows["joint"].astype(str))
    least = rows.loc[rows.groupby(["test", "joint"])["nmse"].idxmin()]
    models, by_joint = (rows.groupby(keys, observed=True) for keys in ("model", ["model", "joint"]))
    names = ["nlpd", "cr1", "cr2", "cr3"]
    means = models.apply(lambda own: pd.Series({name: pooled(own, name) for name in names}), include_groups=False)
    wins = least["model"].value_counts().reindex(means.index).map(f"{{}} of {len(least)}".format)
    summary = models["ratio"].agg(geometric).to_frame().join(by_joint["ratio"].mean().unstack())
    summary = summary.assign(**{"best of all": wins, "NLPD": text(means["nlpd"], 2)})
    for k in (1, 2, 3):
        summary[f"CR-{k}"] = text(means[f"cr{k}"], 3)
    summary["seconds"] = models["fit_seconds"].first().map("{:.1f}".format)
    bands = by_joint.apply(pooled, "cr2", include_groups=False).unstack().dropna().map("{:.3f}".format)
    tables = {"": summary.reset_index(names=""), "CR-2": bands.reset_index(names="")}
    if first:
        errors = rows.pivot(index=["test", "model"], columns="joint", values="nmse")
        errors = errors.groupby("test").transform(best).reindex(rows["test"].unique(), level=0)
        return tables | {"errors": errors.reset_index(names=["test", ""])}
    lost = rows[rows["model"] == EVGP].merge(least, on=["test", "joint"], suffixes=("", " least"))
    lost = lost[lost["model least"] != EVGP]
    lost = lost.assign(joint=lost["joint"].str.removeprefix("joint "), ratio=lost["ratio"].map("{:.2f}".format))
    header = {"model least": "least", "nmse least": "its nMSE", "nmse": "EVGP's"}
    return tables | {"lost": lost[["test", "joint", *header, "ratio"]].rename(columns=header)}


def real_tables(rows: pd.DataFrame, found: pd.DataFrame) -> harness.Tables:
    short, tables = [], {}
    for robot, splits in SPLITS.items():
        of_robot = rows[rows["robot"] == robot]
        for number, split in enumerate(ordered(splits, of_robot["split"])):
            own = of_robot[of_robot["split"] == split]
            for name, table in split_tables(own, number == 0).items():
                tables[", ".join(filter(None, (robot, split, name)))] = table
            own = own[own["model"] == EVGP]
            shares = own.groupby("joint").apply(pooled, "cr2", include_groups=False)
            line = {"arm": robot, "trained on": split, "ratio": f"{geometric(own['ratio']):.3f}"}
            line |= {"worst joint": f"{own.groupby('joint')['ratio'].mean().max():.2f}"}
            line |= {"CR-2 of joints": f"{shares.min():.3f} to {shares.max():.3f}"}
            short.append({**line, "seconds": f"{own['fit_seconds'].iloc[0]:.0f}"})
    tables = {"in short": pd.DataFrame(short), **tables}
    return tables | {"loads": loads_of(found), "friction": friction_of(found)} if len(found) else tables


def loads_of(found: pd.DataFrame) -> pd.DataFrame:
    """Return identified masses of loads with 95 % intervals."""
    known, lines = {loaded: mass for loaded, _, mass in LOADS}, []
    for row in found[found["name"] == "mass"].itertuples():
        low, high, mass = row.value - INTERVAL * row.std, row.value + INTERVAL * row.std, known[row.loaded]
        line = {"log": row.loaded, "arm known from": row.trained.replace("+", " + ")}
        line |= {"gain_scale": str(row.gain_scale), "mass, kg": f"{row.value:.3f}", "std": f"{row.std:.3f}"}
        line |= {"95 %": f"{low:.3f} to {high:.3f}", "width": f"{high - low:.3f}"}
        line |= {"true": "" if mass is None else f"{mass:.3f}"}
        lines.append({**line, "inside": "" if mass is None else "yes" if low <= mass <= high else "no"})
    return pd.DataFrame(lines)


def friction_of(found: pd.DataFrame) -> pd.DataFrame:
    """Return identified friction of the joints with 95 % intervals."""
    own = found[found["loaded"].isna()]
    names = {"known from": own["trained"].str.replace("+", " + "), "": own["name"].str.partition("(")[0]}
    own = own.assign(**names, text=own["value"].map("{:.2f} ± ".format) + (INTERVAL * own["std"]).map("{:.2f}".format))
    own["joint"] = "joint " + (own.groupby(list(names)).cumcount() + 1).astype(str)
    table = own.pivot(index=list(names), columns="joint", values="text")
    table = table.reindex(names["known from"].unique(), level=0).reset_index()
    return table[["", "known from", *table.columns[2:]]]


def plot_real(rows: pd.DataFrame, path: Path) -> None:
    """Draw ratios and shares within two standard deviations: a row of panels per arm, its splits in two colours."""
    robots = ordered(SPLITS, rows["robot"])
    size = (harness.WIDTH, 1.2 + 2.9 * len(robots))
    figure, axes = harness.pyplot().subplots(
        len(robots), 2, figsize=size, sharex="col", sharey="row", squeeze=False, width_ratios=(1.4, 1.0)
    )
    for (ratios, shares), robot in zip(axes, robots, strict=True):
        of_robot = rows[rows["robot"] == robot]
        names = [model for model in MODELS if (of_robot["model"] == model).any()]
        first = next(iter(SPLITS[robot]))
        for number, part in enumerate((of_robot["split"] == first, of_robot["split"] != first)):
            color, label = harness.PALETTE[number], SHARES[number]
            for place, model in enumerate(names):
                own = of_robot[part & (of_robot["model"] == model)]
                if own.empty:
                    continue
                height = place + 0.4 * (number - 0.5)
                errors = own["ratio"] if model != LEAST_SQUARES else own["ratio"][:0]
                bands = own[own["cr2"].notna()].groupby(["split", "joint"])[["cr2", "n_test"]]
                inside = pd.Series([pooled(joint, "cr2") for _, joint in bands], dtype=float)
                for panel, values, mean in ((ratios, errors, geometric), (shares, inside, np.mean)):
                    if len(values):
                        panel.plot(values, [height] * len(values), ".", color=color, alpha=0.3, markersize=5)
                        known = label in panel.get_legend_handles_labels()[1]
                        shown = None if known or panel is shares else label
                        panel.plot(mean(values), height, "so"[number], color=color, markeredgecolor="w", label=shown)
        ratios.set(yticks=range(len(names)), yticklabels=[TODAY.get(name, name) for name in names])
        ratios.set_ylim(len(names) - 0.5, -0.5)
        ratios.axvline(1.0, color="0.5", linewidth=0.8)
        ratios.set_title(robot.upper().replace("E", "e"), loc="left")
        shares.axvspan(0.9, 0.99, color="0.9", zorder=0)
        shares.axvline(0.954, color="0.5", linewidth=0.8)
    harness.logarithmic(axes[0, 0], "x")
    axes[-1, 0].set_xlabel("mean square error / least squares'")
    axes[-1, 1].set_xlabel("share of rows within ± 2 std")
    harness.legend(figure, ncols=2, title="trained on")
    harness.save_picture(figure, path)


def real(options: Any, output: Path) -> tuple[harness.Tables, int]:
    if options.data is None:
        raise SystemExit("--data is needed: a folder with the folders ur10e and ur10, or one of them")
    folder = options.data.resolve()
    cells = [
        Real(robot, split, model, options.size)
        for robot in SPLITS
        for split in splits_of(robot, folder, options.size)
        if tests_of(robot, split, folder)
        for model in MODELS
    ]
    if not cells:
        raise SystemExit(f"{options.data} has no logs of {' or '.join(SPLITS)}")
    n_failures = harness.run_missing(cells, partial(run_real, folder=folder), output, options.jobs)
    second = output.with_name(f"{output.stem}_parameters.csv")
    questions = questions_of(folder, options.size)
    n_failures += harness.run_missing(questions, partial(ask, folder=folder), second, options.jobs)
    rows, found = (harness.frame(path, size=options.size) for path in (output, second))
    plot_real(rows, output.with_suffix(".png"))
    return real_tables(rows, found), n_failures


# --- a simulated arm -----------------------------------------------------------------------------------------------

ROBOT, ERROR, NOISE = "ur10", 0.2, 0.02
FILTERS = {"none": None, "5 Hz": 5.0}
# Trajectories: base frequency in rad/s, number of harmonics, seconds, step.
BASE, HARMONICS, SECONDS, STEP = 2.0 * np.pi * 0.03, 8, 30.0, 0.01
# Coulomb friction (N m) and viscous friction (N m s/rad) as shares of the largest torque, or of 100 N m if less.
FRICTION, LARGEST = (0.02, 0.1), 100.0
STICTION = RigidBodyRegressor().stiction_velocity
TOLD = 0.25  # a share of the prior's variance

# One simulated arm, and the cutoff of the filter.
Simulated = namedtuple("Simulated", "cutoff seed size")


def trajectory(rng: np.random.Generator, n_joints: int, size: str) -> np.ndarray:
    """Return rows [q, q̇, q̈] of sums of sines."""
    t = np.arange(0.0, SECONDS / (3.0 if size == "quick" else 1.0), STEP)
    waves = BASE * np.arange(1, HARMONICS + 1)
    a, b = rng.normal(size=(2, HARMONICS, n_joints)) / (1.5 * np.arange(1, HARMONICS + 1)[:, np.newaxis])
    sines, cosines = np.sin(np.outer(t, waves)), np.cos(np.outer(t, waves))
    q = sines @ a + cosines @ b
    v = (cosines * waves) @ a - (sines * waves) @ b
    return np.hstack([q, v, -(sines * waves**2) @ a - (cosines * waves**2) @ b])


def arm(cell: Simulated) -> Bunch:
    """Return the nominal model, the true weights, training data, and test data without noise and filter."""
    rng = np.random.default_rng(cell.seed)
    nominal = load_robot(ROBOT)
    true = perturb_robot(nominal, ERROR, random_state=cell.seed)
    largest = np.minimum(nominal.upperEffortLimit, LARGEST)
    viscous, coulomb = (rng.uniform(*FRICTION, nominal.nv) * largest for _ in range(2))
    links = np.concatenate([link.toDynamicParameters() for link in list(true.inertias)[1:]])
    zero = np.zeros(nominal.nv)
    weights = np.concatenate([links, viscous, coulomb, zero, zero])
    features = RigidBodyRegressor(true).fit(np.zeros((1, 3 * nominal.nv)))

    def rows(noise: float) -> tuple[np.ndarray, np.ndarray]:
        X = trajectory(rng, nominal.nv, cell.size)
        torque = features.transform(X) @ weights
        return X, torque + noise * torque.std(axis=0) * rng.normal(size=torque.shape)

    parts = [rows(NOISE) for _ in range(2)]
    if FILTERS[cell.cutoff] is not None:
        parts = [filtered(X, y, FILTERS[cell.cutoff]) for X, y in parts]
    train = [np.concatenate(one) for one in zip(*parts, strict=True)]
    groups = np.repeat(np.arange(len(parts)), [len(X) for X, _ in parts])
    test = [np.concatenate(one) for one in zip(*(rows(0.0) for _ in range(2)), strict=True)]
    return Bunch(nominal=nominal, weights=weights, data=train[0], target=train[1], groups=groups, test=test)


def filtered(X: np.ndarray, y: np.ndarray, cutoff: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Write a log without accelerations and read it by `load_log`."""
    n = y.shape[1]
    table = np.column_stack([STEP * np.arange(len(X)), X[:, : 2 * n], y])
    columns = {"time": 0, "position": range(1, n + 1), "velocity": range(n + 1, 2 * n + 1)}
    columns["effort"] = range(2 * n + 1, 3 * n + 1)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "log.csv"
        np.savetxt(file, table, delimiter=",")
        return load_log(file, columns=columns, dt=STEP, cutoff=cutoff, rest_velocity=0.0, return_X_y=True)


def root_of(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return C with C Cᵀ = covariance, without its columns of zeros, and its pseudo-inverse."""
    scale = np.sqrt(np.diag(covariance))
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = eigenvalues > 1e-10 * eigenvalues.max()
    spread, vectors = np.sqrt(eigenvalues[kept]), vectors[:, kept]
    return scale[:, np.newaxis] * vectors * spread, (vectors / spread).T / scale


def told(arm: Bunch, model: InverseDynamics) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of identified combinations in standard deviations, and these as shares of the prior's."""
    _, covariance = model.feature_map_.coef_prior(arm.target.shape[1])
    _, whitening = root_of(covariance)
    variances, directions = np.linalg.eigh(whitening @ model.coef_cov_ @ whitening.T)
    std = np.sqrt(np.maximum(variances, 0.0))
    known = (variances < TOLD) & (variances > 0.0)
    error = directions.T @ whitening @ (model.coef_ - arm.weights)
    return error[known] / std[known], std[known]


def run_simulated(cell: Simulated) -> dict[str, Any]:
    """Identify one arm. ``fit_seconds`` is processor time of one thread."""
    one = arm(cell)
    model = InverseDynamics(one.nominal, n_inducing=0)
    seconds, _ = harness.timed(lambda: model.fit(one.data, one.target, groups=one.groups))
    z, width = told(one, model)
    X, truth = one.test
    H = model.feature_map_.transform(X)
    scatter = truth.std(axis=0)
    missed = rms(H @ model.coef_ - truth) / scatter
    # Without friction: torques of the identified links alone.
    links = 10 * truth.shape[1]
    of_links = H[:, :, :links] @ (model.coef_ - one.weights)[:links]
    return {
        "n_rows": len(one.data),
        "n_told": len(z),
        "covered": np.sum(np.abs(z) <= INTERVAL),
        "squares": np.sum(z**2),
        "width": np.median(width),
        "torque_error": np.sqrt(np.mean(missed**2)),
        "torque_error_worst": missed.max(),
        "links_error_worst": (rms(of_links) / scatter).max(),
        "cad_error_worst": (rms(H @ model.coef_prior_mean_ - truth) / scatter).max(),
        "correlation_time": np.mean(model.correlation_time_),
        "fit_seconds": seconds,
    }


def rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(values**2, axis=0))


def identification_tables(rows: pd.DataFrame) -> harness.Tables:
    runs = rows.fillna({"cutoff": "none"}).groupby("cutoff", sort=False)
    means, sums = runs.mean(numeric_only=True), runs.sum(numeric_only=True)
    shares = runs.apply(lambda own: own["covered"] / own["n_told"], include_groups=False).groupby("cutoff", sort=False)
    columns = {
        "runs": runs.size(),
        "combinations": means["n_told"].map("{:.1f}".format),
        "within 95 %": (sums["covered"] / sums["n_told"]).map("{:.3f}".format),
        "of runs": shares.min().map("{:.2f} to ".format) + shares.max().map("{:.2f}".format),
        "rms z": np.sqrt(sums["squares"] / sums["n_told"]).map("{:.2f}".format),
        "width": means["width"],
    }
    for header, name in {"torques": "torque", "links' torques": "links", "CAD's torques": "cad"}.items():
        errors = runs[f"{name}_error_worst"]
        columns[header] = errors.median().map("{:.2%}".format) + errors.max().map(" ({:.2%})".format)
    columns |= {"correlation time": means["correlation_time"].map("{:.1f}".format)}
    columns |= {"seconds": means["fit_seconds"].map("{:.1f}".format)}
    return {"identification": pd.DataFrame(columns).reset_index(names="filter")}


def identification(options: Any, output: Path) -> tuple[harness.Tables, int]:
    cells = [Simulated(cutoff, seed, options.size) for seed in options.seeds for cutoff in FILTERS]
    n_failures = harness.run_missing(cells, run_simulated, output, options.jobs)
    return identification_tables(harness.frame(output, size=options.size)), n_failures


# --- payloads ------------------------------------------------------------------------------------------------------

# A loaded log of the UR10e, whole and in fifths, of an arm known from other logs, joined by "+".
Weighed = namedtuple("Weighed", "trained gain_scale size")
# A simulated arm whose gains have errors with standard deviation ``gain_scale``. ``moves`` are alike or differ.
Carried = namedtuple("Carried", "gain_scale moves seed size")

FIFTHS, GAIN_SCALES, MOVES = 5, (0.0, 0.1), ("alike", "differ")
# Masses of simulated payloads, kg; relative differences of friction and gains between moves.
MASSES, OF_FRICTION, OF_GAINS = (1.0, 5.0), 0.05, 0.005
# Prior of the velocities of friction: median, rad/s, and standard deviation of the logarithm.
VELOCITIES = (0.015, 0.7)


def weigh(cell: Weighed, folder: Path) -> list[dict[str, Any]]:
    """Identify the payload of the UR10e from the whole log, and from each fifth of it."""
    loaded, _, mass = LOADS[0]
    train = rows_of("ur10e", cell.trained.split("+"), folder, cell.size)
    log = rows_of("ur10e", [loaded], folder, cell.size)
    arm = arm_of(urdf_of("ur10e", folder), cell.size == "quick", cell.gain_scale)
    with harness.one_thread():
        arm.fit(train.data, train.target, groups=train.groups)
        parts = {"whole": np.arange(len(log.data))}
        parts |= {f"{k + 1}/{FIFTHS}": own for k, own in enumerate(np.array_split(parts["whole"], FIFTHS))}
        found = {name: arm.estimate_payload(log.data[own], log.target[own]) for name, own in parts.items()}
    return [{"part": name, "true": mass, "value": one.mass, "std": one.mass_std} for name, one in found.items()]


def carry(cell: Carried) -> list[dict[str, Any]]:
    """Identify a simulated arm from three moves, and its payload from a fourth; returns errors of each quantity."""
    rng = np.random.default_rng(1000 + cell.seed)
    nominal, true = load_robot(ROBOT), perturb_robot(ROBOT, ERROR, random_state=cell.seed)
    n, largest = nominal.nv, np.minimum(nominal.upperEffortLimit, LARGEST)
    viscous, coulomb = (rng.uniform(*FRICTION, n) * largest for _ in range(2))
    velocity = VELOCITIES[0] * np.exp(VELOCITIES[1] * rng.normal(size=n))
    gains = 1.0 + cell.gain_scale * rng.normal(size=n)
    mass, com = rng.uniform(*MASSES), np.array([0.0, 0.0, 0.1]) + 0.05 * rng.normal(size=3)
    differ = float(cell.moves == "differ")

    def rows() -> tuple[np.ndarray, np.ndarray]:
        X = trajectory(rng, n, cell.size)
        body = RigidBodyRegressor(true, stiction_velocity=velocity).fit(X)
        links = np.concatenate([link.toDynamicParameters() for link in list(true.inertias)[1:]])
        rubbing = 1.0 + differ * OF_FRICTION * rng.normal(size=(2, n))
        friction = np.concatenate([rubbing[0] * viscous, rubbing[1] * coulomb, np.zeros(2 * n)])
        H = body.transform(X)
        own = gains * (1.0 + differ * OF_GAINS * rng.normal(size=n))
        clean = own * (H[:, :, : 10 * n] @ links) + H[:, :, 10 * n :] @ friction
        return X, clean + NOISE * clean.std(axis=0) * rng.normal(size=clean.shape)

    moves = [rows() for _ in range(3)]
    X, y = (np.concatenate(one) for one in zip(*moves, strict=True))
    true.inertias[true.njoints - 1] += pinocchio.Inertia(mass, com, 0.01 * np.eye(3))
    with harness.one_thread():
        model = InverseDynamics(nominal, gain_scale=cell.gain_scale, n_inducing=0)
        model.fit(X, y, groups=np.repeat(range(3), len(X) // 3))
        load = model.estimate_payload(*rows())
    weights = dict(zip(model.coef_names_, zip(model.coef_, model.coef_std_, strict=True), strict=True))
    found = [("mass", mass, load.mass, load.mass_std)]
    found += [("com", *one) for one in zip(com, load.com, load.com_std, strict=True)]
    for j, joint in enumerate(list(nominal.names)[1:]):
        found += [(f"gain {j + 1}", gains[j], model.gains_[j], model.gains_std_[j])] if cell.gain_scale else []
        for name, value in {"viscous": viscous[j], "coulomb": coulomb[j]}.items():
            found.append((f"{name} {j + 1}", value, *weights[f"{name}({joint})"]))
        # Intervals of velocities are those of their logarithms.
        name = f"stiction_velocity({joint})"
        value, std = model.theta_[name], model.theta_std_[name]
        found.append((f"log velocity {j + 1}", np.log(velocity[j]), np.log(value), std / value))
    return [{"part": name, "true": truth, "value": value, "std": std} for name, truth, value, std in found]


def payload_tables(weighed: pd.DataFrame, carried: pd.DataFrame) -> harness.Tables:
    """Return masses of the real load, and coverage of intervals of simulated arms and payloads."""
    tables = {}
    if len(weighed):
        lines = []
        for (trained, scale), own in weighed.groupby(["trained", "gain_scale"], sort=False):
            whole, parts = own[own["part"] == "whole"].iloc[0], own[own["part"] != "whole"]
            inside = (np.abs(own["value"] - own["true"]) <= INTERVAL * own["std"])[parts.index]
            line = {"arm known from": trained.replace("+", " + "), "gain_scale": str(scale)}
            line |= {"mass, kg": f"{whole['value']:.3f} ± {INTERVAL * whole['std']:.3f}"}
            line |= {"z": f"{(whole['value'] - whole['true']) / whole['std']:.2f}"}
            line |= {"fifths": f"{parts['value'].min():.2f} to {parts['value'].max():.2f}"}
            line |= {"their scatter": f"{parts['value'].std():.3f}", "their std": f"{parts['std'].mean():.3f}"}
            lines.append({**line, "intervals with the true mass": f"{inside.sum()} of {len(inside)}"})
        tables["UR10e"] = pd.DataFrame(lines)
    z = (carried["value"] - carried["true"]) / carried["std"]
    part = carried["part"].str.replace(r" \d+$", "", regex=True)
    rows = carried.assign(z=z, part=part, inside=np.abs(z) <= INTERVAL)
    groups = rows.groupby(["gain_scale", "moves", "part"], sort=False)
    table = groups.agg(
        arms=("seed", "nunique"),
        inside=("inside", "mean"),
        z=("z", lambda z: np.sqrt(np.mean(z**2))),
        std=("std", "median"),
    ).reset_index()
    table = table.assign(inside=text(table["inside"], 3), z=text(table["z"], 2))
    names = {"part": "quantity", "inside": "within 95 %", "z": "rms z", "std": "median std"}
    return tables | {"simulated": table.rename(columns=names)}


def payload(options: Any, output: Path) -> tuple[harness.Tables, int]:
    cells = [Carried(*cell, options.size) for cell in product(GAIN_SCALES, MOVES, options.seeds)]
    n_failures = harness.run_missing(cells, carry, output, options.jobs)
    second, weighed = output.with_name(f"{output.stem}_real.csv"), pd.DataFrame()
    if options.data is not None:
        folder = options.data.resolve()
        empty, three = LOADS[0][1], SPLITS["ur10e"]["three"]
        trained = [(empty,), *((name,) for name in three), three, (empty, *three)]
        known = ["+".join(names) for names in trained[: 1 if options.size == "quick" else None]]
        questions = [Weighed(names, scale, options.size) for names in known for scale in GAIN_SCALES]
        n_failures += harness.run_missing(questions, partial(weigh, folder=folder), second, options.jobs)
        weighed = harness.frame(second, size=options.size)
    return payload_tables(weighed, harness.frame(output, size=options.size)), n_failures


PARTS = {  # CSV, function, title
    "payload": ("payload", payload, "Payloads and friction of arms"),
    "real": ("real_arms", real, "Torques of real arms"),
    "identification": ("identification", identification, "Identification of a simulated arm"),
}


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="few rows, iterations and trees", seeds=50)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--data", type=Path, help="of real arms: a folder with the folders ur10e and ur10")
    options = harness.parse(parser)
    name, measure, title = PARTS[options.part]
    output = harness.output_path(options, name)
    tables, n_failures = measure(options, output)
    harness.write_page(title, tables, output, n_failures)


if __name__ == "__main__":
    main()
