import autograd.numpy as anp
import dask.array as da
import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from skevgp import BayesianMLPRegressor, CoefPrior, EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS

RNG = np.random.RandomState(0)
X = RNG.uniform(-2, 2, (50, 2))
Y = np.column_stack([np.sin(2 * X[:, 0]) + X[:, 1], 3 * np.cos(X[:, 1]) * X[:, 0]]) + 0.05 * RNG.randn(50, 2)
X_NEW = RNG.uniform(-2.5, 2.5, (30, 2))
TREND = PolynomialFeatures(1)
FIXED = ConstantKernel(1.4, "fixed") * RBF([0.9, 1.6], "fixed")


def fixed(noise=0.01, **arguments):
    """A model whose kernel and noise stay."""
    return EGPRegressor(**{"kernel": FIXED, "noise": Gaussian(variance=noise), "max_iter": 0} | arguments)


# --- agreement with other models ----------------------------------------------------------------------------------


def test_exact_fit_equals_sparse_fit_with_all_points():
    exact = EGPRegressor(TREND, tol=1e-4).fit(X, Y[:, 0])
    sparse = EVGPRegressor(TREND, inducing_init=X, solver=LBFGS(tol=1e-4), noise_cv=None).fit(X, Y[:, 0])
    assert sparse.lower_bound_ == pytest.approx(exact.log_marginal_likelihood_value_, abs=0.01)
    np.testing.assert_allclose(sparse.predict(X_NEW), exact.predict(X_NEW), atol=0.01)
    # At the same kernel and noise they are the same but for the jitter of the sparse model.
    kernel, noise = exact.kernel_, exact.noise_variance_
    same = EVGPRegressor(TREND, kernel, inducing_init=X, noise=Gaussian(variance=noise), max_iter=0).fit(X, Y[:, 0])
    for actual, expected in zip(same.predict(X, return_std=True), exact.predict(X, return_std=True), strict=True):
        np.testing.assert_allclose(actual, expected, atol=1e-6)


# --- vague weights ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", [[True, True, True], [False, True, False]], ids=["all", "one"])
def test_vague_weights_are_the_limit_of_wide_ones(which):
    def at(scale):
        prior = CoefPrior(mean=0.2, scale=np.where(which, scale, 0.7))
        return fixed(feature_map=TREND, coef_prior=prior).fit(X, Y[:, 0])

    def limit(of):
        """Extrapolated in 1 / scale²."""
        first, second = of(at(200.0), 200.0), of(at(400.0), 400.0)
        return (4.0 * second - first) / 3.0

    vague, k = at(np.inf), np.sum(which)
    likelihood = limit(lambda m, c: m.log_marginal_likelihood_value_ + k * np.log(c * np.sqrt(2 * np.pi)))
    assert vague.log_marginal_likelihood_value_ == pytest.approx(likelihood, abs=1e-6)
    np.testing.assert_allclose(vague.coef_, limit(lambda m, _: m.coef_), atol=1e-7)
    np.testing.assert_allclose(vague.coef_cov_, limit(lambda m, _: m.coef_cov_), atol=1e-7)
    for i in (0, 1):
        wide = limit(lambda m, _, i=i: m.predict(X_NEW, return_std=True)[i])
        np.testing.assert_allclose(vague.predict(X_NEW, return_std=True)[i], wide, atol=1e-7)
    np.testing.assert_array_equal(vague.coef_prior_scale_, np.where(which, np.inf, 0.7))


def test_vague_weights_are_estimated_by_generalised_least_squares():
    m = fixed(feature_map=TREND, coef_prior=CoefPrior(scale=np.inf), noise=0.05).fit(X, Y)
    H, K = TREND.fit_transform(X), FIXED(X) + 0.05 * np.eye(50)
    A = H.T @ np.linalg.solve(K, H)
    np.testing.assert_allclose(m.coef_, np.linalg.solve(A, H.T @ np.linalg.solve(K, Y)).T, rtol=1e-9)
    np.testing.assert_allclose(m.coef_cov_, np.array([np.linalg.inv(A)] * 2), rtol=1e-8)
    # Rasmussen & Williams, eq. 2.45.
    C = np.linalg.solve(K, H) @ np.linalg.solve(A, np.linalg.solve(K, H).T)
    squares = np.sum(Y * (np.linalg.solve(K, Y) - C @ Y))
    log_dets = np.linalg.slogdet(K)[1] + np.linalg.slogdet(A)[1] + 47 * np.log(2 * np.pi)
    assert m.log_marginal_likelihood_value_ == pytest.approx(-0.5 * squares - log_dets, rel=1e-10)


