"""scikit-learn kernels -> covariances that the inference can differentiate, and back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import autograd.numpy as anp
import numpy as np
from scipy.spatial.distance import cdist
from sklearn.gaussian_process import kernels as sk

from .inference.parameters import Start
from .inference.start import Starts

# Their squares neither vanish nor overflow.
SMALLEST, LARGEST = 1e-100, 1e100

WORKING = (
    "RBF (with one length scale or one per column), optionally times a ConstantKernel, optionally plus a WhiteKernel"
)


class SquaredExponential:
    """k̃(x, x') = exp(-½ Σ_d ((x_d - x'_d) / ℓ_d)²), hyperparameters log ℓ (Rasmussen & Williams 2006, eq. 4.9, 5.1).

    Parameters
    ----------
    n_columns : int
        d.
    isotropic : bool
        Whether one lengthscale serves all columns.
    """

    def __init__(self, n_columns: int, isotropic: bool = False):
        self.n_columns = n_columns
        self.n_hyperparameters = 1 if isotropic else n_columns

    def prepare(self, inputs: np.ndarray) -> np.ndarray:
        """[x, 1, x²] of each row as columns, (2 d + 1, n): the exponent is linear in it."""
        return np.ascontiguousarray(np.hstack([inputs, np.ones((len(inputs), 1)), inputs**2]).T)

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> SquaredExponentialAt:
        return SquaredExponentialAt(np.exp(hyperparameters), inducing_points)

    def traceable_matrices(self, hyperparameters: Any, inducing_points: Any) -> Any:
        scaled = inducing_points / anp.exp(hyperparameters)
        differences = scaled[..., :, None, :] - scaled[..., None, :, :]
        return anp.exp(-0.5 * anp.sum(differences**2, axis=-1))


class SquaredExponentialAt:
    """A `SquaredExponential` with lengthscales (1,) or (d,) and inducing points (m, d) put in."""

    def __init__(self, lengthscales: np.ndarray, inducing_points: np.ndarray):
        self.lengthscales = np.broadcast_to(lengthscales, inducing_points.shape[1:])
        self.isotropic = len(lengthscales) < inducing_points.shape[1]
        self.inducing_points = inducing_points
        precision = self.lengthscales**-2.0
        self._exponent = np.hstack(
            [
                inducing_points * precision,
                -0.5 * (inducing_points**2 @ precision)[:, np.newaxis],
                np.broadcast_to(-0.5 * precision, inducing_points.shape),
            ]
        )

    def matrix(self) -> np.ndarray:
        scaled = self.inducing_points / self.lengthscales
        return np.exp(-0.5 * cdist(scaled, scaled, "sqeuclidean"))

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        U = self._exponent @ prepared
        np.minimum(U, 0.0, out=U)
        return np.exp(U, out=U)

    def diagonal(self, prepared: np.ndarray) -> float:
        return 1.0

    def cross_pullback(self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: float) -> np.ndarray:
        """Σ_rows Ū U [x, 1, x²], (m, 2 d + 1); the diagonal is constant and adds nothing."""
        np.multiply(U_bar, U, out=U_bar)
        return U_bar @ prepared.T

    def finish_pullback(self, total: np.ndarray, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        Z, d = self.inducing_points, self.inducing_points.shape[1]
        WX, W, WXX = total[:, :d], total[:, d, np.newaxis], total[:, d + 1 :]
        within = K_bar * self.matrix()
        row_sum, within_Z = within.sum(axis=1, keepdims=True), within @ Z
        # Within the inducing points each pair counts twice: as (i, j) and as (j, i).
        Z_bar = WX - W * Z + 2.0 * (within_Z - row_sum * Z)
        length_bar = (WXX - 2.0 * Z * WX + W * Z**2 + 2.0 * Z * (row_sum * Z - within_Z)).sum(axis=0)
        precision = self.lengthscales**-2.0
        length_bar = length_bar * precision
        return length_bar.sum(keepdims=True) if self.isotropic else length_bar, Z_bar * precision


def _start(hyperparameter: sk.Hyperparameter, value: Any) -> Start:
    """A hyperparameter's value and bounds, checked."""
    value = np.atleast_1d(np.asarray(value, dtype=float))
    if not ((value >= SMALLEST) & (value <= LARGEST)).all():
        raise ValueError(f"kernel: {hyperparameter.name} must be between {SMALLEST:g} and {LARGEST:g}; got {value}.")
    if hyperparameter.fixed:
        return Start(value, None, True)
    bounds = np.broadcast_to(np.atleast_2d(hyperparameter.bounds), (len(value), 2)).astype(float)
    if not ((bounds[:, 0] > 0.0) & (bounds[:, 0] <= bounds[:, 1])).all():
        raise ValueError(
            f"kernel: {hyperparameter.name}_bounds must be above 0, the lower ones first; got {bounds.tolist()}."
        )
    return Start(value, bounds)


