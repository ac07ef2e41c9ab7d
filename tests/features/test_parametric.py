"""Features with parameters: derivatives, priors, and errors that name the parameter."""

import pickle
import warnings

import autograd.numpy as anp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.stats import lognorm, norm, uniform
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from skevgp.features import LogNormal, Normal, ParametricFeatures, Uniform

from ..theta import PRIORS, WAVE, data, decay, rows_of_outputs, wave, wave_and_slope

X, _ = data()


# --- priors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("prior", "expected"),
    [
        (Normal(1.0, 2.0), norm(1.0, 2.0)),
        (LogNormal(0.5, 0.2), lognorm(0.2, scale=0.5)),
        (Uniform(-1.0, 3.0), uniform(-1.0, 4.0)),
    ],
    ids=["normal", "log-normal", "uniform"],
)
def test_coordinates_are_standard_normal(prior, expected):
    for z in (-2.5, -0.3, 0.0, 1.7):
        value = prior.value(z)
        assert expected.cdf(value) == pytest.approx(norm.cdf(z))
        assert prior.coordinate(value) == pytest.approx(z, abs=1e-9)
        assert prior.slope(z) == pytest.approx((prior.value(z + 1e-5) - prior.value(z - 1e-5)) / 2e-5)
    assert quad(lambda z: prior.slope(z), -1.0, 1.0)[0] == pytest.approx(prior.value(1.0) - prior.value(-1.0))


def test_bounded_values_stay_within():
    prior = Uniform(0.0, 0.05)
    for z in (-1e300, -40.0, 40.0, 1e300):
        assert 0.0 < prior.value(z) < 0.05
        assert prior.slope(z) > 0.0
        assert np.isfinite(prior.coordinate(prior.value(z)))
    assert prior.coordinate(0.05) == -prior.coordinate(0.0) == 6.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Normal(0.0, 0.0), "std must be finite and above 0"),
        (lambda: Normal(np.nan, 1.0), "mean must be finite"),
        (lambda: LogNormal(0.0, 1.0), "median"),
        (lambda: LogNormal(1.0, -1.0), "sigma"),
        (lambda: Uniform(1.0, 1.0), "low=1.0 must be below high=1.0"),
        (lambda: Uniform(0.0, np.inf), "high"),
    ],
)
def test_priors_out_of_range_raise(make, message):
    with pytest.raises(ValueError, match=message):
        make()
    with pytest.raises(TypeError, match="mean must be a number"):
        Normal("0", 1.0)


# --- derivatives -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("derivatives", ["autograd", "differences"])
@pytest.mark.parametrize("function", [wave, wave_and_slope, rows_of_outputs])
def test_derivatives_are_slopes(function, derivatives):
    features = ParametricFeatures(function, PRIORS, derivatives=derivatives).fit(X)
    theta = {"period": 1.7, "phase": 0.4}
    features.set_theta(theta)
    assert_array_equal(features.transform(X), np.reshape(function(X, **theta), features.transform(X).shape))

    def at(name, step):
        return np.reshape(function(X, **{**theta, name: theta[name] + step}), features.transform(X).shape)

    found = features.theta_jacobian(X)
    for index, name in enumerate(PRIORS):
        assert_allclose(found[..., index], (at(name, 1e-6) - at(name, -1e-6)) / 2e-6, atol=1e-7)
    slopes = features.jacobian(X)
    for column, step in enumerate(1e-6 * np.eye(2)):
        expected = (features.transform(X + step) - features.transform(X - step)) / 2e-6
        assert_allclose(slopes[..., column], expected, atol=1e-6)


def test_parameter_or_column_without_effect_has_slope_0():
    features = ParametricFeatures(lambda X, a, b: a * X[:, 0], {"a": Normal(1, 1), "b": Normal(0, 1)}).fit(X)
    assert_array_equal(features.theta_jacobian(X), np.stack([X[:, :1], np.zeros((40, 1))], axis=-1))
    assert_array_equal(features.jacobian(X)[:, 0], np.tile([1.0, 0.0], (40, 1)))


