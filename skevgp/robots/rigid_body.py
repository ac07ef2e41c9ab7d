"""Pinocchio's recursive algorithms over many rows at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._optional import require


class RigidBody:
    """Forward and inverse dynamics of a robot, for many states at once.

    Pinocchio's articulated-body and recursive Newton-Euler algorithms, without damping; each call is one loop over
    rows in C++ where Pinocchio was built with OpenMP. It can be pickled, and several threads may use it.

    Parameters
    ----------
    model : pinocchio.Model
        With one position and one velocity per joint.
    n_threads : int, default=1
        Threads inside each call; the result does not depend on it.
    """

    def __init__(self, model: Any, n_threads: int = 1):
        self.model = model.copy()  # what the user does to it later changes nothing
        self.n_threads = n_threads

    def __getstate__(self) -> dict[str, Any]:
        return {"model": self.model, "n_threads": self.n_threads}

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
            self._weightless = RigidBody(model, self.n_threads)
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
        """M(q) at one configuration, with reflected rotor inertias on its diagonal.

        Parameters
        ----------
        q : ndarray of shape (n_joints,)

        Returns
        -------
        mass : ndarray of shape (n_joints, n_joints)
        """
        each = np.eye(len(q))
        rows = np.broadcast_to(q, each.shape)
        return self.forces(rows, np.zeros_like(each), each) - self.gravity(rows)

    def _over_rows(self, algorithm: str, *rows: np.ndarray) -> np.ndarray:
        pin = require("pinocchio", "Rigid-body dynamics")
        if not hasattr(pin, f"{algorithm}InParallel"):
            one, data = getattr(pin, algorithm), self.model.createData()
            return np.array([one(self.model, data, *row) for row in zip(*rows, strict=True)]).reshape(rows[0].shape)
        if not hasattr(self, "_pool"):
            self._pool = pin.ModelPool(self.model, self.n_threads)
        columns = [np.asfortranarray(part.T) for part in rows]
        result = getattr(pin, f"{algorithm}InParallel")(self.n_threads, self._pool, *columns)
        return result.reshape(columns[0].shape, order="F").T  # a single row or joint comes back as a vector
