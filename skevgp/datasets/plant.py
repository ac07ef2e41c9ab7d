"""A robot in the simulator: motors with limits on the driven joints, and viscous damping on all joints."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import DOP853, OdeSolver, Radau
from scipy.sparse import eye_array, kron

from ..robots import RigidBody, layout_of, load_robot
from ..robots.loading import Robot, effort_limits

# One-step errors are at most 1e-11 on the four systems, compared with the stored reference.
_EXPLICIT: dict[str, Any] = {"rtol": 1e-11, "atol": 1e-13}
# If damping brings a joint to rest within 1/200 of a step, explicit steps would be about as short, and the implicit
# method was measured to be faster, for 5 joints as for 29.
_STIFF = 200.0
_IMPLICIT: dict[str, Any] = {"rtol": 1e-6, "atol": 1e-8}
# Maximum number of the integrator's own steps: average length in s, and limits of the maximum.
_SHORTEST, _FEWEST_ALLOWED, _MOST_ALLOWED = 5e-5, 600, 20_000
_SINGULAR = 1e-13


class Plant:
    """Forward dynamics of a robot under inputs, for many states at once."""

    def __init__(self, robot: Robot):
        self.model = load_robot(robot)
        self.layout = layout_of(self.model)
        self.body = RigidBody(self.model)
        self._damping = np.array(self.model.damping)
        # Least and largest torque or force of each motor (2, n_inputs), infinite if the model has no limits.
        self.limits = effort_limits(self.model)[:, list(self.layout.driven)]

    def accelerations(self, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return joint accelerations under inputs u, (n, n_inputs)."""
        return self.body.accelerations_under(q, v, u)

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """Return M(q) (n_joints, n_joints) of one configuration, or raise an error if it is singular."""
        M = self.body.mass_matrix(q)
        eigenvalues, eigenvectors = np.linalg.eigh(M)
        null = eigenvectors[:, eigenvalues <= _SINGULAR * eigenvalues[-1]]
        if null.size:
            free = np.flatnonzero(np.linalg.norm(null, axis=1) > 0.1)
            raise ValueError(
                f"The mass matrix of {self.layout.name!r} is singular: no inertia resists the motion of the joints "
                f"{[self.layout.position_names[joint] for joint in free]}. Add inertia to their links, or armature "
                "to the model."
            )
        return M

    def is_stiff(self, q: np.ndarray, dt: float) -> bool:
        """Whether damping acts far faster than dt in one of these configurations (n, n_joints)."""
        M = np.array([self.mass_matrix(row) for row in q])
        rates = np.linalg.eigvals(np.linalg.inv(M) * self._damping)
        return bool(rates.real.max() * dt > _STIFF)

    def advance(self, z: np.ndarray, u: np.ndarray, dt: float, stiff: bool) -> np.ndarray:
        """Return the states (n, 2 * n_joints) after dt of constant inputs u (n, n_inputs)."""
        n, half = len(z), z.size // 2

        def derivative(_t: float, y: np.ndarray) -> np.ndarray:
            # All positions, then all velocities. The implicit method passes several such columns.
            columns = y.reshape(2 * half, -1).T
            q, v = columns[:, :half], columns[:, half:]
            rows = (len(columns) * n, -1)
            acceleration = self.accelerations(q.reshape(rows), v.reshape(rows), np.tile(u, (len(columns), 1)))
            if not np.isfinite(acceleration).all():
                raise ValueError(
                    f"The accelerations of {self.layout.name!r} overflow: its state or input is too large."
                )
            return np.hstack([v, acceleration.reshape(v.shape)]).T.reshape(y.shape)

        start = np.concatenate([part.ravel() for part in np.hsplit(z, 2)])
        solver: OdeSolver
        if stiff:
            n_joints = half // n
            own = kron(eye_array(n), np.ones((n_joints, n_joints)))  # a trajectory depends on itself alone
            sparsity = kron(np.ones((2, 2)), own)
            solver = Radau(derivative, 0.0, start, dt, vectorized=True, jac_sparsity=sparsity, **_IMPLICIT)
        else:
            solver = DOP853(derivative, 0.0, start, dt, **_EXPLICIT)
        allowed = int(np.clip(dt / _SHORTEST, _FEWEST_ALLOWED, _MOST_ALLOWED))
        for _ in range(allowed):
            message = solver.step()
            if solver.status != "running":
                break
        else:
            message = (
                f"it needs more than {allowed} steps of its own. A shorter dt, smaller inputs or armature may help"
            )
        if solver.status != "finished":
            raise ValueError(f"The integration of {self.layout.name!r} over {dt} s failed: {str(message).rstrip('.')}.")
        return np.hstack([part.reshape(n, -1) for part in np.split(solver.y, 2)])
