"""Which fits of the results table and the learning curves are missing or ended by a limit, and how long they take."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from statistics import mean

import numpy as np

from harness import Row, table
from paper.learning_curves import N_TRAJECTORIES, wanted
from paper.models import ADAM, AUTHORS_SCALE, MODELS, SETTINGS, SYSTEMS, UNTIL_FLAT, has
from paper.results_table_report import N_SEEDS, WRAPPED, cut_short
from skevgp.solvers import Adam

# Of the learning curves, those that are asked for.
CURVES = {"skevgp": tuple(N_TRAJECTORIES), "skevgp-nominal": ("iiwa14",), "paper": ("pendulum", "cartpole")}


@dataclass(frozen=True)
class Lack:
    """Fits that are missing in one place.

    Attributes
    ----------
    where, model : str
    n_fits : int
    seconds : float
        Of all of them, of the processor; NaN if no fit tells.
    """

    where: str
    model: str
    n_fits: int
    seconds: float


def asked_for(system: str, setting: str, angles: str) -> bool:
    """Of the results table: no author's starts for iiwa14, and wrapped angles for the others in two settings."""
    if system == "iiwa14":
        return angles == "raw" and setting not in AUTHORS_SCALE
    return angles == "raw" or setting in ("paper", "skevgp")


def asked_for_with_noise(system: str, setting: str) -> bool:
    """Of the results table with noise: skevgp's settings, of iiwa14 no sines and cosines."""
    return setting in ("skevgp", "skevgp-nominal" if system == "iiwa14" else "skevgp-angles")


def ended(row: Row) -> bool:
    """Whether a fit ended by itself, or has come to what counts as its end.

    That is where the author's fixed step, which never comes to rest, stopped, and the network's last epoch, where its
    step has fallen to zero.
    """
    if row["setting"] in AUTHORS_SCALE:
        return not row["max_iter"]
    if row["model"] == "RES-DBNN" and int(row["n_iter"]) == UNTIL_FLAT["max_iter"]:
        return True
    return row["converged"] == "True" and not cut_short(row)


def seconds_of(row: Row) -> float:
    """To the end of a fit that ended, or of one of Adam that was cut short; NaN of others."""
    seconds = float(row["fit_seconds"])
    if ended(row):
        return seconds
    return seconds * Adam.default_max_iter / float(row["n_iter"]) if adams(row["model"], row["setting"]) else np.nan


def adams(model: str, setting: str) -> bool:
    """Whether it is a fit of a GP by Adam."""
    return setting in ADAM and model != "RES-DBNN"


def time_of_one(rows: list[Row], system: str, model: str, setting: str, angles: str) -> float:
    """Seconds of a fit, in the mean over those of the table that are the most like it; NaN if there is none."""
    best: tuple[bool, ...] = ()
    seconds: list[float] = []
    for row in rows:
        alike = MODELS[row["model"]].sizes == MODELS[model].sizes and row["system"] == system
        if alike and adams(row["model"], row["setting"]) == adams(model, setting) and np.isfinite(seconds_of(row)):
            likeness = (row["setting"] == setting, row["model"] == model, row["angles"] == angles)
            if likeness > best:
                best, seconds = likeness, []
            if likeness == best:
                seconds.append(seconds_of(row))
    return float(np.mean(seconds)) if seconds else np.nan


def n_lacking(rows: Iterable[Row], cell: dict[str, str]) -> int:
    """Of the first seeds those of which no row of all columns is of a fit that ended."""
    seeds = {int(row["seed"]) for row in rows if cell.items() <= row.items() and ended(row) and row["inside"] != "nan"}
    return len(set(range(N_SEEDS)) - seeds)


def of_results_table(rows: list[Row], noisy: list[Row]) -> Iterator[Lack]:
    """In the order of the paper's table, then with noise."""
    for system, angles, setting, model in itertools.product(SYSTEMS, ("raw", "wrapped"), SETTINGS, MODELS):
        cell = {"system": system, "model": model, "setting": setting, "angles": angles}
        if has(**cell) and asked_for(system, setting, angles) and (n_fits := n_lacking(rows, cell)):
            case = system + (WRAPPED if angles == "wrapped" else "")
            yield Lack(f"Table 4: {case}, {setting}", model, n_fits, n_fits * time_of_one(rows, **cell))
    for system, setting, model in itertools.product(SYSTEMS, SETTINGS, MODELS):
        cell = {"system": system, "model": model, "setting": setting, "angles": "raw"}
        if has(**cell) and asked_for_with_noise(system, setting) and (n_fits := n_lacking(noisy, cell)):
            where = f"Table 4 with noise: {system}, {setting}"
            yield Lack(where, model, n_fits, n_fits * time_of_one(rows, **cell))


def of_learning_curves(rows: list[Row], whole: list[Row]) -> Iterator[Lack]:
    """A fit takes as long as others to so many rows do.

    If there is none it takes its part of the time of one to all rows; of Adam's steps the same.
    """
    for setting, systems in CURVES.items():
        for system, model in itertools.product(systems, MODELS):
            if not wanted(system, model, setting):
                continue
            n_fits, seconds = 0, 0.0
            for n_trajectories in N_TRAJECTORIES[system]:
                cell = {"system": system, "model": model, "setting": setting, "n_trajectories": str(n_trajectories)}
                n = n_lacking(rows, cell)
                n_fits += n
                own = [float(row["fit_seconds"]) for row in rows if cell.items() <= row.items() and ended(row)]
                share = 1.0 if adams(model, setting) else n_trajectories / max(N_TRAJECTORIES[system])
                if n:
                    seconds += n * (mean(own) if own else share * time_of_one(whole, system, model, setting, "raw"))
            if n_fits:
                yield Lack(f"Figure 6: {system}, {setting}", model, n_fits, seconds)


def lines(lacks: Iterable[Lack]) -> Iterator[list[str]]:
    """One for each place, and the sum."""

    def hours(lacks: list[Lack]) -> str:
        seconds = np.array([lack.seconds for lack in lacks])
        known = max(np.nansum(seconds) / 3600.0, 0.1)
        return f"{known:.1f}" + (" and more" if np.isnan(seconds).any() else "")

    every = list(lacks)
    for where, own in itertools.groupby(every, key=lambda lack: lack.where):
        here = list(own)
        yield [where, ", ".join(f"{lack.model} {lack.n_fits}" for lack in here), hours(here)]
    yield ["all", str(sum(lack.n_fits for lack in every)), hours(every)]


def paragraph(results_table: list[Row], noisy: list[Row], learning_curves: list[Row]) -> str:
    """A table: where, how many fits of which model, and hours of one core."""
    lacks = (*of_results_table(results_table, noisy), *of_learning_curves(learning_curves, results_table))
    return table(["where", "fits", "hours"], lines(lacks))
