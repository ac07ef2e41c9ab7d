from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import DotProduct

from skevgp.identification.weights import Prior, Rows, condensed, identify, left_out, with_gains


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


def test_weights_that_rows_do_not_show_stay_at_the_prior():
    rows, prior, _ = problem()
    features = rows.features.copy()
    features[:, :, 3] = 0.0
    mean = np.array([0.0, 0.0, 0.0, 5.0])
    found = identify(replace(rows, features=features), replace(prior, mean=mean))
    assert found.mean[3] == pytest.approx(5.0)
    assert found.covariance[3, 3] == pytest.approx(1.0)
    assert found.covariance[0, 0] < 1e-3


def test_intervals_hold_the_truth_of_correlated_rows():
    """The mean of eight neighbours as noise: rows say an eighth of what as many independent ones do."""
    rng, inside, naive = np.random.default_rng(0), [], []
    for seed in range(40):
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


def test_gains_between_outputs_are_found():
    gains = np.array([1.1, 0.9, 1.0])
    rows, prior, beta = problem(n_outputs=3, p=5, noise=0.01, gains=gains)
    prior = with_gains(replace(prior, mean=beta, covariance=0.01 * np.eye(5)), 3, 0.2)
    found = identify(rows, prior)
    assert_allclose(found.gains(3) / found.gains(3)[2], gains, rtol=0.01)
    assert_allclose(found.predict(rows.features), rows.targets, atol=0.1)
    # Their common size is only as well known as the weights were.
    assert found.covariance[5, 5] > 1e-4


def test_friction_is_in_the_units_of_what_was_measured():
    rows, prior, beta = problem(noise=1e-3, gains=np.array([2.0, 2.0]), scaled=2)
    known = replace(prior, mean=np.array([*beta[:2], 0.0, 0.0]), covariance=np.diag([1e-12, 1e-12, 1.0, 1.0]))
    found = identify(rows, with_gains(known, 2, 1.0))
    assert_allclose(found.gains(2), 2.0, rtol=1e-2)
    assert_allclose(found.mean[2:4], beta[2:], rtol=1e-2)


def test_variance_is_that_of_drawn_weights():
    rows, prior, beta = problem(n_outputs=2, noise=0.5, n=50, gains=np.array([1.0, 1.3]))
    found = identify(rows, with_gains(replace(prior, mean=beta, covariance=0.01 * np.eye(4)), 2, 0.01))
    drawn = np.random.default_rng(0).multivariate_normal(found.mean, found.covariance, 20_000)
    values = np.einsum("nop,sp->sno", rows.features[:5], drawn[:, :4]) * (1.0 + drawn[:, np.newaxis, 4:])
    assert_allclose(found.variance(rows.features[:5]), values.var(axis=0), rtol=0.1)


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
    found = left_out(rows, identify(rows, prior))
    truth = rows.features @ beta
    assert np.abs(found - truth)[rows.blocks == 2].max() < 0.5  # its own targets are not used
    alone = replace(rows, blocks=np.zeros(len(targets), dtype=int))
    assert np.isfinite(left_out(alone, identify(alone, prior))).all()


@pytest.mark.parametrize("noise", [0.0, 1e-12])
def test_noise_free_rows_and_prior_directions_without_variance(noise):
    rows, prior, beta = problem(noise=noise)
    found = identify(rows, replace(prior, mean=beta, covariance=np.diag([1.0, 1.0, 0.0, 0.0])))
    assert_allclose(found.mean, beta, rtol=1e-6)
    assert np.isfinite(found.covariance).all()
    assert (np.diag(found.covariance) >= 0.0).all()
    zero = identify(replace(rows, features=np.zeros_like(rows.features), targets=np.zeros_like(rows.targets)), prior)
    assert_allclose(zero.covariance, np.eye(4), atol=1e-12)
