"""What the rows of results_table.py say, beside the paper's Table 4: a Markdown page and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness import Row, figure_of, logarithmic, provenance_text, pyplot, save_picture, table
from harness import column as of


class Result(NamedTuple):
    """A row of the paper's Table 4."""

    cr1: float
    cr2: float
    cr3: float
    error: float
    std_norm: float
    n_parameters: int


MODELS = ("VGP", "RES-VGP", "RES-DBNN", "EVGP-IF", "EVGP-IFG")
PAPER: dict[str, dict[str, Result]] = {
    system: {model: Result(*values) for model, values in zip(MODELS, results, strict=True)}
    for system, results in {
        "pendulum": (
            (0.582, 0.841, 0.910, 0.343, 0.273, 407),
            (0.833, 0.951, 0.974, 0.155, 0.216, 407),
            (0.691, 0.908, 0.959, 0.017, 0.010, 634),
            (0.936, 0.986, 0.993, 0.013, 0.024, 119),
            (0.871, 0.965, 0.985, 0.005, 0.007, 123),
        ),
        "cartpole": (
            (0.505, 0.828, 0.901, 0.188, 0.185, 2813),
            (0.518, 0.848, 0.924, 0.216, 0.153, 2813),
            (0.336, 0.767, 0.901, 0.044, 0.036, 6008),
            (0.933, 0.980, 0.990, 0.016, 0.184, 1733),
            (0.935, 0.976, 0.986, 0.011, 0.041, 1741),
        ),
        "acrobot": (
            (0.715, 0.861, 0.913, 1.100, 2.137, 7013),
            (0.705, 0.846, 0.904, 0.820, 1.428, 7013),
            (0.606, 0.837, 0.899, 0.289, 0.378, 8408),
            (0.794, 0.908, 0.950, 0.151, 0.290, 4253),
            (0.712, 0.893, 0.952, 0.131, 0.251, 4269),
        ),
        "iiwa14": (
            (0.000, 0.051, 0.311, 0.048, 0.039, 161049),
            (0.002, 0.163, 0.519, 0.055, 0.047, 161049),
            (0.001, 0.096, 0.346, 0.036, 0.025, 143028),
            (0.040, 0.353, 0.684, 0.037, 0.035, 113337),
            (0.083, 0.480, 0.773, 0.027, 0.030, 113673),
        ),
    }.items()
}
PAPER["cartpole_damped"] = PAPER["cartpole"]  # the paper has one, and does not say which
# Share of targets within two standard deviations of a normal distribution, and how far from it counts as calibrated.
TWO_SIGMA, TOLERANCE = 0.954, 0.03
# Pairs of models of which the first, knowing more, should have the lower Error.
ORDER = (("EVGP-IFG", "EVGP-IF"), ("EVGP-IF", "VGP"), ("EVGP-IF", "RES-VGP"))
# Colour (Okabe & Ito's palette, safe for colour-blind readers) and marker of each setting.
STYLES = {
    "paper": ("#E69F00", "s"),
    "skevgp": ("#0072B2", "o"),
    "skevgp-angles": ("#009E73", "^"),
    "skevgp-nominal": ("#CC79A7", "D"),
}


