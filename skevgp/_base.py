"""What the sparse and the exact model share: intake of X and y, maps, priors, prediction."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin, TransformerMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process.kernels import Kernel
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data

from ._coef_prior import resolve_coef_prior, wide_scale
from ._row_weights import chosen_rows
from ._shapes import like_y
from ._sklearn import Interval, StrOptions
from ._theta import OfKernel, value_at
from ._validation import (
    FLOATS,
    check_integer,
    check_magnitude,
    check_not_vanishing,
    is_frame,
    is_plain,
    validate_frame,
    words_of,
)
from .fitting.start import Units
from .inference.posterior import CoefficientPrior, Predictor
from .kernels.parse import KernelSpec, parse_kernel
from .rows.dask import DaskSource, aligned, as_rows, fit_map_to_chunks, is_dask, predict_chunks
from .rows.mapped import MappedRows, RowShapes, check_shapes, map_rows
from .rows.maps import fit_map, take_rows
from .rows.source import LocalSource, Moments, Source, moments_of_rows

# In place of an infinite prior scale, where any that does not matter will do: so many times what could explain y alone.
_VAGUE = 1e3


@dataclass(frozen=True)
class Problem:
    """What a fit starts from.

    Attributes
    ----------
    data : tuple
        What `ExplicitGaussianProcess._source` makes the source from.
    source : Source
        The rows through the maps.
    units : Units
    spec : KernelSpec
        With the start of the noise.
    vague : ndarray of shape (o, p)
        Which weights have an infinite prior scale; in ``units.prior`` theirs is very wide.
    n_columns : int
        Width of the kernel's inputs.
    per_output : bool
        Whether outputs have inputs or features of their own.
    """

    data: tuple[Any, Any, np.ndarray, Any]
    source: Source
    units: Units
    spec: KernelSpec
    vague: np.ndarray
    n_columns: int
    per_output: bool


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


class ExplicitGaussianProcess(MultiOutputMixin, RegressorMixin, BaseEstimator):
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
        "tol": [Interval(Real, 0, None, closed="left")],
        "random_state": ["random_state"],
        "verbose": ["verbose"],
    }

    feature_map: TransformerMixin | None
    kernel: Kernel | Callable[..., Any] | None
    kernel_map: TransformerMixin | None
    coef_mean: ArrayLike | str
    coef_scale: ArrayLike | str
    coef_cov: ArrayLike | None
    share_coef: bool | Literal["auto"]
    noise_variance: float | None
    normalize_y: bool

    coef_, coef_std_, coef_cov_, coef_prior_mean_, coef_prior_scale_ = (_OfWeights() for _ in range(5))

    _fitted: Fitted
    _spec: KernelSpec
    _row_shapes: RowShapes

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
        """
        if return_cov not in (False, True, "joint"):
            raise ValueError(f"return_cov must be False, True or 'joint'; got {return_cov!r}.")
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be asked for.")
        if not hasattr(self, "_predictor"):
            check_is_fitted(self)
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
            mean, cov = self._predictor.covariance(*rows)
            cov = cov + np.eye(len(array))[:, :, np.newaxis] * noise
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
        rng = check_random_state(random_state)
        mean, cov = self.predict(X, return_cov=True, include_noise=include_noise)
        single = mean.ndim == 1
        mean, cov = mean.reshape(len(mean), -1), cov.reshape(len(mean), len(mean), -1)
        common = np.empty((0, *mean.shape))
        if self._predictor.shared:
            given, array, _ = self._validated(X)
            common = self._predictor.common(*self._inputs_and_features(given, array, slice(None)))
        # Of outputs that share their weights, what comes from these is one draw; all else is independent.
        weights = rng.standard_normal((len(common), n_samples)) if len(common) else np.empty((0, n_samples))
        samples = np.stack(
            [
                rng.multivariate_normal(mean[:, o], cov[:, :, o] - own.T @ own, n_samples, check_valid="ignore").T
                + own.T @ weights
                for o, own in enumerate(np.moveaxis(common, 2, 0))
            ],
            axis=1,
        )
        return samples[:, 0] if single else samples

    def _check_gradient_of(self, theta: ArrayLike | None, eval_gradient: bool) -> None:
        check_is_fitted(self)
        if theta is None and eval_gradient:
            raise ValueError("Gradient can only be evaluated for theta!=None: give theta=kernel_.theta.")

    def _value_at(self, theta: ArrayLike, eval_gradient: bool, of_kernel: OfKernel) -> Any:
        """What is the sum of ``of_kernel`` over outputs, and its gradient; see `value_at`."""
        return value_at(theta, eval_gradient, self._spec.order, self._predictor, of_kernel)

    def _problem(
        self, X: Any, y: Any, sample_weight: Any = None, relative_variance: Any = None, allow_vague: bool = False
    ) -> Problem:
        """Look at X, y and the rows' weights for a new fit: maps, kernel, prior and units."""
        given, X, y = self._validated(X, y, reset=True)
        chosen = chosen_rows(X, y, sample_weight, relative_variance)
        fit_to = fit_map_to_chunks if is_dask(X) else partial(fit_map, chosen=chosen)
        self.feature_map_ = fit_to(self.feature_map, given, y, "feature_map")
        self.kernel_map_ = fit_to(self.kernel_map, given, y, "kernel_map")
        source = self._source(given, X, y, chosen)
        inputs, features, targets = source.sum(moments_of_rows)
        check_not_vanishing(targets.largest, "y")
        check_not_vanishing(inputs.largest, "X, as the kernel sees it,")
        per_output = inputs.mean.ndim == 2 or features.mean.ndim == 2
        for name, moments in (("kernel_map", inputs), ("feature_map", features)):
            if moments.mean.ndim == 2 and len(moments.mean) != len(targets.mean):
                raise ValueError(
                    f"{name}={getattr(self, name)!r} returns a row for each of {len(moments.mean)} outputs, but y has "
                    f"{len(targets.mean)}."
                )
        n_columns = inputs.mean.shape[-1]
        spec = parse_kernel(self.kernel, n_columns)
        if self.noise_variance is not None:
            if spec.starts.noise.value is not None:
                raise ValueError(
                    f"The noise starts either from noise_variance={self.noise_variance!r} or from the WhiteKernel of "
                    f"kernel={self.kernel!r}; give one of them."
                )
            spec = spec.with_noise(self.noise_variance)
        prior, vague = self._prior(given, features, targets, allow_vague)
        target_mean = targets.mean if self.normalize_y else np.zeros(len(targets.mean))
        units = Units.of(source, targets, target_mean, prior)
        self._spec, self._row_shapes = spec, (inputs.mean.shape, features.mean.shape)
        return Problem((given, X, y, chosen), source, units, spec, vague, n_columns, per_output)

    def _prior(
        self, given: Any, features: Moments, targets: Moments, allow_vague: bool
    ) -> tuple[CoefficientPrior, np.ndarray]:
        """The weights' prior, in the user's units, and which of them (o, p) are vague."""
        o, shared = len(targets.mean), self.share_coef
        if isinstance(shared, str):
            shared = bool(getattr(self.feature_map_, "share_coef", False))
        shared = shared and o > 1 and self.feature_map_ is not None
        wide = wide_scale(features.rms, np.sqrt(targets.variance), targets.largest, shared)
        mean, scale, root = resolve_coef_prior(
            self.coef_mean,
            self.coef_scale,
            self.feature_map_,
            given,
            wide,
            coef_cov=self.coef_cov,
            n_outputs=o,
            allow_vague=allow_vague,
        )
        vague = np.isinf(scale)
        unit = _VAGUE * wide_scale(features.rms, targets.largest, targets.largest, shared)
        scale = np.where(vague, unit, scale)
        if shared:
            mean, scale = (np.repeat(values, o, axis=0) for values in (mean, scale))
            root, vague = None if root is None else np.repeat(root, o, axis=0), np.repeat(vague, o, axis=0)
        return CoefficientPrior(mean, scale, np.zeros(scale.shape), root, shared), vague

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "_predictor")

    def _validated(self, X: Any, *y: Any, reset: bool = False) -> tuple[Any, Any, np.ndarray]:
        """X as the maps see it (a data frame stays one), X as the kernel sees it without a map, and y as an array.

        A data frame may hold what is no number if there is a ``kernel_map``: then only the maps see it, and what they
        return is checked. To predict, y is left out.
        """
        given = X
        if is_dask(X):
            validate_data(self, X, reset=reset, skip_check_array=True)
            X, target = aligned(X, *y) if y else (X, np.empty(0))
            return X, X, target
        if is_frame(X) and (self.kernel_map if reset else self.kernel_map_) is not None:
            target = validate_frame(self, X, *y, reset=reset)
        else:
            X, target = self._numbers(X, *y, reset=reset)
        check_magnitude(target, "y")
        return (given if is_frame(given) else X), X, target

    def _numbers(self, X: Any, *y: Any, reset: bool) -> tuple[np.ndarray, np.ndarray]:
        """X and y as arrays of numbers."""
        options = {"multi_output": True, "y_numeric": True} if y else {}
        try:
            validated = validate_data(self, X, *y, reset=reset, dtype=FLOATS, **options)
        except ValueError as error:
            if is_frame(X) and (words := words_of(X)):
                raise ValueError(
                    f"The columns {words} of X are not numbers, but with kernel_map=None the kernel sees all columns: "
                    "give a kernel_map that encodes them or leaves them out."
                ) from error
            raise
        X, target = validated if y else (validated, np.empty(0))
        check_magnitude(X, "X")
        return X, target if target.dtype.kind == "f" else np.asarray(target, dtype=np.float64)

    def _inputs_and_features(self, given: Any, X: Any, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """The kernel's inputs and the features of rows."""
        array = take_rows(X, rows)
        given = array if given is X else take_rows(given, rows)
        inputs, features = map_rows(given, array, self.feature_map_, self.kernel_map_)
        check_shapes((inputs, features), self._row_shapes)
        return inputs, features

    def _source(self, given: Any, X: Any, y: np.ndarray, chosen: Any, shapes: RowShapes | None = None) -> Source:
        """The rows that count, through the maps, which may have to be of certain shapes."""
        maps = self.feature_map_, self.kernel_map_
        if is_dask(X):
            return DaskSource(X, y, *maps, chosen, shapes)
        rows = MappedRows(given, X, y.reshape(len(y), -1), *maps, chosen, shapes)
        return LocalSource(rows, chosen.n_rows, chosen.positions)

    def _set_common_attributes(self) -> None:
        """What is known of weights, if there are any, noise and kernel."""
        fitted, prior = self._fitted, self._fitted.units.prior
        self._predictor: Predictor = fitted.predictor()
        first = 0 if self._single_output else slice(None)
        for name, attribute in vars(ExplicitGaussianProcess).items():
            if isinstance(attribute, _OfWeights):
                self.__dict__.pop(name, None)
        if self.feature_map_ is not None:
            mean, covariance = self._predictor.coefficients()
            first = 0 if prior.shared else first
            self.coef_, self.coef_cov_ = mean[first], covariance[first]
            self.coef_std_ = np.sqrt(np.diagonal(self.coef_cov_, axis1=-2, axis2=-1))
            self.coef_prior_mean_, self.coef_prior_scale_ = prior.mean[first].copy(), prior.scale[first].copy()
        self.noise_variance_ = float(self._predictor.noise[0]) if self._single_output else self._predictor.noise.copy()
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
            warnings.warn(message, ConvergenceWarning, stacklevel=4)

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
