"""A user's covariance function in autograd.numpy, as a scikit-learn kernel and as a covariance."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import autograd.numpy as anp
import numpy as np
from autograd import make_jvp, make_vjp
from sklearn.gaussian_process import kernels as sk

from .base import Covariance, CovarianceAt, PerRow, Sums, as_they_are, reads

# Without a function for k(x, x), it is the diagonal of matrices of this many rows. More rows would need fewer calls of
# the user's function, but waste more numbers off the diagonal.
_CHUNK = 128


class FunctionKernel(sk.Kernel):
    """Covariance written as a function in autograd.numpy.

    The kernel works in `EVGPRegressor`, in scikit-learn's GaussianProcessRegressor, and in sums and products with other
    kernels.

    Parameters
    ----------
    function : callable
        Symmetric, positive semi-definite function in autograd.numpy: ``function(X, Z, **hyperparameters)`` -> array of
        shape (len(X), len(Z)). Parameters with a float as default are the hyperparameters. They are positive, and start
        at the default. Other defaults, such as integers and strings, are constants.
    values : dict of str to float, default=None
        Start values that replace the defaults of hyperparameters.
    values_bounds : pair of floats, "fixed", or dict of str to either, default=(1e-5, 1e5)
        Bounds of all hyperparameters, or of those named in a dict.
    diagonal : callable, default=None
        Function in autograd.numpy: ``diagonal(X, **hyperparameters)`` -> k(x, x) of each row, (len(X),). If None, it is
        computed from ``function``, which takes longer.

    Attributes
    ----------
    hyperparameters : list of Hyperparameter
        Hyperparameters in the order of the function's parameters.

    Raises
    ------
    ValueError
        Using the kernel raises an error if a default is not positive, or a name is unknown or taken. It also raises one
        if the function returns another shape or numbers that are not finite, or autograd cannot trace it.

    Examples
    --------
    A wave whose amplitude grows with x:

    >>> import autograd.numpy as np
    >>> from sklearn.gaussian_process.kernels import ConstantKernel
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.kernels import FunctionKernel
    >>> def growing(X, Z, period=2.0):
    ...     return X @ Z.T * np.cos(2 * np.pi * (X - Z.T) / period)
    >>> kernel = ConstantKernel() * FunctionKernel(growing)
    >>> kernel
    1**2 * FunctionKernel(growing, period=2)
    >>> X = np.linspace(0, 6, 40).reshape(-1, 1)
    >>> model = EVGPRegressor(kernel=kernel, n_inducing=10, random_state=0)
    >>> model.fit(X, X[:, 0] * np.sin(2 * np.pi * X[:, 0] / 1.8)).kernel_.k2
    FunctionKernel(growing, period=1.8)
    """

    def __init__(
        self,
        function: Callable[..., Any],
        values: Mapping[str, float] | None = None,
        values_bounds: Any = (1e-5, 1e5),
        diagonal: Callable[..., Any] | None = None,
    ):
        self.function = function
        self.values = values
        self.values_bounds = values_bounds
        self.diagonal = diagonal

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the arguments of the constructor and, if ``deep``, the hyperparameters.

        Parameters
        ----------
        deep : bool, default=True
            Whether to include the hyperparameters.

        Returns
        -------
        params : dict
            Values by name.
        """
        params = super().get_params(deep=False)
        return {**params, **self._values()} if deep else params

    def set_params(self, **params: Any) -> Self:
        """Set arguments of the constructor, or hyperparameters by name.

        Parameters
        ----------
        **params : dict
            Values by name.

        Returns
        -------
        self : object
            This kernel.
        """
        names = self._defaults()
        super().set_params(**{name: value for name, value in params.items() if name not in names})
        changed = {name: float(params[name]) for name in names if name in params}
        if changed:
            self.values = {**(self.values or {}), **changed}
        return self

    def __sklearn_clone__(self) -> Self:
        # Keep the same functions, so that the clone is an equal covariance and a fit can go on from it.
        return type(self)(self.function, deepcopy(self.values), deepcopy(self.values_bounds), self.diagonal)

    @property
    def hyperparameters(self) -> list[sk.Hyperparameter]:
        """Name and bounds of each hyperparameter."""
        return [sk.Hyperparameter(name, "numeric", self._bounds(name)) for name in self._values()]

    def covariance(self) -> Function:
        """Return the covariance that a fit differentiates.

        Returns
        -------
        covariance : Function
            A function of the values of the hyperparameters.
        """
        return Function(self.function, tuple(self._values()), self.diagonal)

    def __call__(self, X: Any, Y: Any = None, eval_gradient: bool = False) -> Any:
        """Return k(X, Y) (n, m), and if asked for its gradient (n, n, n_dims) in the free log hyperparameters."""
        X = np.atleast_2d(X)
        if Y is not None and eval_gradient:
            raise ValueError("Gradient can only be evaluated when Y is None.")
        Z = X if Y is None else np.atleast_2d(Y)
        covariance, values = self.covariance(), self._numbers()
        K = np.asarray(covariance.values(values, X, Z), dtype=float)
        if not np.isfinite(K).all():
            raise ValueError(f"{name_of(self.function)} returned numbers that are not finite.")
        if not eval_gradient:
            return K
        jvp = make_jvp(lambda hyper: covariance.values(hyper, X, X))(values)
        free = np.array([not hyperparameter.fixed for hyperparameter in self.hyperparameters], dtype=bool)
        # ∂/∂ log h = h ∂/∂h: the direction of a hyperparameter has the length of its value.
        gradient = [jvp(direction)[1] for direction in np.diag(values)[free]]
        return K, np.stack(gradient, axis=2) if gradient else np.empty((*K.shape, 0))

    def diag(self, X: Any) -> np.ndarray:
        """Return the variance k(x, x) of each row.

        Parameters
        ----------
        X : array-like of shape (n, d)
            Rows.

        Returns
        -------
        diagonal : ndarray of shape (n,)
            Variances.
        """
        return np.asarray(self.covariance().diagonal_values(self._numbers(), np.atleast_2d(X)), dtype=float)

    def is_stationary(self) -> bool:
        """Return False, because it is unknown whether the kernel depends on differences of inputs only.

        Returns
        -------
        stationary : bool
            Always False.
        """
        return False

    def __repr__(self) -> str:
        values = (f"{name}={value:.3g}" for name, value in self._values().items())
        return f"{type(self).__name__}({', '.join([name_of(self.function), *values])})"

    def _defaults(self) -> dict[str, float]:
        """Return the function's parameters with a float as default."""
        parameters = inspect.signature(self.function).parameters.values()
        defaults = {p.name: float(p.default) for p in parameters if isinstance(p.default, float)}
        taken = {"function", "values", "values_bounds", "diagonal"} & set(defaults)
        if taken:
            raise ValueError(f"{name_of(self.function)} needs other names for its hyperparameters {sorted(taken)}.")
        return defaults

    def _values(self) -> dict[str, float]:
        defaults = self._defaults()
        self._check_names(self.values or {}, "values")
        values = {**defaults, **(self.values or {})}
        wrong = {name: value for name, value in values.items() if not 0.0 < value < np.inf}
        if wrong:
            raise ValueError(f"Hyperparameters of {name_of(self.function)} must be positive; got {wrong}.")
        return values

    def _numbers(self) -> np.ndarray:
        return np.array(list(self._values().values()), dtype=float)

    def _bounds(self, name: str) -> Any:
        if not isinstance(self.values_bounds, Mapping):
            if not isinstance(self.values_bounds, str) and np.shape(self.values_bounds) != (2,):
                raise ValueError(
                    "values_bounds must be two numbers, the lower first, 'fixed', or a dict of parameter names to "
                    f"either; got {self.values_bounds!r}."
                )
            return self.values_bounds
        self._check_names(self.values_bounds, "values_bounds")
        bounds = self.values_bounds.get(name, (1e-5, 1e5))
        if not isinstance(bounds, str) and np.shape(bounds) != (2,):
            raise ValueError(
                f"values_bounds of {name!r} must be two numbers, the lower first, or 'fixed'; got {bounds!r}."
            )
        return bounds

    def _check_names(self, named: Mapping[str, Any], argument: str) -> None:
        unknown = sorted(set(named) - set(self._defaults()))
        if unknown:
            raise ValueError(
                f"{argument} names {unknown}; the hyperparameters of {name_of(self.function)} (its parameters with a "
                f"float as default) are {sorted(self._defaults())}."
            )


