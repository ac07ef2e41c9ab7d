"""Covariances that users write as functions in autograd.numpy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import autograd.numpy as anp
import numpy as np
from autograd import make_vjp

from .covariances import Covariance, CovarianceAt, PerRow, Pull, Sums

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
    centre : ndarray of shape (d,), default=None
        What has been subtracted from the inputs.
    """

    function: Callable[..., Any]
    names: tuple[str, ...]
    diagonal: Callable[..., Any] | None = None
    centre: np.ndarray | None = field(default=None, compare=False)
    stationary = False

    @property
    def n_hyperparameters(self) -> int:
        return len(self.names)

    def seen_from(self, centre: np.ndarray) -> Function:
        return replace(self, centre=centre)

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
            found = self.function(X, Z, **self._arguments(hyperparameters))
        return self._checked(self.function, found, (len(X), len(Z)))

    def diagonal_values(self, hyperparameters: Any, X: Any) -> Any:
        """k(x, x) of each row, (len(X),), at log hyperparameters."""
        if self.diagonal is None:
            chunks: Iterator[Any] = (X[first : first + _CHUNK] for first in range(0, len(X), _CHUNK))
            return anp.concatenate([anp.diag(self.values(hyperparameters, chunk, chunk)) for chunk in chunks])
        with np.errstate(all="ignore"):
            found = self.diagonal(X, **self._arguments(hyperparameters))
        return self._checked(self.diagonal, found, (len(X),))

    def pulled_back(self, function: Callable[[Any], Any], argument: Any, bar: np.ndarray) -> Any:
        """The gradient in the argument, given that in the function's value.

        Raises
        ------
        ValueError
            If autograd cannot trace the function.
        """
        try:
            with np.errstate(all="ignore"):
                return make_vjp(function)(argument)[0](bar)
        except (TypeError, ValueError, AttributeError, NotImplementedError, IndexError) as error:
            raise ValueError(
                f"{name_of(self.function)} cannot be traced by autograd: write it with autograd.numpy in place of "
                f"numpy. ({type(error).__name__}: {error})"
            ) from error

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
        self._centre = 0.0 if covariance.centre is None else covariance.centre
        self._points = inducing_points + self._centre

    def matrix(self) -> np.ndarray:
        return self._number(self.covariance.values(self.hyperparameters, self._points, self._points))

    def cross(self, prepared: np.ndarray) -> np.ndarray:
        return self._number(self.covariance.values(self.hyperparameters, self._points, self._rows(prepared)))

    def diagonal(self, prepared: np.ndarray) -> np.ndarray:
        return self._number(self.covariance.diagonal_values(self.hyperparameters, self._rows(prepared)))

    def start_pullback(self) -> Sums:
        return Sums((np.zeros_like(self.hyperparameters), np.zeros_like(self.inducing_points)))

    def linearised(self, prepared: np.ndarray) -> tuple[np.ndarray, Pull]:
        return self.cross(prepared), lambda *bars: self._pull(prepared, *bars)

    def cross_pullback(self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        return self._pull(prepared, U_bar, diagonal_bar)

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hyper_bar, points_bar = self.covariance.pulled_back(
            lambda at: self.covariance.values(at[0], at[1], at[1]), (self.hyperparameters, self._points), K_bar
        )
        return total[0] + hyper_bar, total[1] + points_bar

    def _pull(self, prepared: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        X, covariance = self._rows(prepared), self.covariance
        cross_bar = covariance.pulled_back(
            lambda at: covariance.values(at[0], at[1], X), (self.hyperparameters, self._points), U_bar
        )
        if not covariance.names:
            return Sums(cross_bar)
        # Autograd warns of a diagonal that does not depend on the hyperparameters, as are many: it shall seem to.
        hyper_bar = covariance.pulled_back(
            lambda hyper: covariance.diagonal_values(hyper, X) + 0.0 * hyper[0],
            self.hyperparameters,
            np.broadcast_to(diagonal_bar, len(X)),
        )
        return Sums((cross_bar[0] + hyper_bar, cross_bar[1]))

    def _rows(self, prepared: np.ndarray) -> np.ndarray:
        d = self.inducing_points.shape[1]
        return np.ascontiguousarray((prepared[:d].T) + self._centre)

    @staticmethod
    def _number(found: Any) -> np.ndarray:
        return np.asarray(found, dtype=float)


def name_of(function: Callable[..., Any]) -> str:
    """What a message calls a function."""
    return str(getattr(function, "__name__", repr(function)))
