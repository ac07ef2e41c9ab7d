"""
Follow a system that changes
============================

A model of the cartpole is learned from simulated seconds. Then it predicts the next state at each step, and gets the
true state afterwards. After a while, a weight is added to the pole. A model without updates continues to predict the
old system. A model with ``partial_fit`` averages both systems. A model with a ``forgetting_factor`` follows the new
one. Each update takes milliseconds. Run ``python examples/plot_online.py --help`` for options.
"""

# %%
# Options
# -------

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from sklearn.base import clone

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics, simulate
from skevgp.features import AngleEncoder, InertiaForceGravity
from skevgp.robots.systems import SYSTEMS
from skevgp.solvers import LBFGS

parser = argparse.ArgumentParser(description="Follow a system whose mass changes, by partial_fit.")
parser.add_argument("--mass", type=float, default=5.0, help="of the pole after the change, kg (before: 1)")
parser.add_argument("--forgetting", type=float, default=0.95, help="forgetting_factor; default: %(default)s")
parser.add_argument(
    "--noise", type=float, default=0.002, help="as a share of each state's scatter; default: %(default)s"
)
parser.add_argument("--seed", type=int, default=0, help="of data and models; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
quick = os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1"
n_steps, change = (60, 30) if quick else (400, 200)

# %%
# Simulate the cartpole before and after the change
# -------------------------------------------------
# Forces are random, and the measured states have noise.

try:
    import matplotlib.pyplot as plt

    plt.style.use("skevgp.plotting.page")
    train = make_dynamics("cartpole", 10 if quick else 24, noise=options.noise, random_state=options.seed)
    light = SYSTEMS["cartpole"]
    heavy = replace(light, links=(light.links[0], replace(light.links[1], mass=options.mass)))
    rng = np.random.RandomState(options.seed)
    U = 100.0 * rng.standard_normal((n_steps, 1))
    before = simulate(light, [0.0, 0.5, 0.0, 0.0], U[:change])
    states = np.vstack([before, simulate(heavy, before[-1], U[change:])[1:]])
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs Pinocchio and matplotlib: pip install pin matplotlib")
deviation = options.noise * train.target.std(axis=0)
measured = states + deviation * rng.standard_normal(states.shape)

# %%
# Run three models online
# -----------------------
# ``compile`` makes a predictor without validation. ``update`` gives it the new weights after each ``partial_fit``.

model = EVGPRegressor(
    InertiaForceGravity("cartpole"),
    kernel_map=AngleEncoder("cartpole"),
    n_inducing=20 if quick else 60,
    sharing="all",
    solver=LBFGS(tol=10.0),
    random_state=options.seed,
)
ways = {
    "left as it was": None,
    "with all rows": 1.0,
    f"with a forgetting factor of {options.forgetting:g}": options.forgetting,
}
errors, inside = {}, {}
for name, factor in ways.items():
    own = clone(model).fit(train.data, train.target, groups=train.groups)
    fast, found, seconds = own.compile(), [], 0.0
    for z, u, after in zip(states[:-1], U, measured[1:], strict=True):
        x = np.concatenate([z, u])
        mean, std = fast.predict(x, return_std=True)
        found.append((after - mean, std))
        if factor is not None:
            start = time.perf_counter()
            own.partial_fit(x[np.newaxis], after[np.newaxis], forgetting_factor=factor)
            fast.update(own)
            seconds += time.perf_counter() - start
    off, std = (np.array(part) for part in zip(*found, strict=True))
    errors[name] = np.abs(off) / deviation
    inside[name] = (np.abs(off) < 2.0 * std).mean(axis=1)
    halves = errors[name][change // 2 : change], errors[name][(n_steps + change) // 2 :]
    medians = " ".join(f"{np.median(half):6.2f}" for half in halves)
    cost = "" if factor is None else f", {1e3 * seconds / n_steps:.1f} ms per step"
    print(f"{name:34s} median error over the noise: before, after {medians}{cost}", flush=True)

# %%
# Plot errors over time
# ---------------------
# Errors are in units of the noise of each state, averaged over the last second.

figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True)
colours = ("#D55E00", "#999999", "#0072B2")
window = np.ones(33) / 33.0
times = 0.03 * (1.0 + np.arange(n_steps))
for (name, error), colour in zip(errors.items(), colours, strict=True):
    for ax, values in zip(axes, (error.mean(axis=1), inside[name]), strict=True):
        over = np.convolve(np.ones(n_steps), window)[:n_steps]
        ax.plot(times, np.convolve(values, window)[:n_steps] / over, color=colour, label=name)
for ax in axes:
    ax.axvline(0.03 * change, color="k", linestyle=":", linewidth=1)
axes[0].set_yscale("log")
axes[0].set_ylabel("one-step error / noise")
axes[0].set_title(f"The pole's mass goes from 1 to {options.mass:g} kg (dotted line)")
axes[0].legend()
axes[1].axhline(0.954, color="k", linewidth=0.5)
axes[1].set_ylim(0.0, 1.05)
axes[1].set_ylabel("share within 2 std")
axes[1].set_xlabel("time (s)")

options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / "online.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
