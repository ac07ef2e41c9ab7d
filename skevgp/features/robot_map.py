"""Base classes of all maps of a robot, for rows x = [q, q̇, u] or [q, q̇, u, Δt]."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import TransformerMixin
from sklearn.utils import assert_all_finite
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted, validate_data

from ..robots import Layout, layout_of
from ..robots.loading import Robot, read_once
from ..utils.sklearn import check_feature_names_in, fit_context
from ..utils.state import StatefulEstimator
from ..utils.validation import as_floats, is_plain
from .theta import Prior, check_prior, is_positive

# Default time step, s.
STEP = 0.03


def indices_of(chosen: Sequence[int | str], names: Sequence[str], argument: str, things: str) -> list[int]:
    """Return indices from 0 of choices by index or name, or raise an error that lists the names."""
    indices = [names.index(choice) if choice in names else choice for choice in chosen]
    for index in indices:
        if isinstance(index, bool) or not isinstance(index, (int, np.integer)) or not 0 <= index < len(names):
            raise ValueError(f"{argument}={list(chosen)!r} must be indices or names of the {things} {list(names)}.")
    return [int(index) for index in indices]


def joints_named(names: Sequence[str], joints: Sequence[str]) -> list[str] | None:
    """Return the joint in each name, such as "elbow" in "position/elbow"; None if a name has none."""
    # If a name contains several joints, the longest counts. A joint ends where no letter or digit follows.
    longest = sorted(joints, key=len, reverse=True)
    words = [re.compile(rf"(?<![A-Za-z0-9]){re.escape(joint)}(?![A-Za-z0-9])") for joint in longest]
    found = [
        next((joint for joint, word in zip(longest, words, strict=True) if word.search(name)), "") for name in names
    ]
    return found if all(found) else None


class RobotTransformer(TransformerMixin, StatefulEstimator):
    """A transformer of rows x = [q, q̇, u] of a robot, or of any columns without a robot.

    A subclass defines `_features`, `_jacobian`, `_names`, and `_prepare` for data that it needs from the robot. With
    ``dt="column"`` rows of a robot have their time step as last column.
    """

    robot: Robot | None
    dt: float | Literal["column"] | None = None
    _timed = False  # whether rows ended with their time step in the last fit
    _n_blocks: ClassVar[int] = 2  # number of blocks with one column per joint: [q, q̇]
    _begins_with_state: ClassVar[bool] = False

    _parameter_constraints: ClassVar[dict[str, Any]] = {"robot": "no_validation"}

    @fit_context(prefer_skip_nested_validation=True)
    def fit(self, X: ArrayLike, y: object = None) -> Self:
        """Load the robot and check the columns.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows [q, q̇, u], or [q, q̇, u, Δt] with ``dt="column"``. `RigidBodyRegressor` takes rows [q, q̇, q̈].
            Without a robot, X may have any columns.
        y : None
            Ignored.

        Returns
        -------
        self : RobotTransformer
            The transformer itself, fitted.

        Raises
        ------
        ImportError
            If the robot needs Pinocchio, which is not installed.
        ValueError, TypeError
            If the robot is unknown, X has other columns than the robot, or a time step is not positive. If X is a data
            frame with the joints in another order.

        Warns
        -----
        RobotModelWarning
            If the model of the robot is unphysical, as in `skevgp.datasets.load_robot`.
        """
        self._timed = self._takes_steps()
        rows: np.ndarray = validate_data(self, X, dtype=np.float64, ensure_all_finite=not self._timed)
        robot = None if self.robot is None else read_once(self.robot)
        if robot is not None:
            self._layout = layout_of(robot)
            self._check_columns()
            self._check_steps(rows)
            self._mean_step = float(rows[:, -1].mean()) if self._timed else None
        self._prepare(robot)
        self._prepare_parameters()
        return self

    def _takes_steps(self) -> bool:
        return self.robot is not None and isinstance(self.dt, str)

    def _column_names(self) -> list[str]:
        return self._layout.column_names + ["dt"] * self._timed

    def _check_columns(self) -> None:
        """Raise ValueError unless X has the robot's columns in the robot's order, and dt last."""
        wanted, names = self._column_names(), list(getattr(self, "feature_names_in_", []))
        if self.n_features_in_ != len(wanted):
            hint, takes_steps = ".", not self._timed and "dt" in self.get_params(deep=False)
            if self._timed:
                hint = "; the last one, dt, is the time step of each row in seconds."
            elif takes_steps and self.n_features_in_ == len(wanted) + 1:
                hint = '. If the last column is the time step of each row, pass dt="column".'
            # Joints with a motor have three columns each, also the accelerations of `RigidBodyRegressor`. Rows of
            # `log_transitions` also have a time step.
            n_columns, fewer = self.n_features_in_ - self._timed, range(3, 3 * self._layout.n_joints, 3)
            one_more = takes_steps and n_columns - 1 in fewer
            if n_columns in fewer or one_more:
                hint += (
                    " If only some joints were recorded, give the robot as load_robot(robot, joints=[...]), which "
                    "locks the others."
                )
            if one_more and len(wanted) + 1 != self.n_features_in_:
                hint += ' If the last column is the time step of each row, also pass dt="column", or leave it out.'
            raise ValueError(
                f"X has {self.n_features_in_} columns, but {type(self).__name__} of the robot "
                f"{self._layout.name!r} needs {len(wanted)}: {wanted}{hint}"
            )
        misplaced = self._timed and "dt" in names[:-1]
        if misplaced or (names != wanted and set(names) == set(wanted)):
            raise ValueError(f"The columns of X must be in the robot's order {wanted}; got {names}.")
        joints = list(self._layout.position_names)
        expected = joints * self._n_blocks
        found = joints_named(names[: len(expected)], joints) if names else None
        if found is not None and found != expected and sorted(found) == sorted(expected):
            raise ValueError(
                f"The columns of X must be in the robot's order {wanted}; by their names they are those of the joints "
                f"{found}."
            )

    def _check_steps(self, X: np.ndarray) -> None:
        """Check time steps first, then that all of X is finite."""
        if self._timed:
            _steps_of(X)
            assert_all_finite(X, estimator_name=type(self).__name__, input_name="X")

    def transform(self, X: ArrayLike) -> np.ndarray:
        """Evaluate the features.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows with the columns of `fit`.

        Returns
        -------
        H : ndarray of shape (n_samples, n_features_out) or (n_samples, n_joints, n_features_out)
            The features h(x) of each row. `RigidBodyRegressor` with a robot returns a row for each joint.
        """
        return self._values(self._checked(X))

    def jacobian(self, X: ArrayLike) -> np.ndarray:
        """Differentiate the features with respect to the columns of X.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows with the columns of `fit`.

        Returns
        -------
        J : ndarray of the shape of H, and (n_features,)
            Derivatives dh(x)/dx of each row. They are analytic, except for `RigidBodyRegressor`, whose derivatives of Y
            are central differences of fourth order.

        Notes
        -----
        `LinkGravity` uses ∂(Rᵢᵀ g)/∂q_j = Rᵢᵀ (g × a_j) for each revolute joint j with axis a_j between the base and
        link i.

        `NominalDynamics` uses the analytical derivatives of Pinocchio (Carpentier & Mansard, RSS 2018).
        """
        return self._slopes(self._checked(X))

    def _checked(self, X: ArrayLike) -> np.ndarray:
        if not hasattr(self, "n_features_in_"):
            check_is_fitted(self)
        rows: Any = X
        if not is_plain(self, X):
            rows = validate_data(self, X, dtype=np.float64, reset=False, ensure_all_finite=not self._timed)
        self._check_steps(rows)
        return rows

    def get_feature_names_out(self, input_features: ArrayLike | None = None) -> np.ndarray:
        """Name the features.

        Parameters
        ----------
        input_features : array-like of str, default=None
            Names of the columns of X. If None, those of `fit`, or those of the robot.

        Returns
        -------
        names : ndarray of str of shape (n_features_out,)
            Name of each column of the result of `transform`.
        """
        check_is_fitted(self)
        if self.robot is not None and input_features is None and not hasattr(self, "feature_names_in_"):
            input_features = np.array(self._column_names(), dtype=object)
        return np.array(self._labels(check_feature_names_in(self, input_features)), dtype=object)

    def _prepare(self, robot: Robot | None) -> None:
        """Store data of the robot at `fit`, besides the layout; the base class stores nothing."""

    def _prepare_parameters(self) -> None:
        """Set the parameters at the end of `fit`; only subclasses of `ParametricMap` have some."""

    def _n_kept(self, layout: Layout) -> int:
        """Number of columns of the state before the features that are multiplied by Δt."""
        return 2 * layout.n_joints if self._begins_with_state else 0

    def _values(self, X: np.ndarray) -> np.ndarray:
        """Return the result of `transform` for validated rows."""
        return self._features(X)

    def _slopes(self, X: np.ndarray) -> np.ndarray:
        """Return the result of `jacobian` for validated rows."""
        return self._jacobian(X)

    def _labels(self, columns: np.ndarray) -> list[str]:
        """Return the names of the columns of `transform`, given those of X."""
        return self._names(columns)

    def _features(self, X: np.ndarray) -> np.ndarray:
        """Return h(x) of rows (n, n_features_in_), also without a robot."""
        raise NotImplementedError

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        """Return dh/dx of rows (n, n_features_in_), (n, n_features_out, n_features_in_)."""
        raise NotImplementedError

    def _names(self, columns: np.ndarray) -> list[str]:
        """Return the names of the features, given those of the columns of X."""
        raise NotImplementedError


def _steps_of(X: np.ndarray) -> np.ndarray:
    """Return the time step of each row, (n, 1); ValueError if one is not positive and finite."""
    dt = X[:, -1:]
    if not (dt > 0.0).all() or not (dt < np.inf).all():
        row = np.argmin((dt > 0.0) & (dt < np.inf))
        raise ValueError(
            f"dt, the last column of X, is the time step of each row in seconds: it must be positive and finite; "
            f"row {row} has {dt[row, 0]}."
        )
    return dt


class ParametricMap(RobotTransformer):
    """A map of a robot with parameters θ that a regressor learns, if it is given some (see `features.theta`).

    A parameter belongs to a kind, such as "mass", and to some joints. A subclass defines `_allowed_parameters` and
    `_theta_derivatives`, and takes the values at ``theta_`` from `_at_theta`.
    """

    parameters: Mapping[str, Prior] | None
    # Kinds whose values may be 0 or negative.
    _signed: ClassVar[tuple[str, ...]] = ()
    # Kind and joints of each parameter.
    _targets: dict[str, tuple[str, list[int]]]

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **RobotTransformer._parameter_constraints,
        "parameters": [dict, None],
    }

    def theta_prior(self) -> dict[str, Prior]:
        """Return the prior of each parameter.

        Returns
        -------
        priors : dict of str to prior
            The argument ``parameters``. It is empty if the map has no parameters.
        """
        return dict(self.parameters or {})

    def set_theta(self, theta: Mapping[str, float]) -> None:
        """Set the parameters.

        Parameters
        ----------
        theta : dict of str to float
            Value of each parameter.
        """
        self.theta_ = {name: float(theta[name]) for name in self._targets}
        self._store_theta()

    def theta_jacobian(self, X: np.ndarray) -> np.ndarray:
        """Differentiate the features in the parameters at ``theta_``.

        Parameters
        ----------
        X : ndarray of shape (n_samples, n_features)
            Rows with the columns of `fit`.

        Returns
        -------
        jacobian : ndarray of the shape of the features, and (n_theta,)
            Derivatives ∂h/∂θ, in the order of ``parameters``.
        """
        X = np.asarray(X, dtype=np.float64)
        if not self._timed:
            return self._theta_derivatives(X)
        x, dt, n_kept = X[:, :-1], _steps_of(X), self._n_kept(self._layout)
        inner = self._theta_derivatives(x)
        jacobian = np.zeros((len(X), n_kept + inner.shape[1], inner.shape[2]))
        jacobian[:, n_kept:] = dt[:, :, np.newaxis] * inner
        return jacobian

    @property
    def units(self) -> dict[str, str]:
        """Units of the parameters, for `summary`."""
        targets = getattr(self, "_targets", {})
        return {name: self._unit(kind, joints) for name, (kind, joints) in targets.items()}

    def _prepare_parameters(self) -> None:
        self._targets = self._checked_parameters()
        if self._targets:
            self.set_theta({name: prior.value(0.0) for name, prior in self.theta_prior().items()})
        elif hasattr(self, "theta_"):
            del self.theta_

    def _checked_parameters(self) -> dict[str, tuple[str, list[int]]]:
        """Return the kind and the joints of each parameter."""
        priors = self.theta_prior()
        if priors and self.robot is None:
            raise ValueError(f"parameters={list(priors)} of {type(self).__name__} need a robot.")
        allowed = self._allowed_parameters() if priors else {}
        targets: dict[str, tuple[str, list[int]]] = {}
        for name, prior in priors.items():
            known = self._synonym(name)
            if known not in allowed:
                raise ValueError(
                    f"{type(self).__name__} of the robot {self._layout.name!r} has no parameter {name!r}. The "
                    f"parameters that it can have are {list(allowed)}.{self._why_not(known)}"
                )
            check_prior(prior, name)
            kind, joints = allowed[known]
            if kind not in self._signed and not is_positive(prior):
                raise ValueError(
                    f"The parameter {name!r} must be above 0, but its prior {prior!r} also allows other values. Use "
                    "LogNormal(median, sigma), or Uniform(low, high) with low=0 or above."
                )
            for other, (its_kind, its_joints) in targets.items():
                if kind == its_kind and set(joints) & set(its_joints):
                    raise ValueError(f"Parameters {other!r} and {name!r} are for the same joint. Remove one of them.")
            targets[name] = kind, joints
        return targets

    def _at_theta(self, kind: str, default: Iterable[Any]) -> list[Any]:
        """Return the values of a kind of parameters for each joint, given those without parameters."""
        values = list(default)
        for name, (own, joints) in self._targets.items():
            for joint in joints if own == kind else ():
                values[joint] = self.theta_[name]
        return values

    def _synonym(self, name: str) -> str:
        """Return the name in `_allowed_parameters` for a parameter's name."""
        return name

    def _why_not(self, name: str) -> str:
        """Return a sentence, after a space, on why a name is not in `_allowed_parameters`, if there is a reason."""
        return ""

    def _allowed_parameters(self) -> dict[str, tuple[str, list[int]]]:
        """Return the names of all possible parameters, with their kind and joints."""
        raise NotImplementedError

    def _theta_derivatives(self, X: np.ndarray) -> np.ndarray:
        """Return the derivatives of `_features` in the parameters."""
        raise NotImplementedError

    def _store_theta(self) -> None:
        """Store what depends on ``theta_``."""

    def _unit(self, kind: str, joints: list[int]) -> str:
        return ""

    def _one_per_joint(self, kinds: Iterable[str], joints: Iterable[int]) -> dict[str, tuple[str, list[int]]]:
        """Return a parameter of each kind for each joint."""
        names, joints = self._layout.position_names, list(joints)
        return {f"{kind}({names[joint]})": (kind, [joint]) for kind in kinds for joint in joints}

    def _speed_unit(self, joints: list[int]) -> str:
        units = {"rad/s" if self._layout.revolute[joint] else "m/s" for joint in joints}
        return units.pop() if len(units) == 1 else ""


