"""Accelerations and torques of an approximate rigid-body model as explicit features."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, ClassVar, Literal

import numpy as np

from ..robots import Layout, RigidBody
from ..robots.loading import Robot, known_robot
from ..utils.shapes import same_for_all
from ..utils.sklearn import Interval, StrOptions
from .robot_map import STEP, ParametricMap, RobotMap, VelocityPrior
from .theta import Prior

_NAMES = {
    "acceleration": "acc({})",
    "midpoint": "acc in mid-step({})",
    "gravity": "gravity torque({})",
    "bias": "bias torque({})",
    "input": "acc by u({})",
}
# Kinds of parameters. A link's name may stand for its joint in the first ones.
_OF_LINKS, _OF_JOINTS = ("mass", "length", "inertia"), ("damping", "armature")
# Share of a factor by which differences move it.
_MOVE = 0.5


class NominalDynamics(ParametricMap, RobotMap):
    r"""Features from an approximate model of the robot, such as a URDF with inaccurate masses.

    The equation of motion of the model is

    .. math:: M(q) \ddot q + C(q, \dot q) \dot q + D \dot q + g(q) = B u

    with its viscous damping D and the inputs u on the driven joints. Join the features to `InertiaForce`, as in the
    example. See the user guide, :doc:`/guide/priors`.

    Parameters
    ----------
    robot : str, path-like, System, pinocchio.Model or None, default=None
        Approximate model, as in `skevgp.datasets.load_robot`. If None, X passes through, and the weights get the wide
        default prior of the regressor.
    terms : sequence of str, default=("acceleration",)
        Groups of columns, with one column for each joint:

        - ``"acceleration"``: :math:`\ddot q`, rad/s² or m/s²
        - ``"midpoint"``: :math:`\ddot q` in the middle of the time step, by the midpoint rule. Use it for long steps or
          fast motions. It needs a number as ``dt``
        - ``"gravity"``: :math:`g(q)`, N m or N
        - ``"bias"``: :math:`C \dot q + g`, N m or N
        - ``"input"``: :math:`M^{-1} B u`, the acceleration by the input
    dt : float or "column", default=0.03
        Time step Δt of the data, s. If ``"column"``, X is [q, q̇, u, Δt] with the time step of each row, and weights
        are rates.
    outputs : sequence of int or str, default=None
        States in the columns of y, by index or name. If None, all states [q, q̇].
    model_error : float, default=0.3
        Relative error of the accelerations of the model.
    unknown_ratio : float, default=1.0
        Prior standard deviation of the contribution of ``"gravity"`` and ``"bias"`` to velocities, in units of the
        residual of the prior mean.
    other_ratio : float, default=0.03
        Prior standard deviation of the contribution of all other features, in units of the same residual.
    parameters : dict of str to `Normal`, `LogNormal` or `Uniform`, default=None
        Priors of unknown factors on numbers of the model, such as ``{"mass(elbow)": LogNormal(1.0, 0.2)}``. The
        regressor learns the factors. If None, the model is used as it is. A joint and the link that it moves have these
        factors:

        - ``"mass(joint)"``: mass and rotational inertia of the link
        - ``"length(joint)"``: size of the link, with the same mass
        - ``"inertia(joint)"``: rotational inertia of the link about its centre of mass
        - ``"damping(joint)"``: viscous damping of the joint
        - ``"armature(joint)"``: reflected inertia of the rotor

    Attributes
    ----------
    theta_ : dict of str to float
        Factors that ``transform`` uses. `fit` sets the prior medians, and a regressor sets the posterior medians in its
        ``feature_map_``.
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it has any.

    See Also
    --------
    InertiaForce : Features of the state and the input, the other half of Euler's rule.
    skevgp.datasets.perturb_robot : Make an inaccurate model for experiments.

    Notes
    -----
    Weights have mean Δt for one term: ``"midpoint"``, or else ``"acceleration"``, or else ``"input"``. Those of the
    others have mean 0. Do not scale the columns of X before this map. Scale in the ``kernel_map`` of the regressor,
    which only the kernel uses.

    Examples
    --------
    >>> from sklearn.pipeline import make_union
    >>> from skevgp.features import InertiaForce, NominalDynamics
    >>> nominal = NominalDynamics("pendulum", terms=["acceleration", "gravity"])
    >>> nominal.fit_transform([[0.1, 0.0, 1.0]]).round(4)
    array([[2.0413, 0.4897]])
    >>> nominal.get_feature_names_out().tolist()
    ['acc(q)', 'gravity torque(q)']
    >>> nominal.coef_prior(n_outputs=2)[0]
    array([[0.  , 0.  ],
           [0.03, 0.  ]])
    >>> make_union(InertiaForce("pendulum"), nominal).fit_transform([[0.1, 0.0, 1.0]]).shape
    (1, 5)

    A cartpole whose pole has an unknown length:

    >>> from skevgp.features import LogNormal
    >>> cartpole = NominalDynamics("cartpole", parameters={"length(theta)": LogNormal(1.0, 0.2)})
    >>> cartpole.fit([[0.0, 0.1, 0.0, 0.0, 1.0]]).theta_
    {'length(theta)': 1.0}
    """

    def __init__(
        self,
        robot: Robot | None = None,
        *,
        terms: Sequence[str] = ("acceleration",),
        dt: float | Literal["column"] = STEP,
        outputs: Sequence[int | str] | None = None,
        model_error: float = 0.3,
        unknown_ratio: float = 1.0,
        other_ratio: float = 0.03,
        parameters: Mapping[str, Prior] | None = None,
    ):
        self.robot = robot
        self.terms = terms
        self.dt = dt
        self.outputs = outputs
        self.model_error = model_error
        self.unknown_ratio = unknown_ratio
        self.other_ratio = other_ratio
        self.parameters = parameters

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        **ParametricMap._parameter_constraints,
        **RobotMap._parameter_constraints,
        "terms": ["array-like"],
        "dt": [Interval(Real, 0, None, closed="neither"), StrOptions({"column"})],
        "model_error": [Interval(Real, 0, None, closed="left")],
        "unknown_ratio": [Interval(Real, 0, None, closed="left")],
        "other_ratio": [Interval(Real, 0, None, closed="left")],
    }

    # The robot without factors, if there are parameters, and with more and with less of each parameter.
    _given: RigidBody | None
    _moved: list[tuple[RigidBody, RigidBody, float]] | None

    def _prepare(self, robot: Robot | None) -> None:
        self._check_terms()
        self._terms = tuple(self.terms)
        if robot is None:
            return
        self._body = RigidBody(known_robot(robot))
        self._given = self._body if self.parameters else None
        # A massless tip makes the mass matrix singular in nearly every configuration. This row raises the error early.
        self._features(np.random.RandomState(0).uniform(-1.0, 1.0, (1, self._layout.n_columns)))

    def _check_terms(self) -> None:
        terms = [term for term in self.terms if isinstance(term, str) and term in _NAMES]
        if not terms or len(terms) < len(self.terms) or len(set(terms)) < len(terms):
            raise ValueError(f"terms={self.terms!r} must be one or more of {list(_NAMES)}, each once.")
        if "midpoint" in terms and isinstance(self.dt, str):
            raise ValueError(f'terms={self.terms!r} with "midpoint" needs a number as dt; got dt={self.dt!r}.')

    def _features(self, X: np.ndarray) -> np.ndarray:
        if self.robot is None:
            return X.copy()
        n = self._layout.n_joints
        q, v, u = X[:, :n], X[:, n : 2 * n], X[:, 2 * n :]
        body = self._body
        columns = {
            "acceleration": lambda: body.accelerations_under(q, v, u),
            "midpoint": lambda: body.accelerations_under(*self._middle(q, v, u)),
            "gravity": lambda: body.gravity(q),
            "bias": lambda: body.forces(q, v, np.zeros_like(v)),
            "input": lambda: body.accelerations_by_force(q, body.joint_forces(u)),
        }
        features = np.hstack([columns[term]() for term in self._terms])
        self._check_finite(features, q)
        return features

    def _jacobian(self, X: np.ndarray) -> np.ndarray:
        if self.robot is None:
            return same_for_all(np.eye(X.shape[1]), len(X))
        n = self._layout.n_joints
        q, v, u = X[:, :n], X[:, n : 2 * n], X[:, 2 * n :]
        body = self._body
        blocks = {
            "acceleration": lambda: body.accelerations_under_jacobian(q, v, u),
            "midpoint": lambda: self._midpoint_jacobian(q, v, u),
            "gravity": lambda: body.gravity_jacobian(q),
            "bias": lambda: body.forces_jacobian(q, v, np.zeros_like(v)),
            "input": lambda: body.accelerations_by_force_jacobian(q, u),
        }
        jacobian = np.concatenate([blocks[term]() for term in self._terms], axis=1)
        self._check_finite(jacobian, q)
        return jacobian

    # --- the midpoint rule --------------------------------------------------------------------------------------------

    def _half_step(self) -> float:
        assert self.dt is not None  # as for all of these maps
        assert not isinstance(self.dt, str)  # as _check_terms has found
        return 0.5 * self.dt

    def _middle(self, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the state in the middle of the time step, by Euler's rule, and the input."""
        h = self._half_step()
        return q + h * v, v + h * self._body.accelerations_under(q, v, u), u

    def _midpoint_jacobian(self, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        # With x_m = (q + h v, v + h a(x), u): da(x_m)/dx = J(x_m) + h [0, ∂a/∂q(x_m), 0] + h ∂a/∂v(x_m) J(x).
        n, h = q.shape[1], self._half_step()
        at_middle = self._body.accelerations_under_jacobian(*self._middle(q, v, u))
        jacobian = at_middle + h * at_middle[:, :, n : 2 * n] @ self._body.accelerations_under_jacobian(q, v, u)
        jacobian[:, :, n : 2 * n] += h * at_middle[:, :, :n]
        return jacobian

    # --- parameters ---------------------------------------------------------------------------------------------------

    def _model(self) -> Any:
        """Return the model without factors."""
        return (self._given or self._body).model

    def _allowed_parameters(self) -> dict[str, tuple[str, list[int]]]:
        model, n = self._model(), self._layout.n_joints
        links = list(model.inertias)[1:]
        lengths = [np.linalg.norm(link.lever) + np.linalg.norm(link.inertia) for link in links]
        for number, parent in enumerate(list(model.parents)[1:], start=1):
            if parent > 0:
                lengths[parent - 1] += np.linalg.norm(model.jointPlacements[number].translation)
        sizes = {
            "mass": [link.mass for link in links],
            "length": lengths,
            "inertia": [np.linalg.norm(link.inertia) for link in links],
            "damping": list(model.damping),
            "armature": list(model.armature),
        }
        allowed: dict[str, tuple[str, list[int]]] = {}
        for kind, numbers in sizes.items():
            allowed |= self._one_per_joint([kind], [joint for joint in range(n) if numbers[joint] > 0.0])
        return allowed

    def _why_not(self, name: str) -> str:
        kind, _, joint = name.removesuffix(")").partition("(")
        if kind not in ("damping", "armature") or joint not in ("", *self._layout.position_names):
            return ""
        if not joint and self._layout.n_joints == 1:
            return ""  # the list of parameters has it
        of_joint = f"joint {joint!r}" if joint else "any joint"
        instead = " Add Friction(robot) to the features, which learns it." if kind == "damping" else ""
        return f" The model of the robot has no {kind} above 0 for {of_joint}.{instead}"

    def _synonym(self, name: str) -> str:
        kind, _, owner = name.removesuffix(")").partition("(")
        joints = list(self._model().names)[1:]
        if kind not in _OF_LINKS or owner in joints or not name.endswith(")"):
            return name
        for frame in self._model().frames:
            if frame.name == owner and frame.type.name == "BODY" and frame.parentJoint > 0:
                return f"{kind}({joints[frame.parentJoint - 1]})"
        return name

    def _factors(self) -> dict[str, list[Any]]:
        """Return a factor for each joint, of each kind."""
        return {kind: self._at_theta(kind, [1.0] * self._layout.n_joints) for kind in (*_OF_LINKS, *_OF_JOINTS)}

    def _store_theta(self) -> None:
        self._body = RigidBody(_multiplied(self._model(), self._factors()))
        self._moved = None

    def __getstate__(self) -> dict[str, Any]:
        # The moved models follow from the others.
        state = super().__getstate__()
        return {**state, "_moved": None} if "_moved" in state else state

    def _bodies_around(self) -> list[tuple[RigidBody, RigidBody, float]]:
        """Return the robot with more and with less of each parameter, and the difference of the parameter."""
        if self._moved is None:
            factors, moved = self._factors(), []
            for name, (kind, joints) in self._targets.items():
                more, less = (
                    {
                        **factors,
                        kind: [share * own if joint in joints else own for joint, own in enumerate(factors[kind])],
                    }
                    for share in (1.0 + _MOVE, 1.0 - _MOVE)
                )
                bodies = [RigidBody(_multiplied(self._model(), own)) for own in (more, less)]
                moved.append((bodies[0], bodies[1], 2.0 * _MOVE * self.theta_[name]))
            self._moved = moved
        return self._moved

    def _theta_derivatives(self, X: np.ndarray) -> np.ndarray:
        # Joint forces are polynomials of degree 2 in each factor, so that central differences of them are exact for any
        # step. For given forces, M(q) dq̈/dθ is minus the derivative of the forces that q̈ needs.
        n, terms = self._layout.n_joints, self._terms
        q, v, u = X[:, :n], X[:, n : 2 * n], X[:, 2 * n :]
        body, still = self._body, np.zeros_like(v)
        if "acceleration" in terms or "midpoint" in terms:
            a = body.accelerations_under(q, v, u)
        if "midpoint" in terms:
            middle = self._middle(q, v, u)
            a_middle = body.accelerations_under(*middle)
            by_v = self._half_step() * body.accelerations_under_jacobian(*middle)[:, :, n : 2 * n]
        if "input" in terms:
            a_input = body.accelerations_by_force(q, body.joint_forces(u))
        columns = []
        for more, less, width in self._bodies_around():
            found = {}
            if "acceleration" in terms or "midpoint" in terms:
                change = more.forces_under_damping(q, v, a) - less.forces_under_damping(q, v, a)
                found["acceleration"] = -body.accelerations_by_force(q, change)
            if "midpoint" in terms:
                at = (*middle[:2], a_middle)
                change = more.forces_under_damping(*at) - less.forces_under_damping(*at)
                before = (by_v @ found["acceleration"][:, :, np.newaxis])[:, :, 0]
                found["midpoint"] = before - body.accelerations_by_force(middle[0], change)
            if "gravity" in terms:
                found["gravity"] = more.gravity(q) - less.gravity(q)
            if "bias" in terms:
                found["bias"] = more.forces(q, v, still) - less.forces(q, v, still)
            if "input" in terms:
                change = more.inertial_forces(q, a_input) - less.inertial_forces(q, a_input)
                found["input"] = -body.accelerations_by_force(q, change)
            columns.append(np.hstack([found[term] for term in terms]) / width)
        jacobian = np.stack(columns, axis=-1)
        self._check_finite(jacobian, q)
        return jacobian

    def _check_finite(self, values: np.ndarray, q: np.ndarray) -> None:
        if not np.isfinite(values).all():
            bad = ~np.isfinite(values).reshape(len(q), -1).all(axis=1)
            raise ValueError(self._why_not_finite(q[bad][0]))

    def _why_not_finite(self, q: np.ndarray) -> str:
        """Return the text of the error for one configuration."""
        names, inertias = self._layout.position_names, np.diag(self._body.mass_matrix(q))
        light = [name for name, inertia in zip(names, inertias, strict=True) if inertia == 0.0]
        return f"The dynamics of the robot {self._layout.name!r} are not finite: " + (
            f"its joints {light} move no mass."
            if light
            else f"its mass matrix is singular at q = {q.tolist()}, or q̇ or u is too large there."
        )

    def _names(self, columns: np.ndarray) -> list[str]:
        if self.robot is None:
            return columns.tolist()
        return [_NAMES[term].format(name) for term in self._terms for name in columns[: self._layout.n_joints]]

    def _is_known(self, term: str) -> bool:
        """Whether a joint's own column of a term predicts its acceleration: that of the first term of these."""
        return term == next((known for known in ("midpoint", "acceleration", "input") if known in self.terms), None)

    def _mean(self, layout: Layout, dt: float) -> np.ndarray:
        self._check_terms()
        n = layout.n_joints
        return np.vstack(
            [
                np.zeros((n, n * len(self.terms))),
                np.hstack([dt * self._is_known(term) * np.eye(n) for term in self.terms]),
            ]
        )

    def _velocity_prior(self, layout: Layout) -> VelocityPrior:
        # Blocks (n_joints, n_joints) of the terms, next to each other.
        self._check_terms()
        n = layout.n_joints
        prior = VelocityPrior.of(n, 0, 0.0, "")
        for term in self.terms:
            block = VelocityPrior.of(n, n, self.other_ratio, "other accelerations")
            if term in ("gravity", "bias"):
                block = VelocityPrior.of(n, n, self.unknown_ratio, f"{term} torques")
            elif self._is_known(term):
                block.set_rate(np.eye(n, dtype=bool), self.model_error, "model")
            prior = prior.beside(block)
        return prior


def _multiplied(model: Any, factors: Mapping[str, Sequence[float]]) -> Any:
    """Return a copy of a model with numbers multiplied by factors, one for each joint."""
    model = model.copy()
    of_links = zip(*(factors[kind] for kind in _OF_LINKS), strict=True)
    for number, (mass, length, inertia) in enumerate(of_links, start=1):
        link, parent = model.inertias[number], model.parents[number]
        link.inertia = mass * length**2 * inertia * link.inertia
        link.mass, link.lever = mass * link.mass, length * link.lever
        if parent > 0:
            place = model.jointPlacements[number]
            place.translation = factors["length"][parent - 1] * place.translation
    model.damping = np.array(model.damping) * factors["damping"]
    model.armature = np.array(model.armature) * factors["armature"]
    return model
