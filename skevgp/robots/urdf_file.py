"""URDF files: their elements, and what Pinocchio reads of them, checked.

Pinocchio's parser is C++. A chain of thousands of joints ends the interpreter, a mass that is no number becomes 0, and
links in a circle are left out without an error. So skevgp reads the file and gives Pinocchio a copy that holds only
checked links and joints.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from decimal import Decimal
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

import numpy as np

# In the order in which skevgp writes them.
MOMENTS = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
_LIMITED = ("revolute", "prismatic")
_KINDS = (*_LIMITED, "continuous", "fixed", "floating", "planar")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
# Pinocchio divides by the square of an axis's length.
_SHORTEST_AXIS = 1e-9
# ElementTree writes by recursion. Pinocchio goes from joint to joint by recursion, and makes matrices of as many rows
# and columns as joints move.
_DEEPEST, _LONGEST_CHAIN, MOST_JOINTS = 100, 500, 300
# Share of the masses of a body below which their sum is rounding.
_ROUNDING = 1e-12
# Elements that simulators and controllers read, whatever is in them.
_OF_OTHERS = ("gazebo", "transmission")


def read_elements(path: Path) -> tuple[ET.Element, ET.Element]:
    """Read a URDF file: its <robot>, and an element around it that also holds the comments before and after it.

    Raises
    ------
    ValueError
        If `parsed` refuses the file, or its root is not <robot>. The message names the file.
    """
    with naming(path):
        document, robot = parsed(path)
        if robot.tag != "robot":
            raise ValueError(f"its root is <{robot.tag}>, not <robot>")
    return document, robot


def parsed(path: Path) -> tuple[ET.Element, ET.Element]:
    """Read an XML file: its root, and an element around it.

    Raises
    ------
    ValueError
        If the file is not XML, has a document type declaration, or elements are too deep in each other.
    """
    # Expat knows no namespaces here: a prefix stays a part of the name, and need not be declared.
    parser, tree = expat.ParserCreate(), ET.TreeBuilder(insert_comments=True, insert_pis=True)
    parser.StartElementHandler, parser.EndElementHandler = tree.start, tree.end
    parser.CharacterDataHandler, parser.CommentHandler = tree.data, tree.comment
    parser.ProcessingInstructionHandler, parser.StartDoctypeDeclHandler = tree.pi, _refuse_declaration
    tree.start("document", {})
    try:
        parser.Parse(path.read_bytes(), True)
    except (expat.ExpatError, LookupError) as error:
        raise ValueError(str(error)) from error
    tree.end("document")
    document = tree.close()
    root = next(element for element in document if isinstance(element.tag, str))
    level = [root]
    for _ in range(_DEEPEST):
        level = [child for element in level for child in element]
    if level:
        raise ValueError(f"it has elements more than {_DEEPEST} deep in each other")
    return document, root


def _refuse_declaration(*_: object) -> None:
    raise ValueError("it has a document type declaration, which is not read (it may declare entities)")


@contextmanager
def naming(path: Path, what: str = "a URDF") -> Iterator[None]:
    """Name the file in an error."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"The file {str(path)!r} is not {what} that can be read: {error}.") from error


def child_of(joint: ET.Element, end: str = "child") -> str:
    """Return the child link of a checked joint, or its parent link."""
    return joint.findall(end)[0].attrib["link"]


def links_of_body(robot: ET.Element, link: str) -> list[str]:
    """Return a link and all links below it that fixed joints connect to it."""
    below: dict[str, list[str]] = {}
    for joint in robot.findall("joint"):
        if joint.get("type") == "fixed":
            below.setdefault(child_of(joint, "parent"), []).append(child_of(joint))
    found = [link]
    for name in found:
        found += below.get(name, [])
    return found


class CheckedUrdf(NamedTuple):
    """The text for Pinocchio, joints whose limit of effort is unknown, warnings, and links that bodies can be.

    The moments of inertia of `possible_links` violate no law by more than the rounding of their digits.
    """

    text: str
    unknown_efforts: list[str]
    warnings: list[str]
    possible_links: set[str]


