"""Time of predictions, evaluations of the bound and fits, and growth of memory with rows.

    python benchmarks/speed.py latency     # a row and a horizon of 50 for control loops: a minute
    python benchmarks/speed.py latency --peer-python ../peers/bin/python   # GPflow and GPyTorch as well
    python benchmarks/speed.py casadi      # the cartpole as a CasADi function and as compiled C: a minute
    python benchmarks/speed.py evaluation  # the bound and its gradient, in units of four dense products: minutes
    python benchmarks/speed.py rows        # time and memory up to a million rows, files and Dask: 5 minutes
    python benchmarks/speed.py million     # a million rows to the end, by L-BFGS and Adam: minutes of two cores
    python benchmarks/speed.py million --fits reference    # a thousand iterations: much longer
    python benchmarks/speed.py exact       # EGPRegressor and scikit-learn's GPR, up to 2,000 rows: 20 minutes
    python benchmarks/speed.py checkout --other ../older   # fits by this checkout and by another one, in pairs

    python benchmarks/speed.py checkout --other ../older --data ../data   # also torques of a real arm
    python benchmarks/speed.py checkout --other ../older --fits-of million --seeds 1    # a million rows: 10 minutes

Each part takes seconds with --quick.

*latency* has 100 inducing points, 6 columns and 4 outputs that share the points, on one thread. Times are medians over
half a second. skevgp also has groups of one output, and the cartpole with its features.

*casadi* has one group of outputs, without features, with IFG and with nominal dynamics. Times are processor time, the
least of several rounds. CasADi is called through its buffers and C through ctypes.

*evaluation* has the dense products ``L_inv @ U``, ``V @ V.T``, ``G @ V`` and ``L_inv.T @ (G @ V)`` over all rows.
Evaluation and products alternate. Their medians are compared, on one core and on all.

*rows* has fits of 8 iterations to 8 columns with 100 inducing points. They read a memory-mapped file on one and two
threads, or run by Dask on two workers. Memory is the peak above that before the fit.

*million* has three kinds of fits. These are L-BFGS with its defaults, natural gradients on mini-batches for some
epochs, and L-BFGS with a thousand iterations, which is the reference. "gained" is the gain over noise alone, as a share
of that of the reference. The reference in the CSV did not begin on samples of the rows.

*exact* has sines of 8 and 17 columns, with noise of std 0.1 and 0.0001 of a signal of std 1. Both models have the same
kernel with the same bounds and starts.
"""

from __future__ import annotations

import ctypes
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections import namedtuple
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from threadpoolctl import threadpool_limits

import harness
from harness import figure_of
from one_fit import JOBS, OTHER_JOBS
from peers.adapters import microseconds
from peers.against_peers import work
from skevgp import EGPRegressor, EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.features import AngleEncoder, InertiaForceGravity, NominalDynamics
from skevgp.metrics import negative_log_predictive_density
from skevgp.solvers import LBFGS, Adam

# --- latency -------------------------------------------------------------------------------------------------------

ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
ONE_THREAD |= {f"TF_NUM_{name}_THREADS": "1" for name in ("INTEROP", "INTRAOP")}
OTHERS = {"scikit-learn": "scikit-learn GPR", "GPflow": "GPflow SGPR", "GPyTorch": "GPyTorch SGPR"}

Latency = namedtuple("Latency", "library round size")


def latency_cells(options: Any) -> list[Latency]:
    libraries = ["skevgp", "scikit-learn", *(["GPflow", "GPyTorch"] if options.peer_python else [])]
    rounds = range(1 if options.quick else 3)
    return [Latency(library, turn, options.size) for turn in rounds for library in libraries]


