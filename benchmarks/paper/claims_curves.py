"""The paper's claims of its Figure 6: what the rows of learning_curves.py say of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from operator import sub, truediv

import numpy as np

from harness import Row, figure_of
from paper.claims_findings import (
    EVGP,
    OTHERS,
    SETTINGS,
    WORDS,
    BySeed,
    Finding,
    agreed,
    best_of,
    compare,
    lower,
    lowest,
    mean_of,
    pick,
    some_of,
    together,
)
from paper.learning_curves_report import PLATEAU, Curve, curves_of
from paper.results_table_report import MODELS, N_SEEDS, star

Models = dict[str, Curve]
Errors = dict[str, BySeed]


def curves(rows: list[Row]) -> Iterator[tuple[str, str, Models]]:
    """System, setting, and the models' learning curves, where IFG's is."""
    for setting in SETTINGS:
        for system, models in curves_of(rows, setting).items():
            if "EVGP-IFG" in models:
                yield system, setting, {name: curve for name, curve in models.items() if name in MODELS}


def sizes_of(models: Models, names: Sequence[str] = MODELS) -> list[int]:
    """Numbers of rows that some models all have; none if one of these is missing."""
    if not set(names) <= models.keys():
        return []
    return [int(size) for size in reduce(np.intersect1d, [models[name].n_rows for name in names])]


def errors_at(models: Models, sizes: Sequence[int], names: Sequence[str] = MODELS) -> list[Errors]:
    """Errors of models with so many rows, of the runs that all have with all of these; empty if there is none."""
    every = [{name: models[name].by_seed(size) for name in names} for size in sizes]
    seeds = sorted(set.intersection(*(set(own) for errors in every for own in errors.values())))
    return [{name: {seed: own[seed] for seed in seeds} for name, own in errors.items()} for errors in every if seeds]


def with_fewest(rows: list[Row]) -> Iterator[tuple[str, str, Errors, str]]:
    """Where all five models are: place, setting, Errors with the fewest rows, and these in words, the lowest first."""
    for system, setting, models in curves(rows):
        size = min(min(curve.n_rows) for curve in models.values())
        if size in sizes_of(models):
            for errors in errors_at(models, [size]):
                yield f"{system} ({size} rows)", setting, errors, ranking(models, errors, size)


def ranking(models: Models, errors: Errors, size: int) -> str:
    """Mean Errors, the lowest first."""
    means = sorted((mean_of(own), name) for name, own in errors.items())
    said = ", ".join(f"{name} {figure_of(mean)}{stopped(models, [name], size)}" for mean, name in means)
    return said + runs(errors)


def runs(errors: Errors) -> str:
    """How many, in brackets, if not four."""
    n_runs = len(next(iter(errors.values())))
    return f" ({n_runs})" * (n_runs != N_SEEDS)


def stopped(models: Models, names: Sequence[str], size: int) -> str:
    """An asterisk if a fit of these with so many rows ended by a limit."""
    return star(any(models[name].limited[models[name].n_rows == size].any() for name in names))


def small_sets(rows: list[Row]) -> Iterator[Finding]:
    """With the fewest rows the better of the two EVGPs has a lower Error than the best of the other models."""
    for where, setting, errors, said in with_fewest(rows):
        yield Finding(where, setting, lowest(errors, EVGP), said)


def network_is_poor(rows: list[Row]) -> Iterator[Finding]:
    """With the fewest rows RES-DBNN's Error is above those of both EVGPs, from which the sentence counts its gap."""
    for where, setting, errors, said in with_fewest(rows):
        yield Finding(where, setting, lower(pick(errors, EVGP, max), errors["RES-DBNN"]), said)


def fewer_samples(rows: list[Row]) -> Iterator[Finding]:
    """With the last size but one, about half of the rows or less, the better of the two EVGPs has a lower Error than
    the best of the other models with the most; these are those of the lowest mean.
    """
    for system, setting, models in curves(rows):
        sizes = sizes_of(models)[-2:]
        if len(sizes) == 2 and (pair := errors_at(models, sizes)):
            fewer, most = pair
            own, other = best_of(fewer, EVGP), best_of(most, OTHERS)
            said = ", ".join(
                f"{name} {figure_of(mean_of(errors[name]))}{stopped(models, [name], size)} with {size} rows"
                for name, errors, size in zip((own, other), pair, sizes, strict=True)
            )
            yield Finding(system, setting, lower(fewer[own], most[other]), said + runs(most))


