"""The likelihood and the bound as functions of the kernel's hyperparameters."""

import copy
import pickle

import dask.array as da
import numpy as np
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, ExpSineSquared, Matern, RationalQuadratic
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.kernels import Cosine
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS

RNG = np.random.RandomState(0)
X = RNG.uniform(-2, 2, (40, 2))
Y = np.column_stack([5 * np.sin(2 * X[:, 0]) + X[:, 1], 3 * np.cos(X[:, 1]) * X[:, 0]]) + 0.3 * RNG.randn(40, 2)
TREND = PolynomialFeatures(1)
KERNELS = {
    "constant in front": 2.0 * RBF([1.0, 2.0]),
    "none": RBF(1.5),
    "constant behind": Matern([1.0, 2.0], nu=2.5) * ConstantKernel(3.0),
    "of two the outer": (9.0 * RBF()) * 0.5,
    "in the middle": RBF(1.5) * ConstantKernel(2.0) * RationalQuadratic(2.0, 3.0),
    "sum": 2.0 * RBF([1.0, 3.0]) + 0.5 * DotProduct(1.5),
    "product of a sum": 2.0 * (Matern(nu=1.5) + DotProduct(0.5) * RBF(2.0)),
    "fixed signal": ConstantKernel(4.0, "fixed") * RBF([1.0, 2.0]),
    "fixed shape": 4.0 * RBF([1.0, 2.0], "fixed"),
    "one fixed of several": 2.0 * RationalQuadratic(2.0, 3.0, alpha_bounds="fixed") + DotProduct(1.5),
    "periodic": 2.0 * ExpSineSquared(2.0, 3.0) * RBF(1.5),
    "ours": 1.5 * Cosine(3.0) * RBF(2.0),
}


def start(regressor=EGPRegressor, kernel=None, y=Y[:, 0], **arguments):
    """A model whose kernel is where the user said."""
    kernel = 2.0 * RBF([1.0, 2.0]) if kernel is None else kernel
    return regressor(kernel=kernel, noise=Gaussian(variance=0.1), **({"max_iter": 0} | arguments)).fit(X, y)


def elsewhere(model, seed=0):
    kernels = model.kernel_ if isinstance(model.kernel_, list) else [model.kernel_]
    theta = np.array([kernel.theta for kernel in kernels])
    theta += np.random.RandomState(seed).uniform(-0.5, 0.5, theta.shape)
    return theta if isinstance(model.kernel_, list) else theta[0]


def numerical_gradient(function, theta):
    """Good to 1e-7: central differences."""
    flat = np.ravel(theta)
    return np.array(
        [
            (function((flat + step).reshape(theta.shape)) - function((flat - step).reshape(theta.shape))) / 2e-5
            for step in 1e-5 * np.eye(len(flat))
        ]
    ).reshape(theta.shape)


@pytest.mark.parametrize("name", KERNELS)
def test_the_likelihood_is_scikit_learns(name):
    model = start(kernel=KERNELS[name])
    oracle = GaussianProcessRegressor(model.kernel_, alpha=model.noise_variance_, optimizer=None).fit(X, Y[:, 0])
    for theta in (model.kernel_.theta, elsewhere(model), elsewhere(model, 1)):
        actual, expected = (gp.log_marginal_likelihood(theta, eval_gradient=True) for gp in (model, oracle))
        assert actual[0] == pytest.approx(expected[0], rel=1e-9)
        np.testing.assert_allclose(actual[1], expected[1], rtol=1e-6, atol=1e-8)
        assert model.log_marginal_likelihood(theta) == actual[0]


@pytest.mark.parametrize("name", KERNELS)
def test_the_bound_with_all_rows_as_inducing_points_is_the_likelihood(name):
    exact = start(kernel=KERNELS[name])
    sparse = start(EVGPRegressor, KERNELS[name], inducing_init=X)
    theta = elsewhere(exact)
    actual, expected = sparse.lower_bound(theta, eval_gradient=True), exact.log_marginal_likelihood(theta, True)
    assert actual[0] == pytest.approx(expected[0], abs=1e-5)
    np.testing.assert_allclose(actual[1], expected[1], atol=1e-4)


