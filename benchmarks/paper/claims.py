"""What the paper claims, and what the results of these benchmarks say of each: verdicts computed from the CSVs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from harness import Row, figure_of, read, table
from harness import column as of
from paper import beta_report
from paper import claims_curves as curves
from paper import claims_table as fitted
from paper.claims_findings import (
    EVGP,
    FEWEST,
    SETTINGS,
    WORDS,
    Finding,
    Verdict,
    agreed,
    inside_of,
    some_of,
    with_inside,
)
from paper.data_sets import is_angle
from paper.results_table_report import MARKS, group

# Of an output of the acrobot the features to which the paper's matrices of its priors give an unknown weight, γ.
GAMMA = {"dq1/dt": ("sin(q1)", "sin(q1 + q2)"), "dq2/dt": ("u_q2", "sin(q1 + q2)")}


def angles_cover(rows: Sequence[Row]) -> Iterator[Finding]:
    """The angles of each training set reach from -0.95 π to 0.95 π."""
    for system in dict.fromkeys(row["system"] for row in rows):
        own = [row for row in rows if row["system"] == system and is_angle(row) and int(row["random_state"]) < 1000]
        low, high = of(own, "low"), of(own, "high")
        # A start that is uniform in ±π leaves a few hundredths of it out.
        covered = (low < -0.95 * np.pi) & (high > 0.95 * np.pi)
        said = f"narrowest {low.max():.1f} to {high.min():.1f}; {covered.sum()} of {len(own)}"
        yield Finding(system, "", bool(covered.all()), said)


def acrobots(rows: Sequence[Row], setting: str) -> dict[str, list[Row]]:
    """Weights of each EVGP, by seed."""
    wanted = [("acrobot", setting, model) for model in EVGP]
    rows = sorted(rows, key=lambda row: int(row["seed"]))
    return {key[2]: [row for row in rows if (row["system"], row["setting"], row["model"]) == key] for key in wanted}


def imitated_gravity(rows: Sequence[Row]) -> Iterator[Finding]:
    """With IF the weight is negative, and with IFG it is not, or less so than a tenth of it."""
    for setting in SETTINGS:
        own = acrobots(rows, setting)
        if all(own.values()):
            for velocity, position in beta_report.positions(own["EVGP-IF"]):
                plain, gravity = (beta_report.entry(part, velocity, position, "mean") for part in own.values())
                squares = [beta_report.entry(part, velocity, position, "least_squares").mean() for part in own.values()]
                holds = [bool(a < 0.0 and b > 0.1 * a) for a, b in zip(plain, gravity, strict=True)]
                yield Finding(
                    f"({velocity}, {position})",
                    setting,
                    agreed(holds),
                    f"IF {plain.mean():+.3f}, IFG {gravity.mean():+.3f}, on {some_of(holds)} data sets; "
                    f"least squares {squares[0]:+.3f}, {squares[1]:+.3f}",
                )


def structure(rows: Sequence[Row]) -> Iterator[Finding]:
    """On all data sets the weights whose prior mean is not 0 have its sign, and all others of the same output are
    smaller. (Told with the numbers: the same if the paper's γ, of which our prior mean is 0, count as well.)
    """
    for setting in SETTINGS:
        for model, own in acrobots(rows, setting).items():
            seeds = dict.fromkeys(row["seed"] for row in own)
            if seeds:
                signs = [
                    all(float(row["prior_mean"]) * float(row["mean"]) >= 0.0 for row in own if row["seed"] == seed)
                    for seed in seeds
                ]
                (plain, said), (_, with_gamma) = (margins(own, list(seeds), gamma) for gamma in ({}, GAMMA))
                holds = agreed([sign and margin > 1.0 for sign, margin in zip(signs, plain, strict=True)])
                said += f", signs as the prior's on {sum(signs)} of {len(signs)} data sets; with γ {with_gamma}"
                yield Finding(model, setting, holds, said)


def margins(rows: Sequence[Row], seeds: Sequence[str], gamma: Mapping[str, Sequence[str]]) -> tuple[list[float], str]:
    """Of each data set how many times the smallest weight that the prior has is the largest that it has not, over
    outputs the least; and in words the least of all.
    """
    found = []
    for seed in seeds:
        for output in beta_report.names(list(rows), "output"):
            own = [row for row in rows if (row["seed"], row["output"]) == (seed, output)]
            sizes: dict[bool, list[tuple[float, str]]] = {True: [], False: []}
            for row in own:
                given = float(row["prior_mean"]) != 0.0 or row["feature"] in gamma.get(output, ())
                sizes[given].append((abs(float(row["mean"])), row["feature"]))
            least, most = min(sizes[True]), max(sizes[False])
            words = f"least ({output}, {least[1]}) {figure_of(least[0])} against ({output}, {most[1]}) "
            found.append((seed, least[0] / most[0], words + figure_of(most[0])))
    of_seeds = [min(ratio for seed, ratio, _ in found if seed == one) for one in seeds]
    _, ratio, words = min(found, key=lambda one: one[1])
    return of_seeds, f"{words}, × {figure_of(ratio)}"


class Line(NamedTuple):
    """A claim, how it is found, what the same criterion finds in the paper's own table, if it can, and whether it is of
    Errors, of which alone the CSVs have those of the rows inside the training ranges.
    """

    claim: str
    find: Callable[..., Iterator[Finding]]
    there: str = ""
    of_errors: bool = True


def of_the_table() -> tuple[Line, ...]:
    """Claims of Table 4."""
    there = fitted.in_the_paper
    ifg = partial(fitted.lowest_there, wanted=("EVGP-IFG",))
    return (
        Line("EVGP models provided the lowest error", fitted.lowest_error, there(fitted.lowest_there)),
        Line("The EVGP-IFG model provided the lowest prediction error", fitted.lowest_is_ifg, there(ifg)),
        Line(
            "The IFG prior provided lower prediction errors when compared with the IF prior",
            fitted.ifg_below_if,
            there(fitted.ifg_below_if_there),
        ),
        Line("EVGP-IFG provided the estimations with low ‖STD‖", fitted.low_std, there(fitted.low_std_there), False),
        Line("EVGP models provided the best CR scores", fitted.best_ratios, there(fitted.best_ratios_there), False),
        Line(
            "EVGP achieved the best performance using fewer parameters",
            fitted.fewest_parameters,
            there(fitted.fewest_there),
        ),
    )


OF_THE_DATA = Line(
    "The values cover at least the range (-π, π) for the angles on the systems", angles_cover, of_errors=False
)
# Claims of Figure 6, and of the conclusion from it.
OF_THE_CURVES = (
    Line("The prediction error is reduced as we increase the size of our training dataset", curves.more_rows_help),
    Line(
        "The EVGP provides the most accurate predictions while requiring less number of samples", curves.fewer_samples
    ),
    Line("In case of smaller training data sets, EVGP proved its superiority", curves.small_sets),
    Line(
        "In the case of the pendulum, IFG is highly accurate with only a small number of training samples",
        curves.accurate_pendulum,
    ),
    Line("The performance of VGP and RES-VGP plateaus", curves.plateaus),
    Line("RES-DBNN performs poorly with small training datasets", curves.network_is_poor),
    Line("RES-DBNN reduces the gap to EVGP as more data is available", partial(curves.gaps, other="RES-DBNN")),
    Line(
        "As training data is aggregated, the gap between IF and IFG is reduced", partial(curves.gaps, other="EVGP-IF")
    ),
    Line(
        "The difference between physics enhanced and purely data driven becomes smaller with more training data",
        curves.gap_to_physics,
    ),
)
# Claims of Figure 7.
OF_THE_WEIGHTS = (
    Line("The learned parameters follow a similar structure given by the prior", structure, of_errors=False),
    Line(
        "With IF, EVGP assigns negative values to (q̇₁, q₁) and (q̇₂, q₂); with IFG it no longer does",
        imitated_gravity,
        of_errors=False,
    ),
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
    return [
        *(verdict(line, fits, group) for line in of_the_table()),
        verdict(OF_THE_DATA, data_sets),
        *(verdict(line, learning) for line in OF_THE_CURVES),
        *(verdict(line, weights) for line in OF_THE_WEIGHTS),
    ]


def verdict(line: Line, rows: list[Row], arrange: Callable[[list[Row]], Any] = list) -> Verdict:
    """Of one claim, by all test rows and, if it is of Errors, by those inside the training ranges.

    ``arrange`` gives the rows the form in which the claim's finder takes them.
    """
    findings = line.find(arrange(rows))
    if line.of_errors:
        findings = with_inside(findings, line.find(arrange(inside_of(rows))))
    criterion = (line.find.func if isinstance(line.find, partial) else line.find).__doc__
    return Verdict(line.claim, " ".join(str(criterion).split()), tuple(findings), line.there)


def summary(found: Sequence[Verdict]) -> str:
    """A line per claim."""
    header = ["the paper says (holds / fails / undecided)", "its own table"]
    header += [name for setting in SETTINGS for name in (setting, f"{setting}, inside")]
    lines = []
    for one in found:
        counts = [
            one.count(setting, inside) or one.count("", inside) for setting in SETTINGS for inside in (False, True)
        ]
        lines.append([one.claim, one.of_the_paper, *counts])
    return table(header, lines)


def exceptions(found: Sequence[Verdict]) -> str:
    """Where each claim fails or is undecided."""
    return table(
        ["the paper says", "fails", "undecided", "fails, inside", "undecided, inside"],
        [
            [one.claim, *(one.where(holds, inside) for inside in (False, True) for holds in (False, None))]
            for one in found
        ],
    )


def introduction() -> list[str]:
    """What is counted, and what it is worth."""
    settings = " and ".join(SETTINGS)
    return [
        "Written by `benchmarks/paper/reproduction.py` from results_table.csv, learning_curves.csv, beta.csv and "
        f"data_sets.csv. Settings: {settings}, where all five models were fitted; means over the data sets that all "
        "have. Counted is in how many places a claim holds / fails / is undecided. A comparison is undecided unless "
        f"at least {FEWEST} data sets, or runs, all say the same; a gap that is to shrink is so, too, where there is "
        f"none to begin with. {MARKS}",
        "Claims of the Error have a second verdict, *inside*, by the same rule: by the test rows whose columns all lie "
        "within the ranges of the training rows. Where it was not measured, or on too few data sets, it is undecided. "
        "More training rows have wider ranges, in which more of the test rows lie, and harder ones: with the fewest of "
        "the learning curves it can be a fifth of all. So an Error inside may grow with the training rows, and claims "
        "that compare different numbers of these are better judged by all test rows.",
        "*What a verdict is worth.* If two models were equal, four of four data sets would agree in a given direction "
        "with probability 1/16, in either with 1/8; three of three with 1/8, in either with 1/4; the best of several "
        "models are no two fixed beforehand. One verdict is weak evidence, and of so many a few are by chance. Runs of "
        "a learning curve share one test set, and the claims share their fits. cartpole and cartpole_damped are two "
        "readings of one of the paper's plants: in the paper they count as one.",
        "*Gaps.* An absolute difference shrinks whenever all Errors do; a ratio need not. The verdict is the "
        "difference's, since the paper's figure shows Errors; the ratio's is told with the numbers. "
        "[learning_curves.md](learning_curves.md) compares means over runs, here all runs must agree: so a gap whose "
        'mean is less there ("yes") may be undecided here.',
    ]


def paragraphs(found: Sequence[Verdict]) -> list[str]:
    """A page: each claim, and the numbers behind its verdict."""
    parts = ["# The paper's claims, one by one", *introduction(), summary(found), "Where not:", exceptions(found)]
    for one in found:
        header = ["where", "setting", "holds", "numbers"]
        lines = [[own.where, own.setting, WORDS[own.holds], own.said] for own in one.findings]
        if one.has_inside:
            header = ["where", "setting", "holds", "inside the training range", "numbers", "numbers inside"]
            lines = [
                [*line[:3], WORDS[own.inside], line[3], own.said_inside]
                for line, own in zip(lines, one.findings, strict=True)
            ]
        parts += [f"## {one.claim}", one.criterion, table(header, lines)]
    return parts
