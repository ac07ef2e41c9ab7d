"""What the paper claims, and what the results of these benchmarks say of each: verdicts computed from the CSVs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from pathlib import Path

import numpy as np

from harness import Row, figure_of, read, table
from harness import column as of
from paper import beta_report, learning_curves_report
from paper.data_sets import is_angle
from paper.models import SYSTEMS
from paper.results_table_report import MARKS, MODELS, N_SEEDS, NORMAL, PAPER, Groups, Result, group, marks, star

# That each claim is looked at in.
SETTINGS = ("paper", "skevgp")
EVGP = ("EVGP-IF", "EVGP-IFG")
# Data sets by which something is decided.
FEWEST = 3

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
    """

    where: str
    setting: str
    holds: bool | None
    said: str


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

    def count(self, setting: str) -> str:
        """In how many places of a setting it holds; empty if there is none."""
        own = [finding.holds for finding in self.findings if finding.setting == setting]
        return count_of(own) if own else ""

    def where(self, holds: bool | None) -> str:
        """In which places it holds, does not, or is undecided."""
        return "; ".join(
            f"{finding.where}{', ' * bool(finding.setting)}{finding.setting}"
            for finding in self.findings
            if finding.holds is holds
        )


def count_of(holds: Sequence[bool | None]) -> str:
    """How many of all hold: "3 of 5"."""
    return f"{sum(held is True for held in holds)} of {len(holds)}"


def by_seed(rows: Sequence[Row]) -> BySeed:
    """The Error of each data set."""
    return {row["seed"]: float(row["error_mean"]) for row in rows}


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


def lowest(own: dict[str, BySeed], wanted: Sequence[str]) -> bool | None:
    """Whether the best of the wanted models, in the mean over data sets, is below the best of the others."""
    return lower(own[best_of(own, wanted)], own[best_of(own, own.keys() - set(wanted))])


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
                    f"lower on {count_of([gravity[seed] < plain[seed] for seed in seeds])} data sets",
                )


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
        best = best_of(place.errors, EVGP)
        fewest = counts[best] <= 1.1 * min(counts.values())
        listed = ", ".join(f"{model} {count:,.0f}" for model, count in counts.items())
        yield Finding(
            place.system, place.setting, lowest(place.errors, EVGP) if fewest else False, f"{best} of EVGP; {listed}"
        )


def in_the_paper(holds: Callable[[dict[str, Result]], bool]) -> str:
    """A claim by the paper's own table: on how many of its four systems."""
    return count_of([holds(models) for system, models in PAPER.items() if system != "cartpole_damped"])


def lowest_there(models: dict[str, Result], wanted: Sequence[str] = EVGP) -> bool:
    return min(models, key=lambda model: models[model].error) in wanted


def ifg_below_if_there(models: dict[str, Result]) -> bool:
    return models["EVGP-IFG"].error < models["EVGP-IF"].error


def best_ratios_there(models: dict[str, Result]) -> bool:
    distances = {model: away([own.cr1, own.cr2, own.cr3]) for model, own in models.items()}
    return min(distances, key=distances.__getitem__) in EVGP


def fewest_there(models: dict[str, Result]) -> bool:
    best = min(models.values(), key=lambda own: own.error)
    return lowest_there(models) and best.n_parameters <= 1.1 * min(own.n_parameters for own in models.values())


def angles_cover(rows: Sequence[Row]) -> Iterator[Finding]:
    """The angles of each training set reach from -0.95 π to 0.95 π."""
    for system in dict.fromkeys(row["system"] for row in rows):
        own = [row for row in rows if row["system"] == system and is_angle(row) and int(row["random_state"]) < 1000]
        low, high = of(own, "low"), of(own, "high")
        # A start that is uniform in ±π leaves a few hundredths of it out.
        covered = (low < -0.95 * np.pi) & (high > 0.95 * np.pi)
        said = f"narrowest {low.max():.1f} to {high.min():.1f}; {covered.sum()} of {len(own)}"
        yield Finding(system, "", bool(covered.all()), said)


