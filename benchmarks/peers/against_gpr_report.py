"""What the rows of against_gpr.py say: a Markdown page and a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harness import WIDTH, Row, column, figure_of, legend, logarithmic, provenance_text, pyplot, save_picture, table

# Colour (Okabe & Ito's palette, safe for colour-blind readers), marker and line of each model.
STYLES = {
    "GPR": ("#D55E00", "s", "-"),
    "EGP": ("#E69F00", "D", "--"),
    "EVGP": ("#0072B2", "o", "-"),
    "EGP-IFG": ("#CC79A7", "v", "--"),
    "EVGP-IFG": ("#009E73", "^", "-"),
}
LABELS = {
    "GPR": "scikit-learn GPR",
    "EGP": "EGP: skevgp's exact GP",
    "EVGP": "EVGP: 100 inducing points",
    "EGP-IFG": "EGP-IFG: exact, with features",
    "EVGP-IFG": "EVGP-IFG: features, 10 or 60 points",
}
SYSTEMS = {"pendulum": "pendulum", "cartpole": "cartpole", "smooth": "smooth function with noise, 8 columns"}
MEASURES = {
    "fit_seconds": "seconds to fit",
    "memory_mb": "MB while fitting",
    "error": "test error (SI units)",
    "nlpd": "NLPD, nats per row",
}
# Sizes, the largest, over which exponents are fitted.
N_EXPONENT = 4

Lines = dict[str, dict[int, list[Row]]]


def lines_of(rows: list[Row], system: str) -> Lines:
    """Rows by model and N, seeds together."""
    own = [row for row in rows if row["system"] == system]
    return {
        model: {n: [row for row in of if int(row["n_rows"]) == n] for n in sorted({int(row["n_rows"]) for row in of})}
        for model in STYLES
        if (of := [row for row in own if row["model"] == model])
    }


def curve(line: dict[int, list[Row]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """N and the mean over seeds."""
    return np.array(list(line), float), np.array([column(own, name).mean() for own in line.values()])


def exponent(line: dict[int, list[Row]], name: str) -> float:
    """Of the power of N, over the largest sizes."""
    n, values = (values[-N_EXPONENT:] for values in curve(line, name))
    return float(np.polyfit(np.log(n), np.log(np.maximum(values, 1e-9)), 1)[0]) if len(n) > 1 else np.nan


def crossing(one: dict[int, list[Row]], other: dict[int, list[Row]], name: str) -> str:
    """From which N on the other is below the one, between sizes by the straight line of the picture."""
    common = [n for n in one if n in other]
    of = [np.log(np.maximum(curve({n: line[n] for n in common}, name)[1], 1e-9)) for line in (one, other)]
    ahead, x = of[0] - of[1], np.log(common)
    if ahead[-1] <= 0.0:
        return f"not at {common[-1]} rows"
    behind = np.flatnonzero(ahead <= 0.0)
    if not len(behind):
        return "at all of these sizes"
    i = behind[-1]
    return f"from about {np.exp(x[i] - ahead[i] * (x[i + 1] - x[i]) / (ahead[i + 1] - ahead[i])):.0f} rows on"


def details(lines: Lines) -> str:
    """Every measure of every model, N from left to right."""
    sizes = sorted({n for line in lines.values() for n in line})
    measures = {
        "fit_seconds": ("fit, s", ""),
        "predict_seconds": ("predict 1000 rows, s", ""),
        "memory_mb": ("memory, MB", ""),
        "error": ("error", ""),
        "counterpart_error": ("error", ", made exact"),
        "nlpd": ("NLPD", ""),
        "counterpart_nlpd": ("NLPD", ", made exact"),
        "log_likelihood": ("log likelihood / N", ""),
        "counterpart_log_likelihood": ("log likelihood / N", ", made exact"),
    }
    parts = []
    for name, (measure, suffix) in measures.items():
        for model, line in lines.items():
            if suffix and model != "EVGP":
                continue
            cells = []
            for n in sizes:
                value = column(line[n], name).mean() / (n if "likelihood" in name else 1) if n in line else np.nan
                cells.append("" if np.isnan(value) else figure_of(value))
            parts.append([measure, model + suffix, *cells])
    return table(["", "model", *map(str, sizes)], parts)


def verdict(lines: Lines) -> str:
    """Both regressors without features at the largest N that both were fitted to, and where their lines cross."""
    gpr, evgp = lines.get("GPR", {}), lines.get("EVGP", {})
    common = [n for n in gpr if n in evgp]
    if not common:
        return ""
    largest = common[-1]
    gpr_row, evgp_row = ({name: column(line[largest], name).mean() for name in MEASURES} for line in (gpr, evgp))
    said = (
        f"At {largest} rows, the most that GPR was fitted to, it took {figure_of(gpr_row['fit_seconds'])} s and "
        f"{figure_of(gpr_row['memory_mb'])} MB; EVGP {figure_of(evgp_row['fit_seconds'])} s and "
        f"{figure_of(evgp_row['memory_mb'])} MB. "
    )
    if max(evgp) > largest:
        n_next, further = min(n for n in evgp if n > largest), evgp[max(evgp)]
        expected = gpr_row["fit_seconds"] * (n_next / largest) ** 3
        said += (
            f"At {n_next} rows GPR would take {figure_of(expected)} s if that grows with N³; EVGP went on to "
            f"{max(evgp)} rows in {figure_of(column(further, 'fit_seconds').mean())} s and "
            f"{figure_of(column(further, 'memory_mb').mean())} MB. "
        )
    said += (
        f"Where EVGP takes less time: {crossing(gpr, evgp, 'fit_seconds')}; less memory: "
        f"{crossing(gpr, evgp, 'memory_mb')}.\n"
    )
    for name, what in (("error", "error"), ("nlpd", "NLPD")):
        better, unknown = [], []
        for n in common:
            ours, theirs = column(evgp[n], name).mean(), column(gpr[n], name).mean()
            if np.isnan(theirs):
                unknown.append(str(n))
            elif theirs < ours:
                difference = (
                    f"{figure_of(ours / theirs)} times" if name == "error" else f"{figure_of(ours - theirs)} nats"
                )
                better.append(f"{n} ({difference})")
        said += f"\n* {what}: GPR is better than EVGP at {'N = ' + ', '.join(better) if better else 'no size'}."
        if unknown:
            said += f" It has no NLPD at {', '.join(unknown)} rows: negative variances, rounded up to 0."
    exact = {n: own for n, own in evgp.items() if not np.isnan(column(own, "counterpart_nlpd")).any()}
    if exact:
        log_likelihood, error, nlpd = (
            [np.mean(column(own, f"counterpart_{name}") - column(own, name)) for own in exact.values()]
            for name in ("log_likelihood", "error", "nlpd")
        )
        gaps = [(n, difference / n) for n, difference in zip(exact, log_likelihood, strict=True)]
        errors = np.array(error) / [column(own, "error").mean() for own in exact.values()]
        said += "\n* What sparsity costs (log marginal likelihood of the exact counterpart less EVGP's bound, nats per "
        said += f"row): {', '.join(f'{figure_of(gap)} at {n}' for n, gap in gaps)}."
        said += (
            f"\n* Made exact, with kernel and noise as they are, EVGP's error changes by {min(errors):+.0%} to "
            f"{max(errors):+.0%} and its NLPD by {min(nlpd):+.2f} to {max(nlpd):+.2f} nats. What else is between it "
            "and GPR comes of the hyperparameters: of what the bound prefers, and of what GPR's outputs share."
        )
    for model, line in lines.items():
        warned = {n: own[0]["warning"] for n, own in line.items() if own[0]["warning"]}
        if warned:
            message = warned[max(warned)].split(". ")[0].rstrip(":.")
            said += f"\n* {model} warned at {', '.join(map(str, warned))} rows; at {max(warned)}: “{message}.”"
    return said


def paragraphs(rows: list[Row]) -> list[str]:
    """A page: what is compared, exponents, then what each data set shows and its figures.

    Parameters
    ----------
    rows : list of dict
        Of the CSV.

    Returns
    -------
    parts : list of str
    """
    found = {system: lines for system in SYSTEMS if (lines := lines_of(rows, system))}
    seeds = sorted({int(row["seed"]) for row in rows})
    exponents = [
        [system, model, str(max(line)), *(f"{exponent(line, name):.2f}" for name in ("fit_seconds", "memory_mb"))]
        for system, lines in found.items()
        for model, line in lines.items()
    ]
    parts = [
        "# EVGPRegressor and GaussianProcessRegressor as N grows",
        "Written by `benchmarks/peers/against_gpr.py`; its docstring says what the models are. Seconds: of the "
        "processor, one thread. MB: peak while fitting, above what there was before. Error: mean norm of the error on "
        "4800 test rows (of the smooth function against itself without noise), in units of y. NLPD: nats per row. Of "
        "the systems GPR has one kernel and one noise for all outputs, EVGP and EGP a signal variance and a noise for "
        f"each. *EVGP, made exact* is GPR with the EVGP's kernel and noise. Seeds: {', '.join(map(str, seeds))}. "
        f"{provenance_text(rows)}",
        "## Exponents",
        f"Time and memory grow with these powers of N, fitted over the {N_EXPONENT} largest sizes of each model; "
        "memory of a few MB is not fitted well.",
        table(["data", "model", "largest N", "time", "memory"], exponents),
    ]
    for system, lines in found.items():
        parts += [f"## {SYSTEMS[system].capitalize()}", verdict(lines), details(lines)]
    return parts


def plot(rows: list[Row], path: Path) -> None:
    """Time, memory, error and NLPD over N; a column of panels per data set.

    Parameters
    ----------
    rows : list of dict
        Of the CSV.
    path : Path
        Of the PNG.
    """
    found = {system: lines for system in SYSTEMS if (lines := lines_of(rows, system))}
    size = (WIDTH, 8.4)
    figure, grid = pyplot().subplots(len(MEASURES), len(found), figsize=size, squeeze=False, sharex="col")
    for panels, (system, lines) in zip(grid.T, found.items(), strict=True):
        panels[0].set_title(SYSTEMS[system].replace(", ", "\n"))
        for axes, name in zip(panels, MEASURES, strict=True):
            for model, line in lines.items():
                colour, marker, style = STYLES[model]
                axes.plot(*curve(line, name), marker + style, color=colour, label=LABELS[model])
            if name != "nlpd":
                logarithmic(axes)
        logarithmic(panels[-1], "x")
        sizes = sorted({n for line in lines.values() for n in line})[::2]
        panels[-1].set_xticks(sizes, [f"{n:,}" for n in sizes])
        panels[-1].set_xticks([], minor=True)
        panels[-1].set_xlabel("rows, N")
    for axes, label in zip(grid[:, 0], MEASURES.values(), strict=True):
        axes.set_ylabel(label)
    figure.align_ylabels(grid[:, 0])
    n_seeds = max(len(own) for lines in found.values() for line in lines.values() for own in line.values())
    legend(figure, ncols=3, title=f"means over {n_seeds} seeds" if n_seeds > 1 else None)
    save_picture(figure, path)
