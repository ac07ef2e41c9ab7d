"""ResidualRegressor: learn the change of a state instead of the next state."""

from __future__ import annotations

from collections.abc import Callable
from numbers import Integral
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn import get_config
from sklearn.base import MetaEstimatorMixin, RegressorMixin, clone
from sklearn.utils import Bunch, Tags, get_tags
from sklearn.utils.metadata_routing import MetadataRouter, MethodMapping, process_routing
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted, validate_data

from ..control.posterior import Posterior, delegate
from ..data.dask import aligned, as_rows
from ..utils.sklearn import HasMethods, fit_context, safe_indexing
from ..utils.state import StatefulEstimator
from ..utils.validation import (
    FLOATS,
    as_floats,
    is_dask,
    is_frame,
    unchanged_if_it_fails,
    validate_frame,
    validate_numbers,
)


def regressor_has(method: str) -> Callable[[Any], bool]:
    """Return a check for `available_if`: whether the (fitted) regressor has a method."""

    def has(self: Any) -> bool:
        getattr(self.regressor_ if hasattr(self, "regressor_") else self.regressor, method)
        return True

    return has


def _delegate(name: str, takes: Literal["rows", "numbers"] | None = None) -> Any:
    """Delegate a method to the posterior of the sum, if the regressor has it."""
    return available_if(regressor_has(name))(delegate(name, takes))


def columns_of(X: Any, indices: np.ndarray, ndim: int = 2) -> np.ndarray:
    """Return columns of an array or a data frame as numbers, (n, len(indices)), or (n,) if ndim is 1."""
    if ndim == 1:
        return columns_of(X, indices)[:, 0]
    if not is_frame(X):
        return X[:, indices]
    columns = np.column_stack(
        [as_floats(safe_indexing(X, index, axis=1), f"Column {index} of X, a base,") for index in indices.tolist()]
    )
    if not np.isfinite(columns).all():
        raise ValueError("The base columns of X must be finite; they contain NaN or infinity.")
    return columns


