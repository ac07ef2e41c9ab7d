"""The posterior of a fitted model. Everything that is asked of a fitted model is asked of it.

An estimator validates X, and hands it on. Methods take X in one of two ways: as ``Rows``, what the maps see and what
the kernel sees without a map, or as numbers.
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
from .c_code import write_c
from .casadi import Exported, with_base
from .compiled import CompiledPredictor
from .derivatives import gradient_covariance, mapped
from .functions import Functions, FunctionSamples

# Of the derivatives of all rows at once.
_NUMBERS = 2**20


class Rows(NamedTuple):
    """Validated rows: as the maps see them (a data frame stays one), and as the kernel sees them without a map."""

    given: Any
    array: Any


@dataclass(frozen=True)
class Posterior:
    """Maps and frozen predictor of a fitted model, and columns of X that are added to its predictions.

    Attributes
    ----------
    predictor : Predictor
        In the user's units.
    maps : Maps
        Fitted.
    base : ndarray of shape (k, n_outputs), optional
        Indices of columns of X: k columns are added to the mean of each output.
    """

    predictor: Predictor
    maps: Maps
    base: np.ndarray | None = None

    def with_base(self, columns: np.ndarray) -> Posterior:
        """The posterior of y where this one is that of y minus some columns of X, one for each output."""
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
        """Predict y: the mean, and with it the standard deviation or the covariance between rows."""
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
        """Draw functions at rows, exactly: (n, n_samples) or (n, n_outputs, n_samples)."""
        noise = self.predictor.noise if include_noise else np.zeros_like(self.predictor.noise)
        rows = self.maps.rows(*X, slice(None))
        samples = self.predictor.sample(*rows, noise, n_samples, check_random_state(random_state))
        return samples[:, 0] if samples.shape[1] == 1 else samples

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
        return like_y(np.concatenate([self.predictor.novelty(*rows) for rows in self._pieces(X)]))

    def _pieces(self, X: Any) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Kernel inputs and features of rows, so many at once that memory stays small and products are large."""
        size = self.predictor.rows_at_once
        return (self.maps.rows(X.given, X.array, slice(first, first + size)) for first in range(0, len(X.array), size))

    # --- derivatives --------------------------------------------------------------------------------------------------

    def value_and_jacobian(self, X: ArrayLike, return_std: bool = False, include_noise: bool = True) -> Any:
        """Predict y, and how that changes with the columns of X.

        Derivatives go through kernel, kernel map and feature map. They are exact for this package's transformers and
        kernels, for scikit-learn's scalers, PolynomialFeatures, SplineTransformer, PCA and TruncatedSVD, for pipelines
        and unions of these, and for any map with a method ``jacobian(X)`` that returns (n_samples, n_features_out,
        n_features). Of other maps they are central differences, good to about ten digits where the map is smooth on the
        scale of the rows of `fit`.

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
        parts = [fast.value_and_jacobian(rows, return_std) for rows in self._few(X)]
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
        fast, maps = self.compile(), as_maps(self.maps)
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
        """Rows as floats, few enough at once that derivatives fit into memory."""
        rows = np.asarray(X, dtype=np.float64)
        stacked = sum(group.root.shape[0] * group.root.shape[2] for group in self.predictor.groups)
        size = int(np.clip(_NUMBERS // (stacked * rows.shape[1]), 1, 1024))
        return (rows[first : first + size] for first in range(0, len(rows), size))

    # --- what control loops and optimisers call -----------------------------------------------------------------------

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
        return CompiledPredictor(self.predictor, *as_maps(self.maps), include_noise, self.base)

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
        check_integer(n, "n", minimum=1)
        check_integer(n_waves, "n_waves", minimum=1)
        return FunctionSamples(self.functions(), n, n_waves, check_random_state(random_state))

    def functions(self) -> Functions:
        """The posterior as functions to be drawn, and followed along the paths that they make."""
        return Functions(self.predictor, *as_maps(self.maps), self.base)

    def to_casadi(self, name: str = "evgp", *, include_noise: bool = True, parametric: bool = False) -> Any:
        """Write mean and variance as a CasADi function, which differentiates them exactly.

        Parameters
        ----------
        name : str, default="evgp"
            Of the function.
        include_noise : bool, default=True
            Whether the variance is of y, with the learned noise, or of the noise-free g(x).
        parametric : bool, default=False
            Whether all that `partial_fit` changes is a second argument, ``parameters``, which `to_casadi_parameters`
            returns: then an optimal control problem that is built once goes on with a model that learns. Its variance
            takes a few times as long.

        Returns
        -------
        function : casadi.Function
            x of shape (n_features,) -> (mean, variance), each of shape (n_outputs,), in MX; the names of arguments and
            results are ``x``, ``parameters``, ``mean`` and ``variance``. Where it is called with symbols it is put in
            as expressions.

        Raises
        ------
        ImportError
            If CasADi is not installed; the message gives the pip command.
        ValueError, TypeError
            If the kernel, or a map, has no expression in CasADi: the message names it and lists those that have one. A
            map of your own gets one by a method ``to_casadi(x)``, from an MX of shape (n_features, 1) to one of shape
            (n_features_out, 1), or a list of these if it returns a row for each output.
        sklearn.exceptions.NotFittedError
            If the model is not fitted.

        Notes
        -----
        Numbers are those of `predict` but for rounding, which grows where inducing points are hard to tell apart. The
        standard deviation is left to the caller: a square root has no derivative where the variance is 0.

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
        """Give what the function of ``to_casadi(parametric=True)`` takes beside x, as the model now is.

        Parameters
        ----------
        out : ndarray of shape (n_parameters,), default=None
            Where to put it; None makes a new array.

        Returns
        -------
        parameters : ndarray of shape (n_parameters,)
            For each group of outputs that share inducing points, of which there are m, in the order of their first
            outputs: the weights of the mean, of shape (outputs of the group, m + n_h), then the roots of the
            covariance, (outputs of the group, m + n_h, m + n_h). After all groups what is added to the weights of
            features, (n_outputs, n_h), what is added to the mean, (n_outputs,), and the noise variances, (n_outputs,).
            Rows follow each other. Of these `partial_fit` changes weights and roots.

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
        """Write mean and variance, and their Jacobians, as C that needs nothing but the standard library's mathematics.

        Parameters
        ----------
        path : str or path-like
            A folder, or the file that ends in ``.c``; the header goes beside it.
        name : str, default="evgp"
            What the names of the C functions begin with, and of the files in a folder.
        jacobian : bool, default=True
            Whether there are functions for the Jacobians too.
        include_noise : bool, default=True
            Whether the variance is of y, with the learned noise, or of the noise-free g(x).

        Returns
        -------
        source, header : Path
            The files. ``gcc -std=c99 -O2 -c evgp.c`` builds them, with ``-lm`` where it is linked.

        Raises
        ------
        ImportError, ValueError, TypeError, sklearn.exceptions.NotFittedError
            As `to_casadi`, and if there is no such folder, or the name is taken in C, as ``int`` and ``sin`` are.

        Notes
        -----
        The header declares, with rows of Jacobians following each other (one per output)::

            int evgp_predict(const double *x, double *mean, double *variance);
            int evgp_mean_jacobian(const double *x, double *mean, double *mean_jacobian);
            int evgp_jacobian(const double *x, double *mean, double *variance,
                              double *mean_jacobian, double *variance_jacobian);

        They return 0, take no memory but the stack (the header says how much), keep nothing from call to call, and so
        may run in several threads and in an interrupt. Any result may be NULL. The compiled library also is what
        ``casadi.external("evgp", ...)`` loads.
        """
        function = self.to_casadi(name, include_noise=include_noise)
        return write_c(function, path, jacobian, self.maps.columns, include_noise)

    def _for_casadi(self) -> Exported:
        maps = self.maps
        features, inputs = (None if each is None else as_map(each) for each in (maps.feature_map, maps.kernel_map))
        return Exported(self.predictor, features, inputs, maps.n_columns)


# The methods that take rows, and the estimator's method that validates these.
_TAKES = {
    "novelty": "_checked",
    "value_and_jacobian": "_checked_numbers",
    "jacobian": "_checked_numbers",
    "predict_gradient": "_checked_numbers",
}


def delegate(name: str) -> Any:
    """A method of a fitted estimator that asks its posterior, with the documentation of the method of `Posterior`."""
    method: Callable[..., Any] = getattr(Posterior, name)
    takes = _TAKES.get(name)

    @wraps(method)
    def ask(self: Any, *args: Any, **kwargs: Any) -> Any:
        check_fitted(self)
        if takes is None or not (args or "X" in kwargs):
            return method(self._posterior, *args, **kwargs)
        X, *others = args or (kwargs.pop("X"),)
        return method(self._posterior, getattr(self, takes)(X, name), *others, **kwargs)

    return ask
