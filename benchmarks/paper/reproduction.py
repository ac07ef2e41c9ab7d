"""Write REPRODUCTION.md: the text of reproduction.md.in, with its tables and numbers filled in from the CSVs.

A place to fill is written {{name argument ...}}; the names are the functions below that take a `Results`. What a CSV
does not have is a dash. No number that a CSV holds is written by hand; a test fills the text in again and compares.

    python benchmarks/paper/reproduction.py  # no fit: a second
"""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

import harness
from harness import Row, figure_of
from harness import column as of
from paper import cartpole, claims, results_table_report
from paper import network as paper_network
from paper import unfinished as fits_to_come
from paper.results_table_report import WRAPPED, Groups

TEMPLATE = Path(__file__).with_name("reproduction.md.in")
PAGE = Path(__file__).parents[2] / "REPRODUCTION.md"
NOTE = "\n<!-- Written by benchmarks/paper/reproduction.py: change reproduction.md.in beside it. -->\n"
MISSING = "—"


class Results:
    """The CSVs of a folder, read once.

    Parameters
    ----------
    folder : Path
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def rows(self, name: str) -> list[Row]:
        """Those of full size."""
        return [row for row in harness.read(self.folder / f"{name}.csv") if row["size"] == "full"]

    @cached_property
    def table(self) -> Groups:
        """Fits of the results table."""
        return results_table_report.group(self.rows("results_table"))

    @cached_property
    def noisy(self) -> Groups:
        """The same with noise."""
        return results_table_report.group(self.rows("results_table_noise0.01"))

    @cached_property
    def variants(self) -> list[Row]:
        """What was tried on the cartpole."""
        return self.rows("cartpole")

    @cached_property
    def verdicts(self) -> list[claims.Verdict]:
        """On the paper's claims."""
        return claims.verdicts(self.folder)


def without_wrapped(groups: Groups) -> Groups:
    return {key: own for key, own in groups.items() if WRAPPED not in key[0]}


def errors(results: Results) -> str:
    """Table 4 at a glance."""
    return results_table_report.glance(without_wrapped(results.table), list(results_table_report.MODELS))


def which_cartpole(results: Results) -> str:
    """Each reading of the cartpole beside the paper."""
    return "\n\n".join(list(results_table_report.which_cartpole(results.table))[1:])


def unfinished(results: Results) -> str:
    """Fits that are missing or ended by a limit."""
    names = ("results_table", "results_table_noise0.01", "learning_curves")
    return fits_to_come.paragraph(*map(results.rows, names))


def outside(results: Results) -> str:
    """The rows outside the training range of both cartpoles."""
    groups = {key: own for key, own in results.table.items() if key[0] in ("cartpole", "cartpole_damped")}
    return "\n\n".join(list(results_table_report.outside(groups))[1:])


def claims_table(results: Results) -> str:
    """A line per claim of the paper."""
    return claims.summary(results.verdicts)


def tried(results: Results, system: str, model: str) -> str:
    """A line per variant of the cartpole's fit."""
    return cartpole.table_of(results.variants, system, model)


def calibration(results: Results) -> str:
    """Shares that intervals hold, with noise."""
    return results_table_report.coverage(without_wrapped(results.noisy))


def error(results: Results, system: str, model: str, setting: str, which: str = "mean") -> str:
    """One of a cell's Errors, over its data sets: mean, median, smallest, largest, inside (mean), row (median)."""
    own = results.table.get((system, model, setting))
    if not own:
        return MISSING
    values = of(own, {"inside": "error_inside", "row": "error_median"}.get(which, "error_mean"))
    how = {"median": np.median, "smallest": np.min, "largest": np.max}.get(which, np.nanmean)
    return figure_of(float(how(values)))


def spread(results: Results, setting: str, system: str, *models: str) -> str:
    """The largest Error of four data sets over the smallest, lowest and highest of some models."""
    ratios = [
        float(values.max() / values.min())
        for model in models
        if len(values := of(results.table.get((system, model, setting), []), "error_mean")) > 1
    ]
    if not ratios:
        return MISSING
    return " to ".join(dict.fromkeys(figure_of(f(ratios)) for f in (min, max)))


def marks(results: Results) -> str:
    """What they mean."""
    return results_table_report.MARKS


def takes(results: Results, name: str, *conditions: str) -> str:
    """Processor time of a benchmark's fits, of rows with some values: "setting=paper,skevgp"."""
    wanted = {column: values.split(",") for column, _, values in (text.partition("=") for text in conditions)}
    rows = [row for row in results.rows(name) if all(row[column] in values for column, values in wanted.items())]
    # A fit that has several rows tells its time in each.
    seconds = sum({float(row["fit_seconds"]) for row in rows})
    if not rows:
        return MISSING
    if seconds >= 3600.0:
        return f"{seconds / 3600.0:.1f} h"
    return f"{seconds / 60.0:.0f} min" if seconds >= 60.0 else f"{seconds:.0f} s"


def odds(results: Results, setting: str, *without: str) -> str:
    """How many times likelier the paper's Errors are on the damped cartpole than on the other, without some models."""
    cases = [
        case for case in results_table_report.CARTPOLES if any(key[::2] == (case, setting) for key in results.table)
    ]
    sums = {
        case: sum(value for model, value in own.items() if model not in without)
        for case, own in results_table_report.closeness(results.table, cases, setting).items()
    }
    if not {"cartpole", "cartpole_damped"} <= sums.keys():
        return MISSING
    return figure_of(float(np.exp(sums["cartpole_damped"] - sums["cartpole"])))


