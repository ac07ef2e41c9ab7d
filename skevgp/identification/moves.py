"""Effects of a move on the torque of a joint: offset, viscous friction, Coulomb friction and gain."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .rows_of_logs import correlation_time
from .stiction import JointNoise
from .weights import Rows

# Names of the effects of a move on a joint's torque, the columns of `terms`.
EFFECTS = ("offset", "viscous", "coulomb", "gain")
# Least number of moves to find out how moves differ.
FEWEST_MOVES = 3
# Least variance within held-out moves, as a share of that of noise. Rows of a robot at rest may be equal.
_LEAST = 1e-12
# Steps of expectation maximisation.
_STEPS = 50
# Shares of the variances that an update may use, and the part of a move that tests of updates use.
_SHARES, _FIRST = (0.0, 0.01, 0.1, 1.0), 1.0 / 3.0


class MoveEffects(NamedTuple):
    """Effects d ~ N(mean, covariance) of a move: they add z(x)ᵀ d to a torque, with z = (1, q̇, tanh(q̇ / v_s), τ̂)."""

    mean: np.ndarray  # (4,)
    covariance: np.ndarray  # (4, 4)
    extra: float = 0.0  # variance that is added to the noise

    @classmethod
    def none(cls) -> MoveEffects:
        return cls(np.zeros(len(EFFECTS)), np.zeros((len(EFFECTS), len(EFFECTS))))

    def moments(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and the variance of zᵀ d for rows z (n, 4), (n,) each."""
        return z @ self.mean, np.einsum("ni,ij,nj->n", z, self.covariance, z) + self.extra


class Variation(NamedTuple):
    """Differences between the moves of a joint, and the noise within moves."""

    effects: MoveEffects  # of a move without training rows
    update: MoveEffects | None  # the prior of effects in an update, or None if updates do not help
    noise: JointNoise  # within moves


def terms(speed: np.ndarray, torque: np.ndarray, velocity: float) -> np.ndarray:
    """Return z(x) of rows, (n, 4), from their speed and the torque τ̂ that the weights predict, (n,) each."""
    return np.column_stack([np.ones_like(speed), speed, np.tanh(speed / velocity), torque])


def variation(
    z: np.ndarray,
    missed: np.ndarray,
    speed: np.ndarray,
    noise: JointNoise,
    known: np.ndarray,
    rows: Rows,
    usual: np.ndarray,
) -> Variation:
    """Estimate differences between moves, and the noise within moves, from errors missed (n,) on held-out moves."""
    # The variance of errors is the sum of `known` (n,), the variance of the predictions, and of the noise. usual (4,)
    # has the standard deviations of effects in general.
    #
    # Each move has its own effects d ~ N(0, diag(t)), as in a linear model with random effects. Expectation
    # maximisation finds the most likely t. Rows count less if errors are correlated in time. So slow errors within a
    # move do not count as effects.
    std, moves = np.sqrt(noise.of(speed) + known), [rows.groups == move for move in np.unique(rows.groups)]
    within = np.empty_like(missed)
    for own in moves:
        within[own] = _without_effects(z[own] / std[own, np.newaxis], missed[own] / std[own])
    share = float(np.sum(within**2) / max(1, len(within) - z.shape[1] * len(moves)))
    share = min(1.0, max(_LEAST, share))
    scale = std * np.sqrt(share * correlation_time(within, rows.runs))
    informations = [_information(z[own], missed[own], scale[own]) for own in moves]
    size = np.mean(z**2, axis=0)
    variance = np.where(size > 0.0, np.mean(missed**2) / np.where(size > 0.0, size, 1.0), 0.0)
    for _ in range(_STEPS):
        found = [_posterior(variance, *information) for information in informations]
        variance = np.mean([d**2 + np.diag(covariance) for d, covariance in found], axis=0)
    # Effects and noise together are as large as the errors on held-out moves.
    between = float(np.mean(z**2 @ variance / noise.of(speed)))
    inside = max(1.0 - between, share)
    # Blocks of one or two moves differ less than whole moves do.
    factor = (1.0 + 0.5 / rows.n_moves if rows.n_moves < FEWEST_MOVES else 1.0) / max(1.0, between + inside)
    left = noise._replace(variance=factor * inside * noise.variance)
    # Moves of one day differ less than those of several days. So the usual variance is added.
    effects = MoveEffects(np.zeros(len(variance)), np.diag(factor * variance + usual**2))
    update = _update(effects, z, missed, speed, left, known, rows, moves) if rows.n_moves >= FEWEST_MOVES else None
    # With few moves, variances are uncertain. As in Student's t distribution, the variances of a new move are larger.
    wider = effects._replace(covariance=np.diag((1.0 + 2.0 / rows.n_moves) * factor * variance + usual**2))
    return Variation(wider, update, left)


