"""Does a log fit a model? A test of its errors against those of moves that the model was not trained on."""

from __future__ import annotations

import numpy as np
from scipy.stats import f as fisher
from scipy.stats import t as student
from sklearn.utils import Bunch

from .joint_residual import JointResidual
from .moves import free_effects


def check_of(
    joints: list[JointResidual],
    names: list[str],
    missed: np.ndarray,
    std: np.ndarray,
    z: list[np.ndarray],
    runs: np.ndarray,
    probability: float,
) -> Bunch:
    """Return whether errors missed (n, o) with predicted std are those of an ordinary move; see `check_log`."""
    # Two tests for each joint. The logarithm of the mean square, against those of left-out moves, by a t-test: errors
    # that are larger as a whole. And the effects d of the move, which other moves say are N(0, T): with the covariance
    # C of their estimate, dᵀ (T + C)⁻¹ d / k has an F distribution. That finds a shift which is small beside the noise.
    # Variances between moves are known from few moves of each joint, and relative to them all joints are alike, so that
    # all count as degrees of freedom.
    n_moves = max(len(joint.log_squares) for joint in joints)
    dof = max(1, (n_moves - 1) * len(joints))
    logs = np.array([joint.log_squares for joint in joints if len(joint.log_squares) == n_moves])
    spread = float(np.sqrt(np.sum((logs - logs.mean(axis=1, keepdims=True)) ** 2) / dof))
    values = []
    for j, joint in enumerate(joints):
        size = np.log(max(np.mean((missed[:, j] / std[:, j]) ** 2), 1e-300)) - joint.log_squares.mean()
        larger = student.sf(size / (max(spread, 1e-9) * np.sqrt(1.0 + 1.0 / n_moves)), dof)
        d, covariance = free_effects(z[j], missed[:, j], std[:, j], runs)
        together = covariance + joint.effects.covariance
        scale = np.sqrt(np.diag(together))
        known = scale > 0.0
        unit = together[np.ix_(known, known)] / np.outer(scale[known], scale[known])
        moved = d[known] / scale[known]
        k = int(known.sum())
        shifted = fisher.sf(moved @ np.linalg.lstsq(unit, moved, rcond=1e-10)[0] / max(k, 1), max(k, 1), dof)
        values.append(min(1.0, 2.0 * min(larger, shifted)))
    p_values = np.array(values)
    p_value = float(min(1.0, len(joints) * p_values.min()))
    bad = [name for name, value in zip(names, p_values, strict=True) if len(joints) * value < probability]
    return Bunch(fits=p_value >= probability, p_value=p_value, p_values=p_values, joints=bad)
