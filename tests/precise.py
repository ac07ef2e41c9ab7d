"""The models in many digits: dense covariances of mpmath's numbers, with none of the library's algebra.

One output y ~ N(H μ_β, s² Q + H Σ_β Hᵀ + σ² I), with Q = Uᵀ K⁻¹ U for inducing points (Titsias 2009, with explicit
features) and Q = k̃(X, X) in the exact model (Rasmussen & Williams 2006, section 2.7). Arrays are NumPy's, of objects.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import mpmath
import numpy as np

# Enough for a K of condition 1e16 under a signal-to-noise ratio of 1e10, and for differences over 1e-45.
DIGITS = 120
_STEP = mpmath.mpf(10) ** -45
_EPSILON = np.finfo(float).eps


def precise(array):
    """The same numbers, exactly."""
    array = np.asarray(array)
    return array if array.dtype == object else np.vectorize(mpmath.mpf, otypes=[object])(array.astype(float))


def unit_errors(shape, seed):
    """Relative errors of up to a unit in the last place of doubles."""
    return precise(_EPSILON * np.random.RandomState(seed).uniform(-1.0, 1.0, shape))


def identity(n):
    return precise(np.eye(n))


def cholesky(A):
    """Lower triangular L with A = L Lᵀ."""
    L = A.copy()
    for j in range(len(L)):
        L[j, j] = mpmath.sqrt(L[j, j])
        L[j + 1 :, j] = L[j + 1 :, j] / L[j, j]
        L[j, j + 1 :] = mpmath.mpf(0)
        for i in range(j + 1, len(L)):
            L[i, j + 1 : i + 1] -= L[i, j] * L[j + 1 : i + 1, j]
    return L


def solved(L, B):
    """L⁻¹ B of a lower triangular L."""
    X = B.copy()
    for i in range(len(L)):
        X[i] = (X[i] - L[i, :i] @ X[:i]) / L[i, i] if i else X[i] / L[i, i]
    return X


def log_det(L):
    """log |L Lᵀ|."""
    return 2 * sum(mpmath.log(entry) for entry in np.diagonal(L))


def squared_exponential(A, B, lengthscales):
    scaled = (precise(A)[:, None, :] - precise(B)[None, :, :]) / precise(lengthscales)
    return np.vectorize(mpmath.exp, otypes=[object])(-(scaled**2).sum(axis=2) / 2)


def condition(K):
    """Of a symmetric matrix in the 1-norm: that in the 2-norm, or up to its length times as much."""
    root_inv = solved(cholesky(K), identity(len(K)))
    return float(abs(K).sum(axis=0).max() * abs(root_inv.T @ root_inv).sum(axis=0).max())


@dataclass(frozen=True)
class PreciseModel:
    """One output, a squared exponential kernel, and weights that are independent a priori.

    Attributes
    ----------
    lengthscales : array of shape (d,)
    signal, noise : number
        s² and σ².
    points : array of shape (m, d)
    X : array of shape (n, d)
    H : array of shape (n, p)
    y : array of shape (n,)
    coef_mean, coef_scale : array of shape (p,)
    jitter : float
        What the fit adds to the diagonal of k̃(X_m, X_m), which is 1.
    exact : bool
        Whether Q is k̃(X, X).
    seed : int, optional
        Of errors of the kernel's values, up to a unit in the last place of doubles; None are exact values.
    """

    lengthscales: np.ndarray
    signal: mpmath.mpf
    noise: mpmath.mpf
    points: np.ndarray
    X: np.ndarray
    H: np.ndarray
    y: np.ndarray
    coef_mean: np.ndarray
    coef_scale: np.ndarray
    jitter: float = 0.0
    exact: bool = False
    seed: int | None = None

    def __post_init__(self):
        for name in ("lengthscales", "points", "X", "H", "y", "coef_mean", "coef_scale"):
            object.__setattr__(self, name, precise(getattr(self, name)))
        for name in ("signal", "noise"):
            object.__setattr__(self, name, mpmath.mpf(getattr(self, name)))

    def nudged(self, seed):
        """What the model is given, each number moved by up to a unit in its last place."""
        names = ("lengthscales", "signal", "noise", "points", "X", "H", "y")
        values = ((name, getattr(self, name)) for name in names)
        return replace(self, **{name: value * (1 + unit_errors(np.shape(value), seed)) for name, value in values})

    def rounded(self, seed):
        """The same, and values of the kernel moved as far: what any algorithm is up against that has doubles."""
        return replace(self.nudged(seed), seed=seed)

    def k(self, A, B):
        values = squared_exponential(A, B, self.lengthscales)
        if self.seed is None:
            return values
        errors = unit_errors(values.shape, self.seed)
        return values * (1 + (np.tril(errors, -1) + np.tril(errors, -1).T if A is B else errors))

    @cached_property
    def L(self):
        K = self.k(self.points, self.points)
        # As in doubles, where 1 + 1e-12 is off by 1e-4 of what is added.
        np.einsum("ii->i", K)[...] = mpmath.mpf(1.0 + self.jitter)
        return cholesky(K)

    @cached_property
    def V(self):
        return self.whitened(self.X)

    def whitened(self, A):
        return solved(self.L, self.k(self.points, A))

    def projected(self, A, H_A):
        """P = [s Vᵀ, H C], whose coordinates are standard normal a priori."""
        return np.hstack([mpmath.sqrt(self.signal) * self.whitened(A).T, precise(H_A) * self.coef_scale])

    @cached_property
    def P(self):
        return self.projected(self.X, self.H)

    def prior(self, A, H_A):
        """Covariance between A and X."""
        if not self.exact:
            return (self.P if A is self.X else self.projected(A, H_A)) @ self.P.T
        covariance = self.signal * self.k(A, self.X)
        return covariance + (precise(H_A) * self.coef_scale**2) @ self.H.T if self.H.shape[1] else covariance

    @cached_property
    def residuals(self):
        return self.y - self.H @ self.coef_mean if self.H.shape[1] else self.y

    @cached_property
    def root(self):
        """Lower Cholesky factor of y's covariance."""
        covariance = self.prior(self.X, self.H)
        np.einsum("ii->i", covariance)[...] += self.noise
        return cholesky(covariance)

    @cached_property
    def z(self):
        return solved(self.root, self.residuals)

    @cached_property
    def trace(self):
        """Of what the inducing points leave of the covariance."""
        return 0 if self.exact else self.signal * (len(self.y) - (self.V**2).sum())

    @property
    def bound(self):
        """The collapsed bound; of the exact model the log marginal likelihood."""
        n = len(self.y)
        return -(n * mpmath.log(2 * mpmath.pi) + log_det(self.root) + self.z @ self.z + self.trace / self.noise) / 2

    def predict(self, A, H_A):
        """Mean and variance, noise-free, of rows: (n,) each."""
        c = solved(self.root, self.prior(A, H_A).T)
        mean, variance = c.T @ self.z, self.signal - (c**2).sum(axis=0)
        if self.H.shape[1]:
            mean = mean + precise(H_A) @ self.coef_mean
            variance = variance + ((precise(H_A) * self.coef_scale) ** 2).sum(axis=1)
        return mean, variance

    # --- the paper's family ---------------------------------------------------------------------------------------

    @cached_property
    def coordinates(self):
        """T of ω = T (f_m, β - μ_β): (s L)⁻¹ and C⁻¹."""
        m, size = len(self.points), self.P.shape[1]
        T = identity(size)
        T[:m, :m] = solved(self.L, identity(m)) / mpmath.sqrt(self.signal)
        np.einsum("ii->i", T)[m:] /= self.coef_scale
        return T

    @cached_property
    def precision(self):
        """Λ of (f_m, β)."""
        T = self.coordinates
        return T.T @ (identity(len(T)) + self.P.T @ self.P / self.noise) @ T

    @property
    def diagonal_bound(self):
        gap = sum(mpmath.log(entry) for entry in np.diagonal(self.precision)) - log_det(cholesky(self.precision))
        return self.bound - gap / 2

    def diagonal_variance(self, A, H_A):
        """Noise-free: (n,)."""
        unexplained = self.signal * (1 - (self.whitened(A) ** 2).sum(axis=0))
        return unexplained + (self.projected(A, H_A) @ self.coordinates) ** 2 @ (1 / np.diagonal(self.precision))

    # --- any Gaussian q -------------------------------------------------------------------------------------------

    def elbo(self, mean, root):
        """Of q(ω) = N(mean, rootᵀ root), ω as in `projected` (the paper's eq. elbo)."""
        mean, root = precise(mean), precise(root)
        e, deviations = self.residuals - self.P @ mean, root @ self.P.T
        data = e @ e + (deviations**2).sum() + self.trace
        divergence = mean @ mean + (root**2).sum() - len(mean) - log_det(cholesky(root.T @ root))
        return -(len(e) * mpmath.log(2 * mpmath.pi * self.noise) + data / self.noise + divergence) / 2

    def predict_by(self, mean, root, A, H_A):
        """Mean and variance, noise-free, of rows under a q: (n,) each."""
        P, unexplained = self.projected(A, H_A), self.signal * (1 - (self.whitened(A) ** 2).sum(axis=0))
        found = P @ precise(mean) + (precise(H_A) @ self.coef_mean if self.H.shape[1] else 0)
        return found, unexplained + ((precise(root) @ P.T) ** 2).sum(axis=0)

    # --------------------------------------------------------------------------------------------------------------

    def gradient(self, of=lambda model: model.bound):
        """By differences: in log ℓ, log s², log σ² and X_m, one after the other."""
        moved, base = [], of(self)
        for i in range(len(self.lengthscales)):
            lengthscales = self.lengthscales.copy()
            lengthscales[i] *= mpmath.exp(_STEP)
            moved.append({"lengthscales": lengthscales})
        moved += [{name: getattr(self, name) * mpmath.exp(_STEP)} for name in ("signal", "noise")]
        for i in np.ndindex(self.points.shape) if not self.exact else ():
            points = self.points.copy()
            points[i] += _STEP
            moved.append({"points": points})
        return np.array([(of(replace(self, **change)) - base) / _STEP for change in moved])
