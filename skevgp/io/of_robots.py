"""How Pinocchio's models are written down: as numbers, so that no file of a robot is read when one is loaded."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from .._optional import require
from ..robots.loading import joint_axes
from .fields import MalformedError, array, integer, mapping, one_of, several, text
from .records import Record

_ALONG = ("JointModelRevoluteUnaligned", "JointModelPrismaticUnaligned", "JointModelRevoluteUnboundedUnaligned")
_JOINTS = (*(f"JointModel{kind}{axis}" for kind in ("R", "P", "RUB") for axis in "XYZ"), *_ALONG)
_MOST_BODIES = 10_000
# A number for each velocity, but for the position's limits.
_PER_JOINT = (
    "armature",
    "damping",
    "friction",
    "rotorInertia",
    "rotorGearRatio",
    "lowerEffortLimit",
    "upperEffortLimit",
    "lowerVelocityLimit",
    "upperVelocityLimit",
    "lowerDryFrictionLimit",
    "upperDryFrictionLimit",
    "lowerPositionLimit",
    "upperPositionLimit",
    "positionLimitMargin",
)


def _placements(frames: Any) -> np.ndarray:
    return np.array([np.column_stack([one.rotation, one.translation]) for one in frames]).reshape(-1, 3, 4)


def _inertias(bodies: Any) -> np.ndarray:
    """Mass, centre of mass, and the inertia about it by rows, (n, 13)."""
    rows = [np.concatenate([[one.mass], one.lever, np.ravel(one.inertia)]) for one in bodies]
    return np.array(rows).reshape(-1, 13)


def _take(model: Any) -> dict[str, Any]:
    joints = list(model.joints)[1:]
    if strange := sorted({joint.shortname() for joint in joints} - set(_JOINTS)):
        raise ValueError(f"it has joints {strange}, of which skevgp knows nothing")
    frames = list(model.frames)[1:]
    found = {
        "name": model.name,
        "names": list(model.names)[1:],
        "parents": np.array(list(model.parents)[1:], dtype=np.int64),
        "joints": [joint.shortname() for joint in joints],
        "axes": joint_axes(model).reshape(-1, 6),
        "placements": _placements(list(model.jointPlacements)[1:]),
        "inertias": _inertias(model.inertias),
        "gravity": np.array(model.gravity.vector),
        "nbodies": model.nbodies,
        "frames": [frame.name for frame in frames],
        "frame_numbers": np.array([(one.parentJoint, one.parentFrame, int(one.type)) for one in frames]).reshape(-1, 3),
        "frame_placements": _placements([frame.placement for frame in frames]),
        "frame_inertias": _inertias([frame.inertia for frame in frames]),
        "configurations": {entry.key(): np.array(entry.data()) for entry in model.referenceConfigurations},
        **{name: np.array(getattr(model, name)) for name in _PER_JOINT if hasattr(model, name)},
    }
    if _make(found) != model:
        raise ValueError("it is a pinocchio.Model with more in it than joints, links, limits and frames")
    return found


def _make(found: dict[str, Any]) -> Any:
    pin = require("pinocchio", "The robot in this file")
    n_joints, n_frames = len(found["names"]), len(found["frames"])
    if {len(found[name]) for name in ("parents", "joints", "axes", "placements")} | {n_joints} != {n_joints}:
        raise MalformedError(f"a robot of {n_joints} joints has not as many parents, kinds, axes or placements")
    if len(found["inertias"]) != n_joints + 1 or n_joints == 0:
        raise MalformedError(f"a robot of {n_joints} joints has {len(found['inertias'])} links")
    model = pin.Model()
    model.name = found["name"]
    for number in range(n_joints):
        parent = int(found["parents"][number])
        if parent > number:
            raise MalformedError(f"joint {number} of a robot has a parent that comes after it")
        kind, axis = found["joints"][number], found["axes"][number]
        joint = getattr(pin, kind)(*([axis[:3] + axis[3:]] if kind in _ALONG else []))
        model.addJoint(parent, joint, _placement(pin, found["placements"][number]), found["names"][number])
    # Pinocchio counts the bodies that links are made of.
    if found["nbodies"] > _MOST_BODIES:
        raise MalformedError(f"a robot has {found['nbodies']} bodies")
    for _ in range(1, found["nbodies"]):
        model.appendBodyToJoint(1, pin.Inertia.Zero(), pin.SE3.Identity())
    for number, body in enumerate(found["inertias"]):
        model.inertias[number] = _inertia(pin, body)
    model.gravity = pin.Motion(found["gravity"])
    for name in _PER_JOINT:
        if name in found and hasattr(model, name):
            if found[name].shape != getattr(model, name).shape:
                raise MalformedError(f"a robot of {n_joints} joints has {len(found[name])} of {name}")
            setattr(model, name, found[name])
    for number in range(n_frames):
        joint, frame, kind = (int(one) for one in found["frame_numbers"][number])
        if joint > n_joints or frame > number or kind not in pin.FrameType.values:
            raise MalformedError(f"frame {number} of a robot is not one of its joints'")
        placement, inertia = found["frame_placements"][number], found["frame_inertias"][number]
        own = (joint, frame, _placement(pin, placement), pin.FrameType.values[kind], _inertia(pin, inertia))
        model.addFrame(pin.Frame(found["frames"][number], *own), False)
    for name, values in found["configurations"].items():
        if values.shape != (model.nq,):
            raise MalformedError(f"a robot's configuration {name!r:.80} has not {model.nq} positions")
        model.referenceConfigurations[name] = values
    return model


def _placement(pin: Any, values: np.ndarray) -> Any:
    return pin.SE3(np.ascontiguousarray(values[:, :3]), values[:, 3])


def _inertia(pin: Any, values: np.ndarray) -> Any:
    return pin.Inertia(float(values[0]), values[1:4], values[4:].reshape(3, 3))


_FIELDS = {
    "name": text,
    "names": several(text),
    "parents": array("j", "i", least=0),
    "joints": several(one_of(*_JOINTS)),
    "axes": array("j 6"),
    "placements": array("j 3 4"),
    "inertias": array("l 13"),
    "gravity": array("6"),
    "nbodies": integer(1),
    "frames": several(text),
    "frame_numbers": array("f 3", "i", least=0),
    "frame_placements": array("f 3 4"),
    "frame_inertias": array("f 13"),
    "configurations": mapping(array("q")),
    **{name: array("v", finite=False) for name in _PER_JOINT[:-3]},
    **{name: array("w", finite=False) for name in _PER_JOINT[-3:]},
}


def record() -> Record:
    """Of ``pinocchio.Model``, which need not be there to read files without robots."""
    pin = sys.modules.get("pinocchio")
    kind = type(None) if pin is None else pin.Model
    return Record("pinocchio.Model", kind, _FIELDS, frozenset(_PER_JOINT), _take, _make)
