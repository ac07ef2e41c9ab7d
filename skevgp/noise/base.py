"""The interface of noise models."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..utils.state import StatefulEstimator
from ..utils.validation import check_real


class Noise(StatefulEstimator):
    """A noise model with its options."""

    # Whether rows have scales that the fit estimates. A subclass then has the method `row_scales`, which returns q(τ)
    # for a number of outputs and d = Σ_o E(y - g)² / (σ² v) of each row, (n,).
    heavy_tails: ClassVar[bool] = False
    row_scales: Callable[[int, np.ndarray], RowScales]

    # Noise variance at the start of a fit. None: taken from the data.
    variance: float | None
    # Noise of X, as `Gaussian` takes it.
    inputs: ArrayLike | None = None

    def check(self) -> None:
        """Raise an error if an option is out of range."""
        if self.variance is not None:
            check_real(self.variance, f"variance of {type(self).__name__}", minimum=0.0, strict=True)


class RowScales(Protocol):
    """q(τ) of n rows, whose noise variance is σ² v / τ."""

    @property
    def mean(self) -> np.ndarray:
        """E[τ], (n,): about 1 for rows without an error (d = 0), and finite for all."""

    @property
    def outlier(self) -> np.ndarray:
        """Probability (n,) of being an outlier."""

    @property
    def log_variance(self) -> np.ndarray:
        """Addend to log v in the bound, (n,)."""

    def at(self, distances: np.ndarray) -> RowScales:
        """Return q(τ) of rows with other d (n,)."""
