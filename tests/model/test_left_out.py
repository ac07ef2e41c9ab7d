"""What the other folds say of rows, against a posterior per fold from the data."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, solve_triangular

from skevgp.model.left_out import prior_of
from skevgp.model.predictor import CoefficientPrior

from ..oracle import left_out, problem, whitened


def refitted(model, values, rows, outputs, signal, noise, out, counts=None, relative=None):
    """Errors and variances of the first of some outputs, which share w: by QR of all rows but some, and the prior."""
    prior, n = model.prior, len(rows)
    counts, relative = (np.ones(n) if own is None else own for own in (counts, relative))
    stacked, targets, designs = [], [], []
    p, sizes, Ls = rows.features.shape[1], [], []
    for o in outputs:
        Z = values["inducing_points"][o % len(values["inducing_points"])]
        L, V = whitened(values["hyperparameters"], Z, rows.inputs)
        Ls.append((L, V))
        sizes.append(len(L))
    total = sum(sizes) + p
    for k, o in enumerate(outputs):
        P = np.zeros((n, total))
        first = sum(sizes[:k])
        P[:, first : first + sizes[k]] = np.sqrt(signal[k]) * Ls[k][1].T
        P[:, total - p :] = rows.features @ prior.roots()[o]
        root = np.sqrt(counts / (noise[k] * relative))[:, np.newaxis]
        stacked.append((P * root)[~out])
        targets.append((rows.residuals[:, [o]] * root)[~out, 0])
        designs.append(P)
    o = outputs[0]
    Q, R = np.linalg.qr(np.vstack([*stacked, np.eye(total)]))
    mean_before = np.append(np.zeros(total - p), -prior.reference[o])
    mean = solve_triangular(R, Q.T @ np.concatenate([*targets, mean_before]))
    design, V = designs[0][out], Ls[0][1][:, out]
    if model.variant.family == "full":
        latent = np.sum(solve_triangular(R, design.T, trans=1) ** 2, axis=0)
    else:
        # Diagonal in the coordinates (f_m, w) of the output, whatever is not known of other outputs.
        own = np.r_[0 : sizes[0], total - p : total]
        precision = np.linalg.inv(np.linalg.inv(R.T @ R)[np.ix_(own, own)])
        T = block_diag(np.linalg.inv(Ls[0][0]), np.eye(p))
        latent = np.sum((design[:, own] @ T) ** 2 / np.diagonal(T.T @ precision @ T), axis=1)
    unexplained = signal[0] * np.maximum(1.0 - np.sum(V**2, axis=0), 0.0)
    return rows.residuals[out, o] - design @ mean, latent + unexplained + noise[0] * relative[out]


def parts(n, n_folds, seed=3):
    return [np.sort(own) for own in np.array_split(np.random.RandomState(seed).permutation(n), n_folds)]


def assert_as_refitted(model, values, rows, folds, joint=False, rtol=1e-8, **weights):
    """At noise variances, and ratios of the signal to them, around and far from those of ``values``."""
    groups, n_outputs = left_out(model, values, rows, folds, **weights), len(values["noise"])
    where = [(group, index) for group in groups for index in range(len(group[0].group.noise))]
    relative = {}
    if weights:
        relative = {"counts": weights["counts"], "relative": weights["counts"] / weights["precision"]}
    for k, fold in enumerate(folds):
        out = np.isin(np.arange(len(rows)), fold)
        for o, (group, index) in enumerate(where):
            others = [other for other in range(n_outputs) if other != o] if joint else []
            known = prior_of(group[k].group, index)
            for other in others:
                known = known + where[other][0][k].says(where[other][1])
            noise = values["noise"][o] * np.array([1e-3, 1.0, 20.0])
            for ratio in 0.4 * values["signal"][o] / values["noise"][o] * np.array([5e-6, 1.0, 3e4]):
                found = group[k].predicted(index, ratio, noise, known)
                for i, n2 in enumerate(noise):
                    expected = refitted(
                        model,
                        values,
                        rows,
                        [o, *others],
                        [ratio * n2, *values["signal"][others]],
                        [n2, *values["noise"][others]],
                        out,
                        **relative,
                    )
                    for own, oracle in zip(found, expected, strict=True):
                        np.testing.assert_allclose(own[:, min(i, own.shape[1] - 1)], oracle, rtol=rtol, atol=1e-9)


@pytest.mark.parametrize(("features", "n_folds"), [(3, 2), (0, 3), (3, 30)])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_left_out_rows_are_predicted_as_by_refits_without_their_fold(family, shared, features, n_folds):
    model, rows, table = problem(family, shared, n=30, p=features)
    folds = parts(len(rows), n_folds)
    assert_as_refitted(
        model,
        table.values(table.start()),
        rows,
        folds if n_folds < 30 else folds[:2] + [np.sort(np.concatenate(folds[2:]))],
    )


@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_weights_of_rows_and_their_noise(family):
    model, rows, table = problem(family, n=30)
    rng = np.random.RandomState(1)
    counts, relative = rng.randint(1, 4, len(rows)).astype(float), rng.uniform(0.2, 3.0, len(rows))
    weights = {"counts": counts, "precision": counts / relative}
    assert_as_refitted(model, table.values(table.start()), rows, parts(len(rows), 3), **weights)


@pytest.mark.parametrize("joint", [True, False])
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("family", ["full", "diagonal"])
def test_correlated_weights_and_weights_that_outputs_share(family, shared, joint):
    model, rows, table = problem(family, shared, n=30)
    root = np.tril(0.3 + np.random.RandomState(2).rand(3, 3))
    prior = model.prior
    roots = np.array([root, root if joint else 2.0 * root])
    scale = np.sqrt(np.einsum("oij,oij->oi", roots, roots))
    reference = np.repeat(prior.reference[:1], 2, axis=0) if joint else prior.reference
    model = replace(model, prior=CoefficientPrior(prior.mean, scale, reference, roots, joint))
    assert_as_refitted(model, table.values(table.start()), rows, parts(len(rows), 3), joint=joint)


@pytest.mark.parametrize("noise", [1e-4, 1e-8])
def test_feature_of_one_fold_and_a_wide_prior_cost_no_digits(noise):
    """Its sums over the other folds, as differences from those of all rows, would be rounding errors."""
    model, rows, table = problem(n=200)
    rows.features[:, 0] *= np.where(np.arange(200) < 40, 1e3, 1e-6)
    rows.features[:, 1] *= 1e3
    prior = CoefficientPrior(model.prior.mean, np.full((2, 3), 1e6), np.zeros((2, 3)))
    model = replace(model, prior=prior)
    values = table.values(table.start()) | {"noise": np.full(2, noise), "signal": np.ones(2)}
    folds = np.split(np.arange(200), 5)
    ((*each,),) = left_out(model, values, rows, folds)
    total, expected = 0.0, 0.0
    for fold, own in zip(folds, each, strict=True):
        error, variance = own.predicted(0, 1.0 / noise, np.array([noise]))
        total += np.sum(error**2 / variance)
        error, variance = refitted(model, values, rows, [0], [1.0], [noise], np.isin(np.arange(200), fold))
        expected += np.sum(error**2 / variance)
    np.testing.assert_allclose(total, expected, rtol=1e-5)
