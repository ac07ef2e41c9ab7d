"""Logs that are tables of numbers: CSV and the like, also compressed."""

from __future__ import annotations

import csv
import gzip
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...utils.validation import check_integer
from .recording import Recording, Signals

SUFFIXES = (".csv", ".txt", ".tsv", ".csv.gz", ".txt.gz", ".tsv.gz")
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_REQUIRED = ("time", "position")
_EFFORT = ("effort", "current")
_NAMES = (*_REQUIRED, "velocity", "acceleration", *_EFFORT)
# What spreadsheets and loggers write where there is no value.
_MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--"})
# Numbers, perhaps with decimals and groups of thousands.
_DIGITS = re.compile(r"[+-]?[\d.,]*\d[\d.,]*([eE][+-]?\d+)?")


def check_columns(columns: Any) -> dict[str, list[int | str]]:
    """Which columns hold which signal, as lists; or an error."""
    if not isinstance(columns, Mapping):
        raise TypeError(f"columns must be a dict that says which columns hold {', '.join(_NAMES)}; got {columns!r}.")
    columns = {name: value for name, value in columns.items() if value is not None}
    unknown, missing = set(columns) - set(_NAMES), set(_REQUIRED) - set(columns)
    if unknown or missing or len(set(_EFFORT) & set(columns)) != 1:
        raise ValueError(
            f"columns must name 'time', 'position', one of 'effort' and 'current', and perhaps 'velocity' and "
            f"'acceleration'; got {list(columns)}."
        )
    asked = {name: _as_list(value, name) for name, value in columns.items()}
    if len(asked["time"]) != 1:
        raise ValueError(f"columns['time'] must be one column; got {columns['time']!r}.")
    return asked


