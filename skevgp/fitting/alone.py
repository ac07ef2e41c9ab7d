"""The features without a Gaussian process: the bound that a fit must reach, and the noise variances for it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..data.blocks import LinearSums
from ..data.rows import Rows
from ..model.bounds import bounds_alone
from ..model.exact import ExactModel
from ..model.model import SparseModel
from ..model.parameters import ParameterTable
from .rules import LOWEST_NOISE
from .runs import FeaturesAlone
from .units import noise_of_most_evidence

# Noise variances below this share of the prior sum of squares are lost in rounding.
_ROUNDING = 1e-13
# A negligible signal, as a share of a fixed one.
_NO_SIGNAL = 1e-12


def features_alone(
    table: ParameterTable, hidden: bool, best_with: Callable[[np.ndarray], tuple[float, np.ndarray]]
) -> FeaturesAlone:
    """The features with as little Gaussian process as the limits allow.

    ``best_with`` maps signal variances (o,) to the highest bound for them, and to its noise variances (o,). ``hidden``
    says whether the noise may be far above the residuals.
    """
    signal = table["signal"]
    bound, noise = best_with(np.where(signal.free, signal.value_limits()[:, 0], signal.start))
    most = -np.inf
    if hidden and not signal.free.all():
        # The cost of a fixed signal depends on the end of the kernel.
        most, _ = best_with(_NO_SIGNAL * signal.start)
    return FeaturesAlone(bound, noise, most, hidden)


def best_by_sums(
    sparse: SparseModel, table: ParameterTable, rows: Rows, sums: LinearSums, hidden: bool, signal: np.ndarray
) -> tuple[float, np.ndarray]:
    """The highest bound with q(f) at its prior of a given signal (o,), and the noise variances (o,) for it."""
    values, prior = table.values_at_start(), sparse.prior
    variance = np.empty(len(signal))
    for group, (outputs, points) in enumerate(zip(sparse.groups, values["inducing_points"], strict=True)):
        kernel, hyperparameters = sparse.kernel_of(values, group)
        variance[outputs] = np.mean(kernel.at(hyperparameters, points).diagonal(kernel.prepare(points)))
    trace = signal * variance * rows.total * rows.mean_precision
    lowest, highest = table["noise"].value_limits().T
    if not hidden:
        least = highest = np.clip(noise_left_over(rows, sums, trace), lowest, highest)
    else:
        # Directions without data have a precision of 1, which is lost in rounding next to large features.
        sizes = [scale**2 * np.diagonal(sums.of(slice(o, o + 1))[0]) for o, scale in enumerate(prior.scale)]
        unseen = [np.sort(of_output)[: max(len(of_output) - sums.length, 0)].sum() for of_output in sizes]
        least = np.maximum(lowest, _ROUNDING * np.array(unseen))

    def evidence(noise: np.ndarray) -> np.ndarray:
        return bounds_alone(sums, prior, noise, trace)

    return noise_of_most_evidence(evidence, least, highest, prior.shared)


def best_by_likelihood(
    exact: ExactModel, table: ParameterTable, hidden: bool, signal: np.ndarray
) -> tuple[float, np.ndarray]:
    """The highest likelihood for a signal (o,), and the noise variances (o,) for it."""
    rows, values = exact.rows, table.values_at_start()
    least, highest = table["noise"].value_limits().T
    if not hidden:
        least = highest = np.clip(np.average(rows.targets**2, axis=0, weights=rows.precision), least, highest)

    def evidence(noise: np.ndarray) -> np.ndarray:
        return exact.log_likelihoods(values | {"signal": signal, "noise": noise})

    return noise_of_most_evidence(evidence, least, highest, exact.prior.shared)


def noise_left_over(rows: Rows, sums: LinearSums, trace: np.ndarray | float = 0.0) -> np.ndarray:
    """Noise variances (o,) equal to the mean squared residuals of the features, plus a trace of f's prior."""
    return np.maximum((sums.RR + trace) / rows.total, LOWEST_NOISE * rows.mean_precision)
