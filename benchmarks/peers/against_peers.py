"""skevgp against other libraries: same data, same number of inducing points, same kernel, same start.

First every library has to agree with dense matrices at fixed hyperparameters. Then each fit is a row of a CSV, and its
bound, RMSE and NLPD over time are in a second CSV. Rows that are deleted from both are measured again. Peers that are
not installed are left out. GPflow needs another NumPy than skevgp and GPJax. So pass the interpreter that has the peers
(see requirements.txt and requirements_jax.txt).

    python benchmarks/peers/against_peers.py --peer-python .peers/bin/python --data-folder ../uci
    python benchmarks/peers/against_peers.py --peers "GPJax SGPR" --peer-python .peers_jax/bin/python
    python benchmarks/peers/against_peers.py --datasets cartpole --peers skevgp "GPflow SGPR"
    python benchmarks/peers/against_peers.py --quick  # small data, skevgp and scikit-learn: half a minute

All ten splits of the tables, with GPflow's SGPR, gradient boosting, a straight line and skevgp, without curves:

    python benchmarks/peers/against_peers.py --all-splits --peer-python .peers/bin/python --data-folder ../uci

The tables airfoil, elevators and kin40k are read from --data-folder: NAME/data.csv.gz with the target last, and
NAME/test_mask.csv.gz with a column per split. A seed is a split. Tables and "smooth", 10,000 rows of waves of 8 columns
with noise, are standardised with the training rows. On systems, models learn the change of the state.

The kernel is a squared exponential with a lengthscale per column, and the prior mean is 0. skevgp has its defaults. The
noise of the others starts at the whole variance of the targets, and on systems at a hundredth of it. They have 120
iterations of L-BFGS (GPflow, GPJax; on the acrobot 200), 300 steps of Adam (GPyTorch), or an exact GP on 1,500 rows.
Each fit runs in a separate process on two cores. The clock starts with the arrays in memory and the libraries imported,
so that TensorFlow's tracing and JAX's compilation are part of a fit.
"""

from __future__ import annotations

import itertools
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np
import pandas as pd
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal

import harness
import skevgp
from harness import text
from peers.adapters import PEERS, load
from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.metrics import negative_log_predictive_density, std_norm

KEY = ["peer", "dataset", "sharing", "seed"]
SUBSET = 1500  # rows of an exact GP
TOLERANCE = 1e-6  # relative difference from dense matrices
_LINE, _TREES = "scikit-learn BayesianRidge", "scikit-learn HistGradientBoosting"


# --- data ----------------------------------------------------------------------------------------------------------


class Sets(NamedTuple):
    X: np.ndarray
    Y: np.ndarray
    X_test: np.ndarray
    Y_test: np.ndarray


def standardised(X: np.ndarray, y: np.ndarray, is_test: np.ndarray) -> Sets:
    """Scale inputs and target by the training rows' mean and standard deviation."""
    sets = []
    for table in (X, y[:, np.newaxis]):
        train = table[~is_test]
        spread = train.std(axis=0)
        sets.append((table - train.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0))
    return Sets(*(table[rows] for rows in (~is_test, is_test) for table in sets))


def tabular(name: str, seed: int, folder: Path | None) -> Sets:
    table, masks = (np.loadtxt(f"{folder}/{name}/{file}.csv.gz", delimiter=",") for file in ("data", "test_mask"))
    return standardised(table[:, :-1], table[:, -1], masks[:, seed] == 1.0)


def smooth(n_rows: int, seed: int, folder: Path | None) -> Sets:
    """Make sums of waves of 8 columns; about 1 % of their variance is noise."""
    pieces = harness.noisy_waves(n_rows, 8, np.random.RandomState(seed))
    (X, y, _), (X_test, y_test, _) = (next(pieces) for _ in range(2))
    return standardised(np.vstack([X, X_test]), np.concatenate([y, y_test]), np.arange(2 * n_rows) >= n_rows)


