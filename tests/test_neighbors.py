"""`EVGPRegressor(n_neighbors=...)`: a local part beside the inducing points."""

import pickle
import re
import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, ExpSineSquared, Matern, WhiteKernel
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor, ResidualRegressor, rollout
from skevgp.features import LogNormal, ParametricFeatures
from skevgp.io import load, save
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS, Adam

from .theta import decay

RNG = np.random.RandomState(0)
X = RNG.uniform(-2.0, 2.0, (500, 2))
X_NEW = RNG.uniform(-1.8, 1.8, (200, 2))


def waves(rows):
    return np.column_stack([np.sin(4.0 * rows[:, 0]) + rows[:, 1] ** 2, np.cos(5.0 * rows[:, 1]) * rows[:, 0]])


Y = waves(X) + 0.05 * RNG.randn(500, 2)
FIXED = ConstantKernel(1.3, "fixed") * RBF([0.5, 0.4], "fixed") + WhiteKernel(0.01, "fixed")
ROUGH = ConstantKernel(1.3, "fixed") * Matern([0.5, 0.4], "fixed", nu=0.5) + WhiteKernel(0.01, "fixed")


def rms(errors, axis=None):
    return np.sqrt(np.mean(np.square(errors), axis=axis))


def model(**arguments):
    return EVGPRegressor(**{"n_inducing": 15, "n_neighbors": 12, "random_state": 0, **arguments})


def at_once(**arguments):
    """A model whose kernel and noise are given."""
    return model(**{"kernel": FIXED, "max_iter": 0, "inducing_init": X_NEW[:15], **arguments})


@pytest.fixture(scope="module")
def fitted():
    # Whichever test comes first would warn.
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):
        return model(sharing="none", max_iter=20).fit(X[:200], Y[:200])


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_few_inducing_points_suffice(fitted):
    """Fifteen points alone explain little of these functions. Intervals are right too."""
    sparse = clone(fitted).set_params(n_neighbors=0).fit(X[:200], Y[:200])
    errors = [rms(own.predict(X_NEW) - waves(X_NEW)) for own in (fitted, sparse)]
    assert errors[0] < 0.25 * errors[1]
    y_new = waves(X_NEW) + 0.05 * np.random.RandomState(1).randn(200, 2)
    mean, std = fitted.predict(X_NEW, return_std=True)
    assert 0.9 < np.mean(np.abs(y_new - mean) < 1.96 * std) < 0.99
    assert_allclose(np.sqrt(fitted.noise_variance_), 0.05, rtol=0.4)


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"kernel": ROUGH},
        {"feature_map": PolynomialFeatures(1), "coef_prior": "auto"},
        {"kernel_map": StandardScaler(), "inducing_init": "greedy", "normalize_y": True},
    ],
    ids=["rbf", "rough", "features", "maps"],
)
def test_all_rows_as_neighbours_predict_as_the_exact_model(arguments):
    few, weights = slice(0, 80), RNG.randint(1, 3, 80)
    variances = np.exp(0.3 * RNG.randn(80))
    exact_arguments = {name: value for name, value in arguments.items() if name != "inducing_init"}
    local = at_once(n_neighbors=80, **arguments).fit(X[few], Y[few, 0], weights, relative_variance=variances)
    exact = EGPRegressor(**{"kernel": FIXED, "max_iter": 0, "random_state": 0} | exact_arguments)
    exact.fit(X[few], Y[few, 0], weights, relative_variance=variances)
    for include_noise in (True, False):
        found, expected = (own.predict(X_NEW, return_std=True, include_noise=include_noise) for own in (local, exact))
        assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    assert_allclose(
        local.predict(X_NEW[:20], return_cov=True)[1], exact.predict(X_NEW[:20], return_cov=True)[1], atol=1e-6
    )
    assert local.lower_bound_ == pytest.approx(exact.log_marginal_likelihood_value_, rel=1e-6)


