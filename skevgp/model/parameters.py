"""Named parameters, their transforms and limits, and the flat vector that an optimiser moves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import autograd.numpy as anp
import numpy as np

# A value within this share of its upper limit is at the limit, up to rounding.
_AT_LIMIT = 1e-6

# Values of parameters by name.
Values = dict[str, np.ndarray]


@dataclass(frozen=True)
class Parameter:
    """A parameter with its start, transform and limits."""

    name: str
    # First value, in the parameter's own units. It has the parameter's shape.
    start: np.ndarray
    # The optimiser moves the coordinate (value - origin) / unit, or log(value).
    transform: Literal["identity", "log"] = "identity"
    # Limits of the value, broadcast to its shape.
    lower: np.ndarray | float = -np.inf
    upper: np.ndarray | float = np.inf
    # For "identity": the size of a typical change, and a typical value.
    unit: np.ndarray | float = 1.0
    origin: np.ndarray | float = 0.0
    # Whether the value stays where it starts, for all entries or for each.
    fixed: bool | np.ndarray = False
    # Upper limit of a fit that starts at ``upper`` or above. None: ``upper``.
    widest: np.ndarray | float | None = None

    @cached_property
    def free(self) -> np.ndarray:
        """Whether each entry moves, (size,)."""
        return ~np.broadcast_to(self.fixed, self.start.shape).ravel()

    def coordinate(self, value: np.ndarray | float) -> np.ndarray:
        """The optimiser's coordinates (size,) of a value."""
        value = np.broadcast_to(value, self.start.shape)
        if self.transform == "log":
            with np.errstate(divide="ignore"):
                return np.log(np.maximum(value, 0.0)).ravel()
        return ((value - self.origin) / self.unit).ravel()

    def value_limits(self) -> np.ndarray:
        """The widest limits (size, 2) of each entry, in the parameter's own units."""
        limits = np.empty((self.start.size, 2))
        for column, limit in enumerate((self.lower, self.upper if self.widest is None else self.widest)):
            limits[:, column] = np.ravel(np.broadcast_to(limit, self.start.shape))
        return limits


def log_prior(values: Values, gradient: Values | None = None, sign: float = 1.0) -> float:
    """The log prior density of the logarithms of ``coef_factors``, without its constant, times ``sign``.

    They are standard normal: a factor is e or 1/e at one standard deviation. The gradient is added to ``gradient``.
    """
    if "coef_factors" not in values:
        return 0.0
    logs = np.log(values["coef_factors"])
    if gradient is not None:
        gradient["coef_factors"] -= sign * logs
    return -0.5 * sign * float((logs**2).sum())


