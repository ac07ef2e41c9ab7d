"""A fitted Gaussian process as a CasADi function of x: mean and variance, with exact derivatives by CasADi."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import eigh

from ..data.rows import Columns
from ..maps import Map, NoExpressionError
from ..model.predictor import Predictor, PredictorGroup
from ..model.roots import dense
from ..utils.casadi import casadi

# An inlined function lets a caller differentiate the mean without the variance, whose derivatives cost more.
INLINED = {"always_inline": True}
# Lower limit of the residual variance k̃(x, x) - |v|², as a share of k̃(x, x). Below it there is only rounding.
_ROUNDING = 4.0 * np.finfo(float).eps
# Largest allowed part off the diagonal, in units of the rounding error of |V|² at the inducing points.
_BESIDE = 10.0

# The expression of one row: a column (width, 1), or a list with one column for each output.
Mapped = Any


@dataclass(frozen=True)
class Exported:
    """A fitted model as it is exported to CasADi."""

    predictor: Predictor  # in the user's units
    feature_map: Map | None
    kernel_map: Map | None
    n_columns: int  # columns of X

    def function(self, name: str, include_noise: bool, parametric: bool) -> Any:
        """Return (x) -> (mean, variance) as a `casadi.Function`; if parametric, (x, parameters) -> (mean, variance)."""
        ca = casadi()
        if not (isinstance(name, str) and ca.Function.check_name(name)):
            raise ValueError(
                f"name must have a letter first, then letters, digits and single underscores; got {name!r}."
            )
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
        """Return all numbers that new rows may change as one vector, written to ``out`` if that is given."""
        return np.concatenate([np.ravel(part) for part in self._parts()], out=out)

    @property
    def _groups(self) -> list[PredictorGroup]:
        """The groups, with roots that are arrays."""
        return [replace(group, root=dense(group.root)) for group in self.predictor.groups]

    def _parts(self) -> list[np.ndarray]:
        """List the arrays of `parameters` in their order."""
        # For each group of o outputs with the same m inducing points: weights of the mean (o, m + p), then roots of the
        # covariance (o, k, m + p). After all groups: the offset of the features' weights (n_outputs, p), the intercept
        # (n_outputs,) and the noise variances (n_outputs,).
        each = [part for group in self._groups for part in (group.mean, group.root)]
        return [*each, self.predictor.offset, self.predictor.intercept, self.predictor.noise]

    def _frozen(self, inputs: Mapped, features: Mapped, include_noise: bool) -> list[Any]:
        """Return mean and variance with all numbers as constants."""
        ca, predictor = casadi(), self.predictor
        own = [_frozen_group(group, *_at(group, inputs, features)) for group in self._groups]
        mean = self._in_order([mean for mean, _ in own]) + self._by_features(features, predictor.offset)
        variance = self._in_order([variance for _, variance in own])
        variance = variance + ca.DM(predictor.noise) if include_noise else variance
        return [ca.densify(mean + ca.DM(predictor.intercept)), ca.densify(variance)]

    def _given(self, inputs: Mapped, features: Mapped, given: Any, include_noise: bool) -> list[Any]:
        """Return mean and variance with the numbers of `parameters` as symbols."""
        ca = casadi()
        parts = self._parts()
        ends = np.cumsum([0, *(part.size for part in parts)]).tolist()
        # CasADi stores matrices by columns, NumPy by rows.
        open_ = [
            ca.reshape(values, part.shape[-1], int(np.prod(part.shape[:-1])))
            for values, part in zip(ca.vertsplit(given, ends), parts, strict=True)
        ]
        own = [
            _open_group(group, *_at(group, inputs, features), *open_[2 * i : 2 * i + 2])
            for i, group in enumerate(self._groups)
        ]
        offset, intercept, noise = open_[-3:]
        mean = self._in_order([mean for mean, _ in own]) + self._by_features(features, offset)
        variance = self._in_order([variance for _, variance in own])
        return [ca.densify(mean + intercept), ca.densify(variance + noise if include_noise else variance)]

    def _by_features(self, features: Mapped, offset: Any) -> Any:
        """Multiply features by the coefficients of each output: an array (o, p) or a symbol (p, o)."""
        ca = casadi()
        by_output = offset if isinstance(offset, ca.MX) else ca.DM(np.ascontiguousarray(offset.T))
        if not by_output.shape[0]:
            return ca.MX.zeros(len(self.predictor.noise), 1)
        if isinstance(features, list):
            return ca.vertcat(*(ca.dot(own, by_output[:, o]) for o, own in enumerate(features)))
        return ca.mtimes(features.T, by_output).T

    def _in_order(self, parts: list[Any]) -> Any:
        """Stack the columns of all groups into one column in the order of the outputs."""
        ca, n_outputs = casadi(), len(self.predictor.noise)
        order = np.concatenate([np.arange(n_outputs)[group.outputs] for group in self.predictor.groups])
        joined = ca.vertcat(*parts)
        return joined if (order == np.arange(n_outputs)).all() else joined[np.argsort(order).tolist()]

    def _check_widths(self, inputs: Mapped, features: Mapped) -> None:
        """Raise ValueError if the ``to_casadi`` of a user's map returned other shapes than its ``transform``."""
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
    """Return the expression of a mapped row, or raise an error that names the argument with the map."""
    try:
        return own.casadi(x)
    except NoExpressionError as error:
        raise TypeError(f"{argument}: {error}") from None


