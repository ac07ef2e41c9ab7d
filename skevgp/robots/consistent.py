"""Physical inertial parameters nearest to estimated ones."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh, solve_triangular

from ..utils.validation import check_real
from .inertia import (
    N_PARAMETERS,
    checked_covariance,
    checked_parameters,
    from_pseudo_inertia,
    physical_consistency,
    pseudo_inertia,
)

# Additional variances, as shares of the largest, that are tried until there is a consistent solution. Directions
# without variance may leave none.
_FLOORS = (0.0, 1e-12, 1e-8, 1e-4, 1.0)
# The weight of the barrier falls by _FALL until its error is this share of the distance (_ROUGHLY if rounding ends it).
_FALL, _LOST, _ROUGHLY = 0.1, 1e-12, 1e-6
_STEPS = 100
# Newton decrement at which a weight is done, and the last weight.
_NEAR, _THERE = 0.3, 1e-6
_LARGEST_FORCE = 1e15


def _basis() -> np.ndarray:
    """Return orthonormal symmetric matrices, (10, 4, 4)."""
    matrices = []
    for row in range(4):
        for column in range(row + 1):
            matrix = np.zeros((4, 4))
            matrix[row, column] = matrix[column, row] = 1.0 if row == column else np.sqrt(0.5)
            matrices.append(matrix)
    return np.array(matrices)


_BASIS = _basis()
# Matrix from a link's parameters to the coordinates of its pseudo-inertia.
_PSEUDO = np.einsum("aij,pij->ap", _BASIS, pseudo_inertia(np.eye(N_PARAMETERS)))


class _Problem(NamedTuple):
    """Minimise |z|² / 2 over z with ``target`` <= ``factor`` z, in coordinates of symmetric matrices of links."""

    factor: np.ndarray  # (n, 10, n_directions)
    target: np.ndarray  # (n, 10)


def nearest_consistent(mean: np.ndarray, covariance: np.ndarray, *, margin: float = 1e-4) -> np.ndarray:
    """Find the physical inertial parameters nearest to an estimate, in units of its uncertainty.

    They minimise the Mahalanobis distance (π - mean)ᵀ covariance⁻¹ (π - mean) over parameters whose pseudo-inertias J
    (`pseudo_inertia`) satisfy J >= margin R for each link. Here R = diag(q, q, q, m) with the link's own scale of mass
    m and of second moments q. The problem is convex and has one solution: the most probable physical point of a
    Gaussian posterior. Directions that the data determine well hardly change.

    Parameters
    ----------
    mean : array-like of shape (n_links, 10)
        Estimate of the parameters. It is returned unchanged if it is physical.
    covariance : array-like of shape (10 * n_links, 10 * n_links)
        Covariance of the estimate, link by link. It may be singular: directions without variance do not change if there
        is a physical solution. A link with mean and variance 0 is not a body, and does not change.
    margin : float, default=1e-4
        Distance of changed links from the border of physical parameters, in (0, 0.1].

    Returns
    -------
    parameters : ndarray of shape (n_links, 10)
        Physical parameters: `physical_consistency` is above 0 for each body.

    Raises
    ------
    ValueError
        If a shape is wrong, a number not finite, a variance negative, or the margin out of range.

    See Also
    --------
    physical_consistency : Whether parameters are physical.

    Notes
    -----
    If directions without variance leave no physical solution, all directions get a small share of the largest variance,
    in units of each link's scales.
    """
    # A barrier method on the dual problem. Its unknowns are one positive definite matrix Z per link, the multiplier of
    # its constraint: π = mean + covariance 𝒥ᵀ(Z). The covariance is never inverted, so that it may be singular. Z = R
    # Rᵀ moves in the coordinates of its own factor R. The alternative, a Cholesky factor of J as the unknown (Rucker &
    # Wensing, "Smooth parameterization of rigid-body inertia", IEEE RA-L 7(2), 2022), is nonlinear least squares: with
    # a full covariance for a UR10, 3,000 evaluations left 0.2 to 0.6 % more distance.
    mean = checked_parameters(mean, None, "mean")
    covariance = checked_covariance(covariance, mean.size)
    margin = check_real(margin, "margin", minimum=0.0, strict=True)
    if margin > 0.1:
        raise ValueError(f"margin must be in (0, 0.1]; got {margin!r}.")
    bodies = (mean != 0.0).any(axis=1) | (np.diag(covariance).reshape(mean.shape) > 0.0).any(axis=1)
    found = mean.copy()
    if (physical_consistency(mean)[bodies] > 0.0).all():
        return found
    kept = np.repeat(bodies, N_PARAMETERS)
    found[bodies] = _nearest(mean[bodies], covariance[np.ix_(kept, kept)], margin)
    return found


def _nearest(mean: np.ndarray, covariance: np.ndarray, margin: float) -> np.ndarray:
    units = _units(mean, covariance)
    scaled = mean / units
    deviations = _factor(covariance / np.outer(units.ravel(), units.ravel()))
    smallest = np.linalg.eigvalsh(pseudo_inertia(scaled))[:, 0]
    inside = np.where(physical_consistency(mean) > 0.0, np.clip(0.5 * smallest, 0.0, margin), margin)
    identity = np.einsum("aij,ij->a", _BASIS, np.eye(4))
    target = inside[:, None] * identity - scaled @ _PSEUDO.T
    for floor in _FLOORS if deviations.size else _FLOORS[-1:]:
        factor = np.hstack([deviations, np.sqrt(floor) * np.eye(mean.size)]) if floor else deviations
        links = factor.reshape(*mean.shape, -1)
        z = _least_norm(_Problem(np.einsum("ap,lpk->lak", _PSEUDO, links), target))
        if z is None:
            continue
        found = mean + (links @ z) * units  # directions without variance keep their bits
        if (physical_consistency(found) > 0.0).all():
            return found
    return from_pseudo_inertia(_clipped(pseudo_inertia(scaled), margin)) * units


def _units(mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return units of each link's parameters from its scales of mass and second moments."""
    # A scale is the standard deviation if the mean is near 0.
    variances = np.diag(covariance).reshape(mean.shape)
    mass = _scale(np.abs(mean[:, 0]), np.sqrt(variances[:, 0]))
    moments = np.linalg.eigvalsh(pseudo_inertia(mean)[:, :3, :3])
    second = _scale(np.abs(moments).mean(axis=1), np.sqrt(variances[:, [4, 6, 9]].mean(axis=1)))
    return np.column_stack([mass, *[np.sqrt(mass * second)] * 3, *[second] * 6])


