"""EVGPRegressor against scikit-learn's GaussianProcessRegressor as the number of rows grows.

Time, memory, error and NLPD of fits to the first N rows, in random order, of a data set: of the paper's pendulum and
cartpole (the change of state is learned; no noise) and of a smooth function of 8 columns with noise. Each fit has a
process of its own and one thread. Writes a row per fit to a CSV (what is there is not run again), and from it a
Markdown page and a picture.

    python benchmarks/peers/against_gpr.py          # half an hour to an hour of one core
    python benchmarks/peers/against_gpr.py --quick  # 50 and 150 rows: under a minute
    python benchmarks/peers/against_gpr.py --systems smooth --time-limit 1500  # an exact fit to more rows

Models without features: "GPR" is scikit-learn's, with ConstantKernel * RBF (a lengthscale per column) + WhiteKernel,
``normalize_y=True`` and its own optimizer; all columns of y share kernel and noise. "EGP" and "EVGP" (100 inducing
points) are skevgp's with their defaults; each column of y has its signal variance and noise. Beside each EVGP the CSV
has its exact counterpart: GPR with the EVGP's kernel and noise, without an optimizer. With gravity's features there are
"EGP-IFG" and "EVGP-IFG" (the paper's 10 or 60 inducing points).

An exact fit's time grows with N³: where that would take a model beyond --time-limit, judged by the N before, it is left
out.
"""

from __future__ import annotations

import itertools
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
from sklearn.base import RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from threadpoolctl import threadpool_limits

import harness
from paper.models import Fit, build
from peers import against_gpr_report
from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import InertiaForceGravity
from skevgp.metrics import negative_log_predictive_density, prediction_error

SYSTEMS = ("pendulum", "cartpole", "smooth")
# The data sets of systems end before the larger sizes.
SIZES, QUICK_SIZES = (125, 250, 500, 1000, 2000, 4000, 10_000, 30_000, 100_000), (50, 150)
N_ROWS = 4800
# Up to here an EVGP is compared with its exact counterpart.
COUNTERPART_ROWS = 2000
N_INDUCING = 100


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    system, model : str
    n_rows, seed : int
    """

    system: str
    model: str
    n_rows: int
    seed: int


def gpr(cell: Cell, X: np.ndarray) -> GaussianProcessRegressor:
    """Started from the spread of the columns; bounds for data without noise, of which skevgp's is the floor."""
    signal = ConstantKernel(1.0, (1e-6, 1e9)) * RBF(X.std(axis=0), (1e-3, 1e6))
    return GaussianProcessRegressor(signal + WhiteKernel(1e-2, (1e-10, 10.0)), normalize_y=True)


def egp(cell: Cell, X: np.ndarray) -> EGPRegressor:
    return EGPRegressor(random_state=cell.seed)


def evgp(cell: Cell, X: np.ndarray) -> EVGPRegressor:
    return EVGPRegressor(n_inducing=N_INDUCING, random_state=cell.seed)


def egp_with_gravity(cell: Cell, X: np.ndarray) -> EGPRegressor:
    return EGPRegressor(InertiaForceGravity(cell.system), random_state=cell.seed)


def evgp_with_gravity(cell: Cell, X: np.ndarray) -> RegressorMixin:
    """That of the paper's results, its Table 4."""
    return build(Fit(cell.system, "EVGP-IFG", "skevgp", cell.seed, "full", None))


@dataclass(frozen=True)
class Model:
    """A line of the picture.

    Attributes
    ----------
    build : callable
        (cell, X) -> an unfitted regressor.
    growth : int
        The power of N with which the time of a fit grows at most.
    systems : tuple of str
    with_features : bool
        Then it predicts the next state, of which the features' prior speaks; otherwise the change of state.
    """

    build: Callable[[Cell, np.ndarray], RegressorMixin]
    growth: int
    systems: tuple[str, ...] = SYSTEMS
    with_features: bool = False


MODELS = {
    "GPR": Model(gpr, 3),
    "EGP": Model(egp, 3, ("smooth",)),
    "EVGP": Model(evgp, 1),
    "EGP-IFG": Model(egp_with_gravity, 3, ("pendulum", "cartpole"), with_features=True),
    "EVGP-IFG": Model(evgp_with_gravity, 1, ("pendulum", "cartpole"), with_features=True),
}


class Rows(NamedTuple):
    """Inputs, what is observed, and that without noise."""

    X: np.ndarray
    y: np.ndarray
    truth: np.ndarray


