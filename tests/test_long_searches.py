"""What `tests/long/soak.py` and `tests/long/torture.py` go by, with answers that are known."""

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.preprocessing import PolynomialFeatures

from skevgp import EGPRegressor, EVGPRegressor
from tests.alone import alone
from tests.long.soak import WARM_UP, leaks
from tests.long.torture import DefectError, run_case
from tests.nasty import Case

MB = 2**20


def states(sizes, **last):
    """Of rounds with these resident sets."""
    found = [{"resident": size, "open files": ["a"], "threads": 1, "left behind": [], "defects": []} for size in sizes]
    found[-1] |= last
    return found


@pytest.mark.parametrize(
    ("sizes", "last", "message"),
    [
        ([100 * MB] * 20, {}, None),
        (200 * MB + MB * np.random.RandomState(0).randn(20), {}, None),
        (np.append([0.0] * WARM_UP, 100 * MB + 1.5 * MB * np.arange(17)), {}, "memory: .* MB more"),
        ([100 * MB] * 20, {"threads": 2}, "threads: 1 became 2"),
        ([100 * MB] * 20, {"open files": ["a", "b"]}, r"open files: 1 became 2; new: \['b'\]"),
        ([100 * MB] * 20, {"left behind": ["tmp"]}, "files left behind"),
        ([100 * MB] * 20, {"defects": ["17: a std of 0"]}, "17: a std of 0"),
    ],
)
def test_leaks_are_seen(sizes, last, message):
    found = leaks(states(list(sizes), **last))
    assert len(found) == (0 if message is None else 1)
    if message is not None:
        with pytest.raises(AssertionError, match=message):
            raise AssertionError(found[0])


RNG = np.random.RandomState(0)
X, Y = RNG.randn(60, 2), RNG.randn(60, 2)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("weighed", [False, True])
@pytest.mark.parametrize("feature_map", [None, PolynomialFeatures(1)], ids=["plain", "features"])
def test_the_bound_of_features_and_noise_alone_is_that_of_a_kernel_that_says_nothing(feature_map, weighed):
    """At the best noise: given the same, the exact model with hardly any signal has it."""
    weights = {"sample_weight": RNG.randint(1, 4, 60), "relative_variance": RNG.uniform(0.5, 2, 60)} if weighed else {}
    fitted = EVGPRegressor(feature_map, n_inducing=5, max_iter=1, noise_cv=None, random_state=0).fit(X, Y, **weights)
    kernel = ConstantKernel(1e-10, "fixed") * RBF([1.0, 1.0], "fixed") + WhiteKernel(1.0, (1e-6, 1e6))
    nothing = EGPRegressor(feature_map, kernel).fit(X, Y, **weights)
    assert alone(fitted, X, Y, **weights) == pytest.approx(nothing.log_marginal_likelihood_value_, abs=0.05)


class Model:
    """Does what it is told to."""

    def __init__(self, fails=None, mean=0.0, std=1.0):
        self.fails, self.mean, self.std = fails, mean, std

    def fit(self, X, y):
        if self.fails is not None:
            raise self.fails
        return self

    def predict(self, X, return_std=False):
        return (np.full(len(X), self.mean), np.full(len(X), self.std)) if return_std else np.full(len(X), self.mean)


def test_a_good_model_is_fitted():
    assert run_case(Case(Model(), X, Y, X)) == "fitted"


@pytest.mark.parametrize(
    ("model", "options", "message"),
    [
        (Model(mean=np.nan), {}, "mean that is not finite"),
        (Model(std=np.inf), {}, "std that is not finite"),
        (Model(std=0.0), {}, "std of 0.0"),
        (Model(ValueError("SVD did not converge")), {}, "refused, for no reason known"),
        (Model(np.linalg.LinAlgError("X contains NaN")), {"refusals": ["X contains NaN"]}, "raised LinAlgError"),
        (Model(IndexError("X contains NaN")), {"refusals": ["X contains NaN"]}, "raised IndexError"),
        (
            Model(ValueError("X contains NaN")),
            {"refusals": ["X contains NaN"]},
            "from the depths of tests.test_long_searches",
        ),
        (Model(), {"refusals": ["X contains NaN"], "must": True}, "was to be refused"),
    ],
)
def test_defects_are_seen(model, options, message):
    with pytest.raises(DefectError, match=message):
        run_case(Case(model, X, Y, X, **options))
