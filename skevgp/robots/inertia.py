"""Inertial parameters of links: pseudo-inertias, physical consistency, and models with given parameters.

The parameters of a link are ``[m, m c_x, m c_y, m c_z, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]`` in Pinocchio's order: mass,
first moment and inertia about the origin of its joint's frame, in the axes of that frame. Torques are linear in them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..utils.optional import require
from ..utils.validation import as_floats

N_PARAMETERS = 10
# Rows and columns of the symmetric inertia in the order of the parameters.
_ROWS, _COLUMNS = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])


def inertial_parameters(model: Any) -> np.ndarray:
    """Return the inertial parameters of a model's links.

    Parameters
    ----------
    model : pinocchio.Model
        Model of a robot.

    Returns
    -------
    parameters : ndarray of shape (n_links, 10)
        Parameters of the link of each joint, in the order of the joints.
    """
    return np.array([link.toDynamicParameters() for link in list(model.inertias)[1:]]).reshape(-1, N_PARAMETERS)


def pseudo_inertia(parameters: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia J = [[Σ, m c], [m cᵀ, m]], with the second moment of the mass Σ = ½ tr(I) 1 - I.

    A body of positive density with these parameters exists if and only if J is positive definite: Wensing, Kim &
    Slotine, "Linear matrix inequalities for physically-consistent inertial parameter identification: A statistical
    perspective on the mass distribution", IEEE Robotics and Automation Letters 3(1), 60-67, 2018 (arXiv:1701.04395).

    Parameters
    ----------
    parameters : ndarray of shape (..., 10)
        Inertial parameters.

    Returns
    -------
    pseudo : ndarray of shape (..., 4, 4)
        Pseudo-inertias, which are linear in the parameters.
    """
    parameters = np.asarray(parameters, dtype=np.float64)
    inertia = _symmetric(parameters[..., 4:])
    pseudo = np.empty((*parameters.shape[:-1], 4, 4))
    pseudo[..., :3, :3] = _complement(inertia, 0.5)
    pseudo[..., :3, 3] = pseudo[..., 3, :3] = parameters[..., 1:4]
    pseudo[..., 3, 3] = parameters[..., 0]
    return pseudo


def from_pseudo_inertia(pseudo: np.ndarray) -> np.ndarray:
    """Invert `pseudo_inertia`: I = tr(Σ) 1 - Σ.

    Parameters
    ----------
    pseudo : ndarray of shape (..., 4, 4)
        Symmetric matrices.

    Returns
    -------
    parameters : ndarray of shape (..., 10)
        Inertial parameters.
    """
    pseudo = np.asarray(pseudo, dtype=np.float64)
    inertia = _complement(pseudo[..., :3, :3], 1.0)
    return np.concatenate([pseudo[..., 3, 3:], pseudo[..., 3, :3], inertia[..., _ROWS, _COLUMNS]], axis=-1)


def physical_consistency(parameters: np.ndarray) -> np.ndarray:
    """Measure whether links are physical: above 0 if a body with these parameters exists.

    It is the smallest eigenvalue of the pseudo-inertia at the centre of mass, diag(Σ_c, m), in units of the link:
    ``|m|`` for the mass, and for Σ_c the mean absolute value of its three eigenvalues. It is independent of units and
    of the joint's frame. It is 1 for a ball or a cube, some hundredths for a slender link, and 0 for a plate without
    thickness, a rod, a point, and ten zeros. It is below 0, and at least -3, if moments of inertia violate the triangle
    inequality or the mass is negative.

    Parameters
    ----------
    parameters : ndarray of shape (..., 10)
        Inertial parameters.

    Returns
    -------
    consistency : ndarray of shape (...)
        A number for each link.
    """
    pseudo = pseudo_inertia(parameters)
    mass, first = pseudo[..., 3, 3], pseudo[..., :3, 3]
    with np.errstate(all="ignore"):
        lever = np.divide(first, mass[..., None], out=np.zeros_like(first), where=mass[..., None] != 0.0)
        spread = pseudo[..., :3, :3] - first[..., :, None] * lever[..., None, :]
    possible = np.isfinite(spread).all(axis=(-2, -1)) & ((mass != 0.0) | (first == 0.0).all(axis=-1))
    spread = np.where(possible[..., None, None], spread, -np.eye(3))  # not physical: a first moment without a mass
    moments = np.linalg.eigvalsh(0.5 * (spread + spread.swapaxes(-2, -1)))
    size = np.abs(moments).mean(axis=-1)
    smallest = np.divide(moments[..., 0], size, out=np.zeros_like(size), where=size > 0.0)
    return np.minimum(smallest, np.sign(mass))


