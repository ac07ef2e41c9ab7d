"""What the rows of against_peers.py say: a Markdown page and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from harness import WIDTH, Row, column, figure_of, legend, logarithmic, pyplot, save_picture, table

# Whose last bound and NLPD the others are timed against.
REFERENCE = ("GPflow SGPR", "none")
# Okabe & Ito's colours: told apart with any colour vision. Beside skevgp's default its "none" is not drawn: it is
# the same fit once more there.
STYLES = {
    ("skevgp", "none"): ("#0072B2", "-", "skevgp"),
    ("skevgp", "default"): ("#0072B2", "-", "skevgp"),
    ("skevgp", "all"): ("#56B4E9", "--", "skevgp, shared"),
    ("skevgp, same limit", "none"): ("#0072B2", ":", "skevgp, 120 iterations"),
    ("GPflow SGPR", "none"): ("#D55E00", "-", "GPflow SGPR"),
    ("GPflow SGPR", "all"): ("#E69F00", "-", "GPflow SGPR, shared"),
    ("GPyTorch SGPR", "none"): ("#009E73", "-", "GPyTorch SGPR"),
    ("GPyTorch SVGP", "none"): ("#009E73", ":", "GPyTorch SVGP"),
    ("GPJax SGPR", "none"): ("#CC79A7", "-", "GPJax SGPR"),
    ("scikit-learn GPR", "none"): ("#555555", "-", "scikit-learn GPR, up to 1,500 rows"),
}
NOTES = """Seconds are the processor's, not those on the wall; bound: the highest so far, of skevgp before calibration
Models of one output each are fitted one after the other: they have a bound once the last has begun"""
# The curve's bounds are rounded to 0.001 nats.
_ROUNDING = 0.01

# What `against_reference` says, and what it is called in the page.
_TO = {"to_bound": "to bound, s", "faster": "×", "net": "× net", "faster_cpu": "× by cpu", "to_nlpd": "to NLPD, s"}

Curve = list[Row]


def _own(rows: list[Row], **key: str) -> list[Row]:
    return [row for row in rows if all(row[name] == value for name, value in key.items())]


def _done(rows: list[Row]) -> list[Row]:
    return [row for row in rows if row["seconds"]]


def time_to_reach(curve: Curve, name: str, target: float, clock: str) -> float:
    """Seconds until a value was reached, between two times by a straight line in their logarithms.

    Parameters
    ----------
    curve : list of dict
        Of one fit, by time.
    name : {"bound", "nlpd"}
        The bound is to rise to the target, the NLPD to fall.
    target : float
    clock : {"seconds", "cpu_seconds"}

    Returns
    -------
    seconds : float
        NaN if it never was.
    """
    sign = -1.0 if name == "nlpd" else 1.0
    points = [row for row in curve if row[f"{name}_so_far"] not in ("", "nan")]
    seconds, values = column(points, f"{clock}_so_far"), sign * column(points, f"{name}_so_far")
    reached = np.flatnonzero(values >= sign * target)
    if not len(reached):
        return float("nan")
    i = reached[0]
    if i == 0 or not values[i] > values[i - 1]:
        return float(seconds[i])
    share = (sign * target - values[i - 1]) / (values[i] - values[i - 1])
    return float(np.exp(np.interp(share, (0.0, 1.0), np.log(np.maximum(seconds[i - 1 : i + 1], 1e-9)))))


def against_reference(row: Row, rows: list[Row], curves: Curve) -> dict[str, float]:
    """Seconds of a fit to the reference's last bound and NLPD, and how many times faster than all of its fit that is.

    Parameters
    ----------
    row : dict
        Of the fit.
    rows, curves : list of dict
        Of the two CSVs.

    Returns
    -------
    values : dict
        Of `_TO`; NaN where there is no such.
    """
    same = {name: row[name] for name in ("dataset", "seed")}
    peer, sharing = REFERENCE
    references = [
        one for one in _done(_own(rows, peer=peer, sharing=sharing, **same)) if one["n_train"] == row["n_train"]
    ]
    if not references:
        return dict.fromkeys(_TO, np.nan)
    reference = references[0]
    own = _own(curves, peer=row["peer"], sharing=row["sharing"], **same)
    bound = float(reference["bound"]) - _ROUNDING
    to_bound, cpu = (time_to_reach(own, "bound", bound, clock) for clock in ("seconds", "cpu_seconds"))
    first = _own(curves, peer=peer, sharing=sharing, **same)[:1]
    net = float(reference["seconds"]) - sum(column(first, "seconds_so_far"))
    values = (
        to_bound,
        float(reference["seconds"]) / to_bound,
        net / to_bound,
        float(reference["cpu_seconds"]) / cpu,
        time_to_reach(own, "nlpd", float(reference["nlpd"]) + 1e-6, "seconds"),
    )
    return dict(zip(_TO, values, strict=True))


def _number(value: float) -> str:
    return figure_of(value) if np.isfinite(value) else ""


def paragraphs(rows: list[Row], curves: Curve) -> list[str]:
    """Markdown: each data set's first seed, then means over seeds where there are several."""
    if not rows:
        return []
    name, _ = REFERENCE
    parts = [
        "# skevgp against other libraries",
        f"""Times to bound and to NLPD: seconds until the last bound and NLPD of {name} (one model per output) were
reached, between two looks at a fit by a straight line in log time. "×": all of its seconds over those to its bound;
"× net": the same without its seconds up to its first evaluation, most of which TensorFlow takes to trace the model;
"× by cpu": the same in seconds of the processor, over all threads, which other work on the machine disturbs less.
Bounds are in nats per row, of all outputs together; skevgp's last one is that after signal and noise were calibrated
by rows left out, which lowers it. Load: of the machine, just before the fit: where it is far above the number of cores
seconds say little, and those of the processor are to be compared, which the picture has.""",
    ]
    for dataset in dict.fromkeys(row["dataset"] for row in rows):
        own = _own(rows, dataset=dataset)
        first = min(own, key=lambda row: int(row["seed"]))["seed"]
        parts.append(f"## {dataset}, {'split' if _is_table(dataset) else 'seed'} {first}")
        parts.append(_first_seed(_own(own, seed=first), rows, curves))
        if len({row["seed"] for row in own}) > 1:
            parts.append(_all_seeds(dataset, own))
    machines = sorted({row["machine"] for row in rows})
    versions = sorted({row["versions"] for row in _done(rows)})
    dates = sorted({row["date"] for row in rows})
    parts.append(f"{' to '.join(dict.fromkeys((dates[0], dates[-1])))}; {'; '.join(versions)}; {', '.join(machines)}.")
    return parts


