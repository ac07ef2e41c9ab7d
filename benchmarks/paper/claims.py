"""What the paper claims, and what the results of these benchmarks say of each: verdicts computed from the CSVs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness import Row, figure_of, read, table
from harness import column as of
from paper import beta_report, learning_curves_report
from paper.data_sets import is_angle
from paper.models import SYSTEMS
from paper.results_table_report import MODELS, NORMAL, Groups, group

# That each claim is looked at in.
SETTINGS = ("paper", "skevgp")
EVGP = ("EVGP-IF", "EVGP-IFG")


@dataclass(frozen=True)
class Finding:
    """Of a claim in one place.

    Attributes
    ----------
    where : str
        System and setting.
    holds : bool
    said : str
        The numbers.
    """

    where: str
    holds: bool
    said: str


@dataclass(frozen=True)
class Verdict:
    """Of a claim.

    Attributes
    ----------
    claim : str
        In the paper's words, or nearly.
    findings : tuple of Finding
    """

    claim: str
    findings: tuple[Finding, ...]

    @property
    def text(self) -> str:
        """In a word or two."""
        n, true = len(self.findings), sum(finding.holds for finding in self.findings)
        if n == 0:
            return "not measured"
        return "holds" if true == n else "does not hold" if true == 0 else f"holds in {true} of {n}"


def mean_errors(groups: Groups) -> Iterator[tuple[str, str, dict[str, float]]]:
    """System, setting and each model's mean Error, where all five are."""
    for setting in SETTINGS:
        for system in SYSTEMS:
            own = {model: groups[key] for model in MODELS if (key := (system, model, setting)) in groups}
            if len(own) == len(MODELS):
                yield system, setting, {model: float(of(rows, "error_mean").mean()) for model, rows in own.items()}


def said_of(values: dict[str, float]) -> str:
    return ", ".join(f"{model} {figure_of(value)}" for model, value in sorted(values.items(), key=lambda item: item[1]))


def lowest_error(groups: Groups) -> Iterator[Finding]:
    """An EVGP has the lowest mean Error."""
    for system, setting, errors in mean_errors(groups):
        yield Finding(f"{system}, {setting}", min(errors, key=errors.__getitem__) in EVGP, said_of(errors))


def lowest_is_ifg(groups: Groups) -> Iterator[Finding]:
    """EVGP-IFG itself has it."""
    for system, setting, errors in mean_errors(groups):
        yield Finding(f"{system}, {setting}", min(errors, key=errors.__getitem__) == "EVGP-IFG", said_of(errors))


def ifg_below_if(groups: Groups) -> Iterator[Finding]:
    """Of the two priors the one with gravity has the lower mean Error, and on how many data sets."""
    for setting in SETTINGS:
        for system in SYSTEMS:
            own = [groups.get((system, model, setting), []) for model in EVGP]
            by_seed = [{row["seed"]: float(row["error_mean"]) for row in rows} for rows in own]
            seeds = sorted(by_seed[0].keys() & by_seed[1].keys(), key=int)
            if seeds:
                plain, gravity = (np.array([errors[seed] for seed in seeds]) for errors in by_seed)
                yield Finding(
                    f"{system}, {setting}",
                    bool(gravity.mean() < plain.mean()),
                    f"IF {figure_of(plain.mean())}, IFG {figure_of(gravity.mean())}, lower on "
                    f"{(gravity < plain).sum()} of {len(seeds)} data sets",
                )


def best_ratios(groups: Groups) -> Iterator[Finding]:
    """Of all models an EVGP's containing ratios are the closest to 68-95-99.7, summed over the three."""
    for system, setting, _ in mean_errors(groups):
        away = {
            model: float(
                np.abs([of(groups[system, model, setting], f"cr{k}").mean() - NORMAL[k - 1] for k in (1, 2, 3)]).sum()
            )
            for model in MODELS
        }
        yield Finding(f"{system}, {setting}", min(away, key=away.__getitem__) in EVGP, said_of(away))


def fewest_parameters(groups: Groups) -> Iterator[Finding]:
    """The model of the lowest Error has the fewest numbers to learn."""
    for system, setting, errors in mean_errors(groups):
        counts = {model: max(of(groups[system, model, setting], "n_parameters")) for model in MODELS}
        best = min(errors, key=errors.__getitem__)
        # The few that gravity's weights add do not count: they are the claim's own.
        fewest = counts[best] <= 1.1 * min(counts.values())
        listed = ", ".join(f"{model} {count:,.0f}" for model, count in counts.items())
        yield Finding(f"{system}, {setting}", bool(best in EVGP and fewest), f"lowest Error: {best}; {listed}")


