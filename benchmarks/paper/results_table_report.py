"""What the rows of results_table.py say, beside the paper's Table 4: a Markdown page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp
from scipy.stats import chi2, norm

from harness import Row, figure_of, provenance_text, table
from harness import column as of
from paper.models import PROMISED, SYSTEMS
from skevgp.robots import layout_of


class Result(NamedTuple):
    """A row of the paper's Table 4."""

    cr1: float
    cr2: float
    cr3: float
    error: float
    std_norm: float
    n_parameters: int


MODELS = ("VGP", "RES-VGP", "RES-DBNN", "EVGP-IF", "EVGP-IFG")
PAPER: dict[str, dict[str, Result]] = {
    system: {model: Result(*values) for model, values in zip(MODELS, results, strict=True)}
    for system, results in {
        "pendulum": (
            (0.582, 0.841, 0.910, 0.343, 0.273, 407),
            (0.833, 0.951, 0.974, 0.155, 0.216, 407),
            (0.691, 0.908, 0.959, 0.017, 0.010, 634),
            (0.936, 0.986, 0.993, 0.013, 0.024, 119),
            (0.871, 0.965, 0.985, 0.005, 0.007, 123),
        ),
        "cartpole": (
            (0.505, 0.828, 0.901, 0.188, 0.185, 2813),
            (0.518, 0.848, 0.924, 0.216, 0.153, 2813),
            (0.336, 0.767, 0.901, 0.044, 0.036, 6008),
            (0.933, 0.980, 0.990, 0.016, 0.184, 1733),
            (0.935, 0.976, 0.986, 0.011, 0.041, 1741),
        ),
        "acrobot": (
            (0.715, 0.861, 0.913, 1.100, 2.137, 7013),
            (0.705, 0.846, 0.904, 0.820, 1.428, 7013),
            (0.606, 0.837, 0.899, 0.289, 0.378, 8408),
            (0.794, 0.908, 0.950, 0.151, 0.290, 4253),
            (0.712, 0.893, 0.952, 0.131, 0.251, 4269),
        ),
        "iiwa14": (
            (0.000, 0.051, 0.311, 0.048, 0.039, 161049),
            (0.002, 0.163, 0.519, 0.055, 0.047, 161049),
            (0.001, 0.096, 0.346, 0.036, 0.025, 143028),
            (0.040, 0.353, 0.684, 0.037, 0.035, 113337),
            (0.083, 0.480, 0.773, 0.027, 0.030, 113673),
        ),
    }.items()
}
PAPER["cartpole_damped"] = PAPER["cartpole"]  # the paper has one, and does not say which
# A normal distribution's containing ratios.
NORMAL = np.array([0.683, 0.954, 0.997])
# Share of targets within two standard deviations of a normal distribution, and how far from it counts as calibrated.
TWO_SIGMA, TOLERANCE = 0.954, 0.03
# Pairs of models of which the first, knowing more, should have the lower Error.
ORDER = (("EVGP-IFG", "EVGP-IF"), ("EVGP-IF", "VGP"), ("EVGP-IF", "RES-VGP"))
# Colour (Okabe & Ito's palette, safe for colour-blind readers) and marker of each setting.
STYLES = {
    "paper": ("#E69F00", "s"),
    "author": ("#D55E00", "v"),
    "author-100": ("#56B4E9", "P"),
    "skevgp": ("#0072B2", "o"),
    "skevgp-angles": ("#009E73", "^"),
    "skevgp-nominal": ("#CC79A7", "D"),
}
WRAPPED = ", wrapped"
# Which cartpole the paper's may be.
CARTPOLES = ("cartpole", f"cartpole{WRAPPED}", "cartpole_damped", f"cartpole_damped{WRAPPED}")
# Data sets of a cell, if nothing is said.
N_SEEDS = 4
MARKS = (
    "An asterisk: a fit of the cell ended by a limit, not by itself. A dagger: in a fit of the cell the Gaussian "
    "process learned nothing of an output, which a warning says. In brackets: how many data sets, if not four."
)
# How far, in log Error, what the paper does not say may move a number: a factor of 1.5.
UNSAID = np.log(1.5)

Key = tuple[str, str, str]  # case (a system, its angles wrapped or not), model, setting
Groups = dict[Key, list[Row]]


