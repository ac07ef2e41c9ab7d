"""Parameters of feature maps: their posterior, and the model's predictions with it."""

import warnings
from functools import cache
from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.pipeline import make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor, feature_report
from skevgp.exceptions import UnidentifiedWarning
from skevgp.features import LogNormal, Normal, ParametricFeatures, Uniform
from skevgp.fitting import theta as theta_module
from skevgp.fitting.theta import map_at
from skevgp.maps.theta import Theta
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS, Adam

from ..theta import (
    DECAY,
    FIXED,
    PRIORS,
    WAVE,
    DenseTheta,
    data,
    decay,
    line,
    sampled,
    wave,
    wave_and_slope,
)

X, Y = data()
X_NEW = np.random.RandomState(9).uniform(-1.0, 6.0, (7, 2))
Z_DRAWN = np.random.RandomState(3).randn(40, 2)
# A fit of these options ends soon, and without a warning.
ROUGH = {"solver": LBFGS(tol=5.0), "sharing": "all"}
GIVEN = {"kernel": FIXED, "max_iter": 0}
ALL_TRIED, ALL_IMPROVED = theta_module._TRIED, theta_module._IMPROVED


@pytest.fixture(autouse=True)
def few_starts(request, monkeypatch):
    """Trials of starts would take half of a small fit. Long tests have all of them."""
    if request.node.get_closest_marker("long") is None:
        monkeypatch.setattr(theta_module, "_TRIED", 2)
        monkeypatch.setattr(theta_module, "_IMPROVED", 1)


def sparse(features=WAVE, **options):
    return EVGPRegressor(features, **{"n_inducing": 12, "noise_cv": None, "random_state": 0} | options)


def with_all_points(features=WAVE, **options):
    return sparse(features, **{"inducing_init": X} | options)


def assert_same_theta(one, other, share=0.05):
    """To this share of the standard deviations."""
    for name, std in other.theta_std_.items():
        assert abs(one.theta_[name] - other.theta_[name]) < share * std
        assert one.theta_std_[name] == pytest.approx(std, rel=share)


# --- the posterior ---------------------------------------------------------------------------------------------------

