"""How objects of a class are written down: their fields by name, and what each may be."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from sklearn import __version__ as sklearn_version

from .._version import __version__
from .fields import Field, MalformedError, Sizes, anything, integer, nothing


@dataclass(frozen=True)
class Record:
    """How objects of a class are written down.

    Attributes
    ----------
    name : str
        Of the class, in files: it stays when a class moves.
    kind : type
        The class itself: not those that are derived of it.
    fields : dict
        What each field may be, by its name.
    may_lack : frozenset of str
        Fields that may be absent.
    take : callable
        Object -> its fields.
    make : callable
        Fields, all of them good -> object.
    """

    name: str
    kind: type
    fields: Mapping[str, Field]
    may_lack: frozenset[str]
    take: Callable[[Any], dict[str, Any]]
    make: Callable[[dict[str, Any]], Any]

    def taken(self, thing: Any) -> dict[str, Any]:
        """The fields of an object.

        Raises
        ------
        ValueError
            If it has others, which would be lost.
        """
        found = self.take(thing)
        if others := sorted(found.keys() - self.fields.keys()):
            raise ValueError(f"it has {others}, of which this version of skevgp knows nothing")
        return found

    def made(self, found: dict[str, Any]) -> Any:
        """An object of fields from a file.

        Raises
        ------
        MalformedError
            If there are others, some lack, or one is not what it may be.
        """
        if others := sorted(found.keys() - self.fields.keys()):
            raise MalformedError(f"a {self.name} has no {others[:10]}")
        if absent := sorted(self.fields.keys() - self.may_lack - found.keys()):
            raise MalformedError(f"a {self.name} lacks its {absent[:10]}")
        sizes: Sizes = {}
        for name, value in found.items():
            self.fields[name].check(value, sizes, f"{self.name}.{name}")
        return self.make(found)


def plain(kind: type, name: str | None = None, /, **fields: Field) -> Record:
    """Of a class whose objects are made of their fields: a dataclass or a named tuple."""
    names = tuple(fields)
    return Record(
        kind.__name__ if name is None else name,
        kind,
        fields,
        frozenset(),
        lambda thing: {each: getattr(thing, each) for each in names},
        lambda found: kind(**found),
    )


def bare(kind: type, name: str | None = None, /, **fields: Field) -> Record:
    """Of a class whose objects are what they have been given, whatever it is made of."""
    return Record(kind.__name__ if name is None else name, kind, fields, frozenset(), dict_of, _filled(kind))


def estimator(kind: type, name: str | None = None, /, **attributes: Field) -> Record:
    """Of a scikit-learn estimator: its parameters, whatever they are, and attributes, which it may lack."""
    parameters = parameters_of(kind)
    fields = {**dict.fromkeys(parameters, anything), **_OF_ALL, **attributes}
    return Record(
        kind.__name__ if name is None else name,
        kind,
        fields,
        frozenset(fields.keys() - {each for each, default in parameters.items() if default is inspect.Parameter.empty}),
        state_of,
        _validated(kind, parameters),
    )


_VERSIONS = ("_sklearn_version", "_skevgp_version")
# A stranger's file does not start a million processes.
_OF_ALL = {"_sklearn_output_config": anything, "n_jobs": integer(-1024, 1024) | nothing}


def state_of(thing: Any) -> dict[str, Any]:
    """The state of an estimator, but for versions, which a file has once."""
    return {name: value for name, value in thing.__getstate__().items() if name not in _VERSIONS}


def parameters_of(kind: Any) -> dict[str, Any]:
    """The parameters of an estimator and their defaults."""
    arguments = inspect.signature(kind.__init__).parameters
    return {
        name: argument.default
        for name, argument in arguments.items()
        if name != "self" and argument.kind is not argument.VAR_KEYWORD
    }


def dict_of(thing: Any) -> dict[str, Any]:
    """All that an object has been given."""
    return dict(vars(thing))


def _filled(kind: Any) -> Callable[[dict[str, Any]], Any]:
    def make(found: dict[str, Any]) -> Any:
        thing = kind.__new__(kind)
        vars(thing).update(found)
        return thing

    return make


def _validated(kind: Any, parameters: Mapping[str, Any]) -> Callable[[dict[str, Any]], Any]:
    # Whether it still predicts the same is seen when it is tried.
    version = (
        {"_skevgp_version": __version__} if kind.__module__.startswith("skevgp.") else {_VERSIONS[0]: sklearn_version}
    )

    def make(found: dict[str, Any]) -> Any:
        thing = kind.__new__(kind)
        # Parameters that a later version of scikit-learn has more are as they were.
        thing.__setstate__(
            {**{name: value for name, value in parameters.items() if name not in found}, **found, **version}
        )
        # Kernels and solvers check theirs elsewhere.
        if getattr(thing, "_parameter_constraints", None):
            thing._validate_params()
        return thing

    return make


def by_name(records: Iterable[Record]) -> dict[str, Record]:
    """Records by the names of their classes, which differ."""
    found: dict[str, Record] = {}
    for record in records:
        assert record.name not in found, record.name
        found[record.name] = record
    return found
