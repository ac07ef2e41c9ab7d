"""The posterior of a fitted model, which answers all requests to a fitted model.

An estimator validates X and passes it on, either as numbers or as `Rows`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils import check_random_state

from ..data.maps import Maps
from ..maps import as_map, as_maps
from ..model.predictor import Predictor
from ..utils.shapes import like_y
from ..utils.validation import check_fitted, check_integer
from .acados import L4acadosModel, checked_columns
from .c_code import write_c
from .casadi import Exported, with_base
from .compiled import CompiledPredictor
from .derivatives import gradient_covariance, mapped
from .functions import Functions, FunctionSamples

# Largest number of floats in the derivatives of all rows at once.
_NUMBERS = 2**20


class Rows(NamedTuple):
    """Validated rows: ``given`` for the maps (a data frame stays one), ``array`` for a kernel without a map."""

    given: Any
    array: Any


@dataclass(frozen=True)
class Posterior:
    """Maps and frozen predictor of a fitted model, with columns of X that are added to its predictions."""

    predictor: Predictor  # in the user's units
    maps: Maps  # fitted
    base: np.ndarray | None = None  # indices (k, n_outputs): k columns of X are added to the mean of each output

    def with_base(self, columns: np.ndarray) -> Posterior:
        """Add columns of X, one for each output, to the predictions: turns a posterior of residuals into one of y."""
        base = np.atleast_2d(columns)
        return replace(self, base=base if self.base is None else np.vstack([self.base, base]))

    # --- predictions --------------------------------------------------------------------------------------------------

    def predict(
        self,
        X: Rows,
        return_std: bool = False,
        return_cov: bool | Literal["joint"] = False,
        include_noise: bool = True,
    ) -> Any:
        """Return the mean of y, and if asked for the standard deviation or the covariance between rows."""
        noise = self.predictor.noise if include_noise else np.zeros_like(self.predictor.noise)
        if return_cov is not False:
            rows = self.maps.rows(*X, slice(None))
            mean, cov = self.predictor.covariance(*rows, noise)
            cov = self.predictor.jointly(cov, *rows) if return_cov == "joint" else like_y(cov)
            return like_y(mean), cov
        means, deviations = [], []
        for rows in self._pieces(X):
            mean, variance = self.predictor.predict(*rows, return_std)
            means.append(mean)
            if variance is not None:
                deviations.append(np.sqrt(variance + noise))
        mean = like_y(np.concatenate(means))
        return (mean, like_y(np.concatenate(deviations))) if return_std else mean

    def sample_y(
        self, X: Rows, n_samples: int, random_state: int | np.random.RandomState | None, include_noise: bool
    ) -> np.ndarray:
        """Draw functions exactly at rows: (n, n_samples) or (n, n_outputs, n_samples)."""
        noise = self.predictor.noise if include_noise else np.zeros_like(self.predictor.noise)
        rows = self.maps.rows(*X, slice(None))
        samples = self.predictor.sample(*rows, noise, n_samples, check_random_state(random_state))
        return samples[:, 0] if samples.shape[1] == 1 else samples

    def novelty(self, X: ArrayLike) -> np.ndarray:
        """Measure how far rows are from the training data.

        Novelty is the posterior variance of f divided by its prior variance, Var[f(x) | data] / Var[f(x)]. It is near 0
        where f is known, and 1 where predictions depend on the features alone.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Rows, as for `predict`.

        Returns
        -------
        novelty : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            Novelty of each row, from 0 to 1.

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
        return like_y(np.concatenate([self.predictor.novelty(*rows) for rows in self._pieces(X)]))

    def _pieces(self, X: Any) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield kernel inputs and features of a few thousand rows at a time, so that memory stays small."""
        size = self.predictor.rows_at_once
        return (self.maps.rows(X.given, X.array, slice(first, first + size)) for first in range(0, len(X.array), size))

    # --- derivatives --------------------------------------------------------------------------------------------------

    def value_and_jacobian(self, X: ArrayLike, return_std: bool = False, include_noise: bool = True) -> Any:
        """Predict y and the derivatives of the prediction with respect to the columns of X.

        Derivatives are exact for the transformers and kernels of this package, and for pipelines and unions of them.
        They are also exact for scikit-learn's scalers, PolynomialFeatures, SplineTransformer, PCA and TruncatedSVD.
        Your own map is exact if it has a method ``jacobian(X)`` that returns (n_samples, n_features_out, n_features).
        Other maps are differentiated by central differences, to about ten digits if the map is smooth.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numeric rows.
        return_std : bool, default=False
            Whether to return the standard deviation and its derivatives too.
        include_noise : bool, default=True
            Whether the standard deviation is that of y, with the learned noise. If False, it is that of the noise-free
            g(x).

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            The posterior mean, as `predict` returns it.
        jacobian : ndarray of shape (n_samples, n_features) or (n_samples, n_outputs, n_features)
            Derivatives ∂mean/∂x.
        std : ndarray of the shape of ``mean``
            The standard deviation. It is returned only if ``return_std`` is True.
        std_jacobian : ndarray of the shape of ``jacobian``
            Derivatives ∂std/∂x, and 0 where std is 0. They are returned only if ``return_std`` is True.

        Raises
        ------
        ValueError, TypeError
            If X does not fit the training data, is not finite, or is a Dask array.

        See Also
        --------
        predict_gradient : Gradient of g with the standard deviation of the gradient.

        Examples
        --------
        >>> from skevgp import EVGPRegressor
        >>> from skevgp.datasets import make_dynamics
        >>> from skevgp.features import InertiaForceGravity
        >>> train = make_dynamics("pendulum", 2, random_state=0)
        >>> model = EVGPRegressor(InertiaForceGravity("pendulum"), n_inducing=5, random_state=0)
        >>> model = model.fit(train.data, train.target, groups=train.groups)
        >>> mean, jacobian = model.value_and_jacobian([[0.1, 0.0, 0.0]])  # near the bottom: [A, B] of a linear model
        >>> jacobian.shape
        (1, 2, 3)
        """
        fast = self._compiled(include_noise)
        parts = [fast.value_and_jacobian(rows, return_std) for rows in self._few(X)]
        return tuple(np.concatenate(each) for each in zip(*parts, strict=True))

    def jacobian(self, X: ArrayLike) -> np.ndarray:
        """Differentiate the posterior mean with respect to the columns of X.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numeric rows.

        Returns
        -------
        jacobian : ndarray of shape (n_samples, n_features) or (n_samples, n_outputs, n_features)
            Derivatives ∂mean/∂x, as `value_and_jacobian` returns them.

        Raises
        ------
        ValueError, TypeError
            If X does not fit the training data, is not finite, or is a Dask array.
        """
        return self.value_and_jacobian(X)[1]

    def predict_gradient(self, X: ArrayLike, return_std: bool = False, return_cov: bool = False) -> Any:
        """Predict the gradient of the noise-free g(x) with its uncertainty.

        The gradient of a Gaussian process is a Gaussian process too (Rasmussen & Williams 2006, section 9.4). Its
        standard deviation is large where few rows determine the slope of g, even if they determine its value.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Numeric rows.
        return_std : bool, default=False
            Whether to return the standard deviation too.
        return_cov : bool, default=False
            Whether to return the covariance between the entries of each gradient too.

        Returns
        -------
        gradient : ndarray of shape (n_samples, n_features) or (n_samples, n_outputs, n_features)
            The posterior mean of the gradient, as `jacobian` returns it.
        std : ndarray of the same shape
            The standard deviation of each entry. It is returned only if ``return_std`` is True.
        cov : ndarray of shape (n_samples, n_features, n_features) or (n_samples, n_outputs, n_features, n_features)
            The covariance of each gradient. It is returned only if ``return_cov`` is True.

        Raises
        ------
        ValueError, TypeError
            If X does not fit the training data, is not finite, or is a Dask array. If both ``return_std`` and
            ``return_cov`` are True. If functions of the kernel have no gradient, such as Matern with nu=0.5.
        """
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be requested.")
        self._check_smooth("predict_gradient")
        fast, maps = self._compiled(), as_maps(self.maps)
        parts, covariances = [], []
        for rows in self._few(X):
            parts.append(fast.value_and_jacobian(rows)[1])
            if return_std or return_cov:
                covariances.append(gradient_covariance(self.predictor, mapped(rows, *maps)))
        gradient = np.concatenate(parts)
        if not covariances:
            return gradient
        cov = np.concatenate(covariances)
        cov = cov[:, 0] if cov.shape[1] == 1 else cov
        return gradient, cov if return_cov else np.sqrt(np.einsum("...ii->...i", cov))

    def _few(self, X: Any) -> Iterator[np.ndarray]:
        """Yield rows as floats, few enough at a time that derivatives fit into memory."""
        rows = np.asarray(X, dtype=np.float64)
        stacked = sum(group.root.shape[0] * group.root.shape[2] for group in self.predictor.groups)
        size = int(np.clip(_NUMBERS // (stacked * rows.shape[1]), 1, 1024))
        return (rows[first : first + size] for first in range(0, len(rows), size))

    # --- what control loops and optimisers call -----------------------------------------------------------------------

    def compile(self, include_noise: bool = True) -> CompiledPredictor:
        """Make a fast predictor for control loops, without validation of its input.

        Parameters
        ----------
        include_noise : bool, default=True
            Whether standard deviations are those of y, with the learned noise. If False, they are those of the
            noise-free g(x).

        Returns
        -------
        compiled : CompiledPredictor
            Predictor with ``predict`` and ``value_and_jacobian`` for arrays (n_features,) or (n_samples, n_features).
            Its method ``update(model)`` copies the weights after a ``partial_fit``. Threads may share it, and it can be
            pickled.

        Raises
        ------
        NotFittedError
            If the model is not fitted.
        ValueError
            If the training data had columns that are not numbers.

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
        self._check_smooth("compile")
        return self._compiled(include_noise)

    def _compiled(self, include_noise: bool = True) -> CompiledPredictor:
        return CompiledPredictor(self.predictor, *as_maps(self.maps), include_noise, self.base)

    def _check_smooth(self, name: str) -> None:
        """Raise a ValueError if the model has a local part, whose neighbours change from row to row."""
        if any(group.near is not None for group in self.predictor.groups):
            raise ValueError(f"{name} needs a smooth model of fixed size. Fit the model with n_neighbors=0.")

    def to_l4acados(self, columns: ArrayLike | None = None, *, include_noise: bool = True) -> L4acadosModel:
        """Make a residual model for the controllers of L4acados, which plan with acados.

        Fit the model to rows [x, u] and the residual x' - f(x, u) of a nominal model, or to some columns of the
        residual. The argument ``B`` of the controller maps these columns to the state. L4acados is not imported.

        Parameters
        ----------
        columns : array-like of shape (n_features,), default=None
            Indices of the columns of [x, u] that the model was fitted to, in its order. If None, the model was fitted
            to all columns.
        include_noise : bool, default=True
            Whether variances are those of y, with the learned noise. If False, they are those of the noise-free g(x).

        Returns
        -------
        residual_model : L4acadosModel
            Model with ``value_and_jacobian``, ``evaluate``, ``jacobian`` and ``current_variance``, in the shapes of
            L4acados. Its method ``update(model)`` copies the weights after a ``partial_fit``.

        Raises
        ------
        NotFittedError
            If the model is not fitted.
        ValueError
            If the training data had columns that are not numbers, or if ``columns`` does not have a different index for
            each column.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import EVGPRegressor
        >>> XU = np.random.RandomState(0).uniform(-1.0, 1.0, (60, 3))  # two states and an input
        >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(XU[:, :2], -0.1 * np.sin(XU[:, 0]))
        >>> residual = model.to_l4acados(columns=[0, 1])
        >>> value, jacobian = residual.value_and_jacobian(XU[:20])
        >>> value.shape, jacobian.shape
        ((20, 1), (1, 20, 3))
        """
        self._check_smooth("to_l4acados")
        return L4acadosModel(self.compile(include_noise), checked_columns(columns, self.maps.n_columns))

    def sample_functions(
        self, n: int = 1, random_state: int | np.random.RandomState | None = 0, *, n_waves: int = 3000
    ) -> FunctionSamples:
        """Draw functions from the posterior that can be evaluated and differentiated anywhere.

        Use them as scenarios in control and policy search. The mean is exact. The variance is approximate, because f
        between inducing points is a sum of random waves (Wilson et al. 2020). `sample_y` is exact at given rows, and
        `rollout` is exact along paths.

        Parameters
        ----------
        n : int, default=1
            Number of functions.
        random_state : int, RandomState instance or None, default=0
            Seed of the functions. An integer gives the same functions at each call.
        n_waves : int, default=3000
            Number of random waves for each term of the kernel. Time and memory are proportional to it.

        Returns
        -------
        functions : FunctionSamples
            Sequence of n callables. ``functions[i](X)`` is the noise-free g of an array (n_features,) or (n_rows,
            n_features), without validation. ``functions[i].value_and_jacobian(X)`` adds its derivatives.
            ``functions(X)`` evaluates all functions at once, with a first axis of length n.

        Raises
        ------
        ValueError, TypeError
            If ``n`` or ``n_waves`` is not a positive integer. If the training data had columns that are not numbers. If
            functions of the kernel cannot be drawn, such as those of a `FunctionKernel`.

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
        self._check_smooth("sample_functions")
        check_integer(n, "n", minimum=1)
        check_integer(n_waves, "n_waves", minimum=1)
        return FunctionSamples(self.functions(), n, n_waves, check_random_state(random_state))

    def functions(self) -> Functions:
        """Return the posterior as functions that can be drawn and followed along their own paths."""
        return Functions(self.predictor, *as_maps(self.maps), self.base)

    def to_casadi(self, name: str = "evgp", *, include_noise: bool = True, parametric: bool = False) -> Any:
        """Write mean and variance as a CasADi function, which differentiates them exactly.

        Parameters
        ----------
        name : str, default="evgp"
            Name of the function.
        include_noise : bool, default=True
            Whether the variance is that of y, with the learned noise. If False, it is that of the noise-free g(x).
        parametric : bool, default=False
            Whether the function has a second argument ``parameters``, which `to_casadi_parameters` returns. An optimal
            control problem that is built once can then follow a model that learns by `partial_fit`. The variance then
            takes longer.

        Returns
        -------
        function : casadi.Function
            An inlined MX function from ``x`` of shape (n_features,), and ``parameters`` if parametric, to ``mean`` and
            ``variance`` of shape (n_outputs,) each.

        Raises
        ------
        ImportError
            If CasADi is not installed.
        ValueError, TypeError
            If the kernel or a map has no expression in CasADi. Your own map needs a method ``to_casadi(x)``, from an MX
            of shape (n_features, 1) to one of shape (n_features_out, 1). If it returns a row for each output,
            ``to_casadi`` returns a list of these.
        sklearn.exceptions.NotFittedError
            If the model is not fitted.

        Notes
        -----
        Values equal those of `predict` up to rounding, which grows if inducing points are close to each other. The
        function returns the variance because a square root has no derivative where the variance is 0.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import EVGPRegressor
        >>> from skevgp.datasets import make_toy
        >>> X, y = make_toy(random_state=0, return_X_y=True)
        >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, y)
        >>> function = model.to_casadi()
        >>> function
        Function(evgp:(x)->(mean,variance) MXFunction)
        >>> mean, variance = function(0.5)
        >>> bool(np.isclose(float(mean), model.predict([[0.5]])[0]))
        True
        >>> function.factory("linear", ["x"], ["mean", "jac:mean:x"])
        Function(linear:(x)->(mean,jac_mean_x) MXFunction)
        """
        function = self._for_casadi().function(name, include_noise, parametric)
        return function if self.base is None else with_base(function, self.base)

    def to_casadi_parameters(self, out: np.ndarray | None = None) -> np.ndarray:
        """Return the current ``parameters`` of the function ``to_casadi(parametric=True)``.

        Parameters
        ----------
        out : ndarray of shape (n_parameters,), default=None
            Array to write to. If None, a new array is made.

        Returns
        -------
        parameters : ndarray of shape (n_parameters,)
            Numbers of each group of outputs, then numbers of all outputs. A group of o outputs with m inducing points
            has the weights of the mean (o, m + n_h), and the roots of the covariance (o, m + n_h, m + n_h). All outputs
            have the offsets of the features' weights (n_outputs, n_h), the intercepts (n_outputs,) and the noise
            variances (n_outputs,). `partial_fit` changes weights and roots only.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            If the model is not fitted.
        """
        return self._for_casadi().parameters(out)

    def to_c(
        self,
        path: str | os.PathLike[str],
        name: str = "evgp",
        *,
        jacobian: bool = True,
        include_noise: bool = True,
    ) -> tuple[Path, Path]:
        """Write mean and variance, and their Jacobians, as C99 code without dependencies.

        Parameters
        ----------
        path : str or path-like
            A folder, or a file that ends in ``.c``. The header is written next to it.
        name : str, default="evgp"
            Prefix of the names of the C functions, and of the files if ``path`` is a folder.
        jacobian : bool, default=True
            Whether to write functions for the Jacobians too.
        include_noise : bool, default=True
            Whether the variance is that of y, with the learned noise. If False, it is that of the noise-free g(x).

        Returns
        -------
        source, header : Path
            The files. Compile them by ``gcc -std=c99 -O2 -c evgp.c``, and link with ``-lm``.

        Raises
        ------
        ImportError, ValueError, TypeError, sklearn.exceptions.NotFittedError
            As for `to_casadi`, and if the folder does not exist, or the name has a meaning in C, such as ``int``.

        Notes
        -----
        The header declares these functions, with Jacobians stored row by row (a row per output)::

            int evgp_predict(const double *x, double *mean, double *variance);
            int evgp_mean_jacobian(const double *x, double *mean, double *mean_jacobian);
            int evgp_jacobian(const double *x, double *mean, double *variance,
                              double *mean_jacobian, double *variance_jacobian);

        The functions return 0. A result that is not needed may be NULL. The functions keep no state and use only stack
        memory. The header gives its size. Thus they may run in several threads and in an interrupt.
        ``casadi.external("evgp", ...)`` loads the compiled library.
        """
        function = self.to_casadi(name, include_noise=include_noise)
        return write_c(function, path, jacobian, self.maps.columns, include_noise)

    def _for_casadi(self) -> Exported:
        self._check_smooth("An export to CasADi or C")
        maps = self.maps
        features, inputs = (None if each is None else as_map(each) for each in (maps.feature_map, maps.kernel_map))
        return Exported(self.predictor, features, inputs, maps.n_columns)


def delegate(name: str, takes: Literal["rows", "numbers"] | None = None) -> Any:
    """Make a method of an estimator that calls the method of its posterior, with the same docstring.

    If it takes rows X first, the estimator validates them: ``"rows"`` passes `Rows`, ``"numbers"`` passes an array.
    """
    method: Callable[..., Any] = getattr(Posterior, name)

    @wraps(method)
    def ask(self: Any, *args: Any, **kwargs: Any) -> Any:
        check_fitted(self)
        if takes is None or not (args or "X" in kwargs):
            return method(self._posterior, *args, **kwargs)
        X, *others = args or (kwargs.pop("X"),)
        checked = self._checked(X, name) if takes == "rows" else self._checked_numbers(X, name)
        return method(self._posterior, checked, *others, **kwargs)

    return ask
