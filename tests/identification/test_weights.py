from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import DotProduct

from skevgp.identification.weights import Prior, Rows, condensed, folds, identify, with_gains, with_others


def problem(n=400, n_outputs=2, p=4, noise=0.1, seed=0, gains=None, scaled=4):
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(n, n_outputs, p))
    beta = rng.normal(size=p)
    rigid = features[:, :, :scaled] @ beta[:scaled]
    targets = rigid * (1.0 if gains is None else gains) + features[:, :, scaled:] @ beta[scaled:]
    targets = targets + noise * rng.normal(size=(n, n_outputs))
    rows = Rows(features, targets, np.ones((n, n_outputs)), np.zeros(n, dtype=int), *2 * [np.arange(n) * 5 // n])
    prior = Prior(np.zeros(p), np.eye(p), np.arange(p) < scaled, None, np.full(n_outputs, 0.01))
    return rows, prior, beta


def test_with_independent_rows_it_is_the_bayesian_linear_model():
    rows, prior, _ = problem(n_outputs=1)
    found = identify(rows, prior)
    # What the noise is worth is known of the result; the rest is Eq. 2.8 of Rasmussen & Williams.
    worth = found.noise[0].variance * found.correlation_time[0] * found.inflation
    H, y = rows.features[:, 0], rows.targets[:, 0]
    gpr = GaussianProcessRegressor(DotProduct(0.0, "fixed"), alpha=worth, optimizer=None).fit(H, y)
    mean, std = gpr.predict(np.eye(4), return_std=True)
    assert_allclose(found.mean, mean, rtol=1e-6)
    assert_allclose(np.sqrt(np.diag(found.covariance)), std, rtol=1e-5)
    assert found.noise[0].variance == pytest.approx(0.01, rel=0.2)


def test_intervals_hold_the_truth_of_correlated_rows():
    """The mean of eight neighbours as noise: rows say an eighth of what as many independent ones do."""
    rng, inside, naive = np.random.default_rng(0), [], []
    for seed in range(25):
        rows, prior, beta = problem(n=1600, noise=0.0, seed=seed)
        slow = np.repeat(rng.normal(size=(200, 2, 4)), 8, axis=0)
        noise = np.apply_along_axis(np.convolve, 0, rng.normal(size=(1607, 2)), np.full(8, 0.125), mode="valid")
        rows = replace(rows, features=slow, targets=slow @ beta + noise)
        found = identify(rows, prior)
        distance = np.abs(found.mean - beta) / np.sqrt(np.diag(found.covariance))
        inside.append(distance < 1.96)
        naive.append(distance * np.sqrt(found.inflation * found.correlation_time.mean()) < 1.96)
    assert 0.88 <= np.mean(inside) <= 1.0
    assert np.mean(naive) < 0.75  # as if rows were independent


def test_blocks_that_differ_more_than_noise_explains_widen_intervals():
    rows, prior, _ = problem(n=2000)
    found = identify(rows, prior)
    shifts = np.random.default_rng(1).normal(size=(5, 4))[rows.blocks]
    drifting = identify(replace(rows, targets=rows.targets + np.einsum("nop,np->no", rows.features, shifts)), prior)
    assert found.inflation < 2.0
    assert drifting.inflation > 20.0
    assert np.trace(drifting.covariance) > 20.0 * np.trace(found.covariance)


def test_weights_given_others_are_those_of_the_joint_normal():
    rows, prior, _ = problem(n=20)
    found = identify(rows, prior)
    cov = found.covariance
    first = found.mean[:2] + np.array([0.01, -0.02])
    expected = found.mean[2:] + cov[2:, :2] @ np.linalg.solve(cov[:2, :2], [0.01, -0.02])
    assert_allclose(found.given(first).mean, [*first, *expected], rtol=1e-9)


@pytest.mark.parametrize("gains", [None, np.array([1.1, 0.9])])
def test_condensed_rows_say_what_all_rows_said(gains):
    rows, prior, beta = problem(n=600, p=5, gains=gains, scaled=3)
    prior = with_gains(replace(prior, mean=beta, covariance=0.04 * np.eye(5)), 2, 0.0 if gains is None else 0.2)
    first, second = rows[rows.blocks < 3], rows[rows.blocks >= 3]
    alone = identify(first, prior)
    both = identify(second, prior, known=condensed(first, alone))
    all_rows = identify(rows, prior)
    # Noise and what rows are worth are estimated apart, so they agree up to their errors.
    assert_allclose(both.mean, all_rows.mean, atol=0.5 * np.sqrt(np.diag(all_rows.covariance).max()))
    assert_allclose(np.sqrt(np.diag(both.covariance)), np.sqrt(np.diag(all_rows.covariance)), rtol=0.3)
    # The squared errors of any weights are the same.
    known, some = condensed(first, alone), beta + 0.3
    scale = alone.inflation * alone.correlation_time * np.array([noise.variance for noise in alone.noise])
    expected = np.sum((first.targets - first.features @ some) ** 2 / scale)
    assert np.sum((known.targets - known.features @ some) ** 2) == pytest.approx(expected, rel=1e-8)


def test_rows_left_out_are_predicted_from_the_others():
    rows, prior, beta = problem()
    targets = rows.targets.copy()
    targets[rows.blocks == 2] += 100.0
    rows = replace(rows, targets=targets)
    found = np.empty_like(rows.targets)
    for fold in folds(rows, identify(rows, prior)):
        found[fold.out] = fold.torques[fold.out]
    truth = rows.features @ beta
    assert np.abs(found - truth)[rows.blocks == 2].max() < 0.5  # its own targets are not used
    alone = replace(rows, blocks=np.zeros(len(targets), dtype=int))
    (whole,) = folds(alone, identify(alone, prior))
    assert np.isfinite(whole.torques).all()


@pytest.mark.parametrize("gains", [None, np.array([1.1, 0.9])])
def test_prior_of_masses_is_never_narrowed(gains):
    rows, prior, beta = problem(n=600, p=5, gains=gains, scaled=3)
    groups = np.array(["inertia"] * 3 + ["friction"] * 2, dtype=object)
    # The weights are the prior mean, so that the learned scales would be small.
    prior = replace(prior, mean=beta, covariance=np.eye(5), groups=groups)
    prior = prior if gains is None else with_gains(prior, 2, 0.2)
    found = identify(rows, prior)
    assert_allclose(found.factors[:3], 1.0)
    assert found.factors[3:5].max() < 0.5
    # They get wider if the weights are far from the prior mean.
    narrow = replace(prior, mean=prior.mean + 1.0, covariance=0.01 * prior.covariance)
    assert identify(rows, narrow).factors[:5].min() > 3.0


def test_more_weights_change_nothing_where_their_columns_are_zero():
    rows, prior, _ = problem(gains=np.array([1.1, 0.9]))
    prior = with_gains(prior, 2, 0.2)
    found = identify(rows, prior)
    wider = replace(rows, features=np.concatenate([rows.features, np.zeros((400, 2, 3))], axis=2))
    with_three = identify(wider, with_others(prior, np.full(3, 4.0)))
    kept = [0, 1, 2, 3, 7, 8]
    assert_allclose(with_three.mean[kept], found.mean, rtol=1e-6)
    assert_allclose(with_three.covariance[np.ix_(kept, kept)], found.covariance, rtol=1e-5, atol=1e-12)
    assert_allclose(np.diag(with_three.covariance)[4:7], 4.0)


def test_surprise_is_that_of_the_prior_as_given_after_more_rounds():
    rows, prior, beta = problem()
    prior = replace(prior, mean=beta + np.array([5.0, 0.0, 0.0, 0.1]), covariance=np.diag([1.0, 1.0, 4.0, 1.0]))
    prior = replace(prior, groups=np.array(["a", "a", "b", "a"], dtype=object))
    first = identify(rows, prior)
    again = identify(rows, first.prior, start=first)
    assert again.surprise == pytest.approx(first.surprise, rel=0.02)


def test_effects_of_moves_are_integrated_out():
    rows, prior, beta = problem(n=60, n_outputs=1)
    weights = identify(rows, prior)
    effects = np.random.default_rng(1).normal(size=(60, 1, 2))
    known = condensed(rows, weights, effects)
    scale = weights.inflation * weights.correlation_time[0] * weights.noise[0].variance
    covariance = scale * np.eye(60)
    for move in np.unique(rows.groups):
        own = rows.groups == move
        covariance[np.ix_(own, own)] += effects[own, 0] @ effects[own, 0].T

    def square(some):
        error = rows.targets[:, 0] - rows.features[:, 0] @ some
        return error @ np.linalg.solve(covariance, error)

    for some in (beta, beta + 0.3):
        assert np.sum((known.targets - known.features @ some) ** 2) == pytest.approx(square(some), rel=1e-8)
