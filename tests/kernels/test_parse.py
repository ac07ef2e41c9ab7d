import pickle
import warnings

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.spatial.distance import cdist
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import (
    RBF,
    CompoundKernel,
    ConstantKernel,
    DotProduct,
    Exponentiation,
    ExpSineSquared,
    Matern,
    PairwiseKernel,
    RationalQuadratic,
    WhiteKernel,
)

from skevgp import EVGPRegressor
from skevgp.kernels import FunctionKernel
from skevgp.kernels.constant import Constant
from skevgp.kernels.covariances import Product, Sum
from skevgp.kernels.dot_product import DotProduct as DotProductCovariance
from skevgp.kernels.parse import parse_kernel
from skevgp.kernels.stationary import SquaredExponential

rng = np.random.RandomState(0)
X, Z = rng.randn(20, 2), rng.randn(6, 2)


def test_coincident_points_have_covariance_one_at_most():
    kernel = SquaredExponential(2)
    at = kernel.at(np.log([1e-3, 1e-3]), 1e3 * X)
    U = at.cross(kernel.prepare(1e3 * X))
    assert U.max() <= 1.0
    np.testing.assert_allclose(np.diag(U), 1.0, atol=0.05)


def smooth(X, Z, lengthscale=1.0, weight=0.5):
    squared = anp.sum((X[:, None, :] - Z[None, :, :]) ** 2, axis=2)
    return anp.exp(-0.5 * squared / lengthscale**2) * (1.0 + weight * anp.dot(X, Z.T))


@pytest.mark.parametrize(
    ("kernel", "tree", "covariance"),
    [
        (RBF(0.5), 1.0 * RBF(0.5), SquaredExponential(2, True)),
        (2.0 * RBF([0.5, 1.0]), 2.0 * RBF([0.5, 1.0]), SquaredExponential(2)),
        (RBF(0.5) * ConstantKernel(4.0), RBF(0.5) * 4.0, SquaredExponential(2, True)),
        (RBF(0.5) + WhiteKernel(0.1), 1.0 * RBF(0.5), SquaredExponential(2, True)),
        (WhiteKernel(0.1) + 4.0 * RBF(0.5), 4.0 * RBF(0.5), SquaredExponential(2, True)),
        (Matern(nu=np.inf), 1.0 * Matern(nu=np.inf), SquaredExponential(2, True)),
        (ConstantKernel(4.0), 1.0 * ConstantKernel(4.0), Constant()),
        (DotProduct(), 1.0 * DotProduct(), DotProductCovariance()),
        (
            2.0 * RBF() + 0.25,
            1.0 * (2.0 * RBF() + 0.25),
            Sum((Product((Constant(), SquaredExponential(2, True))), Constant())),
        ),
        (
            ConstantKernel(4) * (RBF([1, 2]) + 0.5 * DotProduct()) + WhiteKernel(),
            4.0 * (RBF([1, 2]) + 0.5 * DotProduct()),
            Sum((SquaredExponential(2), Product((Constant(), DotProductCovariance())))),
        ),
        (
            RBF() + WhiteKernel() + DotProduct(),
            1.0 * (RBF() + DotProduct()),
            Sum((SquaredExponential(2, True), DotProductCovariance())),
        ),
        # Of two constant factors the outer one is the signal variance.
        (
            (9.0 * RBF()) * 4.0,
            9.0 * RBF() * 4.0,
            Product((Constant(), SquaredExponential(2, True))),
        ),
    ],
    ids=str,
)
def test_trees_are_read(kernel, tree, covariance):
    spec = parse_kernel(kernel, 2)
    assert spec.tree == tree
    assert spec.covariance == covariance
    assert len(spec.starts.hyperparameters.value) == covariance.n_hyperparameters


def test_the_outer_constant_is_the_signal_variance():
    assert parse_kernel((9.0 * RBF()) * 4.0, 2).starts.signal.value == 4.0
    assert parse_kernel(9.0 * RBF() * DotProduct(), 2).starts.signal.value == 9.0
    assert parse_kernel(RBF() + 1.0, 2).starts.signal.value is None


