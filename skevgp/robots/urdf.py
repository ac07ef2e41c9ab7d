"""URDF files with other inertias and friction."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..utils.files import replacing
from .inertia import body_parameters, checked_covariance, checked_joints, checked_links
from .loading import Robot, known_robot, named_system, robot_file
from .urdf_file import MOMENTS, child_of, links_of_body, read_elements


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

    All links that move with a joint are one body. Its inertia is written to the joint's child link, and a comment
    replaces the inertials of the links that are fixed to that link. All other elements, attributes and comments are
    kept; the file is written in UTF-8, with new indentation. Parameters are in the frame of the child link, and so are
    the numbers written: origin (centre of mass), mass, and inertia about it in the link's axes.

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
    if not isinstance(source, (str, os.PathLike)) or named_system(source) is not None:
        raise ValueError(f"source must be a URDF file, or the name of a robot that has one; got {source!r}.")
    path = robot_file(source)
    document, robot = read_elements(path)  # first: errors of what Pinocchio reads say less
    names = list(known_robot(path).names)[1:]
    if not overwrite and Path(target).exists() and Path(target).samefile(path):
        raise ValueError(f"{str(path)!r} is the source; overwrite=True allows to overwrite it.")
    values, deviations = _numbers(parameters, covariance, names)
    given = {"damping": damping, "friction": friction, "damping_std": damping_std, "friction_std": friction_std}
    of_joints = {key: checked_joints(each, key, len(names)) for key, each in given.items() if each is not None}
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    links = {link.get("name"): link for link in robot.findall("link")}
    for index, name in enumerate(names):
        child, *others = links_of_body(robot, child_of(joints[name]))
        _put(links[child], "inertial", _inertial(values[index], None if deviations is None else deviations[index]))
        for other in others:
            if links[other].find("inertial") is not None:
                called = re.sub("-(?=-)", "- ", child)  # two of them would end the comment
                _put(links[other], "inertial", ET.Comment(f" The inertia of this link is part of that of {called}. "))
        if of_joints:
            numbers = {key: each[index] for key, each in of_joints.items()}
            _put(joints[name], "dynamics", _dynamics(joints[name], numbers))
    ET.indent(robot)
    for element in document:
        element.tail = "\n"
    text = "".join(ET.tostring(element, "unicode") for element in document)
    with replacing(target) as file:
        file.write(f'<?xml version="1.0" encoding="utf-8"?>\n{text}'.encode())


def _numbers(
    parameters: np.ndarray, covariance: np.ndarray | None, names: list[str]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Compute mass, centre of mass and inertia about it of each link, and their standard deviations."""
    checked = checked_links(parameters, names)
    values, jacobian = body_parameters(checked)
    if covariance is None:
        return values, None
    blocks = checked_covariance(covariance, checked.size).reshape(*checked.shape, *checked.shape)
    variances = np.einsum("iab,ibic,iac->ia", jacobian, blocks, jacobian)
    return values, np.sqrt(np.maximum(variances, 0.0))


def _inertial(body: np.ndarray, deviation: np.ndarray | None) -> ET.Element:
    """Make an <inertial>, with standard deviations as a comment inside."""
    inertial, texts = ET.Element("inertial"), _texts(body, repr)
    if deviation is not None:
        inertial.append(_comment(_texts(deviation, "{:.3g}".format)))
    ET.SubElement(inertial, "origin", xyz=texts.pop("xyz"), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=texts.pop("mass"))
    ET.SubElement(inertial, "inertia", texts)
    return inertial


def _texts(body: np.ndarray, write: Callable[[float], str]) -> dict[str, str]:
    """Write ten numbers by name."""
    mass, x, y, z, *moments = map(write, body.tolist())
    return {"mass": mass, "xyz": f"{x} {y} {z}", **dict(zip(MOMENTS, moments, strict=True))}


def _dynamics(joint: ET.Element, numbers: dict[str, float]) -> ET.Element:
    """Make a <dynamics> with the attributes of a joint's own and new numbers."""
    dynamics = ET.Element("dynamics", dict(next((old.attrib for old in joint.findall("dynamics")), {})))
    dynamics.attrib |= {name: repr(float(numbers[name])) for name in ("damping", "friction") if name in numbers}
    deviations = {name: f"{numbers[f'{name}_std']:.3g}" for name in ("damping", "friction") if f"{name}_std" in numbers}
    if deviations:
        dynamics.append(_comment(deviations))
    return dynamics


def _comment(deviations: dict[str, str]) -> Any:
    words = " ".join(f'{name}="{text}"' for name, text in deviations.items())
    return ET.Comment(f" standard deviations: {words} ")


def _put(parent: ET.Element, tag: str, new: Any) -> None:
    """Replace the children of a tag by one element, or insert it as the first child if there are none."""
    old = parent.findall(tag)
    place = list(parent).index(old[0]) if old else 0
    for element in old:
        parent.remove(element)
    parent.insert(place, new)
