"""Data sets: logs of robots, simulated robots (with Pinocchio) and toy data."""

from ..robots import list_robots, load_robot, perturb_robot
from .control import ComputedTorqueController, quintic_reference
from .dynamics import make_dynamics
from .logs import load_log, log_transitions
from .simulation import simulate
from .snelson import fetch_snelson
from .toy import make_toy

__all__ = [
    "ComputedTorqueController",
    "fetch_snelson",
    "list_robots",
    "load_log",
    "load_robot",
    "log_transitions",
    "make_dynamics",
    "make_toy",
    "perturb_robot",
    "quintic_reference",
    "simulate",
]
