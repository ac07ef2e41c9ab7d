"""Noise with a Student-t's tails as a mixture of Gaussians: each row has a scale, and q over it in closed form.

The noise of a row's o outputs is N(0, diag(σ²) v / τ) given its τ: a row is doubted as a whole. A Student-t with ν
degrees of freedom has τ ~ Gamma(ν/2, ν/2) (Tipping & Lawrence 2005, "Variational inference for Student-t models";
Jylänki, Vanhatalo & Vehtari 2011, "Robust Gaussian process regression with a Student-t likelihood"). As the noise of
all rows it doubts every row a little (with ν = 4 one at 2 σ counts 0.6, one at 3 σ 0.4), which on good rows whose noise
is uneven costs 1 % of the error and 3 % of the NLPD (elevators); and a ν that is learned falls below 2 where there are
outliers, and doubts even more. So here a row has τ = 1, but for an outlier, with a probability ε, whose noise is a
Student-t s times as wide:

    p(τ) = (1 - ε) δ(τ - 1) + ε Gamma(ν/2, s² ν/2).

With q(g) given, the best q(τ) follows from d = Σ_o E(y - g)² / (σ² v). The integrals of p(τ) τ^(o/2) exp(-τ d/2) over
the two parts are

    ordinary: (1 - ε) exp(-d/2),    outlier: ε (s² ν/2)^(ν/2) Γ((ν + o)/2) / Γ(ν/2) ((s² ν + d)/2)^(-(ν + o)/2);

their shares are q's, and an outlier's τ ~ Gamma((ν + o)/2, (s² ν + d)/2). All terms of the bound with τ add up to the
logarithm of their sum. To its other terms the row has the noise variance σ² v / E[τ], and in place of log v

    log v - 2/o (log of the sum + ½ E[τ] d).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import expit, gammaln

from ..utils.state import StatefulEstimator
from ..utils.validation import check_real

# ν, s and ε. (With an s of 10, outliers at 20 σ pull enough to cost 4 % of the NLPD where rows are few.)
_NU, _WIDTH, _SHARE = 4.0, 30.0, 1e-6


class StudentT(StatefulEstimator):
    """Noise with the tails of a Student-t, for ``noise=`` of `EVGPRegressor`: for data of which a few rows are wrong.

    Rows off by more than about six standard deviations are outliers. Their noise is a Student-t with 4 degrees of
    freedom, thirty times as wide; that of all other rows is Gaussian. A row is doubted as a whole, by the outputs that
    are fitted together, and ``weights_`` says how much it still counts. ``std`` and ``noise_variance_`` are those of
    rows that are no outliers, and no ``upper_bound_`` is known (inf).

    Memory grows with the rows. Not for Dask arrays or Adam. `partial_fit` doubts new rows, and keeps the doubts of
    earlier ones.

    Parameters
    ----------
    variance : float, default=None
        Noise variance at which a fit starts, in squared units of y. None takes it from the data.

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
    inputs = None

    def __init__(self, variance: float | None = None):
        self.variance = variance

    def check(self) -> None:
        """Refuse options that are out of range."""
        if self.variance is not None:
            check_real(self.variance, "variance of StudentT", minimum=0.0, strict=True)


@dataclass(frozen=True)
class RowScales:
    """q(τ) of n rows.

    Attributes
    ----------
    n_outputs : int
        o.
    distances : ndarray of shape (n,)
        d.
    """

    n_outputs: int
    distances: np.ndarray

    def __getstate__(self) -> dict[str, Any]:
        # The rows are in no copy or pickle of a model, and new ones get distances of their own.
        return {**vars(self), "distances": np.empty(0)}

    @property
    def mean(self) -> np.ndarray:
        """E[τ], (n,): 1 for ordinary rows, and near 0 for outliers."""
        outlier = self.outlier
        return 1.0 - outlier + outlier * self._shape / self._rate

    @property
    def outlier(self) -> np.ndarray:
        """The probability (n,) of being an outlier."""
        return expit(self._log_outlier - self._log_ordinary)

    @property
    def evidence(self) -> np.ndarray:
        """What the terms of the bound with τ sum up to, (n,)."""
        return np.logaddexp(self._log_ordinary, self._log_outlier)

    @property
    def log_variance(self) -> np.ndarray:
        """What is added to log v, (n,)."""
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