def dynamics(system: str, seed: int, folder: Path | None, **sizes: int) -> Sets:
    """Simulate changes of the state, in the units of the system."""
    train, test = (make_dynamics(system, random_state=state, **sizes) for state in (seed, 1000 + seed))
    changes = (part.target - part.data[:, : part.target.shape[1]] for part in (train, test))
    return Sets(train.data, next(changes), test.data, next(changes))


@dataclass(frozen=True)
class DataSet:
    """A data set, the size of its model, the limit of L-BFGS, and where the noise of the other peers starts."""

    load: Callable[[int, Path | None], Sets]
    n_inducing: int
    max_iter: int = 120
    first_noise: float = 1.0
    several: bool = False  # outputs, which may share


TABLES = ("airfoil", "elevators", "kin40k")
SIZES = {"pendulum": (40, 120), "cartpole": (100, 120), "acrobot": (250, 200), "iiwa14": (500, 120)}
DATASETS = {
    **{name: DataSet(partial(tabular, name), 256) for name in TABLES},
    "smooth": DataSet(partial(smooth, 10_000), 256),
    **{name: DataSet(partial(dynamics, name), *sizes, 0.01, several=True) for name, sizes in SIZES.items()},
}
QUICK = {
    "smooth": DataSet(partial(smooth, 200), 8, 20),
    "pendulum": DataSet(partial(dynamics, "pendulum", n_trajectories=5, n_steps=12), 8, 20, 0.01, several=True),
}
# The picture's: tables of real data, small and large, a system of several outputs, and waves.
DRAWN = ("airfoil", "kin40k", "cartpole", "smooth")
# datasets, seeds, checkpoints and peers that are not given
DEFAULTS: dict[str, tuple[Any, ...]] = {
    "against_peers": (list(DATASETS), 1, 12, list(PEERS)),
    "splits": (list(TABLES), 10, 0, ["skevgp", "GPflow SGPR", _TREES, _LINE]),
    "quick": (list(QUICK), 1, 3, ["skevgp", "scikit-learn GPR", _TREES, _LINE]),
}


# --- running -------------------------------------------------------------------------------------------------------


def interpreters(peers: Iterable[str], peer_python: str) -> dict[str, str]:
    """Return the interpreter of each peer that is installed."""
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


def work(python: str, peer: str, given: dict[str, Any], time_limit: float = 300.0, **variables: str) -> SimpleNamespace:
    """Run a peer in a process of its own, with the same skevgp as here and further environment variables."""
    environment = os.environ | {"TF_CPP_MIN_LOG_LEVEL": "3", **variables}
    if PEERS[peer].package == "skevgp":
        paths = [str(Path(skevgp.__file__).parents[1]), os.environ.get("PYTHONPATH")]
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    with tempfile.TemporaryDirectory() as folder:
        job, result = Path(folder, "job.npz"), Path(folder, "result.npz")
        np.savez(job, **given)
        command = [python, str(Path(__file__).with_name("adapters.py")), peer, str(job), str(result)]
        options = {"env": environment, "capture_output": True, "text": True, "check": False, "timeout": time_limit}
        try:
            done = subprocess.run(command, **options)
        except subprocess.TimeoutExpired as error:
            raise RuntimeError("time") from error
        if done.returncode:
            raise RuntimeError((done.stderr.strip().splitlines() or ["no message"])[-1])
        return load(result)


def scores(Y: np.ndarray, mean: np.ndarray, std: np.ndarray) -> dict[str, float]:
    """Return RMSE and NLPD. The NLPD is NaN where scikit-learn's GPR has rounded a negative variance up to 0."""
    nlpd = negative_log_predictive_density(Y, mean, std) if (std > 0.0).all() else np.nan
    return {"rmse": float(np.sqrt(np.mean(np.sum((Y - mean) ** 2, axis=1)))), "nlpd": nlpd}


