import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression
from sklearn.preprocessing import QuantileTransformer, StandardScaler

from skevgp import EGPRegressor, EVGPRegressor, ResidualRegressor
from skevgp.control.casadi import Deviations
from skevgp.kernels import FunctionKernel

from .export_cases import MODELS, POLYNOMIAL, data, evaluated, exact, fitted, jacobians, predicted, sparse

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


@pytest.mark.parametrize("make", [sparse, exact])
def test_one_output_has_one_number(make):
    X, y = data(n_outputs=1)
    model = make(POLYNOMIAL).fit(X, y[:, 0])
    function = model.to_casadi()
    assert function.numel_out(0) == function.numel_out(1) == 1
    mean, std = model.predict(X[:5], return_std=True)
    found = evaluated(function, X[:5])
    np.testing.assert_allclose(found[0][:, 0], mean, rtol=1e-9)
    np.testing.assert_allclose(found[1][:, 0], std**2, rtol=1e-9)


def test_a_model_that_was_optimised_is_the_same():
    model = fitted(EVGPRegressor(POLYNOMIAL, n_inducing=20, sharing="all", max_iter=30, random_state=0))
    X, _ = data(seed=1)
    assert_same(evaluated(model.to_casadi(), X), model, X)


def test_at_the_training_rows_derivatives_are_finite():
    """Where |v|² is k(x, x), all of it."""
    model = fitted(MODELS["exact"])
    for row in data()[0][:3]:
        assert np.isfinite(np.hstack(jacobians(model.to_casadi(), row))).all()


def test_the_function_is_named_as_told_and_so_are_its_arguments():
    model = fitted(sparse())
    function = model.to_casadi("drone", parametric=True)
    assert function.name() == "drone"
    assert (function.name_in(), function.name_out()) == (["x", "parameters"], ["mean", "variance"])
    assert function.size_in(0) == (5, 1)
    assert function.size_in(1) == (len(model.to_casadi_parameters()), 1)


def test_derivatives_of_the_mean_leave_out_the_variance():
    model = fitted(sparse(POLYNOMIAL, sharing="all"))
    x = ca.MX.sym("x", 5)
    mean, variance = model.to_casadi()(x)
    both = ca.Function("j", [x], [ca.jacobian(mean, x), ca.jacobian(variance, x)])
    alone = ca.Function("j", [x], [ca.jacobian(mean, x)])
    assert alone.n_instructions() < 0.7 * both.n_instructions()


def test_it_maps_over_a_horizon():
    model = fitted(sparse(POLYNOMIAL))
    X, _ = data(seed=1)
    mean, variance = model.to_casadi().map(10)(X[:10].T)
    assert_same((mean.full().T, variance.full().T), model, X[:10])


# --- models that learn -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["features", "kernel", "groups", "shared weights", "diagonal", "rows of both"])
def test_new_rows_need_no_new_function(name):
    model = fitted(clone(MODELS[name]))
    function, before = model.to_casadi(parametric=True), model.to_casadi_parameters()
    model.partial_fit(*data(n_rows=30, seed=2))
    X, _ = data(seed=1)
    after = model.to_casadi_parameters()
    assert_same(evaluated(function, X[:5], after), model, X[:5])
    assert after.shape == before.shape
    assert not np.allclose(evaluated(function, X[:5], before)[0], evaluated(function, X[:5], after)[0])


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


def test_parameters_are_put_where_they_are_wanted():
    model = fitted(sparse(POLYNOMIAL))
    out = np.empty(len(model.to_casadi_parameters()))
    assert model.to_casadi_parameters(out) is out
    np.testing.assert_array_equal(out, model.to_casadi_parameters())


# --- residuals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", [None, [3, 1, -1]])
def test_a_residual_model_adds_its_base_columns(base):
    X, y = data()
    model = ResidualRegressor(sparse(POLYNOMIAL), base=base).fit(X, y + X[:, [0, 1, 2] if base is None else base])
    assert_same(evaluated(model.to_casadi("sum"), X[:5]), model, X[:5])
    function = model.to_casadi(parametric=True, include_noise=False)
    model.partial_fit(*data(n_rows=20, seed=2))
    assert_same(evaluated(function, X[:5], model.to_casadi_parameters()), model, X[:5], include_noise=False)