def dense_likelihood(model, theta, y, scale):
    """log N(y | 0, K + H Σ Hᵀ + σ² I) (Rasmussen & Williams 2006, eq. 2.43), and its gradient by eq. 5.9."""
    K, K_theta = model.kernel_.clone_with_theta(theta)(X, eval_gradient=True)
    H = TREND.fit_transform(X)
    C = K + scale**2 * H @ H.T + model.noise_variance_ * np.eye(len(X))
    alpha, (_, log_det) = np.linalg.solve(C, y), np.linalg.slogdet(C)
    inner = np.outer(alpha, alpha) - np.linalg.inv(C)
    value = -0.5 * (y @ alpha + log_det + len(y) * np.log(2 * np.pi))
    return value, 0.5 * np.einsum("ij,ijk->k", inner, K_theta)


def test_with_features_the_likelihood_is_the_dense_one():
    model = start(feature_map=TREND, coef_mean=0.0, coef_scale=2.0)
    theta = elsewhere(model)
    value, gradient = model.log_marginal_likelihood(theta, eval_gradient=True)
    expected = dense_likelihood(model, theta, Y[:, 0], 2.0)
    assert value == pytest.approx(expected[0], rel=1e-9)
    np.testing.assert_allclose(gradient, expected[1], atol=1e-7)
    bound = start(EVGPRegressor, feature_map=TREND, coef_mean=0.0, coef_scale=2.0, inducing_init=X)
    assert bound.lower_bound(theta) == pytest.approx(expected[0], abs=1e-5)


@pytest.mark.parametrize("posterior", ["full", "diagonal"])
@pytest.mark.parametrize("options", [{}, {"feature_map": TREND}, {"normalize_y": True}], ids=["", "map", "normalised"])
def test_the_gradient_of_the_bound_is_the_numerical_one(posterior, options):
    model = start(EVGPRegressor, n_inducing=6, posterior=posterior, random_state=0, **options)
    theta = elsewhere(model)
    value, gradient = model.lower_bound(theta, eval_gradient=True)
    assert model.lower_bound(theta) == value
    np.testing.assert_allclose(gradient, numerical_gradient(model.lower_bound, theta), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("scale", [2.0, np.inf])
def test_the_gradient_of_the_likelihood_is_the_numerical_one(scale):
    model = start(feature_map=TREND, coef_scale=scale, y=100.0 * Y[:, 0])
    theta = elsewhere(model)
    _, gradient = model.log_marginal_likelihood(theta, eval_gradient=True)
    expected = numerical_gradient(model.log_marginal_likelihood, theta)
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-4)
    assert model.log_marginal_likelihood(model.kernel_.theta) == pytest.approx(model.log_marginal_likelihood_value_)


@pytest.mark.parametrize("feature_map", [None, TREND], ids=str)
def test_the_bound_is_below_the_likelihood(feature_map):
    exact = start(feature_map=feature_map)
    sparse = start(EVGPRegressor, feature_map=feature_map, n_inducing=6, random_state=0)
    for seed in range(5):
        theta = elsewhere(exact, seed)
        assert sparse.lower_bound(theta) < exact.log_marginal_likelihood(theta)


def value_of(model):
    return model.log_marginal_likelihood if isinstance(model, EGPRegressor) else model.lower_bound


def fitted_value(model):
    return model.log_marginal_likelihood_value_ if isinstance(model, EGPRegressor) else model.lower_bound_


@pytest.mark.parametrize(
    "model",
    [EGPRegressor(tol=1e-7), EVGPRegressor(n_inducing=8, solver=LBFGS(tol=1e-7), random_state=0)],
    ids=["exact", "sparse"],
)
def test_a_fit_ends_where_the_gradient_vanishes(model):
    model = model.fit(X, Y[:, 0])
    value, gradient = value_of(model)(model.kernel_.theta, eval_gradient=True)
    assert value == pytest.approx(fitted_value(model), abs=1e-6)
    lower, upper = model.kernel_.bounds.T
    inside = (model.kernel_.theta > lower + 1e-6) & (model.kernel_.theta < upper - 1e-6)
    assert inside.sum() >= 2
    np.testing.assert_allclose(gradient[inside], 0.0, atol=0.05)
    # Elsewhere it is not.
    assert np.abs(value_of(model)(model.kernel_.theta - 1.0, eval_gradient=True)[1][inside]).max() > 0.5