def _sklearn_bounds(start: Start, bounds: np.ndarray) -> Any:
    """What a scikit-learn kernel takes as ``..._bounds``."""
    if start.fixed:
        return "fixed"
    return tuple(map(float, bounds[0])) if len(bounds) == 1 else bounds


@dataclass(frozen=True)
class KernelSpec:
    """What a user's kernel says: k = s² k̃ (+ noise).

    Attributes
    ----------
    covariance : SquaredExponential
        k̃.
    starts : Starts
        Of the lengthscales, s² and, from a top-level WhiteKernel, σ².
    """

    covariance: SquaredExponential
    starts: Starts

    def with_noise(self, noise_variance: float) -> KernelSpec:
        """The same kernel with a start of the noise."""
        return replace(self, starts=replace(self.starts, noise=Start(np.array([float(noise_variance)]))))

    def to_sklearn(
        self, lengthscales: np.ndarray, length_bounds: np.ndarray, signal: float, signal_bounds: np.ndarray
    ) -> sk.Kernel:
        """The fitted s² k̃ as a scikit-learn kernel."""
        scale = lengthscales.copy() if len(lengthscales) > 1 else float(lengthscales[0])
        return sk.ConstantKernel(signal, _sklearn_bounds(self.starts.signal, signal_bounds)) * sk.RBF(
            scale, _sklearn_bounds(self.starts.hyperparameters, length_bounds)
        )


def parse_kernel(kernel: sk.Kernel | None, n_columns: int) -> KernelSpec:
    """Read a scikit-learn kernel.

    Parameters
    ----------
    kernel : sklearn.gaussian_process.kernels.Kernel or None
        None is a squared exponential with one lengthscale per column, all starts taken from the data.
    n_columns : int
        Width of the kernel's inputs.

    Returns
    -------
    spec : KernelSpec

    Raises
    ------
    TypeError
        If it is not a scikit-learn kernel.
    ValueError
        If it is one that does not work yet (the message lists what does), its length scales do not fit the columns, or
        a value or bound is out of range.
    """
    if kernel is None:
        return KernelSpec(SquaredExponential(n_columns), Starts(Start(), Start(), Start()))
    if not isinstance(kernel, sk.Kernel):
        raise TypeError(
            f"kernel must be a kernel of sklearn.gaussian_process.kernels or None; got {kernel!r}. "
            f"These work: {WORKING}."
        )
    white = [part for part in _parts(kernel, sk.Sum) if isinstance(part, sk.WhiteKernel)]
    signal = [part for part in _parts(kernel, sk.Sum) if not isinstance(part, sk.WhiteKernel)]
    factors = list(_parts(signal[0], sk.Product)) if len(signal) == 1 else []
    constants = [factor for factor in factors if isinstance(factor, sk.ConstantKernel)]
    # `type is`: Matérn derives from RBF.
    shapes = [factor for factor in factors if type(factor) is sk.RBF]
    if len(white) > 1 or len(constants) > 1 or len(shapes) != 1 or len(factors) != len(constants) + 1:
        raise ValueError(f"kernel={kernel!r} does not work yet. These work: {WORKING}.")

    rbf = shapes[0]
    lengths = np.atleast_1d(np.asarray(rbf.length_scale, dtype=float))
    if rbf.anisotropic and len(lengths) != n_columns:
        raise ValueError(
            f"kernel={kernel!r} has {len(lengths)} length scales, but its inputs have {n_columns} columns: "
            "give one length scale, or one per column."
        )
    return KernelSpec(
        SquaredExponential(n_columns, isotropic=not rbf.anisotropic),
        Starts(
            _start(rbf.hyperparameter_length_scale, lengths),
            _start(constants[0].hyperparameter_constant_value, constants[0].constant_value) if constants else Start(),
            _start(white[0].hyperparameter_noise_level, white[0].noise_level) if white else Start(),
        ),
    )


def _parts(kernel: Any, operator: Any) -> Iterator[Any]:
    """The operands of nested sums (or products)."""
    if isinstance(kernel, operator):
        yield from _parts(kernel.k1, operator)
        yield from _parts(kernel.k2, operator)
    else:
        yield kernel