def data(cell: Cell) -> tuple[Rows, Rows]:
    """Training and test rows; those of a smaller N are among those of a larger one."""
    if cell.system == "smooth":
        pieces = harness.noisy_waves(N_ROWS, 8, np.random.RandomState(cell.seed))
        test = Rows(*next(pieces))
        train = zip(*itertools.islice(pieces, -(-cell.n_rows // N_ROWS)), strict=True)
        return Rows(*(np.concatenate(own)[: cell.n_rows] for own in train)), test
    rows = []
    for random_state in (cell.seed, 1000 + cell.seed):
        X, y = make_dynamics(cell.system, random_state=random_state, return_X_y=True)
        change = y if MODELS[cell.model].with_features else y - X[:, : y.shape[1]]
        rows.append(Rows(X, change, change))
    order = np.random.RandomState(cell.seed).permutation(len(rows[0].X))[: cell.n_rows]
    return Rows(*(a[order] for a in rows[0])), rows[1]


def density(test: Rows, mean: np.ndarray, std: np.ndarray) -> float:
    """NLPD; not a number where GPR has rounded a negative variance up to 0."""
    return negative_log_predictive_density(test.y, mean, std) if (std > 0.0).all() else np.nan


def log_likelihood(regressor: Any, y: np.ndarray) -> float:
    """In nats of the units of y, summed over outputs; of an EVGP its lower bound."""
    if isinstance(regressor, EVGPRegressor):
        return regressor.lower_bound_
    value = float(regressor.log_marginal_likelihood_value_)
    if isinstance(regressor, GaussianProcessRegressor) and regressor.normalize_y:
        value -= len(y) * float(np.log(y.std(axis=0)).sum())
    return value


def counterpart(evgp: EVGPRegressor, train: Rows, test: Rows) -> dict[str, float]:
    """What the exact GP says with the EVGP's kernel and noise, which are per output."""
    kernels = evgp.kernel_ if isinstance(evgp.kernel_, list) else [evgp.kernel_]
    parts, value = [], 0.0
    for kernel, noise, y in zip(kernels, np.ravel(evgp.noise_variance_), np.atleast_2d(train.y.T), strict=True):
        exact = GaussianProcessRegressor(kernel, alpha=noise, optimizer=None).fit(train.X, y)
        value += exact.log_marginal_likelihood_value_
        mean, std = exact.predict(test.X, return_std=True)
        parts.append((mean, np.sqrt(std**2 + noise)))
    mean, std = (np.column_stack(columns).reshape(test.y.shape) for columns in zip(*parts, strict=True))
    return {
        "counterpart_error": prediction_error(test.truth, mean),
        "counterpart_nlpd": density(test, mean, std),
        "counterpart_log_likelihood": value,
    }


def run(cell: Cell) -> dict[str, Any]:
    """Fit, predict, and measure both."""
    model = MODELS[cell.model]
    train, test = data(cell)
    regressor = model.build(cell, train.X)
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # What is imported and allocated once is not the fit's.
        model.build(cell, train.X).fit(train.X[:10], train.y[:10]).predict(test.X[:10], return_std=True)
        with warnings.catch_warnings(record=True) as caught, harness.peak_memory() as memory:
            warnings.simplefilter("always")
            start = time.process_time()
            regressor.fit(train.X, train.y)
            fit_seconds = time.process_time() - start
        start = time.process_time()
        mean, std = regressor.predict(test.X, return_std=True)
        predict_seconds = time.process_time() - start
        exact = dict.fromkeys(("counterpart_error", "counterpart_nlpd", "counterpart_log_likelihood"), np.nan)
        if cell.model == "EVGP" and cell.n_rows <= COUNTERPART_ROWS:
            # With hardly any noise the matrix can be singular.
            with suppress(np.linalg.LinAlgError):
                exact = counterpart(regressor, train, test)
    convergence = [str(warning.message) for warning in caught if issubclass(warning.category, ConvergenceWarning)]
    return {
        **{name: getattr(cell, name) for name in ("system", "model", "n_rows", "seed")},
        "m": regressor.inducing_points_.shape[-2] if isinstance(regressor, EVGPRegressor) else "",
        "fit_seconds": fit_seconds,
        "predict_seconds": 1000.0 * predict_seconds / len(test.X),
        "memory_mb": memory(),
        "error": prediction_error(test.truth, mean),
        "nlpd": density(test, mean, std),
        "zero_std": np.mean(std <= 0.0),
        "log_likelihood": log_likelihood(regressor, train.y),
        **exact,
        "converged": not convergence,
        "warning": convergence[0].splitlines()[0][:120] if convergence else "",
        **harness.provenance(),
    }


def say(row: dict[str, Any]) -> str:
    return f"{row['fit_seconds']:.2f} s, {row['memory_mb']:.0f} MB, error {row['error']:.3g}, NLPD {row['nlpd']:.2f}"


def has(cell: Cell) -> bool:
    """Whether there is such a cell."""
    return cell.system in MODELS[cell.model].systems and (cell.system == "smooth" or cell.n_rows <= N_ROWS)


def expected_seconds(rows: list[harness.Row], cell: Cell) -> float:
    """What a fit takes at most, judged by the largest that is smaller."""
    smaller = [
        (int(row["n_rows"]), float(row["fit_seconds"]))
        for row in rows
        if (row["system"], row["model"], row["seed"]) == (cell.system, cell.model, str(cell.seed))
        and int(row["n_rows"]) < cell.n_rows
    ]
    n, seconds = max(smaller, default=(1, 0.0))
    return seconds * (cell.n_rows / n) ** MODELS[cell.model].growth


def main() -> None:
    parser = harness.argument_parser(
        __doc__, quick="50 and 150 rows", seeds="seeds 0, 1, ...; default: 1", systems=SYSTEMS
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    parser.add_argument("--sizes", nargs="+", type=int, help="rows; default: 125 to 4000, smooth to 100,000")
    parser.add_argument(
        "--time-limit", type=float, default=300.0, help="seconds a fit may be expected to take; default: %(default)g"
    )
    options = parser.parse_args()
    output = harness.output_path(options, "against_gpr")
    n_failures = 0
    # One after the other, since how long a size takes tells what the next would.
    for n_rows in sorted(options.sizes or (QUICK_SIZES if options.quick else SIZES)):
        rows = harness.read(output)
        cells = [
            cell
            for seed in range(1 if options.seeds is None else options.seeds)
            for system in options.systems
            for model in options.models
            if has(cell := Cell(system, model, n_rows, seed)) and expected_seconds(rows, cell) <= options.time_limit
        ]
        n_failures += harness.run_missing(cells, run, output, options.jobs, say, fresh=True, since=options.since)

    rows = harness.read(output)
    if rows:
        against_gpr_report.plot(rows, output.with_suffix(".png"))
    harness.write_report(against_gpr_report.paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
