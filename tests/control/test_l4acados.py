"""The recipe in the docstring of the compiled predictor is what L4acados asks of a residual model.

L4acados needs acados, which no wheel brings; so these stand in its place: `ResidualModel` for its abstract class, and
`Controller` for what its ResidualLearningMPC and ZeroOrderGPMPC do with one in each iteration.
"""

import doctest
from abc import ABC, abstractmethod

import numpy as np
import pytest

from skevgp import EVGPRegressor
from skevgp.control.compiled import CompiledPredictor

from .cases import QUICK


class ResidualModel(ABC):
    @abstractmethod
    def value_and_jacobian(self, y):
        """Values (N, n_residuals) and derivatives (n_residuals, N, n_states + n_inputs) at rows [x, u]."""


class Controller:
    """x' = nominal(x, u) + B residual(x, u), laid straight around each stage of a plan."""

    def __init__(self, residual_model, nominal=None, B=None):
        self.residual_model, self.nominal, self.B = residual_model, nominal, B

    def linear_model(self, plan, n_states):
        """Slopes and offsets of the stages, with the diagonals of what is not known of them."""
        residual, slopes = self.residual_model.value_and_jacobian(plan)
        B = np.eye(n_states) if self.B is None else self.B
        found = []
        for stage, y in enumerate(plan):
            value, by_y = (0.0, 0.0) if self.nominal is None else self.nominal(y)
            by_y = by_y + B @ slopes[:, stage, :]
            found.append((by_y, value + B @ residual[stage, :] - by_y @ y))
        return *map(np.array, zip(*found, strict=True)), self.residual_model.current_variance.flatten()


@pytest.fixture
def recipe():
    """The class in the docstring, as a subclass of L4acados' would be."""
    example = doctest.DocTestParser().get_doctest(CompiledPredictor.__doc__, {}, "recipe", None, None)
    assert doctest.DocTestRunner().run(example, clear_globs=False).failed == 0
    return type("Recipe", (example.globs["LearnedResidual"], ResidualModel), {})


@pytest.fixture
def rows():
    """Of two states and an input."""
    rng = np.random.RandomState(0)
    return rng.uniform(-1.0, 1.0, (80, 3)), rng.uniform(-1.0, 1.0, (7, 3))


def following(y):
    return np.stack([y[..., 0] + 0.1 * y[..., 1], y[..., 1] + 0.1 * (y[..., 2] - np.sin(y[..., 0]))], axis=-1)


def slopes_by_differences(function, y, step=1e-5):
    return np.stack([(function(y + d) - function(y - d)) / (2.0 * step) for d in step * np.eye(y.shape[1])], axis=-1)


def test_one_output_beside_a_nominal_model(recipe, rows):
    """What gravity adds to the velocity, which the nominal model lacks: B lifts it into the state."""
    X, plan = rows
    A, B = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1]]), np.array([[0.0], [1.0]])
    model = EVGPRegressor(n_inducing=20, **QUICK).fit(X, (following(X) - X @ A.T)[:, 1])

    def nominal(y):
        return A @ y, A

    slopes, offsets, variances = Controller(recipe(model.compile()), nominal, B).linear_model(plan, 2)
    mean, std = model.predict(plan, return_std=True)
    expected = plan @ A.T + np.outer(mean, B)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", slopes, plan) + offsets, expected, rtol=0, atol=1e-10)
    by_rows = slopes_by_differences(lambda y: y @ A.T + np.outer(model.predict(y), B), plan)
    np.testing.assert_allclose(slopes, by_rows, rtol=0, atol=1e-5)
    np.testing.assert_allclose(variances, std**2, rtol=1e-9)
    # The residual was learned, and is not a constant.
    np.testing.assert_allclose(mean, -0.1 * np.sin(plan[:, 0]), rtol=0, atol=0.01)