def _update(
    effects: MoveEffects,
    z: np.ndarray,
    missed: np.ndarray,
    speed: np.ndarray,
    noise: JointNoise,
    known: np.ndarray,
    rows: Rows,
    moves: list[np.ndarray],
) -> MoveEffects | None:
    """Return the prior of effects with the best updates: from the first rows of moves, they predict the others."""
    # As in `joint_residual`, each move counts the same. The errors of the rest of a move must fall. If they are larger
    # than predicted, extra noise makes up the difference.
    falls, sizes = np.zeros((len(_SHARES), len(moves))), np.ones((len(_SHARES), len(moves)))
    for k, own in enumerate(moves):
        chosen = np.flatnonzero(own)
        first, rest = np.split(chosen, [int(_FIRST * len(chosen))])
        if len(first) == 0:
            continue
        for s, share in enumerate(_SHARES):
            prior = effects._replace(covariance=share * effects.covariance)
            now = of_move(prior, z[first], missed[first], speed[first], noise, rows.runs[first])
            mean, variance = now.moments(z[rest])
            squares = (missed[rest] - mean) ** 2
            falls[s, k] = np.log(max(float(np.mean(squares)), 1e-300))
            sizes[s, k] = np.mean(squares / (variance + noise.of(speed[rest]) + known[rest]))
    best = int(np.argmin(falls.mean(axis=1)))
    if best == 0:
        return None
    extra = max(0.0, float(sizes[best].mean()) - 1.0) * noise.variance
    return MoveEffects(effects.mean, _SHARES[best] * effects.covariance, extra)


def of_move(
    before: MoveEffects, z: np.ndarray, missed: np.ndarray, speed: np.ndarray, noise: JointNoise, runs: np.ndarray
) -> MoveEffects:
    """Return the posterior of the effects of a move, given errors missed (n,) of predictions without effects."""
    information = _of_correlated(z, missed, np.sqrt(noise.of(speed)), runs)
    return MoveEffects(*_posterior(np.diag(before.covariance), *information), before.extra)


def free_effects(z: np.ndarray, missed: np.ndarray, std: np.ndarray, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares estimate of the effects of a move, and its covariance."""
    information, score = _of_correlated(z, missed, std, runs)
    size = np.sqrt(np.diag(information))
    unit = np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv(information / np.outer(unit, unit), rcond=1e-8, hermitian=True) / np.outer(unit, unit)
    return inverse @ score, inverse


def _of_correlated(
    z: np.ndarray, missed: np.ndarray, std: np.ndarray, runs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return ZᵀZ and Zᵀe of the rows of a move. Rows count less if errors without effects are correlated."""
    left = _without_effects(z / std[:, np.newaxis], missed / std)
    return _information(z, missed, std * np.sqrt(correlation_time(left, runs)))


def _information(z: np.ndarray, missed: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ZᵀZ and Zᵀe of rows in units of their scale (n,)."""
    rows = z / scale[:, np.newaxis]
    return rows.T @ rows, rows.T @ (missed / scale)


def _without_effects(z: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return the errors of a move, in standard deviations, minus its effects by least squares."""
    size = np.sqrt(np.sum(z**2, axis=0))
    unit = z / np.where(size > 0.0, size, 1.0)
    left: np.ndarray = errors - unit @ np.linalg.lstsq(unit, errors, rcond=1e-8)[0]
    return left


def _posterior(variance: np.ndarray, information: np.ndarray, score: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the posterior mean and covariance of d ~ N(0, diag(variance)), given ZᵀZ and Zᵀe of rows."""
    # With d = √t u, the precision of u is I + √t ZᵀZ √t. It is never singular, even for t = 0.
    root = np.sqrt(variance)
    precision = np.eye(len(root)) + root[:, np.newaxis] * information * root
    covariance = root[:, np.newaxis] * np.linalg.inv(precision) * root
    return covariance @ score, covariance
