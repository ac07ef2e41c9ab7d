"""A fitted Gaussian process as a CasADi function: mean and variance in MX, and by CasADi all of their derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import eigh

from ..data.rows import Columns
from ..maps import Map, NoExpressionError
from ..model.predictor import Predictor, PredictorGroup
from ..utils.casadi import casadi

# In another function derivatives of the mean then leave out those of the variance, which cost more.
INLINED = {"always_inline": True}
# Of k̃(x, x): what of k̃(x, x) - |v|² may be rounding, as in predictions.
_ROUNDING = 4.0 * np.finfo(float).eps
# What may be left beside the diagonal: so many times what rounding leaves of |V|² at the inducing points.
_BESIDE = 10.0

# The expression of one row: a column (width, 1), or one for each output.
Mapped = Any


@dataclass(frozen=True)
class Exported:
    """What is exported of an estimator.

    Attributes
    ----------
    predictor : Predictor
        In the user's units.
    feature_map, kernel_map : Map or None
    n_columns : int
        Of X.
    """

    predictor: Predictor
    feature_map: Map | None
    kernel_map: Map | None
    n_columns: int

    def function(self, name: str, include_noise: bool, parametric: bool) -> Any:
        """(x) or (x, parameters) -> (mean, variance), as a `casadi.Function`.

        Parameters
        ----------
        name : str
        include_noise : bool
        parametric : bool
            Whether what `parameters` returns is a second argument.

        Returns
        -------
        function : casadi.Function

        Raises
        ------
        ImportError
            If CasADi is not installed.
        ValueError, TypeError
            If the name is none, or the kernel or a map has no expression in CasADi.
        """
        ca = casadi()
        if not (isinstance(name, str) and ca.Function.check_name(name)):
            raise ValueError(f"name must be letters, digits and single underscores, a letter first; got {name!r}.")
        x = ca.MX.sym("x", self.n_columns)
        inputs: Mapped = x if self.kernel_map is None else _expression(self.kernel_map, x, "kernel_map")
        features: Mapped = ca.MX(0, 1)
        if self.feature_map is not None:
            features = _expression(self.feature_map, x, "feature_map")
        self._check_widths(inputs, features)
        given, outputs = [x], []
        if parametric:
            given.append(ca.MX.sym("parameters", len(self.parameters())))
            outputs = self._given(inputs, features, given[1], include_noise)
        else:
            outputs = self._frozen(inputs, features, include_noise)
        return ca.Function(name, given, outputs, ["x", "parameters"][: len(given)], ["mean", "variance"], INLINED)

    def parameters(self, out: np.ndarray | None = None) -> np.ndarray:
        """What new rows may change, as one vector, put into ``out`` if that is given.

        Of each group of outputs that share inducing points the weights of the mean, (o, m + p), and then the roots of
        the covariance, (o, k, m + p); after all groups the coefficients that the features' weights are added to,
        (n_outputs, p), what is added to the mean, (n_outputs,), and the noise variances, (n_outputs,).
        """
        return np.concatenate([np.ravel(part) for part in self._parts()], out=out)

    def _parts(self) -> list[np.ndarray]:
        each = [part for group in self.predictor.groups for part in (group.mean, group.root)]
        return [*each, self.predictor.offset, self.predictor.intercept, self.predictor.noise]

    def _frozen(self, inputs: Mapped, features: Mapped, include_noise: bool) -> list[Any]:
        """Mean and variance with all numbers put in."""
        ca, predictor = casadi(), self.predictor
        own = [_frozen_group(group, *_at(group, inputs, features)) for group in predictor.groups]
        mean = self._in_order([mean for mean, _ in own]) + self._by_features(features, predictor.offset)
        variance = self._in_order([variance for _, variance in own])
        variance = variance + ca.DM(predictor.noise) if include_noise else variance
        return [ca.densify(mean + ca.DM(predictor.intercept)), ca.densify(variance)]

    def _given(self, inputs: Mapped, features: Mapped, given: Any, include_noise: bool) -> list[Any]:
        """Mean and variance with what `parameters` lists left open."""
        ca = casadi()
        parts = self._parts()
        ends = np.cumsum([0, *(part.size for part in parts)]).tolist()
        # CasADi has columns where NumPy has rows.
        open_ = [
            ca.reshape(values, part.shape[-1], int(np.prod(part.shape[:-1])))
            for values, part in zip(ca.vertsplit(given, ends), parts, strict=True)
        ]
        own = [
            _open_group(group, *_at(group, inputs, features), *open_[2 * i : 2 * i + 2])
            for i, group in enumerate(self.predictor.groups)
        ]
        offset, intercept, noise = open_[-3:]
        mean = self._in_order([mean for mean, _ in own]) + self._by_features(features, offset)
        variance = self._in_order([variance for _, variance in own])
        return [ca.densify(mean + intercept), ca.densify(variance + noise if include_noise else variance)]

    def _by_features(self, features: Mapped, offset: Any) -> Any:
        """Features times the coefficients (o, p), or of a symbol (p, o), of each output."""
        ca = casadi()
        by_output = offset if isinstance(offset, ca.MX) else ca.DM(np.ascontiguousarray(offset.T))
        if not by_output.shape[0]:
            return ca.MX.zeros(len(self.predictor.noise), 1)
        if isinstance(features, list):
            return ca.vertcat(*(ca.dot(own, by_output[:, o]) for o, own in enumerate(features)))
        return ca.mtimes(features.T, by_output).T

    def _in_order(self, parts: list[Any]) -> Any:
        """What each group has of its outputs as one column of all outputs."""
        ca, n_outputs = casadi(), len(self.predictor.noise)
        order = np.concatenate([np.arange(n_outputs)[group.outputs] for group in self.predictor.groups])
        joined = ca.vertcat(*parts)
        return joined if (order == np.arange(n_outputs)).all() else joined[np.argsort(order).tolist()]

    def _check_widths(self, inputs: Mapped, features: Mapped) -> None:
        """A map's own to_casadi may have returned anything."""
        ca = casadi()
        wanted = self.predictor.groups[0].points.shape[1], self.predictor.offset.shape[1]
        for name, row, width in zip(("kernel_map", "feature_map"), (inputs, features), wanted, strict=True):
            each = row if isinstance(row, list) else [row]
            shapes = [tuple(own.shape) if isinstance(own, ca.MX | ca.DM) else type(own).__name__ for own in each]
            n_rows = len(self.predictor.noise) if isinstance(row, list) else 1
            if shapes != [(width, 1)] * n_rows:
                raise ValueError(
                    f"{name}: to_casadi must return an MX of shape ({width}, 1), or one for each of the "
                    f"{len(self.predictor.noise)} outputs; it returned {shapes}."
                )


