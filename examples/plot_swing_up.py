"""
Swing a pole up with a model learned from seconds of data
=========================================================

A cart on a rail swings up its pole and balances it, without known masses and lengths. Models of the next state are
learned from seconds of random moves. One has rough physics (EVGP-IFG: inertia, force and the sine of gravity as
features), the other has none. Then iLQR plans again at each step. It needs predictions and their Jacobians along a
plan, and ``compile()`` computes thousands of them per second.

The simulation waits for each plan. On one core, a plan takes about as long as a step of 0.03 s. The output shows the
mean time. So this planner in Python is at the limit of real time: on a robot, each plan must end within its step. A
shorter horizon or fewer iterations make plans faster.

The planner is in ``mpc.py`` next to this file, and Pinocchio simulates the system. Run ``python
examples/plot_swing_up.py --system pendulum`` for a pendulum with a weak motor, and ``--help`` for options.
"""

# %%
# Options
# -------

import argparse
import dataclasses
import os
import sys
import time
from pathlib import Path

import numpy as np

from skevgp.solvers import LBFGS

sys.path.insert(0, str(Path(__file__).resolve().parent))
from mpc import DT, NEAR, TASKS, learn, swing_up

SECONDS = {"pendulum": 1.5, "cartpole": 4.5}

parser = argparse.ArgumentParser(description="Swing a pole up with a model learned from seconds of data.")
parser.add_argument("--system", choices=sorted(TASKS), default="cartpole", help="default: %(default)s")
parser.add_argument("--seconds", type=float, help="of data; default: 4.5 on the cartpole, 1.5 on the pendulum")
parser.add_argument("--noise", type=float, default=0.0, help="on all states, as a share of their std; default: 0")
parser.add_argument("--seed", type=int, default=0, help="of data, models and first plans; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
task, settings = TASKS[options.system], {}
if os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1":
    task = dataclasses.replace(task, n_steps=134, caution=0.0)
    settings = {"n_inducing": 50, "solver": LBFGS(tol=10.0)}
seconds = SECONDS[task.system] if options.seconds is None else options.seconds

# %%
# Learn and swing up
# ------------------
# Data are short trajectories from random states with random inputs. The planner does not know the equations of the
# system. It starts at rest with a hanging pole. The limit of the force is 100 N. The motor of the pendulum has 2 N m,
# and 4.9 N m would hold it level.

try:
    import matplotlib.pyplot as plt
    from matplotlib.patches import Rectangle

    plt.style.use("skevgp.plotting.page")
    learned, runs = {}, {}
    for name, physics in (("EVGP-IFG", True), ("without physics", False)):
        start = time.perf_counter()
        learned[name] = learn(task.system, seconds, physics, options.noise, options.seed, **settings)
        middle = time.perf_counter()
        fast = learned[name].model.compile(include_noise=False)
        runs[name] = run = swing_up(fast, task, learned[name].noise, options.seed)
        end = time.perf_counter()
        away = np.flatnonzero(run.distance >= NEAR)[-1] + 1
        print(
            f"{name:15s} {len(learned[name].data.data)} rows learned in {middle - start:.1f} s; "
            + (f"upright from {away * DT:.2f} s on" if run.success else "not upright")
            + f"; {(end - middle) / task.n_steps * 1e3:.0f} ms per plan, and {DT * 1e3:.0f} ms per step",
            flush=True,
        )
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs Pinocchio and matplotlib: pip install pin matplotlib")
except ValueError as error:
    sys.exit(f"error: {error}")

# %%
# Plot the swing-up, the plans and the errors
# -------------------------------------------
# Each plan starts at a true state. If a thin line leaves the thick one of its colour, the model was wrong or the plan
# changed. The side on which the pole comes up is random. One step ahead, most errors should be below two standard
# deviations.

colours = {"EVGP-IFG": "#0072B2", "without physics": "#D55E00"}
has_cart = task.system == "cartpole"
push = "force (N)" if has_cart else "torque (N m)"


def draw(ax, state, u, center):
    """Draw the system in a state, around a position on the page."""
    x = state[0] if has_cart else 0.0
    pole = state[task.pole]
    # The cartpole's axis points at us, the pendulum's away from us.
    tip = center + x + (1.0 if has_cart else -1.0) * 0.5 * np.sin(pole), -0.5 * np.cos(pole)
    ax.plot([center + x, tip[0]], [0.0, tip[1]], color="0.2", linewidth=2.5, solid_capstyle="round", zorder=3)
    ax.plot(*tip, "o", color=colours["EVGP-IFG"], markersize=7, zorder=4)
    if not has_cart:
        ax.plot(center, 0.0, "o", color="0.5", markersize=6, zorder=4)
    else:
        ax.plot([center - 0.65, center + 0.65], [-0.07, -0.07], color="0.8", linewidth=1, zorder=1)
        ax.add_patch(Rectangle((center + x - 0.16, -0.07), 0.32, 0.14, facecolor="0.6", zorder=2))
        if abs(u) > 0.1 * task.limit:
            arrow = {"arrowstyle": "-|>", "color": "#D55E00", "linewidth": 1.5, "shrinkA": 0, "shrinkB": 0}
            ax.annotate("", (center + x + 0.45 * u / task.limit, 0.0), (center + x, 0.0), arrowprops=arrow, zorder=5)


shown = runs["EVGP-IFG"]
times = DT * np.arange(task.n_steps + 1)
until = np.flatnonzero(shown.distance >= NEAR)[-1] if shown.success else task.n_steps - 1
frames = np.linspace(0, min(until + 10, task.n_steps - 1), 12).astype(int)

figure = plt.figure(figsize=(8, 6.4))
strip, middle, bottom = figure.subfigures(3, 1, height_ratios=(0.6, 1.2, 1.0))
ax = strip.subplots()
for place, frame in enumerate(frames):
    draw(ax, shown.states[frame], shown.inputs[frame, 0], 1.5 * place)
    ax.text(1.5 * place, -1.0, f"{times[frame]:.2f} s", ha="center")
ax.set(aspect="equal", xlim=(-0.9, 1.5 * len(frames) - 0.6), ylim=(-1.1, 0.65))
ax.axis("off")
ax.set_title(f"EVGP-IFG, learned from {seconds:g} s of data" + (", with the force that acts" if has_cart else ""))

ax = middle.subplots()
for name, run in runs.items():
    for step in range(0, task.n_steps, 8):
        plan = run.plans[step][:, task.pole]
        ax.plot(DT * (step + np.arange(len(plan))), plan, color=colours[name], alpha=0.4, linewidth=0.8)
    label = f"{name}: {'upright' if run.success else 'not upright'} in the last second"
    style = "-" if name == "EVGP-IFG" else "--"  # they may lie on each other
    ax.plot(times, run.states[:, task.pole], style, color=colours[name], linewidth=2.5, label=label)
    turns = np.round((run.states[-1, task.pole] / np.pi - 1.0) / 2.0)
    ax.axhline(np.pi * (1.0 + 2.0 * turns), color="0.3", linestyle=":", zorder=0)
ax.plot([], [], color="0.3", alpha=0.4, linewidth=0.8, label="plans")
ax.plot([], [], color="0.3", linestyle=":", label="upright")
ax.set(title="Plans and what happened", xlabel="time (s)", xlim=(0.0, times[-1]))
ax.set_ylabel("pole's angle from hanging (rad)")
ax.legend(loc="center right")

left, right = bottom.subplots(1, 2)
for name, run in runs.items():
    style = "-" if name == "EVGP-IFG" else "--"
    left.step(times[:-1], run.inputs[:, 0], style, where="post", color=colours[name], label=name)
    mean, std = learned[name].model.predict(np.hstack([run.states[:-1], run.inputs]), return_std=True)
    error = np.abs(mean - run.states[1:])[:, -1]
    right.plot(times[1:], error, color=colours[name], linewidth=1)
    right.plot(times[1:], 2.0 * std[:, -1], color=colours[name], linestyle=":")
right.plot([], [], "k", linewidth=1, label="|error|")
right.plot([], [], "k:", label="2 std")
left.set(title="What the controller did", xlabel="time (s)", ylabel=push, xlim=(0.0, times[-1]))
right.set(title="Errors one step ahead", xlabel="time (s)", ylabel="pole's velocity (rad/s)", yscale="log")
right.yaxis.set_major_formatter("{x:g}")
right.set_xlim(0.0, times[-1])
left.legend()
right.legend()

options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / f"swing_up_{task.system}.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
