"""Adapters of the transformers of this package, with rigid-body dynamics in CasADi (Pinocchio's wheel has none)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..features import AngleEncoder, Friction, InertiaForce, InertiaForceGravity, LinkGravity, NominalDynamics
from ..features.friction import LARGEST_POWER, SMALLEST_RATIO
from ..features.gravity import OffsetAngles, SineGravity
from ..features.robot_map import RobotTransformer
from ..robots.loading import joint_axes
from ..utils.casadi import casadi
from .base import Map, adapts, as_map, unchanged
from .sklearn import chosen


@adapts(RobotTransformer)
class Unvalidated(Map):
    """A transformer of this package without its validation."""

    by_example = False

    @classmethod
    def of(cls, transformer: RobotTransformer, example: Any) -> Map:
        return cls(transformer)

    @classmethod
    def covers(cls, transformer: Any) -> bool:
        # A subclass may add features and their Jacobian. It must not override the public methods.
        return cls is Unvalidated and unchanged(transformer, "_jacobian", "transform", "jacobian")

    def value(self, X: np.ndarray) -> np.ndarray:
        return self.transformer._values(X)

    def jacobian(self, X: np.ndarray) -> np.ndarray:
        return self.transformer._slopes(X)


@adapts(AngleEncoder)
class Angles(Unvalidated):
    """Angles replaced by their sines and cosines."""

    def casadi(self, x: Any) -> Any:
        ca, encoder = casadi(), self.transformer
        if not len(encoder._angles):
            return x
        angles = chosen(x, encoder._angles)
        row, n = ca.vertcat(x, ca.sin(angles), ca.cos(angles)), x.numel()
        source = encoder._source.copy()
        source[encoder._sines] = n + np.arange(len(encoder._angles))
        source[encoder._cosines] = n + len(encoder._angles) + np.arange(len(encoder._angles))
        return row[source.tolist()]


class _OfRobot(Unvalidated):
    """Features of [q, q̇, u], multiplied by the time step if rows end with it (see `RobotMap`)."""

    def casadi(self, x: Any) -> Any:
        features = self.transformer
        if not features._timed:
            return self.features(x)
        return casadi().vertcat(x[: features._n_kept(features._layout)], x[-1] * self.features(x[:-1]))

    def features(self, x: Any) -> Any:
        """Return the expression of the features of x = [q, q̇, u]."""
        raise NotImplementedError


@adapts(InertiaForce)
class Newton(_OfRobot):
    """The row itself."""

    def features(self, x: Any) -> Any:
        return x


@adapts(InertiaForceGravity)
class NewtonGravity(_OfRobot):
    """The row itself with the features of gravity."""

    # Whether `casadi` takes the parameters from ``theta_`` as symbols.
    symbolic_theta = True

    def features(self, x: Any) -> Any:
        gravity, shifted = self.transformer._gravity, _with_offsets(self.transformer, x)
        of_gravity = _sines(gravity, shifted) if type(gravity) is SineGravity else as_map(gravity).casadi(shifted)
        return casadi().vertcat(x, of_gravity)


def _with_offsets(features: OffsetAngles, x: Any) -> Any:
    if not features._targets:
        return x
    n = features._layout.n_joints
    return casadi().vertcat(x[:n] + casadi().vertcat(*features._at_theta("offset", [0.0] * n)), x[n:])


def _sines(gravity: SineGravity, x: Any) -> Any:
    ca, angles = casadi(), gravity._summed
    if (angles.sum(axis=1) == 1.0).all():
        return ca.sin(chosen(x, angles.argmax(axis=1)))
    return ca.sin(ca.mtimes(ca.DM(angles), x))


@adapts(LinkGravity)
class GravityOfLinks(_OfRobot):
    """Gravity in the frame of each link, computed from its parent's as in `LinkGravity`."""

    symbolic_theta = True

    def features(self, x: Any) -> Any:
        if self.transformer.robot is None:
            return x
        x = _with_offsets(self.transformer, x)
        ca, links = casadi(), self.transformer._links
        weights: list[Any] = []
        for i, parent in enumerate(links._parents):
            turns = links._turns[i].any()
            rotation = ca.DM(links._fixed[i, 0] + (0.0 if turns else links._cosine[i, 0]))
            if turns:
                rotation = rotation + ca.cos(x[i]) * ca.DM(links._cosine[i, 0])
                rotation = rotation + ca.sin(x[i]) * ca.DM(links._sine[i, 0])
            before = weights[parent] if parent >= 0 else ca.DM(links._weight.reshape(1, 3))
            weights.append(ca.mtimes(before, rotation))
        return chosen(ca.horzcat(*weights).T, self.transformer._columns) * ca.DM(self.transformer._signs)


