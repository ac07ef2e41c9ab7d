"""
Use a wrong model as a prior
============================

The URDF file of a robot is rarely exact. Here each mass, centre of mass, inertia and rotor inertia of the arm iiwa14 is
wrong by up to 20 %. ``NominalDynamics`` uses the accelerations of this model as features, and the prior mean of their
weights is Δt. Data correct the weights, and a Gaussian process learns the residual. The other model,
InertiaForceGravity (IFG), has rough physics without any mass. Run ``python examples/plot_nominal_dynamics.py --help``
for options.
"""

# %%
# Options
# -------

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np
from scipy.special import erf
from sklearn.pipeline import make_union

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics, perturb_robot
from skevgp.features import InertiaForce, InertiaForceGravity, NominalDynamics
from skevgp.metrics import containing_ratios, prediction_error, std_norm
from skevgp.plotting import CoefficientDisplay
from skevgp.solvers import LBFGS

parser = argparse.ArgumentParser(description="Learn the arm iiwa14 with a wrong model as prior.")
parser.add_argument(
    "--scale", type=float, default=0.2, help="largest relative error of the model; default: %(default)s"
)
parser.add_argument("--seed", type=int, default=0, help="of data, errors and models; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
sizes, n_inducing = ((5, 10), 15) if quick else ((10, 20, 40, 80, 160), 50)

# %%
# Simulate moves of the arm
# -------------------------

try:
    import matplotlib.pyplot as plt

    plt.style.use("skevgp.plotting.page")
    train = make_dynamics("iiwa14", sizes[-1], random_state=options.seed)
    test = make_dynamics("iiwa14", 20, random_state=options.seed + 1000)
    wrong = perturb_robot("iiwa14", options.scale, random_state=options.seed)
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs Pinocchio and matplotlib: pip install pin matplotlib")
except ValueError as error:
    sys.exit(f"error: {error}")
n_joints = train.target.shape[1] // 2

# %%
# Fit both models to more and more data
# -------------------------------------
# With ``tol=10``, L-BFGS stops when an iteration gains less than 10 nats, of some hundred thousand. The default takes
# several times as long, for slightly smaller errors. Rows of a move are alike, so ``groups`` identifies the moves.
# Held-out moves then determine noise and signal.

names = "IFG", "IF + nominal"
features = InertiaForceGravity("iiwa14"), make_union(InertiaForce("iiwa14"), NominalDynamics(wrong))
results = {name: [] for name in names}
predictions, models = {}, {}

print(f"iiwa14: {len(test.data)} test rows, model wrong by up to {options.scale:.0%}, seed {options.seed}")
settings = {"n_inducing": n_inducing, "n_jobs": -1, "random_state": options.seed}
columns = ("Error", "median", "‖STD‖", "CR-1", "CR-2", "CR-3", "seconds")
print(f"{'moves':>5s} {'rows':>6s}  {'':13s}", *(f"{name:>8}" for name in columns))
for size in sizes:
    rows = train.groups < size
    for name, feature_map in zip(names, features, strict=True):
        model = EVGPRegressor(feature_map, solver=LBFGS(tol=10.0), **settings)
        start = time.perf_counter()
        model.fit(train.data[rows], train.target[rows], groups=train.groups[rows])
        seconds = time.perf_counter() - start
        mean, std = model.predict(test.data, return_std=True)
        errors = np.linalg.norm(test.target - mean, axis=1)
        results[name].append(errors.mean())
        predictions[name], models[name] = (mean, std), model  # of the largest size at the end
        ratios = containing_ratios(test.target, mean, std)
        print(
            f"{size:5d} {rows.sum():6d}  {name:13s}",
            *(f"{value:8.5f}" for value in (errors.mean(), np.median(errors), std_norm(std))),
            *(f"{ratio:8.3f}" for ratio in ratios),
            f"{seconds:8.2f}",
            flush=True,
        )

# %%
# The prior mean of the second model needs no data. It is Euler's rule with the accelerations of the wrong model.

nominal = models["IF + nominal"]
untrained = nominal.feature_map_.transform(test.data) @ nominal.coef_prior_mean_.T
untrained_error = prediction_error(test.target, untrained)
velocities, accelerations = np.arange(n_joints, 2 * n_joints), np.arange(-n_joints, 0)
weights = nominal.coef_[velocities, accelerations]
print(f"the wrong model without data: Error {untrained_error:.5f}")
print("weights of the nominal accelerations, as multiples of Δt:", *(f"{weight:.2f}" for weight in weights / test.dt))

# %%
# Plot errors and weights
# -----------------------
# The weights remain within about 20 % of Δt.

colours = dict(zip(names, ("C1", "C0"), strict=True))
figure, axes = plt.subplots(2, 2, figsize=(8, 6.2))

ax = axes[0, 0]
for name, marker in zip(names, "so", strict=True):
    ax.loglog(sizes, results[name], marker=marker, color=colours[name], label=name)
ax.axhline(untrained_error, color="0.4", linestyle="--", label="wrong model, no data")
ax.set_ylim(top=5 * ax.get_ylim()[1])  # room for the legend
ax.set_xticks(sizes, sizes)
ax.minorticks_off()
ax.set_xlabel("training moves of 50 steps")
ax.set_ylabel("Error (rad, rad/s)")
ax.set_title("Error on new moves")

ax = axes[0, 1]
k = np.linspace(0.0, 4.0, 41)[1:]
for name in names:
    ax.plot(k, containing_ratios(test.target, *predictions[name], k=k), color=colours[name], label=name)
ax.plot(k, erf(k / np.sqrt(2.0)), "k--", linewidth=1, label="calibrated")
ax.set_ylim(0.0, 1.02)
ax.set_xlabel("k (standard deviations)")
ax.set_ylabel("share of truths within k std")
ax.set_title(f"Calibration after {sizes[-1]} moves")

ax = axes[1, 0]
output = n_joints + np.argmax(test.target[:, n_joints:].std(axis=0))
move = test.groups == 0
seconds = test.dt * (1 + np.arange(move.sum()))
for name in names:
    mean, std = (part[move, output] for part in predictions[name])
    ax.plot(seconds, np.abs(mean - test.target[move, output]), color=colours[name], label=name)
    ax.plot(seconds, 2 * std, color=colours[name], linestyle=":", label=f"{name}: 2 std")
ax.set_yscale("log")
ax.yaxis.set_major_formatter("{x:g}")
ax.set_ylim(top=20 * ax.get_ylim()[1])  # room for the legend
ax.set_xlabel("time (s)")
ax.set_ylabel(f"|error| of {test.target_names[output]} (rad/s)")
ax.set_title("One-step errors along a test move")

ax = axes[1, 1]
parts = (nominal.coef_, nominal.coef_std_, nominal.coef_prior_mean_, nominal.coef_prior_scale_)
CoefficientDisplay(
    [f"acc(q{joint + 1})" for joint in range(n_joints)],
    *(part[velocities, accelerations] / test.dt for part in parts),
).plot(ax=ax)
ax.set_ylim(bottom=-2.0)  # room for the legend
ax.set_xlabel("weight for the joint's velocity, divided by Δt")
ax.set_title("Weights of the nominal accelerations")

for ax, place in zip(axes.flat, ("upper right", "lower right", "upper left", "lower center"), strict=True):
    ax.legend(loc=place, ncols=2 if ax is axes[1, 0] else 1)
options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / "nominal_dynamics.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
