"""``sample_weight`` and ``relative_variance`` of all estimators."""

import warnings

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler

from skevgp import BayesianMLPRegressor, CoefPrior, EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.solvers import LBFGS, Adam

# A few iterations are enough to compare.
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")

RNG = np.random.RandomState(0)
N = 40
X = RNG.uniform(-2.0, 2.0, (N, 2))
Y = np.column_stack([np.sin(2.0 * X[:, 0]) + X[:, 1], X[:, 0] * X[:, 1]]) + 0.1 * RNG.randn(N, 2)
X_NEW = RNG.uniform(-2.0, 2.0, (30, 2))
WEIGHTS = RNG.randint(0, 4, N)
AGAIN = RNG.permutation(np.repeat(np.arange(N), WEIGHTS))
NOISE = np.exp(RNG.randn(N))


def evgp(**parameters):
    return EVGPRegressor(**{"n_inducing": 9, "max_iter": 3, "sharing": "all", "random_state": 0, **parameters})


MODELS = {
    "plain": evgp(sharing="auto"),
    "scaled": evgp(feature_map=PolynomialFeatures(1), kernel_map=StandardScaler(), normalize_y=True),
    "pipeline": evgp(feature_map=make_pipeline(FunctionTransformer(np.tanh))),
    "not stationary": evgp(kernel=RBF() + DotProduct(), sharing="kernel"),
    "diagonal": evgp(solver=LBFGS(posterior="diagonal"), sharing="none"),
    "all rows": evgp(n_inducing=200),
    "auto": evgp(n_inducing="auto", solver=LBFGS(max_inducing=12), noise_cv=None),
    "adam": evgp(solver=Adam(batch_size=16), max_iter=10),
    "natural": evgp(solver=Adam(batch_size=16, natural_gradient=True), max_iter=10),
    "exact": EGPRegressor(PolynomialFeatures(1), max_iter=2),
    "vague": EGPRegressor(PolynomialFeatures(1), coef_prior=CoefPrior(scale=np.inf), max_iter=2, normalize_y=True),
    "network": BayesianMLPRegressor((8,), max_iter=5, random_state=0),
    "early": BayesianMLPRegressor((8,), max_iter=5, early_stopping=True, random_state=0),
    "residual": ResidualRegressor(evgp()),
}
of_all = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)


def value_of(model):
    """What the fit maximised, if it is known for all rows."""
    for name in ("lower_bound_", "log_marginal_likelihood_value_"):
        if hasattr(model, name):
            return getattr(model, name)
    return 0.0


def assert_same(one, other, rtol=1e-7):
    assert value_of(one) == pytest.approx(value_of(other), rel=rtol)
    for found, expected in zip(one.predict(X_NEW, return_std=True), other.predict(X_NEW, return_std=True), strict=True):
        np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol)


@of_all
def test_weights_of_0_and_2_are_rows_removed_and_repeated(model):
    weighted = clone(model).fit(X, Y, sample_weight=WEIGHTS)
    assert_same(weighted, clone(model).fit(X[AGAIN], Y[AGAIN]))
    # They matter.
    assert np.abs(weighted.predict(X_NEW) - clone(model).fit(X, Y).predict(X_NEW)).max() > 1e-4


@pytest.mark.parametrize("kind", [EVGPRegressor, EGPRegressor])
def test_variance_that_all_rows_have_is_only_a_unit(kind):
    """Far beyond what the least noise in units of the targets would allow."""
    rng = np.random.RandomState(0)
    rows = rng.randn(40, 2)
    y = rows @ [1.0, 2.0] + 0.1 * rng.randn(40)
    model = kind(PolynomialFeatures(1), max_iter=10)
    models = [clone(model).fit(rows, y, relative_variance=np.full(40, v)) for v in (1.0, 1e-100, 1e24, 1e100)]
    bounds = [getattr(m, "lower_bound_" if kind is EVGPRegressor else "log_marginal_likelihood_value_") for m in models]
    np.testing.assert_allclose(bounds, bounds[0], atol=0.1)


def test_known_noise_is_the_alpha_of_scikit_learn():
    kernel = ConstantKernel(1.7) * RBF([0.8, 1.3])
    exact = GaussianProcessRegressor(kernel, alpha=0.1 * NOISE, optimizer=None).fit(X, Y[:, 0])
    expected = exact.predict(X_NEW, return_std=True)
    for estimator in (EGPRegressor, EVGPRegressor):
        own = estimator(kernel=kernel + WhiteKernel(1.0, "fixed"), max_iter=0)
        if estimator is EVGPRegressor:
            own.set_params(n_inducing=N)
        own.fit(X, Y[:, 0], relative_variance=0.1 * NOISE)
        np.testing.assert_allclose(own.predict(X_NEW, return_std=True, include_noise=False), expected, rtol=1e-6)
        assert value_of(own) == pytest.approx(exact.log_marginal_likelihood(), rel=1e-8)


