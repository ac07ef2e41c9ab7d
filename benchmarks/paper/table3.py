"""The paper's Table 3: time and space against inducing points, rows, outputs and units.

The script measures evaluations of the bound with its gradient, steps of Adam in the paper's setting, steps of the
network, and the size of fitted models. Exponents of power laws are fitted to the CSV.

    python benchmarks/paper/table3.py                    # two minutes of an idle core
    python benchmarks/paper/table3.py --quick            # few sizes, seconds
    python benchmarks/paper/table3.py --systems network  # without the GPs

Times are processor time of one thread, the fastest of several repeats, on random rows of 5 columns.
"""

from __future__ import annotations

import pickle
import sys
import time
from collections import namedtuple
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
import pandas as pd

import harness
from harness import figure_of
from paper.models import PAPER
from skevgp import BayesianMLPRegressor, EVGPRegressor
from skevgp.solvers import Adam

N_COLUMNS, BATCH, NETWORK_BATCH = 5, 512, 200
FEW = 16  # rows; shows what does not depend on their number
_SIZES = (10, 25, 50, 100, 200, 400, 800)
SIZES = {
    "n_rows": (300, 1000, 3000, 10_000, 30_000),
    "n_inducing": _SIZES,
    "n_outputs": (1, 2, 4, 8, 16),
    "n_layers": (1, 2, 4, 8, 16),
    "n_units": _SIZES,
}
LABELS = {
    "n_rows": "rows N",
    "n_inducing": "inducing points m",
    "n_outputs": "outputs o",
    "n_layers": "hidden layers L",
    "n_units": "units n",
    ("bound", "all"): "bound and gradient, shared points",
    ("bound", "kernel"): "bound and gradient, points per output",
    ("bound", "none"): "bound and gradient, nothing shared",
    ("adam step", ""): "Adam's step",
    ("network step", ""): f"network's step, {NETWORK_BATCH} rows",
    ("model", "paper"): "model, paper's setting",
    ("model", "skevgp"): "model, skevgp's setting",
    ("network", ""): "network",
}

# One measurement. Sizes that a model does not have are 0.
Cell = namedtuple("Cell", "what setting n_rows n_inducing n_outputs n_layers n_units")


@dataclass(frozen=True)
class Curve:
    """Measurements that differ in one size: a line of the table. ``above`` is the smallest size of the fit."""

    what: str
    setting: str
    varied: str
    above: int
    paper: int
    value: str = "seconds"
    few: bool = False
    sizes: tuple[int, ...] = ()

    def cells(self) -> Iterator[Cell]:
        network = "network" in self.what
        n_rows = 2000 if network else FEW if self.few else 4800
        cell = Cell(self.what, self.setting, n_rows, *((0, 4, 2, 100) if network else (100, 4, 0, 0)))
        for size in self.sizes or SIZES[self.varied]:
            yield cell._replace(**{self.varied: size})

    @property
    def name(self) -> str:
        end = {"seconds": "", "n_bytes": ", pickled", "n_parameters": ", parameters"}[self.value]
        return LABELS[self.what, self.setting] + end + (f", {FEW} rows" if self.few else "")


