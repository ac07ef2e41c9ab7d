from math import log, pi

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.stats import norm
from sklearn.gaussian_process import GaussianProcessRegressor

from skevgp.metrics import (
    calibration_error,
    containing_ratios,
    crps,
    interval_levels,
    neg_calibration_error,
    neg_crps,
    neg_nlpd,
    negative_log_predictive_density,
    prediction_error,
    std_norm,
)

RNG = np.random.default_rng(0)
Y, MEAN = RNG.normal(size=(2, 30, 3))
STD = RNG.uniform(0.1, 2.0, size=(30, 3))
OF_STD = [containing_ratios, negative_log_predictive_density, crps, calibration_error, interval_levels]
OF_PREDICTIONS = [prediction_error, *OF_STD]


def arguments(metric, y=Y, mean=MEAN, std=STD):
    return (y, mean) if metric is prediction_error else (y, mean, std)


def test_error_by_hand():
    assert prediction_error([[0.0, 0.0], [1.0, 2.0]], [[3.0, 4.0], [1.0, 3.0]]) == 3.0


def test_std_norm_by_hand():
    assert std_norm([[3.0, 4.0], [5.0, 12.0]]) == 9.0


def test_ratios_by_hand():
    ratios = containing_ratios([[1.0, -3.0], [0.0, 9.0]], np.zeros((2, 2)), [[1.0, 2.0], [1.0, 1.0]])
    assert_array_equal(ratios, [0.5, 0.75, 0.75])


def test_interval_without_width_holds_what_is_predicted_exactly():
    found = containing_ratios([1.0, 2.0], [1.0, 2.5], [1.0, 1.0], k=0)
    assert isinstance(found, np.ndarray)
    assert_array_equal(found, [0.5])


def test_containing_ratios_default_widths():
    assert_array_equal(containing_ratios([0.5, 1.5, 2.5, 3.5, 4.5], np.zeros(5), np.ones(5)), [0.2, 0.4, 0.6])


def test_edge_of_the_interval_is_inside():
    assert_array_equal(containing_ratios([2.0], [0.0], [1.0], k=[1.9, 2.0]), [0.0, 1.0])


def test_density_by_hand():
    expected = 0.5 * log(2 * pi) + log(2.0) + 0.5 * 1.5**2
    assert negative_log_predictive_density([3.0], [0.0], [2.0]) == pytest.approx(expected, rel=1e-15)


def test_density_sums_outputs_and_averages_rows():
    expected = -norm.logpdf(Y, MEAN, STD).sum() / 30
    assert negative_log_predictive_density(Y, MEAN, STD) == pytest.approx(expected, rel=1e-13)


def test_gaussian_errors_fall_into_the_intervals_of_the_normal_distribution():
    std = RNG.uniform(0.5, 5.0, size=(20_000, 2))
    mean = RNG.normal(size=std.shape)
    ratios = containing_ratios(mean + std * RNG.standard_normal(std.shape), mean, std)
    assert_allclose(ratios, [0.6827, 0.9545, 0.9973], rtol=0, atol=0.01)


def test_crps_sums_outputs_and_averages_rows():
    assert crps(Y, MEAN, STD) == pytest.approx(sum(crps(*column) for column in zip(Y.T, MEAN.T, STD.T, strict=True)))


@pytest.mark.parametrize(("y", "mean", "std"), [(0.3, 0.0, 1.0), (-7.0, 1.0, 0.5), (2.0, 2.0, 3.0)])
def test_crps_is_its_integral(y, mean, std):
    def below(x):
        return norm.cdf(x, mean, std) ** 2

    def above(x):
        return norm.sf(x, mean, std) ** 2

    expected = quad(below, -60.0, y, points=[mean])[0] + quad(above, y, 60.0, points=[mean])[0]
    assert crps([y], [mean], [std]) == pytest.approx(expected, rel=1e-7)


def test_crps_without_uncertainty_is_the_error():
    assert crps([1.0, -2.0, 3.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1e-320]) == pytest.approx(5.0 / 3.0)


def test_calibration_error_by_hand():
    """One value, at the end of the interval of probability p: the area is that of two triangles."""
    for p in (0.0, 0.3, 0.5, 1.0):
        expected = 0.5 * p**2 + 0.5 * (1.0 - p) ** 2
        assert calibration_error([norm.ppf(0.5 + p / 2) if p < 1 else 1.0], [0.0], [float(p < 1)]) == pytest.approx(
            expected
        )


