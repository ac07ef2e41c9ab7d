"""Rows for each output, weights that outputs share, and correlated weights: against a dense Gaussian process."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import make_column_transformer
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel
from sklearn.pipeline import make_pipeline, make_union
from sklearn.preprocessing import FunctionTransformer

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.data.rows import RawRows
from skevgp.kernels.stationary import SquaredExponential
from skevgp.model.exact import ExactModel
from skevgp.model.predictor import CoefficientPrior
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS

from .oracle import Dense, central_differences, relative_error

N, O, P = 40, 3, 4  # noqa: E741


class Rows(TransformerMixin, BaseEstimator):
    """A row for each output, (n, o, width), or one for all; with a prior if there is one."""

    def __init__(self, width=P, per_output=True, prior=None, share_coef=False):
        self.width = width
        self.per_output = per_output
        self.prior = prior
        self.share_coef = share_coef

    def fit(self, X, y=None):
        return self

    def __sklearn_is_fitted__(self):
        return True

    def transform(self, X):
        phases = np.arange(O)[:, np.newaxis] * self.per_output
        rows = np.sin(X.sum(axis=1)[:, np.newaxis, np.newaxis] * (1.0 + 0.3 * np.arange(self.width)) + phases)
        return rows if self.per_output else rows[:, 0]


class Opinionated(Rows):
    def coef_prior(self, n_outputs):
        return self.prior


def own_columns(X):
    """Output j's kernel sees columns j and j + 1."""
    return np.stack([X[:, [j, j + 1]] * (1.0 + j) for j in range(O)], axis=1)


@pytest.fixture(scope="module")
def data():
    rng = np.random.RandomState(0)
    X = rng.uniform(-1.5, 1.5, (N, O + 1))
    beta = np.array([1.0, -0.5, 0.3, 2.0])
    H = Rows().transform(X)
    Y = np.einsum("nop,p->no", H, beta) + np.sin(2.0 * X[:, :O]) + np.array([0.1, 0.2, 0.05]) * rng.randn(N, O)
    A = rng.randn(P, P)
    return X, Y * [1.0, 10.0, 0.1], A @ A.T + 0.1 * np.eye(P), rng.randn(P), rng.uniform(-1.5, 1.5, (7, O + 1))


KERNEL = ConstantKernel(1.5) * RBF([0.8, 1.3])


def dense(H, inputs, Y, mean, Sigma, Z=None, relative=1.0):
    """The model of `KERNEL`, a noise variance of 0.3 and β ~ N(mean, Sigma); exact without inducing points."""
    root, ones = np.linalg.cholesky(Sigma)[np.newaxis].repeat(O, axis=0), np.ones(N)
    prior = CoefficientPrior(np.tile(mean, (O, 1)), np.ones((O, P)), np.zeros((O, P)), root, shared=True)
    values = {"hyperparameters": np.array([0.8, 1.3]), "signal": np.full(O, 1.5), "noise": np.full(O, 0.3)}
    rows = RawRows(inputs, H, Y - np.reshape(H @ mean, (N, -1)), ones, ones / relative)
    return Dense(rows, prior, exact=Z is None), values | {"inducing_points": Z}


def check(model, expected, X_new, inputs, H):
    oracle, values = expected
    bound = model.log_marginal_likelihood_value_ if oracle.exact else model.lower_bound_
    assert bound == pytest.approx(oracle.bound(values), rel=1e-9)
    mean, covariance = oracle.predict(values, inputs, H)
    n = len(X_new)
    covariance = covariance.reshape(O, n, O, n).transpose(1, 0, 3, 2)
    found, joint = model.predict(X_new, return_cov="joint", include_noise=False)
    close = {"rtol": 1e-7, "atol": 1e-8 * np.abs(covariance).max()}
    assert_allclose(found, mean, rtol=1e-8, atol=1e-9)
    assert_allclose(joint, covariance.reshape(n * O, n * O), **close)
    _, std = model.predict(X_new, return_std=True, include_noise=False)
    assert_allclose(std, np.sqrt(np.einsum("nono->no", covariance)), rtol=1e-6)
    _, cov = model.predict(X_new, return_cov=True)
    assert_allclose(cov, np.einsum("nomo->nmo", covariance) + np.eye(n)[:, :, None] * model.noise_variance_, **close)
    coef, coef_cov = (each[0] for each in oracle.weights(values))
    assert_allclose(model.coef_, coef, rtol=1e-7)
    assert_allclose(model.coef_cov_, coef_cov, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("sharing", "per_output"), [("none", True), ("kernel", True), ("kernel", False), ([[1], [0, 2]], False)]
)
def test_shared_weights_are_dense_ones(data, sharing, per_output):
    X, Y, Sigma, mean, X_new = data
    joined = not isinstance(sharing, str)
    features = Rows(per_output=not joined)
    kernel_map = FunctionTransformer(own_columns) if per_output else FunctionTransformer(lambda X: X[:, :2])
    inputs, inputs_new = (kernel_map.transform(rows) for rows in (X, X_new))
    model = EVGPRegressor(
        features,
        KERNEL,
        kernel_map=kernel_map,
        coef_prior=CoefPrior(shared=True, mean=mean, cov=Sigma),
        noise=Gaussian(variance=0.3),
        inducing_init="auto" if per_output else inputs[:9],
        n_inducing=9,
        sharing=sharing,
        max_iter=0,
        random_state=0,
    ).fit(X, Y)
    Z = model.inducing_points_ if per_output else inputs[np.newaxis, :9]
    check(
        model,
        dense(features.transform(X), inputs, Y, mean, Sigma, Z),
        X_new,
        inputs_new,
        features.transform(X_new),
    )
    assert model.upper_bound_ > model.lower_bound_