def _is_table(dataset: str) -> bool:
    from peers.data import DATASETS

    return DATASETS[dataset].from_folder


def _first_seed(rows: list[Row], all_rows: list[Row], curves: Curve) -> str:
    header = (
        *("peer", "sharing", "rows", "m", "seconds", "cpu s", "iterations", "bound / row", "RMSE", "NLPD"),
        *(*_TO.values(), "load", "stop"),
    )
    lines = []
    for row in rows:
        said = [row["peer"], row["sharing"], row["n_train"], row["m"]]
        if not row["seconds"]:
            lines.append([*said, *[""] * (6 + len(_TO)), row["load"], row["stop"]])
            continue
        to = against_reference(row, all_rows, curves)
        numbers = [float(row[name]) for name in ("seconds", "cpu_seconds")]
        iterations = "" if row["iterations"] == "nan" else f"{float(row['iterations']):.0f}"
        bound = float(row["bound"]) / int(row["n_train"])
        lines.append(
            [
                *said,
                *map(_number, numbers),
                iterations,
                f"{bound:.4f}" if np.isfinite(bound) else "",
                _number(float(row["rmse"])),
                f"{float(row['nlpd']):.4f}",
                *(_number(to[name]) for name in _TO),
                row["load"],
                " ".join(dict.fromkeys(row["stop"].split())),
            ]
        )
    return table(header, lines)


