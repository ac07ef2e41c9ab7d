"""`to_l4acados` makes what the controllers of L4acados expect of a residual model.

L4acados needs acados, which has no wheel. Two classes stand in for it:

* `ResidualModel` for its abstract class. It has one method, ``value_and_jacobian(y)``, of rows y = [x, u] of N stages.
  It returns values (N, n_residuals) and derivatives (n_residuals, N, n_states + n_inputs). The residual models that
  L4acados brings also have ``evaluate(y)`` and ``jacobian(y)``, which return one of the two. They keep the results of
  the last call in ``current_prediction``, ``current_prediction_dy`` and ``current_variance`` (N, n_residuals).
* `Controller` for what ResidualLearningMPC and ZeroOrderGPMPC do with one in each iteration: the former linearises the
  model around the stages of a plan, the latter then reads the variances.
"""

import pickle
from abc import ABC, abstractmethod
from copy import deepcopy

import numpy as np
import pytest

from skevgp import EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.control.acados import L4acadosModel

from .cases import QUICK


class ResidualModel(ABC):
    @abstractmethod
    def value_and_jacobian(self, y):
        """Values (N, n_residuals) and derivatives (n_residuals, N, n_states + n_inputs) at rows [x, u]."""


class Controller:
    """x' = nominal(x, u) + B residual(x, u), linearised around each stage of a plan."""

    def __init__(self, residual_model, nominal=None, B=None):
        self.residual_model, self.nominal, self.B = residual_model, nominal, B

    def linear_model(self, plan, n_states):
        """Slopes and offsets of the stages, with the diagonals of the residual's covariance."""
        residual, slopes = self.residual_model.value_and_jacobian(plan)
        B = np.eye(n_states) if self.B is None else self.B
        found = []
        for stage, y in enumerate(plan):
            value, by_y = (0.0, 0.0) if self.nominal is None else self.nominal(y)
            by_y = by_y + B @ slopes[:, stage, :]
            found.append((by_y, value + B @ residual[stage, :] - by_y @ y))
        return *map(np.array, zip(*found, strict=True)), self.residual_model.current_variance.flatten()


@pytest.fixture(scope="module")
def rows():
    """Rows of two states and an input: to fit, and the stages of a plan."""
    rng = np.random.RandomState(0)
    return rng.uniform(-1.0, 1.0, (90, 3)), rng.uniform(-1.0, 1.0, (7, 3))


@pytest.fixture(scope="module")
def model(rows):
    X, _ = rows
    return EVGPRegressor(n_inducing=20, **QUICK).fit(X, following(X))


def following(y):
    return np.stack([y[..., 0] + 0.1 * y[..., 1], y[..., 1] + 0.1 * (y[..., 2] - np.sin(y[..., 0]))], axis=-1)


def slopes_by_differences(function, y, step=1e-5):
    return np.stack([(function(y + d) - function(y - d)) / (2.0 * step) for d in step * np.eye(y.shape[1])], axis=-1)


def test_class_has_what_the_abstract_class_asks_for(model):
    assert not ResidualModel.__abstractmethods__ - set(dir(L4acadosModel))
    type("Ours", (L4acadosModel, ResidualModel), {})(model.compile())


def test_one_output_beside_a_nominal_model(rows):
    """The nominal model lacks what gravity adds to the velocity. B maps this residual to the state."""
    X, plan = rows
    A, B = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1]]), np.array([[0.0], [1.0]])
    model = EVGPRegressor(n_inducing=20, **QUICK).fit(X, (following(X) - X @ A.T)[:, 1])

    def nominal(y):
        return A @ y, A

    slopes, offsets, variances = Controller(model.to_l4acados(), nominal, B).linear_model(plan, 2)
    mean, std = model.predict(plan, return_std=True)
    expected = plan @ A.T + np.outer(mean, B)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", slopes, plan) + offsets, expected, rtol=0, atol=1e-9)
    by_rows = slopes_by_differences(lambda y: y @ A.T + np.outer(model.predict(y), B), plan)
    np.testing.assert_allclose(slopes, by_rows, rtol=0, atol=1e-5)
    np.testing.assert_allclose(variances, std**2, rtol=1e-9)
    # The residual was learned, and is not a constant.
    np.testing.assert_allclose(mean, -0.1 * np.sin(plan[:, 0]), rtol=0, atol=0.01)


@pytest.mark.parametrize("include_noise", [True, False])
@pytest.mark.parametrize(
    "regressor",
    [EVGPRegressor(n_inducing=20, **QUICK), EGPRegressor(max_iter=3), ResidualRegressor(EGPRegressor(max_iter=3))],
    ids=lambda regressor: type(regressor).__name__,
)
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_whole_state_without_a_nominal_model(regressor, include_noise, rows):
    X, plan = rows
    model = regressor.fit(X, following(X))
    residual = model.to_l4acados(include_noise=include_noise)
    slopes, offsets, variances = Controller(residual).linear_model(plan, 2)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", slopes, plan) + offsets, model.predict(plan), rtol=0, atol=1e-9)
    np.testing.assert_allclose(slopes, slopes_by_differences(model.predict, plan), rtol=0, atol=1e-5)
    std = model.value_and_jacobian(plan, return_std=True, include_noise=include_noise)[2]
    np.testing.assert_allclose(variances, std.ravel() ** 2, rtol=1e-7)


def test_value_and_derivatives_alone(model, rows):
    _, plan = rows
    residual, other = model.to_l4acados(), model.to_l4acados()
    value, jacobian = residual.value_and_jacobian(plan)
    assert residual.current_prediction is value
    assert residual.current_prediction_dy is jacobian
    np.testing.assert_allclose(other.evaluate(plan), value, rtol=0, atol=1e-9)  # sums in another order
    assert other.current_prediction.shape == (7, 2)
    np.testing.assert_allclose(other.current_variance, residual.current_variance, rtol=1e-9)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(other)).jacobian(plan), jacobian)


def test_columns_that_the_model_was_not_fitted_to(rows):
    X, plan = rows
    model = EVGPRegressor(n_inducing=15, **QUICK).fit(X[:, [2, 0]], following(X))
    residual = model.to_l4acados(columns=[2, 0])
    value, jacobian = residual.value_and_jacobian(plan)
    np.testing.assert_allclose(value, model.predict(plan[:, [2, 0]]), rtol=0, atol=1e-9)
    assert jacobian.shape == (2, 7, 3)
    by_rows = slopes_by_differences(lambda y: model.predict(y[:, [2, 0]]), plan)
    np.testing.assert_allclose(jacobian.swapaxes(0, 1), by_rows, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(jacobian[:, :, 1], 0.0)


@pytest.mark.parametrize("columns", [[0, 1], [0, 1, 1], [0, 1, -1], [0.0, 1.0, 2.0], [[0, 1, 2]], 3])
def test_invalid_columns_raise(model, columns):
    with pytest.raises(ValueError, match=r"columns=.* must have a different index, from 0, for each of the 3 columns"):
        model.to_l4acados(columns)


def test_update_after_partial_fit(model, rows):
    X, plan = rows
    model = deepcopy(model)
    residual = model.to_l4acados()
    model.partial_fit(X[:20], following(X[:20]) + 0.1)
    assert np.abs(residual.evaluate(plan) - model.predict(plan)).max() > 1e-3
    residual.update(model)
    np.testing.assert_allclose(residual.evaluate(plan), model.predict(plan), rtol=0, atol=1e-9)
