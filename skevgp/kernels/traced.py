"""A covariance that is a user's own function in autograd.numpy, as the inference sees it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import autograd.numpy as anp
import numpy as np
from autograd import make_jvp, make_vjp

from .covariances import Covariance, CovarianceAt, PerRow, Pull, Sums, as_they_are

# k(x, x) of this many rows is the diagonal of one matrix, where the user has no function for it: fewer calls of the
# user's function against fewer numbers that are thrown away.
_CHUNK = 128


@dataclass(frozen=True)
class Function(Covariance):
    """k̃(x, x') = function(X, X', **hyperparameters); its gradients come from autograd.

    Parameters
    ----------
    function : callable
        function(X, Z, **hyperparameters) -> (len(X), len(Z)), in autograd.numpy.
    names : tuple of str
        Of the hyperparameters.
    diagonal : callable, default=None
        diagonal(X, **hyperparameters) -> (len(X),), in autograd.numpy.
    """

    function: Callable[..., Any]
    names: tuple[str, ...]
    diagonal: Callable[..., Any] | None = None
    preparations = (as_they_are,)

    @classmethod
    def of(cls, kernel: Any, n_columns: int) -> Function:
        """The covariance of a `FunctionKernel`."""
        return kernel.covariance()

    @property
    def n_hyperparameters(self) -> int:
        return len(self.names)

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        shape = np.broadcast_shapes(inputs.shape, others.shape)
        inputs, others = (np.broadcast_to(rows, shape).reshape(-1, shape[-1]) for rows in (inputs, others))
        found = np.empty(len(inputs))
        for first in range(0, len(inputs), _CHUNK):
            own = slice(first, first + _CHUNK)
            found[own] = np.diagonal(self.values(hyperparameters, inputs[own], others[own]))
        return found.reshape(shape[:-1])

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> FunctionAt:
        return FunctionAt(self, hyperparameters, inducing_points)

    def values(self, hyperparameters: Any, X: Any, Z: Any) -> Any:
        """k(X, Z) of shape (len(X), len(Z)) at log hyperparameters.

        Raises
        ------
        ValueError
            If the function returns another shape.
        """
        # The optimiser looks at what is not finite.
        with np.errstate(all="ignore"):
            found = self.function(_own(X), _own(Z), **self._arguments(hyperparameters))
        return self._checked(self.function, found, (len(X), len(Z)))

    def diagonal_values(self, hyperparameters: Any, X: Any) -> Any:
        """k(x, x) of each row, (len(X),), at log hyperparameters."""
        if self.diagonal is None:
            chunks: Iterator[Any] = (X[first : first + _CHUNK] for first in range(0, len(X), _CHUNK))
            return anp.concatenate([anp.diag(self.values(hyperparameters, chunk, chunk)) for chunk in chunks])
        with np.errstate(all="ignore"):
            found = self.diagonal(_own(X), **self._arguments(hyperparameters))
        return self._checked(self.diagonal, found, (len(X),))

    def pulled_back(self, function: Callable[[Any], Any], argument: Any, bar: np.ndarray) -> Any:
        """The gradient in the argument, given that in the function's value.

        Raises
        ------
        ValueError
            If autograd cannot trace the function.
        """
        return self._traced(lambda: make_vjp(function)(argument)[0](bar))

    def _traced(self, differentiate: Callable[[], Any]) -> Any:
        try:
            with np.errstate(all="ignore"):
                return differentiate()
        except (TypeError, ValueError, AttributeError, NotImplementedError, IndexError) as error:
            raise ValueError(
                f"{name_of(self.function)} cannot be traced by autograd: write it with autograd.numpy in place of "
                f"numpy. ({type(error).__name__}: {error})"
            ) from error

    def along(self, function: Callable[[Any], Any], rows: Any, column: int) -> Any:
        """The derivative of function(rows) in one column of all rows.

        Raises
        ------
        ValueError
            If autograd cannot trace the function, or knows no forward derivative of a part of it.
        """
        direction = np.zeros(np.shape(rows))
        direction[:, column] = 1.0
        return self._traced(lambda: make_jvp(function)(rows)(direction)[1])

    def _arguments(self, hyperparameters: Any) -> dict[str, Any]:
        return {name: anp.exp(hyperparameters[index]) for index, name in enumerate(self.names)}

    @staticmethod
    def _checked(function: Callable[..., Any], found: Any, shape: tuple[int, ...]) -> Any:
        if np.shape(found) != shape:
            raise ValueError(f"{name_of(function)} must return an array of shape {shape}; it has {np.shape(found)}.")
        return found


class FunctionAt(CovarianceAt):
    """A `Function` with hyperparameters and inducing points (m, d) put in."""

    def __init__(self, covariance: Function, hyperparameters: np.ndarray, inducing_points: np.ndarray):
        self.covariance, self.hyperparameters, self.inducing_points = covariance, hyperparameters, inducing_points

    def matrix(self) -> np.ndarray:
        return self._number(self.covariance.values(self.hyperparameters, self.inducing_points, self.inducing_points))

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        return self._number(self.covariance.values(self.hyperparameters, self.inducing_points, prepared))

    def diagonal(self, prepared: np.ndarray) -> np.ndarray:
        return self._number(self.covariance.diagonal_values(self.hyperparameters, prepared))

    def slopes(self, prepared: np.ndarray) -> np.ndarray:
        covariance = self.covariance

        def values(X: Any) -> Any:
            return covariance.values(self.hyperparameters, self.inducing_points, X)

        return np.stack([covariance.along(values, prepared, column) for column in range(prepared.shape[1])], axis=2)

    def diagonal_slopes(self, prepared: np.ndarray) -> np.ndarray:
        covariance = self.covariance
        return covariance.pulled_back(
            lambda X: covariance.diagonal_values(self.hyperparameters, X) + 0.0 * X[:, 0],
            prepared,
            np.ones(len(prepared)),
        )

    def mixed_slopes(self, prepared: np.ndarray) -> np.ndarray:
        covariance, chunks = self.covariance, range(0, len(prepared), _CHUNK)

        def of(rows: np.ndarray, column: int) -> np.ndarray:
            def slope(X: Any) -> Any:
                values = partial(covariance.values, self.hyperparameters, X)
                return anp.diag(covariance.along(values, rows, column)) + 0.0 * X[:, 0]

            return covariance.pulled_back(slope, rows, np.ones(len(rows)))

        columns = range(prepared.shape[1])
        each = [np.stack([of(prepared[i : i + _CHUNK], column) for column in columns], axis=2) for i in chunks]
        return np.concatenate(each)

    def start_pullback(self) -> Sums:
        return Sums((np.zeros_like(self.hyperparameters), np.zeros_like(self.inducing_points)))

    def linearised(self, prepared: np.ndarray) -> tuple[np.ndarray, Pull]:
        return self.cross(prepared), lambda *bars: self._pull(prepared, *bars)

    def cross_pullback(self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        return self._pull(prepared, U_bar, diagonal_bar)

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hyper_bar, points_bar = self.covariance.pulled_back(
            lambda at: self.covariance.values(at[0], at[1], at[1]), (self.hyperparameters, self.inducing_points), K_bar
        )
        return total[0] + hyper_bar, total[1] + points_bar

    def _pull(self, prepared: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        covariance = self.covariance
        cross_bar = covariance.pulled_back(
            lambda at: covariance.values(at[0], at[1], prepared), (self.hyperparameters, self.inducing_points), U_bar
        )
        if not covariance.names:
            return Sums(cross_bar)
        # Autograd warns of a diagonal that does not depend on the hyperparameters, as are many: it shall seem to.
        hyper_bar = covariance.pulled_back(
            lambda hyper: covariance.diagonal_values(hyper, prepared) + 0.0 * hyper[0],
            self.hyperparameters,
            np.broadcast_to(diagonal_bar, len(prepared)),
        )
        return Sums((cross_bar[0] + hyper_bar, cross_bar[1]))

    @staticmethod
    def _number(found: Any) -> np.ndarray:
        return np.asarray(found, dtype=float)


def _own(rows: Any) -> Any:
    """A copy of rows, which may be the user's data: a function of his may change what it gets."""
    return rows.copy() if isinstance(rows, np.ndarray) else rows


def name_of(function: Callable[..., Any]) -> str:
    """What a message calls a function."""
    return str(getattr(function, "__name__", repr(function)))
