"""The paper's Table 4: the test results of every system and model, next to the paper's numbers.

A model of seed s learns from data of random state s and is tested on 1000 + s.

    python benchmarks/paper/table4.py               # everything, four seeds: days of one core
    python benchmarks/paper/table4.py --quick       # fewer rows and iterations, one seed: a few minutes
    python benchmarks/paper/table4.py --systems iiwa14 --settings paper --max-iter 1000  # half an hour per fit
    python benchmarks/paper/table4.py --noise 0.01  # on training and test targets; in another file
    python benchmarks/paper/table4.py --angles wrapped --systems pendulum cartpole acrobot --settings paper

There are two cartpoles. ``cartpole_damped`` has damping on both joints, as Drake's had in Python when the paper was
written. Angles are raw, or wrapped to [-pi, pi) in the inputs, with the targets moved along.

The settings are:

- "paper": Adam, diagonal posterior, inducing points per output;
- "author" and "author-100": the solver and the starts of the author's library, with a prior scale of 1 or 100;
- "skevgp": defaults;
- "skevgp-angles": the kernel gets sines and cosines of angles;
- "skevgp-nominal", for EVGP on iiwa14: further features from a model of the arm whose inertial parameters are wrong by
  up to 20 %.

With Adam a fit takes up to 5 minutes of one core for the pendulum and the cartpole, and 2 to 16 for the acrobot. For
iiwa14 it takes 2 to 3 hours. In the other settings it takes seconds to minutes, for iiwa14 up to an hour.
"""

from __future__ import annotations

import itertools
import sys
from collections import namedtuple
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
import pandas as pd
from sklearn.utils import Bunch

import harness
from harness import figure_of, ordered, text
from paper.models import (
    MODELS,
    PROMISED,
    PUBLISHED,
    QUICK_TRAJECTORIES,
    SETTINGS,
    SYSTEMS,
    Fit,
    fitted_row,
    has,
    limited,
)
from skevgp.datasets import make_dynamics

MARKERS = dict(zip(SETTINGS, "svPo^D", strict=True))
COLOURS = dict(zip(SETTINGS, np.array(harness.PALETTE)[[4, 1, 5, 0, 2, 3]], strict=True))
N_SEEDS = 4

# One fit. ``noise`` is the share of each training target's standard deviation.
Cell = namedtuple("Cell", "system model setting seed angles noise size")


@lru_cache(maxsize=1)
def data(system: str, seed: int, noise: float, size: str, angles: str) -> tuple[Bunch, Bunch]:
    """Return a training and a test set with the same noise."""
    n_trajectories = QUICK_TRAJECTORIES if size == "quick" else None
    wrap = angles == "wrapped"
    train = make_dynamics(system, n_trajectories, noise=noise, wrap_angles=wrap, random_state=seed)
    test = make_dynamics(system, n_trajectories, wrap_angles=wrap, random_state=1000 + seed)
    states = train.trajectories[:, 1:].reshape(train.target.shape)
    test.target += noise * states.std(axis=0) * np.random.RandomState(2000 + seed).standard_normal(test.target.shape)
    return train, test


def run(cell: Cell, max_iter: int | None) -> dict[str, Any]:
    """Fit one model on one training set and evaluate it on one test set."""
    train, test = data(cell.system, cell.seed, cell.noise, cell.size, cell.angles)
    return fitted_row(Fit(cell.system, cell.model, cell.setting, cell.seed, cell.size, max_iter), train, test)


def sorted_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Put the rows into the paper's order, and add their case: a system and its angles."""
    cases = [system + end for system in SYSTEMS for end in ("", ", wrapped")]
    case = rows["system"] + np.where(rows["angles"] == "wrapped", ", wrapped", "")
    orders = {"setting": SETTINGS, "case": cases, "model": MODELS}
    rows = rows.assign(case=case)
    rows = rows.assign(**{name: pd.Categorical(rows[name], order) for name, order in orders.items()})
    return rows.sort_values([*orders, "seed"])


def unsure(own: pd.DataFrame) -> tuple[bool, bool]:
    """Return whether a limit ended a fit, and whether an output was not learned."""
    return bool(own.apply(limited, axis=1).any()), bool((own["unlearned"] > 0).any())


def marks(own: pd.DataFrame) -> str:
    """Return an asterisk if a limit ended a fit, a dagger if an output was not learned, and the number of seeds."""
    ended, unlearned = unsure(own)
    return "\\*" * ended + "†" * unlearned + (f" ({len(own)})" if len(own) != N_SEEDS else "")


