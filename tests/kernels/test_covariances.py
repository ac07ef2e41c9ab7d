import pickle

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad
from sklearn.gaussian_process import kernels as sk

from skevgp.fitting.start import checked_variance, starting_table
from skevgp.inference.model import SparseModel
from skevgp.inference.objectives import BoundObjective, ElboObjective
from skevgp.kernels import FunctionKernel
from skevgp.kernels.covariances import Sums
from skevgp.kernels.parse import Start, Starts, parse_kernel
from skevgp.kernels.stationary import Exponential, SquaredExponential, Stationary
from skevgp.rows.blocks import Batch
from skevgp.rows.source import Moments

from ..oracle import ArrayRows, central_differences, problem, relative_error

rng = np.random.RandomState(0)
X, Z = rng.randn(40, 2), rng.randn(7, 2)


def warped(X, Z, lengthscale=1.3, weight=0.4):
    squared = anp.sum((X[:, None, :] - Z[None, :, :]) ** 2, axis=2)
    return anp.exp(-0.5 * squared / lengthscale**2) * (1.0 + weight * anp.dot(X, Z.T)) ** 2


def polynomial(X, Z, bias=0.7):
    return (anp.dot(X, Z.T) + bias) ** 2


def polynomial_diagonal(X, bias=0.7):
    return (anp.sum(X**2, axis=1) + bias) ** 2


SIMPLE = {
    "rbf": sk.RBF(0.8),
    "rbf, ard": sk.RBF([0.8, 1.4]),
    "matern 1/2": sk.Matern(0.9, nu=0.5),
    "matern 3/2, ard": sk.Matern([0.9, 1.5], nu=1.5),
    "matern 5/2": sk.Matern(0.9, nu=2.5),
    "matern inf": sk.Matern([0.7, 1.1], nu=np.inf),
    "matern 0.8": sk.Matern(1.1, nu=0.8),
    "matern 1": sk.Matern(1.1, nu=1.0),
    "matern 1.9, ard": sk.Matern([1.1, 0.6], nu=1.9),
    "matern 7.3": sk.Matern(1.1, nu=7.3),
    "matern 60": sk.Matern(1.1, nu=60.0),
    "rational quadratic": sk.RationalQuadratic(0.9, alpha=0.6),
    "exp sine squared": sk.ExpSineSquared(1.2, periodicity=9.0),
    "dot product": sk.DotProduct(0.7),
    "constant": sk.ConstantKernel(0.6),
    "function": FunctionKernel(warped),
    "function with diagonal": FunctionKernel(polynomial, diagonal=polynomial_diagonal),
}
COMPOSITE = {
    "sum": sk.RBF([0.8, 1.4]) + sk.Matern(0.9, nu=2.5) + 0.3,
    "product": sk.Matern(1.9, nu=1.5) * sk.DotProduct(0.7) * sk.ConstantKernel(0.4),
    "nested": (sk.RBF([1.0, 2.0]) + 0.5 * sk.DotProduct()) * (sk.RationalQuadratic(0.9, 0.6) + sk.ConstantKernel(0.2)),
    "periodic": sk.RBF(3.0) * sk.ExpSineSquared(1.2, 9.0) + 0.1 * sk.Matern(0.5, nu=0.5) + FunctionKernel(polynomial),
}
KERNELS = {**SIMPLE, **COMPOSITE}


def parsed(kernel, centre=None):
    """k̃ of a kernel that shall not lose its outermost constant, and its log hyperparameters."""
    spec = parse_kernel(sk.ConstantKernel() * kernel, 2)
    covariance = spec.covariance if centre is None else spec.covariance.centred(centre)
    return covariance, np.log(spec.starts.hyperparameters.value)


def scalar(covariance, hyperparameters, points, inputs, bars):
    """Σ bars * (k(X_m, X), k(x, x), k(X_m, X_m))."""
    at, prepared = covariance.at(hyperparameters, points), covariance.prepare(inputs)
    diagonal = np.broadcast_to(at.diagonal(prepared), len(inputs))
    return np.vdot(bars[0], at.cross(prepared)) + bars[1] @ diagonal + np.vdot(bars[2], at.matrix())


