"""The regression of torques: rows of logs, features, the prior of the weights, and the velocities of friction."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import clone

from ..exceptions import RobotModelWarning, ignored
from ..features import RigidBodyRegressor
from ..fitting.prior import wide_scale
from ..fitting.theta import ThetaPosterior
from ..maps.theta import Theta
from ..utils.state import StatefulEstimator
from ..utils.validation import check_magnitude, checked_groups
from .rows_of_logs import blocks_of, groups_of
from .stiction import VELOCITY_PRIOR, MeanFriction
from .weights import Prior, Rows, Weights, identify, with_gains, with_others

# The search of v_s ends if all steps are shorter than the first number, in posterior standard deviations, or after the
# second number of steps. The third number is the longest step, in prior standard deviations.
_SETTLED, _VELOCITY_STEPS, _LONGEST = 0.1, 6, 1.0


class TorqueRegression(StatefulEstimator):
    """Base of `InverseDynamics` that makes the rows of a regression and finds the weights."""

    robot: Any
    gain_scale: float
    stiction_velocity: Literal["auto"] | None
    learn_scales: bool
    feature_map_: Any
    _weights: Weights
    # The point where mean friction is linearised, and the posterior of the v_s. None if v_s is not learned.
    _friction_at: MeanFriction | None = None
    _theta: ThetaPosterior | None = None

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
        """Return H (n, o, p). Without a robot, each output has its own weights and a constant."""
        H = self.feature_map_.transform(X)
        if H.ndim == 3:
            if self._friction_at is None:
                return H
            return np.concatenate([H, self._friction_at.slopes(self._speed(X, n_outputs))], axis=2)
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
        """Find the weights and the velocities v_s of mean friction, and return the rows."""
        self._friction_at = self._theta = None
        rows = self._as_rows(X, y, groups, pieces)
        prior = self._prior(rows)
        coulomb = prior.coulomb
        if self.stiction_velocity is None or coulomb is None:
            self._weights = identify(rows, prior)
            return rows
        # Gauss-Newton: the derivatives of friction in the coordinates z of v_s are added to the features. Their weights
        # are the step to the mode, and the covariance of the weights is the posterior covariance of z there.
        n_outputs = y.shape[1]
        friction = MeanFriction(np.zeros(n_outputs), np.zeros(n_outputs))
        features = friction.on(rows.features, rows.speed, coulomb)
        self._weights = identify(replace(rows, features=features), replace(prior, velocity=friction.velocity))
        p = self._weights.n_weights
        own = slice(p, p + n_outputs)
        prior = with_others(self._weights.prior, np.ones(n_outputs))
        weights, z = self._weights.with_others(n_outputs), friction.z
        direction, damping = np.zeros(n_outputs), np.ones(n_outputs)
        for _ in range(_VELOCITY_STEPS):
            friction = MeanFriction(weights.mean[coulomb], z)
            features = friction.on(rows.features, rows.speed, coulomb)
            linear = replace(rows, features=np.concatenate([features, friction.slopes(rows.speed)], axis=2))
            mean = prior.mean.copy()
            mean[own] = -z
            weights = identify(linear, replace(prior, mean=mean, velocity=friction.velocity), start=weights)
            step, std = weights.mean[own], np.sqrt(np.diag(weights.covariance)[own])
            if (np.abs(step) < _SETTLED * std).all():
                break
            # A step against the last one means that the last one was too long.
            damping = np.where(direction * step < 0.0, 0.5 * damping, damping)
            direction, z = step, z + damping * np.clip(step, -_LONGEST, _LONGEST)
        self._weights, self._friction_at = weights, friction
        self._theta = self._velocities(friction.z + step, weights.covariance[own, own])
        with ignored(category=RobotModelWarning):  # the first fit of the map has warned
            self.feature_map_.set_params(stiction_velocity=friction.velocity).fit(X)
        return linear

    def _velocities(self, mean: np.ndarray, covariance: np.ndarray) -> ThetaPosterior:
        """Return the posterior of v_s of all joints."""
        n_outputs = len(mean)
        names = tuple(f"stiction_velocity({joint})" for joint in self._output_names(n_outputs))
        empty = ("",) * n_outputs
        return ThetaPosterior(
            Theta((), (0,) * n_outputs, names, names, (VELOCITY_PRIOR,) * n_outputs, empty), mean, covariance
        )

    def _map(self) -> RigidBodyRegressor:
        if isinstance(self.robot, RigidBodyRegressor):
            if self.robot.parameters:
                raise ValueError(
                    f'{type(self).__name__} finds stiction velocities itself, with stiction_velocity="auto". Leave '
                    f"parameters of RigidBodyRegressor at None; got {list(self.robot.parameters)}."
                )
            return clone(self.robot)
        return RigidBodyRegressor(self.robot)

    def _prior(self, rows: Rows) -> Prior:
        """Return the prior of the weights and gains. That of the weights is the feature map's, or a wide one."""
        features, y = rows.features, rows.targets
        n_outputs = y.shape[1]
        names = [str(name) for name in self._names(n_outputs)]
        if hasattr(self.feature_map_, "coef_prior"):
            mean, covariance = self.feature_map_.coef_prior(n_outputs)
        else:
            triangles = np.linalg.qr(features.transpose(1, 0, 2)).R
            scale = wide_scale(
                triangles, len(y), np.abs(y).max(axis=0), shared=True, moderate=y.size < 10 * features.shape[-1]
            )[0]
            mean, covariance = np.zeros(len(scale)), np.diag(scale**2)
        coulomb = np.array([number for number, name in enumerate(names) if name.startswith("coulomb(")])
        inertial = np.arange(len(names)) < (10 * n_outputs if self._has_robot else 0)
        velocity = np.broadcast_to(getattr(self.feature_map_, "stiction_velocity", 0.01), n_outputs)  # v_s, (o,)
        groups = None
        if self.learn_scales and hasattr(self.feature_map_, "coef_groups"):
            groups = np.asarray(self.feature_map_.coef_groups(n_outputs), dtype=object)
        prior = Prior(mean, covariance, inertial, coulomb if len(coulomb) else None, velocity, groups)
        return with_gains(prior, n_outputs, self.gain_scale if self._has_robot else 0.0)
