"""The named systems as tables, and their Pinocchio models.

A system is data: what its joints, masses and actuators are. Feature maps and data sets both read it here, so that a
new system is one entry of ``SYSTEMS``. Everything is in SI units, angles in radians, gravity 9.81 m/s² along -z.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from ._optional import require

GRAVITY = 9.81

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class Link:
    """One joint and the rigid body that it moves.

    Attributes
    ----------
    name : str
        Name of the joint.
    kind : {"revolute", "prismatic"}
    axis : tuple of 3 floats
        Unit vector of the joint in its own frame.
    mass : float
        Mass of the body, kg.
    com : tuple of 3 floats
        Centre of mass in the joint's frame, m.
    inertia : tuple of 3 floats
        Moments of inertia (xx, yy, zz) about the centre of mass, kg m².
    xyz : tuple of 3 floats
        Origin of the joint in its parent's frame, m.
    damping : float
        Viscous damping, N m s/rad or N s/m.
    """

    name: str
    kind: Literal["revolute", "prismatic"]
    axis: Vector3
    mass: float
    com: Vector3 = (0.0, 0.0, 0.0)
    inertia: Vector3 = (0.0, 0.0, 0.0)
    xyz: Vector3 = (0.0, 0.0, 0.0)
    damping: float = 0.0


@dataclass(frozen=True)
class GravityTerm:
    """Gravity's pull as the sine of one angle (the paper's IFG prior for planar systems).

    Attributes
    ----------
    angle : tuple of int
        The joints whose positions add up to the angle against the vertical.
    acts_on : tuple of int
        The joints whose acceleration it changes.
    """

    angle: tuple[int, ...]
    acts_on: tuple[int, ...]


@dataclass(frozen=True)
class System:
    """A robot with a fixed base: a chain of joints, some of them driven.

    Attributes
    ----------
    name : str
    links : tuple of Link
        From the base to the tip.
    driven : tuple of int
        The joints that an input drives, in the order of the inputs.
    gravity : tuple of GravityTerm
    """

    name: str
    links: tuple[Link, ...]
    driven: tuple[int, ...]
    gravity: tuple[GravityTerm, ...]

    @property
    def n_joints(self) -> int:
        return len(self.links)

    @property
    def n_inputs(self) -> int:
        return len(self.driven)

    @property
    def position_names(self) -> list[str]:
        return [link.name for link in self.links]

    @property
    def state_names(self) -> list[str]:
        return self.position_names + [f"d{name}/dt" for name in self.position_names]

    @property
    def input_names(self) -> list[str]:
        return [f"u_{self.links[joint].name}" for joint in self.driven]


_Y = (0.0, 1.0, 0.0)

SYSTEMS: Mapping[str, System] = MappingProxyType(
    {
        system.name: system
        for system in (
            System(
                "pendulum",
                links=(Link("q", "revolute", _Y, mass=1.0, com=(0.0, 0.0, -0.5), damping=0.1),),
                driven=(0,),
                gravity=(GravityTerm(angle=(0,), acts_on=(0,)),),
            ),
            System(
                "cartpole",
                links=(
                    Link("x", "prismatic", (1.0, 0.0, 0.0), mass=10.0),
                    Link("theta", "revolute", (0.0, -1.0, 0.0), mass=1.0, com=(0.0, 0.0, -0.5)),
                ),
                driven=(0,),
                gravity=(GravityTerm(angle=(1,), acts_on=(1,)),),
            ),
            System(
                "acrobot",
                links=(
                    Link("q1", "revolute", _Y, 1.0, com=(0.0, 0.0, -0.5), inertia=(0.0, 0.083, 0.0), damping=0.1),
                    Link(
                        "q2",
                        "revolute",
                        _Y,
                        1.0,
                        com=(0.0, 0.0, -1.0),
                        inertia=(0.0, 0.33, 0.0),
                        xyz=(0.0, 0.0, -1.0),
                        damping=0.1,
                    ),
                ),
                driven=(1,),
                gravity=(GravityTerm(angle=(0,), acts_on=(0,)), GravityTerm(angle=(0, 1), acts_on=(0, 1))),
            ),
        )
    }
)


def get_system(name: str | System) -> System:
    """The named system.

    Parameters
    ----------
    name : str or System
        One of ``SYSTEMS``; a `System` comes back as it is.

    Returns
    -------
    system : System

    Raises
    ------
    ValueError
        If no system has this name; the message lists the known ones.
    TypeError
        If ``name`` is neither a string nor a `System`.
    """
    if isinstance(name, System):
        return name
    if not isinstance(name, str):
        raise TypeError(f"A system must be a name (one of {sorted(SYSTEMS)}) or a System; got {name!r}.")
    try:
        return SYSTEMS[name]
    except KeyError:
        close = get_close_matches(name, SYSTEMS, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"Unknown system {name!r}; the known ones are {sorted(SYSTEMS)}.{hint}") from None


def pinocchio_model(system: str | System) -> Any:
    """Build the rigid-body model of a system.

    Viscous damping is not part of it: `skevgp.datasets.simulate` subtracts it from the joint forces.

    Parameters
    ----------
    system : str or System

    Returns
    -------
    model : pinocchio.Model
        With ``nq == nv == system.n_joints``.

    Raises
    ------
    ImportError
        If Pinocchio is not installed.
    """
    system = get_system(system)
    pin = require("pinocchio", "Rigid-body dynamics")
    joints = {"revolute": pin.JointModelRevoluteUnaligned, "prismatic": pin.JointModelPrismaticUnaligned}
    model = pin.Model()
    model.name = system.name
    model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
    parent = 0
    for link in system.links:
        placement = pin.SE3(np.eye(3), np.array(link.xyz))
        parent = model.addJoint(parent, joints[link.kind](np.array(link.axis)), placement, link.name)
        body = pin.Inertia(link.mass, np.array(link.com), np.diag(link.inertia))
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
    return model
