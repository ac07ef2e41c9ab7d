"""The named systems as tables of joints, masses and motors, in SI units, with gravity 9.81 m/s² along -z.

Feature maps and data sets read the same tables, so that a new system is one entry of ``SYSTEMS``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from types import MappingProxyType
from typing import Literal

import numpy as np

GRAVITY = 9.81

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class Link:
    """One joint and the rigid body that it moves."""

    name: str  # of the joint
    kind: Literal["revolute", "prismatic"]
    axis: Vector3  # unit vector in the joint's own frame
    mass: float  # kg
    com: Vector3 = (0.0, 0.0, 0.0)  # centre of mass in the joint's frame, m
    inertia: Vector3 = (0.0, 0.0, 0.0)  # moments xx, yy, zz about the centre of mass, kg m²
    xyz: Vector3 = (0.0, 0.0, 0.0)  # origin in the parent's frame, m
    rpy: Vector3 = (0.0, 0.0, 0.0)  # roll, pitch and yaw about the parent's fixed axes, rad
    armature: float = 0.0  # reflected inertia of the rotor: squared gear ratio times rotor inertia, kg m² or kg
    damping: float = 0.0  # viscous, N m s/rad or N s/m
    effort: float = np.inf  # largest torque or force of the motor, N m or N; 0 without a motor


@dataclass(frozen=True)
class GravityTerm:
    """The pull of gravity as the sine of one angle (IFG prior of the paper for planar systems).

    Attributes
    ----------
    angle : tuple of int
        Joints whose positions add up to the angle against the vertical.
    acts_on : tuple of int
        Joints that it accelerates.
    """

    angle: tuple[int, ...]
    acts_on: tuple[int, ...]


@dataclass(frozen=True)
class Layout:
    """The columns x = [q, q̇, u] of a robot's states and inputs.

    Attributes
    ----------
    name : str
        Name of the robot.
    position_names : tuple of str
        Name of the position of each joint.
    driven : tuple of int
        Joints with an input, in the order of the inputs.
    revolute : tuple of bool
        Whether the position of each joint is an angle.
    """

    name: str
    position_names: tuple[str, ...]
    driven: tuple[int, ...]
    revolute: tuple[bool, ...]

    @property
    def n_joints(self) -> int:
        return len(self.position_names)

    @property
    def n_inputs(self) -> int:
        return len(self.driven)

    @property
    def n_columns(self) -> int:
        return 2 * self.n_joints + self.n_inputs

    @property
    def state_names(self) -> list[str]:
        return [*self.position_names, *(f"d{name}/dt" for name in self.position_names)]

    @property
    def input_names(self) -> list[str]:
        return [f"u_{self.position_names[joint]}" for joint in self.driven]

    @property
    def column_names(self) -> list[str]:
        return self.state_names + self.input_names


@dataclass(frozen=True)
class System:
    """A robot with a fixed base: a chain of joints, some of them driven.

    Attributes
    ----------
    name : str
        Name of the system.
    links : tuple of Link
        Links from the base to the tip.
    gravity : tuple of GravityTerm
        Pull of gravity in a planar system; empty if it is not a sine.
    """

    name: str
    links: tuple[Link, ...]
    gravity: tuple[GravityTerm, ...] = ()

    @property
    def layout(self) -> Layout:
        """Columns of the states and inputs."""
        return Layout(
            self.name,
            position_names=tuple(link.name for link in self.links),
            driven=tuple(joint for joint, link in enumerate(self.links) if link.effort > 0.0),
            revolute=tuple(link.kind == "revolute" for link in self.links),
        )


_Y, _Z = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_UP = np.pi / 2

# fmt: off
_IIWA14 = (
    # mass, com, inertia about it, origin in the parent, rpy, gear ratio, rotor inertia, effort
    (5.76, (0, -0.03, 0.12), (0.033, 0.0333, 0.0123), (0, 0, 0.1575), (0, 0, 0), 160, 1.321e-4, 320.0),
    (6.35, (0.0003, 0.059, 0.042), (0.0305, 0.011, 0.0304), (0, 0, 0.2025), (_UP, 0, np.pi), 160, 1.321e-4, 320.0),
    (3.5, (0, 0.03, 0.13), (0.025, 0.0238, 0.0076), (0, 0.2045, 0), (_UP, 0, np.pi), 160, 1.321e-4, 176.0),
    (3.5, (0, 0.067, 0.034), (0.017, 0.006, 0.0164), (0, 0, 0.2155), (_UP, 0, 0), 160, 1.321e-4, 176.0),
    (3.5, (0.0001, 0.021, 0.076), (0.01, 0.0087, 0.00449), (0, 0.1845, 0), (-_UP, np.pi, 0), 100, 1.321e-4, 110.0),
    (1.8, (0, 0.0006, 0.0004), (0.0049, 0.0047, 0.0036), (0, 0, 0.2155), (_UP, 0, 0), 160, 4.54e-5, 40.0),
    (1.2, (0, 0, 0.02), (0.001, 0.001, 0.001), (0, 0.081, 0), (-_UP, np.pi, 0), 160, 4.54e-5, 40.0),
)
# fmt: on


def _iiwa14_links() -> tuple[Link, ...]:
    return tuple(
        Link(f"q{number}", "revolute", _Z, mass, com, inertia, xyz, rpy, armature=gear**2 * rotor, effort=effort)
        for number, (mass, com, inertia, xyz, rpy, gear, rotor, effort) in enumerate(_IIWA14, start=1)
    )


_CARTPOLE = System(
    "cartpole",
    links=(
        Link("x", "prismatic", (1.0, 0.0, 0.0), mass=10.0),
        Link("theta", "revolute", (0.0, -1.0, 0.0), mass=1.0, com=(0.0, 0.0, -0.5), effort=0.0),
    ),
    gravity=(GravityTerm(angle=(1,), acts_on=(1,)),),
)
# The cartpole of MIT's course Underactuated Robotics until May 2022. The other one, Drake's own example, has no
# damping.
_CARTPOLE_DAMPED = System(
    "cartpole_damped", tuple(replace(link, damping=0.1) for link in _CARTPOLE.links), _CARTPOLE.gravity
)

SYSTEMS: Mapping[str, System] = MappingProxyType(
    {
        system.name: system
        for system in (
            System(
                "pendulum",
                links=(Link("q", "revolute", _Y, mass=1.0, com=(0.0, 0.0, -0.5), damping=0.1),),
                gravity=(GravityTerm(angle=(0,), acts_on=(0,)),),
            ),
            _CARTPOLE,
            _CARTPOLE_DAMPED,
            System(
                "acrobot",
                links=(
                    Link(
                        "q1",
                        "revolute",
                        _Y,
                        mass=1.0,
                        com=(0.0, 0.0, -0.5),
                        inertia=(0.083, 0.083, 0.0),
                        damping=0.1,
                        effort=0.0,
                    ),
                    Link(
                        "q2",
                        "revolute",
                        _Y,
                        mass=1.0,
                        com=(0.0, 0.0, -1.0),
                        inertia=(0.33, 0.33, 0.0),
                        xyz=(0.0, 0.0, -1.0),
                        damping=0.1,
                    ),
                ),
                gravity=(GravityTerm(angle=(0,), acts_on=(0,)), GravityTerm(angle=(0, 1), acts_on=(0, 1))),
            ),
            System("iiwa14", links=_iiwa14_links()),
        )
    }
)


def get_system(name: str | System) -> System:
    """Return a named system.

    Parameters
    ----------
    name : str or System
        A name in ``SYSTEMS``. A `System` is returned as it is.

    Returns
    -------
    system : System
        The system.

    Raises
    ------
    ValueError
        If no system has this name.
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
