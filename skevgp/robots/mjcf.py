"""MJCF, the robot format of MuJoCo: the part of a file that decides how a robot with a fixed base moves.

Pinocchio reads MJCF too. Its version 4.1 leaves out the orientation of the first body, ``<option gravity>``, and all
bodies of the world except the first, and gives 1 kg to a link of meshes, each without an error. So skevgp reads the
file and builds the model. The rules are those of MuJoCo's XML reference: https://mujoco.readthedocs.io/en/stable/XMLreference.html
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..utils.optional import require
from .urdf_file import MOST_JOINTS, checked_numbers, naming, parsed

_GRAVITY = (0.0, 0.0, -9.81)
_DENSITY = 1000.0
_SHORTEST = 1e-9  # length of an axis or a quaternion
# Elements that make bodies in a way that is not read here.
_MAKERS = ("replicate", "attach", "composite", "flexcomp")
_ORIENTATIONS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
_ACTUATORS = (
    *("general", "motor", "position", "velocity", "intvelocity"),
    *("damper", "cylinder", "muscle", "dcmotor", "plugin"),
)
_BY_MUJOCO = (
    "MuJoCo can write a file that is read: spec = mujoco.MjSpec.from_file(path), spec.compiler.saveinertial = True, "
    "spec.compile() and spec.to_xml()"
)

Attributes = dict[str, str]


def read_mjcf(path: Path) -> tuple[Any, list[str]]:
    """Read an MJCF file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    model : pinocchio.Model
        Joints in the order of the file. Positions are those of MuJoCo, also with ``ref``. A body with several joints
        is a chain of links without mass and the body.
    warnings : list of str
        What the file says that is not used.

    Raises
    ------
    ImportError
        If Pinocchio is not installed.
    ValueError
        If the file is not MJCF, or a number or an element is not allowed. The message names the file.
    """
    with naming(path, "an MJCF"):
        _, root = parsed(path)
        if root.tag != "mujoco":
            raise ValueError(f"its root is <{root.tag}>, not <mujoco>")
        _include(root, path.parent, {path.resolve()})
        for element in root.iter():
            if element.tag in _MAKERS:
                raise ValueError(f"it has the element <{element.tag}>, which is not read here. {_BY_MUJOCO}")
        return _Reader(root).read()


def _include(element: ET.Element, folder: Path, read: set[Path]) -> None:
    """Replace each <include> by what is in the root of its file, which is in `folder`."""
    for place, child in reversed(list(enumerate(element))):
        if child.tag == "include":
            file = folder / child.get("file", "")
            if file.resolve() in read:
                raise ValueError(f"it includes {str(file)!r} twice, or in itself")
            if not file.is_file():
                raise ValueError(f"it includes {str(file)!r}, which is not there")
            read.add(file.resolve())
            _, root = parsed(file)
            _include(root, folder, read)
            element[place : place + 1] = list(root)
        else:
            _include(child, folder, read)


@dataclass
class _Joint:
    name: str
    place: int  # of its position among all
    range: tuple[float, float]
    armature: float
    damping: float
    friction: float
    effort: tuple[float, float]  # limits of the sum of all actuators


@dataclass
class _Reader:
    """The state of a walk through the bodies of a file."""

    root: ET.Element
    joints: list[_Joint] = field(default_factory=list)
    bodies: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.pin = require("pinocchio", "Loading a robot")
        self.model = self.pin.Model()
        self.compiler: Attributes = {}
        for element in self.root.findall("compiler"):
            self.compiler |= element.attrib
        self.defaults = _defaults(self.root)

    def read(self) -> tuple[Any, list[str]]:
        for name in ("settotalmass", "coordinate"):
            if self.compiler.get(name, "-1") not in ("-1", "local"):
                raise ValueError(f"it has <compiler {name}={self.compiler[name]!r:.80}>, which is not read here")
        self._refuse_loops()
        model = self.model
        model.name = self.root.get("model", "MuJoCo Model")
        model.gravity.linear = self._gravity()
        for world in self.root.findall("worldbody"):
            self._walk(world, 0, 0, self.pin.SE3.Identity(), "main")
        for what, names in (("joints", [joint.name for joint in self.joints]), ("bodies", self.bodies)):
            for name, count in Counter(names).items():
                if count > 1:
                    raise ValueError(f"it has {count} {what} of the name {name!r:.80}")
        if len(self.joints) > MOST_JOINTS:
            raise ValueError(f"it has {len(self.joints)} joints that move, more than {MOST_JOINTS}")
        for name in ("armature", "damping", "friction"):
            setattr(model, name, np.array([getattr(joint, name) for joint in self.joints]))
        ranges = np.array([joint.range for joint in self.joints]).reshape(-1, 2)
        model.lowerPositionLimit, model.upperPositionLimit = ranges.T.copy()
        model.velocityLimit = np.full(model.nv, np.inf)
        model.lowerEffortLimit, model.upperEffortLimit = self._efforts().T.copy()
        return model, self.warnings

    # --- bodies ---------------------------------------------------------------------------------------------------

    def _walk(self, element: ET.Element, joint: int, frame: int, place: Any, childclass: str) -> None:
        """Add the bodies in an element, which is at `place` in the frame of a joint."""
        for child in element:
            if child.tag not in ("body", "frame"):
                continue
            inside = child.get("childclass", childclass)
            at = place * self._pose(child.attrib, _called(child))
            if child.tag == "frame":
                for tag in ("joint", "freejoint", "inertial"):
                    if child.find(tag) is not None:
                        raise ValueError(f"a <frame> has <{tag}>, which is not read there")
                self._walk(child, joint, frame, at, inside)
            else:
                self._body(child, joint, frame, at, inside)

    def _body(self, body: ET.Element, joint: int, frame: int, place: Any, childclass: str) -> None:
        model = self.model
        name = body.get("name") or f"body{len(self.bodies) + 1}"
        self.bodies.append(name)
        called = f"the body {name!r:.80}"
        if _number(body.attrib, "gravcomp", called) != 0.0:
            self.warnings.append(f"{_capital(called)} has gravcomp, which is not used: its weight is not compensated.")
        own = [child for child in body if child.tag in ("joint", "freejoint")]
        for number, element in enumerate(own):
            label = element.get("name") or f"{name}_joint{number + 1 if len(own) > 1 else ''}"
            given = self._given(element, "joint", childclass)
            kind = "free" if element.tag == "freejoint" else given.get("type", "hinge")
            if kind not in ("hinge", "slide"):
                hint = "; delete the element, and the base is fixed" if kind == "free" else ""
                raise ValueError(
                    f"{called} has the joint {label!r:.80} of the type {kind!r:.80}; joints must be of the type hinge "
                    f"or slide, and the base fixed{hint}"
                )
            joint, place = self._add_joint(joint, place, label, kind, given)
            frame = model.addJointFrame(joint, frame)
        if joint and (inertia := self._inertia(body, childclass, called)) is not None:
            model.appendBodyToJoint(joint, inertia, place)
        frame = model.addBodyFrame(name, joint, place, frame)
        self._walk(body, joint, frame, place, childclass)

    def _add_joint(self, parent: int, place: Any, name: str, kind: str, given: Attributes) -> tuple[int, Any]:
        """Add a joint to a body at `place`, and return its number and the place of the body in its frame."""
        pin, called, is_hinge = self.pin, f"the joint {name!r:.80}", kind == "hinge"
        unit = self._radians if is_hinge else 1.0
        axis = _direction(_numbers(given, "axis", 3, called, (0.0, 0.0, 1.0)), "axis", called)
        anchor = pin.SE3(np.eye(3), _numbers(given, "pos", 3, called, (0.0, 0.0, 0.0)))
        # MuJoCo's position in the pose of the file is ref.
        ref = unit * _number(given, "ref", called)
        turned = Rotation.from_rotvec(-ref * axis).as_matrix() if is_hinge else np.eye(3)
        back = pin.SE3(turned, np.zeros(3) if is_hinge else -ref * axis)
        model_of = pin.JointModelRevoluteUnaligned if is_hinge else pin.JointModelPrismaticUnaligned
        number = self.model.addJoint(parent, model_of(axis), place * anchor * back, name)
        limits = (-math.inf, math.inf)
        if self._is_limited(given, "limited", "range"):
            low, high = _numbers(given, "range", 2, called)
            if not low < high:
                raise ValueError(f"{called} has range={given['range']!r:.80}; the second number must be the larger one")
            limits = (unit * low, unit * high)
        effort = (-math.inf, math.inf)
        if self._is_limited(given, "actuatorfrclimited", "actuatorfrcrange"):
            effort = tuple(_numbers(given, "actuatorfrcrange", 2, called))
        of_joint = {
            key: _number(given, name, called)
            for key, name in (("armature", "armature"), ("damping", "damping"), ("friction", "frictionloss"))
        }
        if _number(given, "stiffness", called) != 0.0:
            self.warnings.append(f"{_capital(called)} has a spring (stiffness), which is not used.")
        self.joints.append(_Joint(name, len(self.joints), limits, effort=effort, **of_joint))
        return number, anchor.inverse()

    # --- inertias -------------------------------------------------------------------------------------------------

    def _inertia(self, body: ET.Element, childclass: str, called: str) -> Any | None:
        """Return a moving body's inertia: of <inertial>, or of the shapes of its geoms; None without both."""
        from_geoms = self.compiler.get("inertiafromgeom", "auto")
        inertial = body.find("inertial")
        if inertial is None or from_geoms == "true":
            return None if from_geoms == "false" else self._of_geoms(body, childclass, called)
        where = f"<inertial> of {called}"
        for needed in ("pos", "mass"):
            if needed not in inertial.attrib:
                raise ValueError(f"{where} has no {needed}")
        pose = self._pose(inertial.attrib, where)
        mass = _number(inertial.attrib, "mass", where)
        if mass < 0.0:
            raise ValueError(f"{where} has mass={mass:g}; it must be 0 or above")
        mass = max(mass, _number(self.compiler, "boundmass", "<compiler>"))
        moments = np.diag(_numbers(inertial.attrib, "diaginertia", 3, where, (0.0, 0.0, 0.0)))
        if "fullinertia" in inertial.attrib:
            xx, yy, zz, xy, xz, yz = _numbers(inertial.attrib, "fullinertia", 6, where)
            moments = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if (least := _number(self.compiler, "boundinertia", "<compiler>")) > 0.0:
            values, axes = np.linalg.eigh(moments)
            moments = axes @ np.diag(np.maximum(values, least)) @ axes.T
        return self._made(mass, pose, moments)

    def _of_geoms(self, body: ET.Element, childclass: str, called: str) -> Any | None:
        first, last = (int(n) for n in _numbers(self.compiler, "inertiagrouprange", 2, "<compiler>", (0.0, 5.0)))
        whole = None
        for place, geom in self._geoms(body, childclass, self.pin.SE3.Identity()):
            where = f"a geom of {called}"
            if not first <= _number(geom, "group", where) <= last:
                continue
            density, mass = _number(geom, "density", where, _DENSITY), geom.get("mass")
            if (density if mass is None else _number(geom, "mass", where)) == 0.0:
                continue
            kind = geom.get("type", "mesh" if "mesh" in geom else "sphere")
            if kind not in _SHAPES or geom.get("shellinertia") == "true":
                raise ValueError(
                    f"{called} has no <inertial>, and a geom of the type {kind!r:.80}, whose mass is not computed "
                    f"here. {_BY_MUJOCO}"
                )
            pose, size = self._shape(geom, kind, where)
            volume, unit_moments = _SHAPES[kind](*size)
            m = density * volume if mass is None else _number(geom, "mass", where)
            part = self._made(m, place * pose, np.diag(m * np.array(unit_moments)))
            whole = part if whole is None else whole + part
        return whole

    def _geoms(self, element: ET.Element, childclass: str, place: Any) -> Any:
        """List the geoms of a body, also those in frames, as (pose of the frame, attributes)."""
        for child in element:
            if child.tag == "geom":
                yield place, self._given(child, "geom", childclass)
            elif child.tag == "frame":
                inside = place * self._pose(child.attrib, "<frame>")
                yield from self._geoms(child, child.get("childclass", childclass), inside)

    def _shape(self, geom: Attributes, kind: str, where: str) -> tuple[Any, list[float]]:
        """Return the pose and the sizes of a geom."""
        texts = geom.get("size", "").split()
        count = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)
        if "fromto" not in geom:
            size = _numbers({"size": " ".join(texts[:count])}, "size", count, where)
            return self._pose(geom, where), size.tolist()
        ends = _numbers(geom, "fromto", 6, where)
        along = ends[:3] - ends[3:]
        (width,) = _numbers({"size": " ".join(texts[:1])}, "size", 1, where)
        turned = self._rotation({"zaxis": " ".join(map(repr, along.tolist()))}, where)
        pose = self.pin.SE3(turned, 0.5 * (ends[:3] + ends[3:]))
        return pose, [width] * (count - 1) + [0.5 * float(np.linalg.norm(along))]

    def _made(self, mass: float, pose: Any, moments: np.ndarray) -> Any:
        body = self.pin.Inertia.Zero()  # its constructor refuses moments that no body has; `check_bodies` names them
        body.mass, body.lever = mass, pose.translation
        body.inertia = pose.rotation @ moments @ pose.rotation.T
        return body

    # --- motors ---------------------------------------------------------------------------------------------------

    def _efforts(self) -> np.ndarray:
        """Return limits of effort (n, 2): 0 where no actuator acts, if the file has actuators, and infinite without."""
        own = np.array([joint.effort for joint in self.joints]).reshape(-1, 2)
        tendons: dict[str | None, list[tuple[str, float]]] = {
            fixed.get("name"): [
                (part.get("joint", ""), _number(part.attrib, "coef", "a <joint> of a tendon"))
                for part in fixed.findall("joint")
            ]
            for fixed in self.root.findall("tendon/fixed")
        }
        places = {joint.name: joint.place for joint in self.joints}
        actuators = [each for each in self.root.findall("actuator/*") if each.tag in _ACTUATORS]
        total = np.zeros_like(own)
        for actuator in actuators:
            given = self._given(actuator, "general", "main")
            called = f"the actuator {given.get('name', '')!r:.80}"
            gear = float(_numbers({"gear": given.get("gear", "1").split()[0]}, "gear", 1, called)[0])
            low, high = -math.inf, math.inf
            if self._is_limited(given, "forcelimited", "forcerange"):
                low, high = _numbers(given, "forcerange", 2, called)
            elif actuator.tag == "motor" and self._is_limited(given, "ctrllimited", "ctrlrange"):
                low, high = _numbers(given, "ctrlrange", 2, called)
            target = given.get("joint", given.get("jointinparent"))
            acts = [(target, 1.0)] if target is not None else tendons.get(given.get("tendon"))
            if acts is None:  # by a site or another tendon: it may move any joint
                return own
            for name, factor in acts:
                if name not in places:
                    raise ValueError(f"{called} acts on the joint {name!r:.80}, which is not there")
                if (scale := gear * factor) != 0.0:
                    total[places[name]] += sorted((scale * low, scale * high))
        if not actuators:
            return own
        return np.column_stack([np.maximum(total[:, 0], own[:, 0]), np.minimum(total[:, 1], own[:, 1])])

    # --- the rest of the file -------------------------------------------------------------------------------------

    def _gravity(self) -> np.ndarray:
        given: Attributes = {}
        for option in self.root.findall("option"):
            given |= option.attrib
            if any(flag.get("gravity") == "disable" for flag in option.findall("flag")):
                given["gravity"] = "0 0 0"
        return _numbers(given, "gravity", 3, "<option>", _GRAVITY)

    def _refuse_loops(self) -> None:
        """Refuse constraints that close a loop. A coupling of joints is as <mimic> of a URDF: both move."""
        for constraint in self.root.findall("equality/*"):
            if constraint.tag in ("connect", "weld") and constraint.get("active", "true") != "false":
                raise ValueError(
                    f"it has <{constraint.tag}> in <equality>, which closes a loop; robots must be trees. Delete the "
                    "element if the joints of the loop are locked or do not matter"
                )

    def _given(self, element: ET.Element, tag: str, childclass: str) -> Attributes:
        """Return the attributes of an element with those of its class of defaults."""
        name = element.get("class", childclass)
        if name not in self.defaults and name != "main":
            raise ValueError(f"<{element.tag}> has the class {name!r:.80}, which is not in <default>")
        return self.defaults.get(name, {}).get(tag, {}) | element.attrib

    def _is_limited(self, given: Attributes, limited: str, limits: str) -> bool:
        said = given.get(limited, "auto")
        return limits in given if said == "auto" and self.compiler.get("autolimits") != "false" else said == "true"

    @property
    def _radians(self) -> float:
        return 1.0 if self.compiler.get("angle") == "radian" else math.pi / 180.0

    def _pose(self, given: Attributes, where: str) -> Any:
        return self.pin.SE3(self._rotation(given, where), _numbers(given, "pos", 3, where, (0.0, 0.0, 0.0)))

    def _rotation(self, given: Attributes, where: str) -> np.ndarray:
        name = next((name for name in _ORIENTATIONS if name in given), None)
        if name is None:
            return np.eye(3)
        values = _numbers(given, name, _ORIENTATIONS[name], where)
        if name == "quat":
            _direction(values, name, where)
            return Rotation.from_quat(np.roll(values, -1)).as_matrix()
        if name == "axisangle":
            axis = _direction(values[:3], name, where)
            return Rotation.from_rotvec(self._radians * values[3] * axis).as_matrix()
        if name == "zaxis":
            up = np.array([0.0, 0.0, 1.0])
            return self.pin.Quaternion.FromTwoVectors(up, _direction(values, name, where)).matrix()
        if name == "xyaxes":
            x = _direction(values[:3], name, where)
            y = _direction(values[3:] - x * (x @ values[3:]), name, where)
            return np.column_stack([x, y, np.cross(x, y)])
        turned, sequence = np.eye(3), self.compiler.get("eulerseq", "xyz")
        if len(sequence) != 3 or set(sequence.lower()) - set("xyz"):
            raise ValueError(f"<compiler> has eulerseq={sequence!r:.80}; it must be three of xyzXYZ")
        for letter, angle in zip(sequence, self._radians * values, strict=True):
            one = Rotation.from_euler(letter.lower(), angle).as_matrix()
            turned = turned @ one if letter.islower() else one @ turned  # axes that turn with the body, or stay
        return turned


