"""Where fits start, how often, and what they say when they end badly."""

import warnings

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, ExpSineSquared, WhiteKernel
from sklearn.preprocessing import PolynomialFeatures

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS

RNG = np.random.RandomState(0)
X = RNG.uniform(-2, 2, (120, 2))
Y = np.column_stack([np.sin(3 * X[:, 0]) * X[:, 1], np.cos(2 * X[:, 1])]) + 0.01 * RNG.randn(120, 2)
Z = RNG.uniform(-2, 2, (7, 2))


def model(**arguments):
    return EVGPRegressor(
        **{
            "n_inducing": 8,
            "sharing": "all",
            "random_state": 0,
            "solver": LBFGS(tol=0.1),
            "noise_cv": None,
            **arguments,
        }
    )


# --- n_restarts ------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("sharing", ["all", "kernel", "none"])
def test_restarts_keep_the_best_bound(sharing):
    first_bounds = []

    def look(iteration, bound, outputs):
        if iteration == 1:
            first_bounds.append(bound)

    once = model(sharing=sharing, inducing_init="k-means").fit(X, Y)
    solver = LBFGS(n_restarts=3, callback=look, tol=0.1)
    often = model(sharing=sharing, inducing_init="k-means", solver=solver).fit(X, Y)
    assert often.lower_bound_ >= once.lower_bound_
    # None from where another one started.
    assert len(set(first_bounds)) == len(first_bounds) >= 4
    assert -often.loss_curve_[-1] == pytest.approx(often.lower_bound_, abs=0.1)
    assert len(often.loss_curve_) == often.n_iter_


def test_ctrl_c_ends_the_restarts_with_the_best_so_far():
    calls = []

    def interrupt(iteration, bound, outputs):
        calls.append(iteration)
        # In the second iteration of the second start.
        if calls.count(2) == 2:
            raise KeyboardInterrupt

    with pytest.warns(ConvergenceWarning, match="interrupted"):
        m = model(
            inducing_init="k-means", random_state=1, solver=LBFGS(n_restarts=50, callback=interrupt, tol=0.1)
        ).fit(X, Y)
    # The first start is the best one that a fit without restarts tries.
    assert m.lower_bound_ == model(inducing_init="k-means", random_state=1).fit(X, Y).lower_bound_
    assert calls.count(2) == 2


# --- inducing_init -----------------------------------------------------------------------------------------------


def test_replacing_points_finds_relevant_columns():
    """Among ten columns the target knows one: clusters spread over all of them, the learned kernel does not."""
    rng = np.random.RandomState(0)
    x = rng.uniform(-3.0, 3.0, (400, 10))
    y = np.sin(3.0 * x[:, 0]) + 0.01 * rng.randn(400)
    first, auto = (model(n_inducing=16, inducing_init=init).fit(x, y) for init in ("k-means", "auto"))
    assert auto.lower_bound_ > first.lower_bound_ + 10.0
    assert auto.n_iter_ == len(auto.loss_curve_)
    assert auto.lower_bound_ == pytest.approx(-auto.loss_curve_[-1], abs=1e-3)


def test_given_points_replace_n_inducing_and_stay_without_iterations():
    m = model(inducing_init=Z, max_iter=0).fit(X, Y)
    np.testing.assert_allclose(m.inducing_points_, Z, atol=1e-14)
    np.testing.assert_allclose(
        model(inducing_init=Z.tolist(), sharing="kernel", max_iter=0).fit(X, Y).inducing_points_, [Z, Z], atol=1e-14
    )
    assert model(inducing_init=Z, solver=LBFGS(tol=10.0)).fit(X, Y).lower_bound_ > m.lower_bound_


@pytest.mark.parametrize(
    ("init", "message"),
    [
        (np.ones((4, 3)), r"inducing_init must be .* shape \(m, 2\).* got the shape \(4, 3\)"),
        (np.ones(2), r"got the shape \(2,\)"),
        (np.empty((0, 2)), r"got the shape \(0, 2\)"),
        ([[1.0, np.nan]], "inducing_init must be finite"),
        ([["a", "b"]], "inducing_init must be real numbers"),
        ([[1e200, 0.0]], "inducing_init must not exceed"),
        ("random", "'inducing_init' parameter"),
    ],
)
def test_invalid_inducing_points(init, message):
    with pytest.raises(ValueError, match=message):
        model(inducing_init=init).fit(X, Y)


# --- what a fit says when it ends badly --------------------------------------------------------------------------


