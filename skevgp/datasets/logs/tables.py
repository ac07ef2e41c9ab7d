"""Logs that are tables of numbers: CSV and the like, also compressed."""

from __future__ import annotations

import csv
import gzip
import re
import zlib
from array import array
from collections.abc import Iterator, Mapping, Sequence
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
# Spreadsheets and loggers write these words where there is no value.
_MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--"})
# A number, perhaps with decimals and separators of thousands.
_DIGITS = re.compile(r"[+-]?[\d.,]*\d[\d.,]*([eE][+-]?\d+)?")
# float() then reads decimal commas and refuses points.
_COMMAS = str.maketrans(",.", ".?")


def check_columns(columns: Any) -> dict[str, list[int | str]]:
    """Check the argument `columns`; return a list of columns for each signal."""
    if not isinstance(columns, Mapping):
        raise TypeError(f"columns must be a dict with the columns of {', '.join(_NAMES)}; got {columns!r}.")
    columns = {name: value for name, value in columns.items() if value is not None}
    unknown, missing = set(columns) - set(_NAMES), set(_REQUIRED) - set(columns)
    if unknown or missing or len(set(_EFFORT) & set(columns)) != 1:
        raise ValueError(
            f"columns must name 'time', 'position', one of 'effort' and 'current', and perhaps 'velocity' and "
            f"'acceleration'; got {list(columns)}.{' Leave other columns out.' if unknown else ''}"
        )
    asked = {}
    for name, value in columns.items():
        several = list(value) if isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, str) else [value]
        if not several:
            raise ValueError(f"columns[{name!r}] must be at least one column; got {value!r}.")
        asked[name] = [
            one if isinstance(one, str) else check_integer(one, f"columns[{name!r}]", minimum=0) for one in several
        ]
    if len(asked["time"]) != 1:
        raise ValueError(f"columns['time'] must be one column; got {columns['time']!r}.")
    return asked


def read_table(
    path: Path, columns: Mapping[str, list[int | str]], time_unit: str, decimal: Literal[".", ","] = "."
) -> Recording:
    """Read a table; `check_columns` returns the columns."""
    opened: Any = gzip.open if path.suffix.lower() == ".gz" else open
    try:
        # Spreadsheets begin a file with the signature of UTF-8. It is no part of the first title.
        with opened(path, "rt", encoding="utf-8-sig") as text:
            before, first, lines = _first_line(text, decimal)
            delimiter = _delimiter(first, decimal)
            cells = _titles(first, delimiter)
            header = cells
            if all(map(_is_number, cells)):
                header = _titles(before[-1].lstrip("# "), delimiter) if before else []
            places = {name: _places(asked, header, len(cells), name) for name, asked in columns.items()}
            read = {
                place: f"column {place}" + (f" ({header[place]})" if place < len(header) else "")
                for place in sorted({place for several in places.values() for place in several})
            }
            # A word in a column that nobody asks for does not make a header of the first row.
            if all(_is_number(cell) for place, cell in enumerate(cells) if place in read):
                lines = chain([first], lines)
            values, problems = _numbers(lines, delimiter, decimal, read)
    except (gzip.BadGzipFile, EOFError, zlib.error, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"it is not a text file, or its compression is broken ({error}).") from error
    if not len(values):
        raise ValueError("it has no rows.")
    signals = {name: values[:, np.searchsorted(list(read), several)] for name, several in places.items()}
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
            signals["effort" if "effort" in signals else "current"],
        ),
        [f"q{number}" for number in range(1, n_joints + 1)],
        start,
        problems,
    )


def _first_line(text: Any, decimal: str) -> tuple[list[str], str, Iterator[str]]:
    """Return comments and titles before the table, the table's first line, and the lines after it."""
    before: list[str] = []
    lines = (line for line in text if line.strip())
    for first in lines:
        if not first.startswith("#"):
            break
        before.append(first)
    else:
        raise ValueError("it is empty.")
    lines = (line for line in lines if not line.startswith("#"))
    # A title has fewer cells than the line after it, and words among them.
    for second in lines:
        delimiter = _delimiter(second, decimal)
        cells = _titles(first, delimiter)
        if len(cells) >= len(_cells(second, delimiter)) or all(map(_is_number, cells)):
            return before, first, chain([second], lines)
        before.append(first)
        first = second
    return before, first, lines


