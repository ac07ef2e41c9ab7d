import pytest
from sklearn.linear_model import LinearRegression
from sklearn.utils import estimator_checks
from sklearn.utils.estimator_checks import parametrize_with_checks

from skevgp import BayesianMLPRegressor, EGPRegressor, EVGPRegressor, InverseDynamics, ResidualRegressor
from skevgp.features import (
    AngleEncoder,
    Friction,
    InertiaForce,
    InertiaForceGravity,
    LinkGravity,
    LogNormal,
    NominalDynamics,
    ParametricFeatures,
    RigidBodyRegressor,
)
from skevgp.solvers import LBFGS

from .theta import decay


class Decay:
    """A function whose text, and so the names of its tests, is the same in all processes."""

    def __call__(self, X, rate):
        return decay(X, rate)

    def __repr__(self):
        return "decay"


pytestmark = pytest.mark.long
MAPS = [
    AngleEncoder(),
    Friction(),
    InertiaForce(),
    InertiaForce(dt="column"),
    InertiaForceGravity(),
    LinkGravity(),
    NominalDynamics(),
    RigidBodyRegressor(),
    ParametricFeatures(Decay(), {"rate": LogNormal(0.1, 0.3)}),
]
RESIDUALS = [ResidualRegressor(LinearRegression()), ResidualRegressor(EVGPRegressor(n_inducing=5, random_state=0))]
# Its defaults take seconds per fit.
QUICK_NETWORK = BayesianMLPRegressor((10,), learning_rate_init=0.03, max_iter=500, tol=1e9)
SPARSE = [
    EVGPRegressor(),
    EVGPRegressor(noise_cv=3),
    EVGPRegressor(n_inducing="auto", solver=LBFGS(max_inducing=20)),
    EVGPRegressor(sharing="auto"),
    EVGPRegressor(noise="student-t"),
    EVGPRegressor(n_inducing=5, n_neighbors=5),
]
ESTIMATORS = [*SPARSE, EGPRegressor(), InverseDynamics(), QUICK_NETWORK, *RESIDUALS, *MAPS]


@parametrize_with_checks(ESTIMATORS)
def test_scikit_learns_checks(estimator, check, monkeypatch):
    # Without it scikit-learn skips check_array_api_input.
    monkeypatch.setenv("SCIPY_ARRAY_API", "1")
    check(estimator)


# What parametrize_with_checks leaves out, as scikit-learn's own test_common.py calls it.
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=str)
@pytest.mark.parametrize(
    "check",
    [
        estimator_checks.check_param_validation,
        estimator_checks.check_dataframe_column_names_consistency,
        estimator_checks.check_n_features_in_after_fitting,
    ],
)
def test_further_checks_of_estimators(estimator, check):
    check(type(estimator).__name__, estimator)


# They fit a data frame and transform an array, and the other way round.
@pytest.mark.filterwarnings("ignore:X (has|does not have valid) feature names:UserWarning")
@pytest.mark.parametrize("feature_map", MAPS, ids=str)
@pytest.mark.parametrize(
    "check",
    [
        estimator_checks.check_transformer_get_feature_names_out,
        estimator_checks.check_transformer_get_feature_names_out_pandas,
        estimator_checks.check_get_feature_names_out_error,
        estimator_checks.check_set_output_transform,
        estimator_checks.check_set_output_transform_pandas,
        estimator_checks.check_global_output_transform_pandas,
    ],
)
def test_further_checks_of_transformers(feature_map, check):
    check(type(feature_map).__name__, feature_map)
