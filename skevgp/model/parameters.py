"""Named parameters <-> one flat vector of coordinates, with transforms and limits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import autograd.numpy as anp
import numpy as np

# A value so much below its limit, as a share, is there but for rounding.
_AT_LIMIT = 1e-6

# Of parameters, by name.
Values = dict[str, np.ndarray]


@dataclass(frozen=True)
class Parameter:
    """A row of the table.

    Attributes
    ----------
    name : str
    start : ndarray
        First value, in the parameter's own units; its shape is the parameter's.
    transform : {"identity", "log"}
        The optimiser moves ``(value - origin) / unit`` or ``log(value)``.
    lower, upper : ndarray or float
        Limits of the value, broadcast to its shape.
    widest : ndarray or float, optional
        The upper limit of a fit that starts at ``upper`` or above; None leaves that.
    unit : ndarray or float
        Size of a typical change, for ``"identity"``.
    origin : ndarray or float
        A typical value, for ``"identity"``.
    fixed : bool or ndarray of bool
        Whether it stays where it starts; an array of its shape says so of each entry.
    """

    name: str
    start: np.ndarray
    transform: Literal["identity", "log"] = "identity"
    lower: np.ndarray | float = -np.inf
    upper: np.ndarray | float = np.inf
    unit: np.ndarray | float = 1.0
    origin: np.ndarray | float = 0.0
    fixed: bool | np.ndarray = False
    widest: np.ndarray | float | None = None

    @property
    def free(self) -> np.ndarray:
        """Which of its entries move, flat."""
        return ~np.broadcast_to(self.fixed, self.start.shape).ravel()

    def coordinate(self, value: np.ndarray | float) -> np.ndarray:
        """The optimiser's coordinates of a value, flat."""
        value = np.broadcast_to(value, self.start.shape)
        if self.transform == "log":
            with np.errstate(divide="ignore"):
                return np.log(np.maximum(value, 0.0)).ravel()
        return ((value - self.origin) / self.unit).ravel()

    def value_limits(self) -> np.ndarray:
        """Limits of each entry, (size, 2), in the parameter's own units: the widest."""
        limits = self.lower, self.upper if self.widest is None else self.widest
        return np.column_stack([np.ravel(np.broadcast_to(limit, self.start.shape)) for limit in limits])

    def value(self, coordinate: np.ndarray) -> np.ndarray:
        """The value at a coordinate of the parameter's shape."""
        return np.exp(coordinate) if self.transform == "log" else self.origin + coordinate * self.unit


def _shape(values: Values, name: str) -> tuple[int, ...] | None:
    return values[name].shape if name in values else None


