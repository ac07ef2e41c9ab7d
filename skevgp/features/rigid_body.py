"""Torques of a rigid body with friction as explicit features, linear in inertial parameters: one row per joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.metaestimators import available_if

from ..robots import RigidBody, load_robot
from ..robots.loading import Robot, effort_limits, known_robot
from ..utils.shapes import same_for_all
from ..utils.sklearn import Interval
from .robot_map import ParametricMap, has_robot, one_per_joint
from .theta import Prior

FRICTION = ("viscous", "coulomb", "offset", "armature")
_INERTIAL = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
# Standard gravity, for the largest torque of a joint without effort limit.
_G = 9.81
# Speed and acceleration (rad or m, s) at which viscous friction and rotor inertia have the prior scale of dry friction.
_SPEED, _ACCELERATION = 1.0, 10.0
# Step of the central differences of fourth order, whose error is then mostly rounding.
_STEP = 1e-3


class RigidBodyRegressor(ParametricMap):
    r"""Features of inverse dynamics, with one set of weights for the torques of all joints.

    The equation of motion of a robot with friction is

    .. math:: \tau = Y(q, \dot q, \ddot q)\,\pi + F(\dot q, \ddot q)\,\varphi.

    Here π holds ten inertial parameters of each link: mass, first moments, and moments of inertia about the joint's
    frame. φ holds the friction of each joint and the reflected inertia of its rotor ("armature"). `EVGPRegressor` fits
    one β = (π, φ) for all joints. The prior mean is the model of the robot, such as a URDF with inaccurate masses. See
    the user guide, :doc:`/guide/torques`.

    Parameters
    ----------
    robot : str, path-like, System, pinocchio.Model or None, default=None
        Robot, as in `skevgp.datasets.load_robot`. If None, X passes through, and outputs have their own weights.
    friction : sequence of str, default=("viscous", "coulomb", "offset", "armature")
        Torques of each joint in addition to those of the links. They are a weight times :math:`\dot q`,
        :math:`\tanh(\dot q / v_s)`, 1 and :math:`\ddot q`, in this order.
    stiction_velocity : float or array-like of shape (n_joints,), default=0.01
        Velocity v_s in rad/s or m/s, above 0. Coulomb friction changes its sign smoothly between -v_s and v_s.
    mass_scale : float, default=0.2
        Prior standard deviation of the mass of each link, as a share of the mass.
    com_scale : float, default=0.2
        Prior standard deviation of each coordinate of the centre of mass, as a share of the link's size (see Notes).
    inertia_scale : float, default=0.3
        Prior standard deviation of the moments of inertia, as a share of mass times squared size.
    friction_scale : float, default=0.3
        Prior standard deviation of the torques of friction, as a share of the largest torque of the motor.
    parameters : dict of str to `Normal`, `LogNormal` or `Uniform`, default=None
        Priors of unknown velocities v_s, such as ``{"stiction_velocity": LogNormal(0.01, 1.0)}``. The regressor learns
        their values. If None, ``stiction_velocity`` is used.

    Attributes
    ----------
    theta_ : dict of str to float
        Velocities that ``transform`` uses. `fit` sets the prior medians, and a regressor sets the posterior medians in
        its ``feature_map_``.
    share_coef : bool
        Whether all outputs have the same weights. It is True if there is a robot.
    model_ : pinocchio.Model
        The robot, if there is one.
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it has any.

    See Also
    --------
    skevgp.InverseDynamics : Estimator of torques and parameters that uses this map.
    NominalDynamics : Features of forward dynamics.

    Notes
    -----
    The size of a link is the largest of three lengths. These are its radius of gyration, and the distances from its
    joint to the next joint and to its centre of mass.

    X has the columns [q, q̇, q̈], such as those of `skevgp.datasets.load_log`. Do not scale them before this map.

    References
    ----------
    - C. G. Atkeson, C. H. An, J. M. Hollerbach (1986): Estimation of Inertial Parameters of Manipulator Loads and
      Links.

    Examples
    --------
    >>> import numpy as np
    >>> from skevgp.features import RigidBodyRegressor
    >>> body = RigidBodyRegressor("pendulum", friction=["viscous"])
    >>> H = body.fit_transform([[0.5, 1.0, 2.0]])  # q, q̇, q̈
    >>> H.shape
    (1, 1, 11)
    >>> mean, covariance = body.coef_prior(n_outputs=1)
    >>> (H @ mean).round(4)  # 0.25 * 2 + 9.81 * 0.5 * sin(0.5) + 0.1 * 1
    array([[2.9516]])
    >>> body.get_feature_names_out()[[0, -1]].tolist()
    ['m(q)', 'viscous(q)']
    """

    def __init__(
        self,
        robot: Robot | None = None,
        *,
        friction: Sequence[str] = FRICTION,
        stiction_velocity: float | ArrayLike = 0.01,
        mass_scale: float = 0.2,
        com_scale: float = 0.2,
        inertia_scale: float = 0.3,
        friction_scale: float = 0.3,
        parameters: Mapping[str, Prior] | None = None,
    ):
        self.robot = robot
        self.friction = friction
        self.stiction_velocity = stiction_velocity
        self.mass_scale = mass_scale
        self.com_scale = com_scale
        self.inertia_scale = inertia_scale
        self.friction_scale = friction_scale
        self.parameters = parameters

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **ParametricMap._parameter_constraints,
        "friction": ["array-like"],
        "stiction_velocity": [Interval(Real, 0, None, closed="neither"), "array-like"],
        "mass_scale": [Interval(Real, 0, None, closed="left")],
        "com_scale": [Interval(Real, 0, None, closed="left")],
        "inertia_scale": [Interval(Real, 0, None, closed="left")],
        "friction_scale": [Interval(Real, 0, None, closed="left")],
    }

    @property
    def share_coef(self) -> bool:
        return self.robot is not None

    _n_blocks: ClassVar[int] = 3

    def _column_names(self) -> list[str]:
        names = self._layout.position_names
        return [*self._layout.state_names, *(f"d2{name}/dt2" for name in names)]

    def _prepare(self, robot: Robot | None) -> None:
        self._terms = self._checked_friction()
        self._velocity = self._checked_velocity()
        # With a robot each row has a matrix, which a data frame cannot hold, so that `set_output` does not apply.
        self._sklearn_auto_wrap_output_keys = {"transform"} if robot is None else set()
        if robot is not None:
            self.model_ = known_robot(robot).copy()
            self._body = RigidBody(self.model_)

    def _checked_velocity(self) -> np.ndarray:
        n_joints = 1 if self.robot is None else self._layout.n_joints
        return one_per_joint(self.stiction_velocity, "stiction_velocity", n_joints)

    def _allowed_parameters(self) -> dict[str, tuple[str, list[int]]]:
        if "coulomb" not in self._terms:
            return {}
        joints = list(range(self._layout.n_joints))
        return {
            "stiction_velocity": ("stiction_velocity", joints),
            **self._one_per_joint(["stiction_velocity"], joints),
        }

    def _store_theta(self) -> None:
        given = np.broadcast_to(self._checked_velocity(), self._layout.n_joints)
        self._velocity = np.array(self._at_theta("stiction_velocity", given))

    def _unit(self, kind: str, joints: list[int]) -> str:
        return self._speed_unit(joints)

    def _checked_friction(self) -> tuple[str, ...]:
        terms = [term for term in self.friction if isinstance(term, str) and term in FRICTION]
        if (
            isinstance(self.friction, (str, set, frozenset))
            or len(terms) < len(self.friction)
            or len(set(terms)) < len(terms)
        ):
            raise ValueError(f"friction={self.friction!r} must be some of {list(FRICTION)}, each once, or empty.")
        return tuple(terms)

    def _features(self, X: np.ndarray) -> np.ndarray:
        if self.robot is None:
            return X.copy()
        q, v, a = np.split(X, 3, axis=1)
        return np.concatenate([self._body.torque_regressor(q, v, a), self._friction(v, a)], axis=2)

    def _friction(self, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return F(q̇, q̈), (n, n_joints, n_terms * n_joints): a diagonal matrix for each term."""
        n, n_joints = v.shape
        values = {
            "viscous": v,
            "coulomb": np.tanh(v / self._velocity),
            "offset": np.ones_like(v),
            "armature": a,
        }
        friction = np.zeros((n, n_joints, len(self._terms), n_joints))
        for number, term in enumerate(self._terms):
            friction[:, range(n_joints), number, range(n_joints)] = values[term]
        return friction.reshape(n, n_joints, -1)

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        if self.robot is None:
            return same_for_all(np.eye(X.shape[1]), len(X))
        # Y is quadratic in q̇, linear in q̈ and made of sines of q: differences of fourth order suffice.
        v = np.split(X, 3, axis=1)[1]
        n, n_joints = v.shape
        width = 10 * n_joints
        jacobian = np.zeros((n, n_joints, width + len(self._terms) * n_joints, 3 * n_joints))
        for column in range(3 * n_joints):
            for steps, weight in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
                moved = X.copy()
                moved[:, column] += steps * _STEP
                jacobian[:, :, :width, column] += weight * self._body.torque_regressor(*np.split(moved, 3, axis=1))
        jacobian /= 12.0 * _STEP
        zero, one = np.zeros_like(v), np.ones_like(v)
        tanh = np.tanh(v / self._velocity)
        by_v = {"viscous": one, "coulomb": (1.0 - tanh**2) / self._velocity, "offset": zero, "armature": zero}
        for number, term in enumerate(self._terms):
            for joint in range(n_joints):
                feature = width + number * n_joints + joint
                jacobian[:, joint, feature, n_joints + joint] = by_v[term][:, joint]
                jacobian[:, joint, feature, 2 * n_joints + joint] = float(term == "armature")
        return jacobian

    def _theta_derivatives(self, X: np.ndarray) -> np.ndarray:
        v = np.split(X, 3, axis=1)[1]
        (n, n_joints), first = v.shape, (10 + self._terms.index("coulomb")) * v.shape[1]
        # d tanh(v / v_s) / d v_s
        slope = (np.tanh(v / self._velocity) ** 2 - 1.0) * v / self._velocity**2
        jacobian = np.zeros((n, n_joints, (10 + len(self._terms)) * n_joints, len(self._targets)))
        for number, (_, joints) in enumerate(self._targets.values()):
            for joint in joints:
                jacobian[:, joint, first + joint, number] = slope[:, joint]
        return jacobian

    def _names(self, columns: np.ndarray) -> list[str]:
        if self.robot is None:
            return columns.tolist()
        joints = columns[: self._layout.n_joints]
        inertial = [f"{name}({joint})" for joint in joints for name in _INERTIAL]
        return inertial + [f"{term}({joint})" for term in self._terms for joint in joints]

    @available_if(has_robot)
    def coef_prior(self, n_outputs: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the prior of the weights β = (π, φ), which all joints share.

        Parameters
        ----------
        n_outputs : int
            Number of predicted torques, one for each joint.

        Returns
        -------
        mean : ndarray of shape (n_features_out,)
            Parameters of the robot's model: links, armatures, damping and dry friction. Offsets are 0.
        covariance : ndarray of shape (n_features_out, n_features_out)
            Covariance to first order in the errors of mass, centre of mass and shape. Links are independent.

        Raises
        ------
        ValueError
            If ``n_outputs`` is not the number of joints, or a parameter is out of its range.
        """
        self._validate_params()
        terms, model = self._checked_friction(), getattr(self, "model_", None) or load_robot(self.robot)
        if n_outputs != model.nv:
            raise ValueError(
                f"y has {n_outputs} columns, but {type(self).__name__} of the robot {model.name!r} predicts the "
                f"torques of its {model.nv} joints {list(model.names)[1:]}."
            )
        links = np.array([link.toDynamicParameters() for link in list(model.inertias)[1:]])
        sizes = _sizes(model)
        own = {
            "viscous": np.array(model.damping),
            "coulomb": np.array(model.friction),
            "offset": np.zeros(model.nv),
            "armature": np.array(model.armature),
        }
        units = {"viscous": _SPEED, "coulomb": 1.0, "offset": 1.0, "armature": _ACCELERATION}
        scale = self.friction_scale * _largest_torques(model, sizes)
        mean = np.concatenate([links.ravel(), *(own[term] for term in terms)])
        covariance = np.zeros((len(mean), len(mean)))
        for number, (link, size) in enumerate(zip(links, sizes, strict=True)):
            of = slice(10 * number, 10 * number + 10)
            root = _link_errors(link, size, self.mass_scale, self.com_scale, self.inertia_scale)
            covariance[of, of] = root @ root.T
        friction = np.concatenate([np.zeros(0), *(scale / units[term] for term in terms)])
        covariance[range(links.size, len(mean)), range(links.size, len(mean))] = friction**2
        return mean, covariance

    @available_if(has_robot)
    def coef_groups(self, n_outputs: int) -> np.ndarray:
        """Name the groups of weights whose prior standard deviations are learned together.

        Parameters
        ----------
        n_outputs : int
            Number of predicted torques, one for each joint.

        Returns
        -------
        labels : ndarray of str of shape (n_features_out,)
            "inertia" for the inertial parameters of all links, and the names in ``friction``.
        """
        terms = self._checked_friction()
        labels = ["inertia"] * (len(_INERTIAL) * n_outputs) + [term for term in terms for _ in range(n_outputs)]
        return np.array(labels, dtype=object)


def _sizes(model: Any) -> np.ndarray:
    """Return the size of each link: distance to the farthest joint or centre of mass on it, or radius of gyration."""
    sizes = np.zeros(model.nv)
    for joint in range(1, model.njoints):
        link = model.inertias[joint]
        if link.mass > 0.0:
            sizes[joint - 1] = max(sizes[joint - 1], np.sqrt(max(np.trace(link.inertia), 0.0) / 2.0 / link.mass))
            sizes[joint - 1] = max(sizes[joint - 1], np.linalg.norm(link.lever))
        if (parent := model.parents[joint]) > 0:
            sizes[parent - 1] = max(sizes[parent - 1], np.linalg.norm(model.jointPlacements[joint].translation))
    return sizes


def _largest_torques(model: Any, sizes: np.ndarray) -> np.ndarray:
    """Return the effort limit of each joint, or the weight of all links times their reach if it has none."""
    least, largest = effort_limits(model)
    limits = np.maximum(np.abs(least), np.abs(largest))
    weight = _G * sum(link.mass for link in list(model.inertias)[1:]) * sizes.sum()
    return np.where(np.isfinite(limits) & (limits > 0.0), limits, max(weight, 1.0))


def _link_errors(link: np.ndarray, size: float, mass: float, com: float, inertia: float) -> np.ndarray:
    """Return a root C (10, 10) of the prior covariance C Cᵀ of a link's parameters."""
    # To first order in the errors of its mass, its centre of mass c, and its inertia about c.
    m, moment = link[0], link[1:4]
    c = moment / m if m > 0.0 else np.zeros(3)
    root = np.zeros((10, 10))
    root[:, 0] = mass * link  # a heavier link of the same shape
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = com * size * m
        # The inertia about the joint contains m (cᵀc 1 - c cᵀ), which changes with c.
        moved = 2.0 * (c @ shift) * np.eye(3) - np.outer(c, shift) - np.outer(shift, c)
        root[1:4, 1 + axis] = shift
        root[4:, 1 + axis] = moved[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    root[4:, 4:] = inertia * m * size**2 * np.eye(6)
    return root
