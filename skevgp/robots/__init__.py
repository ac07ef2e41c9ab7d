"""Robots: the named systems as tables, any other robot as a Pinocchio model, and the columns of rows x = [q, q̇, u]."""

from .consistent import nearest_consistent
from .inertia import (
    body_parameters,
    from_pseudo_inertia,
    inertial_parameters,
    physical_consistency,
    pseudo_inertia,
    with_parameters,
)
from .loading import layout_of, list_robots, load_robot
from .perturbation import perturb_robot
from .rigid_body import RigidBody
from .systems import GRAVITY, SYSTEMS, GravityTerm, Layout, System, get_system
from .urdf import write_urdf

__all__ = [
    "GRAVITY",
    "SYSTEMS",
    "GravityTerm",
    "Layout",
    "RigidBody",
    "System",
    "body_parameters",
    "from_pseudo_inertia",
    "get_system",
    "inertial_parameters",
    "layout_of",
    "list_robots",
    "load_robot",
    "nearest_consistent",
    "perturb_robot",
    "physical_consistency",
    "pseudo_inertia",
    "with_parameters",
    "write_urdf",
]