def _all_seeds(dataset: str, rows: list[Row]) -> str:
    """Mean and standard error over the seeds that a peer has."""

    def of(own: list[Row], name: str) -> str:
        values = column(own, name)
        if len(values) < 2:
            return f"{values.mean():.4f}"
        return f"{values.mean():.4f} ± {values.std(ddof=1) / np.sqrt(len(values)):.4f}"

    lines = []
    for peer, sharing in dict.fromkeys((row["peer"], row["sharing"]) for row in rows):
        own = _done(_own(rows, peer=peer, sharing=sharing))
        if own:
            seconds = _number(float(np.median(column(own, "seconds"))))
            lines.append([peer, sharing, str(len(own)), of(own, "rmse"), of(own, "nlpd"), seconds])
    what = "splits" if _is_table(dataset) else "seeds"
    said = f"All {what} of {dataset}, mean ± standard error, and the median of the seconds of a fit:"
    return f"{said}\n\n{table(('peer', 'sharing', what, 'RMSE', 'NLPD', 'seconds'), lines)}"


def draw(rows: list[Row], curves: Curve, path: Path) -> None:
    """Bound per row and NLPD over time, of each data set's first seed; where a line ends, its fit ended.

    Time is the processor's, which other work on the machine disturbs less.

    Parameters
    ----------
    rows, curves : list of dict
        Of the two CSVs.
    path : Path
        Of the PNG.
    """
    done = [row for row in _done(rows) if (row["peer"], row["sharing"]) in STYLES]
    datasets = list(dict.fromkeys(row["dataset"] for row in done))
    if not datasets:
        return
    size = (WIDTH, 1.0 + 1.9 * len(datasets))
    figure, grid = pyplot().subplots(len(datasets), 2, figsize=size, squeeze=False, sharex="row")
    for (bound, nlpd), dataset in zip(grid, datasets, strict=True):
        own = _own(done, dataset=dataset)
        first = min(own, key=lambda row: int(row["seed"]))["seed"]
        own, on_the_way = _own(own, seed=first), _own(curves, dataset=dataset, seed=first)
        limited = {(row["peer"], row["sharing"]) for row in own if set(row["stop"].split()) != {"converged"}}
        _panel(bound, on_the_way, "bound", limited)
        _panel(nlpd, on_the_way, "nlpd", limited)
        # Of the sparse ones: an exact GP has one for each of its rows.
        points = " or ".join(dict.fromkeys(row["m"] for row in own if not row["peer"].startswith("scikit-learn")))
        for axes, what in ((bound, "bound"), (nlpd, "test NLPD")):
            axes.set_title(f"{dataset}, {max(int(row['n_train']) for row in own):,} rows, {points} points: {what}")
            axes.set_ylabel("nats per row")
    for axes in grid[-1]:
        axes.set_xlabel("seconds of the processor, all threads")
    grid[-1, -1].plot([], [], "o", color="0.3", label="converged")
    grid[-1, -1].plot([], [], "o", color="0.3", markerfacecolor="white", label="ended by a limit of iterations")
    legend(figure, ncols=3, title=NOTES)
    save_picture(figure, path)


def _panel(axes: Any, curves: Curve, name: str, limited: set[tuple[str, str]]) -> None:
    """The best so far of the bound, and NLPD as it was; hollow ends are those of a limit."""
    ends = []
    for (peer, sharing), (colour, line, label) in STYLES.items():
        own = [row for row in _own(curves, peer=peer, sharing=sharing) if row[f"{name}_so_far"] not in ("", "nan")]
        twice = (peer, sharing) == ("skevgp", "none") and _own(curves, peer=peer, sharing="default")
        if twice or not own:
            continue
        # Each look at skevgp is a fit of its own: what was sooner by one clock may be later by the other.
        own.sort(key=lambda row: float(row["cpu_seconds_so_far"]))
        seconds, values = column(own, "cpu_seconds_so_far"), column(own, f"{name}_so_far")
        if name == "bound":
            values = np.maximum.accumulate(values) / int(own[0]["n_train"])
        face = "white" if (peer, sharing) in limited else colour
        marker = "o" if len(own) > 1 else "D"
        (shown,) = axes.plot(seconds[-1], values[-1], marker, color=colour, markerfacecolor=face, zorder=4)
        if len(own) > 1:
            (shown,) = axes.plot(seconds, values, line, color=colour)
        shown.set_label(label)
        ends.append(values[-1])
    logarithmic(axes, "x")
    axes.tick_params(labelbottom=True)
    if ends:
        # The way up to where the worst fit ended says little.
        low, room = min(ends), max(np.ptp(ends), 0.1)
        axes.set_ylim(
            (low - room, max(ends) + 0.15 * room) if name == "bound" else (low - 0.15 * room, low + 2.0 * room)
        )
