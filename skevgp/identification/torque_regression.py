"""The regression of torques: rows of logs, features, the prior of weights, and speeds of static friction."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import clone

from ..exceptions import RobotModelWarning, ignored
from ..features import RigidBodyRegressor
from ..fitting.prior import wide_scale
from ..utils.state import StatefulEstimator
from ..utils.validation import check_magnitude, checked_groups
from .rows_of_logs import blocks_of, groups_of
from .stiction import likeliest_velocity
from .weights import Prior, Rows, Weights, identify, with_gains

# Maximum number of rounds for the speeds above which friction has a sign.
_STICTION_ROUNDS = 3


class TorqueRegression(StatefulEstimator):
    """Base of `InverseDynamics` that turns its rows into those of a regression, and finds the weights."""

    robot: Any
    gain_scale: float
    stiction_velocity: Literal["auto"] | None
    learn_scales: bool
    feature_map_: Any
    _weights: Weights

    @property
    def _has_robot(self) -> bool:
        return bool(getattr(self.feature_map_, "share_coef", False))

    def _as_rows(self, X: np.ndarray, y: np.ndarray, groups: ArrayLike | None, pieces: ArrayLike | None) -> Rows:
        n, n_outputs = y.shape
        labels = checked_groups(groups, n)
        runs = checked_groups(pieces, n, "pieces")
        if runs is None:
            runs = np.zeros(n, dtype=int) if labels is None else labels
        features = self._features(X, n_outputs)
        check_magnitude(features, "What feature_map_ returns")
        blocks = blocks_of(labels, n)
        n_moves = 1 if labels is None else len(np.unique(labels))
        return Rows(features, y, self._speed(X, n_outputs), runs, groups_of(labels, blocks), blocks, n_moves)

    def _speed(self, X: np.ndarray, n_outputs: int) -> np.ndarray:
        """Return q̇ of each joint, (n, o)."""
        return X[:, n_outputs : 2 * n_outputs] if self._has_robot else np.zeros((len(X), n_outputs))

    def _features(self, X: np.ndarray, n_outputs: int) -> np.ndarray:
        """Return H (n, o, p); without a robot, each output has its own weights and a constant."""
        H = self.feature_map_.transform(X)
        if H.ndim == 3:
            return H
        own = np.column_stack([H, np.ones(len(H))])
        features = np.zeros((len(H), n_outputs, n_outputs, own.shape[1]))
        features[:, range(n_outputs), range(n_outputs)] = own[:, np.newaxis]
        return features.reshape(len(H), n_outputs, -1)

    def _names(self, n_outputs: int) -> np.ndarray:
        names = self.feature_map_.get_feature_names_out()
        if self._has_robot:
            return names
        return np.array([f"{name}({o})" for o in range(n_outputs) for name in [*names, "1"]], dtype=object)

    def _output_names(self, n_outputs: int) -> list[str]:
        layout = getattr(self.feature_map_, "_layout", None)
        return [f"output {o}" for o in range(n_outputs)] if layout is None else list(layout.position_names)

    def _own(self, X: np.ndarray, torque: np.ndarray, joint: int) -> np.ndarray:
        """Return x_j, the inputs of f_j."""
        if not self._has_robot:
            return X
        return np.column_stack([X[:, joint :: torque.shape[1]], torque[:, joint]])

    def _find_weights(self, X: np.ndarray, y: np.ndarray, groups: ArrayLike | None, pieces: ArrayLike | None) -> Rows:
        """Find the weights and the speeds above which friction has a sign; returns the rows."""
        rows = self._as_rows(X, y, groups, pieces)
        prior = self._prior(rows)
        self._weights = identify(rows, prior)
        # One trajectory has little information on these speeds in others.
        labels = checked_groups(groups, len(X))
        several = labels is not None and labels.max() > 1
        if not (several and self.stiction_velocity == "auto" and prior.coulomb is not None):
            return rows
        for _ in range(_STICTION_ROUNDS):
            velocity = self._likeliest_velocities(rows)
            if (velocity == prior.velocity).all():
                break
            with ignored(category=RobotModelWarning):  # given already
                self.feature_map_.set_params(stiction_velocity=velocity).fit(X)
            rows = replace(rows, features=self._features(X, y.shape[1]))
            prior = replace(self._weights.prior, velocity=velocity)
            self._weights = identify(rows, prior, start=self._weights)
        return rows

    def _likeliest_velocities(self, rows: Rows) -> np.ndarray:
        weights, prior = self._weights, self._weights.prior
        left = rows.targets - weights.predict(rows.features)
        return np.array(
            [
                likeliest_velocity(
                    left[:, j],
                    rows.speed[:, j],
                    float(weights.mean[coulomb]),
                    float(prior.velocity[j]),
                    float(weights.correlation_time[j]),
                    weights.noise[j].variance,
                )
                for j, coulomb in enumerate(prior.coulomb)  # type: ignore[arg-type]
            ]
        )

    def _map(self) -> RigidBodyRegressor:
        if isinstance(self.robot, RigidBodyRegressor):
            if self.robot.parameters:
                raise ValueError(
                    f'{type(self).__name__} finds stiction velocities itself, by stiction_velocity="auto": leave the '
                    f"parameters of RigidBodyRegressor at None; got {list(self.robot.parameters)}."
                )
            return clone(self.robot)
        return RigidBodyRegressor(self.robot)

    def _prior(self, rows: Rows) -> Prior:
        """Return the prior of the weights, that of the map or a wide one, and of gains."""
        features, y = rows.features, rows.targets
        n_outputs = y.shape[1]
        names = [str(name) for name in self._names(n_outputs)]
        if hasattr(self.feature_map_, "coef_prior"):
            mean, covariance = self.feature_map_.coef_prior(n_outputs)
        else:
            size = np.sqrt(np.mean(features**2, axis=0))
            scale = wide_scale(size, y.std(axis=0), np.abs(y).max(axis=0), shared=True)[0]
            mean, covariance = np.zeros(len(scale)), np.diag(scale**2)
        coulomb = np.array([number for number, name in enumerate(names) if name.startswith("coulomb(")])
        inertial = np.arange(len(names)) < (10 * n_outputs if self._has_robot else 0)
        velocity = np.broadcast_to(getattr(self.feature_map_, "stiction_velocity", 0.01), n_outputs)  # v_s, (o,)
        groups = None
        if self.learn_scales and hasattr(self.feature_map_, "coef_groups"):
            groups = np.asarray(self.feature_map_.coef_groups(n_outputs), dtype=object)
        prior = Prior(mean, covariance, inertial, coulomb if len(coulomb) else None, velocity, groups)
        return with_gains(prior, n_outputs, self.gain_scale if self._has_robot else 0.0)
