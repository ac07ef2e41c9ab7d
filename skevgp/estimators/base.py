"""What the sparse and the exact model share: prediction, samples, what is known of weights, noise and kernel."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any, ClassVar, Literal, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import MultiOutputMixin, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_random_state

from ..data.dask import as_rows, predict_chunks
from ..exceptions import warn_user
from ..fitting.coef_prior import coef_names
from ..fitting.units import Units
from ..model.predictor import Predictor
from ..utils.shapes import like_y
from ..utils.sklearn import Interval, StrOptions
from ..utils.validation import check_fitted, check_integer, is_dask, is_plain
from .control import ForControl
from .exportable import Exportable
from .summary import ModelSummary, Summarised, of_gaussian_process


class Fitted(Protocol):
    """What `ExplicitGaussianProcess` needs of a fit."""

    @property
    def units(self) -> Units:
        """The units and the prior."""

    @property
    def messages(self) -> tuple[str, ...]:
        """What the user should know of how the fit ended."""

    def predictor(self) -> Predictor:
        """Of all outputs, in the user's units."""

    def limits(self, name: str, output: int) -> np.ndarray:
        """Limits (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""


class _OfWeights:
    """An attribute that a fit sets if there are weights, and an AttributeError that says so if there are none."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, model: Any, owner: type) -> Any:
        # Python looks into the instance first.
        if model is None:
            return self
        raise AttributeError(
            f"{owner.__name__} has {self._name} only after a fit with a feature_map: without one there are no weights."
        )


