"""Trajectories of a robot under inputs that are held over each time step."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Literal, overload

import numpy as np
from joblib import Parallel, delayed, effective_n_jobs
from numpy.typing import ArrayLike

from ..robots.loading import Robot
from ..utils.validation import as_floats, check_integer, check_real
from .control import ComputedTorqueController
from .plant import Plant

Controller = Callable[[int, np.ndarray], ArrayLike]

# Number of trajectories that are integrated together for any n_jobs, so that the result does not depend on it. It is
# large enough that most of the time is spent in C++.
_GROUP = 64


@overload
def simulate(
    system: Robot,
    z0: ArrayLike,
    U: ArrayLike | Controller,
    dt: float = ...,
    *,
    n_steps: int | None = ...,
    wrap_angles: bool = ...,
    return_inputs: Literal[False] = ...,
    n_jobs: int | None = ...,
) -> np.ndarray: ...
@overload
def simulate(
    system: Robot,
    z0: ArrayLike,
    U: ArrayLike | Controller,
    dt: float = ...,
    *,
    n_steps: int | None = ...,
    wrap_angles: bool = ...,
    return_inputs: Literal[True],
    n_jobs: int | None = ...,
) -> tuple[np.ndarray, np.ndarray]: ...
def simulate(
    system: Robot,
    z0: ArrayLike,
    U: ArrayLike | Controller,
    dt: float = 0.03,
    *,
    n_steps: int | None = None,
    wrap_angles: bool = False,
    return_inputs: bool = False,
    n_jobs: int | None = None,
) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
    """Integrate the equations of motion of a robot, with the input held over each step.

    Pinocchio's articulated-body algorithm gives the accelerations, with the effort limits and the viscous damping of
    the model. A model whose effort limits are all 0 has no limits. Dry friction, contacts, and limits of positions and
    velocities are not simulated.

    Parameters
    ----------
    system : str, path-like, System or pinocchio.Model
        Robot as in `load_robot`: a name of `list_robots`, the path of a URDF or an MJCF file, or a model.
    z0 : array-like of shape (2 * n_joints,) or (n_trajectories, 2 * n_joints)
        Initial states: joint positions (rad or m), then velocities (rad/s or m/s).
    U : array-like of shape (n_steps, n_inputs) or (n_trajectories, n_steps, n_inputs), or callable
        Torques (N m) or forces (N) on the driven joints, or a function ``controller(step, Z)``. The function is called
        once per step with the states (n_trajectories, 2 * n_joints), and returns the inputs (n_trajectories, n_inputs).
    dt : float, default=0.03
        Length of a step, s. A `ComputedTorqueController` must have the same ``dt``.
    n_steps : int, default=None
        Number of steps. It is required with a controller, and not allowed otherwise.
    wrap_angles : bool, default=False
        Whether to return revolute positions in [-pi, pi). A controller always gets them unwrapped.
    return_inputs : bool, default=False
        Whether to return the inputs too, after the effort limits are applied.
    n_jobs : int, default=None
        Number of processes for groups of 64 trajectories. If None, 1; if -1, all cores. The result does not depend on
        it.

    Returns
    -------
    Z : ndarray of shape (n_steps + 1, 2 * n_joints) or (n_trajectories, n_steps + 1, 2 * n_joints)
        States at the times 0, dt, 2 dt, ... The first one is ``z0``.
    inputs : ndarray of shape (n_steps, n_inputs) or (n_trajectories, n_steps, n_inputs)
        Inputs ``U`` within the limits of the motors. They are returned only if ``return_inputs`` is True.

    Raises
    ------
    ImportError
        If Pinocchio is not installed.
    ValueError, TypeError
        If a shape does not fit the robot, a value is not a finite real number, or ``dt`` is not positive. If the robot
        is unknown, its mass matrix is singular, or the integrator fails.

    Warns
    -----
    RobotModelWarning
        If the model of the robot is unphysical, as in `load_robot`.

    See Also
    --------
    ComputedTorqueController : Controller for robots whose joints are all driven.

    Notes
    -----
    The integrator is SciPy's DOP853 with a relative tolerance of 1e-11, started again at each step. If damping acts
    more than 200 times faster than ``dt``, the implicit Radau with a tolerance of 1e-6 is used instead. Robots with
    light links and strong damping, such as ``"xarm7"``, take longer than others.

    Examples
    --------
    Release a pendulum at 0.1 rad, without torque, for three steps:

    >>> import numpy as np
    >>> from skevgp.datasets import simulate
    >>> simulate("pendulum", [0.1, 0.0], np.zeros((3, 1))).round(4)
    array([[ 0.1   ,  0.    ],
           [ 0.0991, -0.0582],
           [ 0.0965, -0.1148],
           [ 0.0923, -0.1686]])

    Do the same with a torque that brakes it:

    >>> simulate("pendulum", [0.1, 0.0], lambda step, Z: -2.0 * Z[:, 1:], n_steps=3).round(4)
    array([[ 0.1   ,  0.    ],
           [ 0.0991, -0.0582],
           [ 0.0967, -0.1009],
           [ 0.0932, -0.1312]])
    """
    # A plant has been checked: no second warning.
    plant = system if isinstance(system, Plant) else Plant(system)
    layout = plant.layout
    n, n_inputs = layout.n_joints, layout.n_inputs
    check_real(dt, "dt", minimum=0.0, strict=True)
    z0 = as_floats(z0, "z0")
    single = z0.ndim == 1
    z = np.atleast_2d(z0)
    if z.ndim != 2 or z.shape[1] != 2 * n or len(z) == 0:
        raise ValueError(
            f"z0 must have {2 * n} columns for the system {layout.name!r} and some rows; got the shape {z0.shape}."
        )
    if callable(U):
        if n_steps is None:
            raise ValueError("A controller needs n_steps.")
        if isinstance(U, ComputedTorqueController) and not math.isclose(U.dt, dt):
            raise ValueError(f"dt must be that of the controller, {U.dt!r}; got {dt!r}.")
        n_steps, controller = check_integer(n_steps, "n_steps", minimum=0), U
    elif n_steps is not None:
        raise ValueError(f"Pass n_steps={n_steps!r} only with a controller. U determines the number of steps.")
    else:
        n_steps, controller = _held(as_floats(U, "U"), len(z), n_inputs, single, layout.name)
    if not np.isfinite(z).all():
        raise ValueError("z0 and U must be finite.")

    Z, inputs = np.empty((len(z), n_steps + 1, 2 * n)), np.empty((len(z), n_steps, n_inputs))
    Z[:, 0] = z
    groups = [slice(first, first + _GROUP) for first in range(0, len(z), _GROUP)]
    stiff = [plant.is_stiff(z[group, :n], dt) for group in groups]
    n_tasks = min(effective_n_jobs(n_jobs), len(groups))
    ends = [len(groups) * task // n_tasks for task in range(n_tasks + 1)]
    tasks = [list(zip(groups[i:j], stiff[i:j], strict=True)) for i, j in pairwise(ends)]
    with Parallel(n_jobs=n_tasks) as parallel:
        for step in range(n_steps):
            u = _inputs_of(controller, step, Z[:, step].copy(), n_inputs)
            inputs[:, step] = np.clip(u, *plant.limits)
            after = parallel(
                delayed(_advance)(plant, dt, [(Z[group, step], inputs[group, step], stiff) for group, stiff in task])
                for task in tasks
            )
            Z[:, step + 1] = np.concatenate(after)
    if wrap_angles:
        Z -= turns(Z, layout.revolute)
    if single:
        Z, inputs = Z[0], inputs[0]
    return (Z, inputs) if return_inputs else Z


def _advance(plant: Plant, dt: float, groups: list[tuple[np.ndarray, np.ndarray, bool]]) -> np.ndarray:
    """Return the next states of some groups of trajectories."""
    return np.concatenate([plant.advance(z, u, dt, stiff) for z, u, stiff in groups])


def turns(Z: np.ndarray, revolute: tuple[bool, ...]) -> np.ndarray:
    """Return multiples of 2 pi to subtract from states (..., 2 * n_joints) for revolute positions in [-pi, pi)."""
    away = np.zeros_like(Z)
    columns = np.flatnonzero(revolute)
    angles = Z[..., columns]
    count = np.floor((angles + np.pi) / (2.0 * np.pi))
    # Rounding may leave an angle just outside.
    count += angles - 2.0 * np.pi * count >= np.pi
    count -= angles - 2.0 * np.pi * count < -np.pi
    away[..., columns] = 2.0 * np.pi * count
    return away


def _held(U: np.ndarray, n_trajectories: int, n_inputs: int, single: bool, name: str) -> tuple[int, Controller]:
    """Return the number of steps of given inputs, and a controller that returns them."""
    inputs = U[np.newaxis] if single else U
    if inputs.ndim != 3 or len(inputs) != n_trajectories or inputs.shape[2] != n_inputs:
        wanted = f"(n_steps, {n_inputs})" if single else f"({n_trajectories}, n_steps, {n_inputs})"
        raise ValueError(f"U must have the shape {wanted} for the system {name!r}; got {U.shape}.")
    if not np.isfinite(inputs).all():
        raise ValueError("z0 and U must be finite.")
    return inputs.shape[1], lambda step, _Z: inputs[:, step]


def _inputs_of(controller: Controller, step: int, Z: np.ndarray, n_inputs: int) -> np.ndarray:
    wanted = (len(Z), n_inputs)
    u = as_floats(controller(step, Z), "The controller's inputs")
    if u.shape != wanted or not np.isfinite(u).all():
        found = f"the shape {u.shape}" if u.shape != wanted else "NaN or infinity"
        raise ValueError(f"The controller must return finite inputs of shape {wanted}; got {found} in step {step}.")
    return u
