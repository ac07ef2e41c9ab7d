"""Checks of arguments whose errors name the argument, the value and what is allowed."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

import numpy as np


def check_integer(value: Any, name: str, *, minimum: int) -> int:
    """An integer not below ``minimum``, or an error that names it."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Integral):
        raise TypeError(f"{name} must be an integer; got {value!r}.")
    if value < minimum:
        raise ValueError(f"{name} must be at least {minimum}; got {value!r}.")
    return int(value)


def check_real(value: Any, name: str, *, minimum: float, strict: bool = False) -> float:
    """A finite number not below (``strict``: above) ``minimum``, or an error that names it."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number; got {value!r}.")
    if not np.isfinite(value) or value < minimum or (strict and value == minimum):
        raise ValueError(f"{name} must be finite and {'above' if strict else 'at least'} {minimum}; got {value!r}.")
    return float(value)