@pytest.mark.parametrize(("factor", "expected"), [(0.0, 0.5), (1.0, 0.0), (1e9, 0.5)])
def test_calibration_error_of_gaussian_errors(factor, expected):
    errors = RNG.standard_normal(40_000)
    assert calibration_error(errors, np.zeros_like(errors), np.full_like(errors, factor)) == pytest.approx(
        expected, abs=0.005
    )


def test_levels_are_those_of_intervals_that_just_hold_the_value():
    y, mean = [[0.0, 3.0], [1.0, 2.0], [4.0, 0.0]], [[0.0, 0.0], [1.0, 2.5], [0.0, 0.0]]
    levels = interval_levels(y, mean, [[0.0, 0.0], [1e-320, 1.0], [1e-320, 1.0]])
    assert_allclose(levels, [[0.0, 1.0], [0.0, 2 * norm.cdf(0.5) - 1], [1.0, 0.0]], rtol=1e-12)


def test_scorers_are_scores_of_which_more_is_better():
    """Of a Gaussian process before its fit: mean 0, deviation 1."""
    X, y = np.zeros((3, 1)), np.array([0.5, -1.0, 2.0])
    pairs = [(neg_nlpd, negative_log_predictive_density), (neg_crps, crps), (neg_calibration_error, calibration_error)]
    for scorer, score in pairs:
        assert scorer(GaussianProcessRegressor(), X, y) == pytest.approx(-score(y, np.zeros(3), np.ones(3)))


@pytest.mark.parametrize("metric", OF_PREDICTIONS)
def test_another_number_of_rows_raises(metric):
    with pytest.raises(ValueError, match="inconsistent numbers of samples"):
        metric(*arguments(metric, mean=MEAN[:-1]))


@pytest.mark.parametrize("metric", OF_PREDICTIONS)
@pytest.mark.parametrize("mean", [MEAN[:, :1], MEAN[:, 0]])
def test_another_number_of_outputs_raises(metric, mean):
    with pytest.raises(ValueError, match=r"same number of outputs; got .*'y_true': 3, 'y_pred': 1"):
        metric(*arguments(metric, mean=mean))


@pytest.mark.parametrize("metric", OF_PREDICTIONS)
@pytest.mark.parametrize(("name", "argument"), [("y_true", "y"), ("y_pred", "mean")])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_value_that_is_not_finite_raises(metric, name, argument, value):
    with pytest.raises(ValueError, match=rf"Input {name} contains"):
        metric(*arguments(metric, **{argument: np.add(Y, [0.0, 0.0, value])}))


@pytest.mark.parametrize("metric", OF_STD)
def test_standard_deviation_that_is_not_finite_raises(metric):
    with pytest.raises(ValueError, match="Input std contains NaN"):
        metric(Y, MEAN, np.full_like(STD, np.nan))


@pytest.mark.parametrize("metric", OF_STD)
def test_negative_standard_deviation_raises(metric):
    with pytest.raises(ValueError, match=r"std must .*smallest value is -0\.5"):
        metric([0.0, 0.0], [0.0, 0.0], [1.0, -0.5])


def test_std_norm_of_negative_values_raises():
    with pytest.raises(ValueError, match=r"std must not be negative; its smallest value is -0\.5"):
        std_norm([1.0, -0.5])


def test_density_needs_a_positive_standard_deviation():
    with pytest.raises(ValueError, match=r"std must be above 0; its smallest value is 0\.0"):
        negative_log_predictive_density([0.0], [0.0], [0.0])


@pytest.mark.parametrize("metric", OF_PREDICTIONS)
def test_no_rows_raise(metric):
    with pytest.raises(ValueError, match="minimum of 1 is required"):
        metric(*arguments(metric, y=[], mean=[], std=[]))


@pytest.mark.parametrize("k", [-1, [1, np.nan], [1, None]])
def test_widths_must_not_be_negative(k):
    with pytest.raises(ValueError, match="k must be numbers that are not negative"):
        containing_ratios([0.5], [0.0], [1.0], k=k)