def pulled_back(covariance, hyperparameters, points, inputs, bars, n_blocks=2):
    at = covariance.at(hyperparameters, points)
    total = at.start_pullback()
    for rows in np.array_split(np.arange(len(inputs)), n_blocks):
        prepared = covariance.prepare(inputs[rows])
        total += at.cross_pullback(prepared, at.cross(prepared), bars[0][:, rows].copy(), bars[1][rows])
    return at.finish_pullback(total, bars[2])


def random_bars(m, n, seed=1):
    state = np.random.RandomState(seed)
    symmetric = state.randn(m, m)
    return state.randn(m, n), state.randn(n), symmetric + symmetric.T


@pytest.mark.parametrize("centre", [None, np.array([3.0, -2.0])])
@pytest.mark.parametrize("name", KERNELS)
def test_covariances_are_scikit_learns(name, centre):
    kernel = KERNELS[name]
    covariance, hyperparameters = parsed(kernel, centre)
    shift = 0.0 if centre is None else centre
    at, prepared = covariance.at(hyperparameters, Z - shift), covariance.prepare(X - shift)
    close = {"rtol": 1e-12, "atol": 1e-12}
    np.testing.assert_allclose(at.matrix(), kernel(Z), **close)
    np.testing.assert_allclose(at.cross(prepared), kernel(Z, X), **close)
    np.testing.assert_allclose(np.broadcast_to(at.diagonal(prepared), 40), kernel.diag(X), **close)
    np.testing.assert_allclose(at.linearised(prepared)[0], at.cross(prepared), **close)


@pytest.mark.parametrize("name", KERNELS)
def test_gradients_in_hyperparameters_are_scikit_learns(name):
    kernel = KERNELS[name]
    covariance, hyperparameters = parsed(kernel)
    _, gradient = kernel(Z, eval_gradient=True)
    assert gradient.shape[2] == len(hyperparameters)
    cross_bar, diagonal_bar, K_bar = random_bars(7, 7)
    expected = np.einsum("ij,ijk->k", cross_bar + K_bar, gradient) + diagonal_bar @ np.einsum("iik->ik", gradient)
    actual, _ = pulled_back(covariance, hyperparameters, Z, Z, (cross_bar, diagonal_bar, K_bar))
    # scikit-learn differentiates a general Matérn by forward differences.
    by_differences = isinstance(kernel, sk.Matern) and kernel.nu not in (0.5, 1.5, 2.5, np.inf)
    np.testing.assert_allclose(actual, expected, rtol=1e-2 if by_differences else 1e-9)


@pytest.mark.parametrize("name", KERNELS)
def test_gradients_agree_with_finite_differences(name):
    covariance, hyperparameters = parsed(KERNELS[name], np.array([0.3, -0.2]))
    bars, p = random_bars(7, 40), len(hyperparameters)

    def value(flat):
        return scalar(covariance, flat[:p], flat[p:].reshape(7, 2), X, bars)

    hyper_bar, Z_bar = pulled_back(covariance, hyperparameters, Z, X, bars)
    actual = np.concatenate([hyper_bar, Z_bar.ravel()])
    expected = central_differences(value, np.concatenate([hyperparameters, Z.ravel()]), 1e-5)
    assert np.abs(actual - expected).max() < 1e-7 * max(np.abs(expected).max(), 1.0)


def plain(kernel, A, B, values):
    """The formulas in plain autograd.numpy; takes the hyperparameters' values off the front of a list."""
    if isinstance(kernel, sk.KernelOperator):
        left, right = plain(kernel.k1, A, B, values), plain(kernel.k2, A, B, values)
        return left + right if isinstance(kernel, sk.Sum) else left * right
    if isinstance(kernel, FunctionKernel):
        own = {hyperparameter.name: values.pop(0) for hyperparameter in kernel.hyperparameters}
        return kernel.function(A, B, **own)
    if isinstance(kernel, sk.ConstantKernel):
        return values.pop(0) * np.ones((len(A), len(B)))
    if isinstance(kernel, sk.DotProduct):
        return values.pop(0) ** 2 + A @ B.T
    own = values.pop(0) if isinstance(kernel, sk.RationalQuadratic | sk.ExpSineSquared) else None
    ard = getattr(kernel, "anisotropic", False)
    lengths = anp.array([values.pop(0) for _ in range(2 if ard else 1)])
    squared = anp.sum(((A[:, None, :] - B[None, :, :]) / lengths) ** 2, axis=2)
    if isinstance(kernel, sk.RationalQuadratic):
        return (1.0 + squared / (2.0 * own)) ** -own
    if isinstance(kernel, sk.ExpSineSquared):
        return anp.exp(-2.0 * (anp.sin(np.pi * anp.sqrt(squared)) / own) ** 2)
    nu = getattr(kernel, "nu", np.inf)
    if nu == np.inf:
        return anp.exp(-0.5 * squared)
    t = anp.sqrt(2.0 * nu * squared)
    return {0.5: 1.0, 1.5: 1.0 + t, 2.5: 1.0 + t + t**2 / 3.0}[nu] * anp.exp(-t)


