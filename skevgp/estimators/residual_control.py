"""What controllers ask of a regressor that learns changes: of the sum, what they ask of a regressor itself."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted

from ..control.c_code import write_c
from ..control.casadi import with_base
from ..control.compiled import CompiledPredictor
from ..control.functions import FunctionSamples
from ..utils.sklearn import safe_indexing
from ..utils.state import StatefulEstimator
from ..utils.validation import as_floats, is_frame


def regressor_has(method: str) -> Callable[[Any], bool]:
    """For `available_if`: the fitted regressor has a method or, before `fit`, the one that is given."""

    def has(self: Any) -> bool:
        getattr(self.regressor_ if hasattr(self, "regressor_") else self.regressor, method)
        return True

    return has


def columns_of(X: Any, indices: np.ndarray, ndim: int = 2) -> np.ndarray:
    """Columns of an array or a data frame as numbers, (n, len(indices)), or (n,) of a single one."""
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


class ResidualForControl(StatefulEstimator):
    """A meta-estimator of changes that control loops can use, as far as its regressor can."""

    regressor_: Any
    base_: np.ndarray

    @available_if(regressor_has("value_and_jacobian"))
    def value_and_jacobian(self, X: ArrayLike, return_std: bool = False, **params: Any) -> Any:
        """Predict y, and how that changes with the columns of X, if the regressor can.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numbers.
        return_std : bool, default=False
            Whether to return the standard deviation and its derivatives too.
        **params : dict
            For the regressor's ``value_and_jacobian``.

        Returns
        -------
        mean, jacobian : ndarray
            As of `EVGPRegressor.value_and_jacobian`: base columns add 1 to the derivatives in them.
        std, std_jacobian : ndarray
            If ``return_std``.
        """
        check_is_fitted(self)
        X = self._validated(X)
        mean, jacobian, *spread = self.regressor_.value_and_jacobian(X, return_std=return_std, **params)
        return mean + columns_of(X, self.base_, mean.ndim), self._with_base(jacobian), *spread

    @available_if(regressor_has("jacobian"))
    def jacobian(self, X: ArrayLike) -> np.ndarray:
        """Differentiate the mean in the columns of X, if the regressor can.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numbers.

        Returns
        -------
        jacobian : ndarray of shape (n_samples, n_features) or (n_samples, n_outputs, n_features)
            ∂mean/∂x: base columns add 1 to the derivatives in them.
        """
        check_is_fitted(self)
        return self._with_base(self.regressor_.jacobian(self._validated(X)))

    @available_if(regressor_has("predict_gradient"))
    def predict_gradient(self, X: ArrayLike, **params: Any) -> Any:
        """Predict the gradient of the noise-free function, with its uncertainty, if the regressor can.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numbers.
        **params : dict
            For the regressor's ``predict_gradient``, such as ``return_std`` and ``return_cov``.

        Returns
        -------
        gradient : ndarray of shape (n_samples, n_features) or (n_samples, n_outputs, n_features)
            Its mean: that of `jacobian`.
        std or cov : ndarray
            If the regressor was asked for them: as it returns them.
        """
        check_is_fitted(self)
        predicted = self.regressor_.predict_gradient(self._validated(X), **params)
        gradient, *spread = predicted if isinstance(predicted, tuple) else (predicted,)
        gradient = self._with_base(gradient)
        return (gradient, *spread) if spread else gradient

    @available_if(regressor_has("novelty"))
    def novelty(self, X: ArrayLike) -> np.ndarray:
        """Say how far rows are outside of the data, if the regressor can.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            As of `predict`.

        Returns
        -------
        novelty : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            From 0 to 1, as of `EVGPRegressor.novelty`: base columns are known, and change nothing.
        """
        check_is_fitted(self)
        return self.regressor_.novelty(self._validated(X))

    @available_if(regressor_has("compile"))
    def compile(self, include_noise: bool = True) -> CompiledPredictor:
        """Make a predictor for control loops, if the regressor can.

        Parameters
        ----------
        include_noise : bool, default=True
            Whether its standard deviations are of y, with the learned noise, or of the noise-free function.

        Returns
        -------
        compiled : CompiledPredictor
            As of `EVGPRegressor.compile`, of the sum.
        """
        check_is_fitted(self)
        feature_map, kernel_map = self.regressor_._maps()
        return CompiledPredictor(self.regressor_._predictor, feature_map, kernel_map, include_noise, self.base_)

    @available_if(regressor_has("sample_functions"))
    def sample_functions(self, n: int = 1, random_state: Any = 0, **params: Any) -> FunctionSamples:
        """Draw functions from the posterior, to be evaluated and differentiated anywhere, if the regressor can.

        Parameters
        ----------
        n : int, default=1
            How many functions.
        random_state : int, RandomState instance or None, default=0
            Draws them.
        **params : dict
            For the regressor's ``sample_functions``.

        Returns
        -------
        functions : FunctionSamples
            As of `EVGPRegressor.sample_functions`, of the sum.
        """
        check_is_fitted(self)
        return self.regressor_.sample_functions(n, random_state, **params).with_base(self.base_)

    @available_if(regressor_has("to_casadi"))
    def to_casadi(self, name: str = "evgp", *, include_noise: bool = True, parametric: bool = False) -> Any:
        """Write mean and variance as a CasADi function, if the regressor can.

        Parameters
        ----------
        name : str, default="evgp"
            Of the function.
        include_noise, parametric : bool
            As of `EVGPRegressor.to_casadi`.

        Returns
        -------
        function : casadi.Function
            x of shape (n_features,) -> (mean, variance), each of shape (n_outputs,), base columns included.

        Raises
        ------
        ImportError, ValueError, TypeError, sklearn.exceptions.NotFittedError
            As of `EVGPRegressor.to_casadi`.
        """
        check_is_fitted(self)
        function = self.regressor_.to_casadi(name, include_noise=include_noise, parametric=parametric)
        return with_base(function, self.base_)

    @available_if(regressor_has("to_casadi_parameters"))
    def to_casadi_parameters(self, out: np.ndarray | None = None) -> np.ndarray:
        """Give what the function of ``to_casadi(parametric=True)`` takes beside x, as the regressor now is.

        Parameters
        ----------
        out : ndarray of shape (n_parameters,), default=None
            Where to put it; None makes a new array.

        Returns
        -------
        parameters : ndarray of shape (n_parameters,)
            As of `EVGPRegressor.to_casadi_parameters`.
        """
        check_is_fitted(self)
        return self.regressor_.to_casadi_parameters(out)

    @available_if(regressor_has("to_c"))
    def to_c(
        self,
        path: str | os.PathLike[str],
        name: str = "evgp",
        *,
        jacobian: bool = True,
        include_noise: bool = True,
    ) -> tuple[Path, Path]:
        """Write mean and variance, and their Jacobians, as C, base columns included, if the regressor can.

        Parameters
        ----------
        path : str or path-like
            A folder, or the file that ends in ``.c``; the header goes beside it.
        name : str, default="evgp"
            What the names of the C functions begin with, and of the files in a folder.
        jacobian, include_noise : bool, default=True
            As of `EVGPRegressor.to_c`.

        Returns
        -------
        source, header : Path
            The files.

        Raises
        ------
        ImportError, ValueError, TypeError, sklearn.exceptions.NotFittedError
            As of `EVGPRegressor.to_c`.
        """
        function = self.to_casadi(name, include_noise=include_noise)
        return write_c(function, path, jacobian, getattr(self, "feature_names_in_", None), include_noise)

    @available_if(regressor_has("_functions"))
    def _functions(self) -> Any:
        """The posterior as functions to be drawn and followed."""
        return replace(self.regressor_._functions(), base=self.base_)

    def _with_base(self, jacobian: np.ndarray) -> np.ndarray:
        """A Jacobian of changes as one of what they lead to."""
        found, outputs = jacobian.copy(), np.arange(len(self.base_))
        found.reshape(len(found), len(self.base_), -1)[:, outputs, self.base_] += 1.0
        return found

    def _validated(self, X: Any) -> Any:
        """X as the regressor shall see it."""
        raise NotImplementedError
