"""
Gravity features of a robot's links
===================================

For each link, ``LinkGravity`` computes the torque of gravity about the link's own axis, for a unit mass on a unit
lever. One feature is for a lever along u_x, another for one along u_y. The weights stand for masses and centres of
mass. Here least squares fits the weights to random poses of two arms. A test on a new swing shows where the features
are exact, where they are approximate, and where they fail. Run ``python examples/plot_link_gravity.py --help`` for
options.
"""

# %%
# Options
# -------

import argparse
import os
import sys
from pathlib import Path

import numpy as np
from sklearn.linear_model import LinearRegression

from skevgp.datasets import load_robot, simulate
from skevgp.features import LinkGravity

parser = argparse.ArgumentParser(description="Gravity's features of two arms against its torque.")
parser.add_argument("--seed", type=int, default=0, help="of the random poses; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
n_poses, n_steps = (200, 20) if quick else (2000, 50)

# %%
# Simulate two arms
# -----------------
# The data are random poses, and a swing from rest without motors. The true value is Pinocchio's generalised gravity,
# the torque that holds the arm still.

try:
    import matplotlib.pyplot as plt
    import pinocchio

    plt.style.use("skevgp.plotting.page")
    robots = {name: load_robot(name) for name in ("iiwa14", "ur5")}
except (ImportError, ValueError) as error:
    sys.exit(f"error: {error}\nThis example needs: pip install pin example-robot-data matplotlib")


def torque(robot, positions):
    data = robot.createData()
    return np.array([pinocchio.computeGeneralizedGravity(robot, data, q) for q in positions])


def rows(positions):
    """Return rows [q, q̇, u] at rest."""
    return np.hstack([positions, np.zeros((len(positions), 2 * positions.shape[1]))])


rng = np.random.RandomState(options.seed)
starts = {"iiwa14": [0.0, 1.2, 0.5, -0.9, 0.4, 1.0, 0.0], "ur5": [0.0, -1.2, 0.9, -0.6, 0.4, 0.0]}
poses, swings = {}, {}
for name, start in starts.items():
    n = len(start)
    poses[name] = rng.uniform(-np.pi, np.pi, (n_poses, n))
    swings[name] = simulate(name, np.r_[start, np.zeros(n)], np.zeros((n_steps, n)))[:, :n]
times = 0.03 * np.arange(n_steps + 1)

# %%
# Fit the torque at a joint
# -------------------------
# The paper's formula has the lever u_x only. The frames of the model decide which lever matters. The links of iiwa14
# lie along u_y. Those of UR5 turn about y and lie along u_x.


def along_the_swing(name, joint, **levers):
    """Return the fitted weights (kg m) and the torque (N m) along the swing."""
    robot = robots[name]
    features = LinkGravity(robot, **levers)
    fit = LinearRegression(fit_intercept=False).fit(
        features.fit_transform(rows(poses[name])), torque(robot, poses[name])[:, joint]
    )
    return fit.coef_, fit.predict(features.transform(rows(swings[name])))


X_ALONE, X_AND_Y = {"axes": "x"}, {"axes": "xy"}
cases = [
    ("iiwa14", "q6", {"u_x": X_ALONE, "u_x and u_y": X_AND_Y}),
    ("iiwa14", "q4", {"u_x": X_ALONE, "u_x and u_y": X_AND_Y}),
    ("iiwa14", "q2", {"u_x": X_ALONE, "u_x and u_y": X_AND_Y}),
    ("ur5", "elbow_joint", {"u_x, own link": {"axes": "x", "links": ["elbow_joint"]}, "u_x": X_ALONE}),
    ("ur5", "shoulder_lift_joint", {"u_x, own link": {"axes": "x", "links": ["shoulder_lift_joint"]}, "u_x": X_ALONE}),
]
print(f"gravity's torque along a swing of {times[-1]:.1f} s; weights from {n_poses} random poses, seed {options.seed}")
print(f"{'robot, joint':28s}{'torque rms (N m)':>17s}   {'features':22s}{'error rms (N m)':>15s}{'share':>8s}")
curves = {}
for name, joint, choices in cases:
    index = list(robots[name].names).index(joint) - 1
    truth = torque(robots[name], swings[name])[:, index]
    size = np.sqrt(np.mean(truth**2))
    curves[name, joint] = {"gravity's torque": truth}
    for label, levers in choices.items():
        _, curve = along_the_swing(name, index, **levers)
        error = np.sqrt(np.mean((curve - truth) ** 2))
        curves[name, joint][label] = curve
        print(f"{name + ', ' + joint:28s}{size:17.3f}   {label:22s}{error:15.3f}{error / size:8.1%}")

# %%
# Compare a weight with mass times lever
# --------------------------------------
# Only link 7 follows joint 6 of iiwa14. Its centre of mass lies on its own axis, at a fixed place of link 6. The
# weights are minus the first moment of both links about the joint, because the holding torque is minus the torque of
# gravity.

weights, _ = along_the_swing("iiwa14", 5, links=["q6"])
arm = robots["iiwa14"]
moment = arm.inertias[6].mass * arm.inertias[6].lever
moment += arm.inertias[7].mass * arm.jointPlacements[7].act(arm.inertias[7].lever)
print(f"weight of u_y at iiwa14's q6: {weights[1]:.4f} kg m; the model's mass times lever: {moment[1]:.4f} kg m")

# %%
# Plot the swing
# --------------
# The features are exact at q6 of iiwa14, where the one later link has a fixed place. They are also exact at UR5's
# shoulder, where the later joints turn about parallel axes. At q2 of iiwa14, other axes turn in the frame of link 2,
# and no weights fit. A Gaussian process has to learn this residual.

figure, axes = plt.subplots(2, 2, figsize=(8, 5.6), sharex=True)
features = LinkGravity("iiwa14", links=["q6"])
for values, colour, label in zip(
    features.fit_transform(rows(swings["iiwa14"])).T, ("#D55E00", "#0072B2"), ("u_x", "u_y"), strict=True
):
    axes[0, 0].plot(times, values, color=colour, label=f"gravity(q6, {label})")
axes[0, 0].set_title("iiwa14: the two features of link 6")
axes[0, 0].set_ylabel("feature (m/s²)")
styles = {
    "gravity's torque": {"color": "0.7", "linewidth": 5},
    "u_x": {"color": "#D55E00"},
    "u_x and u_y": {"color": "#0072B2", "linestyle": "--"},
    "u_x, own link": {"color": "#009E73", "linestyle": ":", "linewidth": 2},
}
for ax, case, title in (
    (axes[0, 1], ("iiwa14", "q6"), "iiwa14, q6: exact with u_x and u_y"),
    (axes[1, 0], ("iiwa14", "q2"), "iiwa14, q2: no weights are exact"),
    (axes[1, 1], ("ur5", "shoulder_lift_joint"), "UR5, shoulder lift: exact with all links"),
):
    for label, curve in curves[case].items():
        ax.plot(times, curve, label=label, **styles[label])
    ax.set_title(title)
    ax.set_ylabel("torque (N m)")
for ax in axes.flat:
    ax.axhline(0.0, color="0.85", linewidth=0.8, zorder=0)
    ax.legend()
for ax in axes[1]:
    ax.set_xlabel("time (s)")

options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / "link_gravity.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
