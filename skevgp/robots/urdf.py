"""URDF files with other inertias and friction: the numbers are replaced, every other byte of a file is kept.

Elements are found by expat and their bytes replaced. (ElementTree would write the whole file anew, without the comments
above its root, where licences are, and with other names for its namespaces.)
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from ..utils.files import replacing
from .inertia import N_PARAMETERS, body_parameters, checked_covariance, checked_joints, checked_links
from .loading import Robot, known_robot, named_system, urdf_path
from .urdf_file import MOMENTS, Element, elements_of


class _Edit(NamedTuple):
    start: int
    end: int
    text: str


def write_urdf(
    source: Robot,
    target: str | os.PathLike[str],
    parameters: np.ndarray,
    *,
    covariance: np.ndarray | None = None,
    damping: Any = None,
    friction: Any = None,
    damping_std: Any = None,
    friction_std: Any = None,
    overwrite: bool = False,
) -> None:
    """Write a copy of a URDF file with other inertial parameters and friction.

    What moves with a joint is one body: its inertia is written to the joint's child link, and the inertials of links
    that are fixed to that link are replaced by a comment, since they are part of it. Links fixed to the base, and all
    that is not said here, stay byte by byte. Parameters are in the frame of the child link, and so are the numbers
    written: origin (centre of mass), mass, and inertia about it in the link's axes.

    Parameters
    ----------
    source : str or path-like
        A URDF file, or the name of a robot of `list_robots` that has one.
    target : str or path-like
        The file to write; one that is there is overwritten.
    parameters : array-like of shape (n_links, 10)
        As in `with_parameters`, in the order of the joints of ``load_robot(source)``.
    covariance : array-like of shape (10 * n_links, 10 * n_links), default=None
        Of the parameters: standard deviations of mass, centre of mass and inertia (to first order) are written as a
        comment inside each ``<inertial>``.
    damping, friction : float or array-like of shape (n_joints,), default=None
        Viscous and Coulomb friction, for ``<dynamics>``; None keeps the file's.
    damping_std, friction_std : float or array-like of shape (n_joints,), default=None
        Their standard deviations, as a comment inside ``<dynamics>``.
    overwrite : bool, default=False
        Whether ``target`` may be ``source``.

    Raises
    ------
    ImportError
        If Pinocchio is not installed, which knows the order of the joints.
    ValueError
        If the source is not a URDF file that can be read, has a document type declaration (entities are not expanded),
        or is the target; if arguments have wrong shapes or no body can have the parameters of a link.

    Notes
    -----
    A URDF file has no place for the reflected inertias of rotors (``armature``): torques at high accelerations are
    those of ``with_parameters(..., armature=...)``, not of the file.
    """
    path = _file_of(source)
    data = path.read_bytes()
    root = elements_of(data, path)  # first: Pinocchio's messages say less
    names = list(known_robot(path).names)[1:]
    if not overwrite and Path(target).exists() and Path(target).samefile(path):
        raise ValueError(f"{str(path)!r} is the source; overwrite=True allows to overwrite it.")
    values, deviations = _numbers(parameters, covariance, names)
    given = {"damping": damping, "friction": friction, "damping_std": damping_std, "friction_std": friction_std}
    joint_numbers = {
        name: checked_joints(numbers, name, len(names)) for name, numbers in given.items() if numbers is not None
    }
    joints = {joint.attributes.get("name", ""): joint for joint in root.all("joint")}
    links = {link.attributes.get("name", ""): link for link in root.all("link")}
    fixed = _fixed_to(root)
    edits: list[_Edit] = []
    for index, (name, body, deviation) in enumerate(zip(names, values, deviations, strict=True)):
        joint = joints[name]
        child = joint.attribute_of("child", "link")
        edits += _inertial(data, links[child], body, deviation)
        for other in _welded(child, fixed):
            edits += _moved(data, links[other], child)
        edits += _dynamics(data, joint, {key: numbers[index] for key, numbers in joint_numbers.items()})
    with replacing(target) as file:
        file.write(_edited(data, edits))


def _file_of(source: Robot) -> Path:
    if not isinstance(source, (str, os.PathLike)) or named_system(source) is not None:
        raise ValueError(f"source must be a URDF file, or the name of a robot that has one; got {source!r}.")
    return urdf_path(source)


def _numbers(parameters: np.ndarray, covariance: np.ndarray | None, names: list[str]) -> tuple[np.ndarray, list[Any]]:
    """Mass, centre of mass and inertia about it of each link, and their standard deviations or None."""
    checked = checked_links(parameters, names)
    values, jacobian = body_parameters(checked)
    if covariance is None:
        return values, [None] * len(values)
    full = checked_covariance(covariance, checked.size)
    blocks = full.reshape(*checked.shape, *checked.shape)
    own = np.einsum("iaib->iab", blocks)
    variances = np.einsum("iab,ibc,iac->ia", jacobian, own, jacobian)
    return values, list(np.sqrt(np.maximum(variances, 0.0)))


def _fixed_to(root: Element) -> dict[str, list[str]]:
    """The links that are fixed to each link."""
    children: dict[str, list[str]] = {}
    for joint in root.all("joint"):
        if joint.attributes.get("type") == "fixed":
            children.setdefault(joint.attribute_of("parent", "link"), []).append(joint.attribute_of("child", "link"))
    return children


def _welded(link: str, fixed: dict[str, list[str]]) -> list[str]:
    """All links that are one body with a link, but for itself."""
    found = [link]
    for name in found:
        found += [other for other in fixed.get(name, []) if other not in found]
    return found[1:]


def _inertial(data: bytes, link: Element, body: np.ndarray, deviation: np.ndarray | None) -> list[_Edit]:
    mass, centre, inertia = _texts(body, repr)
    lines = [
        f'<origin xyz={centre} rpy="0 0 0"/>',
        f"<mass value={mass}/>",
        "<inertia " + " ".join(f"{name}={value}" for name, value in zip(MOMENTS, inertia, strict=True)) + "/>",
    ]
    if deviation is not None:
        mass, centre, inertia = _texts(deviation, "{:.3g}".format)
        spread = " ".join(f"{name}={value}" for name, value in zip(MOMENTS, inertia, strict=True))
        lines.insert(0, f"<!-- standard deviations: mass={mass} xyz={centre} {spread} -->")
    return _replaced(data, link, "inertial", ["<inertial>", *[f"  {line}" for line in lines], "</inertial>"])


def _texts(body: np.ndarray, write: Any) -> tuple[str, str, list[str]]:
    texts = [write(float(value)) for value in body]
    return f'"{texts[0]}"', f'"{" ".join(texts[1:4])}"', [f'"{text}"' for text in texts[4:N_PARAMETERS]]


def _moved(data: bytes, link: Element, body: str) -> list[_Edit]:
    if not link.all("inertial"):
        return []
    called = re.sub("-(?=-)", "- ", body)  # two of them would end the comment
    return _replaced(data, link, "inertial", [f"<!-- The inertia of this link is part of that of {called}. -->"])


def _dynamics(data: bytes, joint: Element, numbers: dict[str, float]) -> list[_Edit]:
    if not numbers:
        return []
    attributes = dict(next((element.attributes for element in joint.all("dynamics")), {}))
    attributes |= {name: repr(float(numbers[name])) for name in ("damping", "friction") if name in numbers}
    tag = " ".join(["<dynamics", *[f"{name}={quoteattr(value)}" for name, value in attributes.items()]])
    spread = [f'{name}="{numbers[f"{name}_std"]:.3g}"' for name in ("damping", "friction") if f"{name}_std" in numbers]
    if not spread:
        return _replaced(data, joint, "dynamics", [f"{tag}/>"])
    comment = f"<!-- standard deviations: {' '.join(spread)} -->"
    return _replaced(data, joint, "dynamics", [f"{tag}>", f"  {comment}", "</dynamics>"])


def _replaced(data: bytes, parent: Element, tag: str, lines: list[str]) -> list[_Edit]:
    """The first child of that tag is replaced, others are removed; without one the lines become the first child."""
    old = parent.all(tag)
    if old:
        further = [_Edit(element.start, element.end, "") for element in old[1:]]
        return [_Edit(old[0].start, old[0].end, _laid_out(lines, _indent(data, old[0].start))), *further]
    indent = _indent(data, parent.start)
    inner = None if indent is None else f"{indent}  "
    text = f"{inner or ''}{_laid_out(lines, inner)}"
    if not parent.is_empty:
        return [_Edit(parent.inner, parent.inner, text)]
    slash = data.rindex(b"/", parent.start, parent.end)
    return [_Edit(slash, parent.end, f">{text}{indent or ''}</{parent.tag}>")]


def _indent(data: bytes, start: int) -> str | None:
    """The end of the line and the blanks before an element that has a line of its own."""
    line = data.rfind(b"\n", 0, start)
    if line < 0 or data[line + 1 : start].strip(b" \t"):
        return None
    return data[line - (data[line - 1 : line] == b"\r") : start].decode("ascii")


def _laid_out(lines: list[str], indent: str | None) -> str:
    return "".join(line.strip() for line in lines) if indent is None else indent.join(lines)


def _edited(data: bytes, edits: list[_Edit]) -> bytes:
    pieces, done = [], 0
    for edit in sorted(edits):
        pieces += [data[done : edit.start], edit.text.encode("ascii", "xmlcharrefreplace")]
        done = edit.end
    return b"".join([*pieces, data[done:]])