def body_parameters(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mass, centre of mass and inertia about it, as in URDF files, with their derivatives.

    Parameters
    ----------
    parameters : ndarray of shape (..., 10)
        Inertial parameters.

    Returns
    -------
    values : ndarray of shape (..., 10)
        m, c and I_c, in the order of I. A link without mass has c = 0.
    jacobian : ndarray of shape (..., 10, 10)
        Derivatives of the values with respect to the parameters.
    """
    parameters = np.asarray(parameters, dtype=np.float64)
    first, inverse = parameters[..., 1:4], np.zeros(parameters.shape[:-1])
    np.divide(1.0, parameters[..., 0], out=inverse, where=parameters[..., 0] != 0.0)
    inverse = inverse[..., None]
    steiner = _complement(first[..., :, None] * first[..., None, :], 1.0)[..., _ROWS, _COLUMNS] * inverse
    values = parameters.copy()
    values[..., 1:4] *= inverse
    values[..., 4:] -= steiner

    jacobian = np.zeros((*parameters.shape, N_PARAMETERS))
    jacobian[..., range(N_PARAMETERS), range(N_PARAMETERS)] = 1.0
    jacobian[..., 1:4, 0] = -values[..., 1:4] * inverse
    jacobian[..., 1:4, 1:4] *= inverse[..., None]
    jacobian[..., 4:, 0] = steiner * inverse
    for axis, unit in enumerate(np.eye(3)):
        outer = values[..., 1:4, None] * unit
        changed = _complement(outer + outer.swapaxes(-2, -1), 1.0)
        jacobian[..., 4:, 1 + axis] = -changed[..., _ROWS, _COLUMNS]
    return values, jacobian


def with_parameters(
    model: Any,
    parameters: np.ndarray,
    *,
    armature: Any = None,
    damping: Any = None,
    friction: Any = None,
) -> Any:
    """Copy a model with other inertial parameters.

    Parameters
    ----------
    model : pinocchio.Model
        Model of a robot. It is not changed.
    parameters : array-like of shape (n_links, 10)
        Physical parameters (`physical_consistency` above 0), or ten zeros for a link without mass.
    armature, damping, friction : float or array-like of shape (n_joints,), default=None
        Reflected inertias of the rotors, viscous and Coulomb friction, at least 0. If None, those of the model.

    Returns
    -------
    model : pinocchio.Model
        The copy.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite, or a link is not physical.

    See Also
    --------
    nearest_consistent : Find the physical parameters nearest to given ones.
    """
    pin = require("pinocchio", "A robot's model")
    names = list(model.names)[1:]
    checked = checked_links(parameters, names)
    joint = {"armature": armature, "damping": damping, "friction": friction}
    given = {name: checked_joints(values, name, model.nv) for name, values in joint.items() if values is not None}
    copy = model.copy()
    for index, link in enumerate(checked, start=1):
        copy.inertias[index] = pin.Inertia.FromDynamicParameters(link) if link.any() else pin.Inertia.Zero()
    for name, values in given.items():
        setattr(copy, name, values)
    return copy


def checked_parameters(parameters: Any, n_links: int | None = None, name: str = "parameters") -> np.ndarray:
    """Return finite numbers of shape (n_links, 10), None for any number of links, or raise ValueError."""
    array = as_floats(parameters, name)
    if array.ndim != 2 or array.shape != (n_links or len(array), N_PARAMETERS):
        number = "" if n_links is None else f" = ({n_links}, {N_PARAMETERS})"
        raise ValueError(f"{name} must have the shape (n_links, {N_PARAMETERS}){number}; got {array.shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite.")
    return array


def checked_covariance(covariance: Any, size: int) -> np.ndarray:
    """Return a finite symmetric matrix of shape (size, size) without negative variances, or raise ValueError."""
    array = as_floats(covariance, "covariance")
    if array.shape != (size, size):
        raise ValueError(
            f"covariance must have the shape (10 * n_links, 10 * n_links) = {(size, size)}; got {array.shape}."
        )
    if not np.isfinite(array).all() or (np.diag(array) < 0.0).any():
        raise ValueError("covariance must be finite, and its variances not negative.")
    return 0.5 * (array + array.T)


def checked_links(parameters: Any, names: list[str]) -> np.ndarray:
    """Return parameters of links that are physical or zero, or raise an error that names the first other joint."""
    array = checked_parameters(parameters, len(names))
    for link, name, consistency in zip(array, names, physical_consistency(array), strict=True):
        if consistency <= 0.0 and link.any():
            raise ValueError(
                f"No body can have the parameters of the link that the joint {name!r} moves (mass {link[0]:.3g}): "
                f"their physical_consistency is {consistency:.3g} and must be above 0. Use nearest_consistent, which "
                "finds the parameters nearest to them that bodies can have."
            )
    return array


def checked_joints(values: Any, name: str, n_joints: int) -> np.ndarray:
    """Return a number of at least 0 for each joint, or raise ValueError."""
    array = as_floats(values, name)
    if array.shape not in ((), (n_joints,)):
        raise ValueError(f"{name} must be a number or have the shape (n_joints,) = ({n_joints},); got {array.shape}.")
    if not (np.isfinite(array) & (array >= 0.0)).all():
        raise ValueError(f"{name} must be finite and not negative; got {array.tolist()}.")
    return np.broadcast_to(array, n_joints).copy()


def _symmetric(values: np.ndarray) -> np.ndarray:
    matrix = np.empty((*values.shape[:-1], 3, 3))
    matrix[..., _ROWS, _COLUMNS] = matrix[..., _COLUMNS, _ROWS] = values
    return matrix


def _complement(matrix: np.ndarray, share: float) -> np.ndarray:
    """Return ``share`` tr(A) 1 - A."""
    trace = np.trace(matrix, axis1=-2, axis2=-1)[..., None, None]
    return share * trace * np.eye(3) - matrix
