import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import (
    RBF,
    CompoundKernel,
    ConstantKernel,
    DotProduct,
    Exponentiation,
    ExpSineSquared,
    Matern,
    PairwiseKernel,
    RationalQuadratic,
    WhiteKernel,
)

import skevgp
from skevgp import EVGPRegressor
from skevgp.kernels.base import Product, Sum
from skevgp.kernels.constant import Constant
from skevgp.kernels.dot_product import DotProduct as DotProductCovariance
from skevgp.kernels.parse import parse_kernel
from skevgp.kernels.stationary import SquaredExponential

X = np.random.RandomState(0).randn(20, 2)


@pytest.mark.parametrize(
    ("kernel", "tree", "covariance"),
    [
        (RBF(0.5), 1.0 * RBF(0.5), SquaredExponential(2, True)),
        (2.0 * RBF([0.5, 1.0]), 2.0 * RBF([0.5, 1.0]), SquaredExponential(2)),
        (RBF(0.5) * ConstantKernel(4.0), RBF(0.5) * 4.0, SquaredExponential(2, True)),
        (RBF(0.5) + WhiteKernel(0.1), 1.0 * RBF(0.5), SquaredExponential(2, True)),
        (WhiteKernel(0.1) + 4.0 * RBF(0.5), 4.0 * RBF(0.5), SquaredExponential(2, True)),
        (ConstantKernel(4.0), 1.0 * ConstantKernel(4.0), Constant()),
        (DotProduct(), 1.0 * DotProduct(), DotProductCovariance()),
        (
            2.0 * RBF() + 0.25,
            1.0 * (2.0 * RBF() + 0.25),
            Sum((Product((Constant(), SquaredExponential(2, True))), Constant())),
        ),
        (
            ConstantKernel(4) * (RBF([1, 2]) + 0.5 * DotProduct()) + WhiteKernel(),
            4.0 * (RBF([1, 2]) + 0.5 * DotProduct()),
            Sum((SquaredExponential(2), Product((Constant(), DotProductCovariance())))),
        ),
        (
            RBF() + WhiteKernel() + DotProduct(),
            1.0 * (RBF() + DotProduct()),
            Sum((SquaredExponential(2, True), DotProductCovariance())),
        ),
        # Of two constant factors the outer one is the signal variance.
        (
            (9.0 * RBF()) * 4.0,
            9.0 * RBF() * 4.0,
            Product((Constant(), SquaredExponential(2, True))),
        ),
    ],
    ids=str,
)
def test_trees_are_read(kernel, tree, covariance):
    spec = parse_kernel(kernel, 2)
    assert spec.tree == tree
    assert spec.covariance == covariance
    assert len(spec.starts.hyperparameters.value) == covariance.n_hyperparameters


def test_outer_constant_is_the_signal_variance():
    assert parse_kernel((9.0 * RBF()) * 4.0, 2).starts.signal.value == 4.0
    assert parse_kernel(9.0 * RBF() * DotProduct(), 2).starts.signal.value == 9.0
    assert parse_kernel(RBF() + 1.0, 2).starts.signal.value is None


@pytest.mark.parametrize(
    ("kernel", "named"),
    [
        (PairwiseKernel(metric="laplacian"), "PairwiseKernel"),
        (RBF() + Matern() * PairwiseKernel(), "PairwiseKernel"),
        (RBF() ** 2, "Exponentiation"),
        (RBF() + Exponentiation(RBF(), 2) * 2.0, "Exponentiation"),
        (CompoundKernel([RBF(), RBF()]), "CompoundKernel"),
        ((RBF() + WhiteKernel()) * ConstantKernel(), "WhiteKernel"),
        (RBF() + RBF() * WhiteKernel(), "WhiteKernel"),
        (type("Own", (RBF,), {})(), "Own"),
    ],
)
def test_unsupported_kernel_raises(kernel, named):
    with pytest.raises(ValueError, match=rf"{named} does not work in this place.* These work: .*\bRBF\b"):
        parse_kernel(kernel, 2)


@pytest.mark.parametrize(
    "kernel", [WhiteKernel(), WhiteKernel() + WhiteKernel(), RBF() + WhiteKernel() + WhiteKernel()]
)
def test_noise_is_one_term_of_several(kernel):
    with pytest.raises(ValueError, match="may have one WhiteKernel"):
        parse_kernel(kernel, 2)


@pytest.mark.parametrize("kernel", ["rbf", RBF, 1.0])
def test_invalid_kernel_type_raises(kernel):
    with pytest.raises(TypeError, match="kernel must be a kernel of"):
        EVGPRegressor(kernel=kernel).fit(X, X[:, 0])


