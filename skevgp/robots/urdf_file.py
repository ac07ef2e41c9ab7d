"""URDF files: their elements, and of these what Pinocchio reads, checked.

Pinocchio's parser is C++: a tree of thousands of joints, each on the one before, ends the interpreter; a mass that is
no number becomes 0, and links in a circle are left out, with a line on the standard error at most. So the file is read
here, and Pinocchio gets a text that is written anew from what has been checked: no meshes, no other files, no entities.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

# In the order in which skevgp writes them.
MOMENTS = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
_START_TAG = re.compile(rb"""<[^\s/>]+(?:\s+[^\s=]+\s*=\s*(?:"[^"]*"|'[^']*'))*\s*(/?)>""")
_LIMITED = ("revolute", "prismatic")
_KINDS = (*_LIMITED, "continuous", "fixed", "floating", "planar")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_OF_LIMIT = ("lower", "upper", "effort", "velocity")
# Pinocchio divides by the square of an axis's length.
_SHORTEST_AXIS = 1e-9
# An element takes some hundred times the memory of its text; robots have thousands, nested six deep.
_MOST_ELEMENTS, _DEEPEST = 1_000_000, 100
# Pinocchio goes from joint to joint by recursion, and makes matrices of as many rows and columns as joints move.
_LONGEST_CHAIN, _MOST_JOINTS = 500, 300
# Elements that simulators and controllers read, whatever is in them.
_OF_OTHERS = ("gazebo", "transmission")


class Element:
    """Where the bytes of an element are, and its children."""

    def __init__(self, tag: str, attributes: dict[str, str], data: bytes, start: int):
        self.tag, self.attributes, self.start = tag, attributes, start
        match = _START_TAG.match(data, start)
        if match is None:
            raise ValueError("its encoding is not one that has ASCII in it")
        self.is_empty = bool(match[1])
        self.inner = self.end = match.end()
        self.children: list[Element] = []

    def all(self, tag: str) -> list[Element]:
        return [child for child in self.children if child.tag == tag]

    def attribute_of(self, tag: str, name: str) -> str:
        return next((child.attributes.get(name, "") for child in self.all(tag)), "")


def elements_of(data: bytes, path: Path) -> Element:
    """The root of a file's elements.

    Raises
    ------
    ValueError
        If it is no XML, has a document type declaration, or is no robot; the message names the file.
    """
    parser = expat.ParserCreate()
    open_elements: list[Element] = []
    roots: list[Element] = []
    count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > _MOST_ELEMENTS or len(open_elements) == _DEEPEST:
            raise ValueError(f"it has more than {_MOST_ELEMENTS} elements, or some {_DEEPEST} deep in each other")
        element = Element(tag, attributes, data, parser.CurrentByteIndex)
        (open_elements[-1].children if open_elements else roots).append(element)
        open_elements.append(element)

    def end(_: str) -> None:
        element = open_elements.pop()
        if not element.is_empty:
            element.end = data.index(b">", parser.CurrentByteIndex) + 1

    def declared(*_: object) -> None:
        raise ValueError("it has a document type declaration, which is not read (it may declare entities)")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = declared
    with _naming(path):
        try:
            parser.Parse(data, True)
        except (expat.ExpatError, LookupError) as error:
            raise ValueError(str(error)) from error
        if roots[0].tag != "robot":
            raise ValueError(f"its root is <{roots[0].tag}>, not <robot>")
    return roots[0]


class CheckedUrdf(NamedTuple):
    """What is read of a URDF file.

    Attributes
    ----------
    text : str
        For Pinocchio: the tree of links and joints, with finite numbers.
    unknown_efforts : list of str
        The joints whose limit of effort is not used; the text has 0.
    warnings : list of str
        Sentences about what the file has and the text does not, one for each number.
    """

    text: str
    unknown_efforts: list[str]
    warnings: list[str]


