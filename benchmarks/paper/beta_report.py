"""What the rows of beta.py say: heat maps of the weights, and whether positions imitate gravity."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from harness import WIDTH, Row, column, figure_of, provenance_text, pyplot, save_picture, table

SETTINGS = {
    "paper": "paper's setting",
    "author": "author's starts",
    "author-100": "author's starts, prior scale 100",
    "skevgp": "skevgp's setting",
}
# Blue, white and vermilion of Okabe & Ito's palette, on to dark ones, so that large weights differ too.
DIVERGING = ("#002a42", "#0066a3", "#6fb1d9", "#cfe4f2", "#ffffff", "#f9dcc4", "#f0a469", "#c65600", "#4f2300")
# Weights smaller than this are coloured in proportion, larger ones by their logarithm: 1 and Δt are not all one sees.
LINEAR = 0.05
# Entries are written into cells up to so many columns.
WRITTEN = 12


def groups(rows: list[Row]) -> Iterator[tuple[str, str, list[Row]]]:
    """Of one system: setting, model, rows."""
    for setting in settings_of(rows):
        for model in sorted({row["model"] for row in rows if row["setting"] == setting}):
            yield setting, model, [row for row in rows if (row["setting"], row["model"]) == (setting, model)]


def settings_of(rows: list[Row]) -> list[str]:
    """In the order of `SETTINGS`."""
    return [setting for setting in SETTINGS if any(row["setting"] == setting for row in rows)]


def names(rows: list[Row], what: str) -> list[str]:
    """Outputs or features, in their order."""
    return list(dict.fromkeys(row[what] for row in rows))


def matrix(rows: list[Row], value: str) -> np.ndarray:
    """Of a column (seeds, o, p)."""
    seeds = sorted({row["seed"] for row in rows}, key=int)
    shape = len(names(rows, "output")), len(names(rows, "feature"))
    return np.array([column((row for row in rows if row["seed"] == seed), value).reshape(shape) for seed in seeds])


def positions(rows: list[Row]) -> list[tuple[str, str]]:
    """(velocity, position) of each joint."""
    outputs = names(rows, "output")
    half = len(outputs) // 2
    return list(zip(outputs[half:], outputs[:half], strict=True))


def pretty(name: str) -> str:
    """As the paper writes it: dq1/dt -> q̇₁, u_q2 -> u₂, sin(q1 + q2) -> sin₁₂."""
    for pattern, replacement in (
        (r"sin\(q(\d) \+ q(\d)\)", r"\\sin_{\1\2}"),
        (r"sin\(q(\d)\)", r"\\sin_\1"),
        (r"sin\((\w+)\)", r"\\sin \1"),
        (r"d(q\d*|theta|x)/dt", r"\\dot \1"),
        (r"^u_[a-z]+$", "u"),
        (r"^u_q(\d)$", r"u_\1"),
        (r"q(\d)", r"q_\1"),
        (r"theta", r"\\theta"),
        (r"gravity", "g"),
    ):
        name = re.sub(pattern, replacement, name)
    return f"${name}$"


def paragraphs(rows: list[Row], output: Path) -> list[str]:
    """A page: for each system the picture, the weights in question, and what they show.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one size.
    output : Path
        The CSV.

    Returns
    -------
    parts : list of str
    """
    parts = [
        "# The learned weights of the physics features",
        "Written by `benchmarks/paper/beta.py`. With inertia and force only (IF) the paper's Figure 7 has negative "
        "weights of (q̇₁, q₁) and (q̇₂, q₂) of the acrobot, where the prior has 0, to imitate gravity; with features of "
        f"gravity (IFG) it has not. {provenance_text(rows)}",
    ]
    if rows[0]["size"] == "quick":
        parts.append("**A quick run**: few rows and iterations, not to be compared with the paper.")
    for system in names(rows, "system"):
        own = [row for row in rows if row["system"] == system]
        seeds = sorted({row["seed"] for row in own}, key=int)
        parts += [
            f"## {system}",
            pictures_text(own, picture_of(output, system)),
            f"Shown: {'means over seeds' if len(seeds) > 1 else 'seed'} {', '.join(seeds)}. The weights of positions "
            "on the next velocities:",
            in_question(own),
            "Mean ± standard error over seeds (of one seed: none); std: the posterior's own. *Least squares* is what "
            "the features alone would say of the same rows; *GP*: what least squares reads off the mean of the "
            "Gaussian process. In the picture the entries of positions have a frame.",
            verdict(own) if system == "acrobot" else "",
            explanation(own),
            f"Iterations: {iterations(own)}.",
        ]
    return [part for part in parts if part]


def mean_and_error(values: np.ndarray) -> str:
    """Over seeds."""
    error = f" ± {figure_of(values.std(ddof=1) / np.sqrt(len(values)))}" if len(values) > 1 else ""
    return f"{values.mean():+.3f}{error}"


def in_question(rows: list[Row]) -> str:
    """The table of the weights that would imitate gravity, and of those of gravity itself."""
    lines = []
    for setting, model, own in groups(rows):
        outputs, features = names(own, "output"), names(own, "feature")
        of_gravity = features[len(names(own, "output")) :]
        tables = {name: matrix(own, name) for name in ("mean", "std", "least_squares", "least_squares_of_gp")}
        for velocity, position in positions(own):
            for feature in (position, *(name for name in of_gravity if name.startswith("sin("))):
                at = (slice(None), outputs.index(velocity), features.index(feature))
                mean, std = tables["mean"][at], tables["std"][at]
                lines.append(
                    [
                        *(SETTINGS[setting], model, f"({velocity}, {feature})", mean_and_error(mean)),
                        figure_of(std.mean()),
                        *(mean_and_error(tables[name][at]) for name in ("least_squares", "least_squares_of_gp")),
                    ]
                )
    header = ["setting", "model", "entry", "b", "std", "least squares", "GP"]
    return table(header, lines)


def verdict(rows: list[Row]) -> str:
    """Whether the paper's observation holds, for each setting and joint."""
    sentences = []
    found = {(setting, model): own for setting, model, own in groups(rows)}
    for setting in settings_of(rows):
        plain, gravity = (found.get((setting, model)) for model in ("EVGP-IF", "EVGP-IFG"))
        if plain is None or gravity is None:
            continue
        for velocity, position in positions(rows):
            b, std = ([entry(own, velocity, position, value) for own in (plain, gravity)] for value in ("mean", "std"))
            gp = [entry(own, velocity, position, "least_squares_of_gp") for own in (plain, gravity)]
            negative = bool((b[0] < -2.0 * std[0]).all())
            gone = b[1].mean() > -0.1 * abs(b[0].mean())
            said = (
                f"with IF {'significantly negative in every seed' if negative else 'not negative throughout'} "
                f"({b[0].mean():+.3f}), with IFG {'not ' if gone else ''}negative beyond a tenth of the size of that "
                f"({b[1].mean():+.3f})"
            )
            shown = "as in the paper" if negative and gone else "**not** as in the paper"
            if not (negative and gone):
                said += f"; the Gaussian process takes {gp[0].mean():+.3f} with IF and {gp[1].mean():+.3f} with IFG"
            sentences.append(f"- {SETTINGS[setting]}, ({velocity}, {position}): {shown}: {said}.")
    return "\n".join(sentences)