def test_a_residual_model_of_another_regressor_has_no_export():
    model = ResidualRegressor(LinearRegression()).fit(*data())
    assert not any(hasattr(model, name) for name in ("to_casadi", "to_casadi_parameters", "to_c"))


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [EVGPRegressor(), EGPRegressor(), ResidualRegressor(EVGPRegressor())], ids=repr)
@pytest.mark.parametrize("method", ["to_casadi", "to_casadi_parameters", "to_c"])
def test_what_is_not_fitted_is_not_exported(model, method, tmp_path):
    with pytest.raises(NotFittedError):
        getattr(model, method)(*([tmp_path] if method == "to_c" else []))


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
def test_an_expression_of_another_shape_is_an_error(result):
    model = fitted(sparse(kernel_map=Wrong(result)))
    with pytest.raises(ValueError, match=r"kernel_map: to_casadi must return an MX of shape \(5, 1\)"):
        model.to_casadi()


def test_a_data_frame_without_a_map_is_taken_in_the_order_of_its_columns():
    pandas = pytest.importorskip("pandas")
    X, y = data()
    frame = pandas.DataFrame(X, columns=list("abcde"))
    model = sparse(StandardScaler(), kernel_map=StandardScaler().set_output(transform="default")).fit(frame, y)
    np.testing.assert_allclose(evaluated(model.to_casadi(), X[:3])[0], model.predict(frame[:3]), rtol=1e-9)


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


@pytest.mark.parametrize("name", [name for name in MODELS if "rows" not in name])
def test_variances_are_those_of_the_roots(name):
    group = group_of(MODELS[name])
    by_roots, found = variances(group, Deviations.of(group), *some(group))
    np.testing.assert_allclose(found, by_roots, rtol=1e-8, atol=1e-12 * group.signal.max())


@pytest.mark.parametrize("name", ["all", "groups", "shared weights, all"])
def test_outputs_of_a_group_need_one_product_and_rows_for_their_features(name):
    group = group_of(MODELS[name])
    deviations, p = Deviations.of(group), group.mean.shape[1] - len(group.points)
    assert p == 11
    assert len(group.root) > 1
    assert deviations.squares.shape == (len(group.root), len(group.points))
    assert max(map(len, deviations.others)) <= p


def test_an_exact_model_without_features_has_no_deviations():
    group = group_of(exact())
    deviations = Deviations.of(group)
    assert deviations.squares is None
    assert deviations.projection is group.whitening.L_inv
    assert not any(map(len, deviations.others))


@pytest.mark.parametrize("features", [None, POLYNOMIAL])
def test_roots_that_have_nothing_in_common_stay(features):
    group = group_of(sparse(features, sharing="all"))
    root, rng = group.root.copy(), np.random.RandomState(0)
    m = len(group.points)
    root[1, :m, :m] = np.tril(rng.randn(m, m))
    group = replace(group, root=root)
    deviations = Deviations.of(group)
    assert len(deviations.others[1]) >= m
    assert [len(deviations.others[o]) < m for o in (0, 2)] == [True, True]
    by_roots, found = variances(group, deviations, *some(group))
    np.testing.assert_allclose(found, by_roots, rtol=1e-8, atol=1e-12 * by_roots.max())


def test_little_noise_leaves_the_variances_their_digits():
    """Of outputs with very different noise, the eigenvectors of the best are taken."""
    X, y = data(n_outputs=3)
    y[:, 0] = np.sin(X[:, 0])
    model = sparse(n_inducing=40, sharing="all", max_iter=40, noise_cv=None).fit(X, y)
    (group,) = model._posterior.predictor.groups
    by_roots, found = variances(group, Deviations.of(group), *some(group))
    np.testing.assert_allclose(found, by_roots, rtol=1e-6, atol=1e-10 * group.signal.max())