def run(python: str, peer: str, sets: Sets, job: dict[str, Any], cell: dict[str, Any]) -> tuple[Any, Any]:
    """Fit one peer; return its row of the table and its curve."""
    load_before = os.getloadavg()[0] if hasattr(os, "getloadavg") else np.nan
    points = {"inducing": len(job["inducing_points"]), "rows": len(job["X"]), "none": ""}[PEERS[peer].points]
    names = ("seconds", "cpu_seconds", "predict_seconds", "iterations", "evaluations", "stop", "bound", "output_bounds")
    names += ("rmse", "nlpd", "error_mean", "error_median", "error_p99", "std_norm")
    row = {**cell, "m": points, "n_train": len(job["X"]), **dict.fromkeys(names, "")}
    row |= {"load": round(load_before, 1), "date": harness.provenance()["date"], "versions": ""}
    row["machine"] = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    try:
        result = work(python, peer, job, (2 + 4 * (job["n_checkpoints"] > 0)) * job["time_limit"] + 60)
    except RuntimeError as error:
        return row | {"stop": f"failed: {error}"}, []
    Y, mean, std = sets.Y_test, result.mean[0], result.std[0]
    if not (np.isfinite(mean).all() and np.isfinite(std).all()):
        return row | {"stop": "failed: predictions that are not finite"}, []
    errors = np.linalg.norm(Y - mean, axis=1)
    row |= {name: getattr(result, name) for name in ("predict_seconds", "iterations", "evaluations", "stop")}
    row |= {name: getattr(result, name)[0] for name in ("seconds", "cpu_seconds", "bound")}
    row |= {"output_bounds": " ".join(f"{bound:.2f}" for bound in result.bounds), **scores(Y, mean, std)}
    row |= {"error_mean": errors.mean(), "error_median": np.median(errors), "error_p99": np.quantile(errors, 0.99)}
    row |= {"std_norm": std_norm(std), "versions": result.versions}
    # The first gains are large and the many later ones small. The last point is kept.
    n, most = result.curve.shape[1], 150
    some = np.union1d(np.linspace(0, n - 1, min(n, most)).round().astype(int), np.arange(min(most, n)))
    so_far = ["seconds", "cpu_seconds", "bound"]
    curve = pd.DataFrame(result.curve[:, some].T, columns=so_far).assign(rmse="", nlpd="")
    looked_at = pd.DataFrame({name: getattr(result, name) for name in so_far})
    found = [scores(Y, *each) for each in zip(result.mean, result.std, strict=True)]
    looked_at = looked_at.join(pd.DataFrame(found).map("{:.6f}".format))
    curve = pd.concat([curve, looked_at]).sort_values(["seconds", "cpu_seconds"]).add_suffix("_so_far")
    return row, curve.assign(**cell, n_train=len(job["X"])).to_dict("records")


# --- agreement -----------------------------------------------------------------------------------------------------


def cases() -> list[dict[str, Any]]:
    """Return each kernel with 500 rows and 20 inducing points, and with 60 rows that are all inducing points."""
    made = []
    for kernel, (n, m) in itertools.product(("rbf", "matern52"), ((500, 20), (60, 60))):
        rng = np.random.RandomState(m)
        X, X_test = rng.uniform(-2.0, 2.0, (n, 3)), rng.uniform(-2.0, 2.0, (50, 3))
        y = np.sin(X).sum(axis=1) + 0.2 * rng.randn(n)
        points = X if m == n else rng.uniform(-2.0, 2.0, (m, 3))
        case = {"kernel": kernel, "X": X, "y": y, "X_test": X_test, "inducing_points": points}
        made.append({**case, "lengthscales": np.array([0.6, 0.9, 1.2]), "signal": 1.7, "noise": 0.05})
    return made


