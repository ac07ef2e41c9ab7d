"""An undamped wave as a scikit-learn kernel and as a covariance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from sklearn.gaussian_process import kernels as sk

from ..utils.casadi import casadi
from .base import CentredSquares, Covariance, CovarianceAt, PerRow, one_lengthscale, reads
from .waves import Waves


class Cosine(sk.StationaryKernelMixin, sk.NormalizedKernelMixin, sk.Kernel):
    r"""Undamped wave, periodic in the scaled difference of inputs.

    .. math:: k(x, x') = \cos\Bigl(2 \pi \sum_d \frac{x_d - x'_d}{\ell_d}\Bigr)

    Functions drawn from it are sinusoids with random phase and amplitude. The kernel is a spectral mixture of one
    component without width (Wilson & Adams 2013). Multiply it by an `RBF` for a damped wave.

    The kernel works in `EVGPRegressor`, in scikit-learn's GaussianProcessRegressor, and in sums and products with other
    kernels.

    Parameters
    ----------
    length_scale : float or array-like of shape (n_features,), default=1.0
        Period ℓ in units of the columns, one for all columns or one for each.
    length_scale_bounds : pair of floats, "fixed", or array-like of shape (n_features, 2), default=(1e-5, 1e5)
        Bounds of the length scale.

    Attributes
    ----------
    anisotropic : bool
        Whether each column has its own length scale.
    hyperparameter_length_scale : Hyperparameter
        Length scale and its bounds.

    References
    ----------
    - A. G. Wilson, R. P. Adams (2013): Gaussian Process Kernels for Pattern Discovery and Extrapolation.
    - C. E. Rasmussen, C. K. I. Williams (2006): Gaussian Processes for Machine Learning, section 4.2.1.

    Examples
    --------
    >>> import numpy as np
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.kernels import Cosine
    >>> X = np.linspace(0, 6, 60).reshape(-1, 1)
    >>> y = 3 * np.sin(2 * np.pi * X[:, 0] / 1.8 + 0.5) + 0.1 * np.random.RandomState(0).randn(60)
    >>> model = EVGPRegressor(kernel=Cosine(2.0), n_inducing=5, random_state=0).fit(X, y)
    >>> model.kernel_.k2
    Cosine(length_scale=1.8)
    """

    def __init__(self, length_scale: Any = 1.0, length_scale_bounds: Any = (1e-5, 1e5)):
        self.length_scale = length_scale
        self.length_scale_bounds = length_scale_bounds

    @property
    def anisotropic(self) -> bool:
        return np.size(self.length_scale) > 1

    @property
    def hyperparameter_length_scale(self) -> sk.Hyperparameter:
        return sk.Hyperparameter("length_scale", "numeric", self.length_scale_bounds, np.size(self.length_scale))

    def __call__(self, X: Any, Y: Any = None, eval_gradient: bool = False) -> Any:
        """Return k(X, Y) (n, m), and if asked for its gradient (n, n, n_dims) in the log length scales."""
        X = np.atleast_2d(X)
        if Y is not None and eval_gradient:
            raise ValueError("Gradient can only be evaluated when Y is None.")
        one_lengthscale(self, X.shape[1])
        lengths = np.squeeze(self.length_scale)
        x, z = ((rows - X[0]) / lengths for rows in (X, X if Y is None else np.atleast_2d(Y)))
        phase = 2.0 * np.pi * np.subtract.outer(x.sum(axis=1), z.sum(axis=1))
        K = np.cos(phase)
        if not eval_gradient:
            return K
        if self.hyperparameter_length_scale.fixed:
            return K, np.empty((*K.shape, 0))
        by_length = 2.0 * np.pi * (x[:, np.newaxis] - z) if self.anisotropic else phase[:, :, np.newaxis]
        return K, np.sin(phase)[:, :, np.newaxis] * by_length

    def __repr__(self) -> str:
        lengths = ", ".join(f"{length:.3g}" for length in np.ravel(self.length_scale))
        return f"Cosine(length_scale={f'[{lengths}]' if self.anisotropic else lengths})"


@dataclass(frozen=True)
class Wave(Covariance):
    """k̃(x, x') = cos(2π Σ_d (x_d - x'_d) / ℓ_d); hyperparameters ℓ."""

    n_columns: int
    isotropic: bool = False  # whether all columns have the same length scale
    # The squares are not used, but another part of a sum or product may share them.
    rows: CentredSquares = field(default=CentredSquares(), compare=False)

    @property
    def n_hyperparameters(self) -> int:
        return 1 if self.isotropic else self.n_columns

    def centred(self, centre: np.ndarray) -> Wave:
        return replace(self, rows=CentredSquares(tuple(centre.tolist())))

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        return np.cos((inputs - others) @ self.frequencies(hyperparameters))

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> WaveAt:
        return WaveAt(self.frequencies(hyperparameters), self.rows.centred(inducing_points), self.isotropic)

    def nearness(self, hyperparameters: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        phases = self.rows.centred(inputs) @ self.frequencies(hyperparameters)
        return np.column_stack([np.cos(phases), np.sin(phases)])

    def random_terms(
        self, hyperparameters: np.ndarray, shape: tuple[int, int], rng: np.random.RandomState
    ) -> list[tuple[Waves]]:
        frequencies = np.repeat(self.frequencies(hyperparameters)[np.newaxis], shape[0], axis=0)
        return [(Waves.drawn(frequencies, np.ones(shape[0]), self.rows, rng),)]

    def expression(self, hyperparameters: np.ndarray, points: np.ndarray, x: Any) -> tuple[Any, float]:
        ca, frequencies = casadi(), self.frequencies(hyperparameters)
        phases = ca.DM(self.rows.centred(points) @ frequencies)
        return ca.cos(phases - ca.dot(ca.DM(np.array(frequencies)), self.rows.symbol(x))), 1.0

    def frequencies(self, hyperparameters: np.ndarray) -> np.ndarray:
        """Return 2π / ℓ of each column."""
        return np.broadcast_to(2.0 * np.pi / hyperparameters, self.n_columns)


class WaveAt(CovarianceAt):
    """A `Wave` at given 2π / ℓ (d,) and centred inducing points (m, d)."""

    def __init__(self, frequencies: np.ndarray, points: np.ndarray, isotropic: bool):
        self.frequencies, self.points, self.isotropic = frequencies, points, isotropic
        self._phases = points @ frequencies

    def matrix(self) -> np.ndarray:
        return np.cos(np.subtract.outer(self._phases, self._phases))

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        return np.cos(self._differences(prepared))

    def slopes(self, prepared: np.ndarray) -> np.ndarray:
        return np.sin(self._differences(prepared))[:, :, np.newaxis] * self.frequencies

    def mixed_slopes(self, prepared: np.ndarray) -> np.ndarray:
        d = len(self.frequencies)
        return np.broadcast_to(np.outer(self.frequencies, self.frequencies), (prepared.shape[1], d, d))

    def start_pullback(self) -> np.ndarray:
        return np.zeros((len(self.points), len(self.frequencies) + 1))

    def cross_pullback(
        self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow
    ) -> np.ndarray:
        # With S = Ū sin(phase differences), all gradients follow from S [x, 1].
        U_bar *= np.sin(self._differences(prepared))
        return U_bar @ prepared[: len(self.frequencies) + 1].T

    def finish_pullback(self, total: np.ndarray, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # Within the inducing points each pair counts twice: as (i, j) and as (j, i).
        within = K_bar * np.sin(np.subtract.outer(self._phases, self._phases))
        of_phase = total[:, -1] + 2.0 * within.sum(axis=1)
        length_bar = self.frequencies * (of_phase @ self.points - total[:, :-1].sum(axis=0))
        return length_bar.sum(keepdims=True) if self.isotropic else length_bar, -np.outer(of_phase, self.frequencies)

    def _differences(self, prepared: np.ndarray) -> np.ndarray:
        """Return differences of phases, (m, n)."""
        return np.subtract.outer(self._phases, self.frequencies @ prepared[: len(self.frequencies)])


@reads(Cosine)
def wave(kernel: Cosine, n_columns: int) -> Wave:
    """Return the covariance of a Cosine."""
    return Wave(n_columns, one_lengthscale(kernel, n_columns))