def one_per_joint(value: ArrayLike, name: str, n_joints: int) -> np.ndarray:
    """Return positive numbers, () for all joints or (n_joints,), or raise a ValueError."""
    values = as_floats(value, name)
    if values.shape not in ((), (n_joints,)) or not (np.isfinite(values) & (values > 0.0)).all():
        raise ValueError(f"{name}={value!r} must be a number above 0, or one for each of the {n_joints} joints.")
    return values


def has_robot(transformer: RobotTransformer) -> bool:
    if transformer.robot is None:
        raise AttributeError("coef_prior needs a robot: without one the weights have no physical meaning.")
    return True


class VelocityPrior(NamedTuple):
    """Standard deviations of the weights for velocities, (n_joints, n_features) each."""

    # Of the weight divided by Δt. NaN: in units of the data.
    rate: np.ndarray
    # In units of the data: multiples of rms(y - h(x)ᵀμ) / rms of the feature. NaN: ``rate`` holds. If there are both,
    # the smaller standard deviation holds.
    ratio: np.ndarray
    # The label of the group.
    group: np.ndarray

    @classmethod
    def of(cls, n_joints: int, n_features: int, ratio: float, group: str) -> VelocityPrior:
        """All weights alike, in units of the data."""
        shape = n_joints, n_features
        return cls(np.full(shape, np.nan), np.full(shape, ratio, dtype=float), np.full(shape, group, dtype=object))

    def set(self, where: Any, ratio: float, group: str) -> None:
        """Put some weights into another group, in units of the data."""
        self.rate[where], self.ratio[where], self.group[where] = np.nan, ratio, group

    def set_rate(self, where: Any, rate: float, group: str, ratio: float = np.nan) -> None:
        """Put some weights into another group, with a standard deviation of their own, or at most so much."""
        self.rate[where], self.ratio[where], self.group[where] = rate, ratio, group

    def beside(self, other: VelocityPrior) -> VelocityPrior:
        """The prior of these features and further ones."""
        return VelocityPrior(*(np.hstack(pair) for pair in zip(self, other, strict=True)))