@pytest.mark.parametrize("arguments", [{}, {"feature_map": PolynomialFeatures(2)}], ids=["plain", "features"])
def test_derivatives_and_covariance_agree_with_predictions(arguments):
    own = at_once(**arguments).fit(X, Y)
    rows, step = X_NEW[:9], 1e-5
    mean, jacobian, std, std_jacobian = own.value_and_jacobian(rows, return_std=True)
    predicted = own.predict(rows, return_std=True)
    assert_allclose([mean, std], predicted, rtol=1e-10)
    above, below = (
        [np.array(own.predict(rows + sign * step * e, return_std=True)) for e in np.eye(2)] for sign in (1.0, -1.0)
    )
    slopes = np.moveaxis((np.array(above) - np.array(below)) / (2.0 * step), 0, -1)
    assert_allclose(jacobian, slopes[0], atol=1e-5)
    assert_allclose(std_jacobian, slopes[1], atol=1e-5)
    assert_allclose(own.jacobian(rows), jacobian)
    _, covariance = own.predict(rows, return_cov=True)
    assert_allclose(np.sqrt(np.einsum("iio->io", covariance)), std)
    # Rows close to each other have errors that are alike.
    near = np.array([[0.3, 0.2], [0.31, 0.2], [-1.0, 1.0]])
    _, covariance = own.predict(near, return_cov=True, include_noise=False)
    correlation = covariance[:, :, 0] / np.sqrt(np.outer(*[np.diagonal(covariance[:, :, 0])] * 2))
    assert correlation[0, 1] > 0.9 > abs(correlation[0, 2])


def test_summary_says_that_the_likelihood_is_no_bound(fitted):
    text = str(fitted.summary())
    assert "15 inducing points and 12 neighbours, for 2 outputs" in text
    assert f"log likelihood of the approximation: {fitted.lower_bound_:.2f} nats" in text
    assert fitted.upper_bound_ == np.inf


def test_samples_have_the_moments_of_predictions(fitted):
    mean, std = fitted.predict(X_NEW[:6], return_std=True)
    samples = fitted.sample_y(X_NEW[:6], 4000, random_state=0)
    assert_allclose(samples.mean(axis=2), mean, atol=5.0 * std.max() / np.sqrt(4000))
    assert_allclose(samples.std(axis=2), std, rtol=0.06)


def test_paths_are_functions_of_the_posterior():
    """Their values have the moments of predictions. A function that comes back to a row has the same value there."""
    own = at_once().fit(X, Y)
    rows = np.repeat(X_NEW[:2], 1000, axis=0)
    step = own._posterior.functions().draw(2000, 3, np.random.RandomState(0))
    first, _, again = step(rows), step(rows + 0.3), step(rows)
    assert_allclose(again, first, atol=1e-4)
    mean, std = own.predict(X_NEW[:2], return_std=True, include_noise=False)
    values = first.reshape(2, 1000, 2)
    assert_allclose(values.mean(axis=1), mean, atol=5.0 * std.max() / np.sqrt(1000))
    assert_allclose(values.std(axis=1), std, rtol=0.1)


@pytest.mark.parametrize("method", ["sample", "linearized", "mean"])
def test_rollout(method):
    z, u = RNG.uniform(-1.0, 1.0, (300, 1)), RNG.uniform(-1.0, 1.0, (300, 1))
    own = at_once(inducing_init="auto").fit(np.hstack([z, u]), 0.5 * np.sin(3.0 * z) + u**2)
    found = rollout(own, [0.3], np.full((4, 1), 0.2), method=method, random_state=0)
    mean, std = own.predict([[0.3, 0.2]], return_std=True)
    assert_allclose(found.mean[1], mean, atol=1.0 * std[0])
    assert np.isfinite(found.mean).all()


