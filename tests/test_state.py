"""What is in pickles: the version, and plain data."""

import copy
import pickle
import re
import warnings

import pytest
from sklearn.base import clone

import skevgp.utils.state
from skevgp import BayesianMLPRegressor, EGPRegressor, EVGPRegressor, InverseDynamics, ResidualRegressor, __version__
from skevgp.datasets import load_robot
from skevgp.exceptions import InconsistentVersionWarning
from skevgp.features import AngleEncoder, Friction, InertiaForce, LinkGravity, NominalDynamics, RigidBodyRegressor
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
    Friction(),
    InertiaForce(),
    LinkGravity(),
    NominalDynamics(),
    RigidBodyRegressor(),
]
each = pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda own: type(own).__name__)


@each
def test_version_is_in_the_state_and_not_in_the_estimator(estimator):
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


def test_robot_in_a_pickle_is_the_robot():
    robot = load_robot("acrobot")
    again = pickle.loads(pickle.dumps(NominalDynamics(robot)))
    assert again.robot == robot
    assert type(NominalDynamics(robot).__getstate__()["robot"]).__name__ == "RobotNumbers"
