"""Read a robot's own logs and prepare their signals for learning."""

from .load import load_log
from .transitions import log_transitions

__all__ = ["load_log", "log_transitions"]