def test_the_same_kernel_twice_has_hyperparameters_twice():
    constant, rbf = ConstantKernel(2.0), RBF()
    spec = parse_kernel(constant * (rbf + constant * rbf), 2)
    assert spec.covariance.n_hyperparameters == 3
    assert spec.starts.signal.value == 2.0


@pytest.mark.parametrize(
    ("kernel", "named"),
    [
        (PairwiseKernel(metric="laplacian"), "PairwiseKernel"),
        (RBF() + Matern() * PairwiseKernel(), "PairwiseKernel"),
        (RBF() ** 2, "Exponentiation"),
        (RBF() + Exponentiation(RBF(), 2) * 2.0, "Exponentiation"),
        (CompoundKernel([RBF(), RBF()]), "CompoundKernel"),
        ((RBF() + WhiteKernel()) * ConstantKernel(), "WhiteKernel"),
        (RBF() + RBF() * WhiteKernel(), "WhiteKernel"),
        (type("Own", (RBF,), {})(), "Own"),
    ],
)
def test_what_does_not_work_is_named_with_what_does(kernel, named):
    with pytest.raises(ValueError, match=rf"{named} does not work in this place.* These work: ConstantKernel, RBF"):
        parse_kernel(kernel, 2)


@pytest.mark.parametrize(
    "kernel", [WhiteKernel(), WhiteKernel() + WhiteKernel(), RBF() + WhiteKernel() + WhiteKernel()]
)
def test_noise_is_one_term_of_several(kernel):
    with pytest.raises(ValueError, match="of WhiteKernel there can be one"):
        parse_kernel(kernel, 2)


@pytest.mark.parametrize("kernel", ["rbf", RBF, 1.0])
def test_what_is_not_a_kernel_is_a_type_error(kernel):
    with pytest.raises(TypeError, match="kernel must be a kernel of"):
        EVGPRegressor(kernel=kernel).fit(X, X[:, 0])


def test_length_scales_must_fit_the_columns():
    with pytest.raises(ValueError, match="3 length scales, but its inputs have 2 columns"):
        EVGPRegressor(kernel=RBF([1.0, 2.0, 3.0])).fit(X, X[:, 0])


@pytest.mark.parametrize(
    ("kernel", "message"),
    [
        (RBF(0.0), "length_scale must be between"),
        (RBF(-1.0), "length_scale must be between"),
        (RBF(np.nan), "length_scale must be between"),
        (RBF(1e-300, "fixed"), "length_scale must be between"),
        (ConstantKernel(-1.0) * RBF(), "constant_value must be between"),
        (ConstantKernel(0.0, "fixed") * RBF(), "constant_value must be between"),
        (RBF() + WhiteKernel(np.nan), "noise_level must be between"),
        (RBF() + WhiteKernel(0.0, "fixed"), "noise_level must be between"),
        (DotProduct(0.0, "fixed"), "sigma_0 must be between"),
        (RationalQuadratic(alpha=-1.0), "alpha must be between"),
        (RBF() + ConstantKernel(0.0), "constant_value must be between"),
        (Matern(nu=-1.0), "nu must be above 0"),
        (Matern(nu=np.nan), "nu must be above 0"),
        (Matern(nu=1000.0), "at most 150, or inf; got 1000.0"),
        (RBF(1.0, (10.0, 0.1)), "length_scale_bounds must be above 0, the lower ones first"),
        (RBF(1.0, (np.nan, 10.0)), "length_scale_bounds must be above 0"),
        (RBF() + WhiteKernel(1.0, (-1.0, 10.0)), "noise_level_bounds must be above 0"),
        (ExpSineSquared(1.0, 1.0, (1.0, 2.0), (0.0, 2.0)), "periodicity_bounds must be above 0"),
    ],
)
def test_values_and_bounds_out_of_range_are_named(kernel, message):
    with pytest.raises(ValueError, match=message):
        parse_kernel(kernel, 2)