class ParameterTable:
    """Parameters in a fixed order; the free ones make up the flat vector that an optimiser moves.

    Parameters
    ----------
    parameters : sequence of Parameter
        With distinct names.
    """

    def __init__(self, parameters: Sequence[Parameter]):
        self.parameters = tuple(parameters)
        self._slices: dict[str, slice] = {}
        end = 0
        # For parameters of which only some entries move.
        self._free: dict[str, np.ndarray] = {}
        for parameter in self.parameters:
            free = parameter.free
            if free.any():
                self._slices[parameter.name] = slice(end, end + int(free.sum()))
                end += int(free.sum())
                if not free.all():
                    self._free[parameter.name] = free
        self.size = end

    def __getitem__(self, name: str) -> Parameter:
        return next(parameter for parameter in self.parameters if parameter.name == name)

    def started_at(self, values: Values) -> ParameterTable:
        """The same table with other starts, for what is free of the parameters whose shapes agree.

        Upper limits where these start become the widest.
        """
        table = self.widened(self.held(values))
        return ParameterTable(
            [
                replace(parameter, start=np.where(parameter.fixed, parameter.start, values[parameter.name]))
                if _shape(values, parameter.name) == parameter.start.shape
                else parameter
                for parameter in table.parameters
            ]
        )

    def held(self, values: Values) -> tuple[str, ...]:
        """Parameters of which free values are at an upper limit that is not the widest, or above."""
        return tuple(
            own.name
            for own in self.parameters
            if own.widest is not None
            and _shape(values, own.name) == own.start.shape
            and (np.ravel(values[own.name] >= (1.0 - _AT_LIMIT) * own.upper) & own.free).any()
        )

    def widened(self, names: Iterable[str]) -> ParameterTable:
        """The same table with the widest limits of some parameters."""
        return ParameterTable(
            [
                replace(own, upper=own.widest, widest=None) if own.widest is not None and own.name in names else own
                for own in self.parameters
            ]
        )

    def with_start(self, name: str, start: np.ndarray) -> ParameterTable:
        """The same table with another start of a parameter, perhaps of another shape."""
        return ParameterTable([replace(own, start=start) if own.name == name else own for own in self.parameters])

    def without(self, name: str) -> ParameterTable:
        """The same table without a parameter."""
        return ParameterTable([own for own in self.parameters if own.name != name])

    def with_fixed(self, name: str) -> ParameterTable:
        """The same table with a parameter that stays where it starts."""
        return ParameterTable([replace(own, fixed=True if own.name == name else own.fixed) for own in self.parameters])

    def start(self) -> np.ndarray:
        """The flat vector (size,) of the starts, put inside their limits."""
        flat = self.flat({parameter.name: parameter.coordinate(parameter.start) for parameter in self.parameters})
        return np.clip(flat, *self.limits())

    def values_at_start(self) -> Values:
        """The values by name where the optimiser starts."""
        return self.values(self.start())

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limits (size,) of the flat vector."""
        lower = self.flat({parameter.name: parameter.coordinate(parameter.lower) for parameter in self.parameters})
        upper = self.flat({parameter.name: parameter.coordinate(parameter.upper) for parameter in self.parameters})
        return lower, upper

    def alike(self) -> np.ndarray:
        """An integer (size,) for each coordinate, the same for those of one column of a parameter of three axes."""
        kinds, n_kinds = {}, 0
        for parameter in self.parameters:
            shape = parameter.start.shape
            n_own = shape[2] if len(shape) == 3 else parameter.start.size
            kinds[parameter.name] = n_kinds + np.arange(parameter.start.size) % max(n_own, 1)
            n_kinds += n_own
        return self.flat(kinds).astype(int)

    def coordinates(self, flat: Any) -> dict[str, Any]:
        """The coordinates by name, each in its parameter's shape; can be traced by autograd."""
        found = {}
        for parameter in self.parameters:
            name = parameter.name
            if name in self._free:
                free, first = self._free[name], self._slices[name].start
                # What a fixed entry takes from the vector is thrown away.
                source = first + np.maximum(np.cumsum(free) - 1, 0)
                part = anp.where(free, flat[source], parameter.coordinate(parameter.start))
            elif name in self._slices:
                part = flat[self._slices[name]]
            else:
                part = parameter.coordinate(parameter.start)
            found[name] = part.reshape(parameter.start.shape)
        return found

    def values(self, flat: np.ndarray) -> Values:
        """The values by name, in the parameters' own units."""
        coordinates = self.coordinates(flat)
        return {parameter.name: parameter.value(coordinates[parameter.name]) for parameter in self.parameters}

    def gradient(self, bars: dict[str, np.ndarray]) -> np.ndarray:
        """The flat gradient (size,), from those in the values, or in their logarithms where these are what moves."""
        return self.flat(
            {own.name: bars[own.name] * (own.unit if own.transform == "identity" else 1.0) for own in self.parameters}
        )

    def flat(self, parts: dict[str, np.ndarray]) -> np.ndarray:
        """Join the free parameters' parts (coordinates or gradients in them) into a vector (size,)."""
        if not self._slices:
            return np.empty(0)
        return np.concatenate(
            [
                np.ravel(parts[name])[self._free[name]] if name in self._free else np.ravel(parts[name])
                for name in self._slices
            ]
        )
