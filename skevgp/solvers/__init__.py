"""Solvers of `EVGPRegressor`, which find the parameters of a model."""

from typing import Any

from .adam import Adam
from .base import Solver
from .lbfgs import LBFGS

__all__ = ["LBFGS", "Adam"]

# Solvers by their names for ``solver=``.
SOLVERS: dict[str, type[Solver]] = {"lbfgs": LBFGS, "adam": Adam}


def solvers_of_all_rows() -> str:
    """The values of ``solver`` that see all rows at once, for messages."""
    names = [f'solver="{name}" or {kind.__name__}(...)' for name, kind in SOLVERS.items() if not kind.stochastic]
    return ", ".join(names)


def as_solver(solver: Any) -> Solver:
    """Return the solver for ``solver=``, with checked options; ValueError or TypeError if it is not valid."""
    if isinstance(solver, str) and solver in SOLVERS:
        return SOLVERS[solver]()
    kinds = tuple(SOLVERS.values())
    if not isinstance(solver, kinds):
        names = ", ".join(f'"{name}"' for name in SOLVERS)
        objects = ", ".join(f"skevgp.solvers.{kind.__name__}(...)" for kind in kinds)
        raise ValueError(f"solver must be one of {names}, {objects}; got {solver!r}.")
    solver.check()
    return solver