# Volume, and moments of inertia per mass, of MuJoCo's shapes by their sizes.


def _sphere(r: float) -> tuple[float, list[float]]:
    return 4.0 / 3.0 * math.pi * r**3, [0.4 * r * r] * 3


def _ellipsoid(a: float, b: float, c: float) -> tuple[float, list[float]]:
    return 4.0 / 3.0 * math.pi * a * b * c, [0.2 * (b * b + c * c), 0.2 * (a * a + c * c), 0.2 * (a * a + b * b)]


def _box(a: float, b: float, c: float) -> tuple[float, list[float]]:
    return 8.0 * a * b * c, [(b * b + c * c) / 3.0, (a * a + c * c) / 3.0, (a * a + b * b) / 3.0]


def _cylinder(r: float, half: float) -> tuple[float, list[float]]:
    across = r * r / 4.0 + half * half / 3.0
    return 2.0 * math.pi * r * r * half, [across, across, 0.5 * r * r]


def _capsule(r: float, half: float) -> tuple[float, list[float]]:
    """Two half balls, whose centres of mass are 3 r / 8 from the ends of a cylinder."""
    ball, (of_ball, *_) = _sphere(r)
    rod, (across, _, along) = _cylinder(r, half)
    share = ball / (ball + rod)
    across = (1.0 - share) * across + share * (of_ball + half * half + 0.75 * r * half)
    return ball + rod, [across, across, (1.0 - share) * along + share * of_ball]


