"""What controllers ask of a Gaussian process: derivatives, a fast predictor, functions drawn from it, what is new."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils import check_random_state

from ..control.compiled import CompiledPredictor
from ..control.derivatives import gradient_covariance, mapped
from ..control.functions import Functions, FunctionSamples
from ..data.dask import is_dask
from ..maps import Map, as_maps
from ..model.predictor import Predictor
from ..utils.shapes import like_y
from ..utils.validation import check_fitted, check_integer, is_plain
from .intake import Intake

# Of the derivatives of all rows at once.
_NUMBERS = 2**20


class ForControl(Intake):
    """An estimator that control loops can use."""

    feature_map_: Any
    kernel_map_: Any
    _predictor: Predictor

    def value_and_jacobian(self, X: ArrayLike, return_std: bool = False, include_noise: bool = True) -> Any:
        """Predict y, and how that changes with the columns of X.

        Derivatives go through kernel, kernel map and feature map. They are exact for this package's transformers and
        kernels, for scikit-learn's scalers, PolynomialFeatures and PCA, pipelines and unions of these, and for any map
        with a method ``jacobian(X)`` that returns (n_samples, n_features_out, n_features); of other maps they are
        central differences, good to about ten digits where the map is smooth on the scale of the rows of `fit`.

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
        >>> model = model.fit(train.data, train.target, groups=train.groups)
        >>> mean, jacobian = model.value_and_jacobian([[0.1, 0.0, 0.0]])  # near the bottom: [A, B] of a linear model
        >>> jacobian.shape
        (1, 2, 3)
        """
        fast = self.compile(include_noise)
        parts = [fast.value_and_jacobian(rows, return_std) for rows in self._in_pieces(X)]
        return tuple(np.concatenate(each) for each in zip(*parts, strict=True))

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
        fast, maps = self.compile(), self._maps()
        parts, covariances = [], []
        for rows in self._in_pieces(X):
            parts.append(fast.value_and_jacobian(rows)[1])
            if return_std or return_cov:
                covariances.append(gradient_covariance(self._predictor, mapped(rows, *maps)))
        gradient = np.concatenate(parts)
        if not covariances:
            return gradient
        cov = np.concatenate(covariances)
        cov = cov[:, 0] if cov.shape[1] == 1 else cov
        return gradient, cov if return_cov else np.sqrt(np.einsum("...ii->...i", cov))

    def novelty(self, X: ArrayLike) -> np.ndarray:
        """Say how far rows are outside of the data, as the kernel sees them.

        It is the share of the prior variance of f that is left, Var[f(x) | data] / Var[f(x)]: near 0 where f is known,
        and 1 where the data say nothing of it: there only the features speak. It has no unit, so that one threshold
        serves all outputs.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            As of `predict`.

        Returns
        -------
        novelty : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            From 0 to 1.

        Raises
        ------
        ValueError, TypeError
            If X does not fit the training data, is not finite, or is a Dask array.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import EVGPRegressor
        >>> X = np.linspace(0.0, 6.0, 60)[:, np.newaxis]
        >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, np.sin(X[:, 0]))
        >>> model.novelty([[3.0], [60.0]]).round(3)
        array([0., 1.])
        """
        check_fitted(self)
        if is_dask(X):
            raise ValueError("novelty needs rows in memory: not for Dask arrays. Give it X.compute().")
        given: Any = X
        array: Any = X
        if not is_plain(self, X):
            given, array, _ = self._validated(X)
        size = self._predictor.rows_at_once
        pieces = (slice(first, first + size) for first in range(0, len(array), size))
        parts = [self._predictor.novelty(*self._inputs_and_features(given, array, rows)) for rows in pieces]
        return like_y(np.concatenate(parts))

    def compile(self, include_noise: bool = True) -> CompiledPredictor:
        """Make a predictor for control loops: of few rows, several times as fast, without validation.

        Parameters
        ----------
        include_noise : bool, default=True
            Whether its standard deviations are of y, with the learned noise, or of the noise-free g(x).

        Returns
        -------
        compiled : CompiledPredictor
            With ``predict`` and ``value_and_jacobian`` of arrays (n_features,) or (n_samples, n_features); and
            ``update(model)`` for the weights after a ``partial_fit``. Threads may share it, and it can be pickled.

        Raises
        ------
        NotFittedError
            Before `fit`.
        ValueError
            If columns of X were no numbers.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import EVGPRegressor
        >>> X = np.linspace(0.0, 6.0, 60)[:, np.newaxis]
        >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, np.sin(X[:, 0]))
        >>> mean, slope = model.compile().value_and_jacobian(np.array([0.0]))
        >>> slope.round(2)
        array([1.])
        """
        check_fitted(self)
        return CompiledPredictor(self._predictor, *self._maps(), include_noise)

    def sample_functions(
        self, n: int = 1, random_state: int | np.random.RandomState | None = 0, *, n_waves: int = 3000
    ) -> FunctionSamples:
        """Draw functions from the posterior, to be evaluated and differentiated anywhere.

        For scenarios in control and policy search. (`sample_y` draws exactly, at given rows; `rollout` exactly along
        paths.) The mean is exact, and the variance within a few percent at most rows: f between inducing points is a
        sum of random waves (Wilson et al. 2020, with frequencies drawn wider).

        Parameters
        ----------
        n : int, default=1
            How many functions.
        random_state : int, RandomState instance or None, default=0
            Draws them: an integer gives the same at each call.
        n_waves : int, default=3000
            Random waves for each term of a kernel; time and memory are in proportion.

        Returns
        -------
        functions : FunctionSamples
            A sequence of n callables: ``functions[i](X)`` is the noise-free g of an array (n_features,) or (n_rows,
            n_features), without validation, and ``functions[i].value_and_jacobian(X)`` has its derivatives too.
            ``functions(X)`` are all of them at once, with a first axis of n.

        Raises
        ------
        ValueError, TypeError
            If ``n`` or ``n_waves`` is not a positive integer, columns of X were no numbers, or functions of the kernel
            cannot be drawn, as those of a `FunctionKernel`.

        References
        ----------
        - J. T. Wilson et al. (2020): Efficiently Sampling Functions from Gaussian Process Posteriors.
        - A. Rahimi, B. Recht (2007): Random Features for Large-Scale Kernel Machines.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import EVGPRegressor
        >>> X = np.linspace(0.0, 6.0, 60)[:, np.newaxis]
        >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, np.sin(X[:, 0]))
        >>> functions = model.sample_functions(5)
        >>> functions(X).shape, functions[0](X[0]).shape
        ((5, 60), ())
        >>> value, slope = functions[0].value_and_jacobian(X)
        """
        check_fitted(self)
        check_integer(n, "n", minimum=1)
        check_integer(n_waves, "n_waves", minimum=1)
        return FunctionSamples(self._functions(), n, n_waves, check_random_state(random_state))

    def _functions(self) -> Functions:
        """The posterior as functions to be drawn and followed."""
        return Functions(self._predictor, *self._maps())

    def _maps(self) -> tuple[Map | None, Map | None]:
        """Feature map and kernel map as functions of arrays."""
        return as_maps(self.feature_map_, self.kernel_map_, self._example)

    def _in_pieces(self, X: Any) -> Iterator[np.ndarray]:
        """Rows as floats, few enough at once that derivatives fit into memory."""
        check_fitted(self)
        if is_dask(X):
            raise ValueError("Derivatives need rows in memory: not for Dask arrays. Give them X.compute().")
        rows = X if is_plain(self, X) else self._numbers(X, reset=False)[0]
        rows = np.asarray(rows, dtype=np.float64)
        stacked = sum(group.root.shape[0] * group.root.shape[2] for group in self._predictor.groups)
        size = int(np.clip(_NUMBERS // (stacked * rows.shape[1]), 1, 1024))
        return (rows[first : first + size] for first in range(0, len(rows), size))
