"""Data sets: simulated robots (with Pinocchio) and toys."""

from .dynamics import make_dynamics
from .simulation import simulate
from .toy import make_toy

__all__ = ["make_dynamics", "make_toy", "simulate"]
