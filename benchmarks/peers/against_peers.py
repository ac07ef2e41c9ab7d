"""skevgp against other libraries: same data, same number of inducing points, same kernel, same start.

First every library has to agree with the others at fixed hyperparameters (`agreement.py`). Then it writes one row per
fit to a CSV (fits that are there already are not repeated), bound, RMSE and NLPD over time to a second one, draws a
picture from both, and writes and prints a Markdown page: how long each took to reach the bound and the NLPD of GPflow's
SGPR after its iterations, and means over seeds. Peers that are not installed are left out. GPflow needs another NumPy
than skevgp and GPJax: give the interpreter that has the peers (see requirements.txt, requirements_jax.txt), in a run
for each.

    python benchmarks/peers/against_peers.py --peer-python .peers/bin/python --data-folder ../uci
    python benchmarks/peers/against_peers.py --peers "GPJax SGPR" --peer-python .peers_jax/bin/python
    python benchmarks/peers/against_peers.py --datasets cartpole --peers skevgp "GPflow SGPR" --redo
    python benchmarks/peers/against_peers.py --quick  # half a minute: small data, skevgp and scikit-learn

All ten splits of the tables, GPflow's SGPR, gradient boosting and a straight line beside skevgp, without curves:

    python benchmarks/peers/against_peers.py --all-splits --peer-python .peers/bin/python --data-folder ../uci

The tables airfoil, elevators and kin40k are read from --data-folder (NAME/data.csv.gz, the target last, and
NAME/test_mask.csv.gz, a column per split); a seed is a split. Their inputs and targets are standardised with the
training rows; so are those of "smooth", 10,000 rows of waves of 8 columns with noise. Of systems the change of the
state is learned.

The kernel is a squared exponential with a lengthscale per column, the prior mean 0; signal variance and noise are of
each output, or shared as the peer does it: skevgp keeps them per output, the others share them too. skevgp has its
defaults; the noise of the others starts at all of the variance (GPflow's own start), of systems at a hundredth, and
they have 120 iterations of L-BFGS (GPflow, GPJax; of the acrobot 200), 300 steps of Adam of 0.1 (GPyTorch's SGPR: its
tutorial's 0.01 gets nowhere in as many), or an exact GP on 1,500 rows. Gradient boosting has a constant variance, from
5-fold cross-validation outside the clock. Each fit has a process of its own on two cores. The clock starts with the
arrays in memory and the libraries imported, so that TensorFlow's tracing and JAX's compilation are part of a fit; it
does not run while a fit is looked at. Of skevgp, what there was at an earlier time is what a fit returns that is ended
then, with its time.

GPJax's L-BFGS is its `fit_lbfgs`: that of Optax, whose line search is another than SciPy's, with the whole fit compiled
at once. It is in double precision, which JAX's own is not.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

import harness
import skevgp
from harness import Row
from peers import against_peers_report, agreement
from peers.data import DATASETS, QUICK, Data, DataSet
from peers.jobs import Job, Result
from peers.models import PEERS
from skevgp.metrics import negative_log_predictive_density, std_norm

_LINE, _TREES = "scikit-learn BayesianRidge", "scikit-learn HistGradientBoosting"
_TABLES = [name for name, one in DATASETS.items() if one.from_folder]
# What options mean that are not given: usually, for all splits of the tables, and in short mode.
DEFAULTS: dict[str, dict[str, Any]] = {
    "against_peers": {
        "datasets": list(DATASETS),
        "seeds": 1,
        "checkpoints": 12,
        "peers": ["skevgp", "GPflow SGPR", "GPyTorch SGPR", "GPJax SGPR", "scikit-learn GPR", _TREES, _LINE],
    },
    "splits": {
        "datasets": _TABLES,
        "seeds": 10,
        "checkpoints": 0,
        "peers": ["skevgp", "GPflow SGPR", _TREES, _LINE],
    },
    "against_peers_quick": {
        "datasets": list(QUICK),
        "seeds": 1,
        "checkpoints": 3,
        "peers": ["skevgp", "scikit-learn GPR", _TREES, _LINE],
    },
}
KEY = ("peer", "dataset", "sharing", "seed")
COLUMNS = (
    *(*KEY, "m", "n_train"),
    *("seconds", "cpu_seconds", "predict_seconds", "iterations", "evaluations", "stop", "bound", "output_bounds"),
    *("rmse", "nlpd", "error_mean", "error_median", "error_p99", "std_norm", "load", "date", "versions", "machine"),
)
CURVE_COLUMNS = (*KEY, "n_train", "seconds_so_far", "cpu_seconds_so_far", "bound_so_far", "rmse_so_far", "nlpd_so_far")
_CURVE_POINTS = 150


def environment(peer: str) -> dict[str, str]:
    """Of a peer's process: the same skevgp as here, installed or not."""
    own = os.environ | {"TF_CPP_MIN_LOG_LEVEL": "3"}
    if PEERS[peer].package == "skevgp":
        here = str(Path(skevgp.__file__).parents[1])
        own["PYTHONPATH"] = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    return own