def checked_urdf(path: Path) -> CheckedUrdf:
    """What Pinocchio reads of a file, and what is left out.

    Raises
    ------
    ValueError
        If the file is none that `elements_of` reads, something lacks or is no number, links are not a tree, friction is
        negative, or a joint moves along no axis; the message names the file.
    """
    root = elements_of(path.read_bytes(), path)
    with _naming(path):
        _check_expanded(root)
        _declare_world(root)
        text = _written(root, _ROBOT, "")
        _check_tree(root)
        unknown, warnings = _set_aside(root)
    return CheckedUrdf(_written(root, _ROBOT, "") if warnings else text, unknown, warnings)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise ValueError(f"The file {str(path)!r} is not a URDF that can be read: {error}.") from error


class _Part(NamedTuple):
    """What is read of an element: attributes of so many numbers or (0) of words, and the first child of each name."""

    attributes: Mapping[str, int] = {}
    needed: tuple[str, ...] = ()
    children: Mapping[str, _Part] = {}
    each: bool = False  # all of them, not the first


_PLACE = _Part({"xyz": 3, "rpy": 3})
_INERTIAL = _Part(
    {},
    ("mass", "inertia"),
    {
        "origin": _PLACE,
        "mass": _Part({"value": 1}, ("value",)),
        "inertia": _Part(dict.fromkeys(MOMENTS, 1), MOMENTS),
    },
)
_END = _Part({"link": 0}, ("link",))
_JOINT = _Part(
    {"name": 0, "type": 0},
    ("name", "type", "parent", "child"),
    {
        "parent": _END,
        "child": _END,
        "origin": _PLACE,
        "axis": _Part({"xyz": 3}),
        "limit": _Part(dict.fromkeys(_OF_LIMIT, 1), ("effort", "velocity")),
        "dynamics": _Part({"damping": 1, "friction": 1}),
    },
    each=True,
)
_LINK = _Part({"name": 0}, ("name",), {"inertial": _INERTIAL}, each=True)
_ROBOT = _Part({"name": 0}, ("name",), {"link": _LINK, "joint": _JOINT})


def _written(element: Element, part: _Part, inside: str) -> str:
    """An element as text: what is read of it, if it is all there and its numbers are finite."""
    name = element.attributes.get("name")
    where = f"<{element.tag}>{inside}" if name is None else f"<{element.tag} name={name!r:.80}>"
    of_tag = {tag: element.all(tag) for tag in part.children}
    for needed in part.needed:
        if not (of_tag[needed] if needed in of_tag else element.attributes.get(needed)):
            raise ValueError(f"{where} has no {needed}")
    words = [
        f"{key}={quoteattr(_checked(element.attributes[key], n, f'{key} of {where}'))}"
        for key, n in part.attributes.items()
        if key in element.attributes
    ]
    inner = "".join(
        _written(child, own, inside if name is None else f" of {where}")
        for tag, own in part.children.items()
        for child in (of_tag[tag] if own.each else of_tag[tag][:1])
    )
    return f"<{' '.join([element.tag, *words])}>{inner}</{element.tag}>"


def _checked(text: str, n_numbers: int, where: str) -> str:
    if n_numbers == 0:
        return text
    parts = text.split()
    if len(parts) != n_numbers or not all(_NUMBER.fullmatch(each) and math.isfinite(float(each)) for each in parts):
        expected = "a finite number" if n_numbers == 1 else f"{n_numbers} finite numbers"
        raise ValueError(f"{where} must be {expected}; it is {text!r:.80}")
    return " ".join(parts)


def _check_expanded(root: Element) -> None:
    """Refuse a xacro file, which is a program that writes a URDF file."""
    found = [root]
    for element in found:
        found += [child for child in element.children if child.tag not in _OF_OTHERS]
        if element.tag.startswith("xacro:"):
            raise ValueError(
                f"it has the element <{element.tag}> of xacro, which is not run here; expand the file first, by the "
                "command `xacro robot.xacro > robot.urdf`"
            )


def _declare_world(root: Element) -> None:
    """Drake, and files that are written for it, need no link of the name "world" for what is fixed to it."""
    links = [link.attributes.get("name") for link in root.all("link")]
    if "world" not in links and any(joint.attribute_of("parent", "link") == "world" for joint in root.all("joint")):
        root.children.append(Element("link", {"name": "world"}, b"<link/>", 0))