def _scale(size: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Combine size and deviation, which counts up to the size of the largest link because the prior may be flat."""
    largest = size.max()
    scale = np.hypot(size, np.minimum(deviation, largest) if largest > 0.0 else deviation)
    return np.where(scale > 0.0, scale, scale.max() or 1.0)


def _factor(covariance: np.ndarray) -> np.ndarray:
    """Return F with F Fᵀ = covariance up to a common scale, without directions that are rounding errors."""
    deviations = np.sqrt(np.diag(covariance))
    inverse = np.divide(1.0, deviations, out=np.zeros_like(deviations), where=deviations > 0.0)
    values, vectors = eigh(covariance * np.outer(inverse, inverse))
    known = values > len(values) * np.finfo(np.float64).eps * values[-1]
    factor = deviations[:, None] * vectors[:, known] * np.sqrt(values[known])
    return factor / (deviations.max() or 1.0)


def _least_norm(problem: _Problem) -> np.ndarray | None:
    """Return the solution z = factorᵀ Z, or None if the numbers do not reach one."""
    links = len(problem.target)
    roots = np.tile(np.eye(4), (links, 1, 1))
    z = _pushed(problem, roots)
    # The weight is so large that the start is near the centre. From elsewhere Newton's steps end at the border of the
    # cone.
    weight = z @ z + np.abs(problem.target).sum()
    while True:
        roots, z, is_near = _centre(problem, roots, weight, _NEAR)
        lost = 4 * links * weight / max(z @ z, np.finfo(np.float64).tiny)
        if not is_near:
            return z if lost <= _ROUGHLY else None
        if lost <= _LOST:
            return _centre(problem, roots, weight, _THERE)[1]
        weight *= _FALL


def _centre(problem: _Problem, roots: np.ndarray, weight: float, near: float) -> tuple[np.ndarray, np.ndarray, bool]:
    """Minimise |factorᵀ Z|² / 2 - targetᵀ Z - weight log det Z over Z = R Rᵀ by Newton's method."""
    identity = np.einsum("aij,ij->a", _BASIS, np.eye(4))
    z = _pushed(problem, roots)
    for _ in range(_STEPS):
        turn = np.einsum("aij,nik,bkl,njl->nab", _BASIS, roots, _BASIS, roots, optimize=True)
        factor = np.einsum("nak,nab->nbk", problem.factor, turn).reshape(-1, len(z))
        linear = factor @ z - np.einsum("na,nab->nb", problem.target, turn).ravel()
        gradient = linear - weight * np.tile(identity, len(roots))
        step = _newton(factor, weight, gradient)
        if step is None:
            break
        slope = gradient @ step
        if not -slope > near**2 * weight:
            return roots, z, True
        moves = np.einsum("na,aij->nij", step.reshape(-1, N_PARAMETERS), _BASIS)
        stretch = np.linalg.eigvalsh(moves)
        pushed = step @ factor
        share = min(1.0, 0.95 / max(-stretch.min(), 1e-300))
        while share > 1e-10:
            change = share * (linear @ step) + 0.5 * share**2 * (pushed @ pushed)
            if change - weight * np.log1p(share * stretch).sum() <= 0.1 * share * slope:
                break
            share *= 0.5
        roots = roots @ np.linalg.cholesky(np.eye(4) + share * moves)
        z = _pushed(problem, roots)
        if not np.abs(roots).max() ** 2 <= _LARGEST_FORCE:
            break
    return roots, z, False


def _newton(factor: np.ndarray, weight: float, gradient: np.ndarray) -> np.ndarray | None:
    """Return -(factor factorᵀ + weight 1)⁻¹ gradient, or None if it is not finite."""
    # By QR, because the product would lose directions that are known 1e8 times better than others.
    triangle = np.linalg.qr(np.vstack([factor.T, np.sqrt(weight) * np.eye(len(factor))]), mode="r")
    try:
        step = -solve_triangular(triangle, solve_triangular(triangle, gradient, trans="T"))
    except (np.linalg.LinAlgError, ValueError):  # not invertible, not finite
        return None
    return step if np.isfinite(step).all() else None


def _pushed(problem: _Problem, roots: np.ndarray) -> np.ndarray:
    forces = np.einsum("aij,nik,njk->na", _BASIS, roots, roots)
    return np.einsum("nak,na->k", problem.factor, forces)


def _clipped(pseudo: np.ndarray, margin: float) -> np.ndarray:
    values, vectors = np.linalg.eigh(pseudo)
    return (vectors * np.maximum(values, margin)[..., None, :]) @ vectors.swapaxes(-2, -1)
