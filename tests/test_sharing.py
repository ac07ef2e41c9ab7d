"""Groups of outputs, as a user gives them or has them found: EVGPRegressor's ``sharing``."""

import pickle

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EVGPRegressor, ResidualRegressor
from skevgp.solvers import LBFGS

RNG = np.random.RandomState(0)
X, X_NEW = RNG.uniform(-2.0, 2.0, (120, 4)), RNG.uniform(-2.0, 2.0, (15, 4))


def targets(X):
    """Two smooth and two rough functions, of other sizes, in turns."""
    smooth = [np.sin(0.4 * X.sum(axis=1)), 100.0 * np.cos(0.4 * X[:, 0] - X[:, 1])]
    rough = [np.sin(4.0 * X[:, 0]) + X[:, 1], 0.01 * np.cos(4.0 * X[:, 0]) * X[:, 2]]
    return np.column_stack([smooth[0], rough[0], smooth[1], rough[1]])


Y = targets(X) + [0.01, 0.01, 1.0, 1e-4] * RNG.randn(120, 4)
GROUPS = [[0, 2], [1, 3]]
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def model(**parameters):
    return EVGPRegressor(**{"n_inducing": 10, "sharing": "all", "max_iter": 6, "random_state": 0} | parameters)


def assert_same(one, other, X_NEW=X_NEW):
    for found, expected in zip(one.predict(X_NEW, True), other.predict(X_NEW, True), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert one.lower_bound_ == other.lower_bound_


@pytest.mark.parametrize("feature_map", [None, PolynomialFeatures(1)], ids=["GP", "features"])
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
def test_the_same_groups_are_the_same_fit(sharing, other, feature_map):
    """However they are written down; "all" and "none" are groups too."""
    assert_same(*(model(sharing=own, feature_map=feature_map).fit(X, Y) for own in (sharing, other)))


def test_what_a_model_tells_is_in_the_order_of_the_outputs():
    fit = model(sharing=GROUPS, feature_map=PolynomialFeatures(1)).fit(X, Y)
    parts = [(own, model(feature_map=PolynomialFeatures(1)).fit(X, Y[:, own])) for own in GROUPS]
    assert fit.inducing_points_.shape == (4, 10, 4)
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


@pytest.mark.parametrize(("sharing", "groups"), [("all", [[0, 1, 2, 3]]), ("none", [[0], [1], [2], [3]])])
def test_every_fit_tells_its_groups(sharing, groups):
    assert model(sharing=sharing, max_iter=0).fit(X, Y).sharing_ == groups
    assert model(sharing=sharing, max_iter=0).fit(X, Y[:, 0]).sharing_ == [[0]]


def test_new_rows_go_to_each_group():
    fit = model(sharing=GROUPS).fit(X[:80], Y[:80])
    parts = [(own, model().fit(X[:80], Y[:80, own])) for own in GROUPS]
    fit.partial_fit(X[80:], Y[80:])
    for own, part in parts:
        expected = part.partial_fit(X[80:], Y[80:, own]).predict(X_NEW)
        np.testing.assert_allclose(fit.predict(X_NEW)[:, own], expected, rtol=1e-4, atol=1e-5)
    assert fit.sharing_ == GROUPS


@pytest.mark.parametrize("sharing", [GROUPS, "auto"], ids=str)
@pytest.mark.parametrize("noise_cv", [None, 3])
def test_threads_do_not_change_the_bits(sharing, noise_cv):
    assert_same(*(model(sharing=sharing, noise_cv=noise_cv, n_jobs=n).fit(X, Y) for n in (1, 3)))


def test_a_warm_start_goes_on_in_each_group():
    cold = model(sharing=GROUPS, max_iter=30, warm_start=True).fit(X, Y)
    bound = cold.lower_bound_
    assert cold.set_params(max_iter=1, sharing=GROUPS[::-1]).fit(X, Y).lower_bound_ >= bound - 1e-6 * abs(bound)
    assert cold.set_params(sharing="none", max_iter=0).fit(X, Y).lower_bound_ < bound


def test_copies_keep_the_groups():
    given = [[3, 1], [0, 2]]
    fit = model(sharing=given).fit(X, Y)
    assert fit.get_params()["sharing"] is given
    assert clone(fit).sharing == given == [[3, 1], [0, 2]]
    assert_same(pickle.loads(pickle.dumps(fit)), fit)
    fit.sharing_[0].append(7)
    assert fit.set_params(warm_start=True, max_iter=0).fit(X, Y).sharing_ == GROUPS


@pytest.mark.parametrize("sharing", [[[0, 1]], [[0, 1, 2], [3, 4]], [["a"], [1, 2, 3]], [0, 1, 2, 3]], ids=str)
def test_what_is_no_partition_is_named(sharing):
    fit = model().fit(X, Y)
    with pytest.raises(ValueError, match=r"sharing=\[.*must be 'all', 'kernel', 'none', 'auto' or a partition"):
        fit.set_params(sharing=sharing).fit(X, Y)
    assert fit.sharing_ == [[0, 1, 2, 3]]


def test_found_groups_are_those_of_like_kernels():
    x = np.linspace(-2.0, 2.0, 200)
    waves = np.column_stack([np.sin(x), np.sin(12.0 * x), 100.0 * np.cos(x), 0.01 * np.cos(12.0 * x)])
    waves += [0.01, 0.01, 1.0, 1e-4] * np.random.RandomState(1).randn(200, 4)
    auto = model(sharing="auto", n_inducing=40, noise_cv=None).fit(x[:, np.newaxis], waves)
    assert auto.sharing_ == GROUPS
    given = model(sharing=GROUPS, n_inducing=40, noise_cv=None).fit(x[:, np.newaxis], waves)
    np.testing.assert_array_equal(auto.predict(X_NEW[:, :1]), given.predict(X_NEW[:, :1]))
    assert clone(auto).sharing == "auto"


def test_each_group_finds_its_own_number_of_points():
    x = np.linspace(-2.0, 2.0, 200)
    waves = np.column_stack([np.sin(x), np.sin(12.0 * x), 100.0 * np.cos(x)])
    waves += [0.01, 0.01, 1.0] * np.random.RandomState(1).randn(200, 3)
    options = {"n_inducing": "auto", "solver": LBFGS(max_inducing=60), "max_iter": 30}
    auto = model(sharing="auto", **options).fit(x[:, np.newaxis], waves)
    assert auto.sharing_ == [[0, 2], [1]]
    smooth, rough, other = auto.inducing_points_
    assert len(smooth) < len(rough)
    np.testing.assert_array_equal(smooth, other)
    assert auto.lower_bound_ <= auto.upper_bound_
    given = model(sharing=auto.sharing_, **options).fit(x[:, np.newaxis], waves)
    assert_same(auto, given, x[:10, np.newaxis])


def test_nobody_is_told_of_the_fits_that_find_them(capsys):
    calls = []
    solver = LBFGS(callback=lambda *what: calls.append(what))
    fit = model(sharing="auto", verbose=2, solver=solver).fit(X, Y)
    assert len(calls) == len(capsys.readouterr().out.splitlines())
    for group in fit.sharing_:
        own = [iteration for iteration, _, outputs in calls if list(outputs) == group]
        assert own == list(range(1, len(own) + 1))
        assert own


def test_they_are_found_in_changes_of_a_state_too():
    auto = ResidualRegressor(model(sharing="auto")).fit(X, X + Y)
    given = ResidualRegressor(model(sharing=auto.regressor_.sharing_)).fit(X, X + Y)
    np.testing.assert_array_equal(auto.predict(X_NEW), given.predict(X_NEW))
