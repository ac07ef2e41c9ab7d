"""What is known before there are data."""

from __future__ import annotations

import numpy as np

from ..inference.posterior import CoefficientPrior, Predictor, PredictorGroup
from ..inference.statistics import Whitening
from ..kernels.parse import KernelSpec
from ..rows.internal import Rows
from .start import centred_kernels, checked_variance


def prior_predictor(rows: Rows, spec: KernelSpec, prior: CoefficientPrior) -> Predictor:
    """The prior of y: a predictor without points.

    Parameters
    ----------
    rows : Rows
        Where it is used.
    spec : KernelSpec
        Of which nothing starts from the data (`KernelSpec.as_given`). Noise of which it says nothing is left out.
    prior : CoefficientPrior
        Of the weights, in the user's units.
    """
    o, p = prior.scale.shape
    starts, kernels = spec.starts, centred_kernels(spec.covariance, rows.inputs)
    assert starts.hyperparameters.value is not None
    assert starts.signal.value is not None
    hyperparameters, signal = starts.hyperparameters.value, np.repeat(starts.signal.value, o)
    noise = np.zeros(o) if starts.noise.value is None else np.repeat(starts.noise.value, o)
    nowhere, groups = np.empty((0, rows.inputs.mean.shape[-1])), []
    for index in range(o):
        own, kernel = slice(index, index + 1), kernels[index % len(kernels)]
        checked_variance(kernel, hyperparameters, rows.some(np.zeros(1, dtype=int)).of(own).inputs)
        groups.append(
            PredictorGroup.of(
                own,
                kernel,
                hyperparameters,
                nowhere,
                Whitening.of(kernel, hyperparameters, nowhere),
                signal[own],
                prior.outputs(own),
                [np.zeros(p)],
                [np.eye(p) if p else np.zeros((1, 0))],
            )
        )
    return Predictor(tuple(groups), noise, prior.mean, np.zeros(o), prior.shared)
