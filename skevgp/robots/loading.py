"""Any robot as a Pinocchio model with one position and one velocity per joint."""

from __future__ import annotations

import importlib.metadata
import os
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Container, Mapping, Sequence
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ..exceptions import RobotModelWarning, warn_user
from ..utils.optional import require
from .mjcf import read_mjcf
from .systems import GRAVITY, SYSTEMS, Layout, System
from .unphysical import check_bodies
from .urdf_file import checked_urdf, parsed

_COLLECTION = "example-robot-data"
# Sentences of a warning about a file.
_MOST_TOLD = 4
_MOVABLE = ("revolute", "continuous", "prismatic")
_LIMITS = ("upperEffortLimit", "lowerEffortLimit", "velocityLimit")
_OF_VELOCITIES = ("armature", "damping", "friction", "rotorInertia", "rotorGearRatio", *_LIMITS)
_AXIS_TOLERANCE = 1e-6

Robot = Any  # str | os.PathLike | System | pinocchio.Model: Pinocchio may not be there to name its type


def load_robot(robot: Robot, *, joints: Sequence[str] | None = None) -> Any:
    """Load a robot as a Pinocchio model.

    Parameters
    ----------
    robot : str, path-like, System or pinocchio.Model
        Name from `list_robots`, path of a URDF or an MJCF file, or a model. A model is checked too.
    joints : sequence of str, default=None
        Names of the joints that move, in the order of the robot, such as those of a log. All other joints are locked at
        position 0, or at the limit nearest to 0. Their links become part of the link before them. If None, all joints
        move.

    Returns
    -------
    model : pinocchio.Model
        Model with a fixed base and ``nq == nv``. The position of a continuous joint is its angle. A joint that mimics
        another one moves on its own. Reflected rotor inertias are in ``armature``. `skevgp.datasets.simulate` applies
        viscous ``damping`` and effort limits. A joint whose effort limits are both 0 has no motor, unless all limits
        are 0.

    Raises
    ------
    ImportError
        If Pinocchio is not installed. The message gives the pip command.
    ValueError
        If no robot has this name, or the file does not exist or is neither a URDF nor an MJCF. If no joint moves, or a
        joint is neither revolute nor prismatic. If a number of the model is unphysical, such as a negative mass, or the
        mass matrix is not positive definite. If an MJCF closes a loop, or has elements that are not read. If ``joints``
        is empty, has unknown or repeated names or another order than the robot, or if none of ``joints`` has a motor.
        The message names the joint or the link, and the number.
    TypeError
        If ``robot`` has another type.

    Warns
    -----
    RobotModelWarning
        If the moments of inertia of a link violate the triangle inequality, which no body does, by more than the
        rounding of their digits. If a file has numbers that are not used, such as a negative limit, or the springs of
        an MJCF. If a link of a file has a negative mass.

    See Also
    --------
    list_robots : List the names.

    Examples
    --------
    >>> from skevgp.datasets import load_robot
    >>> model = load_robot("acrobot")
    >>> model.nq, list(model.names)[1:]
    (2, ['q1', 'q2'])
    >>> model.damping
    array([0.1, 0.1])

    The elbow alone, with the shoulder locked:

    >>> elbow = load_robot("acrobot", joints=["q2"])
    >>> elbow.nq, list(elbow.names)[1:]
    (1, ['q2'])
    """
    model, warnings = _read(robot)
    for warning in warnings:
        warn_user(warning, RobotModelWarning)
    return model if joints is None else _with_locked(model, joints)


def known_robot(robot: Robot, *, joints: Sequence[str] | None = None) -> Any:
    """A robot as `load_robot` gives it, without warnings: for callers that load it again, or need no inertia."""
    model = _read(robot)[0]
    return model if joints is None else _with_locked(model, joints)