@dataclass(frozen=True)
class Function(Covariance):
    """k̃(x, x') = function(X, X', **hyperparameters), with gradients by autograd."""

    function: Callable[..., Any]  # function(X, Z, **hyperparameters) -> (len(X), len(Z))
    names: tuple[str, ...]  # of the hyperparameters
    diagonal: Callable[..., Any] | None = None  # diagonal(X, **hyperparameters) -> (len(X),)
    rows = staticmethod(as_they_are)

    @property
    def n_hyperparameters(self) -> int:
        return len(self.names)

    def paired(self, hyperparameters: np.ndarray, inputs: np.ndarray, others: np.ndarray) -> np.ndarray:
        shape = np.broadcast_shapes(inputs.shape, others.shape)
        inputs, others = (np.broadcast_to(rows, shape).reshape(-1, shape[-1]) for rows in (inputs, others))
        covariances = np.empty(len(inputs))
        for first in range(0, len(inputs), _CHUNK):
            chunk = slice(first, first + _CHUNK)
            covariances[chunk] = np.diagonal(self.values(hyperparameters, inputs[chunk], others[chunk]))
        return covariances.reshape(shape[:-1])

    def at(self, hyperparameters: np.ndarray, inducing_points: np.ndarray) -> FunctionAt:
        return FunctionAt(self, hyperparameters, inducing_points)

    def values(self, hyperparameters: Any, X: Any, Z: Any) -> Any:
        """Return k(X, Z), (len(X), len(Z)), at hyperparameters (n_hyper,); ValueError if it has another shape."""
        # The optimiser handles numbers that are not finite.
        with np.errstate(all="ignore"):
            K = self.function(_copied(X), _copied(Z), **self._arguments(hyperparameters))
        return self._checked(self.function, K, (len(X), len(Z)))

    def diagonal_values(self, hyperparameters: Any, X: Any) -> Any:
        """Return k(x, x) of each row, (len(X),), at hyperparameters (n_hyper,)."""
        if self.diagonal is None:
            chunks: Iterator[Any] = (X[first : first + _CHUNK] for first in range(0, len(X), _CHUNK))
            return anp.concatenate([anp.diag(self.values(hyperparameters, chunk, chunk)) for chunk in chunks])
        with np.errstate(all="ignore"):
            diagonal = self.diagonal(_copied(X), **self._arguments(hyperparameters))
        return self._checked(self.diagonal, diagonal, (len(X),))

    def pulled_back(self, function: Callable[[Any], Any], argument: Any, bar: np.ndarray) -> Any:
        """Return the gradient in the argument, given that in the value; ValueError if autograd fails."""
        return self._traced(lambda: make_vjp(function)(argument)[0](bar))

    def _traced(self, differentiate: Callable[[], Any]) -> Any:
        try:
            with np.errstate(all="ignore"):
                return differentiate()
        except (TypeError, ValueError, AttributeError, NotImplementedError, IndexError) as error:
            raise ValueError(
                f"{name_of(self.function)} cannot be traced by autograd. Write it with autograd.numpy instead of "
                f"numpy. ({type(error).__name__}: {error})"
            ) from error

    def along(self, function: Callable[[Any], Any], rows: Any, column: int) -> Any:
        """Return the derivative of function(rows) in one column of all rows; ValueError if autograd cannot trace it."""
        direction = np.zeros(np.shape(rows))
        direction[:, column] = 1.0
        return self._traced(lambda: make_jvp(function)(rows)(direction)[1])

    def _arguments(self, hyperparameters: Any) -> dict[str, Any]:
        return {name: hyperparameters[index] for index, name in enumerate(self.names)}

    @staticmethod
    def _checked(function: Callable[..., Any], values: Any, shape: tuple[int, ...]) -> Any:
        if np.shape(values) != shape:
            raise ValueError(f"{name_of(function)} must return an array of shape {shape}; it has {np.shape(values)}.")
        return values


