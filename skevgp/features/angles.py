"""Angles as sines and cosines, which are the same after a full turn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_array, check_is_fitted

from ..robots.loading import Robot
from ..utils.shapes import same_for_all
from ..utils.sklearn import StrOptions
from .robot_map import RobotTransformer


class AngleEncoder(RobotTransformer):
    """Replace each angle by its sine and cosine, and keep all other columns.

    Pass it as the ``kernel_map`` of a regressor. A kernel of (sin q, cos q) has the same value at q and q + 2π. Thus
    angles on both sides of a full turn are close to each other.

    Parameters
    ----------
    robot : str, path-like, System, pinocchio.Model or None, default=None
        Robot, as in `skevgp.datasets.load_robot`. X then has the columns [q, q̇, u]. If None, X may have any number of
        columns.
    angles : sequence of int or str, default=None
        Columns that are angles in rad, by index or by name. A name is that of a column of the data frame, or of a
        position of the robot. If None, all revolute positions of the robot.
    dt : "column" or None, default=None
        Time step. If ``"column"``, the last column of X is the time step of each row in seconds. It stays as it is.

    Attributes
    ----------
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it has any.

    Notes
    -----
    Sine and cosine replace the angle, in this order. To scale columns, scale after the encoding, as in
    ``make_pipeline(AngleEncoder("acrobot"), StandardScaler())``.

    Examples
    --------
    >>> from skevgp.features import AngleEncoder
    >>> encoder = AngleEncoder("cartpole")
    >>> encoder.fit_transform([[0.5, 1.0, 2.0, 3.0, 4.0]]).round(3)
    array([[0.5  , 0.841, 0.54 , 2.   , 3.   , 4.   ]])
    >>> encoder.get_feature_names_out().tolist()
    ['x', 'sin(theta)', 'cos(theta)', 'dx/dt', 'dtheta/dt', 'u_x']
    """

    def __init__(
        self,
        robot: Robot | None = None,
        *,
        angles: Sequence[int | str] | None = None,
        dt: Literal["column"] | None = None,
    ):
        self.robot = robot
        self.angles = angles
        self.dt = dt

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **RobotTransformer._parameter_constraints,
        "angles": ["array-like", None],
        "dt": [StrOptions({"column"}), None],
    }

    def inverse_transform(self, X: ArrayLike) -> np.ndarray:
        """Turn sines and cosines back into angles.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features_out)
            Encoded rows, as `transform` returns them. A sine and its cosine may have a common positive factor.

        Returns
        -------
        X_original : ndarray of shape (n_samples, n_features)
            Rows with angles in (-π, π].

        Raises
        ------
        ValueError
            If X has another number of columns, or contains NaN or infinity.
        """
        check_is_fitted(self)
        encoded = check_array(X, dtype=np.float64)
        if encoded.shape[1] != len(self._source):
            raise ValueError(
                f"X has {encoded.shape[1]} columns, but {type(self).__name__} made {len(self._source)}: "
                f"{self.get_feature_names_out().tolist()}."
            )
        original = np.empty((len(encoded), self.n_features_in_))
        original[:, self._source] = encoded
        angles = np.arctan2(encoded[:, self._sines], encoded[:, self._cosines])
        original[:, self._angles] = np.where(angles <= -np.pi, np.pi, angles)
        return original

    def _prepare(self, robot: Robot | None) -> None:
        self._angles = np.array(self._columns_of_angles(), dtype=int)
        copies = np.ones(self.n_features_in_, dtype=int)
        copies[self._angles] = 2
        self._source = np.repeat(np.arange(self.n_features_in_), copies)  # the column of X for each encoded column
        self._sines = np.searchsorted(self._source, self._angles)
        self._cosines = self._sines + 1
        self._of_others = np.eye(self.n_features_in_)[self._source]  # the Jacobian without the angles' entries
        self._of_others[:, self._angles] = 0.0

    def _columns_of_angles(self) -> list[int]:
        names = {} if self.robot is None else {name: i for i, name in enumerate(self._layout.column_names)}
        names |= {name: i for i, name in enumerate(getattr(self, "feature_names_in_", []))}
        revolute = [] if self.robot is None else np.flatnonzero(self._layout.revolute).tolist()
        if self.angles is None:
            return revolute
        if self.robot is None:
            allowed = list(range(self.n_features_in_))
            wanted = f"indices of the {self.n_features_in_} columns of X or, if it is a data frame, their names"
        else:
            allowed = revolute
            described = {joint: self._layout.position_names[joint] for joint in revolute}
            wanted = f"indices or names of revolute joints of the robot {self._layout.name!r}: {described}"
        columns = [_index(angle, names) for angle in self.angles]
        if not set(columns) <= set(allowed):
            raise ValueError(f"angles={self.angles!r} must be a sequence of {wanted}.")
        if len(set(columns)) < len(columns):
            raise ValueError(f"angles={self.angles!r} must not name a column twice.")
        return columns

    def _features(self, X: np.ndarray) -> np.ndarray:
        encoded, angles = X.take(self._source, axis=1), X.take(self._angles, axis=1)
        encoded[:, self._sines], encoded[:, self._cosines] = np.sin(angles), np.cos(angles)
        return encoded

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        jacobian, angles = same_for_all(self._of_others, len(X)), X.take(self._angles, axis=1)
        jacobian[:, self._sines, self._angles] = np.cos(angles)
        jacobian[:, self._cosines, self._angles] = -np.sin(angles)
        return jacobian

    def _names(self, columns: np.ndarray) -> list[str]:
        names = columns[self._source]
        for sine, cosine in zip(self._sines, self._cosines, strict=True):
            names[sine], names[cosine] = f"sin({names[sine]})", f"cos({names[cosine]})"
        return names.tolist()


def _index(column: Any, names: dict[str, int]) -> int:
    """Return the index of a column, or -1 if there is no such column."""
    if isinstance(column, str):
        return names.get(column, -1)
    return int(column) if isinstance(column, (int, np.integer)) and not isinstance(column, bool) else -1
