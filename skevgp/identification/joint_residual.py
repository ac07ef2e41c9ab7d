"""What physics missed of one joint's torque: a Gaussian process of the joint's own columns, and its noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from ..estimators.evgp import EVGPRegressor
from ..fitting.messages import signal_gone
from ..kernels.parse import KernelSpec
from .stiction import JointNoise, likeliest_noise, noise_at

# What is left of a torque, squared: less is nothing, and no kernel's variance.
_NOTHING = 1e-90
# The kernel's limits, in standard deviations of residuals and of columns. A signal that is larger than what it was
# fitted to, or changes within less of a position than was visited, is an excuse that holds for one trajectory only;
# friction does change within a fraction of the speeds.
_LARGEST_SIGNAL, _SMALLEST_SIGNAL = 1.0, 1e-3
_SHORTEST, _SHORTEST_OF_SPEED, _START, _LONGEST = 1.0, 0.01, 1.5, 100.0
# Of the noise without f, the share that it leaves at least.
_LEAST = 1e-6


class QuietRegressor(EVGPRegressor):
    """Its limits are not the user's, who is not told that fits end at them."""

    def _warn(self, messages: tuple[str, ...], spec: KernelSpec) -> None:
        self._held_for_no_group = signal_gone(1, 1) in messages


@dataclass(frozen=True)
class JointResidual:
    """f(x_j) ~ GP of a joint's residual torque, and its noise.

    Attributes
    ----------
    model : EVGPRegressor or None
        Of the joint's own columns; None where physics alone predicts.
    noise : JointNoise
    held_for_no_group : bool
        Whether there was something to learn, of which groups that were left out had nothing.
    """

    model: EVGPRegressor | None
    noise: JointNoise
    held_for_no_group: bool = False

    @property
    def signal(self) -> float:
        """The standard deviation of f a priori."""
        if self.model is None:
            return 0.0
        kernel: Any = self.model.kernel_
        return float(np.sqrt(kernel.k1.constant_value))

    def mean(self, x: np.ndarray) -> np.ndarray:
        return np.zeros(len(x)) if self.model is None else self.model.predict(x)

    def moments(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of f, (n,)."""
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
    """Fit the Gaussian process of a joint, and the noise that it leaves.

    Parameters
    ----------
    x : ndarray of shape (n, d)
        The joint's own columns.
    residual, speed : ndarray of shape (n,)
    noise : JointNoise
        Of the residual without f.
    velocity : float
        v_s, the lowest one at which friction may have a sign: below it rows count less for f. (Where filters blur the
        sign the noise reaches further, but there f learns what friction is on average.)
    groups : ndarray of shape (n,)
        What is left out together when signal and noise are calibrated.
    rows : ndarray of int
        Those that the model is fitted to.
    smooth : ndarray of bool of shape (d,)
        Of which columns of x the lengthscale may not be short.
    **options
        Of `EVGPRegressor`.

    Returns
    -------
    joint : JointResidual
    """
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
    # Groups that were left out show how much larger noise is than where f was fitted.
    growth = max(1.0, float(model.noise_variance_ / max(np.mean(left**2 / relative), 1e-300)))
    return JointResidual(model, found._replace(variance=growth * found.variance), model._held_for_no_group)