def calls_of_skevgp(given: dict[str, Any]) -> dict[str, Callable[[], object]]:
    """Return calls of one model, of one in four groups, and of the cartpole."""
    X, Y, Z, ahead = (given[name] for name in ("X", "Y", "inducing_points", "ahead"))
    kernel = RBF(np.full(X.shape[1], 1.5))
    one, four = (
        EVGPRegressor(kernel=kernel, inducing_init=Z, max_iter=0, sharing=sharing).fit(X, Y)
        for sharing in ("all", "none")
    )
    train = make_dynamics("cartpole", 10, random_state=0)
    options = {"n_inducing": len(Z), "sharing": "all", "max_iter": 0, "random_state": 0}
    system = EVGPRegressor(InertiaForceGravity("cartpole"), kernel_map=AngleEncoder("cartpole"), **options)
    system.fit(train.data, train.target)
    calls: dict[str, Callable[[], object]] = {
        "predict: row, mean and std": lambda: one.predict(ahead[:1], return_std=True)
    }
    for name, model, rows in (
        ("compiled", one, ahead),
        ("compiled, four groups", four, ahead),
        ("compiled, cartpole with features", system, train.data[: len(ahead)]),
    ):
        fast, row = model.compile(), rows[0]
        calls |= {
            f"{name}: row, mean": partial(fast.predict, row),
            f"{name}: row, mean and std": partial(fast.predict, row, return_std=True),
            f"{name}: row, mean and Jacobian": partial(fast.value_and_jacobian, row),
            f"{name}: row, mean, std and both Jacobians": partial(fast.value_and_jacobian, row, return_std=True),
            f"{name}: horizon, mean and std": partial(fast.predict, rows, return_std=True),
            f"{name}: horizon, mean and Jacobian": partial(fast.value_and_jacobian, rows),
        }
    calls["partial_fit of 10 rows"] = lambda: system.partial_fit(train.data[:10], train.target[:10])
    calls["new weights into the compiled predictor"] = lambda: fast.update(system)
    return calls


def run_latency(cell: Latency, options: Any) -> list[dict[str, Any]]:
    rng, quick = np.random.RandomState(0), cell.size == "quick"
    X = rng.uniform(-2.0, 2.0, (2000, 6))
    Y = np.sin(X @ rng.randn(6, 4)) + 0.05 * rng.randn(2000, 4)
    given = {"X": X, "Y": Y, "inducing_points": X[rng.permutation(2000)[: 10 if quick else 100]]}
    given |= {"ahead": rng.uniform(-2.0, 2.0, (50, 6)), "seconds": 0.0 if quick else 0.5}
    if cell.library == "skevgp":
        with harness.one_thread():
            found = {name: microseconds(call, given["seconds"]) for name, call in calls_of_skevgp(given).items()}
    else:
        python = sys.executable if cell.library == "scikit-learn" else options.peer_python
        said = work(python, OTHERS[cell.library], given, **ONE_THREAD)
        found = dict(zip(said.calls, said.microseconds, strict=True))
    return [{"call": name, "microseconds": value} for name, value in found.items()]


def latency_tables(rows: pd.DataFrame) -> harness.Tables:
    found = rows.groupby(["library", "call"], sort=False)["microseconds"].agg(["median", "min", "size"])
    found = found.round(0).astype(int).set_axis(["median", "least round", "rounds"], axis=1)
    return {"latency": found.reset_index()}


# --- casadi --------------------------------------------------------------------------------------------------------

Casadi = namedtuple("Casadi", "features m")


def casadi_cells(options: Any) -> list[Casadi]:
    sizes = (10,) if options.quick else (50, 100, 200)
    return [Casadi(features, m) for m in sizes for features in ("none", "IFG", "nominal")]


def least(call: Callable[[], Any], n_calls: int = 300) -> float:
    """Return microseconds of processor time of a call, the least of 15 rounds."""
    found = np.inf
    for _ in range(15):
        start = time.process_time()
        for _ in range(n_calls):
            call()
        found = min(found, (time.process_time() - start) / n_calls)
    return 1e6 * found


def buffered(function: Any, *given: np.ndarray) -> Callable[[], None]:
    """Return a call of a CasADi function that copies nothing."""
    buffer, call = function.buffer()
    results = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
    for i, values in enumerate(given):
        buffer.set_arg(i, memoryview(values))
    for i, values in enumerate(results):
        buffer.set_res(i, memoryview(values))

    def run(*kept: Any) -> None:
        call()

    return partial(run, buffer, given, results)  # the call only points to them


