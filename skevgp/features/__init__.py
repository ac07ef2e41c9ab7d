"""Explicit features h(x) from physics, as scikit-learn transformers."""

from .angles import AngleEncoder
from .gravity import LinkGravity
from .newton import InertiaForce, InertiaForceGravity
from .nominal import NominalDynamics
from .rigid_body import RigidBodyRegressor

__all__ = [
    "AngleEncoder",
    "InertiaForce",
    "InertiaForceGravity",
    "LinkGravity",
    "NominalDynamics",
    "RigidBodyRegressor",
]