@pytest.mark.parametrize(
    ("kernel", "message"),
    [
        (RBF(0.0), "length_scale must be between"),
        (RBF(-1.0), "length_scale must be between"),
        (RBF(np.nan), "length_scale must be between"),
        (RBF(1e-300, "fixed"), "length_scale must be between"),
        (ConstantKernel(-1.0) * RBF(), "constant_value must be between"),
        (ConstantKernel(0.0, "fixed") * RBF(), "constant_value must be between"),
        (RBF() + WhiteKernel(np.nan), "noise_level must be between"),
        (RBF() + WhiteKernel(0.0, "fixed"), "noise_level must be between"),
        (DotProduct(0.0, "fixed"), "sigma_0 must be between"),
        (RationalQuadratic(alpha=-1.0), "alpha must be between"),
        (RBF() + ConstantKernel(0.0), "constant_value must be between"),
        (RBF(1.0, (10.0, 0.1)), "length_scale_bounds must be above 0, the lower ones first"),
        (RBF(1.0, (np.nan, 10.0)), "length_scale_bounds must be above 0"),
        (RBF(1.0, "fix"), "length_scale_bounds must be 'fixed' or pairs of numbers; got .*fix"),
        (RBF() + WhiteKernel(1.0, (-1.0, 10.0)), "noise_level_bounds must be above 0"),
        (ExpSineSquared(1.0, 1.0, (1.0, 2.0), (0.0, 2.0)), "periodicity_bounds must be above 0"),
    ],
)
def test_values_and_bounds_out_of_range_raise(kernel, message):
    with pytest.raises(ValueError, match=message):
        parse_kernel(kernel, 2)


# --- bounds ------------------------------------------------------------------------------------------------------

BOUNDS = (0.5, 8.0)


@pytest.mark.parametrize(
    ("kernel", "at_bounds"),
    [
        (RBF(2.0, BOUNDS), []),
        (RBF(8.0, BOUNDS), ["length_scale 0 upper 8.0"]),
        (RBF(8.0, "fixed"), []),
        (RBF([2.0, 0.5], [(0.1, 3.0), BOUNDS]), ["length_scale 1 lower 0.5"]),
        (ConstantKernel(0.5, BOUNDS) * RBF(2.0, BOUNDS), ["k1__constant_value 0 lower 0.5"]),
        (RBF(2.0, BOUNDS) * ConstantKernel(8.0, BOUNDS), ["k2__constant_value 0 upper 8.0"]),
        (ConstantKernel(8.0, "fixed") * RBF(0.5, BOUNDS), ["k2__length_scale 0 lower 0.5"]),
        (
            WhiteKernel(8.0, BOUNDS) + 2.0 * RBF([2.0, 8.0], BOUNDS),
            ["k1__noise_level 0 upper 8.0", "k2__k2__length_scale 1 upper 8.0"],
        ),
        (RBF(2.0, BOUNDS) + DotProduct(0.5, BOUNDS) + WhiteKernel(0.5, "fixed"), ["k1__k2__sigma_0 0 lower 0.5"]),
        (
            ConstantKernel(2.0) * (DotProduct(8.0, "fixed") + RationalQuadratic(8.0, 0.5, BOUNDS, BOUNDS))
            + WhiteKernel(0.5, BOUNDS),
            ["k1__k2__k2__alpha 0 lower 0.5", "k1__k2__k2__length_scale 0 upper 8.0", "k2__noise_level 0 lower 0.5"],
        ),
    ],
    ids=str,
)
def test_parameter_at_bound_is_named(kernel, at_bounds):
    spec = parse_kernel(kernel, 2)
    # Where the user lets them start.
    signal, noise = (
        1.0 if start.value is None else float(start.value[0]) for start in (spec.starts.signal, spec.starts.noise)
    )
    found = spec.at_bounds(spec.starts.hyperparameters.value, signal, noise)
    assert len(found) == len(at_bounds)
    for sentence, expected in zip(found, at_bounds, strict=True):
        name, dimension, side, bound = expected.split()
        assert f"dimension {dimension} of parameter {name} is close to the specified {side} bound {bound}." in sentence


def warnings_of(model, X, y):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        model.fit(X, y)
    return [str(one.message) for one in told if issubclass(one.category, ConvergenceWarning)]


@pytest.mark.parametrize("regressor", [skevgp.EGPRegressor, EVGPRegressor])
@pytest.mark.parametrize("kernel", [RBF(1.0, (1e-5, 1e-3)), WhiteKernel(1.0, (1e-5, 1e-3)) + RBF(1.0, (1e3, 1e5))])
def test_parameter_at_bound_warns_like_sklearn(regressor, kernel):
    rows = np.array([[1.0], [3.0], [5.0], [6.0], [7.0], [8.0]])
    y = (rows * np.sin(rows))[:, 0]
    expected = warnings_of(GaussianProcessRegressor(kernel), rows, y)
    assert expected
    actual = warnings_of(regressor(kernel=kernel), rows, y)
    assert [message for message in actual if "specified" in message] == expected
