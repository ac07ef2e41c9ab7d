"""How the torques of one joint differ from move to move: offset, friction and gain of a move."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .rows_of_logs import correlation_time
from .stiction import JointNoise
from .weights import Rows

# Names of the effects of a move on a joint's torque, the columns of `terms`.
EFFECTS = ("offset", "viscous", "coulomb", "gain")
# Steps of expectation maximisation, in each of some rounds for the correlation of errors.
_STEPS, _ROUNDS = 30, 4
# Least share of the noise of left-out moves that is not the variation between moves.
_OWN = 0.05
# Blocks of a move differ less than moves do. With so few moves, variances are multiplied by 1 + 1 / (2 moves).
_FEW = 2


class MoveEffects(NamedTuple):
    """Effects d ~ N(mean, covariance) of a move on a joint's torque, z(x)ᵀ d with z = (1, q̇, tanh(q̇ / v_s), τ̂)."""

    mean: np.ndarray  # (4,)
    covariance: np.ndarray  # (4, 4)

    @classmethod
    def none(cls) -> MoveEffects:
        return cls(np.zeros(len(EFFECTS)), np.zeros((len(EFFECTS), len(EFFECTS))))

    def moments(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and variance of the effects on rows with terms z (n, 4), (n,) each."""
        return z @ self.mean, np.einsum("ni,ij,nj->n", z, self.covariance, z)


def terms(speed: np.ndarray, torque: np.ndarray, velocity: float) -> np.ndarray:
    """Return z(x) of rows, (n, 4), from speed and torque by the weights, (n,) each."""
    return np.column_stack([np.ones_like(speed), speed, np.tanh(speed / velocity), torque])


def variation(
    z: np.ndarray, missed: np.ndarray, speed: np.ndarray, noise: JointNoise, rows: Rows
) -> tuple[MoveEffects, JointNoise]:
    """Find how moves differ, and the noise that is left, from what other moves predict wrongly, missed (n,)."""
    # Each move has its own effects d ~ N(0, diag(t)), as in a linear model with random effects. Expectation
    # maximisation finds the most likely t. Rows count less if errors are correlated in time, so that slow errors within
    # a move are not taken for effects. At first all of the errors count as such, then what effects leave.
    std = np.sqrt(noise.of(speed))
    size = np.mean(z**2, axis=0)
    variance = np.where(size > 0.0, np.mean(missed**2) / np.where(size > 0.0, size, 1.0), 0.0)
    moves = [rows.groups == move for move in np.unique(rows.groups)]
    within = missed.copy()
    for _ in range(_ROUNDS):
        scale = std * np.sqrt(np.mean((within / std) ** 2) * correlation_time(within / std, rows.runs))
        informations = [_information(z[own], missed[own], scale[own]) for own in moves]
        for _ in range(_STEPS):
            found = [_posterior(variance, *information) for information in informations]
            variance = np.mean([d**2 + np.diag(covariance) for d, covariance in found], axis=0)
        for own, (d, _) in zip(moves, found, strict=True):
            within[own] = missed[own] - z[own] @ d
    between = float(np.mean(z**2 @ variance / std**2)) * noise.variance
    n_moves = rows.n_moves
    factor = 1.0 + 0.5 / n_moves if n_moves <= _FEW else 1.0
    left = noise._replace(variance=factor * max(noise.variance - between, _OWN * noise.variance))
    return MoveEffects(np.zeros(len(variance)), factor * np.diag(variance)), left


def of_move(
    before: MoveEffects, z: np.ndarray, missed: np.ndarray, speed: np.ndarray, noise: JointNoise, runs: np.ndarray
) -> MoveEffects:
    """Return the effects of a move after some of its rows, whose errors without effects are missed (n,)."""
    std = np.sqrt(noise.of(speed))
    mean, covariance = before
    for _ in range(_ROUNDS):
        scale = std * np.sqrt(correlation_time((missed - z @ mean) / std, runs))
        mean, covariance = _posterior(np.diag(before.covariance), *_information(z, missed, scale))
    return MoveEffects(mean, covariance)


def free_effects(z: np.ndarray, missed: np.ndarray, std: np.ndarray, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the effects of a move by least squares, and their covariance."""
    scale = std * np.sqrt(correlation_time(missed / std, runs))
    rows = z / scale[:, np.newaxis]
    size = np.sqrt(np.sum(rows**2, axis=0))
    unit = np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv((rows / unit).T @ (rows / unit), rcond=1e-8, hermitian=True) / np.outer(unit, unit)
    return inverse @ (rows.T @ (missed / scale)), inverse


def _information(z: np.ndarray, missed: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ZᵀZ and Zᵀe of rows in units of their scale (n,)."""
    rows = z / scale[:, np.newaxis]
    return rows.T @ rows, rows.T @ (missed / scale)


def _posterior(variance: np.ndarray, information: np.ndarray, score: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of d ~ N(0, diag(variance)) given rows with information ZᵀZ and score Zᵀe."""
    # With d = √t u the precision of u is I + √t ZᵀZ √t, which no t makes singular.
    root = np.sqrt(variance)
    precision = np.eye(len(root)) + root[:, np.newaxis] * information * root
    covariance = root[:, np.newaxis] * np.linalg.inv(precision) * root
    return covariance @ score, covariance
