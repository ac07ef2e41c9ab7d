import os
import signal

import numpy as np
import pandas as pd
import pytest
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, StandardScaler

from skevgp import CoefPrior, EVGPRegressor
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS, Adam


def smooth(n=150, outputs=2, noise=0.05, seed=0):
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2, 2, (n, 2))
    Y = np.column_stack([np.sin(2 * X[:, 0]) + X[:, 1], 3 * np.cos(X[:, 1]) * X[:, 0]])[:, :outputs]
    return X, Y + noise * rng.randn(*Y.shape)


X, Y = smooth()
X_NEW, Y_NEW = smooth(80, seed=1)


def model(**arguments):
    return EVGPRegressor(**{"n_inducing": 20, "sharing": "all", "random_state": 0} | arguments)


# --- shapes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("y", "outputs"), [(Y[:, 0], ()), (Y[:, :1], ()), (Y, (2,))])
@pytest.mark.parametrize("sharing", ["all", "kernel", "none"])
def test_shapes_of_attributes(y, outputs, sharing):
    m = model(feature_map=PolynomialFeatures(1), sharing=sharing, n_inducing=10, noise_cv=None, solver=LBFGS(tol=1e9))
    m.fit(X, y)
    assert m.coef_.shape == m.coef_std_.shape == (*outputs, 3)
    assert m.coef_prior_mean_.shape == m.coef_prior_scale_.shape == (*outputs, 3)
    assert m.coef_cov_.shape == (*outputs, 3, 3)
    assert np.shape(m.noise_variance_) == outputs
    assert isinstance(m.noise_variance_, float) == (outputs == ())
    n_sets = () if sharing == "all" else outputs
    assert m.inducing_points_.shape == (*n_sets, 10, 2)
    assert isinstance(m.kernel_, list) == (outputs != ())
    assert m.loss_curve_.shape == (m.n_iter_,)


def test_number_of_points_is_no_truth_value():
    with pytest.raises(TypeError, match="n_inducing must be an integer; got True"):
        EVGPRegressor(n_inducing=True).fit(np.eye(4), np.arange(4.0))


def test_noise_is_included_unless_told_otherwise():
    m = model(solver=LBFGS(tol=1e9)).fit(X, Y)
    _, with_noise = m.predict(X_NEW, return_std=True)
    _, without = m.predict(X_NEW, return_std=True, include_noise=False)
    np.testing.assert_allclose(with_noise**2 - without**2, np.broadcast_to(m.noise_variance_, (80, 2)), rtol=1e-6)


# --- learning ----------------------------------------------------------------------------------------------------


