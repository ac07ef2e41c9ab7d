"""What all maps of a robot share: they take rows x = [q, q̇, u]; those of features know which states y holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted, validate_data

from .._sklearn import check_feature_names_in, fit_context
from .._validation import is_plain
from ..robots import Layout, layout_of
from ..robots.loading import Robot, read_once


def indices_of(chosen: Sequence[int | str], names: Sequence[str], argument: str, things: str) -> list[int]:
    """Indices from 0 of what a user chose by index or name, or an error that names the argument and lists the names."""
    indices = [names.index(choice) if choice in names else choice for choice in chosen]
    for index in indices:
        if isinstance(index, bool) or not isinstance(index, (int, np.integer)) or not 0 <= index < len(names):
            raise ValueError(f"{argument}={list(chosen)!r} must be indices or names of the {things} {list(names)}.")
    return [int(index) for index in indices]


class RobotTransformer(TransformerMixin, BaseEstimator):
    """A transformer of rows x = [q, q̇, u] of a robot; without a robot it takes any number of columns.

    What a subclass says: `_features`, their `_jacobian` and `_names`, and `_prepare` what it needs of the robot.
    """

    robot: Robot | None

    _parameter_constraints: ClassVar[dict[str, Any]] = {"robot": "no_validation"}

    @fit_context(prefer_skip_nested_validation=True)
    def fit(self, X: ArrayLike, y: object = None) -> Self:
        """Load the robot and check the columns.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows [q, q̇, u]; any width without a robot.
        y : None
            Ignored.

        Returns
        -------
        self : RobotTransformer
            Fitted.

        Raises
        ------
        ImportError
            If the robot needs Pinocchio and it is not installed; the message gives the pip command.
        ValueError, TypeError
            If the robot is unknown, or X does not have its 2 * n_joints + n_inputs columns.
        """
        validate_data(self, X, dtype=np.float64)
        robot = None if self.robot is None else read_once(self.robot)
        if robot is not None:
            self._layout = layout_of(robot)
            if self.n_features_in_ != self._layout.n_columns:
                raise ValueError(
                    f"X has {self.n_features_in_} columns, but {type(self).__name__} of the robot "
                    f"{self._layout.name!r} needs {self._layout.n_columns}: {self._layout.column_names}."
                )
            self._check_order()
        self._prepare(robot)
        return self

    def _check_order(self) -> None:
        """Columns that bear the robot's own names must be in its order."""
        names = list(getattr(self, "feature_names_in_", []))
        if names != self._layout.column_names and set(names) == set(self._layout.column_names):
            raise ValueError(f"The columns of X must be in the robot's order {self._layout.column_names}; got {names}.")

    def transform(self, X: ArrayLike) -> np.ndarray:
        """Evaluate the features.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows with the columns of `fit`.

        Returns
        -------
        H : ndarray of shape (n_samples, n_features_out)
            The features h(x) of each row.
        """
        return self._features(self._checked(X))

    def jacobian(self, X: ArrayLike) -> np.ndarray:
        """Differentiate the features by the columns of X.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows with the columns of `fit`.

        Returns
        -------
        J : ndarray of shape (n_samples, n_features_out, n_features)
            The analytic derivatives dh(x)/dx of each row.

        Notes
        -----
        Gravity as link i sees it, from which `LinkGravity` makes its features, turns with each joint j that turns and
        bears the link, about the axis a_j: ∂(Rᵢᵀ g)/∂q_j = Rᵢᵀ (g × a_j). The derivatives of `NominalDynamics` are
        Pinocchio's (Carpentier & Mansard, "Analytical derivatives of rigid body dynamics algorithms", RSS 2018).
        """
        return self._jacobian(self._checked(X))

    def _checked(self, X: ArrayLike) -> np.ndarray:
        if not hasattr(self, "n_features_in_"):
            check_is_fitted(self)
        return X if is_plain(self, X) else validate_data(self, X, dtype=np.float64, reset=False)  # type: ignore[return-value]

    def get_feature_names_out(self, input_features: ArrayLike | None = None) -> np.ndarray:
        """Name the features.

        Parameters
        ----------
        input_features : array-like of str, default=None
            Names of the columns of X; by default those seen in `fit`, or the robot's own.

        Returns
        -------
        names : ndarray of str of shape (n_features_out,)
            One per column of what `transform` returns.
        """
        check_is_fitted(self)
        if self.robot is not None and input_features is None and not hasattr(self, "feature_names_in_"):
            input_features = np.array(self._layout.column_names, dtype=object)
        return np.array(self._names(check_feature_names_in(self, input_features)), dtype=object)

    def _prepare(self, robot: Robot | None) -> None:
        """What `fit` keeps of the robot (read) besides the layout; nothing here."""

    def _features(self, X: np.ndarray) -> np.ndarray:
        """h(x) of rows (n, n_features_in_); without a robot too."""
        raise NotImplementedError

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        """dh/dx of the same rows, (n, n_features_out, n_features_in_)."""
        raise NotImplementedError

    def _names(self, columns: np.ndarray) -> list[str]:
        """Names of the features, given those of the columns of X."""
        raise NotImplementedError


def same_for_all(jacobian: np.ndarray, n_rows: int) -> np.ndarray:
    """A copy of one row's Jacobian (n_features_out, n_features_in_) for each of the rows."""
    copies = np.empty((n_rows, *jacobian.shape))
    copies[:] = jacobian
    return copies


def _has_robot(transformer: RobotMap) -> bool:
    if transformer.robot is None:
        raise AttributeError("coef_prior needs a robot: without one the weights have no physical meaning.")
    return True


class RobotMap(RobotTransformer):
    """Features of a robot that know which states y holds, and a prior of their weights: `_prior`."""

    outputs: Sequence[int | str] | None

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **RobotTransformer._parameter_constraints,
        "outputs": ["array-like", None],
    }

    @available_if(_has_robot)
    def coef_prior(self, n_outputs: int) -> tuple[np.ndarray, np.ndarray]:
        """Give the prior of the weights β.

        Parameters
        ----------
        n_outputs : int
            How many states are predicted: all 2 * n_joints, or as many as ``outputs`` says.

        Returns
        -------
        mean, scale : ndarray of shape (n_outputs, n_features_out)
            Means and standard deviations.

        Raises
        ------
        ValueError
            If ``n_outputs`` does not fit the robot, or a parameter is out of its range.
        """
        self._validate_params()
        layout = self._layout if hasattr(self, "_layout") else layout_of(self.robot)
        mean, scale = self._prior(layout)
        rows = self._predicted_states(layout)
        if n_outputs != len(rows):
            names = [layout.state_names[row] for row in rows]
            raise ValueError(
                f"y has {n_outputs} columns, but {type(self).__name__} of the robot {layout.name!r} predicts "
                f"{len(rows)} states: {names}. Say which ones y holds with outputs=[...]; the names are "
                f"{layout.state_names}."
            )
        return mean[rows], scale[rows]

    def _predicted_states(self, layout: Layout) -> list[int]:
        names = layout.state_names
        if self.outputs is None:
            return list(range(len(names)))
        return indices_of(self.outputs, names, "outputs", "states")

    def _prior(self, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
        """Mean and scale (2 * n_joints, n_features_out) of the weights for all states; before `fit` too."""
        raise NotImplementedError
