"""Likely causes if a robot's model does not fit the torques: order of columns, degrees, positions beyond limits.

The torques of some rows are regressed on the model's features with a wide prior. The regression is repeated with
columns in another order and with angles in radians. A cause is named if this makes the residual far smaller.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations, permutations
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..data.threads import single_threaded_libraries
from ..robots import RigidBody
from ..robots.loading import joint_axes
from .rows_of_logs import evenly_spread

_ROWS, _ROWS_OF_SEARCH = 400, 200
# Robots with many joints use fewer rows. With more joints than the last number, only limits of positions are tested.
_TORQUES, _LEAST_ROWS, _MOST_JOINTS = 4000, 100, 40
# A cause is named if the residual's share of the variance falls to the first number times its value, and by at least
# the second number.
_FALL, _LEAST_FALL = 0.5, 0.02
# The prior of a regression is that of the feature map, wider by the first factor. The noise is at least the second
# number times the variance of the torque.
_WIDER, _LEAST_NOISE = 10.0, 1e-4
# A search of orders counts smaller shares as this one.
_LEAST_SHARE = 1e-3
# Up to the first number of joints, all orders are tried. Up to the second number, a search exchanges or moves joints
# step by step, with about the third number of trials. With more joints, only orders by name and backwards are tried.
_MOST_ALL, _MOST_SEARCHED, _MOST_TRIALS = 6, 12, 1000
# Positions are beyond their limits if they exceed these by the first number times the range. They look like degrees if
# they exceed a turn, and the second number times the larger limit.
_BEYOND, _DEGREES = 0.1, 3.0
# Signals below this limit are not in degrees. Most positions, velocities and accelerations in radians are below it.
_RADIANS = 2.0 * np.pi
_MOST_NAMED, _MOST_SAID = 8, 3
_UNITS = (("q",), ("q", "v", "a"), ("q", "v"), ("q", "a"), ("v", "a"), ("v",), ("a",))
_BLOCKS = {"q": "positions", "v": "velocities", "a": "accelerations"}
# If the range differs from a turn by less, rad, the joint turns freely, and its limits are ignored.
_A_TURN = 0.05
# Larger limits are ignored.
_LARGEST_LIMIT = 1e6


@single_threaded_libraries()  # with small matrices, threads would only wait for each other
def likely_causes(
    feature_map: Any, X: np.ndarray, y: np.ndarray, prior: tuple[np.ndarray, np.ndarray], *, is_far: bool
) -> list[str]:
    """Return sentences that name likely causes, without a full stop."""
    # prior is (mean, covariance) of the map's weights. If is_far, the identified weights are far from the model. Only
    # then are positions slightly beyond their limits named.
    n_joints = y.shape[1]
    said, degrees = _beyond_limits(feature_map.model_, X[:, :n_joints])
    if not is_far:
        said = {joint: said[joint] for joint in degrees}
    if n_joints > _MOST_JOINTS:
        return _of_limits(said, degrees)
    n_rows = min(len(X), _ROWS, max(_LEAST_ROWS, _TORQUES // n_joints))
    some = evenly_spread(len(X), n_rows)
    trial = _Trial(feature_map, prior, X[some], y[some])
    before, tried = trial.left(trial.X, trial.y), _degrees(trial, degrees)
    best = min(tried, key=lambda one: one.left, default=None)
    # Radians are degrees times a small factor, which nearly removes the signals. So degrees are named only if torques
    # are not explained as well without these signals.
    if best is not None and _much_less(best.left, before) and _much_less(best.left, trial.left_without(best)):
        rest = {joint: text for joint, text in said.items() if "q" not in best.blocks or joint not in best.joints}
        return [best.said(trial.names), *_of_limits(rest, degrees), *_order(trial, best.X)]
    # If columns are in another order too, radians alone do not explain torques better. Both are tried together.
    of_positions = [one for one in tried if "q" in one.blocks]
    for one in of_positions if degrees else []:
        if order := _order(trial, one.X):
            return [one.said(trial.names), *order]
    if not any(one.left <= before for one in of_positions):  # radians increase the residual, so these are not degrees
        said, degrees = said if is_far else {}, []
    return [*_of_limits(said, degrees), *_order(trial, trial.X)]


class _Trial:
    """Some rows of a log, with regressions of their torques on the model's features."""

    def __init__(self, feature_map: Any, prior: tuple[np.ndarray, np.ndarray], X: np.ndarray, y: np.ndarray):
        self.model, self.X, self.y = feature_map.model_, X, y
        self.names = list(self.model.names)[1:]
        self.turns = np.any(joint_axes(self.model)[:, 3:], axis=1)
        self._map, self._body = feature_map, RigidBody(self.model)
        self._mean, covariance = prior
        values, vectors = np.linalg.eigh(covariance)
        self._root = _WIDER * vectors * np.sqrt(np.maximum(values, 0.0))

    def left(self, X: np.ndarray, y: np.ndarray) -> float:
        """Return the residual's share of the variance of torques, as a mean over joints whose torque varies."""
        H = self._map.transform(X)
        variance = y.var(axis=0)
        moves = variance > 0.0
        if not moves.any() or not np.isfinite(H).all():
            return 1.0
        root, target = self._root, y - H @ self._mean
        noise = 0.01 * np.where(moves, variance, 1.0)
        for _ in range(2):
            weight = moves / noise
            information = (H * weight[:, np.newaxis]).reshape(-1, len(root)).T @ H.reshape(-1, len(root))
            precision = root.T @ information @ root + np.eye(len(root))
            right = root.T @ np.einsum("nop,no->p", H, target * weight)
            missed = target - H @ (root @ np.linalg.lstsq(precision, right, rcond=None)[0])
            share = np.mean(missed**2, axis=0)[moves] / variance[moves]
            noise[moves] = np.maximum(share, _LEAST_NOISE) * variance[moves]
        return float(np.mean(np.minimum(share, 1.0)))

    def left_without(self, one: _Degrees) -> float:
        """Return the residual's share with signals set to 0."""
        X = self.X.copy()
        X[:, one.columns] = 0.0
        return self.left(X, self.y)

    def costs(self, X: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the log share of the variance of each column of y that each joint leaves, (joint, column)."""
        # A column of y is regressed on the joint's torque by the model, its friction and its acceleration. Columns that
        # do not vary have the cost 0.
        q, v, a = np.split(X, 3, axis=1)
        designs = np.stack([self._body.forces(q, v, a), v, np.sign(v), a], axis=2).swapaxes(0, 1)
        designs -= designs.mean(axis=1, keepdims=True)
        size = np.linalg.norm(designs, axis=1, keepdims=True)
        vectors, values, _ = np.linalg.svd(designs / np.where(size > 0.0, size, 1.0), full_matrices=False)
        centred = y - y.mean(axis=0)
        projected = np.einsum("jnk,ni->jki", vectors * (values > 1e-8)[:, np.newaxis], centred)
        total = np.sum(centred**2, axis=0)
        share = np.sum(projected**2, axis=1) / np.where(total > 0.0, total, np.inf)
        return np.log(np.maximum(1.0 - share, _LEAST_SHARE))


def _much_less(left: float, before: float) -> bool:
    return left <= _FALL * before and left <= before - _LEAST_FALL


def _beyond_limits(model: Any, q: np.ndarray) -> tuple[dict[int, str], list[int]]:
    """Describe the joints with positions beyond their limits, and list those that may be in degrees."""
    said: dict[int, str] = {}
    degrees: list[int] = []
    turns = np.any(joint_axes(model)[:, 3:], axis=1)
    least, largest = q.min(axis=0).tolist(), q.max(axis=0).tolist()
    for joint, name in enumerate(list(model.names)[1:]):
        lower, upper = float(model.lowerPositionLimit[joint]), float(model.upperPositionLimit[joint])
        if not lower < upper or max(-lower, upper) > _LARGEST_LIMIT:
            continue
        if turns[joint] and abs(upper - lower - 2.0 * np.pi) < _A_TURN:
            continue
        margin = _BEYOND * (upper - lower)
        if least[joint] >= lower - margin and largest[joint] <= upper + margin:
            continue
        said[joint] = (
            f"{name!r} (from {least[joint]:.3g} to {largest[joint]:.3g}, with limits of {lower:.3g} and {upper:.3g} "
            f"{'rad' if turns[joint] else 'm'})"
        )
        if turns[joint] and max(-least[joint], largest[joint]) > max(_DEGREES * max(-lower, upper), 2.0 * np.pi):
            degrees.append(joint)
    return said, degrees


def _of_limits(said: dict[int, str], degrees: list[int]) -> list[str]:
    found = []
    if large := [joint for joint in said if joint in degrees]:
        found.append(f"positions of {_listed(said, large)} look like degrees, and must be in radians")
    if others := [joint for joint in said if joint not in degrees]:
        found.append(f"positions of {_listed(said, others)} are beyond the joints' limits")
    return found


def _listed(said: dict[int, str], joints: list[int]) -> str:
    more = f" and {len(joints) - _MOST_SAID} more" if len(joints) > _MOST_SAID else ""
    return ", ".join(said[joint] for joint in joints[:_MOST_SAID]) + more


class _Degrees(NamedTuple):
    """Signals that may be in degrees, with the rows X with these in radians, and the residual's share with X."""

    blocks: tuple[str, ...]
    joints: list[int]
    columns: list[int]
    X: np.ndarray
    left: float

    def said(self, names: list[str]) -> str:
        what = " and ".join(", ".join(_BLOCKS[block] for block in self.blocks).rsplit(", ", 1))
        return f"{what} of {_some([names[joint] for joint in self.joints])} look like degrees, and must be in radians"


def _degrees(trial: _Trial, suspects: list[int]) -> list[_Degrees]:
    """List signals that may be in degrees, for all revolute joints and for the suspects."""
    n, turning, found = len(trial.names), np.flatnonzero(trial.turns).tolist(), []
    for joints in [turning] * bool(turning) + [suspects] * (bool(suspects) and suspects != turning):
        for blocks in _UNITS:
            places = [[n * "qva".index(block) + joint for joint in joints] for block in blocks]
            if all(np.abs(trial.X[:, columns]).max() > _RADIANS for columns in places):
                columns, X = [column for block in places for column in block], trial.X.copy()
                X[:, columns] *= np.pi / 180.0
                found.append(_Degrees(blocks, joints, columns, X, trial.left(X, trial.y)))
    return found


def _order(trial: _Trial, X: np.ndarray) -> list[str]:
    """Return a sentence on the order of columns, if another order explains torques far better."""
    n = len(trial.names)
    if n == 1:
        return []
    some = evenly_spread(len(X), _ROWS_OF_SEARCH)
    x, y = X[some], trial.y[some]
    found = {
        "X and y": _best_order(trial.names, lambda order: np.trace(trial.costs(_taken(x, order), y[:, order]))),
        "X": _best_order(trial.names, lambda order: np.trace(trial.costs(_taken(x, order), y))),
        "y": linear_sum_assignment(trial.costs(x, y))[1].tolist(),
    }
    trials = []
    for what, order in found.items():
        if order != list(range(n)):
            moved_x = X if what == "y" else _taken(X, order)
            moved_y = trial.y if what == "X" else trial.y[:, order]
            trials.append((trial.left(moved_x, moved_y), what, order))
    if not trials:
        return []
    left, what, order = min(trials)
    if not _much_less(left, trial.left(X, trial.y)):
        return []
    columns = [trial.names[joint] for joint in np.argsort(order)]
    return [f"the columns of {what} seem to be in the order {columns}, and must be in the robot's: {trial.names}"]


def _taken(X: np.ndarray, order: Sequence[int]) -> np.ndarray:
    """Return rows in which joint j has column order[j] of each block."""
    n = len(order)
    return X[:, [n * block + column for block in range(3) for column in order]]


def _best_order(names: list[str], cost: Callable[[list[int]], float]) -> list[int]:
    n = len(names)
    identity = list(range(n))
    if n <= _MOST_ALL:
        return min(map(list, permutations(identity)), key=cost)
    # Some drivers sort joints by name, or begin at the tip.
    starts = [identity, np.argsort(np.argsort(names)).tolist(), identity[::-1]]
    best, lowest, trials = identity, np.inf, 0
    for start in starts:
        here, level = start, cost(start)
        while n <= _MOST_SEARCHED and trials < _MOST_TRIALS:
            near = [(cost(order), order) for order in _neighbours(here)]
            trials += len(near)
            if min(near)[0] >= level:
                break
            level, here = min(near)
        if level < lowest:
            best, lowest = here, level
    return best


def _neighbours(order: list[int]) -> Iterator[list[int]]:
    """Yield the orders with two joints exchanged or one joint moved."""
    for first, second in combinations(range(len(order)), 2):
        swapped = order.copy()
        swapped[first], swapped[second] = swapped[second], swapped[first]
        yield swapped
        if second > first + 1:
            for source, target in ((first, second), (second, first)):
                moved = order.copy()
                moved.insert(target, moved.pop(source))
                yield moved


def _some(names: list[str]) -> str:
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return f"{names[:_MOST_NAMED]}{more}"
