"""A fitted model for control loops: predictions and derivatives of a few rows, without validation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..data.rows import of_outputs
from ..maps import Map
from ..model.predictor import Predictor, PredictorGroup
from ..utils.shapes import like_y
from ..utils.validation import check_fitted
from .derivatives import MappedRows, chained, mapped

_NONE = np.empty((0, 0))
# What two points may differ by that are the same but for rounding, as a share of the largest.
_ROUNDING = 1e-9


class CompiledPredictor:
    """What `EVGPRegressor.compile` returns: the frozen model, as fast as NumPy is.

    It checks nothing: rows are float64 arrays with the columns of `fit`, finite and not empty. Predictions are those of
    ``predict``, to rounding. It keeps no state between calls, so that threads may share it, and can be pickled.

    Parameters
    ----------
    predictor : Predictor
        Frozen, in the user's units.
    feature_map, kernel_map : Map or None
        Of plain arrays.
    include_noise : bool, default=True
        Whether standard deviations are of y, with the learned noise, or of the noise-free g(x).
    base : ndarray of shape (k, n_outputs), default=None
        Indices of columns that are added to the mean (of a `ResidualRegressor`).

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

    As a ``ResidualModel`` of L4acados, whose Jacobians have the axis of outputs first, and always have it, and whose
    zero-order controller reads the variances of the rows that were asked for last:

    >>> class LearnedResidual:  # or of l4acados.models.ResidualModel, of which no more is asked
    ...     def __init__(self, model):
    ...         self.model = model
    ...
    ...     def value_and_jacobian(self, y):
    ...         mean, jacobian, std, _ = self.model.value_and_jacobian(y, return_std=True)
    ...         self.current_variance = std.reshape(len(y), -1) ** 2
    ...         return mean.reshape(len(y), -1), jacobian.reshape(len(y), -1, y.shape[1]).swapaxes(0, 1)
    >>> LearnedResidual(fast).value_and_jacobian(X)[1].shape
    (2, 60, 1)
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
        """Take on the weights of a model that has seen further rows, by ``partial_fit``.

        Calls that run in other threads end with the weights that they began with.

        Parameters
        ----------
        model : EVGPRegressor, EGPRegressor or ResidualRegressor
            Of the same fit: with the same maps, kernel and inducing points.

        Raises
        ------
        ValueError
            If it is of another fit.
        NotFittedError
            If it is of none.
        """
        check_fitted(model)
        predictor = model._posterior.predictor
        if not _goes_on(self._state[0], predictor):
            raise ValueError("update takes on the weights of the same fit; compile a model that was fitted again.")
        self._freeze(predictor)

    def _freeze(self, predictor: Predictor) -> None:
        noise = predictor.noise if self.include_noise else np.zeros_like(predictor.noise)
        groups = tuple(_Group.of(group, predictor.offset[group.outputs]) for group in predictor.groups)
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
            Without the axis of outputs if there is one.
        std : ndarray of the same shape
            If ``return_std``.
        """
        rows, state = X if X.ndim == 2 else X[np.newaxis], self._state
        inputs = rows if self._kernel_map is None else self._kernel_map.value(rows)
        features = _NONE if self._feature_map is None else self._feature_map.value(rows)
        _, mean, std = self._said(state, rows, inputs, features, return_std)
        mean = like_y(mean if X.ndim == 2 else mean[0])
        return (mean, like_y(std if X.ndim == 2 else std[0])) if return_std else mean

    def value_and_jacobian(self, X: np.ndarray, return_std: bool = False) -> Any:
        """Predict y, and how that changes with the columns of X.

        Parameters
        ----------
        X : ndarray of shape (n_features,) or (n_samples, n_features)
            One row or several.
        return_std : bool, default=False
            Whether to return the standard deviation and its derivatives too.

        Returns
        -------
        mean : ndarray of shape (n_outputs,) or (n_samples, n_outputs)
            As of `predict`.
        jacobian : ndarray of shape (n_outputs, n_features) or (n_samples, n_outputs, n_features)
            ∂mean/∂x. (Neither has the axis of outputs if there is one.)
        std, std_jacobian : ndarray of these shapes
            If ``return_std``.
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
    ) -> tuple[list[_Moments], np.ndarray, Any]:
        """What each group says of rows behind both maps, and mean and (or None) std (n, o) of all outputs."""
        predictor, groups, noise = state
        found = [group.moments(inputs, features, return_std) for group in groups]
        mean = predictor.in_order([each.mean for each in found]).T + predictor.intercept
        if self.base is not None:
            mean += rows[:, self.base].sum(axis=1)
        if not return_std:
            return found, mean, None
        return found, mean, np.sqrt(predictor.in_order([each.variance for each in found]).T + noise)


def _goes_on(before: Predictor, predictor: Predictor) -> bool:
    """Whether they are of one fit, as far as kernels, inducing points and numbers of weights tell.

    The points of an exact fit are its rows. Its first update leaves some of them out, and those that are left are the
    same but for rounding.
    """
    if before.offset.shape != predictor.offset.shape:
        return False
    return all(
        _are_among(new.points, old.points) and np.array_equal(old.hyperparameters, new.hyperparameters)
        for old, new in zip(before.by_output, predictor.by_output, strict=True)
    )