@pytest.mark.parametrize(
    ("regressor", "options"),
    [
        (EGPRegressor, {}),
        *((EVGPRegressor, {"sharing": sharing, "n_inducing": 6}) for sharing in ("all", "kernel", "none")),
    ],
)
@pytest.mark.parametrize("feature_map", [None, TREND], ids=str)
def test_several_outputs_have_a_theta_each(regressor, options, feature_map):
    model = start(regressor, y=Y, feature_map=feature_map, random_state=0, **options)
    assert value_of(model)([kernel.theta for kernel in model.kernel_]) == pytest.approx(fitted_value(model), rel=1e-9)
    theta = elsewhere(model)
    value, gradient = value_of(model)(theta, eval_gradient=True)
    np.testing.assert_allclose(gradient, numerical_gradient(value_of(model), theta), rtol=1e-5, atol=1e-4)
    # They are independent: one's theta changes what the other has by nothing.
    other = theta + [[0.0], [0.3]]
    np.testing.assert_array_equal(value_of(model)(other, eval_gradient=True)[1][0], gradient[0])
    assert value_of(model)(other) != value


def test_threads_change_nothing():
    models = [start(EVGPRegressor, n_inducing=6, n_jobs=n_jobs, random_state=0) for n_jobs in (1, 2)]
    theta = elsewhere(models[0])
    (one, first), (other, second) = (model.lower_bound(theta, eval_gradient=True) for model in models)
    assert one == other
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("regressor", [EGPRegressor, EVGPRegressor])
def test_without_theta_it_is_the_fitted_value(regressor):
    model = start(regressor, random_state=0)
    assert value_of(model)() == fitted_value(model)
    with pytest.raises(ValueError, match="Gradient can only be evaluated for theta!=None"):
        value_of(model)(eval_gradient=True)
    with pytest.raises(NotFittedError):
        value_of(regressor())()


@pytest.mark.parametrize("regressor", [EGPRegressor, EVGPRegressor])
def test_a_theta_that_does_not_fit_is_an_error(regressor):
    one, two = start(regressor, random_state=0), start(regressor, y=Y, random_state=0)
    for model, theta in [(one, [0.0]), (one, np.zeros((1, 3))), (two, np.zeros(3)), (two, np.zeros((3, 3)))]:
        with pytest.raises(ValueError, match="theta must be of shape"):
            value_of(model)(theta)
    for wrong in (np.nan, np.inf, 400.0, -400.0):
        with pytest.raises(ValueError, match="theta must be logarithms of numbers from 1e-100 to 1e"):
            value_of(one)([0.0, wrong, 0.0])
    with pytest.raises(ValueError, match="theta must be real numbers"):
        value_of(one)(["a", "b", "c"])


@pytest.mark.parametrize("regressor", [EGPRegressor, EVGPRegressor])
def test_a_kernel_that_overflows_is_infinitely_unlikely(regressor):
    model = start(regressor, DotProduct(1.0) * DotProduct(1.0), random_state=0)
    assert value_of(model)([0.0, 230.0, 230.0]) == -np.inf
    value, gradient = value_of(model)([0.0, 230.0, 230.0], eval_gradient=True)
    assert value == -np.inf
    np.testing.assert_array_equal(gradient, np.zeros(3))


@pytest.mark.parametrize("regressor", [EGPRegressor, EVGPRegressor])
def test_it_changes_nothing_in_the_model(regressor):
    model = start(regressor, random_state=0)
    before = model.kernel_.theta, model.predict(X)
    value_of(model)(elsewhere(model), eval_gradient=True)
    np.testing.assert_array_equal(model.kernel_.theta, before[0])
    np.testing.assert_array_equal(model.predict(X), before[1])


@pytest.mark.parametrize("y", [Y[:, 0], Y], ids=["one output", "two outputs"])
def test_a_theta_stays_in_a_kernel_that_is_not_cloned(y):
    model = start(y=y)
    theta, before = elsewhere(model), model.predict(X)
    model.log_marginal_likelihood(theta, clone_kernel=False)
    kernels = model.kernel_ if y.ndim == 2 else [model.kernel_]
    np.testing.assert_allclose([kernel.theta for kernel in kernels], np.atleast_2d(theta), atol=1e-12)
    np.testing.assert_array_equal(model.predict(X), before)


