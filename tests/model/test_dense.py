"""Bound, gradient, mean, variance and weights of all models are those of dense matrices."""

from dataclasses import replace
from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest
from autograd import grad
from numpy.testing import assert_allclose

from skevgp.model.bounds import Variant
from skevgp.model.exact import ExactModel
from skevgp.model.model import SparseModel
from skevgp.model.objectives import BoundObjective, ElboObjective
from skevgp.model.parameters import log_prior

from ..oracle import Dense, blocks_of, problem, relative_error, values_of, with_groups

M, N, O = 6, 40, 2  # noqa: E741
RNG = np.random.RandomState(7)
X_NEW, H_NEW = RNG.randn(7, 2), RNG.randn(7, 3)
# Groups of outputs with points of their own, weights that the outputs share, weights of the rows, number of features.
SETTINGS = [each for each in product((1, 2), (False, True), (False, True), (0, 3)) if each[3] or not each[1]]
# A diagonal posterior has no shared weights.
SPARSE = [
    # Of the bound, the groups and the weights of rows, each pair is a quick test, with all of the others.
    pytest.param(family, tight, *each, marks=[pytest.mark.long] if (tight + each[0] + each[2]) % 2 else [])
    for family, tight, each in product(("full", "diagonal"), (False, True), SETTINGS)
    if family == "full" or not each[1]
]


def setting(family, n_groups, shared, weighted, p):
    """Model, rows and table of parameters."""
    model, rows, table = problem(family, n_groups == 1, n=N, p=p)
    rng, raw = np.random.RandomState(3), rows.raw
    if shared:  # and correlated
        root = np.tril(rng.randn(p, p))[np.newaxis].repeat(O, axis=0)
        own = {name: getattr(model.prior, name)[:1].repeat(O, axis=0) for name in ("mean", "reference")}
        prior = replace(model.prior, root=root, scale=np.sqrt((root**2).sum(axis=2)), shared=True, **own)
        model = replace(model, prior=prior)
    if weighted:
        counts, variance = rng.uniform(0.2, 3.0, N), np.exp(rng.randn(N))
        raw = replace(raw, counts=counts, precision=counts / variance)
    model, table = with_groups(model, table)
    return model, raw, table


def assert_predictions(predictor, dense, values, p):
    features = H_NEW[:, :p]
    mean, second = dense.predict(values, X_NEW, features)
    found, variance = predictor.predict(X_NEW, features, return_variance=True)
    assert_allclose(found, mean, rtol=1e-7, atol=1e-9)
    coef, coef_cov = dense.weights(values)
    for own, expected in zip(predictor.coefficients(), (coef, coef_cov), strict=True):
        assert_allclose(np.broadcast_to(own, expected.shape), expected, rtol=1e-6, atol=1e-9)
    if dense.family == "diagonal":
        assert_allclose(variance, second, rtol=1e-6)
        return
    _, covariance = predictor.covariance(X_NEW, features)
    n = len(X_NEW)
    joint = second.reshape(O, n, O, n).transpose(1, 0, 3, 2)
    assert_allclose(variance, np.einsum("nono->no", joint), rtol=1e-6)
    assert_allclose(covariance, np.einsum("nomo->nmo", joint), rtol=1e-6, atol=1e-9)
    jointly = predictor.jointly(covariance, X_NEW, features).reshape(n, O, n, O)
    assert_allclose(jointly, joint, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("family", "tight", "n_groups", "shared", "weighted", "p"), SPARSE)