class ParameterTable:
    """Parameters with distinct names, in a fixed order. Their free entries make up the flat vector (size,)."""

    def __init__(self, parameters: Sequence[Parameter]):
        self.parameters = tuple(parameters)
        # The place of each parameter's free entries in the flat vector, and the coordinates where it starts.
        self._slices: dict[str, slice] = {}
        self._starts: dict[str, np.ndarray] = {}
        self.size = 0
        for parameter in self.parameters:
            end = self.size + int(parameter.free.sum())
            self._slices[parameter.name], self.size = slice(self.size, end), end
            self._starts[parameter.name] = parameter.coordinate(parameter.start)

    def __getitem__(self, name: str) -> Parameter:
        return next(parameter for parameter in self.parameters if parameter.name == name)

    # --- other tables with the same parameters ------------------------------------------------------------------------

    def changed(self, name: str, **fields: Any) -> ParameterTable:
        """The same table with other fields of one parameter, such as its start, perhaps of another shape."""
        return ParameterTable(
            [replace(parameter, **fields) if parameter.name == name else parameter for parameter in self.parameters]
        )

    def without(self, name: str) -> ParameterTable:
        """The same table without one parameter."""
        return ParameterTable([parameter for parameter in self.parameters if parameter.name != name])

    def started_at(self, values: Values) -> ParameterTable:
        """The same table with the free entries at other starts, for each parameter whose shape agrees.

        Where these starts are at an upper limit or above, the widest limit replaces it.
        """
        parameters = []
        for parameter in self.widened(self.held(values)).parameters:
            if parameter.name in values and values[parameter.name].shape == parameter.start.shape:
                parameter = replace(parameter, start=np.where(parameter.fixed, parameter.start, values[parameter.name]))
            parameters.append(parameter)
        return ParameterTable(parameters)

    def held(self, values: Values) -> tuple[str, ...]:
        """Names of parameters with free values at or above an upper limit that is not the widest."""
        names = []
        for parameter in self.parameters:
            if (
                parameter.widest is not None
                and parameter.name in values
                and values[parameter.name].shape == parameter.start.shape
            ):
                at_limit = values[parameter.name] >= (1.0 - _AT_LIMIT) * parameter.upper
                if (at_limit.ravel() & parameter.free).any():
                    names.append(parameter.name)
        return tuple(names)

    def widened(self, names: Iterable[str]) -> ParameterTable:
        """The same table with the widest limits of some parameters."""
        table = self
        for name in names:
            if (widest := self[name].widest) is not None:
                table = table.changed(name, upper=widest, widest=None)
        return table

    # --- values and the flat vector -----------------------------------------------------------------------------------

    def start(self) -> np.ndarray:
        """The flat vector (size,) of the starts, clipped to their limits."""
        return np.clip(self.flat(self._starts), *self.limits())

    def values_at_start(self) -> Values:
        """The values by name where the optimiser starts."""
        return self.values(self.start())

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limits (size,) of the flat vector."""
        lower = self.flat({parameter.name: parameter.coordinate(parameter.lower) for parameter in self.parameters})
        upper = self.flat({parameter.name: parameter.coordinate(parameter.upper) for parameter in self.parameters})
        return lower, upper

    def alike(self) -> np.ndarray:
        """An integer (size,) for each coordinate. Coordinates of one column of a parameter of three axes share it."""
        kinds, n_kinds = {}, 0
        for parameter in self.parameters:
            shape = parameter.start.shape
            n_own = shape[2] if len(shape) == 3 else parameter.start.size
            kinds[parameter.name] = n_kinds + np.arange(parameter.start.size) % max(n_own, 1)
            n_kinds += n_own
        return self.flat(kinds).astype(int)

    def coordinates(self, flat: Any) -> dict[str, Any]:
        """The coordinates by name, each in its parameter's shape. Autograd can trace this."""
        coordinates = {}
        for parameter in self.parameters:
            part = flat[self._slices[parameter.name]]
            if not parameter.free.any():
                part = self._starts[parameter.name]
            elif not parameter.free.all():
                # The k-th free entry is part[k].
                part = anp.where(parameter.free, part[np.cumsum(parameter.free) - 1], self._starts[parameter.name])
            coordinates[parameter.name] = part.reshape(parameter.start.shape)
        return coordinates

    def values(self, flat: np.ndarray) -> Values:
        """The values by name, in the parameters' own units."""
        values = self.coordinates(flat)
        for parameter in self.parameters:
            at = values[parameter.name]
            values[parameter.name] = (
                np.exp(at) if parameter.transform == "log" else parameter.origin + at * parameter.unit
            )
        return values

    def gradient(self, bars: Values) -> np.ndarray:
        """The gradient (size,) in the flat vector, from gradients in values or, for "log", in their logarithms."""
        units = {
            parameter.name: parameter.unit if parameter.transform == "identity" else 1.0
            for parameter in self.parameters
        }
        return self.flat({name: bars[name] * unit for name, unit in units.items()})

    def flat(self, parts: Values) -> np.ndarray:
        """The flat vector (size,) of coordinates by name, or of gradients in them."""
        return np.concatenate(
            [np.empty(0), *(np.ravel(parts[parameter.name])[parameter.free] for parameter in self.parameters)]
        )