def interpreters(peers: Iterable[str], peer_python: str) -> dict[str, str]:
    """The interpreter of each peer that is installed; says which are not."""
    found = {}
    for peer in peers:
        module = PEERS[peer].package
        python = sys.executable if module in ("skevgp", "sklearn") else peer_python
        check = f"import importlib.util as u, sys; sys.exit(u.find_spec({module!r}) is None)"
        if module == "skevgp" or subprocess.run([python, "-c", check], check=False).returncode == 0:
            found[peer] = python
        else:
            print(f"{peer}: {module} is not installed in {python}, left out")
    return found


def work(python: str, peer: str, given: Path, result: Path, time_limit: float = 300.0) -> None:
    """Run a peer in a process of its own.

    Raises
    ------
    RuntimeError
        If the peer failed, with the last line of what it said; or ran over its time.
    """
    command = [python, str(Path(__file__).parent / "models.py"), peer, str(given), str(result)]
    try:
        done = subprocess.run(
            command, env=environment(peer), capture_output=True, text=True, timeout=time_limit, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise RuntimeError("time") from error
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or ["no message"])[-1])


def fit(python: str, peer: str, job: Job) -> Result:
    """Run a job in a process of its own, which may take its time for all checkpoints."""
    with tempfile.TemporaryDirectory() as folder:
        given, result = Path(folder, "job.npz"), Path(folder, "result.npz")
        job.save(given)
        work(python, peer, given, result, (2 + 4 * (job.n_checkpoints > 0)) * job.time_limit + 60)
        return Result.load(result)


def scores(Y: np.ndarray, mean: np.ndarray, std: np.ndarray) -> dict[str, float]:
    """RMSE and NLPD, over rows; not a number where scikit-learn's GPR has rounded a negative variance up to 0."""
    nlpd = negative_log_predictive_density(Y, mean, std) if (std > 0.0).all() else np.nan
    return {"rmse": float(np.sqrt(np.mean(np.sum((Y - mean) ** 2, axis=1)))), "nlpd": nlpd}


