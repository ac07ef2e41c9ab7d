"""Data frames as arrays and back, for states and files that cannot hold them."""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from .validation import is_frame

_PACKAGES = {"pandas": "DataFrame", "polars": "DataFrame", "pyarrow": "table"}


class FrameColumns(NamedTuple):
    """A data frame as arrays.

    Attributes
    ----------
    package : str
        pandas, polars or pyarrow.
    names : list of str
        Of its columns.
    columns : list of ndarray of shape (n,)
        Of numbers or strings.
    """

    package: str
    names: list[str]
    columns: list[np.ndarray]

    @classmethod
    def of(cls, frame: Any) -> FrameColumns | None:
        """A data frame of one of these packages; None of what is none."""
        package = type(frame).__module__.partition(".")[0]
        if package not in _PACKAGES or not is_frame(frame):
            return None
        names = frame.column_names if package == "pyarrow" else frame.columns
        return cls(package, [str(name) for name in names], [np.asarray(frame[name]) for name in names])

    def frame(self) -> Any:
        """The data frame.

        Raises
        ------
        ImportError
            If its package is not installed.
        ValueError
            If there is no such package, or columns differ in length.
        """
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
