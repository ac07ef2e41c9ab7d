from dataclasses import replace

import numpy as np
import pytest

from skevgp.fitting import outliers
from skevgp.fitting.doubts import RowDoubts, look_at
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
    doubts = RowDoubts(StudentTScales(O, np.random.RandomState(1).uniform(0.0, 60.0, N)))
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
    doubts = RowDoubts(StudentTScales(O, np.zeros(N)))
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
