"""Pictures of the front page: three from the benchmarks' CSVs, one from a small fit. Each is as wide as a card."""

from collections.abc import Callable
from pathlib import Path
from statistics import fmean, geometric_mean

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from comparison import RESULTS, rows_of
from skevgp import EVGPRegressor, rollout
from skevgp.datasets import make_dynamics
from skevgp.features import AngleEncoder, InertiaForceGravity

SIZE = (3.5, 3.1)  # inches, 385 pixels of a page
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#7f7f7f"


def physics() -> Figure:
    """Draw the Error over the number of training trajectories, with and without physics."""
    rows = [row for row in rows_of(RESULTS / "physics_curves.csv") if float(row["noise"]) == 0.01]
    figure, ax = plt.subplots(figsize=SIZE)
    for system, name, style in (("cartpole_damped", "cartpole", "-"), ("pendulum", "pendulum", "--")):
        for model, label, color in (("RES-VGP", "without physics", ORANGE), ("EVGP-IFG", "with physics", BLUE)):
            own = [row for row in rows if row["system"] == system and row["model"] == model]
            counts = sorted({int(row["trajectories"]) for row in own})
            errors = [fmean(float(row["error"]) for row in own if int(row["trajectories"]) == n) for n in counts]
            ax.loglog(counts, errors, style, color=color, marker="o", label=f"{name}, {label}")
    ax.set_xticks(counts, [str(n) for n in counts])
    ax.minorticks_off()
    ax.set_xlabel("training trajectories of 3 s")
    ax.set_ylabel("mean error of the next state (SI units)")
    ax.set_ylim(top=0.9)
    ax.legend(loc="upper right", handlelength=2.5)
    return figure


def angle_of_the_pole() -> Figure:
    """Draw a rollout of the cartpole: what the pole does in three seconds, known from 18 s of data."""
    train, test = make_dynamics("cartpole", 6, random_state=0), make_dynamics("cartpole", 12, random_state=1)
    model = EVGPRegressor(
        InertiaForceGravity("cartpole"),
        kernel_map=AngleEncoder("cartpole"),
        n_inducing=60,
        sharing="all",
        random_state=0,
    )
    model.fit(train.data, train.target, groups=train.groups)
    n_steps = 100
    ahead = [
        rollout(model, states[0], test.data[test.groups == i][:n_steps, 4:], random_state=0)
        for i, states in enumerate(test.trajectories)
    ]
    widest = max(range(len(ahead)), key=lambda i: ahead[i].std[-1, 1])  # the least certain of them
    shown, truth = ahead[widest], test.trajectories[widest][1 : n_steps + 1, 1]
    times = test.dt * (1 + np.arange(len(truth)))
    mean, std = shown.mean[:, 1], shown.std[:, 1]
    figure, ax = plt.subplots(figsize=SIZE)
    ax.fill_between(times, mean - 2 * std, mean + 2 * std, color=BLUE, alpha=0.2, linewidth=0, label="±2 std")
    ax.plot(times, shown.samples[:8, :, 1].T, color=GREY, linewidth=0.7)
    ax.plot([], [], color=GREY, linewidth=0.7, label="samples")
    ax.plot(times, mean, color=BLUE, label="mean")
    ax.plot(times, truth, "--", color=ORANGE, label="truth")
    ax.set_xlabel("time (s)")
    ax.set_ylabel("angle of the pole of a cartpole (rad)")
    ax.legend(loc="best")
    return figure


def bars(names: list[str], values: list[float], colors: list[str], label: str) -> Figure:
    """Draw a bar with its number for each name, from top to bottom."""
    figure, ax = plt.subplots(figsize=SIZE)
    drawn = ax.barh(names, values, color=colors)
    ax.bar_label(drawn, [f"{value:.2g}" for value in values], padding=3)
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    ax.set_xlim(right=1.2 * max(values))
    ax.set_xlabel(label)
    return figure


def arm() -> Figure:
    """Draw mean square errors of torques of the UR10e over those of least squares."""
    models = {
        "gradient boosting": "gradient\nboosting",
        "GP": "Gaussian process\nwithout physics",
        "least squares": "least squares",
        "least squares, prior": "InverseDynamics,\nphysics alone",
        "EVGP": "InverseDynamics",
    }
    rows = [row for row in rows_of(RESULTS / "real_arms.csv") if (row["robot"], row["split"]) == ("ur10e", "three")]
    rows = [row for row in rows if row["size"] == "full"]
    means = [geometric_mean(float(row["ratio"]) for row in rows if row["model"] == model) for model in models]
    return bars([*models.values()], means, [GREY] * 3 + [BLUE] * 2, "mean square error / least squares'")


def acrobot() -> Figure:
    """Draw errors of the next state of a real acrobot under a controller that is not in the training data."""
    models = {
        "RES": "without physics",
        "IFG": "InertiaForceGravity",
        "IF, nominal, friction": "URDF",
        "IF, nominal with parameters, friction": "URDF, masses\nlearned",
    }
    rows = rows_of(RESULTS / "machines_acrobot.csv")
    rows = [row for row in rows if (row["rows"], row["test"]) == ("aligned", "another controller")]
    means = [geometric_mean(float(row["nmse"]) for row in rows if row["model"] == model) for model in models]
    return bars([*models.values()], means, [ORANGE] + [BLUE] * 3, "error / variance of the change")


PICTURES: dict[str, Callable[[], Figure]] = {
    "front_physics": physics,
    "front_rollout": angle_of_the_pole,
    "front_arm": arm,
    "front_acrobot": acrobot,
}


def write_front(folder: Path) -> None:
    """Draw the pictures that are not there."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in PICTURES.items():
        if not (folder / f"{name}.png").exists():
            with plt.style.context("skevgp.plotting.page"):
                figure = draw()
                figure.savefig(folder / f"{name}.png")
                plt.close(figure)
