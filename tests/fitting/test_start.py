import numpy as np
import pytest

from skevgp.fitting.messages import alike_neighbours
from skevgp.fitting.rules import Rules
from skevgp.fitting.start import parameter_of
from skevgp.kernels.parse import Start, Starts
from skevgp.kernels.stationary import SquaredExponential
from skevgp.model.model import SparseModel
from skevgp.model.parameters import ParameterTable

from ..oracle import identity_rows, table_of
from .cases import NO_FEATURES, H, X, Y, source_of, units_of


@pytest.mark.parametrize("scale", [1.0, 1e-9])
def test_neighbours_of_a_smooth_function_are_alike_and_of_noise_are_not(scale):
    rng = np.random.RandomState(0)
    X = scale * rng.rand(3000, 2)
    wave, noise = np.sin(10 * X[:, 0] / scale), rng.randn(3000)
    alike = alike_neighbours(identity_rows(X, np.column_stack([wave, wave + 0.5 * noise, noise, np.ones(3000)])))
    np.testing.assert_array_equal(alike, [True, True, False, False])


@pytest.mark.parametrize(
    ("start", "first", "lower", "upper", "widest"),
    [
        (Start(), 2.0, 1.0, 3.0, 9.0),
        (Start(np.array([20.0]), np.array([[5.0, 50.0]])), 2.0, 0.5, 5.0, None),
        (Start(np.array([100.0])), 3.0, 1.0, 3.0, 9.0),
    ],
    ids=["no opinion", "in the user's units", "outside of the limits"],
)
def test_start_is_the_users_within_limits(start, first, lower, upper, widest):
    own = parameter_of(start, "x", np.array([2.0]), np.array([1.0]), np.array([3.0]), 10.0, 9.0)
    assert (own.lower, own.upper, own.widest) == ([lower], [upper], widest)
    table = ParameterTable([own])
    np.testing.assert_allclose(table.values(table.start())["x"], [first])


def test_starts_and_limits_follow_the_data_and_the_rules():
    """Twice as far, or ten times as high, is twice or ten times as much for the parameters too."""
    X = np.random.RandomState(0).randn(50, 2) * [1.0, 2.0]
    limits = {"highest_noise": 50.0, "lengthscale_limits": (0.1, 10.0), "signal_limits": (1e-3, 1e3)}
    limits |= {"widest_signal": 1e5}
    rules = Rules(1e-4, 1e-10, lengthscale=0.5, **limits)
    scatter, points = np.array([1.0, 0.01]), np.zeros((1, 3, 2))
    starts = Starts(Start(), Start(), Start())
    table = table_of(X, points, starts, scatter, SquaredExponential(2), rules)
    first, (sigma, root) = table.values(table.start()), (X.std(axis=0), np.sqrt(2.0))
    np.testing.assert_allclose(first["hyperparameters"], 0.5 * root * sigma)
    np.testing.assert_allclose(first["signal"], 1.0)
    np.testing.assert_allclose(first["noise"], 1e-4 * scatter)
    lower, upper = (table.values(limit) for limit in table.limits())
    np.testing.assert_allclose([lower["hyperparameters"], upper["hyperparameters"]], [0.1 * sigma, 10.0 * root * sigma])
    np.testing.assert_allclose([lower["signal"], upper["signal"]], [[1e-3] * 2, [1e3] * 2])
    np.testing.assert_allclose([lower["noise"], upper["noise"]], [1e-10 * scatter, [50.0] * 2])
    np.testing.assert_allclose(table["signal"].widest, 1e5)


# --- there and back between the user's units and the internal ones ---------------------------------------------------


def test_features_leave_as_little_as_they_can_at_the_reference():
    """Least squares of y on them, the priors being wide."""
    fitted = np.linalg.lstsq(H, Y, rcond=None)[0]
    left = np.sqrt(np.mean((Y - H @ fitted) ** 2, axis=0))
    np.testing.assert_allclose(units_of().target_unit, left, rtol=1e-2)
    assert (units_of().target_unit < units_of(H=NO_FEATURES).target_unit).all()


def test_predictions_are_of_y():
    """A model of internal residuals, one output at a time, speaks of y: its mean, its noise and its weights."""
    units = units_of(target_mean=(3.0, -20.0))
    kernel, prior, rows = SquaredExponential(2), units.internal_prior(), units.rows(source_of())
    parts = []
    for o in range(2):
        own = slice(o, o + 1)
        model = SparseModel(kernel, prior.outputs(own), (slice(0, 1),))
        values = {
            "hyperparameters": np.ones(2),
            "signal": np.ones(1),
            "noise": np.full(1, 0.01),
            "inducing_points": X[np.newaxis, :20],
        }
        parts.append(model.at_optimum(values, model.statistics(values, rows.outputs(own).blocks(kernel, 20))))
    predictor = units.predictor(parts, [[0], [1]])
    mean, variance = predictor.predict(X, H, return_variance=True)
    np.testing.assert_allclose(predictor.noise, 0.01 * units.target_unit**2)
    assert (np.abs(Y - mean) < 4.0 * np.sqrt(variance + predictor.noise)).all()
    for o, part in enumerate(parts):
        internal, spread = part.predict(X, H, return_variance=True)
        left_over = internal[:, 0] - H @ prior.offset[o]
        in_units = units.target_mean[o] + H @ units.prior.offset[o] + units.target_unit[o] * left_over
        np.testing.assert_allclose(mean[:, o], in_units, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(variance[:, o], units.target_unit[o] ** 2 * spread[:, 0], rtol=1e-10)
        coef, covariance = part.coefficients()
        np.testing.assert_allclose(predictor.coefficients()[0][o], units.target_unit[o] * coef[0], rtol=1e-9)
        np.testing.assert_allclose(
            predictor.coefficients()[1][o], units.target_unit[o] ** 2 * covariance[0], rtol=1e-10
        )
