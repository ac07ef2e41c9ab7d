"""What is found of a claim of the paper, and the comparisons by which it is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness import Row

# That each claim is looked at in.
SETTINGS = ("paper", "skevgp")
EVGP = ("EVGP-IF", "EVGP-IFG")
# Models that know no physics.
OTHERS = ("VGP", "RES-VGP", "RES-DBNN")
# Data sets by which something is decided.
FEWEST = 3
WORDS = {True: "yes", False: "no", None: "undecided"}

BySeed = dict[str, float]  # of a data set or run: an Error, or what else is compared


@dataclass(frozen=True)
class Finding:
    """Of a claim in one place.

    Attributes
    ----------
    where : str
        System and, perhaps, more.
    setting : str
        Empty if there is none.
    holds : bool or None
        None is undecided.
    said : str
        The numbers.
    inside : bool or None
        The same of test rows inside the training rows' ranges.
    said_inside : str
        Empty if the claim is not of Errors.
    """

    where: str
    setting: str
    holds: bool | None
    said: str
    inside: bool | None = None
    said_inside: str = ""


@dataclass(frozen=True)
class Verdict:
    """Of a claim.

    Attributes
    ----------
    claim : str
        In the paper's words, or nearly.
    criterion : str
        What is taken for it here.
    findings : tuple of Finding
    of_the_paper : str
        The same criterion on the paper's own numbers; empty where it does not give them.
    """

    claim: str
    criterion: str
    findings: tuple[Finding, ...]
    of_the_paper: str = ""

    @property
    def has_inside(self) -> bool:
        """Whether the claim is of Errors, so that it has a second verdict."""
        return any(finding.said_inside for finding in self.findings)

    def count(self, setting: str, inside: bool = False) -> str:
        """In how many places of a setting it holds, fails and is undecided; empty if there is none."""
        if inside and not self.has_inside:
            return ""
        own = [finding.inside if inside else finding.holds for finding in self.findings if finding.setting == setting]
        return count_of(own) if own else ""

    def where(self, holds: bool | None, inside: bool = False) -> str:
        """In which places it holds, does not, or is undecided: "paper: lake, sea; skevgp: pond"."""
        if inside and not self.has_inside:
            return ""
        places: dict[str, list[str]] = {}
        for finding in self.findings:
            if (finding.inside if inside else finding.holds) is holds:
                places.setdefault(finding.setting, []).append(finding.where)
        return "; ".join(f"{setting}{': ' * bool(setting)}{', '.join(own)}" for setting, own in places.items())


def count_of(holds: Sequence[bool | None]) -> str:
    """How many hold, fail and are undecided: "3 / 0 / 2"."""
    return " / ".join(str(sum(held is word for held in holds)) for word in WORDS)


def some_of(flags: Sequence[bool]) -> str:
    """How many of all: "3 of 4"."""
    return f"{sum(flags)} of {len(flags)}"


def inside_of(rows: Sequence[Row]) -> list[Row]:
    """The same fits by the Error of test rows inside the training rows' ranges; without those of which it is unknown,
    measured by older code, or with no such row.
    """
    return [{**row, "error_mean": row["error_inside"]} for row in rows if np.isfinite(float(row["error_inside"]))]


def with_inside(everywhere: Iterable[Finding], inside: Iterable[Finding]) -> Iterator[Finding]:
    """A finding from all test rows, and beside it that of the same place from those inside."""
    known = {(finding.where, finding.setting): finding for finding in inside}
    for finding in everywhere:
        own = known.get((finding.where, finding.setting))
        yield replace(finding, inside=own.holds if own else None, said_inside=own.said if own else "not measured")


def by_seed(rows: Sequence[Row], name: str = "error_mean") -> BySeed:
    """The Error, or another column, of each data set."""
    return {row["seed"]: float(row[name]) for row in rows}


def mean_of(own: BySeed) -> float:
    """Over data sets."""
    return float(np.mean(list(own.values())))


def best_of(own: dict[str, BySeed], models: Iterable[str]) -> str:
    """Of some models that of the lowest mean over data sets."""
    return min(models, key=lambda model: mean_of(own[model]))


def lower(first: BySeed, second: BySeed) -> bool | None:
    """Whether one model's Error is below another's, on the data sets that both have.

    Undecided where it is not so on all of them, or there are fewer than `FEWEST`.
    """
    return agreed([first[seed] < second[seed] for seed in first.keys() & second.keys()])


def agreed(holds: Sequence[bool]) -> bool | None:
    """What all data sets say, if there are enough."""
    said = set(holds)
    return said.pop() if len(said) == 1 and len(holds) >= FEWEST else None


def together(holds: Sequence[bool | None]) -> bool | None:
    """Whether all hold: not if one fails, undecided if otherwise one is."""
    return None if None in holds and False not in holds else all(holds)


def lowest(own: dict[str, BySeed], wanted: Sequence[str]) -> bool | None:
    """Whether the best of the wanted models is below the best of the others, each the best of a data set."""
    return lower(pick(own, wanted, min), pick(own, own.keys() - set(wanted), min))


def pick(own: dict[str, BySeed], models: Iterable[str], by: Callable[[Iterable[float]], float]) -> BySeed:
    """Of some models the lowest or highest value of each data set that all of these have."""
    values = [own[model] for model in models]
    seeds = set.intersection(*(set(one) for one in values))
    return {seed: by([one[seed] for one in values]) for seed in sorted(seeds)}


def compare(first: BySeed, second: BySeed, by: Callable[[float, float], float]) -> BySeed:
    """A difference, or a ratio, of the runs that both have."""
    return {seed: by(first[seed], second[seed]) for seed in sorted(first.keys() & second.keys())}
