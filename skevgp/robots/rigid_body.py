"""Pinocchio's recursive algorithms over many rows at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._optional import require
from .loading import layout_of


class RigidBody:
    """Forward and inverse dynamics of a robot, for many states at once.

    Pinocchio's articulated-body and recursive Newton-Euler algorithms; each call is one loop over rows in C++ where
    Pinocchio was built with OpenMP. It can be pickled, and several threads may use it.

    Parameters
    ----------
    model : pinocchio.Model
        With one position and one velocity per joint; it is copied.
    """

    def __init__(self, model: Any):
        self.model = model.copy()  # what the user does to it later changes nothing
        self._damping = np.array(model.damping)
        self._driven = np.array(layout_of(model).driven)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_pool", "_weightless")}

    def joint_forces(self, u: np.ndarray) -> np.ndarray:
        """B u, the inputs on the driven joints and 0 on the others.

        Parameters
        ----------
        u : ndarray of shape (n, n_inputs)

        Returns
        -------
        force : ndarray of shape (n, n_joints)
        """
        force = np.zeros((len(u), self.model.nv))
        force[:, self._driven] = u
        return force

    def accelerations_under(self, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        """q̈ = M(q)⁻¹ (B u - D q̇ - C(q, q̇)q̇ - g(q)), with the model's viscous damping D.

        Parameters
        ----------
        q, v : ndarray of shape (n, n_joints)
            Positions and velocities.
        u : ndarray of shape (n, n_inputs)

        Returns
        -------
        a : ndarray of shape (n, n_joints)
            NaN or infinite where the mass matrix is singular.
        """
        return self.accelerations(q, v, self.joint_forces(u) - self._damping * v)

    def accelerations(self, q: np.ndarray, v: np.ndarray, force: np.ndarray) -> np.ndarray:
        """q̈ = M(q)⁻¹ (τ - C(q, q̇)q̇ - g(q)), by the articulated-body algorithm.

        Parameters
        ----------
        q, v, force : ndarray of shape (n, n_joints)
            Positions, velocities and joint forces τ.

        Returns
        -------
        a : ndarray of shape (n, n_joints)
            NaN or infinite where the mass matrix is singular.
        """
        return self._over_rows("aba", q, v, force)

    def accelerations_by_force(self, q: np.ndarray, force: np.ndarray) -> np.ndarray:
        """M(q)⁻¹ τ, what joint forces add to the accelerations.

        Parameters
        ----------
        q, force : ndarray of shape (n, n_joints)
            Positions and joint forces τ.

        Returns
        -------
        a : ndarray of shape (n, n_joints)
            NaN or infinite where the mass matrix is singular.
        """
        if not hasattr(self, "_weightless"):
            model = self.model.copy()
            model.gravity.linear = np.zeros(3)
            self._weightless = RigidBody(model)
        return self._weightless.accelerations(q, np.zeros_like(q), force)

    def forces(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """τ = M(q)q̈ + C(q, q̇)q̇ + g(q), by the recursive Newton-Euler algorithm.

        Parameters
        ----------
        q, v, a : ndarray of shape (n, n_joints)
            Positions, velocities and accelerations.

        Returns
        -------
        force : ndarray of shape (n, n_joints)
        """
        return self._over_rows("rnea", q, v, a)

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """g(q), the joint forces that hold the robot still.

        Parameters
        ----------
        q : ndarray of shape (n, n_joints)

        Returns
        -------
        force : ndarray of shape (n, n_joints)
        """
        still = np.zeros_like(q)
        return self.forces(q, still, still)

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """M(q) at one configuration, with reflected rotor inertias, by the composite-rigid-body algorithm.

        Parameters
        ----------
        q : ndarray of shape (n_joints,)

        Returns
        -------
        mass : ndarray of shape (n_joints, n_joints)
        """
        pin = require("pinocchio", "Rigid-body dynamics")
        upper = np.triu(pin.crba(self.model, self.model.createData(), q))
        return upper + np.triu(upper, 1).T

    def _over_rows(self, algorithm: str, *rows: np.ndarray) -> np.ndarray:
        pin = require("pinocchio", "Rigid-body dynamics")
        if not hasattr(pin, f"{algorithm}InParallel"):
            one, data = getattr(pin, algorithm), self.model.createData()
            return np.array([one(self.model, data, *row) for row in zip(*rows, strict=True)]).reshape(rows[0].shape)
        if not hasattr(self, "_pool"):
            self._pool = pin.ModelPool(self.model, 1)
        columns = [np.asfortranarray(part.T) for part in rows]
        result = getattr(pin, f"{algorithm}InParallel")(1, self._pool, *columns)
        return result.reshape(columns[0].shape, order="F").T  # a single row or joint comes back as a vector
