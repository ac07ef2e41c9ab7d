"""The paper's claims of its Table 4: what the rows of results_table.py say of each, and the paper's own table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from harness import Row, figure_of
from harness import column as of
from paper.claims_findings import (
    EVGP,
    OTHERS,
    SETTINGS,
    BySeed,
    Finding,
    best_of,
    by_seed,
    count_of,
    lower,
    lowest,
    mean_of,
    some_of,
)
from paper.models import SYSTEMS
from paper.results_table_report import MODELS, NORMAL, PAPER, Groups, Result, marks


@dataclass(frozen=True)
class Place:
    """A system in a setting, with the fits of all five models.

    Attributes
    ----------
    system, setting : str
    fits : dict
        Model -> rows of data sets that all models have.
    notes : dict
        Model -> what to know of its cell.
    """

    system: str
    setting: str
    fits: dict[str, list[Row]]
    notes: dict[str, str]

    @property
    def errors(self) -> dict[str, BySeed]:
        """Of each model."""
        return {model: by_seed(rows) for model, rows in self.fits.items()}

    def lowest(self, values: dict[str, BySeed], wanted: Sequence[str]) -> Finding:
        """Whether one of the wanted models has the lowest values, with the means of all, the lowest first."""
        means = sorted((mean_of(own), model) for model, own in values.items())
        said = ", ".join(f"{model} {figure_of(mean)}{self.notes[model]}" for mean, model in means)
        return Finding(self.system, self.setting, lowest(values, wanted), said)


def places(groups: Groups) -> Iterator[Place]:
    """Where all five models are."""
    for setting in SETTINGS:
        for system in SYSTEMS:
            own = {model: groups[key] for model in MODELS if (key := (system, model, setting)) in groups}
            if len(own) == len(MODELS):
                seeds = set.intersection(*({row["seed"] for row in rows} for rows in own.values()))
                fits = {model: [row for row in rows if row["seed"] in seeds] for model, rows in own.items()}
                if seeds:
                    yield Place(system, setting, fits, {model: marks(rows) for model, rows in fits.items()})


def lowest_error(groups: Groups) -> Iterator[Finding]:
    """The better of the two EVGPs has a lower Error than the best of the other models."""
    for place in places(groups):
        yield place.lowest(place.errors, EVGP)


def lowest_is_ifg(groups: Groups) -> Iterator[Finding]:
    """EVGP-IFG has a lower Error than the best of all others."""
    for place in places(groups):
        yield place.lowest(place.errors, ("EVGP-IFG",))


def ifg_below_if(groups: Groups) -> Iterator[Finding]:
    """EVGP-IFG has a lower Error than EVGP-IF."""
    for setting in SETTINGS:
        for system in SYSTEMS:
            own = [groups.get((system, model, setting), []) for model in EVGP]
            plain, gravity = map(by_seed, own)
            seeds = plain.keys() & gravity.keys()
            if seeds:
                plain, gravity = ({seed: errors[seed] for seed in seeds} for errors in (plain, gravity))
                yield Finding(
                    system,
                    setting,
                    lower(gravity, plain),
                    f"IF {figure_of(mean_of(plain))}{marks(own[0])}, IFG {figure_of(mean_of(gravity))}{marks(own[1])}, "
                    f"lower on {some_of([gravity[seed] < plain[seed] for seed in seeds])} data sets",
                )


def low_std(groups: Groups) -> Iterator[Finding]:
    """EVGP-IFG's ‖STD‖, the mean norm of the predictions' standard deviations, is the lowest of all models'."""
    for place in places(groups):
        stds = {model: by_seed(rows, "std_norm") for model, rows in place.fits.items()}
        yield place.lowest(stds, ("EVGP-IFG",))


def away(ratios: Sequence[float]) -> float:
    """How far CR-1 to 3 are from a normal distribution's, summed."""
    return float(np.abs(np.array(ratios) - NORMAL).sum())


def best_ratios(groups: Groups) -> Iterator[Finding]:
    """An EVGP's containing ratios are the closest of all models' to 0.683, 0.954, 0.997: differences summed."""
    for place in places(groups):
        distances = {
            model: {row["seed"]: away([float(row[f"cr{k}"]) for k in (1, 2, 3)]) for row in rows}
            for model, rows in place.fits.items()
        }
        yield place.lowest(distances, EVGP)


def fewest_parameters(groups: Groups) -> Iterator[Finding]:
    """The lowest Error is an EVGP's, and it has the fewest numbers to learn (or 10 % more: gravity's own weights)."""
    for place in places(groups):
        counts = {model: float(max(of(rows, "n_parameters"))) for model, rows in place.fits.items()}
        best, other = best_of(place.errors, EVGP), best_of(place.errors, OTHERS)
        fewest = counts[best] <= 1.1 * min(counts.values())
        listed = ", ".join(f"{model} {count:,.0f}" for model, count in counts.items())
        errors = (f"{model} {figure_of(mean_of(place.errors[model]))}{place.notes[model]}" for model in (best, other))
        said = f"Error: {', '.join(errors)}; parameters: {listed}"
        yield Finding(place.system, place.setting, lowest(place.errors, EVGP) if fewest else False, said)


def in_the_paper(holds: Callable[[dict[str, Result]], bool]) -> str:
    """A claim by the paper's own table, one data set each: on how many of its four systems it holds and fails."""
    return count_of([holds(models) for system, models in PAPER.items() if system != "cartpole_damped"])


def lowest_there(models: dict[str, Result], wanted: Sequence[str] = EVGP) -> bool:
    return min(models, key=lambda model: models[model].error) in wanted


def ifg_below_if_there(models: dict[str, Result]) -> bool:
    return models["EVGP-IFG"].error < models["EVGP-IF"].error


def low_std_there(models: dict[str, Result]) -> bool:
    return min(models, key=lambda model: models[model].std_norm) == "EVGP-IFG"


def best_ratios_there(models: dict[str, Result]) -> bool:
    distances = {model: away([own.cr1, own.cr2, own.cr3]) for model, own in models.items()}
    return min(distances, key=distances.__getitem__) in EVGP


def fewest_there(models: dict[str, Result]) -> bool:
    best = min(models.values(), key=lambda own: own.error)
    return lowest_there(models) and best.n_parameters <= 1.1 * min(own.n_parameters for own in models.values())
