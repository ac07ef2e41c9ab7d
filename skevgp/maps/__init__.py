"""A fitted transformer as a function of rows, with value, Jacobian and CasADi expression in one adapter for each."""

from . import physics, sklearn  # noqa: F401  whose adapters register themselves
from .base import ADAPTERS, Identity, Map, NoExpressionError, adapts, as_map, as_maps

__all__ = ["ADAPTERS", "Identity", "Map", "NoExpressionError", "adapts", "as_map", "as_maps"]