def checked_urdf(path: Path) -> CheckedUrdf:
    """Read and check what Pinocchio needs of a file.

    Raises
    ------
    ValueError
        If `read_elements` refuses the file, something is missing or not a number, links are not a tree, friction is
        negative, negative masses are too large, or a joint moves along no axis. The message names the file.
    """
    _, robot = read_elements(path)
    with naming(path):
        _check_expanded(robot)
        copy = _copied(robot)
        links = [link.attrib["name"] for link in copy.findall("link")]
        # Drake, and files that are written for it, need no link "world" for what is fixed to it.
        if "world" not in links and any(child_of(joint, "parent") == "world" for joint in copy.findall("joint")):
            ET.SubElement(copy, "link", name="world")
        _check_tree(copy)
        unknown, warnings = _set_aside(copy)
        warnings += _check_masses(copy)
        possible = {link.attrib["name"] for link in copy.findall("link") if _is_possible(link)}
    return CheckedUrdf(ET.tostring(copy, "unicode"), unknown, warnings, possible)


class _Part(NamedTuple):
    """The attributes of an element that are read, with the count of numbers in each (0 for text), and its children."""

    attributes: Mapping[str, int]
    needed: tuple[str, ...] = ()
    children: tuple[str, ...] = ()


_PARTS = {
    "robot": _Part({"name": 0}, ("name",), ("link", "joint")),
    "link": _Part({"name": 0}, ("name",), ("inertial",)),
    "inertial": _Part({}, ("mass", "inertia"), ("origin", "mass", "inertia")),
    "mass": _Part({"value": 1}, ("value",)),
    "inertia": _Part(dict.fromkeys(MOMENTS, 1), MOMENTS),
    "joint": _Part(
        {"name": 0, "type": 0},
        ("name", "type", "parent", "child"),
        ("parent", "child", "origin", "axis", "limit", "dynamics", "mimic"),
    ),
    "parent": _Part({"link": 0}, ("link",)),
    "child": _Part({"link": 0}, ("link",)),
    "origin": _Part({"xyz": 3, "rpy": 3}),
    "axis": _Part({"xyz": 3}),
    "limit": _Part(dict.fromkeys(("lower", "upper", "effort", "velocity"), 1), ("effort", "velocity")),
    "dynamics": _Part({"damping": 1, "friction": 1}),
    "mimic": _Part({"joint": 0}),
}


def _copied(element: ET.Element, inside: str = "") -> ET.Element:
    """Copy the parts of an element that are read, and check them. Only the first child of most tags counts."""
    part, name = _PARTS[element.tag], element.get("name")
    where = f"<{element.tag}>{inside}" if name is None else f"<{element.tag} name={name!r:.80}>"
    for needed in part.needed:
        if not (element.findall(needed) if needed in part.children else element.get(needed)):
            raise ValueError(f"{where} has no {needed}")
    copy = ET.Element(element.tag)
    for key, n_numbers in part.attributes.items():
        if (text := element.get(key)) is not None:
            copy.set(key, " ".join(checked_numbers(text, n_numbers, f"{key} of {where}")) if n_numbers else text)
    for tag in part.children:
        for child in element.findall(tag)[: None if tag in ("link", "joint") else 1]:
            copy.append(_copied(child, inside if name is None else f" of {where}"))
    return copy


def checked_numbers(text: str, n_numbers: int, where: str) -> list[str]:
    """Split a text into finite numbers, as they are written. The error names ``where``."""
    parts = text.split()
    if len(parts) != n_numbers or not all(_NUMBER.fullmatch(each) and math.isfinite(float(each)) for each in parts):
        expected = "a finite number" if n_numbers == 1 else f"{n_numbers} finite numbers"
        raise ValueError(f"{where} must be {expected}; it is {text!r:.80}")
    return parts


def _check_expanded(robot: ET.Element) -> None:
    """Refuse a xacro file, which is a program that writes a URDF file."""
    found = [robot]
    for element in found:
        found += [child for child in element if child.tag not in _OF_OTHERS]
        if str(element.tag).startswith("xacro:"):
            raise ValueError(
                f"it has the element <{element.tag}> of xacro, which is not run here; expand the file first, by the "
                "command `xacro robot.xacro > robot.urdf`"
            )