PROBLEMS = {
    "one output": (sparse(n_inducing=40), Y[:, 0]),
    "own weights": (EGPRegressor(WAVE, random_state=0), Y),
    "shared weights": (
        sparse(n_inducing=40, coef_prior=CoefPrior(0.0, 3.0, shared=True)),
        Y @ np.array([[1.0, 1.0], [0.0, 0.3]]),
    ),
    "weights fixed at 1": (
        EGPRegressor(DECAY, coef_prior=CoefPrior(1.0, 0.0), random_state=0),
        np.exp(-1.3 * X[:, 0]) + 0.1 * np.sin(3.0 * X[:, 1]) + 0.05 * Z_DRAWN[:, 0],
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", PROBLEMS)
def test_posterior_is_that_of_mcmc(name):
    model, y = PROBLEMS[name]
    model.fit(X, y)
    dense = DenseTheta(model, X, y)
    found, std = dense.coordinates(model.theta_), np.array(list(model.theta_std_.values()))
    slopes = np.array([prior.slope(z) for (_, prior), z in zip(dense.priors, found, strict=True)])
    covariance = model.theta_cov_ / np.multiply.outer(slopes, slopes)
    draws = sampled(dense, found, covariance)
    # The linearisation and the sampler are both accurate to a few percent.
    assert (np.abs(found - draws.mean(axis=0)) < 0.2 * draws.std(axis=0)).all()
    assert_allclose(std / slopes, draws.std(axis=0), rtol=0.15)
    correlation = (model.theta_cov_ / np.multiply.outer(std, std))[0, -1]
    assert correlation == pytest.approx(np.corrcoef(draws.T)[0, -1] if len(std) > 1 else 1.0, abs=0.1)


def test_exact_model_is_the_sparse_one_with_all_points():
    expected = with_all_points(noise_cv=None).fit(X, Y[:, 0])
    assert_same_theta(EGPRegressor(WAVE, random_state=0).fit(X, Y[:, 0]), expected)


# Each three of the four are in all combinations. The other eight cases are long.
LINEAR_CASES = [
    pytest.param(
        exact, n, weighted, kind, marks=[pytest.mark.long] * ((exact + n + weighted + (kind == "free")) % 2 == 1)
    )
    for exact, n, weighted, kind in product([False, True], [1, 2], [False, True], ["free", "orthogonal"])
]


@pytest.mark.parametrize(("exact", "n_outputs", "weighted", "discrepancy"), LINEAR_CASES)
def test_parameters_of_a_linear_function_are_weights(exact, n_outputs, weighted, discrepancy):
    """Outputs share θ, as they share weights."""
    options = {"kernel": FIXED, "max_iter": 0, "discrepancy": discrepancy}
    make = EGPRegressor if exact else lambda *args, **others: with_all_points(*args, inducing_init=X[::4], **others)
    features = ParametricFeatures(line, {"a": Normal(0.5, 1.0), "b": Normal(-0.5, 2.0)})
    y = Y[:, :n_outputs] if n_outputs == 2 else Y[:, 0]
    weights = np.where(np.arange(40) % 5 == 0, 0.0, np.linspace(0.5, 2.0, 40)) if weighted else None
    model = make(features, coef_prior=CoefPrior(1.0, 0.0), **options).fit(X, y, sample_weight=weights)
    prior = CoefPrior([0.5, -0.5], [1.0, 2.0], shared=n_outputs == 2)
    expected = make(FunctionTransformer(), coef_prior=prior, **options).fit(X, y, sample_weight=weights)
    assert_allclose(model.coef_, np.ones(model.coef_.shape))
    for one, other in zip(model.predict(X_NEW, return_std=True), expected.predict(X_NEW, return_std=True), strict=True):
        assert_allclose(one, other, rtol=1e-6, atol=1e-8)
    # Outputs that share θ are correlated, as those that share weights.
    joint = [one.predict(X_NEW[:4], return_cov="joint")[1] for one in (model, expected)]
    assert_allclose(*joint, rtol=1e-5, atol=1e-7)
    if discrepancy == "free":
        # The weights of an orthogonal f are those of the best fit.
        assert_allclose(list(model.theta_.values()), expected.coef_, rtol=1e-6)
        assert_allclose(model.theta_cov_, expected.coef_cov_, rtol=1e-6)
    if n_outputs == 2 and discrepancy == "orthogonal":
        return
    if exact:
        found, known = model.log_marginal_likelihood_value_, expected.log_marginal_likelihood_value_
    else:
        found, known = model.lower_bound_, expected.lower_bound_
    assert found == pytest.approx(known, abs=1e-5)


@pytest.mark.parametrize("discrepancy", ["free", "orthogonal"])
@pytest.mark.parametrize("shared", [False, True])
def test_points_at_all_rows_give_exact_model(shared, discrepancy):
    options = {"kernel": FIXED, "max_iter": 0, "coef_prior": CoefPrior(0.0, 2.0, shared=shared)}
    rows, y = X[::2], Y[::2]
    one = with_all_points(discrepancy=discrepancy, inducing_init=rows, **options).fit(rows, y)
    other = EGPRegressor(WAVE, discrepancy=discrepancy, random_state=0, **options).fit(rows, y)
    assert_same_theta(one, other, 1e-3)
    for found, expected in zip(one.predict(X_NEW, True), other.predict(X_NEW, True), strict=True):
        assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    assert_allclose(one.coef_std_, other.coef_std_, rtol=1e-3)


def test_frequency_without_slope_at_its_median_is_learned(monkeypatch):
    monkeypatch.setattr(theta_module, "_TRIED", 8)
    monkeypatch.setattr(theta_module, "_IMPROVED", 1)

    def cosine(X, w):
        return anp.cos(w * X[:, 0])

    y = 2.0 * np.cos(1.5 * X[:, 0]) + 0.05 * Z_DRAWN[:, 0]
    model = sparse(ParametricFeatures(cosine, {"w": Normal(0.0, 1.0)}), **GIVEN).fit(X, y)
    assert abs(model.theta_["w"]) == pytest.approx(1.5, abs=0.02)


def test_best_of_several_optima_is_found(monkeypatch):
    """From the prior median, a local search ends in another wave."""
    monkeypatch.setattr(theta_module, "_TRIED", ALL_TRIED)
    monkeypatch.setattr(theta_module, "_IMPROVED", ALL_IMPROVED)
    y = 2.0 * wave(X, 1.2, 0.2) + 0.05 * Z_DRAWN[:, 0]
    model = sparse(ParametricFeatures(wave, PRIORS | {"period": Uniform(0.8, 4.0)}), **ROUGH).fit(X, y)
    assert model.theta_["period"] == pytest.approx(1.2, abs=0.01)


# --- the same model by another way -----------------------------------------------------------------------------------


def own_wave(X, period, phase):
    return wave(X, period, phase)[:, None]


FIXED_WEIGHTS = {
    "kernel": FIXED,
    "max_iter": 0,
    "inducing_init": X[::3],
    "coef_prior": CoefPrior([[0.0, 0.2], [0.1, 0.0]], 2.0),
}
SECOND = FunctionTransformer(lambda X: X[:, 1:])
TWO_COLUMNS = ParametricFeatures(wave_and_slope, PRIORS)
NESTED = {
    "union": make_union(WAVE, SECOND),
    "pipeline": make_pipeline(
        FunctionTransformer(lambda X: 2.0 * X), FunctionTransformer(lambda X: 0.5 * X), TWO_COLUMNS
    ),
    "union of pipelines": make_union(make_pipeline(FunctionTransformer(), WAVE, "passthrough"), SECOND),
    "differences": ParametricFeatures(wave_and_slope, PRIORS, derivatives="differences"),
}


@cache
def of_two_columns():
    return sparse(TWO_COLUMNS, **FIXED_WEIGHTS).fit(X, Y)


@pytest.mark.parametrize("name", NESTED)
def test_nested_maps_are_one_function(name):
    expected = of_two_columns()
    model = sparse(NESTED[name], **FIXED_WEIGHTS).fit(X, Y)
    assert model.theta_ == pytest.approx(expected.theta_, rel=1e-6)
    assert model.theta_std_ == pytest.approx(expected.theta_std_, rel=1e-6)
    for found, known in zip(model.predict(X_NEW, True), expected.predict(X_NEW, True), strict=True):
        assert_allclose(found, known, rtol=1e-6, atol=1e-8)


def test_scales_after_the_function_move_into_the_weights():
    """A scaler, and weights of a union, with a prior of the weights in their units."""
    scaler = StandardScaler(with_mean=False).fit(map_at(WAVE.fit(X), np.zeros(2)).transform(X))
    union = make_union(make_pipeline(WAVE, StandardScaler(with_mean=False)))
    union.set_params(transformer_weights={"pipeline": 4.0})
    options = {"kernel": FIXED, "max_iter": 0, "inducing_init": X[::3]}
    expected = sparse(coef_prior=CoefPrior(0.3, 2.0), **options).fit(X, Y[:, 0])
    by = scaler.scale_[0] / 4.0
    model = sparse(union, coef_prior=CoefPrior(0.3 * by, 2.0 * by), **options).fit(X, Y[:, 0])
    assert model.theta_ == pytest.approx(expected.theta_, rel=1e-6)
    assert model.theta_std_ == pytest.approx(expected.theta_std_, rel=1e-6)
    assert_allclose(model.coef_std_, by * expected.coef_std_, rtol=1e-6)


def test_parameters_of_the_same_name_get_those_of_their_parts():
    union = make_union(WAVE, DECAY, ParametricFeatures(decay, {"rate": LogNormal(2.0, 0.1)}))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnidentifiedWarning)
        model = sparse(union, **GIVEN).fit(X, Y[:, 0])
    assert list(model.theta_) == ["period", "phase", "parametricfeatures-2__rate", "parametricfeatures-3__rate"]


@pytest.mark.parametrize("n_outputs", [1, 2])
@pytest.mark.parametrize("discrepancy", ["free", "orthogonal"])
def test_partial_fit_adds_rows_to_the_same_linearisation(discrepancy, n_outputs):
    """In a linear function, all linearisations are the same, so that the model is that of all rows."""
    features = ParametricFeatures(line, {"a": Normal(0.5, 1.0), "b": Normal(-0.5, 2.0)})
    options = {"kernel": FIXED, "max_iter": 0, "discrepancy": discrepancy, "inducing_init": X[::4]}
    options["coef_prior"] = CoefPrior(1.0, 0.0)
    y, first = Y[:, :n_outputs], np.arange(40) % 3 > 0
    whole = sparse(features, **options).fit(X, y)
    model = sparse(features, **options).fit(X[first], y[first])
    before = dict(model.theta_)
    for rows in (np.flatnonzero(~first)[:5], np.flatnonzero(~first)[5:]):
        model.partial_fit(X[rows], y[rows])
    assert model.theta_ != pytest.approx(before, rel=1e-3)
    assert model.theta_ == pytest.approx(whole.theta_, rel=1e-6)
    assert model.theta_std_ == pytest.approx(whole.theta_std_, rel=1e-6)
    for found, expected in zip(model.predict(X_NEW, True), whole.predict(X_NEW, True), strict=True):
        assert_allclose(found, expected, rtol=1e-6, atol=1e-7)
    if n_outputs == 1 or discrepancy == "free":
        assert model.lower_bound_ == pytest.approx(whole.lower_bound_, abs=1e-4)


@pytest.mark.parametrize("n_outputs", [1, 2])
def test_partial_fit_of_a_curved_function_is_a_newton_step(n_outputs):
    """Its posterior is that of the fit to all rows if the first rows already determine θ well."""
    options = {"kernel": FIXED, "max_iter": 0, "inducing_init": X[::4]}
    y, first = Y[:, :n_outputs], np.arange(40) % 4 > 0
    whole = sparse(**options).fit(X, y)
    model = sparse(**options).fit(X[first], y[first]).partial_fit(X[~first], y[~first])
    assert_same_theta(model, whole, 0.2)
    assert_allclose(model.predict(X_NEW), whole.predict(X_NEW), atol=0.05)


def test_warm_start_goes_on_from_the_last_parameters():
    model = sparse(WAVE, warm_start=True).fit(X, Y[:, 0])
    n_iter, theta = model.n_iter_, dict(model.theta_)
    model.fit(X, Y[:, 0])
    assert model.n_iter_ < n_iter
    assert model.theta_ == pytest.approx(theta, rel=1e-2)


@pytest.mark.parametrize("make", [sparse, EGPRegressor])
def test_parameters_do_not_move_under_a_guess_of_the_noise(make):
    """Without a fit of kernel and noise, θ is the best for the features alone."""
    options = {"optimizer": None} if make is EGPRegressor else {"max_iter": 0}
    rough = {} if make is EGPRegressor else ROUGH
    model, whole = make(WAVE, **options).fit(X, Y[:, 0]), make(WAVE, **rough).fit(X, Y[:, 0])
    for name, value in whole.theta_.items():
        assert model.theta_[name] == pytest.approx(value, abs=5.0 * whole.theta_std_[name] + 0.02)


@pytest.mark.parametrize("make", [sparse, EGPRegressor])
def test_report_on_features_with_parameters(make):
    model = make(WAVE, **GIVEN).fit(X, Y[:, 0])
    (group, everything) = feature_report(model, X, Y[:, 0], n_splits=2).groups
    assert everything.n_weights == group.n_weights == model.coef_.shape[-1]


# --- combinations ----------------------------------------------------------------------------------------------------

OPTIONS = {
    "chosen points": {"n_inducing": "auto"},
    "folds": {"noise_cv": 4},
    "kernel of each": {"sharing": "kernel"},
    "apart": {"sharing": "none"},
    "groups": {"sharing": [[1], [0]]},
    "found": {"sharing": "auto"},
    "tight": {"solver": LBFGS(bound="tight", tol=5.0)},
    "learned scales": {"coef_prior": CoefPrior(0.0, 3.0, groups=["w"])},
    "warm": {"warm_start": True},
    "orthogonal": {"discrepancy": "orthogonal"},
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options_keep_theta(name):
    groups = np.arange(40) // 4 if name == "folds" else None
    model = sparse(**ROUGH | OPTIONS[name]).fit(X, Y, groups=groups)
    if name == "warm":
        model.fit(X, Y)
    theta, std = np.array(list(model.theta_.values())), np.array(list(model.theta_std_.values()))
    assert_allclose(theta, [1.8, 0.3], rtol=0.0, atol=4.0 * std.max())
    assert (std < [0.03, 0.2]).all()
    mean, cov = model.predict(X_NEW, return_cov=True)
    assert_allclose(np.sqrt(np.einsum("iio->io", cov)), model.predict(X_NEW, return_std=True)[1], rtol=1e-6)
    draws = model.sample_y(X_NEW, 4000)
    std = np.sqrt(np.einsum("iio->io", cov))
    assert (np.abs(draws.mean(axis=2) - mean) < 5.0 * std / np.sqrt(4000)).all()
    assert_allclose(draws.std(axis=2), std, rtol=0.06)


def test_shift_of_y_is_that_of_predictions():
    one = sparse(kernel=FIXED, max_iter=0, normalize_y=True).fit(X, Y)
    other = sparse(kernel=FIXED, max_iter=0, normalize_y=True).fit(X, Y + [10.0, -3.0])
    assert one.theta_ == pytest.approx(other.theta_, rel=1e-6)
    assert_allclose(one.predict(X_NEW) + [10.0, -3.0], other.predict(X_NEW), rtol=1e-6)


def test_weights_of_rows_are_copies():
    counts = np.arange(40) % 3
    options = {"kernel": FIXED, "max_iter": 0, "inducing_init": X[::4]}
    one = sparse(**options).fit(X, Y, sample_weight=counts)
    other = sparse(**options).fit(np.repeat(X, counts, axis=0), np.repeat(Y, counts, axis=0))
    assert one.theta_ == pytest.approx(other.theta_, rel=1e-6)
    assert one.theta_std_ == pytest.approx(other.theta_std_, rel=1e-6)
    assert_allclose(one.predict(X_NEW), other.predict(X_NEW), rtol=1e-6, atol=1e-8)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_dask_is_numpy():
    import dask.array as da

    options = {"kernel": FIXED, "max_iter": 0, "inducing_init": X[::4]}
    one = sparse(**options).fit(da.from_array(X, chunks=(13, 2)), da.from_array(Y, chunks=(13, 2)))
    other = sparse(**options).fit(X, Y)
    assert one.theta_ == pytest.approx(other.theta_, rel=1e-6)
    assert_allclose(one.predict(da.from_array(X_NEW, chunks=(3, 2))).compute(), other.predict(X_NEW), rtol=1e-6)


# --- orthogonal f (Plumlee 2017) -------------------------------------------------------------------------------------


def own_rows(X):
    return np.stack([np.column_stack([np.ones(len(X)), X[:, 0]]), np.column_stack([X[:, 1], X[:, 0] ** 2])], axis=1)


def common_rows(X):
    return np.column_stack([np.ones(len(X)), X[:, 0]])


class Orthogonal:
    """The dense model of one output, or of outputs one below the other: k⊥ = k - k_h G⁻¹ k_hᵀ with sums over rows."""

    def __init__(self, model, X, Y, features, shared):
        self.X, self.shared, self.features = X, shared, features
        self.o, n = Y.shape[1], len(X)
        self.kernel, self.noise = FIXED.k1, 0.01
        self.scale = np.broadcast_to(model.coef_prior_scale_, (self.o, model.coef_.shape[-1]))
        self.mean = np.broadcast_to(model.coef_prior_mean_, self.scale.shape)
        r = (Y - np.stack([self.H(X, o) @ self.mean[o] for o in range(self.o)], axis=1)).T.ravel()
        S = self.cov(X, X) + self.noise * np.eye(n * self.o)
        self.S, self.alpha = S, np.linalg.solve(S, r)

    def H(self, X, o):
        values = self.features(X)
        return values[:, o] if values.ndim == 3 else values

    def k(self, A, B, o):
        used = self.scale[o] > 0.0
        H = self.H(self.X, o)[:, used]
        k_A, k_B = self.kernel(A, self.X) @ H, self.kernel(B, self.X) @ H
        H_A, H_B = self.H(A, o)[:, used], self.H(B, o)[:, used]
        P = np.linalg.inv(H.T @ H)
        # f⊥ = f - h (HᵀH)⁻¹ Hᵀf(X).
        middle = P @ H.T @ self.kernel(self.X) @ H @ P
        return self.kernel(A, B) - H_A @ P @ k_B.T - k_A @ P @ H_B.T + H_A @ middle @ H_B.T

    def cov(self, A, B):
        def block(i, j):
            linear = (self.H(A, i) * self.scale[i] ** 2) @ self.H(B, j).T
            return linear + self.k(A, B, i) if i == j else linear * float(self.shared)

        return np.block([[block(i, j) for j in range(self.o)] for i in range(self.o)])

    def predict(self, A):
        cross, n = self.cov(A, self.X), len(A)
        mean = (cross @ self.alpha).reshape(self.o, n).T
        mean = mean + np.stack([self.H(A, o) @ self.mean[o] for o in range(self.o)], axis=1)
        variance = np.diag(self.cov(A, A) - cross @ np.linalg.solve(self.S, cross.T)).reshape(self.o, n).T
        return mean, np.sqrt(variance)

    def coef(self, o):
        each = [self.scale[o][:, None] ** 2 * self.H(self.X, i).T * float(i == o or self.shared) for i in range(self.o)]
        cross = np.hstack(each)
        covariance = np.diag(self.scale[o] ** 2) - cross @ np.linalg.solve(self.S, cross.T)
        return self.mean[o] + cross @ self.alpha, np.sqrt(np.maximum(np.diag(covariance), 0.0))


@pytest.mark.parametrize("features", [common_rows, own_rows])
@pytest.mark.parametrize(
    ("shared", "scale"), [(False, [0.7, 1.5]), (True, [0.7, 1.5]), (False, [0.7, 0.0]), (False, [0.0, 0.0])]
)
@pytest.mark.parametrize("exact", [False, True])
def test_orthogonal_model_is_dense_one(exact, shared, scale, features):
    options = {"kernel": FIXED, "max_iter": 0, "discrepancy": "orthogonal"}
    scale = scale if shared else [scale, scale[::-1]]
    options["coef_prior"] = CoefPrior([0.3, -0.2] if shared else [[0.3, -0.2], [0.0, 0.5]], scale, shared=shared)
    given = FunctionTransformer(features)
    model = EGPRegressor(given, **options) if exact else with_all_points(given, **options)
    model.fit(X, Y)
    dense = Orthogonal(model, X, Y, features, shared)
    for rows in (X[:9], X_NEW):
        for found, expected in zip(model.predict(rows, True, include_noise=False), dense.predict(rows), strict=True):
            assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    coef, std = (np.broadcast_to(own, (2, 2)) for own in (model.coef_, model.coef_std_))
    for o in range(2):
        expected, expected_std = dense.coef(o)
        assert_allclose(coef[o], expected, rtol=1e-5, atol=1e-6)
        assert_allclose(std[o], expected_std, rtol=1e-4, atol=1e-6)


def test_wide_prior_makes_orthogonal_f_the_projection_of_a_free_one():
    """With a flat prior, only the meaning of the weights differs: coef_ is β + (HᵀH)⁻¹ Hᵀ f of the free model."""
    options = {"kernel": FIXED, "max_iter": 0, "coef_prior": CoefPrior(0.0, 1e4), "inducing_init": X}
    free, orthogonal = (
        sparse(FunctionTransformer(common_rows), discrepancy=kind, **options).fit(X, Y)
        for kind in ("free", "orthogonal")
    )
    for one, other in zip(free.predict(X_NEW, True), orthogonal.predict(X_NEW, True), strict=True):
        assert_allclose(one, other, rtol=1e-4)
    projection = np.linalg.lstsq(common_rows(X), free.predict(X), rcond=None)[0].T
    assert_allclose(orthogonal.coef_, projection, rtol=1e-5)
    _, joint = free.predict(X, return_cov=True, include_noise=False)
    P = np.linalg.pinv(common_rows(X))
    for o in range(2):
        assert_allclose(orthogonal.coef_cov_[o], P @ joint[:, :, o] @ P.T, rtol=1e-3, atol=1e-7)


def test_orthogonal_f_without_features_is_free():
    one, other = (sparse(None, discrepancy=kind, **ROUGH).fit(X, Y) for kind in ("free", "orthogonal"))
    for found, expected in zip(one.predict(X_NEW, True), other.predict(X_NEW, True), strict=True):
        assert_allclose(found, expected, rtol=1e-9)


def test_partial_fit_projects_on_all_rows():
    options = {"kernel": FIXED, "max_iter": 0, "coef_prior": CoefPrior(0.0, 2.0), "inducing_init": X[::3]}
    options |= {"discrepancy": "orthogonal"}
    whole = sparse(FunctionTransformer(own_rows), **options).fit(X, Y)
    model = sparse(FunctionTransformer(own_rows), **options).fit(X[:25], Y[:25]).partial_fit(X[25:], Y[25:])
    for found, expected in zip(model.predict(X_NEW, True), whole.predict(X_NEW, True), strict=True):
        assert_allclose(found, expected, rtol=1e-6, atol=1e-8)
    assert_allclose(model.coef_, whole.coef_, rtol=1e-6)


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"solver": Adam()},
        {"solver": LBFGS(posterior="diagonal")},
        {"noise": "student-t"},
        {"noise": Gaussian(inputs=0.1)},
    ],
    ids=str,
)
def test_unsupported_combinations_raise(options):
    with pytest.raises(ValueError, match=r"parameters \(period, phase\) needs solver="):
        sparse(**options).fit(X, Y)