@pytest.mark.parametrize("sharing", ["none", "kernel", "all"])
def test_gradient_is_that_of_finite_differences(data, sharing):
    X, Y, Sigma, _, _ = data
    found = []

    class Checked(LBFGS):
        def minimise(self, objective, start, *others):
            x = start + 0.1 * np.random.RandomState(1).randn(len(start))
            found.append(relative_error(objective(x)[1], central_differences(lambda x: objective(x)[0], x)))
            return super().minimise(objective, start, *others)

    apart = sharing != "all"
    kernel_map = FunctionTransformer(own_columns) if apart else FunctionTransformer(lambda X: X[:, :2])
    model = EVGPRegressor(
        Rows(per_output=apart),
        kernel_map=kernel_map,
        coef_prior=CoefPrior(shared=True, cov=Sigma),
        sharing=sharing,
        n_inducing=6,
        solver=Checked(),
        max_iter=1,
        random_state=0,
    )
    with pytest.warns(ConvergenceWarning, match="max_iter"):
        model.fit(X, Y)
    assert max(found) < 1e-5


def test_exact_gradient_is_that_of_finite_differences(data):
    X, Y, Sigma, mean, _ = data
    rows = RawRows(own_columns(X), Rows().transform(X), Y / Y.std(axis=0))
    roots = np.repeat(np.linalg.cholesky(Sigma)[np.newaxis], O, axis=0)
    prior = CoefficientPrior(np.tile(mean, (O, 1)), np.ones((O, P)), np.tile(0.1 * mean, (O, 1)), roots, shared=True)
    kernels = tuple(SquaredExponential(2) for _ in range(O))
    model = ExactModel(kernels[0], prior, np.zeros((O, P), dtype=bool), rows, kernels)

    def likelihood(theta):
        values = {"hyperparameters": theta[:2], "signal": theta[2 : 2 + O], "noise": theta[2 + O :]}
        return model.log_likelihood({name: np.exp(value) for name, value in values.items()})

    theta = np.log(np.concatenate([[0.8, 1.3], [1.0, 2.0, 0.5], [0.1, 0.3, 0.2]]))
    gradient = np.concatenate(list(likelihood(theta)[1].values()))
    assert relative_error(gradient, central_differences(lambda x: likelihood(x)[0], theta)) < 1e-6


def test_dask_agrees(data):
    da = pytest.importorskip("dask.array")
    X, Y, Sigma, _, X_new = data
    kernel_map = FunctionTransformer(own_columns)
    model = EVGPRegressor(
        Rows(),
        KERNEL,
        kernel_map=kernel_map,
        coef_prior=CoefPrior(shared=True, cov=Sigma, mean=0.0),
        noise=Gaussian(variance=0.3),
        n_inducing=8,
        inducing_init=own_columns(X)[:8, 0],
        sharing="kernel",
        max_iter=0,
    )
    expected = model.fit(X, Y).predict(X_new, return_std=True)
    found = model.fit(da.from_array(X, chunks=(15, O + 1)), da.from_array(Y, chunks=(15, O))).predict(
        X_new, return_std=True
    )
    for own, other in zip(found, expected, strict=True):
        assert_allclose(own, other, rtol=1e-8)