def case_of(row: Row) -> str:
    """The system, and whether its angles are wrapped."""
    return row["system"] + (WRAPPED if row["angles"] == "wrapped" else "")


def group(rows: list[Row]) -> Groups:
    """Rows of each (case, model, setting), in the order of the paper's table."""
    cases = [case for system in SYSTEMS for case in (system, f"{system}{WRAPPED}")]
    keys = [(case, model, setting) for setting in STYLES for case in cases for model in MODELS]
    groups: Groups = {key: [] for key in keys}
    for row in rows:
        groups[case_of(row), row["model"], row["setting"]].append(row)
    return {key: sorted(own, key=lambda row: int(row["seed"])) for key, own in groups.items() if own}


def noisy(rows: list[Row]) -> bool:
    """Whether targets have noise, of which the paper tells nothing: containing ratios count then, not its Errors."""
    return float(rows[0]["noise"]) > 0.0


def models_of(rows: list[Row]) -> list[str]:
    """All of the paper's; with noise those that are there."""
    present = {row["model"] for row in rows}
    return [model for model in MODELS if model in present or not noisy(rows)]


def published(case: str, model: str) -> Result:
    """The paper's numbers."""
    return PAPER[case.removesuffix(WRAPPED)][model]


def cut_short(row: Row) -> bool:
    """Whether a fit went all the iterations that ``--max-iter`` left it; Adam's then end as if there were no more."""
    return row["max_iter"] == row["n_iter"]


def limited(row: Row) -> bool:
    """Whether a limit of iterations ended a fit."""
    return row["converged"] == "False" or cut_short(row)


def unlearned(row: Row) -> bool:
    """Whether there is an output of which the Gaussian process learned nothing, as a warning said."""
    return float(row["unlearned"]) > 0.0


def marks(own: list[Row]) -> str:
    """What a reader must know of a cell: `MARKS`, or fewer seeds."""
    seen = star(any(map(limited, own))) + ("†" if any(map(unlearned, own)) else "")
    return seen + (f" ({len(own)})" if len(own) != N_SEEDS else "")


def star(is_limited: bool) -> str:
    """The asterisk of `MARKS`, in Markdown."""
    return "\\*" if is_limited else ""


def both(own: list[Row]) -> str:
    """The mean Error of all rows and, where it was measured, of those inside the training range, means over seeds."""
    everywhere, inside = of(own, "error_mean").mean(), of(own, "error_inside").mean()
    return figure_of(everywhere) + (f" / {figure_of(inside)}" if np.isfinite(inside) else "") + marks(own)


def paragraphs(rows: list[Row]) -> list[str]:
    """A page: all settings at a glance by mean Error, with noise by CR-2, then a table of everything for each setting.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size and one noise.

    Returns
    -------
    parts : list of str
    """
    groups = group(rows)
    seeds = sorted({int(row["seed"]) for row in rows})
    parts = [
        "# The results: Table 4 of the paper, and ours",
        "Written by `benchmarks/paper/results_table.py`. Error is the mean over test rows of the norm of the error, in "
        f"SI units. Noise: {rows[0]['noise']} of each training target's standard deviation, on training and test "
        f"targets. Seeds: {', '.join(map(str, seeds))}. {provenance_text(rows)}",
    ]
    if noisy(rows):
        parts.append(
            "The paper tells of no noise on its data, so its numbers are no target here; our Errors contain the test "
            f"targets' noise. CR-2 should be a normal distribution's {TWO_SIGMA}."
        )
    if rows[0]["size"] == "quick":
        parts.append(
            "**A quick run**: fewer rows and iterations than the paper's, not to be compared with its numbers."
        )
    if noisy(rows):
        parts += ["## CR-2, mean over seeds", MARKS, glance(groups, models_of(rows), with_noise=True)]
    else:
        parts += [
            "## Error, mean over seeds",
            f"*All rows / rows whose columns all lie within the training rows' ranges.* {MARKS}",
            glance(groups, models_of(rows)),
            *which_cartpole(groups),
            *outside(groups),
        ]
    parts += ["## Where it falls short", shortfalls(groups, noisy(rows))]
    parts += ["## Calibration", f"Shares of the targets within intervals that promise them. {MARKS}", coverage(groups)]
    settings = [setting for setting in STYLES if any(key[2] == setting for key in groups)]
    parts += [part for setting in settings for part in (f"## Setting: {setting}", details(groups, setting))]
    parts.append(
        "Each pair is *ours / the paper's*; ours are means over seeds, but for the spread of the Error over seeds "
        "(median and largest). Inside, outside: mean Error of the test rows within the training rows' ranges, with "
        "their share, and of the others. Median and 99 % of rows: quantiles of the error over test rows. NLPD: "
        "negative log predictive density, nats per row. Seconds: processor time of the fit, one thread."
    )
    if {"VGP", "RES-VGP"} & set(models_of(rows)):
        parts.append("VGP and RES-VGP have 1.4 to 4 times as many inducing points as EVGP: the paper's sizes.")
    return [*parts, *limits(groups)]