@adapts(Friction)
class FrictionOfJoints(_OfRobot):
    """Friction as a function of velocities."""

    symbolic_theta = True

    def features(self, x: Any) -> Any:
        friction = self.transformer
        if friction.robot is None:
            return x
        ca, n = casadi(), friction._layout.n_joints
        v = x[n : 2 * n]
        number = {name: ca.vertcat(*values) for name, values in friction._numbers_of_joints().items()}
        tanh = ca.tanh(v / number["stiction_velocity"])
        ratio = ca.fmax(ca.fabs(v) / number["stribeck_velocity"], SMALLEST_RATIO)
        power = ca.fmin(ratio ** number["sharpness"], LARGEST_POWER)
        values = {"viscous": v, "coulomb": tanh, "stribeck": tanh * ca.exp(-power)}
        return ca.vertcat(*(values[term] for term in friction._terms))


@adapts(NominalDynamics)
class Nominal(_OfRobot):
    """Accelerations and torques of a rigid-body model."""

    symbolic_theta = True

    def features(self, x: Any) -> Any:
        if self.transformer.robot is None:
            return x
        ca, layout, theta = casadi(), self.transformer._layout, getattr(self.transformer, "theta_", {})
        n, symbols = layout.n_joints, ca.MX.sym("theta", len(theta))
        nominal = copy(self.transformer)
        nominal.theta_ = {name: symbols[i] for i, name in enumerate(theta)}
        body = SymbolicRigidBody(nominal._model(), nominal._factors())
        row = ca.MX.sym("x", x.numel())
        q, v = row[:n], row[n : 2 * n]
        force = ca.MX.zeros(n, 1)
        force[list(layout.driven)] = row[2 * n :]
        terms = {
            "acceleration": lambda: body.accelerations_under(q, v, force),
            "midpoint": lambda: body.accelerations_under(
                q + 0.5 * self.transformer.dt * v,
                v + 0.5 * self.transformer.dt * body.accelerations_under(q, v, force),
                force,
            ),
            "gravity": lambda: body.gravity(q),
            "bias": lambda: body.forces(q, v, None),
            "input": lambda: body.accelerations(q, None, force, gravity=False),
        }
        found = ca.vertcat(*(terms[term]() for term in self.transformer._terms))
        # As a function of scalars it takes a tenth of the time of 6 x 6 matrices.
        function = ca.Function("nominal_dynamics", [row, symbols], [found]).expand()
        return function(x, ca.vertcat(*theta.values()) if theta else ca.DM(0, 1))


# --- rigid-body dynamics ---------------------------------------------------------------------------------------------
# Algorithms of Featherstone (2008, chapters 5 and 7), with the numbers of a Pinocchio model. Spatial vectors are
# Pinocchio's: linear part first, in the frame of their joint.

_KNOWN = ("JointModelR", "JointModelP")
_FACTORS = ("mass", "length", "inertia", "damping", "armature")


@dataclass(frozen=True)
class _Joint:
    """A joint and the link that it moves."""

    parent: int  # -1 is the base
    axis: np.ndarray  # (6,): motion per unit of velocity
    # (6, 6) each: fixed + sine sin q + cosine cos q + linear q turns a motion in the parent's frame into this frame.
    # Numbers and symbols of CasADi.
    fixed: Any
    sine: Any
    cosine: Any
    linear: Any
    inertia: Any  # (6, 6)
    armature: Any

    def transform(self, q: Any) -> Any:
        """Return the transform of motions from the parent's frame to this one; its transpose takes forces back."""
        ca = casadi()
        if self.axis[3:].any():
            return self.fixed + ca.sin(q) * self.sine + ca.cos(q) * self.cosine
        return self.fixed + q * self.linear


