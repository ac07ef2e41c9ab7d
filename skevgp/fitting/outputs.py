"""Run the fits of all outputs, and collect what is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..data.threads import BlockMap, side_by_side
from ..utils.monitor import Monitor
from .advice import interrupted
from .fitted import FittedOutputs
from .learned import Learned
from .outliers import fit_doubting
from .plan import Request, models_of, plan
from .sparse import SparseTask, grown
from .strategy import Fit, search


def fit_outputs(
    request: Request, rng: np.random.RandomState, monitor: Monitor, previous: FittedOutputs | None = None
) -> FittedOutputs:
    """Place inducing points and maximise the bound of each model.

    Parameters
    ----------
    request : Request
    rng : RandomState
        Places inducing points, draws mini-batches and restarts.
    monitor : Monitor
        Told of each iteration's loss, in the user's units.
    previous : FittedOutputs, default=None
        Start where this one ended, as far as shapes agree.

    Returns
    -------
    fitted : FittedOutputs
    """
    models = models_of(request)
    # One model has all threads for its blocks of rows; several have one each.
    at_once = min(request.n_threads, len(models))
    threads = BlockMap(request.n_threads if len(models) == 1 else 1)
    try:
        tasks = plan(request, rng, monitor, threads, previous)
        # Of the time that is left each has a share when its turn comes.
        turns = [(task, 1.0 / -(-(len(models) - i) // at_once)) for i, task in enumerate(tasks)]
        learned = side_by_side(_fit_one, turns, at_once, monitor)
    finally:
        threads.close()
    messages = sorted({one.message for one in learned if one.message})
    if monitor.stopped or monitor.out_of_time:
        n_iter, max_time = max(len(one.loss_curve) for one in learned), None if monitor.stopped else monitor.max_time
        messages = [interrupted(n_iter, max_time)]
    return FittedOutputs(
        request.units, [model.outputs for model in models], request.found, tuple(learned), tuple(messages)
    )


def _fit_one(turn: tuple[SparseTask, float]) -> Learned:
    task, share = turn
    # A copy, with which the blocks of rows are forgotten.
    task = replace(task, monitor=task.monitor.with_time(share))
    if task.heavy_tails:
        return fit_doubting(task, _best)
    return Learned.of(task, search(task)) if task.placement.max_inducing is None else Learned.of(*grown(task))


def _best(task: SparseTask) -> tuple[SparseTask, Fit]:
    return (task, search(task)) if task.placement.max_inducing is None else grown(task)