_SHAPES: dict[str, Any] = {
    "sphere": _sphere,
    "ellipsoid": _ellipsoid,
    "box": _box,
    "cylinder": _cylinder,
    "capsule": _capsule,
}


def _defaults(root: ET.Element) -> dict[str, dict[str, Attributes]]:
    """Return the attributes of each class of <default> for each tag. A class has those of the class around it."""
    found: dict[str, dict[str, Attributes]] = {}

    def add(element: ET.Element, name: str, around: dict[str, Attributes]) -> None:
        own = {tag: dict(attributes) for tag, attributes in around.items()}
        for child in element:
            tag = "general" if child.tag in _ACTUATORS else child.tag
            if tag != "default":
                own[tag] = own.get(tag, {}) | child.attrib
        found[name] = own
        for child in element.findall("default"):
            if "class" not in child.attrib:
                raise ValueError("a <default> in another one has no class")
            add(child, child.attrib["class"], own)

    for element in root.findall("default"):
        name = element.get("class", "main")
        add(element, name, found.get(name, {}))
        found.setdefault("main", found[name])
    return found


def _called(element: ET.Element) -> str:
    name = element.get("name")
    return f"<{element.tag}>" if name is None else f"<{element.tag} name={name!r:.80}>"


def _capital(called: str) -> str:
    return called[0].upper() + called[1:]


def _number(given: Attributes, name: str, where: str, default: float = 0.0) -> float:
    return float(_numbers(given, name, 1, where, (default,))[0])


def _numbers(
    given: Attributes, name: str, count: int, where: str, default: tuple[float, ...] | None = None
) -> np.ndarray:
    """Return the numbers of an attribute."""
    if name not in given:
        if default is None:
            raise ValueError(f"{where} has no {name}")
        return np.array(default)
    return np.array([float(part) for part in checked_numbers(given[name], count, f"{name} of {where}")])


def _direction(values: np.ndarray, name: str, where: str) -> np.ndarray:
    length = float(np.linalg.norm(values))
    if not length > _SHORTEST:
        raise ValueError(f"{name} of {where} has no direction; one of the numbers must differ from 0")
    return values / length
