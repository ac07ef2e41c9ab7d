"""Warnings about logs with too little information: joints at rest, joints without a motor, little motion."""

from __future__ import annotations

import numpy as np

from .rows_of_logs import correlation_time
from .weights import Rows, Weights

# A joint counts as not driven if its torque is below this share of the torque of the robot's model.
_NOT_DRIVEN = 0.1
# A joint counts as at rest if its speed is always lower, rad/s or m/s.
_REST = 0.01
# Least number of independent rows for each combination of weights that the rows determine.
_ROWS_PER_WEIGHT = 3.0


def weaknesses(rows: Rows, weights: Weights, n_coef: int, names: list[str]) -> list[str]:
    """Return warnings about too little information in the rows. The first n_coef weights are those of the model."""
    said = []
    prior = weights.prior
    fastest = np.abs(rows.speed).max(axis=0)
    still = fastest < _REST
    if still.any():
        said.append(
            f"{_of(names, still)} never move faster than {fastest[still].max():.2g} rad/s (m/s). So their friction "
            "and inertia cannot be estimated. Record motion of all joints."
        )
    needed = np.sqrt(np.mean((rows.features[:, :, :n_coef] @ prior.mean[:n_coef]) ** 2, axis=0))
    torque = np.sqrt(np.mean(rows.targets**2, axis=0))
    idle = (torque < _NOT_DRIVEN * needed) & ~still
    if idle.any():
        share = 100.0 * (torque[idle] / needed[idle]).max()
        said.append(
            f"Torques of {_of(names, idle)} are at most {share:.1f} % of those of the robot's model for this motion. "
            "If the motors were off, predictions will be wrong when they are on. Otherwise, y may have another unit, "
            "or the masses of the robot's model may be far too large."
        )
    errors = rows.targets - weights.predict(rows.features)
    for move in np.unique(rows.groups) if rows.n_moves > 1 else []:  # an offset is not a correlation
        errors[rows.groups == move] -= errors[rows.groups == move].mean(axis=0)
    worth = sum(len(errors) / correlation_time(column, rows.runs) for column in errors.T)
    if worth < _ROWS_PER_WEIGHT * weights.determined:
        said.append(
            f"Successive rows are correlated. {rows.targets.size} torques have as much information as {worth:.0f} "
            f"independent ones, for {weights.determined:.0f} combinations of weights. Record more motion."
        )
    return said


def _of(names: list[str], chosen: np.ndarray) -> str:
    return str([name for name, one in zip(names, chosen, strict=True) if one])
