"""
Learn any robot's dynamics
==========================

A robot's name, or the path of its URDF file, is enough for simulations and features. This example uses the arm UR5 of
the package example-robot-data. Cross-validation over moves compares four models. The first is a sparse Gaussian process
alone. The others have features: inertia and force (IF), also gravity on the links (IFG), and a URDF file with wrong
masses. Run ``python examples/plot_any_robot.py --robot acrobot`` for another robot, and ``--help`` for options.
"""

# %%
# Options
# -------

import argparse
import os
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.metrics import make_scorer
from sklearn.model_selection import GroupKFold, cross_validate
from sklearn.pipeline import make_union

from skevgp import EVGPRegressor
from skevgp.datasets import list_robots, load_robot, make_dynamics, perturb_robot
from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, NominalDynamics
from skevgp.metrics import containing_ratios, prediction_error
from skevgp.plotting import PosteriorDisplay
from skevgp.robots import layout_of
from skevgp.solvers import LBFGS

parser = argparse.ArgumentParser(description="Learn a robot's dynamics from its URDF file and simulated moves.")
parser.add_argument("--robot", default="ur5", help="a name of list_robots() or the path of a URDF file; default: ur5")
parser.add_argument("--trajectories", type=int, help="for cross-validation; default: 60")
parser.add_argument("--seed", type=int, default=0, help="of data and models; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
n_trajectories = (30 if quick else 60) if options.trajectories is None else options.trajectories
n_folds, n_inducing, sharing = (2, 15, "all") if quick else (3, 30, "none")

# %%
# Simulate moves under computed-torque control
# --------------------------------------------

try:
    import matplotlib.pyplot as plt

    plt.style.use("skevgp.plotting.page")
    robot = load_robot(options.robot)
    moves = make_dynamics(options.robot, n_trajectories, random_state=options.seed)
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs: pip install pin example-robot-data matplotlib")
except ValueError as error:
    sys.exit(f"error: {error}")
n_joints = moves.target.shape[1] // 2
print(f"{robot.name}, one of {len(list_robots())} known robots: joints {', '.join(list(robot.names)[1:])}")
print(f"{n_trajectories} moves, {len(moves.data)} rows of {moves.data.shape[1]} columns, seed {options.seed}")

# %%
# Define four models
# ------------------
# The kernel of the last three models has sines and cosines of the angles as inputs, since the change of state is
# periodic in the angles. A Gaussian process alone predicts the angles themselves, which are not periodic. The masses,
# centres of mass and inertias of the URDF file are wrong by up to 20 %. Shoulder and wrist differ, so each output has
# its own kernel and inducing points. ``tol=10`` ends the search early, a few nats below the maximum of the bound.

wrong = perturb_robot(robot, 0.2, random_state=options.seed)
settings = {"n_inducing": n_inducing, "sharing": sharing, "solver": LBFGS(tol=10.0)}
settings |= {"n_jobs": -1, "random_state": options.seed}
encoded = settings | {"kernel_map": AngleEncoder(robot)}
models = {
    "GP alone": EVGPRegressor(**settings),
    "IF": EVGPRegressor(InertiaForce(robot), **encoded),
    "IFG": EVGPRegressor(InertiaForceGravity(robot), **encoded),
    "IF + wrong URDF": EVGPRegressor(make_union(InertiaForce(robot), NominalDynamics(wrong)), **encoded),
}

# %%
# Cross-validate over moves
# -------------------------
# ``GroupKFold`` keeps all rows of a move together, because neighbouring rows are alike. CR-2 is the share of true
# values within two standard deviations. The right value is 0.954. ``fit`` also gets the moves (``params``), and sets
# noise and signal on held-out moves.

splits = {"groups": moves.groups, "cv": GroupKFold(n_folds), "return_estimator": True, "return_indices": True}
splits["params"] = {"groups": moves.groups}
scoring = make_scorer(prediction_error, greater_is_better=False)
constant = moves.data[:, : 2 * n_joints].copy()
constant[:, :n_joints] += moves.dt * constant[:, n_joints:]
print(f"{'':20s}{'Error':>9s}{'its folds':>20s}{'CR-2':>8s}{'seconds':>9s}")
print(f"{'constant velocity':20s}{prediction_error(moves.target, constant):9.5f}")
predictions = {}
for name, model in models.items():
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ConvergenceWarning)
        folds = cross_validate(model, moves.data, moves.target, scoring=scoring, **splits)
    seconds = time.perf_counter() - start
    mean, std = np.empty_like(moves.target), np.empty_like(moves.target)
    for fitted, rows in zip(folds["estimator"], folds["indices"]["test"], strict=True):
        mean[rows], std[rows] = fitted.predict(moves.data[rows], return_std=True)
    predictions[name] = mean, std
    errors, ratio = -folds["test_score"], containing_ratios(moves.target, mean, std, k=2)[0]
    around = f"{errors.min():.5f} to {errors.max():.5f}"
    print(f"{name:20s}{errors.mean():9.5f}{around:>20s}{ratio:8.3f}{seconds:9.2f}", flush=True)
    for message in sorted({str(warning.message).partition(". ")[0] for warning in caught}):
        print(f"    a fit warned: {message}")

# %%
# Predict a new move
# ------------------
# The plot shows the change of two joint velocities in one step. These joints move the most.

rows = moves.groups == 0
seconds = moves.dt * (1 + np.arange(rows.sum()))
change = (moves.target - constant)[:, n_joints:]
joints = np.sort(np.argsort(change[rows].std(axis=0))[-2:])
figure, axes = plt.subplots(len(joints), 2, figsize=(8, 2.6 * len(joints)), sharex=True, squeeze=False)
for row, joint in zip(axes, joints.tolist(), strict=True):
    velocity = n_joints + joint
    for ax, name in zip(row, ("IFG", "IF + wrong URDF"), strict=True):
        mean, std = (part[rows, velocity] for part in predictions[name])
        now, after = moves.data[rows, velocity], moves.target[rows, velocity]
        PosteriorDisplay(seconds, mean - now, std, after - now).plot(ax, label="predicted")
        ax.set_title(f"{robot.names[joint + 1]}: {name}")
    row[1].sharey(row[0])
    unit = "rad/s" if layout_of(robot).revolute[joint] else "m/s"
    row[0].set_ylabel(f"change in {moves.dt} s ({unit})")
figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
for ax in axes[-1]:
    ax.set_xlabel("time (s)")

options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / f"any_robot_{robot.name}.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
