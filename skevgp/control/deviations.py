"""The variance that is left of a group's outputs, as few products for all of them.

The variance of g(x) is |root P|², P = [V; h], with a root (k, m + p) of each output: most of a prediction's time. But
the rows of root that see V alone are, for all outputs, functions of one matrix V Vᵀ of the training rows: in its
eigenvectors U they are diagonal (simultaneous diagonalisation), so that one product with Uᵀ L⁻¹ serves all outputs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from ..model.predictor import PredictorGroup

# What may be left beside the diagonal: so many times what rounding leaves of |V|² at the inducing points.
_BESIDE = 10.0


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
