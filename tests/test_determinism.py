"""The same seed gives the same bits: again, for any number of threads, and in other processes."""

import json
import os
import subprocess
import sys
from functools import cache
from hashlib import sha256
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.gaussian_process.kernels import RBF, DotProduct, Matern
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from skevgp import BayesianMLPRegressor, CoefPrior, EGPRegressor, EVGPRegressor, ResidualRegressor, rollout
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS, Adam

pytestmark = [
    pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning"),
    pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning"),
]
RNG = np.random.RandomState(0)
N = 60
X, X_NEW = RNG.uniform(-2.0, 2.0, (N, 3)), RNG.uniform(-2.0, 2.0, (9, 3))
Y = np.column_stack([np.sin(2.0 * X[:, 0]), X[:, 0] * X[:, 1], np.cos(3.0 * X[:, 2])]) + 0.05 * RNG.randn(N, 3)


def evgp(*maps, **options):
    return EVGPRegressor(*maps, **{"n_inducing": 6, "max_iter": 3, "random_state": 0, **options})


THREADED = {
    "auto": evgp(),
    "all": evgp(PolynomialFeatures(1), sharing="all", kernel_map=StandardScaler()),
    "kernel": evgp(sharing="kernel", solver=LBFGS(posterior="diagonal")),
    "none": evgp(sharing="none", solver=LBFGS(n_restarts=1)),
    "groups": evgp(sharing=[[0, 2], [1]], kernel=RBF() + DotProduct(), inducing_init="greedy"),
    "shared weights": evgp(PolynomialFeatures(1), coef_prior=CoefPrior(shared=True), sharing="none"),
    "number of points": evgp(n_inducing="auto", solver=LBFGS(max_inducing=12)),
    "student-t": evgp(noise="student-t", sharing="none"),
    "noisy inputs": evgp(noise=Gaussian(inputs=0.1)),
    "adam": evgp(solver=Adam(batch_size=16)),
    "natural": evgp(solver=Adam(batch_size=16, natural_gradient=True), sharing="none"),
}
OTHERS = {
    "exact": EGPRegressor(PolynomialFeatures(1), Matern(nu=1.5), n_restarts=1, max_iter=3, random_state=0),
    "network": BayesianMLPRegressor((5,), max_iter=2, early_stopping=True, random_state=0),
    "residual": ResidualRegressor(evgp(sharing="all")),
}
ATTRIBUTES = ("coef_", "coef_cov_", "noise_variance_", "weights_", "loss_curve_", "lower_bound_", "upper_bound_")


def said_by(model):
    """All numbers that a fitted model gives, by name; those that come after new rows last."""
    found = {name: getattr(model, name) for name in ATTRIBUTES if hasattr(model, name)}
    found["mean"], found["std"] = model.predict(X_NEW, return_std=True)
    found["samples"] = model.sample_y(X_NEW, 2, random_state=1)
    for method in ("sample", "linearized"):
        found[method] = rollout(model, X_NEW[0], np.empty((3, 0)), n_samples=4, method=method, random_state=2).mean
    if hasattr(model, "inducing_points_"):
        points = model.inducing_points_
        found |= {f"points {i}": own for i, own in enumerate(points if isinstance(points, list) else [points])}
        found["functions"] = np.array(model.sample_functions(2, 3, n_waves=20)(X_NEW))
        found["jacobian"] = model.jacobian(X_NEW)
        model.partial_fit(X_NEW, Y[:9])
        found["after"], found["bound after"] = model.predict(X_NEW), model.lower_bound_
    return {name: np.asarray(values, dtype=float) for name, values in found.items()}


def assert_same(found, expected):
    assert found.keys() == expected.keys()
    for name, values in found.items():
        np.testing.assert_array_equal(values, expected[name], err_msg=name)


@pytest.mark.long
@pytest.mark.parametrize("name", THREADED)
def test_number_of_threads_changes_no_bit(name, monkeypatch):
    """With blocks so small that threads have something to do."""
    monkeypatch.setattr("skevgp.data.blocks._MIN_BLOCK_ROWS", 16)
    monkeypatch.setattr("skevgp.data.blocks._WORTH_THREADS", 0)
    monkeypatch.setattr("skevgp.data.blocks._BLOCK_NUMBERS", 16)
    one, many = (clone(THREADED[name]).set_params(n_jobs=n_jobs).fit(X, Y) for n_jobs in (None, 3))
    assert_same(said_by(many), said_by(one))


@pytest.mark.parametrize("name", ["none", "natural", *OTHERS])
def test_seed_and_a_random_state_with_that_seed_give_same_bits(name):
    model = (THREADED | OTHERS)[name]
    inner = "regressor__random_state" if name == "residual" else "random_state"
    one = said_by(clone(model).fit(X, Y))
    other = said_by(clone(model).set_params(**{inner: np.random.RandomState(0)}).fit(X, Y))
    assert_same(other, one)


@cache
def digests(names=("auto", "natural", "exact", "network")):
    """Of what models say."""
    found = {}
    for name in names:
        model = clone((THREADED | OTHERS)[name]).fit(X, Y)
        numbers = BytesIO()
        np.savez(numbers, **said_by(model))
        found[name] = sha256(numbers.getvalue()).hexdigest()
    return found


@pytest.mark.long
@pytest.mark.parametrize(("hash_seed", "threads"), [("0", "1"), ("random", "4")])
def test_other_processes_give_same_bits(hash_seed, threads):
    """Whatever the order of sets of strings, and the threads that BLAS may have."""
    code = f"import json, warnings, {__name__} as t; warnings.simplefilter('ignore'); print(json.dumps(t.digests()))"
    environment = os.environ | {
        "PYTHONHASHSEED": hash_seed,
        "PYTHONPATH": os.pathsep.join([path or "." for path in sys.path]),
        **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), threads),
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == digests()
