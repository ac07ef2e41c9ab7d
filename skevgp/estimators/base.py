"""Common part of the sparse and the exact model: prediction, samples, and the attributes that a fit sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import MultiOutputMixin, RegressorMixin, TransformerMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import Kernel

from ..control.posterior import Posterior, Rows, delegate
from ..data.dask import as_rows, predict_chunks
from ..data.dataset import Dataset, checked_numbers, checked_rows
from ..exceptions import warn_user
from ..fitting.fitted import Fitted
from ..fitting.prior import CoefPrior, as_coef_prior, coef_names
from ..fitting.problem import Problem
from ..fitting.theta import ThetaPosterior, restricted
from ..kernels.parse import KernelSpec
from ..noise import as_noise
from ..noise.base import Noise
from ..solvers import as_solver
from ..utils.state import StatefulEstimator
from ..utils.validation import check_fitted, check_integer, is_dask, is_plain
from .summary import ModelSummary, html_of, of_gaussian_process

# Attributes of models with weights only.
_OF_WEIGHTS = (
    "coef_",
    "coef_std_",
    "coef_cov_",
    "coef_names_",
    "coef_prior_mean_",
    "coef_prior_scale_",
    "coef_groups_",
)
# Attributes of models whose feature map has parameters.
_OF_THETA = ("theta_", "theta_std_", "theta_cov_")
# Attributes that are computed when they are read.
_AFTER_FIT = ("lower_bound_", "upper_bound_")


class GaussianProcess(MultiOutputMixin, RegressorMixin, StatefulEstimator):
    """A Gaussian process with explicit features: a shell around the `Posterior` of a fit."""

    feature_map: TransformerMixin | None
    kernel: Kernel | Callable[..., Any] | None
    kernel_map: TransformerMixin | None
    coef_prior: CoefPrior | Literal["auto"]
    noise: str | Noise
    normalize_y: bool
    max_iter: Any
    solver: Any

    _posterior: Posterior
    _fitted: Fitted
    # The posterior of the parameters of the feature map, if it has any.
    _theta: ThetaPosterior | None = None
    # The share of the error that nearest rows would take away. None: it is not known.
    _gain_of_neighbours: float | None = None

    def predict(
        self,
        X: ArrayLike,
        return_std: bool = False,
        return_cov: bool | Literal["joint"] = False,
        include_noise: bool = True,
    ) -> Any:
        """Predict y.

        Parameters
        ----------
        X : array-like or dask.array.Array of shape (n_samples, n_features)
            Rows with the columns of `fit`. For a Dask array, the results are lazy Dask arrays of the same chunks.
        return_std : bool, default=False
            Whether to return the standard deviation too.
        return_cov : bool or "joint", default=False
            Whether to return the covariance between rows too, for each output. If ``"joint"``, the covariance between
            outputs is included. Outputs depend on each other if they share their weights or parameters of the features.
        include_noise : bool, default=True
            Whether standard deviation and covariance include the learned noise of y. If False, they are those of the
            noise-free g(x).

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            Posterior mean.
        std : ndarray of the same shape
            Standard deviation. It is returned only if ``return_std`` is True.
        cov : ndarray of shape (n_samples, n_samples) or (n_samples, n_samples, n_outputs)
            Covariance. It is returned only if ``return_cov`` is set. With ``"joint"``, its shape is (n_samples *
            n_outputs, n_samples * n_outputs), in the order of ``mean.ravel()``.

        Raises
        ------
        ValueError
            If X does not fit the training data or is not finite. If both ``return_std`` and ``return_cov`` are set, or
            ``return_cov`` is set for a Dask array.

        Notes
        -----
        The diagonal of the covariance is the square of ``std``. Variances are at least their rounding error, about
        1e-15 of the signal variance.
        """
        if np.ndim(return_cov) > 0 or return_cov not in (False, True, "joint"):
            raise ValueError(f"return_cov must be False, True or 'joint'; got {return_cov!r}.")
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be requested.")
        if not self.__sklearn_is_fitted__():
            return self._before_fit(X).predict(X, return_std, return_cov, include_noise)
        if is_dask(X):
            if return_cov:
                raise ValueError("return_cov needs all rows in memory. Pass X.compute() instead of a Dask array.")
            X = as_rows(X, "X", known=False)
            checked_rows(self, X)
            shape = () if self._n_outputs == 1 else (self._n_outputs,)
            return predict_chunks(self, X, return_std, include_noise, shape)
        return self._posterior.predict(self._checked(X), return_std, return_cov, include_noise)

    def sample_y(
        self,
        X: ArrayLike,
        n_samples: int = 1,
        random_state: int | np.random.RandomState | None = 0,
        include_noise: bool = True,
    ) -> np.ndarray:
        """Draw functions from the posterior at some rows.

        Samples have the covariance of `predict` with ``return_cov=True``. Memory is quadratic in the number of rows,
        and time is cubic. For thousands of rows, use `sample_functions`, which is approximate but takes linear time.

        Parameters
        ----------
        X : array-like of shape (n_rows, n_features)
            Rows at which the functions are evaluated.
        n_samples : int, default=1
            Number of functions.
        random_state : int, RandomState instance or None, default=0
            Seed of the functions. An integer gives the same functions at each call.
        include_noise : bool, default=True
            Whether samples are those of y, with the learned noise. If False, they are those of the noise-free g(x).

        Returns
        -------
        samples : ndarray of shape (n_rows, n_samples) or (n_rows, n_outputs, n_samples)
            One function per entry of the last axis.

        Raises
        ------
        ValueError, TypeError
            If X does not fit the training data, is not finite or is a Dask array, or ``n_samples`` is not a positive
            integer.

        See Also
        --------
        sample_functions : Functions without noise that can be evaluated anywhere.
        """
        check_integer(n_samples, "n_samples", minimum=1)
        if not is_dask(X) and not self.__sklearn_is_fitted__():
            return self._before_fit(X).sample_y(X, n_samples, random_state, include_noise)
        return self._posterior.sample_y(self._checked(X, "sample_y"), n_samples, random_state, include_noise)

    value_and_jacobian = delegate("value_and_jacobian", takes="numbers")
    jacobian = delegate("jacobian", takes="numbers")
    predict_gradient = delegate("predict_gradient", takes="numbers")
    novelty = delegate("novelty", takes="rows")
    compile = delegate("compile")
    sample_functions = delegate("sample_functions")
    to_casadi = delegate("to_casadi")
    to_casadi_parameters = delegate("to_casadi_parameters")
    to_c = delegate("to_c")
    to_l4acados = delegate("to_l4acados")

    def summary(self) -> ModelSummary:
        """Summarise the fit: kernel, noise, bounds on the likelihood, and weights with their prior.

        Returns
        -------
        summary : ModelSummary
            Object that prints as text. A notebook shows it as tables, and ``to_frame()`` returns a data frame.
        """
        check_fitted(self)
        return of_gaussian_process(self)

    @property
    def _repr_html_(self) -> Callable[[], str]:
        # The attribute exists only if scikit-learn's option ``display`` is "diagram".
        diagram: Callable[[], str] = super()._repr_html_
        return lambda: diagram() + html_of(self)

    def _repr_mimebundle_(self, **kwargs: Any) -> dict[str, str]:
        bundle: dict[str, str] = super()._repr_mimebundle_(**kwargs)
        if "text/html" in bundle:
            bundle["text/html"] += html_of(self)
        return bundle

    def set_params(self, **params: Any) -> Self:
        """Set parameters of the estimator and of its nested objects.

        With ``solver__...``, a solver that is a string becomes an object. The same holds for the noise and the prior of
        the weights.

        Parameters
        ----------
        **params : dict
            Parameters of the estimator and of its nested objects.

        Returns
        -------
        self : object
            The estimator itself.
        """
        for name, as_object in (("solver", as_solver), ("noise", as_noise), ("coef_prior", as_coef_prior)):
            value = params.get(name, getattr(self, name, None))
            if isinstance(value, str) and any(key.startswith(f"{name}__") for key in params):
                params[name] = as_object(value)
        return super().set_params(**params)

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "_posterior")

    def __getattr__(self, name: str) -> Any:
        kind = type(self).__name__
        if name in _OF_WEIGHTS:
            raise AttributeError(
                f"{kind} has {name} only after a fit with a feature_map, because its features have the weights."
            )
        if name in _OF_THETA:
            raise AttributeError(f"{kind} has {name} only after a fit with a feature_map that has parameters.")
        if name in _AFTER_FIT and not self.__sklearn_is_fitted__():
            raise AttributeError(f"{kind} has {name} only after fit.")
        raise AttributeError(f"{kind!r} object has no attribute {name!r}")

    @property
    def _counted_twice(self) -> float:
        # Models of outputs whose features share parameters are each given the other outputs.
        return 0.0 if self._theta is None else self._theta.counted_twice

    # --- validation before, and attributes after a fit ----------------------------------------------------------------

    def _before_fit(self, X: Any) -> Self:
        """Return a model that predicts from the prior, or raise NotFittedError if there is none."""
        check_fitted(self)
        raise AssertionError

    def _checked(self, X: Any, asked: str = "predict") -> Rows:
        """Validate X for a prediction, for the maps and for a kernel without a map."""
        if is_plain(self, X):
            return Rows(X, X)
        if is_dask(X):
            raise ValueError(f"{asked} needs rows in memory. Pass X.compute() instead of a Dask array.")
        return Rows(*checked_rows(self, X)[:2])

    def _checked_numbers(self, X: Any, asked: str) -> np.ndarray:
        """Validate X as numbers, for derivatives."""
        if is_plain(self, X):
            return X
        if is_dask(X):
            raise ValueError(f"{asked} needs rows in memory. Pass X.compute() instead of a Dask array.")
        return checked_numbers(self, X)[0]

    @property
    def _n_outputs(self) -> int:
        # A y of one column has no axis of outputs, as in scikit-learn's GPR.
        return len(self._posterior.predictor.noise)

    def _set_posterior(
        self,
        data: Dataset,
        problem: Problem,
        spec: KernelSpec,
        fitted: Fitted,
        theta: ThetaPosterior | None = None,
    ) -> None:
        """Store the posterior of a fit, and the attributes that describe it."""
        for name in (*_OF_WEIGHTS, *_OF_THETA):
            self.__dict__.pop(name, None)
        maps = replace(data.maps, shapes=problem.shapes)
        self.feature_map_, self.kernel_map_, self._fitted = maps.feature_map, maps.kernel_map, fitted
        self._theta, found = theta, fitted.predictor()
        if theta is not None:
            self.feature_map_, found = maps.feature_map.feature_map, theta.predictor(fitted)
        self._posterior = Posterior(found, maps)
        self._set_weights_and_noise()
        predictor, prior = self._posterior.predictor, fitted.prior
        if self.feature_map_ is not None:
            first = 0 if self._n_outputs == 1 or predictor.shared else slice(None)
            self.coef_names_ = coef_names(self.feature_map_, maps.columns, self.coef_.shape[-1])
            prior = restricted(prior, self.coef_.shape[-1])
            self.coef_prior_mean_, self.coef_prior_scale_ = prior.mean[first].copy(), prior.scale[first].copy()
            labels = np.array([*prior.labels, ""], dtype=object)
            self.coef_groups_ = labels[np.full(prior.scale.shape, -1) if prior.groups is None else prior.groups][first]
        mode = fitted.at_mode.predictor()
        kernels = [
            spec.to_sklearn(
                group.hyperparameters,
                fitted.limits("hyperparameters", o),
                float(mode.signal[o]),
                fitted.limits("signal", o),
            )
            for o, group in enumerate(mode.by_output)
        ]
        self.kernel_ = kernels[0] if self._n_outputs == 1 else kernels

    def _set_weights_and_noise(self) -> None:
        """Set the attributes that new rows change."""
        predictor = self._posterior.predictor
        if self.feature_map_ is not None:
            mean, covariance = predictor.coefficients()
            first = 0 if self._n_outputs == 1 or predictor.shared else slice(None)
            p = mean.shape[1]
            if self._theta is not None:
                # The columns of the linearisation have weights too, which are no weights of features.
                p -= len(self._posterior.maps.feature_map.columns)
                self.theta_, self.theta_std_, self.theta_cov_ = self._theta.attributes()
            self.coef_, self.coef_cov_ = mean[first, ..., :p], covariance[first, ..., :p, :p]
            self.coef_std_ = np.sqrt(np.diagonal(self.coef_cov_, axis1=-2, axis2=-1))
        self.noise_variance_: Any = float(predictor.noise[0]) if self._n_outputs == 1 else predictor.noise.copy()

    def _warn(self, messages: tuple[str, ...], spec: KernelSpec) -> None:
        """Warn about the end of the fit, and about parameters of the given kernel that ended at their bounds."""
        predictor = self._fitted.at_mode.predictor()
        at_bounds = (
            []
            if self.max_iter == 0
            else [
                message
                for o, group in enumerate(predictor.by_output)
                for message in spec.at_bounds(
                    group.hyperparameters, float(predictor.signal[o]), float(predictor.noise[o])
                )
            ]
        )
        # Messages on parameters that outputs share are given once.
        for message in (*messages, *dict.fromkeys(at_bounds)):
            warn_user(message, ConvergenceWarning)
