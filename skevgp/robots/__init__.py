"""Robots: the named systems as tables, any other as a Pinocchio model, and what both say of a row x = [q, q̇, u]."""

from .loading import layout_of, list_robots, load_robot
from .perturbation import perturb_robot
from .rigid_body import RigidBody
from .systems import GRAVITY, SYSTEMS, GravityTerm, Layout, System, get_system

__all__ = [
    "GRAVITY",
    "SYSTEMS",
    "GravityTerm",
    "Layout",
    "RigidBody",
    "System",
    "get_system",
    "layout_of",
    "list_robots",
    "load_robot",
    "perturb_robot",
]
