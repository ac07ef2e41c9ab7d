"""Logs that are tables of numbers: CSV and the like, also compressed."""

from __future__ import annotations

import csv
import gzip
import zlib
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from ..._validation import check_integer
from .recording import Recording, Signals
from .unpacking import Allowance

SUFFIXES = (".csv", ".txt", ".tsv", ".csv.gz", ".txt.gz", ".tsv.gz")
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_REQUIRED = ("time", "position")
_EFFORT = ("effort", "current")
_NAMES = (*_REQUIRED, "velocity", "acceleration", *_EFFORT)


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


def read_table(path: Path, columns: Mapping[str, list[int | str]], time_unit: str) -> Recording:
    """Read a table.

    Parameters
    ----------
    path : Path
    columns : dict of lists of int or str
        As `check_columns` returns it: numbers from 0, names, or patterns of names.
    time_unit : {"s", "ms", "us", "ns"}

    Returns
    -------
    recording : Recording

    Raises
    ------
    ValueError
        If there are no such columns, signals differ in their number of columns, or something is not a number.
    """
    packed = path.suffix.lower() == ".gz"
    try:
        if packed:
            with gzip.open(path) as content:
                Allowance(path.stat().st_size).take_all(content)
        # The signature of UTF-8, which spreadsheets write, is none of the first column's name.
        with (gzip.open if packed else open)(path, "rt", encoding="utf-8-sig") as lines:
            found, values = _read(lines, columns)
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
    return Recording(
        Signals(
            time - time[0],
            signals["position"],
            signals.get("velocity"),
            signals.get("acceleration"),
            effort,
        ),
        [f"q{number}" for number in range(1, n_joints + 1)],
        float(time[0]),
    )


def _as_list(value: Any, name: str) -> list[int | str]:
    several = [value] if isinstance(value, str) or not isinstance(value, (Sequence, np.ndarray)) else list(value)
    if not several:
        raise ValueError(f"columns[{name!r}] must be at least one column; got {value!r}.")
    return [one if isinstance(one, str) else check_integer(one, f"columns[{name!r}]", minimum=0) for one in several]


def _read(text: Any, columns: Mapping[str, list[int | str]]) -> tuple[dict[str, list[int]], np.ndarray]:
    """Where each signal is among the columns that are read, and their values."""
    comments, first, lines = _beginning(text)
    separator = max((",", ";", "\t"), key=first.count)
    delimiter = separator if separator in first else None
    cells = _cells(first, delimiter)
    numeric = all(map(_is_number, cells))
    header = _cells(comments[-1].lstrip("# "), delimiter) if numeric and comments else [] if numeric else cells
    places = {name: _places(asked, header, len(cells), name) for name, asked in columns.items()}
    read = sorted({place for several in places.values() for place in several})
    # A word in a column that nobody asks for does not make a header of the first row.
    rows = lines if not all(_is_number(cells[place]) for place in read) else chain([first], lines)
    data = next(rows, None)
    if data is None:
        raise ValueError("it has no rows.")
    values = np.loadtxt(
        chain([data], rows), delimiter=delimiter, usecols=read, comments=None, quotechar='"', ndmin=2, dtype=np.float64
    )
    return {name: [read.index(place) for place in several] for name, several in places.items()}, values


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
    try:
        float(cell)
    except ValueError:
        return cell == ""  # a missing value, which `loadtxt` tells
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
