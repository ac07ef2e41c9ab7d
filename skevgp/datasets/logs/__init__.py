"""Read the logs of a robot and prepare their signals for learning."""

from .load import load_log
from .transitions import log_transitions

__all__ = ["load_log", "log_transitions"]