def times_of_c(model: Any, row: np.ndarray) -> dict[str, Any]:
    """Return times of the compiled functions; empty without a compiler."""
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
    mean, variance = np.zeros((2, len(model.noise_variance_)))
    of_mean, of_variance = np.zeros((2, len(mean), len(row)))
    times = []
    for function, values in (
        (loaded.evgp_predict, (row, mean, variance)),
        (loaded.evgp_mean_jacobian, (row, mean, of_mean)),
        (loaded.evgp_jacobian, (row, mean, variance, of_mean, of_variance)),
    ):
        pointers = [each.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for each in values]
        times.append(least(lambda call=function, given=pointers: call(*given)))
    return dict(zip(names, [1e3 * (written - start), compiling, *times], strict=True))


def run_casadi(cell: Casadi, options: Any) -> dict[str, Any]:
    """Return times, and the largest difference from `predict`."""
    import casadi as ca

    name, features = "cartpole", {"IFG": InertiaForceGravity, "nominal": NominalDynamics}
    data = make_dynamics(name, 60, 20, random_state=0)
    scale = data.target.std(axis=0)
    y = data.target + 0.01 * scale * np.random.RandomState(0).randn(*data.target.shape)
    settings = {"n_inducing": cell.m, "sharing": "all", "max_iter": 50, "random_state": 0}
    features_of = features[cell.features](name) if cell.features in features else None
    model = EVGPRegressor(features_of, kernel_map=AngleEncoder(name), **settings)
    harness.timed(lambda: model.fit(data.data, y))
    X = make_dynamics(name, 10, 20, random_state=1).data
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
    exact_mean, exact_std = model.predict(X, return_std=True)
    found_mean, found_variance = (found.full().T for found in function.map(len(X))(X.T))
    return {
        "build_ms": 1e3 * (built - start),
        "build_j_ms": 1e3 * (end - built),
        "f_us": least(buffered(function, row)),
        "j_us": least(buffered(jacobian, row)),
        "f_and_j_us": least(buffered(both, row)),
        "all_us": least(buffered(everything, row)),
        "parametric_us": least(buffered(parametric, row, parameters)),
        "parameters_us": least(lambda: model.to_casadi_parameters(parameters)),
        **times_of_c(model, row),
        "predict_us": least(lambda: model.predict(X[:1], return_std=True), 30),
        "mean_off": np.max(np.abs(found_mean - exact_mean) / scale),
        "std_off": np.max(np.abs(np.sqrt(found_variance) - exact_std) / scale),
        "casadi": ca.CasadiMeta.version(),
    }


def casadi_tables(rows: pd.DataFrame) -> harness.Tables:
    columns = {"f": "f_us", "J": "j_us", "f and J": "f_and_j_us", "all": "all_us", "f of parameters": "parametric_us"}
    columns |= {"C: f": "c_f_us", "C: mean and J": "c_j_us", "C: all": "c_all_us", "`predict`": "predict_us"}
    once = {"build, ms": "build_ms", "build J, ms": "build_j_ms", "parameters, µs": "parameters_us"}
    once |= {"write C, ms": "write_ms", "compile C, s": "compile_s", "mean off": "mean_off", "std off": "std_off"}
    rows = rows.assign(**{name: rows[name].map("{:.0e}".format) for name in ("mean_off", "std_off")})
    return {
        title: rows[["features", "m", *names.values()]].set_axis(["features", "m", *names], axis=1)
        for title, names in (("µs of a row", columns), ("once", once))
    }


# --- evaluation ----------------------------------------------------------------------------------------------------

SIZES = {  # sweep -> (name, rows, inducing points, columns, outputs)
    "data": [
        ("pendulum", 4800, 10, 3, 2),
        ("cartpole", 4800, 100, 5, 4),
        ("acrobot", 9300, 150, 5, 4),
        ("iiwa14", 23250, 350, 21, 14),
    ],
    "rows": [("", n, 100, 5, 4) for n in (1000, 3000, 10_000, 30_000, 100_000)],
    "points": [("", 9300, m, 5, 4) for m in (10, 25, 50, 100, 200, 400)],
}

Evaluation = namedtuple("Evaluation", "sweep name n m d outputs cores")


