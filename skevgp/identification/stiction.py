"""Coulomb friction of a joint at low speed: noise, because its sign is unknown there, and its mean."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from ..features import LogNormal

# A joint counts as moving if less than this share of the variance of friction at rest remains.
_MOVING = 0.1
# Limits of the speed v_s above which friction has a sign, rad/s or m/s.
_SLOWEST, _FASTEST = 1e-3, 0.3
# Prior of v_s of mean friction.
VELOCITY_PRIOR = LogNormal(0.015, 0.7)


def undecided(speed: np.ndarray, velocity: np.ndarray | float) -> np.ndarray:
    """Return 1 - tanh²(q̇ / v_s), the share of the variance of friction at rest that remains, (n,) or (n, o)."""
    return 1.0 - np.tanh(speed / velocity) ** 2


class JointNoise(NamedTuple):
    """Noise of a joint's torque, with the variance σ² + F²/3 (1 - tanh²(q̇ / v_s))."""

    # At rest, friction is uniform between -F and F, with the variance F²/3. At higher speeds its mean is
    # F tanh(q̇ / v_s), and the share 1 - tanh²(q̇ / v_s) of the variance remains.
    variance: float  # σ²
    coulomb: float  # F, or 0 without Coulomb friction
    velocity: float  # v_s

    def of(self, speed: np.ndarray) -> np.ndarray:
        """Return the variance at each speed."""
        return self.variance + self.standing(speed)

    def standing(self, speed: np.ndarray) -> np.ndarray:
        """Return the variance due to friction of unknown sign."""
        return self.coulomb**2 / 3.0 * undecided(speed, self.velocity)


def noise_at(errors: np.ndarray, speed: np.ndarray, coulomb: float, velocity: float, least: float) -> JointNoise:
    """Find the most likely σ², at least ``least``, of Gaussian errors (n,), given F and v_s."""
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
    """Find the most likely σ² and v_s, given F. The v_s depends on the filters of the signals."""
    # The search of v_s starts at velocity and above it. If start is given, the noise of similar errors, it is the only
    # starting point.
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
    """Return an upper limit of the noise variance."""
    return max(2.0 * float(np.max(errors**2)), 10.0 * least)


class MeanFriction(NamedTuple):
    """Mean friction F tanh(q̇ / v_s) of joints, linearised in the coordinates z of v_s (`features.theta.Prior`)."""

    coulomb: np.ndarray  # (o,), F
    z: np.ndarray  # (o,), the coordinates where it is linearised

    @property
    def velocity(self) -> np.ndarray:
        """Return v_s, (o,)."""
        return np.array([VELOCITY_PRIOR.value(z) for z in self.z])

    def on(self, features: np.ndarray, speed: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return features (n, o, p) with these v_s, given the columns (o,) of Coulomb friction."""
        changed = features.copy()
        changed[:, range(len(self.z)), columns] = np.tanh(speed / self.velocity)
        return changed

    def slopes(self, speed: np.ndarray) -> np.ndarray:
        """Return the derivatives of friction in z, (n, o, o): a diagonal matrix for each row of speeds (n, o)."""
        # d tanh(q̇ / v_s) / d log v_s = -(q̇ / v_s) (1 - tanh²(q̇ / v_s)), and log v_s = const + sigma z.
        velocity, n_joints = self.velocity, len(self.z)
        by_log = -self.coulomb * speed / velocity * undecided(speed, velocity)
        found = np.zeros((len(speed), n_joints, n_joints))
        found[:, range(n_joints), range(n_joints)] = VELOCITY_PRIOR.sigma * by_log
        return found
