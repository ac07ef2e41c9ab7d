"""Newton's second law as explicit features: inertia + force (+ gravity), section III of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils._param_validation import Interval

from .._validation import as_floats
from ..robots import GravityTerm, Layout, get_system
from ..robots.loading import Robot
from .robot_map import RobotMap


class _NewtonFeatures(RobotMap):
    """What `InertiaForce` and `InertiaForceGravity` share: h starts with x = [q, q̇, u]."""

    dt: float
    inverse_inertia: ArrayLike
    known_scale: float
    unknown_scale: float
    free_scale: float

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **RobotMap._parameter_constraints,
        "dt": [Interval(Real, 0, None, closed="neither")],
        "inverse_inertia": [Real, "array-like"],
        "known_scale": [Interval(Real, 0, None, closed="left")],
        "unknown_scale": [Interval(Real, 0, None, closed="left")],
        "free_scale": [Interval(Real, 0, None, closed="left")],
    }

    def _prior(self, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
        """Euler's rule (the paper's eq. inertia_prior), and what a subclass knows of gravity.

        Known entries (1 and Δt) have ``known_scale``; unknown ones (Δt/J and gravity's factors) the user's guess and
        ``unknown_scale``; the rest mean 0 and ``free_scale``.
        """
        n, n_inputs = layout.n_joints, layout.n_inputs
        joints = np.arange(n)
        width = layout.n_columns + self._n_gravity(layout)
        mean = np.zeros((2 * n, width))
        scale = np.full((2 * n, width), self.free_scale, dtype=float)
        for row, column, value in (
            (joints, joints, 1.0),  # q' = q + ...
            (joints, n + joints, self.dt),  # ... + Δt q̇
            (n + joints, n + joints, 1.0),  # q̇' = q̇ + ...
        ):
            mean[row, column], scale[row, column] = value, self.known_scale
        driven, inputs = n + np.array(layout.driven), 2 * n + np.arange(n_inputs)
        mean[driven, inputs] = self.dt * _per_term(self.inverse_inertia, n_inputs, "inverse_inertia")  # γ u
        scale[driven, inputs] = self.unknown_scale
        self._gravity_prior(layout, mean, scale)
        return mean, scale

    def _features(self, X: np.ndarray) -> np.ndarray:
        return np.hstack([X, self._gravity_columns(X)])

    def _names(self, columns: np.ndarray) -> list[str]:
        return [*columns, *self._gravity_names(columns)]

    def _gravity_columns(self, X: np.ndarray) -> np.ndarray:
        return np.empty((len(X), 0))

    def _gravity_names(self, names: np.ndarray) -> list[str]:
        return []

    def _n_gravity(self, layout: Layout) -> int:
        return 0

    def _gravity_prior(self, layout: Layout, mean: np.ndarray, scale: np.ndarray) -> None:
        """Fill in the gravity columns; none here."""


def _per_term(value: ArrayLike, n_terms: int, name: str) -> np.ndarray:
    array = as_floats(value, name)
    if array.shape not in ((), (n_terms,)) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be a finite number or {n_terms} of them; got {value!r}.")
    return array


class InertiaForce(_NewtonFeatures):
    r"""Inertia + force features (IF): :math:`h(x) = [q, \dot q, u]` with a Newtonian prior on the weights.

    The prior mean is Euler's rule for :math:`J \ddot q = u` (the paper's eq. inertia_prior),

    .. math:: q' = q + \Delta t\,\dot q, \qquad \dot q' = \dot q + \gamma u, \qquad \gamma = \Delta t / J,

    with :math:`\gamma` on the driven joints.

    Parameters
    ----------
    robot : str or None, default=None
        A named system (``"pendulum"``, ``"cartpole"``, ``"acrobot"``). Without one, any number of columns is taken as
        it is and the weights get the regressor's wide default prior.
    dt : float, default=0.03
        Length of a time step, s; that of the data.
    inverse_inertia : float or array-like of shape (n_inputs,), default=0.0
        Guess of 1/J, the acceleration per unit of input: (rad/s²)/(N m) or (m/s²)/N.
    outputs : sequence of int or str, default=None
        Which states, by index or name, the columns of y hold; None means all of them, [q, q̇].
    known_scale : float, default=0.1
        Prior standard deviation of the entries that physics knows (1 and Δt): narrower than the others, and wide enough
        for what Euler's rule neglects.
    unknown_scale : float, default=1.0
        Prior standard deviation of the entries that physics names but does not know (γ).
    free_scale : float, default=1.0
        Prior standard deviation of the entries that are 0 in the prior mean; 0 pins them there.

    Attributes
    ----------
    n_features_in_ : int
    feature_names_in_ : ndarray of str
        If X had column names.

    See Also
    --------
    InertiaForceGravity : Adds gravity.

    Notes
    -----
    Do not scale the columns of x before this map: the prior is in SI units. Scaling belongs in the regressor's
    ``kernel_map``, which only the kernel sees.

    Examples
    --------
    >>> from skevgp.features import InertiaForce
    >>> features = InertiaForce("pendulum").fit([[0.1, 0.0, 1.0]])
    >>> features.get_feature_names_out().tolist()
    ['q', 'dq/dt', 'u_q']
    >>> mean, scale = features.coef_prior(n_outputs=2)
    >>> mean
    array([[1.  , 0.03, 0.  ],
           [0.  , 1.  , 0.  ]])
    """

    def __init__(
        self,
        robot: Robot | None = None,
        *,
        dt: float = 0.03,
        inverse_inertia: ArrayLike = 0.0,
        outputs: Sequence[int | str] | None = None,
        known_scale: float = 0.1,
        unknown_scale: float = 1.0,
        free_scale: float = 1.0,
    ):
        self.robot = robot
        self.dt = dt
        self.inverse_inertia = inverse_inertia
        self.outputs = outputs
        self.known_scale = known_scale
        self.unknown_scale = unknown_scale
        self.free_scale = free_scale


class InertiaForceGravity(_NewtonFeatures):
    r"""Inertia + force + gravity features (IFG): IF and the sine of each link's angle against the vertical.

    :math:`h(x) = [q, \dot q, u, \sin(\cdot)]` (the paper's eq. gravity_prior and section III-B) with the sines
    :math:`\sin q` (pendulum), :math:`\sin\theta` (cartpole), :math:`\sin q_1` and :math:`\sin(q_1 + q_2)` (acrobot).
    Gravity slows a link down by :math:`\Delta t` times its gain times the sine.

    Parameters
    ----------
    robot : str or None, default=None
        A named system (``"pendulum"``, ``"cartpole"``, ``"acrobot"``). Without one, the sine of every column is added
        and the weights get the regressor's wide default prior.
    dt : float, default=0.03
        Length of a time step, s; that of the data.
    inverse_inertia : float or array-like of shape (n_inputs,), default=0.0
        Guess of 1/J, the acceleration per unit of input: (rad/s²)/(N m) or (m/s²)/N.
    gravity_gain : float or array-like of shape (n_sines,) or (n_joints, n_sines), default=0.0
        Guess of gravity's acceleration at sine 1, rad/s² (g/l for a point mass): one for all, one per sine, or one per
        joint and sine (of which those that the prior names are used).
    outputs : sequence of int or str, default=None
        Which states, by index or name, the columns of y hold; None means all of them, [q, q̇].
    known_scale : float, default=0.1
        Prior standard deviation of the entries that physics knows (1 and Δt): narrower than the others, and wide enough
        for what Euler's rule neglects.
    unknown_scale : float, default=1.0
        Prior standard deviation of the entries that physics names but does not know (γ).
    free_scale : float, default=1.0
        Prior standard deviation of the entries that are 0 in the prior mean; 0 pins them there.

    Attributes
    ----------
    n_features_in_ : int
    feature_names_in_ : ndarray of str
        If X had column names.

    See Also
    --------
    InertiaForce : Without gravity.

    Notes
    -----
    Do not scale the columns of x before this map: the sine of a z-score is not gravity. Scaling belongs in the
    regressor's ``kernel_map``, which only the kernel sees.

    Examples
    --------
    >>> from skevgp.features import InertiaForceGravity
    >>> features = InertiaForceGravity("pendulum", inverse_inertia=4.0, gravity_gain=20.0)
    >>> features.fit_transform([[0.1, 0.0, 1.0]]).round(4)
    array([[0.1   , 0.    , 1.    , 0.0998]])
    >>> features.get_feature_names_out().tolist()
    ['q', 'dq/dt', 'u_q', 'sin(q)']
    >>> features.coef_prior(n_outputs=2)[0]
    array([[ 1.  ,  0.03,  0.  ,  0.  ],
           [ 0.  ,  1.  ,  0.12, -0.6 ]])
    """

    def __init__(
        self,
        robot: Robot | None = None,
        *,
        dt: float = 0.03,
        inverse_inertia: ArrayLike = 0.0,
        gravity_gain: ArrayLike = 0.0,
        outputs: Sequence[int | str] | None = None,
        known_scale: float = 0.1,
        unknown_scale: float = 1.0,
        free_scale: float = 1.0,
    ):
        self.robot = robot
        self.dt = dt
        self.inverse_inertia = inverse_inertia
        self.gravity_gain = gravity_gain
        self.outputs = outputs
        self.known_scale = known_scale
        self.unknown_scale = unknown_scale
        self.free_scale = free_scale

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **_NewtonFeatures._parameter_constraints,
        "gravity_gain": [Real, "array-like"],
    }

    def _angles(self) -> list[tuple[int, ...]] | None:
        """Columns that add up to each angle; None without a robot: every column is one."""
        return None if self.robot is None else [term.angle for term in self._terms()]

    def _terms(self) -> tuple[GravityTerm, ...]:
        assert self.robot is not None
        return get_system(self.robot).gravity

    def _gravity_columns(self, X: np.ndarray) -> np.ndarray:
        angles = self._angles()
        if angles is None:
            return np.sin(X)
        return np.sin(np.column_stack([X[:, list(columns)].sum(axis=1) for columns in angles]))

    def _gravity_names(self, names: np.ndarray) -> list[str]:
        angles = self._angles()
        if angles is None:
            angles = [(column,) for column in range(len(names))]
        return [f"sin({' + '.join(names[list(columns)])})" for columns in angles]

    def _n_gravity(self, layout: Layout) -> int:
        return len(self._terms())

    def _gravity_prior(self, layout: Layout, mean: np.ndarray, scale: np.ndarray) -> None:
        terms = self._terms()
        n, n_terms = layout.n_joints, len(terms)
        gain = as_floats(self.gravity_gain, "gravity_gain")
        if gain.shape != (n, n_terms) or not np.isfinite(gain).all():
            gain = np.broadcast_to(_per_term(gain, n_terms, "gravity_gain"), (n, n_terms))
        first = layout.n_columns
        for index, term in enumerate(terms):
            for joint in term.acts_on:
                mean[n + joint, first + index] = 0.0 - self.dt * gain[joint, index]
                scale[n + joint, first + index] = self.unknown_scale
