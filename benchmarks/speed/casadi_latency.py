"""How long a prediction takes as a CasADi function and as compiled C, in microseconds a row.

The cartpole's four states from a few trajectories, one group of outputs, without features and with IFG; the kernel sees
sine and cosine of the angle. Times are processor times, the least of several rounds of calls: of CasADi through its
buffer interface, of C through ctypes (whose own call is part of them). Writes one row per cell to a CSV (what is there
already is not measured again) and a page beside it.

    python benchmarks/speed/casadi_latency.py          # a minute
    python benchmarks/speed/casadi_latency.py --quick  # few points, seconds
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import casadi as ca
import numpy as np
from sklearn.exceptions import ConvergenceWarning

import harness
from harness import Row
from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import AngleEncoder, InertiaForceGravity, NominalDynamics

SYSTEM = "cartpole"
FEATURES = {"none": None, "IFG": InertiaForceGravity(SYSTEM), "nominal": NominalDynamics(SYSTEM)}
SIZES, QUICK_SIZES = (50, 100, 200), (10,)
N_TRAJECTORIES, N_STEPS, NOISE = 60, 20, 0.01
ROUNDS = 15
# Header -> column, of the tables of the page.
TIMES = {
    "f": "f_us",
    "J": "j_us",
    "f and J": "f_and_j_us",
    "all": "all_us",
    "f of parameters": "parametric_us",
    "C: f": "c_f_us",
    "C: mean and J": "c_j_us",
    "C: all": "c_all_us",
    "`predict`": "predict_us",
}
ONCE = {
    "build, ms": "build_ms",
    "build J, ms": "build_j_ms",
    "parameters, µs": "parameters_us",
    "write C, ms": "write_ms",
    "compile C, s": "compile_s",
    "mean off": "mean_off",
    "std off": "std_off",
}


@dataclass(frozen=True)
class Cell:
    """A model."""

    features: str
    m: int


def least(call: Callable[[], Any], n_calls: int = 300) -> float:
    """Microseconds of processor time a call takes."""
    found = np.inf
    for _ in range(ROUNDS):
        start = time.process_time()
        for _ in range(n_calls):
            call()
        found = min(found, (time.process_time() - start) / n_calls)
    return 1e6 * found


def buffered(function: Any, *given: np.ndarray) -> Callable[[], None]:
    """A call of a CasADi function that copies nothing in or out."""
    buffer, call = function.buffer()
    results = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
    for i, values in enumerate(given):
        buffer.set_arg(i, memoryview(values))
    for i, values in enumerate(results):
        buffer.set_res(i, memoryview(values))
    kept = buffer, given, results  # which the call only points to

    def run() -> None:
        assert kept
        call()

    return run


def fitted(cell: Cell) -> tuple[Any, np.ndarray, np.ndarray]:
    """The model, rows that it has not seen, and the scale of y."""
    data = make_dynamics(SYSTEM, N_TRAJECTORIES, N_STEPS, random_state=0)
    scale = data.target.std(axis=0)
    y = data.target + NOISE * scale * np.random.RandomState(0).randn(*data.target.shape)
    model = EVGPRegressor(
        FEATURES[cell.features],
        kernel_map=AngleEncoder(SYSTEM),
        n_inducing=cell.m,
        sharing="all",
        max_iter=50,
        random_state=0,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model.fit(data.data, y)
    return model, make_dynamics(SYSTEM, 10, N_STEPS, random_state=1).data, scale


def of_casadi(model: Any, X: np.ndarray) -> dict[str, float]:
    """Times of the function and its derivatives."""
    row, x = X[0].copy(), ca.MX.sym("x", X.shape[1])
    start = time.perf_counter()
    function = model.to_casadi()
    built = time.perf_counter()
    mean, variance = function(x)
    of_mean, of_variance = (ca.jacobian(output, x) for output in (mean, variance))
    jacobian = ca.Function("J", [x], [of_mean])
    both = ca.Function("f_and_J", [x], [mean, variance, of_mean])
    end = time.perf_counter()
    everything = ca.Function("all", [x], [mean, variance, of_mean, of_variance])
    parametric, parameters = model.to_casadi(parametric=True), model.to_casadi_parameters()
    return {
        "build_ms": 1e3 * (built - start),
        "build_j_ms": 1e3 * (end - built),
        "f_us": least(buffered(function, row)),
        "j_us": least(buffered(jacobian, row)),
        "f_and_j_us": least(buffered(both, row)),
        "all_us": least(buffered(everything, row)),
        "parametric_us": least(buffered(parametric, row, parameters)),
        "parameters_us": least(lambda: model.to_casadi_parameters(parameters)),
    }


def of_c(model: Any, X: np.ndarray) -> dict[str, Any]:
    """Times of the compiled functions; empty without a compiler."""
    names = ("write_ms", "compile_s", "c_f_us", "c_j_us", "c_all_us")
    if (compiler := shutil.which("gcc") or shutil.which("cc")) is None:
        return dict.fromkeys(names, "")
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        source, _ = model.to_c(folder)
        written, library, before = time.perf_counter(), Path(folder) / "evgp.so", os.times()
        command = [compiler, "-std=c99", "-O2", "-shared", "-fPIC", "-o", str(library), str(source), "-lm"]
        subprocess.run(command, check=True)
        after = os.times()
        loaded = ctypes.CDLL(str(library))
    compiling = after.children_user + after.children_system - before.children_user - before.children_system
    n_outputs, row = len(model.noise_variance_), X[0].copy()
    mean, variance = np.zeros((2, n_outputs))
    of_mean, of_variance = np.zeros((2, n_outputs, len(row)))
    times = []
    for function, values in (
        (loaded.evgp_predict, (row, mean, variance)),
        (loaded.evgp_mean_jacobian, (row, mean, of_mean)),
        (loaded.evgp_jacobian, (row, mean, variance, of_mean, of_variance)),
    ):
        pointers = [each.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for each in values]
        times.append(least(lambda call=function, given=pointers: call(*given)))
    return dict(zip(names, [1e3 * (written - start), compiling, *times], strict=True))


def differences(model: Any, X: np.ndarray, scale: np.ndarray) -> dict[str, float]:
    """From `predict`, in units of the outputs' scales."""
    mean, std = model.predict(X, return_std=True)
    of_mean, of_variance = (found.full().T for found in model.to_casadi().map(len(X))(X.T))
    return {
        "mean_off": np.max(np.abs(of_mean - mean) / scale),
        "std_off": np.max(np.abs(np.sqrt(of_variance) - std) / scale),
    }