class SymbolicRigidBody:
    """The functions of `skevgp.robots.RigidBody` for one symbolic state; joints must be revolute or prismatic.

    ``factors`` holds a number or symbol of each kind for each joint, as in `NominalDynamics`.
    """

    def __init__(self, model: Any, factors: Mapping[str, Sequence[Any]] | None = None):
        factors = factors or dict.fromkeys(_FACTORS, [1.0] * model.nv)
        self._joints = _joints_of(model, factors)
        self._gravity = np.array(model.gravity.vector, dtype=float)
        self._damping = [own * damping for own, damping in zip(factors["damping"], model.damping.tolist(), strict=True)]

    def forces(self, q: Any, v: Any, a: Any, gravity: bool = True) -> Any:
        """Return τ = M(q) a + C(q, v) v + g(q) by the recursive Newton-Euler algorithm; v and a may be None for 0."""
        ca = casadi()
        transforms, motions, biases = self._kinematics(q, v)
        accelerations: list[Any] = []
        forces = []
        for i, joint in enumerate(self._joints):
            before = (
                accelerations[joint.parent] if joint.parent >= 0 else ca.DM(-self._gravity if gravity else np.zeros(6))
            )
            own = ca.mtimes(transforms[i], before) + biases[i]
            accelerations.append(own if a is None else own + ca.DM(joint.axis) * a[i])
            forces.append(ca.mtimes(joint.inertia, accelerations[i]) + self._gyroscopic(i, motions[i]))
        found = [None] * len(self._joints)
        for i, joint in reversed(list(enumerate(self._joints))):
            found[i] = ca.dot(ca.DM(joint.axis), forces[i])
            if a is not None:
                found[i] += joint.armature * a[i]
            if joint.parent >= 0:
                forces[joint.parent] += ca.mtimes(transforms[i].T, forces[i])
        return ca.vertcat(*found)

    def gravity(self, q: Any) -> Any:
        """Return g(q), the joint forces (n_joints, 1) that hold the robot still."""
        return self.forces(q, None, None)

    def accelerations(self, q: Any, v: Any, force: Any, gravity: bool = True) -> Any:
        """Return q̈ = M(q)⁻¹ (τ - C(q, v) v - g(q)) by the articulated-body algorithm; v may be None for zeros."""
        ca = casadi()
        transforms, motions, biases = self._kinematics(q, v)
        inertias = [ca.MX(joint.inertia) for joint in self._joints]
        forces = [self._gyroscopic(i, motion) for i, motion in enumerate(motions)]
        passed: list[Any] = [None] * len(self._joints)
        for i, joint in reversed(list(enumerate(self._joints))):
            axis = ca.DM(joint.axis)
            of_axis = ca.mtimes(inertias[i], axis)
            inertia = ca.dot(axis, of_axis) + joint.armature
            left = force[i] - ca.dot(axis, forces[i])
            passed[i] = of_axis, inertia, left
            if joint.parent >= 0:
                articulated = inertias[i] - ca.mtimes(of_axis, of_axis.T) / inertia
                borne = forces[i] + ca.mtimes(articulated, biases[i]) + of_axis * (left / inertia)
                inertias[joint.parent] += ca.mtimes([transforms[i].T, articulated, transforms[i]])
                forces[joint.parent] += ca.mtimes(transforms[i].T, borne)
        found: list[Any] = []
        accelerations: list[Any] = []
        for i, joint in enumerate(self._joints):
            before = (
                accelerations[joint.parent] if joint.parent >= 0 else ca.DM(-self._gravity if gravity else np.zeros(6))
            )
            falling = ca.mtimes(transforms[i], before) + biases[i]
            of_axis, inertia, left = passed[i]
            found.append((left - ca.dot(of_axis, falling)) / inertia)
            accelerations.append(falling + ca.DM(joint.axis) * found[i])
        return ca.vertcat(*found)

    def accelerations_under(self, q: Any, v: Any, force: Any) -> Any:
        """Return the accelerations under joint forces and the model's viscous damping."""
        return self.accelerations(q, v, force - casadi().vertcat(*self._damping) * v)

    def _kinematics(self, q: Any, v: Any) -> tuple[list[Any], list[Any], list[Any]]:
        """Return transforms from the parents, motions of the links, and the accelerations that follow from motion."""
        ca = casadi()
        transforms: list[Any] = []
        motions: list[Any] = []
        biases: list[Any] = []
        for i, joint in enumerate(self._joints):
            transforms.append(joint.transform(q[i]))
            if v is None:
                motions.append(None)
                biases.append(ca.DM.zeros(6))
                continue
            own = ca.DM(joint.axis) * v[i]
            motions.append(own if joint.parent < 0 else ca.mtimes(transforms[i], motions[joint.parent]) + own)
            biases.append(_cross_motion(motions[i], own))
        return transforms, motions, biases

    def _gyroscopic(self, i: int, motion: Any) -> Any:
        """Return the force v ×* I v of a link."""
        ca = casadi()
        if motion is None:
            return ca.DM.zeros(6)
        return _cross_force(motion, ca.mtimes(self._joints[i].inertia, motion))