class ResidualRegressor(MetaEstimatorMixin, RegressorMixin, StatefulEstimator):
    """Fit a regressor to the difference of y and some columns of X, and predict the sum.

    For x = (state, input) and y = next state, the regressor learns the change of the state. The paper calls this
    RES-VGP and RES-DBNN. The standard deviation of the sum is that of the change.

    Parameters
    ----------
    regressor : estimator
        Regressor that learns the difference. A clone is fitted to all columns of X. Scale columns and encode angles
        inside of the regressor, as in ``make_pipeline(AngleEncoder("cartpole"), BayesianMLPRegressor())``. Base columns
        then stay as they are.
    base : int, str or array-like of shape (n_outputs,), default=None
        Column of X that is subtracted from each output, by its index, or by its name in a data frame. If None, the
        first ``n_outputs`` columns are subtracted.

    Attributes
    ----------
    regressor_ : estimator
        Regressor fitted to ``y - X[:, base_]``.
    base_ : ndarray of shape (n_outputs,)
        Indices of the base columns.
    n_features_in_ : int
        Number of columns of X.
    feature_names_in_ : ndarray of str
        Names of the columns of X, if it has any.

    References
    ----------
    - D. L. Marino, M. Manic (2020): Physics Enhanced Data-Driven Models with Variational Gaussian Processes, section
      IV-B.

    Examples
    --------
    >>> from skevgp import EVGPRegressor, ResidualRegressor
    >>> from skevgp.datasets import make_toy
    >>> X, y = make_toy(random_state=0, return_X_y=True)
    >>> model = ResidualRegressor(EVGPRegressor(n_inducing=10, random_state=0)).fit(X, y)
    >>> mean, std = model.predict(X, return_std=True)
    >>> round(model.score(X, y), 2)
    0.96
    """

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        "regressor": [HasMethods(["fit", "predict"])],
        "base": ["array-like", Integral, str, None],
    }

    regressor_: Any
    base_: np.ndarray

    def __init__(self, regressor: Any, *, base: ArrayLike | None = None):
        self.regressor = regressor
        self.base = base

    @fit_context(prefer_skip_nested_validation=False)
    def fit(self, X: ArrayLike, y: ArrayLike, **params: Any) -> Self:
        """Fit a clone of the regressor to the difference of y and the base columns.

        Parameters
        ----------
        X : array-like or dask.array.Array of shape (n_samples, n_features)
            Rows. The regressor gets a data frame or a Dask array as given. Base columns must be numbers.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Targets in units of their base columns.
        **params : dict
            Arguments for ``fit`` of the regressor, such as ``sample_weight``. With metadata routing, the regressor gets
            those that it requests.

        Returns
        -------
        self : ResidualRegressor
            The estimator itself, fitted.

        Raises
        ------
        ValueError
            If X has fewer columns than y, or ``base`` does not name a column of X for each output.
        """
        with unchanged_if_it_fails(self):
            return self._fit("fit", X, y, params)

    @available_if(regressor_has("partial_fit"))
    @fit_context(prefer_skip_nested_validation=False)
    def partial_fit(self, X: ArrayLike, y: ArrayLike, **params: Any) -> Self:
        """Learn further rows by ``partial_fit`` of the regressor, if it has one.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            New rows, with the columns of the first call.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Targets of the new rows.
        **params : dict
            Arguments for ``partial_fit`` of the regressor.

        Returns
        -------
        self : ResidualRegressor
            The estimator itself, fitted.

        Raises
        ------
        ValueError
            As for `fit`, and if y does not have the outputs of the first call.
        """
        with unchanged_if_it_fails(self):
            return self._fit("partial_fit", X, y, params)

    def predict(self, X: ArrayLike, **params: Any) -> Any:
        """Predict y: the base columns plus the prediction of the regressor.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows with the columns of `fit`.
        **params : dict
            Arguments for ``predict`` of the regressor, such as ``return_std``, ``return_cov`` and ``include_noise``.

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            Mean of y at each row.
        std or cov : ndarray
            Uncertainty as the regressor returns it, if it is requested.
        """
        check_is_fitted(self)
        X = self._validated(X)
        predicted = self.regressor_.predict(X, **params)
        mean, *spread = predicted if isinstance(predicted, tuple) else (predicted,)
        mean = mean + columns_of(X, self.base_, mean.ndim)
        return (mean, *spread) if spread else mean

    @available_if(regressor_has("sample_y"))
    def sample_y(self, X: ArrayLike, n_samples: int = 1, random_state: Any = 0, **params: Any) -> np.ndarray:
        """Draw functions from the posterior at some rows, if the regressor has ``sample_y``.

        Parameters
        ----------
        X : array-like of shape (n_rows, n_features)
            Rows with the columns of `fit`.
        n_samples : int, default=1
            Number of functions.
        random_state : int, RandomState instance or None, default=0
            Seed of the functions.
        **params : dict
            Arguments for ``sample_y`` of the regressor.

        Returns
        -------
        samples : ndarray of shape (n_rows, n_samples) or (n_rows, n_outputs, n_samples)
            One function per entry of the last axis, with the base columns added.
        """
        check_is_fitted(self)
        X = self._validated(X)
        samples = self.regressor_.sample_y(X, n_samples, random_state, **params)
        return samples + columns_of(X, self.base_).reshape(*samples.shape[:-1], 1)

    value_and_jacobian = _delegate("value_and_jacobian", takes="numbers")
    jacobian = _delegate("jacobian", takes="numbers")
    predict_gradient = _delegate("predict_gradient", takes="numbers")
    novelty = _delegate("novelty", takes="rows")
    compile = _delegate("compile")
    sample_functions = _delegate("sample_functions")
    to_casadi = _delegate("to_casadi")
    to_casadi_parameters = _delegate("to_casadi_parameters")
    to_c = _delegate("to_c")
    to_l4acados = _delegate("to_l4acados")

    @property
    def _posterior(self) -> Posterior | None:
        """Posterior of the sum, or None if the regressor has no posterior."""
        posterior = getattr(self.regressor_, "_posterior", None)
        return None if posterior is None else posterior.with_base(self.base_)

    def _checked(self, X: Any, asked: str) -> Any:
        return self.regressor_._checked(self._validated(X), asked)

    def _checked_numbers(self, X: Any, asked: str) -> np.ndarray:
        numbers: np.ndarray = self.regressor_._checked_numbers(self._validated(X), asked)
        return numbers

    def get_metadata_routing(self) -> MetadataRouter:
        """Return the routing of metadata from this estimator to the regressor.

        Returns
        -------
        routing : MetadataRouter
            Routing of `fit`, `partial_fit` and `predict` to the methods of the regressor.
        """
        mapping = MethodMapping()
        for method in ("fit", "partial_fit", "predict"):
            mapping.add(caller=method, callee=method)
        router = MetadataRouter(owner=self).add_self_request(self)
        return router.add(regressor=self.regressor, method_mapping=mapping)

    def __sklearn_tags__(self) -> Tags:
        tags, own = super().__sklearn_tags__(), get_tags(self.regressor)
        tags.target_tags.single_output = own.target_tags.single_output
        tags.target_tags.multi_output = own.target_tags.multi_output
        tags.non_deterministic = own.non_deterministic
        if own.regressor_tags is not None:
            tags.regressor_tags.poor_score = own.regressor_tags.poor_score
        return tags

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "regressor_")

    def _fit(self, method: str, X: Any, y: Any, params: dict[str, Any]) -> Self:
        """Fit a new clone, or continue with the fitted regressor."""
        first = method == "fit" or not hasattr(self, "regressor_")
        if is_frame(X):
            y = validate_frame(self, X, y, reset=first)
        elif is_dask(X):
            validate_data(self, X, reset=first, skip_check_array=True)
            X, y = aligned(X, y)
        else:
            X, y = validate_numbers(self, X, y, reset=first, dtype=FLOATS)
        n_outputs = 1 if y.ndim == 1 else y.shape[1]
        if not first and n_outputs != len(self.base_):
            raise ValueError(f"y has {n_outputs} outputs, but the model has {len(self.base_)}.")
        base = self._base(n_outputs) if first else self.base_
        regressor = clone(self.regressor) if first else self.regressor_
        routed = {method: params}
        if get_config()["enable_metadata_routing"]:
            routed = process_routing(self, method, **params).get("regressor", Bunch())
        residuals = y - columns_of(X, base, y.ndim)
        if hasattr(regressor, "_columns_changed"):
            # The noise of these columns is in the differences too.
            regressor._columns_changed = base
        self.regressor_ = getattr(regressor, method)(X, residuals, **routed.get(method, {}))
        self.base_ = base
        return self

    def _validated(self, X: Any) -> Any:
        """Validate X for the regressor; a data frame stays one, and the regressor checks its values."""
        if is_frame(X):
            validate_frame(self, X, reset=False)
            return X
        if is_dask(X):
            validate_data(self, X, reset=False, skip_check_array=True)
            return as_rows(X, "X", known=False)
        return validate_numbers(self, X, reset=False, dtype=FLOATS)

    def _base(self, n_outputs: int) -> np.ndarray:
        """Return the index of the base column of each output."""
        if self.base is None:
            if n_outputs > self.n_features_in_:
                raise ValueError(
                    f"base=None takes the first n_outputs={n_outputs} columns of X, which has {self.n_features_in_}. "
                    "Pass base=..., the column that is subtracted from each output."
                )
            return np.arange(n_outputs)
        columns = np.atleast_1d(np.asarray(self.base, dtype=object))
        given = columns.ravel().tolist()
        if columns.shape != (n_outputs,) or not all(
            type(c) is not bool and isinstance(c, Integral | str) for c in given
        ):
            raise ValueError(
                f"base={self.base!r} must be one index or name of a column of X for each of n_outputs={n_outputs}."
            )
        names = getattr(self, "feature_names_in_", np.empty(0, dtype=object)).tolist()
        if not {c for c in given if isinstance(c, str)} <= set(names):
            raise ValueError(f"base={self.base!r} must name columns of X; its columns' names are {names}.")
        base = np.array([names.index(c) if isinstance(c, str) else c for c in given])
        if (base < -self.n_features_in_).any() or (base >= self.n_features_in_).any():
            raise ValueError(f"base={self.base!r} must be below the {self.n_features_in_} columns of X.")
        return base.astype(np.intp) % self.n_features_in_
