"""What the rows of learning_curves.py say, and whether it is what the paper says: a Markdown page and a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from harness import WIDTH, Row, figure_of, legend, logarithmic, provenance_text, pyplot, save_picture, table
from paper.results_table_report import PAPER

NOMINAL = "EVGP-IFG, nominal"  # EVGP-IFG in the setting skevgp-nominal
# Colours of Okabe & Ito's palette, safe for colour-blind readers.
COLOURS = {
    "VGP": "#E69F00",
    "RES-VGP": "#56B4E9",
    "RES-DBNN": "#009E73",
    "EVGP-IF": "#D55E00",
    "EVGP-IFG": "#0072B2",
    NOMINAL: "#CC79A7",
}
WORDS = {"skevgp": "skevgp's defaults", "paper": "the paper's setting"}
# An Error that a doubling of the rows leaves above this share of what it was has reached a plateau.
PLATEAU = 0.9


@dataclass(frozen=True)
class Curve:
    """Of one model on one system.

    Attributes
    ----------
    n_rows : ndarray of shape (n_sizes,)
    seeds : list of int
        Of the runs.
    errors : ndarray of shape (n_sizes, n_runs)
        NaN where a run is missing.
    limited : ndarray of shape (n_sizes,)
        Whether a fit ended by its limit of iterations.
    """

    n_rows: np.ndarray
    seeds: list[int]
    errors: np.ndarray
    limited: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        return np.nanmean(self.errors, axis=1)

    def rows_to_reach(self, error: float) -> str:
        """The fewest rows with at most this Error."""
        return next((str(size) for size, own in zip(self.n_rows, self.mean, strict=True) if own <= error), "—")

    def by_seed(self, size: int) -> dict[str, float]:
        """The Error of each run with so many rows."""
        (own,) = self.errors[self.n_rows == size]
        return {str(seed): float(error) for seed, error in zip(self.seeds, own, strict=True) if np.isfinite(error)}

    def doubling(self) -> float:
        """What share of the mean Error a doubling of the rows leaves, by the last three sizes and the runs that have
        them; NaN of one size, or if no run has.
        """
        whole = np.isfinite(self.errors[-3:]).all(axis=0)
        return self._share_left(self.errors[:, whole].mean(axis=1)) if whole.any() else np.nan

    def doublings(self) -> list[float]:
        """The same of each run that has these sizes."""
        return [self._share_left(own) for own in self.errors.T if np.isfinite(own[-3:]).all()]

    def _share_left(self, errors: np.ndarray) -> float:
        if len(self.n_rows) < 2:
            return np.nan
        return float(2.0 ** np.polyfit(np.log2(self.n_rows[-3:]), np.log2(errors[-3:]), 1)[0])


Curves = dict[str, dict[str, Curve]]  # of a setting: system -> model -> curve


def curve_of(rows: list[Row], measure: str) -> Curve:
    """From the rows of one model on one system."""
    sizes, seeds = (sorted({int(row[name]) for row in rows}) for name in ("n_rows", "seed"))
    errors = np.full((len(sizes), len(seeds)), np.nan)
    for row in rows:
        errors[sizes.index(int(row["n_rows"])), seeds.index(int(row["seed"]))] = float(row[measure])
    limited = {int(row["n_rows"]) for row in rows if row["converged"] == "False"}
    return Curve(np.array(sizes), seeds, errors, np.isin(sizes, list(limited)))


def curves_of(rows: list[Row], setting: str, measure: str = "error_mean") -> Curves:
    """In the order of the paper; skevgp-nominal counts as a model of the setting skevgp."""
    curves: Curves = {}
    for system in PAPER:
        for name in COLOURS:
            wanted = (system, *(("EVGP-IFG", "skevgp-nominal") if name == NOMINAL else (name, setting)))
            own = [row for row in rows if (row["system"], row["model"], row["setting"]) == wanted]
            if own and (name != NOMINAL or setting == "skevgp"):
                curves.setdefault(system, {})[name] = curve_of(own, measure)
    return curves


def settings_of(rows: list[Row]) -> list[str]:
    """Of the file, skevgp first; the nominal one is shown with it."""
    names = {row["setting"].removesuffix("-nominal") for row in rows}
    return sorted(names, key=lambda name: (name != "skevgp", name))


def paragraphs(rows: list[Row]) -> list[str]:
    """A page: tables of the Error, and the paper's claims checked.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size.

    Returns
    -------
    parts : list of str
    """
    parts = [
        "# Learning curves: Figure 6 of the paper, and ours",
        "Written by `benchmarks/paper/learning_curves.py`. Error is the mean over all test rows of the norm of the "
        "error, in SI units; [claims](claims.md) has verdicts by the rows inside the training range, too. The test set "
        "is fixed, trajectories are added to the training set. Means over runs; in brackets "
        f"the lowest and the highest, and how many runs. {provenance_text(rows)}",
    ]
    if rows[0]["size"] == "quick":
        parts.append("**A quick run**: few rows and iterations, not to be compared with the paper.")
    for setting in settings_of(rows):
        curves, medians = curves_of(rows, setting), curves_of(rows, setting, "error_median")
        parts.append(f"## Setting: {setting}")
        for system, models in curves.items():
            parts += [
                f"### {system}",
                error_table("Error of", models) + f"\nIn the paper, with all rows: {in_the_paper(system)}.",
                error_table("median row of", medians[system], spread=False),
            ]
        parts += ["### What the paper says of it", *claims(curves)]
    stopped = [row for row in rows if row["converged"] == "False"]
    if stopped:
        limited = Counter((row["system"], row["model"], row["setting"], row["n_iter"]) for row in stopped)
        text = ", ".join(
            f"{n} of {' '.join(of)} after {n_iter} iterations" for (*of, n_iter), n in sorted(limited.items())
        )
        parts.append(f"Ended by a limit, of iterations or of the network's epochs: {text}.")
    parts.append(
        "The median row is the median of the error over test rows: far below the Error where few rows make the Error, "
        f"those far from the training data. {len(stopped)} of {len(rows)} fits did not end by themselves."
    )
    return parts


def error_table(corner: str, models: dict[str, Curve], spread: bool = True) -> str:
    """A line per model, a column per number of rows: means over runs, and how far these spread."""
    sizes = sorted({size for curve in models.values() for size in curve.n_rows})
    lines = []
    for name, curve in models.items():
        cells = dict.fromkeys(sizes, "")
        for size, errors in zip(curve.n_rows, curve.errors, strict=True):
            own = errors[np.isfinite(errors)]
            cells[size] = figure_of(own.mean())
            if spread and len(own) > 1:
                cells[size] += f" ({figure_of(own.min())} to {figure_of(own.max())}, {len(own)})"
        lines.append([name, *cells.values()])
    return table([corner, *(f"{size} rows" for size in sizes)], lines)


def in_the_paper(system: str) -> str:
    return ", ".join(f"{name} {result.error:.3f}" for name, result in PAPER[system].items())


def claims(curves: Curves) -> Iterator[str]:
    """Each of the paper's observations, and what our means over runs say of it."""
    names = [name for name in COLOURS if any(name in models for models in curves.values())]
    with_ifg = {system: models for system, models in curves.items() if "EVGP-IFG" in models}
    if with_ifg:
        yield (
            "**EVGP needs fewer samples.** Rows from which each model has at most the Error that EVGP-IFG has with the "
            "fewest rows (—: not even with the most):"
        )
        yield table(
            ["system", "that Error", *names],
            [
                [system, figure_of(target := models["EVGP-IFG"].mean[0])]
                + [models[name].rows_to_reach(target) if name in models else "" for name in names]
                for system, models in with_ifg.items()
            ],
        )
    yield (
        "**EVGP is the most accurate.** The model of the lowest Error, with so many rows as all models have "
        "(without the nominal arm):"
    )
    yield "\n".join(f"* {system}: {lowest(models)}" for system, models in curves.items() if set(models) != {NOMINAL})
    yield (
        "**VGP and RES-VGP plateau.** What a doubling of the rows leaves of the Error, over the last three sizes (a "
        f"plateau, in italics, is above {PLATEAU}):"
    )
    yield table(
        ["system", *names],
        [
            [system, *(share_left(models[name].doubling()) if name in models else "" for name in names)]
            for system, models in curves.items()
        ],
    )
    yield (
        "**The gap from RES-DBNN to EVGP-IFG is reduced with more data, and that from IF to IFG.** Difference of the "
        "Errors, and their ratio (—: there is no gap to begin with). A difference shrinks whenever all Errors do, a "
        "ratio need not; and these are means over runs, where [claims](claims.md) asks that all runs agree, and leaves "
        'undecided what is "yes" here if one of them does not:'
    )
    yield table(
        ["system", "from EVGP-IFG to", "with the fewest rows", "with the most", "difference reduced", "ratio reduced"],
        [
            [system, name, *gap(models[name], models["EVGP-IFG"])]
            for name in ("RES-DBNN", "EVGP-IF")
            for system, models in with_ifg.items()
            if name in models
        ],
    )
    above = [
        f"{system} with {size} rows ({figure_of(ifg)} against {figure_of(other)})"
        for system, models in with_ifg.items()
        if "EVGP-IF" in models
        for size, ifg, other in zip(*common(models["EVGP-IFG"], models["EVGP-IF"]), strict=True)
        if ifg > other
    ]
    yield f"**IFG is below IF.** Not so: {', '.join(above) or 'nowhere'}."


