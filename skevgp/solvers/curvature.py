"""How far a step along each coordinate may go: from the curvature of the loss there."""

from __future__ import annotations

import numpy as np

from ..utils.linalg import NotPositiveDefiniteError
from .minimum import Objective

# Of a step between two gradients, in the coordinates of a `ParameterTable`.
_STEP = 1e-3
# A unit is the size of a step while the curvature stays what it is, and no longer.
_SHORTEST, _LONGEST = 0.1, 100.0


def curvature_units(objective: Objective, x: np.ndarray, alike: np.ndarray, n_probes: int) -> np.ndarray:
    """1 / √|∂²loss/∂x²|, of which coordinates that are alike have one: the root of what they are in the mean.

    The diagonal of the Hessian from differences of gradients in random directions v of signs: the mean of
    v (∇(x + εv) - ∇(x)) / ε (Bekas, Kokiopoulou & Saad 2007, "An estimator for the diagonal of a matrix"). What the
    other entries add to it by chance makes units smaller, not larger.

    Parameters
    ----------
    objective : callable
        x -> (loss, gradient).
    x : ndarray of shape (size,)
    alike : ndarray of shape (size,)
        Integers, equal for coordinates that are alike.
    n_probes : int

    Returns
    -------
    units : ndarray of shape (size,)
        1 where the loss cannot be evaluated.
    """
    rng, total = np.random.RandomState(0), np.zeros(len(x))
    try:
        here = objective(x)[1]
        for _ in range(n_probes):
            signs = rng.choice([-1.0, 1.0], len(x))
            there = objective(x + _STEP * signs)[1]
            with np.errstate(invalid="ignore"):
                total += signs * (there - here) / _STEP
    except NotPositiveDefiniteError:
        return np.ones(len(x))
    kinds, kind = np.unique(alike, return_inverse=True)
    if len(kinds) == 0 or not np.isfinite(total).all():
        return np.ones(len(x))
    curvature = np.bincount(kind, np.abs(total) / n_probes) / np.bincount(kind)
    return np.clip(1.0 / np.sqrt(np.maximum(curvature, _LONGEST**-2)), _SHORTEST, _LONGEST)[kind]
