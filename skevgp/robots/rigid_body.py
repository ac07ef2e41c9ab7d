"""Pinocchio's recursive algorithms for many rows at once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ..utils.optional import require
from .loading import layout_of
from .numbers import RobotNumbers


class RigidBody:
    """Forward and inverse dynamics of a robot, for many states at once.

    It uses Pinocchio's articulated-body and recursive Newton-Euler algorithms. Each call is one loop over rows in C++
    if Pinocchio was built with OpenMP. It can be pickled, and several threads may use it.

    Parameters
    ----------
    model : pinocchio.Model
        Model with one position and one velocity per joint. It is copied.
    """

    def __init__(self, model: Any):
        self.model = model.copy()  # so that later changes by the user have no effect
        self._damping = np.array(model.damping)
        self._driven = np.array(layout_of(model).driven)

    def __getstate__(self) -> dict[str, Any]:
        return {"model": RobotNumbers.of(self.model) or self.model}

    def __setstate__(self, state: dict[str, Any]) -> None:
        model = state["model"]
        self.__init__(model.model() if isinstance(model, RobotNumbers) else model)  # type: ignore[misc]

    def joint_forces(self, u: np.ndarray) -> np.ndarray:
        """Return joint forces B u (n, n_joints) of inputs u (n, n_inputs): 0 on joints without input."""
        force = np.zeros((len(u), self.model.nv))
        force[:, self._driven] = u
        return force

    def accelerations_under(self, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return q̈ = M(q)⁻¹ (B u - D q̇ - C(q, q̇)q̇ - g(q)), with the model's viscous damping D.

        Parameters
        ----------
        q, v : ndarray of shape (n, n_joints)
            Positions and velocities.
        u : ndarray of shape (n, n_inputs)
            Inputs.

        Returns
        -------
        a : ndarray of shape (n, n_joints)
            Accelerations. They are NaN or infinite if the mass matrix is singular.
        """
        return self.accelerations(q, v, self.joint_forces(u) - self._damping * v)

    def accelerations(self, q: np.ndarray, v: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Return q̈ = M(q)⁻¹ (τ - C(q, q̇)q̇ - g(q)), by the articulated-body algorithm.

        Parameters
        ----------
        q, v, force : ndarray of shape (n, n_joints)
            Positions, velocities and joint forces τ.

        Returns
        -------
        a : ndarray of shape (n, n_joints)
            Accelerations. They are NaN or infinite if the mass matrix is singular.
        """
        return self._over_rows("aba", q, v, force)

    def accelerations_by_force(self, q: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Return M(q)⁻¹ τ (n, n_joints), the accelerations by joint forces τ, at positions q, (n, n_joints) each."""
        return self._without_gravity.accelerations(q, np.zeros_like(q), force)

    def forces(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return τ = M(q)q̈ + C(q, q̇)q̇ + g(q), by the recursive Newton-Euler algorithm.

        Parameters
        ----------
        q, v, a : ndarray of shape (n, n_joints)
            Positions, velocities and accelerations.

        Returns
        -------
        force : ndarray of shape (n, n_joints)
            Joint forces.
        """
        return self._over_rows("rnea", q, v, a)

    def forces_under_damping(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return B u = M(q)q̈ + C(q, q̇)q̇ + D q̇ + g(q) (n, n_joints), the inverse of `accelerations_under`."""
        return self.forces(q, v, a) + self._damping * v

    def inertial_forces(self, q: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return M(q)q̈ (n, n_joints), the inverse of `accelerations_by_force`."""
        return self._without_gravity.forces(q, np.zeros_like(q), a)

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Return g(q) (n, n_joints), the joint forces that hold the robot still at positions q (n, n_joints)."""
        still = np.zeros_like(q)
        return self.forces(q, still, still)

    def accelerations_under_jacobian(self, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return analytic derivatives of `accelerations_under` in [q, q̇, u].

        They are those of Pinocchio (Carpentier & Mansard, "Analytical derivatives of rigid body dynamics algorithms",
        RSS 2018).

        Parameters
        ----------
        q, v : ndarray of shape (n, n_joints)
            Positions and velocities.
        u : ndarray of shape (n, n_inputs)
            Inputs.

        Returns
        -------
        jacobian : ndarray of shape (n, n_joints, 2 * n_joints + n_inputs)
            Derivatives. They are NaN or infinite if the mass matrix is singular.
        """
        force = self.joint_forces(u) - self._damping * v
        by_q, by_v, by_force = self._derivatives("computeABADerivatives", q, v, force)
        # The force of damping depends on the velocity too.
        return np.concatenate([by_q, by_v - by_force * self._damping, by_force[:, :, self._driven]], axis=2)

    def accelerations_by_force_jacobian(self, q: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return derivatives of `accelerations_by_force` for forces B u in [q, q̇, u], (n, n_joints, n_columns)."""
        body, force = self._without_gravity, self.joint_forces(u)
        by_q, _, by_force = body._derivatives("computeABADerivatives", q, np.zeros_like(q), force)
        return np.concatenate([by_q, np.zeros_like(by_q), by_force[:, :, self._driven]], axis=2)

    def forces_jacobian(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return derivatives of `forces` in [q, q̇, u], (n, n_joints, n_columns); those in u are 0."""
        by_q, by_v, _ = self._derivatives("computeRNEADerivatives", q, v, a)
        return self._by_state(by_q, by_v)

    def gravity_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return derivatives of `gravity` in [q, q̇, u], (n, n_joints, n_columns); only those in q are not 0."""
        (by_q,) = self._derivatives("computeGeneralizedGravityDerivatives", q)
        return self._by_state(by_q, np.zeros_like(by_q))

    def torque_regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return Y(q, q̇, q̈) with `forces` = Y π, by Pinocchio's joint torque regressor.

        Parameters
        ----------
        q, v, a : ndarray of shape (n, n_joints)
            Positions, velocities and accelerations.

        Returns
        -------
        regressor : ndarray of shape (n, n_joints, 10 * n_joints)
            Factors of the inertial parameters π of the links, from the base to the tip: mass m, first moments m c and
            moments of inertia Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the joint's frame. Reflected rotor inertias are not
            included.
        """
        n, n_joints = q.shape
        regressor = np.empty((n, n_joints, 10 * n_joints))
        compute = require("pinocchio", "Rigid-body dynamics").computeJointTorqueRegressor
        with self._idle_data() as data:
            for rows, *row in zip(regressor, q, v, a, strict=True):
                rows[:] = compute(self.model, data, *row)  # a view of data, until its next use
        return regressor

    def _by_state(self, by_q: np.ndarray, by_v: np.ndarray) -> np.ndarray:
        return np.concatenate([by_q, by_v, np.zeros((*by_q.shape[:2], len(self._driven)))], axis=2)

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """Return M(q) (n_joints, n_joints) at one configuration q (n_joints,), with reflected rotor inertias."""
        pin = require("pinocchio", "Rigid-body dynamics")
        upper = np.triu(pin.crba(self.model, self.model.createData(), q))
        return upper + np.triu(upper, 1).T

    @property
    def _without_gravity(self) -> RigidBody:
        if not hasattr(self, "_weightless"):
            model = self.model.copy()
            model.gravity.linear = np.zeros(3)
            self._weightless = RigidBody(model)
        return self._weightless

    def _derivatives(self, algorithm: str, *rows: np.ndarray) -> np.ndarray:
        """Return the matrices of one of Pinocchio's algorithms for each row, (n_matrices, n, n_joints, n_joints)."""
        derive = getattr(require("pinocchio", "Rigid-body dynamics"), algorithm)
        n, n_joints = rows[0].shape
        found = np.empty((n, 1 if algorithm == "computeGeneralizedGravityDerivatives" else 3, n_joints, n_joints))
        with self._idle_data() as data:
            for matrices, *row in zip(found, *rows, strict=True):
                matrices[:] = derive(self.model, data, *row)  # views of data, until its next use
        return found.swapaxes(0, 1)

    @contextmanager
    def _idle_data(self) -> Iterator[Any]:
        """Lend a work space of Pinocchio: one for each concurrent thread, because they take long to make."""
        idle = vars(self).setdefault("_idle", [])
        try:
            data = idle.pop()
        except IndexError:
            data = self.model.createData()
        yield data
        idle.append(data)

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