@pytest.mark.parametrize("options", [{"solver": Adam()}, {"solver": LBFGS(posterior="diagonal")}], ids=str)
def test_orthogonal_f_needs_full_posterior(options):
    with pytest.raises(ValueError, match=r'discrepancy="orthogonal" needs solver='):
        sparse(FunctionTransformer(), discrepancy="orthogonal", **options).fit(X, Y)


@pytest.mark.parametrize("model", [sparse, EGPRegressor])
def test_parameter_that_data_do_not_identify_warns(model):
    with pytest.warns(UnidentifiedWarning, match=r"\['phase'\]"):
        fitted = model(ParametricFeatures(lambda X, period, phase: wave(X, period, 0.3) + 0.0 * phase, PRIORS)).fit(
            X, Y[:, 0]
        )
    assert fitted.theta_["phase"] == 0.0
    assert fitted.theta_std_["phase"] == pytest.approx(0.5)


def test_parameter_at_the_edge_of_its_prior_warns():
    """The data ask for a period of 1.8. Another phase, far from its prior, makes up for a part of it."""
    features = ParametricFeatures(wave, {**PRIORS, "period": Uniform(2.2, 3.0)})
    with pytest.warns(ConvergenceWarning, match=r"\['period', 'phase'\] ended at the edges of their priors"):
        model = sparse(features, kernel=FIXED, max_iter=0).fit(X, Y[:, 0])
    assert model.theta_["period"] == pytest.approx(2.2, abs=0.01)


