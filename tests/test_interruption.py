"""Ctrl-C at many places of a fit, of a prediction and of saving: nothing found is lost, nothing is half done."""

import pickle
import signal
import warnings
from functools import cache

import numpy as np
import pytest
from sklearn.base import clone
from threadpoolctl import threadpool_info

from skevgp import BayesianMLPRegressor, EGPRegressor, EVGPRegressor, ResidualRegressor, rollout
from skevgp.io import load, save
from skevgp.noise import Gaussian
from skevgp.solvers import Adam

from .interruption import interrupted_at

pytestmark = pytest.mark.long

RNG = np.random.RandomState(0)
X = RNG.uniform(-2.0, 2.0, (200, 2))
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1]]) + 0.05 * RNG.randn(200, 2)


def sparse(**parameters):
    return EVGPRegressor(**{"n_inducing": 8, "sharing": "all", "max_iter": 8, "random_state": 0, **parameters})


MODELS = {
    "lbfgs": sparse(),
    "adam": sparse(solver=Adam(batch_size=60)),
    "points": sparse(n_inducing="auto"),
    "calibration": sparse(noise_cv=4),
    "models": sparse(sharing="none"),
    "outliers": sparse(noise="student-t"),
    "input noise": sparse(noise=Gaussian(inputs=0.01)),
    "exact": EGPRegressor(max_iter=8),
    "network": BayesianMLPRegressor((4, 4), max_iter=8, random_state=0),
    "residual": ResidualRegressor(sparse()),
}
each_model = pytest.mark.parametrize("name", MODELS)


@cache
def fitted(name):
    """A fitted model, and how often functions of the package begin until its first iteration, and in all."""
    with interrupted_at() as places, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = clone(MODELS[name]).fit(X, Y)
    return model, places.index("Monitor.iteration") + 1, len(places)


def predictions(model):
    return np.array(model.predict(X[:5], return_std=True))


@each_model
def test_before_there_is_anything_to_keep_the_model_is_as_it_was(name):
    """Or it is kept as it starts, and said so."""
    model, first, _ = fitted(name)
    for n in np.linspace(1, first - 10, 3).astype(int):
        for estimator in (clone(MODELS[name]), pickle.loads(pickle.dumps(model))):
            before = dict(vars(estimator))
            if _fit(estimator, n) == "raised":
                assert vars(estimator) == before
            else:
                assert np.isfinite(predictions(estimator)).all()


@each_model
def test_from_the_first_iteration_on_the_best_so_far_is_kept(name):
    """Also where the fit is put together: what took hours is not lost in its last second."""
    _, first, last = fitted(name)
    libraries = threadpool_info()
    for n in np.unique(np.r_[np.linspace(first, last - 60, 4), np.linspace(max(first, last - 300), last - 60, 2)]):
        model = clone(MODELS[name])
        assert _fit(model, int(n)) == "kept", (n, first, last)
        assert np.isfinite(predictions(model)).all()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert threadpool_info() == libraries


def _fit(model, n):
    """Whether a fit with Ctrl-C at the n-th function kept what it had, and said so, or raised."""
    with interrupted_at(n) as places, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            model.fit(X, Y)
        except KeyboardInterrupt:
            return f"raised at {places[-1]}" if "Monitor.iteration" in places else "raised"
    return "kept" if any("interrupted" in str(warning.message) for warning in caught) else f"untold: {places[-1]}"


def test_file_is_replaced_or_as_it_was(tmp_path):
    model, path = fitted("lbfgs")[0], tmp_path / "model.skevgp"
    save(model, path)
    before = path.read_bytes()
    with interrupted_at() as places:
        save(fitted("exact")[0], path)
    path.write_bytes(before)
    for n in np.linspace(2, len(places) - 5, 6).astype(int):
        with interrupted_at(n), pytest.raises(KeyboardInterrupt):
            save(fitted("exact")[0], path)
        assert path.read_bytes() == before
        assert [file.name for file in tmp_path.iterdir()] == [path.name]
    np.testing.assert_array_equal(predictions(load(path)), predictions(model))


@pytest.mark.parametrize(
    "use",
    [
        lambda model: model.predict(X, return_std=True),
        lambda model: model.partial_fit(X, Y),
        lambda model: rollout(model, X[0], np.zeros((5, 0)), n_samples=3, random_state=0),
        lambda model: rollout(model, X[0], np.zeros((5, 0)), method="linearized"),
        lambda model: model.jacobian(X),
        lambda model: model.sample_y(X[:5]),
    ],
    ids=["predict", "partial_fit", "particles", "linearised", "jacobian", "sample_y"],
)
def test_interrupted_methods_keep_model(use):
    model = pickle.loads(pickle.dumps(fitted("lbfgs")[0]))
    before = predictions(model)
    other = pickle.loads(pickle.dumps(model))
    with interrupted_at() as places:
        use(other)
    for n in np.linspace(2, 0.5 * len(places), 5).astype(int):
        with interrupted_at(n), pytest.raises(KeyboardInterrupt):
            use(model)
        np.testing.assert_array_equal(predictions(model), before)
