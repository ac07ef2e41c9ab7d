"""
Predict a hundred steps
=======================

Models learn one step of 0.03 s of a pendulum, a cartpole and an acrobot. ``rollout`` applies them to their own
predictions, for three seconds. Each particle follows one function from the posterior, because the error of the model is
the same at each step. The test states and inputs are new. Run ``python examples/plot_rollout.py --help`` for options.
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

from skevgp import EVGPRegressor, rollout
from skevgp.datasets import make_dynamics
from skevgp.features import AngleEncoder, InertiaForceGravity
from skevgp.plotting import RolloutDisplay
from skevgp.solvers import LBFGS

# Number of inducing points, number of training trajectories of 3 s, and index of the plotted position.
SYSTEMS = {
    "pendulum": (10, 5, 0, "angle (rad)"),
    "cartpole": (40, 6, 1, "angle of the pole (rad)"),
    "acrobot": (100, 30, 1, "angle of the elbow (rad)"),
}

parser = argparse.ArgumentParser(description="Learn three systems' dynamics, and predict a hundred steps of them.")
parser.add_argument("--seed", type=int, default=0, help="of data, models and particles; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
n_test, n_particles, n_steps, tol = (4, 20, 30, 1e3) if quick else (20, 100, 100, 10.0)

# %%
# Learn one step and predict many
# -------------------------------
# The kernel has sines and cosines of the angles as inputs, because angles are periodic. One call of ``rollout``
# predicts from all initial states. 95 % of the true states should be within two standard deviations of the mean.

horizons = np.array([1, n_steps // 10, n_steps // 2, n_steps])
rollouts, truths, coverage = {}, {}, {}
print(f"share of the true states within 2 std, of {n_test} trajectories; seed {options.seed}")
print(f"{'':10s}{'rows':>6s}", *(f"{f'step {step}':>9s}" for step in horizons), f"{'seconds':>9s}")
try:
    import matplotlib.pyplot as plt

    plt.style.use("skevgp.plotting.page")

    for system, (n_inducing, n_trajectories, *_) in SYSTEMS.items():
        train = make_dynamics(system, n_trajectories, random_state=options.seed)
        test = make_dynamics(system, n_test, n_steps, random_state=options.seed + 1000)
        start = time.perf_counter()
        model = EVGPRegressor(
            InertiaForceGravity(system),
            kernel_map=AngleEncoder(system),
            n_inducing=min(n_inducing, 20) if quick else n_inducing,
            solver=LBFGS(tol=tol),
            random_state=options.seed,
        ).fit(train.data, train.target, groups=train.groups)
        n_states = train.target.shape[1]
        inputs = test.data[:, n_states:].reshape(n_test, n_steps, -1)
        ahead = rollout(model, test.trajectories[:, 0], inputs, n_samples=n_particles, random_state=options.seed)
        seconds = time.perf_counter() - start
        truth = test.trajectories[:, 1:]
        inside = np.abs(ahead.mean - truth) <= 2.0 * ahead.std
        rollouts[system], truths[system], coverage[system] = ahead, truth, inside.mean(axis=(0, 2))
        print(
            f"{system:10s}{len(train.data):6d}",
            *(f"{share:9.2f}" for share in coverage[system][horizons - 1]),
            f"{seconds:9.1f}",
            flush=True,
        )
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs Pinocchio and matplotlib: pip install pin matplotlib")
except ValueError as error:
    sys.exit(f"error: {error}")

# %%
# Plot trajectories and errors
# ----------------------------
# The upper row shows a trajectory of the cartpole and one of the acrobot, those with the largest standard deviation
# at the end. The lower row is of all test trajectories and all systems. Errors of the angles grow hundreds of times
# within a second, and so do the standard deviations. The dotted line is the share that should be within two of them.

figure, axes = plt.subplots(2, 2, figsize=(8, 6), sharex=True)
times = train.dt * np.arange(1, n_steps + 1)
for ax, system in zip(axes[0], ("cartpole", "acrobot"), strict=True):
    ahead, truth = rollouts[system], truths[system]
    _, n_trajectories, state, name = SYSTEMS[system]
    index = int(np.argmax(ahead.std[:, -1, state]))
    RolloutDisplay.from_rollout(
        ahead,
        truth[index],
        states=[state],
        state_names=[name] * truth.shape[2],
        dt=train.dt,
        index=index,
        axes=ax,
    )
    ax.set_xlabel("")
    ax.set_title(f"{system}, learned from {n_trajectories} × 3 s:\nthe least sure of {n_test} trajectories")
axes[0, 0].legend()
growth, share = axes[1]
for (system, (_, _, state, _)), colour in zip(SYSTEMS.items(), ("#009E73", "#CC79A7", "#E69F00"), strict=True):
    ahead, truth = rollouts[system], truths[system]
    errors = np.abs(ahead.mean - truth)[:, :, state]
    growth.plot(times, np.median(errors, axis=0), color=colour, linestyle="--")
    growth.plot(times, np.median(ahead.std[:, :, state], axis=0), color=colour)
    share.plot(times, coverage[system], color=colour, label=f"{system}: {coverage[system].mean():.0%}")
growth.plot([], [], "k", label="std")
growth.plot([], [], "k--", label="|error|")
growth.set(title=f"Medians of {n_test} trajectories", xlabel="time (s)", ylabel="angle (rad)", yscale="log")
share.axhline(0.954, color="k", linestyle=":", linewidth=1)
share.set(title="True states within 2 std", xlabel="time (s)", ylabel="share of states", ylim=(0.0, 1.05))
growth.yaxis.set_major_formatter("{x:g}")
growth.legend(loc="lower right")
share.legend(loc="lower right")

options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / "rollout.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
