"""
Track references with a learned torque model
============================================

An iiwa14 tracks references by computed torque. Its model has no load and no friction, so it makes errors.
``InverseDynamics`` learns the torques from a minute of the arm's own log. All joints share masses and friction, with
the nominal model as prior, and a Gaussian process learns the residual. The reference is known in advance, so one batch
predicts all torques, and the controller adds them.

The standard deviations of the torques are useful too. Moves are made as fast as torque limits allow. If only the mean
is below the limits, most moves exceed them. If the mean plus k standard deviations is below the limits, they hold, and
moves take slightly longer.

``computed_torque.py`` next to this file simulates the arm. Run ``python examples/plot_tracking.py --help`` for options.
"""

# %%
# Options
# -------

import argparse
import os
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
import computed_torque as arms
from computed_torque import DT, ComputedTorque

parser = argparse.ArgumentParser(description="Track references with a load that the model does not know.")
parser.add_argument("--payload", type=float, default=3.0, help="in the hand, kg; default: %(default)s")
parser.add_argument("--limit", type=float, default=0.35, help="share of the motors' torques; default: %(default)s")
parser.add_argument("--chance", type=float, default=0.95, help="that a move keeps the limits; default: %(default)s")
parser.add_argument("--seed", type=int, default=0, help="of arm, references and models; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
n_runs, seconds, n_inducing, n_moves = (3, 4.0, 10, 20) if quick else (6, 10.0, 40, 150)

# %%
# Learn from the log
# ------------------
# The arm moves along some waves, inaccurately, and sensors measure the torques. The prior is the nominal model with a
# load of unknown mass, up to a few kg.

try:
    import matplotlib.pyplot as plt
    import pinocchio as pin

    plt.style.use("skevgp.plotting.page")
    from skevgp.datasets import load_robot
    from skevgp.robots import RigidBody

    arm, nominal = arms.make_arm(options.payload, options.seed), RigidBody(load_robot("iiwa14"))
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs Pinocchio and matplotlib: pip install pin matplotlib")
log = arms.track(arm, ComputedTorque(nominal, arms.waves(n_runs, seconds, options.seed + 1)), options.seed)
X, y, groups = arms.log_of(log)
model = arms.learner(n_inducing=n_inducing, max_rows=1500, random_state=options.seed).fit(X, y, groups=groups)

# %%
# Track new references
# --------------------

reference = arms.waves(1, 4.0 if quick else 8.0, options.seed + 2)
feedforward = arms.missed_by(nominal, model, reference)
runs = {
    "nominal model": arms.track(arm, ComputedTorque(nominal, reference), options.seed),
    "with the learned torques": arms.track(arm, ComputedTorque(nominal, reference, feedforward), options.seed),
}
errors = {name: 1e3 * np.sqrt(np.mean(run.error**2)) for name, run in runs.items()}
for name, error in errors.items():
    print(f"{name:22s} rms error of joints {error:6.2f} mrad")

# %%
# Move as fast as the limits allow
# --------------------------------
# By Boole's inequality, the probability that a move exceeds a limit is at most the sum over joints and steps. This is
# cautious. The margin helps with accelerations that were not in the log, where standard deviations of the model are too
# small.

limits = options.limit * arm.effort
n_joints = len(limits)
k = arms.cautious(options.chance, n_joints, n_steps=400)  # of moves that take 2 s or less
starts, ends = arms.positions(n_moves, options.seed + 3)
planned = {width: arms.fastest(model, starts, ends, limits, width) for width in (0.0, k)}
decided = np.logical_and(*(chosen for _, chosen in planned.values()))  # by torques
if not decided.any():
    sys.exit("error: no move is decided by the limits of torques; another --limit, please.")
starts, ends, tried = starts[decided], ends[decided], {}
for width, (durations, _) in planned.items():
    durations = durations[decided]
    path = arms.moves(starts, ends, durations, durations.max() + DT)
    run = arms.track(arm, ComputedTorque(nominal, path, arms.missed_by(nominal, model, path)), options.seed)
    moving = (DT * np.arange(len(path))[:, np.newaxis] < durations)[:, :, np.newaxis]
    tried[width] = durations, path, run.torque, np.where(moving, np.abs(run.torque) / limits, 0.0).max(axis=(0, 2))
    broken = np.mean(tried[width][3] > 1.0)
    print(f"mean + {width:3.1f} std: {broken:4.0%} of {len(starts)} moves break a limit, {durations.mean():.2f} s each")

# %%
# Plot the results
# ----------------
# The lower row shows one move that exceeds a limit if only the mean is below it. Intervals are wide where joints stand
# still, at both ends, because friction may have any value up to Coulomb's.

blue, orange, grey = "#0072B2", "#D55E00", "0.35"
colours = dict(zip(runs, (orange, blue), strict=True))
figure, ((of_path, of_peaks), one_move) = plt.subplots(2, 2, figsize=(8, 6.2))
data = nominal.model.createData()


def tip(q):
    """Return the position of the last joint, m."""
    places = []
    for row in q:
        pin.forwardKinematics(nominal.model, data, row)
        places.append(data.oMi[n_joints].translation.copy())
    return np.array(places)


times, wanted = DT * np.arange(len(reference)), reference[:, 0]
desired = tip(wanted[:, :n_joints])
part = times < 4.0
of_path.plot(*desired[part, 1:].T, color=grey, linewidth=5, alpha=0.35, label="reference")
for name, run in runs.items():
    place = tip(wanted[:, :n_joints] + run.error[:, 0])
    off = 1e3 * np.linalg.norm(place - desired, axis=1)
    label = f"{name}: {np.sqrt(np.mean(off**2)):.2g} mm rms off"
    of_path.plot(*place[part, 1:].T, color=colours[name], linewidth=1.3, label=label)
of_path.set(title="The hand, seen from the front", xlabel="y (m)", ylabel="z (m)")
low, high = of_path.get_ylim()
of_path.set_ylim(low, high + 0.4 * (high - low))  # below the legend
of_path.legend(loc="upper right")

# Without caution: the median of the moves that exceed a limit, at the joint, step and side where it does.
by_peak = np.argsort(tried[0.0][3])
move = by_peak[(np.searchsorted(tried[0.0][3][by_peak], 1.0) + len(by_peak)) // 2]
over = np.abs(tried[0.0][2][:, move]) / limits
over[round(tried[0.0][0][move] / DT) :] = 0.0
step, joint = np.unravel_index(over.argmax(), over.shape)
side, shown = np.sign(tried[0.0][2][step, move, joint]), []
for ax, (width, (durations, path, torque, _)) in zip(one_move, tried.items(), strict=False):
    until = round(durations[move] / DT)
    t, measured = DT * np.arange(until), side * torque[:until, move, joint]
    mean, std = (part[:, joint] for part in model.predict(path[:until, move], return_std=True))
    ax.plot(t, side * mean, color=blue, label="predicted mean")
    ax.fill_between(
        t, side * mean - k * std, side * mean + k * std, color=blue, alpha=0.25, linewidth=0, label=f"± {k:.1f} std"
    )
    ax.plot(t, measured, ".", color=grey, markersize=2, label="measured")
    beyond = measured > limits[joint]
    ax.plot(
        t[beyond], measured[beyond], "o", color=orange, markersize=4, label="over the limit" if beyond.any() else None
    )
    ax.axhline(limits[joint], color="k", linestyle="--", linewidth=1)
    what = f"mean + {width:.1f} std" if width else "the mean"
    ax.set(title=f"One move: {what} within the limit", xlabel=f"time (s), {durations[move]:.2f} s in all")
    ax.set(ylabel=f"torque of joint {joint + 1} (N m)")
    shown.append(side * mean - k * std)
low = min(values.min() for values in shown)
for ax in one_move:
    ax.set_ylim(low, limits[joint] + 0.12 * (limits[joint] - low))
figure.legend(*one_move[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)

bins = np.linspace(*np.percentile(np.concatenate([each[3] for each in tried.values()]), (0, 100)), 25)
for (width, (*_, peak)), colour in zip(tried.items(), (orange, blue), strict=True):
    what = f"mean + {width:.1f} std" if width else "mean"
    label = f"{what}: {np.mean(peak > 1.0):.0%} above"
    of_peaks.hist(peak, bins, color=colour, alpha=0.6, label=label)
of_peaks.axvline(1.0, color="k", linestyle="--", linewidth=1)
of_peaks.set(title=f"Largest torque of {len(starts)} moves", xlabel="share of the limit", ylabel="number of moves")
of_peaks.yaxis.get_major_locator().set_params(integer=True)
of_peaks.margins(y=0.35)  # above which the legend is
of_peaks.legend(loc="upper left")

options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / "tracking.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