def explanation(rows: list[Row]) -> str:
    """Why b alone does not show where gravity went."""
    apart = np.concatenate(
        [
            matrix(own, "mean").ravel()
            + matrix(own, "least_squares_of_gp").ravel()
            - matrix(own, "least_squares").ravel()
            for _, _, own in groups(rows)
        ]
    )
    said = (
        "The data determine what b and the Gaussian process say together: in all fits the sum of *b* and *GP* is the "
        f"least squares weight, to {np.abs(apart).max():.0e}. How it is divided differs between settings and seeds."
    )
    stds = {(setting, model): matrix(own, "std").mean(axis=0) for setting, model, own in groups(rows)}
    models = sorted({model for _, model in stds if {("paper", model), ("skevgp", model)} <= stds.keys()})
    if models:
        ratio = np.median(np.concatenate([(stds["skevgp", own] / stds["paper", own]).ravel() for own in models]))
        said += (
            " The paper's diagonal posterior has the standard deviation of a weight with all others and the Gaussian "
            f"process given; the full posterior's, which knows that they can stand in for each other, is {ratio:.0f} "
            "times as large (median over weights; kernels and noise of the fits differ too)."
        )
    scattered = {setting: scatter([row for row in rows if row["setting"] == setting]) for setting in settings_of(rows)}
    if np.isfinite(list(scattered.values())).all():
        times = ", ".join(f"{ratio:.3g} in {SETTINGS[setting]}" for setting, ratio in scattered.items())
        said += (
            " Between seeds, that is between data sets, the standard deviation of a weight is so many times that of "
            f"its posterior, which is given one kernel (median over weights): {times}."
        )
    return said


