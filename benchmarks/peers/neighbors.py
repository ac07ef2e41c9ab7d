"""EVGPRegressor with neighbours against the sparse model, boosting and local models of other libraries.

``n_neighbors=60`` adds a local part to 200 inducing points. Is it more accurate than the inducing points alone, and
what does it cost?

    python benchmarks/peers/neighbors.py --data ../data  # with the folder uci: kin40k, elevators and airfoil
    python benchmarks/peers/neighbors.py --sets waves-20000 --models sparse neighbors
    python benchmarks/peers/neighbors.py --data ../data --peer-python .peers/bin/python --limit 900
    python benchmarks/peers/neighbors.py --curves  # time and error over rows of waves, with a picture
    python benchmarks/peers/neighbors.py --quick  # small made sets: a minute

Models are fitted one after the other, each in a separate process on two cores. The CSV has one row per fit. A fit that
fails, or whose process takes longer than --limit, is a row with a note and no numbers. Delete the row to try again.

The tables are read from the folder uci of --data: NAME/data.csv.gz with the target last, and NAME/test_mask.csv.gz with
a column for each split. A seed is a split. "kin40k-8000" has 8,000 random training rows of the same split. Without
--data these sets are left out. "friedman1", "waves" and "million" are made. "waves" is a draw of a Matérn Gaussian
process with short length scales, which 200 inducing points cannot represent. "million" has one seed and two models.
Columns and targets are divided by the training rows' standard deviation.

- "sparse" and "neighbors" are EVGPRegressor with 0 and 60 neighbours. "exact-2000" is EGPRegressor on at most 2,000
  random training rows. "exact-5000" and "neighbors-80" are measured only if they are named.
- "GPR" is scikit-learn's GaussianProcessRegressor, fitted to at most 4,000 rows. It is measured with --curves.
- "boosting" is HistGradientBoostingRegressor with early stopping and at most 2,000 trees. Its std and its interval
  (split conformal) come from a first fit to four fifths of the rows. Both fits are timed.
- GPBoost, MuyGPyS and GPyTorch run with --peer-python, which is an interpreter that has them:
  ``pip install gpboost muygpys gpytorch``. Packages that are missing there are named and left out.

All Gaussian processes have a squared exponential kernel with a length scale for each column.

Columns: ``seconds`` (on the wall) and ``cpu_seconds`` of the fit, ``us_per_prediction`` with std in blocks of 1,000
rows, ``coverage`` of 95 % intervals, and ``peak_mb``, by which the highest memory of the process rose during the fit
and the predictions.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections import namedtuple
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
import pandas as pd
from scipy.stats import norm
from sklearn.datasets import make_friedman1

import harness
import skevgp
from peers.local_models import LEVEL, MODELS, load
from skevgp.metrics import crps, negative_log_predictive_density

Cell = namedtuple("Cell", "set model seed")
# The numbers of a row, which are empty if a fit fails.
COSTS = ("seconds", "cpu_seconds", "us_per_prediction")
SCORES = ("rmse", "nlpd", "crps", "coverage")


# --- data ----------------------------------------------------------------------------------------------------------


class Data(NamedTuple):
    """Training and test rows, in units of the training rows' standard deviation."""

    X: np.ndarray
    y: np.ndarray
    X_test: np.ndarray
    y_test: np.ndarray


def scaled(X: np.ndarray, y: np.ndarray, is_test: np.ndarray) -> Data:
    """Split and standardise."""
    sets = []
    for table in (X, y):
        train = table[~is_test]
        spread = train.std(axis=0)
        sets.append((table - train.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0))
    return Data(*(table[rows] for rows in (~is_test, is_test) for table in sets))


