import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, Matern, WhiteKernel

from skevgp import EVGPRegressor
from skevgp.kernels import SquaredExponential, parse_kernel

rng = np.random.RandomState(0)
X, Z = rng.randn(20, 2), rng.randn(6, 2)


@pytest.mark.parametrize("lengths", [[0.7], [0.5, 1.5]])
def test_the_covariance_is_scikit_learns(lengths):
    kernel = SquaredExponential(2, isotropic=len(lengths) == 1)
    at = kernel.at(np.log(lengths), Z)
    reference = RBF(lengths if len(lengths) > 1 else lengths[0])
    np.testing.assert_allclose(at.matrix(), reference(Z), rtol=1e-13)
    np.testing.assert_allclose(at.cross(kernel.prepare(X)), reference(Z, X), rtol=1e-12)
    np.testing.assert_allclose(kernel.traceable_matrices(np.log(lengths), Z[np.newaxis])[0], reference(Z), rtol=1e-12)


def test_coincident_points_have_covariance_one_at_most():
    kernel = SquaredExponential(2)
    at = kernel.at(np.log([1e-3, 1e-3]), 1e3 * X)
    U = at.cross(kernel.prepare(1e3 * X))
    assert U.max() <= 1.0
    np.testing.assert_allclose(np.diag(U), 1.0, atol=0.05)


@pytest.mark.parametrize(
    "kernel",
    [
        RBF(0.5),
        ConstantKernel(2.0) * RBF([0.5, 1.0]),
        RBF(0.5) * ConstantKernel(2.0),
        RBF(0.5) + WhiteKernel(0.1),
        WhiteKernel(0.1) + ConstantKernel(2.0) * RBF(0.5),
    ],
)
def test_kernels_that_work(kernel):
    assert parse_kernel(kernel, 2).starts.hyperparameters.value is not None


@pytest.mark.parametrize(
    "kernel",
    [
        Matern(),
        DotProduct(),
        RBF() + RBF(),
        RBF() * RBF(),
        ConstantKernel() + RBF(),
        ConstantKernel(),
        WhiteKernel(),
        RBF() + WhiteKernel() + WhiteKernel(),
        (RBF() + WhiteKernel()) * ConstantKernel(),
        RBF() ** 2,
    ],
)
def test_kernels_that_do_not_work_yet_say_what_does(kernel):
    with pytest.raises(ValueError, match="does not work yet. These work: RBF"):
        parse_kernel(kernel, 2)


@pytest.mark.parametrize("kernel", ["rbf", RBF, lambda a, b: 0.0])
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
        (RBF(1.0, (10.0, 0.1)), "length_scale_bounds must be above 0, the lower ones first"),
        (RBF(1.0, (np.nan, 10.0)), "length_scale_bounds must be above 0"),
        (RBF() + WhiteKernel(1.0, (-1.0, 10.0)), "noise_level_bounds must be above 0"),
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