def test_map_may_say_that_weights_are_shared_and_how_they_vary(data):
    X, Y, Sigma, mean, X_new = data
    options = {"kernel_map": FunctionTransformer(own_columns), "max_iter": 0, "noise": Gaussian(variance=0.3)}
    told = EGPRegressor(Opinionated(prior=(mean, Sigma), share_coef=True), KERNEL, **options).fit(X, Y)
    given = EGPRegressor(Rows(), KERNEL, coef_prior=CoefPrior(shared=True, mean=mean, cov=Sigma), **options).fit(X, Y)
    assert_allclose(told.predict(X_new), given.predict(X_new), rtol=1e-9)
    assert_allclose(told.coef_prior_scale_, np.sqrt(np.diagonal(Sigma)))
    union = make_union(Opinionated(prior=(mean, Sigma), share_coef=True), Rows(width=2, per_output=False))
    with_more = EGPRegressor(union, KERNEL, coef_prior=CoefPrior(shared=True), **options).fit(X, Y)
    assert with_more.coef_.shape == (P + 2,)
    assert_allclose(with_more.coef_prior_scale_[:P], np.sqrt(np.diagonal(Sigma)))


@pytest.mark.parametrize(
    ("feature_map", "shared"),
    [
        (make_pipeline(FunctionTransformer(), Rows(share_coef=True)), True),
        (make_pipeline(Rows(share_coef=True, per_output=False), FunctionTransformer()), False),
        (make_union(Rows(share_coef=True), make_pipeline(Rows(width=2, share_coef=True))), True),
        (make_union(Rows(share_coef=True), Rows(width=2)), False),
        (make_column_transformer((Rows(share_coef=True, per_output=False), [0]), ("drop", [1])), True),
        (make_column_transformer((Rows(share_coef=True, per_output=False), [0]), ("passthrough", [1])), False),
        (FunctionTransformer(), False),
    ],
    ids=["last step", "first step", "union", "union of both", "columns", "columns of both", "none"],
)
def test_shared_weights_of_unions(data, feature_map, shared):
    X, Y, *_ = data
    model = EGPRegressor(feature_map, max_iter=0).fit(X, Y)
    assert model.coef_.ndim == (1 if shared else 2)


def test_weight_without_variance_keeps_its_mean(data):
    X, Y, Sigma, mean, _ = data
    Sigma = Sigma.copy()
    Sigma[1], Sigma[:, 1] = 0.0, 0.0
    model = EGPRegressor(Rows(), coef_prior=CoefPrior(shared=True, mean=mean, cov=Sigma), max_iter=5, tol=1e3).fit(X, Y)
    assert model.coef_[1] == mean[1]
    assert model.coef_std_[1] == 0.0


def _not_symmetric(Sigma):
    return Sigma + np.triu(np.ones((P, P)), 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coef_prior": CoefPrior(cov=np.eye(3))}, r"cov of CoefPrior must be of the shape .* = \(4, 4\)"),
        ({"coef_prior": CoefPrior(cov=_not_symmetric(np.eye(P)))}, "cov of CoefPrior must be symmetric"),
        (
            {"coef_prior": CoefPrior(cov=np.eye(P) + 2.0 * (1 - np.eye(P)))},
            "cov of CoefPrior must be positive semi-definite",
        ),
        ({"coef_prior": CoefPrior(cov=-np.eye(P))}, "cov of CoefPrior must have no negative variance"),
        ({"coef_prior": CoefPrior(cov=np.full((P, P), np.nan))}, "cov of CoefPrior must be finite"),
        ({"coef_prior": CoefPrior(cov=np.eye(P), scale=1.0)}, "cov and scale=1.0 of CoefPrior both set"),
        (
            {"coef_prior": CoefPrior(cov=np.eye(P) + 0.1), "solver": LBFGS(posterior="diagonal")},
            r'cov of CoefPrior\) needs posterior="full"',
        ),
        ({"coef_prior": CoefPrior(cov=np.eye(P) + 0.1), "solver": "adam"}, r'cov of CoefPrior\) needs solver="lbfgs"'),
        (
            {"coef_prior": CoefPrior(shared=True), "solver": LBFGS(posterior="diagonal")},
            r'shared=True of CoefPrior needs posterior="full"',
        ),
        ({"coef_prior": CoefPrior(shared=True), "solver": "adam"}, r'shared=True of CoefPrior needs solver="lbfgs"'),
        (
            {"coef_prior": CoefPrior(shared=True, mean=np.ones((O, P)))},
            r"= \(4,\), since the outputs share",
        ),
        (
            {"coef_prior": CoefPrior(shared=True), "feature_map": Opinionated(prior=(np.ones((O, P)),) * 2)},
            r"= \(4,\), since the outputs",
        ),
        ({"feature_map": Opinionated(prior=(np.full((O, P), "a"),) * 2)}, "coef_prior of .* must be real numbers"),
        ({"feature_map": Opinionated(prior=([[1], [1, 2]], 1))}, "coef_prior of .* must be real numbers"),
        ({"feature_map": Opinionated(prior=3)}, "must return two arrays .* got int"),
        ({"coef_prior": CoefPrior(cov=[[1], [1, 2]])}, "cov of CoefPrior must be real numbers"),
        ({"feature_map": None, "coef_prior": CoefPrior(cov=np.eye(P))}, "cov of CoefPrior needs a feature_map"),
        ({"feature_map": None, "coef_prior": CoefPrior(mean=[1.0] * P)}, "mean of CoefPrior needs a feature_map"),
        ({"coef_prior": CoefPrior(shared="yes")}, "shared of CoefPrior must be"),
        ({"coef_prior": CoefPrior(shared=True), "feature_map": None}, "shared=True of CoefPrior needs a feature_map"),
        ({"sharing": "all"}, "sharing='all' joins outputs by their inducing points"),
        ({"sharing": [[0, 1], [2]]}, "joins outputs by their inducing points"),
        ({"sharing": "kernel", "solver": "adam"}, 'sharing="kernel" of outputs with rows of their own needs'),
    ],
)
def test_invalid_arguments_raise(data, options, message):
    X, Y, _, _, _ = data
    with pytest.raises((ValueError, TypeError), match=f"(?s){message}"):
        EVGPRegressor(
            **{"feature_map": Rows(), "kernel_map": FunctionTransformer(own_columns), "max_iter": 1, **options}
        ).fit(X, Y)