def fitted(kernel, **arguments):
    y = np.sin(2 * X[:, 0]) + 0.1 * np.random.RandomState(1).randn(20)
    return EVGPRegressor(kernel=kernel, n_inducing=8, random_state=0, **arguments).fit(X, y)


def test_fixed_parameters_stay():
    kernel = ConstantKernel(2.0, "fixed") * RBF(0.5, "fixed") + WhiteKernel(0.03, "fixed")
    model = fitted(kernel)
    assert model.kernel_ == ConstantKernel(2.0, "fixed") * RBF(0.5, "fixed")
    assert model.noise_variance_ == pytest.approx(0.03, rel=1e-12)
    assert model.n_parameters_ == 8 * 2 + 8 + 8 * 9 // 2


def test_bounds_are_respected_and_come_back():
    kernel = ConstantKernel(2.0, (1.9, 2.1)) * RBF([0.5, 0.5], [(0.4, 0.6), (0.45, 0.55)]) + WhiteKernel(
        0.5, (0.4, 0.6)
    )
    model = fitted(kernel)
    assert 1.9 <= model.kernel_.k1.constant_value <= 2.1
    assert (model.kernel_.k2.length_scale >= [0.4, 0.45]).all()
    assert (model.kernel_.k2.length_scale <= [0.6, 0.55]).all()
    assert 0.4 <= model.noise_variance_ <= 0.6
    np.testing.assert_allclose(model.kernel_.k1.constant_value_bounds, (1.9, 2.1))
    np.testing.assert_allclose(model.kernel_.k2.length_scale_bounds, [(0.4, 0.6), (0.45, 0.55)])


def test_starts_are_the_users():
    model = fitted(ConstantKernel(3.0) * RBF(0.5) + WhiteKernel(0.2), max_iter=0)
    assert model.kernel_.k1.constant_value == pytest.approx(3.0)
    assert model.kernel_.k2.length_scale == pytest.approx(0.5)
    assert model.noise_variance_ == pytest.approx(0.2)


def test_the_users_kernel_is_left_alone():
    kernel = ConstantKernel(2.0) * RBF([0.5, 1.0]) + WhiteKernel(0.1)
    before = repr(kernel)
    fitted(kernel)
    assert repr(kernel) == before


def test_the_fitted_kernel_is_a_valid_start_again():
    model = fitted(None)
    again = fitted(model.kernel_, noise_variance=model.noise_variance_, max_iter=0)
    np.testing.assert_allclose(again.kernel_.theta, model.kernel_.theta, rtol=1e-9)


def test_outputs_have_their_own_signal_variance_and_share_the_shape():
    Y = np.column_stack([np.sin(X[:, 0]), 100.0 * np.cos(X[:, 0])])
    model = EVGPRegressor(n_inducing=8, random_state=0, tol=1.0).fit(X, Y)
    first, second = model.kernel_
    np.testing.assert_array_equal(first.k2.length_scale, second.k2.length_scale)
    assert second.k1.constant_value > 100.0 * first.k1.constant_value


def test_noise_from_two_sides_is_an_error():
    with pytest.raises(ValueError, match="noise_variance=0.1 or from the WhiteKernel"):
        fitted(RBF(1.0) + WhiteKernel(0.1), noise_variance=0.1)


# --- other kernels -----------------------------------------------------------------------------------------------

TREES = {
    "matern 1/2": Matern(0.8, nu=0.5),
    "matern 3/2": 2.0 * Matern([0.8, 1.5], nu=1.5),
    "matern 5/2": Matern(0.8, nu=2.5) * 3.0,
    "matern 0.8": Matern(0.8, nu=0.8),
    "matern 3.1": Matern([0.8, 1.1], nu=3.1),
    "matern inf": Matern(0.8, nu=np.inf),
    "rational quadratic": 2.0 * RationalQuadratic(0.8, 0.7),
    "exp sine squared": ExpSineSquared(1.5, 12.0),
    "dot product": DotProduct(0.5),
    "constant": ConstantKernel(2.0),
    "sum with a bias": 2.0 * RBF([0.7, 0.9]) + 0.1,
    "nested": ConstantKernel(4) * (RBF([1, 2]) + 0.5 * DotProduct()) + WhiteKernel(0.02),
    "product": RBF(2.0) * ExpSineSquared(1.0, 10.0) + RationalQuadratic() * DotProduct() + WhiteKernel(0.02),
    "function": ConstantKernel(2.0) * FunctionKernel(smooth) + WhiteKernel(0.02),
    "function and others": FunctionKernel(smooth, {"weight": 0.1}) * Matern() + 0.3,
}
Y = np.column_stack([np.sin(2 * X[:, 0]) + X[:, 1], 5.0 * np.cos(X[:, 1])]) + 0.1 * np.random.RandomState(1).randn(
    20, 2
)
X_NEW = np.random.RandomState(2).randn(15, 2)


