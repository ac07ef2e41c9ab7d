"""
Plan with Crocoddyl on a learned model
======================================

`Crocoddyl <https://github.com/loco-3d/crocoddyl>`_ plans motions of robots by differential dynamic programming (FDDP).
It needs the next state and its derivatives in state and input. ``compile()`` of a fitted model computes both, so the
``ActionModel`` is short. Here FDDP swings up a pole on a model learned from seconds of data. The simulated system then
runs the plan with and without the feedback gains of FDDP. A rollout of the model predicts the errors in advance.

Run ``python examples/plot_crocoddyl.py --system pendulum`` for a pendulum with a weak motor, and ``--help`` for
options.
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

sys.path.insert(0, str(Path(__file__).resolve().parent))
from mpc import DT, LAST, NEAR, TASKS, learn
from skevgp import rollout
from skevgp.datasets import simulate
from skevgp.features import AngleEncoder

SECONDS = {"pendulum": 1.5, "cartpole": 4.5}
# Number of steps for the swing-up.
FIRST = {"pendulum": 100, "cartpole": 50}

parser = argparse.ArgumentParser(description="Swing a pole up with Crocoddyl, on a model learned from data.")
parser.add_argument("--system", choices=sorted(TASKS), default="cartpole", help="default: %(default)s")
parser.add_argument("--seconds", type=float, help="of data; default: 4.5 on the cartpole, 1.5 on the pendulum")
parser.add_argument("--seed", type=int, default=0, help="of data, model and particles; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
task = dataclasses.replace(TASKS[options.system], n_steps=134) if quick else TASKS[options.system]
seconds = SECONDS[task.system] if options.seconds is None else options.seconds
n_particles = 20 if quick else 100

try:
    import crocoddyl
    import matplotlib.pyplot as plt
    import pinocchio  # noqa: F401

    plt.style.use("skevgp.plotting.page")
except ImportError as error:
    packages = "pip install pin crocoddyl matplotlib"
    sys.exit(f"error: {error}\nThis example needs Pinocchio, Crocoddyl and matplotlib: {packages}")

# %%
# Define an action model for Crocoddyl
# ------------------------------------
# ``calc`` computes the next state and the cost. ``calcDiff`` computes their derivatives at the same point. The cost is
# half the sum of squares of ``r``, so its second derivatives are Gauss-Newton approximations.


class LearnedAction(crocoddyl.ActionModelAbstract):
    """A step of a learned system, with the cost of the distance from a goal.

    Parameters
    ----------
    model : CompiledPredictor
        Predictor for rows [state, input].
    task : Task
        Goal and limit of the input.
    weights : array-like
        Weights of the encoded row, which has sines and cosines instead of angles.
    """

    def __init__(self, model, task, weights):
        self.model, self.weights, self.goal = model, np.array(weights), np.array(task.goal)
        n_states = len(task.last_weights) - 1
        super().__init__(crocoddyl.StateVector(n_states), 1, len(self.goal))
        self.encoder = AngleEncoder(task.system).fit(np.zeros((1, n_states + 1)))
        self.u_lb, self.u_ub = np.array([-task.limit]), np.array([task.limit])

    def calc(self, data, x, u=None):
        """Compute next state and cost. Without an input, at the end of the horizon, the state does not change."""
        row = np.append(x, 0.0 if u is None else u)
        data.xnext = x if u is None else self.model.predict(row)
        data.r = self.weights * (self.encoder.transform(row[np.newaxis])[0] - self.goal)
        data.cost = 0.5 * data.r @ data.r

    def calcDiff(self, data, x, u=None):
        row, n = np.append(x, 0.0 if u is None else u), len(x)
        if u is not None:
            _, slopes = self.model.value_and_jacobian(row)
            data.Fx, data.Fu = slopes[:, :n], slopes[:, n:]
        by_row = self.weights[:, np.newaxis] * self.encoder.jacobian(row[np.newaxis])[0]
        gradient, curvature = by_row.T @ data.r, by_row.T @ by_row
        data.Lx, data.Lu = gradient[:n], gradient[n:]
        data.Lxx, data.Lxu, data.Luu = curvature[:n, :n], curvature[:n, n:], curvature[n:, n:]


# %%
# Learn the model and plan
# ------------------------
# Data are short trajectories from random states with random inputs. FDDP can start from an impossible motion. Here the
# pole is upright from the first step, and iterations close the gaps between steps. From rest at the bottom it would
# stay there, because hanging is stationary. The box version of FDDP keeps the limit of the motor. The first plan is
# short, because FDDP finds detours in long ones. The final plan starts from the first one.

try:
    start = time.perf_counter()
    learned = learn(task.system, seconds, True, seed=options.seed)
except ValueError as error:
    sys.exit(f"error: {error}")
fast = learned.model.compile(include_noise=False)
print(f"{len(learned.data.data)} rows learned in {time.perf_counter() - start:.1f} s", flush=True)

each_step, last = LearnedAction(fast, task, task.weights), LearnedAction(fast, task, (*task.last_weights, 0.0))
rest = np.zeros(each_step.state.nx)


def plan(Z, U):
    """Run FDDP from a guess. Return the solver and the log of its iterations."""
    solver = crocoddyl.SolverBoxFDDP(crocoddyl.ShootingProblem(rest, [each_step] * len(U), last))
    solver.th_stop, log = 1e-3, crocoddyl.CallbackLogger()
    solver.setCallbacks([log])
    start = time.perf_counter()
    solver.solve(list(Z), list(U), 150)
    taken = time.perf_counter() - start
    print(f"{len(U)} steps: {solver.iter} iterations in {taken:.1f} s, cost {solver.cost:.1f}", flush=True)
    return solver, log


def goal(z):
    """Return the state at rest, upright on the side nearest to the pole of a state."""
    upright = np.zeros_like(rest)
    upright[task.pole] = np.pi * (1.0 + 2.0 * np.round((z[task.pole] / np.pi - 1.0) / 2.0))
    return upright


n_first = FIRST[task.system]
n_left = task.n_steps - n_first
first, first_log = plan([rest] + [goal(rest)] * n_first, np.zeros((n_first, 1)))
solver, log = plan([*first.xs, *[goal(first.xs[-1])] * n_left], [*first.us, *np.zeros((n_left, 1))])
Z, U = np.array(solver.xs), np.array(solver.us)
gains = np.array(solver.K).reshape(task.n_steps, 1, -1)

# %%
# Check the derivatives
# ---------------------
# Crocoddyl computes finite differences of ``calc`` at states and inputs along the plan.

differences = crocoddyl.ActionModelNumDiff(each_step, True)
differences.disturbance = 1e-5  # larger than the default, because of rounding
furthest = dict.fromkeys(("Fx", "Fu", "Lx", "Lu", "Lxx", "Lxu", "Luu"), 0.0)
for z, u in zip(Z[:-1:10], U[::10], strict=True):
    pair = each_step.createData(), differences.createData()
    for model, data in zip((each_step, differences), pair, strict=True):
        model.calc(data, z, u)
        model.calcDiff(data, z, u)
    for name in furthest:
        mine, theirs = (getattr(data, name) for data in pair)
        furthest[name] = max(furthest[name], np.abs(mine - theirs).max() / max(np.abs(theirs).max(), 1.0))
print("off Crocoddyl's differences:", ", ".join(f"{name} {off:.0e}" for name, off in furthest.items()), flush=True)

# %%
# Run the plan on the true system
# -------------------------------
# The upright position is unstable. In an open loop, errors of the model grow. The gains of FDDP correct them. The
# rollout uses the same gains, and each particle follows one function of the posterior. It shows in advance how far the
# true system may deviate. Some particles may fall.


def controller(z, t):
    """Return the input of the plan, with feedback on deviations from the planned states."""
    return np.clip(U[t] - (z - Z[t]) @ gains[t].T, -task.limit, task.limit)


runs = {
    "inputs as planned": simulate(task.system, rest, U, DT),
    "with FDDP's gains": simulate(task.system, rest, lambda t, z: controller(z, t), DT, n_steps=task.n_steps),
}
ahead = rollout(learned.model, rest, controller, n_steps=task.n_steps, n_samples=n_particles, random_state=options.seed)


def off_upright(states):
    """Return the distance of the pole from upright, rad."""
    return np.abs(states[..., task.pole] % (2.0 * np.pi) - np.pi)


success = {name: bool((off_upright(states)[-LAST:] < NEAR).all()) for name, states in runs.items()}
particles = (off_upright(ahead.samples)[:, -LAST:] < NEAR).all(axis=1)
for name, states in runs.items():
    off = np.abs(states - Z)[:, task.pole].max()
    said = "upright" if success[name] else "not upright"
    print(f"{name}: {said} in the last second; the pole is off the plan by up to {off:.3f} rad")
print(f"in the model, with the gains, {particles.sum()} of {n_particles} particles are", flush=True)

# %%
# Plot the plan and the runs
# --------------------------

colours = {"inputs as planned": "#D55E00", "with FDDP's gains": "#0072B2"}
times, pole = DT * np.arange(task.n_steps + 1), task.pole
figure, ((top_left, top_right), (bottom_left, bottom_right)) = plt.subplots(2, 2, figsize=(8, 5.6))
for name, states in runs.items():
    top_left.plot(times, states[:, pole], color=colours[name], linewidth=2.5, label=name)
    bottom_left.plot(times, np.abs(states - Z)[:, pole], color=colours[name], label=name)
top_left.plot(times, Z[:, pole], color="k", linewidth=1, linestyle="--", label="plan")
top_left.axhline(goal(Z[-1])[pole], color="0.6", linestyle=":", zorder=0, label="upright")
top_left.set_ylim(Z[:, pole].min() - 1.0, Z[:, pole].max() + 1.0)
top_left.set(title="The simulated system", xlabel="time (s)", ylabel="pole's angle from hanging (rad)")

driven = np.array([controller(z, t) for t, z in enumerate(runs["with FDDP's gains"][:-1])])
top_right.step(times[:-1], driven[:, 0], where="post", color=colours["with FDDP's gains"], label="with FDDP's gains")
top_right.step(times[:-1], U[:, 0], where="post", color="k", linewidth=1, linestyle="--", label="plan")
push = "force (N)" if task.system == "cartpole" else "torque (N m)"
top_right.set(title="What the motor does", xlabel="time (s)", ylabel=push)

low, middle, high = np.quantile(np.abs(ahead.samples[..., pole] - Z[1:, pole]), (0.05, 0.5, 0.95), axis=0)
bottom_left.fill_between(times[1:], low, high, color="0.85", zorder=0, label="particles, with the gains: 5 to 95 %")
bottom_left.plot(times[1:], middle, color="0.5", linestyle=":", zorder=0, label="and their median")
bottom_left.set(title="How far the pole is off the plan", xlabel="time (s)", ylabel="angle (rad)", yscale="log")
bottom_left.yaxis.set_major_formatter("{x:g}")
bottom_left.set_ylim(1e-9, 10.0)  # room for the legend

for own, label, colour in ((first_log, f"{n_first} steps", "#009E73"), (log, f"all {task.n_steps}", "#CC79A7")):
    bottom_right.plot(own.costs, ".-", color=colour, label=label)
bottom_right.set(title="Costs of FDDP: motions with gaps are cheap", xlabel="iteration", ylabel="cost", yscale="log")
for ax in (top_left, top_right, bottom_left, bottom_right):
    ax.legend()
figure.suptitle(f"Crocoddyl's FDDP on EVGP-IFG, learned from {seconds:g} s of data")

options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / f"crocoddyl_{task.system}.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