def evaluation_cells(options: Any) -> list[Evaluation]:
    sizes = {"data": [("pendulum", 500, 10, 3, 2)]} if options.quick else SIZES
    cores = sorted({1, os.cpu_count() or 1})
    return [Evaluation(sweep, *size, own) for sweep, own_sizes in sizes.items() for size in own_sizes for own in cores]


def run_evaluation(cell: Evaluation, options: Any) -> dict[str, Any]:
    """Return medians and fastest of evaluation and products, which alternate in four rounds."""
    rng = np.random.RandomState(0)
    X = rng.randn(cell.n, cell.d)
    Y = np.sin(X @ rng.randn(cell.d, cell.outputs)) + 0.01 * rng.randn(cell.n, cell.outputs)
    L_inv, U, G = np.tril(rng.randn(cell.m, cell.m)), rng.rand(cell.m, cell.n), rng.randn(cell.m, cell.m)
    evaluations: list[float] = []
    products: list[float] = []
    for _ in range(4):
        time.sleep(0.2)  # threads of BLAS wait for more work for a while after a product
        evaluations += harness.evaluation_seconds(X, Y, cell.m, wall=True, sharing="all", n_jobs=cell.cores)
        time.sleep(0.2)
        with threadpool_limits(cell.cores):
            for _ in range(6):
                start = time.perf_counter()
                V = L_inv @ U
                V @ V.T, L_inv.T @ (G @ V)
                products.append(time.perf_counter() - start)
    return {
        "evaluation_ms": 1e3 * np.median(evaluations),
        "floor_ms": 1e3 * np.median(products),
        "ratio": np.median(evaluations) / np.median(products),
        "evaluation_fastest_ms": 1e3 * min(evaluations),
        "floor_fastest_ms": 1e3 * min(products),
        "repeats": len(evaluations),
    }


def evaluation_tables(rows: pd.DataFrame) -> harness.Tables:
    columns = {"name": "data", "n": "rows", "m": "points", "outputs": "outputs", "cores": "cores"}
    columns |= {"evaluation_ms": "evaluation, ms", "floor_ms": "products, ms", "ratio": "ratio"}
    return {"evaluation": rows[list(columns)].rename(columns=columns).fillna({"data": ""})}


# --- rows ----------------------------------------------------------------------------------------------------------

CHUNK = 50_000


class Timed(LBFGS):
    """L-BFGS that keeps the seconds of each evaluation."""

    def minimise(self, objective: Any, *others: Any, **options: Any) -> Any:
        self.seconds_: list[float] = getattr(self, "seconds_", [])

        def timed(x: np.ndarray) -> Any:
            start = time.perf_counter()
            result = objective(x)
            self.seconds_.append(time.perf_counter() - start)
            return result

        return super().minimise(timed, *others, **options)


Rows = namedtuple("Rows", "n_rows engine max_iter", defaults=[8])


def rows_cells(options: Any) -> list[Rows]:
    sizes = (1_000, 10_000) if options.quick else (10_000, 30_000, 100_000, 300_000, 1_000_000)
    engines = ("1 thread", "2 threads") + (() if options.quick else ("Dask, 2 workers",))
    return [Rows(n, engine) for n in sizes for engine in engines]


def make_files(folder: Path, n_rows: int) -> tuple[Path, Path]:
    """Write a smooth function of 8 columns with noise of std 0.1, piece by piece."""
    paths = folder / f"X{n_rows}.npy", folder / f"y{n_rows}.npy"
    X = np.lib.format.open_memmap(paths[0], "w+", np.float64, (n_rows, 8))
    y = np.lib.format.open_memmap(paths[1], "w+", np.float64, (n_rows,))
    pieces = harness.noisy_waves(min(CHUNK, n_rows), 8, np.random.RandomState(0))
    for first, piece in zip(range(0, n_rows, CHUNK), pieces, strict=False):
        X[first : first + CHUNK], y[first : first + CHUNK] = (part[: n_rows - first] for part in piece[:2])
    X.flush(), y.flush()
    return paths