@pytest.mark.parametrize("columns", [[0, 0], [0, None]], ids=["twice the same", "a column of zeros"])
def test_vague_weights_need_independent_features(columns):
    given = np.column_stack([np.zeros(50) if column is None else X[:, column] for column in columns])
    with pytest.raises(
        ValueError, match=r"An infinite scale of CoefPrior needs .* independent .* 3 features .* only 2"
    ):
        EGPRegressor(TREND, coef_prior=CoefPrior(scale=np.inf)).fit(given, Y)
    EGPRegressor(TREND, coef_prior=CoefPrior(scale=[[np.inf, np.inf, 1.0]]), max_iter=0).fit(given, Y[:, 0])


def test_vague_weights_need_as_many_rows():
    with pytest.raises(ValueError, match="only 2 of them are independent"):
        EGPRegressor(TREND, coef_prior=CoefPrior(scale=np.inf)).fit(X[:2], Y[:2])
    assert np.isfinite(
        EGPRegressor(TREND, coef_prior=CoefPrior(scale=np.inf), max_iter=0).fit(X[:3], Y[:3]).predict(X_NEW)
    ).all()


@pytest.mark.parametrize("scale", [np.nan, -np.inf, -1.0])
def test_invalid_coef_scale_raises(scale):
    with pytest.raises(ValueError, match="scale of CoefPrior must"):
        EGPRegressor(TREND, coef_prior=CoefPrior(scale=scale)).fit(X, Y)


def test_sparse_model_refuses_vague_weights():
    with pytest.raises(ValueError, match="scale=?.* of CoefPrior.* must be finite|scale of CoefPrior must be finite"):
        EVGPRegressor(TREND, coef_prior=CoefPrior(scale=np.inf)).fit(X, Y)


# --- learning -----------------------------------------------------------------------------------------------------


def test_loss_curve_ends_at_likelihood():
    # With fewer rows, it has the prior of kernel and noise too.
    rng = np.random.RandomState(1)
    rows = rng.uniform(-2, 2, (80, 2))
    truth, expected = (
        np.column_stack([np.sin(2 * x[:, 0]) + x[:, 1], 3 * np.cos(x[:, 1]) * x[:, 0]]) for x in (rows, X_NEW)
    )
    m = EGPRegressor(TREND).fit(rows, truth + 0.05 * rng.randn(80, 2))
    assert m.score(X_NEW, expected) > 0.97
    assert m.loss_curve_.shape == (m.n_iter_,)
    assert -m.loss_curve_.min() == pytest.approx(m.log_marginal_likelihood_value_, abs=0.05)
    assert m.loss_curve_[0] > m.loss_curve_[-1]
    np.testing.assert_allclose(m.noise_variance_, 0.05**2, rtol=0.6)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_restarts_keep_the_likeliest_and_repeat():
    def fit(n_restarts, seed):
        # So few iterations end where they began.
        return EGPRegressor(max_iter=1, n_restarts=n_restarts, random_state=seed).fit(X, Y)

    one = fit(0, None).log_marginal_likelihood_value_
    several = [fit(1, seed) for seed in range(6)]
    likelihoods = {m.log_marginal_likelihood_value_ for m in several}
    assert min(likelihoods) == one < max(likelihoods)
    for seed, m in enumerate(several):
        np.testing.assert_array_equal(fit(1, seed).predict(X_NEW), m.predict(X_NEW))


def test_line_search_that_steps_far_off_comes_back():
    """A little noise makes the loss 1e10 there; told as it is, the fit ended after two iterations, at 56.7 nats."""
    x = np.linspace(0, 10, 30)[:, np.newaxis]
    m = EGPRegressor(kernel=RBF(1.0) + WhiteKernel(1e-10, "fixed")).fit(x, x[:, 0] * np.sin(x[:, 0]))
    assert m.log_marginal_likelihood_value_ > 160.0


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_fixed_noise_that_vanishes_does_not_raise():
    kernel = RBF(5.0) + WhiteKernel(1e-30, "fixed")
    m = EGPRegressor(kernel=kernel, max_iter=20).fit(np.vstack([X, X]), np.vstack([Y, Y]))
    assert np.isfinite(m.predict(X_NEW)).all()


