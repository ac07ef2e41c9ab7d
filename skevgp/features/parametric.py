"""Features from a user's function h(x; θ) with parameters that the regressors learn."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal

import autograd.numpy as anp
import numpy as np
from autograd import make_jvp
from numpy.typing import ArrayLike
from sklearn.base import TransformerMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ..exceptions import ignored
from ..utils.sklearn import StrOptions, check_feature_names_in, fit_context
from ..utils.state import StatefulEstimator
from .theta import Prior, check_prior

# The function is tried at so many prior standard deviations of each parameter, on so many rows.
_EDGE, _TRIED_ROWS = 3.0, 64
# Step of central differences of fourth order, in prior standard deviations: errors are about 1e-11 of the values.
_STEP = 1e-3


class _Symbol(np.ndarray):
    """A symbol as an array without axes. Functions of it are such arrays too, and not symbols as NumPy has them."""

    @classmethod
    def of(cls, symbol: Any) -> _Symbol:
        found = np.empty((), dtype=object)
        found[()] = symbol
        return found.view(cls)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        plain = (own.view(np.ndarray) if isinstance(own, _Symbol) else own for own in inputs)
        found = getattr(ufunc, method)(*plain, **kwargs)
        return found if isinstance(found, np.ndarray) else _Symbol.of(found)


class ParametricFeatures(TransformerMixin, StatefulEstimator):
    """Features h(x; θ) from a function, with parameters θ that a regressor learns.

    Use it as the ``feature_map`` of `EVGPRegressor` or `EGPRegressor` for physics that is not linear in an unknown
    number. Examples are a length, a Stribeck velocity, a time constant, or the input of a simulator. The regressor
    learns θ together with the weights β, kernel and noise. Its ``theta_`` and ``theta_std_`` are medians and standard
    deviations of the posterior. See :doc:`/guide/parameters`.

    Parameters
    ----------
    function : callable
        Function in autograd.numpy: ``function(X, **theta)`` -> features of shape (n_samples,), (n_samples, n_h) or
        (n_samples, n_outputs, n_h). X is an array. Each row of the result must depend on its own row of X only.
    parameters : dict of str to `Normal`, `LogNormal` or `Uniform`
        Prior of each parameter, in the units of the parameter. Each argument of ``function`` without a default needs
        one.
    units : dict of str to str, default=None
        Units of the parameters for `summary`, such as ``{"length": "m"}``.
    derivatives : {"autograd", "differences"}, default="autograd"
        Method for derivatives in θ and x. Use ``"differences"`` if autograd cannot trace ``function``, such as a
        simulator in C. Differences need four more calls per parameter.

    Attributes
    ----------
    theta_ : dict of str to float
        Values that ``transform`` uses. `fit` sets the prior medians, and a regressor sets the posterior medians in its
        ``feature_map_``.
    n_features_in_ : int
        Number of columns of X.

    Raises
    ------
    ValueError, TypeError
        `fit` raises an error if a parameter has no prior, or is unknown to ``function``. It also raises one if
        ``function`` returns numbers that are not finite, or changes its shape, within three prior standard deviations.

    See Also
    --------
    skevgp.CoefPrior : Prior of the weights β. ``CoefPrior(mean=1.0, scale=0.0)`` fixes them at 1, for a simulator.

    Examples
    --------
    The period of a wave is between 1 and 3:

    >>> import autograd.numpy as np
    >>> from skevgp import EVGPRegressor
    >>> from skevgp.features import ParametricFeatures, Uniform
    >>> def wave(X, period):
    ...     return np.sin(2 * np.pi * X / period)
    >>> X = np.linspace(0.0, 5.0, 60).reshape(-1, 1)
    >>> y = 2.0 * np.sin(2 * np.pi * X[:, 0] / 1.8) + np.random.default_rng(0).normal(0.0, 0.1, 60)
    >>> features = ParametricFeatures(wave, {"period": Uniform(1.0, 3.0)}, units={"period": "s"})
    >>> model = EVGPRegressor(features, n_inducing=20, random_state=0).fit(X, y)
    >>> round(model.theta_["period"], 2)
    1.8
    """

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        "function": [callable],
        "parameters": [dict],
        "units": [dict, None],
        "derivatives": [StrOptions({"autograd", "differences"})],
    }

    def __init__(
        self,
        function: Callable[..., Any],
        parameters: Mapping[str, Prior],
        units: Mapping[str, str] | None = None,
        derivatives: Literal["autograd", "differences"] = "autograd",
    ):
        self.function = function
        self.parameters = parameters
        self.units = units
        self.derivatives = derivatives

    @fit_context(prefer_skip_nested_validation=True)
    def fit(self, X: ArrayLike, y: Any = None) -> ParametricFeatures:
        """Set the parameters to their prior medians, and try the function on some rows.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows.
        y : Ignored
            It is not used.

        Returns
        -------
        self : ParametricFeatures
            The transformer itself.
        """
        rows: np.ndarray = validate_data(self, X, dtype=np.float64)
        self._check_parameters()
        self.set_theta({name: prior.value(0.0) for name, prior in self.parameters.items()})
        self._try(rows[np.unique(np.linspace(0, len(rows) - 1, _TRIED_ROWS).astype(int))])
        return self

    def transform(self, X: ArrayLike) -> np.ndarray:
        """Compute the features at ``theta_``.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows.

        Returns
        -------
        features : ndarray of shape (n_samples, n_h) or (n_samples, n_outputs, n_h)
            Features h(x; θ).
        """
        check_is_fitted(self)
        return self._values(validate_data(self, X, dtype=np.float64, reset=False))

    def get_feature_names_out(self, input_features: Any = None) -> np.ndarray:
        """Name the features after the function.

        Parameters
        ----------
        input_features : array-like of str or None, default=None
            Names of the columns of X. They must be those of `fit`.

        Returns
        -------
        names : ndarray of str of shape (n_h,)
            Name of the function, with a number if there are several features.
        """
        check_is_fitted(self)
        check_feature_names_in(self, input_features)
        name = getattr(self.function, "__name__", "h").strip("<>")
        return np.array([name] if self._width == 1 else [f"{name}{i}" for i in range(self._width)], dtype=object)

    # --- parameters (see `features.theta`) ----------------------------------------------------------------------------

    def theta_prior(self) -> dict[str, Prior]:
        """Return the prior of each parameter.

        Returns
        -------
        priors : dict of str to prior
            The argument ``parameters``.
        """
        return dict(self.parameters)

    def set_theta(self, theta: Mapping[str, float]) -> None:
        """Set the parameters.

        Parameters
        ----------
        theta : dict of str to float
            Value of each parameter.
        """
        self.theta_ = {name: float(theta[name]) for name in self.parameters}

    def theta_jacobian(self, X: np.ndarray) -> np.ndarray:
        """Differentiate the features in the parameters at ``theta_``.

        Parameters
        ----------
        X : ndarray of shape (n_samples, n_features)
            Rows.

        Returns
        -------
        jacobian : ndarray of shape (n_samples, n_h, n_theta) or (n_samples, n_outputs, n_h, n_theta)
            Derivatives ∂h/∂θ, in the order of ``parameters``.
        """
        # Values of the parameters at which it is not finite are no optimum.
        with np.errstate(all="ignore"):
            return self._theta_jacobian(np.asarray(X, dtype=np.float64), list(self.parameters))

    def _theta_jacobian(self, X: np.ndarray, names: list[str]) -> np.ndarray:
        if self.derivatives == "differences":
            return np.stack([self._difference(X, name) for name in names], axis=-1)
        theta = np.array([self.theta_[name] for name in names])
        tangent = self._tangent(lambda theta: self._at(X, dict(zip(names, theta, strict=True))), theta)
        return np.stack([tangent(direction) for direction in np.eye(len(names))], axis=-1)

    def jacobian(self, X: ArrayLike) -> np.ndarray:
        """Differentiate the features in the columns of X at ``theta_``.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows.

        Returns
        -------
        jacobian : ndarray of shape (n_samples, n_h, n_features) or (n_samples, n_outputs, n_h, n_features)
            Derivatives ∂h/∂x.
        """
        check_is_fitted(self)
        return self._slopes(validate_data(self, X, dtype=np.float64, reset=False))

    # --- the function -------------------------------------------------------------------------------------------------

    def _slopes(self, X: np.ndarray) -> np.ndarray:
        if self.derivatives == "differences":
            step = np.cbrt(np.finfo(float).eps) * np.maximum(np.abs(X), 1.0)
            found = []
            for column in np.eye(X.shape[1]):
                there, back = X + step * column, X - step * column
                width = ((there - back) @ column).reshape(-1, *[1] * (self._ndim - 1))
                found.append((self._values(there) - self._values(back)) / width)
            return np.stack(found, axis=-1)
        # The rows are independent: moving one column of all rows at once gives its derivative in each row.
        tangent = self._tangent(lambda X: self._at(X, self.theta_), X)
        return np.stack([tangent(np.tile(column, (len(X), 1))) for column in np.eye(X.shape[1])], axis=-1)

    def _expressions(self, x: list[Any], theta: Mapping[str, Any]) -> list[list[Any]]:
        """The features of a row of symbols, for each output that has its own."""
        # Arrays of objects, also without axes: symbols alone would take over arithmetic with arrays.
        row, numbers = np.empty((1, len(x)), dtype=object), {}
        row[0] = x
        for name, symbol in theta.items():
            numbers[name] = _Symbol.of(symbol)
        found = np.asarray(self._at(row, numbers), dtype=object)[0]
        return found.tolist() if self._ndim == 3 else [found.tolist()]

    def _values(self, X: np.ndarray) -> np.ndarray:
        return np.asarray(self._at(X, self.theta_), dtype=np.float64)

    def _at(self, X: Any, theta: Mapping[str, Any]) -> Any:
        if type(X) is np.ndarray:
            # A function that writes into X would change the user's rows.
            X = X.view()
            X.flags.writeable = False
        values = self.function(X, **theta)
        if not hasattr(values, "ndim"):
            values = anp.array(values)
        return values.reshape(-1, 1) if values.ndim == 1 else values

    def _tangent(self, function: Callable[[Any], Any], at: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """The derivative of a function in a direction."""

        def along(direction: np.ndarray) -> np.ndarray:
            try:
                with ignored("Output seems independent"):
                    value, slope = make_jvp(function)(at)(direction)
            except Exception as error:
                raise ValueError(
                    f"autograd cannot differentiate {self!r}: {error} Write the function in autograd.numpy, or use "
                    'derivatives="differences".'
                ) from error
            # autograd returns a 0 without a shape if the function does not depend on its argument.
            return np.broadcast_to(np.asarray(slope, dtype=np.float64), np.shape(value))

        return along

    def _difference(self, X: np.ndarray, name: str) -> np.ndarray:
        """∂h/∂θ by central differences of fourth order in the prior's z."""
        prior = self.parameters[name]
        z, total = prior.coordinate(self.theta_[name]), np.zeros(1)
        for steps, weight in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
            moved = {**self.theta_, name: prior.value(z + steps * _STEP)}
            total = total + weight * np.asarray(self._at(X, moved), dtype=np.float64)
        return np.asarray(total / (12.0 * _STEP * max(prior.slope(z), np.finfo(float).tiny)))

    # --- checks -------------------------------------------------------------------------------------------------------

    def _check_parameters(self) -> None:
        if not self.parameters:
            raise ValueError("parameters is empty: a function without parameters is a FunctionTransformer.")
        for name, prior in self.parameters.items():
            check_prior(prior, name)
        if others := [name for name in self.units or {} if name not in self.parameters]:
            raise ValueError(f"units={self.units!r} names {others}, which are no parameters.")
        try:
            own = list(inspect.signature(self.function).parameters.values())[1:]
        except (TypeError, ValueError):
            return
        names = {one.name for one in own if one.kind in (one.KEYWORD_ONLY, one.POSITIONAL_OR_KEYWORD)}
        open_ended = any(one.kind == one.VAR_KEYWORD for one in own)
        for one in own:
            if one.name in names and one.default is one.empty and one.name not in self.parameters:
                check_prior(None, one.name)
        unknown = [name for name in self.parameters if name not in names]
        if unknown and not open_ended:
            raise ValueError(
                f"The function {self.function!r} has no parameters {unknown}; those that can be passed by name are "
                f"{sorted(names)}."
            )

    def _try(self, X: np.ndarray) -> None:
        """Raise a ValueError unless the function returns finite numbers of one shape over the prior."""
        medians, shape = self.theta_, None
        self._width, self._ndim = 0, 2
        edges = [(name, edge) for name in self.parameters for edge in (0.0, -_EDGE, _EDGE)]
        for name, edge in edges:
            value = self.parameters[name].value(edge)
            told = f"The function {self.function!r} of ParametricFeatures, with {name}={value:.6g}"
            found = self.function(X, **{**medians, name: value})
            found = np.asarray(found, dtype=np.float64)
            if found.ndim not in (1, 2, 3) or len(found) != len(X):
                raise ValueError(
                    f"{told}, must return a row for each row of X, (n_samples, n_h); for {len(X)} rows it returned "
                    f"the shape {found.shape}."
                )
            if shape is not None and found.shape != shape:
                raise ValueError(f"{told}, returned the shape {found.shape}, but {shape} at the prior medians.")
            if not np.isfinite(found).all():
                raise ValueError(f"{told}, returned NaN or infinity. Give {name} a narrower prior.")
            shape = found.shape
        assert shape is not None
        self._width, self._ndim = (1, 2) if len(shape) == 1 else (shape[-1], len(shape))
        slopes = self.theta_jacobian(X)
        for index, name in enumerate(self.parameters):
            if not np.isfinite(slopes[..., index]).all():
                raise ValueError(
                    f"The derivative of the function {self.function!r} of ParametricFeatures in {name} is NaN or "
                    f"infinite at its prior median, {name}={medians[name]:.6g}. Change the function there, or "
                    'use derivatives="differences".'
                )
