"""Data frames as arrays and back."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from sys import modules
from typing import Any, NamedTuple

import numpy as np

from .validation import is_frame

# Packages, and the argument of their constructor for the names of the columns of an array.
_NAMED = (("pandas", "columns"), ("polars", "schema"))
_PACKAGES = {"pandas": "DataFrame", "polars": "DataFrame", "pyarrow": "table"}


class FrameColumns(NamedTuple):
    """A data frame as arrays, for states and files."""

    package: str  # pandas, polars or pyarrow
    names: list[str]
    columns: list[np.ndarray]  # (n,) each, of numbers or strings

    @classmethod
    def of(cls, frame: Any) -> FrameColumns | None:
        """Convert a data frame of these packages; returns None for any other object."""
        package = type(frame).__module__.partition(".")[0]
        if package not in _PACKAGES or not is_frame(frame):
            return None
        names = frame.column_names if package == "pyarrow" else frame.columns
        return cls(package, [str(name) for name in names], [np.asarray(frame[name]) for name in names])

    def frame(self) -> Any:
        """Return the data frame; ImportError if its package is not installed, ValueError if the columns are invalid."""
        if self.package not in _PACKAGES or len(self.names) != len(self.columns):
            raise ValueError(f"There are no data frames of {self.package!r} with {len(self.names)} columns.")
        if len({column.shape for column in self.columns}) > 1:
            raise ValueError("The columns of a data frame differ in length.")
        try:
            module = import_module(self.package)
        except ImportError as error:
            raise ImportError(
                f"The model was fitted to a data frame of {self.package}: pip install {self.package} (here: {error})."
            ) from error
        return getattr(module, _PACKAGES[self.package])(dict(zip(self.names, self.columns, strict=True)))


def package_of(values: Any) -> str:
    """Return the top-level package of an object's class."""
    return type(values).__module__.partition(".")[0]


def as_fitted(estimator: Any, X: np.ndarray, package: str) -> Any:
    """Return rows as a data frame if the estimator was fitted to one, in ``package`` or any that is installed."""
    names = getattr(estimator, "feature_names_in_", None)
    if names is None:
        return X
    for name, keyword in sorted(_NAMED, key=lambda frame: (frame[0] != package, frame[0] not in modules)):
        if name in modules or find_spec(name) is not None:
            return import_module(name).DataFrame(X, **{keyword: list(names)})
    return X
