"""What a robot wrote down of itself: files are read, their signals made ready for learning."""

from .load import load_log
from .transitions import log_transitions

__all__ = ["load_log", "log_transitions"]