class ExplicitGaussianProcess(MultiOutputMixin, RegressorMixin, Summarised, Exportable, ForControl):
    """A Gaussian process with explicit features, however it is fitted."""

    _parameter_constraints: ClassVar[dict[str, Any]] = {
        "feature_map": "no_validation",
        "kernel": "no_validation",
        "kernel_map": "no_validation",
        "coef_mean": ["array-like", Real, StrOptions({"auto"})],
        "coef_scale": ["array-like", Real, StrOptions({"auto"})],
        "coef_cov": ["array-like", None],
        "share_coef": ["boolean", StrOptions({"auto"})],
        "noise_variance": [Interval(Real, 0, None, closed="neither"), None],
        "normalize_y": ["boolean"],
        "max_iter": [Interval(Integral, 0, None, closed="left")],
        "max_time": [Interval(Real, 0, None, closed="neither"), None],
        "tol": [Interval(Real, 0, None, closed="left")],
        "random_state": ["random_state"],
        "verbose": ["verbose"],
    }

    coef_, coef_std_, coef_cov_, coef_prior_mean_, coef_prior_scale_, coef_names_ = (_OfWeights() for _ in range(6))

    _fitted: Fitted
    _predictor: Predictor

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
            For a Dask array the results are lazy Dask arrays of the same chunks.
        return_std : bool, default=False
            Whether to return the standard deviation too.
        return_cov : bool or "joint", default=False
            Whether to return the covariance between rows too, of each output; ``"joint"`` also between outputs, which
            depend on each other if they share their weights.
        include_noise : bool, default=True
            Whether they are of y, with the learned noise, or of the noise-free g(x).

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs)
            Of y and of g(x) alike.
        std : ndarray of the same shape
            If ``return_std``.
        cov : ndarray of shape (n_samples, n_samples) or (n_samples, n_samples, n_outputs)
            If ``return_cov``. If that is ``"joint"``, of shape (n_samples * n_outputs, n_samples * n_outputs), in the
            order of ``mean.ravel()``.

        Raises
        ------
        ValueError
            If X does not fit the training data, is not finite, both std and covariance are asked for, or the covariance
            of the rows of a Dask array.

        Notes
        -----
        The diagonal of the covariance is the square of ``std``. Neither is below the rounding error of the variance,
        about 1e-15 of the signal's: smaller variances cannot be told from 0.
        """
        if np.ndim(return_cov) > 0 or return_cov not in (False, True, "joint"):
            raise ValueError(f"return_cov must be False, True or 'joint'; got {return_cov!r}.")
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be asked for.")
        if not hasattr(self, "_predictor"):
            return self._before_fit(X).predict(X, return_std, return_cov, include_noise)
        if is_dask(X):
            if return_cov:
                raise ValueError("return_cov needs all rows at once: not for Dask arrays. Give it X.compute().")
            X = as_rows(X, "X", known=False)
            self._validated(X)
            shape = () if self._single_output else (self._n_outputs,)
            return predict_chunks(self, X, return_std, include_noise, shape)
        given: Any = X
        array: Any = X
        if not is_plain(self, X):
            given, array, _ = self._validated(X)
        noise = self._predictor.noise if include_noise else np.zeros_like(self._predictor.noise)
        if return_cov is not False:
            rows = self._inputs_and_features(given, array, slice(None))
            mean, cov = self._predictor.covariance(*rows, noise)
            if return_cov == "joint":
                return like_y(mean), self._predictor.jointly(cov, *rows)
            return like_y(mean), like_y(cov)
        means, deviations = [], []
        size = self._predictor.rows_at_once
        for first in range(0, len(array), size):
            rows = self._inputs_and_features(given, array, slice(first, first + size))
            mean, variance = self._predictor.predict(*rows, return_std)
            means.append(mean)
            if variance is not None:
                deviations.append(np.sqrt(variance + noise))
        mean = like_y(np.concatenate(means))
        return (mean, like_y(np.concatenate(deviations))) if return_std else mean

    def sample_y(
        self,
        X: ArrayLike,
        n_samples: int = 1,
        random_state: int | np.random.RandomState | None = 0,
        include_noise: bool = True,
    ) -> np.ndarray:
        """Draw functions from the posterior at some rows.

        Parameters
        ----------
        X : array-like of shape (n_rows, n_features)
            Where the functions are evaluated.
        n_samples : int, default=1
            How many functions.
        random_state : int, RandomState instance or None, default=0
            Draws them: an integer gives the same at each call.
        include_noise : bool, default=True
            Whether samples are of y, with the learned noise, or of the noise-free g(x).

        Returns
        -------
        samples : ndarray of shape (n_rows, n_samples) or (n_rows, n_outputs, n_samples)
            One function per entry of the last axis.

        Raises
        ------
        ValueError, TypeError
            If X does not fit the training data, is not finite or is a Dask array, or ``n_samples`` is not a positive
            integer.
        """
        check_integer(n_samples, "n_samples", minimum=1)
        if is_dask(X):
            raise ValueError("sample_y needs all rows at once: not for Dask arrays. Give it X.compute().")
        if not hasattr(self, "_predictor"):
            return self._before_fit(X).sample_y(X, n_samples, random_state, include_noise)
        given, array, _ = self._validated(X)
        rows = self._inputs_and_features(given, array, slice(None))
        noise = self._predictor.noise if include_noise else np.zeros_like(self._predictor.noise)
        samples = self._predictor.sample(*rows, noise, n_samples, check_random_state(random_state))
        return samples[:, 0] if samples.shape[1] == 1 else samples

    def _check_gradient_of(self, theta: ArrayLike | None, eval_gradient: bool) -> None:
        check_fitted(self)
        if theta is None and eval_gradient:
            raise ValueError("Gradient can only be evaluated for theta!=None: give theta=kernel_.theta.")

    def _numbers_of_kernels(self) -> list[np.ndarray]:
        """Of each output k̃'s hyperparameters and s², as fitted, in the user's units."""
        signal = self._predictor.signal
        return [np.append(group.hyperparameters, signal[o]) for o, group in enumerate(self._predictor.by_output)]

    def _before_fit(self, X: Any) -> Self:
        """What predicts as long as there was no fit: nothing, but for a model with a prior of its own."""
        check_fitted(self)
        raise AssertionError

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "_predictor")

    def _described(self) -> ModelSummary:
        return of_gaussian_process(self)

    def _set_posterior(self) -> None:
        """What is known of weights, if there are any, and noise."""
        self._predictor = self._fitted.predictor()
        if self.feature_map_ is not None:
            mean, covariance = self._predictor.coefficients()
            first = self._of_weights
            self.coef_, self.coef_cov_ = mean[first], covariance[first]
            self.coef_std_ = np.sqrt(np.diagonal(self.coef_cov_, axis1=-2, axis2=-1))
        self.noise_variance_ = float(self._predictor.noise[0]) if self._single_output else self._predictor.noise.copy()

    @property
    def _of_weights(self) -> int | slice:
        """Which rows of arrays (n_outputs, ...) of weights attributes hold."""
        return 0 if self._single_output or self._predictor.shared else slice(None)

    def _set_common_attributes(self) -> None:
        """The same, and what stays as it is when there are more rows: the prior of weights, and the kernel."""
        for name, attribute in vars(ExplicitGaussianProcess).items():
            if isinstance(attribute, _OfWeights):
                self.__dict__.pop(name, None)
        self._set_posterior()
        fitted, prior = self._fitted, self._fitted.units.prior
        if self.feature_map_ is not None:
            columns, first = getattr(self, "feature_names_in_", None), self._of_weights
            self.coef_names_ = coef_names(self.feature_map_, columns, self.coef_.shape[-1])
            self.coef_prior_mean_, self.coef_prior_scale_ = prior.mean[first].copy(), prior.scale[first].copy()
        kernels = [
            self._spec.to_sklearn(
                group.hyperparameters,
                fitted.limits("hyperparameters", o),
                float(self._predictor.signal[o]),
                fitted.limits("signal", o),
            )
            for o, group in enumerate(self._predictor.by_output)
        ]
        self.kernel_ = kernels[0] if self._single_output else kernels

    def _warn_of(self, messages: tuple[str, ...]) -> None:
        """Tell the user of ``fit`` how it ended."""
        for message in (*messages, *(self._at_bounds() if self.max_iter != 0 else ())):
            warn_user(message, ConvergenceWarning)

    def _at_bounds(self) -> list[str]:
        """Which parameters of the user's kernel ended at its bounds; what outputs share, once."""
        signal, noise = self._predictor.signal, self._predictor.noise
        return list(
            dict.fromkeys(
                message
                for o, group in enumerate(self._predictor.by_output)
                for message in self._spec.at_bounds(group.hyperparameters, float(signal[o]), float(noise[o]))
            )
        )

    @property
    def _n_outputs(self) -> int:
        return len(self._predictor.noise)

    @property
    def _single_output(self) -> bool:
        """Whether nothing has an axis of outputs: for a y of one column too, as in scikit-learn's GPR."""
        return self._n_outputs == 1
