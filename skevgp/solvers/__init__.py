"""Solvers: how the parameters of a model are found."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .solvers import LBFGS, Adam

__all__ = ["LBFGS", "Adam"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from . import solvers

        return getattr(solvers, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
