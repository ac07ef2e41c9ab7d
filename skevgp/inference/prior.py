"""The prior of the weights of explicit features."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..rows.source import Columns


@dataclass(frozen=True)
class CoefficientPrior:
    """β ~ N(mean, C Cᵀ) for each output, and the reference that residuals are taken from.

    Attributes
    ----------
    mean, scale : ndarray of shape (o, p)
        With ``scale`` the standard deviations.
    reference : ndarray of shape (o, p)
        w₀: residuals are y - H (mean + C w₀).
    root : ndarray of shape (o, p, p), optional
        C; None means diag(scale), independent weights.
    shared : bool, default=False
        Whether all outputs have the same w, and with it the same β in the user's units: rows of the arrays then differ
        by the outputs' units only.
    """

    mean: np.ndarray
    scale: np.ndarray
    reference: np.ndarray
    root: np.ndarray | None = None
    shared: bool = False

    @property
    def offset(self) -> np.ndarray:
        """The coefficients (o, p) that the residuals are taken from."""
        return self.mean + self.times(self.reference)

    def times(self, w: np.ndarray) -> np.ndarray:
        """C w of each output, (o, p)."""
        return self.scale * w if self.root is None else np.einsum("oij,oj->oi", self.root, w)

    def roots(self) -> np.ndarray:
        """C of each output, (o, p, p)."""
        return self.scale[:, :, np.newaxis] * np.eye(self.scale.shape[1]) if self.root is None else self.root

    def outputs(self, columns: Columns) -> CoefficientPrior:
        """The prior of some of the outputs."""
        return CoefficientPrior(
            self.mean[columns],
            self.scale[columns],
            self.reference[columns],
            None if self.root is None else self.root[columns],
            self.shared,
        )

    def scaled(self, factor: np.ndarray) -> CoefficientPrior:
        """The prior of β times ``factor`` (o,), with the same w."""
        by = factor[:, np.newaxis]
        root = None if self.root is None else self.root * by[:, np.newaxis]
        return replace(self, mean=self.mean * by, scale=self.scale * by, root=root)