def _read(robot: Robot) -> tuple[Any, list[str]]:
    system = named_system(robot)
    if system is not None:
        return _plain(_model_of_table(system), f"The system {system.name!r}")
    if isinstance(robot, (str, os.PathLike)):
        path = robot_file(robot)
        pin = require("pinocchio", "Loading a robot")
        if _root_of(path) == "mujoco":
            model, found = read_mjcf(path)
            plain, warnings = _plain(model, f"The robot {str(robot)!r}")
            return plain, _of_file(path, found) + warnings
        urdf = checked_urdf(path)
        try:
            model = pin.buildModelFromXML(urdf.text)
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"The file {str(path)!r} is not a URDF that Pinocchio can read: {error}") from error
        _lift_efforts(model, urdf.unknown_efforts)
        plain, warnings = _plain(model, f"The robot {str(robot)!r}", urdf.possible_links)
        return plain, _of_file(path, urdf.warnings) + warnings
    pin = require("pinocchio", "Loading a robot")
    if isinstance(robot, pin.Model):
        return _plain(robot, f"The model {robot.name!r}")
    raise TypeError(
        f"A robot must be a name (skevgp.datasets.list_robots() gives them), the path of a URDF or an MJCF file, a "
        f"System or a pinocchio.Model; got {robot!r}."
    )


def _root_of(path: Path) -> str:
    """The root element of a robot's file: "robot" of a URDF, also of a file that is not XML, "mujoco" of an MJCF."""
    try:
        root: str = parsed(path)[1].tag
    except ValueError:
        return "robot"  # whose reader says what is wrong
    if root not in ("robot", "mujoco"):
        raise ValueError(
            f"The file {str(path)!r} is neither a URDF nor an MJCF: its root is <{root}>, not <robot> or <mujoco>."
        )
    return root


def _of_file(path: Path, warnings: list[str]) -> list[str]:
    """One warning of the first sentences about a file, if there are any."""
    told = warnings[:_MOST_TOLD]
    if len(warnings) > _MOST_TOLD:
        told.append(f"({len(warnings) - _MOST_TOLD} more are like these.)")
    return [f"The file {str(path)!r}: {' '.join(told)}"] * bool(told)


def list_robots() -> list[str]:
    """List the names that `load_robot` knows.

    Returns
    -------
    names : list of str
        Systems of the paper, then the robots of the installed package example-robot-data.

    Notes
    -----
    The trunk of legged robots and drones is fixed to the world. The page :doc:`/howto/urdf_reference` names the robots
    that cannot be simulated, because some of their joints move no mass.

    Examples
    --------
    >>> from skevgp.datasets import list_robots
    >>> names = list_robots()
    >>> names[:5]
    ['acrobot', 'cartpole', 'cartpole_damped', 'iiwa14', 'pendulum']
    >>> "panda" in names
    True
    """
    return sorted(SYSTEMS) + sorted(_collection())


def layout_of(robot: Robot) -> Layout:
    """Names of the columns of a robot's states and inputs.

    Parameters
    ----------
    robot : str, path-like, System or pinocchio.Model
        As in `load_robot`; the named systems need no Pinocchio.

    Returns
    -------
    layout : Layout
    """
    system = named_system(robot)
    if system is not None:
        return system.layout
    model = known_robot(robot)
    return Layout(
        model.name,
        position_names=tuple(model.names)[1:],
        driven=tuple(np.flatnonzero(effort_limits(model).any(axis=0)).tolist()),
        revolute=tuple(bool(np.any(axis[3:])) for axis in joint_axes(model)),
    )


def named_system(robot: Robot) -> System | None:
    """The table of a robot, if it has one: it needs no Pinocchio then."""
    if isinstance(robot, str):
        return SYSTEMS.get(robot)
    return robot if isinstance(robot, System) else None


def read_once(robot: Robot) -> Robot:
    """A named system as it is, any other robot as its model, so that a file is read once."""
    return load_robot(robot) if named_system(robot) is None else robot


def effort_limits(model: Any) -> np.ndarray:
    """Effort limits of the motors of a model.

    Parameters
    ----------
    model : pinocchio.Model

    Returns
    -------
    limits : ndarray of shape (2, n_joints)
        The least and the largest torque or force on each joint: 0 and 0 without a motor, infinite on all joints if the
        model knows none (all are 0).
    """
    lower, upper = np.array(model.lowerEffortLimit), np.array(model.upperEffortLimit)
    lower = np.where(lower == np.finfo(np.float64).min, -upper, lower)  # Pinocchio's value where it was never set
    limits = np.array([lower, upper])
    return limits if limits.any() else np.array([[-np.inf], [np.inf]]) * np.ones(model.nv)


