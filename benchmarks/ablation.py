"""What is each rule of a fit, and each number in it, good for?

Fits many data sets with the default solver, and again with one rule or number changed at a time; writes one row per fit
to a CSV (fits that are there already are not repeated), and a page with one line per change beside it. The lines of
"luck" change nothing that matters: what they gain and lose is the noise by which the others are to be judged. (The rows
are kept as results/ablation.csv.gz; unpack them to add to them.)

    python benchmarks/ablation.py                   # everything: about an hour on one core
    python benchmarks/ablation.py --rules stage     # only some rules
    python benchmarks/ablation.py --quick           # a few rules on a few small sets
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

import harness
import internals
import robustness
from harness import Row
from robustness import Data

NUMBERS = ("bound_per_row", "gain_per_row", "error", "noise_share", "seconds")
# Bounds per row that differ by less count as equal: predictions are then as good but for 1 %.
CLOSE = 0.01
# So do errors that differ by a smaller factor.
CLOSE_ERROR = 1.1


def everywhere(default: Row) -> bool:
    """A change that matters to all fits; further sets serve only rarer ones."""
    return not default["case"].startswith("more-")


def where_it_collapsed(default: Row) -> bool:
    """A change that matters only if a fit ended in a bad optimum."""
    return default["collapsed"] != "0"


def where_noise_is_high(default: Row) -> bool:
    """A change that matters only if the noise explains much."""
    return default["outcome"] == "ok" and (default["collapsed"] != "0" or float(default["noise_share"]) > 0.3)


def where_points_move(default: Row) -> bool:
    """A change that matters only if inducing points may be placed anew."""
    return default["placed_anew"] == "1"


def where_points_are_many(default: Row) -> bool:
    """A change that matters only with about as many inducing points as rows."""
    return float(default["points_per_row"]) >= 0.3


@dataclass(frozen=True)
class Change:
    """A rule, and what becomes of it.

    Attributes
    ----------
    rule, variant : str
    rules, descent : dict
        What replaces fields of the search's and the solver's records.
    enough : float, optional
        What share of its gain an iteration has to gain.
    concerns : callable
        The default's row of a case -> whether the fit could be another one.
    other_seed : int
        Added to the random state.
    """

    rule: str
    variant: str
    rules: dict[str, Any] = field(default_factory=dict)
    descent: dict[str, Any] = field(default_factory=dict)
    enough: float | None = None
    concerns: Callable[[Row], bool] = everywhere
    other_seed: int = 0


def _of(record: str, name: str, *values: Any, concerns: Callable[[Row], bool] = everywhere) -> list[Change]:
    """One change per value of a field."""
    return [
        Change(
            name,
            str(value).replace(" ", ""),
            **{record: internals.ablated_field(record, name, value)},
            concerns=concerns,
        )
        for value in values
    ]


def changes() -> list[Change]:
    """All but the default, which changes nothing."""
    starts = internals.ablated_default("rules", "other_starts")
    fewer = [()] + [tuple(other for other in starts if other != one) for one in starts] * (len(starts) > 1)
    return [
        Change("luck", "random_state", other_seed=100),
        Change("luck", "first_noise=1.1e-4", {"first_noise": 1.1e-4}),
        Change("luck", "lengthscale=0.61", {"lengthscale": 0.61}),
        *_of("rules", "other_starts", *fewer, concerns=where_it_collapsed),
        *_of("rules", "stage", None, 50, 100, concerns=where_points_move),
        *_of("rules", "sample", None, (1000, 10)),
        *_of("rules", "much_noise", None, 1e2, concerns=where_points_are_many),
        *_of("descent", "patience", 1, 10),
        *_of("rules", "first_noise", 1e-2, 1e-3, 1e-5, 1e-6),
        *_of("rules", "signal_limits", (1e-8, 1e8), (1e-3, 1e1)),
        *_of("rules", "widest_signal", None, 1e6),
        *_of("rules", "last_start", False),
        *_of("rules", "lowest_noise", 1e-8, 1e-12),
        *_of("rules", "jitter.well_conditioned", 0.0, np.inf),
        *_of("rules", "jitter.size", 1e-8, 1e-10, 1e-14),
        *_of("rules", "collapsed", 0.5, 0.99, concerns=where_noise_is_high),
        *_of("rules", "lengthscale", 0.2, 1.5),
        *_of("rules", "lengthscale_limits", (1e-4, 1e6), (1e-1, 1e2)),
        *_of("rules", "highest_noise", 1.0),
        *_of("descent", "memory", 30, 300),
        *(Change("enough", str(value), enough=value) for value in (1e-5, 1e-4)),
        *_of("descent", "probes", 2),
        *_of("descent", "gradient", 1e-6),
    ]


DEFAULT = Change("default", "")


def waves(n_waves: int, n_inducing: int, noise: float, seed: int) -> Data:
    """1000 rows of a sine that the inducing points can hardly follow: much tempts a fit to call all of it noise."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-1, 1, (2000, 1))
    y = np.sqrt(2.0) * np.sin(n_waves * np.pi * X[:, 0])
    observed = y[:1000] + noise * rng.randn(1000)
    return Data(X[:1000], observed, X[1000:], y[1000:], {"n_inducing": n_inducing}, "waves")


