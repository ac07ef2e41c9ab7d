"""Data sets for learning dynamics: x = (state, input) now, y = state one step later."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, overload

import numpy as np
from sklearn.utils import Bunch, check_random_state

from .._validation import check_integer, check_real
from ..robots import layout_of
from ..robots.loading import Robot
from .simulation import simulate

RandomState = int | np.random.RandomState | None


@dataclass(frozen=True)
class _Sampling:
    """A row of the paper's Table 2: how trajectories of a system are drawn."""

    state_scale: tuple[float, ...]  # alpha: the first state is alpha * U(-1, 1)
    input_scale: float  # eta: each input is eta * N(0, 1)
    n_trajectories: int  # H
    n_steps: int = 100


_PAPER: Mapping[str, _Sampling] = MappingProxyType(
    {
        "pendulum": _Sampling((np.pi, 0.5), 1.0, 48),
        "cartpole": _Sampling((1.0, np.pi, 0.5, 0.5), 100.0, 48),
        "acrobot": _Sampling((np.pi, 1.0, 0.5, 0.5), 0.5, 93),
    }
)


@overload
def make_dynamics(
    system: Robot,
    n_trajectories: int | None = ...,
    n_steps: int | None = ...,
    *,
    dt: float = ...,
    noise: float = ...,
    input_noise: float = ...,
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
    noise: float = ...,
    input_noise: float = ...,
    random_state: RandomState = ...,
    return_X_y: Literal[True],
) -> tuple[np.ndarray, np.ndarray]: ...
def make_dynamics(
    system: Robot,
    n_trajectories: int | None = None,
    n_steps: int | None = None,
    *,
    dt: float = 0.03,
    noise: float = 0.0,
    input_noise: float = 0.0,
    random_state: RandomState = None,
    return_X_y: bool = False,
) -> Bunch | tuple[np.ndarray, np.ndarray]:
    """Simulate a system from random states under random inputs (section IV-B of the paper).

    Each trajectory starts at ``alpha * U(-1, 1)`` and is driven by inputs ``eta * N(0, 1)``, held over each step,
    with the paper's scales (its Table 2). Angles are not wrapped.

    Parameters
    ----------
    system : str
        ``"pendulum"``, ``"cartpole"`` or ``"acrobot"``.
    n_trajectories : int, default=None
        At least 1; None takes the paper's (48, 48 and 93).
    n_steps : int, default=None
        Steps per trajectory, at least 1; None takes the paper's 100.
    dt : float, default=0.03
        Length of a step, s.
    noise : float, default=0.0
        Standard deviation of the Gaussian noise on each target, as a fraction of that target's standard deviation.
    input_noise : float, default=0.0
        The same for the states in ``data``, as a fraction of each state's standard deviation. Inputs stay exact.
    random_state : int, RandomState instance or None, default=None
        Draws the initial states, the inputs and the noise, in this order.
    return_X_y : bool, default=False
        Whether to return ``(data, target)`` in place of a Bunch.

    Returns
    -------
    dynamics : :class:`~sklearn.utils.Bunch`
        With

        - ``data`` : ndarray of shape (n_rows, 2 * n_joints + n_inputs): positions (rad or m), velocities (rad/s or
          m/s), inputs (N m or N), where n_rows = n_trajectories * n_steps, one trajectory after the other;
        - ``target`` : ndarray of shape (n_rows, 2 * n_joints): positions and velocities after ``dt``;
        - ``groups`` : ndarray of shape (n_rows,): the trajectory of each row, for `GroupKFold`;
        - ``trajectories`` : ndarray of shape (n_trajectories, n_steps + 1, 2 * n_joints): the true states;
        - ``dt`` : float, and ``robot``, as given: what a feature map must be told (``InertiaForce(robot, dt=dt)``);
        - ``feature_names``, ``target_names``, ``DESCR``.
    (data, target) : tuple of ndarray
        If ``return_X_y``.

    Raises
    ------
    ImportError
        If Pinocchio is not installed; the message gives the pip command.
    ValueError, TypeError
        If an argument is out of its range or of the wrong type, or the system is unknown.

    Examples
    --------
    >>> from skevgp.datasets import make_dynamics
    >>> pendulum = make_dynamics("pendulum", n_trajectories=2, n_steps=5, random_state=0)
    >>> pendulum.data.shape, pendulum.target.shape
    ((10, 3), (10, 2))
    >>> pendulum.feature_names, pendulum.groups.tolist()
    (['q', 'dq/dt', 'u_q'], [0, 0, 0, 0, 0, 1, 1, 1, 1, 1])
    """
    robot, system = system, layout_of(system)
    if system.name not in _PAPER or len(_PAPER[system.name].state_scale) != 2 * system.n_joints:
        raise ValueError(f"No sampling scales are known for {system.name!r}; the known systems are {sorted(_PAPER)}.")
    sampling = _PAPER[system.name]
    n_trajectories = sampling.n_trajectories if n_trajectories is None else n_trajectories
    n_steps = sampling.n_steps if n_steps is None else n_steps
    check_integer(n_trajectories, "n_trajectories", minimum=1)
    check_integer(n_steps, "n_steps", minimum=1)
    check_real(dt, "dt", minimum=0.0, strict=True)
    check_real(noise, "noise", minimum=0.0)
    check_real(input_noise, "input_noise", minimum=0.0)

    rng = check_random_state(random_state)
    n_states = 2 * system.n_joints
    z0 = np.array(sampling.state_scale) * rng.uniform(-1.0, 1.0, (n_trajectories, n_states))
    inputs = sampling.input_scale * rng.standard_normal((n_trajectories, n_steps, system.n_inputs))
    trajectories = simulate(robot, z0, inputs, dt)

    states = trajectories[:, :-1].reshape(-1, n_states)
    target = trajectories[:, 1:].reshape(-1, n_states)
    states = states + input_noise * states.std(axis=0) * rng.standard_normal(states.shape)
    target = target + noise * target.std(axis=0) * rng.standard_normal(target.shape)
    data = np.hstack([states, inputs.reshape(-1, system.n_inputs)])
    if return_X_y:
        return data, target
    return Bunch(
        data=data,
        target=target,
        groups=np.repeat(np.arange(n_trajectories), n_steps),
        trajectories=trajectories,
        feature_names=system.state_names + system.input_names,
        target_names=system.state_names,
        robot=robot,
        dt=dt,
        DESCR=(
            f"{n_trajectories} trajectories of {n_steps} steps of {dt} s of the system {system.name!r}; noise {noise} "
            f"on the targets and {input_noise} on the states, as fractions of their standard deviations."
        ),
    )