def joint_axes(model: Any) -> np.ndarray:
    """Motion of each joint per unit of its velocity, in its own frame.

    Parameters
    ----------
    model : pinocchio.Model
        With one velocity per joint.

    Returns
    -------
    axes : ndarray of shape (n_joints, 6)
        Linear (of a prismatic joint), then angular part (of a revolute one).
    """
    return np.array([_axis(joint) for joint in list(model.joints)[1:]])


def _axis(joint: Any) -> np.ndarray:
    data = joint.createData()
    joint.calc(data, np.eye(joint.nq)[0])  # neutral, also for an angle kept as (cos, sin)
    return np.asarray(data.S, dtype=float).reshape(-1)


def robot_file(robot: str | os.PathLike[str]) -> Path:
    """The file of a name or path, or an error, which lists the known names if it may be a name."""
    names = _collection()
    if isinstance(robot, str) and robot in names:
        return names[robot]
    path = Path(os.path.expanduser(robot))
    if path.is_file():
        return path
    if robot and path.is_dir():
        raise ValueError(f"{str(path)!r} is a folder; a robot is one URDF or MJCF file.")
    if not isinstance(robot, str):
        raise ValueError(f"There is no file {str(path)!r}; a robot's name must be a string, not a path.")
    if path.suffix == ".urdf" or len(path.parts) > 1:
        own = path.stem in names
        raise ValueError(f"There is no file {str(path)!r}.{f' {path.stem!r} is the name of a robot.' if own else ''}")
    if path.suffix:  # a file, or a name such as alexander_v1.lowerBodyOnly
        raise ValueError(f"There is no file {str(path)!r}; the names that are known are {list_robots()}.")
    known = {name.lower(): name for name in list_robots()}
    close = [repr(known[name]) for name in get_close_matches(robot.lower(), known, n=3)]
    hint = f" Did you mean {' or '.join(close)}?" if close else ""
    more = "" if names else f" (pip install {_COLLECTION} brings more)"
    raise ValueError(
        f"Unknown robot {robot!r}.{hint} The known ones are {list_robots()}{more}, and any URDF or MJCF path."
    )


@lru_cache(maxsize=1)
def _collection() -> Mapping[str, Path]:
    """Name -> URDF file of the robots in example-robot-data, if it is installed."""
    folder = _collection_folder()
    files = [] if folder is None else [path for path in sorted(folder.rglob("*.urdf")) if _has_moving_joint(path)]
    stems = [path.stem.removesuffix("_robot") for path in files]
    return MappingProxyType(
        {
            stem if stems.count(stem) == 1 else f"{path.relative_to(folder).parts[0]}/{stem}": path  # type: ignore[arg-type]
            for stem, path in zip(stems, files, strict=True)
        }
    )


def _collection_folder() -> Path | None:
    # Version 6 of the package has files and no Python module; conda's has no list of files.
    candidates = [Path(sys.prefix) / "share" / _COLLECTION / "robots"]
    try:
        files = importlib.metadata.files(_COLLECTION) or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    for file in files:
        if "robots" in file.parts[:-1]:
            parts = Path(str(file.locate())).parts
            candidates.insert(0, Path(*parts[: parts.index("robots", parts.index(_COLLECTION)) + 1]))
            break
    return next((folder for folder in candidates if folder.is_dir()), None)


def _has_moving_joint(path: Path) -> bool:
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError:
        return False
    return bool(root.get("name")) and any(joint.get("type") in _MOVABLE for joint in root.iter("joint"))


