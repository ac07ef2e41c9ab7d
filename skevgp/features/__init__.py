"""Explicit features h(x): scikit-learn transformers that say what physics knows."""

from .gravity import LinkGravity
from .newton import InertiaForce, InertiaForceGravity

__all__ = ["InertiaForce", "InertiaForceGravity", "LinkGravity"]