def test_sparse_model_is_dense_one(family, tight, n_groups, shared, weighted, p):
    model, raw, table = setting(family, n_groups, shared, weighted, p)
    model, dense = replace(model, variant=Variant(family, tight)), Dense(raw, model.prior, family, tight=tight)
    values, blocks = table.values_at_start(), blocks_of(raw, model.kernel)
    statistics = model.statistics(values, blocks)
    lower, likelihood, of_factors = dense.bound(values), dense.likelihood(values), log_prior(values)
    assert of_factors < 0.0
    assert model.bound(values, statistics, blocks) == pytest.approx(lower, rel=1e-8)
    assert model.bound(values, statistics) == pytest.approx(lower, rel=1e-8)
    assert lower < likelihood < model.upper_bound(values, statistics, blocks)
    if tight:
        loose = replace(model, variant=Variant(family))
        assert loose.bound(values, loose.statistics(values, blocks), blocks) < lower
    if not weighted and not shared:
        for seen in (blocks, None):
            assert model.upper_bound(values, statistics, seen) == pytest.approx(dense.upper_bound(values), rel=1e-8)

    value, gradient = BoundObjective(model, table, blocks)(table.start())
    assert value == pytest.approx(-(lower + of_factors) / blocks.linear.n_rows, rel=1e-8)

    def loss(flat):
        values = values_of(table, flat)
        return (0.5 * anp.sum(anp.log(values["coef_factors"]) ** 2) - dense.bound(values)) / blocks.linear.n_rows

    expected = grad(loss)(table.start())
    assert relative_error(gradient, expected) < 1e-7
    if not shared:
        elbo = ElboObjective(model, table, blocks)
        assert elbo.evaluate(elbo.table.start(), blocks)[0] == pytest.approx(value, rel=1e-8)
    assert_predictions(model.at_optimum(values, statistics), dense, values, p)


@pytest.mark.parametrize(("shared", "weighted", "p"), [each[1:] for each in SETTINGS if each[0] == 1])
def test_exact_model_is_dense_one(shared, weighted, p):
    sparse, raw, table = setting("full", 1, shared, weighted, p)
    model = ExactModel(sparse.kernel, sparse.prior, np.zeros((O, p), dtype=bool), raw)
    dense, values = Dense(raw, model.prior, exact=True), table.values_at_start()
    names = ("hyperparameters", "signal", "noise", "coef_factors")
    value, gradient = model.log_likelihood(values)
    assert value == pytest.approx(dense.likelihood(values), rel=1e-10)

    def of_logs(logs):
        parts = dict(zip(names, (logs[:2], logs[2 : 2 + O], logs[2 + O : 2 + 2 * O], logs[2 + 2 * O :]), strict=True))
        parts["coef_factors"] = parts["coef_factors"].reshape(values["coef_factors"].shape)
        return dense.likelihood(values | {name: anp.exp(part) for name, part in parts.items()})

    logs = np.log(np.concatenate([values[name].ravel() for name in names]))
    assert relative_error(np.concatenate([gradient[name].ravel() for name in names]), grad(of_logs)(logs)) < 1e-8
    assert_predictions(model.predictor(values), dense, values, p)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("p", [0, 3])
def test_points_at_all_rows_give_exact_model(p, weighted):
    model, rows, table = problem(n=30, m=2, d=3, p=p)
    raw = replace(rows.raw, counts=np.full(30, 3.0), precision=np.linspace(1.0, 5.0, 30)) if weighted else rows.raw
    values = table.values_at_start() | {"inducing_points": raw.inputs[np.newaxis]}
    model = SparseModel(model.kernel, model.prior, model.groups, complete=True)
    blocks = blocks_of(raw, model.kernel)
    statistics, expected = model.statistics(values, blocks), Dense(raw, model.prior, exact=True).likelihood(values)
    assert model.bound(values, statistics, blocks) == pytest.approx(expected, rel=1e-6)
    assert model.upper_bound(values, statistics, blocks) == pytest.approx(expected, rel=1e-6)


def test_more_features_than_rows_are_as_many_as_rows_in_each_group():
    """Also with a factor on the scales of each group."""
    sparse, raw, table = setting("full", 1, False, False, 3)
    rng = np.random.RandomState(1)
    n, p = 5, 20
    raw = replace(raw, inputs=raw.inputs[:n], targets=raw.targets[:n], features=rng.randn(n, p))
    groups = np.tile(np.repeat([-1, 0, 1], [3, 8, 9]), (O, 1))
    prior = replace(
        sparse.prior,
        mean=np.zeros((O, p)),
        scale=0.5 + rng.rand(O, p),
        reference=rng.randn(O, p),
        groups=groups,
    )
    model = ExactModel(sparse.kernel, prior, np.zeros((O, p), dtype=bool), raw)
    fewer, values = model.with_fewer_features(), table.values_at_start()
    assert fewer.prior.scale.shape == (O, 13)
    values["noise"] = np.full(O, 0.3)
    (value, gradient), (expected, expected_gradient) = (each.log_likelihood(values) for each in (fewer, model))
    assert value == pytest.approx(expected, rel=1e-10)
    for name, own in expected_gradient.items():
        assert_allclose(gradient[name], own, rtol=1e-8, atol=1e-10)
