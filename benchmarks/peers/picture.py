"""Draw what against_peers.py measured: the bound on its way, and what error it took how long to reach."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

Row = dict[str, str]

# Okabe & Ito's colours: told apart with any colour vision.
STYLES = {
    ("skevgp", "all"): ("#0072B2", "-", "skevgp, shared"),
    ("skevgp", "none"): ("#56B4E9", "-", "skevgp, per output"),
    ("GPflow SGPR", "none"): ("#D55E00", "-", "GPflow, per output"),
    ("GPflow SGPR", "all"): ("#E69F00", "-", "GPflow, shared"),
    ("GPyTorch SGPR", "none"): ("#009E73", "-", "GPyTorch SGPR"),
    ("GPyTorch SVGP", "none"): ("#CC79A7", "-", "GPyTorch SVGP"),
    ("scikit-learn GPR", "none"): ("#555555", "-", "scikit-learn GPR, 600 rows"),
}
LINEAR = "scikit-learn BayesianRidge"
_SIZE = 8.0
# Room for the names, to the right of where the fits ended: a share of the axis before.
_ROOM = 0.45


def draw(rows: list[Row], curves: list[Row], path: Path, model: str = "RES-VGP") -> None:
    """One column per data set: the bound per row over time (the first seed), and Error over time (all seeds).

    Parameters
    ----------
    rows, curves : list of dict
        Of the two CSVs.
    path : Path
        Of the PNG.
    model : str
        Which of the models; what the CSV has, if it is not there.
    """
    done = [row for row in rows if row["seconds"] and (row["peer"], row["sharing"]) in STYLES]
    if not done:
        return
    model = model if any(row["model"] == model for row in done) else done[0]["model"]
    done = [row for row in done if row["model"] == model]
    curves = [row for row in curves if row["model"] == model]
    datasets = list(dict.fromkeys(row["dataset"] for row in done))
    figure, grid = plt.subplots(
        2, len(datasets), figsize=(1.2 + 4.4 * len(datasets), 7.0), squeeze=False, sharex="col", layout="constrained"
    )
    for column, dataset in enumerate(datasets):
        own = [row for row in done if row["dataset"] == dataset]
        n_train = max(int(row["n_train"]) for row in own)
        m = next(row["m"] for row in own if int(row["n_train"]) == n_train)
        first = min(int(row["seed"]) for row in own)
        linear = [row for row in rows if row["peer"] == LINEAR and (row["dataset"], row["model"]) == (dataset, model)]
        on_the_way = [row for row in curves if row["dataset"] == dataset and int(row["seed"]) == first]
        # Names are placed by where points are on the page: the axis that both share comes first.
        _time_axis(grid[0, column], own, on_the_way)
        _errors(grid[1, column], own, [float(row["error_mean"]) for row in linear if row["seconds"]])
        _bounds(grid[0, column], on_the_way)
        grid[0, column].set_title(f"{dataset}: {n_train} rows, {m} inducing points", fontsize=10)
        grid[1, column].set_xlabel("seconds to fit all outputs")
    grid[0, 0].set_ylabel("bound so far, nats per row, all outputs")
    grid[1, 0].set_ylabel("test Error (mean)")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _time_axis(axes: Axes, rows: list[Row], curves: list[Row]) -> None:
    """From about where the first curve is worth looking at."""
    last = [float(row["seconds"]) for row in rows]
    lowest = min((_per_row(row, "bound") for row in rows if row["bound"] != "nan"), default=np.inf)
    begun = [float(row["seconds_so_far"]) for row in curves if _per_row(row, "bound_so_far") > lowest]
    first = 0.6 * min([*last, *begun])
    axes.set_xscale("log")
    axes.set_xlim(first, max(last) * (max(last) / first) ** _ROOM)


def _per_row(row: Row, column: str) -> float:
    return float(row[column]) / int(row["n_train"])


def _bounds(axes: Axes, curves: list[Row]) -> None:
    """The best bound so far; where a line ends, its fit ended."""
    ends = []
    for (peer, sharing), (colour, line, label) in STYLES.items():
        own = [row for row in curves if (row["peer"], row["sharing"]) == (peer, sharing)]
        if not own:
            continue
        seconds = np.array([float(row["seconds_so_far"]) for row in own])
        bound = np.array([_per_row(row, "bound_so_far") for row in own])
        if len(own) > 1:
            axes.plot(seconds, bound, line, color=colour, linewidth=1.8, drawstyle="steps-post")
        axes.plot(seconds[-1], bound[-1], "o", color=colour, markersize=5)
        ends.append((seconds[-1], bound[-1], label, colour))
    _grid(axes)
    if ends:
        values = [bound for _, bound, *_ in ends]
        # The climb up to where the first fit ended says little.
        bottom, room = min(values), max(np.ptp(values), 1.0)
        axes.set_ylim(bottom - room, max(values) + 0.15 * room)
        _label(axes, ends)


def _errors(axes: Axes, rows: list[Row], linear: list[float]) -> None:
    """The median over seeds as a point, and each seed as a smaller one; what a linear model leaves as a line."""
    points = []
    for (peer, sharing), (colour, _, label) in STYLES.items():
        own = [row for row in rows if (row["peer"], row["sharing"]) == (peer, sharing)]
        if not own:
            continue
        seconds, error = (np.array([float(row[name]) for row in own]) for name in ("seconds", "error_mean"))
        axes.plot(seconds, error, "o", color=colour, markersize=3, alpha=0.5)
        points.append((float(np.median(seconds)), float(np.median(error)), label, colour))
        axes.plot(*points[-1][:2], "o", color=colour, markersize=6)
    if linear:
        axes.axhline(np.median(linear), color="#999999", linestyle=":", linewidth=1.2)
        axes.annotate(
            "linear regression",
            (0.02, float(np.median(linear))),
            (0, -3),
            xycoords=axes.get_yaxis_transform(),
            textcoords="offset points",
            va="top",
            fontsize=_SIZE,
            color="#777777",
        )
    axes.set_yscale("log")
    axes.margins(y=0.15)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "235" else "")
    axes.tick_params(axis="y", which="both", labelsize=_SIZE)
    _grid(axes)
    _label(axes, points)


def _grid(axes: Axes) -> None:
    axes.grid(alpha=0.25, which="major")
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")


def _label(axes: Axes, ends: list[tuple[float, float, str, str]]) -> None:
    """Write each name to the right of its point, clear of other names and points."""
    axes.figure.canvas.draw()
    to_points: Any = axes.transData.transform
    taken: list[tuple[float, ...]] = []
    dots = [to_points(end[:2]) for end in ends]
    for dot, (seconds, value, label, colour) in sorted(zip(dots, ends, strict=True), key=lambda pair: pair[0][1]):
        width, height = 0.62 * _SIZE * len(label) * axes.figure.dpi / 72, 1.5 * _SIZE * axes.figure.dpi / 72
        box = (dot[0] + 8, dot[1] - height / 2, dot[0] + 8 + width, dot[1] + height / 2)
        obstacles = [*taken, *((x - 4, y - 4, x + 4, y + 4) for x, y in dots)]
        lifts = sorted(np.arange(-6, 7) * height / 2, key=abs)
        lift = next((lift for lift in lifts if not any(_overlap(box, lift, other) for other in obstacles)), 0.0)
        taken.append((box[0], box[1] + lift, box[2], box[3] + lift))
        axes.annotate(
            label,
            (seconds, value),
            (8 * 72 / axes.figure.dpi, lift * 72 / axes.figure.dpi),
            textcoords="offset points",
            va="center",
            fontsize=_SIZE,
            color=colour,
            annotation_clip=False,
        )


def _overlap(box: tuple[float, ...], lift: float, other: tuple[float, ...]) -> bool:
    across = box[0] < other[2] and other[0] < box[2]
    return across and box[1] + lift < other[3] and other[1] < box[3] + lift
