"""Solvers of `EVGPRegressor`: how the parameters of a model are found."""

from typing import Any

from .adam import Adam
from .lbfgs import LBFGS

__all__ = ["LBFGS", "Adam"]

# What the strings of ``solver=`` stand for.
SOLVERS: dict[str, type[LBFGS] | type[Adam]] = {"lbfgs": LBFGS, "adam": Adam}


def as_solver(solver: Any) -> LBFGS | Adam:
    """Return the solver that ``solver=`` names or is, with its options checked.

    Raises
    ------
    ValueError, TypeError
        If it is none, or an option is out of range.
    """
    if isinstance(solver, str) and solver in SOLVERS:
        return SOLVERS[solver]()
    kinds = tuple(SOLVERS.values())
    if not isinstance(solver, kinds):
        names = ", ".join(f'"{name}"' for name in SOLVERS)
        objects = ", ".join(f"skevgp.solvers.{kind.__name__}(...)" for kind in kinds)
        raise ValueError(f"solver must be one of {names}, {objects}; got {solver!r}.")
    solver.check()
    return solver