def few_rows(dimension: int, noise: float, points_per_row: float, seed: int) -> Data:
    """60 rows, and about as many inducing points."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2, 2, (560, dimension))
    y = np.sin(2 * X[:, 0]) + 0.3 * X.sum(axis=1)
    observed = y[:60] + noise * rng.randn(60)
    return Data(X[:60], observed, X[60:], y[60:], {"n_inducing": int(60 * points_per_row)}, "few-rows")


def is_smooth(data: Data) -> bool:
    """Whether a nasty set has something to learn and enough rows for it: the bounds of others are rounding."""
    words = data.case.split()
    return len(data.X) >= 20 and ("waves" in words or "bump" in words) and "outliers" not in words


def cases(quick: bool) -> dict[tuple[str, int], Callable[[], Data]]:
    """(case, seed) -> makes its data."""
    found: dict[tuple[str, int], Callable[[], Data]] = {}

    def add(case: str, make: Callable[[int], Data], seeds: Iterable[int]) -> None:
        found.update({(case, seed): lambda seed=seed: make(seed) for seed in seeds})  # type: ignore[misc]

    two = range(1 if quick else 2)
    for n_waves, n_inducing in [(20, 20)] if quick else [(10, 20), (15, 30), (20, 30), (20, 40)]:
        for noise in (0.01,) if quick else (0.01, 0.3):
            add(
                f"waves-{n_waves}-points-{n_inducing}-noise-{noise:g}",
                lambda seed, of=(n_waves, n_inducing, noise): waves(*of, seed),  # type: ignore[misc]
                two,
            )
    for d, noise in [(1, 0.1)] if quick else [(1, 0.0), (1, 0.1), (3, 0.0), (3, 0.1), (6, 0.1)]:
        share = 0.8 if noise == 0.1 and d != 3 else 1.0
        add(
            f"few-rows-{d}d-noise-{noise:g}-points-{share:g}",
            lambda seed, of=(d, noise, share): few_rows(*of, seed),  # type: ignore[misc]
            two,
        )
    add("nasty", robustness.nasty, (s for s in range(2, 20 if quick else 200) if is_smooth(robustness.nasty(s))))
    if quick:
        return found
    # Where fits collapse.
    for n_waves, n_inducing in [(10, 15), (10, 20), (15, 30), (20, 30)]:
        add(
            f"more-waves-{n_waves}-points-{n_inducing}-noise-0.1",
            lambda seed, of=(n_waves, n_inducing, 0.1): waves(*of, seed),  # type: ignore[misc]
            range(2, 10),
        )
    # Where the kernel may explain every row by itself.
    for d, noise, share in [(2, 0.01, 0.7), (2, 0.1, 0.7), (4, 0.01, 0.7), (4, 0.1, 0.7), (2, 0.1, 0.9), (4, 0.1, 0.9)]:
        add(
            f"more-few-rows-{d}d-noise-{noise:g}-points-{share:g}",
            lambda seed, of=(d, noise, share): few_rows(*of, seed),  # type: ignore[misc]
            range(4),
        )
    add("more-nasty", robustness.nasty, (seed for seed in range(200, 400) if is_smooth(robustness.nasty(seed))))
    for d in (1, 3, 6):
        for noise in robustness.NOISES:
            add(
                f"smooth-{d}d-noise-{noise:g}",
                lambda seed, of=(d, noise): robustness.smooth(*of, seed),  # type: ignore[misc]
                two,
            )
    for name in ("VGP", "RES-VGP", "IF", "IFG"):
        add(f"pendulum-{name}", lambda seed, name=name: robustness.dynamics("pendulum", name, seed), two)  # type: ignore[misc]
    # The data of seed 0, other random states.
    add("pendulum-IFG-again", lambda seed: robustness.dynamics("pendulum", "IFG", 0), range(1, 4))
    add("cartpole-IFG", lambda seed: robustness.dynamics("cartpole", "IFG", seed), two)
    return found


@dataclass(frozen=True)
class Cell:
    """One fit."""

    rule: str
    variant: str
    case: str
    seed: int
    quick: bool = field(compare=False)


@cache
def _data(case: str, seed: int, quick: bool) -> Data:
    return cases(quick)[case, seed]()


def run(cell: Cell) -> dict[str, Any]:
    """The row of a fit."""
    change = next(c for c in (DEFAULT, *changes()) if (c.rule, c.variant) == (cell.rule, cell.variant))
    data = _data(cell.case, cell.seed, cell.quick)
    with internals.ablated(change.rules, change.descent, change.enough) as solver:
        values = robustness.fit(data, cell.seed + change.other_seed, solver=solver, noise_cv=None)
    row = {"rule": cell.rule, "variant": cell.variant, "case": cell.case, "seed": cell.seed}
    row |= dict.fromkeys(("outcome", *NUMBERS, "n_iter"), "") | values
    row |= {name: f"{values[name]:.7g}" for name in NUMBERS if name in values}
    row |= {
        "n_evaluations": len(solver.seconds_),
        "n_starts": solver.n_starts_,
        "collapsed": solver.n_collapsed_,
        "placed_anew": int(solver.placed_anew_),
        "points_per_row": f"{solver.points_per_row_:.3g}",
    }
    return row | harness.provenance()


def said(row: dict[str, Any]) -> str:
    """Of a fit that is done."""
    return f"{row['outcome']}, bound per row {row['bound_per_row']}, {row['n_evaluations']} evaluations"


def line_of(change: Change, rows: Sequence[Row], default: dict[tuple[str, str], Row]) -> list[str]:
    """A change's line of the table: on the cases it concerns, what is better or worse than the default, and by what."""
    own = [row for row in rows if (row["rule"], row["variant"]) == (change.rule, change.variant)]
    failed = sum(row["outcome"] != "ok" for row in own)
    pairs = [(row, default[row["case"], row["seed"]]) for row in own if row["outcome"] == "ok"]
    pairs = [(row, base) for row, base in pairs if base["outcome"] == "ok"]
    if not pairs:
        return []
    names = [f"{row['case']} ({row['seed']})" for row, _ in pairs]
    new, old = ([pair[side] for pair in pairs] for side in (0, 1))
    gain = harness.column(new, "bound_per_row") - harness.column(old, "bound_per_row")
    error, before = (np.maximum(harness.column(side, "error"), robustness.ERROR_FLOOR) for side in (new, old))
    ratio = error / before
    better, worse, worst = gain > CLOSE, gain < -CLOSE, int(np.argmin(gain))
    evaluations = harness.column(new, "n_evaluations"), harness.column(old, "n_evaluations")
    moved = gain[better | worse]
    return [
        change.rule,
        change.variant,
        f"{better.sum()} / {len(pairs) - better.sum() - worse.sum()} / {worse.sum()}"
        + f", {failed} failed" * bool(failed),
        f"{np.median(moved):+.3f}" if len(moved) else "",
        f"{gain[worst]:+.3f}, {names[worst]}" if worse.any() else "",
        f"{(ratio < 1 / CLOSE_ERROR).sum()} / {(ratio > CLOSE_ERROR).sum()}",
        f"{np.exp(np.mean(np.log(ratio))):.2f}",
        f"{evaluations[0].sum() / evaluations[1].sum():.2f}",
    ]


