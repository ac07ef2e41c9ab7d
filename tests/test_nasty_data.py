"""Finite data never end in LinAlgError or NaN; what cannot be fitted is refused with a message that helps."""

import warnings

import numpy as np
import pytest
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures

from skevgp import CoefPrior, EVGPRegressor
from skevgp.features import InertiaForce, InertiaForceGravity
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS, Adam


def nasty(seed):
    """A random data set with some of: few rows, wild scales, constants, copies, offsets, no noise, no signal."""
    rng = np.random.RandomState(seed)
    n, d, o = rng.choice([1, 2, 3, 5, 20, 60]), rng.randint(1, 5), rng.randint(1, 3)
    X = rng.randn(n, d)
    if rng.rand() < 0.3:
        X *= 10.0 ** rng.uniform(-12, 12, d)
    if rng.rand() < 0.2:
        X[:, 0] = rng.choice([0.0, 3.0, 1e8])
    if rng.rand() < 0.2:
        X[:, -1] = X[:, 0]
    if rng.rand() < 0.3:
        X = X[rng.randint(0, max(1, n // 4), n)]
    if rng.rand() < 0.2:
        X = X + 1e8
    standard = (X - X.mean(axis=0)) / np.where(X.std(axis=0) > 0, X.std(axis=0), 1)
    waves = np.sin(2 * standard @ rng.randn(d, o))
    Y = [waves, standard @ rng.randn(d, o), np.zeros((n, o)), np.full((n, o), 5.0), rng.randn(n, o)][rng.randint(5)]
    if rng.rand() < 0.3:
        Y = Y * 10.0 ** rng.uniform(-12, 12, o)
    if rng.rand() < 0.2:
        Y = Y + 1e8
    arguments = {
        "feature_map": [None, PolynomialFeatures(1), PolynomialFeatures(2)][rng.randint(3)],
        "n_inducing": int(rng.choice([1, 5, 20, 200])),
        "sharing": str(rng.choice(["all", "kernel", "none", "auto"])),
        "solver": [LBFGS, LBFGS, LBFGS, Adam][rng.randint(4)](posterior=str(rng.choice(["full", "diagonal"]))),
        "normalize_y": bool(rng.rand() < 0.5),
    }
    return X, Y, arguments


@pytest.mark.long
@pytest.mark.parametrize("seed", range(80))
def test_finite_data_never_fail(seed):
    X, Y, arguments = nasty(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = EVGPRegressor(**arguments, max_iter=30, random_state=0).fit(X, Y)
    assert_finite(model, X)
    assert np.isfinite(model.lower_bound_)
    assert np.isfinite(model.upper_bound_)
    if isinstance(arguments["solver"], LBFGS):
        # Adam's lower bound is summed in another way, of which rounding at 1e8 leaves other digits.
        assert_above(model.upper_bound_, model.lower_bound_)
    assert np.isfinite(model.sample_y(X[:3])).all()


def assert_finite(model, X):
    """Predictions near the rows."""
    mean, std = model.predict(np.vstack([X, X + X.std(axis=0)]), return_std=True)
    assert np.isfinite(mean).all()
    assert np.isfinite(std).all()
    assert (std > 0).all()


def assert_above(upper, lower):
    """But for rounding."""
    assert lower - 1e-5 * abs(lower) - 1e-3 <= upper < np.inf


@pytest.mark.parametrize("seed", range(30))
def test_finite_data_never_fail_however_many_points_there_are_to_be(seed):
    X, Y, arguments = nasty(seed)
    arguments |= {"solver": LBFGS(max_inducing=40), "n_inducing": "auto"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = EVGPRegressor(**arguments, max_iter=20, random_state=0).fit(X, Y)
    assert_finite(model, X)
    assert_above(model.upper_bound_, model.lower_bound_)


@pytest.mark.parametrize("seed", range(30))
def test_finite_data_never_fail_natural_gradients(seed):
    X, Y, arguments = nasty(seed)
    arguments |= {"solver": Adam(batch_size=64, natural_gradient=True, posterior="full")}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = EVGPRegressor(**arguments, max_iter=30, random_state=0).fit(X, Y)
    mean, std = model.predict(np.vstack([X, X + X.std(axis=0)]), return_std=True)
    assert np.isfinite(mean).all()
    assert (std > 0.0).all()
    assert np.isfinite(std).all()
    assert np.isfinite(model.lower_bound_)


@pytest.mark.parametrize("scale", [1e-120, 1e-12, 1e12, 1e90])
def test_targets_of_any_scale(scale):
    X = np.linspace(0, 3, 40)[:, np.newaxis]
    model = EVGPRegressor(n_inducing=10, random_state=0, solver=LBFGS(tol=1.0)).fit(X, scale * np.sin(X[:, 0]))
    mean, std = model.predict(X, return_std=True)
    np.testing.assert_allclose(mean / scale, np.sin(X[:, 0]), atol=0.05)
    assert (std > 0).all()


def test_numbers_whose_squares_overflow_are_refused():
    X = np.ones((3, 1))
    with pytest.raises(ValueError, match=r"y must not exceed 1e\+100 in size; its largest value is 1e\+200"):
        EVGPRegressor().fit(X, [1.0, 2.0, 1e200])
    with pytest.raises(ValueError, match="X must not exceed"):
        EVGPRegressor().fit(1e200 * X, [1.0, 2.0, 3.0])


def test_fewer_rows_than_inducing_points_works_with_fewer_points():
    X = np.random.RandomState(0).randn(7, 2)
    assert EVGPRegressor(n_inducing=100, solver=LBFGS(tol=1.0)).fit(X, X[:, 0]).inducing_points_.shape == (7, 2)


def test_rows_on_top_of_each_other_count_as_one_place():
    X = np.repeat(np.arange(4.0), 10)[:, np.newaxis]
    y = X[:, 0] + 0.1 * np.random.RandomState(0).randn(40)
    model = EVGPRegressor(n_inducing=100, solver=LBFGS(tol=1.0)).fit(X, y)
    assert model.inducing_points_.shape == (4, 1)
    np.testing.assert_allclose(model.predict([[0.0], [3.0]]), [0.0, 3.0], atol=0.2)


def test_noise_that_is_all_there_is_is_found():
    rng = np.random.RandomState(0)
    X, y = rng.randn(300, 2), 2.0 * rng.randn(300)
    model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, y)
    assert np.sqrt(model.noise_variance_) == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("constant", [0.1, 0.3, 1e8 + 0.1])
def test_a_constant_column_may_move_a_little_afterwards(constant):
    """The mean of equal numbers rounds; the column must not end with a lengthscale of 1e-17."""
    rng = np.random.RandomState(0)
    X = np.column_stack([rng.uniform(-2, 2, 1000), np.full(1000, constant)])
    y = np.sin(2 * X[:, 0]) + 0.05 * rng.randn(1000)
    model = EVGPRegressor(n_inducing=15, random_state=0, solver=LBFGS(tol=1.0)).fit(X, y)
    assert model.score(X * [1.0, 1.0 + 1e-9], y) > 0.99


@pytest.mark.parametrize("offset", [1e2, 5e3])
def test_a_wave_far_from_zero_is_learned(offset):
    rng = np.random.RandomState(0)
    X = rng.uniform(-2, 2, (300, 1))
    y = offset + np.sin(2 * X[:, 0]) + 0.05 * rng.randn(300)
    assert EVGPRegressor(n_inducing=20, random_state=0).fit(X, y).score(X, y) > 0.98


@pytest.mark.parametrize("scale", [1.0, 1e8])
def test_powers_of_columns_far_from_zero_explain_a_line(scale):
    rng = np.random.RandomState(0)
    X = 1e8 + rng.randn(30, 5)
    line = (X - 1e8).sum(axis=1)
    model = EVGPRegressor(PolynomialFeatures(), coef_prior=CoefPrior(scale=scale), random_state=0).fit(
        X, line + 1e-8 * rng.randn(30)
    )
    # The weights of 20 products of 1e16, which add up to a line of size 1, leave 1e-7 of it.
    assert np.abs(model.predict(X) - line).max() <= 1e-5
    assert model.noise_variance_ <= 1e-10


def test_rows_that_differ_by_rounding_share_inducing_points():
    rng = np.random.RandomState(0)
    X = np.repeat([[0.0], [1.0], [2.0]], 20, axis=0) + 1e-14 * rng.randn(60, 1)
    model = EVGPRegressor(n_inducing=20, random_state=0, solver=LBFGS(tol=1.0)).fit(X, X[:, 0] + 0.1 * rng.randn(60))
    assert np.isfinite(model.predict(X)).all()


GOOD = np.random.RandomState(0).randn(20, 3)


@pytest.mark.parametrize(
    ("X", "y", "message"),
    [
        (np.full((5, 2), np.nan), np.ones(5), "X contains NaN"),
        (np.full((5, 2), np.inf), np.ones(5), "X contains infinity"),
        (np.ones((5, 2)), np.full(5, np.nan), "y contains NaN"),
        (np.ones((0, 2)), np.ones(0), "0 sample"),
        (np.ones((5, 0)), np.ones(5), "0 feature"),
        (np.ones(5), np.ones(5), "Expected 2D array"),
        (np.ones((5, 2)), np.ones(4), "inconsistent numbers of samples"),
        (np.ones((5, 2)), None, "requires y to be passed"),
        (np.array([["a"], ["b"]]), np.ones(2), "X must be real numbers: could not convert"),
    ],
)
def test_bad_data(X, y, message):
    with pytest.raises(ValueError, match=message):
        EVGPRegressor().fit(X, y)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_inducing": 0}, "'n_inducing' parameter .* must be an int in the range"),
        ({"sharing": "some"}, "'sharing' parameter .* must be a str among"),
        ({"solver": LBFGS(posterior="banded")}, 'posterior of LBFGS must be "full" or "diagonal"'),
        ({"solver": "sgd"}, r"solver must be one of \"lbfgs\", \"adam\", .*LBFGS\(\.\.\.\), .*; got 'sgd'"),
        ({"noise": "cauchy"}, r"noise must be one of \"gaussian\", \"student-t\", .*StudentT\(\.\.\.\); got 'cauchy'"),
        ({"noise": Gaussian(variance=0.0)}, "variance of Gaussian must be finite and above 0"),
        ({"max_iter": -1}, "'max_iter' parameter"),
        ({"solver": LBFGS(tol=-1.0)}, "tol of LBFGS must be finite and at least 0"),
        ({"solver": Adam(batch_size=0)}, "batch_size of Adam must be at least 1; got 0"),
        ({"solver": Adam(learning_rate=0.0)}, "learning_rate of Adam must be finite and above 0"),
        ({"solver": LBFGS(n_restarts=-1)}, "n_restarts of LBFGS must be at least 0; got -1"),
        (
            {"feature_map": PolynomialFeatures(1), "coef_prior": CoefPrior(mean="prior")},
            "mean of CoefPrior must be real",
        ),
        (
            {"feature_map": PolynomialFeatures(1), "coef_prior": CoefPrior(mean=[1.0, 2.0])},
            r"mean of CoefPrior must be .* \(1, 4\)",
        ),
        (
            {"feature_map": PolynomialFeatures(1), "coef_prior": CoefPrior(scale=-1.0)},
            "scale of CoefPrior must not be negative",
        ),
        ({"feature_map": PolynomialFeatures(1), "coef_prior": CoefPrior(scale=np.inf)}, "finite"),
        (
            {"feature_map": PolynomialFeatures(1), "coef_prior": CoefPrior(mean=1e300)},
            "mean of CoefPrior must not exceed",
        ),
        ({"feature_map": FunctionTransformer(lambda X: 1e200 * X)}, "What feature_map=.* must not exceed"),
        ({"kernel_map": FunctionTransformer(lambda X: X[:, :0])}, "kernel_map=.* returned no columns"),
        ({"feature_map": InertiaForceGravity("pendulums")}, "Unknown robot 'pendulums'.*Did you mean 'pendulum'"),
        ({"feature_map": InertiaForce("acrobot")}, "X has 3 columns, but .* needs 5"),
        ({"feature_map": InertiaForce("pendulum")}, "y has 1 columns, but .* predicts 2 states"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        EVGPRegressor(**arguments).fit(GOOD, GOOD[:, 0])


@pytest.mark.parametrize("argument", ["feature_map", "kernel_map"])
@pytest.mark.parametrize("value", ["linear", np.sin, PolynomialFeatures])
def test_what_is_not_a_transformer_is_a_type_error(argument, value):
    with pytest.raises(TypeError, match=f"{argument} must be None or a transformer instance"):
        EVGPRegressor(**{argument: value}).fit(GOOD, GOOD[:, 0])


class Broken(TransformerMixin, BaseEstimator):
    def __init__(self, how="rows"):
        self.how = how

    def fit(self, X, y=None):
        return self

    def transform(self, X):
        return X[:-1] if self.how == "rows" else np.log(np.full((len(X), 1), 0.5)) * np.inf


@pytest.mark.parametrize("argument", ["feature_map", "kernel_map"])
@pytest.mark.parametrize(("how", "message"), [("rows", "one row per row of X"), ("values", "NaN or infinity")])
def test_maps_that_return_nonsense(argument, how, message):
    with pytest.raises(ValueError, match=f"{argument}=.*{message}"):
        EVGPRegressor(**{argument: Broken(how)}).fit(GOOD, GOOD[:, 0])


def test_a_failed_fit_leaves_the_data_alone():
    X, y = GOOD.copy(), GOOD[:, 0].copy()
    with pytest.raises(ValueError, match="scale of CoefPrior"):
        EVGPRegressor(PolynomialFeatures(1), coef_prior=CoefPrior(scale=-1.0)).fit(X, y)
    np.testing.assert_array_equal(X, GOOD)
    np.testing.assert_array_equal(y, GOOD[:, 0])


@pytest.mark.parametrize("n_inducing", [10, 40, 80])
@pytest.mark.parametrize("posterior", ["full", "diagonal"])
def test_rows_that_are_equal_but_for_rounding_are_duplicates(posterior, n_inducing):
    rng = np.random.RandomState(0)
    rows, new = rng.uniform(-2, 2, (40, 2)), rng.uniform(-2, 2, (30, 2))
    y = np.tile(np.sin(2 * rows[:, 0]) + rows[:, 1], 2) + 0.05 * rng.randn(80)
    nearly = rows * (1.0 + 4e-16 * rng.choice([-1, 1], rows.shape))
    model = EVGPRegressor(
        n_inducing=n_inducing,
        solver=LBFGS(posterior=posterior),
        noise=Gaussian(variance=0.01),
        max_iter=0,
        random_state=0,
    )
    same, near = (clone(model).fit(np.vstack([rows, others]), y) for others in (rows, nearly))
    assert (np.vstack([rows, nearly]) != np.vstack([rows, rows])).any()
    for found, expected in zip(near.predict(new, return_std=True), same.predict(new, return_std=True), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-8)
    assert near.lower_bound_ == pytest.approx(same.lower_bound_, abs=1e-6)


DEPENDENT = {
    "sum": lambda X: [X, X.sum(axis=1)],
    "other units": lambda X: [X, 3.7 * X, 1e-3 * X],
    "copies and zeros": lambda X: [X, X, 0.0 * X],
}


@pytest.mark.parametrize("coef_scale", [1e3, 1e7, 1e9])
@pytest.mark.parametrize("name", DEPENDENT)
def test_features_that_depend_on_each_other_share_what_they_explain(name, coef_scale):
    """Of all weights that explain it the prior takes the smallest, however wide it is; rounding is not one of them."""
    rng = np.random.RandomState(0)
    X = rng.randn(60, 2)
    y = X @ [1.0, 2.0] + 0.5 + 0.1 * rng.randn(60)
    features = FunctionTransformer(lambda X: np.column_stack([*DEPENDENT[name](X), np.ones(len(X))]))
    model = EVGPRegressor(features, coef_prior=CoefPrior(scale=coef_scale), n_inducing=5, max_iter=0).fit(X, y)
    expected = np.linalg.lstsq(features.transform(X), y, rcond=1e-10)[0]
    np.testing.assert_allclose(model._fitted.units.prior.offset[0], expected, atol=1e-4)
