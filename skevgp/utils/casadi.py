"""Import of CasADi, which only exports need."""

from __future__ import annotations

from typing import Any

from .optional import require


def casadi() -> Any:
    """Return the package, or raise an ImportError with the pip command."""
    return require("casadi", "The export to CasADi and C")