@pytest.mark.parametrize("sharing", ["all", "none"])
@pytest.mark.parametrize("name", TREES)
def test_inducing_points_at_all_rows_give_the_exact_gp(name, sharing):
    kernel = TREES[name]
    noise = None if "WhiteKernel" in str(kernel) else 0.02
    offset = np.array([2.0, -1.0])
    model = EVGPRegressor(kernel=kernel, noise_variance=noise, n_inducing=20, max_iter=0, sharing=sharing)
    model.fit(X + offset, Y)
    mean, std = model.predict(X_NEW + offset, return_std=True, include_noise=False)
    _, cov = model.predict(X_NEW + offset, return_cov=True, include_noise=False)
    bound = 0.0
    for o in range(2):
        gpr = GaussianProcessRegressor(model.kernel_[o], alpha=model.noise_variance_[o], optimizer=None)
        gpr.fit(X + offset, Y[:, o])
        exact_mean, exact_cov = gpr.predict(X_NEW + offset, return_cov=True)
        np.testing.assert_allclose(mean[:, o], exact_mean, atol=1e-6)
        np.testing.assert_allclose(std[:, o], np.sqrt(np.diag(exact_cov)), atol=1e-6)
        np.testing.assert_allclose(cov[:, :, o], exact_cov, atol=1e-6)
        bound += gpr.log_marginal_likelihood_value_
    assert model.lower_bound_ == pytest.approx(bound, abs=1e-4)


@pytest.mark.parametrize("name", TREES)
def test_a_fit_gains_and_comes_back_as_the_same_tree(name):
    kernel = TREES[name]
    start, end = (fitted(kernel, max_iter=n, tol=1.0) for n in (0, None))
    assert end.lower_bound_ > start.lower_bound_
    assert np.isfinite(end.predict(X_NEW, return_std=True)).all()
    tree = parse_kernel(kernel, 2).tree
    assert [(h.name, h.n_elements) for h in end.kernel_.hyperparameters] == [
        (h.name, h.n_elements) for h in tree.hyperparameters
    ]
    spec = parse_kernel(kernel, 2)
    if spec.starts.signal.value is not None:
        np.testing.assert_array_equal(end.kernel_.bounds, tree.bounds)
        np.testing.assert_allclose(start.kernel_.theta, tree.theta)
    again = fitted(end.kernel_ + WhiteKernel(end.noise_variance_, "fixed"), max_iter=0)
    np.testing.assert_allclose(again.kernel_.theta, end.kernel_.theta, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["matern 5/2", "nested", "function"])
def test_adam_serves_other_kernels(name):
    start, end = (fitted(TREES[name], solver="adam", max_iter=n) for n in (0, 60))
    assert end.lower_bound_ > start.lower_bound_


@pytest.mark.parametrize("name", ["matern 1/2", "nested", "function"])
def test_samples_follow_the_covariance(name):
    model = fitted(TREES[name], max_iter=0)
    mean, cov = model.predict(X_NEW, return_cov=True)
    samples = model.sample_y(X_NEW, 4000)
    np.testing.assert_allclose(samples.mean(axis=1), mean, atol=0.1 * np.sqrt(cov.max()))
    np.testing.assert_allclose(np.cov(samples), cov, atol=0.15 * cov.max())