CLOSED_FORM = [name for name, kernel in KERNELS.items() if getattr(kernel, "nu", 0.5) in (0.5, 1.5, 2.5, np.inf)]


@pytest.mark.parametrize("name", CLOSED_FORM)
def test_gradients_of_the_rows_agree_with_autograd(name):
    kernel = KERNELS[name]
    covariance, hyperparameters = parsed(kernel)
    cross_bar, p = random_bars(7, 40)[0], len(hyperparameters)

    def value(flat):
        points = flat[p:].reshape(7, 2)
        return anp.sum(cross_bar * plain(kernel, points, X, [anp.exp(flat[i]) for i in range(p)]))

    flat = np.concatenate([hyperparameters, Z.ravel()])
    hyper_bar, Z_bar = pulled_back(covariance, hyperparameters, Z, X, (cross_bar, np.zeros(40), np.zeros((7, 7))))
    assert relative_error(np.concatenate([hyper_bar, Z_bar.ravel()]), grad(value)(flat)) < 1e-9


@pytest.mark.parametrize("nu", [30.0, 60.5, 100.0, 150.0])
def test_matern_where_bessel_functions_overflow(nu):
    """1 - ν r² / 2(ν - 1) + ν² r⁴ / 8(ν - 1)(ν - 2) - ..., from exact fractions; scikit-learn's is inf there."""
    covariance, hyperparameters = parsed(sk.Matern(1.0, nu=nu))
    r = np.array([0.0, 1e-8, 1e-4, 1e-3, 1e-2])
    points = np.column_stack([r, np.zeros(5)])
    first, second = nu / (2.0 * (nu - 1.0)), nu**2 / (8.0 * (nu - 1.0) * (nu - 2.0))
    expected = 1.0 - first * r**2 + second * r**4
    np.testing.assert_allclose(covariance.at(hyperparameters, points).matrix()[0], expected, rtol=1e-12)
    E = -0.5 * r**2
    slope, _ = covariance.profile.derivatives(E, expected, np.empty(0))
    np.testing.assert_allclose(slope, 2.0 * first - 4.0 * second * r**2, rtol=1e-8)