def _cross_motion(by: Any, motion: Any) -> Any:
    """Return the motion v × m."""
    ca = casadi()
    v, w = by[:3], by[3:]
    return ca.vertcat(ca.cross(w, motion[:3]) + ca.cross(v, motion[3:]), ca.cross(w, motion[3:]))


def _cross_force(by: Any, force: Any) -> Any:
    """Return the force v ×* f."""
    ca = casadi()
    v, w = by[:3], by[3:]
    return ca.vertcat(ca.cross(w, force[:3]), ca.cross(w, force[3:]) + ca.cross(v, force[:3]))


def _joints_of(model: Any, factors: Mapping[str, Sequence[Any]]) -> list[_Joint]:
    names, joints = list(model.names)[1:], list(model.joints)[1:]
    for name, joint in zip(names, joints, strict=True):
        if not joint.shortname().startswith(_KNOWN) or joint.nq != 1:
            raise ValueError(
                f"The joint {name!r} of the robot {model.name!r} is of the type {joint.shortname()}. Only revolute "
                "and prismatic joints can be exported."
            )
    found = []
    for i, (axis, armature) in enumerate(zip(joint_axes(model), model.armature.tolist(), strict=True)):
        parent, inertia = int(model.parents[i + 1]) - 1, model.inertias[i + 1]
        own = {kind: factors[kind][i] for kind in _FACTORS}
        length = factors["length"][parent] if parent >= 0 else 1.0
        placed = _placed(axis, model.jointPlacements[i + 1], length)
        found.append(_Joint(parent, axis, *placed, _inertia(inertia, own), own["armature"] * armature))
    return found


def _placed(axis: np.ndarray, placement: Any, length: Any) -> tuple[Any, Any, Any, Any]:
    """Return the parts of the transform to a joint, R(q) = I + sin q [u] + (1 - cos q) [u]², or its shift by q u."""
    ca, zero = casadi(), np.zeros((3, 3))
    # The placement is multiplied by ``length``. The transform of motions is affine in it.
    whole, turned = np.array(placement.toActionMatrixInverse()), placement.copy()
    turned.translation = np.zeros(3)
    without = np.array(turned.toActionMatrixInverse())
    slide, turn = _skew(axis[:3]), _skew(axis[3:])
    both = turn @ turn
    fixed = np.eye(6) + np.block([[both, zero], [zero, both]])
    # In the turned frame a motion is multiplied by R(q)ᵀ; in the shifted frame it is v - q u × w.
    sine, cosine = -np.block([[turn, zero], [zero, turn]]), -np.block([[both, zero], [zero, both]])
    linear = -np.block([[zero, slide], [zero, zero]])

    def placed(part: np.ndarray) -> Any:
        return ca.DM(part @ without) + length * ca.DM(part @ (whole - without))

    return placed(fixed), placed(sine), placed(cosine), placed(linear)


def _inertia(link: Any, factors: Mapping[str, Any]) -> Any:
    """Return the spatial inertia of a link, multiplied as in `NominalDynamics`."""
    ca = casadi()
    whole, own = np.array(link.matrix()), np.zeros((6, 6))
    own[3:, 3:] = link.inertia
    by_mass, by_moment, by_square = np.zeros((3, 6, 6))
    by_mass[:3, :3] = whole[:3, :3]
    by_moment[:3, 3:], by_moment[3:, :3] = whole[:3, 3:], whole[3:, :3]
    by_square[3:, 3:] = whole[3:, 3:] - own[3:, 3:]
    length = factors["length"]
    turning = ca.DM(by_square) + factors["inertia"] * ca.DM(own)
    return factors["mass"] * (ca.DM(by_mass) + length * ca.DM(by_moment) + length**2 * turning)


def _skew(u: np.ndarray) -> np.ndarray:
    """Return the matrix [u] with [u] a = u × a."""
    return np.array([[0.0, -u[2], u[1]], [u[2], 0.0, -u[0]], [-u[1], u[0], 0.0]])