def accurate_pendulum(rows: list[Row]) -> Iterator[Finding]:
    """On the pendulum EVGP-IFG has with the fewest rows a lower Error than EVGP-IF, the other model of the figure that
    the sentence is about, with the most.
    """
    for system, setting, models in curves(rows):
        sizes = sizes_of(models, EVGP)
        if system == "pendulum" and len(sizes) > 1 and (pair := errors_at(models, [sizes[0], sizes[-1]], EVGP)):
            few, most = pair
            said = ", ".join(
                f"{name} {figure_of(mean_of(errors[name]))}{stopped(models, [name], size)} with {size} rows"
                for name, errors, size in (("EVGP-IFG", few, sizes[0]), *((name, most, sizes[-1]) for name in EVGP))
            )
            yield Finding(system, setting, lower(few["EVGP-IFG"], most["EVGP-IF"]), said + runs(most))


def more_rows_help(rows: list[Row]) -> Iterator[Finding]:
    """Every model has a lower Error with the most rows than with the fewest."""
    for system, setting, models in curves(rows):
        holds, said = [], []
        for name, curve in models.items():
            sizes = sizes_of(models, [name])
            pair = errors_at(models, [sizes[0], sizes[-1]], [name]) if len(sizes) > 1 else []
            if pair:
                few, most = (errors[name] for errors in pair)
                holds.append(lower(most, few))
                said.append(
                    f"{name} × {figure_of(mean_of(most) / mean_of(few))}{star(any(curve.limited[[0, -1]]))}"
                    f" ({some_of([most[seed] < few[seed] for seed in few])})"
                )
        if holds:
            yield Finding(system, setting, together(holds), ", ".join(said))


def plateaus(rows: list[Row]) -> Iterator[Finding]:
    """A doubling of the rows leaves VGP and RES-VGP more than nine tenths of their Error, over the last three sizes."""
    for system, setting, models in curves(rows):
        own = {name: models[name] for name in ("VGP", "RES-VGP") if name in models and len(models[name].n_rows) > 1}
        if own:
            said = ", ".join(
                f"{name} × {curve.doubling():.2f}{star(any(curve.limited[-3:]))}" for name, curve in own.items()
            )
            flat = [agreed([share > PLATEAU for share in curve.doublings()]) for curve in own.values()]
            yield Finding(system, setting, together(flat), said)


def gaps(rows: list[Row], other: str) -> Iterator[Finding]:
    """Where another model's mean Error is above EVGP-IFG's with the fewest rows (else undecided), the difference is
    less, or reversed, with the most. The ratio, which need not shrink where all Errors do, is told with the numbers.
    """
    yield from gaps_between(rows, (other,), ("EVGP-IFG",))


def gap_to_physics(rows: list[Row]) -> Iterator[Finding]:
    """Where the best of the models without physics has a mean Error above the better EVGP's with the fewest rows (else
    undecided), the difference is less, or reversed, with the most; best are those of the lowest mean at each size.
    """
    yield from gaps_between(rows, OTHERS, EVGP)


def gaps_between(rows: list[Row], others: Sequence[str], physics: Sequence[str]) -> Iterator[Finding]:
    """From the best of some models to the best of others, with the fewest rows and with the most."""
    for system, setting, models in curves(rows):
        names = (*others, *physics)
        sizes = sizes_of(models, names)
        if len(sizes) > 1 and (ends := errors_at(models, [sizes[0], sizes[-1]], names)):
            best = [(best_of(errors, others), best_of(errors, physics)) for errors in ends]
            pairs = [(errors[other], errors[own]) for errors, (other, own) in zip(ends, best, strict=True)]
            stars = [stopped(models, two, size) for two, size in zip(best, (sizes[0], sizes[-1]), strict=True)]
            holds, said = gap(pairs, stars)
            who = "; " + ", then ".join(f"{own} and {other}" for other, own in best) if len(names) > 2 else ""
            yield Finding(system, setting, holds, said + who + runs(ends[0]))


def gap(pairs: Sequence[tuple[BySeed, BySeed]], stars: Sequence[str] = ("", "")) -> tuple[bool | None, str]:
    """Whether the difference of two Errors is less with the most rows than with the fewest, and difference and ratio
    in words; nothing is decided if there was no gap to begin with.
    """
    differences = [compare(*pair, by=sub) for pair in pairs]
    ratios = [compare(*pair, by=truediv) for pair in pairs]
    means = [[mean_of(own) for own in pair] for pair in pairs]
    shown = [figure_of(first - second) + note for (first, second), note in zip(means, stars, strict=True)]
    times = [f"× {figure_of(first / second)}" for first, second in means]
    said = f"difference {' → '.join(shown)}", f"ratio {' → '.join(times)}"
    if means[0][0] <= means[0][1]:
        return None, f"{'; '.join(said)}; no gap to begin with"
    less = [[last[seed] < first[seed] for seed in first] for first, last in (differences, ratios)]
    counts = (f"{part}, less in {some_of(own)}" for part, own in zip(said, less, strict=True))
    return agreed(less[0]), f"{'; '.join(counts)}: {WORDS[agreed(less[1])]}"