def overview(rows: pd.DataFrame, noisy: bool) -> pd.DataFrame:
    """Return mean Errors, all rows / rows inside the training range; of noisy data CR-2. A column per setting."""

    def means(own: pd.DataFrame) -> str:
        shown = [own["cr2"].mean()] if noisy else [own["error_mean"].mean(), own["error_inside"].mean(skipna=False)]
        return " / ".join(figure_of(mean) for mean in shown if np.isfinite(mean)) + marks(own)

    found = rows.groupby(["case", "model", "setting"], observed=True).apply(means, include_groups=False)
    found = found.unstack(fill_value="")
    published = PUBLISHED["cr2" if noisy else "error"].map("{:.3f}".format)
    papers = [published[case.removesuffix(", wrapped"), model] for case, model in found.index]
    found.columns = [f"ours: {setting}" for setting in found.columns]
    found.insert(0, "in the paper", papers)
    return found.reset_index(names=["system", "model"])


def calibration(rows: pd.DataFrame) -> pd.DataFrame:
    """Return shares of the targets within intervals that promise them."""
    names = {"within_0.5": "0.5", "within_0.8": "0.8", "within_0.95": "0.95"}
    names |= {"cr1": "CR-1: 0.683", "cr2": "CR-2: 0.954", "cr3": "CR-3: 0.997"}
    groups = rows.groupby(["setting", "case", "model"], observed=True)
    shares = {
        f"{case} {model} {setting}{marks(own)}": own[list(names)].mean(skipna=False)
        for (setting, case, model), own in groups
    }
    table = pd.DataFrame(shares).T.rename(columns=names)
    return table.apply(text, digits=3).reset_index(names="promised")


def details(rows: pd.DataFrame) -> pd.DataFrame:
    """Return all columns of the paper's table, ours / the paper's, for one setting."""
    lines = []
    for (case, model), own in rows.groupby(["case", "model"], observed=True):
        paper, mean = PUBLISHED.loc[own["system"].iloc[0], model], own.mean(numeric_only=True)
        inside = own["error_inside"].mean(skipna=False)
        counts = ", ".join(map(str, sorted(own["n_parameters"].unique())))
        lines.append(
            {
                "system": case,
                "model": model,
                "seeds": len(own),
                "Error": f"{figure_of(mean['error_mean'])} / {paper.error:.3f}",
                "median seed": own["error_mean"].median(),
                "largest": own["error_mean"].max(),
                "inside": f"{figure_of(inside)} ({mean['inside']:.1%})" if np.isfinite(inside) else "",
                "outside": mean["error_outside"],
                "median row": mean["error_median"],
                "99 % of rows": mean["error_p99"],
                "‖STD‖": f"{figure_of(mean['std_norm'])} / {paper.std_norm:.3f}",
                **{f"CR-{k}": f"{mean[f'cr{k}']:.3f} / {paper[f'cr{k}']:.3f}" for k in (1, 2, 3)},
                "NLPD": f"{mean['nlpd']:.2f}",
                "parameters": f"{counts} / {paper.n_parameters:.0f}",
                "iterations": f"{own['n_iter'].median():.0f}",
                "seconds": f"{mean['fit_seconds']:.1f}",
            }
        )
    return pd.DataFrame(lines)


def drawn(rows: pd.DataFrame) -> list[str]:
    """Return the systems of pictures: the paper's four, of the two cartpoles the one with damping."""
    systems = ordered(SYSTEMS, rows["system"])
    return [system for system in systems if system != "cartpole" or "cartpole_damped" not in systems]