def _at(group: PredictorGroup, inputs: Mapped, features: Mapped) -> tuple[Any, Any, Any]:
    """Return k̃(X_m, x), k̃(x, x) and the features of a group."""
    kernel: Any = group.kernel  # the type in `model` has no expressions
    own = kernel.expression(group.hyperparameters, group.points, _of(inputs, group.outputs))
    return *own, _of(features, group.outputs)


def _of(row: Mapped, outputs: Columns) -> Any:
    """Return the row of a group. If each output has a row of its own, each group has one output."""
    return row[outputs.start if isinstance(outputs, slice) else outputs[0]] if isinstance(row, list) else row


def _frozen_group(group: PredictorGroup, cross: Any, diagonal: Any, features: Any) -> tuple[Any, Any]:
    """Return mean (without the offset) and variance of a group's outputs."""
    ca = casadi()
    m, deviations = len(group.points), Deviations.of(group)
    # The mean does not need V: with W L⁻¹ (o, m) multiplied once, its derivatives are cheap.
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
        sums = np.repeat(np.eye(len(sizes)), sizes, axis=1)  # adds up the rows of each output
        variance = variance + ca.mtimes(ca.DM(sums), left)
    return mean, variance


def _open_group(
    group: PredictorGroup, cross: Any, diagonal: Any, features: Any, weights: Any, root: Any
) -> tuple[Any, Any]:
    """Do the same with symbols for the weights (m + p, o) of the mean and the root (m + p, o k) of the covariance."""
    ca = casadi()
    V = ca.mtimes(ca.DM(group.whitening.L_inv), cross)
    P = ca.vertcat(V, features).T
    o, k, _ = group.root.shape
    left = ca.sum1(ca.reshape(ca.mtimes(P, root) ** 2, k, o)).T
    return ca.mtimes(P, weights).T, ca.DM(group.signal) * _unexplained(diagonal, ca.sumsqr(V)) + left


def _unexplained(diagonal: Any, squares: Any) -> Any:
    """Return k̃(x, x) - |v|², the variance that the inducing points do not explain."""
    return casadi().fmax(diagonal - squares, _ROUNDING * diagonal)


def with_base(function: Any, columns: np.ndarray) -> Any:
    """Return a function that adds columns of x, by their indices (k, n_outputs), to the mean of a `casadi.Function`."""
    ca = casadi()
    names_in, names_out = function.name_in(), function.name_out()
    given = [ca.MX.sym(name, function.size_in(i)) for i, name in enumerate(names_in)]
    mean, *others = function.call(given, True, False)
    outputs = [sum((given[0][own.tolist()] for own in columns), start=mean), *others]
    return ca.Function(function.name(), given, outputs, names_in, names_out, INLINED)


# --- the posterior variance of a group's outputs ---------------------------------------------------------------------
# The variance of g(x) is |root P|², P = [V; h], with a root (k, m + p) of each output. It takes most of a prediction's
# time. The rows of root that multiply V alone are, for all outputs, functions of one matrix V Vᵀ of the training rows.
# In its eigenvectors U they are diagonal (simultaneous diagonalisation), and one product with Uᵀ L⁻¹ serves all
# outputs.


@dataclass(frozen=True)
class Deviations:
    """The posterior variances of o outputs as ``squares`` V'² + |others P'|² with V' = ``projection`` k̃(X_m, x)."""

    projection: np.ndarray  # (m, m): |V'| = |V|
    squares: np.ndarray | None  # (o, m); None stands for zeros
    others: list[np.ndarray]  # of each output (q, m + p), for P' = [V'; h]

    @classmethod
    def of(cls, group: PredictorGroup) -> Deviations:
        """Diagonalise the roots of a group. Roots that rounding made too different are kept as they are."""
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
    """Return an orthogonal U (m, m) and the diagonals (o, m) of all outputs in it, NaN where the rest is too large."""
    # The eigenvectors of one output's covariance serve all, but their accuracy depends on its noise. Take the best.
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