def _are_among(points: np.ndarray, others: np.ndarray) -> bool:
    """Whether each of some points (n, d) is one of the others, but for rounding."""
    if points.shape == others.shape and np.array_equal(points, others):
        return True
    if points.shape[1] != others.shape[1]:
        return False
    size = np.maximum(np.abs(others).max(axis=0), np.finfo(float).tiny)
    distance, _ = cKDTree(others / size).query(points / size)
    return bool((distance <= _ROUNDING).all())


class _Moments(NamedTuple):
    """What a group of o outputs says of n rows.

    Attributes
    ----------
    mean, variance : ndarray of shape (o, n)
        Of the noise-free g(x), but for the intercept; the variance is None if it is not asked for.
    prepared : object
        What the kernel makes of the rows.
    P : ndarray of shape (m + p, n)
        [V; Hᵀ].
    deviation : ndarray of shape (o, k, n)
        root @ P, or None.
    """

    mean: np.ndarray
    variance: Any
    prepared: Any
    P: np.ndarray
    deviation: Any


@dataclass(frozen=True)
class _Group:
    """A group of outputs, made ready.

    With P = [V; Hᵀ] the mean is W P and the variance s² (k̃(x, x) - |v|²) + |R P|² (`inference.posterior`); their
    derivatives are pulled back through P to the kernel's inputs and the features, and through the maps to X.

    Attributes
    ----------
    own : PredictorGroup
    product : ndarray of shape (o + o k, m + p)
        W (with the offset of the weights) and R of each output, below each other.
    from_cross : ndarray of shape (o, m)
        W L⁻¹: the mean's derivative in k̃(z, x).
    """

    own: PredictorGroup
    product: np.ndarray
    from_cross: np.ndarray

    @classmethod
    def of(cls, group: PredictorGroup, offset: np.ndarray) -> _Group:
        """With the offset (o, p) of its weights."""
        (o, k, size), m = group.root.shape, len(group.points)
        product = np.empty((o + o * k, size))
        product[:o], product[o:] = group.mean, group.root.reshape(o * k, size)
        product[:o, m:] += offset
        return cls(group, product, group.mean[:, :m] @ group.whitening.L_inv)

    def moments(self, inputs: np.ndarray, features: np.ndarray, return_variance: bool) -> _Moments:
        """Mean and variance at rows, given what both maps make of them (without features, whatever these are)."""
        group = self.own
        own = of_outputs(inputs, group.outputs)
        (o, k, size), m, n = group.root.shape, len(group.points), len(own)
        prepared, P = group.kernel.prepare(own), np.empty((size, n))
        if return_variance:
            group.whitening.solve(prepared, out=P[:m])
        else:
            np.matmul(group.whitening.L_inv, group.whitening.covariance.cross(prepared), out=P[:m])
        if size > m:
            P[m:] = of_outputs(features, group.outputs).T
        if not return_variance:
            return _Moments(self.product[:o] @ P, None, prepared, P, None)
        found = self.product @ P
        deviation = found[o:].reshape(o, k, n)
        unexplained = group.whitening.remaining(prepared, P[:m])
        variance = np.einsum("okn,okn->on", deviation, deviation) + group.signal[:, np.newaxis] * unexplained
        return _Moments(found[:o], variance, prepared, P, deviation)

    def slopes(self, found: _Moments, rows: MappedRows) -> tuple[np.ndarray, Any]:
        """Derivatives of mean and (or None) variance in X, (o, n, D) each."""
        group, covariance = self.own, self.own.whitening.covariance
        (o, _, size), m, (by_inputs, by_features) = group.root.shape, len(group.points), rows.of(group)
        slopes = covariance.slopes(found.prepared)  # (m, n, d)
        _, n, d = slopes.shape
        mean = chained((self.from_cross @ slopes.reshape(m, n * d)).reshape(o, n, d).transpose(1, 0, 2), by_inputs)
        if size > m:
            mean = mean + self.product[:o, m:] @ by_features
        if found.variance is None:
            return mean.transpose(1, 0, 2), None
        P_bar = 2.0 * (group.root.transpose(0, 2, 1) @ found.deviation)  # (o, m + p, n)
        P_bar[:, :m] -= (2.0 * group.signal)[:, np.newaxis, np.newaxis] * found.P[:m]
        U_bar = group.whitening.L_inv.T @ P_bar[:, :m]
        variance = U_bar.transpose(2, 0, 1) @ slopes.transpose(1, 0, 2)  # (n, o, d)
        at_row = covariance.diagonal_slopes(found.prepared)
        if np.ndim(at_row):
            variance += group.signal[:, np.newaxis] * at_row[:, np.newaxis]
        variance = chained(variance, by_inputs)
        if size > m:
            variance = variance + P_bar[:, m:].transpose(2, 0, 1) @ by_features
        return mean.transpose(1, 0, 2), variance.transpose(1, 0, 2)


def _shaped(X: np.ndarray, values: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (n, o) and slopes (o, n, D) as `value_and_jacobian` returns them for X."""
    slopes, values = slopes[0] if len(slopes) == 1 else slopes.transpose(1, 0, 2), like_y(values)
    return (values, slopes) if X.ndim == 2 else (values[0], slopes[0])


# What predictions are made from: weights, groups made ready, and the noise of each output.
_State = tuple[Predictor, tuple[_Group, ...], np.ndarray]
