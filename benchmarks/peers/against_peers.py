"""skevgp against other libraries: same data, same number of inducing points, same kernel, same start.

Writes one row per fit to a CSV (fits that are there already are not repeated), the way of the bound over time to a
second one, draws a picture from both, and prints a table. Peers that are not installed are left out. GPflow needs
another NumPy than skevgp: give the interpreter that has the peers (see requirements.txt).

    python benchmarks/peers/against_peers.py --peer-python .peers/bin/python
    python benchmarks/peers/against_peers.py --systems cartpole --peers skevgp "GPflow SGPR" --redo
    python benchmarks/peers/against_peers.py --quick  # a few seconds: a small pendulum, skevgp and scikit-learn

The kernel is a squared exponential with a lengthscale per column, the prior mean 0; signal variance and noise are of
each output, or with sharing="all" what the peer makes of it: skevgp keeps them per output, the others share them too.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

import harness
import skevgp
from harness import Row
from peers.jobs import Job, Result
from peers.models import PEERS
from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.metrics import negative_log_predictive_density, std_norm

# Where the peer ends whose last bound the others are timed against.
REFERENCE = ("GPflow SGPR", "none")
QUICK_PEERS = ("skevgp", "scikit-learn GPR", "scikit-learn BayesianRidge")
# Rows of an exact GP.
SUBSET = 600
KEY = ("peer", "dataset", "model", "sharing", "m", "n_train", "seed")
COLUMNS = (
    *KEY,
    *("target", "seconds", "cpu_seconds", "predict_seconds", "iterations", "evaluations", "stop", "bound"),
    *("output_bounds", "error_mean", "error_median", "error_p99", "nlpd", "std_norm", "load", "versions", "machine"),
)
CURVE_COLUMNS = (*KEY, "seconds_so_far", "cpu_seconds_so_far", "bound_so_far")
_CURVE_POINTS = 150


@dataclass(frozen=True)
class System:
    """A data set, and the size of the model that learns it.

    Attributes
    ----------
    name : str
    n_inducing : int
        Of the paper's VGP (its Table 2).
    max_iter : int
        The common limit of L-BFGS, per output.
    sizes : dict
        For `make_dynamics`; empty for the paper's.
    """

    name: str
    n_inducing: int
    max_iter: int
    sizes: dict[str, int]


SYSTEMS = {
    "pendulum": System("pendulum", 40, 300, {}),
    "cartpole": System("cartpole", 100, 200, {}),
    "acrobot": System("acrobot", 250, 100, {}),
}
QUICK = System("pendulum", 8, 20, {"n_trajectories": 5, "n_steps": 12})
# What is learned: the next state as it is, or the change of the state.
MODELS = {"VGP": "state", "RES-VGP": "change"}


@dataclass(frozen=True)
class Data:
    """Training and test rows, and where all fits of a seed start."""

    X: np.ndarray
    Y: np.ndarray
    X_test: np.ndarray
    Y_test: np.ndarray
    inducing_points: np.ndarray
    lengthscales: np.ndarray

    @classmethod
    def of(cls, system: System, model: str, seed: int) -> Data:
        train = make_dynamics(system.name, random_state=seed, **system.sizes)
        test = make_dynamics(system.name, random_state=1000 + seed, **system.sizes)
        before, before_test = (
            (data.data[:, : data.target.shape[1]] if MODELS[model] == "change" else 0.0) for data in (train, test)
        )
        Y = train.target - before
        start = EVGPRegressor(n_inducing=system.n_inducing, max_iter=0, random_state=seed).fit(train.data, Y)
        lengthscales = np.broadcast_to(start.kernel_[0].k2.length_scale, train.data.shape[1])
        return cls(train.data, Y, test.data, test.target - before_test, start.inducing_points_, lengthscales)

    def rows(self, peer: str, seed: int) -> np.ndarray | slice:
        """The training rows that a peer gets."""
        if not PEERS[peer].subset or len(self.X) <= SUBSET:
            return slice(None)
        return np.random.RandomState(seed).choice(len(self.X), SUBSET, replace=False)


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


def fit(python: str, peer: str, job: Job) -> Result:
    """Run a job in a process of its own.

    Raises
    ------
    RuntimeError
        If the peer failed, with the last line of what it said; or ran over twice its time.
    """
    environment = os.environ | {"TF_CPP_MIN_LOG_LEVEL": "3"}
    if PEERS[peer].package == "skevgp":
        # The same skevgp as here, installed or not.
        here = str(Path(skevgp.__file__).parents[1])
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    with tempfile.TemporaryDirectory() as folder:
        given, result = Path(folder, "job.npz"), Path(folder, "result.npz")
        job.save(given)
        command = [python, str(Path(__file__).parent / "models.py"), peer, str(given), str(result)]
        try:
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=2 * job.time_limit + 60, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise RuntimeError("time") from error
        if done.returncode:
            raise RuntimeError((done.stderr.strip().splitlines() or ["no message"])[-1])
        return Result.load(result)


def run(python: str, peer: str, system: System, data: Data, key: Row, time_limit: float) -> tuple[Row, list[Row]]:
    """Fit one peer: its row of the table, and its curve."""
    seed = int(key["seed"])
    rows = data.rows(peer, seed)
    job = Job(
        data.X[rows],
        data.Y[rows],
        data.X_test,
        data.inducing_points,
        data.lengthscales,
        key["sharing"],
        0 if PEERS[peer].own_rule and system is not QUICK else system.max_iter,
        time_limit,
        seed,
    )
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    values: dict[str, object] = {
        "target": MODELS[key["model"]],
        "load": round(load, 1),
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores",
    }
    try:
        result = fit(python, peer, job)
        if not (np.isfinite(result.mean).all() and np.isfinite(result.std).all()):
            raise RuntimeError("predictions that are not finite")
    except RuntimeError as error:
        return {name: str({**key, **values, "stop": f"failed: {error}"}.get(name, "")) for name in COLUMNS}, []
    errors = np.linalg.norm(data.Y_test - result.mean, axis=1)
    # scikit-learn's GPR rounds negative variances up to 0.
    proper = (result.std > 0.0).all()
    values |= {
        "seconds": result.seconds,
        "cpu_seconds": result.cpu_seconds,
        "predict_seconds": result.predict_seconds,
        "iterations": result.iterations,
        "evaluations": result.evaluations,
        "stop": result.stop,
        "bound": result.bounds.sum() if len(result.bounds) else np.nan,
        "output_bounds": " ".join(f"{bound:.2f}" for bound in result.bounds),
        "error_mean": errors.mean(),
        "error_median": np.median(errors),
        "error_p99": np.quantile(errors, 0.99),
        "nlpd": negative_log_predictive_density(data.Y_test, result.mean, result.std) if proper else np.nan,
        "std_norm": std_norm(result.std),
        "versions": result.versions,
    }
    clock, bound = np.column_stack([result.curve_seconds, result.curve_cpu_seconds]), result.curve_bound
    if len(bound):
        # The first gains are large, the many later ones small; the last point is kept.
        some = np.linspace(0, len(bound) - 1, _CURVE_POINTS).round().astype(int)
        some = np.union1d(some, np.arange(min(_CURVE_POINTS, len(bound))))
        clock, bound = clock[some], bound[some]
    curve = [
        {
            **key,
            "seconds_so_far": f"{seconds:.4f}",
            "cpu_seconds_so_far": f"{cpu_seconds:.4f}",
            "bound_so_far": f"{value:.3f}",
        }
        for (seconds, cpu_seconds), value in zip(clock, bound, strict=True)
    ]
    return {name: str({**key, **values}[name]) for name in COLUMNS}, curve


class Table:
    """A CSV of rows by key; written anew at each change, so that an interrupted run loses one fit at most."""

    def __init__(self, path: Path, columns: tuple[str, ...]):
        self.path, self.columns, self.rows = path, columns, harness.read(path)

    def of(self, key: Row) -> list[Row]:
        return [row for row in self.rows if all(row[name] == value for name, value in key.items())]

    def replace(self, key: Row, rows: list[Row]) -> None:
        """Put rows in place of those of the same key."""
        self.rows = [row for row in self.rows if any(row[name] != key[name] for name in KEY)] + rows
        harness.write(self.rows, self.columns, self.path)


def time_to_reach(curve: list[Row], bound: float, clock: str) -> float:
    """Seconds until a bound was reached; NaN if it never was."""
    for row in curve:
        if float(row["bound_so_far"]) >= bound:
            return float(row[f"{clock}_so_far"])
    return float("nan")


def comparison(row: Row, table: Table, curves: Table) -> tuple[float, float, float]:
    """Seconds of a fit to the reference's last bound, and how many times faster than the reference that is.

    Returns
    -------
    seconds, faster, faster_cpu : float
        The last one by the processor's seconds, which other work on the machine disturbs less.
    """
    name, sharing = REFERENCE
    key = {column: row[column] for column in KEY}
    reference = [one for one in table.of(key | {"peer": name, "sharing": sharing}) if one["seconds"]]
    if not reference:
        return float("nan"), float("nan"), float("nan")
    # The curve is rounded to 0.001 nats.
    bound, curve = float(reference[0]["bound"]) - 0.01, curves.of(key)
    seconds, cpu_seconds = (time_to_reach(curve, bound, clock) for clock in ("seconds", "cpu_seconds"))
    return seconds, float(reference[0]["seconds"]) / seconds, float(reference[0]["cpu_seconds"]) / cpu_seconds


def summarise(table: Table, curves: Table) -> None:
    """Medians over seeds."""
    titles = ("seeds", "seconds", "cpu s", "to bound", "faster", "by cpu", "bound/row", "Error", "NLPD")
    for dataset, model in dict.fromkeys((row["dataset"], row["model"]) for row in table.rows):
        own = table.of({"dataset": dataset, "model": model})
        print(f"\n{dataset}, {model}\n{'':27s}sharing" + "".join(f"{title:>10s}" for title in titles) + "  stop")
        for peer, sharing in dict.fromkeys((row["peer"], row["sharing"]) for row in own):
            rows = [row for row in own if (row["peer"], row["sharing"]) == (peer, sharing)]
            done = [row for row in rows if row["seconds"]]
            if not done:
                print(f"{peer:27s}{sharing:7s}{len(rows):10d}  {rows[0]['stop']}")
                continue
            to_bound, faster, by_cpu = np.median([comparison(row, table, curves) for row in done], axis=0)
            seconds, cpu, error, nlpd = (
                np.median([float(row[name]) for row in done])
                for name in ("seconds", "cpu_seconds", "error_mean", "nlpd")
            )
            per_row = np.median([float(row["bound"]) / int(row["n_train"]) for row in done])
            print(
                f"{peer:27s}{sharing:7s}{len(done):10d}{seconds:10.2f}{cpu:10.2f}{to_bound:10.2f}{faster:10.1f}"
                f"{by_cpu:10.1f}{per_row:10.3f}{error:10.5f}{nlpd:10.2f}  {done[0]['stop']}"
            )
    print(f"\nto bound: seconds until the last bound of {REFERENCE[0]} per output was reached (its noise from 0.01);")
    print("faster: all its seconds over those; by cpu: the same in seconds of the processor, over all threads")


def arguments() -> argparse.Namespace:
    parser = harness.argument_parser(
        __doc__,
        quick="a small pendulum in seconds",
        seeds="seeds 0, 1, ...; default: 1",
        systems=SYSTEMS,
        in_processes=False,
    )
    parser.set_defaults(seeds=1)
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    parser.add_argument("--peers", nargs="+", choices=PEERS, metavar="PEER", help=f"of {', '.join(PEERS)}")
    parser.add_argument("--sharing", nargs="+", choices=("none", "all"), default=["none", "all"], help="default: both")
    parser.add_argument("--time-limit", type=float, default=900.0, help="seconds per fit; default: %(default)s")
    parser.add_argument("--peer-python", default=sys.executable, help="interpreter with GPflow and GPyTorch")
    parser.add_argument("--redo", action="store_true", help="run fits again that are in the CSV")
    options = parser.parse_args()
    options.output = harness.output_path(options, "against_peers")
    if options.peers is None:
        options.peers = list(QUICK_PEERS if options.quick else PEERS)
    return options


def main() -> None:
    options = arguments()
    pythons = interpreters(options.peers, options.peer_python)
    table = Table(options.output, COLUMNS)
    curves = Table(options.output.with_name(f"{options.output.stem}_curves.csv"), CURVE_COLUMNS)
    systems = [QUICK] if options.quick else [SYSTEMS[name] for name in options.systems]
    for system, model, seed in ((s, m, i) for s in systems for m in options.models for i in range(options.seeds)):
        data = Data.of(system, model, seed)
        for peer, python in pythons.items():
            for sharing in (sharing for sharing in PEERS[peer].sharing if sharing in options.sharing):
                n_train = len(data.X[data.rows(peer, seed)])
                m = n_train if PEERS[peer].subset else len(data.inducing_points)
                key = dict(zip(KEY, map(str, (peer, system.name, model, sharing, m, n_train, seed)), strict=True))
                if table.of(key) and not options.redo:
                    continue
                print(f"{system.name} {model} seed {seed}: {peer}, sharing {sharing} ...", end=" ", flush=True)
                row, curve = run(python, peer, system, data, key, options.time_limit)
                table.replace(key, [row])
                curves.replace(key, curve)
                said = f"{float(row['seconds']):.2f} s, error {float(row['error_mean']):.5f}" if row["seconds"] else ""
                print(said, row["stop"], flush=True)
    summarise(table, curves)
    if find_spec("matplotlib") is None:
        print("No picture: pip install matplotlib")
        return
    from peers.picture import draw

    draw(table.rows, curves.rows, options.output.with_suffix(".png"))


if __name__ == "__main__":
    main()