def share_left(ratio: float) -> str:
    """In italics if it is most."""
    return "" if np.isnan(ratio) else f"*{ratio:.2f}*" if ratio > PLATEAU else f"{ratio:.2f}"


def common(*curves: Curve) -> tuple[np.ndarray, ...]:
    """Numbers of rows that all curves have, and the mean Error of each there."""
    sizes = reduce(np.intersect1d, [curve.n_rows for curve in curves])
    return sizes, *(curve.mean[np.isin(curve.n_rows, sizes)] for curve in curves)


def gap(other: Curve, ifg: Curve) -> list[str]:
    """The first and the last, and whether the last is less, as a difference and as a ratio: if there was one."""
    sizes, other_errors, errors = common(other, ifg)
    if not len(sizes):
        return [""] * 4
    differences, ratios = other_errors - errors, other_errors / errors
    cells = [f"{figure_of(differences[end])} (× {figure_of(ratios[end])})" for end in (0, -1)]
    if differences[0] <= 0:
        return [*cells, "—", "—"]
    if differences[-1] < 0:
        return [*cells, "reversed", "reversed"]
    return cells + ["yes" if values[-1] < values[0] else "no" for values in (differences, ratios)]


def lowest(models: dict[str, Curve]) -> str:
    """Which model is, for each number of rows."""
    names = [name for name in models if name != NOMINAL]
    sizes, *errors = common(*(models[name] for name in names))
    return ", ".join(f"{names[best]} ({size})" for size, best in zip(sizes, np.argmin(errors, axis=0), strict=True))


