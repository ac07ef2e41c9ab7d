"""Against 120 digits: what is lost to rounding. `tests/long/accuracy.py` has a table of many more problems."""

from dataclasses import replace
from functools import cache

import mpmath
import numpy as np
import pytest

from skevgp import EGPRegressor

from .accuracy import MODELS, Problem, errors, jitter_of, measure_of, sparse
from .precise import DIGITS

SHAPE = {"n": 8, "m": 4, "d": 2, "p": 2}
# A backward stable algorithm is up to so many times as far off as one with a unit in the last place of each number.
SLACK = SHAPE["n"] + SHAPE["m"]


@pytest.fixture(autouse=True)
def _digits():
    with mpmath.workdps(DIGITS):
        yield


@cache
def drawn(*of, seed):
    """A problem that all models are given."""
    return Problem.drawn(*of, seed=seed, **SHAPE)


@pytest.mark.parametrize("name", MODELS)
def test_little_is_lost_at_a_ratio_of_1e8(name):
    model = MODELS[name](drawn(1e8, 1e6, seed=1))
    library = measure_of(model)(model.found())
    assert library["bound"] < 1e-8
    assert library["mean"] < 1e-8
    assert library["variance"] < 1e-6
    assert library.get("gradient", 0.0) < 1e-6


@pytest.mark.parametrize(
    "ratio", [1e8, pytest.param(1.0, marks=pytest.mark.long), pytest.param(1e10, marks=pytest.mark.long)]
)
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("seed", [0])
def test_with_k_nearly_singular_no_more_is_lost_than_doubles_of_its_values_lose(name, ratio, seed):
    """That is more than 1e-8 of the bound and 1e-6 of variances: no algorithm has them who has doubles of K."""
    model = MODELS[name](drawn(ratio, 1e16, seed=seed))
    library, inputs, kernel = errors(model, gradient=False, draws=4)
    for figure, error in library.items():
        assert error < SLACK * max(kernel[figure], 1e-14), figure
        # It is not the problem.
        assert inputs[figure] < 1e-8
    if name != "given q":
        assert library["mean"] < 1e-8


# --- inducing points at all rows --------------------------------------------------------------------------------------


def both(wanted, p):
    """Of the same rows, with a noise variance of 1e-10 of y's."""
    problem = Problem.drawn(1e8, wanted, n=12, m=12, d=2, p=p, seed=0)
    problem = replace(problem, noise=1e-10 * problem.y.var(), points=problem.X)
    return problem, sparse(problem), EGPRegressor(**problem.arguments).fit(problem.X, problem.y)


@pytest.mark.parametrize("p", [0, 2])
def test_points_at_all_rows_give_the_exact_model_with_hardly_any_noise(p):
    problem, sparsely, exactly = both(1e5, p)
    assert jitter_of(sparsely) == 0.0
    # Of p directions the data say nothing: B is 1 there, which its Cholesky factor knows to a rounding error of its
    # trace. Means are refined (without it they differ by 1e-6 of y), determinant and variances are not.
    share = p * np.finfo(float).eps * float((problem.precise().P ** 2).sum() / problem.noise)
    slack = 1e-9 * abs(exactly.log_marginal_likelihood_value_) + share
    assert sparsely.lower_bound_ == pytest.approx(exactly.log_marginal_likelihood_value_, abs=slack)
    of_mean = {"rtol": 0, "atol": 1e-8 * np.abs(problem.y).max()}
    (mean, std), (exact_mean, exact_std) = (
        model.predict(problem.X_new, return_std=True, include_noise=False) for model in (sparsely, exactly)
    )
    np.testing.assert_allclose(mean, exact_mean, **of_mean)
    np.testing.assert_allclose(std, exact_std, rtol=1e-8 + share)
    if p:
        np.testing.assert_allclose(sparsely.coef_, exactly.coef_, **of_mean)
