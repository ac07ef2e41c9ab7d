"""Models as files: data alone (`save`, `load`), and what skops has to trust (`TRUSTED_TYPES`)."""

from .files import load, save
from .trusted import TRUSTED_TYPES

__all__ = ["TRUSTED_TYPES", "load", "save"]