@pytest.mark.parametrize("name", ["matern 5/2", "nested", "function"])
def test_partial_fit_and_pickles_keep_other_kernels(name):
    kernel, y = TREES[name], Y[:, 0]
    noise = None if "WhiteKernel" in str(kernel) else 0.02
    arguments = {"kernel": kernel, "noise_variance": noise, "n_inducing": 12, "max_iter": 0}
    # Distinct rows, no more than inducing points: those are the points; the units of y are those of the first rows.
    model = EVGPRegressor(**arguments).fit(X[:12] + 1.0, y[:12])
    model.partial_fit(X[12:] + 1.0, y[12:])
    model = pickle.loads(pickle.dumps(model))
    Z, k = X[:12] + 1.0, model.kernel_
    V = np.linalg.solve(np.linalg.cholesky(k(Z) + 1e-12 * np.diag(k.diag(Z))), k(Z, np.vstack([X, X_NEW]) + 1.0))
    B = np.eye(12) + V[:, :20] @ V[:, :20].T / model.noise_variance_
    expected = V[:, 20:].T @ np.linalg.solve(B, V[:, :20] @ y) / model.noise_variance_
    np.testing.assert_allclose(model.predict(X_NEW + 1.0), expected, atol=1e-6)


def test_a_signal_variance_that_is_not_given_matches_the_scatter():
    """s² Σ k̃(x, x) / n is the mean square of y, however large k̃ is."""
    y = 100.0 * Y[:, 0]
    for kernel in (RBF(), DotProduct(30.0), RBF() + 0.001 * DotProduct(), FunctionKernel(smooth)):
        model = EVGPRegressor(kernel=kernel, n_inducing=20, max_iter=0).fit(X, y)
        assert np.mean(model.kernel_.diag(X)) == pytest.approx(np.mean(y**2), rel=1e-6)
        low, high = np.exp(model.kernel_.bounds[0])
        assert low == pytest.approx(1e-8 * model.kernel_.k1.constant_value)
        assert high == pytest.approx(1e2 * model.kernel_.k1.constant_value)


def test_single_hyperparameters_can_be_fixed():
    kernel = 2.0 * (
        RBF([0.5, 1.0], "fixed") + ConstantKernel(0.5) * RationalQuadratic(1.5, 0.7, "fixed", (0.1, 5.0))
    ) + WhiteKernel(0.1)
    model = fitted(kernel, tol=1.0)
    rbf, scaled = model.kernel_.k2.k1, model.kernel_.k2.k2
    assert rbf == RBF([0.5, 1.0], "fixed")
    assert scaled.k2.length_scale == 1.5
    assert scaled.k2.length_scale_bounds == "fixed"
    assert scaled.k2.alpha != 0.7
    assert scaled.k2.alpha_bounds == (0.1, 5.0)
    assert scaled.k1.constant_value != 0.5
    # The constant of the sum, alpha, signal variance and noise; then inducing points and q.
    assert model.n_parameters_ == 2 + 2 + 8 * 2 + 8 + 8 * 9 // 2
    assert fitted(kernel, solver="adam", max_iter=3).kernel_.k2.k1 == rbf


def test_a_warm_start_takes_over_hyperparameters_of_the_same_kernel_only():
    y = Y[:, 0]
    model = EVGPRegressor(kernel=RBF([1.0, 1.0]), n_inducing=8, random_state=0, tol=1.0, warm_start=True).fit(X, y)
    learned = model.kernel_.k2.length_scale
    model.set_params(max_iter=0).fit(X, y)
    np.testing.assert_allclose(model.kernel_.k2.length_scale, learned)
    model.set_params(kernel=RationalQuadratic(0.9, 0.7)).fit(X, y)
    assert model.kernel_.k2 == RationalQuadratic(0.9, 0.7)
    model.set_params(kernel=FunctionKernel(smooth)).fit(X, y)
    assert model.kernel_.k2.get_params()["lengthscale"] == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("name", TREES)
