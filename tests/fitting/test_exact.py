"""The exact model's fit: units of its likelihood, where it starts, what it refuses and says."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from skevgp.fitting import rules
from skevgp.fitting.fit import fit_model
from skevgp.fitting.inducing import Placement
from skevgp.fitting.search import search
from skevgp.model.exact import ExactModel, LikelihoodObjective
from skevgp.solvers import LBFGS
from skevgp.utils.monitor import Monitor

from .cases import H, N, Y, models, problem_of, units_of

KERNEL = ConstantKernel(1.4, (0.1, 200.0)) * RBF([0.9, 1.6], [(0.1, 9.0), (0.2, 8.0)]) + WhiteKernel(0.2)


def fitted(kernel=KERNEL, H=H, Y=Y, vague=False, max_iter=0, n_restarts=0, monitor=None, tol=0.01):
    vague = np.broadcast_to(vague, (Y.shape[1], H.shape[1]))
    fit = {"placement": Placement("all rows", 0), "solver": LBFGS(n_restarts=n_restarts), "tol": tol}
    problem = problem_of(kernel=kernel, H=H, Y=Y, vague=vague, max_iter=max_iter, **fit)
    return fit_model(problem, np.random.RandomState(0), Monitor() if monitor is None else monitor)


@pytest.mark.parametrize(
    ("vague", "contrasts"), [(False, [N, N]), (True, [N - 2, N - 2]), ([[True, False], [False, False]], [N - 1, N])]
)
def test_each_contrast_has_a_unit(vague, contrasts):
    done = fitted(vague=vague)
    expected = np.dot(contrasts, np.log(units_of().target_unit))
    assert done.models[0].bound - done.lower_bound == pytest.approx(expected)


def test_features_that_rows_cannot_tell_apart_are_refused_if_nothing_is_known_of_their_weights():
    twice = np.column_stack([H[:, 0], 2.0 * H[:, 0]])
    with pytest.raises(
        ValueError, match=r"An infinite scale .* needs .* 2 features have an infinite scale, but only 1 of them"
    ):
        fitted(H=twice, vague=True)
    assert np.isfinite(fitted(H=twice, vague=[[True, False], [False, True]]).lower_bound)


def test_convergence_warnings_of_exact_fit():
    assert fitted(max_iter=200).messages == ()
    (message,) = fitted(max_iter=1, tol=1e-9).messages
    assert "likelihood was still rising after max_iter=1" in message


def test_y_far_from_its_prior_mean_is_told_but_a_vague_weight_has_none():
    """An intercept that explains it, and of which nothing is known, is as near as can be."""
    far = Y + 1e3
    assert any("prior standard deviations away" in message for message in fitted(Y=far, max_iter=50).messages)
    assert not any("prior" in message for message in fitted(Y=far, max_iter=50, vague=True).messages)


def test_fit_that_begins_on_a_sample_ends_at_the_likelihood_of_all_rows(monkeypatch):
    """A sample's objective is the likelihood of its rows. The fit to all rows ends as high as one without a sample."""
    monkeypatch.setattr(rules, "RULES", replace(rules.RULES, few_rows=0.0))
    (model,) = models(kernel=KERNEL, placement=Placement("all rows", 0), max_iter=200, tol=0.01)
    assert model.is_exact
    assert model.samples == ()
    plain = search(model)
    monkeypatch.setattr(rules, "RULES", replace(rules.RULES, exact_sample=(25, 1)))
    (model,) = models(kernel=KERNEL, placement=Placement("all rows", 0), max_iter=200, tol=0.01)
    assert model.samples == (25,)
    sample = model._sample.some(np.arange(25))
    expected = LikelihoodObjective(ExactModel.of(model.sparse, model.vague, sample), model.table)
    x = model.table.start()
    for found, wanted in zip(model.objective(model.table, 25)(x), expected(x), strict=True):
        np.testing.assert_array_equal(found, wanted)
    fit = search(model)
    assert fit.n_rows is None
    assert fit.bound > plain.bound - 0.05
    assert fit.bound == pytest.approx(model.exact.log_likelihoods(fit.values).sum(), rel=1e-9)
