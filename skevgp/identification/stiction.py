"""Noise of a joint that hardly moves: Coulomb's friction has no sign there, and holds whatever the others ask."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize, minimize_scalar

# A row moves if friction leaves less than this share of its variance open.
_MOVING = 0.1
# rad/s or m/s: between which the speed is found at which friction has a sign.
_SLOWEST, _FASTEST = 1e-3, 0.3
# What is tried for that of mean friction, and its prior: the usual one and the standard deviation of its logarithm.
_VELOCITIES = np.array([0.002, 0.003, 0.005, 0.007, 0.01, 0.015, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2])
_USUAL, _USUAL_SPREAD = 0.015, 0.7


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


def noise_at(errors: np.ndarray, speed: np.ndarray, coulomb: float, velocity: float, least: float) -> JointNoise:
    """The most likely σ² of Gaussian errors (n,) whose other noise is known, no less than some."""
    standing = coulomb**2 / 3.0 * undecided(speed, velocity)
    most = _most(errors, least)

    def loss(log_variance: float) -> float:
        variance = np.exp(log_variance) + standing
        return float(np.mean(np.log(variance) + errors**2 / variance))

    found = minimize_scalar(loss, bounds=(np.log(least), np.log(most)), method="bounded")
    return JointNoise(float(np.exp(found.x)), coulomb, velocity)


def likeliest_noise(
    errors: np.ndarray,
    speed: np.ndarray,
    coulomb: float,
    velocity: float,
    least: float,
    start: JointNoise | None = None,
) -> JointNoise:
    """The same with the most likely v_s, which depends on how signals were filtered.

    Parameters
    ----------
    errors, speed : ndarray of shape (n,)
    coulomb : float
    velocity : float
        Where v_s starts.
    least : float
        Which σ² is not below, above 0.
    start : JointNoise, optional
        Of errors that were nearly the same: it starts there alone.

    Returns
    -------
    noise : JointNoise
    """
    if coulomb == 0.0:
        return noise_at(errors, speed, coulomb, velocity, least)
    squares, largest, most = errors**2, coulomb**2 / 3.0, _most(errors, least)

    def loss(logs: np.ndarray) -> tuple[float, np.ndarray]:
        ratio = speed / np.exp(logs[1])
        sign = np.tanh(ratio)
        standing = largest * (1.0 - sign**2)
        variance = np.exp(logs[0]) + standing
        slope = (1.0 - squares / variance) / variance
        by_logs = [np.mean(slope) * np.exp(logs[0]), np.mean(slope * standing * 2.0 * sign * ratio)]
        return float(np.mean(np.log(variance) + squares / variance)), np.array(by_logs)

    slowest, fastest = min(_SLOWEST, velocity), max(_FASTEST, velocity)
    limits = np.log([[least, most], [slowest, fastest]])
    if start is not None and start.coulomb > 0.0:
        starts = [np.log([start.variance, start.velocity])]
    else:
        moving = squares[undecided(speed, velocity) < _MOVING]
        size = float(np.mean(squares))
        variances = np.maximum([size, 0.1 * size, np.mean(moving) if len(moving) else size], least)
        starts = [
            np.log([variance, first]) for variance in variances for first in (velocity, np.sqrt(velocity * fastest))
        ]
    fits = [minimize(loss, np.clip(first, *limits.T), jac=True, method="L-BFGS-B", bounds=limits) for first in starts]
    best = np.exp(min(fits, key=lambda fit: fit.fun).x)
    return JointNoise(float(best[0]), coulomb, float(best[1]))


def _most(errors: np.ndarray, least: float) -> float:
    """A variance that noise does not exceed."""
    return max(2.0 * float(np.max(errors**2)), 10.0 * least)


def likeliest_velocity(
    left: np.ndarray, speed: np.ndarray, coulomb: float, velocity: float, worth: float, least: float
) -> float:
    """The speed v_s at which a joint's mean friction F tanh(q̇ / v_s) has a sign, by what it leaves.

    Parameters
    ----------
    left : ndarray of shape (n,)
        What all weights leave of the joint's torque.
    speed : ndarray of shape (n,)
    coulomb : float
        F, with its sign.
    velocity : float
        The v_s with which F was found.
    worth : float
        The rows that say as much as an independent one.
    least : float
        Which the variance of errors is not below, above 0.

    Returns
    -------
    velocity : float
        Of a grid; F, viscous friction and an offset are fitted anew to each, and a log-normal prior keeps it from ends
        of which the log says little. All rows count the same, for it is slow ones that tell.
    """
    target = left + coulomb * np.tanh(speed / velocity)
    scale = worth * max(float(np.mean(left**2)), least)
    losses = []
    for candidate in _VELOCITIES:
        terms = np.column_stack([np.tanh(speed / candidate), speed, np.ones_like(speed)])
        error = target - terms @ np.linalg.lstsq(terms, target, rcond=None)[0]
        losses.append(error @ error / scale + (np.log(candidate / _USUAL) / _USUAL_SPREAD) ** 2)
    return float(_VELOCITIES[int(np.argmin(losses))])
