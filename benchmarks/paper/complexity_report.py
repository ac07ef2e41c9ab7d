"""What the rows of complexity.py say: which power laws hold, beside the paper's Table 3."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from harness import WIDTH, Row, figure_of, logarithmic, provenance_text, pyplot, save_picture, table

BATCH, NETWORK_BATCH = 512, 200
# Few rows: what an evaluation takes whatever their number.
MANY, FEW = 4800, 16

_SIZES = (10, 25, 50, 100, 200, 400, 800)
SIZES = {
    "n_rows": (300, 1000, 3000, 10_000, 30_000),
    "n_inducing": _SIZES,
    "n_outputs": (1, 2, 4, 8, 16),
    "n_layers": (1, 2, 4, 8, 16),
    "n_units": _SIZES,
}
GP = {"n_rows": MANY, "n_inducing": 100, "n_outputs": 4, "n_layers": 0, "n_units": 0}
NETWORK = {"n_rows": 2000, "n_inducing": 0, "n_outputs": 4, "n_layers": 2, "n_units": 100}
WORDS = {
    "n_rows": "rows N",
    "n_inducing": "inducing points m",
    "n_outputs": "outputs o",
    "n_layers": "hidden layers L",
    "n_units": "units n",
    "bound": "bound and gradient",
    "adam step": f"Adam's step, {BATCH} rows",
    "network step": f"network's step, {NETWORK_BATCH} rows",
    "model": "model",
    "network": "network",
    "": "",
    "all": "shared points",
    "kernel": "points per output",
    "none": "nothing shared",
    "paper": "paper's setting",
    "skevgp": "skevgp's setting",
    "seconds": "",
    "n_bytes": "pickled",
    "n_parameters": "parameters",
}
# Of what and setting: Okabe & Ito's palette, safe for colour-blind readers, and markers.
STYLES = {
    ("bound", "all"): ("#0072B2", "o"),
    ("bound", "kernel"): ("#D55E00", "s"),
    ("bound", "none"): ("#009E73", "^"),
    ("adam step", ""): ("#E69F00", "D"),
    ("network step", ""): ("#CC79A7", "v"),
    ("model", "skevgp"): ("#0072B2", "o"),
    ("model", "paper"): ("#E69F00", "D"),
    ("network", ""): ("#CC79A7", "v"),
}
# Of each panel: title, horizontal and vertical axis, slopes of the thin lines.
PANELS = (
    ("Time of wider models", "inducing points m, or the network's units n", "milliseconds", (1, 2, 3)),
    ("Time with more rows", "rows N", "milliseconds", (1,)),
    ("Time with more outputs or layers", "outputs o, or the network's hidden layers L", "milliseconds", (1,)),
    ("Space of wider models", "inducing points m, or the network's units n", "megabytes", (1, 2)),
)
NOTES = f"""Behind each name its exponent, fitted to the sizes that are not pale; bound: with its gradient
What is not varied: N = {MANY:,}, m = 100, o = 4, n = 100, L = 2; a parameter: 8 bytes"""


def by_cell(rows: list[Row]) -> dict[tuple[str, ...], Row]:
    """Each by what, setting and sizes."""
    return {tuple(row[name] for name in ("what", "setting", *GP)): row for row in rows}


@dataclass(frozen=True)
class Curve:
    """Measurements that differ in one size.

    Attributes
    ----------
    panel : int or None
        Of the picture; None is for the table only.
    what, setting : str
        Of a cell.
    varied : str
        Which size is not fixed.
    above : int
        A power law is fitted to sizes from here on.
    paper : int
        The paper's exponent.
    value : {"seconds", "n_bytes", "n_parameters"}
    few : bool
        Whether there are few rows.
    sizes : tuple of int, default=()
        Empty: the usual ones.
    """

    panel: int | None
    what: str
    setting: str
    varied: str
    above: int
    paper: int
    value: str = "seconds"
    few: bool = False
    sizes: tuple[int, ...] = ()

    def cells(self) -> list[dict[str, str | int]]:
        """One for each size."""
        fixed = {"what": self.what, "setting": self.setting, **(NETWORK if "network" in self.what else GP)}
        if self.few:
            fixed["n_rows"] = FEW
        return [{**fixed, self.varied: size} for size in self.sizes or SIZES[self.varied]]

    def is_in(self, rows: list[Row]) -> bool:
        """Whether all of it was measured."""
        return {tuple(map(str, cell.values())) for cell in self.cells()} <= by_cell(rows).keys()

    def points(self, rows: list[Row]) -> tuple[np.ndarray, np.ndarray]:
        """Sizes and what was measured."""
        found = by_cell(rows)
        values = [float(found[tuple(map(str, cell.values()))][self.value]) for cell in self.cells()]
        return np.array([cell[self.varied] for cell in self.cells()], float), np.array(values)

    def exponent(self, rows: list[Row]) -> tuple[float, float, float]:
        """Of the power law closest in logarithms; the smallest and the largest between neighbours."""
        sizes, values = self.points(rows)
        x, y = np.log(sizes[sizes >= self.above]), np.log(values[sizes >= self.above])
        steps = np.diff(y) / np.diff(x)
        return float(np.polyfit(x, y, 1)[0]), float(steps.min()), float(steps.max())

    @property
    def name(self) -> str:
        """In words."""
        what = WORDS[self.what].replace(f", {BATCH} rows", "") if self.few else WORDS[self.what]
        parts = (what, WORDS[self.setting], WORDS[self.value], f"{FEW} rows" if self.few else "")
        return ", ".join(part for part in parts if part)

    @property
    def label(self) -> str:
        """Its name in the picture."""
        return self.name.replace(" and gradient", "").removeprefix("model, ")


CURVES = (
    Curve(0, "bound", "all", "n_inducing", 100, 3),
    Curve(None, "bound", "all", "n_inducing", 200, 3, few=True),
    Curve(0, "bound", "kernel", "n_inducing", 100, 3),
    Curve(0, "bound", "kernel", "n_inducing", 200, 3, few=True),
    Curve(1, "bound", "all", "n_rows", 3000, 1),
    Curve(1, "bound", "kernel", "n_rows", 3000, 1),
    Curve(1, "adam step", "", "n_rows", 3000, 0),
    Curve(2, "bound", "all", "n_outputs", 4, 1),
    Curve(2, "bound", "kernel", "n_outputs", 4, 1),
    Curve(2, "bound", "none", "n_outputs", 4, 1),
    Curve(2, "adam step", "", "n_outputs", 4, 1),
    Curve(0, "adam step", "", "n_inducing", 100, 3),
    Curve(None, "adam step", "", "n_inducing", 200, 3, few=True),
    Curve(0, "network step", "", "n_units", 200, 2),
    Curve(2, "network step", "", "n_layers", 4, 1),
    Curve(3, "model", "skevgp", "n_inducing", 200, 1, "n_bytes"),
    Curve(None, "model", "skevgp", "n_inducing", 200, 1, "n_parameters"),
    Curve(3, "model", "paper", "n_inducing", 200, 1, "n_bytes"),
    Curve(3, "model", "paper", "n_inducing", 200, 1, "n_parameters"),
    Curve(None, "model", "skevgp", "n_rows", 1000, 0, "n_bytes"),
    Curve(None, "model", "paper", "n_rows", 1000, 0, "n_bytes"),
    Curve(None, "model", "skevgp", "n_outputs", 4, 1, "n_bytes"),
    Curve(None, "model", "paper", "n_outputs", 4, 1, "n_bytes"),
    Curve(None, "model", "paper", "n_outputs", 4, 1, "n_parameters"),
    Curve(3, "network", "", "n_units", 50, 2, "n_bytes", sizes=_SIZES[:-2]),
    Curve(None, "network", "", "n_units", 50, 2, "n_parameters", sizes=_SIZES[:-2]),
)
QUICK = tuple(replace(curve, above=0, sizes=SIZES[curve.varied][:3]) for curve in CURVES)


def two_digits(value: float) -> str:
    """After the point; a zero has no sign, which would be one of rounding."""
    return f"{round(value, 2) + 0.0:.2f}"


def exponent_text(values: tuple[float, float, float]) -> str:
    """The fitted one and, between neighbouring sizes, the least and the largest."""
    fitted, least, largest = map(two_digits, values)
    return f"{fitted} ({least} to {largest})"


def paragraphs(curves: tuple[Curve, ...], rows: list[Row], quick: bool = False) -> list[str]:
    """A page: the exponents beside the paper's, and where they come from.

    Parameters
    ----------
    curves : tuple of Curve
        Of `CURVES` or `QUICK`; with only some of them there is nothing but the table.
    rows : list of dict
        Of the CSV, with all cells of the curves.
    quick : bool, default=False
        Whether they are of `QUICK`.

    Returns
    -------
    parts : list of str
    """
    lines = []
    for curve in curves:
        sizes, values = curve.points(rows)
        unit, scale = ("s", 1.0) if curve.value == "seconds" else ("MB", 1e-6)
        if curve.value == "n_parameters":
            unit, scale = "", 1.0
        lines.append(
            [
                *(curve.name, WORDS[curve.varied], str(curve.paper), exponent_text(curve.exponent(rows))),
                f"{max(sizes[0], curve.above):g} to {sizes[-1]:g}",
                " to ".join(f"{figure_of(scale * value)}" for value in values[[0, -1]]) + f" {unit}".rstrip(),
            ]
        )
    parts = [
        "# Complexity: the paper's Table 3, and measured",
        "Written by `benchmarks/paper/complexity.py`. The paper says O(o m³) of time and O(o m) of space for (E)VGP "
        "and O(L n²) of both for the network, time linear in the rows |D| and space constant. Times are processor time "
        f"of one thread, the fastest of several repeats. {provenance_text(rows)}",
    ]
    if quick:
        parts.append("**A quick run**: sizes too small for exponents to mean anything.")
    header = ["what", "against", "paper's exponent", "ours (between neighbours)", "fitted to", "smallest to largest"]
    parts.append(table(header, lines))
    if len(curves) < len(CURVES):
        return [*parts, "Not everything was measured; `benchmarks/paper/complexity.py` goes on."]
    return [*parts, "## Where they differ, and why", *explanations(curves, rows)]


def explanations(curves: tuple[Curve, ...], rows: list[Row]) -> list[str]:
    """In words, with figures from the rows."""

    def values(what: str, setting: str, varied: str, value: str = "seconds", few: bool = False) -> np.ndarray:
        key = (what, setting, varied, value, few)
        (found,) = (own for own in curves if (own.what, own.setting, own.varied, own.value, own.few) == key)
        return found.points(rows)[1]

    m = np.array(curves[0].points(rows)[0])
    many, few = (values("bound", "kernel", "n_inducing", few=own) for own in (False, True))
    shared, shared_few = (values("bound", "all", "n_inducing", few=own) for own in (False, True))
    adam, adam_few = (values("adam step", "", "n_inducing", few=own) for own in (False, True))
    hundred, last = int(np.argmin(np.abs(m - 100))), f"{m[-1]:g}"
    # Rows, as multiples of m, that take as long as all that does not depend on them.
    equal, shared_equal = ((a * (MANY - FEW) / (b - a) - FEW) / m for a, b in ((few, many), (shared_few, shared)))
    large = slice(-3, None)
    by_output, by_kernel = (values("bound", own, "n_outputs") for own in ("all", "kernel"))
    outputs, n = SIZES["n_outputs"], curves[4].points(rows)[0]
    per_row = values("bound", "all", "n_rows") / n
    steps = values("network step", "", "n_units")
    units = np.array(SIZES["n_units"][: len(steps)], float)
    own_bytes, paper_bytes = (values("model", own, "n_inducing", "n_bytes") for own in ("skevgp", "paper"))
    over_rows = [values("model", own, "n_rows", "n_bytes") for own in ("skevgp", "paper")]
    spread = max(np.ptp(own) / own.mean() for own in over_rows)
    return [
        f"- **m³ is the smaller part while rows are many.** An evaluation takes O(N m²) for the rows and O(m³) for the "
        f"matrices. What is left with {FEW} rows is, with points per output, {few[hundred] / many[hundred]:.0%} "
        f"of the time with {MANY} rows at m = {m[hundred]:g}, and {few[-1] / many[-1]:.0%} at m = {last} (shared "
        f"points: {shared_few[-1] / shared[-1]:.0%}). The two parts take as long as each other with "
        f"{equal[large].min():.1f} m to {equal[large].max():.1f} m rows at m from {m[large][0]:g} (shared points: "
        f"{shared_equal[large].min():.1f} m to {shared_equal[large].max():.1f} m). There are usually more rows than "
        f"that, and time grows like m², not m³. With {FEW} rows, too, it grows more slowly than m³ (from m = "
        f"{m[-2]:g} to {last} with the power {np.log(few[-1] / few[-2]) / np.log(m[-1] / m[-2]):.2f}): large products "
        "run at a higher rate than small ones.",
        f"- **A step of Adam** sees {BATCH} rows only: what {FEW} rows take is {adam_few[hundred] / adam[hundred]:.0%} "
        f"of its time at m = {m[hundred]:g} and {adam_few[-1] / adam[-1]:.0%} at m = {last}. From m = {m[-2]:g} to "
        f"{last} its time grows with the power {np.log(adam[-1] / adam[-2]) / np.log(m[-1] / m[-2]):.2f} of m.",
        f"- **Shared inducing points** make the O(N m²) part the same for any number of outputs: "
        f"{outputs[len(by_output) - 1]} outputs take {by_output[-1] / by_output[0]:.1f} times as long as one, against "
        f"{by_kernel[-1] / by_kernel[0]:.1f} times with points per output (the paper's). What grows with outputs is "
        "the m³ of each output's own posterior, and products with its residuals.",
        f"- **Rows**: {1e6 * per_row[-1]:.2f} µs per row at N = {n[-1]:g} and {1e6 * per_row[0]:.2f} µs at "
        f"N = {n[0]:g}, where what does not depend on them counts. A step of Adam does not depend on N; a pass over "
        f"the rows has N / {BATCH} of them.",
        f"- **Space**: a fitted model keeps the sums over rows and the posterior's covariance, O(o m²), so that "
        "`partial_fit` can go on and predictions need no factorisation; the paper's O(o m) counts parameters only "
        f"(its diagonal posterior has that many; the full one has m²/2 per output). At m = {last}: "
        f"{own_bytes[-1] / 1e6:.1f} MB in skevgp's setting, {paper_bytes[-1] / 1e6:.1f} MB in the paper's. Rows are "
        f"not kept: bytes differ by {spread:.1%} between {n[0]:g} and {n[-1]:g} rows.",
        "- **The network** grows like n² only where layers are wide, since a step has O(n) work per row too (draws, "
        f"activations): from n = {units[-2]:g} to {units[-1]:g} its time grows with the power "
        f"{np.log(steps[-1] / steps[-2]) / np.log(units[-1] / units[-2]):.2f} of n. A fitted one also keeps 100 "
        "draws of its weights for predictions.",
    ]


def plot(curves: tuple[Curve, ...], rows: list[Row], path: Path) -> None:
    """Four panels: measurements, exponents in the legends, grey lines of whole slopes.

    Parameters
    ----------
    curves, rows
        As in `paragraphs`.
    path : Path
        Of the PNG.
    """
    figure, grid = pyplot().subplots(2, 2, figsize=(WIDTH, 7.0))
    for panel, (axes, (title, xlabel, ylabel, slopes)) in enumerate(zip(grid.flat, PANELS, strict=True)):
        shown = [own for own in curves if own.panel == panel]
        axes.set_visible(bool(shown))
        if not shown:
            continue
        for curve in shown:
            sizes, values = curve.points(rows)
            values = values * {"seconds": 1e3, "n_bytes": 1e-6, "n_parameters": 8e-6}[curve.value]
            (colour, marker), dotted = STYLES[curve.what, curve.setting], curve.few or curve.value == "n_parameters"
            how = {"marker": marker, "linestyle": ":" if dotted else "-", "color": colour}
            how["markerfacecolor"] = "white" if dotted else colour
            axes.plot(sizes, values, alpha=0.35, **how)
            fitted = sizes >= curve.above
            label = f"{curve.label}: {two_digits(curve.exponent(rows)[0])}"
            axes.plot(sizes[fitted], values[fitted], label=label, **how)
        for which in "xy":
            logarithmic(axes, which)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** (0.1 + 0.075 * len(shown)))  # room for the legend
        axes.set(title=title, xlabel=xlabel, ylabel=ylabel)
        axes.legend(loc="upper left", handlelength=2.2, borderaxespad=0.2)
        slope_lines(axes, slopes)
    figure.suptitle(NOTES)
    save_picture(figure, path)


def slope_lines(axes: Any, slopes: tuple[int, ...]) -> None:
    """Grey, each with its number, in the corner below the curves."""
    (left, right), (low, high) = np.log10(axes.get_xlim()), np.log10(axes.get_ylim())
    ends = left + (right - left) * np.array([0.68, 0.85])
    for slope in slopes:
        line = low + 0.04 * (high - low) + slope * (ends - ends[0])
        axes.plot(10**ends, 10**line, color="0.4", linewidth=1.0, scalex=False, scaley=False)
        where = {"xytext": (3, 0), "textcoords": "offset points", "va": "center", "fontsize": 8}
        axes.annotate(f"slope {slope}", (10 ** ends[1], 10 ** line[1]), color="0.4", **where)