@pytest.mark.parametrize("name", ["kernel_map", "feature_map"])
def test_rows_for_other_outputs_than_those_of_y_raise(data, name):
    X, Y, _, _, _ = data
    with pytest.raises(ValueError, match=rf"{name}=.* returns a row for each of 3 outputs, but y has 2"):
        EVGPRegressor(**{name: FunctionTransformer(own_columns)}).fit(X, Y[:, :2])


@pytest.mark.parametrize("kind", [EVGPRegressor, EGPRegressor])
def test_map_that_changes_between_fit_and_predict_raises(data, kind):
    X, Y, _, _, X_new = data
    model = kind(Rows(), max_iter=0).fit(X, Y)
    model.feature_map_.width = 3
    message = r"must return the same number of columns for all rows; they returned \(4, 3 x 4\) and \(4, 3 x 3\)"
    with pytest.raises(ValueError, match=message):
        model.predict(X_new)
    if kind is EVGPRegressor:
        with pytest.raises(ValueError, match=message):
            model.partial_fit(X, Y)


def test_joint_covariance_is_asked_for_by_name(data):
    X, Y, _, _, X_new = data
    model = EVGPRegressor(max_iter=0, n_inducing=5).fit(X, Y)
    for word in ("all", np.array([1, 2])):
        with pytest.raises(ValueError, match="return_cov must be False, True or 'joint'; got "):
            model.predict(X_new, return_cov=word)
    cov = model.predict(X_new, return_cov=True)[1]
    joint = model.predict(X_new, return_cov="joint")[1].reshape(len(X_new), O, len(X_new), O)
    for i in range(O):
        for j in range(O):
            np.testing.assert_array_equal(joint[:, i, :, j], cov[:, :, i] if i == j else 0.0)


def test_shared_weights_with_known_noise_are_dense_ones(data):
    X, Y, Sigma, mean, X_new = data
    relative = np.random.RandomState(1).uniform(0.2, 5.0, N)
    options = {"kernel_map": FunctionTransformer(own_columns), "noise": Gaussian(variance=0.3), "max_iter": 0}
    options |= {"coef_prior": CoefPrior(shared=True, mean=mean, cov=Sigma)}
    sparse = EVGPRegressor(Rows(), KERNEL, n_inducing=9, random_state=0, **options)
    exact = EGPRegressor(Rows(), KERNEL, **options)
    for model in (sparse, exact):
        model.fit(X, Y, relative_variance=relative)
        Z = model.inducing_points_ if model is sparse else None
        expected = dense(Rows().transform(X), own_columns(X), Y, mean, Sigma, Z, relative)
        check(model, expected, X_new, own_columns(X_new), Rows().transform(X_new))
