"""Smooth references, and the computed-torque controller that follows them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..robots.loading import Robot
from ..utils.validation import as_floats, check_integer, check_real
from .plant import Plant


def quintic_reference(
    q0: ArrayLike, q1: ArrayLike, duration: float, times: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the minimum-jerk motion between two positions at rest.

    With s = t / duration, it is q0 + (q1 - q0) (10 s³ - 15 s⁴ + 6 s⁵), and q1 afterwards.

    Parameters
    ----------
    q0, q1 : array-like of shape (n_joints,) or (n_trajectories, n_joints)
        First and last positions, rad or m.
    duration : float
        Duration of the motion, s; above 0.
    times : float or array-like of shape (n_times,)
        Times after the start, s.

    Returns
    -------
    positions, velocities, accelerations : ndarray of shape (n_joints,) or (n_trajectories, n_joints)
        The motion in rad or m, and its derivatives per s and s². For several times, the shape is (..., n_times,
        n_joints).

    Raises
    ------
    ValueError, TypeError
        If a value is not a finite real number, shapes do not fit each other, or ``duration`` is not positive.

    Examples
    --------
    >>> from skevgp.datasets import quintic_reference
    >>> q, dq, ddq = quintic_reference([0.0], [1.0], duration=2.0, times=[0.0, 1.0, 2.0, 3.0])
    >>> q.ravel(), dq.ravel()
    (array([0. , 0.5, 1. , 1. ]), array([0.    , 0.9375, 0.    , 0.    ]))
    """
    start, end, t = (_finite(values, name) for values, name in ((q0, "q0"), (q1, "q1"), (times, "times")))
    check_real(duration, "duration", minimum=0.0, strict=True)
    if start.ndim not in (1, 2) or start.shape != end.shape:
        raise ValueError(
            "q0 and q1 must have the same shape, (n_joints,) or (n_trajectories, n_joints); "
            f"got {start.shape} and {end.shape}."
        )
    if t.ndim > 1:
        raise ValueError(f"times must be a number or one-dimensional; got the shape {t.shape}.")
    s = np.clip(t / duration, 0.0, 1.0)[..., np.newaxis]
    if t.ndim:
        start, end = start[..., np.newaxis, :], end[..., np.newaxis, :]
    way = end - start
    return (
        start + way * (s**3 * (10.0 - 15.0 * s + 6.0 * s**2)),
        way * (30.0 * (s * (1.0 - s)) ** 2 / duration),
        way * (60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / duration**2),
    )


