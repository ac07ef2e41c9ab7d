"""
An acrobot that learns to stand up
==================================

An acrobot is a double pendulum with a motor at the elbow only. It hangs, and it must swing up and stand on its
shoulder, which has no motor. Its masses and inertias are unknown. It first moves at random for 10 s. Then it learns a
model of the next state (EVGP-IFG: inertia, force and the sine of gravity as features), plans swing-ups on the model,
and tries them. Each try gives more data for the next model and the next plans.

To stand, the feedback needs accurate derivatives of the model at the top. A slope that is wrong by some percent makes
it fall. So half of the tries start near the top, and the feedback is computed for the whole posterior: functions that
``sample_functions`` draws have different slopes, and the gain has the lowest expected cost over all of them.

Robot, limits and noise are those of the simulated benchmark RealAIGym. The page :doc:`/guide/realaigym` has the scores.
The simulation is in ``double_pendulum.py`` and the controllers are in ``follow_plans.py``, both next to this file.
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
from double_pendulum import DRIVEN, LENGTHS, LIMIT, STEP, Plants, Truth, is_upright, simulate_plants, study
from follow_plans import Follower

parser = argparse.ArgumentParser(description="Let an acrobot learn to stand up.")
parser.add_argument("--robot", choices=sorted(DRIVEN), default="acrobot", help="default: %(default)s")
parser.add_argument("--model", choices=("IFG", "GP", "URDF", "parameters"), default="IFG", help="default: %(default)s")
parser.add_argument("--seed", type=int, default=0, help="of data, models and first plans; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
stages, n_inducing, seconds = (10.0, 20.0, 40.0), 120, 5.0
if os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1":
    stages, n_inducing, seconds = (5.0, 8.0), 20, 2.5
n_steps = round(seconds / STEP)

# %%
# Learn, plan and try
# -------------------
# After each stage, the robot swings up once without disturbances. The true equations of the robot only simulate it and
# measure errors: neither the model nor the plans use them.

try:
    import matplotlib.pyplot as plt

    plt.style.use("skevgp.plotting.page")
    tries = []
    for stage in study(options.robot, options.model, options.seed, stages, n_inducing):
        follower = Follower(stage.library, 1, STEP)
        states, torques = simulate_plants(Plants(options.robot), follower, np.zeros((1, 4)), n_steps=n_steps)
        rows = np.column_stack([stage.plans.Z[0, :-1], stage.plans.U[0]])
        mean, std = stage.model.predict(rows, return_std=True)
        error = mean - Truth(Plants(options.robot)).predict(rows)
        stage.update(states=states[:, 0], torques=torques[:, 0], stands=bool(is_upright(states[-1])[0]))
        stage.update(error=np.sqrt((error[:, 2:] ** 2).mean()), std=np.sqrt((std[:, 2:] ** 2).mean()))
        tries.append(stage)
        print(
            f"{stage.seconds:3.0f} s of data, learned in {stage.fit_seconds:.1f} s: it "
            f"{'stands' if stage.stands else 'falls'}. Velocities along the plan are wrong by {stage.error:.3f} rad/s, "
            f"and the predicted std is {stage.std:.3f}",
            flush=True,
        )
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs matplotlib, and Pinocchio for a URDF: pip install matplotlib pin")

# %%
# Plot the last try
# -----------------
# Poses are those of the last try, from hanging to standing. Below, each line is the angle of the first link after so
# many seconds of data. Errors are those of the velocities 0.01 s later along the plan.

last = tries[-1]
times = STEP * np.arange(n_steps)
figure = plt.figure(figsize=(8, 4.6))
strip, bottom = figure.subfigures(2, 1, height_ratios=(0.55, 1.0))
ax = strip.subplots()
for place, frame in enumerate(np.linspace(0, min(2.4 / STEP, n_steps - 1), 13).astype(int)):
    first, second = np.cumsum(last.states[frame, :2])
    elbow = LENGTHS[0] * np.array([np.sin(first), -np.cos(first)])
    tip = elbow + LENGTHS[1] * np.array([np.sin(second), -np.cos(second)])
    xs, ys = 0.75 * place + np.array([0.0, elbow[0], tip[0]]), np.array([0.0, elbow[1], tip[1]])
    ax.plot(xs, ys, color="#0072B2", linewidth=3, solid_capstyle="round", zorder=2)
    ax.plot(xs[:2], ys[:2], "o", color="0.4", markersize=5, zorder=3)
    ax.text(0.75 * place, -0.68, f"{times[frame]:.1f} s", ha="center")
ax.set(aspect="equal", ylim=(-0.72, 0.56), title=f"The {options.robot} after {last.seconds:g} s of data")
ax.axis("off")

left, middle, right = bottom.subplots(1, 3)
colours = plt.colormaps["viridis_r"](np.linspace(0.15, 0.95, len(tries)))
for stage, colour in zip(tries, colours, strict=True):
    label = f"{stage.seconds:g} s: {'stands' if stage.stands else 'falls'}"
    left.plot(times, stage.states[:-1, 0], color=colour, label=label)
for turn in (-1.0, 1.0):
    left.axhline(turn * np.pi, color="0.3", linestyle=":", zorder=0)
left.set(title="First link", xlabel="time (s)", ylabel="angle from hanging (rad)", ylim=(-17.0, 5.0))
left.legend(title="data", loc="lower left")
middle.plot(times, last.torques, color="#D55E00")
middle.set(title="Last try", xlabel="time (s)", ylabel="torque (N m)", ylim=(-1.1 * LIMIT, 1.1 * LIMIT))
seconds = [stage.seconds for stage in tries]
right.plot(seconds, [stage.error for stage in tries], "o-", color="#0072B2", label="error")
right.plot(seconds, [stage.std for stage in tries], "o:", color="0.4", label="predicted std")
right.set(title="Velocity after 0.01 s", xlabel="data (s)", ylabel="rms along the plan (rad/s)", yscale="log")
right.yaxis.set_major_formatter("{x:g}")
right.legend()

options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / f"{options.robot}.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