def _expression(own: Map, x: Any, argument: str) -> Mapped:
    """What a map makes of a row, or an error that names the argument it is from."""
    try:
        return own.casadi(x)
    except NoExpressionError as error:
        raise TypeError(f"{argument}: {error}") from None


def _at(group: PredictorGroup, inputs: Mapped, features: Mapped) -> tuple[Any, Any, Any]:
    """k̃(X_m, x), k̃(x, x) and the features of a group."""
    kernel: Any = group.kernel  # the mathematics names no class
    own = kernel.expression(np.log(group.hyperparameters), group.points, _of(inputs, group.outputs))
    return *own, _of(features, group.outputs)


def _of(row: Mapped, outputs: Columns) -> Any:
    """The row of a group, which is that of its only output if each has one."""
    return row[outputs.start if isinstance(outputs, slice) else outputs[0]] if isinstance(row, list) else row


def _frozen_group(group: PredictorGroup, cross: Any, diagonal: Any, features: Any) -> tuple[Any, Any]:
    """Mean (but for the offset) and variance of a group's outputs.

    The mean does not need V: its weights are multiplied by L⁻¹ once, which makes its derivatives cheap.
    """
    ca = casadi()
    m, deviations = len(group.points), Deviations.of(group)
    weights = np.hstack([group.mean[:, :m] @ group.whitening.L_inv, group.mean[:, m:]])
    mean = ca.mtimes(ca.DM(weights), ca.vertcat(cross, features))
    V = ca.mtimes(ca.DM(deviations.projection), cross)
    squares = V**2
    variance = ca.DM(group.signal) * _unexplained(diagonal, ca.sum1(squares))
    if deviations.squares is not None:
        variance = variance + ca.mtimes(ca.DM(deviations.squares), squares)
    sizes = [len(own) for own in deviations.others]
    if any(sizes):
        left = ca.mtimes(ca.DM(np.vstack(deviations.others)), ca.vertcat(V, features)) ** 2
        variance = variance + ca.mtimes(ca.DM(_sums_of(sizes)), left)
    return mean, variance


def _open_group(
    group: PredictorGroup, cross: Any, diagonal: Any, features: Any, weights: Any, root: Any
) -> tuple[Any, Any]:
    """The same with the weights (m + p, o) of the mean and the root (m + p, o k) as symbols."""
    ca = casadi()
    V = ca.mtimes(ca.DM(group.whitening.L_inv), cross)
    P = ca.vertcat(V, features).T
    o, k, _ = group.root.shape
    left = ca.sum1(ca.reshape(ca.mtimes(P, root) ** 2, k, o)).T
    return ca.mtimes(P, weights).T, ca.DM(group.signal) * _unexplained(diagonal, ca.sumsqr(V)) + left