def expected(case: dict[str, Any]) -> tuple[float, np.ndarray, np.ndarray]:
    """Compute bound (Titsias 2009, equation 9), mean and variance (equation 6, with noise) by dense matrices."""
    X, y, Z, signal, noise = (case[name] for name in ("X", "y", "inducing_points", "signal", "noise"))

    def covariance(A: np.ndarray, B: np.ndarray) -> np.ndarray:
        r = cdist(A / case["lengthscales"], B / case["lengthscales"])
        if case["kernel"] == "rbf":
            return signal * np.exp(-0.5 * r**2)
        return signal * (1.0 + np.sqrt(5.0) * r + 5.0 / 3.0 * r**2) * np.exp(-np.sqrt(5.0) * r)

    Kmm, Kmn, Kms = (covariance(Z, other) for other in (Z, X, case["X_test"]))
    Q = Kmn.T @ np.linalg.solve(Kmm, Kmn)
    Q = 0.5 * (Q + Q.T)
    bound = multivariate_normal(np.zeros(len(X)), Q + noise * np.eye(len(X))).logpdf(y)
    bound -= 0.5 * (signal - np.diagonal(Q)).sum() / noise
    precision = cho_factor(Kmm + Kmn @ Kmn.T / noise)
    explained = np.einsum("ms,ms->s", Kms, np.linalg.solve(Kmm, Kms) - cho_solve(precision, Kms))
    return float(bound), Kms.T @ cho_solve(precision, Kmn @ y) / noise, signal - explained + noise


def check(pythons: dict[str, str]) -> None:
    """Compare one peer of each library with dense matrices; exit with an error if a library disagrees."""
    asked = {PEERS[peer].package: peer for peer in reversed(pythons) if PEERS[peer].at_fixed}
    for package, peer in asked.items():
        worst = 0.0
        for case in cases():
            if PEERS[peer].points == "rows" and len(case["inducing_points"]) < len(case["X"]):
                continue
            said, (bound, mean, variance) = work(pythons[peer], peer, case), expected(case)
            apart = abs(said.bound / bound - 1.0), np.max(np.abs(said.mean - mean)) / np.max(np.abs(mean))
            worst = max(worst, *apart, np.max(np.abs(said.variance / variance - 1.0)))
        if not worst <= TOLERANCE:
            raise SystemExit(f"{package} disagrees: {worst:.1e} from the dense matrices. Nothing was timed.")
        print(f"{package} agrees with dense matrices to {worst:.0e} (jitter: {PEERS[peer].jitter})", flush=True)


# --- tables and picture --------------------------------------------------------------------------------------------


def time_to_reach(curve: pd.DataFrame, name: str, target: float, clock: str) -> float:
    """Return seconds until the bound rose, or the NLPD fell, to a target; NaN if it never did."""
    sign = -1.0 if name == "nlpd" else 1.0
    points = curve.dropna(subset=f"{name}_so_far")
    seconds, values = points[f"{clock}_so_far"].to_numpy(), sign * points[f"{name}_so_far"].to_numpy()
    reached = np.flatnonzero(values >= sign * target)
    if not len(reached):
        return np.nan
    i = reached[0]
    if i == 0 or not values[i] > values[i - 1]:
        return float(seconds[i])
    share = (sign * target - values[i - 1]) / (values[i] - values[i - 1])
    return float(np.exp(np.interp(share, (0.0, 1.0), np.log(np.maximum(seconds[i - 1 : i + 1], 1e-9)))))


def first_seed(rows: pd.DataFrame, curves: pd.DataFrame) -> pd.DataFrame:
    """Return a line per fit of one data set and seed, with times to the last bound and NLPD of GPflow's SGPR."""
    reference = rows[(rows["peer"] == "GPflow SGPR") & (rows["sharing"] == "none")].dropna(subset="seconds")
    lines = []
    for row in rows.itertuples():
        line = {"to bound, s": np.nan, "×": np.nan, "× net": np.nan, "× by cpu": np.nan, "to NLPD, s": np.nan}
        same = reference[reference["n_train"] == row.n_train]
        if len(same) and len(curves):
            best = same.iloc[0]
            own = curves[(curves["peer"] == row.peer) & (curves["sharing"] == row.sharing)]
            bound = best["bound"] - 0.01  # the curve's bounds are rounded
            to_bound, cpu = (time_to_reach(own, "bound", bound, clock) for clock in ("seconds", "cpu_seconds"))
            first = curves[(curves["peer"] == "GPflow SGPR") & (curves["sharing"] == "none")]["seconds_so_far"]
            line |= {"to bound, s": to_bound, "×": best["seconds"] / to_bound}
            line["× net"] = (best["seconds"] - first.head(1).sum()) / to_bound
            line["× by cpu"] = best["cpu_seconds"] / cpu
            line["to NLPD, s"] = time_to_reach(own, "nlpd", best["nlpd"] + 1e-6, "seconds")
        lines.append(line)
    stops = rows["stop"].map(lambda stop: " ".join(dict.fromkeys(stop.split())))
    columns = {
        "peer": rows["peer"],
        "sharing": rows["sharing"],
        "rows": rows["n_train"],
        "m": text(rows["m"], 0),
        "seconds": rows["seconds"],
        "cpu s": rows["cpu_seconds"],
        "iterations": text(rows["iterations"], 0),
        "bound / row": text(rows["bound"] / rows["n_train"], 4),
        "RMSE": rows["rmse"],
        "NLPD": text(rows["nlpd"], 4),
        **pd.DataFrame(lines, index=rows.index),
        "load": rows["load"].astype(str),
        "stop": stops,
    }
    return pd.DataFrame(columns)


