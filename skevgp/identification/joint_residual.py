"""The residual torque of one joint: a Gaussian process of the joint's own signals, and its noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from ..estimators.evgp import EVGPRegressor
from ..kernels.parse import KernelSpec
from .stiction import JointNoise, likeliest_noise, noise_at

# Smallest mean square of a residual torque that a kernel is fitted to.
_NOTHING = 1e-90
# Limits of the kernel, in standard deviations of residuals and of columns. A signal that is larger than the residuals,
# or changes within less than the range of positions, is valid for one trajectory only. Friction does change within a
# fraction of the range of speeds.
_LARGEST_SIGNAL, _SMALLEST_SIGNAL = 1.0, 1e-3
_SHORTEST, _SHORTEST_OF_SPEED, _START, _LONGEST = 1.0, 0.01, 1.5, 100.0
# Least noise with f, as a share of the noise without f.
_LEAST = 1e-6


class QuietRegressor(EVGPRegressor):
    """A regressor that does not warn about parameters at their bounds, which the user did not set."""

    def _warn(self, messages: tuple[str, ...], spec: KernelSpec) -> None:
        """Do not warn."""


@dataclass(frozen=True)
class JointResidual:
    """f(x_j) ~ GP of a joint's residual torque, and its noise."""

    model: EVGPRegressor | None  # of the joint's own columns; None if physics alone predicts
    noise: JointNoise
    held_for_no_group: bool = False  # whether the signal was valid for no left-out group

    @property
    def signal(self) -> float:
        """Prior standard deviation of f."""
        if self.model is None:
            return 0.0
        kernel: Any = self.model.kernel_
        return float(np.sqrt(kernel.k1.constant_value))

    def mean(self, x: np.ndarray) -> np.ndarray:
        return np.zeros(len(x)) if self.model is None else self.model.predict(x)

    def moments(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and variance of f, (n,) each."""
        if self.model is None:
            return np.zeros(len(x)), np.zeros(len(x))
        mean, std = self.model.predict(x, return_std=True, include_noise=False)
        return mean, std**2


def fit_joint_residual(
    x: np.ndarray,
    residual: np.ndarray,
    speed: np.ndarray,
    noise: JointNoise,
    velocity: float,
    groups: np.ndarray,
    rows: np.ndarray,
    smooth: np.ndarray,
    **options: Any,
) -> JointResidual:
    """Fit the Gaussian process of a joint to some rows of x (n, d), and its noise to all rows."""
    # noise is that of the residual (n,) without f. Below velocity v_s, the lowest speed at which friction may have a
    # sign, rows count less for f. If filters blur the sign, the noise is larger up to a higher speed, but there f
    # learns the average friction. groups (n,) are left out to calibrate signal and noise; rows are the indices that f
    # is fitted to; smooth (d,) are the columns of x with long length scales; options are those of EVGPRegressor.
    size = float(np.mean(residual**2))
    if size <= _NOTHING:
        return JointResidual(None, noise)
    spread = x[rows].std(axis=0)
    spread = np.where(spread > 1e-9 * np.abs(x[rows]).max(axis=0), spread, 1.0)
    shortest = np.where(smooth, _SHORTEST, _SHORTEST_OF_SPEED)
    signal = ConstantKernel(0.25 * size, (_SMALLEST_SIGNAL**2 * size, _LARGEST_SIGNAL**2 * size))
    kernel = signal * RBF(_START * spread, np.column_stack([shortest * spread, _LONGEST * spread]))
    least = _LEAST * noise.variance
    sharp = noise_at(residual, speed, noise.coulomb, velocity, least)
    relative = sharp.of(speed) / sharp.variance
    model = QuietRegressor(kernel=kernel, **options)
    model.fit(x[rows], residual[rows], groups=groups[rows], relative_variance=relative[rows])
    left = residual - model.predict(x)
    found = likeliest_noise(left, speed, noise.coulomb, noise.velocity, least)
    # Left-out groups show how much larger the noise is than on the rows that f was fitted to.
    growth = max(1.0, float(model.noise_variance_ / max(np.mean(left**2 / relative), 1e-300)))
    return JointResidual(model, found._replace(variance=growth * found.variance), model._fitted.gone > 0)