def _unexplained(diagonal: Any, squares: Any) -> Any:
    """What the inducing points leave of k̃(x, x)."""
    return casadi().fmax(diagonal - squares, _ROUNDING * diagonal)


def _sums_of(sizes: list[int]) -> np.ndarray:
    """The matrix that sums so many rows of each output."""
    return np.repeat(np.eye(len(sizes)), sizes, axis=1)


def with_base(function: Any, columns: np.ndarray) -> Any:
    """The same function with some columns of x added to its mean.

    Parameters
    ----------
    function : casadi.Function
        Of x (and parameters), with the mean first.
    columns : ndarray of shape (n_outputs,)
        Indices.

    Returns
    -------
    function : casadi.Function
    """
    ca = casadi()
    names_in, names_out = function.name_in(), function.name_out()
    given = [ca.MX.sym(name, function.size_in(i)) for i, name in enumerate(names_in)]
    mean, *others = function.call(given, True, False)
    outputs = [sum((given[0][own.tolist()] for own in columns), start=mean), *others]
    return ca.Function(function.name(), given, outputs, names_in, names_out, INLINED)


# --- the variance that is left of a group's outputs ------------------------------------------------------------------
# The variance of g(x) is |root P|², P = [V; h], with a root (k, m + p) of each output: most of a prediction's time. But
# the rows of root that see V alone are, for all outputs, functions of one matrix V Vᵀ of the training rows: in its
# eigenvectors U they are diagonal (simultaneous diagonalisation). One product with Uᵀ L⁻¹ then serves all outputs.


@dataclass(frozen=True)
class Deviations:
    """Of o outputs: V' = ``projection`` k̃(X_m, x) is as long as V; variances are ``squares`` V'² plus |others P'|².

    Attributes
    ----------
    projection : ndarray of shape (m, m)
    squares : ndarray of shape (o, m), or None
        None are zeros.
    others : list of ndarray of shape (q, m + p)
        Of each output, for P' = [V'; h].
    """

    projection: np.ndarray
    squares: np.ndarray | None
    others: list[np.ndarray]

    @classmethod
    def of(cls, group: PredictorGroup) -> Deviations:
        """What a group's roots say, or the roots themselves where rounding made them too different."""
        m, L_inv = len(group.points), group.whitening.L_inv
        used = [own[own.any(axis=1)] for own in group.root]
        beside = [own[:, m:].any(axis=1) for own in used]
        alone = [own[~own_beside, :m] for own, own_beside in zip(used, beside, strict=True)]
        others = [own[own_beside] for own, own_beside in zip(used, beside, strict=True)]
        if not any(map(len, alone)):
            return cls(L_inv, None, others)
        U, squares = _common_eigenvectors(alone, group)
        for o in np.flatnonzero(np.isnan(squares[:, 0])):
            others[o] = np.vstack([np.pad(alone[o], [(0, 0), (0, group.root.shape[2] - m)]), others[o]])
        turned = [np.hstack([own[:, :m] @ U, own[:, m:]]) for own in others]
        return cls(U.T @ L_inv, np.nan_to_num(squares), turned)


def _common_eigenvectors(roots: list[np.ndarray], group: PredictorGroup) -> tuple[np.ndarray, np.ndarray]:
    """An orthogonal matrix (m, m), and what is on the diagonal in it (o, m): NaN of outputs with too much beside it.

    Those of one output's root serve all, but it depends on its noise how well they are known: the best are taken.
    """
    L, L_inv = group.whitening.L, group.whitening.L_inv
    covariances = np.array([own.T @ own for own in roots])
    V = L.T  # at the inducing points
    rounding = np.finfo(float).eps * np.einsum("ji,ji->i", np.abs(V), np.abs(L_inv) @ np.abs(L @ V))
    allowed = _BESIDE * np.outer(group.signal, rounding)
    variances = np.array([np.einsum("ij,ij->j", own @ V, own @ V) for own in roots])
    best, least = (np.eye(len(L)), np.full((len(roots), len(L)), np.nan)), (len(roots), np.inf)
    for covariance in covariances:
        _, U = eigh(covariance)
        squares = np.einsum("oij,ij->oj", covariances @ U, U).clip(0.0)
        excess = (np.abs(variances - squares @ (U.T @ V) ** 2) / allowed).max(axis=1)
        kept = excess <= 1.0
        if (worst := (int(np.sum(~kept)), float(excess.max()))) < least:
            best, least = (U, np.where(kept[:, np.newaxis], squares, np.nan)), worst
    return best
