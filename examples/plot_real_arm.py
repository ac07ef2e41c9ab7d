"""
Learn torques of a real arm from its logs
=========================================

A robot's log has positions, velocities and motor currents. The URDF file of its maker has rough masses and no friction.
From both, ``InverseDynamics`` learns the torques with standard deviations, and finds masses and friction with
intervals. Here it is compared with the URDF alone and with least squares, on a new trajectory.

Pass the folder of a real arm's logs, ``python examples/plot_real_arm.py DATA_DIR``. Without a folder, an arm is
simulated. Run ``python examples/plot_real_arm.py --help`` for options.
"""

# %%
# Options
# -------
# The folder of a real arm has a URDF file and tables with the names below, without a header. The columns are time, six
# positions, six velocities and six currents. Further columns are ignored.

import argparse
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from skevgp import InverseDynamics
from skevgp.datasets import load_log, load_robot, perturb_robot
from skevgp.features import RigidBodyRegressor
from skevgp.plotting import SignalsDisplay

sys.path.insert(0, str(Path(__file__).resolve().parent))

TRAINING = {"20sec_8harm": 20.0, "30sec_12harm": 30.0, "40sec_12harm": 40.0}  # and how long to simulate, s
NEW = {"50sec_12harm": 40.0}
UR10E_GAINS = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]  # of its catalogue: torque per current, N m/A

parser = argparse.ArgumentParser(description="Torques, masses and friction of an arm from its own logs.")
parser.add_argument("data", type=Path, nargs="?", help="folder of a real arm's logs; default: simulate an arm")
parser.add_argument("--seed", type=int, default=0, help="of the simulated arm and the model; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the pictures; default: examples/output",
)
options = parser.parse_args()
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
settings = {"n_inducing": 10, "max_rows": 300, "max_iter": 15} if quick else {}
scratch = tempfile.TemporaryDirectory()

# %%
# Read the URDF and the logs
# --------------------------
# The simulated arm is a UR10. Masses, centres of mass and inertias of its model are wrong by up to 20 %. Its gears have
# viscous friction, and Coulomb friction that grows with the load. Currents have 2 % noise, and motors give about 5 %
# less torque than the catalogue says. The models below get the log only.

try:
    import matplotlib.pyplot as plt

    plt.style.use("skevgp.plotting.page")
    from simulated_arm import CATALOGUE_GAINS, write_log

    if options.data is None:
        truth, folder, gains = load_robot("ur10"), Path(scratch.name), CATALOGUE_GAINS
        robot = perturb_robot(truth, 0.2, random_state=options.seed)
        for seed, (name, seconds) in enumerate((TRAINING | NEW).items(), start=100 * options.seed):
            write_log(folder / f"{name}.csv.gz", truth, min(seconds, 8.0) if quick else seconds, seed)
    else:
        truth, folder, gains = None, options.data, UR10E_GAINS
        robot = load_robot(next(folder.glob("*.urdf"), folder / "robot.urdf"))
    joints = list(robot.names)[1:]
    columns = {"time": 0, "position": range(1, 7), "velocity": range(7, 13), "current": range(13, 19)}
    files = {name: next(folder.glob(f"*{name}.csv*"), folder / f"{name}.csv") for name in TRAINING | NEW}
    train, new = (
        load_log([files[name] for name in names], columns=columns, joints=joints, gains=gains)
        for names in (TRAINING, NEW)
    )
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs: pip install pin example-robot-data matplotlib")
except (ValueError, OSError) as error:
    sys.exit(f"error: {error}")
scratch.cleanup()
print(f"{robot.name}, {'simulated' if truth else 'its logs'}: {len(train.data)} rows of {len(TRAINING)} trajectories")

# %%
# Plot the processed signals
# --------------------------
# Signals are interpolated to a grid of 10 ms and filtered at 5 Hz, forwards and backwards, so that there is no delay.
# Accelerations are differences of the filtered velocities.

options.output.mkdir(parents=True, exist_ok=True)
stem = "real_arm" if options.data is None else "real_arm_measured"
elbow = 2
SignalsDisplay.from_log(train, joints=[elbow]).figure_.savefig(options.output / f"{stem}_signals.png")

# %%
# Predict torques in three ways
# -----------------------------
# The first two models have the same features: the torque is linear in masses, first moments, inertias and friction.
# ``gain_scale`` allows gains to differ from the catalogue by about 10 %. Rows of a log depend on each other, so
# ``groups`` identifies the files.

body = RigidBodyRegressor(robot)
features, features_new = body.fit_transform(train.data), body.transform(new.data)
cad, _ = body.coef_prior(len(joints))
least_squares = np.linalg.lstsq(features.reshape(-1, len(cad)), train.target.ravel(), rcond=None)[0]
model = InverseDynamics(robot, gain_scale=0.1, random_state=options.seed, **settings)
model.fit(train.data, train.target, groups=train.groups, pieces=train.pieces)
mean, std = model.predict(new.data, return_std=True)
predictions = {"URDF": features_new @ cad, "least squares": features_new @ least_squares, "InverseDynamics": mean}
errors = {
    name: np.mean((new.target - torque) ** 2, axis=0) / new.target.var(axis=0) for name, torque in predictions.items()
}
print("mean squared error over the torque's variance, on a new trajectory:")
print(f"{'':16s}", *(f"{joint.removesuffix('_joint'):>13s}" for joint in joints))
for name, error in errors.items():
    print(f"{name:16s}", *(f"{value:13.4f}" for value in error))
