"""A user's own covariance, a function in autograd.numpy, as a scikit-learn kernel."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any, Self

import numpy as np
from autograd import make_jvp
from sklearn.gaussian_process import kernels as sk

from .traced import Function, name_of


class FunctionKernel(sk.Kernel):
    """A covariance written as a function in autograd.numpy.

    It works in `EVGPRegressor`, in scikit-learn's GaussianProcessRegressor, and in sums and products with other
    kernels.

    Parameters
    ----------
    function : callable
        ``function(X, Z, **hyperparameters)`` -> array of shape (len(X), len(Z)), in autograd.numpy: symmetric and
        positive semi-definite. Its parameters with a float as default are the hyperparameters; all are positive, and
        start there. Other defaults (integers, strings) stay as they are.
    values : dict of str to float, default=None
        Where hyperparameters start, if not at their defaults.
    values_bounds : pair of floats, "fixed", or dict of str to either, default=(1e-5, 1e5)
        Bounds of all hyperparameters, or of those named (the others then have the default).
    diagonal : callable, default=None
        ``diagonal(X, **hyperparameters)`` -> k(x, x) of each row, (len(X),), in autograd.numpy. None takes it from
        ``function`` in chunks of rows, which takes longer.

    Attributes
    ----------
    hyperparameters : list of Hyperparameter
        In the order of the function's parameters.

    Raises
    ------
    ValueError
        When used: if a default is not positive, a name is unknown or taken, the function returns another shape or
        numbers that are not finite, or autograd cannot trace it.

    Examples
    --------
    A wave whose size grows with x:

    >>> import autograd.numpy as np
    >>> from sklearn.gaussian_process.kernels import ConstantKernel
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.kernels import FunctionKernel
    >>> def growing(X, Z, period=2.0):
    ...     return X @ Z.T * np.cos(2 * np.pi * (X - Z.T) / period)
    >>> kernel = ConstantKernel() * FunctionKernel(growing)
    >>> kernel
    1**2 * FunctionKernel(growing, period=2)
    >>> X = np.linspace(0, 6, 60).reshape(-1, 1)
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
        """The arguments of the constructor and, if ``deep``, the hyperparameters by name.

        Parameters
        ----------
        deep : bool, default=True
            Whether the hyperparameters are among them.

        Returns
        -------
        params : dict
            Each by its name.
        """
        params = super().get_params(deep=False)
        return {**params, **self._values()} if deep else params

    def set_params(self, **params: Any) -> Self:
        """Set arguments of the constructor, or hyperparameters by name.

        Parameters
        ----------
        **params : dict
            Each by its name.

        Returns
        -------
        self : object
            This kernel.
        """
        names = self._defaults()
        super().set_params(**{name: value for name, value in params.items() if name not in names})
        own = {name: float(params[name]) for name in names if name in params}
        if own:
            self.values = {**(self.values or {}), **own}
        return self

    def __sklearn_clone__(self) -> Self:
        # The same functions, not copies of them: a clone is then the same covariance, from which a fit can go on.
        return type(self)(self.function, deepcopy(self.values), deepcopy(self.values_bounds), self.diagonal)

    @property
    def hyperparameters(self) -> list[sk.Hyperparameter]:
        """Name and bounds of each hyperparameter."""
        return [sk.Hyperparameter(name, "numeric", self._bounds(name)) for name in self._values()]

    def covariance(self) -> Function:
        """What the inference differentiates.

        Returns
        -------
        covariance : Function
            Of the hyperparameters' logarithms.
        """
        return Function(self.function, tuple(self._values()), self.diagonal)

    def __call__(self, X: Any, Y: Any = None, eval_gradient: bool = False) -> Any:
        """The matrix k(X, Y), and its gradient in the free logarithms of the hyperparameters.

        Parameters
        ----------
        X : array-like of shape (n, d)
        Y : array-like of shape (m, d), default=None
            None means X.
        eval_gradient : bool, default=False
            Only if Y is None.

        Returns
        -------
        K : ndarray of shape (n, m)
        K_gradient : ndarray of shape (n, n, n_dims)
            If ``eval_gradient``.
        """
        X = np.atleast_2d(X)
        if Y is not None and eval_gradient:
            raise ValueError("Gradient can only be evaluated when Y is None.")
        Z = X if Y is None else np.atleast_2d(Y)
        covariance, start = self.covariance(), self._log_values()
        K = np.asarray(covariance.values(start, X, Z), dtype=float)
        if not np.isfinite(K).all():
            raise ValueError(f"{name_of(self.function)} returned numbers that are not finite.")
        if not eval_gradient:
            return K
        jvp = make_jvp(lambda hyper: covariance.values(hyper, X, X))(start)
        free = np.array([not hyperparameter.fixed for hyperparameter in self.hyperparameters], dtype=bool)
        gradient = [jvp(direction)[1] for direction in np.eye(len(start))[free]]
        return K, np.stack(gradient, axis=2) if gradient else np.empty((*K.shape, 0))

    def diag(self, X: Any) -> np.ndarray:
        """The variance k(x, x) of each row.

        Parameters
        ----------
        X : array-like of shape (n, d)
            The rows.

        Returns
        -------
        diagonal : ndarray of shape (n,)
            One number of each row.
        """
        return np.asarray(self.covariance().diagonal_values(self._log_values(), np.atleast_2d(X)), dtype=float)

    def is_stationary(self) -> bool:
        """Whether it depends on differences of inputs only: not known, so no.

        Returns
        -------
        stationary : bool
            False.
        """
        return False

    def __repr__(self) -> str:
        values = (f"{name}={value:.3g}" for name, value in self._values().items())
        return f"{type(self).__name__}({', '.join([name_of(self.function), *values])})"

    def _defaults(self) -> dict[str, float]:
        """The function's parameters with a float as default."""
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

    def _log_values(self) -> np.ndarray:
        return np.log(np.array(list(self._values().values()), dtype=float))

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
