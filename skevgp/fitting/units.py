"""Between the user's units and the internal ones, in which every residual is of order one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..inference.bounds import CoefficientPrior
from ..inference.posterior import Predictor
from ..rows.internal import Rows
from ..rows.source import Columns, Moments, RawRows, Source
from ..rows.threads import BlockMap
from .start import features_alone, unit_of


@dataclass(frozen=True)
class Units:
    """What is subtracted from and divided out of the targets before inference.

    Attributes
    ----------
    target_mean : ndarray of shape (o,)
        Subtracted from y; part of the model (0 unless y is normalised).
    target_unit : ndarray of shape (o,)
        The size of what the features alone leave over.
    prior : CoefficientPrior
        In the user's units.
    """

    target_mean: np.ndarray
    target_unit: np.ndarray
    prior: CoefficientPrior

    @classmethod
    def of(
        cls,
        source: Source,
        targets: Moments,
        target_mean: np.ndarray,
        coef_mean: np.ndarray,
        coef_scale: np.ndarray,
    ) -> Units:
        """The units of a training set, from its rows, its targets' moments, and the prior (o, p) of its weights."""
        reference, left_over = features_alone(source, target_mean, coef_mean, coef_scale)
        prior = CoefficientPrior(coef_mean, coef_scale, reference)
        return cls(target_mean, unit_of(left_over, targets.largest), prior)

    def to_internal(self, raw: RawRows) -> RawRows:
        """The same inputs and features, and what the reference leaves of the targets, in its own units."""
        left_over = raw.targets - self.target_mean - raw.features @ self.prior.offset.T
        return replace(raw, targets=left_over / self.target_unit)

    def rows(self, source: Source, threads: BlockMap | None = None) -> Rows:
        """Rows in internal units."""
        return Rows(source, self.to_internal, threads=BlockMap() if threads is None else threads)

    def internal_prior(self) -> CoefficientPrior:
        """The prior for residuals in units of ``target_unit``."""
        unit = self.target_unit[:, np.newaxis]
        return CoefficientPrior(self.prior.mean / unit, self.prior.scale / unit, self.prior.reference)

    def log_unit(self, outputs: Columns) -> float:
        """What one row of some outputs adds to the loss on the way to the user's units."""
        return float(np.log(self.target_unit[outputs]).sum())

    def predictor(self, parts: Sequence[Predictor], outputs: Sequence[list[int]]) -> Predictor:
        """Predictors of some outputs each, in internal units -> one of all in the user's."""
        return Predictor.joined(parts, outputs, self.target_unit, self.prior.offset, self.target_mean)
