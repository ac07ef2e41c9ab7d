"""Finite data never end in LinAlgError or NaN; what cannot be fitted is refused with a message that helps."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures

from skevgp import CoefPrior, EVGPRegressor
from skevgp.features import InertiaForce, InertiaForceGravity
from skevgp.noise import Gaussian
from skevgp.solvers import LBFGS, Adam


def test_numbers_whose_squares_overflow_raise():
    X = np.ones((3, 1))
    with pytest.raises(ValueError, match=r"y must not exceed 1e\+100 in size; its largest value is 1e\+200"):
        EVGPRegressor().fit(X, [1.0, 2.0, 1e200])
    with pytest.raises(ValueError, match="X must not exceed"):
        EVGPRegressor().fit(1e200 * X, [1.0, 2.0, 3.0])


def test_rows_on_top_of_each_other_count_as_one_place():
    X = np.repeat(np.arange(4.0), 10)[:, np.newaxis]
    y = X[:, 0] + 0.1 * np.random.RandomState(0).randn(40)
    model = EVGPRegressor(n_inducing=100, solver=LBFGS(tol=1.0)).fit(X, y)
    assert model.inducing_points_.shape == (4, 1)
    np.testing.assert_allclose(model.predict([[0.0], [3.0]]), [0.0, 3.0], atol=0.2)


@pytest.mark.parametrize("n", [1, 20])
def test_rows_at_one_place_have_no_neighbours_to_learn_from(n):
    """Warnings are errors here: that the noise explains everything is as it should be."""
    y = 1.0 + np.random.RandomState(0).randn(n)
    model = EVGPRegressor(n_inducing=1, normalize_y=True, noise_cv=None, random_state=0).fit(np.ones((n, 2)), y)
    assert model.predict(np.ones((1, 2))) == pytest.approx(y.mean(), abs=1e-6)


def test_outliers_that_are_too_many_are_noise():
    """A third of the rows: their scatter as noise of all rows is far likelier than so many large scales."""
    rng = np.random.RandomState(0)
    X = rng.uniform(-2.0, 2.0, (60, 1))
    y = np.sin(2.0 * X[:, 0]) + 0.05 * rng.randn(60)
    y[:20] += 20.0 * np.tile([-1.0, 1.0], 10)
    model = EVGPRegressor(noise="student-t", n_inducing=10, random_state=0)
    with pytest.warns(ConvergenceWarning, match="of the rows are far from the prediction"):
        model.fit(X, y)
    assert model.weights_.min() > 0.9
    assert np.sqrt(model.noise_variance_) == pytest.approx(20.0 / np.sqrt(3.0), rel=0.2)


@pytest.mark.parametrize("constant", [0.1, 0.3, 1e8 + 0.1])
def test_constant_column_may_move_a_little_afterwards(constant):
    """The mean of equal numbers rounds; the column must not end with a lengthscale of 1e-17."""
    rng = np.random.RandomState(0)
    X = np.column_stack([rng.uniform(-2, 2, 1000), np.full(1000, constant)])
    y = np.sin(2 * X[:, 0]) + 0.05 * rng.randn(1000)
    model = EVGPRegressor(n_inducing=15, random_state=0, solver=LBFGS(tol=1.0)).fit(X, y)
    assert model.score(X * [1.0, 1.0 + 1e-9], y) > 0.99
    assert model.kernel_.k2.length_scale[1] > 1e-4


@pytest.mark.parametrize(("offset", "width"), [(1.7e18, 1e7), (1e9, 1e-3)], ids=["nanoseconds", "1e9"])
def test_column_with_a_large_offset_is_learned(offset, width):
    rng = np.random.RandomState(0)
    share = rng.uniform(size=300)
    y = np.sin(6.0 * share) + 0.05 * rng.randn(300)
    model = EVGPRegressor(n_inducing=15, random_state=0).fit((offset + width * share)[:, np.newaxis], y)
    assert model.score((offset + width * share)[:, np.newaxis], y) > 0.98


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
def test_invalid_data(X, y, message):
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
def test_invalid_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        EVGPRegressor(**arguments).fit(GOOD, GOOD[:, 0])


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