def test_partial_fit_is_a_fit_of_all_rows_in_this_order():
    all_rows = at_once().fit(X, Y)
    parts = at_once().fit(X[:300], Y[:300])
    parts.partial_fit(X[300:], Y[300:])
    # The order of rows differs, and with it the earlier rows on which each is conditioned.
    assert_allclose(parts.predict(X_NEW), all_rows.predict(X_NEW), atol=0.05)
    few, first, rest = slice(0, 100), slice(0, 60), slice(60, 100)
    exact = at_once(n_neighbors=100).fit(X[few], Y[few])
    growing = at_once(n_neighbors=100).fit(X[first], Y[first]).partial_fit(X[rest], Y[rest])
    assert_allclose(growing.predict(X_NEW, return_std=True), exact.predict(X_NEW, return_std=True), atol=1e-7)


def test_further_rows_of_an_exact_model_are_conditioned_too():
    """As many inducing points as rows need no local part. Further rows do."""
    own = at_once(n_neighbors=100, n_inducing=40, inducing_init="auto").fit(X[:40], Y[:40, 0])
    own.partial_fit(X[40:100], Y[40:100, 0])
    exact = EGPRegressor(kernel=FIXED, max_iter=0).fit(X[:100], Y[:100, 0])
    assert_allclose(own.predict(X_NEW, return_std=True), exact.predict(X_NEW, return_std=True), atol=1e-6)


def test_forgetting_raises():
    with pytest.raises(ValueError, match="n_neighbors=12, partial_fit needs forgetting_factor=1; got forgetting_fac"):
        at_once().fit(X, Y).partial_fit(X, Y, forgetting_factor=0.9)


# So few rows do not tell the rate, whose feature is almost a straight line.
UNIDENTIFIED = pytest.mark.filterwarnings("ignore::skevgp.exceptions.UnidentifiedWarning")
PARAMETERS = pytest.param("parameters", marks=UNIDENTIFIED)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("case", ["offset", "smooth output", "shared weights", PARAMETERS])
def test_details_are_found_whatever_is_beside_them(case):
    """The sparse fit takes the details of the first output for noise. The start of the local fit must not.

    (Eight points take them for noise at 200 rows, and 15 points at 500 rows if the outputs have one kernel.)
    """
    y, smooth = Y[:, 0], 0.5 * X[:, 1] ** 2 + 0.1 * np.random.RandomState(1).randn(500)
    both, few = np.column_stack([y, smooth]), slice(0, 200)
    if case == "offset":
        mean = model(n_inducing=8, noise_cv=None).fit(X[few], y[few] + 30.0).predict(X_NEW) - 30.0
    elif case == "smooth output":
        mean = model(n_neighbors=8, sharing="kernel", max_iter=30, noise_cv=None).fit(X, both).predict(X_NEW)[:, 0]
    elif case == "shared weights":
        weights = {"feature_map": PolynomialFeatures(1), "coef_prior": CoefPrior(shared=True)}
        shared = model(**weights, n_inducing=8, n_neighbors=8, sharing="none", noise_cv=None)
        mean = shared.fit(X[few], both[few]).predict(X_NEW)[:, 0]
    else:
        decaying = ParametricFeatures(decay, {"rate": LogNormal(0.1, 0.3)})
        own = model(feature_map=decaying, n_inducing=8, n_neighbors=8, noise_cv=None).fit(X[few], y[few])
        mean = own.partial_fit(X[:5], y[:5]).predict(X_NEW)
    assert rms(mean - waves(X_NEW)[:, 0]) < 0.2


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_copies_and_files_predict_the_same(fitted, tmp_path):
    save(fitted, tmp_path / "model.skevgp")
    expected = fitted.predict(X_NEW, return_std=True)
    for copy in (pickle.loads(pickle.dumps(fitted)), load(tmp_path / "model.skevgp")):
        assert_array_equal(copy.predict(X_NEW, return_std=True), expected)
        copy.partial_fit(X_NEW[:3], waves(X_NEW[:3]))
        assert np.isfinite(copy.predict(X_NEW)).all()
    options = {"n_neighbors": 6, "sharing": "none", "max_iter": 2}
    alone, threads = (model(n_jobs=n_jobs, **options).fit(X[:30], Y[:30]) for n_jobs in (None, 2))
    assert_allclose(threads.predict(X_NEW, return_std=True), alone.predict(X_NEW, return_std=True), rtol=1e-9)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_intervals_hold_on_new_trajectories():
    """Rows of a trajectory are left out together. Few inducing points cannot represent this function."""

    def walks(seed, n, length):
        rng = np.random.RandomState(seed)
        t = np.linspace(0.0, 1.0, length)[:, np.newaxis]
        rows = np.vstack([rng.uniform(-2.0, 2.0, 2) + t * rng.uniform(-1.0, 1.0, 2) for _ in range(n)])
        return rows, np.sin(4.0 * rows[:, 0]) * np.cos(3.0 * rows[:, 1]) + 0.01 * rng.randn(n * length)

    (rows, y), (rows_new, y_new), groups = walks(5, 15, 14), walks(105, 20, 60), np.repeat(np.arange(15), 14)
    local, sparse = (model(n_inducing=12, n_neighbors=k, max_iter=10).fit(rows, y, groups=groups) for k in (12, 0))
    (mean, std), (sparse_mean, _) = (own.predict(rows_new, return_std=True) for own in (local, sparse))
    assert np.mean((mean - y_new) ** 2) < 0.8 * np.mean((sparse_mean - y_new) ** 2)
    assert np.mean(np.abs(mean - y_new) < 1.96 * std) > 0.85


