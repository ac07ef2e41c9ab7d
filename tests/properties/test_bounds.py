"""Bounds on the likelihood are in order, and what more points and more rows do to them and to variances."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.base import clone
from sklearn.gaussian_process import kernels as sk

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.solvers import LBFGS, Adam

from .cases import STATELESS, data, fewer, fixed_cases, fixed_models, tables

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def exact_of(model):
    """The exact model of the same kernel, noise and prior."""
    names = ("feature_map", "kernel", "kernel_map", "coef_prior", "normalize_y")
    return EGPRegressor(**{name: getattr(model, name) for name in names}, max_iter=0)


def assert_in_order(*values):
    """But for a jitter, 1e-12 of the signal for each of 24 rows over a noise of 1e-3 or more, and for rounding.

    With points that are all the same it is 1e-16 over the jitter's root, 1e-10 of V, times signal over noise.
    """
    for lower, higher in pairwise(values):
        assert lower <= higher + 1e-6 * max(abs(lower), abs(higher), 1.0)


@given(fixed_cases(exact=False))
def test_bounds_are_ordered(case):
    model = case.fitted()
    likelihood = exact_of(case.model).fit(case.X, case.Y).log_marginal_likelihood_value_
    assert_in_order(model.lower_bound_, likelihood, model.upper_bound_)
    loose, tight = (case.with_model(solver=LBFGS(bound=own)).fitted().lower_bound_ for own in ("titsias", "tight"))
    assert_in_order(loose, tight, likelihood)
    if not case.model.coef_prior.shared:
        # The loose bound is that of a full q.
        diagonal = case.with_model(solver=LBFGS(posterior="diagonal")).fitted().lower_bound_
        assert_in_order(diagonal, loose, likelihood)


@fewer(2)
@given(fixed_cases(exact=False), st.floats(0.01, 2.0))
def test_bounds_of_weighted_rows_are_ordered(case, weight):
    weights = weight * np.linspace(0.1, 1.0, len(case.X))
    models = [*(case.with_model(solver=LBFGS(bound=own)).model for own in ("titsias", "tight")), exact_of(case.model)]
    loose, tight, exact = (clone(model).fit(case.X, case.Y, weights) for model in models)
    assert_in_order(loose.lower_bound_, tight.lower_bound_, exact.log_marginal_likelihood_value_, tight.upper_bound_)


@given(fixed_cases(exact=False), st.data())
def test_more_points_bring_the_bounds_together(case, draws):
    points = draws.draw(tables(7, case.X.shape[1]))
    m = draws.draw(st.integers(1, 6))
    few, many = (
        case.with_model(solver=LBFGS(bound="titsias"), inducing_init=own).fitted() for own in (points[:m], points)
    )
    assert_in_order(few.lower_bound_, many.lower_bound_, many.upper_bound_, few.upper_bound_)


@fewer(2)
@given(fixed_cases(exact=False, most_outputs=1), st.integers(0, 10), st.booleans())
def test_bound_of_any_q_is_below_that_of_the_best(case, n_steps, natural):
    """Adam's q, after a few steps, and q at its optimum for the same points, kernel and noise."""
    posterior = "full" if natural else case.model.solver.posterior
    bound = case.model.solver.bound
    adam = Adam(batch_size=len(case.X), natural_gradient=natural, posterior=posterior, bound=bound)
    any_q = case.with_model(solver=adam, max_iter=n_steps, noise_cv=None).fitted()
    kernel = any_q.kernel_ + sk.WhiteKernel(any_q.noise_variance_, "fixed")
    best = case.with_model(kernel=kernel, inducing_init=any_q.inducing_points_)
    bounds = [
        best.with_model(solver=LBFGS(posterior=own, bound=bound)).fitted().lower_bound_ for own in (posterior, "full")
    ]
    assert_in_order(
        any_q.lower_bound_, *bounds, exact_of(best.model).fit(case.X, case.Y).log_marginal_likelihood_value_
    )


@given(data(fewest_rows=2), st.data())
def test_more_rows_leave_less_to_know(rows, draws):
    X, Y, X_new = rows
    model = draws.draw(fixed_models(X, Y.shape[1], given_maps=STATELESS))
    cut = draws.draw(st.integers(1, len(X) - 1))
    if isinstance(model, EVGPRegressor):
        model.set_params(inducing_init=draws.draw(tables(5, X.shape[1])))
    few, more = clone(model).fit(X[:cut], Y[:cut]), [clone(model).fit(X, Y)]
    if isinstance(model, EVGPRegressor):
        more.append(clone(model).fit(X[:cut], Y[:cut]).partial_fit(X[cut:], Y[cut:]))
    H = 0.0 if few.feature_map_ is None else np.abs(few.feature_map_.transform(X_new)).max()
    before = few.predict(X_new, return_std=True, include_noise=False)[1]
    for one in more:
        after = one.predict(X_new, return_std=True, include_noise=False)[1]
        assert (after**2 <= before**2 + 1e-7 * max(4.0, H) ** 2).all()
