"""Between the user's units and the internal ones, in which every number is of order one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..inference.bounds import CoefficientPrior
from ..inference.posterior import Posterior
from ..rows.internal import Rows
from ..rows.source import Moments, RawRows, Source
from .start import features_alone, unit_of


@dataclass(frozen=True)
class Frame:
    """What is subtracted from and divided out of the targets before inference, and where the inputs are.

    Attributes
    ----------
    centre : ndarray of shape (d,)
        Amid the kernel's inputs.
    target_mean : ndarray of shape (o,)
        Subtracted from y; part of the model (0 unless y is normalised).
    target_unit : ndarray of shape (o,)
        The size of what the features alone leave over.
    prior : CoefficientPrior
        In the user's units.
    """

    centre: np.ndarray
    target_mean: np.ndarray
    target_unit: np.ndarray
    prior: CoefficientPrior

    @classmethod
    def of(
        cls,
        source: Source,
        inputs: Moments,
        targets: Moments,
        target_mean: np.ndarray,
        coef_mean: np.ndarray,
        coef_scale: np.ndarray,
    ) -> Frame:
        """The frame of a training set, from its rows, moments of its columns, and the prior (o, p) of its weights."""
        reference, left_over = features_alone(source, target_mean, coef_mean, coef_scale)
        prior = CoefficientPrior(coef_mean, coef_scale, reference)
        # The mean of equal numbers may round; what differs from it must then be 0, not a column of tiny numbers.
        constant = inputs.highest - inputs.lowest <= 8.0 * np.finfo(float).eps * inputs.largest
        centre = np.where(constant, inputs.lowest, inputs.mean)
        return cls(centre, target_mean, unit_of(left_over, targets.largest), prior)

    def to_internal(self, raw: RawRows) -> RawRows:
        """Inputs, features, and what the reference leaves of the targets, in its own units."""
        left_over = raw.targets - self.target_mean - raw.features @ self.prior.offset.T
        return RawRows(raw.inputs, raw.features, left_over / self.target_unit)

    def rows(self, source: Source) -> Rows:
        """Rows in internal units."""
        return Rows(source, self.to_internal)

    def internal_prior(self) -> CoefficientPrior:
        """The prior for residuals in units of ``target_unit``."""
        unit = self.target_unit[:, np.newaxis]
        return CoefficientPrior(self.prior.mean / unit, self.prior.scale / unit, self.prior.reference)

    def log_unit(self, outputs: slice) -> float:
        """What one row of some outputs adds to the loss on the way to the user's units."""
        return float(np.log(self.target_unit[outputs]).sum())

    def posterior(self, parts: Sequence[Posterior]) -> Posterior:
        """Posteriors of consecutive outputs in internal units -> one in the user's, but for target_mean."""
        inducing, first = [], 0
        for part in parts:
            for group in part.inducing:
                width = group.outputs.stop - group.outputs.start
                inducing.append(replace(group, outputs=slice(first, first + width)))
                first += width
        return Posterior(
            parts[0].kernel,
            tuple(inducing),
            np.concatenate([part.signal for part in parts]) * self.target_unit**2,
            np.concatenate([part.noise for part in parts]) * self.target_unit**2,
            self.prior,
            tuple(mean for part in parts for mean in part.mean),
            tuple(root for part in parts for root in part.root),
        )
