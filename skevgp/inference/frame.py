"""Between the user's units and the internal ones, in which every number is of order one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .bounds import CoefficientPrior
from .posterior import Posterior
from .rows import Rows
from .start import features_alone, unit_of


@dataclass(frozen=True)
class Frame:
    """What is subtracted from and divided out of the data before inference.

    Attributes
    ----------
    centre : ndarray of shape (d,)
        Subtracted from the kernel's inputs.
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
        inputs: np.ndarray,
        features: np.ndarray,
        targets: np.ndarray,
        target_mean: np.ndarray,
        coef_mean: np.ndarray,
        coef_scale: np.ndarray,
    ) -> Frame:
        """The frame of a training set: inputs (n, d), features (n, p), targets (n, o), prior (o, p)."""
        residuals = targets - target_mean - features @ coef_mean.T
        reference = features_alone(features, residuals, coef_scale)
        prior = CoefficientPrior(coef_mean, coef_scale, reference)
        left_over = targets - target_mean - features @ prior.offset.T
        # The mean of equal numbers may round; what is left must then be 0, not a column of tiny numbers.
        constant = np.ptp(inputs, axis=0) <= 8.0 * np.finfo(float).eps * np.abs(inputs).max(axis=0)
        centre = np.where(constant, inputs[0], inputs.mean(axis=0))
        return cls(centre, target_mean, unit_of(left_over, targets), prior)

    def rows(self, inputs: np.ndarray, features: np.ndarray, targets: np.ndarray) -> Rows:
        """Rows in internal units."""
        left_over = targets - self.target_mean - features @ self.prior.offset.T
        return Rows(inputs - self.centre, features, left_over / self.target_unit)

    def internal_prior(self) -> CoefficientPrior:
        """The prior for residuals in units of ``target_unit``."""
        unit = self.target_unit[:, np.newaxis]
        return CoefficientPrior(self.prior.mean / unit, self.prior.scale / unit, self.prior.reference)

    def log_unit(self, outputs: slice) -> float:
        """What one row of some outputs adds to the loss on the way to the user's units."""
        return float(np.log(self.target_unit[outputs]).sum())

    def posterior(self, parts: Sequence[Posterior]) -> Posterior:
        """Posteriors of consecutive outputs in internal units -> one in the user's, but for centre and target_mean."""
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