def scatter(rows: list[Row]) -> float:
    """The standard deviation between seeds over the posterior's own, the median over weights; NaN of one seed."""
    found = [(matrix(own, "mean"), matrix(own, "std")) for *_, own in groups(rows)]
    ratios = [(mean.std(axis=0, ddof=1) / std.mean(axis=0)).ravel() for mean, std in found if len(mean) > 1]
    return float(np.median(np.concatenate(ratios))) if ratios else np.nan


def entry(rows: list[Row], output: str, feature: str, value: str) -> np.ndarray:
    """One weight's column, over seeds."""
    return column((row for row in rows if (row["output"], row["feature"]) == (output, feature)), value)


def iterations(rows: list[Row]) -> str:
    """Of each setting, and the limit if there was one."""
    said = []
    for setting in settings_of(rows):
        own = [row for row in rows if row["setting"] == setting]
        most = " to ".join(dict.fromkeys(str(f(column(own, "n_iter").astype(int))) for f in (np.min, np.max)))
        limits = sorted({row["max_iter"] for row in own} - {""}, key=int)
        limit = f" (limited to {', '.join(limits)})" if limits else ""
        said.append(f"{most}{limit} in {SETTINGS[setting]}")
    return "; ".join(said)


def picture_of(output: Path, system: str) -> Path:
    """Of one system."""
    return output.with_name(f"{output.stem}_{system}.png")


def panels_of(rows: list[Row]) -> list[tuple[str, str, str]]:
    """Lines of the picture: title, setting and column of the CSV. The first two are the same in all settings."""
    settings = settings_of(rows)
    first = settings[0]
    return [
        ("Prior mean", first, "prior_mean"),
        ("Least squares, features alone", first, "least_squares"),
        *((f"b, {SETTINGS[setting]}", setting, "mean") for setting in settings),
        *((f"std, {SETTINGS[setting]}", setting, "std") for setting in settings),
    ]


def pictures_of(rows: list[Row], path: Path) -> dict[Path, list[Row]]:
    """The rows of each picture: that of the author's settings is one of its own, with "_author" behind the name."""
    own: dict[Path, list[Row]] = {}
    for row in rows:
        is_authors = row["setting"].startswith("author")
        own.setdefault(path.with_stem(f"{path.stem}_author") if is_authors else path, []).append(row)
    return own


def pictures_text(rows: list[Row], path: Path) -> str:
    """The first, and a link to the other, in Markdown."""
    first, *others = sorted(pictures_of(rows, path))
    links = "".join(f"\n\nThe same in the author's settings: [`{other.name}`]({other.name})." for other in others)
    return f"![b of the {rows[0]['system']}]({first.name}){links}"


def plot(rows: list[Row], path: Path) -> None:
    """A column of panels per model, one below the other prior, least squares and posterior: means over seeds.

    Parameters
    ----------
    rows : list of dict
        Of the CSV, of one system.
    path : Path
        Of the PNG; the author's settings have "_author" behind its name.
    """
    for own_path, own in pictures_of(rows, path).items():
        plot_settings(own, own_path)


