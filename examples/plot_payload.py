"""
Estimate the payload of an arm
==============================

The torques of a robot depend on the body that it carries. First, ``InverseDynamics.estimate_payload`` finds the mass
and the centre of mass of the body, from a log with it and a log without it. Intervals shrink with more data. The second
part works online: the arm picks up the body while it moves. An ``EVGPRegressor`` whose torques share one set of weights
follows by ``partial_fit``.

Pass the folder of a real arm's logs, ``python examples/plot_payload.py DATA_DIR``. Without a folder, an arm is
simulated. Run ``python examples/plot_payload.py --help`` for options.
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
import warnings
from pathlib import Path

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.preprocessing import FunctionTransformer

from skevgp import CoefPrior, EVGPRegressor, InverseDynamics
from skevgp.datasets import load_log, load_robot, perturb_robot
from skevgp.exceptions import DependentRowsWarning
from skevgp.features import RigidBodyRegressor

sys.path.insert(0, str(Path(__file__).resolve().parent))

UNLOADED, LOADED = "14harm50sec", "14harm50secLoad"
UR10E_GAINS, UR10E_LOAD = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47], 2.805  # of its catalogue, N m/A; weighed, kg

parser = argparse.ArgumentParser(description="Mass and centre of mass of what an arm carries, from logs and online.")
parser.add_argument("data", type=Path, nargs="?", help="folder of a real arm's logs; default: simulate an arm")
parser.add_argument("--mass", type=float, default=2.8, help="of the simulated body, kg; default: %(default)s")
parser.add_argument("--seed", type=int, default=0, help="of the simulated arm and the models; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
if not options.mass > 0.0:
    parser.error("--mass must be above 0")
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
duration = 8.0 if quick else 30.0
scratch = tempfile.TemporaryDirectory()

# %%
# Read logs with and without the load
# -----------------------------------
# The simulated arm is a UR10. Masses, centres of mass and inertias of its model are wrong by up to 20 %. Its motors
# give about 5 % less torque than the catalogue says. In a third log, the arm picks up the body half-way. The friction
# of the gears grows with the load, as in harmonic drives, and no weight of the model describes that.
#
# With right gains (``gain_scale=0``), 95 % intervals contained mass and centre of mass 12 times of 16, in four such
# pairs of 20 s. In six pairs whose friction did not grow, they did 24 times of 24.

try:
    import matplotlib.pyplot as plt

    plt.style.use("skevgp.plotting.page")
    from simulated_arm import CATALOGUE_GAINS, with_payload, write_log

    columns = {"time": 0, "position": range(1, 7), "velocity": range(7, 13), "current": range(13, 19)}
    folder, gains, com = options.data, UR10E_GAINS, None
    if options.data is None:
        truth, folder, gains = load_robot("ur10"), Path(scratch.name), CATALOGUE_GAINS
        robot, mass, com = perturb_robot(truth, 0.2, random_state=options.seed), options.mass, [0.02, 0.05, 0.06]
        heavy, seed, change = with_payload(truth, mass, com), 10 * options.seed, duration / 2.0
        write_log(folder / f"{UNLOADED}.csv.gz", truth, duration, seed)
        write_log(folder / f"{LOADED}.csv.gz", heavy, duration, seed + 1)
        write_log(folder / "picked_up.csv.gz", truth, duration, seed + 2, loaded=heavy, change=change)
    else:
        robot, mass = load_robot(next(folder.glob("*.urdf"), folder / "robot.urdf")), UR10E_LOAD
    joints = list(robot.names)[1:]
    files = [next(folder.glob(f"*{name}.csv*"), folder / f"{name}.csv") for name in (UNLOADED, LOADED)]
    unloaded, loaded = (load_log(file, columns=columns, joints=joints, gains=gains) for file in files)
    online = load_log(folder / "picked_up.csv.gz", columns=columns, gains=gains) if com else None
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs: pip install pin example-robot-data matplotlib")
except (ValueError, OSError) as error:
    sys.exit(f"error: {error}")
scratch.cleanup()

# %%
# Estimate the load from more and more data
# -----------------------------------------
# With ``gain_scale=0``, an error of the gains becomes an error of the mass, and the interval does not include it. If
# motors give 5 % less than the catalogue, the load seems 5 % too heavy. With ``gain_scale=0.1``, each gain is uncertain
# by about 10 %, and the interval of the mass includes that. ``n_inducing=0`` leaves out the Gaussian process, because
# only weights are needed.

lengths = np.linspace(2.0, loaded.time[-1] - loaded.time[0], 2 if quick else 9)
models, found = {}, {}
print(f"{'':24s}{'seconds':>8s}{'mass (kg)':>17s}   centre of mass (mm, in the last joint's frame)")
for gain_scale in (0.0, 0.1):
    model = InverseDynamics(robot, gain_scale=gain_scale, n_inducing=0).fit(
        unloaded.data, unloaded.target, pieces=unloaded.pieces
    )
    models[gain_scale] = model
    found[gain_scale] = []
    for seconds in lengths:
        rows = loaded.time <= loaded.time[0] + seconds
        load = model.estimate_payload(loaded.data[rows], loaded.target[rows], pieces=loaded.pieces[rows])
        found[gain_scale].append(load)
        places = "  ".join(f"{1e3 * c:6.1f} ± {1.96e3 * s:5.1f}" for c, s in zip(load.com, load.com_std, strict=True))
        print(f"gain_scale={gain_scale:<13g}{seconds:8.1f}{load.mass:9.3f} ± {1.96 * load.mass_std:5.3f}   {places}")
print(f"{'truth':32s}{mass:9.3f}{'' if com is None else f'           {1e3 * np.array(com)}'}")

# %%
# Estimate the load online
# ------------------------
# The posterior of the arm is the prior. The last link may get any ten parameters that a body of some kg would add. Each
# batch has five rows of half a second. ``partial_fit`` adds it exactly and in milliseconds. At each batch, the past is
# multiplied by the forgetting factor. With 0.8, the last 2.5 s matter. The Gaussian process has velocities as inputs
# only. With positions, it would explain part of the load.
#
# The gains are not estimated here, so the load seems about 5 % too heavy, as above. The intervals assume a constant
# mass. Just after a change they are too narrow, while old rows still count.


def velocities(X):
    return X[:, len(joints) : 2 * len(joints)]


followed, step = {}, 5
if online is not None:
    last = 10 * (len(joints) - 1)
    of_the_last = range(last, last + 10)
    known = models[0.0]
    prior = known.coef_cov_.copy()
    prior[of_the_last, of_the_last] += (3.0 * np.repeat([1.0, 0.1, 0.01], [1, 3, 6])) ** 2
    X, y = online.data[::10], online.target[::10]
    times = online.time[::10][step - 1 :: step]
    for factor in (1.0, 0.8):
        follower = EVGPRegressor(
            RigidBodyRegressor(robot),
            kernel_map=FunctionTransformer(velocities),
            coef_prior=CoefPrior(mean=known.coef_, cov=prior),
            n_inducing=10 if quick else 20,
            max_iter=20,
            random_state=options.seed,
        )
        with warnings.catch_warnings():
            # Only the weights are needed, so the tolerance is large.
            warnings.simplefilter("ignore", ConvergenceWarning)
            warnings.simplefilter("ignore", DependentRowsWarning)
            follower.fit(unloaded.data[::10], unloaded.target[::10])
        weights = []
        for start in range(0, len(times) * step, step):
            follower.partial_fit(X[start : start + step], y[start : start + step], forgetting_factor=factor)
            weights.append((follower.coef_[last] - known.coef_[last], follower.coef_std_[last]))
        followed[factor] = np.array(weights).T
        ends = " to ".join(f"{followed[factor][0, k]:.2f}" for k in (0, -1))
        print(f"online, forgetting factor {factor:g}: mass of the load from {ends} kg")

# %%
# Plot mass and centre of mass
# ----------------------------

figure, axes = plt.subplots(2 if online is None else 3, 1, figsize=(8, 5 if online is None else 7.2))
colours = ("#D55E00", "#0072B2", "#009E73")
for (gain_scale, loads), colour, shift in zip(found.items(), colours, (-0.15, 0.15), strict=False):
    masses, deviations = np.array([(load.mass, load.mass_std) for load in loads]).T
    label = f"gain_scale={gain_scale:g}"
    axes[0].errorbar(lengths + shift, masses, 1.96 * deviations, fmt="o", color=colour, capsize=3, label=label)
axes[0].axhline(mass, color="k", linewidth=1, label="truth")
axes[0].set_ylabel("mass (kg)")
axes[0].set_title("The load, with 95 % intervals of the model")
for axis, colour in enumerate(colours):
    middle, half = 1e3 * np.array([(load.com[axis], 1.96 * load.com_std[axis]) for load in found[0.1]]).T
    axes[1].errorbar(
        lengths + 0.15 * (axis - 1), middle, half, fmt="o", color=colour, capsize=3, label=f"{'xyz'[axis]}"
    )
    if com:
        axes[1].axhline(1e3 * com[axis], color=colour, linewidth=1)
axes[1].set_ylabel("centre of mass (mm)")
axes[1].set_title("gain_scale=0.1" + (", and the truth as lines" if com else ""))
axes[1].set_xlabel("length of the log with the load (s)")
axes[1].sharex(axes[0])
for (factor, (load, deviation)), colour in zip(followed.items(), colours, strict=False):
    axes[2].plot(times, load, color=colour, label=f"forgetting_factor={factor:g}")
    axes[2].fill_between(times, load - 2 * deviation, load + 2 * deviation, color=colour, alpha=0.3, linewidth=0)
if followed:
    axes[2].step([0.0, change, online.time[-1]], [0.0, 0.0, mass], "k", linewidth=1, label="truth")
    axes[2].axvline(change, color="k", linestyle=":", linewidth=1)
    axes[2].set_title("Online: the arm picks the load up (dotted line)")
    axes[2].set_ylabel("mass (kg)")
    axes[2].set_xlabel("time (s)")
for ax in axes:
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))

options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / ("payload.png" if online is not None else "payload_measured.png")
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