def angles_cover(rows: Sequence[Row]) -> Iterator[Finding]:
    """The angles of each training set reach from -π to π."""
    for system in dict.fromkeys(row["system"] for row in rows):
        own = [row for row in rows if row["system"] == system and is_angle(row) and int(row["random_state"]) < 1000]
        low, high = of(own, "low"), of(own, "high")
        # A start that is uniform in ±π leaves a few hundredths of it out.
        covered = (low < -0.95 * np.pi) & (high > 0.95 * np.pi)
        yield Finding(
            system, bool(covered.all()), f"narrowest {low.max():.1f} to {high.min():.1f}; {covered.sum()} of {len(own)}"
        )


def curves(rows: list[Row], setting: str) -> Iterator[tuple[str, dict[str, learning_curves_report.Curve]]]:
    """System, and its models' learning curves, where IFG's is."""
    for system, models in learning_curves_report.curves_of(rows, setting).items():
        if "EVGP-IFG" in models:
            yield system, {name: curve for name, curve in models.items() if name in MODELS}


def small_sets(rows: list[Row]) -> Iterator[Finding]:
    """With the fewest rows an EVGP has the lowest mean Error."""
    for setting in SETTINGS:
        for system, models in curves(rows, setting):
            errors = {name: float(curve.mean[0]) for name, curve in models.items()}
            n_rows = models["EVGP-IFG"].n_rows[0]
            best = min(errors, key=errors.__getitem__)
            yield Finding(f"{system}, {setting}, {n_rows} rows", best in EVGP, said_of(errors))


def plateaus(rows: list[Row]) -> Iterator[Finding]:
    """A doubling of the rows leaves VGP and RES-VGP more than nine tenths of their Error, over the last three sizes."""
    for setting in SETTINGS:
        for system, models in curves(rows, setting):
            ratios = {name: models[name].doubling() for name in ("VGP", "RES-VGP") if name in models}
            if ratios:
                said = ", ".join(f"{name} × {ratio.strip('*')}" for name, ratio in ratios.items())
                yield Finding(f"{system}, {setting}", all("*" in ratio for ratio in ratios.values()), said)


def gaps(rows: list[Row], other: str) -> Iterator[Finding]:
    """The difference of another model's Error from EVGP-IFG's is smaller with the most rows than with the fewest."""
    for setting in SETTINGS:
        for system, models in curves(rows, setting):
            if other in models:
                first, last, difference, _ = learning_curves_report.gap(models[other], models["EVGP-IFG"])
                yield Finding(f"{system}, {setting}", difference == "yes", f"{first} with the fewest rows, then {last}")


def imitated_gravity(rows: list[Row]) -> Iterator[Finding]:
    """With IF the acrobot's weights of positions on velocities are negative in every seed, with IFG nearly gone."""
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
                    f"({velocity}, {position}), {setting}",
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
    claims: tuple[tuple[str, Callable[..., Iterator[Finding]], tuple[object, ...]], ...] = (
        ("EVGP models provided the lowest error", lowest_error, (groups,)),
        ("The EVGP-IFG model provided the lowest prediction error", lowest_is_ifg, (groups,)),
        ("The IFG prior provided lower prediction errors when compared with the IF prior", ifg_below_if, (groups,)),
        ("EVGP models provided the best CR scores", best_ratios, (groups,)),
        ("EVGP achieved the best performance using fewer parameters", fewest_parameters, (groups,)),
        ("The values cover at least the range (-π, π) for the angles on the systems", angles_cover, (data_sets,)),
        ("In case of smaller training data sets, EVGP proved its superiority", small_sets, (learning,)),
        ("The performance of VGP and RES-VGP plateaus", plateaus, (learning,)),
        ("RES-DBNN reduces the gap to EVGP as more data is available", gaps, (learning, "RES-DBNN")),
        ("As training data is aggregated, the gap between IF and IFG is reduced", gaps, (learning, "EVGP-IF")),
        (
            "With IF, EVGP assigns negative values to (q̇₁, q₁) and (q̇₂, q₂); with IFG it no longer does",
            imitated_gravity,
            (weights,),
        ),
    )
    return [Verdict(claim, tuple(find(*arguments))) for claim, find, arguments in claims]


def summary(found: Sequence[Verdict]) -> str:
    """A line per claim."""
    return table(
        ["the paper says", "here", "not so"],
        [
            [verdict.claim, verdict.text, "; ".join(finding.where for finding in verdict.findings if not finding.holds)]
            for verdict in found
        ],
    )


def paragraphs(found: Sequence[Verdict]) -> list[str]:
    """A page: each claim, and the numbers behind its verdict."""
    settings = " and ".join(SETTINGS)
    parts = [
        "# The paper's claims, one by one",
        "Written by `benchmarks/paper/reproduction.py` from results_table.csv, learning_curves.csv, beta.csv and "
        f"data_sets.csv. Settings: {settings}, where all five models were fitted; means over data sets.",
        summary(found),
    ]
    for verdict in found:
        lines = [[finding.where, "yes" if finding.holds else "no", finding.said] for finding in verdict.findings]
        parts += [f"## {verdict.claim}", f"{verdict.text.capitalize()}.", table(["where", "holds", "numbers"], lines)]
    return parts