def plot_errors(rows: pd.DataFrame, path: Path) -> None:
    """Draw a panel per system: bars of the paper, a marker for each setting."""
    systems, rows = drawn(rows), sorted_rows(rows[rows["angles"] == "raw"])
    n_lines = -(-len(systems) // 2)
    figure, grid = harness.pyplot().subplots(n_lines, 2, figsize=(harness.WIDTH, 1.4 + 2.9 * n_lines), squeeze=False)
    places = np.arange(len(MODELS))
    for axes, system in zip(grid.flat, systems, strict=False):
        papers = PUBLISHED.loc[system]["error"].reindex(MODELS)
        axes.hlines(papers, places - 0.42, places + 0.42, color="black", label="in the paper")
        groups = rows[rows["system"] == system].groupby(["setting", "model"], observed=True)
        for (setting, model), own in groups:
            place = MODELS.index(model) + 0.16 * (SETTINGS.index(setting) - 2.5)
            colour, values = COLOURS[setting], own["error_mean"]
            style = {"color": colour, "markerfacecolor": "white" if any(unsure(own)) else colour, "linestyle": ""}
            axes.plot([place] * len(values), values, ".", color=colour, markersize=4, alpha=0.5)
            axes.plot(place, values.mean(), MARKERS[setting], label=f"ours: {setting}", **style)
            axes.plot(place, own["error_inside"].mean(), "_", color=colour, markersize=12)
        axes.set_xticks(places, [model.replace("-", "-\n") for model in MODELS])
        axes.set(title=system, ylabel="test Error (SI units)")
        harness.logarithmic(axes)
    for axes in grid.flat[len(systems) :]:
        axes.set_axis_off()
    title = "large: mean; small: each data set; dash: mean inside the training range\n"
    harness.legend(figure, ncols=4, title=title + "hollow: a fit ended by a limit, or an output was not learned")
    harness.save_picture(figure, path)


def plot_reliability(rows: pd.DataFrame, path: Path) -> None:
    """Draw a panel per system: the share that intervals hold less the share that they promise."""
    # Old rows have no such shares.
    rows = rows[(rows["angles"] == "raw") & rows[f"within_{PROMISED[0]}"].notna()]
    systems, settings = drawn(rows), ordered(SETTINGS, rows["setting"])
    n_lines = -(-len(systems) // 2)
    size = {"figsize": (harness.WIDTH, 1.4 + 2.5 * n_lines), "squeeze": False}
    figure, grid = harness.pyplot().subplots(n_lines, 2, sharex=True, sharey=True, **size)
    for axes, system in zip(grid.flat, systems, strict=False):
        axes.axhline(0.0, color="black", linewidth=0.8)
        for setting, style in zip(settings, ("o-", "s:", "^--", "D-."), strict=False):
            for model, colour in zip(MODELS, harness.PALETTE, strict=False):
                own = rows[(rows["system"] == system) & (rows["setting"] == setting) & (rows["model"] == model)]
                held = own[[f"within_{share}" for share in PROMISED]].mean()
                if len(own):
                    label = f"{model}, {setting}"
                    axes.plot(PROMISED, held.to_numpy() - PROMISED, style, color=colour, markersize=4, label=label)
        axes.set_title(system)
    for axes in grid.flat[len(systems) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("share promised")
    for axes in grid[:, 0]:
        axes.set_ylabel("share held - promised")
    harness.legend(figure, ncols=4, title="means over data sets")
    harness.save_picture(figure, path)


def tables_of(rows: pd.DataFrame) -> harness.Tables:
    rows, noisy = sorted_rows(rows), bool((rows["noise"] > 0).any())
    settings = rows.groupby("setting", observed=True)
    return {
        "CR-2" if noisy else "Error": overview(rows, noisy),
        "calibration": calibration(rows),
        **{f"setting {setting}": details(own) for setting, own in settings},
    }


def main() -> None:
    parser = harness.argument_parser(
        __doc__, quick="12 trajectories, few iterations and one seed", seeds=N_SEEDS, systems=SYSTEMS
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS, help="default: all")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=SETTINGS, help="default: all")
    parser.add_argument("--angles", nargs="+", choices=("raw", "wrapped"), default=["raw"], help="default: raw")
    parser.add_argument("--noise", type=float, default=0.0, help="as a share of each training target's std; default: 0")
    parser.add_argument("--max-iter", type=int, help="of an EVGP; default: the regressor's")
    options = harness.parse(parser)
    noise = options.noise
    output = harness.output_path(options, f"results_table{f'_noise{noise:g}' if noise else ''}")
    cells = [
        Cell(system, model, setting, seed, angles, noise, options.size)
        for system, seed, angles, model, setting in itertools.product(
            options.systems, options.seeds, options.angles, options.models, options.settings
        )
        if has(system, model, setting, angles)
    ]
    n_failures = harness.run_missing(cells, partial(run, max_iter=options.max_iter), output, options.jobs)
    rows = harness.frame(output, size=options.size, noise=noise)
    (plot_reliability if noise else plot_errors)(rows, output.with_suffix(".png"))
    harness.write_page("The results: Table 4 of the paper, and ours", tables_of(rows), output, n_failures)


if __name__ == "__main__":
    main()