def test_likelihood_of_other_kernels_sees_the_weights_of_the_fit():
    exact = EGPRegressor(max_iter=5).fit(X, Y[:, 0], WEIGHTS, relative_variance=NOISE)
    found = exact.log_marginal_likelihood(exact.kernel_.theta)
    assert found == pytest.approx(exact.log_marginal_likelihood_value_, rel=1e-8)


# --- large and foreign data ----------------------------------------------------------------------------------------


def at_fixed_points(**parameters):
    return evgp(inducing_init=X_NEW[:9], max_iter=0, **parameters)


@pytest.mark.parametrize("posterior", ["full", "diagonal"])
def test_partial_fit_with_weights_is_one_pass(posterior):
    first, rest = slice(0, 20), slice(20, None)

    def fitted_to(rows):
        model = evgp(solver=LBFGS(posterior=posterior), max_iter=5).fit(X[first], Y[first], NOISE[first])
        for part in rows:
            model.partial_fit(X[part], Y[part], WEIGHTS[part], relative_variance=NOISE[part])
        return model

    at_once, in_parts = fitted_to([rest]), fitted_to([slice(20, 30), slice(30, None)])
    assert_same(at_once, in_parts)
    repeated = evgp(solver=LBFGS(posterior=posterior), max_iter=5).fit(X[first], Y[first], NOISE[first])
    rows = np.repeat(np.arange(20, N), WEIGHTS[rest])
    assert_same(at_once, repeated.partial_fit(X[rows], Y[rows], relative_variance=NOISE[rows]))
    begun = evgp(solver=LBFGS(posterior=posterior), max_iter=5).partial_fit(X[first], Y[first], NOISE[first])
    assert_same(begun, evgp(solver=LBFGS(posterior=posterior), max_iter=5).fit(X[first], Y[first], NOISE[first]))


def test_partial_fit_after_an_exact_fit_does_not_depend_on_the_unit_of_variances():
    def predicted(unit):
        model = EVGPRegressor(n_inducing=N, max_iter=15, random_state=0)
        model.fit(X[:20], X[:20, 0] ** 2, relative_variance=np.full(20, unit))
        return model.partial_fit(X[20:], X[20:, 0] ** 2, relative_variance=np.full(N - 20, unit)).predict(X)

    expected = predicted(1.0)
    for unit in (1e-8, 1e8):
        np.testing.assert_allclose(predicted(unit), expected, atol=1e-3)


@pytest.mark.parametrize("as_dask", [True, False])
def test_dask(as_dask):
    import dask.array as da

    order = np.lexsort(X.T[::-1])
    x, y, w, v = X[order], Y[order], WEIGHTS[order].astype(float), NOISE[order]
    w[:13] = 0.0  # a whole chunk
    weights = (w, v) if not as_dask else (da.from_array(w, chunks=15), da.from_array(v, chunks=20))
    chunks = da.from_array(x, chunks=(13, 2)), da.from_array(y, chunks=(13, 2))
    expected = evgp().fit(x, y, w, relative_variance=v)
    # The sums' rounding is another, and so is where the iterations end.
    assert_same(evgp().fit(*chunks, weights[0], relative_variance=weights[1]), expected, rtol=1e-5)
    updated = at_fixed_points().fit(*chunks).partial_fit(*chunks, weights[0], relative_variance=weights[1])
    assert_same(updated, at_fixed_points().fit(x, y).partial_fit(x, y, w, relative_variance=v))
    for bad, message in ((-w, "sample_weight"), (0.0 * w, "zero"), (w[:5], "shape")):
        with pytest.raises(ValueError, match=message):
            evgp().fit(*chunks, bad)
    with pytest.raises(ValueError, match="relative_variance must be positive"):
        evgp().fit(*chunks, relative_variance=w)


# --- maps -----------------------------------------------------------------------------------------------------------


class Recorder(FunctionTransformer):
    """Remembers what it was fitted to."""

    def fit(self, X, y=None):
        self.seen_ = np.asarray(X)
        return super().fit(X, y)


class Weighing(FunctionTransformer):
    def fit(self, X, y=None, sample_weight=None):
        self.weights_ = sample_weight
        return super().fit(X, y)


