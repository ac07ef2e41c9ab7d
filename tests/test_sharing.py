"""Groups of outputs, as a user gives them or has them found: EVGPRegressor's ``sharing``."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EVGPRegressor

RNG = np.random.RandomState(0)
X, X_NEW = RNG.uniform(-2.0, 2.0, (50, 4)), RNG.uniform(-2.0, 2.0, (15, 4))


def targets(X):
    """Two smooth and two rough functions, of other sizes, in turns."""
    smooth = [np.sin(0.4 * X.sum(axis=1)), 100.0 * np.cos(0.4 * X[:, 0] - X[:, 1])]
    rough = [np.sin(4.0 * X[:, 0]) + X[:, 1], 0.01 * np.cos(4.0 * X[:, 0]) * X[:, 2]]
    return np.column_stack([smooth[0], rough[0], smooth[1], rough[1]])


Y = targets(X) + [0.01, 0.01, 1.0, 1e-4] * RNG.randn(50, 4)
GROUPS = [[0, 2], [1, 3]]
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def model(**parameters):
    return EVGPRegressor(
        **{"n_inducing": 6, "sharing": "all", "max_iter": 3, "noise_cv": None, "random_state": 0} | parameters
    )


def assert_same(one, other, X_NEW=X_NEW):
    for found, expected in zip(one.predict(X_NEW, True), other.predict(X_NEW, True), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert one.lower_bound_ == other.lower_bound_


@pytest.mark.parametrize(
    "feature_map", [pytest.param(None, marks=pytest.mark.long), PolynomialFeatures(1)], ids=["GP", "features"]
)
@pytest.mark.parametrize(
    ("sharing", "other"),
    [
        ([[0, 1, 2, 3]], "all"),
        ([[3], [1], [0], [2]], "none"),
        ([[3, 1], [2, 0]], GROUPS),
        (np.array(GROUPS), ((0, 2), (1, 3))),
    ],
    ids=str,
)
def test_same_groups_are_the_same_fit(sharing, other, feature_map):
    """However they are written down; "all" and "none" are groups too."""
    assert_same(*(model(sharing=own, feature_map=feature_map).fit(X, Y) for own in (sharing, other)))


def test_attributes_are_in_order_of_outputs():
    fit = model(sharing=GROUPS, feature_map=PolynomialFeatures(1)).fit(X, Y)
    parts = [(own, model(feature_map=PolynomialFeatures(1)).fit(X, Y[:, own])) for own in GROUPS]
    assert fit.inducing_points_.shape == (4, 6, 4)
    assert fit.sharing_ == GROUPS
    for own, part in parts:
        for name in ("coef_", "coef_std_", "coef_cov_", "coef_prior_mean_", "coef_prior_scale_", "noise_variance_"):
            np.testing.assert_allclose(getattr(fit, name)[own], getattr(part, name), rtol=1e-5, atol=1e-9, err_msg=name)
        for o, points, kernel in zip(own, fit.inducing_points_[own], part.kernel_, strict=True):
            np.testing.assert_allclose(points, part.inducing_points_, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(fit.kernel_[o].theta, kernel.theta, rtol=1e-5, atol=1e-5)
            np.testing.assert_allclose(fit.kernel_[o].bounds, kernel.bounds, rtol=1e-9)
        for asked in ("return_std", "return_cov"):
            found, expected = fit.predict(X_NEW, **{asked: True}), part.predict(X_NEW, **{asked: True})
            np.testing.assert_allclose(found[0][:, own], expected[0], rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(found[1][..., own], expected[1], rtol=1e-4, atol=1e-6)
    assert fit.lower_bound_ == pytest.approx(sum(part.lower_bound_ for _, part in parts), rel=1e-6)
    assert fit.n_parameters_ == sum(part.n_parameters_ for _, part in parts)
    assert fit.n_iter_ == max(part.n_iter_ for _, part in parts)


@pytest.mark.parametrize("sharing", [[[0, 1]], [[0, 1, 2], [3, 4]], [["a"], [1, 2, 3]], [0, 1, 2, 3]], ids=str)
def test_invalid_partition_raises(sharing):
    fit = model(max_iter=0).fit(X, Y)
    with pytest.raises(ValueError, match=r"sharing=\[.*must be 'all', 'kernel', 'none', 'auto' or a partition"):
        fit.set_params(sharing=sharing).fit(X, Y)
    assert fit.sharing_ == [[0, 1, 2, 3]]


def test_found_groups_are_those_of_like_kernels():
    x = np.linspace(-2.0, 2.0, 100)
    waves = np.column_stack([np.sin(x), np.sin(12.0 * x), 100.0 * np.cos(x), 0.01 * np.cos(12.0 * x)])
    waves += [0.01, 0.01, 1.0, 1e-4] * np.random.RandomState(1).randn(100, 4)
    auto = model(sharing="auto", n_inducing=25).fit(x[:, np.newaxis], waves)
    assert auto.sharing_ == GROUPS
    given = model(sharing=GROUPS, n_inducing=25).fit(x[:, np.newaxis], waves)
    np.testing.assert_array_equal(auto.predict(X_NEW[:, :1]), given.predict(X_NEW[:, :1]))
    assert clone(auto).sharing == "auto"