# --- the rows that a bound needs ---------------------------------------------------------------------------------


def test_dask_has_the_same_bound():
    there = EVGPRegressor(
        TREND, KERNELS["constant in front"], inducing_init=X[:6], noise=Gaussian(variance=0.1), max_iter=0
    )
    here = copy.deepcopy(there).fit(X, Y[:, 0])
    there = there.fit(da.from_array(X, chunks=(15, 2)), da.from_array(Y[:, 0], chunks=15))
    theta = elsewhere(here)
    for actual, expected in zip(there.lower_bound(theta, True), here.lower_bound(theta, True), strict=True):
        np.testing.assert_allclose(actual, expected, rtol=1e-8)


def test_rows_of_a_file_are_not_copied(tmp_path):
    np.save(tmp_path / "X.npy", X)
    mapped = np.load(tmp_path / "X.npy", mmap_mode="r")
    model = EVGPRegressor(n_inducing=6, max_iter=0, random_state=0).fit(mapped, Y[:, 0])
    expected = EVGPRegressor(n_inducing=6, max_iter=0, random_state=0).fit(X, Y[:, 0])
    theta = elsewhere(model)
    assert model.lower_bound(theta) == expected.lower_bound(theta)
    assert any(np.shares_memory(kept, mapped) for kept in model._training_data)


@pytest.mark.parametrize("again", [lambda model: pickle.loads(pickle.dumps(model)), copy.copy, copy.deepcopy])
def test_copies_have_no_rows(again):
    model = again(start(EVGPRegressor, n_inducing=6, random_state=0))
    assert model.lower_bound() == model.lower_bound_
    with pytest.raises(ValueError, match="copies and pickles of a model leave them out"):
        model.lower_bound(model.kernel_.theta)
    model.fit(X, Y[:, 0])
    assert model.lower_bound(model.kernel_.theta) == pytest.approx(model.lower_bound_, rel=1e-9)


def test_pickles_do_not_grow_with_the_rows():
    def size(repeats):
        model = EVGPRegressor(kernel=RBF(), inducing_init=X[:6], max_iter=0)
        return len(pickle.dumps(model.fit(np.tile(X, (repeats, 1)), np.tile(Y[:, 0], repeats))))

    assert size(100) < size(1) + 500


def test_partial_fit_keeps_no_rows():
    model = EVGPRegressor(n_inducing=6, max_iter=0, random_state=0).partial_fit(X[:30], Y[:30, 0])
    assert model.lower_bound(model.kernel_.theta) == pytest.approx(model.lower_bound_, rel=1e-9)
    model.partial_fit(X[30:], Y[30:, 0])
    assert model.lower_bound() == model.lower_bound_
    with pytest.raises(ValueError, match="partial_fit keeps none"):
        model.lower_bound(model.kernel_.theta)


def test_after_adam_q_is_at_its_optimum():
    model = EVGPRegressor(n_inducing=6, solver="adam", max_iter=50, random_state=0).fit(X, Y[:, 0])
    assert model.lower_bound(model.kernel_.theta) >= model.lower_bound_ - 1e-6


def test_the_gradient_knows_that_a_jitter_is_a_share_of_the_diagonal():
    """Three points on a line, of a linear kernel: K is singular, and a diagonal q's bound has the logarithm of what a
    jitter makes of its least eigenvalue. That is noisy: differences need wide steps."""
    x = np.append(np.zeros(7), [0.25, -0.25])[:, np.newaxis]
    kernel = ConstantKernel(1.0, "fixed") * DotProduct(1.0)
    model = EVGPRegressor(
        kernel=kernel, inducing_init=x[6:], solver=LBFGS(posterior="diagonal"), noise=Gaussian(variance=0.1), max_iter=0
    )
    model.fit(x, RNG.randn(9))
    theta = model.kernel_.theta
    slope = (model.lower_bound(theta + 0.01) - model.lower_bound(theta - 0.01)) / 0.02
    assert model.lower_bound(theta, eval_gradient=True)[1] == pytest.approx(slope, abs=0.1)