class RobotMap(RobotTransformer):
    """Features for predicting states, with a prior of their weights.

    A subclass defines h(x) of x = [q, q̇, u], and `_mean` and `_velocity_prior` of the weights for one time step. With
    ``dt="column"`` features are multiplied by the row's Δt, and weights are per second. Features that begin with the
    state z become [z, Δt h(x)].
    """

    outputs: Sequence[int | str] | None

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **RobotTransformer._parameter_constraints,
        "outputs": ["array-like", None],
    }

    @available_if(has_robot)
    def coef_prior(self, n_outputs: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the part of the prior of the weights β that does not depend on the data.

        Parameters
        ----------
        n_outputs : int
            Number of predicted states, 2 * n_joints or the length of ``outputs``.

        Returns
        -------
        mean, scale : ndarray of shape (n_outputs, n_features_out)
            Means and standard deviations. A standard deviation that depends on the data is NaN (see `coef_scale`).

        Raises
        ------
        ValueError
            If ``n_outputs`` does not fit the robot, or a parameter is out of its range.
        """
        self._validate_params()
        layout = self._known_layout()
        rows, prior = self._checked_states(layout, n_outputs), self._velocity_prior(layout)
        scale = np.where(np.isnan(prior.ratio), prior.rate, np.nan)
        dt = self._typical_step() or STEP
        mean = self._mean(layout, dt)
        # A velocity that is wrong by some amount moves its position by Δt times that.
        scale = np.vstack([dt * scale, scale])
        if not self._takes_steps():
            return mean[rows], dt * scale[rows]
        before = np.eye(2 * layout.n_joints, self._n_kept(layout))
        mean[:, : before.shape[1]] -= before
        mean, scale = np.hstack([before, mean / dt]), np.hstack([np.zeros_like(before), scale])
        return mean[rows], scale[rows]

    @available_if(has_robot)
    def coef_scale(self, left_over: ArrayLike, size: ArrayLike) -> np.ndarray:
        """Return the prior standard deviations that depend on the data.

        Parameters
        ----------
        left_over : array-like of shape (n_outputs,)
            Root mean square of the residual of the prior mean, rms(y - h(x)ᵀμ), for each column of y.
        size : array-like of shape (n_features_out,)
            Root mean square of each feature, above 0.

        Returns
        -------
        scale : ndarray of shape (n_outputs, n_features_out)
            Ratio of the map times ``left_over / size``. For a position, ``left_over`` is Δt times that of its velocity,
            if y has the velocity. The scale is NaN if `coef_prior` gives it.
        """
        layout = self._known_layout()
        left_over = np.asarray(left_over, dtype=float)
        rows, n = self._checked_states(layout, len(left_over)), layout.n_joints
        prior = self._velocity_prior(layout)
        ratio, rate = (self._with_kept(values, layout, np.nan) for values in (prior.ratio, prior.rate))
        found = dict(zip(rows, left_over, strict=True))
        step = self._typical_step()
        change = [
            step * found[row + n] if step is not None and row < n and row + n in found else found[row] for row in rows
        ]
        joints = [row % n for row in rows]
        scale = ratio[joints] * np.array(change)[:, np.newaxis] / np.asarray(size, dtype=float)
        dt = step or STEP
        per_step = np.array([dt if row < n else 1.0 for row in rows])[:, np.newaxis]
        per_step = per_step if self._takes_steps() else dt * per_step
        return np.fmin(scale, np.where(np.isnan(ratio[joints]), np.nan, per_step * rate[joints]))

    @available_if(has_robot)
    def coef_groups(self, n_outputs: int) -> np.ndarray:
        """Name the groups of weights whose standard deviations are learned together.

        Parameters
        ----------
        n_outputs : int
            Number of predicted states.

        Returns
        -------
        labels : ndarray of str of shape (n_outputs, n_features_out)
            Group of each weight. The weights for a position have the groups of those for its velocity, or "known" if
            Newton's law gives them.
        """
        layout = self._known_layout()
        rows = self._checked_states(layout, n_outputs)
        labels, mean = self._velocity_prior(layout).group, self._mean(layout, STEP)[: layout.n_joints]
        if self._takes_steps():
            mean = mean - (self._n_kept(layout) > 0) * np.eye(*mean.shape)  # of the state itself
        # Newton's law gives the weights of a position that are not 0.
        of_positions = np.where(mean != 0.0, "known", labels)
        labels = self._with_kept(np.vstack([of_positions, labels]), layout, "")
        return labels[rows]

    def _known_layout(self) -> Layout:
        return self._layout if hasattr(self, "_layout") else layout_of(self.robot)

    def _checked_states(self, layout: Layout, n_outputs: int) -> list[int]:
        """Return the predicted states, or raise ValueError if their number is not ``n_outputs``."""
        rows = self._predicted_states(layout)
        if n_outputs != len(rows):
            names = [layout.state_names[row] for row in rows]
            raise ValueError(
                f"y has {n_outputs} columns, but {type(self).__name__} of the robot {layout.name!r} predicts "
                f"{len(rows)} states: {names}. Name the columns of y by outputs=[...]. The names are "
                f"{layout.state_names}."
            )
        return rows

    def _typical_step(self) -> float | None:
        """Return the time step, or the mean of those in `fit`. None if it is not known."""
        return float(self.dt) if isinstance(self.dt, Real) else getattr(self, "_mean_step", None)

    def _with_kept(self, values: np.ndarray, layout: Layout, kept: float | str) -> np.ndarray:
        """Return values (n, p) with columns for the state in front, if features begin with it and steps are given."""
        n_kept = self._n_kept(layout) if self._takes_steps() else 0
        return np.hstack([np.full((len(values), n_kept), kept, dtype=values.dtype), values])

    def _predicted_states(self, layout: Layout) -> list[int]:
        names = layout.state_names
        if self.outputs is None:
            return list(range(len(names)))
        return indices_of(self.outputs, names, "outputs", "states")

    def _mean(self, layout: Layout, dt: float) -> np.ndarray:
        """Return the mean (2 * n_joints, n_features) of the weights for all states; works before `fit`."""
        raise NotImplementedError

    def _velocity_prior(self, layout: Layout) -> VelocityPrior:
        """Return the prior standard deviations of the weights for velocities; works before `fit`."""
        raise NotImplementedError

    def _values(self, X: np.ndarray) -> np.ndarray:
        if not self._timed:
            return self._features(X)
        x, dt = X[:, :-1], _steps_of(X)  # rollouts have not checked the time steps
        return np.concatenate((x[:, : self._n_kept(self._layout)], dt * self._features(x)), axis=1)

    def _slopes(self, X: np.ndarray) -> np.ndarray:
        if not self._timed:
            return self._jacobian(X)
        x, dt, n_kept = X[:, :-1], _steps_of(X), self._n_kept(self._layout)
        features = self._features(x)
        jacobian = np.zeros((len(X), n_kept + features.shape[1], X.shape[1]))
        jacobian[:, :n_kept, :n_kept] = np.eye(n_kept)
        jacobian[:, n_kept:, :-1] = dt[:, :, np.newaxis] * self._jacobian(x)
        jacobian[:, n_kept:, -1] = features
        return jacobian

    def _labels(self, columns: np.ndarray) -> list[str]:
        if not self._timed:
            return self._names(columns)
        *x, dt = columns
        kept = x[: self._n_kept(self._layout)]
        return [*kept, *(f"{dt} * {name}" for name in self._names(np.array(x, dtype=object)))]
