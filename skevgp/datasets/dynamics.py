"""Data sets for learning dynamics: x = (state, input), y = state one step later."""

from __future__ import annotations

from typing import Literal, overload

import numpy as np
from sklearn.utils import Bunch, check_random_state

from ..robots.loading import Robot
from ..utils.validation import check_integer, check_real
from .plant import Plant
from .sampling import sampling_of
from .simulation import simulate, turns

RandomState = int | np.random.RandomState | None


@overload
def make_dynamics(
    system: Robot,
    n_trajectories: int | None = ...,
    n_steps: int | None = ...,
    *,
    dt: float = ...,
    duration: float | None = ...,
    noise: float = ...,
    input_noise: float = ...,
    wrap_angles: bool = ...,
    n_jobs: int | None = ...,
    random_state: RandomState = ...,
    return_X_y: Literal[False] = ...,
) -> Bunch: ...
@overload
def make_dynamics(
    system: Robot,
    n_trajectories: int | None = ...,
    n_steps: int | None = ...,
    *,
    dt: float = ...,
    duration: float | None = ...,
    noise: float = ...,
    input_noise: float = ...,
    wrap_angles: bool = ...,
    n_jobs: int | None = ...,
    random_state: RandomState = ...,
    return_X_y: Literal[True],
) -> tuple[np.ndarray, np.ndarray]: ...
def make_dynamics(
    system: Robot,
    n_trajectories: int | None = None,
    n_steps: int | None = None,
    *,
    dt: float = 0.03,
    duration: float | None = None,
    noise: float = 0.0,
    input_noise: float = 0.0,
    wrap_angles: bool = False,
    n_jobs: int | None = None,
    random_state: RandomState = None,
    return_X_y: bool = False,
) -> Bunch | tuple[np.ndarray, np.ndarray]:
    """Simulate data sets of a robot, such as those of section IV-B of the paper.

    The pendulum, the cartpole and the acrobot start at ``alpha * U(-1, 1)`` and are driven by inputs ``eta * N(0, 1)``,
    held over each step, with the scales of the paper (its Table 1). ``"cartpole"`` is Drake's own example, without
    friction. ``"cartpole_damped"`` has a damping of 0.1 N s/m and 0.1 N m s/rad on its joints, as in MIT's course
    Underactuated Robotics until May 2022. The paper does not say which one it has.

    The arm iiwa14 starts at rest with joints at U(-1.5, 1.5) rad, and moves to a target within 0.8 rad of each joint.
    It follows a quintic reference by computed-torque control (gains 100, 20 and 1, held over each step), with noise of
    standard deviation 0.1 * (3, 15, 3, 2, 2, 2, 0.05) N m on the torques. See Notes on other robots.

    Parameters
    ----------
    system : str, path-like, System or pinocchio.Model
        Robot as in `load_robot`: ``"pendulum"``, ``"cartpole"``, ``"cartpole_damped"``, ``"acrobot"``, ``"iiwa14"``,
        another name of `list_robots`, the path of a URDF file, or a model.
    n_trajectories : int, default=None
        Number of trajectories, at least 1. If None, that of the paper (48, 93 for the acrobot, 465 for iiwa14), and 100
        for other robots.
    n_steps : int, default=None
        Number of steps per trajectory, at least 1. If None, that of the paper (100, 50 for iiwa14), and 50 for other
        robots.
    dt : float, default=0.03
        Length of a step, s. Above 0.03 the gains of the controller are lower. Robots with light links need a short
        step.
    duration : float, default=None
        Duration of a controlled move, s. Then the target is held. If None, the move takes the whole trajectory. Only
        for robots that are controlled.
    noise : float, default=0.0
        Standard deviation of the Gaussian noise on each target, as a fraction of the standard deviation of that target.
    input_noise : float, default=0.0
        Standard deviation of the noise on the states in ``data``, as a fraction of that of each state. Inputs are
        exact.
    wrap_angles : bool, default=False
        Whether to wrap revolute positions in ``data`` to [-pi, pi), after noise was added. ``target`` is shifted by the
        same multiple of 2 pi, so that the difference stays small.
    n_jobs : int, default=None
        Number of processes for the simulation, as in `simulate`. The result does not depend on it.
    random_state : int, RandomState instance or None, default=None
        Seed of the initial states, of the inputs (or the targets, then the noise on the torques), and of the noise on
        states and targets, in this order.
    return_X_y : bool, default=False
        Whether to return ``(data, target)`` instead of a Bunch.

    Returns
    -------
    dynamics : :class:`~sklearn.utils.Bunch`
        The data set, with n_rows = n_trajectories * n_steps, one trajectory after the other:

        - ``data`` : ndarray of shape (n_rows, 2 * n_joints + n_inputs): positions (rad or m), velocities (rad/s or
          m/s) and inputs within the motors' limits (N m or N);
        - ``target`` : ndarray of shape (n_rows, 2 * n_joints): positions and velocities after ``dt``;
        - ``groups`` : ndarray of shape (n_rows,): the trajectory of each row, for `GroupKFold`;
        - ``trajectories`` : ndarray of shape (n_trajectories, n_steps + 1, 2 * n_joints): true states, not wrapped;
        - ``dt`` : float, and ``robot``, as given, for feature maps (``InertiaForce(robot, dt=dt)``);
        - ``feature_names``, ``target_names``, ``DESCR``.
    (data, target) : tuple of ndarray
        Only if ``return_X_y``.

    Raises
    ------
    ImportError
        If Pinocchio is not installed.
    ValueError, TypeError
        If an argument is out of its range or of the wrong type, the robot is unknown, it cannot be simulated (see
        `simulate`), or controlled moves are unstable because ``dt`` is too long or ``duration`` too short.

    Warns
    -----
    RobotModelWarning
        If the model of the robot is unphysical, as in `load_robot`.

    Notes
    -----
    Any other robot whose joints are all driven moves like iiwa14 within its position limits. The noise on its torques
    is a tenth of the torques that hold it and accelerate each joint by 1 rad/s², or less if that would accelerate a
    light link by more than 2 rad/s². A robot with a joint without motor starts in a random state within its limits, and
    is driven by random inputs of that size, like the acrobot. A robot with the name and the size of a named system is
    sampled like it. See `simulate` on forces and computing times.

    Examples
    --------
    >>> from skevgp.datasets import make_dynamics
    >>> pendulum = make_dynamics("pendulum", n_trajectories=2, n_steps=5, random_state=0)
    >>> pendulum.data.shape, pendulum.target.shape
    ((10, 3), (10, 2))
    >>> pendulum.feature_names, pendulum.groups.tolist()
    (['q', 'dq/dt', 'u_q'], [0, 0, 0, 0, 0, 1, 1, 1, 1, 1])

    A robot of the package example-robot-data:

    >>> make_dynamics("ur5", n_trajectories=2, n_steps=5, random_state=0).data.shape
    (10, 18)
    """
    plant = Plant(system)
    layout, sampling = plant.layout, sampling_of(plant)
    n_trajectories = sampling.n_trajectories if n_trajectories is None else n_trajectories
    n_steps = sampling.n_steps if n_steps is None else n_steps
    check_integer(n_trajectories, "n_trajectories", minimum=1)
    check_integer(n_steps, "n_steps", minimum=1)
    check_real(dt, "dt", minimum=0.0, strict=True)
    if duration is not None:
        check_real(duration, "duration", minimum=0.0, strict=True)
    check_real(noise, "noise", minimum=0.0)
    check_real(input_noise, "input_noise", minimum=0.0)

    rng = check_random_state(random_state)
    z0, controller = sampling.draw(plant, (n_trajectories, n_steps), dt, duration, rng)
    trajectories, inputs = simulate(plant, z0, controller, dt, n_steps=n_steps, return_inputs=True, n_jobs=n_jobs)

    states = trajectories[:, :-1].reshape(-1, 2 * layout.n_joints)
    target = trajectories[:, 1:].reshape(states.shape)
    states = states + input_noise * states.std(axis=0) * rng.standard_normal(states.shape)
    target = target + noise * target.std(axis=0) * rng.standard_normal(target.shape)
    if wrap_angles:
        away = turns(states, layout.revolute)
        states, target = states - away, target - away
    data = np.hstack([states, inputs.reshape(-1, layout.n_inputs)])
    if return_X_y:
        return data, target
    return Bunch(
        data=data,
        target=target,
        groups=np.repeat(np.arange(n_trajectories), n_steps),
        trajectories=trajectories,
        feature_names=layout.column_names,
        target_names=layout.state_names,
        robot=system,
        dt=dt,
        DESCR=(
            f"{n_trajectories} trajectories of {n_steps} steps of {dt} s of the system {layout.name!r} under "
            f"{sampling.description}; noise {noise} on the targets and {input_noise} on the states, as fractions of "
            f"their standard deviations; angles {'' if wrap_angles else 'not '}wrapped."
        ),
    )
