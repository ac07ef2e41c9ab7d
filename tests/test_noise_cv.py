"""noise_cv: a noise variance, and so a std, that is honest on new trajectories."""

import pickle

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EVGPRegressor
from skevgp.metrics import containing_ratios
from skevgp.solvers import LBFGS

# A few iterations are enough.
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")

SETTINGS = [("lbfgs", "full"), ("lbfgs", "diagonal"), ("adam", "full"), ("adam", "diagonal")]


def trajectories(n, seed, length=100):
    """Slow walks through a square, one after the other, over a function too rough for few inducing points."""
    rng = np.random.RandomState(seed)
    t = np.linspace(0.0, 1.0, length)[:, np.newaxis]
    X = np.vstack([rng.uniform(-2, 2, 2) + t * rng.uniform(-1, 1, 2) for _ in range(n)])
    Y = np.column_stack([np.sin(4 * X[:, 0]) * np.cos(3 * X[:, 1]), np.cos(3 * X.sum(axis=1)) + X[:, 1]])
    return X, Y + 0.01 * rng.randn(*Y.shape)


X, Y = trajectories(20, 0)
X_NEW, Y_NEW = trajectories(40, 1)


def model(**arguments):
    defaults = {"feature_map": PolynomialFeatures(1), "n_inducing": 12, "max_iter": 30, "random_state": 0}
    return EVGPRegressor(**{**defaults, **arguments})


def mean_square_z(m):
    """Of each output on new trajectories; 1 if std is honest."""
    mean, std = m.predict(X_NEW, return_std=True)
    return np.mean(((Y_NEW - mean) / std) ** 2, axis=0)


def test_on_new_trajectories_as_many_rows_as_should_lie_within_the_std():
    normal = np.array([0.683, 0.954, 0.997])
    ratios = []
    for noise_cv in (None, 10):
        mean, std = model(noise_cv=noise_cv).fit(X, Y).predict(X_NEW, return_std=True)
        ratios.append(containing_ratios(Y_NEW, mean, std))
    plain, calibrated = ratios
    assert (plain < normal).all()
    assert (np.abs(calibrated - normal) < 0.7 * np.abs(plain - normal)).all()


def test_independent_rows_keep_their_noise():
    rng = np.random.RandomState(0)
    X = rng.uniform(-2, 2, (2000, 2))
    Y = np.column_stack([np.sin(X[:, 0]), X[:, 0] * X[:, 1]]) + [0.1, 0.5] * rng.randn(2000, 2)
    plain, calibrated = (model(n_inducing=20, noise_cv=noise_cv).fit(X, Y) for noise_cv in (None, 10))
    np.testing.assert_allclose(calibrated.noise_variance_, plain.noise_variance_, rtol=0.05)
    assert (calibrated.noise_variance_ != plain.noise_variance_).all()


@pytest.mark.parametrize(("solver", "posterior"), SETTINGS)
@pytest.mark.parametrize("sharing", ["all", "kernel", "none"])
@pytest.mark.parametrize("feature_map", [None, PolynomialFeatures(1)], ids=["no features", "features"])
def test_it_calibrates_whatever_is_fitted_and_leaves_the_rest(feature_map, sharing, solver, posterior):
    settings = {"feature_map": feature_map, "sharing": sharing, "solver": solver, "posterior": posterior}
    # Too few rows for a sample, and iterations for a good fit: there is much to calibrate.
    settings |= {"max_iter": 10}
    plain, calibrated = (model(**settings, noise_cv=noise_cv).fit(X[:1900], Y[:1900]) for noise_cv in (None, 5))
    np.testing.assert_array_equal(calibrated.inducing_points_, plain.inducing_points_)
    np.testing.assert_array_equal([k.theta for k in calibrated.kernel_], [k.theta for k in plain.kernel_])
    np.testing.assert_array_equal(calibrated.loss_curve_, plain.loss_curve_)
    before, z = mean_square_z(plain), mean_square_z(calibrated)
    assert (before > 2.0).all()
    assert (z > 0.3).all()
    assert (z < 2.0).all()


@pytest.mark.parametrize(("solver", "posterior"), SETTINGS)
def test_q_is_at_its_optimum_for_the_new_noise(solver, posterior):
    y = Y[:, 0]
    m = model(solver=solver, posterior=posterior, noise_cv=5).fit(X, y)
    again = model(
        kernel=m.kernel_ + WhiteKernel(m.noise_variance_, "fixed"),
        inducing_init=m.inducing_points_,
        posterior=posterior,
        max_iter=0,
    ).fit(X, y)
    for part, expected in zip(m.predict(X_NEW, return_std=True), again.predict(X_NEW, return_std=True), strict=True):
        np.testing.assert_allclose(part, expected, rtol=1e-6, atol=1e-8)
    assert m.lower_bound_ == pytest.approx(again.lower_bound_, rel=1e-8)
    assert m.upper_bound_ == pytest.approx(again.upper_bound_, rel=1e-8)


