"""A fitted model for control loops: predictions and derivatives of a few rows, without validation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..data.rows import of_outputs
from ..maps import Map
from ..model.predictor import Predictor, PredictorGroup
from ..model.roots import times, transposed_times
from ..utils.shapes import like_y
from ..utils.validation import check_fitted
from .derivatives import MappedRows, chained, mapped
from .near import NearGroup

_NONE = np.empty((0, 0))
# Two points are the same if they differ by rounding only: by at most this share of the largest.
_ROUNDING = 1e-9


class CompiledPredictor:
    """A fitted model for control loops, as `EVGPRegressor.compile` returns it.

    Predictions equal those of ``predict`` up to rounding. Rows are not validated: pass finite float64 arrays with the
    columns of `fit` and at least one row. Threads may share the object, and it can be pickled. For L4acados, use
    `EVGPRegressor.to_l4acados`.

    Parameters
    ----------
    predictor : Predictor
        The posterior, in the user's units.
    feature_map, kernel_map : Map or None
        The fitted transformers as functions of arrays.
    include_noise : bool, default=True
        Whether standard deviations are those of y, with the learned noise, or those of the noise-free g(x).
    base : ndarray of shape (k, n_outputs), default=None
        Indices of columns that are added to the mean. A `ResidualRegressor` has them.

    Examples
    --------
    >>> import numpy as np
    >>> from skevgp import EVGPRegressor
    >>> X = np.linspace(0.0, 6.0, 60)[:, np.newaxis]
    >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, np.column_stack([np.sin(X), np.cos(X)]))
    >>> fast = model.compile()
    >>> mean, std = fast.predict(np.array([1.0]), return_std=True)
    >>> mean.shape, fast.value_and_jacobian(X)[1].shape
    ((2,), (60, 2, 1))
    """

    _state: _State

    def __init__(
        self,
        predictor: Predictor,
        feature_map: Map | None,
        kernel_map: Map | None,
        include_noise: bool = True,
        base: np.ndarray | None = None,
    ):
        self.include_noise, self.base = include_noise, base
        self._feature_map, self._kernel_map = feature_map, kernel_map
        self._freeze(predictor)

    def update(self, model: Any) -> None:
        """Copy the weights of a model that has learned further rows by ``partial_fit``.

        Calls that run in other threads end with the old weights.

        Parameters
        ----------
        model : EVGPRegressor, EGPRegressor or ResidualRegressor
            The model that was compiled, not fitted again since: with the same maps, kernel and inducing points.

        Raises
        ------
        ValueError
            If the model was fitted again, or is another one.
        NotFittedError
            If the model is not fitted.
        """
        check_fitted(model)
        predictor = model._posterior.predictor
        if not _goes_on(self._state[0], predictor):
            raise ValueError("update needs a model of the same fit. Compile a model again after it was fitted again.")
        self._freeze(predictor)

    def _freeze(self, predictor: Predictor) -> None:
        noise = predictor.noise if self.include_noise else np.zeros_like(predictor.noise)
        groups = tuple(_group_of(group, predictor.offset[group.outputs]) for group in predictor.groups)
        self._state = (predictor, groups, noise)

    def predict(self, X: np.ndarray, return_std: bool = False) -> Any:
        """Predict y.

        Parameters
        ----------
        X : ndarray of shape (n_features,) or (n_samples, n_features)
            One row or several.
        return_std : bool, default=False
            Whether to return the standard deviation too.

        Returns
        -------
        mean : ndarray of shape (n_outputs,) or (n_samples, n_outputs)
            The posterior mean. The axis of outputs is left out if y has one column.
        std : ndarray of the same shape
            The standard deviation. Only if ``return_std=True``.
        """
        rows, state = X if X.ndim == 2 else X[np.newaxis], self._state
        inputs = rows if self._kernel_map is None else self._kernel_map.value(rows)
        features = _NONE if self._feature_map is None else self._feature_map.value(rows)
        _, mean, std = self._said(state, rows, inputs, features, return_std)
        mean = like_y(mean if X.ndim == 2 else mean[0])
        return (mean, like_y(std if X.ndim == 2 else std[0])) if return_std else mean

    def value_and_jacobian(self, X: np.ndarray, return_std: bool = False) -> Any:
        """Predict y and the derivatives of the prediction with respect to the columns of X.

        Parameters
        ----------
        X : ndarray of shape (n_features,) or (n_samples, n_features)
            One row or several.
        return_std : bool, default=False
            Whether to return the standard deviation and its derivatives too.

        Returns
        -------
        mean : ndarray of shape (n_outputs,) or (n_samples, n_outputs)
            The posterior mean, as `predict` returns it.
        jacobian : ndarray of shape (n_outputs, n_features) or (n_samples, n_outputs, n_features)
            ∂mean/∂x. The axis of outputs is left out if y has one column.
        std, std_jacobian : ndarray of these shapes
            The standard deviation and its derivatives. Only if ``return_std=True``.
        """
        rows, state = X if X.ndim == 2 else X[np.newaxis], self._state
        predictor, groups, _ = state
        behind = mapped(rows, self._feature_map, self._kernel_map)
        found, mean, std = self._said(state, rows, behind.inputs, behind.features, return_std)
        slopes = [group.slopes(each, behind) for group, each in zip(groups, found, strict=True)]
        jacobian = predictor.in_order([by for by, _ in slopes])
        if self.base is not None:
            for columns in self.base:
                jacobian[np.arange(len(jacobian)), :, columns] += 1.0
        mean, jacobian = _shaped(X, mean, jacobian)
        if not return_std:
            return mean, jacobian
        by_std = (0.5 / np.where(std > 0.0, std, np.inf)).T[:, :, np.newaxis]
        return mean, jacobian, *_shaped(X, std, by_std * predictor.in_order([by for _, by in slopes]))

    def _said(
        self, state: _State, rows: np.ndarray, inputs: np.ndarray, features: np.ndarray, return_std: bool
    ) -> tuple[list[Any], np.ndarray, Any]:
        """Return the moments of each group at mapped rows, and mean and std (n, o) of all outputs; std may be None."""
        predictor, groups, noise = state
        found = [group.moments(inputs, features, return_std) for group in groups]
        mean = predictor.in_order([each.mean for each in found]).T + predictor.intercept
        if self.base is not None:
            mean += rows[:, self.base].sum(axis=1)
        if not return_std:
            return found, mean, None
        return found, mean, np.sqrt(predictor.in_order([each.variance for each in found]).T + noise)


def _goes_on(before: Predictor, predictor: Predictor) -> bool:
    """Whether two predictors come from one fit, judged by kernels, inducing points and numbers of weights."""
    if before.offset.shape != predictor.offset.shape:
        return False
    # The points of an exact fit are its rows. Its first update leaves some out and keeps the others up to rounding.
    return all(
        _are_among(new.points, old.points) and np.array_equal(old.hyperparameters, new.hyperparameters)
        for old, new in zip(before.by_output, predictor.by_output, strict=True)
    )


def _are_among(points: np.ndarray, others: np.ndarray) -> bool:
    """Whether each of some points (n, d) is one of the others, up to rounding."""
    if points.shape == others.shape and np.array_equal(points, others):
        return True
    if points.shape[1] != others.shape[1]:
        return False
    size = np.maximum(np.abs(others).max(axis=0), np.finfo(float).tiny)
    distance, _ = cKDTree(others / size).query(points / size)
    return bool((distance <= _ROUNDING).all())


class _Moments(NamedTuple):
    """Mean and variance of a group of o outputs at n rows, with the parts that derivatives need."""

    mean: np.ndarray  # (o, n), of the noise-free g(x) without the intercept
    variance: Any  # (o, n), of the noise-free g(x), or None
    prepared: Any  # the kernel's own form of the rows
    P: np.ndarray  # (m + p, n): [V; Hᵀ]
    deviation: Any  # (o, k, n): R P, or None


def _group_of(group: PredictorGroup, offset: np.ndarray) -> _Group | NearGroup:
    """Prepare a group with the offset (o, p) of its weights."""
    return _Group.of(group, offset) if group.near is None else NearGroup(group, group.near, offset[0])


@dataclass(frozen=True)
class _Group:
    """The posterior of a group of outputs, with the matrices that do not depend on the rows computed once."""

    # With P = [V; Hᵀ] (m + p, n) the mean is W P and the variance s² (k̃(x, x) - |v|²) + |R P|² (`model.predictor`).
    # Their derivatives go back through P to the kernel's inputs and the features, and through the maps to X.
    own: PredictorGroup
    product: np.ndarray  # (o + o k, m + p): W (with the offset of the weights) above the R of each output, if an array
    from_cross: np.ndarray  # (o, m): W L⁻¹, the derivative of the mean with respect to k̃(z, x)

    @classmethod
    def of(cls, group: PredictorGroup, offset: np.ndarray) -> _Group:
        """Prepare a group with the offset (o, p) of its weights."""
        (o, k, size), m = group.root.shape, len(group.points)
        # The root of a mixture has blocks. It is not copied.
        is_array = isinstance(group.root, np.ndarray)
        product = np.empty((o + o * k * is_array, size))
        product[:o] = group.mean
        product[:o, m:] += offset
        if is_array:
            product[o:] = group.root.reshape(o * k, size)
        return cls(group, product, group.whitening.times_inverse_transposed(group.mean[:, :m].T).T)

    def moments(self, inputs: np.ndarray, features: np.ndarray, return_variance: bool) -> _Moments:
        """Return mean and variance at mapped rows. Without a feature map, features are ignored."""
        group = self.own
        own = of_outputs(inputs, group.outputs)
        (o, k, size), m, n = group.root.shape, len(group.points), len(own)
        prepared, P = group.kernel.prepare(own), np.empty((size, n))
        if return_variance:
            group.whitening.solve(prepared, out=P[:m])
        else:
            P[:m] = group.whitening.times_inverse(group.whitening.covariance.cross(prepared))
        if size > m:
            P[m:] = of_outputs(features, group.outputs).T
        if not return_variance:
            return _Moments(self.product[:o] @ P, None, prepared, P, None)
        found = self.product @ P
        deviation = found[o:].reshape(o, k, n) if isinstance(group.root, np.ndarray) else times(group.root, P)
        unexplained = group.whitening.remaining(prepared, P[:m])
        variance = np.einsum("okn,okn->on", deviation, deviation) + group.signal[:, np.newaxis] * unexplained
        return _Moments(found[:o], variance, prepared, P, deviation)

    def slopes(self, found: _Moments, rows: MappedRows) -> tuple[np.ndarray, Any]:
        """Return derivatives of mean and variance (None if the moments have none) with respect to X, (o, n, D) each."""
        group, covariance = self.own, self.own.whitening.covariance
        (o, _, size), m, (by_inputs, by_features) = group.root.shape, len(group.points), rows.of(group)
        slopes = covariance.slopes(found.prepared)  # (m, n, d)
        _, n, d = slopes.shape
        mean = chained((self.from_cross @ slopes.reshape(m, n * d)).reshape(o, n, d).transpose(1, 0, 2), by_inputs)
        if size > m:
            mean = mean + self.product[:o, m:] @ by_features
        if found.variance is None:
            return mean.transpose(1, 0, 2), None
        P_bar = 2.0 * transposed_times(group.root, found.deviation)  # (o, m + p, n)
        P_bar[:, :m] -= (2.0 * group.signal)[:, np.newaxis, np.newaxis] * found.P[:m]
        U_bar = group.whitening.times_inverse_transposed(P_bar[:, :m])
        variance = U_bar.transpose(2, 0, 1) @ slopes.transpose(1, 0, 2)  # (n, o, d)
        at_row = covariance.diagonal_slopes(found.prepared)
        if np.ndim(at_row):
            variance += group.signal[:, np.newaxis] * at_row[:, np.newaxis]
        variance = chained(variance, by_inputs)
        if size > m:
            variance = variance + P_bar[:, m:].transpose(2, 0, 1) @ by_features
        return mean.transpose(1, 0, 2), variance.transpose(1, 0, 2)


def _shaped(X: np.ndarray, values: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give values (n, o) and slopes (o, n, D) the shapes that `value_and_jacobian` returns for X."""
    slopes, values = slopes[0] if len(slopes) == 1 else slopes.transpose(1, 0, 2), like_y(values)
    return (values, slopes) if X.ndim == 2 else (values[0], slopes[0])


# The numbers of all predictions: weights, prepared groups, and the noise of each output.
_State = tuple[Predictor, tuple[Any, ...], np.ndarray]
