import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct

from skevgp.fitting.sharing import found_groups
from skevgp.utils.monitor import Monitor

from .cases import data_of, fitted, problem_of


def waves(frequencies, noise=0.01, n=200, seed=0):
    """Sums of a few waves of random directions and phases: each output as rough as its frequency says."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2.0, 2.0, (n, 2))
    columns = []
    for frequency in frequencies:
        directions = rng.randn(2, 5)
        directions *= frequency / np.linalg.norm(directions, axis=0)
        columns.append(np.sin(X @ directions + rng.uniform(0.0, 6.0, 5)).sum(axis=1))
    Y = np.column_stack(columns)
    return data_of(Y + noise * rng.randn(*Y.shape), X)


AUTO = {"sharing": "auto", "n_inducing": 30, "kernel": RBF(1.0)}


def found(n_threads=1, rng=0, **changes):
    asked = problem_of(**{**AUTO, "n_threads": n_threads} | changes)
    return found_groups(asked, np.random.RandomState(rng), Monitor())


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_outputs_of_like_smoothness_are_joined(seed):
    """Whatever their scale, and though they are functions of their own."""
    data = waves([0.5, 3.0, 0.5, 3.0], seed=seed)
    scaled = data_of(data["Y"] * [1.0, 1e-3, 1e4, 1.0], data["X"])
    assert found(**data) == found(**scaled) == [[0, 2], [1, 3]]
    assert found(**waves([0.5, 0.5, 0.5], seed=seed)) == [[0, 1, 2]]


@pytest.mark.parametrize(
    "changes",
    [
        {"max_iter": 0},
        {"kernel": ConstantKernel() * RBF(1.0, "fixed")},
        {"kernel": ConstantKernel() * DotProduct(1.0, "fixed")},
    ],
    ids=["no iterations", "fixed", "nothing to learn"],
)
def test_kernels_that_stay_where_they_start_are_shared(changes):
    assert found(**waves([0.5, 3.0]), **changes) == [[0, 1]]


def test_fit_with_found_groups_is_the_fit_with_these_given():
    data = waves([0.5, 3.0, 0.5])
    auto = fitted(**AUTO, **data)
    assert auto.outputs == [[0, 2], [1]]
    given = fitted(**AUTO | {"sharing": auto.outputs}, **data)
    np.testing.assert_array_equal(
        auto.predictor().predict(data["X"], data["H"])[0], given.predictor().predict(data["X"], data["H"])[0]
    )
    assert auto.lower_bound == given.lower_bound
