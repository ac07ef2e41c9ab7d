import ctypes
import shutil
import subprocess

import casadi as ca
import numpy as np
import pytest
from sklearn.pipeline import make_union

import skevgp
from skevgp import CoefPrior
from skevgp.features import AngleEncoder, InertiaForceGravity, NominalDynamics

from .export_cases import MODELS, POLYNOMIAL, data, fitted, jacobians, predicted, sparse

COMPILER = shutil.which("gcc") or shutil.which("cc")
pytestmark = [
    pytest.mark.skipif(COMPILER is None, reason="there is no C compiler"),
    pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning"),
]
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror"]
SHAPES = {
    "predict": ("mean", "variance"),
    "mean_jacobian": ("mean", "mean_jacobian"),
    "jacobian": ("mean", "variance", "mean_jacobian", "variance_jacobian"),
}


def compiled(source, optimise="-O0"):
    library = source.with_suffix(".so")
    command = [COMPILER, *WARNINGS, "-shared", "-fPIC", "-o", library, source, optimise, "-lm"]
    subprocess.run(list(map(str, command)), check=True, capture_output=True, text=True)
    return library


def called(library, name, x, n_outputs, which="jacobian", without=()):
    """The results of one of the functions, by name."""
    results = {
        result: np.full((n_outputs, len(x)) if "jacobian" in result else n_outputs, np.nan) for result in SHAPES[which]
    }
    function = getattr(ctypes.CDLL(str(library)), f"{name}_{which}")
    pointers = [
        None if result in without else values.ctypes.data_as(ctypes.c_void_p) for result, values in results.items()
    ]
    given = np.ascontiguousarray(x, dtype=float)
    assert function(given.ctypes.data_as(ctypes.c_void_p), *pointers) == 0
    return results


OTHERS = [pytest.param(name, marks=pytest.mark.long) for name in ("no maps", "groups", "sums")]


@pytest.mark.parametrize("name", ["cartpole", "rows of both", "exact, features", *OTHERS])
def test_c_predicts(name, tmp_path):
    model = fitted(MODELS[name], n_rows=30)
    source, header = model.to_c(tmp_path)
    assert (source, header) == (tmp_path / "evgp.c", tmp_path / "evgp.h")
    assert f"skevgp {skevgp.__version__} with CasADi {ca.CasadiMeta.version()}" in header.read_text()
    library, function = compiled(source), model.to_casadi()
    for x in data(seed=1)[0][:3]:
        mean, variance = predicted(model, x.reshape(1, -1))
        of_mean, of_variance = jacobians(function, x)
        found = called(library, "evgp", x, 3)
        np.testing.assert_allclose(found["mean"], mean[0], rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(found["variance"], variance[0], rtol=1e-9)
        np.testing.assert_allclose(found["mean_jacobian"], of_mean, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(found["variance_jacobian"], of_variance, rtol=1e-9, atol=1e-10)
        for which in ("predict", "mean_jacobian"):
            for result, values in called(library, "evgp", x, 3, which).items():
                np.testing.assert_allclose(values, found[result], rtol=1e-12, atol=1e-14)


@pytest.mark.long
def test_c_predicts_rows_that_end_with_their_time_step(tmp_path):
    X, y = data()
    X = np.column_stack([X, np.linspace(0.005, 0.05, len(X))])
    columns = {"dt": "column"}
    union = make_union(InertiaForceGravity("cartpole", **columns), NominalDynamics("cartpole", **columns))
    model = sparse(
        union, kernel_map=AngleEncoder("cartpole", **columns), coef_prior=CoefPrior(mean=0.1, scale=1.0)
    ).fit(X, y)
    library = compiled(model.to_c(tmp_path)[0])
    for x in X[::30]:
        found, (mean, slopes) = called(library, "evgp", x, 3), model.value_and_jacobian(x.reshape(1, -1))
        np.testing.assert_allclose(found["mean"], mean[0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found["mean_jacobian"], slopes[0], rtol=1e-7, atol=1e-9 * np.abs(slopes).max())


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A model, and its library."""
    model = fitted(sparse(POLYNOMIAL, sharing="all", n_inducing=4))
    return model, compiled(model.to_c(tmp_path_factory.mktemp("c"), "arm", include_noise=False)[0], "-O1")


def test_noise_is_left_out_if_that_is_asked_for(exported):
    model, library = exported
    x = data(seed=1)[0][0]
    found = called(library, "arm", x, 3, "predict")
    np.testing.assert_allclose(found["variance"], predicted(model, x.reshape(1, -1), False)[1][0], rtol=1e-9)


@pytest.mark.parametrize("name", ["int", "restrict", "sin", "fmaf", "x", "casadi_int", "NAN"])
def test_reserved_c_name_raises(name, tmp_path):
    with pytest.raises(ValueError, match=f"name='{name}' is a reserved word of C"):
        fitted(sparse()).to_c(tmp_path, name)
    assert not list(tmp_path.iterdir())


def test_missing_folder_raises(tmp_path):
    model = fitted(sparse())
    with pytest.raises(ValueError, match=r"path=.*the folder .*missing.* does not exist"):
        model.to_c(tmp_path / "missing" / "model.c")
    with pytest.raises(ValueError, match=r"the folder .*missing.* does not exist"):
        model.to_c(tmp_path / "missing")
