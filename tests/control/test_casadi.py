import sys
from functools import cache

import numpy as np
import pytest
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.preprocessing import QuantileTransformer

from skevgp import ResidualRegressor
from skevgp.control.casadi import Deviations
from skevgp.kernels import FunctionKernel

from .export_cases import MODELS, POLYNOMIAL, data, evaluated, fitted, jacobians, predicted, sparse

each_model = pytest.mark.parametrize("name", MODELS)
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


@cache
def case(name):
    return fitted(clone(MODELS[name]))


def assert_same(found, model, X, include_noise=True):
    """To 1e-10 of the output's scale, the standard deviation too."""
    scale = data()[1].std(axis=0)[: found[0].shape[1]]
    mean, variance = predicted(model, X, include_noise)
    assert found[0].shape == mean.shape
    np.testing.assert_array_less(np.abs(found[0] - mean).max(axis=0), 1e-10 * scale)
    np.testing.assert_array_less(np.abs(np.sqrt(found[1]) - np.sqrt(variance)).max(axis=0), 1e-10 * scale)


@each_model
def test_function_predicts(name):
    model = case(name)
    X, _ = data(seed=1)
    for include_noise in (True, False):
        assert_same(evaluated(model.to_casadi(include_noise=include_noise), X[:20]), model, X[:20], include_noise)


@each_model
def test_function_of_parameters_predicts(name):
    model = case(name)
    X, _ = data(seed=1)
    found = evaluated(model.to_casadi(parametric=True), X[:5], model.to_casadi_parameters())
    assert_same(found, model, X[:5])


@each_model
def test_jacobians_are_those_of_predict(name):
    model = case(name)
    function, h = model.to_casadi(), 1e-5
    for row in data(seed=1)[0][:2]:
        up, down = (predicted(model, row + sign * h * np.eye(len(row))) for sign in (1.0, -1.0))
        for found, plus, minus in zip(jacobians(function, row), up, down, strict=True):
            expected = (plus - minus).T / (2.0 * h)
            np.testing.assert_allclose(found, expected, atol=1e-6 * max(1.0, np.abs(expected).max()))


# --- residuals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", [None, [3, 1, -1]])
def test_residual_model_adds_its_base_columns(base):
    X, y = data()
    model = ResidualRegressor(sparse(POLYNOMIAL), base=base).fit(X, y + X[:, [0, 1, 2] if base is None else base])
    assert_same(evaluated(model.to_casadi("sum"), X[:5]), model, X[:5])
    function = model.to_casadi(parametric=True, include_noise=False)
    model.partial_fit(*data(n_rows=20, seed=2))
    assert_same(evaluated(function, X[:5], model.to_casadi_parameters()), model, X[:5], include_noise=False)


@pytest.mark.parametrize("method", ["to_casadi", "to_c"])
def test_without_casadi_there_is_the_pip_command(method, monkeypatch, tmp_path):
    model = fitted(sparse())
    monkeypatch.setitem(sys.modules, "casadi", None)
    message = r"The export to CasADi and C needs the optional package 'casadi'.*pip install casadi .*'\.\[casadi\]'"
    with pytest.raises(ImportError, match=message):
        getattr(model, method)(*([tmp_path] if method == "to_c" else []))
    assert len(model.to_casadi_parameters())


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["two words", "1st", "", "a__b", None, 3])
def test_invalid_casadi_name_raises(name):
    with pytest.raises(
        ValueError, match=r"name must have a letter first, then letters, digits and single underscores.*got"
    ):
        fitted(sparse()).to_casadi(name)


def test_kernel_that_cannot_be_exported_raises():
    model = fitted(sparse(kernel=FunctionKernel(lambda X, Z: X @ Z.T)))
    with pytest.raises(ValueError, match=r"The kernel Function\(.*These can be exported"):
        model.to_casadi()


@pytest.mark.parametrize("argument", ["feature_map", "kernel_map"])
def test_map_that_cannot_be_exported_raises(argument):
    model = fitted(sparse(**{argument: QuantileTransformer(n_quantiles=10)}))
    with pytest.raises(TypeError, match=rf"{argument}: QuantileTransformer.*These can be exported: AngleEncoder"):
        model.to_casadi()


class Wrong(TransformerMixin, BaseEstimator):
    """Its expression is not what it does."""

    def __init__(self, result="short"):
        self.result = result

    def fit(self, X, y=None):
        return self

    def transform(self, X):
        return X.copy()

    def to_casadi(self, x):
        return {"short": x[:2], "row": x.T, "list": [x, x], "array": np.ones(5)}[self.result]


@pytest.mark.parametrize("result", ["short", "row", "list", "array"])
def test_expression_of_another_shape_raises(result):
    model = fitted(sparse(kernel_map=Wrong(result)))
    with pytest.raises(ValueError, match=r"kernel_map: to_casadi must return an MX of shape \(5, 1\)"):
        model.to_casadi()


# --- what is left of the variance ------------------------------------------------------------------------------------


def group_of(model, which=0):
    return fitted(model)._posterior.predictor.groups[which]


@pytest.mark.parametrize("name", ["all", "groups", "shared weights, all"])
def test_outputs_of_a_group_need_one_product_and_rows_for_their_features(name):
    group = group_of(MODELS[name])
    deviations, p = Deviations.of(group), group.mean.shape[1] - len(group.points)
    assert p == 11
    assert len(group.root) > 1
    assert deviations.squares.shape == (len(group.root), len(group.points))
    assert max(map(len, deviations.others)) <= p