NASTY = {
    "one row": (X[:1], Y[:1]),
    "two rows": (X[:2], Y[:2]),
    "fewer rows than neighbours": (X[:9], Y[:9]),
    "duplicates": (np.repeat(X[:12], 3, axis=0), np.repeat(waves(X[:12])[:, :1], 3, axis=0)),
    "contradicting duplicates": (np.repeat(X[:12], 3, axis=0), RNG.randn(36, 1)),
    "no noise": (X[:30], waves(X[:30])),
    "constant column": (np.column_stack([X[:30], np.ones(30)]), Y[:30, :1]),
    "constant X": (np.ones((30, 2)), Y[:30]),
    "constant y": (X[:30], np.ones((30, 1))),
    "far": (1e6 + X[:30], 1e6 + Y[:30, :1]),
    "tiny": (1e-9 * X[:30], 1e9 * Y[:30, :1]),
}


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("name", NASTY)
def test_nasty_data_end_right(name):
    rows, y = NASTY[name]
    # "auto" would make trial fits of each, which take most of the time.
    sharing = "auto" if name == "no noise" else "none"
    own = model(n_inducing=8, max_iter=10, normalize_y=True, sharing=sharing).fit(rows, y)
    mean, std = own.predict(rows, return_std=True)
    assert np.isfinite(mean).all()
    assert np.isfinite(std).all()
    assert (std >= 0.0).all()
    # No worse than the mean of y, by more than chance.
    error = rms(mean.reshape(y.shape) - y)
    assert error <= 1.05 * rms(y - y.mean(axis=0)) + 1e-9 * np.abs(y).max()


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize(
    "kernel", [Matern(nu=0.5), Matern(nu=1.5), RBF([1.0, 1.0]) + DotProduct(), DotProduct(), None], ids=str
)
def test_kernels(kernel):
    # One case as users fit it. Others without what is the same for all kernels.
    options, n_outputs = ({}, 2) if kernel is None else ({"noise_cv": None, "kernel": 1.0 * kernel}, 1)
    own = model(**options, n_neighbors=6, sharing="none", max_iter=3).fit(X[:40], Y[:40, :n_outputs])
    assert np.isfinite(own.predict(X_NEW, return_std=True)).all()


