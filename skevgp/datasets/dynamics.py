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

    Each trajectory starts at a random state. Random inputs drive robots with a joint that has no motor, and the
    pendulum. All other robots follow smooth references by computed-torque control. The page
    :doc:`/howto/urdf_reference` describes how each robot is sampled.

    Parameters
    ----------
    system : str, path-like, System or pinocchio.Model
        Robot as in `load_robot`: a name of `list_robots`, the path of a URDF or an MJCF file, or a model.
    n_trajectories : int, default=None
        Number of trajectories. If None, that of the paper, or 100 for other robots.
    n_steps : int, default=None
        Number of steps per trajectory. If None, that of the paper, or 50 for other robots.
    dt : float, default=0.03
        Length of a step, s. Robots with light links need a short step.
    duration : float, default=None
        Duration of a controlled move, s. Afterwards the target is held. If None, the move takes the whole trajectory.
    noise : float, default=0.0
        Standard deviation of the Gaussian noise on each target, as a share of the standard deviation of that target.
    input_noise : float, default=0.0
        Standard deviation of the noise on the states in ``data``, as a share of that of each state.
    wrap_angles : bool, default=False
        Whether to wrap revolute positions in ``data`` to [-pi, pi). ``target`` is shifted by the same multiple of 2 pi.
    n_jobs : int, default=None
        Number of processes, as in `simulate`. The result does not depend on it.
    random_state : int, RandomState instance or None, default=None
        Seed of the initial states, the inputs and the noise.
    return_X_y : bool, default=False
        Whether to return ``(data, target)`` instead of a Bunch.

    Returns
    -------
    dynamics : :class:`~sklearn.utils.Bunch`
        The data set, with n_rows = n_trajectories * n_steps, one trajectory after the other:

        - ``data`` : ndarray of shape (n_rows, 2 * n_joints + n_inputs), with positions, velocities and inputs in SI
          units;
        - ``target`` : ndarray of shape (n_rows, 2 * n_joints), with positions and velocities after ``dt``;
        - ``groups`` : ndarray of shape (n_rows,), with the trajectory of each row;
        - ``trajectories`` : ndarray of shape (n_trajectories, n_steps + 1, 2 * n_joints), with the true states;
        - ``dt`` and ``robot``, as given, for feature maps such as ``InertiaForce(robot, dt=dt)``;
        - ``feature_names``, ``target_names``, ``DESCR``.
    (data, target) : tuple of ndarray
        Returned only if ``return_X_y`` is True.

    Raises
    ------
    ImportError
        If Pinocchio is not installed.
    ValueError, TypeError
        If an argument is out of its range or of the wrong type. If the robot is unknown or cannot be simulated. If
        controlled moves are unstable, because ``dt`` is too long or ``duration`` is too short.

    Warns
    -----
    RobotModelWarning
        If the model of the robot is unphysical, as in `load_robot`.

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
