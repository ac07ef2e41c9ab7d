"""Warnings about logs: joints at rest, joints without a motor, torques of the opposite sign, little motion."""

from __future__ import annotations

import numpy as np

from .rows_of_logs import correlation_time
from .weights import Rows, Weights

# A joint counts as not driven if its torque is below this share of the torque of the robot's model.
_NOT_DRIVEN = 0.1
# Torques have the opposite sign if their correlation with those of the robot's model is below the first number. The
# standard deviation of those of the model is then at least the second share of theirs: friction may have any sign.
_OPPOSED, _SIMILAR = -0.5, 0.5
# A joint counts as at rest if its speed is always lower, rad/s or m/s.
_REST = 0.01
# Least number of independent rows for each combination of weights that the rows determine.
_ROWS_PER_WEIGHT = 3.0


def weaknesses(rows: Rows, weights: Weights, n_coef: int, names: list[str]) -> list[str]:
    """Return warnings about the rows of a log. The first n_coef weights are those of the robot's model."""
    said = []
    prior = weights.prior
    fastest = np.abs(rows.speed).max(axis=0)
    still = fastest < _REST
    if still.any():
        said.append(
            f"{_of(names, still)} never move faster than {fastest[still].max():.2g} rad/s (m/s). So their friction "
            "and inertia cannot be estimated. Record motion of all joints."
        )
    of_model = rows.features[:, :, :n_coef] @ prior.mean[:n_coef]
    needed = np.sqrt(np.mean(of_model**2, axis=0))
    torque = np.sqrt(np.mean(rows.targets**2, axis=0))
    idle = (torque < _NOT_DRIVEN * needed) & ~still
    if idle.any():
        share = 100.0 * (torque[idle] / needed[idle]).max()
        said.append(
            f"Torques of {_of(names, idle)} are at most {share:.1f} % of those of the robot's model for this motion. "
            "If the motors were off, predictions will be wrong when they are on. Otherwise, y may have another unit, "
            "or the masses of the robot's model may be far too large."
        )
    similar = of_model.std(axis=0) >= _SIMILAR * rows.targets.std(axis=0)
    opposed = (_correlation(of_model, rows.targets) < _OPPOSED) & similar & ~idle & ~still
    if opposed.any():
        said.append(
            f"Torques of {_of(names, opposed)} have the opposite sign to those of the robot's model. Check the signs "
            "of y and of the joints' axes. Springs and counterbalances can be another reason."
        )
    errors = rows.targets - weights.predict(rows.features)
    for move in np.unique(rows.groups) if rows.n_moves > 1 else []:  # an offset is not a correlation
        errors[rows.groups == move] -= errors[rows.groups == move].mean(axis=0)
    worth = sum(len(errors) / correlation_time(column, rows.runs) for column in errors.T)
    if worth < _ROWS_PER_WEIGHT * weights.determined:
        said.append(
            f"Successive rows are correlated. {rows.targets.size} torques have as much information as {worth:.0f} "
            f"independent ones, for {weights.determined:.0f} combinations of weights. There should be at least "
            f"{_ROWS_PER_WEIGHT:.0f} for each. Otherwise, intervals may be too narrow. Record more motion."
        )
    return said


def _correlation(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the correlation (o,) of columns (n, o), or 0 if one of them is constant up to rounding."""
    one, other = (
        np.where(np.ptp(column, axis=0) > 1e-10 * np.abs(column).max(axis=0), column - column.mean(axis=0), 0.0)
        for column in (one, other)
    )
    size = np.sqrt(np.sum(one**2, axis=0)) * np.sqrt(np.sum(other**2, axis=0))
    product: np.ndarray = np.sum(one * other, axis=0) / np.where(size > 0.0, size, 1.0)
    return product


def _of(names: list[str], chosen: np.ndarray) -> str:
    return str([name for name, one in zip(names, chosen, strict=True) if one])
