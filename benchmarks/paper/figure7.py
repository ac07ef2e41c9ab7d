"""The paper's Figure 7: the learned weights of the physics features.

The CSV has a row per weight: its prior, its posterior and its least squares estimate. In the paper, the weights of
positions on velocities of the acrobot turn negative without features of gravity, to imitate it.

    python benchmarks/paper/figure7.py                                     # the acrobot, four seeds: hours of one core
    python benchmarks/paper/figure7.py --quick                             # few rows and iterations: a minute
    python benchmarks/paper/figure7.py --systems pendulum cartpole iiwa14  # into the same file
    python benchmarks/paper/figure7.py --settings paper --max-iter 2000    # instead of 16000 steps of Adam

The settings are those of table4.py. With Adam a fit of the acrobot takes 2 to 6 minutes of one core, in skevgp's
setting half a minute.
"""

from __future__ import annotations

import itertools
import re
import sys
from collections import namedtuple
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
import pandas as pd

import harness
from harness import figure_of, ordered
from paper.models import QUICK_TRAJECTORIES, SYSTEMS, Fit, build
from skevgp.datasets import make_dynamics

SETTINGS = {
    "paper": "paper's setting",
    "author": "author's starts",
    "author-100": "author's starts, prior scale 100",
    "skevgp": "skevgp's setting",
}
MODELS = ("EVGP-IF", "EVGP-IFG")

Cell = namedtuple("Cell", "system model setting seed size")


def run(cell: Cell, max_iter: int | None) -> list[dict[str, Any]]:
    n_trajectories = QUICK_TRAJECTORIES if cell.size == "quick" else None
    train = make_dynamics(cell.system, n_trajectories, random_state=cell.seed)
    regressor = build(Fit(cell.system, cell.model, cell.setting, cell.seed, cell.size, max_iter))
    seconds, _ = harness.timed(lambda: regressor.fit(train.data, train.target, groups=train.groups))
    mean = regressor.predict(train.data)
    H = regressor.feature_map_.transform(train.data)
    tables = {
        "prior_mean": regressor.coef_prior_mean_,
        "prior_std": regressor.coef_prior_scale_,
        "mean": regressor.coef_,
        "std": regressor.coef_std_,
        "least_squares": np.linalg.lstsq(H, train.target)[0].T,
        "least_squares_of_gp": np.linalg.lstsq(H, mean - H @ regressor.coef_.T)[0].T,
    }
    return [
        {
            "output": output,
            "feature": feature,
            **{name: values[o, j] for name, values in tables.items()},
            "max_iter": "" if regressor.max_iter is None else regressor.max_iter,
            "n_iter": regressor.n_iter_,
            "fit_seconds": seconds,
        }
        for o, output in enumerate(train.target_names)
        for j, feature in enumerate(regressor.feature_map_.get_feature_names_out())
    ]