def read_table(
    path: Path, columns: Mapping[str, list[int | str]], time_unit: str, decimal: Literal[".", ","] = "."
) -> Recording:
    """Read a table.

    Parameters
    ----------
    path : Path
    columns : dict of lists of int or str
        As `check_columns` returns it: numbers from 0, names, or patterns of names.
    time_unit : {"s", "ms", "us", "ns"}
    decimal : {".", ","}, default="."
        What stands before the decimals.

    Returns
    -------
    recording : Recording

    Raises
    ------
    ValueError
        If there are no such columns, signals differ in their number of columns, or numbers have another decimal sign.
    """
    packed = path.suffix.lower() == ".gz"
    try:
        # The signature of UTF-8, which spreadsheets write, is none of the first column's name.
        def opened() -> Any:
            return (gzip.open if packed else open)(path, "rt", encoding="utf-8-sig")

        with opened() as lines:
            layout, rows = _layout(lines, columns, decimal)
            values, problems = layout.numbers(rows), dict[int, str]()
        if values is None:
            with opened() as lines:
                layout, rows = _layout(lines, columns, decimal)
                values, problems = layout.numbers_one_by_one(rows)
        found = layout.found
    except (gzip.BadGzipFile, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise ValueError(f"it is no text, or its compression is broken ({error}).") from error
    signals = {name: values[:, places] for name, places in found.items()}
    effort = signals.get("effort", signals.get("current"))
    assert effort is not None
    n_joints = signals["position"].shape[1]
    for name, signal in signals.items():
        if name != "time" and signal.shape[1] != n_joints:
            raise ValueError(f"there are {n_joints} columns of position, and {signal.shape[1]} of {name}.")
    time = signals["time"][:, 0] * SECONDS[time_unit]
    known = time[~np.isnan(time)]
    start = float(known[0]) if len(known) else np.nan
    return Recording(
        Signals(
            time - start,
            signals["position"],
            signals.get("velocity"),
            signals.get("acceleration"),
            effort,
        ),
        [f"q{number}" for number in range(1, n_joints + 1)],
        start,
        problems,
    )


def _as_list(value: Any, name: str) -> list[int | str]:
    several = [value] if isinstance(value, str) or not isinstance(value, (Sequence, np.ndarray)) else list(value)
    if not several:
        raise ValueError(f"columns[{name!r}] must be at least one column; got {value!r}.")
    return [one if isinstance(one, str) else check_integer(one, f"columns[{name!r}]", minimum=0) for one in several]


@dataclass(frozen=True)
class _Layout:
    """How a table is written, and what is read of it.

    Attributes
    ----------
    delimiter : str or None
        None are spaces.
    decimal : {".", ","}
    read : list of int
        The columns that are read.
    titles : list of str
        What they are called.
    found : dict
        Where each signal is among them.
    """

    delimiter: str | None
    decimal: str
    read: list[int]
    titles: list[str]
    found: dict[str, list[int]]

    def numbers(self, lines: Iterator[str]) -> np.ndarray | None:
        """Values (n, columns read) of lines that are complete, fast; None if one of them is not."""
        decimal = self.decimal
        if decimal == ",":
            if self.delimiter == ",":
                return None
            lines = (line.replace(",", ".") if "." not in line else "?" for line in lines)
        try:
            return np.loadtxt(
                lines, delimiter=self.delimiter, usecols=self.read, comments=None, quotechar='"', ndmin=2, dtype=float
            )
        except ValueError:
            return None

    def numbers_one_by_one(self, lines: Iterator[str]) -> tuple[np.ndarray, dict[int, str]]:
        """The same of any lines, with NaN for what is missing, and what rows lack by their numbers."""
        values, problems = [], dict[int, str]()
        for row, line in enumerate(lines):
            cells, numbers = _cells(line, self.delimiter), []
            for place, title in zip(self.read, self.titles, strict=True):
                number = np.nan
                if place >= len(cells):
                    problems.setdefault(row, f"it has {len(cells)} cells, and column {place} is read")
                elif (cell := cells[place]).lower() not in _MISSING:
                    self._check_decimal(cell, row, title)
                    try:
                        number = float(cell.replace(",", ".") if self.decimal == "," else cell)
                    except ValueError:
                        problems.setdefault(row, f"{cell!r} in {title} is no number")
                numbers.append(number)
            values.append(numbers)
        return np.array(values), problems

    def _check_decimal(self, cell: str, row: int, title: str) -> None:
        """Refuse a number whose decimals are set off by the other sign, or thousands by any."""
        other = "," if self.decimal == "." else "."
        if other not in cell or not _DIGITS.fullmatch(cell):
            return
        if self.decimal == "." and cell.count(",") == 1 and "." not in cell:
            hint = 'Pass decimal=","'
        elif self.decimal == "," and cell.count(".") == 1 and "," not in cell:
            hint = 'Pass decimal="."'
        else:
            hint = "Write numbers without separators of thousands"
        raise ValueError(f"row {row} has {cell!r} in {title}, and decimal={self.decimal!r}. {hint}.")


def _layout(text: Any, columns: Mapping[str, list[int | str]], decimal: str) -> tuple[_Layout, Iterator[str]]:
    """How a table is written, and its rows."""
    comments, first, lines = _beginning(text)
    while (second := next(lines, None)) is not None:
        delimiter = _delimiter(second, decimal)
        cells = _cells(first, delimiter)
        if len(cells) >= len(_cells(second, delimiter)) or all(_is_number(cell) for cell in cells):
            lines = chain([second], lines)
            break
        comments.append(first)  # a title
        first = second
    delimiter = _delimiter(first, decimal)
    cells = _cells(first, delimiter)
    numeric = all(_is_number(cell) for cell in cells)
    header = _cells(comments[-1].lstrip("# "), delimiter) if numeric and comments else [] if numeric else cells
    places = {name: _places(asked, header, len(cells), name) for name, asked in columns.items()}
    read = sorted({place for several in places.values() for place in several})
    # A word in a column that nobody asks for does not make a header of the first row.
    rows = lines if not all(_is_number(cells[place]) for place in read) else chain([first], lines)
    data = next(rows, None)
    if data is None:
        raise ValueError("it has no rows.")
    titles = [f"column {place}" + (f" ({header[place]})" if place < len(header) else "") for place in read]
    found = {name: [read.index(place) for place in several] for name, several in places.items()}
    return _Layout(delimiter, decimal, read, titles, found), chain([data], rows)


def _delimiter(line: str, decimal: str) -> str | None:
    """What separates cells; None are spaces."""
    bare = re.sub(r'"[^"]*"', "", line).rstrip("\t; \r\n")
    for other in ("\t", ";"):
        cells = [cell.strip() for cell in bare.split(other)]
        # A comma then stands before decimals, or in a name. One at the end of a cell separates it from the next.
        apart = len(cells) > 1 and not any(cell.endswith(",") for cell in cells)
        if apart and (all(_is_number(cell) for cell in cells) or len(cells) > bare.count(",")):
            return other
    return "," if "," in line and (decimal == "." or '"' in line) else None


def _beginning(text: Any) -> tuple[list[str], str, Iterator[str]]:
    """The comments at the beginning, the first line that is none, and those that follow."""
    comments: list[str] = []
    lines = (line for line in text if line.strip())
    for line in lines:
        if not line.startswith("#"):
            return comments, line, (later for later in lines if not later.startswith("#"))
        comments.append(line)
    raise ValueError("it is empty.")


def _cells(line: str, delimiter: str | None) -> list[str]:
    cells = line.split() if delimiter is None else next(csv.reader([line], delimiter=delimiter))
    return [cell.strip().strip('"') for cell in cells]


def _is_number(cell: str) -> bool:
    """Whether it is a number, whatever stands before its decimals, or missing."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return cell.lower() in _MISSING
    return True


def _places(asked: list[int | str], header: list[str], n_columns: int, name: str) -> list[int]:
    places = [place for one in asked for place in _places_of(one, header, n_columns, name)]
    if len(set(places)) != len(places):
        raise ValueError(f"columns[{name!r}] has a column twice: {asked}.")
    return places


def _places_of(one: int | str, header: list[str], n_columns: int, name: str) -> list[int]:
    if isinstance(one, int):
        if one >= n_columns:
            raise ValueError(f"columns[{name!r}] asks for column {one}, but there are 0 to {n_columns - 1} only.")
        return [one]
    if not header:
        raise ValueError(f"columns[{name!r}] asks for {one!r}, but there is no header: give numbers, from 0.")
    pattern = one.replace("[", "[[]")  # which is a bracket in names such as q[0]
    found = [place for place, title in enumerate(header) if title == one or fnmatchcase(title, pattern)]
    if not found:
        raise ValueError(f"columns[{name!r}] asks for {one!r}, which is none of the columns {header}.")
    if len(found) > 1 and "*" not in one and "?" not in one:
        raise ValueError(f"columns[{name!r}] asks for {one!r}, but several columns have this name.")
    return found
