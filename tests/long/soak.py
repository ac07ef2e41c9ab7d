"""Fits, predictions, partial fits, rollouts, calibration and files, over and over in one process, which must end as it
began: no more memory, open files, threads, or files left behind.

    python -m tests.long.soak --minutes 60

Rounds are alike: the same jobs, each with data of its own but of the same shapes. After each round, garbage is
collected, free memory is given back to the system (``malloc_trim``, where there is one), and the resident set is read.
Caches and imports are filled in the first rounds, which do not count. Of those after them, it is a leak if the median
of the second half is above that of the first by more than SLACK, and the least of the second half above the most of
the first: a leak does both, fragments of freed memory come and go.
"""

import argparse
import ctypes
import gc
import os
import pickle
import tempfile
import threading
import time
import warnings
from contextlib import suppress
from pathlib import Path

import autograd.numpy as anp
import numpy as np
from sklearn.base import clone
from sklearn.gaussian_process.kernels import ConstantKernel, Matern
from sklearn.model_selection import cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from skevgp import BayesianMLPRegressor, EGPRegressor, EVGPRegressor, InverseDynamics, ResidualRegressor, rollout
from skevgp.features import InertiaForce, InertiaForceGravity
from skevgp.io import load, save
from skevgp.kernels import FunctionKernel
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS, Adam

# Bytes. Eleven rounds of a process that leaks nothing lay within 5 MB, the medians of their halves 1 MB apart. A leak
# of r bytes in each of n rounds moves these medians by r n / 2: of 30 rounds, one of 0.3 MB a round is seen.
SLACK = 4 * 2**20
WARM_UP = 3


def resident():
    """Bytes of the resident set; None where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


def give_back():
    """Free what can be freed."""
    for _ in range(3):
        gc.collect()
    with suppress(AttributeError, OSError, TypeError):  # of C libraries that have none
        ctypes.CDLL(None).malloc_trim(0)


def open_files():
    """What the process has open; None where the system does not say."""
    try:
        return sorted(os.readlink(entry) for entry in Path("/proc/self/fd").iterdir() if entry.exists())
    except OSError:
        return None


def data(rng, n=400):
    """A damped pendulum's steps: rows [q, q̇, u] and next states."""
    X = rng.uniform(-2, 2, (n, 3))
    acceleration = X[:, 2] - 9.81 * np.sin(X[:, 0]) - 0.1 * X[:, 1]
    Y = np.column_stack([X[:, 0] + 0.03 * X[:, 1], X[:, 1] + 0.03 * acceleration])
    return X, Y + 0.001 * rng.randn(n, 2)


def quadratic(X, Z, height=1.0):
    """A user's own covariance."""
    return (1.0 + height * anp.dot(X, Z.T)) ** 2


def fits(rng, folder):
    """All solvers, posteriors, kinds of noise and sharing."""
    X, Y = data(rng)
    groups = np.repeat(np.arange(8), 50)
    for options in (
        {},
        {"sharing": "none", "n_jobs": 2},
        {"solver": LBFGS(posterior="diagonal"), "sharing": "kernel"},
        {"noise": "student-t"},
        {"n_inducing": "auto", "solver": LBFGS(max_inducing=25)},
        {"solver": Adam(batch_size=50)},
        {"solver": Adam(posterior="diagonal")},
        {"solver": LBFGS(n_restarts=1), "kernel": ConstantKernel() * Matern([1.0, 1.0, 1.0], nu=2.5)},
        {"kernel": FunctionKernel(quadratic), "max_iter": 2},
        {"noise": Gaussian(inputs=0.01)},
    ):
        options = {"n_inducing": 15, "max_iter": 8, "random_state": rng.randint(1000), **options}
        model = EVGPRegressor(InertiaForceGravity("pendulum"), **options).fit(X, Y, groups=groups)
        model.predict(X, return_std=True)
        model.predict(X[:50], return_cov=True)
        model.sample_y(X[:20], 5)
        model.jacobian(X[:5])
        repr(model), model._repr_html_(), clone(model)


def others(rng, folder):
    """The other estimators, pipelines, cross-validation."""
    X, Y = data(rng, 120)
    exact = EGPRegressor(InertiaForce(), max_iter=10).fit(X, Y)
    exact.predict(X, return_std=True)
    ResidualRegressor(EVGPRegressor(n_inducing=10, max_iter=5, random_state=0)).fit(X, Y).predict(X)
    BayesianMLPRegressor((8,), max_iter=3, random_state=0).fit(X, Y).predict(X, return_std=True)
    torque = InverseDynamics("pendulum", n_inducing=5, max_iter=5, random_state=0).fit(X, Y[:, 1])
    torque.predict(X, return_std=True)
    pipeline = make_pipeline(StandardScaler(), PolynomialFeatures(1), EVGPRegressor(n_inducing=8, max_iter=5))
    cross_val_score(pipeline, X, Y, cv=3)


