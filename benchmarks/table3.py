"""The paper's Table 3: every system and model in the paper's setting and in skevgp's, beside the paper's numbers.

Writes one row per fit to a CSV as soon as it is done (what is there already is not fitted again), and from the CSV a
Markdown table and a picture beside it. Models of seed s learn from data of random state s and are tested on 1000 + s.

    python benchmarks/table3.py                             # everything, four seeds
    python benchmarks/table3.py --quick                     # fewer rows and iterations, one seed: a few minutes
    python benchmarks/table3.py --systems iiwa14 --settings paper --max-iter 1000  # half an hour at most per fit
    python benchmarks/table3.py --systems pendulum --settings skevgp --seeds 10
    python benchmarks/table3.py --noise 0.01                # on training and test targets, in another file

Settings: "paper" (Adam, diagonal posterior, inducing points per output), "skevgp" (its defaults), "skevgp-angles" (the
kernel sees sines and cosines of angles) and, for iiwa14's EVGP, "skevgp-nominal" (a model of the arm whose masses,
centres of mass and inertias are wrong by up to 20 % as further features).

In the paper's setting a fit takes 1 to 4 minutes of one core for the pendulum and the cartpole, 10 to 30 for the
acrobot, and 3 (EVGP) to 8 hours (VGP) for iiwa14; in the others seconds to minutes, and for iiwa14 up to an hour.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import platform
import signal
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import scipy
import sklearn
import table3_report
from sklearn.base import RegressorMixin, TransformerMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.pipeline import make_union
from sklearn.utils import Bunch
from threadpoolctl import threadpool_limits

import skevgp
from skevgp import EVGPRegressor, ResidualRegressor
from skevgp.datasets import make_dynamics, perturb_robot
from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, NominalDynamics
from skevgp.metrics import containing_ratios, negative_log_predictive_density, prediction_error, std_norm

SETTINGS = ("paper", "skevgp", "skevgp-angles", "skevgp-nominal")
# How wrong the nominal arm is, relative.
NOMINAL_ERROR = 0.2
# Of a quick run: trajectories, and iterations of L-BFGS and steps of Adam, so that the large systems take no longer.
QUICK_TRAJECTORIES = 12
QUICK_ITERATIONS = {"pendulum": (300, 2000), "cartpole": (200, 1000), "acrobot": (50, 100), "iiwa14": (10, 2)}
SYSTEMS = tuple(QUICK_ITERATIONS)
COLUMNS = [
    *("system", "model", "setting", "seed", "error_mean", "error_median", "error_p99", "std_norm", "cr1", "cr2", "cr3"),
    *("nlpd", "n_parameters", "fit_seconds", "noise", "size", "max_iter", "n_iter", "bound_per_row", "converged"),
    *("date", "versions", "machine"),
]
# What tells a row from all others.
KEY = ("system", "model", "setting", "seed", "noise", "size")


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    system, model, setting : str
    seed : int
    noise : float
        Of both data sets, as a share of each target's standard deviation.
    size : {"full", "quick"}
    max_iter : int or None
    """

    system: str
    model: str
    setting: str
    seed: int
    noise: float
    size: str
    max_iter: int | None = field(compare=False)

    @property
    def key(self) -> tuple[str, ...]:
        return tuple(str(getattr(self, name)) for name in KEY)


def evgp(physics: type[TransformerMixin] | None, cell: Cell, n_inducing: int) -> EVGPRegressor:
    """With inertia and force, with gravity too, or without features."""
    features = None if physics is None else physics(cell.system)
    if cell.setting == "skevgp-nominal":
        wrong = perturb_robot(cell.system, NOMINAL_ERROR, random_state=cell.seed)
        features = make_union(features, NominalDynamics(wrong))
    arguments: dict[str, Any] = {}
    if cell.setting == "paper":
        arguments = {"solver": "adam", "posterior": "diagonal", "sharing": "kernel"}
    if cell.setting == "skevgp-angles":
        arguments = {"kernel_map": AngleEncoder(cell.system)}
    iterations = cell.max_iter
    if iterations is None and cell.size == "quick":
        iterations = QUICK_ITERATIONS[cell.system][cell.setting == "paper"]
    return EVGPRegressor(features, n_inducing=n_inducing, max_iter=iterations, random_state=cell.seed, **arguments)


def residual_vgp(cell: Cell, n_inducing: int) -> ResidualRegressor:
    """It learns the change of state."""
    return ResidualRegressor(evgp(None, cell, n_inducing))


@dataclass(frozen=True)
class Model:
    """A model of the table.

    Attributes
    ----------
    build : callable
        (cell, its size) -> an unfitted regressor.
    sizes : tuple
        Of the pendulum, the cartpole, the acrobot and iiwa14: inducing points or hidden units, the paper's Table 2.
    settings : tuple of str
    """

    build: Callable[[Cell, Any], RegressorMixin]
    sizes: tuple[Any, ...]
    settings: tuple[str, ...] = ("paper", "skevgp", "skevgp-angles")


MODELS = {
    "VGP": Model(partial(evgp, None), (40, 100, 250, 500)),
    "RES-VGP": Model(residual_vgp, (40, 100, 250, 500)),
    "EVGP-IF": Model(partial(evgp, InertiaForce), (10, 60, 150, 350), settings=SETTINGS),
    "EVGP-IFG": Model(partial(evgp, InertiaForceGravity), (10, 60, 150, 350), settings=SETTINGS),
}