def test_maps_see_the_rows_that_count_and_how_often_if_they_ask():
    model = evgp(feature_map=Recorder(), kernel_map=Weighing(), max_iter=0).fit(X, Y, WEIGHTS)
    assert {tuple(row) for row in model.feature_map_.seen_} == {tuple(row) for row in X[WEIGHTS > 0]}
    np.testing.assert_array_equal(np.sort(model.kernel_map_.weights_), np.sort(WEIGHTS[WEIGHTS > 0]))
    repeated = evgp(feature_map=Recorder(), kernel_map=Weighing(), max_iter=0).fit(X[AGAIN], Y[AGAIN])
    assert len(repeated.feature_map_.seen_) == len(AGAIN)
    np.testing.assert_array_equal(repeated.kernel_map_.weights_, model.kernel_map_.weights_)
    plain = evgp(feature_map=Recorder(), kernel_map=Weighing(), max_iter=0).fit(X, Y)
    assert plain.kernel_map_.weights_ is None
    assert len(plain.feature_map_.seen_) == N


# --- bad input -------------------------------------------------------------------------------------------------------

EACH = {"EVGP": evgp(max_iter=1), "EGP": EGPRegressor(max_iter=1), "network": BayesianMLPRegressor((3,), max_iter=1)}


@pytest.mark.parametrize("model", EACH.values(), ids=EACH)
@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (-np.ones(N), "sample_weight must be finite, not negative .* -1"),
        (np.full(N, np.nan), "sample_weight must be finite"),
        (np.full(N, np.inf), "sample_weight must be finite"),
        (np.zeros(N), "sample_weight must be above 0 .* zero"),
        (np.ones(N - 1), r"sample_weight must have the shape \(n_samples,\) = \(40,\); got \(39,\)"),
        (np.ones((N, 1)), "sample_weight must have the shape"),
        (2.0, "sample_weight must have the shape"),
        (["a"] * N, "sample_weight must be real numbers"),
    ],
    ids=range(8),
)
def test_invalid_weights(model, weights, message):
    with pytest.raises(ValueError, match=message):
        clone(model).fit(X, Y, sample_weight=weights)


@pytest.mark.parametrize("model", [EACH["EVGP"], EACH["EGP"]], ids=["EVGP", "EGP"])
@pytest.mark.parametrize(
    ("variance", "message"),
    [
        (np.zeros(N), "relative_variance must be positive.*range from 0"),
        (-np.ones(N), "relative_variance must be positive"),
        (np.full(N, np.nan), "relative_variance must be positive"),
        (np.ones((N, 2)), "relative_variance must have the shape"),
    ],
    ids=range(4),
)
def test_invalid_variances(model, variance, message):
    with pytest.raises(ValueError, match=message):
        clone(model).fit(X, Y, relative_variance=variance)


def test_row_that_is_known_exactly_leaves_what_the_others_say():
    """One row has almost all of the weight: sums over rows lost the others, and a few residuals have the variance 0."""
    X = np.random.RandomState(0).uniform(-2.0, 2.0, (80, 2))
    y = np.sin(2.0 * X[:, 0]) + X[:, 1] + 0.1 * np.random.RandomState(1).randn(80)
    model = EVGPRegressor(n_inducing=20, random_state=0)
    expected = clone(model).fit(X[1:], y[1:]).noise_variance_
    model.fit(X, y, relative_variance=np.r_[1e-14, np.ones(79)])
    assert model.noise_variance_ == pytest.approx(expected, rel=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # y is not far from its prior mean
        model.fit(X[:20], y[:20], relative_variance=np.r_[1e-14, np.ones(19)])


@pytest.mark.parametrize("as_dask", [True, False])
def test_removed_rows_do_not_lift_the_smallest_variance_that_counts(as_dask):
    import dask.array as da

    variance = np.r_[np.full(22, 1e14), np.full(18, 2.0), 1.0][1:]
    given = {"sample_weight": (variance < 10.0).astype(float), "relative_variance": variance}
    given = {name: da.from_array(each, 10) if as_dask else each for name, each in given.items()}
    rows = (da.from_array(X, (10, 2)), da.from_array(Y[:, 0], 10)) if as_dask else (X, Y[:, 0])
    removed = evgp(inducing_init=X[30:]).fit(*rows, **given)
    expected = evgp(inducing_init=X[30:]).fit(X[21:], Y[21:, 0], relative_variance=variance[21:])
    np.testing.assert_allclose(removed.predict(X_NEW), expected.predict(X_NEW), rtol=1e-6, atol=1e-6)
