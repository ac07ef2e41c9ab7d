"""Explicit features h(x) from physics, as scikit-learn transformers."""

from .angles import AngleEncoder
from .friction import Friction
from .gravity import LinkGravity
from .newton import InertiaForce, InertiaForceGravity
from .nominal import NominalDynamics
from .parametric import ParametricFeatures
from .rigid_body import RigidBodyRegressor
from .theta import LogNormal, Normal, Uniform

__all__ = [
    "AngleEncoder",
    "Friction",
    "InertiaForce",
    "InertiaForceGravity",
    "LinkGravity",
    "LogNormal",
    "NominalDynamics",
    "Normal",
    "ParametricFeatures",
    "RigidBodyRegressor",
    "Uniform",
]