def limits(groups: Groups) -> Iterator[str]:
    """Which fits did not end by themselves, and why a cell may be large."""
    stopped = [
        f"{' '.join(key)} ({sum(row['converged'] == 'False' for row in own)} of {len(own)})"
        for key, own in groups.items()
        if any(row["converged"] == "False" for row in own)
    ]
    yield f"Fits whose search did not end by itself, as a warning said: {', '.join(stopped) or 'none'}."
    nothing = [
        f"{' '.join(key)} ({sum(map(unlearned, own))} of {len(own)})"
        for key, own in groups.items()
        if any(map(unlearned, own))
    ]
    yield f"Fits of which the Gaussian process learned nothing of an output: {', '.join(nothing) or 'none'}."
    limited = [
        f"{' '.join(key)} ({', '.join(sorted({row['max_iter'] for row in own if cut_short(row)}, key=int))})"
        for key, own in groups.items()
        if any(map(cut_short, own))
    ]
    yield f"Iterations were limited by `--max-iter` in: {', '.join(limited) or 'none'}."
    if any(key[1:] == ("VGP", "skevgp-angles") for key in groups):
        yield (
            "A kernel of sines and cosines cannot tell an angle from the same after a turn. Where joints turn, VGP, "
            "whose targets are angles, cannot learn them in the setting skevgp-angles; the other models know that an "
            "angle starts where it is."
        )


def glance(groups: Groups, models: list[str], with_noise: bool = False) -> str:
    """A line per case and model, a column per setting."""
    settings = [setting for setting in STYLES if any(key[2] == setting for key in groups)]
    lines = []
    for case in dict.fromkeys(key[0] for key in groups):
        for model in models:
            paper = published(case, model)
            cells = [groups.get((case, model, setting)) for setting in settings]
            if with_noise:
                written = [figure_of(of(own, "cr2").mean()) + marks(own) if own else "" for own in cells]
            else:
                written = [both(own) if own else "" for own in cells]
            lines.append([case, model, f"{paper.cr2 if with_noise else paper.error:.3f}", *written])
    return table(["system", "model", "in the paper", *(f"ours: {setting}" for setting in settings)], lines)


def which_cartpole(groups: Groups) -> Iterator[str]:
    """Each reading of the paper's cartpole beside its numbers, and how likely these are under each."""
    settings = [
        setting
        for setting in STYLES
        if sum(any(key[::2] == (case, setting) for key in groups) for case in CARTPOLES) > 1
    ]
    if not settings:
        return
    yield "## Which cartpole is the paper's?"
    for setting in settings:
        cases = [case for case in CARTPOLES if any(key[::2] == (case, setting) for key in groups)]
        lines = [
            [model, f"{PAPER['cartpole'][model].error:.3f}"]
            + [spread(groups.get((case, model, setting), [])) for case in cases]
            for model in MODELS
        ]
        yield f"Setting {setting}: the Error of each data set, all rows; in brackets those inside the training range."
        yield table(["model", "in the paper", *cases], lines)
        scores = closeness(groups, cases, setting)
        if len(scores) > 1:
            yield (
                "How likely the paper's Error of each model is under each reading: its logarithm, nats. Over data sets "
                "log Error is taken as normal, with all means and variances that ours leave possible, and widened by a "
                "factor of 1.5 for what the paper does not say. The models share their data sets, so that their sum "
                "counts the same evidence several times: it says too much. Left out are readings with fewer than three "
                "models, and models that not all readings have on two data sets or of which an output was not learned."
            )
            common = list(next(iter(scores.values())))
            best = max(sum(own.values()) for own in scores.values())
            yield table(
                ["reading", *common, "sum", "less than the best"],
                [
                    [case, *(f"{value:.1f}" for value in (*own.values(), total, best - total))]
                    for case, own in sorted(scores.items(), key=lambda item: -sum(item[1].values()))
                    for total in [sum(own.values())]
                ],
            )


