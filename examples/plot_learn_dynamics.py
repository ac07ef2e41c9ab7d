"""
Learn a robot's dynamics with rough physics
===========================================

Four models learn to predict a system's next state from its state and input, from simulated trajectories. The first is a
sparse Gaussian process (VGP). RES-VGP is the same for the change of state. EVGP-IF has inertia and force as explicit
features, and EVGP-IFG also has gravity. The physics is rough: the features contain no mass, length or friction. Run
``python examples/plot_learn_dynamics.py --help`` for options.
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

from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForce, InertiaForceGravity
from skevgp.metrics import containing_ratios, prediction_error, std_norm
from skevgp.plotting import CoefficientDisplay
from skevgp.solvers import Adam

# Number of inducing points in the paper's Table 2, of VGP and RES-VGP, and of EVGP.
INDUCING = {"pendulum": (40, 10), "cartpole": (100, 60), "acrobot": (250, 150)}
# Error, ‖STD‖, CR-1, CR-2, CR-3 and parameters in the paper's Table 4.
PAPER = {
    "pendulum": {
        "VGP": (0.343, 0.273, 0.582, 0.841, 0.910, 407),
        "RES-VGP": (0.155, 0.216, 0.833, 0.951, 0.974, 407),
        "EVGP-IF": (0.013, 0.024, 0.936, 0.986, 0.993, 119),
        "EVGP-IFG": (0.005, 0.007, 0.871, 0.965, 0.985, 123),
    },
    "cartpole": {
        "VGP": (0.188, 0.185, 0.505, 0.828, 0.901, 2813),
        "RES-VGP": (0.216, 0.153, 0.518, 0.848, 0.924, 2813),
        "EVGP-IF": (0.016, 0.184, 0.933, 0.980, 0.990, 1733),
        "EVGP-IFG": (0.011, 0.041, 0.935, 0.976, 0.986, 1741),
    },
    "acrobot": {
        "VGP": (1.100, 2.137, 0.715, 0.861, 0.913, 7013),
        "RES-VGP": (0.820, 1.428, 0.705, 0.846, 0.904, 7013),
        "EVGP-IF": (0.151, 0.290, 0.794, 0.908, 0.950, 4253),
        "EVGP-IFG": (0.131, 0.251, 0.712, 0.893, 0.952, 4269),
    },
}

parser = argparse.ArgumentParser(description="Learn a system's dynamics with and without rough physics.")
parser.add_argument("--system", choices=sorted(INDUCING), default="pendulum", help="default: %(default)s")
parser.add_argument("--trajectories", type=int, help="for training and for testing; default: the paper's")
parser.add_argument("--steps", type=int, help="of 0.03 s per trajectory; default: the paper's 100")
parser.add_argument("--inducing", type=int, nargs=2, metavar=("VGP", "EVGP"), help="default: the paper's")
parser.add_argument("--noise", type=float, default=0.0, help="on the targets, as a share of their std; default: 0")
parser.add_argument(
    "--solver",
    choices=("lbfgs", "adam"),
    default="lbfgs",
    help="lbfgs: skevgp's defaults; adam: the paper's set-up (diagonal posterior, inducing points per output)",
)
parser.add_argument("--seed", type=int, default=0, help="of data and models; default: %(default)s")
parser.add_argument(
    "--output",
    type=Path,
    default=Path(__file__).resolve().parent / "output",
    help="folder for the picture; default: examples/output",
)
options = parser.parse_args()
if os.environ.get("SKEVGP_EXAMPLES_QUICK") == "1":
    quick = {"trajectories": 10, "steps": 30, "inducing": (20, 10)}
    options = argparse.Namespace(
        **{name: quick.get(name) if value is None else value for name, value in vars(options).items()}
    )
m_vgp, m_evgp = options.inducing or INDUCING[options.system]

# %%
# Simulate trajectories for training and testing
# ----------------------------------------------

try:
    import matplotlib.pyplot as plt

    plt.style.use("skevgp.plotting.page")
    sizes = {"n_trajectories": options.trajectories, "n_steps": options.steps}
    train = make_dynamics(options.system, **sizes, noise=options.noise, random_state=options.seed)
    test = make_dynamics(options.system, **sizes, random_state=options.seed + 1000)
except ImportError as error:
    sys.exit(f"error: {error}\nThis example needs Pinocchio and matplotlib: pip install pin matplotlib")
except ValueError as error:
    sys.exit(f"error: {error}")

# %%
# Fit the models
# --------------
# RES-VGP predicts the change of state. In the EVGP models, the features already move a position by its velocity.

settings = {"solver": options.solver, "random_state": options.seed}
if options.solver == "adam":
    settings |= {"solver": Adam(posterior="diagonal"), "sharing": "kernel", "noise_cv": None}
models = {
    "VGP": EVGPRegressor(n_inducing=m_vgp, **settings),
    "RES-VGP": EVGPRegressor(n_inducing=m_vgp, **settings),
    "EVGP-IF": EVGPRegressor(InertiaForce(options.system), n_inducing=m_evgp, **settings),
    "EVGP-IFG": EVGPRegressor(InertiaForceGravity(options.system), n_inducing=m_evgp, **settings),
}
n_states = train.target.shape[1]
predictions = {}

print(f"{options.system}: {len(train.data)} rows for training, {len(test.data)} for testing, seed {options.seed}")
columns = ("Error", "median", "99 %", "‖STD‖", "CR-1", "CR-2", "CR-3", "param.", "seconds")
paper_columns = ("Error", "‖STD‖", "CR-1", "CR-2", "CR-3", "param.")
print(" " * 9, *(f"{name:>8}" for name in columns), "  paper:", *(f"{name:>7}" for name in paper_columns))
for name, model in models.items():
    base = (train.data[:, :n_states], test.data[:, :n_states]) if name == "RES-VGP" else (0.0, 0.0)
    start = time.perf_counter()
    model.fit(train.data, train.target - base[0], groups=train.groups)
    seconds = time.perf_counter() - start
    mean, std = model.predict(test.data, return_std=True)
    mean = mean + base[1]
    predictions[name] = mean, std
    errors = np.linalg.norm(test.target - mean, axis=1)
    accuracy = prediction_error(test.target, mean), np.median(errors), np.quantile(errors, 0.99), std_norm(std)
    print(
        f"{name:9s}",
        *(f"{value:8.5f}" for value in accuracy),
        *(f"{ratio:8.3f}" for ratio in containing_ratios(test.target, mean, std)),
        f"{model.n_parameters_:8d} {seconds:8.2f}         ",
        *(f"{value:7.3f}" if isinstance(value, float) else f"{value:7d}" for value in PAPER[options.system][name]),
        flush=True,
    )

# %%
# Plot the hardest trajectory and the weights
# -------------------------------------------
# This is the trajectory with the largest error of VGP. It leaves the range of the training data. In the prior mean,
# velocity moves position and stays constant. All other weights have mean 0 and a wide scale.

output = n_states - 1
errors_vgp = np.abs(test.target - predictions["VGP"][0]).sum(axis=1)
hardest = np.argmax([errors_vgp[test.groups == group].sum() for group in np.unique(test.groups)])
rows = test.groups == hardest
seconds = 0.03 * (1 + np.arange(rows.sum()))
truth = test.target[rows, output]
velocity = f"{test.target_names[output]} (rad/s)"
colours = {"VGP": "C1", "EVGP-IFG": "C0"}

figure, axes = plt.subplots(2, 2, figsize=(8, 5.2), width_ratios=(1.5, 1))
for name, colour in colours.items():
    mean, std = (part[rows, output] for part in predictions[name])
    axes[0, 0].plot(seconds, mean, color=colour, label=name)
    axes[0, 0].fill_between(seconds, mean - 2 * std, mean + 2 * std, color=colour, alpha=0.2, linewidth=0)
    axes[1, 0].plot(seconds, np.abs(mean - truth), color=colour, label=f"{name}: |error|")
    axes[1, 0].plot(seconds, 2 * std, color=colour, linestyle=":", label=f"{name}: 2 std")
axes[0, 0].plot(seconds, truth, "k--", linewidth=1, label="truth")
axes[0, 0].set(title="One-step predictions along a test trajectory, ±2 std", ylabel=velocity)
axes[1, 0].set(title="Errors and standard deviations", ylabel=velocity, yscale="log", xlabel="time (s)")
axes[1, 0].yaxis.set_major_formatter("{x:g}")
axes[0, 0].legend()
axes[1, 0].set_ylim(top=200 * axes[1, 0].get_ylim()[1])  # room for the legend
axes[1, 0].legend(loc="upper left", ncols=2)
for ax, state in zip(axes[:, 1], range(n_states - 2, n_states), strict=True):
    CoefficientDisplay.from_estimator(models["EVGP-IFG"], output=state, ax=ax)
    ax.set(title=f"EVGP-IFG: weights of the next {test.target_names[state]}", xlabel="weight (SI units)")
axes[0, 1].legend(loc="lower left", ncols=2, bbox_to_anchor=(0, 1.08))

options.output.mkdir(parents=True, exist_ok=True)
picture = options.output / f"learn_dynamics_{options.system}.png"
figure.savefig(picture)
print(f"picture: {picture}")
plt.show()