def lazy(path: Path, shape: tuple[int, ...]) -> Any:
    """Return a Dask array whose chunks read a file."""
    import dask
    import dask.array as da

    rows = max(min(CHUNK, shape[0] // 4), 1)

    @dask.delayed
    def piece(first: int) -> np.ndarray:
        return np.array(np.load(path, mmap_mode="r")[first : first + rows])

    firsts = range(0, shape[0], rows)
    sizes = [(min(rows, shape[0] - first), *shape[1:]) for first in firsts]
    pieces = zip(firsts, sizes, strict=True)
    return da.concatenate([da.from_delayed(piece(first), size, dtype=np.float64) for first, size in pieces])


def run_rows(cell: Rows, options: Any) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        paths = make_files(Path(folder), cell.n_rows)
        X, y = arrays = [np.load(path, mmap_mode="r") for path in paths]
        client = None
        if cell.engine.startswith("Dask"):
            import distributed

            cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0")
            client = distributed.Client(cluster)
            X, y = (lazy(path, array.shape) for path, array in zip(paths, arrays, strict=True))
        solver = Timed()
        settings = {"max_iter": cell.max_iter, "noise_cv": None, "random_state": 0}
        model = EVGPRegressor(n_inducing=100, solver=solver, n_jobs=2 if cell.engine.startswith("2") else 1, **settings)
        with warnings.catch_warnings(record=True) as caught, harness.peak_memory() as memory:
            warnings.simplefilter("always")
            start = time.perf_counter()
            model.fit(X, y)
            fit_seconds = time.perf_counter() - start
        if client is not None:
            client.close()
            cluster.close()
        test = np.sort(np.random.RandomState(1).randint(cell.n_rows, size=min(cell.n_rows, 5000)))
        return {
            "n_columns": 8,
            "n_inducing": 100,
            "evaluation_seconds": np.median(solver.seconds_),
            "n_evaluations": len(solver.seconds_),
            "fit_seconds": fit_seconds,
            "memory_mb": memory(),
            "data_mb": 8e-6 * cell.n_rows * 9,
            "r2": model.score(*(array[test] for array in arrays)),
            "noise_sd": np.sqrt(model.noise_variance_),
            "converged": not caught,
        }


def rows_tables(rows: pd.DataFrame) -> harness.Tables:
    seconds = rows.pivot(index="n_rows", columns="engine", values="evaluation_seconds")
    most = rows.groupby("n_rows")[["data_mb", "memory_mb"]].max()  # of all engines
    table = most.set_axis(["data, MB", "peak memory of the fit above the data, MB"], axis=1)
    return {"rows": table.join(seconds.add_prefix("seconds per evaluation: ")).rename_axis("rows").reset_index()}


# --- million -------------------------------------------------------------------------------------------------------

EPOCHS = {"adam 10": 10, "adam 40": 40, "adam 120": 120}
FITS = ("default", *EPOCHS, "reference")

Million = namedtuple("Million", "n_rows fit")


def million_cells(options: Any) -> list[Million]:
    fits = options.fits or (FITS if options.quick else FITS[:-1])
    return [Million(5_000 if options.quick else 1_000_000, fit) for fit in fits]


def run_million(cell: Million, options: Any) -> dict[str, Any]:
    """Fit in this process, with two threads and the noise where the bound is highest."""
    with tempfile.TemporaryDirectory() as folder:
        rows = [np.load(path, mmap_mode="r") for path in make_files(Path(folder), cell.n_rows + 10_000)]
        (X, X_test), (y, y_test) = (np.split(array, [cell.n_rows]) for array in rows)
        model = EVGPRegressor(n_inducing=100, noise_cv=None, n_jobs=2, random_state=0)
        if cell.fit in EPOCHS:
            adam = Adam(batch_size=2000, natural_gradient=True)
            model.set_params(solver=adam, max_iter=EPOCHS[cell.fit] * cell.n_rows // 2000)
        elif cell.fit == "reference":
            model.set_params(solver=LBFGS(tol=0.0), max_iter=min(1000, cell.n_rows // 500))
        with warnings.catch_warnings(record=True) as caught, harness.peak_memory() as memory:
            warnings.simplefilter("always")
            start, cpu_start = time.perf_counter(), time.process_time()
            model.fit(X, y)
            seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
        noise = float(np.mean(np.square(y)))
        mean, std = model.predict(X_test, return_std=True)
        return {
            "n_iter": model.n_iter_,
            "seconds": seconds,
            "cpu_seconds": cpu_seconds,
            "memory_mb": memory(),
            "bound_per_row": model.lower_bound_ / cell.n_rows,
            "noise_alone_per_row": -0.5 * (np.log(2.0 * np.pi * noise) + 1.0),
            "nlpd": negative_log_predictive_density(y_test, mean, std),
            "warned": bool(caught),
        }


def million_tables(rows: pd.DataFrame) -> harness.Tables:
    gained = rows["bound_per_row"] - rows["noise_alone_per_row"]
    share = 100.0 * gained / gained.where(rows["fit"] == "reference").max()
    columns = {"fit": rows["fit"], "iterations": rows["n_iter"]}
    for header, name in {"s": "seconds", "CPU s": "cpu_seconds", "MB above the data": "memory_mb"}.items():
        columns[header] = rows[name].map("{:.0f}".format)
    columns |= {"bound per row": rows["bound_per_row"].map("{:.4f}".format), "gained": share.map("{:.2f} %".format)}
    return {"million": pd.DataFrame({**columns, "NLPD": rows["nlpd"].map("{:.4f}".format)})}


# --- exact fits ----------------------------------------------------------------------------------------------------

Exact = namedtuple("Exact", "n_rows columns noise seed")


def exact_cells(options: Any) -> list[Exact]:
    sizes, columns = ((60,), (3,)) if options.quick else ((500, 1000, 2000), (8, 17))
    return [Exact(*cell) for cell in itertools.product(sizes, columns, (0.1, 1e-4), options.seeds)]


def run_exact(cell: Exact, options: Any) -> list[dict[str, Any]]:
    """Fit `EGPRegressor` and scikit-learn's GPR with the same kernel, one after the other, on all cores."""
    rng = np.random.RandomState(cell.seed)
    X, _, truth = next(harness.noisy_waves(cell.n_rows + 1000, cell.columns, rng))
    y = (truth - truth.mean()) / truth.std() + cell.noise * rng.standard_normal(len(X))
    n = cell.n_rows
    y -= y[:n].mean()
    kernel = ConstantKernel(1.0) * RBF(np.ones(cell.columns)) + WhiteKernel(0.1, (1e-12, 1e3))
    found = []
    for model in (EGPRegressor(kernel=kernel, normalize_y=False), GaussianProcessRegressor(kernel)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            start, cpu_start = time.perf_counter(), time.process_time()
            model.fit(X[:n], y[:n])
            seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
            mean, std = model.predict(X[n:], return_std=True)
        found.append(
            {
                "model": type(model).__name__,
                "seconds": seconds,
                "cpu_seconds": cpu_seconds,
                "likelihood_per_row": model.log_marginal_likelihood_value_ / n,
                "rmse": float(np.sqrt(np.mean((y[n:] - mean) ** 2))),
                "nlpd": negative_log_predictive_density(y[n:, np.newaxis], mean[:, np.newaxis], std[:, np.newaxis]),
            }
        )
    return found


def exact_tables(rows: pd.DataFrame) -> harness.Tables:
    keys = ["n_rows", "columns", "noise"]
    wide = rows.pivot_table(
        index=keys, columns="model", values=["seconds", "cpu_seconds", "likelihood_per_row", "rmse"]
    )
    ours, other = "EGPRegressor", "GaussianProcessRegressor"
    table = {name: wide.index.get_level_values(name) for name in keys}
    for label, name in (("s", "seconds"), ("CPU s", "cpu_seconds")):
        for model in (ours, other):
            table[f"{model}, {label}"] = wide[name][model].to_numpy()
    table["times as fast"] = (wide["seconds"][other] / wide["seconds"][ours]).to_numpy()
    for label, name in (("likelihood per row", "likelihood_per_row"), ("RMSE", "rmse")):
        for model in (ours, other):
            table[f"{label}, {model}"] = wide[name][model].map("{:.4f}".format).to_numpy()
    return {"exact": pd.DataFrame(table)}


# --- checkout ------------------------------------------------------------------------------------------------------

Checkout = namedtuple("Checkout", "job checkout commit seed repeat")


def folders(options: Any) -> dict[str, Path]:
    here = Path(__file__).resolve().parents[1]
    return {"this": here, "other": (options.other or here).resolve()}


def checkout_cells(options: Any) -> list[Checkout]:
    jobs, seeds, commits = options.jobs_of_checkout or [*JOBS, *(["ur10e"] if options.data else [])], options.seeds, {}
    if options.quick:
        jobs, seeds = ["pendulum"], range(1)
    for name, folder in folders(options).items():
        command = ["git", "-C", str(folder), "describe", "--always", "--dirty"]
        commits[name] = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    runs = itertools.product(jobs, seeds, commits)  # in pairs
    return [Checkout(job, name, commits[name], seed, 0) for job, seed, name in runs]


def run_checkout(cell: Checkout, options: Any) -> dict[str, Any]:
    """Fit in a process that imports skevgp from the folder."""
    command = [sys.executable, str(Path(__file__).with_name("one_fit.py")), cell.job, str(cell.seed)]
    command += ["--quick"] if options.quick else []
    command += ["--data", str(options.data.resolve())] if options.data else []
    environment = os.environ | {"PYTHONPATH": str(folders(options)[cell.checkout])}
    told = {"env": environment, "cwd": tempfile.gettempdir(), "capture_output": True, "text": True, "check": True}
    return json.loads(subprocess.run(command, **told).stdout.splitlines()[-1])


def checkout_tables(rows: pd.DataFrame) -> harness.Tables:
    """Return medians of times, the median of their ratios, and means of the rest: this / other."""
    names = ["seconds", "cpu_seconds", "n_iter", "bound", "error", "nlpd"]
    rows = rows.drop_duplicates(["job", "checkout", "seed", "repeat"], keep="last")  # of the last run
    pairs = rows.pivot(index=["job", "seed", "repeat"], columns="checkout", values=names).dropna()
    lines = []
    for job, own in pairs.groupby("job"):
        line = {"this / other": job, "pairs": len(own)}
        for name in names:
            this, other = (own[name][which].median() for which in ("this", "other"))
            line[name] = f"{figure_of(float(this))} / {figure_of(float(other))}"
            if "seconds" in name:
                line[f"ratio of {name}"] = f"{(own[name]['this'] / own[name]['other']).median():.3f}"
        lines.append(line)
    return {"checkout": pd.DataFrame(lines)}


PARTS: dict[str, tuple[str, Any, Any, Any, str]] = {  # CSV, cells, run, tables, title
    "latency": ("latency", latency_cells, run_latency, latency_tables, "Latency of predictions"),
    "casadi": ("casadi_latency", casadi_cells, run_casadi, casadi_tables, "A prediction by CasADi and in C"),
    "evaluation": (
        "evaluation_cost",
        evaluation_cells,
        run_evaluation,
        evaluation_tables,
        "One evaluation of the bound and its gradient",
    ),
    "rows": ("scaling", rows_cells, run_rows, rows_tables, "Time and memory over rows"),
    "million": ("many_rows", million_cells, run_million, million_tables, "A fit to 1,000,000 rows"),
    "exact": ("exact_fits", exact_cells, run_exact, exact_tables, "Exact fits against scikit-learn"),
    "checkout": ("checkout", checkout_cells, run_checkout, checkout_tables, "This checkout against another"),
}


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="seconds", seeds=3, in_processes=False)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--peer-python", help="of latency: a Python that has GPflow and GPyTorch")
    parser.add_argument("--fits", nargs="+", choices=FITS, help="of million; default: all but the reference")
    parser.add_argument("--other", type=Path, help="of checkout: folder of the other checkout; default: this one")
    parser.add_argument(
        "--fits-of", nargs="+", dest="jobs_of_checkout", choices=[*JOBS, *OTHER_JOBS], help="of checkout"
    )
    parser.add_argument("--data", type=Path, help="of checkout: a folder with the logs of the UR10e (see robots.py)")
    options = harness.parse(parser)
    name, cells, run, tables_of, title = PARTS[options.part]
    output = harness.output_path(options, name)
    n_failures = harness.run_missing(cells(options), partial(run, options=options), output, fresh=True)
    harness.write_page(title, tables_of(harness.frame(output)), output, n_failures)


if __name__ == "__main__":
    main()