class FunctionAt(CovarianceAt):
    """A `Function` at given hyperparameters and inducing points (m, d)."""

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
        slopes = [np.stack([of(prepared[i : i + _CHUNK], column) for column in columns], axis=2) for i in chunks]
        return np.concatenate(slopes)

    def start_pullback(self) -> Sums:
        return Sums((np.zeros_like(self.hyperparameters), np.zeros_like(self.inducing_points)))

    def cross_pullback(self, prepared: np.ndarray, U: np.ndarray, U_bar: np.ndarray, diagonal_bar: PerRow) -> Sums:
        covariance = self.covariance
        cross_bar = covariance.pulled_back(
            lambda at: covariance.values(at[0], at[1], prepared), (self.hyperparameters, self.inducing_points), U_bar
        )
        if not covariance.names:
            return Sums(cross_bar)
        # Autograd warns if the diagonal does not depend on the hyperparameters. Adding 0 times one of them avoids that.
        hyper_bar = covariance.pulled_back(
            lambda hyper: covariance.diagonal_values(hyper, prepared) + 0.0 * hyper[0],
            self.hyperparameters,
            np.broadcast_to(diagonal_bar, len(prepared)),
        )
        return Sums((cross_bar[0] + hyper_bar, cross_bar[1]))

    def finish_pullback(self, total: Sums, K_bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hyper_bar, points_bar = self.covariance.pulled_back(
            lambda at: self.covariance.values(at[0], at[1], at[1]), (self.hyperparameters, self.inducing_points), K_bar
        )
        # From gradients in the values to those in the logarithms: ∂/∂ log h = h ∂/∂h.
        return self.hyperparameters * (total[0] + hyper_bar), total[1] + points_bar

    @staticmethod
    def _number(value: Any) -> np.ndarray:
        return np.asarray(value, dtype=float)


def _copied(rows: Any) -> Any:
    """Copy rows that may be the user's data, because the user's function may change them."""
    return rows.copy() if isinstance(rows, np.ndarray) else rows


def name_of(function: Callable[..., Any]) -> str:
    """Return the name of a function for messages."""
    return str(getattr(function, "__name__", repr(function)))


@reads(FunctionKernel, in_casadi=False)
def function(kernel: FunctionKernel, n_columns: int) -> Function:
    """Return the covariance of a FunctionKernel."""
    return kernel.covariance()
