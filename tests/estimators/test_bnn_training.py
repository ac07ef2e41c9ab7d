import numpy as np
import pytest

from skevgp.estimators.bnn_model import VariationalNetwork
from skevgp.estimators.bnn_training import Scaling, _EarlyStopping, train

RNG = np.random.RandomState(0)
X, Y = RNG.randn(60, 3) * [1.0, 1e9, 1e-9] + [5.0, 0.0, 1e-9], RNG.randn(60, 2) * [1e-6, 1e6] + [1e-6, -3.0]


def test_standardised_columns_have_mean_0_and_deviation_1():
    scaling = Scaling.of(X, Y)
    for values in (scaling.inputs(X), scaling.targets(Y)):
        np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=1e-6)
        np.testing.assert_allclose(values.std(axis=0), 1.0, rtol=1e-6)
    assert scaling.log_unit == pytest.approx(np.log(Y.std(axis=0)).sum())


@pytest.mark.parametrize("value", [0.0, 0.1, -1e12, 1e-12])
def test_a_constant_column_becomes_0_in_units_of_itself(value):
    scaling = Scaling.of(np.full((7, 1), value), np.full((7, 1), value))
    np.testing.assert_array_equal(scaling.inputs(np.full((7, 1), value)), 0.0)
    assert scaling.y_scale[0] == (abs(value) or 1.0)


@pytest.mark.parametrize("hidden", [(), (4,), (4, 3)])
def test_a_network_taken_over_to_another_scaling_is_the_same_function(hidden):
    network = VariationalNetwork([3, *hidden, 2], [1.0] * (len(hidden) + 1), 0.01)
    rng = np.random.default_rng(0)
    old = rng.standard_normal(network.n_parameters)
    new = np.empty_like(old)
    for layer in network.split(old)[0]:
        layer.log_std[:] = np.log(1e-8)
    before, after = Scaling.of(X, Y), Scaling.of(2.0 * X + X.std(axis=0), 3.0 * Y - 1.0)
    after.take_over(before, network.split(old), network.split(new))
    x = X[:5]

    def outputs(scaling, theta):
        means = [layer.mean[np.newaxis] for layer in network.split(theta)[0]]
        return network.functions(theta, means, scaling.inputs(x))[0] * scaling.y_scale + scaling.y_mean

    np.testing.assert_allclose(outputs(after, new), outputs(before, old), rtol=1e-7)
    for (layers, noise), (again, same) in zip(
        [before.to_users(*network.split(old))], [after.to_users(*network.split(new))], strict=True
    ):
        np.testing.assert_allclose(noise, same, rtol=1e-12)
        for a, b in zip(layers, again, strict=True):
            np.testing.assert_allclose(a.log_std, b.log_std, rtol=1e-12)


def test_early_stopping_keeps_the_best_and_waits():
    scores = iter([1.0, 3.0, 3.05, 2.0, 2.0])
    watch = _EarlyStopping(lambda theta: next(scores), 2, 0.1, 3)
    ended = [watch(np.array([step])) for step in range(10)]
    assert ended == [False] * 9 + [True]
    assert watch.scores == [1.0, 3.0, 3.05, 2.0, 2.0]
    assert watch.theta == [5]


def test_rows_held_back_are_not_learned_from():
    """Targets that differ by rows: the network is the same whatever the targets of the rows held back."""
    network = VariationalNetwork([1, 2], [1.0], 0.01)
    x, y = RNG.randn(30, 1), RNG.randn(30, 2)
    held_back = np.random.default_rng(3).permutation(30)[:10]
    other = y.copy()
    other[held_back] += 1e-3
    options = {"n_held_back": 10, "max_iter": 5, "batch_size": 7, "learning_rate": 0.01, "tol": 0.0, "patience": 100}
    a, b = (
        train(network, np.zeros(network.n_parameters), x, t, np.random.default_rng(3), **options) for t in (y, other)
    )
    np.testing.assert_array_equal(a.minimum.x, b.minimum.x)
    assert (a.scores != b.scores).all()
    assert len(a.losses) == len(a.scores) == 5
    assert a.minimum.n_iter == 5 * 3
    np.testing.assert_allclose(a.losses[0], np.mean(a.minimum.loss_curve[:3]))


def test_all_rows_at_once_weighed_are_the_same_rows_repeated():
    """Without hidden layers nothing is drawn."""
    rng = np.random.RandomState(0)
    X, counts = rng.randn(30, 2), rng.randint(1, 4, 30)
    Y, again = X @ [[1.0], [-0.5]] + 0.1 * rng.randn(30, 1), np.repeat(np.arange(30), counts)
    network, options = (
        VariationalNetwork([2, 1], [0.7], 0.01),
        {"n_held_back": 0, "max_iter": 50, "learning_rate": 0.05},
    )
    options |= {"tol": 0.0, "patience": 1}
    weighed, repeated = (
        train(network, np.zeros(network.n_parameters), *rows, np.random.default_rng(0), batch_size=n, **options, **more)
        for rows, n, more in (((X, Y), 30, {"counts": counts.astype(float)}), ((X[again], Y[again]), len(again), {}))
    )
    np.testing.assert_allclose(weighed.theta, repeated.theta, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(weighed.losses, repeated.losses, rtol=1e-8)


def test_the_scaling_of_rows_that_count_twice_is_that_of_repeated_ones():
    rng = np.random.RandomState(0)
    X, Y, counts = rng.randn(20, 3), rng.randn(20, 2), rng.randint(1, 4, 20)
    again = np.repeat(np.arange(20), counts)
    found, expected = Scaling.of(X, Y, counts.astype(float)), Scaling.of(X[again], Y[again])
    for name in ("x_mean", "x_scale", "y_mean", "y_scale"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-12)