@pytest.mark.parametrize("prior", ["auto", CoefPrior(mean=[2.0], scale=0)], ids=["free", "fixed"])
def test_parameter_far_outside_of_its_prior_warns_by_name(prior):
    """The frequency is 1.5. A prior scale of 0 is the user's choice, and no reason for another warning."""
    rows = np.random.RandomState(0).uniform(-3.0, 3.0, (30, 1))
    features = ParametricFeatures(lambda X, frequency: anp.sin(frequency * X), {"frequency": LogNormal(1.0, 0.1)})
    kernel = ConstantKernel(0.01, "fixed") * RBF(0.8, "fixed") + WhiteKernel(1e-4, "fixed")
    with pytest.warns(ConvergenceWarning) as caught:
        model = EGPRegressor(features, kernel=kernel, max_iter=0, coef_prior=prior).fit(
            rows, 2.0 * np.sin(1.5 * rows[:, 0])
        )
    assert ["['frequency'] ended at the edges" in str(one.message) for one in caught] == [True]
    assert model.theta_["frequency"] == pytest.approx(1.5, abs=0.01)


def test_theta_of_another_model_is_explained():
    with pytest.raises(AttributeError, match="theta_ only after a fit with a feature_map that has parameters"):
        _ = sparse(FunctionTransformer(), **GIVEN).fit(X, Y).theta_
    model = sparse(**GIVEN).fit(X, Y).set_params(feature_map=FunctionTransformer()).fit(X, Y)
    assert not hasattr(model, "theta_std_")


