"""Torque of gravity on each link as explicit features (section III-B of the paper)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, ClassVar, Literal

import numpy as np

from ..robots import GravityTerm, Layout, get_system, layout_of
from ..robots.loading import Robot, joint_axes, known_robot
from ..robots.systems import GRAVITY
from ..utils.shapes import same_for_all
from ..utils.sklearn import Interval, StrOptions
from .robot_map import ParametricMap, RobotMap, VelocityPrior, indices_of
from .theta import Prior

# An axis counts as vertical up to this angle in rad, because URDF files round π/2.
_TILT = 1e-3
# Number of rows at a time, so that their rotations stay in the cache.
_BLOCK = 1024
# Index and sign of the component of w = Rᵀg along (u_x, u_y, u_z) for each lever: (u_x × w)·u_z = w·u_y and
# (u_y × w)·u_z = -w·u_x. The axis of a prismatic joint is its u_z.
_COMPONENTS = {"u_x": (1, 1.0), "u_y": (0, -1.0), "": (2, 1.0)}


class GravityMap(RobotMap):
    """Features of gravity alone, with a prior that knows which joints each feature accelerates."""

    inverse_length: float
    unknown_ratio: float
    coupling_ratio: float
    # What a weight is per 1/l: 1 for features in m/s².
    _per_length: ClassVar[float] = 1.0

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **RobotMap._parameter_constraints,
        "inverse_length": [Interval(Real, 0, None, closed="left")],
        "unknown_ratio": [Interval(Real, 0, None, closed="left")],
        "coupling_ratio": [Interval(Real, 0, None, closed="left")],
    }

    def _terms(self) -> Sequence[GravityTerm | Lever]:
        """List one term for each feature; works before `fit` if there is a robot."""
        raise NotImplementedError

    def _acts_on(self, layout: Layout) -> np.ndarray:
        """Whether each feature accelerates each joint, (n_joints, n_features_out)."""
        terms = self._terms()
        acts_on = np.zeros((layout.n_joints, len(terms)), dtype=bool)
        for column, term in enumerate(terms):
            acts_on[list(term.acts_on), column] = True
        return acts_on

    def _mean(self, layout: Layout, dt: float) -> np.ndarray:
        return np.zeros((2 * layout.n_joints, len(self._terms())))

    def _velocity_prior(self, layout: Layout) -> VelocityPrior:
        # Gravity decelerates a link by g / l times the sine of its angle.
        acts_on, rate = self._acts_on(layout), self._per_length * self.inverse_length
        prior = VelocityPrior.of(layout.n_joints, acts_on.shape[1], np.nan, "")
        ratio = self.unknown_ratio
        prior.set_rate(acts_on, rate, "gravity", ratio)
        prior.set_rate(~acts_on, self.coupling_ratio * rate, "coupling", self.coupling_ratio * ratio)
        return prior


class SineGravity(GravityMap):
    """The sine of each angle against the vertical of a planar system, or of every column without a robot."""

    _per_length: ClassVar[float] = GRAVITY

    def __init__(self, robot: Robot | None, inverse_length: float, unknown_ratio: float, coupling_ratio: float):
        self.robot = robot
        self.outputs = None
        self.inverse_length = inverse_length
        self.unknown_ratio = unknown_ratio
        self.coupling_ratio = coupling_ratio

    def _terms(self) -> Sequence[GravityTerm]:
        assert self.robot is not None
        return get_system(self.robot).gravity

    def _prepare(self, robot: Robot | None) -> None:
        angles: list[tuple[int, ...]] = [(column,) for column in range(self.n_features_in_)]
        if robot is not None:
            angles = [term.angle for term in self._terms()]
        self._first = np.array([columns[0] for columns in angles])
        self._further = [(term, column) for term, columns in enumerate(angles) for column in columns[1:]]
        self._summed = np.zeros((len(angles), self.n_features_in_))  # angles of the terms are X @ summed.T
        for term, columns in enumerate(angles):
            self._summed[term, list(columns)] = 1.0

    def _angles(self, X: np.ndarray) -> np.ndarray:
        angles = X.take(self._first, axis=1)
        for term, column in self._further:
            angles[:, term] += X[:, column]
        return angles

    def _features(self, X: np.ndarray) -> np.ndarray:
        return np.sin(self._angles(X))

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        return np.cos(self._angles(X))[:, :, np.newaxis] * self._summed

    def _names(self, columns: np.ndarray) -> list[str]:
        if self.robot is None:
            return [f"sin({name})" for name in columns]
        return [f"sin({' + '.join(columns[list(term.angle)])})" for term in self._terms()]


class OffsetAngles(ParametricMap):
    """A map whose features of gravity take each angle plus an offset, which is a parameter."""

    _signed: ClassVar[tuple[str, ...]] = ("offset",)
    _offsets: np.ndarray

    def _allowed_parameters(self) -> dict[str, tuple[str, list[int]]]:
        return self._one_per_joint(["offset"], np.flatnonzero(self._layout.revolute).tolist())

    def _store_theta(self) -> None:
        self._offsets = np.array(self._at_theta("offset", [0.0] * self._layout.n_joints))

    def _with_offsets(self, X: np.ndarray) -> np.ndarray:
        """Return rows with the angles of which gravity is a function."""
        if not self._targets:
            return X
        X = X.copy()
        X[:, : len(self._offsets)] += self._offsets
        return X

    def _by_offsets(self, by_x: np.ndarray) -> np.ndarray:
        """Return derivatives in the parameters, given those in x."""
        return by_x[:, :, [joints[0] for _, joints in self._targets.values()]]

    def _unit(self, kind: str, joints: list[int]) -> str:
        return "rad"


@dataclass(frozen=True)
class Lever:
    """A feature of `LinkGravity`: gravity on one link along one lever."""

    link: int
    name: str  # "u_x" or "u_y"; empty for a prismatic joint, which has no lever
    acts_on: tuple[int, ...]  # joints between the base and the link


class LinkGravity(OffsetAngles, GravityMap):
    r"""Torque of gravity about the axis of each joint, for a unit mass at the end of a unit lever on its link.

    The features of a link i with a revolute joint are

    .. math:: (u_x \times R_i^\top g) \cdot u_z, \qquad (u_y \times R_i^\top g) \cdot u_z.

    Here :math:`R_i` is the rotation of the link, :math:`g` is the gravity vector, and :math:`u_z` is the axis of the
    joint in its own frame. A prismatic joint has one feature, gravity along its axis. All features are in m/s². The
    weights are products of the mass and the centre of mass of the link. See the user guide, :doc:`/guide/priors`.

    Parameters
    ----------
    robot : str, path-like, System or pinocchio.Model, default=None
        Robot, as in `skevgp.datasets.load_robot`. If None, X passes through, and the weights get the wide default prior
        of the regressor.
    axes : {"xy", "x"}, default="xy"
        Levers: :math:`u_x` and :math:`u_y`, which represent any centre of mass, or :math:`u_x` alone, as in the paper.
    links : sequence of int or str, default=None
        Links, by the name of their joint or its index from 0. If None, all links.
    outputs : sequence of int or str, default=None
        States in the columns of y, by index or name. If None, all states [q, q̇].
    inverse_length : float, default=3.0
        Prior standard deviation of 1/l in 1/m, with the length l of a pendulum equivalent to the link.
    unknown_ratio : float, default=1.0
        Largest prior standard deviation of the contribution of a feature to a velocity, in units of the residual of the
        prior mean.
    coupling_ratio : float, default=0.3
        Prior standard deviation of the contribution to the velocities of other joints, as a share of that.
    dt : float, "column" or None, default=None
        Time step Δt of the data in s, for the prior. If ``"column"``, the last column of X is the time step, and
        weights are rates. If None, it is unknown.
    parameters : dict of str to `Normal`, `LogNormal` or `Uniform`, default=None
        Priors of unknown offsets of angles in rad, such as ``{"offset(q1)": Normal(0.0, 0.05)}``. The regressor learns
        the offsets. If None, angles are as in X.

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
    InertiaForceGravity : These features together with x = [q, q̇, u].

    Notes
    -----
    The torque of gravity at a joint is linear in the features of its link if all later joints turn about parallel axes.

    X has all columns [q, q̇, u], of which only q is used. Do not scale the columns of X before this map. Scale in the
    ``kernel_map`` of the regressor, which only the kernel uses.

    Examples
    --------
    >>> import numpy as np
    >>> from skevgp.features import LinkGravity
    >>> features = LinkGravity("pendulum")
    >>> features.fit_transform([[np.pi / 6, 0.0, 1.0]]).round(3)
    array([[4.905, 8.496]])
    >>> features.get_feature_names_out().tolist()
    ['gravity(q, u_x)', 'gravity(q, u_y)']

    Join them to other features:

    >>> from sklearn.pipeline import FeatureUnion
    >>> from skevgp.features import InertiaForce
    >>> union = FeatureUnion([("inertia", InertiaForce("iiwa14")), ("gravity", LinkGravity("iiwa14", axes="x"))])
    >>> union.fit_transform(np.zeros((1, 21))).shape
    (1, 28)
    """

    def __init__(
        self,
        robot: Robot | None = None,
        *,
        axes: str = "xy",
        links: Sequence[int | str] | None = None,
        outputs: Sequence[int | str] | None = None,
        inverse_length: float = 3.0,
        unknown_ratio: float = 1.0,
        coupling_ratio: float = 0.3,
        dt: float | Literal["column"] | None = None,
        parameters: Mapping[str, Prior] | None = None,
    ):
        self.robot = robot
        self.axes = axes
        self.links = links
        self.outputs = outputs
        self.inverse_length = inverse_length
        self.unknown_ratio = unknown_ratio
        self.coupling_ratio = coupling_ratio
        self.dt = dt
        self.parameters = parameters

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **OffsetAngles._parameter_constraints,
        **GravityMap._parameter_constraints,
        "axes": [StrOptions({"xy", "x"})],
        "links": ["array-like", None],
        "dt": [Interval(Real, 0, None, closed="neither"), StrOptions({"column"}), None],
    }

    def _prepare(self, robot: Robot | None) -> None:
        if robot is not None:
            model = known_robot(robot)
            self._levers = self._levers_of(model)
            self._links = Links(model)
            components = [_COMPONENTS[lever.name] for lever in self._levers]
            self._columns = np.array(
                [3 * lever.link + axis for lever, (axis, _) in zip(self._levers, components, strict=True)], dtype=int
            )
            self._signs = np.array([sign for _, sign in components])

    def _terms(self) -> Sequence[Lever]:
        return self._levers if hasattr(self, "_levers") else self._levers_of(known_robot(self.robot))

    def _levers_of(self, model: Any) -> list[Lever]:
        names = list(model.names)[1:]
        links = list(range(len(names)))
        if self.links is not None:
            links = indices_of(self.links, names, "links", "links")
            if len(set(links)) < len(links):
                raise ValueError(f"links={list(self.links)!r} must not name a link twice.")
        turns = np.any(joint_axes(model)[:, 3:], axis=1)
        return [
            Lever(link, name, tuple(joint - 1 for joint in model.supports[link + 1] if joint > 0))
            for link in links
            for name in ([f"u_{axis}" for axis in self.axes] if turns[link] else [""])
        ]

    def _features(self, X: np.ndarray) -> np.ndarray:
        if self.robot is None:
            return X.copy()
        if len(X) > _BLOCK:
            return np.vstack([self._features(X[start : start + _BLOCK]) for start in range(0, len(X), _BLOCK)])
        q = self._with_offsets(X)[:, : self._layout.n_joints]
        return self._links.gravity(q)[:, self._columns] * self._signs

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        if self.robot is None:
            return same_for_all(np.eye(X.shape[1]), len(X))
        n, columns = self._layout.n_joints, self._columns
        jacobian = np.zeros((len(X), len(columns), X.shape[1]))
        X = self._with_offsets(X)
        for start in range(0, len(X), _BLOCK):
            rows = slice(start, start + _BLOCK)
            by_q = self._links.gravity_jacobian(X[rows, :n])[:, columns]
            jacobian[rows, :, :n] = by_q * self._signs[:, np.newaxis]
        return jacobian

    def _theta_derivatives(self, X: np.ndarray) -> np.ndarray:
        return self._by_offsets(self._jacobian(X))

    def _names(self, columns: np.ndarray) -> list[str]:
        if self.robot is None:
            return list(columns)
        return [f"gravity({', '.join(filter(None, (columns[lever.link], lever.name)))})" for lever in self._levers]


class Links:
    """Forward kinematics of many rows at once: rotations only, which is all that gravity needs."""

    def __init__(self, model: Any):
        # Gravity is passed on from each link to the next, as components along (u_x, u_y, u_z) of its joint. The
        # rotation of a link in its parent is fixed + cos(q) * cosine + sin(q) * sine.
        axes = joint_axes(model)
        self._turns = np.any(axes[:, 3:], axis=1).astype(float)[:, np.newaxis, np.newaxis, np.newaxis]
        self._parents = [parent - 1 for parent in list(model.parents)[1:]]
        self._weight = np.reshape(model.gravity.linear, (1, 1, 3))
        frames = [_right_handed(axis[:3] + axis[3:]) for axis in axes]
        at_zero = [
            (frames[parent].T if parent >= 0 else np.eye(3)) @ placement.rotation @ frame
            for parent, placement, frame in zip(self._parents, list(model.jointPlacements)[1:], frames, strict=True)
        ]
        self._fixed, self._cosine, self._sine = (
            (np.array(at_zero) @ np.array(part, dtype=float))[:, np.newaxis]
            for part in (np.diag([0, 0, 1]), np.diag([1, 1, 0]), [[0, -1, 0], [1, 0, 0], [0, 0, 0]])
        )

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Return Rᵢᵀg along u_x, u_y and u_z of each link i, (n, 3 * n_joints), at positions (n, n_joints)."""
        weights: list[np.ndarray] = []  # of (n, 1, 3)
        for parent, rotation in zip(self._parents, self._rotations(q), strict=True):
            weights.append((weights[parent] if parent >= 0 else self._weight) @ rotation)
        return np.concatenate(weights, axis=2)[:, 0]

    def gravity_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return derivatives of `gravity` with respect to positions, (n, 3 * n_joints, n_joints)."""
        # The derivatives of a link are its parent's, rotated. In the frame of a link that turns about its own u_z,
        # (w_x, w_y, w_z) turns the other way: its derivative is (w_y, -w_x, 0).
        n_joints = q.shape[1]
        at_base = np.concatenate([self._weight, np.zeros((1, n_joints, 3))], axis=1)
        passed: list[np.ndarray] = []  # of (n, 1 + n_joints, 3): gravity, then its derivative by each position
        for joint, (parent, rotation) in enumerate(zip(self._parents, self._rotations(q), strict=True)):
            here = (passed[parent] if parent >= 0 else at_base) @ rotation
            if self._turns[joint]:
                here[:, 1 + joint, 0], here[:, 1 + joint, 1] = here[:, 0, 1], -here[:, 0, 0]
            passed.append(here)
        return np.concatenate([here[:, 1:] for here in passed], axis=2).transpose(0, 2, 1)

    def _rotations(self, q: np.ndarray) -> np.ndarray:
        """Return the rotation of each link in its parent, (n_joints, n, 3, 3)."""
        angles = q.T[:, :, np.newaxis, np.newaxis] * self._turns
        rotations = np.cos(angles) * self._cosine
        rotations += np.sin(angles) * self._sine
        rotations += self._fixed
        return rotations


def _right_handed(axis: np.ndarray) -> np.ndarray:
    """Return the columns u_x, u_y and u_z, which is the joint's axis."""
    lever = np.eye(3)[(np.argmax(np.abs(axis)) + 1) % 3]
    lever = lever - (lever @ axis) * axis
    lever /= np.linalg.norm(lever)
    return np.column_stack([lever, np.cross(axis, lever), axis])


def links_under_gravity(robot: Robot) -> list[int]:
    """List the links with a feature of `LinkGravity` that is not 0 in some of a few fixed random positions."""
    X = np.random.RandomState(0).uniform(-np.pi, np.pi, (5, layout_of(robot).n_columns))
    features = LinkGravity(robot).fit(X)
    pulled = np.abs(features.transform(X)).max(axis=0) > _TILT * np.linalg.norm(features._links._weight)
    return sorted({lever.link for lever, moves in zip(features._levers, pulled, strict=True) if moves})