def report(rows: Sequence[Row]) -> list[str]:
    """The page."""
    default = {(row["case"], row["seed"]): row for row in rows if row["rule"] == DEFAULT.rule}
    known = {(change.rule, change.variant): change for change in changes()}
    done = dict.fromkeys((row["rule"], row["variant"]) for row in rows if row["rule"] != DEFAULT.rule)
    lines = [line for own in done if (line := line_of(known.get(own, Change(*own)), rows, default))]
    for line in lines:
        line[0] += "" if (line[0], line[1]) in known else " (no field any more)"
    header = ["rule", "variant", "bound better / equal / worse", "median difference", "worst difference"]
    header += ["error better / worse", "error, ratio", "evaluations, ratio"]
    return [
        "# What each rule of a fit is good for",
        f"`python benchmarks/ablation.py`: {len(default)} data sets, each fitted with the default solver and with one "
        "rule or number changed at a time. A change is run on the sets that it concerns: other starts where a fit "
        "collapsed, stages where inducing points may be placed anew. Bounds are in nats per row, and equal up to "
        f"{CLOSE:g}; the median difference is that of the bounds that are not equal. Errors on test data count as "
        f'different from a factor of {CLOSE_ERROR:g}; their ratio is a geometric mean. The lines of "luck" change '
        "nothing that matters: they show what chance does.",
        harness.table(header, lines),
        harness.provenance_text(rows),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    rules = list(dict.fromkeys(change.rule for change in changes()))
    parser = harness.argument_parser(__doc__, quick="a few small sets, a few rules")
    parser.add_argument("--rules", nargs="+", choices=rules, help="default: all")
    options = parser.parse_args(arguments)
    asked = options.rules or (["luck", "patience"] if options.quick else rules)
    output, sets = harness.output_path(options, "ablation"), list(cases(options.quick))

    def missing(cells: list[Cell]) -> int:
        return harness.run_missing(cells, run, output, options.jobs, said, since=options.since)

    failures = missing([Cell(DEFAULT.rule, DEFAULT.variant, *own, options.quick) for own in sets])
    default = {(row["case"], int(row["seed"])): row for row in harness.read(output) if row["rule"] == DEFAULT.rule}
    failures += missing(
        [
            Cell(change.rule, change.variant, *own, options.quick)
            for change in changes()
            for own in sets
            if change.rule in asked and own in default and change.concerns(default[own])
        ]
    )
    harness.write_report(report(harness.read(output)), output, failures)


if __name__ == "__main__":
    main()
