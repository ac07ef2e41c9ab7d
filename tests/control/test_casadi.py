import sys

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.preprocessing import QuantileTransformer

from skevgp import ResidualRegressor
from skevgp.control.casadi import Deviations
from skevgp.kernels import FunctionKernel

from .export_cases import MODELS, POLYNOMIAL, data, evaluated, fitted, jacobians, predicted, sparse

each_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def assert_same(found, model, X, include_noise=True):
    """To 1e-10 of the output's scale, the standard deviation too."""
    scale = data()[1].std(axis=0)[: found[0].shape[1]]
    mean, variance = predicted(model, X, include_noise)
    assert found[0].shape == mean.shape
    np.testing.assert_array_less(np.abs(found[0] - mean).max(axis=0), 1e-10 * scale)
    np.testing.assert_array_less(np.abs(np.sqrt(found[1]) - np.sqrt(variance)).max(axis=0), 1e-10 * scale)


@each_model
def test_the_function_predicts(model):
    model = fitted(clone(model))
    X, _ = data(seed=1)
    for include_noise in (True, False):
        assert_same(evaluated(model.to_casadi(include_noise=include_noise), X[:20]), model, X[:20], include_noise)


@each_model
def test_the_function_of_parameters_predicts(model):
    model = fitted(clone(model))
    X, _ = data(seed=1)
    found = evaluated(model.to_casadi(parametric=True), X[:5], model.to_casadi_parameters())
    assert_same(found, model, X[:5])


@each_model
def test_jacobians_are_those_of_predict(model):
    model = fitted(clone(model))
    function, h = model.to_casadi(), 1e-5
    for row in data(seed=1)[0][:2]:
        up, down = (predicted(model, row + sign * h * np.eye(len(row))) for sign in (1.0, -1.0))
        for found, plus, minus in zip(jacobians(function, row), up, down, strict=True):
            expected = (plus - minus).T / (2.0 * h)
            np.testing.assert_allclose(found, expected, atol=1e-6 * max(1.0, np.abs(expected).max()))


def test_the_function_is_named_as_told_and_so_are_its_arguments():
    model = fitted(sparse())
    function = model.to_casadi("drone", parametric=True)
    assert function.name() == "drone"
    assert (function.name_in(), function.name_out()) == (["x", "parameters"], ["mean", "variance"])
    assert function.size_in(0) == (5, 1)
    assert function.size_in(1) == (len(model.to_casadi_parameters()), 1)


# --- models that learn -----------------------------------------------------------------------------------------------


def test_parameters_are_in_the_order_that_is_documented():
    model = fitted(sparse(POLYNOMIAL, sharing=[[2, 0], [1]], n_inducing=7, normalize_y=True))
    parameters, size = model.to_casadi_parameters(), 7 + 11
    assert len(parameters) == 3 * size * (1 + size) + 3 * 11 + 3 + 3
    np.testing.assert_array_equal(parameters[-3:], model.noise_variance_)
    np.testing.assert_allclose(parameters[-6:-3], data()[1].mean(axis=0))
    # The weights of features: what is added to them, and their mean.
    added = parameters[-6 - 33 : -6].reshape(3, 11)
    first, second = parameters[: 2 * size].reshape(2, size), parameters[2 * size * (1 + size) :][:size]
    np.testing.assert_allclose(added[[0, 2, 1]] + np.vstack([first, second])[:, 7:], model.coef_[[0, 2, 1]])


# --- residuals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", [None, [3, 1, -1]])
def test_a_residual_model_adds_its_base_columns(base):
    X, y = data()
    model = ResidualRegressor(sparse(POLYNOMIAL), base=base).fit(X, y + X[:, [0, 1, 2] if base is None else base])
    assert_same(evaluated(model.to_casadi("sum"), X[:5]), model, X[:5])
    function = model.to_casadi(parametric=True, include_noise=False)
    model.partial_fit(*data(n_rows=20, seed=2))
    assert_same(evaluated(function, X[:5], model.to_casadi_parameters()), model, X[:5], include_noise=False)


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["to_casadi", "to_c"])
def test_without_casadi_there_is_the_pip_command(method, monkeypatch, tmp_path):
    model = fitted(sparse())
    monkeypatch.setitem(sys.modules, "casadi", None)
    message = r"The export to CasADi and C needs the optional package 'casadi'.*pip install casadi .*'\.\[casadi\]'"
    with pytest.raises(ImportError, match=message):
        getattr(model, method)(*([tmp_path] if method == "to_c" else []))
    assert len(model.to_casadi_parameters())


@pytest.mark.parametrize("name", ["two words", "1st", "", "a__b", None, 3])
def test_a_name_that_casadi_refuses_is_told(name):
    with pytest.raises(ValueError, match=r"name must be letters, digits and single underscores.*got"):
        fitted(sparse()).to_casadi(name)


def test_a_kernel_that_cannot_be_exported_is_named():
    model = fitted(sparse(kernel=FunctionKernel(lambda X, Z: X @ Z.T)))
    with pytest.raises(ValueError, match=r"The kernel Function\(.*These can be exported"):
        model.to_casadi()


@pytest.mark.parametrize("argument", ["feature_map", "kernel_map"])
def test_a_map_that_cannot_be_exported_is_named(argument):
    model = fitted(sparse(**{argument: QuantileTransformer(n_quantiles=10)}))
    with pytest.raises(TypeError, match=rf"{argument}: QuantileTransformer.*These can be exported: AngleEncoder"):
        model.to_casadi()


# --- what is left of the variance ------------------------------------------------------------------------------------


def group_of(model, which=0):
    return fitted(model)._posterior.predictor.groups[which]


def variances(group, deviations, V, H):
    """What is left of the variance, by the roots and by the deviations, each (o, n)."""
    by_roots = np.array([((own @ np.vstack([V, H])) ** 2).sum(axis=0) for own in group.root])
    turned = deviations.projection @ (group.whitening.L @ V)
    found = np.array([((own @ np.vstack([turned, H])) ** 2).sum(axis=0) for own in deviations.others])
    if deviations.squares is not None:
        found = found + deviations.squares @ turned**2
    np.testing.assert_allclose((turned**2).sum(axis=0), (V**2).sum(axis=0), rtol=1e-9)
    return by_roots, found


def some(group, n_rows=20):
    """V and H of rows."""
    m = len(group.points)
    rng = np.random.RandomState(0)
    points = rng.randint(m, size=n_rows)
    return group.whitening.L.T[:, points], rng.randn(group.mean.shape[1] - m, n_rows)


@pytest.mark.parametrize("name", ["all", "groups", "shared weights, all"])
def test_outputs_of_a_group_need_one_product_and_rows_for_their_features(name):
    group = group_of(MODELS[name])
    deviations, p = Deviations.of(group), group.mean.shape[1] - len(group.points)
    assert p == 11
    assert len(group.root) > 1
    assert deviations.squares.shape == (len(group.root), len(group.points))
    assert max(map(len, deviations.others)) <= p


def test_little_noise_leaves_the_variances_their_digits():
    """Of outputs with very different noise, the eigenvectors of the best are taken."""
    X, y = data(n_outputs=3)
    y[:, 0] = np.sin(X[:, 0])
    model = sparse(n_inducing=40, sharing="all", max_iter=40, noise_cv=None).fit(X, y)
    (group,) = model._posterior.predictor.groups
    by_roots, found = variances(group, Deviations.of(group), *some(group))
    np.testing.assert_allclose(found, by_roots, rtol=1e-6, atol=1e-10 * group.signal.max())
