"""A model <-> plain JSON and a list of arrays: objects one after the other, each of which knows only those before it.

Numbers, strings, lists, True, False and None are themselves. All else is an object of JSON with one name:
``{"array": 3}`` an array, ``{"object": 5}`` an object, ``{"tuple": [...]}``, ``{"dict": [[key, value], ...]}``,
``{"slice": [...]}``, ``{"float": "nan"}``, ``{"number": ["int64", 3]}`` a number of NumPy's, ``{"words": [...]}`` an
array of strings, ``{"type": "float64"}``, ``{"dtype": "<f8"}``. Since objects refer backwards,
there are no cycles.
"""

from __future__ import annotations

import math
import re
from collections import UserList
from collections.abc import Callable, Mapping
from pathlib import PurePath
from typing import Any

import numpy as np

from .container import Container
from .fields import MalformedError
from .records import Record

_DEEPEST = 32
# Objects may be part of several others; each part counts as often as it is met.
_MOST_PARTS = 10**7
_KINDS = "biuf"
TYPES: dict[str, Any] = {
    "bool": bool,
    "int": int,
    "float": float,
    "object": object,
    **{name: getattr(np, name) for name in ("float64", "float32", "int64", "int32", "number", "integer", "floating")},
}
_NAMES = {kind: name for name, kind in TYPES.items()}
_NUMBERS = {name: getattr(np, name) for name in ("bool", "int64", "int32", "intp", "uint64", "float64", "float32")}


class Writer:
    """Values -> JSON, objects and arrays.

    Parameters
    ----------
    records : mapping
        Class -> how it is written down.
    """

    def __init__(self, records: Mapping[type, Record]):
        self.objects: list[dict[str, Any]] = []
        self.arrays: list[np.ndarray] = []
        self._records = records
        # With the objects themselves, so that no other gets the identity of one that is gone.
        self._seen: dict[int, tuple[Any, int]] = {}

    def value(self, value: Any, where: str) -> Any:
        """A value as JSON.

        Raises
        ------
        ValueError
            If it is none that a file may hold; the message names it.
        """
        kind = type(value)
        if value is None or kind in (bool, str) or (kind is int and abs(value) < 2**63):
            return value
        if kind is float:
            return value if math.isfinite(value) else {"float": repr(value)}
        if kind is list or isinstance(value, UserList):  # which ColumnTransformer had in scikit-learn 1.6
            return self._items(value if kind is list else value.data, where)
        if kind is tuple:
            return {"tuple": self._items(value, where)}
        if kind is dict:
            pairs = value.items()
            return {"dict": [[self.value(key, where), self.value(own, f"{where}[{key!r}]")] for key, own in pairs]}
        if kind is slice:
            return {"slice": [self.value(part, where) for part in (value.start, value.stop, value.step)]}
        if isinstance(value, np.generic) and value.dtype.name in _NUMBERS:
            return {"number": [value.dtype.name, self.value(value.item(), where)]}
        if kind in (np.ndarray, np.memmap):
            return self._array(value, where)
        if isinstance(value, np.dtype) and value.kind in "OU" + _KINDS:
            return {"dtype": value.str}
        if isinstance(value, PurePath):
            return str(value)
        if isinstance(value, type) and value in _NAMES:
            return {"type": _NAMES[value]}
        if kind in self._records:
            return self._object(value, where)
        raise ValueError(refusal(value, where))

    def _items(self, items: Any, where: str) -> list[Any]:
        return [self.value(item, f"{where}[{number}]") for number, item in enumerate(items)]

    def _array(self, values: np.ndarray, where: str) -> Any:
        if values.dtype.kind in "OU":
            return {"words": [list(values.shape), values.dtype.kind, self._items(values.ravel().tolist(), where)]}
        if values.dtype.kind not in _KINDS or values.dtype.itemsize > 8:
            raise ValueError(f"{where} is an array of {values.dtype}: a file holds numbers and strings alone.")
        if id(values) not in self._seen:
            self._seen[id(values)] = values, len(self.arrays)
            little = values.dtype.newbyteorder("<") if values.dtype.byteorder == ">" else values.dtype
            self.arrays.append(np.asarray(values, dtype=little))
        return {"array": self._seen[id(values)][1]}

    def _object(self, thing: Any, where: str) -> Any:
        if id(thing) not in self._seen:
            record = self._records[type(thing)]
            try:
                fields = record.taken(thing)
            except ValueError as error:
                raise ValueError(f"{where} is a {type(thing).__name__} that no file can hold: {error}.") from error
            written = {name: self.value(value, f"{where}.{name}") for name, value in fields.items()}
            self._seen[id(thing)] = thing, len(self.objects)
            self.objects.append({"class": record.name, "fields": written})
        return {"object": self._seen[id(thing)][1]}


def refusal(value: Any, where: str) -> str:
    """Why something is in no file, and what to do."""
    kind = value if isinstance(value, type) else type(value)
    name = f"{kind.__module__}.{kind.__qualname__}"
    what = (
        f"the function {getattr(value, '__qualname__', value)!r}"
        if callable(value) and kind.__module__ in ("builtins", "numpy", "functools")
        else f"a {name}"
    )
    inside = next((name for name in ("best_estimator_", "regressor_", "estimators_") if hasattr(value, name)), None)
    advice = f"Save its {inside}" if inside and where == "model" else "Leave it out"
    return (
        f"{where} is {what}, which a data-only file does not hold: it has numbers and the classes that "
        f"skevgp.io knows, and no code. {advice}, or save the model with skops.io.dump, which says what has to be "
        "trusted, or with pickle or joblib, for those who trust the file."
    )


