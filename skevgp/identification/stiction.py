"""Noise of a joint that hardly moves: Coulomb's friction has no sign there, and holds whatever the others ask."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize, minimize_scalar

# Noise is at least this share of the variance of a torque.
_FLOOR = 1e-10
# rad/s or m/s: between which the speed is found at which friction has a sign.
_SLOWEST, _FASTEST = 1e-3, 0.3


def undecided(speed: np.ndarray, velocity: np.ndarray | float) -> np.ndarray:
    """The share 1 - tanh²(q̇ / v_s) of a joint's largest standing-friction variance, (n,) or (n, o)."""
    return 1.0 - np.tanh(speed / velocity) ** 2


class JointNoise(NamedTuple):
    """The variance of a joint's torque, σ² + F²/3 (1 - tanh²(q̇ / v_s)).

    At rest friction is anything between -F and F, with variance F²/3 if nothing else is known; at a speed at which its
    mean is F tanh(q̇ / v_s), the rest of F² is left to chance.

    Attributes
    ----------
    variance : float
        σ².
    coulomb : float
        F, Coulomb's friction; 0 where there is none.
    velocity : float
        v_s.
    """

    variance: float
    coulomb: float
    velocity: float

    def of(self, speed: np.ndarray) -> np.ndarray:
        """The variance at each speed."""
        return self.variance + self.standing(speed)

    def standing(self, speed: np.ndarray) -> np.ndarray:
        """Its part from friction."""
        return self.coulomb**2 / 3.0 * undecided(speed, self.velocity)


def noise_at(errors: np.ndarray, speed: np.ndarray, coulomb: float, velocity: float) -> JointNoise:
    """The most likely σ² of Gaussian errors (n,) whose other noise is known."""
    standing = coulomb**2 / 3.0 * undecided(speed, velocity)
    size = _size(errors, coulomb)

    def loss(log_variance: float) -> float:
        variance = np.exp(log_variance) + standing
        return float(np.mean(np.log(variance) + errors**2 / variance))

    found = minimize_scalar(loss, bounds=(np.log(_FLOOR * size), np.log(2.0 * size)), method="bounded")
    return JointNoise(float(np.exp(found.x)), coulomb, velocity)


def likeliest_noise(errors: np.ndarray, speed: np.ndarray, coulomb: float, velocity: float) -> JointNoise:
    """The same with the most likely v_s, which depends on how signals were filtered; it starts at ``velocity``."""
    if coulomb == 0.0:
        return noise_at(errors, speed, coulomb, velocity)
    size = _size(errors, coulomb)

    def loss(logs: np.ndarray) -> float:
        variance = JointNoise(np.exp(logs[0]), coulomb, np.exp(logs[1])).of(speed)
        return float(np.mean(np.log(variance) + errors**2 / variance))

    slowest, fastest = min(_SLOWEST, velocity), max(_FASTEST, velocity)
    limits = [(np.log(_FLOOR * size), np.log(2.0 * size)), (np.log(slowest), np.log(fastest))]
    fits = [
        minimize(loss, [np.log(share * size), np.log(start)], method="L-BFGS-B", bounds=limits)
        for share in (1.0, 0.1)
        for start in (velocity, np.sqrt(velocity * fastest))
    ]
    best = min(fits, key=lambda fit: fit.fun)
    return JointNoise(float(np.exp(best.x[0])), coulomb, float(np.exp(best.x[1])))


def _size(errors: np.ndarray, coulomb: float) -> float:
    """A variance that noise does not exceed."""
    return float(np.mean(errors**2)) or coulomb**2 * _FLOOR or 1e-300