def run(cell: Cell) -> dict[str, Any]:
    """All of it."""
    model, X, scale = fitted(cell)
    return {
        "features": cell.features,
        "m": len(model.inducing_points_),
        **of_casadi(model, X),
        **of_c(model, X),
        "predict_us": least(lambda: model.predict(X[:1], return_std=True), 30),
        **differences(model, X, scale),
        **harness.provenance(),
        "casadi": ca.CasadiMeta.version(),
    }


def say(row: dict[str, Any]) -> str:
    return f"f {row['f_us']:.1f} µs, J {row['j_us']:.1f} µs"


def shown(value: str) -> str:
    """Of a cell of a table."""
    return "" if value == "" else harness.figure_of(float(value)) if float(value) >= 1e-3 else f"{float(value):.0e}"


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page."""
    tables = [
        harness.table(
            ["features", "m", *columns],
            [[row["features"], row["m"], *(shown(row[c]) for c in columns.values())] for row in rows],
        )
        for columns in (TIMES, ONCE)
    ]
    return [
        "# A prediction by CasADi and in C",
        f"The {SYSTEM}'s four states, one group of outputs, the angle encoded; noise of {100 * NOISE:g} % of each. f: "
        "mean and variance. J: the mean's Jacobian. all: mean, variance and the Jacobians of both. Processor time of a "
        "row, in µs: the least of several rounds, through CasADi's buffers and, of C (gcc -O2), ctypes.",
        tables[0],
        "What is done once, new parameters of a model that has learned, and the largest difference from `predict` on "
        "rows that were not seen, in standard deviations of y: where inducing points are hard to tell apart, what "
        "rounding leaves of either.",
        tables[1],
        f"CasADi {', '.join(sorted({row['casadi'] for row in rows}))}; {harness.provenance_text(rows)}",
    ]


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="few points, seconds", in_processes=False)
    options = parser.parse_args()
    output = harness.output_path(options, "casadi_latency")
    cells = [Cell(features, m) for m in (QUICK_SIZES if options.quick else SIZES) for features in FEATURES]
    n_failures = harness.run_missing(cells, run, output, 1, say, fresh=True)
    rows = harness.read(output)
    harness.write_report(paragraphs(rows) if rows else [], output, n_failures)


if __name__ == "__main__":
    main()