def group(rows: list[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """Rows of each (system, model, setting), in the order of the paper's table."""
    groups = {
        (system, model, setting): [
            row for row in rows if (row["system"], row["model"], row["setting"]) == (system, model, setting)
        ]
        for setting in STYLES
        for system in PAPER
        for model in MODELS
    }
    return {key: own for key, own in groups.items() if own}


def noisy(rows: list[Row]) -> bool:
    """Whether targets have noise, of which the paper tells nothing: containing ratios count then, not its Errors."""
    return float(rows[0]["noise"]) > 0.0


def models_of(rows: list[Row]) -> list[str]:
    """All of the paper's; with noise those that are there."""
    present = {row["model"] for row in rows}
    return [model for model in MODELS if model in present or not noisy(rows)]


def paragraphs(rows: list[Row]) -> list[str]:
    """A page: all settings at a glance by mean Error, with noise by CR-2, then a table of everything for each setting.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size and one noise.

    Returns
    -------
    parts : list of str
    """
    groups = group(rows)
    settings = [setting for setting in STYLES if any(key[2] == setting for key in groups)]
    systems = [system for system in PAPER if any(key[0] == system for key in groups)]
    heading, measure, in_paper = ("CR-2", "cr2", "cr2") if noisy(rows) else ("Error", "error_mean", "error")
    glance = [
        [system, model, f"{getattr(PAPER[system][model], in_paper):.3f}"]
        + [
            figure_of(of(own, measure).mean()) if (own := groups.get((system, model, setting))) else ""
            for setting in settings
        ]
        for system in systems
        for model in models_of(rows)
    ]
    seeds = sorted({int(row["seed"]) for row in rows})
    parts = [
        "# The results: Table 4 of the paper, and ours",
        "Written by `benchmarks/paper/results_table.py`. Error is the mean over test rows of the norm of the error, in "
        f"SI units. Noise: {rows[0]['noise']} of each training target's standard deviation, on training and test "
        f"targets. Seeds: {', '.join(map(str, seeds))}. {provenance_text(rows)}",
    ]
    if noisy(rows):
        parts.append(
            "The paper tells of no noise on its data, so its numbers are no target here; our Errors contain the test "
            f"targets' noise. CR-2 should be a normal distribution's {TWO_SIGMA}."
        )
    if rows[0]["size"] == "quick":
        parts.append(
            "**A quick run**: fewer rows and iterations than the paper's, not to be compared with its numbers."
        )
    parts += [
        f"## {heading}, mean over seeds",
        table(["system", "model", "in the paper", *(f"ours: {setting}" for setting in settings)], glance),
        "### Where it falls short",
        shortfalls(groups, noisy(rows)),
        *(part for setting in settings for part in (f"## Setting: {setting}", details(groups, setting))),
        "Each pair is *ours / the paper's*; ours are means over seeds, but for the spread of the Error over seeds "
        "(median and largest). Median and 99 % of rows: quantiles of the error over test rows. NLPD: negative log "
        "predictive density, nats per row. Seconds: processor time of the fit, one thread.",
    ]
    if {"VGP", "RES-VGP"} & set(models_of(rows)):
        parts.append("VGP and RES-VGP have 1.4 to 4 times as many inducing points as EVGP: the paper's sizes.")
    stopped = [
        f"{system} {model} {setting} ({sum(row['converged'] == 'False' for row in own)} of {len(own)})"
        for (system, model, setting), own in groups.items()
        if any(row["converged"] == "False" for row in own)
    ]
    if stopped:
        parts.append(f"Fits that ended with a ConvergenceWarning: {', '.join(stopped)}.")
    limited = [
        f"{system} {model} {setting} ({', '.join(sorted({row['max_iter'] for row in own} - {''}, key=int))})"
        for (system, model, setting), own in groups.items()
        if any(row["max_iter"] for row in own)
    ]
    if limited:
        parts.append(f"Iterations were limited by `--max-iter` in: {', '.join(limited)}.")
    if any(key[1:] == ("VGP", "skevgp-angles") for key in groups):
        parts.append(
            "A kernel of sines and cosines cannot tell an angle from the same after a turn. Where joints turn, VGP, "
            "whose targets are angles, cannot learn them in the setting skevgp-angles; the other models know that an "
            "angle starts where it is."
        )
    return parts


def shortfalls(groups: dict[tuple[str, str, str], list[Row]], with_noise: bool = False) -> str:
    """Where means over seeds miss a normal's CR-2 and, without noise, the models' order or the paper's Error."""
    errors = {key: of(own, "error_mean").mean() for key, own in groups.items()}
    unordered = [
        f"{system} {setting}: {better} {figure_of(errors[system, better, setting])}, "
        f"{worse} {figure_of(errors[system, worse, setting])}"
        for system, setting in dict.fromkeys((system, setting) for system, _, setting in groups)
        for better, worse in ORDER
        if errors.get((system, better, setting), np.nan) > errors.get((system, worse, setting), np.nan)
    ]
    above, uncalibrated = [], []
    for key, own in groups.items():
        if key[1].startswith("EVGP"):
            paper, cr2 = PAPER[key[0]][key[1]].error, of(own, "cr2").mean()
            above += [f"{' '.join(key)} ({figure_of(errors[key])}, there {paper:.3f})"] if errors[key] > paper else []
            uncalibrated += [f"{' '.join(key)} ({cr2:.3f})"] if abs(cr2 - TWO_SIGMA) > TOLERANCE else []
    calibration = {f"An EVGP's CR-2 is more than {TOLERANCE} from a normal distribution's {TWO_SIGMA}": uncalibrated}
    points = (
        calibration
        if with_noise
        else {
            "EVGP-IFG's Error is above EVGP-IF's, or this above VGP's or RES-VGP's": unordered,
            "An EVGP's Error is above the paper's": above,
            **calibration,
        }
    )
    return "\n".join(f"* {what}: {'; '.join(where) or 'nowhere'}." for what, where in points.items())


def details(groups: dict[tuple[str, str, str], list[Row]], setting: str) -> str:
    """Every column of the paper's table and of the CSV, for one setting."""
    lines = []
    for (system, model, own_setting), own in groups.items():
        if own_setting != setting:
            continue
        paper, errors = PAPER[system][model], of(own, "error_mean")
        counts = sorted({row["n_parameters"] for row in own}, key=int)
        lines.append(
            [
                *(system, model, str(len(own)), f"{figure_of(errors.mean())} / {paper.error:.3f}"),
                *(figure_of(value) for value in (np.median(errors), errors.max())),
                *(figure_of(of(own, column).mean()) for column in ("error_median", "error_p99")),
                f"{figure_of(of(own, 'std_norm').mean())} / {paper.std_norm:.3f}",
                *(f"{of(own, name).mean():.3f} / {getattr(paper, name):.3f}" for name in ("cr1", "cr2", "cr3")),
                f"{of(own, 'nlpd').mean():.2f}",
                f"{', '.join(counts)} / {paper.n_parameters}",
                f"{of(own, 'fit_seconds').mean():.1f}",
            ]
        )
    header = ["system", "model", "seeds", "Error", "median seed", "largest", "median row", "99 % of rows"]
    return table([*header, "‖STD‖", "CR-1", "CR-2", "CR-3", "NLPD", "parameters", "seconds"], lines)


def plot(rows: list[Row], path: Path) -> None:
    """A panel per system: the Error of each model, in the paper and here; with noise CR-2, beside a normal's.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size and one noise.
    path : Path
        Of the PNG.
    """
    groups, models = group(rows), models_of(rows)
    systems = [system for system in PAPER if any(key[0] == system for key in groups)]
    n_columns = min(2, len(systems))
    n_rows = -(-len(systems) // n_columns)
    figure, grid = pyplot().subplots(
        n_rows, n_columns, figsize=(1 + 4.2 * n_columns, 0.9 + 2.7 * n_rows), squeeze=False, layout="constrained"
    )
    settings = [setting for setting in STYLES if any(key[2] == setting for key in groups)]
    offsets = dict(zip(settings, 0.17 * (np.arange(len(settings)) - 0.5 * (len(settings) - 1)), strict=True))
    for axes, system in zip(grid.flat, systems, strict=False):
        if noisy(rows):
            band = (TWO_SIGMA - TOLERANCE, TWO_SIGMA + TOLERANCE)
            axes.axhspan(*band, color="0.9", linewidth=0, label=f"± {TOLERANCE}, our tolerance")
            axes.axhline(TWO_SIGMA, color="black", linewidth=1.2, label="a normal distribution's")
        else:
            papers = [PAPER[system][model].error for model in models]
            places = np.arange(len(models))
            axes.hlines(papers, places - 0.42, places + 0.42, color="black", linewidth=1.8, label="in the paper")
        for (own_system, model, setting), own in groups.items():
            if own_system != system:
                continue
            values, (colour, marker) = of(own, "cr2" if noisy(rows) else "error_mean"), STYLES[setting]
            place = models.index(model) + offsets[setting]
            axes.plot([place] * len(values), values, ".", color=colour, markersize=4, alpha=0.5)
            face = colour if len(values) > 1 else "white"
            axes.plot(place, values.mean(), marker, color=colour, markerfacecolor=face, markersize=7)
        axes.set_title(system, fontsize=11)
        axes.set_xticks(range(len(models)), models, fontsize=9)
        axes.set_xlim(-0.5, len(models) - 0.5)
        axes.tick_params(axis="x", length=0)
        axes.grid(axis="y", alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(y=0.12)
        if not noisy(rows):
            logarithmic(axes)
    for axes in grid.flat[len(systems) :]:
        axes.set_axis_off()
    for axes in grid[:, 0]:
        axes.set_ylabel("CR-2" if noisy(rows) else "test Error")
    for setting, (colour, marker) in STYLES.items():
        if setting in settings:
            label = "paper's setting" if setting == "paper" else setting
            grid[0, 0].plot([], [], marker, color=colour, markersize=7, label=f"ours: {label}")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    notes = ["a quick run, not to be compared"] if rows[0]["size"] == "quick" else []
    notes += [f"noise: {float(rows[0]['noise']):.0%} of each target's standard deviation"] if noisy(rows) else []
    notes += ["large: mean over data sets (hollow: one only), small: each"]
    columns = 3 if n_columns > 1 else 2
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False, title="\n".join(notes))
    save_picture(figure, path)