# --- scikit-learn's conventions -----------------------------------------------------------------------------------


def test_noise_starts_in_one_place():
    with pytest.raises(ValueError, match="either from variance=0.1 of Gaussian or from the WhiteKernel"):
        EGPRegressor(kernel=RBF() + WhiteKernel(), noise=Gaussian(variance=0.1)).fit(X, Y)


def test_dask_arrays_raise():
    with pytest.raises(TypeError, match="Use EVGPRegressor"):
        EGPRegressor().fit(da.from_array(X), Y)


def test_dask_arrays_are_predicted():
    m = fixed(feature_map=TREND).fit(X, Y)
    mean, std = m.predict(da.from_array(X_NEW, chunks=(10, 2)), return_std=True)
    expected = m.predict(X_NEW, return_std=True)
    np.testing.assert_allclose(mean.compute(scheduler="sync"), expected[0], rtol=1e-12)
    np.testing.assert_allclose(std.compute(scheduler="sync"), expected[1], rtol=1e-12)


def test_warnings_point_at_the_line_that_fits():
    sparse, network = EVGPRegressor(n_inducing=5, max_iter=2), BayesianMLPRegressor([4], max_iter=2, random_state=0)
    models = [EGPRegressor(max_iter=2), sparse, network]
    models += [ResidualRegressor(sparse, base=0), make_pipeline(StandardScaler(), sparse)]
    fits = [model.fit for model in models]
    for fit in [*fits, clone(sparse).partial_fit, ResidualRegressor(sparse, base=0).partial_fit]:
        with pytest.warns(ConvergenceWarning) as warned:
            fit(X, Y[:, 0])
        assert {warning.filename for warning in warned} == {__file__}


def test_interrupted_fit_keeps_best_parameters():
    looks = []

    def interrupting(X, Z, scale=1.0):
        looks.append(1)
        if len(looks) == 30:
            raise KeyboardInterrupt
        return anp.exp(-0.5 * anp.sum((X[:, None] - Z[None]) ** 2, axis=2) / scale**2)

    with pytest.warns(ConvergenceWarning, match="interrupted after"):
        m = EGPRegressor(kernel=interrupting, n_restarts=2).fit(X, Y)
    assert 0 < m.n_iter_ < 30
    assert np.isfinite(m.predict(X_NEW)).all()


@pytest.mark.parametrize("noise", [1e-10, 1e-6])
def test_points_at_all_rows_give_the_exact_likelihood(noise):
    """The sparse bound at X_m = X, where rounding in k(x, x) - |v|² is far above so low a noise."""
    x = np.array([[1.0], [3.0], [5.0], [6.0], [7.0], [8.0]])
    y, kernel = x[:, 0] * np.sin(x[:, 0]), RBF(1.0) + WhiteKernel(noise, "fixed")
    sparse, exact = EVGPRegressor(kernel=kernel).fit(x, y), EGPRegressor(kernel=kernel).fit(x, y)
    assert sparse.lower_bound_ == pytest.approx(exact.log_marginal_likelihood_value_, abs=1e-6)
    # Rows beyond the points are something else again.
    x_new = np.array([[2.0], [4.0]])
    bound = sparse.partial_fit(x_new, x_new[:, 0] * np.sin(x_new[:, 0])).lower_bound_
    both = EGPRegressor(kernel=exact.kernel_ + WhiteKernel(noise, "fixed"), max_iter=0)
    all_rows = np.vstack([x, x_new])
    assert bound < both.fit(all_rows, all_rows[:, 0] * np.sin(all_rows[:, 0])).log_marginal_likelihood_value_


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_weak_signal_that_a_sample_does_not_show_is_found(seed):
    """The wave has 5 % of the variance. A kernel like white noise explains a sample of 300 rows as well."""
    rng = np.random.RandomState(100 + seed)
    X = rng.rand(1000, 4)
    truth = 0.3 * np.sin(5.0 * X[:, 0])
    y = truth + rng.randn(1000)
    model = EGPRegressor().fit(X[:500], y[:500])
    assert model.noise_variance_ > 0.7
    assert np.sqrt(np.mean((model.predict(X[500:]) - truth[500:]) ** 2)) < 0.15
