"""Standard deviations, covariances and samples describe one distribution, also where rounding outweighs the noise."""

from functools import cache

import mpmath as mp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.preprocessing import PolynomialFeatures

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.solvers import LBFGS

X = np.linspace(0.0, 1.0, 40)[:, np.newaxis]
X_NEW = np.vstack([X[::4], X[::6] + 0.003, [[1.7], [-3.0]]])
Y = np.column_stack([X[:, 0] ** 2, 1.0 + X[:, 0], np.sin(6.0 * X[:, 0])])
EPS = np.finfo(float).eps
MODELS = {
    "exact, one output": (EGPRegressor(), Y[:, 0]),
    "exact, several outputs": (EGPRegressor(), Y),
    "exact, shared weights": (EGPRegressor(PolynomialFeatures(1), coef_prior=CoefPrior(shared=True)), Y),
    "sparse, diagonal": (
        EVGPRegressor(n_inducing=12, solver=LBFGS(posterior="diagonal"), sharing="all", random_state=0),
        Y,
    ),
    "sparse, shared weights": (
        EVGPRegressor(
            PolynomialFeatures(1), n_inducing=12, coef_prior=CoefPrior(shared=True), sharing="kernel", random_state=0
        ),
        Y,
    ),
    "residual": (ResidualRegressor(EVGPRegressor(n_inducing=12, random_state=0)), Y[:, 0]),
}


@cache
def fitted(name):
    regressor, y = MODELS[name]
    return regressor.fit(X, y)


@pytest.fixture(params=MODELS)
def model(request):
    return fitted(request.param)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("include_noise", [True, False])
def test_std_covariance_and_samples_agree(model, include_noise):
    mean, std = model.predict(X_NEW, return_std=True, include_noise=include_noise)
    _, cov = model.predict(X_NEW, return_cov=True, include_noise=include_noise)
    samples = model.sample_y(X_NEW, 3000, random_state=0, include_noise=include_noise)
    assert (std > 0.0).all()
    assert_allclose(np.moveaxis(np.diagonal(cov), -1, 0), std**2, rtol=1e-9)
    each = [cov] if cov.ndim == 2 else np.moveaxis(cov, 2, 0)
    for own in each:
        assert_allclose(own, own.T, rtol=0.0, atol=1e-12 * own.max())
        assert np.linalg.eigvalsh(own)[0] >= -len(own) * EPS * own.diagonal().max()
    # The standard error of a standard deviation of 3,000 draws is 1.3 %, that of their mean 1.8 % of one.
    assert_allclose(samples.std(axis=-1), std, rtol=0.08)
    assert (np.abs(samples.mean(axis=-1) - mean) < 0.11 * std + 8.0 * EPS * np.abs(mean)).all()


@pytest.mark.long
def test_variance_of_a_noise_free_parabola_is_right_to_rounding():
    """Against 60 digits: rounding of a sum of 40 squares that is about the signal variance."""
    model = EGPRegressor().fit(X, X[:, 0] ** 2)
    signal, length = model.kernel_.k1.constant_value, model.kernel_.k2.length_scale
    rows = [0, 17, 30]
    with mp.workdps(60):
        x, s2, noise = [mp.mpf(float(v)) for v in X[:, 0]], mp.mpf(float(signal)), mp.mpf(model.noise_variance_)
        K = mp.matrix([[s2 * mp.exp(-(((a - b) / mp.mpf(float(length))) ** 2) / 2) for b in x] for a in x])
        A = K + noise * mp.eye(len(x))
        weights = [mp.lu_solve(A, K[:, i]) for i in rows]
        truth = [float(K[i, i] - mp.fdot(K[:, i], w) + noise) for i, w in zip(rows, weights, strict=True)]
    _, cov = model.predict(X, return_cov=True)
    assert_allclose(np.diag(cov)[rows], truth, rtol=0.0, atol=len(X) * EPS * signal)
    assert_allclose(
        [model.predict(X[[i]], return_std=True)[1][0] ** 2 for i in rows], truth, atol=len(X) * EPS * signal
    )


@pytest.mark.parametrize(
    "function",
    [
        pytest.param(np.square, id="square"),
        pytest.param(np.exp, id="exp", marks=pytest.mark.long),
        pytest.param(lambda x: x + 1.0, id="line"),
        pytest.param(np.sinc, id="sinc", marks=pytest.mark.long),
    ],
)
def test_more_inducing_points_do_not_widen_the_std(function):
    """With points at all rows it is the exact model's; the signal does not grow to make up for a jitter."""
    rows = np.linspace(0.0, 1.0, 40)[:, np.newaxis]
    between = (rows[:-1] + rows[1:]) / 2.0
    y, truth = function(rows[:, 0]), function(between[:, 0])
    stds, errors = [], []
    for model in (*(EVGPRegressor(n_inducing=m, random_state=0) for m in (8, 20, 60)), EGPRegressor()):
        mean, std = model.fit(rows, y).predict(between, return_std=True)
        stds.append(np.median(std))
        errors.append(np.sqrt(np.mean((mean - truth) ** 2)))
    assert stds[1] < 1.3 * stds[0]
    assert stds[2] < 0.5 * stds[1]
    # The two fits end within their tolerances of the same optimum, where the likelihood hardly depends on the signal.
    assert_allclose(stds[2], stds[3], rtol=0.2)
    # Honest: neither far above the errors nor far below.
    assert (np.array(errors) < 4.0 * np.array(stds)).all()


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("include_noise", [True, False])
@pytest.mark.parametrize("name", ["exact, shared weights", "sparse, shared weights"])
def test_joint_covariance_of_shared_weights_is_that_of_samples(name, include_noise):
    regressor = fitted(name)
    _, std = regressor.predict(X_NEW, return_std=True, include_noise=include_noise)
    _, joint = regressor.predict(X_NEW, return_cov="joint", include_noise=include_noise)
    assert_allclose(np.diag(joint), std.ravel() ** 2, rtol=1e-9)
    assert np.linalg.eigvalsh(joint)[0] >= -len(joint) * EPS * np.diag(joint).max()
    samples = regressor.sample_y(X_NEW, 3000, random_state=0, include_noise=include_noise)
    far = samples[-2:].reshape(2 * 3, -1)  # where the weights say nearly all
    assert_allclose(np.corrcoef(far), joint[-6:, -6:] / np.outer(std[-2:], std[-2:]), atol=0.1)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("name", ["exact, several outputs", "sparse, shared weights"])
def test_roots_without_noise_need_no_eigenvalues(name, monkeypatch):
    """Eigenvalues take ten times as long as the samples with noise."""
    regressor = fitted(name)
    monkeypatch.setattr("skevgp.utils.linalg.eigh", None)
    rows = np.vstack([np.linspace(-1.0, 2.0, 200)[:, np.newaxis], X])
    assert np.isfinite(regressor.sample_y(rows, include_noise=False)).all()
    regressor.predict(rows, return_cov=True, include_noise=False)
