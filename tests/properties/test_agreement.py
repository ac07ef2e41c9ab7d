"""Whatever predicts, predicts the same: derivatives, compiled, exported and loaded models, rollouts."""

import ctypes
import pickle
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skevgp import EVGPRegressor, ResidualRegressor, rollout
from skevgp.io import load, save

from .cases import (
    Case,
    assert_near,
    assert_same_bits,
    columns_of,
    data,
    fewer,
    fixed_cases,
    fixed_models,
    learned_cases,
    size_of,
)

COMPILER = shutil.which("gcc") or shutil.which("cc")
pytestmark = [
    pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning"),
    pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning"),
]


def slopes(function, X, step=2e-4):
    """Derivatives (n, o, d) of an array (n, o) by central differences of fourth order."""
    columns = []
    for way in step * np.eye(X.shape[1]):
        near = columns_of(function(X + way)) - columns_of(function(X - way))
        far = columns_of(function(X + 2.0 * way)) - columns_of(function(X - 2.0 * way))
        columns.append((8.0 * near - far) / (12.0 * step))
    return np.stack(columns, axis=2)


@given(fixed_cases(smooth=True))
def test_jacobians_are_slopes(case):
    model, X = case.fitted(), case.X_new
    size = size_of(model, case)
    mean, jacobian, std, of_std = model.value_and_jacobian(X, return_std=True)
    found = jacobian.reshape(*columns_of(mean).shape, X.shape[1])
    assert_near(found, slopes(model.predict, X), size, 1e-5)
    of_variance = 2.0 * columns_of(std)[:, :, np.newaxis] * of_std.reshape(found.shape)
    assert_near(of_variance, slopes(lambda rows: model.predict(rows, return_std=True)[1] ** 2, X), size**2, 1e-5)


@given(fixed_cases(), st.booleans())
def test_compiled_models_predict(case, include_noise):
    model = case.fitted()
    size, fast = size_of(model, case), model.compile(include_noise)
    mean, std = model.predict(case.X_new, return_std=True, include_noise=include_noise)
    for compiled in (fast, pickle.loads(pickle.dumps(fast))):
        found, found_std = compiled.predict(case.X_new, return_std=True)
        assert_near(found, mean, size, 1e-9)
        assert_near(found_std**2, std**2, size**2, 1e-8)
        assert_near(compiled.value_and_jacobian(case.X_new)[0], mean, size, 1e-9)
        assert_near(compiled.predict(case.X_new[0]), mean[0], size, 1e-9)


@fewer(2)
@given(fixed_cases(known_maps=True), st.booleans(), st.booleans())
def test_casadi_predicts(case, include_noise, parametric):
    model = case.fitted()
    size = size_of(model, case)
    if "nu=2.2" in repr(model.kernel_):
        with pytest.raises(ValueError, match="nu must be"):
            model.to_casadi()
        return
    function = model.to_casadi(include_noise=include_noise, parametric=parametric)
    others = [model.to_casadi_parameters()] if parametric else []
    mean, std = model.predict(case.X_new, return_std=True, include_noise=include_noise)
    for row, of_mean, of_std in zip(case.X_new, columns_of(mean), columns_of(std), strict=True):
        found_mean, found_variance = (found.full().ravel() for found in function(row, *others))
        assert_near(found_mean, of_mean, size, 1e-8)
        assert_near(found_variance, of_std**2, size**2, 1e-7)


@pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
@fewer(4)
@given(fixed_cases(known_maps=True, smooth=True))
def test_c_predicts(case):
    model = case.fitted()
    size = size_of(model, case)
    mean, jacobian, std, of_std = model.value_and_jacobian(case.X_new, return_std=True)
    o, d = columns_of(mean).shape[1], case.X.shape[1]
    with tempfile.TemporaryDirectory() as folder:
        source, _ = model.to_c(folder)
        library = Path(folder) / "evgp.so"
        command = [COMPILER, "-std=c99", "-O0", "-shared", "-fPIC", "-o", library, source, "-lm"]
        subprocess.run(list(map(str, command)), check=True, capture_output=True)
        function = ctypes.CDLL(str(library)).evgp_jacobian
    for i, row in enumerate(case.X_new):
        results = [np.full(shape, np.nan) for shape in (o, o, (o, d), (o, d))]
        pointers = [values.ctypes.data_as(ctypes.c_void_p) for values in (np.ascontiguousarray(row), *results)]
        assert function(*pointers) == 0
        assert_near(results[0], columns_of(mean)[i], size, 1e-8)
        assert_near(results[1], columns_of(std)[i] ** 2, size**2, 1e-7)
        assert_near(results[2], jacobian[i].reshape(o, d), size, 1e-7)
        of_variance = 2.0 * columns_of(std)[i][:, np.newaxis] * of_std[i].reshape(o, d)
        assert_near(results[3], of_variance, size**2, 1e-6)


@fewer(2)
@given(st.one_of(fixed_cases(known_maps=True), learned_cases(known_maps=True)))
def test_files_and_pickles_hold_the_model_to_the_bit(case):
    model = case.fitted()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.skevgp"
        save(model, path)
        copies = [load(path), pickle.loads(pickle.dumps(model))]
    for copy in copies:
        assert_same_bits(copy, model, case.X_new)
        np.testing.assert_array_equal(copy.sample_y(case.X_new), model.sample_y(case.X_new))
        assert copy.get_params().keys() == model.get_params().keys()


@st.composite
def dynamics(draw):
    """Models of the next state of as many states as there are outputs, and inputs."""
    X, Y, X_new = draw(data(most_columns=4, fewest_rows=2))
    Y = Y[:, : X.shape[1]]
    model = draw(fixed_models(X, Y.shape[1]))
    return Case(ResidualRegressor(model) if draw(st.booleans()) else model, X, Y, X_new)


@given(dynamics(), st.sampled_from(["mean", "linearized"]), st.sampled_from(["learned", "none"]))
def test_first_step_of_a_rollout_is_the_prediction(case, method, noise):
    model, o = case.fitted(), case.Y.shape[1]
    x = case.X_new[[0]]
    ahead = rollout(model, x[0, :o], x[:, o:], method=method, process_noise=noise)
    mean, std = model.predict(x, return_std=True, include_noise=noise == "learned")
    inner = getattr(model, "regressor_", model)
    size = size_of(inner, case) + np.abs(x).max()
    assert_near(ahead.mean[0], np.ravel(mean), size, 1e-9)
    assert_near(ahead.std[0] ** 2, np.ravel(std) ** 2, size**2, 1e-8)
    assert_near(np.diag(ahead.covariance[0]), np.ravel(std) ** 2, size**2, 1e-8)


@given(fixed_cases(known_maps=True))
def test_residual_regressor_is_the_model_of_the_change(case):
    Y = columns_of(case.Y)[:, : case.X.shape[1]]
    o = Y.shape[1]
    if isinstance(case.model, EVGPRegressor):
        case = case.with_model(sharing="all")
    one = ResidualRegressor(case.model).fit(case.X, Y)
    other = case.fitted(Y=Y - case.X[:, :o])
    size = size_of(other, case) + np.abs(case.X_new).max()
    for shift, found, expected in zip(
        (case.X_new[:, :o], 0.0),
        one.predict(case.X_new, return_std=True),
        other.predict(case.X_new, return_std=True),
        strict=True,
    ):
        assert_near(columns_of(found), columns_of(expected) + shift, size, 1e-9)
