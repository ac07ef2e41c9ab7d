"""What the fields of an object in a file may be: checks that a value passes, or an error that says what is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np

# Sizes of an object's axes by their letters: the first array that has one says what it is.
Sizes = dict[str, int]


class MalformedError(ValueError):
    """What a file says cannot be; `load` adds the name of the file."""


_KINDS = {"f": "floats", "i": "integers", "u": "integers from 0", "b": "truth values", "O": "objects", "U": "strings"}


@dataclass(frozen=True)
class Field:
    """A check of a value: what it must be, in words, and whether it is."""

    words: str
    holds: Callable[[Any, Sizes], bool]

    def __or__(self, other: Field) -> Field:
        return Field(f"{self.words} or {other.words}", lambda v, sizes: self.holds(v, sizes) or other.holds(v, sizes))

    def check(self, value: Any, sizes: Sizes, where: str) -> None:
        """Refuse a value that does not hold."""
        if not self.holds(value, sizes):
            raise MalformedError(f"{where} must be {self.words}; it is {_told(value)}")


def _told(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype} of the shape {value.shape}" + (
            "" if value.dtype.kind != "f" or np.isfinite(value).all() else ", not all of it finite"
        )
    text = repr(value) if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"
    return text if len(text) < 80 else f"{text[:77]}..."


def array(axes: str, kinds: str = "f", *, least: float = -np.inf, above: float = -np.inf, finite: bool = True) -> Field:
    """An array.

    Parameters
    ----------
    axes : str
        A word for each axis: a letter, whose size is the same in all arrays of the object, or a number. ``"..."``: any.
    kinds : str, default="f"
        Of its dtype.
    least, above : float
        All numbers are at least, or above, these.
    finite : bool, default=True
        Whether all numbers must be finite.
    """
    told = f"an array ({', '.join(axes.split())}) of {' or '.join(_KINDS[kind] for kind in kinds)}"
    told += f" of at least {least:g}" if least > -np.inf else ""
    told += f" above {above:g}" if above > -np.inf else ""

    def holds(value: Any, sizes: Sizes) -> bool:
        if not isinstance(value, np.ndarray) or value.dtype.kind not in kinds:
            return False
        if axes != "...":
            names = axes.split()
            if len(names) != value.ndim:
                return False
            for name, size in zip(names, value.shape, strict=True):
                if size != (int(name) if name.isdigit() else sizes.setdefault(name, size)):
                    return False
        if value.dtype.kind != "f":
            return True
        good = np.isfinite(value).all() if finite else not np.isnan(value).any() or least == above == -np.inf
        return bool(good and not (value < least).any() and ((value > above).all() or above == -np.inf))

    return Field(told + (", all finite" if finite and "f" in kinds else ""), holds)


def real(*, least: float = -np.inf, above: float = -np.inf, finite: bool = True) -> Field:
    """A number; NumPy's too."""

    def holds(value: Any, sizes: Sizes) -> bool:
        if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
            return False
        number = float(value)
        if not np.isfinite(number):
            return not finite and (number >= least or np.isnan(number))
        return number >= least and (number > above or above == -np.inf)

    limits = (f" of at least {least:g}" if least > -np.inf else "") + (f" above {above:g}" if above > -np.inf else "")
    return Field(f"a {'finite ' if finite else ''}number{limits}", holds)


def integer(least: int, most: int = 2**62) -> Field:
    """An integer; NumPy's too."""

    def holds(value: Any, sizes: Sizes) -> bool:
        return type(value) is not bool and isinstance(value, Integral) and least <= int(value) <= most

    return Field(f"an integer from {least} to {most}" if most < 2**62 else f"an integer of at least {least}", holds)


def one_of(*choices: str) -> Field:
    """One of some words."""
    return Field(f"one of {list(choices)}", lambda value, sizes: isinstance(value, str) and value in choices)


def made(*kinds: type) -> Field:
    """An object of a kind."""
    return Field(f"a {' or '.join(kind.__name__ for kind in kinds)}", lambda value, sizes: isinstance(value, kinds))


def several(item: Field, kind: Any = list) -> Field:
    """A list (or tuple) whose items hold."""
    return Field(
        f"a {kind.__name__} of which each is {item.words}",
        lambda value, sizes: type(value) is kind and all(item.holds(each, sizes) for each in value),
    )


def row(*items: Field) -> Field:
    """A tuple of so many items, each of which holds."""
    return Field(
        f"a tuple of {', '.join(item.words for item in items)}",
        lambda value, sizes: (
            type(value) is tuple
            and len(value) == len(items)
            and all(item.holds(each, sizes) for item, each in zip(items, value, strict=True))
        ),
    )


def mapping(item: Field) -> Field:
    """A dictionary by names, whose values hold."""
    return Field(
        f"a dictionary of which each value is {item.words}",
        lambda value, sizes: (
            type(value) is dict and all(type(key) is str and item.holds(each, sizes) for key, each in value.items())
        ),
    )


anything = Field("anything", lambda value, sizes: True)
nothing = Field("None", lambda value, sizes: value is None)
flag = Field("True or False", lambda value, sizes: isinstance(value, bool | np.bool_))
text = Field("a string", lambda value, sizes: type(value) is str)
words = Field(
    "an array of strings",
    lambda value, sizes: isinstance(value, np.ndarray) and all(type(each) is str for each in value.ravel().tolist()),
)
# Outputs that follow each other; outputs as slices, or by their numbers.
span = Field(
    "a slice of integers from 0",
    lambda value, sizes: (
        type(value) is slice
        and all(part is None or (type(part) is int and part >= 0) for part in (value.start, value.stop, value.step))
    ),
)
columns = span | several(integer(0))
