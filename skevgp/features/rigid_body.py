"""Torques of a rigid body with friction, linear in masses, first moments, inertias and friction: one row per joint."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.metaestimators import available_if

from ..robots import RigidBody, load_robot
from ..robots.loading import Robot, effort_limits, known_robot
from ..utils.sklearn import Interval
from ..utils.validation import as_floats
from .robot_map import RobotTransformer, has_robot, same_for_all

FRICTION = ("viscous", "coulomb", "offset", "armature")
_INERTIAL = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
# Gravity of the links beyond a joint, where no motor's limit says how large its torque may be.
_G = 9.81
# rad/s or m/s, rad/s² or m/s²: at which viscous friction and a rotor's inertia may be as large as Coulomb's friction.
_SPEED, _ACCELERATION = 1.0, 10.0
# Of the central differences; their error, of fourth order, is then that of rounding.
_STEP = 1e-3


class RigidBodyRegressor(RobotTransformer):
    r"""Features of inverse dynamics: the torques of all joints are linear in one set of weights.

    A robot's equation of motion with friction is

    .. math:: \tau = Y(q, \dot q, \ddot q)\,\pi + F(\dot q, \ddot q)\,\varphi

    where π holds ten inertial parameters of each link (mass m, first moments m c, moments of inertia about the joint's
    frame), and φ the friction of each joint: viscous, Coulomb's, an offset, and the reflected inertia of its rotor
    ("armature"). The map gives the matrix [Y F] of each row, a row per joint; `EVGPRegressor` then fits one β = (π, φ)
    that all joints share, as `share_coef` tells it. The prior mean is the robot's model, a URDF with wrong masses for
    example. What torques do not show (the mass of a base that never moves) stays at the prior, with its uncertainty.

    Parameters
    ----------
    robot : str, path-like, System, pinocchio.Model or None, default=None
        As in `skevgp.datasets.load_robot`. Without one X passes through, a row for all outputs, and nothing is shared.
    friction : sequence of str, default=("viscous", "coulomb", "offset", "armature")
        What each joint has beside its links: a torque :math:`\dot q`, :math:`\tanh(\dot q / v_s)`, 1 and
        :math:`\ddot q` times a weight.
    stiction_velocity : float or array-like of shape (n_joints,), default=0.01
        v_s, rad/s or m/s, of all joints or of each: below it Coulomb's friction has no sign yet. Above 0.
    mass_scale : float, default=0.2
        Prior standard deviation of each link's mass, as a share of it.
    com_scale : float, default=0.2
        That of each coordinate of its centre of mass, as a share of the link's size (see Notes).
    inertia_scale : float, default=0.3
        That of its moments of inertia, as a share of mass times squared size.
    friction_scale : float, default=0.3
        That of Coulomb's friction and of the offset, as a share of the largest torque of the joint's motor; viscous
        friction may be as large at 1 rad/s, the rotor's torque at 10 rad/s².

    Attributes
    ----------
    share_coef : bool
        Whether all outputs have the same weights: with a robot.
    model_ : pinocchio.Model
        The robot; only with one.
    n_features_in_ : int
    feature_names_in_ : ndarray of str
        If X had column names.

    See Also
    --------
    skevgp.InverseDynamics : The estimator of torques, parameters and bands that is made of it.
    NominalDynamics : The other direction, accelerations from torques.

    Notes
    -----
    A link's size is the largest of three lengths: from its joint to the next one, from its joint to its centre of mass,
    and the radius of gyration about that. An error of its mass changes first moments and inertias too, so the prior is
    a covariance (`coef_prior`). Where the model knows no limits of effort, the weight of all links, times the sum of
    their sizes, stands for the motor's largest torque.

    Rows need accelerations: `skevgp.datasets.load_log` makes them from a robot's log. Do not scale the columns of x
    before this map.

    References
    ----------
    - C. G. Atkeson, C. H. An, J. M. Hollerbach (1986): Estimation of Inertial Parameters of Manipulator Loads and
      Links. The regressor Y is Pinocchio's ``computeJointTorqueRegressor``.

    Examples
    --------
    >>> import numpy as np
    >>> from skevgp.datasets import load_robot
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
    ):
        self.robot = robot
        self.friction = friction
        self.stiction_velocity = stiction_velocity
        self.mass_scale = mass_scale
        self.com_scale = com_scale
        self.inertia_scale = inertia_scale
        self.friction_scale = friction_scale

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **RobotTransformer._parameter_constraints,
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
        # Rows have a matrix each with a robot, which no frame can hold, whatever `set_output` says.
        self._sklearn_auto_wrap_output_keys = {"transform"} if robot is None else set()
        if robot is not None:
            self.model_ = known_robot(robot).copy()
            self._body = RigidBody(self.model_)

    def _checked_velocity(self) -> np.ndarray:
        velocity = as_floats(self.stiction_velocity, "stiction_velocity")
        n_joints = 1 if self.robot is None else self._layout.n_joints
        if velocity.shape not in ((), (n_joints,)) or not (np.isfinite(velocity) & (velocity > 0.0)).all():
            raise ValueError(
                f"stiction_velocity={self.stiction_velocity!r} must be a number above 0, or one for each of the "
                f"{n_joints} joints."
            )
        return velocity

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
        """F(q̇, q̈), (n, n_joints, n_terms * n_joints): of each term a diagonal matrix."""
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
        """Of Y by differences of fourth order: it is quadratic in q̇, linear in q̈ and made of sines of q."""
        if self.robot is None:
            return same_for_all(np.eye(X.shape[1]), len(X))
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

    def _names(self, columns: np.ndarray) -> list[str]:
        if self.robot is None:
            return columns.tolist()
        joints = columns[: self._layout.n_joints]
        inertial = [f"{name}({joint})" for joint in joints for name in _INERTIAL]
        return inertial + [f"{term}({joint})" for term in self._terms for joint in joints]

    @available_if(has_robot)
    def coef_prior(self, n_outputs: int) -> tuple[np.ndarray, np.ndarray]:
        """Give the prior of the weights β = (π, φ), which all joints share.

        Parameters
        ----------
        n_outputs : int
            How many torques are predicted: one per joint.

        Returns
        -------
        mean : ndarray of shape (n_features_out,)
            Of the robot's model: its links, armatures, damping and dry friction; offsets 0.
        covariance : ndarray of shape (n_features_out, n_features_out)
            Of independent links; to first order in the errors of mass, centre of mass and shape.

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


def _sizes(model: Any) -> np.ndarray:
    """Of each link: the distance to the farthest joint on it, or to its centre of mass, or its radius of gyration."""
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
    """What the motor of each joint can give, or what the links weigh, times their reach."""
    least, largest = effort_limits(model)
    limits = np.maximum(np.abs(least), np.abs(largest))
    weight = _G * sum(link.mass for link in list(model.inertias)[1:]) * sizes.sum()
    return np.where(np.isfinite(limits) & (limits > 0.0), limits, max(weight, 1.0))


def _link_errors(link: np.ndarray, size: float, mass: float, com: float, inertia: float) -> np.ndarray:
    """C (10, 10) with the prior covariance C Cᵀ of a link's parameters, to first order in the errors of its mass, its
    centre of mass and its inertia about that.
    """
    m, moment = link[0], link[1:4]
    c = moment / m if m > 0.0 else np.zeros(3)
    root = np.zeros((10, 10))
    root[:, 0] = mass * link  # a heavier link of the same shape
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = com * size * m
        # I about the joint has m (cᵀc 1 - c cᵀ), which moves with c.
        moved = 2.0 * (c @ shift) * np.eye(3) - np.outer(c, shift) - np.outer(shift, c)
        root[1:4, 1 + axis] = shift
        root[4:, 1 + axis] = moved[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    root[4:, 4:] = inertia * m * size**2 * np.eye(6)
    return root
