"""CasADi, which only those who export need."""

from __future__ import annotations

from typing import Any

from .optional import require


def casadi() -> Any:
    """The package, or an ImportError that gives the pip command."""
    return require("casadi", "The export to CasADi and C")
