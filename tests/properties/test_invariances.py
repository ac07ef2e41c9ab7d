"""What must not change a model: the order of rows, columns, points and outputs, units, copies instead of weights."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.base import clone
from sklearn.gaussian_process import kernels as sk
from sklearn.preprocessing import FunctionTransformer

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.solvers import LBFGS

from .cases import (
    LENGTHS,
    NOISES,
    STATELESS,
    assert_near,
    assert_same_bits,
    assert_same_predictions,
    columns_of,
    data,
    fewer,
    fixed_cases,
    fixed_models,
    learned_cases,
    one_or_more,
    size_of,
    tables,
)

pytestmark = [
    pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning"),
    pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning"),
]


def value_of(model):
    """What a fit makes as large as it can."""
    return getattr(model, "lower_bound_" if isinstance(model, EVGPRegressor) else "log_marginal_likelihood_value_")


def assert_same_value(one, other, shift=0.0):
    """Not of a diagonal q: where points need a jitter, its bound has the logarithm of what rounding makes of that."""
    if not hasattr(one, "solver") or one.solver.posterior == "full":
        assert value_of(one) == pytest.approx(value_of(other) + shift, rel=1e-6, abs=1e-5)


# --- rows: the same bits, so that iterations that follow are the same too -------------------------------------------


@given(learned_cases(most_outputs=2), st.data())
def test_order_of_rows_changes_no_bit(case, draws):
    order = draws.draw(st.permutations(range(len(case.X))))
    one, other = case.fitted(), case.fitted(case.X[order], case.Y[order])
    assert_same_bits(one, other, case.X_new)
    assert value_of(one) == value_of(other)
    if hasattr(one, "weights_"):
        np.testing.assert_array_equal(other.weights_, one.weights_[order])


@fewer(2)
@given(learned_cases())
def test_fit_repeats_to_the_bit(case):
    model = case.fitted()
    again = clone(model).fit(case.X, case.Y)
    assert_same_bits(model, again, case.X_new)
    assert_same_bits(model, again.fit(case.X, case.Y), case.X_new)


@st.composite
def repetitions(draw, n_rows):
    """How often each row counts, some of them above 0; and the rows, each so often."""
    weights = np.array(draw(st.lists(st.integers(0, 3), min_size=n_rows, max_size=n_rows).filter(any)))
    return weights, np.repeat(np.arange(n_rows), weights)


@given(learned_cases(most_outputs=2, given_maps=STATELESS), st.data())
def test_weight_is_so_many_rows_to_the_bit(case, draws):
    weights, rows = draws.draw(repetitions(len(case.X)))
    weighted, repeated = case.fitted(sample_weight=weights), case.fitted(case.X[rows], case.Y[rows])
    assert_same_bits(weighted, repeated, case.X_new)
    assert value_of(weighted) == value_of(repeated)


@given(fixed_cases(), st.sampled_from([0.5, 3.0, 100.0]), st.data())
def test_unit_of_known_noise_is_the_noises(case, unit, draws):
    n = len(case.X)
    variance = np.array(draws.draw(st.lists(st.sampled_from([1.0, 0.1, 4.0]), min_size=n, max_size=n)))
    one = case.fitted(relative_variance=variance)
    kernel, noise = case.model.kernel.k1, case.model.kernel.k2.noise_level
    other = case.with_model(kernel=kernel + sk.WhiteKernel(noise / unit, "fixed"))
    other = other.fitted(relative_variance=unit * variance)
    size = size_of(one, case)
    asked = {"return_std": True, "include_noise": False}
    for (found, expected), power in zip(
        zip(other.predict(case.X_new, **asked), one.predict(case.X_new, **asked), strict=True), (1, 2), strict=True
    ):
        assert_near(found**power, expected**power, size**power)
    assert_same_value(other, one)


# --- y ---------------------------------------------------------------------------------------------------------------


@given(fixed_cases(), st.sampled_from([1.0, -100.0, 1e4]))
def test_constant_added_to_a_normalised_y_is_added_to_predictions(case, constant):
    one = case.with_model(normalize_y=True).fitted()
    other = case.with_model(normalize_y=True).fitted(Y=case.Y + constant)
    size = max(size_of(one, case), abs(constant))
    mean, std = one.predict(case.X_new, return_std=True)
    moved, moved_std = other.predict(case.X_new, return_std=True)
    assert_near(moved, mean + constant, size)
    assert_near(moved_std**2, std**2, size_of(one, case) ** 2)


@given(fixed_cases(), st.sampled_from([2.0, -1.0, 1e3, -1e-3]))
def test_unit_of_y_is_that_of_predictions(case, unit):
    one, given = case.fitted(), case.model
    signal, noise, shared = given.kernel.k1, given.kernel.k2.noise_level, given.coef_prior.shared
    scaled = case.with_model(
        kernel=sk.ConstantKernel(signal.k1.constant_value * unit**2, "fixed") * signal.k2
        + sk.WhiteKernel(noise * unit**2, "fixed"),
        coef_prior=CoefPrior(given.coef_prior.mean * unit, given.coef_prior.scale * abs(unit), shared=shared),
    )
    other, size = scaled.fitted(Y=case.Y * unit), size_of(one, case)
    for include_noise in (True, False):
        asked = {"return_std": True, "include_noise": include_noise}
        (mean, std), (moved, moved_std) = one.predict(case.X_new, **asked), other.predict(case.X_new, **asked)
        assert_near(moved / unit, mean, size)
        assert_near((moved_std / unit) ** 2, std**2, size**2)
    assert_same_value(one, other, case.Y.size * np.log(abs(unit)))


# --- columns, points and outputs -------------------------------------------------------------------------------------


@st.composite
def plain_cases(draw):
    """A model with a length scale and a weight for each column, as function of their units and order."""
    X, Y, X_new = draw(data())
    d = X.shape[1]
    lengths = np.array(draw(st.lists(LENGTHS, min_size=d, max_size=d)))
    scales = np.array(draw(st.lists(st.sampled_from([1.0, 0.1, 0.0]), min_size=d, max_size=d)))
    points = draw(tables(draw(st.integers(1, 8)), d))
    rough, noise = draw(st.sampled_from([np.inf, 2.5, 1.5, 0.5])), draw(NOISES)
    is_exact, posterior = draw(st.booleans()), draw(st.sampled_from(["full", "diagonal"]))

    def model(unit, order):
        kernel = sk.ConstantKernel(2.0, "fixed") * sk.Matern((np.abs(unit) * lengths)[order], nu=rough)
        o = Y.shape[1]
        parameters = {
            "feature_map": FunctionTransformer(),
            "kernel": kernel + sk.WhiteKernel(noise, "fixed"),
            "coef_prior": CoefPrior(
                mean=np.tile((0.5 / unit)[order], (o, 1)), scale=np.tile((scales / np.abs(unit))[order], (o, 1))
            ),
            "max_iter": 0,
        }
        if is_exact:
            return EGPRegressor(**parameters)
        places = (points * unit)[:, order]
        return EVGPRegressor(**parameters, inducing_init=places, solver=LBFGS(posterior=posterior), sharing="all")

    return model, X, Y, X_new


@given(plain_cases(), st.data())
def test_units_and_order_of_columns_do_not_matter(case, draws):
    model, X, Y, X_new = case
    d = X.shape[1]
    unit = np.array(draws.draw(st.lists(st.sampled_from([1.0, -2.0, 1e3, 0.01]), min_size=d, max_size=d)))
    order = np.array(draws.draw(st.permutations(range(d))))
    one = model(np.ones(d), np.arange(d)).fit(X, Y)
    other = model(unit, order).fit((X * unit)[:, order], Y)
    size = float(max(np.abs(Y).max(), 2.0, np.abs(X_new).max() * d))
    for found, expected in zip(
        other.predict((X_new * unit)[:, order], return_std=True), one.predict(X_new, return_std=True), strict=True
    ):
        assert_near(found, expected, size)


@given(fixed_cases(known_maps=True), st.data())
def test_order_of_outputs_does_not_matter(case, draws):
    Y = columns_of(case.Y)
    order, new = draws.draw(st.permutations(range(Y.shape[1]))), {}
    if isinstance(case.model, EVGPRegressor) and isinstance(case.model.sharing, list):
        new = {"sharing": [[order.index(output) for output in group] for group in case.model.sharing]}
    one, other = case.fitted(Y=Y), case.with_model(**new).fitted(Y=Y[:, order])
    size = size_of(one, case)
    for power, found, expected in zip(
        (1, 2), other.predict(case.X_new, return_std=True), one.predict(case.X_new, return_std=True), strict=True
    ):
        assert_near(columns_of(found) ** power, columns_of(expected)[:, order] ** power, size**power)
    assert_same_value(other, one)


# --- new rows --------------------------------------------------------------------------------------------------------


@given(data(fewest_rows=2), st.data())
def test_rows_in_parts_are_rows_at_once(rows, draws):
    X, Y, X_new = rows
    model = draws.draw(fixed_models(X, Y.shape[1], exact=False, given_maps=STATELESS))
    model.set_params(inducing_init=draws.draw(tables(5, X.shape[1])), normalize_y=False)
    Y, cut = one_or_more(draws.draw, Y), draws.draw(st.integers(1, len(X) - 1))
    at_once = clone(model).fit(X, Y)
    in_parts = clone(model).partial_fit(X[:cut], Y[:cut]).partial_fit(X[cut:], Y[cut:])
    H = 0.0 if at_once.feature_map_ is None else np.abs(at_once.feature_map_.transform(X_new)).max()
    size = max(np.abs(Y).max(), 4.0, H)
    assert_same_predictions(in_parts, at_once, X_new, 4.0 * size)
    assert_same_value(in_parts, at_once)