def all_seeds(rows: pd.DataFrame, what: str) -> pd.DataFrame:
    """Return means ± standard errors over seeds, and the median of the seconds."""
    found = rows.dropna(subset="seconds").groupby(["peer", "sharing"], sort=False)
    table = pd.DataFrame({what: found.size()})
    for name in ("rmse", "nlpd"):
        means, errors = (values.map("{:.4f}".format) for values in (found[name].mean(), found[name].sem()))
        table[name.upper()] = (means + " ± " + errors).where(table[what] > 1, means)
    return table.assign(seconds=found["seconds"].median()).reset_index()


def tables_of(rows: pd.DataFrame, curves: pd.DataFrame) -> harness.Tables:
    """Return two tables per data set: its first seed, and means over seeds if there are several."""
    tables = {}
    for name, own in rows.groupby("dataset", sort=False):
        what, first = "split" if name in TABLES else "seed", own["seed"].min()
        on_the_way = curves[(curves["dataset"] == name) & (curves["seed"] == first)] if len(curves) else curves
        tables[f"{name}, {what} {first}"] = first_seed(own[own["seed"] == first], on_the_way)
        if own["seed"].nunique() > 1:
            tables[f"{name}, all"] = all_seeds(own, f"{what}s")
    return tables


def plot(rows: pd.DataFrame, curves: pd.DataFrame, path: Path) -> None:
    """Draw NLPD over processor time, of the first seed of up to four data sets."""
    curves = curves[[PEERS[peer].points != "none" for peer in curves["peer"]]]
    names = [name for name in DRAWN if name in set(rows["dataset"])] or list(rows["dataset"].unique())[:4]
    n_lines = -(-len(names) // 2)
    size = (harness.WIDTH, 1.0 + 2.5 * n_lines)
    figure, grid = harness.pyplot().subplots(n_lines, 2, figsize=size, squeeze=False)
    palette = dict(zip(["skevgp", "GPflow SGPR", "GPyTorch SGPR", "GPJax SGPR"], harness.PALETTE, strict=False))
    for axes, name in zip(grid.flat, names, strict=False):
        own = curves[(curves["dataset"] == name) & (curves["seed"] == curves["seed"].min())]
        ends = []
        for (peer, sharing), line in own.dropna(subset="nlpd_so_far").groupby(["peer", "sharing"]):
            points = line.sort_values("cpu_seconds_so_far")
            seconds, values = points["cpu_seconds_so_far"], points["nlpd_so_far"]
            style = {"color": palette.get(peer, "#555555"), "linestyle": {"none": "-", "all": "--"}.get(sharing, ":")}
            label = peer + {"none": "", "all": ", all shared"}.get(sharing, f", sharing={sharing}")
            if PEERS[peer].points == "rows":
                label += f", up to {SUBSET:,} rows"
            axes.plot(seconds, values, label=label, marker="o", markevery=[-1], **style)
            ends.append(values.iloc[-1])
        harness.logarithmic(axes, "x")
        axes.set_title(f"{name}, {rows[rows['dataset'] == name]['n_train'].max():,} rows")
        if ends:  # the way down to where the worst fit ended says little
            low, room = min(ends), max(np.ptp(ends), 0.1)
            axes.set_ylim(low - 0.15 * room, low + 2.0 * room)
    for axes in grid.flat[len(names) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("processor time, all threads (s)")
    for axes in grid[:, 0]:
        axes.set_ylabel("test NLPD (nats per row)")
    harness.legend(figure, ncols=3, handlelength=3.5)
    harness.save_picture(figure, path)


# --- command -------------------------------------------------------------------------------------------------------


def main() -> None:
    parser = harness.argument_parser(__doc__, quick="small data in half a minute", in_processes=False)
    parser.add_argument("--seeds", type=int, help="number of seeds or splits; default: 1")
    parser.add_argument("--datasets", nargs="+", choices=DATASETS, metavar="NAME", help=f"of {', '.join(DATASETS)}")
    parser.add_argument("--data-folder", type=Path, help="with the tables; default: they are left out")
    parser.add_argument("--peers", nargs="+", choices=PEERS, metavar="PEER", help=f"of {', '.join(PEERS)}")
    parser.add_argument("--all-splits", action="store_true", help="other defaults: the tables, 10 splits, no curves")
    parser.add_argument("--time-limit", type=float, default=900.0, help="seconds per fit; default: %(default)s")
    parser.add_argument("--peer-python", default=sys.executable, help="interpreter with GPflow and GPyTorch, or GPJax")
    options = parser.parse_args()
    harness.pyplot()  # fail before the fits if matplotlib is missing
    name = "splits" if options.all_splits else "against_peers"
    datasets, n_seeds, n_checkpoints, peers = DEFAULTS["quick" if options.quick else name]
    output = harness.output_path(options, name)
    curves_output = output.with_name(f"{output.stem}_curves.csv")
    pythons, checked = interpreters(options.peers or peers, options.peer_python), False
    known = QUICK if options.quick else DATASETS
    if options.data_folder is None:
        known = {name: dataset for name, dataset in known.items() if name not in TABLES}
    wanted = [name for name in options.datasets or datasets if name in known]
    for name, seed in itertools.product(wanted, range(options.seeds or n_seeds)):
        dataset, sets, done = known[name], None, harness.finished(output, KEY)
        for peer in pythons:
            for sharing in PEERS[peer].sharing if dataset.several else ("none",):
                cell = dict(zip(KEY, (peer, name, sharing, seed), strict=True))
                if tuple(map(str, cell.values())) in done:
                    continue
                if not checked:
                    check(pythons)
                    checked = True
                if sets is None:
                    sets = dataset.load(seed, options.data_folder)
                    start = EVGPRegressor(n_inducing=dataset.n_inducing, sharing="all", max_iter=0, random_state=seed)
                    kernel = np.ravel(start.fit(sets.X, sets.Y).kernel_)[0]
                rows: Any = slice(None)
                if PEERS[peer].points == "rows" and len(sets.X) > SUBSET:
                    rows = np.random.RandomState(seed).choice(len(sets.X), SUBSET, replace=False)
                job = {
                    "X": sets.X[rows],
                    "Y": sets.Y[rows],
                    "X_test": sets.X_test,
                    "inducing_points": start.inducing_points_,
                    "lengthscales": np.broadcast_to(kernel.k2.length_scale, sets.X.shape[1]),
                    "noise": dataset.first_noise,
                    "sharing": sharing,
                    "max_iter": 0 if PEERS[peer].own_rule and not options.quick else dataset.max_iter,
                    "time_limit": options.time_limit,
                    "seed": seed,
                    "n_checkpoints": n_checkpoints if seed == 0 else 0,
                }
                row, curve = run(pythons[peer], peer, sets, job, cell)
                harness.append([row], output)
                if curve:
                    harness.append(curve, curves_output)
                print(f"{name}, seed {seed}: {peer}, {sharing}: {row['seconds']} s, {row['stop']}", flush=True)
    rows, curves = harness.frame(output), harness.frame(curves_output)
    if len(curves):
        plot(rows, curves, output.with_suffix(".png"))
    harness.write_page("skevgp against other libraries", tables_of(rows, curves), output)


if __name__ == "__main__":
    main()