inside = (np.abs(new.target - mean) < 2.0 * std).mean(axis=0)
print(f"{'within 2 std':16s}", *(f"{value:13.3f}" for value in inside))

# %%
# Look at masses and friction
# ---------------------------
# Torques do not determine all masses. Examples are the mass of a link that turns about the vertical, and how two links
# share a mass. For these, the interval is that of the prior, around the value of the URDF. Any linear function of the
# weights has an interval, such as the torque that holds the stretched arm. The friction of the simulated gears grows
# with the load, so it has no single true value. It is in the units of the measured torques, with the gains of the
# catalogue.

n_inertial = 10 * len(joints)
holding = body.transform(np.zeros((1, 3 * len(joints))))[0]
holding[:, n_inertial:] = 0.0
asked = {name: row for name, row in zip(model.coef_names_, np.eye(len(cad)), strict=True) if name.startswith("m(")}
asked |= {f"holds the stretched arm({joints[joint]})": holding[joint] for joint in (1, 2)}
friction = [name for name in model.coef_names_ if name.startswith(("coulomb(", "viscous("))]
asked |= {name: (model.coef_names_ == name).astype(float) for name in friction}
units = {"m": "kg", "v": "N m s", "c": "N m", "h": "N m"}
true_weights = RigidBodyRegressor(truth).coef_prior(len(joints))[0] if truth else None
prior_cov = body.coef_prior(len(joints))[1]


def interval(row, mean, covariance):
    """Return the mean of row @ weights, and half the width of its 95 % interval."""
    return np.array([row @ mean, 1.96 * np.sqrt(row @ covariance @ row)])


print(f"\n{'':46s}{'unit':7s}{'URDF, prior':>17s}{'found':>19s}{'truth' if truth else '':>10s}")
for name, row in asked.items():
    before, after = interval(row, cad, prior_cov), interval(row, model.coef_, model.coef_cov_)
    known = f"{row @ true_weights:10.3f}" if truth and name not in friction else ""
    print(f"{name:46s}{units[name[0]]:7s}{before[0]:8.2f} ± {before[1]:6.2f}{after[0]:10.3f} ± {after[1]:6.3f}{known}")

# %%
# Plot torques, errors and parameters
# -----------------------------------
# The URDF alone has gravity, but no friction. The interval is two standard deviations of InverseDynamics on each side
# of its mean. The other intervals hold 95 %.

figure, ((of_torque, of_errors), (of_masses, of_friction)) = plt.subplots(2, 2, figsize=(8, 6.2))
colours = {"URDF": "#D55E00", "least squares": "#999999", "InverseDynamics": "#0072B2"}
window = slice(0, 1000)
# No line reaches across a gap or rest: one row less there.
seconds = np.where(np.diff(new.pieces, prepend=new.pieces[0]) == 0, new.time, np.nan)[window]
of_torque.plot(seconds, predictions["URDF"][window, elbow], color=colours["URDF"], linewidth=1)
of_torque.plot(seconds, new.target[window, elbow], "k", linewidth=1, label="measured")
band = mean[window, elbow] + 2.0 * np.array([[-1.0], [1.0]]) * std[window, elbow]
of_torque.fill_between(seconds, *band, color=colours["InverseDynamics"], alpha=0.5, linewidth=0)
of_torque.set(title="The elbow on a new trajectory", xlabel="time (s)", ylabel="torque (N m)")

short = [joint.removesuffix("_joint").replace("_", "\n") for joint in joints]
places = np.arange(len(joints))
for (name, error), marker in zip(errors.items(), "s^o", strict=True):
    of_errors.plot(places, error, marker, color=colours[name], label=name)
of_errors.set(title="Errors on the new trajectory", ylabel="mean squared error / variance", yscale="log")
for ax, start, title, unit in (
    (of_masses, "m(", "Masses of the links", "mass (kg)"),
    (of_friction, "coulomb(", "Coulomb's friction", "torque (N m)"),
):
    rows = [row for name, row in asked.items() if name.startswith(start)]
    before, after = (
        np.array([interval(row, *of) for row in rows]).T for of in ((cad, prior_cov), (model.coef_, model.coef_cov_))
    )
    if start == "m(":
        ax.errorbar(places - 0.22, *before, fmt="s", color=colours["URDF"], capsize=3)
    shift = 0.22 * (start == "m(")
    ax.errorbar(places + shift, *after, fmt="o", color=colours["InverseDynamics"], capsize=3)
    if truth and start == "m(":
        ax.plot(places, [row @ true_weights for row in rows], "kx", label="truth")
    ax.set(title=title, ylabel=unit)
    ax.set_ylim(bottom=0.0)
for ax in (of_errors, of_masses, of_friction):
    ax.set_xticks(places, short)
    ax.set_xlim(-0.5, len(joints) - 0.5)
handles = [*of_torque.get_lines()[1:], *of_errors.get_lines(), *of_masses.get_lines()[-1:]]
handles = [handle for handle in handles if not handle.get_label().startswith("_")]
figure.legend(handles, [handle.get_label() for handle in handles], loc="outside lower center", ncols=5)

picture = options.output / f"{stem}.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