CURVES = (
    Curve("bound", "all", "n_inducing", 100, 3),
    Curve("bound", "all", "n_inducing", 200, 3, few=True),
    Curve("bound", "kernel", "n_inducing", 100, 3),
    Curve("bound", "kernel", "n_inducing", 200, 3, few=True),
    Curve("bound", "all", "n_rows", 3000, 1),
    Curve("bound", "kernel", "n_rows", 3000, 1),
    Curve("adam step", "", "n_rows", 3000, 0),
    *(Curve("bound", sharing, "n_outputs", 4, 1) for sharing in ("all", "kernel", "none")),
    Curve("adam step", "", "n_outputs", 4, 1),
    Curve("adam step", "", "n_inducing", 100, 3),
    Curve("adam step", "", "n_inducing", 200, 3, few=True),
    Curve("network step", "", "n_units", 200, 2),
    Curve("network step", "", "n_layers", 4, 1),
    *(
        Curve("model", setting, "n_inducing", 200, 1, value)
        for setting in ("skevgp", "paper")
        for value in ("n_bytes", "n_parameters")
    ),
    *(Curve("model", setting, "n_rows", 1000, 0, "n_bytes") for setting in ("skevgp", "paper")),
    *(Curve("model", setting, "n_outputs", 4, 1, "n_bytes") for setting in ("skevgp", "paper")),
    Curve("model", "paper", "n_outputs", 4, 1, "n_parameters"),
    *(Curve("network", "", "n_units", 50, 2, value, sizes=_SIZES[:-2]) for value in ("n_bytes", "n_parameters")),
)
QUICK = tuple(replace(curve, above=0, sizes=SIZES[curve.varied][:3]) for curve in CURVES)