class Reader:
    """What `Writer` made of values -> the values.

    Parameters
    ----------
    container : Container
        Has the arrays.
    records : mapping
        Name of a class -> how it is written down.
    """

    def __init__(self, container: Container, records: Mapping[str, Record]):
        self._container, self._records = container, records
        self._objects: list[Any] = []
        self._parts: list[int] = []
        self._met = 0
        self._readers: dict[str, tuple[type, Callable[[Any, int], Any]]] = {
            "tuple": (list, self._tuple),
            "dict": (list, self._dict),
            "slice": (list, self._slice),
            "float": (str, self._float),
            "number": (list, self._number),
            "words": (list, self._words),
            "type": (str, self._type),
            "dtype": (str, self._dtype),
        }

    def objects(self, written: Any) -> list[Any]:
        """All objects, in their order.

        Raises
        ------
        MalformedError
            If something is not what `Writer` writes.
        """
        if type(written) is not list:
            raise MalformedError("its objects are no list")
        for number, own in enumerate(written):
            if type(own) is not dict or own.keys() != {"class", "fields"} or type(own["fields"]) is not dict:
                raise MalformedError(f"object {number} is not a class and its fields")
            record = self._records.get(own["class"]) if type(own["class"]) is str else None
            if record is None:
                raise MalformedError(
                    f"object {number} is of the class {own['class']!r:.80}, which skevgp.io does not know"
                )
            self._met = 1
            fields = {name: self.value(value) for name, value in own["fields"].items()}
            if self._met > _MOST_PARTS:
                raise MalformedError(f"object {number} has more than {_MOST_PARTS} parts")
            self._objects.append(record.made(fields))
            self._parts.append(self._met)
        return self._objects

    def value(self, written: Any, depth: int = 0) -> Any:
        """A value from its JSON."""
        self._met += 1
        if depth > _DEEPEST:
            raise MalformedError(f"its values are nested more than {_DEEPEST} deep")
        if written is None or type(written) in (bool, float, str):
            return written
        if type(written) is int and abs(written) < 2**63:
            return written
        if type(written) is list:
            return [self.value(item, depth + 1) for item in written]
        if type(written) is dict and len(written) == 1:
            ((name, content),) = written.items()
            if name in ("array", "object"):
                return self._known(name, content)
            kind, read = self._readers.get(name, (None, None))
            if read is not None and type(content) is kind:
                return read(content, depth + 1)
        raise MalformedError(f"it has a value that no such file has: {written!r:.80}")

    def _known(self, kind: str, number: Any) -> Any:
        there = self._container.n_arrays if kind == "array" else len(self._objects)
        if type(number) is not int or not 0 <= number < there:
            raise MalformedError(f"it refers to the {kind} {number!r:.80}, of {there} that there are so far")
        if kind == "array":
            return self._container.array(number)
        self._met += self._parts[number]
        return self._objects[number]

    def _tuple(self, content: list[Any], depth: int) -> Any:
        return tuple(self.value(item, depth) for item in content)

    def _dict(self, content: list[Any], depth: int) -> Any:
        found = {}
        for pair in content:
            key, value = self._of_length(pair, 2)
            key = self.value(key, depth)
            if type(key) not in (str, int) or key in found:
                raise MalformedError(f"it has a dictionary with the key {key!r:.80}, or that twice")
            found[key] = self.value(value, depth)
        return found

    def _slice(self, content: list[Any], depth: int) -> Any:
        parts = [self.value(part, depth) for part in self._of_length(content, 3)]
        if not all(part is None or type(part) in (int, str) for part in parts):
            raise MalformedError(f"it has a slice of {parts!r:.80}")
        return slice(*parts)

    def _float(self, content: str, depth: int) -> Any:
        if content not in ("nan", "inf", "-inf"):
            raise MalformedError(f"it has the number {content!r:.80}")
        return float(content)

    def _number(self, content: list[Any], depth: int) -> Any:
        name, value = self._of_length(content, 2)
        number = self.value(value, depth)
        if type(name) is not str or name not in _NUMBERS or type(number) not in (bool, int, float):
            raise MalformedError(f"it has a number of the type {name!r:.80}")
        found = _NUMBERS[name](number)
        if found.item() != number and number == number:
            raise MalformedError(f"it has a number that is no {name}")
        return found

    def _words(self, content: list[Any], depth: int) -> Any:
        shape, kind, items = self._of_length(content, 3)
        good = type(shape) is list and all(type(size) is int and size >= 0 for size in shape) and type(items) is list
        if not good or len(shape) > 32 or math.prod(shape) != len(items) or kind not in ("O", "U"):
            raise MalformedError("it has an array of strings whose shape does not fit")
        values = [self.value(item, depth) for item in items]
        if not all(each is None or type(each) in (str, bool, int, float) for each in values):
            raise MalformedError("it has an array of strings in which other things are")
        # Padded to the longest, an array takes as much for each.
        if kind == "U" and max(map(len, map(str, values)), default=0) * len(values) > 100 * self._met:
            raise MalformedError("it has an array of strings that is much larger than they are")
        found = np.empty(len(values), dtype=object)
        found[:] = values
        return (found if kind == "O" else found.astype(str)).reshape(shape)

    def _type(self, content: str, depth: int) -> Any:
        if content not in TYPES:
            raise MalformedError(f"it names the type {content!r:.80}")
        return TYPES[content]

    def _dtype(self, content: str, depth: int) -> Any:
        if not re.fullmatch(r"[<|](b1|[iu][1248]|f[248]|O|U\d{1,6})", content):
            raise MalformedError(f"it names the type {content!r:.80}")
        return np.dtype(content)

    def _of_length(self, content: Any, length: int) -> list[Any]:
        if type(content) is not list or len(content) != length:
            raise MalformedError(f"it has a value of other than {length} parts: {content!r:.80}")
        return content