def test_bound_rises_and_ends_at_minus_the_loss():
    m = model(inducing_init="k-means", noise_cv=None).fit(X, Y)
    assert (np.diff(m.loss_curve_) <= 0).all()
    assert m.lower_bound_ == pytest.approx(-m.loss_curve_[-1], rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("posterior", ["full", "diagonal"])
def test_adam_and_lbfgs_agree_at_the_optimum(posterior):
    """Same kernel: Adam has to find q, whose optimum L-BFGS has in closed form; then all of it."""
    fixed = ConstantKernel(2.0, "fixed") * RBF([1.0, 1.0], "fixed") + WhiteKernel(0.01, "fixed")
    x, y = X[:60], Y[:60, 0]
    arguments = {"n_inducing": 6, "feature_map": PolynomialFeatures(1), "kernel": fixed}
    lbfgs = model(solver=LBFGS(tol=1e-8, posterior=posterior), **arguments).fit(x, y)
    adam = model(solver=Adam(batch_size=60, posterior=posterior), max_iter=2000, **arguments).fit(x, y)
    assert adam.lower_bound_ == pytest.approx(lbfgs.lower_bound_, rel=1e-4)
    np.testing.assert_allclose(adam.predict(X_NEW), lbfgs.predict(X_NEW), atol=0.01)
    np.testing.assert_allclose(
        adam.predict(X_NEW, return_std=True)[1], lbfgs.predict(X_NEW, return_std=True)[1], rtol=0.02
    )


def test_adam_ends_on_few_rows_when_the_loss_is_flat(monkeypatch):
    """The optimum of q for a fixed kernel, which L-BFGS has in closed form; it may end earlier than elsewhere."""
    monkeypatch.setattr("skevgp.solvers.adam._FEWEST", 200)
    fixed = ConstantKernel(2.0, "fixed") * RBF([1.0, 1.0], "fixed") + WhiteKernel(0.01, "fixed")
    x, y, arguments = X[:5], Y[:5, 0], {"n_inducing": 2, "kernel": fixed, "noise_cv": None}
    lbfgs, adam = (model(solver=solver, **arguments).fit(x, y) for solver in ("lbfgs", "adam"))
    assert adam.n_iter_ < 2000
    assert adam.lower_bound_ == pytest.approx(lbfgs.lower_bound_, abs=0.1)


@pytest.mark.long
def test_natural_gradients_and_lbfgs_agree_at_the_optimum():
    """Inducing points and noise free, mini-batches of a third of the rows."""
    rng = np.random.RandomState(0)
    x, x_new = rng.uniform(-2, 2, (600, 1)), np.linspace(-2, 2, 50)[:, np.newaxis]
    y = np.sin(3 * x[:, 0]) + 0.5 * x[:, 0] + 0.1 * rng.randn(600)
    kernel = ConstantKernel(1.0, "fixed") * RBF(0.8, "fixed")
    arguments = {"kernel": kernel, "n_inducing": 8, "feature_map": PolynomialFeatures(1)}
    lbfgs = model(**arguments).fit(x, y)
    natural = model(solver=Adam(batch_size=200, natural_gradient=True), max_iter=2000, **arguments).fit(x, y)
    assert natural.lower_bound_ == pytest.approx(lbfgs.lower_bound_, abs=1.0)
    for a, b in zip(natural.predict(x_new, return_std=True), lbfgs.predict(x_new, return_std=True), strict=True):
        np.testing.assert_allclose(a, b, atol=0.01)
    np.testing.assert_allclose((natural.coef_ - lbfgs.coef_) / lbfgs.coef_std_, 0.0, atol=0.2)
    np.testing.assert_allclose(natural.coef_std_, lbfgs.coef_std_, rtol=0.1)
    np.testing.assert_allclose(natural.noise_variance_, lbfgs.noise_variance_, rtol=0.05)


def test_natural_gradients_are_of_the_full_posterior():
    m = model(solver=Adam(natural_gradient=True, posterior="diagonal"))
    with pytest.raises(ValueError, match=r'natural_gradient=True of Adam needs posterior="full"; got posterior='):
        m.fit(X, Y)


@pytest.mark.parametrize(
    ("n_columns", "n_features", "m", "outputs", "expected"),
    [
        (3, 0, 40, 2, 407),
        (3, 3, 10, 2, 119),
        (3, 4, 10, 2, 123),
        (5, 0, 100, 4, 2813),
        (5, 5, 60, 4, 1733),
        (5, 6, 60, 4, 1741),
        # As the others, with more points.
        pytest.param(5, 0, 250, 4, 7013, marks=pytest.mark.long),
        pytest.param(5, 5, 150, 4, 4253, marks=pytest.mark.long),
        pytest.param(5, 7, 150, 4, 4269, marks=pytest.mark.long),
    ],
)
def test_parameter_counts_are_the_papers(n_columns, n_features, m, outputs, expected):
    rng = np.random.RandomState(0)
    x = rng.randn(300, n_columns)
    features = FunctionTransformer(lambda x: np.hstack([x, x, x])[:, :n_features]) if n_features else None
    fitted = model(feature_map=features, n_inducing=m, solver=LBFGS(posterior="diagonal"), sharing="kernel", max_iter=0)
    assert fitted.fit(x, rng.randn(300, outputs)).n_parameters_ == expected


def test_units_do_not_matter():
    """A column or a target in other units gives the same model in those units."""
    unit_x, unit_y = np.array([1e6, 1e-6]), np.array([1e-9, 1e9])
    plain = model(max_iter=30, solver=LBFGS(tol=1e-9))
    scaled = clone(plain)
    with pytest.warns(ConvergenceWarning):
        plain.fit(X, Y)
    with pytest.warns(ConvergenceWarning):
        scaled.fit(X * unit_x, Y * unit_y)
    np.testing.assert_allclose(scaled.predict(X_NEW * unit_x) / unit_y, plain.predict(X_NEW), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(scaled.noise_variance_ / unit_y**2, plain.noise_variance_, rtol=1e-2)
    assert scaled.lower_bound_ == pytest.approx(plain.lower_bound_ - 150 * np.log(unit_y).sum(), rel=1e-3)


# --- explicit features -------------------------------------------------------------------------------------------


def test_scale_of_zero_keeps_a_weight_at_its_mean():
    m = model(
        feature_map=PolynomialFeatures(1),
        coef_prior=CoefPrior(mean=[1.0, 2.0, 3.0], scale=[1.0, 0.0, 1.0]),
        solver=LBFGS(tol=1e9),
    )
    m.fit(X, Y[:, 0])
    assert m.coef_[1] == 2.0
    assert m.coef_std_[1] == 0.0
    assert m.coef_[0] != 1.0


@pytest.mark.parametrize("posterior", ["full", "diagonal"])
@pytest.mark.parametrize("solver", ["lbfgs", "adam"])
def test_fixed_weight_works_with_all_solvers(solver, posterior):
    m = model(feature_map=PolynomialFeatures(1), coef_prior=CoefPrior(scale=0.0, mean=1.0), solver=solver)
    m.set_params(max_iter=20, solver=LBFGS(tol=1e9)).fit(X, Y[:, 0])
    np.testing.assert_array_equal(m.coef_, 1.0)
    assert np.isfinite(m.lower_bound_)


def test_maps_see_the_data_as_given():
    """A data frame stays one, in fit and in predict; the kernel's inputs and the features each have their own map."""

    class Recorder(TransformerMixin, BaseEstimator):
        seen = []  # noqa: RUF012

        def fit(self, X, y=None):
            self.n_fits_ = getattr(self, "n_fits_", 0) + 1
            return self

        def transform(self, X):
            Recorder.seen.append(type(X))
            return X[["b"]]

    frame = pd.DataFrame(X, columns=["a", "b"])
    m = model(feature_map=Recorder(), kernel_map=StandardScaler(), max_iter=0).fit(frame, Y)
    m.predict(frame, return_std=True)
    assert set(Recorder.seen) == {pd.DataFrame}
    assert m.feature_map_.n_fits_ == 1
    assert m.coef_.shape == (2, 1)


# --- going on ----------------------------------------------------------------------------------------------------


def test_partial_fit_equals_a_fit_of_all_rows():
    kernel = ConstantKernel(2.0, "fixed") * RBF([0.8, 1.2], "fixed") + WhiteKernel(0.01, "fixed")
    first = X[:20]
    arguments = {"kernel": kernel, "n_inducing": 20, "max_iter": 0, "coef_prior": CoefPrior(mean=0.5, scale=2.0)}
    parts = model(feature_map=PolynomialFeatures(1), **arguments).partial_fit(first, Y[:20])
    parts.partial_fit(X[20:], Y[20:])
    # A warm start keeps the first fit's inducing points, the first twenty rows.
    whole = model(feature_map=PolynomialFeatures(1), **arguments, warm_start=True).fit(first, Y[:20])
    whole.fit(X, Y)
    np.testing.assert_allclose(whole.inducing_points_, parts.inducing_points_, atol=1e-12)
    np.testing.assert_allclose(parts.predict(X_NEW), whole.predict(X_NEW), atol=1e-8)
    np.testing.assert_allclose(parts.coef_cov_, whole.coef_cov_, atol=1e-8)
    assert parts.lower_bound_ == pytest.approx(whole.lower_bound_, rel=1e-8)
    assert parts.upper_bound_ == pytest.approx(whole.upper_bound_, rel=1e-8)


def test_forgetting_weighs_earlier_rows_as_fewer():
    """Rows that come twice at a weight of one half are rows that came once."""
    kernel = ConstantKernel(2.0, "fixed") * RBF([0.8, 1.2], "fixed") + WhiteKernel(0.01, "fixed")
    arguments = {"feature_map": PolynomialFeatures(1), "kernel": kernel, "n_inducing": 20, "max_iter": 0}
    arguments |= {"coef_prior": CoefPrior(mean=0.5, scale=2.0)}
    once = model(**arguments).fit(X, Y)
    twice = model(**arguments).fit(X, Y).partial_fit(X, Y)
    # Half of two times the rows, and once more, are two times the rows.
    again = model(**arguments).fit(X, Y).partial_fit(X, Y).partial_fit(X, Y, forgetting_factor=0.5)
    for part, expected in zip(again.predict(X_NEW, True), twice.predict(X_NEW, True), strict=True):
        np.testing.assert_allclose(part, expected, rtol=1e-8)
    drifting = model(**arguments).fit(X, Y)
    for _ in range(20):
        drifting.partial_fit(X, -Y, forgetting_factor=0.2)
    # A long time after, the weight of what came first is 0.2^20, that of the new 1 + 0.2 + ... = 1.25.
    np.testing.assert_allclose(drifting.predict(X_NEW), -once.predict(X_NEW), atol=0.05 * np.abs(Y).max())
    assert drifting.lower_bound_ < once.lower_bound_


@pytest.mark.parametrize("factor", [-1.0, 0.0, 2.0, np.nan, "a", None])
def test_fitted_model_refuses_a_wrong_forgetting_factor(factor):
    m = model(max_iter=0).fit(X, Y)
    expected = m.predict(X_NEW)
    with pytest.raises((ValueError, TypeError), match="forgetting_factor must be"):
        m.partial_fit(X, Y, forgetting_factor=factor)
    np.testing.assert_array_equal(m.predict(X_NEW), expected)


def test_partial_fit_refuses_other_shapes():
    m = model(max_iter=0).fit(X, Y)
    with pytest.raises(ValueError, match="y has 1 outputs, but the model has 2"):
        m.partial_fit(X, Y[:, 0])
    with pytest.raises(ValueError, match="3 features"):
        m.partial_fit(np.hstack([X, X[:, :1]]), Y)


@pytest.mark.parametrize("sharing", ["all", "none"])
def test_warm_start_goes_on_where_the_last_fit_ended(sharing):
    m = model(warm_start=True, sharing=sharing, noise_cv=None).fit(X, Y)
    first, n_first = m.lower_bound_, m.n_iter_
    m.fit(X, Y)
    assert m.lower_bound_ >= first - 0.1
    assert m.n_iter_ < n_first / 2


@pytest.mark.long
@pytest.mark.parametrize("solver", [LBFGS(tol=1e6), Adam(tol=1e6)], ids=["lbfgs", "adam"])
@pytest.mark.parametrize("sharing", ["all", "none"])
def test_same_random_state_same_bits_for_any_n_jobs(sharing, solver, monkeypatch):
    monkeypatch.setattr("skevgp.data.blocks._MIN_BLOCK_ROWS", 16)
    monkeypatch.setattr("skevgp.data.blocks._WORTH_THREADS", 0)
    monkeypatch.setattr("skevgp.data.blocks._BLOCK_NUMBERS", 16)
    fits = [model(sharing=sharing, solver=solver, n_jobs=n_jobs, max_iter=20).fit(X, Y) for n_jobs in (None, 1, 2)]
    for m in fits[1:]:
        np.testing.assert_array_equal(m.predict(X_NEW), fits[0].predict(X_NEW))
        np.testing.assert_array_equal(m.loss_curve_, fits[0].loss_curve_)


def test_log_ends_with_the_line_of_the_last_iteration(capsys):
    m = model(verbose=1, noise_cv=None).fit(X, Y)
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith(f"all rows, iteration {m.n_iter_}, bound ")
    assert float(line.split(", ")[2].split()[1]) == pytest.approx(m.lower_bound_, abs=1e-2)


def test_too_few_iterations_warn_and_say_what_to_change():
    with pytest.warns(ConvergenceWarning, match=r"max_iter=3 iterations. Raise max_iter"):
        model(max_iter=3).fit(X, Y)


@pytest.mark.parametrize("solver", [LBFGS, Adam])
@pytest.mark.parametrize("sharing", ["all", "none"])
def test_interrupted_fit_keeps_best_parameters(sharing, solver):
    def interrupt(iteration, bound, outputs):
        if iteration == 3:
            raise KeyboardInterrupt

    with pytest.warns(ConvergenceWarning, match="interrupted after 3 iterations"):
        m = model(solver=solver(callback=interrupt), sharing=sharing).fit(X, Y)
    assert np.isfinite(m.predict(X_NEW)).all()
    assert m.n_iter_ == 3


# --- changed parameters, failed fits, threads --------------------------------------------------------------------


def test_failed_refit_leaves_the_model_as_it_was():
    m = model(feature_map=PolynomialFeatures(1), max_iter=0).fit(X, Y)
    before = m.predict(X_NEW)
    m.set_params(
        kernel_map=StandardScaler(), feature_map=None, noise=Gaussian(variance=1.0), kernel=RBF() + WhiteKernel()
    )
    with pytest.raises(ValueError, match="Pass one of them only"):
        m.fit(np.hstack([X, X]), Y)
    np.testing.assert_array_equal(m.predict(X_NEW), before)


@pytest.mark.parametrize("solver", [LBFGS(), Adam(batch_size=32)], ids=str)
def test_real_ctrl_c_stops_all_outputs_and_keeps_them(solver):
    """With outputs in threads of their own, the signal reaches the main thread only."""
    sent = []
    # A run in the background of a shell ignores SIGINT.
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupt(iteration, bound, outputs):
        if iteration == 3 and not sent:
            sent.append(os.kill(os.getpid(), signal.SIGINT))

    solver = clone(solver).set_params(callback=interrupt)
    m = model(sharing="none", solver=solver, n_jobs=2, max_iter=3000)
    try:
        with pytest.warns(ConvergenceWarning, match="interrupted after"):
            m.fit(X, np.hstack([Y] * 3))
    finally:
        signal.signal(signal.SIGINT, handler)
    assert m.predict(X_NEW).shape == (80, 6)
    assert np.isfinite(m.predict(X_NEW)).all()