def plot(rows: list[Row], path: Path) -> None:
    """A picture per setting, with a panel per system: medians and quartiles of runs, and the paper's last points.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size.
    path : Path
        Of the PNG of the first setting; the others have their setting behind the name.
    """
    for setting in settings_of(rows):
        own = path if setting == settings_of(rows)[0] else path.with_stem(f"{path.stem}_{setting}")
        plot_setting(curves_of(rows, setting), own, WORDS.get(setting, setting), rows[0]["size"] == "quick")


def n_runs(models: dict[str, Curve]) -> str:
    """Of the points of a panel, and which models do not have all of them at which sizes."""
    numbers = {name: np.isfinite(curve.errors).sum(axis=1) for name, curve in models.items()}
    most = int(max(own.max() for own in numbers.values()))
    fewer: dict[str, list[str]] = {}
    for name, own in numbers.items():
        if own.min() < most:
            sizes = ", ".join(f"{size:,}" for size in models[name].n_rows[own < most])
            fewer.setdefault(f"fewer at {sizes}", []).append(name)
    return "; ".join([f"{most} run{'s' * (most > 1)}", *(f"{', '.join(who)} {said}" for said, who in fewer.items())])


def plot_setting(curves: Curves, path: Path, setting: str, quick: bool) -> None:
    """One of its pictures."""
    n_columns = min(2, len(curves))
    n_lines = -(-len(curves) // n_columns)
    figure, grid = pyplot().subplots(n_lines, n_columns, figsize=(WIDTH, 0.8 + 2.7 * n_lines), squeeze=False)
    for axes, (system, models) in zip(grid.flat, curves.items(), strict=False):
        for number, (name, curve) in enumerate(models.items()):
            plot_curve(axes, curve, name, 1.02 ** (number - (len(models) - 1) / 2))
            result = PAPER[system].get(name)
            if result:  # beside each other: some are of nearly the same Error
                place = 1.25 * 1.08**number * max(curve.n_rows)
                axes.plot(place, result.error, "*", color=COLOURS[name], markersize=8, zorder=4)
        axes.set_title(f"{system} ({n_runs(models)})")
        axes.set(xlabel="training rows", ylabel="test Error (SI units)")
        logarithmic(axes, "x")
        sizes = sorted({size for curve in models.values() for size in curve.n_rows})
        axes.set_xticks(sizes, [f"{size:,}" for size in sizes])
        axes.set_xticks([], minor=True)
        logarithmic(axes)
    for axes in grid.flat[len(curves) :]:
        axes.set_axis_off()
    axes = grid.flat[len(curves) - 1]
    axes.plot([], [], "*", color="0.3", markersize=8, label="in the paper, with all rows")
    if any(curve.limited.any() for models in curves.values() for curve in models.values()):
        axes.plot([], [], "o", color="0.3", markerfacecolor="white", label="a fit ended by its limit of iterations")
    title = f"{setting}: medians of runs, bars from first to third quartile"
    legend(figure, ncols=4, title=title + ("; a quick run, not to be compared" if quick else ""))
    save_picture(figure, path)


def plot_curve(axes: Any, curve: Curve, name: str, shift: float) -> None:
    """Medians with bars of quartiles, hollow where a fit ended by its limit; shifted, so that bars stand apart."""
    middle, low, high = np.nanpercentile(curve.errors, (50, 25, 75), axis=1)
    x, colour = shift * curve.n_rows, COLOURS[name]
    zorder = 3 if name.startswith("EVGP") else 2
    axes.plot(x, middle, color=colour, linewidth=1.4, zorder=zorder, label=name)
    axes.errorbar(x, middle, (middle - low, high - middle), fmt="none", color=colour, linewidth=1.4, zorder=zorder)
    for face, shown in ((colour, ~curve.limited), ("white", curve.limited)):
        axes.plot(x[shown], middle[shown], "o", color=colour, markerfacecolor=face, markersize=4.5, zorder=zorder)
