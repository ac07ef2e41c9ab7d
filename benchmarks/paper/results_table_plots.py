"""Pictures of the rows of results_table.py: Errors beside the paper's; with noise, how reliable intervals are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from harness import WIDTH, Row, legend, logarithmic, pyplot, save_picture
from harness import column as of
from paper.results_table_report import (
    N_SEEDS,
    PAPER,
    STYLES,
    WRAPPED,
    group,
    limited,
    models_of,
    noisy,
    reliability,
    unlearned,
)


def plot(rows: list[Row], path: Path) -> None:
    """A panel per system: the Error of each model, in the paper and here; with noise the reliability of intervals.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size and one noise.
    path : Path
        Of the PNG.
    """
    groups, models = {key: own for key, own in group(rows).items() if WRAPPED not in key[0]}, models_of(rows)
    if not groups:
        return
    systems = list(dict.fromkeys(key[0] for key in groups))
    n_columns = min(2, len(systems))
    n_rows = -(-len(systems) // n_columns)
    figure, grid = pyplot().subplots(n_rows, n_columns, figsize=(WIDTH, 0.9 + 2.7 * n_rows), squeeze=False)
    settings = [setting for setting in STYLES if any(key[2] == setting for key in groups)]
    for axes, system in zip(grid.flat, systems, strict=False):
        own = {key[1:]: rows for key, rows in groups.items() if key[0] == system}
        if noisy(rows):
            reliability_panel(axes, own)
        else:
            errors_panel(axes, own, system, models, settings)
        axes.set_title(system)
    for axes in grid.flat[len(systems) :]:
        axes.set_axis_off()
    for axes in grid[:, 0]:
        axes.set_ylabel("share held - promised" if noisy(rows) else "test Error (SI units)")
    notes = ["a quick run, not to be compared"] if rows[0]["size"] == "quick" else []
    if noisy(rows):
        notes += [f"noise: {float(rows[0]['noise']):.0%} of each target's standard deviation; means over data sets"]
        notes += ["hollow: a fit ended by a limit; three symbols: only CR-1 to 3 were measured"]
    else:
        notes += ["large: mean over data sets, with their number if not four, small: each"]
        notes += ["hollow: a fit ended by a limit or, crossed, its Gaussian process learned nothing of an output"]
        notes += ["a dash of the same colour: mean of the rows inside the training range"]
    legend(figure, ncols=3 if n_columns > 1 else 2, title="\n".join(notes))
    save_picture(figure, path)


def errors_panel(
    axes: Any, own: dict[tuple[str, str], list[Row]], system: str, models: list[str], settings: list[str]
) -> None:
    """The Error of each model: a bar in the paper, a marker for each setting here."""
    papers, places = [PAPER[system][model].error for model in models], np.arange(len(models))
    axes.hlines(papers, places - 0.42, places + 0.42, color="black", linewidth=1.8, label="in the paper")
    offsets = dict(zip(settings, np.linspace(-0.4, 0.4, len(settings)), strict=True))
    for (model, setting), rows in own.items():
        values, (colour, marker) = of(rows, "error_mean"), STYLES[setting]
        place = models.index(model) + offsets[setting]
        nothing = any(map(unlearned, rows))
        face = "white" if nothing or any(map(limited, rows)) else colour
        axes.plot([place] * len(values), values, ".", color=colour, markersize=4, alpha=0.5)
        axes.plot(place, values.mean(), marker, color=colour, markerfacecolor=face, markersize=7)
        axes.plot(place, of(rows, "error_inside").mean(), "_", color=colour, markersize=12)
        if nothing:
            axes.plot(place, values.mean(), "x", color=colour, markersize=7)
        if len(rows) != N_SEEDS:
            where = {"xytext": (0, 5), "textcoords": "offset points", "ha": "center", "fontsize": 7}
            axes.annotate(str(len(rows)), (place, values.mean()), color=colour, **where)
    for setting in settings:
        colour, marker = STYLES[setting]
        label = "ours: the paper's setting" if setting == "paper" else f"ours: {setting}"
        axes.plot([], [], marker, color=colour, markersize=7, label=label)
    axes.set_xticks(range(len(models)), models, fontsize=9)
    axes.set_xlim(-0.5, len(models) - 0.5)
    axes.tick_params(axis="x", length=0)
    axes.margins(y=0.12)
    logarithmic(axes)


def reliability_panel(axes: Any, own: dict[tuple[str, str], list[Row]]) -> None:
    """How much more or less intervals hold than they promise."""
    axes.axhline(0.0, color="black", linewidth=1.2, label="as promised")
    lines = {"EVGP-IFG": "o-", "EVGP-IF": "^--", "RES-VGP": "s-.", "VGP": "v:", "RES-DBNN": "x:"}
    for (model, setting), rows in own.items():
        promised, held = reliability(rows)
        colour, _ = STYLES[setting]
        face = "white" if any(map(limited, rows)) else colour
        axes.plot(promised, held - promised, lines[model], color=colour, markerfacecolor=face, markersize=4)
    for model, line in lines.items():
        axes.plot([], [], line, color="0.3", markersize=4, label=model)
    for setting in dict.fromkeys(setting for _, setting in own):
        axes.plot([], [], color=STYLES[setting][0], linewidth=4, label=setting)
    low, high = axes.get_ylim()
    axes.set(xlabel="share promised", xlim=(0, 1), ylim=(min(low, -0.05), max(high, 0.05)))