def tabular(name: str, n_train: int | None, seed: int, folder: Path) -> Data:
    """Read a split of a table, and keep some of its training rows."""
    paths = (folder / "uci" / name / f"{part}.csv.gz" for part in ("data", "test_mask"))
    table, masks = (pd.read_csv(path, header=None).to_numpy() for path in paths)
    is_test = masks[:, seed] == 1
    if n_train:
        train = np.random.RandomState(seed).permutation(np.flatnonzero(~is_test))[:n_train]
        rows = np.concatenate([np.sort(train), np.flatnonzero(is_test)])
        table, is_test = table[rows], is_test[rows]
    return scaled(table[:, :-1].astype(float), table[:, -1].astype(float), is_test)


def friedman(n_rows: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    return make_friedman1(n_rows, n_features=10, noise=1.0, random_state=rng)


def waves(n_rows: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """Draw a Matérn-5/2 Gaussian process of length scale 0.3 in [0, 1]⁴, by 2,000 random Fourier features."""
    n_waves, length_scale, shape = 2000, 0.3, 5.0  # the frequencies are of a t distribution with 2 ν = 5
    frequencies = rng.randn(n_waves, 4) * np.sqrt(shape / rng.chisquare(shape, (n_waves, 1))) / length_scale
    phases, weights = rng.uniform(0.0, 2.0 * np.pi, n_waves), rng.randn(n_waves) * np.sqrt(2.0 / n_waves)
    X = rng.uniform(0.0, 1.0, (n_rows, 4))
    parts = np.split(X, range(2000, n_rows, 2000))  # for memory
    y = np.concatenate([np.cos(part @ frequencies.T + phases) @ weights for part in parts])
    return X, y + 0.05 * rng.randn(n_rows)


def smooth(n_rows: int, rng: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    return next(harness.noisy_waves(n_rows, 6, rng))[:2]


def made(
    draw: Callable[[int, np.random.RandomState], Any], n_train: int, n_test: int, seed: int, folder: Path | None
) -> Data:
    X, y = draw(n_train + n_test, np.random.RandomState(seed))
    return scaled(X, y, np.arange(len(X)) >= n_train)


class DataSet(NamedTuple):
    """How a set is loaded from a seed and a folder, its number of seeds, and its models."""

    load: Callable[[int, Any], Data]
    n_seeds: int = 2
    models: tuple[str, ...] = tuple(name for name in MODELS if name not in ("exact-5000", "neighbors-80", "GPR"))


TABLES = {
    "kin40k-8000": DataSet(partial(tabular, "kin40k", 8000), 1),
    "airfoil": DataSet(partial(tabular, "airfoil", None), 5),
    "elevators": DataSet(partial(tabular, "elevators", None)),
    "kin40k": DataSet(partial(tabular, "kin40k", None), 1),
}
SETS = {
    **TABLES,
    "friedman1-10000": DataSet(partial(made, friedman, 10_000, 5000)),
    "waves-20000": DataSet(partial(made, waves, 20_000, 5000)),
    "million": DataSet(partial(made, smooth, 1_000_000, 100_000), 1, ("neighbors", "boosting")),
}
QUICK = {
    "friedman1-200": DataSet(partial(made, friedman, 200, 50), 1),
    "waves-300": DataSet(partial(made, waves, 300, 50), 1),
}
# Models and sizes of the picture. The exact model is fitted to at most so many rows.
NAMES = {
    "GPR": "GaussianProcessRegressor",
    "boosting": "HistGradientBoostingRegressor",
    "sparse": "EVGPRegressor",
    "neighbors": "EVGPRegressor, 60 neighbours",
}
MOST_EXACT = 4000
CURVES = {
    f"waves-{n}": DataSet(partial(made, waves, n, 5000), 1, tuple(NAMES)[n > MOST_EXACT :])
    for n in (500, 1000, 2000, 4000, 20_000, 100_000)
}
QUICK_CURVES = {f"waves-{n}": DataSet(partial(made, waves, n, 50), 1, tuple(NAMES)) for n in (100, 200)}


# --- running -------------------------------------------------------------------------------------------------------


def interpreters(models: Iterable[str], peer_python: str) -> dict[str, str]:
    """Return the interpreter of each model whose package is installed."""
    found = {}
    for name in models:
        package = MODELS[name].package
        own = package in ("skevgp", "sklearn")
        python = sys.executable if own else peer_python
        check = f"import importlib.util as u, sys; sys.exit(u.find_spec({package!r}) is None)"
        if own or subprocess.run([python, "-c", check], check=False).returncode == 0:
            found[name] = python
        else:
            print(f"{name}: {package} is not installed in {python}, left out")
    return found


def work(python: str, model: str, data: Data, seed: int, limit: float) -> Any:
    """Fit a model in a process of its own, with the same skevgp as here."""
    environment = {**os.environ, "OMP_WAIT_POLICY": "passive"}  # threads that spin are slow on a busy machine
    if MODELS[model].package == "skevgp":
        paths = [str(Path(skevgp.__file__).parents[1]), os.environ.get("PYTHONPATH")]
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    with tempfile.TemporaryDirectory() as folder:
        job, result = Path(folder, "job.npz"), Path(folder, "result.npz")
        np.savez(job, X=data.X, y=data.y, X_test=data.X_test, seed=seed)
        command = [python, str(Path(__file__).with_name("local_models.py")), model, str(job), str(result)]
        options = {"env": environment, "capture_output": True, "text": True, "check": False, "timeout": limit}
        done = subprocess.run(command, **options)
        if done.returncode < 0:
            raise RuntimeError(f"ended by signal {-done.returncode}")
        if done.returncode:
            said = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise RuntimeError(re.sub(r"\S*/\S*", "...", said)[:120])  # without paths
        return load(str(result))


def scores(y: np.ndarray, found: Any) -> dict[str, float]:
    """Return the scores of predictions."""
    mean, std = found.mean, found.std
    if not (np.isfinite(mean).all() and np.isfinite(std).all() and (std > 0.0).all()):
        raise RuntimeError("predictions that are not finite, or a std of 0")
    half_width = norm.ppf(0.5 + LEVEL / 2.0) * std if np.isnan(found.half_width) else found.half_width
    return {
        "rmse": float(np.sqrt(np.mean((y - mean) ** 2))),
        "nlpd": negative_log_predictive_density(y, mean, std),
        "crps": crps(y, mean, std),
        "coverage": float(np.mean(np.abs(y - mean) <= half_width)),
    }


def run(cell: Cell, known: dict[str, DataSet], pythons: dict[str, str], folder: Path | None, limit: float) -> Any:
    """Fit one model to one set; return its row."""
    data = known[cell.set].load(cell.seed, folder)
    row: dict[str, Any] = {"n_train": len(data.X), "n_test": len(data.X_test)}
    row |= {**dict.fromkeys((*COSTS, *SCORES, "peak_mb"), np.nan), "note": "", "package": ""}
    try:
        found = work(pythons[cell.model], cell.model, data, cell.seed, limit)
        row |= {**scores(data.y_test, found), "n_train": found.n_train, "package": found.package}
    except subprocess.TimeoutExpired:
        return row | {"note": f"longer than {limit:.0f} s"}
    except RuntimeError as error:
        return row | {"note": f"failed: {error}"}
    row |= {name: round(getattr(found, name), 3) for name in (*COSTS, "peak_mb")}
    return row


def tables_of(rows: pd.DataFrame) -> harness.Tables:
    """Return a table for each set, with means over the seeds."""
    tables = {}
    rows = rows.assign(note=rows["note"].map(lambda note: note if isinstance(note, str) else ""))
    for name in harness.ordered([*SETS, *QUICK], rows["set"]):
        own = rows[rows["set"] == name].groupby("model")
        models = harness.ordered(MODELS, own.groups)
        means, notes = (
            own.mean(numeric_only=True).loc[models],
            own["note"].agg(lambda each: " ".join(sorted(set(each)))),
        )
        columns = {
            "rows": harness.text(means["n_train"], 0),
            "seeds": own["seed"].nunique().loc[models],
            "RMSE": harness.best(means["rmse"]),
            "NLPD": harness.text(means["nlpd"], 3),
            "CRPS": harness.best(means["crps"]),
            "coverage": harness.text(means["coverage"], 3),
            "s": means["seconds"],
            "CPU s": means["cpu_seconds"],
            "µs per prediction": means["us_per_prediction"],
            "MB": harness.text(means["peak_mb"], 0),
            "note": notes.loc[models].str.strip(),
        }
        tables[name] = pd.DataFrame(columns).reset_index()
    return tables


def tables_of_curves(rows: pd.DataFrame) -> harness.Tables:
    """Return a table with a row for each number of rows and model."""
    means = rows.groupby(["n_train", "model"]).mean(numeric_only=True)
    pairs = [(n, model) for n, own in rows.groupby("n_train") for model in harness.ordered([*NAMES], own["model"])]
    columns = {"rmse": "RMSE", "nlpd": "NLPD", "coverage": "coverage", "cpu_seconds": "CPU s"}
    named = means.loc[pairs, list(columns)].rename(columns=columns).reset_index()
    return {"curves": named.rename(columns={"n_train": "rows"})}


def draw_curves(rows: pd.DataFrame, path: Path) -> None:
    """Draw the time of a fit and the error of new rows over the number of training rows."""
    figure, axes = harness.pyplot().subplots(1, 2, figsize=(harness.WIDTH, 3.2), layout="constrained")
    panels = {"cpu_seconds": "processor time of the fit (s)", "rmse": "error of new rows (std of y)"}
    for ax, (column, label) in zip(axes, panels.items(), strict=True):
        for (name, shown), color in zip(NAMES.items(), harness.PALETTE, strict=False):
            own = rows[rows["model"] == name].groupby("n_train")[column].mean()
            ax.plot(own.index, own, "o-", color=color, label=shown)
        ax.set(xlabel="training rows", ylabel=label)
        harness.logarithmic(ax, "x")
        harness.logarithmic(ax)
    harness.legend(figure, ncols=2)
    harness.save_picture(figure, path)


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="small made sets, a minute", in_processes=False)
    parser.add_argument("--curves", action="store_true", help="time and error over the number of rows of waves")
    parser.add_argument(
        "--sets", nargs="+", choices=[*SETS, *QUICK, *CURVES], metavar="SET", help=f"of {', '.join(SETS)}"
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, metavar="MODEL", help=f"of {', '.join(MODELS)}")
    said = "number of seeds of each set; default: 1 for kin40k and million, 5 for airfoil, otherwise 2"
    parser.add_argument("--seeds", dest="n_seeds", type=int, help=said)
    parser.add_argument("--data", type=Path, help="folder with the folder uci; default: its sets are left out")
    parser.add_argument("--peer-python", default=sys.executable, help="interpreter with GPBoost, MuyGPyS and GPyTorch")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds per fit; default: %(default)s")
    options = harness.parse(parser)
    known = QUICK if options.quick else SETS
    if options.curves:
        known = QUICK_CURVES if options.quick else CURVES
    if options.data is None:
        known = {name: found for name, found in known.items() if name not in TABLES}
    output = harness.output_path(options, "neighbors_curves" if options.curves else "neighbors")
    models = dict.fromkeys(name for found in known.values() for name in found.models)
    pythons = interpreters(options.models or models, options.peer_python)
    cells = [
        Cell(name, model, seed)
        for name in options.sets or known
        if name in known
        for seed in range(options.n_seeds or known[name].n_seeds)
        for model in pythons
        if model in known[name].models or (options.models and name != "million")
    ]
    fit = partial(run, known=known, pythons=pythons, folder=options.data, limit=options.limit)
    n_failures = harness.run_missing(cells, fit, output)
    rows = harness.frame(output)
    if options.curves:
        draw_curves(rows, output.with_suffix(".png"))
        harness.write_page("Time and error over rows", tables_of_curves(rows), output, n_failures)
    else:
        harness.write_page("Nearest rows beside inducing points", tables_of(rows), output, n_failures)


if __name__ == "__main__":
    main()