class ComputedTorqueController:
    """Move a robot along a smooth reference by feedback linearisation, for many trajectories at once.

    Each call computes the torques by the recursive Newton-Euler algorithm:

        τ = M(q) (q̈_d + k_p (q_d - q) + k_d (q̇_d - q̇) + k_i ∫(q_d - q) dt) + C(q, q̇) q̇ + g(q) + D q̇_d

    The reference (q_d, q̇_d, q̈_d) is that of `quintic_reference` at the start of the step. D is the viscous damping of
    the model. Use the object as a controller of `simulate`, which holds torques over a step and applies effort limits.

    Parameters
    ----------
    robot : str, path-like, System or pinocchio.Model
        Robot as in `load_robot`. All its joints must be driven.
    q0, q1 : array-like of shape (n_joints,) or (n_trajectories, n_joints)
        Start and end of the reference, rad or m.
    duration : float
        Duration of the reference motion, s. Afterwards the reference stays at ``q1``.
    dt : float, default=0.03
        Length of a step, s.
    kp, kd, ki : float or array-like of shape (n_joints,), default=100.0, 20.0 and 1.0
        Gains of position, velocity and integral, in 1/s², 1/s and 1/s³, at least 0. ``kd`` must be below 2 / dt,
        because larger gains are unstable.

    Attributes
    ----------
    dt : float
        Length of a step, s.
    integral : ndarray of shape (n_trajectories, n_joints)
        Integral of q_d - q up to the last call, rad s or m s.

    Raises
    ------
    ImportError
        If Pinocchio is not installed.
    ValueError, TypeError
        If a joint has no motor, a value is out of its range, or a shape does not fit the robot.

    See Also
    --------
    simulate : Simulate the robot with the controller.

    Examples
    --------
    >>> import numpy as np
    >>> from skevgp.datasets import ComputedTorqueController, simulate
    >>> q0, q1 = np.zeros(7), np.full(7, 0.5)
    >>> controller = ComputedTorqueController("iiwa14", q0, q1, duration=1.0)
    >>> Z = simulate("iiwa14", np.r_[q0, np.zeros(7)], controller, n_steps=60)
    >>> Z[-1, :7].round(2)
    array([0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5])
    """

    def __init__(
        self,
        robot: Robot,
        q0: ArrayLike,
        q1: ArrayLike,
        *,
        duration: float,
        dt: float = 0.03,
        kp: ArrayLike = 100.0,
        kd: ArrayLike = 20.0,
        ki: ArrayLike = 1.0,
    ):
        self._plant = robot if isinstance(robot, Plant) else Plant(robot)
        layout = self._plant.layout
        n = layout.n_joints
        if layout.n_inputs != n:
            free = [name for joint, name in enumerate(layout.position_names) if joint not in layout.driven]
            raise ValueError(f"All joints must be driven; those of {layout.name!r} without a motor are {free}.")
        self.dt = check_real(dt, "dt", minimum=0.0, strict=True)
        self._duration = check_real(duration, "duration", minimum=0.0, strict=True)
        quintic_reference(q0, q1, duration, 0.0)
        self._q0, self._q1 = np.atleast_2d(as_floats(q0, "q0")), np.atleast_2d(as_floats(q1, "q1"))
        if self._q0.shape[1] != n:
            raise ValueError(f"q0 and q1 must have {n} columns for {layout.name!r}; got {self._q0.shape[1]}.")
        self._kp, self._kd, self._ki = (_gain(k, name, n) for k, name in ((kp, "kp"), (kd, "kd"), (ki, "ki")))
        if (self._kd * dt >= 2.0).any():
            raise ValueError(f"kd must be below 2 / dt = {2.0 / dt:g}, because larger gains are unstable; got {kd!r}.")
        self.integral = np.zeros_like(self._q0)
        self._next = 0

    def __call__(self, step: int, Z: ArrayLike) -> np.ndarray:
        """Return the torques of a step, (n_trajectories, n_joints); steps must follow each other from 0."""
        if check_integer(step, "step", minimum=0) not in (0, self._next):
            raise ValueError(f"Steps must follow one another from 0; got {step}, expected 0 or {self._next}.")
        states = np.array(_finite(Z, "Z"))
        if states.ndim != 2 or states.shape[1] != 2 * self._q0.shape[1] or len(self._q0) not in (1, len(states)):
            raise ValueError(f"The states must fit q0, of shape {self._q0.shape}; got the shape {states.shape}.")
        if step and len(states) != len(self.integral):
            raise ValueError(f"There were {len(self.integral)} trajectories in step 0; got {len(states)}.")
        q, v = np.hsplit(states, 2)
        self.integral = self.integral + self._change(q, v) if step else np.zeros_like(q)
        q_d, v_d, a_d = quintic_reference(self._q0, self._q1, self._duration, step * self.dt)
        a = a_d + self._kp * (q_d - q) + self._kd * (v_d - v) + self._ki * self.integral
        # Damping at the desired velocity. At the measured one, held over a step, it would stop a strongly damped joint.
        torque = self._plant.body.forces(q, v, a) + np.array(self._plant.model.damping) * v_d
        self._before, self._next = (q, v, q_d, torque), step + 1
        return torque

    def _change(self, q1: np.ndarray, v1: np.ndarray) -> np.ndarray:
        """Return the integral of q_d - q over the last step, from the states at both ends and in the middle."""
        # The error of the cubic through the ends is h³/180 times the second difference of the accelerations. Those of
        # the model suffice, and they hardly depend on the torque.
        h = self.dt
        q0, v0, q_d, torque = self._before
        middle = (q0 + q1) / 2.0 + h / 8.0 * (v0 - v1), 1.5 * (q1 - q0) / h - (v0 + v1) / 4.0
        ends = self._plant.accelerations(q0, v0, torque) + self._plant.accelerations(q1, v1, torque)
        bend = ends - 2.0 * self._plant.accelerations(*middle, torque)
        return h * q_d - (h / 2.0 * (q0 + q1) + h**2 / 12.0 * (v0 - v1) + h**3 / 180.0 * bend)


def _finite(values: ArrayLike, name: str) -> np.ndarray:
    array = as_floats(values, name)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite.")
    return array


def _gain(values: ArrayLike, name: str, n_joints: int) -> np.ndarray:
    gain = _finite(values, name)
    if gain.shape not in ((), (n_joints,)) or (gain < 0.0).any():
        raise ValueError(f"{name} must be a number or {n_joints} numbers, not negative; got {values!r}.")
    return gain
