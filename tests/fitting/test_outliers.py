from dataclasses import replace

import numpy as np
import pytest

from skevgp.fitting import outliers
from skevgp.fitting.doubts import Look, RowDoubts, look_at
from skevgp.fitting.outliers import settle
from skevgp.fitting.runs import Start, better
from skevgp.model.bounds import Variant
from skevgp.noise import StudentT
from skevgp.noise.student_t import StudentTScales

from .cases import N, O, Y, data_of, model_of

BAD = np.array([3, 17, 40])


def wrong_at_three(**changes):
    """With rows of which three are far off."""
    wrong = Y.copy()
    wrong[BAD] += 6.0 * Y.std(axis=0)
    return model_of(**data_of(wrong), **changes, noise=StudentT())


@pytest.mark.parametrize("changes", [{}, {"variant": Variant("diagonal")}, {"sharing": "kernel"}], ids=str)
def test_no_turn_lowers_the_bound(changes):
    model = wrong_at_three(max_iter=10, **changes)
    rows = model.rows
    doubts = RowDoubts(StudentTScales(O, np.random.RandomState(1).uniform(0.0, 60.0, N)), np.ones(O))
    weighed = replace(model, rows=doubts.weigh(rows))
    fit = weighed.minimise(Start(model.table.values_at_start(), 10))
    for _ in range(4):
        weighed, settled, doubts = settle(weighed, fit, rows, doubts)
        assert settled.bound >= fit.bound - 1e-8 * abs(fit.bound)
        further = better(settled, weighed.minimise(Start(settled.values, settled.n_iter + 5, settled)))
        assert further.bound >= settled.bound
        fit = further


def test_bound_of_doubted_rows_has_the_evidence_of_their_scales():
    """With q(τ) at its optimum the terms with τ are the evidence: the bound from matrices, less what stands for it."""
    model = wrong_at_three()
    rows = model.rows
    fit = model.minimise(Start(model.table.values_at_start(), 0))
    doubts = RowDoubts(StudentTScales(O, np.zeros(N)), np.ones(O))
    for _ in range(20):
        model, fit, doubts = settle(model, fit, rows, doubts)
    scales, noise = doubts.scales, fit.values["noise"]
    (statistics,) = model.sparse.statistics(fit.values, model.blocks)
    assert statistics.log_variance == pytest.approx(scales.log_variance.sum())
    look = look_at(rows, outliers.predictor_at(model, fit.values))
    # Less the divergence of q(g): what depends on the rows.
    expected = scales.evidence.sum() - 0.5 * N * np.log(2.0 * np.pi * noise).sum()
    found = -0.5 * (scales.mean @ look.distances(noise) + N * np.log(2.0 * np.pi * noise).sum())
    assert found - 0.5 * O * statistics.log_variance == pytest.approx(expected, rel=1e-3)


def test_variance_of_clean_rows_is_theirs():
    rng = np.random.RandomState(0)
    errors = rng.randn(4000, 2) * [1.0, 10.0]
    bad = rng.rand(4000) < 0.05
    look = Look(errors, np.zeros_like(errors), np.ones(4000), np.ones(4000))
    np.testing.assert_allclose(look.clean_variance(look.beyond(look.typical)), (errors**2).mean(axis=0), rtol=1e-12)
    spoiled = replace(look, errors=errors + 20.0 * bad[:, np.newaxis] * [1.0, 10.0])
    clean = spoiled.clean_variance(spoiled.beyond(spoiled.typical))
    np.testing.assert_allclose(clean, [1.0, 100.0], rtol=0.05)
    twice = replace(spoiled, variance=np.full(4000, 2.0), counts=np.full(4000, 3.0))
    np.testing.assert_allclose(twice.clean_variance(twice.beyond(twice.typical)), 0.5 * clean)