def run(python: str, peer: str, data: Data, job: Job, key: Row) -> tuple[Row, list[Row]]:
    """Fit one peer: its row of the table, and its curve."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    provenance = harness.provenance()
    values: dict[str, object] = {
        "m": {"inducing": len(job.inducing_points), "rows": len(job.X), "none": ""}[PEERS[peer].points],
        "n_train": len(job.X),
        "load": round(load, 1),
        "date": provenance["date"],
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores",
    }
    Y = data.sets.Y_test
    try:
        result = fit(python, peer, job)
        if not (np.isfinite(result.mean).all() and np.isfinite(result.std).all()):
            raise RuntimeError("predictions that are not finite")
    except RuntimeError as error:
        return {name: str({**key, **values, "stop": f"failed: {error}"}.get(name, "")) for name in COLUMNS}, []
    errors = np.linalg.norm(Y - result.mean[0], axis=1)
    values |= {
        "seconds": result.seconds[0],
        "cpu_seconds": result.cpu_seconds[0],
        "predict_seconds": result.predict_seconds,
        "iterations": result.iterations,
        "evaluations": result.evaluations,
        "stop": result.stop,
        "bound": result.bound[0],
        "output_bounds": " ".join(f"{bound:.2f}" for bound in result.bounds),
        **scores(Y, result.mean[0], result.std[0]),
        "error_mean": errors.mean(),
        "error_median": np.median(errors),
        "error_p99": np.quantile(errors, 0.99),
        "std_norm": std_norm(result.std[0]),
        "versions": result.versions,
    }
    return {name: str({**key, **values}[name]) for name in COLUMNS}, curve_of(
        result, Y, key | {"n_train": str(len(job.X))}
    )


def curve_of(result: Result, Y: np.ndarray, key: Row) -> list[Row]:
    """Its bounds on the way, with RMSE and NLPD where it was looked at, and the end."""
    _, n_bounds = result.curve.shape
    # The first gains are large, the many later ones small; the last point is kept.
    some = np.linspace(0, n_bounds - 1, min(n_bounds, _CURVE_POINTS)).round().astype(int)
    some = np.union1d(some, np.arange(min(_CURVE_POINTS, n_bounds)))
    points = [(*result.curve[:, i], {"rmse": "", "nlpd": ""}) for i in some]
    for i in range(len(result.seconds)):
        looked_at = scores(Y, result.mean[i], result.std[i])
        points.append(
            (result.seconds[i], result.cpu_seconds[i], result.bound[i], {n: f"{v:.6f}" for n, v in looked_at.items()})
        )
    return [
        {
            **key,
            "seconds_so_far": f"{seconds:.4f}",
            "cpu_seconds_so_far": f"{cpu_seconds:.4f}",
            "bound_so_far": f"{bound:.3f}",
            **{f"{name}_so_far": value for name, value in looked_at.items()},
        }
        for seconds, cpu_seconds, bound, looked_at in sorted(points, key=lambda point: point[:2])
    ]


class Table:
    """A CSV of rows by key; written anew at each change, so that an interrupted run loses one fit at most."""

    def __init__(self, path: Path, columns: tuple[str, ...]):
        self.path, self.columns, self.rows = path, columns, harness.read(path)
        if self.rows and set(self.rows[0]) != set(columns):
            raise SystemExit(f"{path} has other columns, of another version: give another --output, or move it away.")

    def of(self, key: Row) -> list[Row]:
        return [row for row in self.rows if all(row[name] == value for name, value in key.items())]

    def replace(self, key: Row, rows: list[Row]) -> None:
        """Put rows in place of those of the same key."""
        self.rows = [row for row in self.rows if any(row[name] != key[name] for name in KEY)] + rows
        harness.write(self.rows, self.columns, self.path)


def arguments() -> argparse.Namespace:
    parser = harness.argument_parser(
        __doc__, quick="small data in half a minute", seeds="seeds or splits 0, 1, ...; default: 1", in_processes=False
    )
    parser.add_argument("--datasets", nargs="+", choices=DATASETS, metavar="NAME", help=f"of {', '.join(DATASETS)}")
    parser.add_argument("--data-folder", type=Path, help="with the tables; default: they are left out")
    parser.add_argument("--peers", nargs="+", choices=PEERS, metavar="PEER", help=f"of {', '.join(PEERS)}")
    parser.add_argument("--sharing", nargs="+", choices=("none", "all", "default"), help="default: all")
    parser.add_argument("--all-splits", action="store_true", help="other defaults: the tables, 10 splits, no curves")
    said = "times before the end at which a fit of the first seed is looked at, 0 and more; default: 12"
    parser.add_argument("--checkpoints", type=int, help=said)
    parser.add_argument("--time-limit", type=float, default=900.0, help="seconds per fit; default: %(default)s")
    parser.add_argument("--peer-python", default=sys.executable, help="interpreter with GPflow and GPyTorch, or GPJax")
    parser.add_argument("--redo", action="store_true", help="run fits again that are in the CSV")
    options = parser.parse_args()
    name = "splits" if options.all_splits else "against_peers"
    for option, value in DEFAULTS["against_peers_quick" if options.quick else name].items():
        if getattr(options, option) is None:
            setattr(options, option, value)
            if option == "datasets" and options.data_folder is None:
                options.datasets = [name for name in value if name not in _TABLES]
    known = QUICK if options.quick else DATASETS
    options.datasets = {name: known[name] for name in options.datasets if name in known}
    options.output = harness.output_path(options, name)
    return options


def sharings(peer: str, dataset: DataSet, chosen: list[str] | None) -> list[str]:
    """With one output there is nothing to share."""
    if not dataset.several:
        return ["none"]
    return [sharing for sharing in PEERS[peer].sharing if chosen is None or sharing in chosen]


def run_missing(
    name: str, seed: int, pythons: dict[str, str], options: argparse.Namespace, table: Table, curves: Table
) -> None:
    """All fits of a data set that the tables do not have."""
    dataset: DataSet = options.datasets[name]
    keys = [
        dict(zip(KEY, (peer, name, sharing, str(seed)), strict=True))
        for peer in pythons
        for sharing in sharings(peer, dataset, options.sharing)
    ]
    keys = [key for key in keys if options.redo or not table.of(key)]
    data = Data.of(dataset, seed, options.data_folder) if keys else None
    for key in keys:
        peer = key["peer"]
        options.agree()
        rows = data.rows(PEERS[peer].points == "rows", seed)
        job = Job(
            data.sets.X[rows],
            data.sets.Y[rows],
            data.sets.X_test,
            data.inducing_points,
            data.lengthscales,
            dataset.first_noise,
            key["sharing"],
            0 if PEERS[peer].own_rule and not options.quick else dataset.max_iter,
            options.time_limit,
            seed,
            options.checkpoints if seed == 0 else 0,
        )
        print(f"{name}, seed {seed}: {peer}, sharing {key['sharing']} ...", end=" ", flush=True)
        row, curve = run(pythons[peer], peer, data, job, key)
        table.replace(key, [row])
        curves.replace(key, curve)
        said = "RMSE {:.4f}, NLPD {:.4f} in {:.2f} s,"
        numbers = [float(row[name]) for name in ("rmse", "nlpd", "seconds") if row["seconds"]]
        print(said.format(*numbers) if numbers else "", row["stop"], flush=True)


def main() -> None:
    options = arguments()
    try:
        harness.pyplot()  # before the fits, not after them
    except ImportError as problem:
        raise SystemExit(f"No picture could be drawn ({problem}): pip install matplotlib") from problem
    table = Table(options.output, COLUMNS)
    curves = Table(options.output.with_name(f"{options.output.stem}_curves.csv"), CURVE_COLUMNS)
    pythons = interpreters(options.peers, options.peer_python)
    options.agree = cache(partial(agreement.check, pythons, work))  # once, before the first fit
    for name in options.datasets:
        for seed in range(options.seeds):
            run_missing(name, seed, pythons, options, table, curves)
    against_peers_report.draw(table.rows, curves.rows, options.output.with_suffix(".png"))
    harness.write_report(against_peers_report.paragraphs(table.rows, curves.rows), options.output)


if __name__ == "__main__":
    main()