def test_values_of_parameters_stay_within_their_map():
    """The map that the user gave is not changed, and that of the fit has the posterior's values."""
    given = ParametricFeatures(wave, PRIORS)
    model = sparse(given, **ROUGH).fit(X, Y)
    assert not hasattr(given, "theta_")
    own = Theta.of(model.feature_map_)
    assert own.names == ("period", "phase")
    for name, value in model.feature_map_.theta_.items():
        assert abs(value - model.theta_[name]) < 0.1 * model.theta_std_[name]


NASTY_X = {
    "few": lambda n: X[:n],
    "equal": lambda n: np.repeat(X[:1], n, axis=0),
    "constant column": lambda n: np.column_stack([np.ones(n), X[:n, 1]]),
    "far": lambda n: 1e6 + X[:n],
}
NASTY_Y = {
    "0": lambda X: np.zeros((len(X), 2)),
    "constant": lambda X: np.full((len(X), 2), 5.1),
    "no noise": lambda X: np.column_stack([wave(X, 1.8, 0.3), -wave(X, 1.8, 0.3)]),
    "little noise": lambda X: wave(X, 1.8, 0.3)[:, None] + 1e-8 * Z_DRAWN[: len(X)],
    "one row": lambda X: (np.arange(len(X)) == 0)[:, None] * np.ones(2),
    "vast": lambda X: 1e20 * Y[: len(X)],
}
NASTY_MAPS = {
    "wave": WAVE,
    "0": ParametricFeatures(lambda X, a: 0.0 * a * X[:, 0], {"a": Normal(0.0, 1.0)}),
    "imitated by weights": ParametricFeatures(lambda X, a: a * X[:, 0], {"a": LogNormal(1.0, 0.5)}),
    "of each other": ParametricFeatures(lambda X, a, b: (a + b) * X[:, :1], {"a": Normal(0, 1), "b": Uniform(0, 1)}),
}


