"""Pinocchio models as plain numbers and back, for files, which then need no URDF file."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..utils.optional import require
from ..utils.state import stored_as
from .loading import joint_axes

_ALONG = ("JointModelRevoluteUnaligned", "JointModelPrismaticUnaligned", "JointModelRevoluteUnboundedUnaligned")
JOINTS = (*(f"JointModel{kind}{axis}" for kind in ("R", "P", "RUB") for axis in "XYZ"), *_ALONG)
# Attributes with a number for each velocity or position. Versions of Pinocchio have some of them.
LIMITS = (
    "armature",
    "damping",
    "friction",
    "rotorInertia",
    "rotorGearRatio",
    "lowerEffortLimit",
    "upperEffortLimit",
    "lowerVelocityLimit",
    "upperVelocityLimit",
    "velocityLimit",
    "lowerDryFrictionLimit",
    "upperDryFrictionLimit",
    "lowerPositionLimit",
    "upperPositionLimit",
    "positionLimitMargin",
)
_MOST_BODIES = 10_000


@dataclass(frozen=True)
class RobotNumbers:
    """The numbers of a ``pinocchio.Model`` with j revolute and prismatic joints and f frames."""

    name: str
    names: list[str]  # of the joints
    joints: list[str]  # types of the joints
    parents: np.ndarray  # (j,) joint before each; 0 is the world
    axes: np.ndarray  # (j, 6) of `joint_axes`
    placements: np.ndarray  # (j, 3, 4) rotation and translation of each joint in its parent
    inertias: np.ndarray  # (j + 1, 13) mass, centre of mass and inertia about it, of the world and of each link
    n_bodies: int  # number of bodies that links consist of
    gravity: np.ndarray  # (6,)
    limits: dict[str, np.ndarray]  # by the names of `LIMITS`
    frames: list[str]  # names of all frames except the first
    frame_numbers: np.ndarray  # (f, 3) joint, parent frame and type of each
    frame_placements: np.ndarray  # (f, 3, 4)
    frame_inertias: np.ndarray  # (f, 13)
    configurations: dict[str, np.ndarray]  # named positions

    @classmethod
    def of(cls, model: Any) -> RobotNumbers | None:
        """Convert a model; returns None for other objects, and for models with more in them, such as other joints."""
        pin = sys.modules.get("pinocchio")
        if pin is None or not isinstance(model, pin.Model):
            return None
        joints, frames = list(model.joints)[1:], list(model.frames)[1:]
        if not joints or {joint.shortname() for joint in joints} - set(JOINTS):
            return None
        numbers = [(frame.parentJoint, frame.parentFrame, int(frame.type)) for frame in frames]
        found = cls(
            model.name,
            list(model.names)[1:],
            [joint.shortname() for joint in joints],
            np.array(list(model.parents)[1:], dtype=np.int64),
            joint_axes(model),
            _of_placements(list(model.jointPlacements)[1:]),
            _of_bodies(model.inertias),
            model.nbodies,
            np.array(model.gravity.vector),
            {name: np.array(getattr(model, name)) for name in LIMITS if hasattr(model, name)},
            [frame.name for frame in frames],
            np.array(numbers, dtype=np.int64).reshape(-1, 3),
            _of_placements([frame.placement for frame in frames]),
            _of_bodies([frame.inertia for frame in frames]),
            {entry.key(): np.array(entry.data()) for entry in model.referenceConfigurations},
        )
        return found if found.model() == model else None

    def model(self) -> Any:
        """Return the model; ImportError without Pinocchio, ValueError if numbers do not fit each other."""
        pin = require("pinocchio", "The robot of this model")
        self._check(pin)
        model = pin.Model()
        model.name = self.name
        for name, kind, parent, axis, place in zip(
            self.names, self.joints, self.parents.tolist(), self.axes, self.placements, strict=True
        ):
            joint = getattr(pin, kind)(*([axis[:3] + axis[3:]] if kind in _ALONG else []))
            model.addJoint(parent, joint, _placement(pin, place), name)
        # Pinocchio counts the bodies that are appended.
        for _ in range(1, self.n_bodies):
            model.appendBodyToJoint(1, pin.Inertia.Zero(), pin.SE3.Identity())
        for number, body in enumerate(self.inertias):
            model.inertias[number] = _body(pin, body)
        model.gravity = pin.Motion(self.gravity)
        for name, values in self.limits.items():
            if hasattr(model, name):
                if values.shape != getattr(model, name).shape:
                    raise ValueError(f"A robot of {len(self.names)} joints has {len(values)} of {name}.")
                setattr(model, name, values)
        for name, (joint, frame, kind), place, body in zip(
            self.frames, self.frame_numbers.tolist(), self.frame_placements, self.frame_inertias, strict=True
        ):
            own = _placement(pin, place), pin.FrameType.values[kind], _body(pin, body)
            model.addFrame(pin.Frame(name, joint, frame, *own), False)
        for name, values in self.configurations.items():
            if values.shape != (model.nq,):
                raise ValueError(f"A robot's configuration {name!r} does not have {model.nq} positions.")
            model.referenceConfigurations[name] = values
        return model

    def _check(self, pin: Any) -> None:
        """Raise ValueError for numbers that Pinocchio would not check."""
        n_joints, n_frames = len(self.names), len(self.frames)
        parts = (self.joints, self.parents, self.axes, self.placements, self.inertias[1:])
        if n_joints == 0 or any(len(part) != n_joints for part in parts):
            raise ValueError(f"A robot of {n_joints} joints does not have as many types, parents and links.")
        if not set(self.joints) <= set(JOINTS) or not set(self.limits) <= set(LIMITS):
            raise ValueError("A robot has joints, or limits, of an unknown type.")
        if (self.parents < 0).any() or (self.parents > np.arange(n_joints)).any() or not self.n_bodies <= _MOST_BODIES:
            raise ValueError("A robot has a joint that comes before its parent, or too many bodies.")
        of_frames = (self.frame_numbers, self.frame_placements, self.frame_inertias)
        joint, frame, kind = self.frame_numbers.T
        if (
            any(len(part) != n_frames for part in of_frames)
            or (joint > n_joints).any()
            or (frame > np.arange(n_frames)).any()
            or (self.frame_numbers < 0).any()
            or not set(kind.tolist()) <= set(pin.FrameType.values)
        ):
            raise ValueError("A robot has a frame on a joint or a frame that does not exist.")


def _of_placements(placements: Any) -> np.ndarray:
    return np.array([np.column_stack([one.rotation, one.translation]) for one in placements]).reshape(-1, 3, 4)


def _of_bodies(bodies: Any) -> np.ndarray:
    rows = [np.concatenate([[one.mass], one.lever, np.ravel(one.inertia)]) for one in bodies]
    return np.array(rows).reshape(-1, 13)


def _placement(pin: Any, values: np.ndarray) -> Any:
    return pin.SE3(np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3]))


def _body(pin: Any, values: np.ndarray) -> Any:
    body = pin.Inertia.Zero()  # its constructor rejects moments that rounding made negative
    body.mass, body.lever, body.inertia = float(values[0]), values[1:4], values[4:].reshape(3, 3)
    return body


stored_as(RobotNumbers, RobotNumbers.of, RobotNumbers.model)
