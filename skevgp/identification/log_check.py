"""Test whether a log fits a model: its errors against those of held-out moves."""

from __future__ import annotations

import numpy as np
from scipy.stats import f as fisher
from scipy.stats import t as student
from sklearn.utils import Bunch

from .joint_residual import JointResidual
from .moves import free_effects
from .rows_of_logs import correlation_time

# Smaller eigenvalues of a correlation matrix are rounding errors.
_SINGULAR = 1e-10


def check_of(
    joints: list[JointResidual],
    names: list[str],
    missed: np.ndarray,
    std: np.ndarray,
    z: list[np.ndarray],
    runs: np.ndarray,
    probability: float,
) -> Bunch:
    """Test whether errors missed (n, o), with their predicted std, are as usual for a new move; see `check_log`."""
    # There are two tests for each joint. A t-test compares the logarithm of the mean square error with those of
    # held-out moves. It finds errors that are larger as a whole. The other test is of the effects d of the move, with
    # the prior N(0, T). If C is the covariance of their estimate, dᵀ (T + C)⁻¹ d / k has an F distribution. This finds
    # shifts that are smaller than the noise.
    #
    # Each joint has few moves, so its variances between moves are uncertain. Relative to the noise, all joints count as
    # alike: they share the degrees of freedom, and the variances of effects of a joint are at least the mean over
    # joints.
    judged = [j for j, joint in enumerate(joints) if len(joint.log_squares) > 1]
    logs = np.array([joints[j].log_squares for j in judged]).reshape(len(judged), -1)
    n_moves = logs.shape[1] if judged else 1
    dof = max(1, (n_moves - 1) * len(judged))
    spread = float(np.sum((logs - logs.mean(axis=1, keepdims=True)) ** 2) / dof) if judged else 0.0
    sizes = np.array([np.mean(of_joint**2, axis=0) / joints[j].noise.variance for j, of_joint in enumerate(z)])
    variances = np.array([np.diag(joint.effects.covariance) for joint in joints])
    usual = np.mean((variances * sizes)[judged], axis=0)
    variances = np.maximum(variances, np.where(sizes > 0.0, usual / np.where(sizes > 0.0, sizes, 1.0), 0.0))
    p_values = np.ones(len(joints))
    for j, of_joint in zip(judged, logs, strict=True):
        squares = (missed[:, j] / std[:, j]) ** 2
        # This is the variance of the logarithm of the mean of n squares, to first order.
        mean = max(float(squares.mean()), 1e-300)
        sampling = squares.var() / mean**2 * correlation_time(squares - mean, runs) / len(squares)
        error = np.sqrt(spread * (1.0 + 1.0 / n_moves) + sampling)
        larger = student.sf((np.log(mean) - of_joint.mean()) / max(error, 1e-9), dof)
        p_values[j] = min(1.0, 2.0 * min(larger, _shifted(variances[j], z[j], missed[:, j], std[:, j], runs, dof)))
    together = np.minimum(1.0, len(judged) * p_values)
    bad = [name for name, value in zip(names, together, strict=True) if value < probability]
    return Bunch(fits=not bad, p_value=float(together.min()), p_values=p_values, joints=bad)


def _shifted(
    variance: np.ndarray, z: np.ndarray, missed: np.ndarray, std: np.ndarray, runs: np.ndarray, dof: int
) -> float:
    """Return the probability that the effects of a new move without a fault are at least as large."""
    d, covariance = free_effects(z, missed, std, runs)
    covariance = covariance + np.diag(variance)
    scale = np.sqrt(np.diag(covariance))
    d, scale, covariance = d[scale > 0.0], scale[scale > 0.0], covariance[np.ix_(scale > 0.0, scale > 0.0)]
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > _SINGULAR
    if not kept.any():
        return 1.0
    squares = (vectors[:, kept].T @ (d / scale)) ** 2 / values[kept]
    return float(fisher.sf(squares.mean(), len(squares), dof))