def test_function_outside_of_autograd_needs_differences():
    def by_scipy(X, rate):
        return np.array([float(np.exp(-rate * x)) for x in X[:, 0]])

    with pytest.raises(ValueError, match='(?s)autograd cannot differentiate.*derivatives="differences"'):
        ParametricFeatures(by_scipy, {"rate": LogNormal(1.0, 0.3)}).fit(X)
    features = ParametricFeatures(by_scipy, {"rate": LogNormal(1.0, 0.3)}, derivatives="differences").fit(X)
    expected = ParametricFeatures(decay, {"rate": LogNormal(1.0, 0.3)}).fit(X)
    assert_allclose(features.theta_jacobian(X), expected.theta_jacobian(X), rtol=1e-9)


def test_function_may_return_list():
    features = ParametricFeatures(lambda X, a: [[a * x] for x in X[:, 0]], {"a": Normal(2.0, 1.0)}).fit(X)
    assert_array_equal(features.transform(X), 2.0 * X[:, :1])
    assert_array_equal(features.theta_jacobian(X)[..., 0], X[:, :1])


# --- names, copies ---------------------------------------------------------------------------------------------------


def test_names_are_those_of_the_function():
    assert list(clone(WAVE).fit(X).get_feature_names_out()) == ["wave"]
    named = ParametricFeatures(wave_and_slope, PRIORS).fit(X)
    assert list(named.get_feature_names_out()) == ["wave_and_slope0", "wave_and_slope1"]
    assert list(ParametricFeatures(lambda X, a: a * X, {"a": Normal(1, 1)}).fit(X[:, :1]).get_feature_names_out()) == [
        "lambda"
    ]


def test_copies_keep_values_and_clones_forget_them():
    features = clone(WAVE).fit(X)
    features.set_theta({"period": 1.3, "phase": 0.1})
    again = pickle.loads(pickle.dumps(features))
    assert again.theta_ == features.theta_ == {"period": 1.3, "phase": 0.1}
    with pytest.raises(NotFittedError):
        clone(features).transform(X)


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("function", "parameters", "error", "message"),
    [
        (wave, {"period": Uniform(1, 3)}, TypeError, "parameter 'phase' has no prior"),
        (wave, {"period": Uniform(1, 3), "phase": 0.5}, TypeError, "parameter 'phase' has no prior.*got 0.5"),
        (
            wave,
            {**PRIORS, "frequency": Normal(0, 1)},
            ValueError,
            r"no parameters \['frequency'\]; those that can be passed by name are \['per",
        ),
        (wave, {}, ValueError, "parameters is empty"),
        (lambda X, a: anp.log(a) * X, {"a": Normal(1.0, 0.5)}, ValueError, "with a=-0.5, returned NaN"),
        (lambda X, a: X / (a - 4.0), {"a": Normal(1.0, 1.0)}, ValueError, "with a=4, returned NaN or infinity"),
        (
            lambda X, a: X[:, : 1 + (a > 1.0)] * a,
            {"a": Normal(0, 1)},
            ValueError,
            r"with a=3, returned the shape \(4",
        ),
        (lambda X, a: a * X[:3], {"a": Normal(0, 1)}, ValueError, r"with a=0, must return a row for each row of X"),
        (lambda X, a: anp.sqrt(a * X), {"a": LogNormal(1, 1)}, ValueError, "derivative.* in a is NaN.* a=1. Change"),
    ],
)
def test_errors_name_parameter_and_value(function, parameters, error, message):
    rows = np.abs(X) * (np.arange(40) > 0)[:, None]
    with warnings.catch_warnings():
        # NumPy's own, of a user's function.
        warnings.simplefilter("ignore", RuntimeWarning)
        with pytest.raises(error, match=message):
            ParametricFeatures(function, parameters).fit(rows)


def test_unit_of_unknown_parameter_raises():
    with pytest.raises(ValueError, match=r"names \['length'\], which are no parameters"):
        ParametricFeatures(wave, PRIORS, units={"length": "m"}).fit(X)
