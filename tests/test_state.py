"""What is in pickles: the version, and plain data."""

import copy
import pickle
import re
import warnings

import joblib
import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.preprocessing import StandardScaler

import skevgp.utils.state
from skevgp import BayesianMLPRegressor, EGPRegressor, EVGPRegressor, InverseDynamics, ResidualRegressor, __version__
from skevgp.datasets import load_robot
from skevgp.exceptions import InconsistentVersionWarning
from skevgp.features import AngleEncoder, InertiaForce, LinkGravity, NominalDynamics, RigidBodyRegressor
from skevgp.solvers import LBFGS, Adam

ESTIMATORS = [
    EVGPRegressor(),
    EGPRegressor(),
    ResidualRegressor(EVGPRegressor()),
    BayesianMLPRegressor(),
    InverseDynamics(),
    LBFGS(),
    Adam(),
    AngleEncoder(),
    InertiaForce(),
    LinkGravity(),
    NominalDynamics(),
    RigidBodyRegressor(),
]
each = pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda own: type(own).__name__)


@each
def test_the_version_is_in_the_state_and_not_in_the_estimator(estimator):
    assert estimator.__getstate__()["_skevgp_version"] == __version__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = pickle.loads(pickle.dumps(estimator))
    assert vars(again).keys() == vars(estimator).keys()
    assert "_skevgp_version" not in vars(clone(copy.deepcopy(again)))


@each
def test_another_version_is_warned_of(estimator, monkeypatch):
    data = pickle.dumps(estimator)
    monkeypatch.setattr(skevgp.utils.state, "__version__", "99.0")
    message = rf"{type(estimator).__name__} is a pickle of skevgp {__version__}, and this is 99\.0"
    # What is inside may be warned of too.
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pickle.loads(data)
    assert {one.category for one in caught} == {InconsistentVersionWarning}
    assert any(re.match(message, str(one.message)) for one in caught)
    assert caught[0].filename == __file__


def test_pickles_without_a_version_are_older():
    model = EVGPRegressor.__new__(EVGPRegressor)
    with pytest.warns(InconsistentVersionWarning, match=r"of skevgp \(version unknown\), and this is"):
        model.__setstate__({"n_inducing": 7})
    assert model.n_inducing == 7


class Derived(EVGPRegressor):
    pass


def test_classes_of_users_have_versions_of_their_own():
    assert "_skevgp_version" not in Derived().__getstate__()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pickle.loads(pickle.dumps(Derived(n_inducing=3)))


def test_a_robot_in_a_pickle_is_the_robot():
    robot = load_robot("acrobot")
    again = pickle.loads(pickle.dumps(NominalDynamics(robot)))
    assert again.robot == robot
    assert type(NominalDynamics(robot).__getstate__()["robot"]).__name__ == "RobotNumbers"


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_frames_in_pickles_are_arrays():
    X = pd.DataFrame({"a": np.linspace(0.0, 1.0, 30), "b": np.linspace(1.0, 0.0, 30) ** 2})
    model = EVGPRegressor(kernel_map=StandardScaler(), n_inducing=5, max_iter=2, random_state=0).fit(X, X["a"])
    assert b"pandas.core" not in pickle.dumps(model)
    again = pickle.loads(pickle.dumps(model))
    pd.testing.assert_frame_equal(again._posterior.maps.example, model._posterior.maps.example)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_joblib_keeps_the_model(tmp_path):
    X = np.random.RandomState(0).uniform(-2.0, 2.0, (40, 2))
    model = EVGPRegressor(InertiaForce(), n_inducing=5, max_iter=2, random_state=0).fit(X, np.sin(X[:, 0]))
    joblib.dump(model, tmp_path / "model.joblib", compress=3)
    again = joblib.load(tmp_path / "model.joblib")
    for found, expected in zip(again.predict(X, return_std=True), model.predict(X, return_std=True), strict=True):
        np.testing.assert_array_equal(found, expected)