# Some of the cases, and those that failed once.
@pytest.mark.long
@settings(max_examples=25, derandomize=True, database=None, deadline=None)
@given(
    st.sampled_from(sorted(NASTY_MAPS)),
    st.sampled_from(sorted(NASTY_X)),
    st.sampled_from(sorted(NASTY_Y)),
    st.sampled_from([EVGPRegressor, EGPRegressor]),
    st.sampled_from(["free", "orthogonal"]),
    st.sampled_from([1, 2, 3, 4, 5, 40]),
)
@example("wave", "few", "little noise", EVGPRegressor, "free", 2)
@example("wave", "far", "one row", EGPRegressor, "orthogonal", 3)
@example("imitated by weights", "few", "no noise", EGPRegressor, "free", 40)
@example("0", "few", "constant", EVGPRegressor, "free", 1)
@example("of each other", "few", "constant", EVGPRegressor, "orthogonal", 40)
def test_nasty_data_are_fitted(name, rows, target, kind, discrepancy, n):
    inputs = NASTY_X[rows](n)
    y = NASTY_Y[target](inputs)
    model = kind(NASTY_MAPS[name], discrepancy=discrepancy, random_state=0, max_iter=15)
    with warnings.catch_warnings():
        for category in (UnidentifiedWarning, ConvergenceWarning):
            warnings.simplefilter("ignore", category)
        model.fit(inputs, y if n % 2 else y[:, 0])
    mean, std = model.predict(X_NEW, return_std=True)
    assert np.isfinite(mean).all()
    assert np.isfinite(std).all()
    assert (std > 0.0).all()
    assert np.isfinite([*model.theta_.values(), *model.theta_std_.values(), *model.coef_std_.ravel()]).all()
    # The posterior is not wider than the prior.
    for parameter, prior in NASTY_MAPS[name].parameters.items():
        slope = prior.slope(prior.coordinate(model.theta_[parameter]))
        assert model.theta_std_[parameter] <= slope * (1.0 + 1e-6)