def _model_of_table(system: System) -> Any:
    pin = require("pinocchio", "Rigid-body dynamics")
    kinds = {"revolute": pin.JointModelRevoluteUnaligned, "prismatic": pin.JointModelPrismaticUnaligned}
    model = pin.Model()
    model.name = system.name
    model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
    parent = 0
    for link in system.links:
        placement = pin.SE3(pin.rpy.rpyToMatrix(*link.rpy), np.array(link.xyz))
        parent = model.addJoint(parent, kinds[link.kind](np.array(link.axis)), placement, link.name)
        model.appendBodyToJoint(
            parent, pin.Inertia(link.mass, np.array(link.com), np.diag(link.inertia)), pin.SE3.Identity()
        )
    model.armature = np.array([link.armature for link in system.links])
    model.damping = np.array([link.damping for link in system.links])
    efforts = np.array([link.effort for link in system.links])
    model.upperEffortLimit, model.lowerEffortLimit = efforts, -efforts
    return model


def _lift_efforts(model: Any, joints: list[str]) -> None:
    """Infinite limits of effort, as of a joint without <limit>; a joint of several velocities is refused later."""
    lower, upper = np.array(model.lowerEffortLimit), np.array(model.upperEffortLimit)
    for name in joints:
        # The first name is Pinocchio's own, "universe", which a joint of the file may have too.
        velocity = model.joints[list(model.names).index(name, 1)].idx_v
        lower[velocity], upper[velocity] = -np.inf, np.inf
    if joints:
        model.lowerEffortLimit, model.upperEffortLimit = lower, upper


def _plain(model: Any, called: str, possible_links: Container[str] = ()) -> tuple[Any, list[str]]:
    """The model, or a copy whose continuous joints have one angle each, and warnings; or a ValueError."""
    joints = list(model.joints)[1:]
    if not joints:
        raise ValueError(f"{called} has no joint that moves.")
    for joint, name in zip(joints, list(model.names)[1:], strict=True):
        if "Mimic" in joint.shortname():
            raise ValueError(
                f"{called} has the joint {name!r} that mimics another; load the URDF with mimic=False, which lets it "
                "move on its own."
            )
        if joint.nv != 1 or joint.nq > 2 or ((axis := _axis(joint))[:3].any() and axis[3:].any()):
            raise ValueError(
                f"{called} has the joint {name!r} of the type {joint.shortname()}; joints must be revolute or "
                "prismatic and the base fixed (load the file without a free-flyer)."
            )
        length = np.linalg.norm(axis)
        if not abs(length - 1.0) <= _AXIS_TOLERANCE:
            raise ValueError(f"{called} has the joint {name!r} with an axis of length {length:g}; it must be 1.")
    _check_numbers(model, called)
    plain = model if model.nq == model.nv else _rebuilt(model, range(1, model.njoints))
    return plain, check_bodies(plain, called, _names_of_links(model), possible_links)


def _names_of_links(model: Any) -> list[list[str]]:
    """Of the links that move with each joint, as far as the model knows their names."""
    names: list[list[str]] = [[] for _ in range(model.njoints)]
    body = require("pinocchio", "Loading a robot").FrameType.BODY
    for frame in model.frames:
        if frame.type == body:
            names[frame.parentJoint].append(frame.name)
    return names[1:]


def _check_numbers(model: Any, called: str) -> None:
    """Raise an error for impossible numbers, which Pinocchio accepts."""
    links = list(model.inertias)[1:]
    numbers = {
        "gravity": model.gravity.vector,
        "jointPlacements": [placement.homogeneous for placement in model.jointPlacements],
        "inertias": [link.toDynamicParameters() for link in links],
        "armature": model.armature,
        "damping": model.damping,
        "friction": model.friction,
    }
    for name, values in numbers.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{called} has NaN or infinity in its {name}; they must be finite.")
    owned = {"mass": np.array([link.mass for link in links])}
    owned |= {name: np.array(getattr(model, name)) for name in ("armature", "damping", "friction")}
    for name, values in owned.items():
        if (values < 0.0).any():
            joint = model.names[1 + int(np.argmin(values))]
            whose = f"link that the joint {joint!r} moves" if name == "mass" else f"joint {joint!r}"
            raise ValueError(f"{called} has {name}={values.min():g} at the {whose}; it must be 0 or above.")
    for name in (*_LIMITS, "lowerPositionLimit", "upperPositionLimit"):
        if np.isnan(getattr(model, name)).any():
            raise ValueError(f"{called} has NaN in its {name}.")
    least, largest = effort_limits(model)
    for joint in np.flatnonzero((least > 0.0) | (largest < 0.0)).tolist():
        raise ValueError(
            f"{called} has motors that cannot give 0, such as that of the joint {model.names[1 + joint]!r}: its effort "
            f"is between {least[joint]:g} and {largest[joint]:g}."
        )