def test_what_the_user_fixes_stays():
    kernel = ConstantKernel() * RBF([1.0, 1.0]) + WhiteKernel(0.3, "fixed")
    plain, fixed = (model(kernel=kernel, max_iter=5, noise_cv=noise_cv).fit(X, Y) for noise_cv in (None, 5))
    np.testing.assert_allclose(fixed.noise_variance_, 0.3)
    np.testing.assert_array_equal(fixed.predict(X_NEW), plain.predict(X_NEW))


def test_the_noise_stays_within_the_users_bounds():
    kernel = ConstantKernel() * RBF([1.0, 1.0]) + WhiteKernel(1e-4, (1e-5, 2e-4))
    np.testing.assert_allclose(model(kernel=kernel, max_iter=5, noise_cv=5).fit(X, Y).noise_variance_, 2e-4)


def test_without_iterations_the_noise_alone_is_learned():
    kernel = ConstantKernel(1.5) * RBF([0.7, 0.8])
    m = model(kernel=kernel, noise_variance=1e-6, max_iter=0, noise_cv=5).fit(X, Y[:, 0])
    np.testing.assert_allclose(np.exp(m.kernel_.theta), [1.5, 0.7, 0.8])
    assert m.noise_variance_ > 1e-4


def test_units_do_not_matter():
    m = model(noise_cv=5, max_iter=5).fit(X, Y)
    in_millimetres = model(noise_cv=5, max_iter=5).fit(X, 1e3 * Y)
    np.testing.assert_allclose(in_millimetres.noise_variance_, 1e6 * m.noise_variance_, rtol=1e-4)


def test_rows_of_a_file_give_the_same(tmp_path):
    np.save(tmp_path / "X.npy", X)
    mapped = np.load(tmp_path / "X.npy", mmap_mode="r")
    expected = model(noise_cv=5).fit(X, Y)
    np.testing.assert_array_equal(model(noise_cv=5).fit(mapped, Y).noise_variance_, expected.noise_variance_)


@pytest.mark.parametrize("noise_cv", [1, 0, -3, True, 2.0, "10"])
def test_a_wrong_number_of_folds_is_refused(noise_cv):
    with pytest.raises(ValueError, match="The 'noise_cv' parameter of EVGPRegressor must be"):
        model(noise_cv=noise_cv).fit(X, Y)


def test_more_folds_than_rows_are_refused_and_as_many_leave_out_rows_one_by_one():
    with pytest.raises(ValueError, match=r"noise_cv=31 folds need a row each; got n_samples=30\."):
        model(noise_cv=31).fit(X[::67], Y[::67])
    assert (model(noise_cv=30).fit(X[::67], Y[::67]).noise_variance_ > 0.0).all()


@pytest.mark.parametrize("sharing", ["all", "kernel", "none"])
def test_same_bits_for_any_n_jobs(sharing, monkeypatch):
    monkeypatch.setattr("skevgp.rows.blocks._MIN_BLOCK_ROWS", 64)
    monkeypatch.setattr("skevgp.rows.blocks._WORTH_THREADS", 0)
    monkeypatch.setattr("skevgp.rows.blocks._BLOCK_NUMBERS", 64)
    fits = [model(sharing=sharing, n_jobs=n_jobs, max_iter=3, noise_cv=4).fit(X, Y) for n_jobs in (1, 3)]
    np.testing.assert_array_equal(fits[0].noise_variance_, fits[1].noise_variance_)
    np.testing.assert_array_equal(fits[0].predict(X_NEW), fits[1].predict(X_NEW))


def test_partial_fit_keeps_the_noise():
    m = model(noise_cv=5).partial_fit(X, Y)
    noise, std = m.noise_variance_, m.predict(X_NEW, return_std=True, include_noise=False)[1]
    np.testing.assert_array_equal(noise, model(noise_cv=5).fit(X, Y).noise_variance_)
    m.partial_fit(X_NEW, Y_NEW)
    np.testing.assert_array_equal(m.noise_variance_, noise)
    assert (m.predict(X_NEW, return_std=True, include_noise=False)[1] < std).all()


def test_it_pickles_and_clones():
    m = model(noise_cv=3, max_iter=3).fit(X, Y)
    again = pickle.loads(pickle.dumps(m))
    np.testing.assert_array_equal(again.predict(X_NEW), m.predict(X_NEW))
    assert clone(m).noise_cv == 3


@pytest.mark.parametrize("sharing", ["all", "none"])
def test_ctrl_c_leaves_it_out(sharing):
    def interrupt(iteration, bound, outputs):
        if iteration == 3:
            raise KeyboardInterrupt

    noise = []
    for noise_cv in (None, 5):
        with pytest.warns(ConvergenceWarning, match="interrupted after 3 iterations"):
            m = model(sharing=sharing, noise_cv=noise_cv, solver=LBFGS(callback=interrupt)).fit(X, Y)
        noise.append(m.noise_variance_)
    np.testing.assert_array_equal(*noise)