def spread(own: list[Row]) -> str:
    """The Errors of data sets, and those inside."""
    known = bool(own) and np.isfinite(of(own, "error_inside")).all()
    inside = f" ({', '.join(map(figure_of, of(own, 'error_inside')))})" if known else ""
    return ", ".join(map(figure_of, of(own, "error_mean"))) + inside


def closeness(groups: Groups, cases: list[str], setting: str) -> dict[str, dict[str, float]]:
    """The log likelihood of the paper's Errors under our data sets' of each reading, by the models that all have."""
    own = {(case, model): groups.get((case, model, setting), []) for case in cases for model in MODELS}
    told = {key for key, rows in own.items() if len(rows) > 1 and not any(map(unlearned, rows))}
    models = {case: {model for model in MODELS if (case, model) in told} for case in cases}
    # A reading with less than three models would leave too few to compare by.
    models = {case: known for case, known in models.items() if len(known) > 2}
    common = set.intersection(*models.values()) if models else set()
    return {
        case: {model: likelihood(published(case, model).error, own[case, model]) for model in MODELS if model in common}
        for case in models
        if common
    }


def likelihood(error: float, own: list[Row]) -> float:
    """The logarithm of it, of one Error: normal, over all means and variances that the few data sets leave possible.

    Without prior knowledge of both the mean is normal, and the variance inverse χ² with n - 1 degrees of freedom
    (Gelman et al., Bayesian Data Analysis, 3.2).
    """
    errors = np.log(of(own, "error_mean"))
    n = len(errors)
    shares = (np.arange(10_000) + 0.5) / 10_000
    variances = errors.var(ddof=1) * (n - 1) / chi2.ppf(shares, n - 1)
    scales = np.sqrt(variances * (1.0 + 1.0 / n) + UNSAID**2)
    return float(logsumexp(norm.logpdf(np.log(error), errors.mean(), scales)) - np.log(len(shares)))


def outside(groups: Groups) -> Iterator[str]:
    """Which test rows lie beyond the training rows, and how much of an Error they make."""
    by_case: dict[str, dict[str, Row]] = {}
    of_ifg: dict[tuple[str, str, str], Row] = {}
    for (case, model, setting), own in groups.items():
        for row in (row for row in own if np.isfinite(float(row["inside"]))):
            by_case.setdefault(case, {}).setdefault(row["seed"], row)
            if model == "EVGP-IFG":
                of_ifg[case, setting, row["seed"]] = row
    shown = [setting for setting in ("paper", "skevgp") if any(key[1] == setting for key in of_ifg)]
    lines = []
    for case, by_seed in by_case.items():
        names = layout_of(case.removesuffix(WRAPPED)).column_names
        for seed, row in sorted(by_seed.items(), key=lambda item: int(item[0])):
            columns = [text.split(":") for text in row["outside"].split()]
            said = [f"{names[int(column)]} {n} ({limit} → {reach})" for column, n, limit, reach in columns]
            shares = [
                f"{share_outside(of_ifg[case, setting, seed]):.0%}" if (case, setting, seed) in of_ifg else ""
                for setting in shown
            ]
            lines.append([case, seed, f"{1.0 - float(row['inside']):.1%}", *shares, ", ".join(said) or "none"])
    yield "## The rows outside the training range"
    yield (
        "Of each data set: the share of test rows with a column beyond all training rows, and what share these have "
        "in the Error of EVGP-IFG. Then of each column how many rows are beyond, from the end of the training rows' "
        "range to the farthest (rad, m, s, N)."
    )
    yield table(["system", "seed", "rows", *(f"of the Error, {setting}" for setting in shown), "columns"], lines)


def share_outside(row: Row) -> float:
    """What part of a fit's Error rows outside the training range make."""
    return 1.0 - float(row["inside"]) * float(row["error_inside"]) / float(row["error_mean"])