def _check_tree(robot: ET.Element) -> None:
    """Refuse links and joints that are not a tree, and trees larger than any robot."""
    joints = robot.findall("joint")
    links = [link.attrib["name"] for link in robot.findall("link")]
    for what, names in (("link", links), ("joint", [joint.attrib["name"] for joint in joints])):
        if len(set(names)) < len(names):
            ((twice, _),) = Counter(names).most_common(1)
            raise ValueError(f"it has two {what}s of the name {twice!r:.80}")
    moving = sum(joint.get("type") != "fixed" for joint in joints)
    if moving > MOST_JOINTS:
        raise ValueError(f"it has {moving} joints that move, more than {MOST_JOINTS}")
    known, below, children = set(links), dict[str, list[str]](), set[str]()
    for joint in joints:
        kind, called = joint.get("type"), f"the joint {joint.get('name')!r:.80}"
        if kind not in _KINDS:
            raise ValueError(f"{called} is of the type {kind!r:.80}, which is none of {', '.join(_KINDS)}")
        if kind in _LIMITED and joint.find("limit") is None:
            raise ValueError(f"{called} has no <limit>, which a {kind} one needs")
        parent, child = child_of(joint, "parent"), child_of(joint)
        for end, link in (("parent", parent), ("child", child)):
            if link not in known:
                close = get_close_matches(link, links, n=1)
                hint = f"; did you mean {close[0]!r:.80}?" if close else ""
                raise ValueError(f"{called} has the {end} link {link!r:.80}, which is not there{hint}")
        if child in children:
            raise ValueError(f"the link {child!r:.80} is the child of two joints")
        children.add(child)
        below.setdefault(parent, []).append(child)
    roots = [link for link in links if link not in children]
    if len(roots) > 1:
        raise ValueError(f"it has {len(roots)} links that are no joint's child, {roots[:3]}; a tree has one")
    level, reached, depth = roots, set[str](), 0
    while level:
        reached, depth = reached.union(level), depth + 1
        level = [child for link in level for child in below.get(link, [])]
    if len(reached) < len(links):
        raise ValueError(f"it has links in a circle: {[link for link in links if link not in reached][:5]}")
    if depth > _LONGEST_CHAIN:
        raise ValueError(f"it has {depth} links in a row, more than {_LONGEST_CHAIN}")


def _set_aside(robot: ET.Element) -> tuple[list[str], list[str]]:
    """Refuse numbers that no joint can have, replace those that are not needed, and say which these are."""
    unknown, warnings = [], []
    names = [joint.attrib["name"] for joint in robot.findall("joint")]
    for joint, name in zip(robot.findall("joint"), names, strict=True):
        mimics = joint.findall("mimic")
        for mimic in mimics:
            joint.remove(mimic)
        if joint.get("type") == "fixed":
            continue
        _check_motion(joint, f"the joint {name!r:.80}")
        called = f"The joint {name!r:.80}"
        for limit in joint.findall("limit"):
            for key in ("effort", "velocity"):
                if float(limit.attrib[key]) < 0.0:
                    warnings.append(
                        f'{called} has <limit {key}="{limit.get(key)}">; a limit of {key} must be 0 or above, and '
                        "this one is not used."
                    )
                    limit.set(key, "0")
                    unknown += [name] if key == "effort" else []
            lower, upper = (float(limit.get(key, "0")) for key in ("lower", "upper"))
            if lower > upper and joint.get("type") in _LIMITED:
                warnings.append(
                    f"{called} has <limit> with lower={lower:g} above upper={upper:g}; its limits of position are not "
                    "used."
                )
                limit.attrib |= {"lower": "0", "upper": "0"}
        for mimic in mimics:
            if (other := mimic.get("joint", "")) not in names or other == name:
                warnings.append(
                    f'{called} has <mimic joint="{other:.80}">, which is not another joint of the file, and moves on '
                    "its own."
                )
    return unknown, warnings


