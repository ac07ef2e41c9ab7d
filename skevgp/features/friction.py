"""Friction of the joints as explicit features of forward dynamics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..robots import Layout
from ..robots.loading import Robot
from ..utils.shapes import same_for_all
from ..utils.sklearn import Interval, StrOptions
from .robot_map import STEP, ParametricMap, RobotMap, VelocityPrior, one_per_joint
from .theta import Prior

_TERMS = ("viscous", "coulomb", "stribeck")
# The numbers that each term depends on.
_NEEDED: dict[str, tuple[str, ...]] = {
    "viscous": (),
    "coulomb": ("stiction_velocity",),
    "stribeck": ("stiction_velocity", "stribeck_velocity", "sharpness"),
}
# (|v| / v_S)^δ is kept within these bounds, so that its derivatives are finite for any v.
SMALLEST_RATIO, LARGEST_POWER = 1e-100, 700.0


class Friction(ParametricMap, RobotMap):
    r"""Friction of each joint as features of its velocity.

    The features of a joint with velocity :math:`v = \dot q` are

    .. math:: v, \qquad \tanh(v / v_s), \qquad \tanh(v / v_s)\,\exp(-(|v| / v_S)^\delta)

    for viscous friction, Coulomb friction, and the higher friction at low speed (Stribeck effect). Join them to
    `InertiaForce` or `NominalDynamics`. The weights are the decelerations by each term.

    Parameters
    ----------
    robot : str, path-like, System, pinocchio.Model or None, default=None
        Robot, as in `skevgp.datasets.load_robot`. If None, X passes through, and the weights get the wide default prior
        of the regressor.
    terms : sequence of str, default=("viscous", "coulomb", "stribeck")
        Groups of columns, with one column for each joint.
    stiction_velocity : float or array-like of shape (n_joints,), default=0.01
        Velocity v_s in rad/s or m/s, above 0. Friction changes its sign smoothly between -v_s and v_s.
    stribeck_velocity : float or array-like of shape (n_joints,), default=0.1
        Velocity v_S in rad/s or m/s, above 0, at which the Stribeck effect has decreased to 37 %.
    sharpness : float or array-like of shape (n_joints,), default=2.0
        Exponent δ of the Stribeck effect, above 0. Typical values are from 0.5 to 2.
    dt : float or "column", default=0.03
        Time step Δt of the data, s. If ``"column"``, X is [q, q̇, u, Δt] with the time step of each row. Features are
        multiplied by it, and weights are rates.
    outputs : sequence of int or str, default=None
        States in the columns of y, by index or name. If None, all states [q, q̇].
    unknown_ratio : float, default=1.0
        Prior standard deviation of the contribution of a feature to the velocity of its joint, in units of the residual
        of the prior mean.
    coupling_ratio : float, default=0.3
        Prior standard deviation of the contribution to the velocities of other joints, as a share of ``unknown_ratio``.
        If 0, these weights stay 0.
    parameters : dict of str to `Normal`, `LogNormal` or `Uniform`, default=None
        Priors of unknown numbers, such as ``{"sharpness": Uniform(0.5, 2.5)}`` for all joints or
        ``{"stribeck_velocity(elbow)": LogNormal(0.1, 0.5)}`` for one. They replace ``stiction_velocity``,
        ``stribeck_velocity`` and ``sharpness``. The regressor learns their values. If None, all numbers are as given.

    Attributes
    ----------
    theta_ : dict of str to float
        Values that ``transform`` uses. `fit` sets the prior medians, and a regressor sets the posterior medians in its
        ``feature_map_``.
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it has any.

    See Also
    --------
    RigidBodyRegressor : Friction in inverse dynamics.
    NominalDynamics : Accelerations without dry friction.

    Notes
    -----
    The weights have mean 0. Prior standard deviations for a position are Δt times those for its velocity. Do not scale
    the columns of X before this map. Scale in the ``kernel_map`` of the regressor, which only the kernel uses.

    References
    ----------
    - B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit (1994): A survey of models, analysis tools and compensation
      methods for the control of machines with friction.

    Examples
    --------
    >>> from skevgp.features import Friction, LogNormal
    >>> friction = Friction("pendulum", parameters={"stribeck_velocity": LogNormal(0.1, 0.5)})
    >>> friction.fit_transform([[0.0, 0.05, 1.0]]).round(4)
    array([[0.05  , 0.9999, 0.7787]])
    >>> friction.get_feature_names_out().tolist()
    ['viscous(q)', 'coulomb(q)', 'stribeck(q)']
    >>> friction.theta_
    {'stribeck_velocity': 0.1}
    """

    def __init__(
        self,
        robot: Robot | None = None,
        *,
        terms: Sequence[str] = _TERMS,
        stiction_velocity: float | ArrayLike = 0.01,
        stribeck_velocity: float | ArrayLike = 0.1,
        sharpness: float | ArrayLike = 2.0,
        dt: float | Literal["column"] = STEP,
        outputs: Sequence[int | str] | None = None,
        unknown_ratio: float = 1.0,
        coupling_ratio: float = 0.3,
        parameters: Mapping[str, Prior] | None = None,
    ):
        self.robot = robot
        self.terms = terms
        self.stiction_velocity = stiction_velocity
        self.stribeck_velocity = stribeck_velocity
        self.sharpness = sharpness
        self.dt = dt
        self.outputs = outputs
        self.unknown_ratio = unknown_ratio
        self.coupling_ratio = coupling_ratio
        self.parameters = parameters

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **ParametricMap._parameter_constraints,
        **RobotMap._parameter_constraints,
        "terms": ["array-like"],
        "stiction_velocity": [Interval(Real, 0, None, closed="neither"), "array-like"],
        "stribeck_velocity": [Interval(Real, 0, None, closed="neither"), "array-like"],
        "sharpness": [Interval(Real, 0, None, closed="neither"), "array-like"],
        "dt": [Interval(Real, 0, None, closed="neither"), StrOptions({"column"})],
        "unknown_ratio": [Interval(Real, 0, None, closed="left")],
        "coupling_ratio": [Interval(Real, 0, None, closed="left")],
    }

    def _prepare(self, robot: Robot | None) -> None:
        self._terms = self._checked_terms()
        n_joints = 1 if robot is None else self._layout.n_joints
        self._given = {
            name: np.broadcast_to(one_per_joint(getattr(self, name), name, n_joints), n_joints).tolist()
            for name in _NEEDED["stribeck"]
        }
        self._numbers = {name: np.array(values) for name, values in self._given.items()}

    def _checked_terms(self) -> tuple[str, ...]:
        terms = [term for term in self.terms if isinstance(term, str) and term in _TERMS]
        if not terms or len(terms) < len(self.terms) or len(set(terms)) < len(terms):
            raise ValueError(f"terms={self.terms!r} must be one or more of {list(_TERMS)}, each once.")
        return tuple(terms)

    # --- parameters ---------------------------------------------------------------------------------------------------

    def _allowed_parameters(self) -> dict[str, tuple[str, list[int]]]:
        kinds = list(dict.fromkeys(kind for term in self._terms for kind in _NEEDED[term]))
        joints = list(range(self._layout.n_joints))
        return {kind: (kind, joints) for kind in kinds} | self._one_per_joint(kinds, joints)

    def _store_theta(self) -> None:
        self._numbers = {name: np.array(values) for name, values in self._numbers_of_joints().items()}

    def _numbers_of_joints(self) -> dict[str, list[Any]]:
        return {name: self._at_theta(name, values) for name, values in self._given.items()}

    def _unit(self, kind: str, joints: list[int]) -> str:
        return "" if kind == "sharpness" else self._speed_unit(joints)

    def _theta_derivatives(self, X: np.ndarray) -> np.ndarray:
        n_joints = self._layout.n_joints
        by_kind = {kind: self._by_kind(X[:, n_joints : 2 * n_joints], kind) for kind, _ in self._targets.values()}
        jacobian = np.zeros((len(X), len(self._terms), n_joints, len(self._targets)))
        for number, (kind, joints) in enumerate(self._targets.values()):
            for place, term in enumerate(self._terms):
                if kind in _NEEDED[term]:
                    jacobian[:, place, joints, number] = by_kind[kind][term][:, joints]
        return jacobian.reshape(len(X), -1, len(self._targets))

    def _by_kind(self, v: np.ndarray, kind: str) -> dict[str, np.ndarray]:
        """Return derivatives (n, n_joints) of the terms in the number of each joint."""
        tanh, ratio, power, decay = self._parts(v)
        if kind == "stiction_velocity":
            slope = (tanh**2 - 1.0) * v / self._numbers[kind] ** 2
            return {"coulomb": slope, "stribeck": slope * decay}
        if kind == "stribeck_velocity":
            return {"stribeck": tanh * decay * power * self._numbers["sharpness"] / self._numbers[kind]}
        return {"stribeck": -tanh * decay * power * np.log(ratio)}

    # --- features -----------------------------------------------------------------------------------------------------

    def _parts(self, v: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return tanh(v / v_s), r = |v| / v_S, r^δ and exp(-r^δ)."""
        ratio = np.maximum(np.abs(v) / self._numbers["stribeck_velocity"], SMALLEST_RATIO)
        with np.errstate(over="ignore"):
            power = np.minimum(ratio ** self._numbers["sharpness"], LARGEST_POWER)
        return np.tanh(v / self._numbers["stiction_velocity"]), ratio, power, np.exp(-power)

    def _features(self, X: np.ndarray) -> np.ndarray:
        if self.robot is None:
            return X.copy()
        v = X[:, self._layout.n_joints : 2 * self._layout.n_joints]
        tanh, _, _, decay = self._parts(v)
        values = {"viscous": v, "coulomb": tanh, "stribeck": tanh * decay}
        return np.hstack([values[term] for term in self._terms])

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        if self.robot is None:
            return same_for_all(np.eye(X.shape[1]), len(X))
        n = self._layout.n_joints
        v = X[:, n : 2 * n]
        tanh, ratio, power, decay = self._parts(v)
        steep = (1.0 - tanh**2) / self._numbers["stiction_velocity"]
        # d r^δ / dv
        slope = self._numbers["sharpness"] * power / ratio * np.sign(v) / self._numbers["stribeck_velocity"]
        by_v = {"viscous": np.ones_like(v), "coulomb": steep, "stribeck": (steep - tanh * slope) * decay}
        jacobian = np.zeros((len(X), len(self._terms), n, X.shape[1]))
        for place, term in enumerate(self._terms):
            jacobian[:, place, range(n), range(n, 2 * n)] = by_v[term]
        return jacobian.reshape(len(X), -1, X.shape[1])

    def _names(self, columns: np.ndarray) -> list[str]:
        if self.robot is None:
            return list(columns)
        return [f"{term}({joint})" for term in self._terms for joint in columns[: self._layout.n_joints]]

    # --- prior of the weights -----------------------------------------------------------------------------------------

    def _mean(self, layout: Layout, dt: float) -> np.ndarray:
        return np.zeros((2 * layout.n_joints, layout.n_joints * len(self._checked_terms())))

    def _velocity_prior(self, layout: Layout) -> VelocityPrior:
        n = layout.n_joints
        prior = VelocityPrior.of(n, 0, 0.0, "")
        for _ in self._checked_terms():
            block = VelocityPrior.of(n, n, self.coupling_ratio * self.unknown_ratio, "coupling")
            block.set(np.eye(n, dtype=bool), self.unknown_ratio, "friction")
            prior = prior.beside(block)
        return prior
