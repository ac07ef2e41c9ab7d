"""Newton's second law as explicit features: inertia + force (+ gravity), section III of the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import clone

from ..robots import Layout
from ..robots.loading import Robot, named_system, read_once
from ..utils.shapes import same_for_all
from ..utils.sklearn import Interval, StrOptions
from ..utils.validation import as_floats
from .gravity import GravityMap, LinkGravity, OffsetAngles, SineGravity, links_under_gravity
from .robot_map import STEP, RobotMap, VelocityPrior
from .theta import Prior


class _NewtonFeatures(RobotMap):
    """Common part of `InertiaForce` and `InertiaForceGravity`: h(x) starts with x = [q, q̇, u]."""

    dt: float | Literal["column"]
    inverse_inertia: ArrayLike
    known_rate: float
    unknown_ratio: float
    coupling_ratio: float
    other_ratio: float
    _begins_with_state = True

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **RobotMap._parameter_constraints,
        "dt": [Interval(Real, 0, None, closed="neither"), StrOptions({"column"})],
        "inverse_inertia": [Real, "array-like"],
        "known_rate": [Interval(Real, 0, None, closed="left")],
        "unknown_ratio": [Interval(Real, 0, None, closed="left")],
        "coupling_ratio": [Interval(Real, 0, None, closed="left")],
        "other_ratio": [Interval(Real, 0, None, closed="left")],
    }

    def _mean(self, layout: Layout, dt: float) -> np.ndarray:
        # Euler's rule (the paper's eq. inertia_prior), with the user's guess of Δt/J. All other entries are 0.
        n, n_inputs = layout.n_joints, layout.n_inputs
        joints = np.arange(n)
        mean = np.zeros((2 * n, layout.n_columns))
        mean[joints, joints] = mean[n + joints, n + joints] = 1.0  # q' = q + ..., q̇' = q̇ + ...
        mean[joints, n + joints] = dt  # ... + Δt q̇
        guess = _per_term(self.inverse_inertia, n_inputs, "inverse_inertia")
        mean[n + np.array(layout.driven), 2 * n + np.arange(n_inputs)] = dt * guess  # γ u
        return mean

    def _velocity_prior(self, layout: Layout) -> VelocityPrior:
        n, joints = layout.n_joints, np.arange(layout.n_joints)
        prior = VelocityPrior.of(n, layout.n_columns, self.other_ratio, "other")
        prior.set(np.s_[:, 2 * n :], self.coupling_ratio * self.unknown_ratio, "coupling")
        prior.set((np.array(layout.driven), 2 * n + np.arange(layout.n_inputs)), self.unknown_ratio, "input")
        prior.set_rate((joints, n + joints), self.known_rate, "known")
        return prior


def _per_term(value: ArrayLike, n_terms: int, name: str) -> np.ndarray:
    array = as_floats(value, name)
    if array.shape not in ((), (n_terms,)) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be a finite number or {n_terms} of them; got {value!r}.")
    return array


class InertiaForce(_NewtonFeatures):
    r"""Inertia + force features (IF): :math:`h(x) = [q, \dot q, u]` with a Newtonian prior on the weights.

    The prior mean is Euler's rule for :math:`J \ddot q = u` (the paper's eq. inertia_prior),

    .. math:: q' = q + \Delta t\,\dot q, \qquad \dot q' = \dot q + \gamma u, \qquad \gamma = \Delta t / J,

    with :math:`\gamma` on the driven joints. See the user guide, :doc:`/guide/priors`.

    Parameters
    ----------
    robot : str, path-like, System or pinocchio.Model, default=None
        Robot, as in `skevgp.datasets.load_robot`. If None, X passes through, and the weights get the wide default prior
        of the regressor.
    dt : float or "column", default=0.03
        Time step Δt of the data, s. If ``"column"``, X is [q, q̇, u, Δt] with the time step of each row (see Notes).
    inverse_inertia : float or array-like of shape (n_inputs,), default=0.0
        Guess of 1/J, the acceleration per unit of input: (rad/s²)/(N m) or (m/s²)/N.
    outputs : sequence of int or str, default=None
        States in the columns of y, by index or name. If None, all states [q, q̇].
    known_rate : float, default=0.3
        Prior standard deviation of the weights that Newton's law gives, in 1/s. The weight of a velocity for itself is
        1 ± ``known_rate`` Δt.
    unknown_ratio : float, default=1.0
        Prior standard deviation of the contribution of an input to the velocity of its joint. It is in units of the
        residual of the prior mean (see Notes).
    coupling_ratio : float, default=0.3
        Prior standard deviation of the contribution of inputs at other joints, as a share of ``unknown_ratio``. If 0,
        these weights stay 0.
    other_ratio : float, default=0.003
        Prior standard deviation of the contribution of all other features, in units of the same residual. If 0, their
        weights stay at their mean.

    Attributes
    ----------
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it has any.

    See Also
    --------
    InertiaForceGravity : The same features with gravity.

    Notes
    -----
    A ratio becomes a standard deviation by the factor rms(y - h(x)ᵀμ) / rms(feature), where μ is the prior mean of all
    weights. Thus it fits any robot and time step. Standard deviations for a position are Δt times those for its
    velocity. The scale of each group of weights is then learned with the kernel (see `skevgp.CoefPrior`).

    Do not scale the columns of X before this map, because Euler's rule needs velocities that are derivatives of
    positions. Scale in the ``kernel_map`` of the regressor, which only the kernel uses.

    With ``dt="column"`` the features are :math:`[z, \Delta t\,z, \Delta t\,u]` with the state :math:`z = [q, \dot q]`,
    for :math:`z' = z + \Delta t\,(A z + B u)`. The weights of z are fixed to 1 and 0. All other weights are rates in SI
    units. Euler's rule neglects a term in Δt², so short steps identify physics best.

    Examples
    --------
    >>> from skevgp.features import InertiaForce
    >>> features = InertiaForce("pendulum").fit([[0.1, 0.0, 1.0]])
    >>> features.get_feature_names_out().tolist()
    ['q', 'dq/dt', 'u_q']
    >>> features.coef_prior(n_outputs=2)[0]
    array([[1.  , 0.03, 0.  ],
           [0.  , 1.  , 0.  ]])
    >>> features.coef_groups(n_outputs=2)[1].tolist()
    ['other', 'known', 'input']

    Features of a log whose rows have different time steps, with 1/J about 4:

    >>> features = InertiaForce("pendulum", dt="column", inverse_inertia=4.0)
    >>> features.fit_transform([[0.1, 1.0, 2.0, 0.01], [0.1, 1.0, 2.0, 0.02]])
    array([[0.1  , 1.   , 0.001, 0.01 , 0.02 ],
           [0.1  , 1.   , 0.002, 0.02 , 0.04 ]])
    >>> features.get_feature_names_out().tolist()
    ['q', 'dq/dt', 'dt * q', 'dt * dq/dt', 'dt * u_q']
    """

    def __init__(
        self,
        robot: Robot | None = None,
        *,
        dt: float | Literal["column"] = STEP,
        inverse_inertia: ArrayLike = 0.0,
        outputs: Sequence[int | str] | None = None,
        known_rate: float = 0.3,
        unknown_ratio: float = 1.0,
        coupling_ratio: float = 0.3,
        other_ratio: float = 0.003,
    ):
        self.robot = robot
        self.dt = dt
        self.inverse_inertia = inverse_inertia
        self.outputs = outputs
        self.known_rate = known_rate
        self.unknown_ratio = unknown_ratio
        self.coupling_ratio = coupling_ratio
        self.other_ratio = other_ratio

    def _features(self, X: np.ndarray) -> np.ndarray:
        return X.copy()

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        return same_for_all(np.eye(X.shape[1]), len(X))

    def _names(self, columns: np.ndarray) -> list[str]:
        return list(columns)


class InertiaForceGravity(OffsetAngles, _NewtonFeatures):
    r"""Inertia + force + gravity features (IFG): those of `InertiaForce` and the pull of gravity on each link.

    For the pendulum, the cartpole and the acrobot, h(x) is :math:`[q, \dot q, u, \sin(\cdot)]` with the sine of the
    angle of each link against the vertical. Other robots have the features of `LinkGravity` instead of sines. See the
    user guide, :doc:`/guide/priors`.

    Parameters
    ----------
    robot : str, path-like, System or pinocchio.Model, default=None
        Robot, as in `skevgp.datasets.load_robot`. If None, the sine of every column is added, and the weights get the
        wide default prior of the regressor.
    dt : float or "column", default=0.03
        Time step Δt of the data, s. If ``"column"``, X is [q, q̇, u, Δt] with the time step of each row (see the Notes
        of `InertiaForce`).
    inverse_inertia : float or array-like of shape (n_inputs,), default=0.0
        Guess of 1/J, the acceleration per unit of input: (rad/s²)/(N m) or (m/s²)/N.
    gravity : LinkGravity, default=None
        Features of gravity. If None, sines for the three systems above, and otherwise `LinkGravity` of all links whose
        features are not always 0.
    gravity_gain : float or array-like of shape (n_terms,) or (n_joints, n_terms), default=0.0
        Guess of the deceleration by gravity per unit of each feature. For a point mass at distance l, it is g/l
        (rad/s²) for a sine, and 1/l (1/m) for `LinkGravity`.
    outputs : sequence of int or str, default=None
        States in the columns of y, by index or name. If None, all states [q, q̇].
    known_rate : float, default=0.3
        Prior standard deviation of the weights that Newton's law gives, in 1/s, as in `InertiaForce`.
    inverse_length : float, default=3.0
        Prior standard deviation of 1/l in 1/m, with the length l of a pendulum equivalent to a link. ``unknown_ratio``
        limits the contribution of gravity.
    unknown_ratio : float, default=1.0
        Prior standard deviation of the contribution of an input, as in `InertiaForce`.
    coupling_ratio : float, default=0.3
        Prior standard deviation of the contribution of inputs and gravity at other joints, as a share of the standard
        deviations above.
    other_ratio : float, default=0.003
        Prior standard deviation of the contribution of all other features, as in `InertiaForce`.
    parameters : dict of str to `Normal`, `LogNormal` or `Uniform`, default=None
        Priors of unknown offsets of angles in rad, such as ``{"offset(q)": Normal(0.0, 0.05)}``. Gravity is computed
        for the angle in X plus the offset. The regressor learns the offsets. If None, angles are as in X.

    Attributes
    ----------
    theta_ : dict of str to float
        Offsets that ``transform`` uses. `fit` sets the prior medians, and a regressor sets the posterior medians in its
        ``feature_map_``.
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it has any.

    See Also
    --------
    InertiaForce : The same features without gravity.
    LinkGravity : Gravity on links in 3D, without other features.

    Notes
    -----
    Do not scale the columns of X before this map. Scale in the ``kernel_map`` of the regressor, which only the kernel
    uses.

    See the Notes of `InertiaForce` on prior standard deviations and on ``dt="column"``. The mean of the weights of
    gravity is minus ``gravity_gain``, times Δt unless ``dt="column"``.

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
    >>> features.coef_groups(n_outputs=2)[1].tolist()
    ['other', 'known', 'input', 'gravity']

    An arm in 3D, with two levers for each of the links 2 to 7:

    >>> arm = InertiaForceGravity("iiwa14").fit([[0.0] * 21])
    >>> arm.get_feature_names_out()[21:24].tolist()
    ['gravity(q2, u_x)', 'gravity(q2, u_y)', 'gravity(q3, u_x)']
    """

    def __init__(
        self,
        robot: Robot | None = None,
        *,
        dt: float | Literal["column"] = STEP,
        inverse_inertia: ArrayLike = 0.0,
        gravity: LinkGravity | None = None,
        gravity_gain: ArrayLike = 0.0,
        outputs: Sequence[int | str] | None = None,
        known_rate: float = 0.3,
        inverse_length: float = 3.0,
        unknown_ratio: float = 1.0,
        coupling_ratio: float = 0.3,
        other_ratio: float = 0.003,
        parameters: Mapping[str, Prior] | None = None,
    ):
        self.robot = robot
        self.dt = dt
        self.inverse_inertia = inverse_inertia
        self.gravity = gravity
        self.gravity_gain = gravity_gain
        self.outputs = outputs
        self.known_rate = known_rate
        self.inverse_length = inverse_length
        self.unknown_ratio = unknown_ratio
        self.coupling_ratio = coupling_ratio
        self.other_ratio = other_ratio
        self.parameters = parameters

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **OffsetAngles._parameter_constraints,
        **_NewtonFeatures._parameter_constraints,
        "gravity": [LinkGravity, None],
        "gravity_gain": [Real, "array-like"],
        "inverse_length": [Interval(Real, 0, None, closed="left")],
    }

    def _prepare(self, robot: Robot | None) -> None:
        self._gravity = self._gravity_map(robot, self.n_features_in_ - self._timed)

    def _gravity_map(self, robot: Robot | None, n_columns: int) -> GravityMap:
        """Return the fitted features of gravity."""
        if self.gravity is not None:
            features = clone(self.gravity)
            for name in ("outputs", "dt", "parameters"):
                if getattr(features, name) is not None:
                    raise ValueError(f"gravity={self.gravity!r} must leave {name} to {type(self).__name__}.")
            if features.robot is None:
                features.robot = robot
        elif robot is None or ((system := named_system(robot)) is not None and system.gravity):
            features = SineGravity(robot, self.inverse_length, self.unknown_ratio, self.coupling_ratio)
        else:
            features = LinkGravity(
                robot,
                links=links_under_gravity(robot),
                inverse_length=self.inverse_length,
                unknown_ratio=self.unknown_ratio,
                coupling_ratio=self.coupling_ratio,
            )
        return features.fit(np.zeros((1, n_columns)))

    def _features(self, X: np.ndarray) -> np.ndarray:
        return np.concatenate((X, self._gravity._features(self._with_offsets(X))), axis=1)

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        of_gravity, d = self._gravity._jacobian(self._with_offsets(X)), X.shape[1]
        jacobian = np.empty((len(X), d + of_gravity.shape[1], d))
        jacobian[:, :d] = np.eye(d)
        jacobian[:, d:] = of_gravity
        return jacobian

    def _theta_derivatives(self, X: np.ndarray) -> np.ndarray:
        # X itself is measured, and does not depend on the offsets.
        by_offsets = self._by_offsets(self._jacobian(X))
        by_offsets[:, : X.shape[1]] = 0.0
        return by_offsets

    def _names(self, columns: np.ndarray) -> list[str]:
        return [*columns, *self._gravity._names(columns)]

    def _of_gravity(self, layout: Layout) -> GravityMap:
        """Return the features of gravity, also before `fit`."""
        return (
            self._gravity if hasattr(self, "_gravity") else self._gravity_map(read_once(self.robot), layout.n_columns)
        )

    def _mean(self, layout: Layout, dt: float) -> np.ndarray:
        acts_on, gain = self._of_gravity(layout)._acts_on(layout), as_floats(self.gravity_gain, "gravity_gain")
        if gain.shape != acts_on.shape or not np.isfinite(gain).all():
            gain = _per_term(gain, acts_on.shape[1], "gravity_gain")
        of_gravity = np.zeros((2 * layout.n_joints, acts_on.shape[1]))
        of_gravity[layout.n_joints :] = np.where(acts_on, 0.0 - dt * gain, 0.0)
        return np.hstack([super()._mean(layout, dt), of_gravity])

    def _velocity_prior(self, layout: Layout) -> VelocityPrior:
        return super()._velocity_prior(layout).beside(self._of_gravity(layout)._velocity_prior(layout))
