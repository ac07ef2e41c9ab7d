"""Model predictive control on a learned model: iLQR with a limit on the input, and a new plan at each step.

`plot_swing_up.py` and `benchmarks/control.py` have it. `follow_plans.py` plans before the run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.utils import Bunch

from skevgp import EVGPRegressor, ResidualRegressor
from skevgp.datasets import make_dynamics, simulate
from skevgp.features import AngleEncoder, InertiaForceGravity

DT = 0.03
# Number of steps of a training trajectory.
LENGTH = 10
# Largest angle that counts as upright, rad, and the number of steps that it must last.
NEAR, LAST = 0.1, 34
# Step lengths of the line search, evaluated together.
STEPS = 0.5 ** np.arange(8)[:, np.newaxis]


@dataclass(frozen=True)
class Task:
    """The task to swing a pole up and to balance it.

    The cost is the square of weights * (encoded row - goal). The encoded row has sines and cosines instead of angles,
    and the input as its last column.

    Attributes
    ----------
    system : str
    limit : float
        Limit of the force or torque, N or N m.
    goal, weights, last_weights : tuple of float
        Values for each column of the encoded row. ``last_weights`` is for the end of the horizon.
    pole : int
        Column of the pole's angle. The pole hangs at 0.
    horizon, n_steps : int
        Number of steps of a plan, and of the whole run.
    caution : float, default=0.0
        The square of caution * std is added to the cost. Without it, plans exploit errors of the model.
    """

    system: str
    limit: float
    goal: tuple[float, ...]
    weights: tuple[float, ...]
    last_weights: tuple[float, ...]
    pole: int
    horizon: int
    n_steps: int
    caution: float = 0.0


TASKS = {
    # The torque can hold the pendulum at 24 degrees at most, so it has to swing.
    "pendulum": Task(
        "pendulum",
        limit=2.0,
        goal=(0.0, -1.0, 0.0, 0.0),
        weights=(1.0, 1.0, 0.1, 0.1),
        last_weights=(10.0, 10.0, 3.0),
        pole=0,
        horizon=60,
        n_steps=167,
    ),
    "cartpole": Task(
        "cartpole",
        limit=100.0,
        goal=(0.0, 0.0, -1.0, 0.0, 0.0, 0.0),
        weights=(0.5, 1.0, 1.0, 0.1, 0.1, 0.003),
        last_weights=(3.0, 10.0, 10.0, 3.0, 3.0),
        pole=1,
        horizon=50,
        n_steps=167,
        caution=10.0,
    ),
}


class Planner:
    """iLQR: derivatives of the model along a plan give a linear-quadratic problem. Its solution is the next plan.

    Parameters
    ----------
    model : CompiledPredictor
        Or an object with the same `predict` and `value_and_jacobian`. Rows are [state, input], with one input.
    task : Task

    Attributes
    ----------
    U : ndarray of shape (horizon, 1)
        The plan.
    Z : ndarray of shape (horizon + 1, n_states)
        Predicted states of the plan.
    gain : ndarray of shape (horizon, n_states)
        Feedback gains on deviations from the planned states.
    cost : float
    """

    def __init__(self, model: Any, task: Task):
        self.model, self.task = model, task
        self._encoder = AngleEncoder(task.system).fit(np.zeros((1, len(task.goal) - 1)))
        self._goal, self._weights = np.array(task.goal), np.tile(task.weights, (task.horizon + 1, 1))
        self._weights[-1] = *task.last_weights, 0.0

    def start(self, z: np.ndarray, rng: np.random.RandomState, n_starts: int = 5, n_iter: int = 30) -> None:
        """Plan from several smooth random inputs, and keep the best plan."""
        horizon, times = self.task.horizon, np.arange(self.task.horizon)[:, np.newaxis]
        best: tuple[Any, ...] = (np.inf,)
        for _ in range(n_starts):
            period, phase = rng.uniform(20.0, 60.0), rng.uniform(0.0, 2.0 * np.pi)
            self.U = rng.uniform(0.2, 1.0) * self.task.limit * np.sin(2.0 * np.pi * times / period + phase)
            self.Z, self.gain = np.tile(z, (horizon + 1, 1)), np.zeros((horizon, len(z)))
            self.improve(z, n_iter)
            best = min(best, (self.cost, self.U, self.Z, self.gain), key=lambda found: found[0])
        self.cost, self.U, self.Z, self.gain = best

    def move_on(self, z: np.ndarray, n_iter: int = 3) -> None:
        """Plan from the next state. Shift the plan by a step and improve it."""
        self.U, self.Z, self.gain = (np.concatenate([part[1:], part[-1:]]) for part in (self.U, self.Z, self.gain))
        self.improve(z, n_iter)

    def improve(self, z: np.ndarray, n_iter: int) -> None:
        """Iterate, from the states to which the plan and its gains lead from z."""
        U, Z = self._forward(z, np.zeros(len(self.U)), self.gain, np.zeros((1, 1)))
        self.U, self.Z, self.cost = U[0], Z[0], float(self._costs(Z, U)[0])
        damping = 1e-3
        for _ in range(n_iter):
            before = self.cost
            if self._iterate(damping):
                damping = max(damping / 5.0, 1e-6)
                if before - self.cost < 1e-4 * before:
                    break
            else:
                damping *= 10.0

    def _iterate(self, damping: float) -> bool:
        """Return whether the plan became better."""
        change, gain = self._backward(damping)
        U, Z = self._forward(self.Z[0], change, gain, STEPS)
        costs = self._costs(Z, U)
        costs[~np.isfinite(costs)] = np.inf
        best = np.argmin(costs)
        if costs[best] >= self.cost:
            return False
        self.U, self.Z, self.gain, self.cost = U[best], Z[best], gain, float(costs[best])
        return True

    def _residuals(self, Z: np.ndarray, U: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows [state, input] along plans, and their costs before squaring. The last state is included."""
        rows = np.concatenate([Z, np.concatenate([U, np.zeros_like(U[..., :1, :])], axis=-2)], axis=-1)
        encoded = self._encoder.transform(rows.reshape(-1, rows.shape[-1]))
        return rows, self._weights * (encoded.reshape(*rows.shape[:-1], -1) - self._goal)

    def _costs(self, Z: np.ndarray, U: np.ndarray) -> np.ndarray:
        rows, residuals = self._residuals(Z, U)
        costs = (residuals**2).sum(axis=(1, 2))
        if self.task.caution:
            _, std = self.model.predict(rows[:, :-1].reshape(-1, rows.shape[-1]), return_std=True)
            costs += ((self.task.caution * std) ** 2).reshape(len(Z), -1).sum(axis=1)
        return costs

    def _backward(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Return changes of the inputs, and feedback gains on deviations from the planned states."""
        rows, residuals = self._residuals(self.Z, self.U)
        _, slopes, *spread = self.model.value_and_jacobian(rows[:-1], return_std=self.task.caution > 0.0)
        by_rows = self._weights[:, :, np.newaxis] * self._encoder.jacobian(rows)
        gradients = np.einsum("trx,tr->tx", by_rows, residuals)
        curvatures = by_rows.transpose(0, 2, 1) @ by_rows  # Gauss-Newton: never negative
        if self.task.caution:
            std, by_std = spread
            gradients[:-1] += self.task.caution**2 * np.einsum("tox,to->tx", by_std, std)
            curvatures[:-1] += self.task.caution**2 * (by_std.transpose(0, 2, 1) @ by_std)
        n, limit = self.Z.shape[1], self.task.limit
        v, V = gradients[-1, :n], curvatures[-1, :n, :n]
        change, gain = np.zeros(len(self.U)), np.zeros((len(self.U), n))
        for t in reversed(range(len(self.U))):
            q = gradients[t] + slopes[t].T @ v
            Q = curvatures[t] + slopes[t].T @ V @ slopes[t]
            own = Q[n, n] * (1.0 + damping) + 1e-12
            wanted = -q[n] / own
            change[t] = np.clip(wanted, -limit - self.U[t, 0], limit - self.U[t, 0])
            if change[t] == wanted:  # at its limit an input does not answer
                gain[t] = -Q[n, :n] / own
            v = q[:n] + gain[t] * (Q[n, n] * change[t] + q[n]) + Q[n, :n] * change[t]
            cross = np.outer(gain[t], Q[n, :n])
            V = Q[:n, :n] + Q[n, n] * np.outer(gain[t], gain[t]) + cross + cross.T
        return change, gain

    def _forward(
        self, z: np.ndarray, change: np.ndarray, gain: np.ndarray, steps: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return new plans from z, one for each step length."""
        Z = np.empty((len(steps), *self.Z.shape))
        U = np.empty((len(steps), *self.U.shape))
        Z[:, 0] = z
        for t in range(len(change)):
            answer = steps[:, 0] * change[t] + (Z[:, t] - self.Z[t]) @ gain[t]
            U[:, t, 0] = np.clip(self.U[t] + answer, -self.task.limit, self.task.limit)
            Z[:, t + 1] = self.model.predict(np.concatenate([Z[:, t], U[:, t]], axis=1))
        return U, Z


def learn(
    system: str,
    seconds: float,
    physics: bool,
    noise: float = 0.0,
    seed: int = 0,
    length: int = LENGTH,
    **settings: Any,
) -> Bunch:
    """Learn a system from trajectories with random first states.

    Parameters
    ----------
    system : str
    seconds : float
        Duration of the data, in trajectories of ``length`` steps.
    physics : bool
        Whether to use features of rough physics (EVGP-IFG). If False, a Gaussian process learns the change of state.
    noise : float, default=0.0
        Noise on all states, relative to their scatter.
    seed : int, default=0
    length : int, default=LENGTH
    **settings
        Arguments of `EVGPRegressor`.

    Returns
    -------
    learned : Bunch
        ``model``, ``data`` (of `make_dynamics`) and ``noise``, the standard deviation of each state's.
    """
    n_trajectories = max(round(seconds / (length * DT)), 1)
    data = make_dynamics(system, n_trajectories, length, dt=DT, noise=noise, input_noise=noise, random_state=seed)
    settings = {"kernel_map": AngleEncoder(system), "n_inducing": 100, "random_state": seed} | settings
    if physics:
        model = EVGPRegressor(**{"feature_map": InertiaForceGravity(system, dt=DT)} | settings)
    else:
        model = ResidualRegressor(EVGPRegressor(**settings))
    model.fit(data.data, data.target, groups=data.groups)
    return Bunch(model=model, data=data, noise=noise * data.target.std(axis=0))


def swing_up(model: Any, task: Task, noise: np.ndarray | float = 0.0, seed: int = 0) -> Bunch:
    """Swing the true system up from rest, by plans on a model.

    Parameters
    ----------
    model : CompiledPredictor
        See `Planner`.
    task : Task
    noise : ndarray of shape (n_states,) or float, default=0.0
        Standard deviation of the noise on the states that the planner sees.
    seed : int, default=0
        Seed of the first plans and of the noise.

    Returns
    -------
    run : Bunch
        ``states`` (n_steps + 1, n_states), ``inputs`` (n_steps, 1), ``plans``, a list of each step's (horizon + 1,
        n_states), ``distance`` (n_steps + 1,) of the pole from upright in rad, and ``success``.
    """
    rng, planner, plans = np.random.RandomState(seed), Planner(model, task), []

    def controller(step: int, Z: np.ndarray) -> np.ndarray:
        z = Z[0] + noise * rng.standard_normal(Z.shape[1])
        if step == 0:
            planner.start(z, rng)
        else:
            planner.move_on(z)
        plans.append(planner.Z)
        return planner.U[:1]

    rest = np.zeros(len(task.last_weights) - 1)
    states, inputs = simulate(task.system, rest, controller, DT, n_steps=task.n_steps, return_inputs=True)
    distance = np.abs(states[:, task.pole] % (2.0 * np.pi) - np.pi)
    success = bool((distance[-LAST:] < NEAR).all())
    return Bunch(states=states, inputs=inputs, plans=plans, distance=distance, success=success)