def curves(rows: list[Row], setting: str) -> Iterator[tuple[str, dict[str, learning_curves_report.Curve]]]:
    """System, and its models' learning curves, where IFG's is."""
    for system, models in learning_curves_report.curves_of(rows, setting).items():
        if "EVGP-IFG" in models:
            yield system, {name: curve for name, curve in models.items() if name in MODELS}


def small_sets(rows: list[Row]) -> Iterator[Finding]:
    """With the fewest rows the better of the two EVGPs has a lower Error than the best of the other models."""
    for setting in SETTINGS:
        for system, models in curves(rows, setting):
            size = min(min(curve.n_rows) for curve in models.values())
            every = {name: curve.by_seed(size) for name, curve in models.items() if size in curve.n_rows}
            seeds = reduce(set.intersection, (set(own) for own in every.values()))
            if set(every) == set(MODELS) and seeds:
                errors = {name: {seed: own[seed] for seed in sorted(seeds)} for name, own in every.items()}
                means = sorted((mean_of(own), name) for name, own in errors.items())
                said = ", ".join(f"{name} {figure_of(mean)}{star(models[name].limited[0])}" for mean, name in means)
                said += f" ({len(seeds)})" * (len(seeds) != N_SEEDS)
                yield Finding(f"{system}, {size} rows", setting, lowest(errors, EVGP), said)


def plateaus(rows: list[Row]) -> Iterator[Finding]:
    """A doubling of the rows leaves VGP and RES-VGP more than nine tenths of their Error, over the last three sizes."""
    for setting in SETTINGS:
        for system, models in curves(rows, setting):
            own = {name: models[name] for name in ("VGP", "RES-VGP") if name in models and len(models[name].n_rows) > 1}
            if own:
                said = ", ".join(
                    f"{name} × {curve.doubling():.2f}{star(curve.limited[-3:].any())}" for name, curve in own.items()
                )
                flat = [
                    agreed([share > learning_curves_report.PLATEAU for share in curve.doublings()])
                    for curve in own.values()
                ]
                yield Finding(system, setting, None if None in flat and False not in flat else all(flat), said)


def gaps(rows: list[Row], other: str) -> Iterator[Finding]:
    """Where another model's Error is above EVGP-IFG's with the fewest rows, it is less so, or not, with the most."""
    for setting in SETTINGS:
        for system, models in curves(rows, setting):
            pair = [models[name] for name in (other, "EVGP-IFG") if name in models]
            sizes = reduce(np.intersect1d, [curve.n_rows for curve in pair])[[0, -1]]
            if len(pair) == 2 and sizes[0] < sizes[1]:
                first, last = (difference(*(curve.by_seed(size) for curve in pair)) for size in sizes)
                shown = [mean_of(own) for own in (first, last)]
                few, most = (
                    figure_of(mean) + star(any(curve.limited[curve.n_rows == size].any() for curve in pair))
                    for mean, size in zip(shown, sizes, strict=True)
                )
                said = f"above by {few} with the fewest rows, by {most} with the most"
                yield Finding(system, setting, lower(last, first) if shown[0] > 0.0 else None, said)


def difference(first: BySeed, second: BySeed) -> BySeed:
    """Of the runs that both have."""
    return {seed: first[seed] - second[seed] for seed in sorted(first.keys() & second.keys())}


def imitated_gravity(rows: list[Row]) -> Iterator[Finding]:
    """With IF the weight is more than two std below 0 on every data set; with IFG its mean is at most a tenth of it."""
    for setting in SETTINGS:
        own = {
            model: [row for row in rows if (row["system"], row["setting"], row["model"]) == ("acrobot", setting, model)]
            for model in EVGP
        }
        if all(own.values()):
            for velocity, position in beta_report.positions(own["EVGP-IF"]):
                b, std = (
                    [beta_report.entry(part, velocity, position, value) for part in own.values()]
                    for value in ("mean", "std")
                )
                squares = [beta_report.entry(part, velocity, position, "least_squares").mean() for part in own.values()]
                holds = (b[0] < -2.0 * std[0]).all() and b[1].mean() > -0.1 * abs(b[0].mean())
                yield Finding(
                    f"({velocity}, {position})",
                    setting,
                    bool(holds),
                    f"IF {b[0].mean():+.3f}, IFG {b[1].mean():+.3f}; "
                    f"least squares {squares[0]:+.3f}, {squares[1]:+.3f}",
                )