def reliability(own: list[Row]) -> tuple[np.ndarray, np.ndarray]:
    """What intervals promise and hold, means over seeds: at all shares; where these were not measured, CR-1 to 3."""
    held = np.array([of(own, f"within_{share}").mean() for share in PROMISED])
    if np.isfinite(held).all():
        return np.array(PROMISED), held
    return NORMAL, np.array([of(own, f"cr{k}").mean() for k in (1, 2, 3)])


def coverage(groups: Groups) -> str:
    """Shares held by intervals of some promised shares, means over seeds."""
    names = {"0.5": "within_0.5", "0.8": "within_0.8", "0.95": "within_0.95"}
    names |= {f"CR-{k}: {share}": f"cr{k}" for k, share in zip((1, 2, 3), NORMAL, strict=True)}
    lines = []
    for key, own in groups.items():
        held = [of(own, name).mean() for name in names.values()]
        lines.append([" ".join(key) + marks(own), *(f"{value:.3f}" if np.isfinite(value) else "" for value in held)])
    return table(["promised", *names], lines)


def shortfalls(groups: Groups, with_noise: bool = False) -> str:
    """Where means over seeds miss a normal's CR-2 and, without noise, the models' order or the paper's Error."""
    errors = {key: of(own, "error_mean").mean() for key, own in groups.items()}
    unordered = [
        f"{case} {setting}: {better} {figure_of(errors[case, better, setting])}, "
        f"{worse} {figure_of(errors[case, worse, setting])}"
        for case, setting in dict.fromkeys((case, setting) for case, _, setting in groups)
        for better, worse in ORDER
        if errors.get((case, better, setting), np.nan) > errors.get((case, worse, setting), np.nan)
    ]
    above, uncalibrated = [], []
    for key, own in groups.items():
        if key[1].startswith("EVGP"):
            paper, cr2 = published(*key[:2]).error, of(own, "cr2").mean()
            above += [f"{' '.join(key)} ({figure_of(errors[key])}, there {paper:.3f})"] if errors[key] > paper else []
            uncalibrated += [f"{' '.join(key)} ({cr2:.3f})"] if abs(cr2 - TWO_SIGMA) > TOLERANCE else []
    calibration = {f"An EVGP's CR-2 is more than {TOLERANCE} from a normal distribution's {TWO_SIGMA}": uncalibrated}
    points = (
        calibration
        if with_noise
        else {
            "EVGP-IFG's Error is above EVGP-IF's, or this above VGP's or RES-VGP's": unordered,
            "An EVGP's Error is above the paper's": above,
            **calibration,
        }
    )
    return "\n".join(f"* {what}: {'; '.join(where) or 'nowhere'}." for what, where in points.items())


def details(groups: Groups, setting: str) -> str:
    """Every column of the paper's table and of the CSV, for one setting."""
    lines = []
    for (case, model, own_setting), own in groups.items():
        if own_setting != setting:
            continue
        paper, errors = published(case, model), of(own, "error_mean")
        counts = sorted({row["n_parameters"] for row in own}, key=int)
        beyond, inside = of(own, "error_outside"), of(own, "error_inside").mean()
        lines.append(
            [
                *(case, model, str(len(own)), f"{figure_of(errors.mean())} / {paper.error:.3f}"),
                *(figure_of(value) for value in (np.median(errors), errors.max())),
                f"{figure_of(inside)} ({of(own, 'inside').mean():.1%})" if np.isfinite(inside) else "",
                figure_of(np.nanmean(beyond)) if np.isfinite(beyond).any() else "",
                *(figure_of(of(own, column).mean()) for column in ("error_median", "error_p99")),
                f"{figure_of(of(own, 'std_norm').mean())} / {paper.std_norm:.3f}",
                *(f"{of(own, name).mean():.3f} / {getattr(paper, name):.3f}" for name in ("cr1", "cr2", "cr3")),
                f"{of(own, 'nlpd').mean():.2f}",
                f"{', '.join(counts)} / {paper.n_parameters}",
                f"{np.median(of(own, 'n_iter')):.0f}",
                f"{of(own, 'fit_seconds').mean():.1f}",
            ]
        )
    header = ["system", "model", "seeds", "Error", "median seed", "largest", "inside", "outside", "median row"]
    header += ["99 % of rows", "‖STD‖", "CR-1", "CR-2", "CR-3", "NLPD", "parameters", "iterations", "seconds"]
    return table(header, lines)
