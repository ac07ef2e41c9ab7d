"""The paper's Figure 6: the Error on a fixed test set as trajectories are added to the training set.

Run s learns from the first trajectories of the data of random state s. All runs of a system are tested on the data of
random state 1000.

    python benchmarks/paper/figure6.py                       # everything, four runs: many hours of one core
    python benchmarks/paper/figure6.py --quick               # two sizes, few iterations, one run: a few minutes
    python benchmarks/paper/figure6.py --systems pendulum --settings paper skevgp-angles
    python benchmarks/paper/figure6.py --systems iiwa14 --max-iter 60  # of each GP

The settings are those of table4.py. "skevgp-nominal" has only EVGP-IFG on iiwa14. In skevgp's settings a run takes
20 seconds of one core for the pendulum, 3 minutes for the cartpole, 12 for the acrobot and 3 hours for iiwa14.
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
from harness import figure_of, ordered
from paper.models import MODELS, PUBLISHED, QUICK_TRAJECTORIES, SETTINGS, SYSTEMS, Fit, fitted_row, has
from skevgp.datasets import make_dynamics

N_TRAJECTORIES = {
    "pendulum": (3, 6, 12, 24, 48),
    "cartpole": (3, 6, 12, 24, 48),
    "acrobot": (6, 12, 24, 48, 93),
    "iiwa14": (20, 60, 150, 465),
}
TEST_STATE = 1000
NOMINAL = "EVGP-IFG, nominal"
COLOURS = dict(zip([*MODELS, NOMINAL], np.array(harness.PALETTE)[[4, 5, 2, 1, 0, 3]], strict=True))

Cell = namedtuple("Cell", "system model setting n_trajectories seed size")


@lru_cache(maxsize=2)
def data(system: str, random_state: int, size: str) -> Bunch:
    """Return all trajectories of a run, or the test set."""
    return make_dynamics(system, QUICK_TRAJECTORIES if size == "quick" else None, random_state=random_state)


def run(cell: Cell, max_iter: int | None) -> dict[str, Any]:
    """Fit one model to the first trajectories of a run."""
    whole, test = (data(cell.system, state, cell.size) for state in (cell.seed, TEST_STATE))
    rows = whole.groups < cell.n_trajectories
    train = Bunch(data=whole.data[rows], target=whole.target[rows], groups=whole.groups[rows])
    fit = Fit(cell.system, cell.model, cell.setting, cell.seed, cell.size, max_iter)
    return fitted_row(fit, train, test, n_rows=len(train.data))


def named(rows: pd.DataFrame) -> pd.DataFrame:
    """Count EVGP-IFG of the setting skevgp-nominal as a model of the setting skevgp."""
    nominal = rows["setting"] == "skevgp-nominal"
    return rows.assign(model=rows["model"].mask(nominal, NOMINAL), setting=rows["setting"].str.removesuffix("-nominal"))


def table_of(rows: pd.DataFrame, measure: str, corner: str, spread: bool) -> pd.DataFrame:
    """Return means over runs, with lowest, highest and number of runs: a line per model, a column per size."""

    def text(values: pd.Series) -> str:
        mean = figure_of(values.mean())
        if not spread or len(values) < 2:
            return mean
        return f"{mean} ({figure_of(values.min())} to {figure_of(values.max())}, {len(values)})"

    found = rows.groupby(["model", "n_rows"])[measure].apply(text).unstack(fill_value="")
    found = found.loc[ordered(COLOURS, found.index)]
    return found.rename(columns="{} rows".format).rename_axis(corner).reset_index()


def tables_of(rows: pd.DataFrame) -> harness.Tables:
    tables = {}
    for setting in sorted(rows["setting"].unique(), key=lambda name: name != "skevgp"):
        of_setting = rows[rows["setting"] == setting]
        for system in ordered(SYSTEMS, of_setting["system"]):
            own = of_setting[of_setting["system"] == system]
            tables[f"{setting}, {system}, Error"] = table_of(own, "error_mean", "Error of", True)
            tables[f"{setting}, {system}, median row"] = table_of(own, "error_median", "median row of", False)
    return tables


def plot(rows: pd.DataFrame, path: Path) -> None:
    """Draw a panel per system: medians and quartiles over runs, and the paper's last points."""
    systems = ordered(SYSTEMS, rows["system"])
    n_lines = -(-len(systems) // 2)
    figure, grid = harness.pyplot().subplots(n_lines, 2, figsize=(harness.WIDTH, 0.8 + 2.7 * n_lines), squeeze=False)
    for axes, system in zip(grid.flat, systems, strict=False):
        own = rows[rows["system"] == system]
        for number, (name, colour) in enumerate(COLOURS.items()):
            runs = own[own["model"] == name].groupby("n_rows")
            quartiles = runs["error_mean"].quantile([0.25, 0.5, 0.75]).unstack()
            if quartiles.empty:
                continue
            middle, x = quartiles[0.5], quartiles.index * 1.02 ** (number - 2.5)  # bars stand apart
            bars = (middle - quartiles[0.25], quartiles[0.75] - middle)
            axes.errorbar(x, middle, bars, fmt="-", color=colour)
            faces = [colour if ended else "white" for ended in runs["converged"].all()]
            axes.scatter(x, middle, c=faces, edgecolors=colour, s=20, zorder=3)
            axes.plot([], [], "o-", color=colour, label=name)
            if name in MODELS:
                place = 1.25 * 1.08**number * own["n_rows"].max()
                axes.plot(place, PUBLISHED.loc[system, name].error, "*", color=colour)
        axes.set(title=system, xlabel="training rows", ylabel="test Error (SI units)")
        for which in "xy":
            harness.logarithmic(axes, which)
    for axes in grid.flat[len(systems) :]:
        axes.set_axis_off()
    title = "medians of runs, bars from first to third quartile; hollow: a fit ended by a limit; star: in the paper"
    harness.legend(figure, ncols=4, title=title)
    harness.save_picture(figure, path)


def main() -> None:
    parser = harness.argument_parser(
        __doc__, quick="4 and 12 trajectories, few iterations and one run", seeds=4, systems=N_TRAJECTORIES
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS, help="default: all")
    default = ["skevgp", "skevgp-nominal"]
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=default, help=f"default: {default}")
    parser.add_argument("--max-iter", type=int, help="of an EVGP; default: the regressor's")
    options = harness.parse(parser)
    output = harness.output_path(options, "learning_curves")
    cells = [
        Cell(system, model, setting, n_trajectories, seed, options.size)
        for system in options.systems
        for seed, n_trajectories, model, setting in itertools.product(
            options.seeds,
            (4, QUICK_TRAJECTORIES) if options.quick else N_TRAJECTORIES[system],
            options.models,
            options.settings,
        )
        if has(system, model, setting) and (setting != "skevgp-nominal" or model == "EVGP-IFG")
    ]
    n_failures = harness.run_missing(cells, partial(run, max_iter=options.max_iter), output, options.jobs)
    rows = named(harness.frame(output, size=options.size))
    for setting, own in rows.groupby("setting"):
        plot(own, output.with_name(f"{output.stem}{'' if setting == 'skevgp' else f'_{setting}'}.png"))
    harness.write_page("Learning curves: Figure 6 of the paper, and ours", tables_of(rows), output, n_failures)


if __name__ == "__main__":
    main()
