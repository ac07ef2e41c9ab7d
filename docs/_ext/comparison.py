"""Tables of the page Comparison, from the benchmarks' CSVs."""

import csv
from collections.abc import Iterable, Sequence
from math import sqrt
from pathlib import Path
from statistics import fmean, stdev

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
# Which systems' outputs are so many models, where peers fit one for each; tables have one output.
DATA = {
    "elevators": "elevators",
    "kin40k": "kin40k",
    "airfoil": "airfoil",
    "smooth": "smooth, 8 columns",
    "pendulum": "pendulum, 2 outputs",
    "cartpole": "cartpole, 4 outputs",
    "acrobot": "acrobot, 4 outputs",
}
# Where the machine's load before a fit is above this, with two cores, its seconds are much of other work.
BUSY = 4.0
SHARING = {"none": "one model per output", "all": "one model", "default": "defaults"}
EXACT = {
    "GPR": "scikit-learn, exact",
    "EVGP": "skevgp, 100 points",
    "EVGP-IFG": "skevgp, with physics",
}


def rows_of(path: Path) -> list[dict[str, str]]:
    """Read a CSV."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def short(value: float) -> str:
    """Write a number with three digits."""
    return f"{value:#.3g}".rstrip(".") if abs(value) < 1000.0 else f"{value:,.0f}"


def best(values: Sequence[float], among: Sequence[bool] | None = None) -> list[str]:
    """Write numbers of which less is better, in bold the best of all, or of some that can be compared."""
    least = min(value for value, counts in zip(values, among or [True] * len(values), strict=True) if counts)
    return [f"**{short(value)}**" if value == least else short(value) for value in values]


def peers() -> str:
    """Write seconds, error and NLPD of each library on each data set; in bold the best of those with all seeds.

    Seconds beside much other work are in parentheses, and not compared.
    """
    found: dict[str, dict[tuple[str, str], list[dict[str, str]]]] = {}
    for row in rows_of(RESULTS / "against_peers.csv"):
        found.setdefault(row["dataset"], {}).setdefault((row["peer"], row["sharing"]), []).append(row)
    lines = []
    for data, fits in found.items():
        most = max(len(rows) for rows in fits.values())
        full = [len(rows) == most for rows in fits.values()]
        busy = [any(float(row["load"]) > BUSY for row in rows) for rows in fits.values()]
        seconds, *others = (
            [fmean(float(row[name]) for row in rows) for rows in fits.values()]
            for name in ("seconds", "cpu_seconds", "rmse", "nlpd")
        )
        quiet = best(seconds, [every and not other for every, other in zip(full, busy, strict=True)])
        clock = [f"({value})" if other else value for value, other in zip(quiet, busy, strict=True)]
        several = "outputs" in DATA[data]
        for (peer, sharing), rows, *numbers in zip(
            fits, fits.values(), clock, *(best(column, full) for column in others), strict=True
        ):
            size = f"{int(rows[0]['n_train']):,}"
            how = f", {SHARING[sharing]}" if several else ""
            lines.append([DATA[data], size, rows[0]["m"], f"{peer}{how}", str(len(rows)), *numbers])
    header = ["data", "rows", "points", "", "data sets", "seconds", "of the processor", "RMSE", "NLPD"]
    return table(header, lines)


def splits() -> str:
    """Write RMSE, NLPD and seconds on tables of data, means over random splits with standard errors."""
    rows, lines = rows_of(RESULTS / "splits.csv"), []
    for data in dict.fromkeys(row["dataset"] for row in rows):
        fits: dict[str, list[dict[str, str]]] = {}
        for row in rows:
            if row["dataset"] == data:
                fits.setdefault(row["peer"], []).append(row)
        columns = []
        for name in ("rmse", "nlpd", "seconds"):
            values = {peer: [float(row[name]) for row in fit] for peer, fit in fits.items()}
            means = best([fmean(each) for each in values.values()])
            errors = [stdev(each) / sqrt(len(each)) for each in values.values()]
            columns.append(
                means if name == "seconds" else [f"{m} ± {short(e)}" for m, e in zip(means, errors, strict=True)]
            )
        for (peer, fit), *numbers in zip(fits.items(), *columns, strict=True):
            size = f"{int(fit[0]['n_train']):,}"
            lines.append([data, size, peer.removeprefix("scikit-learn "), str(len(fit)), *numbers])
    return table(["data", "rows", "", "splits", "RMSE", "NLPD", "seconds"], lines)


def exact() -> str:
    """Write seconds, memory, error and NLPD of scikit-learn's exact model and ours, at the most rows it was given."""
    rows, lines = rows_of(RESULTS / "against_gpr.csv"), []
    for system in dict.fromkeys(row["system"] for row in rows):
        here = [row for row in rows if row["system"] == system and row["model"] in EXACT]
        most = max(int(row["n_rows"]) for row in here if row["model"] == "GPR")
        fits = [row for row in here if int(row["n_rows"]) == most]
        fits.sort(key=lambda row: list(EXACT).index(row["model"]))
        columns = [[float(row[name]) for row in fits] for name in ("fit_seconds", "memory_mb", "error", "nlpd")]
        for row, *numbers in zip(fits, *map(best, columns), strict=True):
            lines.append([system, f"{most:,}", EXACT[row["model"]], *numbers])
    return table(["data", "rows", "", "seconds", "MB", "error", "NLPD"], lines)


def packages() -> str:
    """Write what pip installs with each library, and how much code it is."""
    lines = [
        [
            row["package"],
            row["version"],
            row["distributions"],
            short(float(row["megabytes"])),
            f"{int(row['lines_of_code']):,}",
        ]
        for row in rows_of(ROOT / "benchmarks" / "peers" / "packages.csv")
    ]
    return table(["", "version", "packages that pip installs", "MB in all", "lines of code of its own"], lines)


def parts() -> dict[str, str]:
    """Write all tables, by name."""
    return {"peers": peers(), "splits": splits(), "exact": exact(), "packages": packages()}