def test_noise_that_explains_everything_warns():
    """One inducing point cannot follow forty waves, whatever the start."""
    x = np.linspace(0, 1, 800)[:, np.newaxis]
    y = np.column_stack([np.sin(80 * np.pi * x[:, 0]), np.random.RandomState(0).randn(800)])
    with pytest.warns(
        ConvergenceWarning, match=r"noise explains the whole residual .* for 1 of 2 outputs .* raise n_inducing"
    ):
        model(n_inducing=1).fit(x, y)


@pytest.mark.long
@pytest.mark.parametrize("sharing", ["all", "none"])
def test_targets_far_from_their_prior_mean_warn(sharing):
    with pytest.warns(ConvergenceWarning, match=r"more than 10000 times its scatter .* Set normalize_y=True"):
        model(sharing=sharing).fit(X, Y + [0.0, 1e6])
    line = model(feature_map=PolynomialFeatures(1), solver=LBFGS(tol=1.0), sharing=sharing)
    with pytest.warns(ConvergenceWarning, match="The weights of 1.* are .* or raise the scale of coef_prior"):
        clone(line).set_params(coef_prior=CoefPrior(scale=10.0)).fit(X, Y + 1e6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert model(n_inducing=30, normalize_y=True).fit(X, Y + 1e6).score(X, Y + 1e6) > 0.99
        assert line.set_params(n_inducing=30).fit(X, Y + 1e6).score(X, Y + 1e6) > 0.99


def test_targets_whose_squares_vanish_raise():
    with pytest.raises(ValueError, match=r"y must be 0 or exceed 1e-140 in size; a column's largest value is 1.*e-150"):
        model().fit(X, 1e-150 * Y)
    assert model().fit(X, np.zeros(len(X))).predict(X) == pytest.approx(np.zeros(len(X)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_as_many_points_as_rows_do_not_explain_the_noise(seed):
    """From a low first noise alone, such fits end on a plateau on which the kernel explains every row by itself."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2, 2, (60, 3))
    y = np.sin(2 * X[:, 0]) + 0.3 * X.sum(axis=1) + 0.1 * rng.randn(60)
    model = EVGPRegressor(random_state=0).fit(X, y)
    fewer = EVGPRegressor(n_inducing=50, noise=Gaussian(variance=0.05), random_state=0).fit(X, y)
    assert model.lower_bound_ > fewer.lower_bound_ - 1.0
    assert 1e-3 < model.noise_variance_ < 0.1


def test_kernel_that_explains_less_than_noise_is_tried_from_other_starts():
    rng = np.random.RandomState(0)
    X = np.sort(rng.uniform(-2, 2, (60, 1)), axis=0)
    y = np.sin(2 * X[:, 0]) + 0.3 * X[:, 0] + 0.1 * rng.randn(60)
    model = EVGPRegressor(kernel=ExpSineSquared(), n_inducing=60, random_state=0).fit(X, y)
    assert model.lower_bound_ > -0.5 * 60 * (np.log(2 * np.pi * np.mean(y**2)) + 1.0)


@pytest.mark.long
def test_warm_start_that_leads_nowhere_is_left():
    cold = model(n_inducing=12).fit(1e3 * X, Y)
    warm = model(n_inducing=12, warm_start=True).fit(X, Y).fit(1e3 * X, Y)
    assert warm.lower_bound_ > cold.lower_bound_ - 0.02 * abs(cold.lower_bound_)


@pytest.mark.parametrize("make", [EGPRegressor, lambda: EVGPRegressor(n_inducing=30, noise_cv=None, random_state=0)])
def test_polynomial_asks_for_a_signal_far_above_its_scatter(make):
    """A cubic is a long lengthscale and a high signal; a limit of ten times the scatter costs ten nats and more."""
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (60, 2))
    y = (X**3 - X).sum(axis=1)
    y = y / y.std() + 0.01 * rng.randn(60)
    free = make().fit(X, y)
    kernel = ConstantKernel(1.0, (1e-8, 1e2)) * RBF([1.0, 1.0], (1e-2, 1e4))
    with pytest.warns(ConvergenceWarning, match="k1__constant_value is close to the specified upper bound 100"):
        narrow = make().set_params(kernel=kernel).fit(X, y)
    bound = "lower_bound_" if isinstance(free, EVGPRegressor) else "log_marginal_likelihood_value_"
    assert free.kernel_.k1.constant_value > 200.0
    assert getattr(free, bound) > getattr(narrow, bound) + 5.0


def alone(fitted, X, y):
    """The likelihood of features and noise without a kernel, at the best noise variance."""
    H = fitted.feature_map_.transform(X)
    mean = np.ravel(fitted.coef_prior_mean_)
    r = y - (np.mean(y) if fitted.normalize_y else 0.0) - H @ mean
    K = (H * np.ravel(fitted.coef_prior_scale_) ** 2) @ H.T
    variances, vectors = np.linalg.eigh(K)
    squares, variances = (vectors.T @ r) ** 2, np.maximum(variances, 0.0)
    noises = np.var(y) * np.geomspace(1e-10, 10.0, 2000)[:, np.newaxis]
    total = variances + noises
    return np.max(-0.5 * (np.log(2.0 * np.pi * total) + squares / total).sum(axis=1))


@pytest.mark.parametrize("shift", [0.0, 1e8])
@pytest.mark.parametrize("noise", [1e-2, 1.0])
def test_features_that_interpolate_do_not_hide_the_noise(noise, shift):
    """What they leave over is rounding; the fit is still not below features with the noise that suits them best."""
    rng = np.random.RandomState(0)
    few = rng.randn(10, 5)
    y = shift + few @ rng.randn(5) + noise * rng.randn(10)
    fitted = model(
        feature_map=PolynomialFeatures(), coef_prior=CoefPrior(scale=1e3), normalize_y=True, n_inducing=10
    ).fit(few, y)
    assert fitted.lower_bound_ > alone(fitted, few, y) - 0.2
    mean, std = fitted.predict(few, return_std=True)
    assert (np.abs(y - mean) < 4 * std + 1e-9 * shift).all()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("max_iter", [20, 200])
def test_many_more_features_than_rows_find_a_noise_that_rounding_does_not_outweigh(max_iter, seed):
    """Whether the fits before have ended or not."""
    rng = np.random.RandomState(seed)
    few, y = rng.randn(5, 60), rng.randn(5)
    fitted = model(feature_map=PolynomialFeatures(degree=1), normalize_y=True, n_inducing=5, max_iter=max_iter)
    fitted.fit(few, y)
    # No more than that either: there is nothing else to learn.
    assert fitted.lower_bound_ == pytest.approx(alone(fitted, few, y), abs=0.2)


def test_fit_with_one_parameter_is_restarted():
    x, numbers = np.linspace(0.0, 3.0, 15)[:, np.newaxis], {0: [], 2: []}
    y = np.sin(2.0 * x[:, 0]) + 0.1 * np.random.RandomState(0).randn(15)
    kernel = ConstantKernel(1.0, "fixed") * RBF(1.0, "fixed") + WhiteKernel(0.3)
    for n_restarts, seen in numbers.items():
        solver = LBFGS(n_restarts=n_restarts, callback=lambda number, *_, seen=seen: seen.append(number))
        EVGPRegressor(kernel=kernel, inducing_init=x, solver=solver, noise_cv=None, random_state=0).fit(x, y)
    assert numbers[2].count(1) == 3 * numbers[0].count(1) > 0


def test_column_that_a_sample_misses_is_learned():
    """Noise of the size of the signal: on 1000 rows, the wave in the first column looks like noise."""
    rng = np.random.default_rng(1)
    X = rng.uniform(-1.0, 1.0, (6000, 6))
    signal = 2.0 * X[:, 1] + X[:, 2] ** 2 + 0.8 * np.sin(5.0 * X[:, 0])
    y = signal + rng.standard_normal(6000)
    model = EVGPRegressor(n_inducing=40, noise_cv=None, random_state=1).fit(X[:5000], y[:5000])
    assert model.score(X[5000:], signal[5000:]) > 0.95


@pytest.mark.parametrize("seed", range(4))
def test_short_waves_are_not_taken_for_noise(seed):
    """A product of waves along two columns, beside a column with a line and one of zeros and ones."""
    rng = np.random.default_rng(seed)
    n = 3200
    X = np.column_stack([rng.uniform(0.0, 4.0, (n, 2)), rng.lognormal(4.5, 0.4, n), rng.integers(0, 2, n)])
    y = 5.0 * np.sin(3.0 * X[:, 0]) * np.cos(3.0 * X[:, 1]) + 0.05 * X[:, 2] + 3.0 * X[:, 3]
    y += rng.standard_normal(n)
    model = EVGPRegressor(normalize_y=True, random_state=0, noise_cv=None).fit(X, y)
    assert model.noise_variance_ == pytest.approx(1.0, abs=0.4)