def test_a_profile_of_the_general_class_is_the_squared_exponential():
    hyperparameters = np.log([0.8, 1.4])
    special, general = SquaredExponential(2), Stationary(Exponential(), 2)
    bars = random_bars(7, 40)
    for one, other in zip(
        pulled_back(special, hyperparameters, Z, X, bars),
        pulled_back(general, hyperparameters, Z, X, bars),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.parametrize("name", KERNELS)
def test_what_a_worker_receives_can_be_pickled(name):
    covariance, hyperparameters = parsed(KERNELS[name])
    again, at = pickle.loads(pickle.dumps((covariance, covariance.at(hyperparameters, Z))))
    assert again == covariance
    prepared = covariance.prepare(X)
    total = at.cross_pullback(prepared, at.cross(prepared), np.ones((7, 40)), 1.0)
    total = pickle.loads(pickle.dumps(total)) + total
    expected = pulled_back(covariance, hyperparameters, Z, X, (np.ones((7, 40)), np.ones(40), np.zeros((7, 7))), 1)
    for one, other in zip(at.finish_pullback(total, np.zeros((7, 7))), expected, strict=True):
        np.testing.assert_allclose(one, 2.0 * other, rtol=1e-10, atol=1e-10)


def test_what_depends_on_differences_only_is_stationary():
    moving = {"dot product", "function", "function with diagonal", "product", "nested", "periodic"}
    assert {name for name, kernel in KERNELS.items() if not parsed(kernel)[0].stationary} == moving


def test_sums_add_side_by_side():
    total = Sums((np.ones(2), Sums((1.0, np.zeros(3)))))
    total += Sums((np.ones(2), Sums((2.0, np.ones(3)))))
    assert total[1][0] == 3.0
    np.testing.assert_array_equal(total[0], [2.0, 2.0])
    np.testing.assert_array_equal(total[1][1], [1.0, 1.0, 1.0])


ROUGH = [sk.Matern(1.0, nu=0.3), sk.Matern(1.0, nu=0.5), sk.Matern([1.0, 2.0], nu=1.0)]


@pytest.mark.parametrize("kernel", [*ROUGH, *SIMPLE.values()], ids=repr)
def test_coincident_points(kernel):
    """X_m = X with duplicates, far from the origin: k(x, x) keeps its digits and gradients stay finite."""
    inputs = 1e3 * np.vstack([X, X[:5]])
    # Away from the origin the dot products are large, not 1.
    covariance, hyperparameters = parsed(kernel)
    at = covariance.at(hyperparameters, inputs)
    U = at.cross(covariance.prepare(inputs))
    smooth = kernel not in ROUGH and getattr(kernel, "nu", 1.5) not in (0.5, 0.8, 1.0)
    np.testing.assert_allclose(U, at.matrix(), rtol=1e-8, atol=1e-7 if smooth else 1e-12)
    for gradient in pulled_back(covariance, hyperparameters, inputs, inputs, random_bars(45, 45)):
        assert np.isfinite(gradient).all()


def test_matern_gradients_next_to_coincident_points():
    """The kink of exp(-r) at r = 0: on either side of it, and 1e-6 of the inputs' size away from it."""
    covariance, hyperparameters = parsed(sk.Matern([1.0, 0.7], nu=0.5))
    points = X[:7] + 1e-6 * rng.randn(7, 2)
    bars = random_bars(7, 40)

    def value(flat):
        return scalar(covariance, hyperparameters, flat.reshape(7, 2), X, (*bars[:2], np.zeros((7, 7))))

    _, Z_bar = pulled_back(covariance, hyperparameters, points, X, (*bars[:2], np.zeros((7, 7))))
    expected = central_differences(value, points.ravel(), 1e-9).reshape(7, 2)
    np.testing.assert_allclose(Z_bar, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", KERNELS)
def test_extreme_hyperparameters_and_distances_are_finite(name):
    """To the corners of scikit-learn's default bounds and well beyond, on inputs of any size, without warnings."""
    kernel = KERNELS[name]
    covariance, hyperparameters = parsed(kernel)
    for inputs_scale in (1e-12, 1.0, 1e12):
        points, inputs = inputs_scale * Z, inputs_scale * np.vstack([X, Z])
        for corner in (-5.0, 5.0, -30.0, 30.0):
            for which in (np.full(len(hyperparameters), True), rng.rand(len(hyperparameters)) < 0.5):
                at_corner = np.where(which, corner * np.log(10.0) * np.ones(len(hyperparameters)), hyperparameters)
                at, prepared = covariance.at(at_corner, points), covariance.prepare(inputs)
                assert np.isfinite(at.matrix()).all()
                assert np.isfinite(at.cross(prepared)).all()
                assert np.isfinite(at.diagonal(prepared)).all()
                for gradient in pulled_back(covariance, at_corner, points, inputs, random_bars(7, 47)):
                    assert np.isfinite(gradient).all()


def model_with(kernel, shared=True, **sizes):
    """The small problem of the oracle with another kernel."""
    model, rows, table = problem("full", shared, **sizes)
    # Inputs as an estimator hands them over: centred, the covariance told so.
    centre = rows.inputs.mean(axis=0) + np.array([0.5, -0.3])
    spec = parse_kernel(sk.ConstantKernel() * kernel, 2)
    covariance = spec.covariance.centred(centre)
    first = spec.starts.hyperparameters.value
    points = table["inducing_points"].start - centre
    rows = ArrayRows(rows.inputs - centre, rows.features, rows.residuals)
    starts = Starts(spec.starts.hyperparameters, Start(np.array([0.7])), Start(np.array([0.2])))
    variance = checked_variance(covariance, first, points[0])
    table = starting_table(
        Moments.of(rows.inputs), points, np.ones(2), starts, np.ones(2), 1e-2, covariance.n_hyperparameters, variance
    )
    return SparseModel(covariance, model.prior, "full", model.groups), rows, table


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "shared"),
    [*((name, True) for name in KERNELS if name != "constant"), ("matern 5/2", False), ("nested", False)],
)
def test_gradient_of_the_bound_agrees_with_finite_differences(name, shared):
    """Σ k(x, x) enters the bound too."""
    model, rows, table = model_with(KERNELS[name], shared=shared)
    objective = BoundObjective(model, table, rows.blocks(model.kernel, 17))
    _, gradient = objective(table.start())
    assert relative_error(gradient, central_differences(lambda x: objective(x)[0], table.start(), 1e-5)) < 1e-5


