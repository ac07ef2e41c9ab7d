"""The sparse model of some outputs on some rows: θ -> bound and gradient, θ -> posterior."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._linalg import jittered_cholesky, triangular_inverse
from ..rows.blocks import Blocks
from .bounds import BoundAtOptimum, CoefficientPrior, PosteriorFamily
from .posterior import InducingSet, Posterior
from .statistics import Kernel, SufficientStatistics, collect

# Relative to the signal variance. k(X_m, X_m) from exact differences is accurate to about m times 1e-16.
JITTER = 1e-12

Values = dict[str, np.ndarray]


@dataclass(frozen=True)
class SparseModel:
    """Covariance, prior and family of q: all that a bound needs but the rows and the parameters.

    Attributes
    ----------
    kernel : Kernel
        k̃, of unit signal variance, with hyperparameters common to all outputs.
    prior : CoefficientPrior
        Of o outputs.
    family : {"full", "diagonal"}
    groups : tuple of slice
        The outputs that each set of inducing points serves.
    """

    kernel: Kernel
    prior: CoefficientPrior
    family: PosteriorFamily
    groups: tuple[slice, ...]

    def statistics(self, values: Values, rows: Blocks) -> list[SufficientStatistics]:
        """The statistics of all outputs for each set of inducing points."""
        return [collect(rows, at, L_inv) for at, _, L_inv in self.factors(values)]

    def at_optimum(self, values: Values, statistics: list[SufficientStatistics]) -> tuple[float, Posterior]:
        """The bound and the posterior with q at its optimum.

        Parameters
        ----------
        values : dict
            Of ``hyperparameters``, ``signal``, ``noise`` and ``inducing_points``.
        statistics : list of SufficientStatistics
            What `statistics` returns for these values.

        Returns
        -------
        bound : float
        posterior : Posterior
        """
        total, mean, root = 0.0, [], []
        for own, outputs, (_, L, L_inv) in zip(statistics, self.groups, self.factors(values), strict=True):
            bound = self.bound(own, outputs, values["signal"], values["noise"], L, L_inv)
            total += bound.value(bound.residuals())
            for q in bound.posteriors:
                mean.append(q.mean)
                root.append(q.root_inv if self.family == "full" else diagonal_root(*log_variances(q.B, L_inv), L_inv))
        return total, self.posterior(values, mean, root)

    def posterior(self, values: Values, mean: Sequence[np.ndarray], root: Sequence[np.ndarray]) -> Posterior:
        """Put q(ω), with covariance rootᵀ root, together with the parameters."""
        sets = tuple(
            InducingSet(np.log(values["hyperparameters"]), points, L_inv, outputs)
            for points, outputs, (_, _, L_inv) in zip(
                values["inducing_points"], self.groups, self.factors(values), strict=True
            )
        )
        return Posterior(self.kernel, sets, values["signal"], values["noise"], self.prior, tuple(mean), tuple(root))

    def factors(self, values: Values) -> Iterator[tuple[Any, np.ndarray, np.ndarray]]:
        """For each set of inducing points: the covariance, L and L⁻¹."""
        for points in values["inducing_points"]:
            at = self.kernel.at(np.log(values["hyperparameters"]), points)
            L = jittered_cholesky(at.matrix(), JITTER)
            yield at, L, triangular_inverse(L)

    def bound(
        self,
        statistics: SufficientStatistics,
        outputs: slice,
        signal: np.ndarray,
        noise: np.ndarray,
        L: np.ndarray,
        L_inv: np.ndarray,
    ) -> BoundAtOptimum:
        """The bound of one group, given the statistics of all outputs."""
        return BoundAtOptimum(
            statistics.outputs(outputs),
            signal[outputs],
            noise[outputs],
            self.prior.outputs(outputs),
            self.family,
            L,
            L_inv,
        )


def log_variances(B: np.ndarray, L_inv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log variances 1/Λ_ii of the optimal diagonal q: of f_m (in units of s²) and of w."""
    m = len(L_inv)
    precision = np.einsum("ji,jk,ki->i", L_inv, B[:m, :m], L_inv, optimize=True)
    return -np.log(precision), -np.log(np.diagonal(B)[m:])


def diagonal_root(log_f: np.ndarray, log_w: np.ndarray, L_inv: np.ndarray) -> np.ndarray:
    """R with Cov[ω] = Rᵀ R for diagonal covariances of f_m and β."""
    m = len(L_inv)
    root = np.zeros((m + len(log_w), m + len(log_w)))
    root[:m, :m] = (L_inv * np.exp(0.5 * log_f)).T
    root[m:, m:] = np.diag(np.exp(0.5 * log_w))
    return root
