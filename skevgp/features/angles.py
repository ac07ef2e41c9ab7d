"""Angles as the kernel should see them: the same after a full turn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_array, check_is_fitted

from ..robots.loading import Robot
from ..utils.sklearn import StrOptions
from .robot_map import RobotTransformer, same_for_all


class AngleEncoder(RobotTransformer):
    """Replace each angle by its sine and cosine; other columns stay as they are.

    For the regressor's ``kernel_map``: a kernel of (sin q, cos q) takes q and q + 2π for the same, and sees nearby
    angles on both sides of the turn as near. It is a transformer of its own too.

    Parameters
    ----------
    robot : str, path-like, System, pinocchio.Model or None, default=None
        As in `skevgp.datasets.load_robot`; the named systems need no Pinocchio. X then has the columns [q, q̇, u].
        Without one, any number of columns is taken.
    angles : sequence of int or str, default=None
        Which columns are angles (rad), by index or by name: a column of the data frame, or a position of the robot.
        None means all revolute positions of the robot, and no column without a robot.
    dt : "column" or None, default=None
        ``"column"``: beside the robot's, X has a last column, the time step of each row in seconds, which stays as it
        is.

    Attributes
    ----------
    n_features_in_ : int
    feature_names_in_ : ndarray of str
        If X had column names.

    Notes
    -----
    The sine and the cosine take the angle's place, in this order; the order of the columns stays. Scale after encoding:
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
        """Give back the angles of sines and cosines.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features_out)
            As `transform` returns them; a sine and a cosine may share a positive factor.

        Returns
        -------
        X_original : ndarray of shape (n_samples, n_features)
            The angles lie in (-π, π].

        Raises
        ------
        ValueError
            If X has another number of columns, or holds NaN or infinity.
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
        self._source = np.repeat(np.arange(self.n_features_in_), copies)  # the column of X of each encoded one
        self._sines = np.searchsorted(self._source, self._angles)
        self._cosines = self._sines + 1
        self._of_others = np.eye(self.n_features_in_)[self._source]  # the Jacobian but for the angles' entries
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
    """The index of a column, or -1 if it cannot be one."""
    if isinstance(column, str):
        return names.get(column, -1)
    return int(column) if isinstance(column, (int, np.integer)) and not isinstance(column, bool) else -1
