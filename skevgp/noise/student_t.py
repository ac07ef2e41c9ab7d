"""Noise with outliers: each row has a scale, whose posterior is known in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import expit, gammaln

from .base import Noise

# The noise of a row's o outputs is N(0, diag(σ²) v / τ) given τ, so that a row is an outlier in all its outputs. A
# Student-t with ν degrees of freedom has τ ~ Gamma(ν/2, ν/2) (Tipping & Lawrence 2005, "Variational inference for
# Student-t models"; Jylänki, Vanhatalo & Vehtari 2011, "Robust Gaussian process regression with a Student-t
# likelihood"). As the noise of all rows it reduces the weight of good rows too: with ν = 4, a row at 2 σ counts 0.6,
# and one at 3 σ 0.4. That costs 1 % of the error and 3 % of the NLPD on good rows whose noise is uneven (elevators). A
# learned ν falls below 2 if there are outliers, and weights fall further. So here a row has τ = 1, unless it is an
# outlier, with a probability ε. The noise of an outlier is a Student-t that is s times as wide:
#
#     p(τ) = (1 - ε) δ(τ - 1) + ε Gamma(ν/2, s² ν/2).
#
# Given q(g), the best q(τ) follows from d = Σ_o E(y - g)² / (σ² v). The integrals of p(τ) τ^(o/2) exp(-τ d/2) over the
# two parts are
#
#     ordinary: (1 - ε) exp(-d/2),    outlier: ε (s² ν/2)^(ν/2) Γ((ν + o)/2) / Γ(ν/2) ((s² ν + d)/2)^(-(ν + o)/2).
#
# Their shares are the probabilities of q, and τ of an outlier ~ Gamma((ν + o)/2, (s² ν + d)/2). All terms of the bound
# with τ add up to the logarithm of the sum of the two. In all other terms of the bound the row has the noise variance
# σ² v / E[τ], and log v is replaced by
#
#     log v - 2/o (log of the sum + ½ E[τ] d).

# ν, s and ε. With s = 10, outliers at 20 σ would cost 4 % of the NLPD if there are few rows.
_NU, _WIDTH, _SHARE = 4.0, 30.0, 1e-6


class StudentT(Noise):
    """Noise with outliers, for the argument ``noise`` of `EVGPRegressor`.

    Rows with an error of more than about six standard deviations are outliers. Their noise is a Student-t with 4
    degrees of freedom, thirty times as wide. The noise of all other rows is Gaussian. The attribute ``weights_`` of the
    regressor holds the weight of each row. ``std`` and ``noise_variance_`` are those of rows that are not outliers, and
    ``upper_bound_`` is inf.

    Memory grows with the number of rows. Dask arrays and Adam do not support this noise. See the user guide,
    :doc:`/guide/noise`.

    Parameters
    ----------
    variance : float, default=None
        Noise variance at the start of a fit, in squared units of y. If None, it is estimated from the data.

    References
    ----------
    - M. E. Tipping, N. D. Lawrence (2005): Variational Inference for Student-t Models.
    - P. Jylänki, J. Vanhatalo, A. Vehtari (2011): Robust Gaussian Process Regression with a Student-t Likelihood.

    Examples
    --------
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> y[3] += 50.0
    >>> model = EVGPRegressor(n_inducing=10, noise="student-t", random_state=0).fit(X, y)
    >>> bool(model.weights_[3] < 0.01)
    True
    """

    heavy_tails = True

    def __init__(self, variance: float | None = None):
        self.variance = variance

    def row_scales(self, n_outputs: int, distances: np.ndarray) -> StudentTScales:
        """Return the noise scales of rows, q(τ).

        Parameters
        ----------
        n_outputs : int
            Number of outputs o.
        distances : ndarray of shape (n_rows,)
            Distances d = Σ_o E(y - g)² / (σ² v) of each row.

        Returns
        -------
        scales : StudentTScales
            Scales with E[τ] and the probability of being an outlier.
        """
        return StudentTScales(n_outputs, distances)


@dataclass(frozen=True)
class StudentTScales:
    """q(τ) of n rows with o outputs."""

    n_outputs: int  # o
    distances: np.ndarray  # d, (n,)

    def __getstate__(self) -> dict[str, Any]:
        # Copies and pickles of a model hold no rows; new rows get their own distances.
        return {**vars(self), "distances": np.empty(0)}

    def at(self, distances: np.ndarray) -> StudentTScales:
        """Return q(τ) of rows with other d (n,)."""
        return StudentTScales(self.n_outputs, distances)

    @property
    def mean(self) -> np.ndarray:
        """E[τ], (n,): 1 for ordinary rows, and near 0 for outliers."""
        outlier = self.outlier
        return 1.0 - outlier + outlier * self._shape / self._rate

    @property
    def outlier(self) -> np.ndarray:
        """Probability (n,) of being an outlier."""
        return expit(self._log_outlier - self._log_ordinary)

    @property
    def evidence(self) -> np.ndarray:
        """Sum of the terms of the bound with τ, (n,)."""
        return np.logaddexp(self._log_ordinary, self._log_outlier)

    @property
    def log_variance(self) -> np.ndarray:
        """Addend to log v, (n,)."""
        return -2.0 / self.n_outputs * (self.evidence + 0.5 * self.mean * self.distances)

    @property
    def _shape(self) -> float:
        return 0.5 * (_NU + self.n_outputs)

    @property
    def _rate(self) -> np.ndarray:
        return 0.5 * (_WIDTH**2 * _NU + self.distances)

    @property
    def _log_ordinary(self) -> np.ndarray:
        return np.log1p(-_SHARE) - 0.5 * self.distances

    @property
    def _log_outlier(self) -> np.ndarray:
        prior = 0.5 * _NU
        constant = np.log(_SHARE) + prior * np.log(_WIDTH**2 * prior) - gammaln(prior) + gammaln(self._shape)
        return constant - self._shape * np.log(self._rate)