def table_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the weights that would imitate gravity and those of gravity, means ± standard errors over seeds."""

    def text(values: pd.Series) -> str:
        error = f" ± {figure_of(values.std() / np.sqrt(len(values)))}" if len(values) > 1 else ""
        return f"{values.mean():+.3f}{error}"

    outputs = list(rows["output"].unique())
    half = len(outputs) // 2
    position = rows["output"].map(dict(zip(outputs[half:], outputs[:half], strict=True)))
    rows = rows[position.notna() & ((rows["feature"] == position) | rows["feature"].str.startswith("sin("))]
    orders = {"setting": list(SETTINGS), "model": MODELS, "output": outputs}
    rows = rows.assign(**{name: pd.Categorical(rows[name], order) for name, order in orders.items()})
    lines = []
    for (setting, model, output), own in rows.groupby(list(orders), observed=True):
        for feature, weight in own.groupby("feature", sort=False):
            line = {"setting": SETTINGS[setting], "model": model, "entry": f"({output}, {feature})"}
            line |= {"b": text(weight["mean"]), "std": weight["std"].mean()}
            line |= {"least squares": text(weight["least_squares"]), "GP": text(weight["least_squares_of_gp"])}
            lines.append(line)
    return pd.DataFrame(lines)


def pretty(name: str) -> str:
    """Write a column as the paper does: dq1/dt -> q̇₁, u_q2 -> u₂, sin(q1 + q2) -> sin₁₂."""
    for pattern, replacement in (
        (r"sin\(q(\d) \+ q(\d)\)", r"\\sin_{\1\2}"),
        (r"sin\(q(\d)\)", r"\\sin_\1"),
        (r"sin\((\w+)\)", r"\\sin \1"),
        (r"d(q\d*|theta|x)/dt", r"\\dot \1"),
        (r"^u_[a-z]+$", "u"),
        (r"^u_q(\d)$", r"u_\1"),
        (r"q(\d)", r"q_\1"),
        (r"theta", r"\\theta"),
        (r"gravity", "g"),
    ):
        name = re.sub(pattern, replacement, name)
    return f"${name}$"


def plot(rows: pd.DataFrame, path: Path) -> None:
    """Draw heat maps of posterior means and standard deviations, a column of panels per model; means over seeds."""
    from matplotlib.colors import SymLogNorm
    from matplotlib.patches import Rectangle

    settings, models = ordered(SETTINGS, rows["setting"]), ordered(MODELS, rows["model"])
    outputs = list(rows["output"].unique())
    half = len(outputs) // 2
    size = (harness.WIDTH, 0.3 + len(settings) * (0.6 + 0.39 * len(outputs)))
    figure, grid = harness.pyplot().subplots(len(settings), len(models), figsize=size, squeeze=False)
    for line, setting in zip(grid, settings, strict=True):
        for axes, model in zip(line, models, strict=True):
            own = rows[(rows["setting"] == setting) & (rows["model"] == model)]
            tables = own.groupby(["output", "feature"], sort=False)[["mean", "std"]].mean().unstack(sort=False)
            means, stds = tables["mean"], tables["std"]
            picture = axes.imshow(means, aspect="auto", cmap="RdBu_r", norm=SymLogNorm(0.05, vmin=-1.0, vmax=1.0))
            axes.set_xticks(range(means.shape[1]), map(pretty, means.columns), fontsize=12)
            axes.set_yticks(range(means.shape[0]), map(pretty, means.index), fontsize=12)
            axes.grid(False)
            axes.set_title(f"{model}, {SETTINGS[setting]}")
            for place in range(half):  # of positions on velocities
                corner = (list(means.columns).index(outputs[place]) - 0.5, half + place - 0.5)
                axes.add_patch(Rectangle(corner, 1.0, 1.0, fill=False, edgecolor="k", linewidth=1.5))
            if means.shape[1] <= 12:
                for (o, j), mean in np.ndenumerate(means):
                    dark = np.mean(picture.cmap(picture.norm(mean))[:3]) < 0.5
                    text = f"{short(mean)}\n±{short(stds.iloc[o, j])}"
                    color = "w" if dark else "k"
                    axes.text(j, o, text, ha="center", va="center", fontsize=8.5, linespacing=1.0, color=color)
    seeds = f"means over {rows['seed'].nunique()} seeds"
    figure.suptitle(f"{rows['system'].iloc[0]}: weights (SI units) ± their posterior std, {seeds}")
    harness.save_picture(figure, path)


def short(value: float) -> str:
    """Write a number in at most six characters: 0.0304 -> .030, 0.00002 -> 2e-5."""
    if 0.0 < abs(value) < 5e-4:
        return f"{value:.0e}".replace("e-0", "e-")
    return f"{value:.3f}".replace("0.", ".", 1)


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="12 trajectories, few iterations and one seed",
        seeds=4,
        systems=SYSTEMS,
        default_systems=["acrobot"],
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS, help="default: both")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS), help="default: all")
    parser.add_argument("--max-iter", type=int, help="default: the regressor's")
    options = harness.parse(parser)
    output = harness.output_path(options, "beta")
    cells = [
        Cell(system, model, setting, seed, options.size)
        for system, seed, setting, model in itertools.product(
            options.systems, options.seeds, options.settings, options.models
        )
    ]
    n_failures = harness.run_missing(cells, partial(run, max_iter=options.max_iter), output, options.jobs)
    rows, tables = harness.frame(output, size=options.size), {}
    for system, own in rows.groupby("system"):
        tables[system] = table_of(own)
        authors = own["setting"].str.startswith("author")
        for end, part in (("", own[~authors]), ("_author", own[authors])):
            if len(part):
                plot(part, output.with_name(f"{output.stem}_{system}{end}.png"))
    harness.write_page("The learned weights of the physics features", tables, output, n_failures)


if __name__ == "__main__":
    main()
