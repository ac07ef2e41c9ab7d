"""What one set of weights for all outputs costs: an evaluation of bound and gradient, beside a set for each output.

Random rows of six outputs, each with three columns and forty features of its own (the shape of a robot's torques), one
thread. Writes one row per size to a CSV (what is there already is not measured again), and prints the ratio of the
processor times, each the least of several evaluations in turns.

    python benchmarks/speed/shared_weights.py          # half a minute
    python benchmarks/speed/shared_weights.py --quick  # few rows, seconds
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.preprocessing import FunctionTransformer

import harness
from harness import Row
from internals import watched
from skevgp import CoefPrior, EVGPRegressor

N_OUTPUTS, N_FEATURES, N_COLUMNS = 6, 40, 3
SIZES, QUICK_SIZES = ((6000, 40), (6000, 100), (20_000, 100)), ((500, 10),)
TURNS = 7


@dataclass(frozen=True)
class Cell:
    """Rows and inducing points of each output."""

    n_rows: int
    m: int


class Waves(TransformerMixin, BaseEstimator):
    """Features for each output, (n, o, p)."""

    def fit(self, X: Any, y: Any = None) -> Waves:
        return self

    def transform(self, X: NDArray) -> NDArray:
        frequencies = 1.0 + 0.1 * np.arange(N_FEATURES)
        return np.stack([np.sin(np.outer(X.sum(axis=1) + o, frequencies)) for o in range(N_OUTPUTS)], axis=1)


def own_columns(X: NDArray) -> NDArray:
    """Of each output, (n, o, d)."""
    return X.reshape(len(X), N_OUTPUTS, N_COLUMNS)


def evaluations(cell: Cell, share_coef: bool) -> Callable[[], None]:
    """The evaluation of all outputs, ready to be timed."""
    rng = np.random.RandomState(0)
    X = rng.randn(cell.n_rows, N_OUTPUTS * N_COLUMNS)
    Y = np.sin(X[:, :N_OUTPUTS]) + 0.1 * rng.randn(cell.n_rows, N_OUTPUTS)
    found: dict[int, Any] = {}
    model = EVGPRegressor(
        Waves(),
        kernel_map=FunctionTransformer(own_columns),
        n_inducing=cell.m,
        coef_prior=CoefPrior(shared=share_coef),
        sharing="none",
        noise_cv=None,
        max_iter=1,
        random_state=0,
    )
    with watched(lambda own, start, fit: found.update({own.rows.columns[0]: own})), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model.fit(X, Y)
    each = [(own.objective(own.table), own.table.start()) for own in found.values()]

    def evaluate() -> None:
        for objective, start in each:
            objective(start)

    return evaluate


def run(cell: Cell) -> dict[str, Any]:
    """The least processor time of each, in turns."""
    both = {share: evaluations(cell, share) for share in (True, False)}
    least = dict.fromkeys(both, np.inf)
    for _ in range(TURNS):
        for share, evaluate in both.items():
            start = time.process_time()
            evaluate()
            least[share] = min(least[share], time.process_time() - start)
    return {
        "n_rows": cell.n_rows,
        "m": cell.m,
        "shared_seconds": least[True],
        "own_seconds": least[False],
        "ratio": least[True] / least[False],
        **harness.provenance(),
    }


def say(row: dict[str, Any]) -> str:
    return f"{row['ratio']:.2f} of the time with weights for each output"


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page."""
    lines = [
        [
            row["n_rows"],
            row["m"],
            *(f"{1e3 * float(row[name]):.1f}" for name in ("own_seconds", "shared_seconds")),
            f"{float(row['ratio']):.2f}",
        ]
        for row in rows
    ]
    header = ["rows", "m", "weights of each output, ms", "shared weights, ms", "ratio"]
    return [
        "# One set of weights for all outputs",
        "An evaluation of bound and gradient, six outputs with columns and features of their own, one thread.",
        harness.table(header, lines),
        f"{harness.provenance_text(rows)}",
    ]


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="few rows, seconds", in_processes=False)
    options = parser.parse_args()
    output = harness.output_path(options, "shared_weights")
    cells = [Cell(*size) for size in (QUICK_SIZES if options.quick else SIZES)]
    n_failures = harness.run_missing(cells, run, output, 1, say, fresh=True)
    rows = harness.read(output)
    harness.write_report(paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
