"""What controllers ask of a Gaussian process beside its predictions: their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_is_fitted

from ._intake import Intake
from ._shapes import like_y
from ._validation import is_plain
from .inference.posterior import Predictor
from .prediction.derivatives import MappedRows, gradient_covariance, mapped, moments_with_slopes
from .prediction.maps import direct
from .prediction.paths import Functions
from .rows.dask import is_dask

# Of the derivatives of all rows at once.
_NUMBERS = 2**20


class Differentiable(Intake):
    """An estimator whose predictions can be differentiated in the columns of X."""

    feature_map_: Any
    kernel_map_: Any
    _predictor: Predictor

    def value_and_jacobian(self, X: ArrayLike, return_std: bool = False, include_noise: bool = True) -> Any:
        """Predict y, and how that changes with the columns of X.

        Derivatives go through kernel, kernel map and feature map. They are exact for this package's transformers and
        kernels, for scikit-learn's scalers, PolynomialFeatures and PCA, pipelines and unions of these, and for any map
        with a method ``jacobian(X)`` that returns (n_samples, n_features_out, n_features); of other maps they are
        central differences, good to about ten digits.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numbers.
        return_std : bool, default=False
            Whether to return the standard deviation and its derivatives too.
        include_noise : bool, default=True
            Whether the standard deviation is of y, with the learned noise, or of the noise-free g(x).

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            As of `predict`.
        jacobian : ndarray of shape (n_samples, n_features) or (n_samples, n_outputs, n_features)
            ∂mean/∂x.
        std : ndarray of the shape of ``mean``
            If ``return_std``.
        std_jacobian : ndarray of the shape of ``jacobian``
            If ``return_std``: ∂std/∂x; 0 where std is 0.

        Raises
        ------
        ValueError, TypeError
            If X does not fit the training data, is not finite, or is a Dask array.

        See Also
        --------
        predict_gradient : The gradient of g with its own standard deviation.

        Examples
        --------
        >>> from skevgp import EVGPRegressor
        >>> from skevgp.datasets import make_dynamics
        >>> from skevgp.features import InertiaForceGravity
        >>> train = make_dynamics("pendulum", 10, random_state=0)
        >>> model = EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=10, random_state=0)
        >>> model = model.fit(train.data, train.target)
        >>> mean, jacobian = model.value_and_jacobian([[0.1, 0.0, 0.0]])  # near the bottom: [A, B] of a linear model
        >>> jacobian.shape
        (1, 2, 3)
        """
        parts = self._in_pieces(X, lambda rows: moments_with_slopes(self._predictor, rows, return_std))
        mean, slopes = (np.concatenate(each) for each in zip(*(part[:2] for part in parts), strict=True))
        if not return_std:
            return like_y(mean), self._like_jacobian(slopes)
        variance, variance_slopes = (np.concatenate(each) for each in zip(*(part[2:] for part in parts), strict=True))
        std = np.sqrt(variance + (self._predictor.noise if include_noise else 0.0))
        variance_slopes *= (0.5 / np.where(std > 0.0, std, np.inf))[:, :, np.newaxis]
        return like_y(mean), self._like_jacobian(slopes), like_y(std), self._like_jacobian(variance_slopes)

    def jacobian(self, X: ArrayLike) -> np.ndarray:
        """Differentiate the mean in the columns of X.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numbers.

        Returns
        -------
        jacobian : ndarray of shape (n_samples, n_features) or (n_samples, n_outputs, n_features)
            ∂mean/∂x, as of `value_and_jacobian`.

        Raises
        ------
        ValueError, TypeError
            As of `value_and_jacobian`.
        """
        return self.value_and_jacobian(X)[1]

    def predict_gradient(self, X: ArrayLike, return_std: bool = False, return_cov: bool = False) -> Any:
        """Predict the gradient of the noise-free g(x), with its uncertainty.

        The gradient of a Gaussian process is one too (Rasmussen & Williams 2006, section 9.4). Where the model knows g
        but not how it changes, as between rows that are far from each other, the standard deviation says so.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numbers.
        return_std : bool, default=False
            Whether to return the standard deviation too.
        return_cov : bool, default=False
            Whether to return the covariance between the entries of each gradient too.

        Returns
        -------
        gradient : ndarray of shape (n_samples, n_features) or (n_samples, n_outputs, n_features)
            Its mean: that of `jacobian`.
        std : ndarray of the same shape
            If ``return_std``.
        cov : ndarray of shape (n_samples, n_features, n_features) or (n_samples, n_outputs, n_features, n_features)
            If ``return_cov``.

        Raises
        ------
        ValueError, TypeError
            As of `value_and_jacobian`; if both std and covariance are asked for; and if functions of the kernel have no
            gradient, as those of a Matern kernel with nu=0.5.
        """
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be asked for.")
        parts = self._in_pieces(X, self._gradient_with_covariance if return_std or return_cov else self._gradient)
        gradient, *cov = (np.concatenate(each) for each in zip(*parts, strict=True))
        gradient = self._like_jacobian(gradient)
        if not cov:
            return gradient
        found = self._like_jacobian(cov[0])
        return gradient, found if return_cov else np.sqrt(np.einsum("...ii->...i", found))

    def _functions(self) -> Functions:
        """The posterior as functions to be drawn and followed."""

        def to_features(X: np.ndarray) -> np.ndarray:
            return np.empty((len(X), 0)) if self.feature_map_ is None else features(X)

        features = direct(self.feature_map_)
        return Functions(self._predictor, direct(self.kernel_map_), to_features)

    def _gradient(self, rows: MappedRows) -> tuple[np.ndarray, ...]:
        return (moments_with_slopes(self._predictor, rows).mean_slopes,)

    def _gradient_with_covariance(self, rows: MappedRows) -> tuple[np.ndarray, ...]:
        return *self._gradient(rows), gradient_covariance(self._predictor, rows)

    def _in_pieces(self, X: Any, function: Callable[[MappedRows], Any]) -> list[Any]:
        """What a function has of some rows at once, through the maps with their Jacobians."""
        check_is_fitted(self)
        if is_dask(X):
            raise ValueError("Derivatives need rows in memory: not for Dask arrays. Give them X.compute().")
        rows = X if is_plain(self, X) else self._numbers(X, reset=False)[0]
        rows = np.asarray(rows, dtype=np.float64)
        stacked = sum(group.root.shape[0] * group.root.shape[2] for group in self._predictor.groups)
        size = int(np.clip(_NUMBERS // (stacked * rows.shape[1]), 1, 1024))
        maps = self.feature_map_, self.kernel_map_
        return [function(mapped(rows[first : first + size], *maps)) for first in range(0, len(rows), size)]

    def _like_jacobian(self, slopes: np.ndarray) -> np.ndarray:
        """Without the axis of outputs, the second, if there is one output."""
        return slopes[:, 0] if slopes.shape[1] == 1 else slopes