def _check_motion(joint: ET.Element, called: str) -> None:
    """Refuse negative friction, and an axis of length 0."""
    for dynamics in joint.findall("dynamics"):
        for name, text in dynamics.attrib.items():
            if float(text) < 0.0:
                raise ValueError(
                    f'{called} has <dynamics {name}="{text}">; {name} must be 0 or above. A negative value from an '
                    "identification means that torques do not show this friction: write 0"
                )
    for axis in joint.findall("axis"):
        if not math.hypot(*map(float, axis.get("xyz", "1 0 0").split())) > _SHORTEST_AXIS:
            raise ValueError(
                f'{called} has <axis xyz="{axis.get("xyz")}">, which has no direction; one of the three numbers must '
                "differ from 0"
            )


def _check_masses(robot: ET.Element) -> list[str]:
    """Warn of links with negative masses, and refuse those that are too large for Pinocchio to add."""
    masses = {
        link.attrib["name"]: float(mass.attrib["value"])
        for link in robot.findall("link")
        for mass in link.findall("inertial/mass")
    }
    negative = {name: mass for name, mass in masses.items() if mass < 0.0}
    for joint in robot.findall("joint") if negative else []:
        if joint.get("type") == "fixed":
            continue
        body = links_of_body(robot, child_of(joint))
        of_body = [masses.get(link, 0.0) for link in body]
        # Pinocchio adds link after link, the joint's own first, and divides by each sum. A body whose whole mass is
        # negative is refused later.
        least, rounding = of_body[0] + sum(negative.get(link, 0.0) for link in body[1:]), sum(map(abs, of_body))
        if min(of_body) < 0.0 and sum(of_body) >= -_ROUNDING * rounding and least <= _ROUNDING * rounding:
            link = min(body, key=lambda name: masses.get(name, 0.0))
            raise ValueError(
                f'the link {link!r:.80} has <mass value="{masses[link]:g}">; the negative masses of links that are '
                f"fixed to each other must be smaller than the mass of the first of them, {body[0]!r:.80}, which is "
                f"{of_body[0]:g}. Write the whole inertia to that link"
            )
    return [
        f'The link {name!r:.80} has <mass value="{mass:g}">; a mass must be 0 or above. It counts as a part of the '
        "body to which the link is fixed."
        for name, mass in negative.items()
    ]


def _is_possible(link: ET.Element) -> bool:
    """Whether some body rounds to the mass and the moments of inertia of a link.

    The rounding of a number is half a unit of its last digit: 0.0005 of 0.001. A 0 is rounded as the coarsest of the
    other moments. Let E be the roundings. If vᵀ I v < -|v|ᵀ E |v| for an eigenvector v, no body has the inertia. Nor
    has one if tr(I) - 2 vᵀ I v is below 0 by more than rounding (triangle inequality).
    """
    for inertial in link.findall("inertial"):
        mass = float(inertial.findall("mass")[0].attrib["value"])
        texts = [inertial.findall("inertia")[0].attrib[name] for name in MOMENTS]
        values = np.array(texts, dtype=float)
        if mass < 0.0 or (mass == 0.0 and values.any()):
            return False
        halves = np.array([0.5 * 10.0 ** int(Decimal(t).as_tuple().exponent) if float(t) else 0.0 for t in texts])
        halves[values == 0.0] = halves.max()
        largest = np.abs(values).max() or 1.0  # as a unit: sums of the largest doubles overflow
        inertia, rounding = (entries[[[0, 1, 3], [1, 2, 4], [3, 4, 5]]] / largest for entries in (values, halves))
        moments, axes = np.linalg.eigh(inertia)
        first, last = np.abs(axes[:, 0]), np.abs(axes[:, 2])
        lacking = np.trace(inertia) - 2.0 * moments[2]
        of_lacking = np.abs(np.eye(3) - 2.0 * np.outer(last, last)) * rounding
        if moments[0] < -(first @ rounding @ first) or lacking < -of_lacking.sum():
            return False
    return True