def verdicts(results: Path) -> list[Verdict]:
    """Of every claim of the paper that can be measured.

    Parameters
    ----------
    results : Path
        The folder of the CSVs.
    """
    names = ("results_table", "data_sets", "learning_curves", "beta")
    fits, data_sets, learning, weights = (
        [row for row in read(results / f"{name}.csv") if row["size"] == "full"] for name in names
    )
    groups = group([row for row in fits if row["angles"] == "raw"])
    ifg = partial(lowest_there, wanted=("EVGP-IFG",))
    claims: tuple[tuple[str, Callable[..., Iterator[Finding]], tuple[object, ...], str], ...] = (
        ("EVGP models provided the lowest error", lowest_error, (groups,), in_the_paper(lowest_there)),
        ("The EVGP-IFG model provided the lowest prediction error", lowest_is_ifg, (groups,), in_the_paper(ifg)),
        (
            "The IFG prior provided lower prediction errors when compared with the IF prior",
            ifg_below_if,
            (groups,),
            in_the_paper(ifg_below_if_there),
        ),
        ("EVGP models provided the best CR scores", best_ratios, (groups,), in_the_paper(best_ratios_there)),
        (
            "EVGP achieved the best performance using fewer parameters",
            fewest_parameters,
            (groups,),
            in_the_paper(fewest_there),
        ),
        ("The values cover at least the range (-π, π) for the angles on the systems", angles_cover, (data_sets,), ""),
        ("In case of smaller training data sets, EVGP proved its superiority", small_sets, (learning,), ""),
        ("The performance of VGP and RES-VGP plateaus", plateaus, (learning,), ""),
        ("RES-DBNN reduces the gap to EVGP as more data is available", gaps, (learning, "RES-DBNN"), ""),
        ("As training data is aggregated, the gap between IF and IFG is reduced", gaps, (learning, "EVGP-IF"), ""),
        (
            "With IF, EVGP assigns negative values to (q̇₁, q₁) and (q̇₂, q₂); with IFG it no longer does",
            imitated_gravity,
            (weights,),
            "",
        ),
    )
    return [
        Verdict(claim, str(find.__doc__), tuple(find(*arguments)), there) for claim, find, arguments, there in claims
    ]


def summary(found: Sequence[Verdict]) -> str:
    """A line per claim."""
    return table(
        ["the paper says", "its own table", *(f"here: {setting}" for setting in SETTINGS), "not so", "undecided"],
        [
            [verdict.claim, verdict.of_the_paper]
            + [verdict.count(setting) or verdict.count("") for setting in SETTINGS]
            + [verdict.where(False), verdict.where(None)]
            for verdict in found
        ],
    )


def paragraphs(found: Sequence[Verdict]) -> list[str]:
    """A page: each claim, and the numbers behind its verdict."""
    settings = " and ".join(SETTINGS)
    parts = [
        "# The paper's claims, one by one",
        "Written by `benchmarks/paper/reproduction.py` from results_table.csv, learning_curves.csv, beta.csv and "
        f"data_sets.csv. Settings: {settings}, where all five models were fitted; means over the data sets that all "
        f"have. A comparison is undecided unless at least {FEWEST} data sets, or runs, all say the same. Counted is in "
        f"how many places a claim holds, of all, those that are undecided among them. {MARKS}",
        summary(found),
    ]
    words = {True: "yes", False: "no", None: "undecided"}
    for verdict in found:
        lines = [[one.where, one.setting, words[one.holds], one.said] for one in verdict.findings]
        parts += [f"## {verdict.claim}", verdict.criterion, table(["where", "setting", "holds", "numbers"], lines)]
    return parts