def wrapped_below(results: Results, *settings: str) -> str:
    """How many times the cartpoles' Errors with wrapped angles are below the paper's, of all models but the network."""
    times = [
        results_table_report.published(case, model).error / float(of(own, "error_mean").mean())
        for (case, model, setting), own in results.table.items()
        if case.startswith("cartpole") and WRAPPED in case and model != "RES-DBNN" and setting in settings
    ]
    return f"{min(times):,.0f} to {max(times):,.0f}" if times else MISSING


def error_rows(results: Results, noise: str, system: str, kind: str, which: str) -> str:
    """Of a kind of test rows: their share "of_rows", "of_error" of each data set, or a mean."""
    wanted = (system, kind, noise)
    own = [row for row in results.rows("error_rows") if (row["system"], row["kind"], row["noise"]) == wanted]
    if not own:
        return MISSING
    if which == "of_error":
        return ", ".join(f"{share:.0%}" for share in of(sorted(own, key=lambda row: int(row["seed"])), which))
    mean = float(np.nanmean(of(own, which)))
    return f"{mean:.1%}" if which == "of_rows" else figure_of(mean)


def outside_share(results: Results, system: str, setting: str, *models: str) -> str:
    """What part of an Error rows outside the training range make, of the data sets' the lowest and the highest."""
    shares = [
        results_table_report.share_outside(row)
        for model in models
        for row in results.table.get((system, model, setting), [])
        if np.isfinite(float(row["inside"]))
    ]
    return f"{min(shares):.0%} to {max(shares):.0%}" if shares else MISSING


def containing(results: Results, system: str, model: str, setting: str) -> str:
    """Without noise: CR-1 to 3, means over data sets."""
    own = results.table.get((system, model, setting))
    if not own:
        return MISSING
    return " / ".join(f"{of(own, f'cr{k}').mean():.3f}" for k in (1, 2, 3)) + results_table_report.marks(own)


def containing_with(results: Results, system: str, setting: str, n_trajectories: str, *models: str) -> str:
    """Of the learning curves, with so many trajectories: CR-1 and CR-2, over runs and models the ranges."""
    own = [
        row
        for row in results.rows("learning_curves")
        if (row["system"], row["setting"], row["n_trajectories"]) == (system, setting, n_trajectories)
        and row["model"] in models
    ]
    shares = (of(own, name) for name in ("cr1", "cr2"))
    return " and ".join(f"{share.min():.2f} to {share.max():.2f}" for share in shares) if own else MISSING


def network(results: Results, system: str, which: str, name: str = "error_tested", on: str = "held") -> str:
    """Of the network's variants the "best" on trajectories "held" back, or "early" stopping: its name, or a mean.

    ``on`` may be "test", too.
    """
    rows = [row for row in results.rows("network") if row["system"] == system]
    found = paper_network.compared(rows)
    if not found:
        return MISSING
    variant, epochs = found[{"best": 0, "early": -1}[which]]
    if name == "name":
        return f"{variant}, {epochs} epochs" if variant else f"{epochs} epochs"
    wanted = (variant, epochs, {"held": paper_network.HELD, "test": paper_network.TEST}[on])
    own = [row for row in rows if (row["variant"], int(row["epochs"]), row["tested_on"]) == wanted]
    return figure_of(float(of(own, name).mean())) if own else MISSING


def paper(results: Results, system: str, model: str, *names: str) -> str:
    """In the paper: the Error, or other columns of its table."""
    own = results_table_report.PAPER[system][model]
    return " / ".join(f"{getattr(own, name):.3f}" for name in names or ("error",))


def held(results: Results, system: str, model: str, setting: str, which: str) -> str:
    """With noise: a containing ratio (cr1, cr2, cr3) or the Error, mean over data sets."""
    own = results.noisy.get((system, model, setting))
    if not own:
        return MISSING
    value = float(of(own, which).mean())
    return figure_of(value) if which == "error_mean" else f"{value:.3f}"


def n_parameters(results: Results, system: str, model: str, setting: str) -> str:
    """The largest number that a cell's fits learned."""
    own = results.table.get((system, model, setting))
    return f"{max(of(own, 'n_parameters')):,.0f}" if own else MISSING


def variant(results: Results, system: str, name: str, model: str, which: str = "error_mean") -> str:
    """A column of what was tried on a cartpole, its mean over data sets."""
    wanted = (system, name, model)
    own = [row for row in results.variants if (row["system"], row["variant"], row["model"]) == wanted]
    return figure_of(float(of(own, which).mean())) if own else MISSING


FILLERS: dict[str, Callable[..., str]] = {
    function.__name__: function
    for function in (
        *(errors, unfinished, which_cartpole, outside, claims_table, tried, calibration),
        *(error, spread, paper, held, n_parameters, variant, marks, outside_share, containing, containing_with),
        *(network, takes, odds, wrapped_below, error_rows),
    )
}


def filled(text: str, results: Results) -> str:
    """The text with every place filled in.

    Raises
    ------
    KeyError
        If a place names no function.
    """

    def fill(place: re.Match[str]) -> str:
        name, *arguments = shlex.split(place[1])
        return FILLERS[name](results, *arguments).strip("\n")

    title, _, rest = re.sub(r"\{\{(.+?)\}\}", fill, text).partition("\n")
    return f"{title}\n{NOTE}{rest}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", type=Path, default=PAGE, help="what is written; default: %(default)s")
    options = parser.parse_args()
    results = Results(harness.RESULTS)
    harness.write_report(claims.paragraphs(results.verdicts), harness.RESULTS / "claims.csv")
    options.page.write_text(filled(TEMPLATE.read_text(), results))
    print(f"{options.page} is written.")


if __name__ == "__main__":
    main()
