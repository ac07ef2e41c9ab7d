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

    with :math:`\gamma` on the driven joints.

    Parameters
    ----------
    robot : str, path-like, System or pinocchio.Model, default=None
        A named system (``"pendulum"``, ``"iiwa14"``, ...), or any other robot as in `skevgp.datasets.load_robot`.
        If None, X passes through and the weights get the regressor's wide default prior.
    dt : float or "column", default=0.03
        Time step Δt of the data, s. If ``"column"``, X is [q, q̇, u, Δt] with the time step of each row, and weights are
        rates (see Notes).
    inverse_inertia : float or array-like of shape (n_inputs,), default=0.0
        Guess of 1/J, the acceleration per unit of input: (rad/s²)/(N m) or (m/s²)/N.
    outputs : sequence of int or str, default=None
        States in the columns of y, by index or name. If None, all of them, [q, q̇].
    known_rate : float, default=0.3
        Prior standard deviation of the weights that Newton's law gives, as a rate in 1/s: the weight of a velocity for
        itself is 1 ± ``known_rate`` Δt. Viscous damping of c/J changes it by c/J Δt.
    unknown_ratio : float, default=1.0
        Prior standard deviation of what an input contributes to the velocity of its own joint, as a multiple of the
        change that the prior mean of all features leaves (see Notes).
    coupling_ratio : float, default=0.3
        The same for inputs at other joints, which act through the mass matrix, as a share of ``unknown_ratio``. With 0
        these weights stay 0.
    other_ratio : float, default=0.003
        Prior standard deviation of what all other features contribute, as a multiple of the same change. These weights
        are 0 in Newton's law, or the 1 of a position for itself. With 0 they stay at their mean.

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
    A standard deviation that is given as a ratio is in units of the data, and fits any robot and time step: it is the
    ratio times rms(y - h(x)ᵀμ) / rms(feature), where μ is the prior mean of the weights of all features. The prior
    standard deviations for a position are Δt times those for its velocity. If y has a position without its velocity,
    they follow from what the prior mean leaves of the position.

    The scale of each group of weights (``"known"``, ``"input"``, ``"coupling"`` and ``"other"``) is then learned with
    the kernel, for each output (see ``groups`` of `skevgp.CoefPrior`).

    Do not scale the columns of X before this map, because Euler's rule holds only if velocities are the derivatives of
    positions. Scale in the ``kernel_map`` of the regressor, which only the kernel uses.

    With ``dt="column"`` the features are :math:`[z, \Delta t\,z, \Delta t\,u]` with the state :math:`z = [q, \dot q]`,
    for :math:`z' = z + \Delta t\,(A z + B u)`. The weights of z are fixed to 1 and 0. All others are rates in SI units
    and the same for any Δt: 1 for :math:`\dot q` in the rows of positions, ``inverse_inertia`` for u, and 0. For Δt in
    the prior standard deviations, the mean of the column in `fit` is used. Euler's rule neglects ½ Δt times the second
    derivative, which biases the weights. Short steps identify physics best.

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
    >>> features.coef_prior(n_outputs=2)[0]
    array([[1., 0., 0., 1., 0.],
           [0., 1., 0., 0., 4.]])
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

    For a planar system of the paper :math:`h(x) = [q, \dot q, u, \sin(\cdot)]` (its eq. gravity_prior and section
    III-B), with the sine of each link's angle against the vertical: :math:`\sin q` (pendulum), :math:`\sin\theta`
    (cartpole), :math:`\sin q_1` and :math:`\sin(q_1 + q_2)` (acrobot). Other robots have the features of `LinkGravity`
    instead of sines. Gravity decelerates a link by its gain times the feature.

    Parameters
    ----------
    robot : str, path-like, System or pinocchio.Model, default=None
        A named system (``"pendulum"``, ``"iiwa14"``, ...), or any other robot as in `skevgp.datasets.load_robot`.
        If None, the sine of every column is added and the weights get the regressor's wide default prior.
    dt : float or "column", default=0.03
        Time step Δt of the data, s. If ``"column"``, X is [q, q̇, u, Δt] with the time step of each row, and weights are
        rates (see Notes).
    inverse_inertia : float or array-like of shape (n_inputs,), default=0.0
        Guess of 1/J, the acceleration per unit of input: (rad/s²)/(N m) or (m/s²)/N.
    gravity : LinkGravity, default=None
        Other features of gravity, with their own ``inverse_length`` and ``coupling_ratio``. If None, the sines for the
        pendulum, cartpole and acrobot, and for other robots `LinkGravity` of all links whose features are not always 0.
    gravity_gain : float or array-like of shape (n_terms,) or (n_joints, n_terms), default=0.0
        Guess of the deceleration by gravity per unit of each feature: one for all, one per feature, or one per joint
        and feature, where entries of joints that the feature does not accelerate are ignored. For a sine it is in
        rad/s² (g/l for a point mass), for a lever of `LinkGravity` in 1/m (1/l for a point mass at -l times the lever).
    outputs : sequence of int or str, default=None
        States in the columns of y, by index or name. If None, all of them, [q, q̇].
    known_rate : float, default=0.3
        Prior standard deviation of the weights that Newton's law gives, as a rate in 1/s: the weight of a velocity for
        itself is 1 ± ``known_rate`` Δt. Viscous damping of c/J changes it by c/J Δt.
    inverse_length : float, default=3.0
        Prior standard deviation of 1/l in 1/m, with the effective length l of a pendulum that a link would be. Gravity
        decelerates the joints that it pulls by g/l times a sine, or by 1/l times a feature of `LinkGravity`. In units
        of the data, its contribution has at most the standard deviation ``unknown_ratio``.
    unknown_ratio : float, default=1.0
        Prior standard deviation of what an input contributes to the velocity of its own joint, as a multiple of the
        change that the prior mean of all features leaves (see the Notes of `InertiaForce`). With 0, inputs keep their
        guesses, and gravity too.
    coupling_ratio : float, default=0.3
        The same for inputs and gravity at other joints, which act through the mass matrix, as a share of the standard
        deviations above. With 0 these weights stay 0.
    other_ratio : float, default=0.003
        Prior standard deviation of what all other features contribute, as a multiple of the same change. These weights
        are 0 in Newton's law, or the 1 of a position for itself. With 0 they stay at their mean.
    parameters : dict of str to `Normal`, `LogNormal` or `Uniform`, default=None
        Priors of unknown offsets of angles in rad, such as ``{"offset(q)": Normal(0.0, 0.05)}`` for the position ``q``.
        Gravity is computed for the angle in X plus the offset: the zero error of an encoder. Each position of a
        revolute joint may have one. The regressor learns their values. If None, angles are as in X.

    Attributes
    ----------
    theta_ : dict of str to float
        Offsets that ``transform`` uses, if there are ``parameters``. `fit` sets the prior medians. In the
        ``feature_map_`` of a fitted regressor, they are those of the posterior.
    n_features_in_ : int
    feature_names_in_ : ndarray of str
        If X had column names.

    See Also
    --------
    InertiaForce : Without gravity.
    LinkGravity : Gravity on links in 3D, alone.

    Notes
    -----
    Do not scale the columns of X before this map, because the sine of a scaled angle is not gravity. Scale in the
    ``kernel_map`` of the regressor, which only the kernel uses.

    See the Notes of `InertiaForce` on prior standard deviations. The groups of weights whose scales are learned are
    ``"known"``, ``"input"``, ``"gravity"``, ``"coupling"`` and ``"other"``.

    With ``dt="column"``, see the Notes of `InertiaForce`, too. Features of gravity are multiplied by Δt, and the mean
    of their weights is minus ``gravity_gain``.

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

    Rows of a log with irregular time steps, each with the time until the next row:

    >>> logged = InertiaForceGravity("pendulum", dt="column", inverse_inertia=4.0, gravity_gain=20.0)
    >>> logged.fit([[0.1, 0.0, 1.0, 0.008]]).get_feature_names_out().tolist()
    ['q', 'dq/dt', 'dt * q', 'dt * dq/dt', 'dt * u_q', 'dt * sin(q)']
    >>> logged.coef_prior(n_outputs=2)[0]
    array([[  1.,   0.,   0.,   1.,   0.,   0.],
           [  0.,   1.,   0.,   0.,   4., -20.]])
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
