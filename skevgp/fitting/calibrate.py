"""Signal and noise variance under which rows that were left out are predicted as well as possible, std included.

The bound counts every row as new knowledge. Rows of a trajectory are alike, and what a sparse model cannot represent is
alike in all of them: the noise that the bound likes best, and with it the standard deviation of predictions, is too
small for new trajectories. And what inducing points cannot represent is noise to the bound, while predictions count it
twice: of independent rows the noise is too large. So folds of rows are left out one after the other (Rasmussen &
Williams 2006, section 5.4.2: cross-validation), with kernel and inducing points as they are, and each output's signal
and noise variance are where this is highest:

    mean over rows left out of log N(r | mean, variance)  -  ½ log rms of (r - mean)  +  log prior / number of rows,

with a prior that is log-normal around what the bound found: where the rows left out say nothing, all stays. (Density
alone would give the mean away where rows are uncertain anyway.) What predicts rows left out is in `left_out`.

Groups, such as trajectories, are few: how far a new one may be from all is hardly known from a fold of them. So the
signal, by which std grows away from the data, does not fall, unless nothing of what was learned holds for groups left
out; and both variances are widened by Student's t, for as many degrees of freedom as the groups' own errors leave.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..data.internal import Rows
from ..model.bounds import bounds_at_optimum, projected
from ..model.model import SparseModel
from ..model.parameters import ParameterTable, Values
from ..model.statistics import SufficientStatistics, collect
from ..utils.linalg import NotPositiveDefiniteError
from .calibration_search import Limits, Search
from .folds import CrossValidation, Fold, folds_in_order, follow_a_path
from .left_out import LeftOut, Seen, Weights, prior_of, sums_of_others

# The noise is no lower than this share of the square of what the model leaves over of its own rows: inducing points are
# where they are because of all rows, also of those that are left out.
_LEFT_OVER = 0.4
# Random folds are of no more rows than this.
_MOST_ROWS = 50_000
# The signal's limits in a fit are so many times wider here, if they are not the user's.
_WIDER = 1e4
# Rows depend on those near them if the noise by blocks of consecutive rows is so many times that by random folds. So do
# rows along a path if log density by blocks is so much lower, in nats per row. (Of a sorted table it may be, too: there
# blocks are where no other rows are.)
_DEPENDENT, _WORSE = 4.0, 0.1
# Of so many rows that can be seen.
_FEWEST_DEPENDENT = 200
# A noise that is no more than so many times its lower limit is as good as none.
_NOISELESS = 1.1
# What explained more than so much of an output holds for no other group if it gains less than this, in nats per row
# that was left out.
_EXPLAINED, _GAIN = 0.5, 0.01


@dataclass(frozen=True)
class Calibrated:
    """What came of it.

    Attributes
    ----------
    signal, noise : ndarray of shape (o,)
        s² and σ².
    gone : int
        Outputs of which nothing that was learned holds for groups that were left out.
    dependent : bool
        Whether rows near each other are alike.
    """

    signal: np.ndarray
    noise: np.ndarray
    gone: int = 0
    dependent: bool = False


def calibrated(
    model: SparseModel,
    values: Values,
    statistics: list[SufficientStatistics],
    table: ParameterTable,
    rows: Rows,
    by: CrossValidation,
    seed: int,
) -> Calibrated | None:
    """The signal and noise variances of each output; None if none is free, there are too few rows, or it fails.

    Parameters
    ----------
    model : SparseModel
    values : dict
        As in `SparseModel.at_optimum`.
    statistics : list of SufficientStatistics
        Of all rows, for these values.
    table : ParameterTable
        What is free, within which limits.
    rows : Rows
    by : CrossValidation
    seed : int
        Draws folds.
    """
    rng = np.random.RandomState(seed)
    if by.groups is None and len(rows) > _MOST_ROWS:
        # So many tell as much, and what says which rows are where does not grow with them.
        rows = rows.some_of(np.unique(np.linspace(0, len(rows) - 1, _MOST_ROWS).astype(int)), 1.0)
    folds = by.folds(rows.as_given(), rng)
    if len(folds) < 2 or not any(table[name].free.any() for name in ("signal", "noise")):
        return None
    try:
        return _by_folds(model, values, statistics, table, rows, by, folds, rng)
    except NotPositiveDefiniteError:
        # All rows could be learned from; fewer need not be.
        return None


def _by_folds(
    model: SparseModel,
    values: Values,
    statistics: list[SufficientStatistics],
    table: ParameterTable,
    rows: Rows,
    by: CrossValidation,
    folds: list[Fold],
    rng: np.random.RandomState,
) -> Calibrated:
    limits, lowest = Limits.of(table, _WIDER if by.wide else 1.0), _left_over(model, values, statistics)
    first = limits.with_signal_above(values["signal"])
    if by.groups is None:
        # Without noise, errors still fall where the signal rises, and std rises with it: it stays where it is.
        noiseless = values["noise"] <= _NOISELESS * limits.noise[:, 0]
        first = limits.with_signal_below(np.where(noiseless, values["signal"], np.inf))
    searches = _searches(model, values, folds, rows, first, _LEFT_OVER * lowest)
    found = list(rows.threads(Search.best, searches))
    # Rows left out of an output that does not vary say nothing of its variances.
    still, at_bound = rows.still(), np.column_stack([values["signal"], values["noise"]])
    gone, dependent = 0, False
    if by.groups is not None:
        explained = (values["noise"] < (1.0 - _EXPLAINED) * rows.scatter()) & ~still
        for own, is_explained in zip(searches, explained, strict=True):
            little = own.without_signal() - _GAIN
            if own.loss(*found[own.output]) > little:
                # All of it does not hold for groups left out; perhaps some does.
                found[own.output] = own.with_limits(limits, own.lowest).best()
                gone += int(is_explained and own.loss(*found[own.output]) > little)
        groups = [by.groups[fold.predicted] for fold in folds]
        found = [own.times(own.in_doubt(*best, groups), *best) for own, best in zip(searches, found, strict=True)]
    elif limits.free_noise and len(rows) >= _FEWEST_DEPENDENT:
        dependent = _dependent(model, values, rows, by, rng, searches, found, lowest)
    signal, noise = np.where(still[:, np.newaxis], at_bound, found).T
    return Calibrated(signal, noise, gone, dependent)


def _dependent(
    model: SparseModel,
    values: Values,
    rows: Rows,
    by: CrossValidation,
    rng: np.random.RandomState,
    searches: list[Search],
    found: list[tuple[float, float]],
    lowest: np.ndarray,
) -> bool:
    """Whether rows near each other are alike: left out in blocks, they are predicted worse than by ``searches``."""
    order = rows.as_given()
    alone = replace(searches[0].limits, free_signal=False)
    blocks = _searches(model, values, folds_in_order(order, by.n_folds, rng), rows, alone, lowest)
    worse = [block.loss(*best) - own.loss(*best) for block, own, best in zip(blocks, searches, found, strict=True)]
    if max(worse) > _WORSE and follow_a_path(order, lambda some: rows.some(some).inputs):
        return True
    chance = [search.with_limits(alone, lowest[search.output]) for search in searches]
    each = (np.array([noise for _, noise in rows.threads(Search.best, own)]) for own in (blocks, chance))
    return bool((next(each) > _DEPENDENT * next(each)).any())


def _left_over(model: SparseModel, values: Values, statistics: list[SufficientStatistics]) -> np.ndarray:
    """The square (o,) of what the model leaves over of its own rows, per degree of freedom."""
    found = np.empty(len(values["noise"]))
    for bound in bounds_at_optimum(list(model.groups_of(values, statistics)), model.family):
        group = bound.group
        n_rows = group.statistics.n_rows
        # Rows less the trace of I - B⁻¹, the weights that they determine.
        freedom = [n_rows - len(q.B) + np.vdot(q.root_inv, q.root_inv) for q in bound.posteriors]
        if group.prior.shared:
            # Other outputs determine them, too: the trace of σ⁻² Pᵀ P B⁻¹.
            for o, q in enumerate(bound.posteriors):
                own = q.root_inv @ projected(group, o)[0] @ q.root_inv.T
                freedom[o] = n_rows - own.trace() / group.noise[o]
        found[group.outputs] = bound.residuals().squares / np.maximum(freedom, 1e-6 * n_rows)
    return found


def _searches(
    model: SparseModel, values: Values, folds: Sequence[Fold], rows: Rows, limits: Limits, lowest: np.ndarray
) -> list[Search]:
    """For each output, in order: a pass over the rows for each group."""
    m, share = values["inducing_points"].shape[1], 1.0 / len(folds)
    all_of = [model.blocks(rows.some_of(fold.rows, share), m) for fold in folds]
    predicted = [model.blocks(rows.some_of(fold.predicted, share), m) for fold in folds]
    each = []
    for outputs, whitening in zip(model.groups, model.whitenings(values), strict=True):
        of_others = sums_of_others([collect(fold, whitening, outputs) for fold in all_of])
        seen = [fold.sum(Seen(whitening, outputs)) for fold in predicted]
        groups = [model.group(values, outputs, whitening, others) for others in of_others]
        each.append([LeftOut(group, model.family, own) for group, own in zip(groups, seen, strict=True)])
    known: list[list[Weights | None]] = [[None] * len(folds)] * len(values["noise"])
    if model.prior.shared:
        known = _known_elsewhere(each)
    searches: list[Search] = []
    for group in each:
        for index in range(len(group[0].group.noise)):
            o = len(searches)
            searches.append(Search(o, index, group, known[o], values, limits, float(lowest[o])))
    return searches


def _known_elsewhere(groups: Sequence[Sequence[LeftOut]]) -> list[list[Weights | None]]:
    """Of each output: what its prior and the other outputs, as fitted, say of the weights without each fold."""
    outputs = [(group, index) for group in groups for index in range(len(group[0].group.noise))]
    told = [[fold.says(index) for fold in group] for group, index in outputs]
    found: list[list[Weights | None]] = []
    for o, (group, index) in enumerate(outputs):
        own: list[Weights | None] = []
        for k, fold in enumerate(group):
            others = (each[k] for j, each in enumerate(told) if j != o)
            own.append(sum(others, start=prior_of(fold.group, index)))
        found.append(own)
    return found