def test_neighbours_of_a_periodic_function_are_those_of_all_periods():
    x = np.linspace(0.0, 20.0, 300)[:, np.newaxis]
    kernel = ConstantKernel(1.0, "fixed") * ExpSineSquared(0.3, 2.0, "fixed", "fixed") + WhiteKernel(0.25, "fixed")
    y = np.sign(np.sin(np.pi * x[:, 0])) + 0.5 * RNG.randn(300)
    own = EVGPRegressor(kernel=kernel, n_inducing=2, n_neighbors=40, max_iter=0, random_state=0).fit(x, y)
    # Neighbours of one period only would leave three times as large a variance.
    exact = EGPRegressor(kernel=kernel, max_iter=0).fit(x, y)
    std, expected = (one.predict(x, return_std=True, include_noise=False)[1].mean() for one in (own, exact))
    assert std < 1.3 * expected


@pytest.mark.parametrize("n_neighbors", [-1, 1.5, "all"])
def test_invalid_number_raises(n_neighbors):
    with pytest.raises((ValueError, TypeError), match="n_neighbors"):
        model(n_neighbors=n_neighbors).fit(X, Y)


@pytest.mark.parametrize(
    "arguments",
    [
        {"solver": Adam()},
        {"solver": LBFGS(posterior="diagonal")},
        {"noise": "student-t"},
        {"noise": Gaussian(inputs=0.1)},
        {"discrepancy": "orthogonal", "feature_map": PolynomialFeatures(1)},
    ],
    ids=str,
)
def test_what_is_not_supported_raises(arguments):
    with pytest.raises(ValueError, match="n_neighbors=12 does not support .*Use n_neighbors=0"):
        model(**arguments).fit(X, Y)


@pytest.mark.parametrize(
    "name", ["compile", "to_casadi", "to_c", "to_l4acados", "sample_functions", "predict_gradient"]
)
def test_what_needs_a_smooth_model_names_the_argument(name, fitted, tmp_path):
    arguments = {"predict_gradient": (X_NEW,), "to_c": (tmp_path / "model.c",)}.get(name, ())
    with pytest.raises(ValueError, match="needs a smooth model of fixed size. Fit the model with n_neighbors=0"):
        getattr(fitted, name)(*arguments)


def test_residuals_of_columns_of_X():
    own = ResidualRegressor(at_once(), base=[0, 1]).fit(X, Y + X)
    assert rms(own.predict(X_NEW) - waves(X_NEW) - X_NEW) < 0.1
    assert own.jacobian(X_NEW[:3]).shape == (3, 2, 2)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_summary_of_a_sparse_fit_says_what_neighbours_would_gain():
    """Also if the sparse fit takes the waves for noise, with long length scales."""
    rng = np.random.RandomState(1)
    rows, rows_new = rng.uniform(-2.0, 2.0, (3000, 2)), rng.uniform(-2.0, 2.0, (300, 2))
    y, y_new = (waves(some)[:, 0] + 0.05 * rng.randn(len(some)) for some in (rows, rows_new))
    learned = EVGPRegressor(n_inducing=5, max_iter=3, noise_cv=None, random_state=0)
    given = clone(learned).set_params(kernel=FIXED, n_inducing=8)
    # Kernel and noise are right: there is nothing to learn.
    near = clone(given).set_params(n_neighbors=60, max_iter=0)
    after = rms(near.fit(rows, y).predict(rows_new) - y_new)
    for model in (learned, given):
        before = rms(model.fit(rows, y).predict(rows_new) - y_new)
        said = float(re.search(r"would lower the error by at least about (\d+) %", str(model.summary()))[1]) / 100.0
        # It is a lower limit, up to what 500 and 300 rows know of an error.
        assert 0.5 < said < 1.0 - after / before + 0.05
    for others in ({"n_inducing": 150}, {"n_neighbors": 5}, {"noise": "student-t"}, {"solver": Adam()}):
        assert "would" not in str(clone(given).set_params(**others).fit(rows, y).summary())
    assert "would" not in str(clone(given).fit(rows, y, groups=np.arange(3000) % 7).summary())
    assert "would" not in str(learned.partial_fit(rows_new, y_new).summary())