def partial_fits(rng, folder):
    """A model that goes on, with and without forgetting."""
    for forgetting_factor in (1.0, 0.9):
        model = EVGPRegressor(n_inducing=15, max_iter=5, random_state=0)
        for _ in range(10):
            model.partial_fit(*data(rng, 50), forgetting_factor=forgetting_factor)
            model.predict(data(rng, 5)[0], return_std=True)
        if not np.isfinite(model.lower_bound_):
            raise AssertionError("the bound is not finite")


def rollouts(rng, folder):
    X, Y = data(rng)
    model = EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=15, max_iter=10, random_state=0).fit(X, Y)
    for method in ("sample", "linearized", "mean"):
        rollout(model, [0.5, 0.0], np.zeros((20, 1)), method=method, n_samples=20, random_state=0)
    model.sample_functions(3, random_state=0)
    fast = model.compile()
    for row in X[:200]:
        fast.predict(row[np.newaxis], return_std=True)


def files(rng, folder):
    X, Y = data(rng, 100)
    model = EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=15, max_iter=5, random_state=0).fit(X, Y)
    path = folder / "model.skevgp"
    for _ in range(5):
        save(model, path)
        np.testing.assert_array_equal(load(path).predict(X), model.predict(X))
    pickle.loads(pickle.dumps(model))
    mapped = folder / "rows.npy"
    np.save(mapped, X)
    EVGPRegressor(n_inducing=10, max_iter=3, random_state=0).fit(np.load(mapped, mmap_mode="r"), Y)
    mapped.unlink()
    path.unlink()


JOBS = (fits, others, partial_fits, rollouts, files)


def state(folder):
    give_back()
    return {
        "resident": resident(),
        "open files": open_files(),
        "threads": threading.active_count(),
        "left behind": sorted(each.name for each in folder.iterdir()),
    }


def soak(seconds, tell=print):
    """States after each round; at least so many that halves can be compared."""
    states, rng, start = [], np.random.RandomState(0), time.monotonic()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder, before = Path(folder), tempfile.tempdir
        tempfile.tempdir = str(folder)  # temporary files of all that is called are seen
        try:
            while time.monotonic() - start < seconds or len(states) < WARM_UP + 4:
                for job in JOBS:
                    job(rng, folder)
                states.append(state(folder))
                size = states[-1]["resident"]
                tell(
                    f"round {len(states)}, {time.monotonic() - start:.0f} s: "
                    f"{'?' if size is None else f'{size / 2**20:.1f}'} MB, "
                    f"{len(states[-1]['open files'] or ())} open files, {states[-1]['threads']} threads, "
                    f"{len(states[-1]['left behind'])} files left"
                )
        finally:
            tempfile.tempdir = before
    return states


def leaks(states):
    """What is wrong, in words."""
    counted, found = states[WARM_UP:], []
    first, last = counted[0], counted[-1]
    if first["open files"] is not None:
        new = set(last["open files"]) - set(first["open files"])
        if len(last["open files"]) > len(first["open files"]):
            found.append(f"open files: {len(first['open files'])} became {len(last['open files'])}; new: {sorted(new)}")
    if last["threads"] > first["threads"]:
        found.append(f"threads: {first['threads']} became {last['threads']}")
    if last["left behind"]:
        found.append(f"files left behind: {last['left behind']}")
    sizes = [each["resident"] for each in counted]
    if None not in sizes:
        half = len(sizes) // 2
        early, late = sizes[:half], sizes[-half:]
        growth = np.median(late) - np.median(early)
        if growth > SLACK and min(late) > max(early):
            found.append(f"memory: {growth / 2**20:.1f} MB more in the second half")
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    states = soak(60.0 * parser.parse_args().minutes, lambda line: print(line, flush=True))
    sizes = np.array([each["resident"] or 0 for each in states[WARM_UP:]]) / 2**20
    half = len(sizes) // 2
    print(
        f"{len(states)} rounds; after {WARM_UP} of them, resident sets from {sizes.min():.1f} to {sizes.max():.1f} MB, "
    )
    print(f"median {np.median(sizes[:half]):.1f} MB in the first half, {np.median(sizes[-half:]):.1f} MB in the second")
    found = leaks(states)
    print("\n".join(found) or "no leak")
    raise SystemExit(bool(found))


if __name__ == "__main__":
    main()