def test_nasty_data_are_fitted(name, scale):
    """Duplicates, a constant column, targets without noise and of any size: no error, no NaN."""
    inputs = np.column_stack([np.repeat(X[:10, 0], 3), np.full(30, 0.3)])
    y = scale * np.round(np.sin(3 * inputs[:, 0]), 2)
    kernel = TREES[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = EVGPRegressor(kernel=kernel, n_inducing=15, max_iter=30, random_state=0).fit(inputs, y)
    mean, std = model.predict(inputs, return_std=True)
    assert np.isfinite(mean).all()
    assert (std > 0.0).all()


# --- users' functions --------------------------------------------------------------------------------------------


def test_a_function_is_a_kernel():
    model, same = fitted(smooth, tol=1.0), fitted(FunctionKernel(smooth), tol=1.0)
    assert model.kernel_ == same.kernel_
    assert isinstance(model.kernel_.k2, FunctionKernel)
    np.testing.assert_array_equal(model.predict(X_NEW), same.predict(X_NEW))


def test_a_function_kernel_is_a_scikit_learn_kernel():
    kernel = FunctionKernel(smooth, {"weight": 0.2}, {"weight": "fixed"})
    assert repr(kernel) == "FunctionKernel(smooth, lengthscale=1, weight=0.2)"
    assert [(h.name, h.fixed) for h in kernel.hyperparameters] == [("lengthscale", False), ("weight", True)]
    np.testing.assert_allclose(kernel.theta, [0.0])
    np.testing.assert_allclose(np.exp(kernel.bounds), [[1e-5, 1e5]])
    other = clone(kernel).set_params(lengthscale=2.0)
    assert (kernel.get_params()["lengthscale"], other.get_params()["lengthscale"]) == (1.0, 2.0)
    assert other != kernel
    assert clone(other) == other == pickle.loads(pickle.dumps(other))
    assert other.clone_with_theta(kernel.theta) == clone(kernel).set_params(lengthscale=1.0)
    composite = 2.0 * kernel + WhiteKernel()
    assert composite.set_params(k1__k2__lengthscale=3.0).k1.k2.values["lengthscale"] == 3.0
    assert not kernel.is_stationary()
    assert kernel(X, X_NEW).shape == (20, 15)
    np.testing.assert_allclose(kernel.diag(X), np.diag(kernel(X)))


def test_function_kernels_work_in_the_exact_gp():
    kernel = FunctionKernel(smooth, values_bounds={"weight": (0.01, 10.0)})
    _, gradient = kernel(X, eval_gradient=True)
    for index, step in enumerate(1e-6 * np.eye(2)):
        up, down = kernel.clone_with_theta(kernel.theta + step), kernel.clone_with_theta(kernel.theta - step)
        np.testing.assert_allclose(gradient[:, :, index], (up(X) - down(X)) / 2e-6, atol=1e-7)
    kernel = 2.0 * FunctionKernel(smooth, values_bounds={"weight": "fixed"}) + WhiteKernel(0.1)
    gpr = GaussianProcessRegressor(kernel).fit(X, Y[:, 0])
    start = GaussianProcessRegressor(kernel, optimizer=None).fit(X, Y[:, 0])
    assert gpr.log_marginal_likelihood_value_ > start.log_marginal_likelihood_value_ + 0.1
    assert FunctionKernel(smooth, values_bounds="fixed")(X, eval_gradient=True)[1].shape == (20, 20, 0)
    with pytest.raises(ValueError, match="only be evaluated when Y is None"):
        FunctionKernel(smooth)(X, X, eval_gradient=True)


def test_a_function_of_the_users_for_the_diagonal_is_used():
    def diagonal(X, lengthscale=1.0, weight=0.5):
        return 1.0 + weight * anp.sum(X**2, axis=1)

    with_it, without = fitted(FunctionKernel(smooth, diagonal=diagonal)), fitted(FunctionKernel(smooth))
    assert with_it.lower_bound_ == pytest.approx(without.lower_bound_, rel=1e-6)

    def wrong(X, **_):
        return 1.0

    with pytest.raises(ValueError, match="wrong must return an array of shape"):
        fitted(FunctionKernel(smooth, diagonal=wrong))


def test_other_defaults_than_floats_are_no_hyperparameters():
    def power(X, Z, degree=2, bias=1.0, name=None):
        return (anp.dot(X, Z.T) + bias) ** degree

    kernel = FunctionKernel(power)
    assert [h.name for h in kernel.hyperparameters] == ["bias"]
    assert fitted(kernel, tol=1.0).kernel_.k2.function is power


def test_a_function_without_hyperparameters():
    model = fitted(lambda X, Z: anp.exp(-anp.sum((X[:, None] - Z[None]) ** 2, axis=2)), tol=1.0)
    assert repr(model.kernel_.k2) == "FunctionKernel(<lambda>)"
    assert model.n_parameters_ == 2 + 8 * 2 + 8 + 8 * 9 // 2


def test_a_function_that_is_0_at_a_row():
    inputs = np.arange(10.0).reshape(-1, 1)
    model = EVGPRegressor(kernel=lambda X, Z: X @ Z.T, n_inducing=10, random_state=0).fit(inputs, 3.0 * inputs[:, 0])
    mean, std = model.predict(inputs, return_std=True)
    np.testing.assert_allclose(mean, 3.0 * inputs[:, 0], atol=1e-3)
    assert (std > 0.0).all()


def negative(X, Z, shift=-1.0):
    return X @ Z.T


def taken(X, Z, values=1.0):
    return X @ Z.T


@pytest.mark.parametrize(
    ("kernel", "message"),
    [
        (FunctionKernel(negative), r"Hyperparameters of negative must be positive; got \{'shift': -1.0\}"),
        (FunctionKernel(taken), r"taken needs other names for its hyperparameters \['values'\]"),
        (FunctionKernel(smooth, {"length": 1.0}), r"values names \['length'\]; the hyperparameters of smooth"),
        (FunctionKernel(smooth, values_bounds={"length": (1, 2)}), r"values_bounds names \['length'\]"),
        (FunctionKernel(smooth, {"weight": 0.0}), "must be positive"),
        (FunctionKernel(lambda X, Z: np.exp(-cdist(X, Z))), "<lambda> cannot be traced by autograd: write it with"),
        (FunctionKernel(lambda X, Z: X @ Z.T * np.nan), r"kernel: k\(X, X\) is not finite"),
        (FunctionKernel(lambda X, Z: X), "must return an array of shape"),
    ],
)
def test_functions_that_do_not_work_say_why(kernel, message):
    with pytest.raises(ValueError, match=message):
        fitted(kernel)


def test_the_exact_gp_is_told_of_numbers_that_are_not_finite():
    with pytest.raises(ValueError, match="returned numbers that are not finite"):
        FunctionKernel(lambda X, Z: X @ Z.T * np.nan)(X)


def kinked(X, Z, scale=1.0):
    return anp.exp(-anp.sqrt(anp.sum((X[:, None, :] - Z[None, :, :]) ** 2, axis=2)) / scale)


def test_a_function_without_a_gradient_at_distance_zero_is_named():
    with pytest.raises(ValueError, match=r"gradient is not finite where x = x'"):
        EVGPRegressor(kernel=kinked, n_inducing=5, random_state=0).fit(X, Y[:, 0])


class Callable:
    def __call__(self, X, Z, scale=1.0):
        return smooth(X, Z, scale)


def test_warm_starts_know_callable_objects_again():
    m = EVGPRegressor(kernel=Callable(), n_inducing=8, warm_start=True, random_state=0).fit(X, Y[:, 0])
    expected = m.kernel_.theta
    np.testing.assert_allclose(m.set_params(max_iter=0).fit(X, Y[:, 0]).kernel_.theta, expected, rtol=1e-9)


@pytest.mark.parametrize("bounds", [3.0, {"scale": 3.0}, (1.0, 2.0, 3.0)])
def test_bounds_of_a_function_are_pairs(bounds):
    with pytest.raises(ValueError, match="values_bounds"):
        EVGPRegressor(kernel=FunctionKernel(Callable().__call__, values_bounds=bounds)).fit(X, Y[:, 0])