@pytest.mark.parametrize("name", ["matern 5/2", "nested", "function"])
def test_gradient_of_the_papers_loss_agrees_with_finite_differences(name):
    model, rows, table = model_with(KERNELS[name], n=30, m=4, p=2)
    elbo = ElboObjective(model, table, rows.blocks(model.kernel, 30))
    block = rows.blocks(model.kernel, 30)[0]
    objective = elbo.minibatch(iter([Batch(block)] * 1000))
    x = elbo.table.start() + 0.1 * np.random.RandomState(1).randn(elbo.table.size)
    _, gradient = objective(x)
    assert relative_error(gradient, central_differences(lambda x: objective(x)[0], x, 1e-5)) < 1e-5


def test_the_value_of_a_bound_that_depends_on_the_diagonal():
    """Titsias 2009, eq. 9, written down from matrices, for a covariance that is not stationary."""
    kernel = KERNELS["nested"]
    model, rows, table = model_with(kernel)
    values = table.values(table.start())
    centre = model.kernel.parts[0].parts[1].parts[1].centre
    inputs, points = rows.inputs + centre, values["inducing_points"][0] + centre
    K = kernel(points) + 1e-12 * np.diag(kernel.diag(points))
    V = np.linalg.solve(np.linalg.cholesky(K), kernel(points, inputs))
    expected = 0.0
    for o in range(2):
        prior, noise, signal = model.prior, values["noise"][o], values["signal"][o]
        H = rows.features * prior.scale[o]
        r = rows.residuals[:, o] + H @ prior.reference[o]
        covariance = signal * V.T @ V + H @ H.T + noise * np.eye(60)
        quadratic = r @ np.linalg.solve(covariance, r)
        expected -= 0.5 * (60 * np.log(2 * np.pi) + np.linalg.slogdet(covariance)[1] + quadratic)
        expected -= 0.5 * signal * (kernel.diag(inputs).sum() - (V**2).sum()) / noise
    found, _ = BoundObjective(model, table, rows.blocks(model.kernel, 17))(table.start())
    assert found == pytest.approx(-expected / 60, rel=1e-8)


@pytest.mark.parametrize(
    ("kernel", "message"),
    [
        (FunctionKernel(lambda X, Z: X @ Z.T - 10.0), "positive semi-definite"),
        (FunctionKernel(lambda X, Z: 0.0 * X @ Z.T), "positive semi-definite and not 0"),
        (FunctionKernel(lambda X, Z: X @ Z.T + X[:, :1]), "must be symmetric"),
        (FunctionKernel(lambda X, Z: X @ Z.T / 0.0), "not finite"),
        (FunctionKernel(lambda X, Z: np.exp(X @ Z.T)[:-1]), r"<lambda> must return an array of shape \(7, 7\); it has"),
        (FunctionKernel(polynomial, diagonal=lambda X, bias: X[:, 0] ** 2), "does not return the k"),
        (FunctionKernel(lambda X, Z: 1.0), r"must return an array of shape \(7, 7\); it has \(\)"),
        (FunctionKernel(lambda X, Z: np.array([[float(x @ z) for z in Z] for x in X])), "cannot be traced by autograd"),
    ],
)
def test_kernels_that_do_not_work_on_the_points_say_why(kernel, message):
    covariance, hyperparameters = parsed(kernel)
    with pytest.raises(ValueError, match=message):
        checked_variance(covariance, np.exp(hyperparameters), Z)