@lru_cache(maxsize=2)
def data(system: str, random_state: int, noise: float, size: str) -> Bunch:
    """Of one system; the models that learn from it come one after the other."""
    n_trajectories = QUICK_TRAJECTORIES if size == "quick" else None
    return make_dynamics(system, n_trajectories, noise=noise, random_state=random_state)


def run(cell: Cell) -> dict[str, Any]:
    """Fit one model on one training set, and look at it on one test set."""
    train, test = (data(cell.system, state, cell.noise, cell.size) for state in (cell.seed, 1000 + cell.seed))
    model = MODELS[cell.model]
    regressor = model.build(cell, model.sizes[SYSTEMS.index(cell.system)])
    with threadpool_limits(1), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ConvergenceWarning)
        start = time.perf_counter()
        regressor.fit(train.data, train.target)
        seconds = time.perf_counter() - start
        mean, std = regressor.predict(test.data, return_std=True)
    errors = np.linalg.norm(test.target - mean, axis=1)
    fitted = getattr(regressor, "regressor_", regressor)
    values = (
        *(cell.system, cell.model, cell.setting, cell.seed, prediction_error(test.target, mean)),
        *(np.median(errors), np.quantile(errors, 0.99), std_norm(std), *containing_ratios(test.target, mean, std)),
        *(negative_log_predictive_density(test.target, mean, std), fitted.n_parameters_, seconds),
        *(cell.noise, cell.size, "" if cell.max_iter is None else cell.max_iter, fitted.n_iter_),
        getattr(fitted, "lower_bound_", np.nan) / len(train.data),
        not any(issubclass(warning.category, ConvergenceWarning) for warning in caught),
        datetime.now(UTC).date().isoformat(),
        " ".join(f"{package.__name__} {package.__version__}" for package in (skevgp, np, scipy, sklearn)),
        platform.processor() or platform.machine(),
    )
    return dict(zip(COLUMNS, values, strict=True))


def read(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def append(row: dict[str, Any], path: Path) -> None:
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if file.tell() == 0:
            writer.writeheader()
        writer.writerow(row)


def run_all(cells: Sequence[Cell], jobs: int, output: Path) -> int:
    """Run cells in processes, write each row as it comes, and return how many failed."""
    start, failures = time.perf_counter(), 0
    # Fresh processes, since a copy of this one could hold locks of its threads. Ctrl-C ends them: a fit would take it
    # for the end of its iterations, and go on to the next.
    with ProcessPoolExecutor(jobs, get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_DFL)) as pool:
        pending = {pool.submit(run, cell): cell for cell in cells}
        try:
            for count, future in enumerate(as_completed(pending), start=1):
                cell = pending[future]
                said = f"[{count}/{len(cells)}] {cell.system} {cell.model} {cell.setting} seed {cell.seed}: "
                try:
                    row = future.result()
                except Exception as problem:  # hours of other cells are not lost with this one
                    failures += 1
                    said += f"failed: {type(problem).__name__}: {problem}"
                else:
                    append(row, output)
                    paper = table3_report.PAPER[cell.system][cell.model].error
                    said += f"Error {row['error_mean']:.6f} (paper {paper:g}), {row['fit_seconds']:.1f} s"
                print(f"{said}; {time.perf_counter() - start:.0f} s so far", flush=True)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            raise SystemExit(f"Interrupted. What is finished is in {output}; run again to go on.") from None
    return failures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="12 trajectories, few iterations and one seed")
    parser.add_argument("--seeds", type=int, help="seeds 0, 1, ...; default: 4, of a quick run 1")
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=SYSTEMS, help="default: all")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=SETTINGS, help="default: all")
    parser.add_argument(
        "--jobs", type=int, help="fits at a time, each in a process and on one core; default: all cores"
    )
    parser.add_argument("--noise", type=float, default=0.0, help="as a share of each target's std; default: 0")
    parser.add_argument(
        "--max-iter",
        type=int,
        help="the most iterations of each fit, which the tables then tell; what is in the CSV stays (default: the "
        "regressor's)",
    )
    parser.add_argument("--output", type=Path, help="default: results/table3.csv, with quick and the noise in its name")
    options = parser.parse_args()
    size, noise = "quick" if options.quick else "full", options.noise
    name = f"table3{'_quick' if options.quick else ''}{f'_noise{noise:g}' if noise else ''}.csv"
    output = options.output or Path(__file__).parent / "results" / name
    output.parent.mkdir(parents=True, exist_ok=True)
    n_seeds = (1 if options.quick else 4) if options.seeds is None else options.seeds

    cells = [
        Cell(system, model, setting, seed, noise, size, options.max_iter)
        for system, seed, model, setting in itertools.product(
            options.systems, range(n_seeds), options.models, options.settings
        )
        if setting in MODELS[model].settings and (setting != "skevgp-nominal" or system == "iiwa14")
    ]
    done = {tuple(row[name] for name in KEY) for row in read(output)}
    to_do = [cell for cell in cells if cell.key not in done]
    print(f"{len(cells) - len(to_do)} of {len(cells)} cells are in {output}", flush=True)
    failures = run_all(to_do, options.jobs or joblib.cpu_count(), output) if to_do else 0

    # Everything the file has of this size and noise, not only what was asked for now.
    rows = [row for row in read(output) if (row["size"], row["noise"]) == (size, str(noise))]
    if rows:
        text = table3_report.markdown(rows)
        output.with_suffix(".md").write_text(text)
        table3_report.plot(rows, output.with_suffix(".png"))
        print(f"\n{text}\n{output.with_suffix('.md')}, {output.with_suffix('.png')}")
    if failures:
        raise SystemExit(f"{failures} cells failed; run again to try only these.")


if __name__ == "__main__":
    main()