def _numbers(
    lines: Iterator[str], delimiter: str | None, decimal: str, read: Mapping[int, str]
) -> tuple[np.ndarray, dict[int, str]]:
    """Read the values (n, columns), NaN where one is missing, and what is wrong in which row."""
    values, problems = array("d"), dict[int, str]()

    def number(cell: str) -> float:
        return float(cell.translate(_COMMAS))

    convert = float if decimal == "." else number
    for row, line in enumerate(lines):
        cells = _cells(line, delimiter)
        try:
            values.extend([convert(cells[place]) for place in read])
            continue
        except (ValueError, IndexError):
            pass  # cell by cell
        for place, title in read.items():
            value = np.nan
            if place >= len(cells):
                problems.setdefault(row, f"it has {len(cells)} cells, and column {place} is read")
            elif (cell := _bare(cells[place])).lower() not in _MISSING:
                try:
                    value = convert(cell)
                except ValueError:
                    if hint := _hint(cell, decimal):
                        told = f"row {row} has {cell!r:.80} in {title}, and decimal={decimal!r}. {hint}."
                        raise ValueError(told) from None
                    problems.setdefault(row, f"{cell!r:.80} in {title} is no number")
            values.append(value)
    return np.array(values).reshape(-1, len(read)), problems


def _hint(cell: str, decimal: str) -> str:
    """Return what to do about a number with the other decimal sign or separators of thousands; "" for other cells."""
    other = "," if decimal == "." else "."
    if other not in cell or not _DIGITS.fullmatch(cell):
        return ""
    if cell.count(other) == 1 and decimal not in cell:
        return f'Pass decimal="{other}"'
    return "Write numbers without separators of thousands"


def _delimiter(line: str, decimal: str) -> str | None:
    """Find what separates cells; None stands for spaces."""
    bare = re.sub(r'"[^"]*"', "x", line).rstrip("\t; \r\n")
    for other in ("\t", ";"):
        cells = [cell.strip() for cell in bare.split(other)]
        # A comma then stands before decimals, or in a name. One at the end of a cell separates it from the next.
        apart = len(cells) > 1 and not any(cell.endswith(",") for cell in cells)
        if apart and (all(map(_is_number, cells)) or len(cells) > bare.count(",")):
            return other
    return "," if "," in line and (decimal == "." or '"' in line) else None


def _cells(line: str, delimiter: str | None) -> list[str]:
    if '"' not in line:
        return line.split(delimiter)
    if delimiter is None:
        line, delimiter = " ".join(line.split()), " "
    return next(csv.reader([line], delimiter=delimiter))


def _titles(line: str, delimiter: str | None) -> list[str]:
    return list(map(_bare, _cells(line, delimiter)))


def _bare(cell: str) -> str:
    return cell.strip().strip('"')


def _is_number(cell: str) -> bool:
    """Whether a cell is a number, with any decimal sign, or missing."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return cell.lower() in _MISSING
    return True


def _places(asked: list[int | str], header: list[str], n_columns: int, name: str) -> list[int]:
    """Return the numbers of the columns that are asked for by numbers, names or patterns."""
    places: list[int] = []
    for one in asked:
        found = [one] if isinstance(one, int) else []
        if isinstance(one, str):
            if not header:
                raise ValueError(f"columns[{name!r}] asks for {one!r}, but there is no header: give numbers, from 0.")
            pattern = one.replace("[", "[[]")  # a bracket, as in q[0]
            found = [place for place, title in enumerate(header) if title == one or fnmatchcase(title, pattern)]
            if not found:
                raise ValueError(f"columns[{name!r}] asks for {one!r}, which is not among the columns {header}.")
            if len(found) > 1 and "*" not in one and "?" not in one:
                raise ValueError(f"columns[{name!r}] asks for {one!r}, but several columns have this name.")
        elif one >= n_columns:
            raise ValueError(f"columns[{name!r}] asks for column {one}, but there are 0 to {n_columns - 1} only.")
        places += found
    if len(set(places)) != len(places):
        raise ValueError(f"columns[{name!r}] has a column twice: {asked}.")
    return places