def _with_locked(model: Any, joints: Sequence[str]) -> Any:
    """A copy of a plain model in which only these joints move; or a ValueError."""
    called, names = f"The robot {model.name!r}", list(model.names)[1:]
    if (
        not isinstance(joints, (list, tuple, np.ndarray))
        or not len(joints)
        or not all(isinstance(name, str) for name in joints)
    ):
        raise ValueError(f"joints must be a list of names, at least one; got {joints!r}.")
    if unknown := [name for name in joints if name not in names]:
        close = [repr(name) for name in get_close_matches(unknown[0], names, n=3)]
        hint = f" Did you mean {' or '.join(close)}?" if close else ""
        raise ValueError(f"{called} has no joints {unknown}.{hint} Its joints are {names}.")
    ordered = [name for name in names if name in joints]
    if ordered != list(joints):
        raise ValueError(f"joints must name each joint once, in the order of the robot {ordered}; got {list(joints)}.")
    numbers = [1 + names.index(name) for name in ordered]
    driven = [names[joint] for joint in np.flatnonzero(effort_limits(model).any(axis=0))]
    if not set(driven) & set(ordered):
        raise ValueError(f"None of joints={ordered} has a motor. The joints with a motor are {driven}.")
    return model if ordered == names else _rebuilt(model, numbers)


def _rebuilt(model: Any, moving: Sequence[int]) -> Any:
    """A copy in which only some joints move, by their numbers, and a continuous joint that moves has an angle.

    The other joints must have one position each, in which they are locked as near to 0 as their limits allow.
    """
    pin = require("pinocchio", "Loading a robot")
    copy = pin.Model()
    copy.name, copy.gravity = model.name, model.gravity
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    locked = np.where(lower <= upper, np.clip(0.0, lower, upper), 0.0)
    # The joint of the copy that moves with each joint of the model, and the place of the latter in it.
    places = [(0, pin.SE3.Identity())]
    for number in range(1, model.njoints):
        joint, body = model.joints[number], model.inertias[number]
        parent, place = places[model.parents[number]]
        place = place * model.jointPlacements[number]
        if number in moving:
            own = joint if joint.nq == 1 else pin.JointModelRevoluteUnaligned(_axis(joint)[3:])
            index = copy.addJoint(parent, own, place, model.names[number])
            copy.inertias[index] = body
            places.append((index, pin.SE3.Identity()))
        else:
            data = joint.createData()
            joint.calc(data, locked)
            places.append((parent, place * data.M))
            copy.appendBodyToJoint(parent, body, places[number][1])
    for frame in list(model.frames)[1:]:
        index, place = places[frame.parentJoint]
        is_locked = frame.type == pin.FrameType.JOINT and frame.parentJoint not in moving
        kind = pin.FrameType.FIXED_JOINT if is_locked else frame.type
        # Inertias of frames are part of those of the joints.
        copy.addFrame(
            pin.Frame(frame.name, index, frame.parentFrame, place * frame.placement, kind, frame.inertia), False
        )
    joints = [model.joints[number] for number in moving]
    velocities, positions = [joint.idx_v for joint in joints], [joint.idx_q for joint in joints]
    for name in _OF_VELOCITIES:
        setattr(copy, name, np.array(getattr(model, name))[velocities])
    bounded = np.array([joint.nq == 1 for joint in joints])
    copy.lowerPositionLimit = np.where(bounded, lower[positions], -np.inf)
    copy.upperPositionLimit = np.where(bounded, upper[positions], np.inf)
    return copy
