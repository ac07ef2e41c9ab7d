"""Pictures of the rows of results_table.py: Errors beside the paper's; with noise, how reliable intervals are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from harness import WIDTH, Row, legend, pyplot, save_picture
from harness import column as of
from paper.learning_curves_report import COLOURS
from paper.results_table_report import (
    N_SEEDS,
    PAPER,
    STYLES,
    WRAPPED,
    Groups,
    group,
    limited,
    models_of,
    noisy,
    reliability,
    unlearned,
)

NOTES = """large: mean over data sets; small: each
a number below: of data sets, if not four
hollow: a fit ended by a limit or, crossed, its
Gaussian process learned nothing of an output
a dash of the same colour: mean of the rows
inside the training range"""
# Of models in panels of one setting.
LINES = {"EVGP-IFG": "o-", "EVGP-IF": "^--", "RES-VGP": "s-", "VGP": "v-", "RES-DBNN": "x-"}


def plot(rows: list[Row], path: Path) -> None:
    """The Error of each model, in the paper and here; with noise the reliability of intervals.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size and one noise.
    path : Path
        Of the PNG.
    """
    groups = {key: own for key, own in group(rows).items() if WRAPPED not in key[0]}
    if not groups:
        return
    figure = reliability_figure(groups) if noisy(rows) else errors_figure(groups, models_of(rows))
    save_picture(figure, path)


def errors_figure(groups: Groups, models: list[str]) -> Any:
    """A panel per system."""
    systems = list(dict.fromkeys(key[0] for key in groups))
    n_columns = min(2, len(systems))
    n_rows = -(-len(systems) // n_columns)
    height = 2.9 * n_rows + (0.0 if n_rows * n_columns > len(systems) else 2.4)  # the legend's, if no panel is free
    figure, grid = pyplot().subplots(n_rows, n_columns, figsize=(WIDTH, height), squeeze=False)
    settings = [setting for setting in STYLES if any(key[2] == setting for key in groups)]
    for axes, system in zip(grid.flat, systems, strict=False):
        own = {key[1:]: rows for key, rows in groups.items() if key[0] == system}
        errors_panel(axes, own, system, models, settings)
        axes.set_title(system)
    for axes in grid[:, 0]:
        axes.set_ylabel("test Error (SI units)")
    said = legend(figure, title="\n".join([*quick_note(groups), NOTES]))
    for axes in grid.flat[len(systems) :]:
        axes.set_axis_off()
        said.set_loc("center")
        said.set_bbox_to_anchor((0, 0, 1, 1), axes.transAxes)
    return figure


def reliability_figure(groups: Groups) -> Any:
    """A line of panels per system, with one for each setting; all of one scale."""
    settings = {key[0]: list(dict.fromkeys(other[2] for other in groups if other[0] == key[0])) for key in groups}
    n_rows, n_columns = len(settings), max(map(len, settings.values()))
    size = {"figsize": (WIDTH, 1.1 + 1.7 * n_rows), "squeeze": False}
    figure, grid = pyplot().subplots(n_rows, n_columns, sharex=True, sharey=True, **size)
    for line, (system, own) in zip(grid, settings.items(), strict=True):
        for axes in line[len(own) :]:
            axes.set_axis_off()
        for axes, setting in zip(line, own, strict=False):
            reliability_panel(axes, {key[1]: rows for key, rows in groups.items() if key[::2] == (system, setting)})
            axes.set_title(f"{system}, {setting}")
        line[0].set_ylabel("share held - promised")
    for axes in grid[-1]:
        axes.set_xlabel("share promised")
    low, high = axes.get_ylim()
    axes.set(xlim=(0, 1), ylim=(min(low, -0.05), max(high, 0.05)))
    noise = float(next(iter(groups.values()))[0]["noise"])
    notes = [*quick_note(groups), f"noise: {noise:.0%} of each target's standard deviation; means over data sets"]
    notes += ["hollow: a fit ended by a limit; three symbols: only CR-1 to 3 were measured"]
    legend(figure, ncols=3, title="\n".join(notes))
    return figure


def quick_note(groups: Groups) -> list[str]:
    """If it was one."""
    first = next(iter(groups.values()))[0]
    return ["a quick run, not to be compared"] if first["size"] == "quick" else []


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
            axes.text(place, 0.02, str(len(rows)), transform=axes.get_xaxis_transform(), ha="center", fontsize=7)
    for setting in settings:
        colour, marker = STYLES[setting]
        label = "ours: the paper's setting" if setting == "paper" else f"ours: {setting}"
        axes.plot([], [], marker, color=colour, markersize=7, label=label)
    axes.set_xticks(range(len(models)), models, fontsize=8)
    axes.set_xlim(-0.6, len(models) - 0.4)
    axes.tick_params(axis="x", length=0)
    axes.margins(y=0.12)
    axes.set_yscale("log")  # of powers: harness's plain numbers would be too long in some panels


def reliability_panel(axes: Any, own: dict[str, list[Row]]) -> None:
    """How much more or less intervals of each model hold than they promise."""
    axes.axhline(0.0, color="black", linewidth=1.2, label="as promised")
    for model, rows in own.items():
        promised, held = reliability(rows)
        how = {"color": COLOURS[model], "markersize": 4, "zorder": 3 if model.startswith("EVGP") else 2}
        face = "white" if any(map(limited, rows)) else COLOURS[model]
        axes.plot(promised, held - promised, LINES[model], markerfacecolor=face, **how)
        axes.plot([], [], LINES[model], label=model, **how)
