from dataclasses import replace

import numpy as np
import pytest

from skevgp.control.casadi import Deviations

from .export_cases import MODELS, POLYNOMIAL, data, exact, fitted, sparse

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


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