def seconds_of(cell: Cell, X: np.ndarray, Y: np.ndarray, points: np.ndarray) -> list[float]:
    """Measure processor seconds of evaluations or steps."""
    if cell.what == "bound":
        one = harness.evaluation_seconds(X, Y, cell.n_inducing, sharing=cell.setting)
        return [seconds * (cell.n_outputs if cell.setting == "none" else 1) for seconds in one]
    if cell.what == "adam step":
        times: list[float] = []
        solver = Adam(BATCH, callback=lambda *_: times.append(time.process_time()), posterior="diagonal")
        EVGPRegressor(inducing_init=points, max_iter=30, random_state=0, **PAPER | {"solver": solver}).fit(X, Y)
        return list(np.diff(times))
    layers = (cell.n_units,) * cell.n_layers
    network = BayesianMLPRegressor(layers, batch_size=NETWORK_BATCH, max_iter=1, n_samples=2, random_state=0)
    n_steps = -(-cell.n_rows // NETWORK_BATCH)
    return [harness.timed(lambda: network.fit(X, Y))[0] / n_steps for _ in range(4)][1:]


def run(cell: Cell) -> dict[str, Any]:
    """Measure time, or parameters and pickled bytes of a fitted model."""
    rng = np.random.RandomState(0)
    X = rng.randn(cell.n_rows, N_COLUMNS)
    Y = np.sin(X @ rng.randn(N_COLUMNS, cell.n_outputs)) + 0.01 * rng.randn(cell.n_rows, cell.n_outputs)
    points = np.random.RandomState(1).randn(cell.n_inducing, N_COLUMNS)
    row: dict[str, Any] = dict.fromkeys(("seconds", "seconds_median", "repeats", "n_parameters", "n_bytes"), "")
    with harness.one_thread():
        if cell.what not in ("model", "network"):
            seconds = seconds_of(cell, X, Y, points)
            row |= {"seconds": min(seconds), "seconds_median": np.median(seconds), "repeats": len(seconds)}
        else:
            if cell.what == "network":
                model = BayesianMLPRegressor((cell.n_units,) * cell.n_layers, max_iter=1, random_state=0)
            else:
                setting = PAPER if cell.setting == "paper" else {}
                model = EVGPRegressor(inducing_init=points, max_iter=0, random_state=0, **setting)
            n_bytes = len(pickle.dumps(model.fit(X, Y))) - (cell.what == "model") * len(pickle.dumps(points))
            row |= {"n_parameters": model.n_parameters_, "n_bytes": n_bytes}
    return row


def points_of(curve: Curve, data: pd.DataFrame) -> pd.Series:
    """Return the measurements of a curve by size."""
    wanted = pd.DataFrame(list(curve.cells()))
    found = wanted.merge(data.assign(setting=data["setting"].astype(object).fillna("")), how="inner")
    return found.set_index(curve.varied)[curve.value].astype(float)


def exponents(curve: Curve, points: pd.Series) -> tuple[float, float, float]:
    """Return the exponent of the power law, and the lowest and highest one between neighbouring sizes."""
    points = np.log(points[points.index >= curve.above])
    x, steps = np.log(points.index), np.diff(points) / np.diff(np.log(points.index))
    return np.polyfit(x, points, 1)[0], steps.min(), steps.max()


def table_of(curves: list[Curve], data: pd.DataFrame) -> pd.DataFrame:
    """Return exponents beside the paper's."""
    lines = []
    for curve in curves:
        points = points_of(curve, data)
        fitted, low, high = (f"{round(value, 2) + 0.0:.2f}" for value in exponents(curve, points))
        unit, scale = {"seconds": (" s", 1.0), "n_bytes": (" MB", 1e-6), "n_parameters": ("", 1.0)}[curve.value]
        line = {"quantity": curve.name, "against": LABELS[curve.varied], "paper's exponent": curve.paper}
        line["ours (between neighbours)"] = f"{fitted} ({low} to {high})"
        line["fitted to"] = f"{max(points.index[0], curve.above):g} to {points.index[-1]:g}"
        line["smallest to largest"] = " to ".join(map(figure_of, scale * points.iloc[[0, -1]])) + unit
        lines.append(line)
    return pd.DataFrame(lines)


def short(name: str) -> str:
    """Shorten the name of a curve for the legend of a panel that says the rest."""
    for part in (" and gradient", "model, ", ", pickled"):
        name = name.replace(part, "")
    return name


def plot(curves: list[Curve], data: pd.DataFrame, path: Path) -> None:
    """Draw time against widths, rows and outputs, and space against widths."""
    panels = {
        "Time of wider models": ("n_inducing", "n_units"),
        "Time with more rows": ("n_rows",),
        "Time with more outputs or layers": ("n_outputs", "n_layers"),
        "Space of wider models": ("n_inducing", "n_units"),
    }
    figure, grid = harness.pyplot().subplots(2, 2, figsize=(harness.WIDTH, 7.0))
    for axes, (title, varied) in zip(grid.flat, panels.items(), strict=True):
        value, label, scale = "seconds", "time (ms)", 1e3
        if title.startswith("Space"):
            value, label, scale = "n_bytes", "pickled (MB)", 1e-6
        shown = [curve for curve in curves if curve.varied in varied and curve.value == value]
        axes.set_visible(bool(shown))
        for number, curve in enumerate(shown):
            points = points_of(curve, data)
            name = f"{short(curve.name)}: {exponents(curve, points)[0]:.2f}"
            marker = "o" if number < len(harness.PALETTE) else "s"  # colours begin again
            axes.plot(scale * points, f"{marker}{':' if curve.few else '-'}", markersize=4, label=name)
        if not shown:
            continue
        for which in "xy":
            harness.logarithmic(axes, which)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** (0.11 * len(shown)))  # room for the legend
        axes.set(title=title, xlabel=" or ".join(LABELS[name] for name in varied), ylabel=label)
        axes.legend(loc="upper left")
    figure.suptitle("Numbers in the legends: exponents of power laws; bound: with its gradient")
    harness.save_picture(figure, path)


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="few sizes", systems=("gp", "network"))
    parser.set_defaults(jobs=1)
    options = harness.parse(parser)
    output = harness.output_path(options, "complexity")
    curves = [
        curve
        for curve in (QUICK if options.quick else CURVES)
        if ("network" if "network" in curve.what else "gp") in options.systems
    ]
    cells = [cell for curve in curves for cell in curve.cells()]
    n_failures = harness.run_missing(cells, run, output, options.jobs)
    data = harness.frame(output)
    tables = {}
    if not n_failures:
        plot(curves, data, output.with_suffix(".png"))
        tables = {"complexity": table_of(curves, data)}
    harness.write_page("Complexity: the paper's Table 3, and measured", tables, output, n_failures)


if __name__ == "__main__":
    main()