def _check_tree(root: Element) -> None:
    """Refuse what is no tree (names twice, links that are not there, two roots, circles) or larger than any robot."""
    links = [link.attributes["name"] for link in root.all("link")]
    for what, names in (("link", links), ("joint", [joint.attributes["name"] for joint in root.all("joint")])):
        if len(set(names)) < len(names):
            ((twice, _),) = Counter(names).most_common(1)
            raise ValueError(f"it has two {what}s of the name {twice!r:.80}")
    moving = sum(joint.attributes["type"] != "fixed" for joint in root.all("joint"))
    if moving > _MOST_JOINTS:
        raise ValueError(f"it has {moving} joints that move, more than {_MOST_JOINTS}")
    known, below, children = set(links), dict[str, list[str]](), set[str]()
    for joint in root.all("joint"):
        kind, called = joint.attributes["type"], f"the joint {joint.attributes['name']!r:.80}"
        if kind not in _KINDS:
            raise ValueError(f"{called} is of the type {kind!r:.80}, which is none of {', '.join(_KINDS)}")
        if kind in _LIMITED and not joint.all("limit"):
            raise ValueError(f"{called} has no <limit>, which a {kind} one needs")
        parent, child = joint.attribute_of("parent", "link"), joint.attribute_of("child", "link")
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


def _set_aside(root: Element) -> tuple[list[str], list[str]]:
    """Refuse numbers that no joint can have, and replace those that are not needed.

    Returns
    -------
    unknown_efforts, warnings : list of str
    """
    unknown, warnings = [], []
    joints = [joint.attributes["name"] for joint in root.all("joint")]
    for joint in root.all("joint"):
        name, kind = joint.attributes["name"], joint.attributes["type"]
        if kind == "fixed":
            continue
        called = f"The joint {name!r:.80}"
        _check_motion(joint, f"the joint {name!r:.80}")
        for limit in joint.all("limit")[:1]:
            numbers = {key: float(value) for key, value in limit.attributes.items() if key in _OF_LIMIT}
            for key in ("effort", "velocity"):
                if numbers.get(key, 0.0) < 0.0:
                    warnings.append(
                        f'{called} has <limit {key}="{limit.attributes[key]}">; a limit of {key} must be 0 or above, '
                        "and this one is not used."
                    )
                    limit.attributes[key] = "0"
                    unknown += [name] if key == "effort" else []
            lower, upper = numbers.get("lower", 0.0), numbers.get("upper", 0.0)
            if lower > upper and kind in _LIMITED:
                warnings.append(
                    f"{called} has <limit> with lower={lower:g} above upper={upper:g}; its limits of position are not "
                    "used."
                )
                limit.attributes |= {"lower": "0", "upper": "0"}
        for mimic in joint.all("mimic")[:1]:
            if (other := mimic.attributes.get("joint", "")) not in joints or other == name:
                warnings.append(
                    f'{called} has <mimic joint="{other:.80}">, which is not another joint of the file, and moves on '
                    "its own."
                )
    for link in root.all("link"):
        for inertial in link.all("inertial")[:1]:
            if (mass := float(inertial.attribute_of("mass", "value"))) < 0.0:
                warnings.append(
                    f'The link {link.attributes["name"]!r:.80} has <mass value="{mass:g}">; a mass must be 0 or '
                    "above. It counts as a part of the body to which the link is fixed."
                )
    return unknown, warnings


def _check_motion(joint: Element, called: str) -> None:
    """Refuse negative friction, and an axis that is none."""
    for dynamics in joint.all("dynamics")[:1]:
        for name in ("damping", "friction"):
            if float(dynamics.attributes.get(name, 0.0)) < 0.0:
                raise ValueError(
                    f'{called} has <dynamics {name}="{dynamics.attributes[name]}">; {name} must be 0 or above. A '
                    "negative value from an identification means that torques do not show this friction: write 0"
                )
    for axis in joint.all("axis")[:1]:
        numbers = [float(each) for each in axis.attributes.get("xyz", "1 0 0").split()]
        if not math.hypot(*numbers) > _SHORTEST_AXIS:
            raise ValueError(
                f'{called} has <axis xyz="{axis.attributes["xyz"]}">, which has no direction; one of the three numbers '
                "must differ from 0"
            )
