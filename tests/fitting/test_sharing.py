import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct

from skevgp.data.rows import LocalSource
from skevgp.fitting.sharing import found_groups, with_groups
from skevgp.model.objectives import BoundObjective
from skevgp.solvers import LBFGS
from skevgp.utils.linalg import NotPositiveDefiniteError
from skevgp.utils.monitor import Monitor

from .cases import N, data_of, fitted, problem_of


def waves(frequencies, noise=0.01, n=400, seed=0):
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


AUTO = {"sharing": "auto", "n_inducing": 40, "kernel": RBF(1.0)}


def found(n_threads=1, rng=0, **changes):
    asked = problem_of(**{**AUTO, "n_threads": n_threads} | changes)
    return found_groups(asked, np.random.RandomState(rng), Monitor())


@pytest.mark.parametrize("seed", range(3))
def test_outputs_of_like_smoothness_are_joined(seed):
    """Whatever their scale, and though they are functions of their own."""
    data = waves([0.5, 3.0, 0.5, 3.0], seed=seed)
    scaled = data_of(data["Y"] * [1.0, 1e-3, 1e4, 1.0], data["X"])
    assert found(**data) == found(**scaled) == [[0, 2], [1, 3]]
    assert found(**waves([0.5, 0.5, 0.5], seed=seed)) == [[0, 1, 2]]


def test_constant_outputs_and_noise_have_groups_of_their_own():
    """A constant's kernel is as smooth as may be; what looks like noise may be something in rows not drawn."""
    data = waves([0.5, 3.0])
    X, Y, zeros = data["X"], data["Y"], np.zeros((len(data["Y"]), 1))
    noise = np.random.RandomState(5).randn(len(Y), 1)
    assert found(**data_of(np.hstack([Y, zeros, noise]), X)) == [[0], [1], [3], [2]]
    assert found(**data_of(np.hstack([noise, Y, zeros]), X)) == [[1], [2], [0], [3]]
    assert found(**data_of(np.hstack([noise, zeros]), X)) == [[0, 1]]
    assert sorted(found(**data_of(np.hstack([zeros, zeros + 7.0]), X))) in ([[0, 1]], [[0], [1]])


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


def test_a_single_output_is_not_looked_at():
    def load(rows):
        raise AssertionError("nobody needs the rows")

    data = waves([0.5])
    asked = problem_of(**data, source=LocalSource(load, N), sharing="auto", max_iter=5)
    assert found_groups(asked, np.random.RandomState(0), Monitor()) == [[0]]


def test_a_fit_with_found_groups_is_the_fit_with_these_given():
    data = waves([0.5, 3.0, 0.5])
    auto = fitted(**AUTO, **data)
    assert auto.outputs == [[0, 2], [1]]
    given = fitted(**AUTO | {"sharing": auto.outputs}, **data)
    np.testing.assert_array_equal(
        auto.predictor().predict(data["X"], data["H"])[0], given.predictor().predict(data["X"], data["H"])[0]
    )
    assert auto.lower_bound == given.lower_bound


def test_only_groups_that_were_asked_for_are_looked_for():
    for one in ("all", "kernel", "none", [[1], [0]]):
        asked = problem_of(sharing=one)
        assert with_groups(asked, np.random.RandomState(0), Monitor()) is asked


def test_groups_that_were_found_are_kept_and_others_are_not():
    rough, smooth = waves([0.5, 3.0]), waves([0.5, 0.5])
    first = fitted(**AUTO, **rough)
    assert first.outputs == [[0], [1]]
    assert fitted(previous=first, **AUTO, **smooth).outputs == [[0], [1]]
    assert fitted(**AUTO, **smooth).outputs == [[0, 1]]
    assert fitted(previous=fitted(sharing="none", **rough), **AUTO, **smooth).outputs == [[0, 1]]
    assert fitted(previous=first, **AUTO, **waves([0.5])).outputs == [[0]]


def test_ctrl_c_while_groups_are_looked_for_reaches_the_user(monkeypatch):
    """There is no fit yet to keep; and nobody is told of these fits."""

    minimise = LBFGS.minimise

    def interrupted(*arguments):
        arguments[-1].stop()
        return minimise(*arguments)

    monkeypatch.setattr(LBFGS, "minimise", interrupted)
    told = []
    with pytest.raises(KeyboardInterrupt):
        fitted(Monitor(lambda *what: told.append(what)), sharing="auto", **waves([0.5, 3.0]))
    assert not told


@pytest.mark.parametrize("raises", [True, False])
def test_bounds_that_cannot_be_computed_do_not_end_the_fit(monkeypatch, raises):
    class Broken(BoundObjective):
        def __call__(self, flat):
            if raises:
                raise NotPositiveDefiniteError
            return np.nan, np.full_like(flat, np.nan)

    monkeypatch.setattr("skevgp.fitting.model.BoundObjective", Broken)
    assert found(**waves([0.5, 3.0])) == [[0, 1]]


def test_what_the_sample_does_not_show_is_not_ruled_by_the_others():
    """An output that is not 0 on a few of many rows only: its own kernel explains it, the others' does not."""
    data, rng = waves([0.5], n=5000), np.random.RandomState(0)
    X = data["X"]
    rare = np.where(np.linalg.norm(X - X[7], axis=1) < 0.08, 3.0, 0.0)
    assert 0 < np.count_nonzero(rare) < 50
    groups = found(**data_of(np.column_stack([data["Y"][:, 0], rare + 0.01 * rng.randn(5000)]), X))
    assert groups == [[0], [1]]