def plot_settings(rows: list[Row], path: Path) -> None:
    """One of its pictures."""
    from matplotlib.colors import LinearSegmentedColormap, LogNorm, SymLogNorm

    models, lines = sorted({row["model"] for row in rows}), panels_of(rows)
    found = {(setting, model): own for setting, model, own in groups(rows)}
    height = max(0.33, 0.16 + 0.5 / len(names(rows, "output"))) if is_written(rows) else 0.12
    stds = np.concatenate([matrix(own, "std").ravel() for own in found.values()])
    stds = stds[stds > 0.0]
    diverging = LinearSegmentedColormap.from_list("blue to vermilion", DIVERGING)
    colours: dict[bool, tuple[Any, Any]] = {
        False: (diverging, SymLogNorm(LINEAR, vmin=-1.0, vmax=1.0)),
        True: ("Greys", LogNorm(stds.min(), 10.0 * stds.max())),  # no black, on which nothing can be read
    }
    figure, grid = pyplot().subplots(
        *(len(lines), len(models)),
        figsize=(WIDTH, 0.4 + len(lines) * (0.45 + height * len(names(rows, "output")))),
        squeeze=False,
    )
    for axes_of_line, (title, setting, value) in zip(grid, lines, strict=True):
        for axes, model in zip(axes_of_line, models, strict=True):
            own = found.get((setting, model), [])
            axes.set_visible(bool(own))
            if own:
                heat_map(axes, own, value, *colours[value == "std"])
                axes.set_title(f"{model}: {title[0].lower()}{title[1:]}")
    for which, label in ((False, "weight (SI units)"), (True, "std (SI units)")):
        own = [
            axes for line, (*_, value) in zip(grid, lines, strict=True) for axes in line if (value == "std") == which
        ]
        picture = next(axes.images[0] for axes in own if axes.images)
        bar = figure.colorbar(picture, ax=own, label=label, aspect=40, pad=0.01, extend="neither" if which else "both")
        bar.outline.set_visible(False)
        if not which:
            ticks = [sign * size for sign in (-1, 1) for size in (1.0, 0.3, 0.1, 0.03, 0.01)]
            bar.set_ticks([*ticks, 0.0], labels=[f"{tick:g}" for tick in (*ticks, 0.0)])
            bar.ax.minorticks_off()
    n_seeds = len({row["seed"] for row in rows})
    said = f"means over {n_seeds} seeds" if n_seeds > 1 else "one seed"
    if is_written(rows):
        said += ", ± standard error" * (n_seeds > 1) + "; framed: what would imitate gravity"
    lines = f"{rows[0]['system']}: {said}", f"b, std: posterior; iterations: {iterations(rows)}"
    figure.suptitle("\n".join(textwrap.fill(line, 100) for line in lines))
    save_picture(figure, path)


def is_written(rows: list[Row]) -> bool:
    """Whether entries have room for their numbers."""
    return len(names(rows, "feature")) <= WRITTEN


def heat_map(axes: Any, rows: list[Row], value: str, colours: Any, norm: Any) -> None:
    """Of a column's means over seeds, with their standard error where there is room."""
    from matplotlib.patches import Rectangle

    values, outputs, features = matrix(rows, value), names(rows, "output"), names(rows, "feature")
    mean, is_wide = values.mean(axis=0), not is_written(rows)
    picture = axes.imshow(mean, cmap=colours, norm=norm, aspect="auto")
    axes.set_xticks(range(len(features)), map(pretty, features), fontsize=6 if is_wide else 8.5, rotation=90 * is_wide)
    axes.set_yticks(range(len(outputs)), map(pretty, outputs), fontsize=6 if is_wide else 8.5)
    axes.tick_params(length=0)
    axes.grid(False)
    axes.spines[:].set_visible(False)
    if is_wide:
        return
    for o, j in np.ndindex(*mean.shape):
        red, green, blue, _ = picture.cmap(norm(mean[o, j]))
        dark = 0.3 * red + 0.59 * green + 0.11 * blue < 0.5
        text = written(mean[o, j])
        if len(values) > 1 and value in ("mean", "least_squares"):
            text += f"\n±{written(values[:, o, j].std(ddof=1) / np.sqrt(len(values)))}"
        axes.text(j, o, text, ha="center", va="center", fontsize=8.5, linespacing=1.0, color="w" if dark else "k")
    for velocity, position in positions(rows) if value in ("mean", "least_squares") else ():
        corner = features.index(position) - 0.48, outputs.index(velocity) - 0.48
        axes.add_patch(Rectangle(corner, 0.96, 0.96, fill=False, edgecolor="k", linewidth=1.2))


def written(value: float) -> str:
    """In few letters."""
    if value == 0.0:
        return "0"
    return f"{value:.0e}".replace("e-0", "e-") if abs(value) < 5e-4 else f"{value:.3f}".replace("0.", ".", 1)
