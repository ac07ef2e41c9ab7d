"""Trajectories of a system under inputs that are held over each time step."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from .._validation import as_floats, check_real
from ..robots import RigidBody, layout_of, load_robot
from ..robots.loading import Robot

# Measured against the stored reference: one-step errors below 1e-10 on the pendulum, cartpole and acrobot.
_RTOL, _ATOL = 1e-11, 1e-13


class Plant:
    """A robot as the simulator sees it: motors on the driven joints, viscous damping on all."""

    def __init__(self, robot: Robot):
        model = load_robot(robot)
        self.layout = layout_of(robot)
        self.body = RigidBody(model)
        self._damping = np.array(model.damping)
        self._driven = np.array(self.layout.driven)

    def accelerations(self, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        force = -self._damping * v
        force[:, self._driven] += u
        return self.body.accelerations(q, v, force)


def simulate(system: Robot, z0: ArrayLike, U: ArrayLike, dt: float = 0.03) -> np.ndarray:
    """Integrate a system's equations of motion with the input held over each step.

    Accelerations come from Pinocchio's articulated-body algorithm, with viscous damping subtracted from the joint
    forces; the integrator is SciPy's DOP853, started anew at each step, for all trajectories together.

    Parameters
    ----------
    system : str or System
        A named system (``"pendulum"``, ``"cartpole"``, ``"acrobot"``).
    z0 : array-like of shape (2 * n_joints,) or (n_trajectories, 2 * n_joints)
        Initial states: joint positions (rad or m), then velocities (rad/s or m/s).
    U : array-like of shape (n_steps, n_inputs) or (n_trajectories, n_steps, n_inputs)
        Inputs: torques (N m) or forces (N) on the driven joints, each held for ``dt``.
    dt : float, default=0.03
        Length of a step, s.

    Returns
    -------
    Z : ndarray of shape (n_steps + 1, 2 * n_joints) or (n_trajectories, n_steps + 1, 2 * n_joints)
        The states at the times 0, dt, 2 dt, ...; the first is ``z0``.

    Raises
    ------
    ImportError
        If Pinocchio is not installed; the message gives the pip command.
    ValueError, TypeError
        If a shape does not fit the system, a value is not a finite real number, ``dt`` is not positive, the system is
        unknown, or the integrator gives up.

    Examples
    --------
    A pendulum let go at 0.1 rad, without torque, for three steps:

    >>> import numpy as np
    >>> from skevgp.datasets import simulate
    >>> simulate("pendulum", [0.1, 0.0], np.zeros((3, 1))).round(4)
    array([[ 0.1   ,  0.    ],
           [ 0.0991, -0.0582],
           [ 0.0965, -0.1148],
           [ 0.0923, -0.1686]])
    """
    plant = Plant(system)
    system = plant.layout
    n, n_inputs = system.n_joints, system.n_inputs
    check_real(dt, "dt", minimum=0.0, strict=True)
    z0, U = as_floats(z0, "z0"), as_floats(U, "U")
    single = z0.ndim == 1
    z, inputs = np.atleast_2d(z0), U[np.newaxis] if single else U
    if z.ndim != 2 or z.shape[1] != 2 * n or len(z) == 0:
        raise ValueError(
            f"z0 must have {2 * n} columns for the system {system.name!r} and some rows; got the shape {z0.shape}."
        )
    if inputs.ndim != 3 or inputs.shape[0] != len(z) or inputs.shape[2] != n_inputs:
        wanted = f"(n_steps, {n_inputs})" if single else f"({len(z)}, n_steps, {n_inputs})"
        raise ValueError(f"U must have the shape {wanted} for the system {system.name!r}; got {U.shape}.")
    if not (np.isfinite(z).all() and np.isfinite(inputs).all()):
        raise ValueError("z0 and U must be finite.")

    def derivative(_t: float, flat: np.ndarray, u: np.ndarray) -> np.ndarray:
        state = flat.reshape(-1, 2 * n)
        q, v = state[:, :n], state[:, n:]
        change = np.hstack([v, plant.accelerations(q, v, u)]).ravel()
        if not np.isfinite(change).all():
            raise ValueError(f"The accelerations of {system.name!r} overflow: z0 or U is too large.")
        return change

    Z = np.empty((len(z), inputs.shape[1] + 1, 2 * n))
    Z[:, 0] = z
    for step in range(inputs.shape[1]):
        solution = solve_ivp(
            derivative,
            (0.0, dt),
            Z[:, step].ravel(),
            method="DOP853",
            t_eval=(dt,),
            args=(inputs[:, step],),
            rtol=_RTOL,
            atol=_ATOL,
        )
        if not solution.success:
            raise ValueError(f"The integration of {system.name!r} failed in step {step}: {solution.message}")
        Z[:, step + 1] = solution.y[:, -1].reshape(-1, 2 * n)
    return Z[0] if single else Z
