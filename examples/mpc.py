"""Control on a learned model: iLQR with a limit on the input, and a new plan at each step or feedback along plans.

`plot_swing_up.py` and `benchmarks/control.py` plan at each step (`Planner`). `plot_acrobot.py` and
`benchmarks/realaigym.py` plan before the run, and follow the plans (`plan_many`, `Library`, `Follower`).
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
# States of a plan stay below this. Number of steps until a Riccati equation is at rest. Largest delay, in steps.
_FAR, _LONG, _LATEST = 100.0, 2000, 21


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


# --- plans from many states, and a controller that follows them -------------------------------------------------------


@dataclass(frozen=True)
class Reach:
    """The task to reach a state at rest and to stay there, with one input.

    Plans minimise the sum of squares of weights * (encoded row - encoded goal). The encoded row has sines and cosines
    instead of angles, and the input as its last column. Feedback minimises the quadratic cost of deviations.

    Attributes
    ----------
    goal : tuple of float
        The state to reach.
    angles : tuple of int
        Columns of the state that are angles.
    limit : float
        Limit of the input.
    dt : float
        Time step of the model, s.
    weights, last_weights : tuple of float
        Values for each column of the encoded row, along the plan and at its end (without the input).
    state_cost, input_cost : tuple of float, float
        Cost per second of squared deviations from the plan.
    top_state_cost, top_input_cost : tuple of float, float
        The same at the goal.
    """

    goal: tuple[float, ...]
    angles: tuple[int, ...]
    limit: float
    dt: float
    weights: tuple[float, ...]
    last_weights: tuple[float, ...]
    state_cost: tuple[float, ...]
    input_cost: float
    top_state_cost: tuple[float, ...]
    top_input_cost: float

    def difference(self, z: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return z - other, with angles from -pi to pi."""
        found = z - other
        turns = found[..., self.angles]
        found[..., self.angles] = turns - 2.0 * np.pi * np.round(turns / (2.0 * np.pi))
        return found


def plan_many(model: Any, task: Reach, starts: np.ndarray, U: np.ndarray, n_iter: int = 60) -> Bunch:
    """Plan from many states at once by iLQR. Each plan has its own damping and step length.

    Parameters
    ----------
    model : CompiledPredictor
        Or an object with the same `predict` and `value_and_jacobian`. Rows are [state, input].
    task : Reach
    starts : ndarray of shape (n_plans, n_states)
    U : ndarray of shape (n_plans, horizon)
        First inputs.
    n_iter : int, default=60

    Returns
    -------
    plans : Bunch
        ``Z`` (n_plans, horizon + 1, n_states), ``U`` (n_plans, horizon) and ``cost`` (n_plans,), best plans first.
    """
    n, horizon = U.shape
    d = starts.shape[1]
    encoder = AngleEncoder(angles=task.angles).fit(np.zeros((1, d)))
    goal = encoder.transform(np.array([task.goal]))[0]
    weights = np.tile(task.weights[:-1], (horizon + 1, 1))
    weights[-1], by_input = task.last_weights, task.weights[-1] ** 2
    steps, every = 0.5 ** np.arange(5), np.arange(n)

    def residuals(Z: np.ndarray) -> np.ndarray:
        return weights * (encoder.transform(Z.reshape(-1, d)).reshape(*Z.shape[:-1], -1) - goal)

    def forward(change: np.ndarray, gain: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return new plans (n, n_steps, ...) and their costs."""
        tried = np.empty((n, len(steps), horizon))
        states = np.empty((n, len(steps), horizon + 1, d))
        states[:, :, 0] = starts[:, np.newaxis]
        for t in range(horizon):
            answer = ((states[:, :, t] - Z[:, np.newaxis, t]) * gain[:, np.newaxis, t]).sum(axis=2)
            tried[:, :, t] = U[:, np.newaxis, t] + steps * change[:, np.newaxis, t] + answer
            np.clip(tried[:, :, t], -task.limit, task.limit, out=tried[:, :, t])
            rows = np.concatenate([states[:, :, t], tried[:, :, t, np.newaxis]], axis=2).reshape(-1, d + 1)
            # A diverging plan stays finite, and is not taken.
            states[:, :, t + 1] = np.clip(model.predict(rows), -_FAR, _FAR).reshape(n, -1, d)
        costs = (residuals(states) ** 2).sum(axis=(2, 3)) + by_input * (tried**2).sum(axis=2)
        return states, tried, costs

    Z, change, gain = np.zeros((n, horizon + 1, d)), np.zeros((n, horizon)), np.zeros((n, horizon, d))
    Z, U, cost = (part[:, 0] for part in forward(change, gain, np.zeros(1)))
    damping = np.ones(n)
    for _ in range(n_iter):
        slopes = model.value_and_jacobian(np.concatenate([Z[:, :-1], U[:, :, np.newaxis]], axis=2).reshape(-1, d + 1))
        F = slopes[1].reshape(n, horizon, d, d + 1)
        by_rows = weights[:, :, np.newaxis] * encoder.jacobian(Z.reshape(-1, d)).reshape(n, horizon + 1, -1, d)
        gradients = np.einsum("ntrx,ntr->ntx", by_rows, residuals(Z))
        curvatures = by_rows.swapaxes(2, 3) @ by_rows  # Gauss-Newton: never negative
        v, V = gradients[:, -1], curvatures[:, -1]
        for t in reversed(range(horizon)):
            across = F[:, t].swapaxes(1, 2)
            q, Q = (across @ v[:, :, np.newaxis])[:, :, 0], across @ V @ F[:, t]
            q[:, :d] += gradients[:, t]
            Q[:, :d, :d] += curvatures[:, t]
            q[:, d] += by_input * U[:, t]
            Q[:, d, d] += by_input
            own = Q[:, d, d] * (1.0 + damping) + 1e-12
            wanted = -q[:, d] / own
            change[:, t] = np.clip(wanted, -task.limit - U[:, t], task.limit - U[:, t])
            free = change[:, t] == wanted  # at its limit an input does not answer
            gain[:, t] = np.where(free[:, np.newaxis], -Q[:, d, :d] / own[:, np.newaxis], 0.0)
            K, k = gain[:, t], change[:, t, np.newaxis]
            v = q[:, :d] + K * (Q[:, d, d, np.newaxis] * k + q[:, d, np.newaxis]) + Q[:, d, :d] * k
            cross = K[:, :, np.newaxis] * Q[:, d, np.newaxis, :d]
            square = K[:, :, np.newaxis] * K[:, np.newaxis]
            V = Q[:, :d, :d] + Q[:, d, d, np.newaxis, np.newaxis] * square + cross + cross.swapaxes(1, 2)
        states, tried, costs = forward(change, gain, steps)
        best = costs.argmin(axis=1)
        better = costs[every, best] < cost
        gained = np.where(better, cost - costs[every, best], 0.0) / cost
        Z[better], U[better] = states[every, best][better], tried[every, best][better]
        cost = np.where(better, costs[every, best], cost)
        damping = np.where(better, np.maximum(damping / 4.0, 1e-6), np.minimum(damping * 5.0, 1e12))
        if np.all((better & (gained < 1e-3)) | (damping > 1e8)):
            break
    order = np.argsort(cost)
    return Bunch(Z=Z[order], U=U[order], cost=cost[order])


def waves(n: int, horizon: int, dt: float, size: float, rng: np.random.RandomState) -> np.ndarray:
    """Return smooth random inputs (n, horizon) as first plans."""
    t = dt * np.arange(horizon)
    periods, phases = rng.uniform(0.4, 1.5, (n, 1)), rng.uniform(0.0, 2.0 * np.pi, (n, 1))
    return size * rng.uniform(0.2, 1.0, (n, 1)) * np.sin(2.0 * np.pi * t / periods + phases)


def riccati(
    F: np.ndarray, task: Reach, P: np.ndarray, at_goal: bool = False, spread: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return gains (T, n_states) and costs to go (T + 1, n_states, n_states) along Jacobians F.

    F has the shape (T, n_states, n_states + 1). The input changes by gain @ (state - planned state). ``spread``
    (n_samples, n_states, n_states + 1) has deviations of sampled Jacobians from their mean. The gain then minimises the
    expected cost if each step has another sample. It acts more strongly against a fall that the mean may hide.
    """
    states, inputs = (task.top_state_cost, task.top_input_cost) if at_goal else (task.state_cost, task.input_cost)
    d = len(P)
    now = task.dt * np.diag([*states, inputs])
    gains, costs = np.empty((len(F), d)), np.empty((len(F) + 1, d, d))
    costs[-1] = P
    if spread is not None:  # E[D' P D] is linear in P
        doubt = np.einsum("sia,sjb->abij", spread, spread).reshape((d + 1) ** 2, d * d) / len(spread)
    for t in reversed(range(len(F))):
        H = now + F[t].T @ costs[t + 1] @ F[t]
        if spread is not None:
            H += (doubt @ costs[t + 1].ravel()).reshape(d + 1, d + 1)
        gains[t] = -H[d, :d] / H[d, d]
        P = H[:d, :d] + np.outer(H[:d, d], gains[t])
        costs[t] = 0.5 * (P + P.T)
    return gains, costs


def sampled_slopes(regressor: Any, row: np.ndarray, n_samples: int = 100, step: float = 1e-3) -> np.ndarray:
    """Return Jacobians (n_samples, n_outputs, n_columns) of sampled functions at a row, without their mean."""
    moves = step * np.eye(len(row))
    values = regressor.sample_functions(n_samples, random_state=0)(np.concatenate([row + moves, row - moves]))
    slopes = (values[:, : len(row)] - values[:, len(row) :]) / (2.0 * step)
    return np.swapaxes(slopes - slopes.mean(axis=0), 1, 2)


def _at_rest(F: np.ndarray, task: Reach, spread: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the gain and the cost to go at the goal. No gain is safe for a very wide spread, which is then halved."""
    while True:
        gains, costs = riccati(np.repeat(F, _LONG, axis=0), task, np.diag(task.top_state_cost), True, spread)
        if spread is None or costs[0].max() < 1.01 * costs[_LONG // 10].max():
            return gains[0], costs[0]
        spread = 0.5 * spread


class Library:
    """Plans to the goal with feedback: nodes that know their state, input, gain, cost to go and local dynamics.

    Parameters
    ----------
    model : CompiledPredictor
    task : Reach
    Z : ndarray of shape (n_plans, horizon + 1, n_states)
        The first plan is that from rest.
    U : ndarray of shape (n_plans, horizon)
    spread : ndarray of shape (n_samples, n_states, n_states + 1), default=None
        Deviations of sampled Jacobians at the goal, as returned by `sampled_slopes`. If None, the model is certain.
    """

    def __init__(self, model: Any, task: Reach, Z: np.ndarray, U: np.ndarray, spread: np.ndarray | None = None):
        self.task, d = task, Z.shape[2]
        self.goal = np.array(task.goal)
        F = model.value_and_jacobian(np.append(self.goal, 0.0)[np.newaxis])[1]
        self.top_gain, self.top_cost = _at_rest(F, task, spread)
        # Within this cost to go, the feedback at the goal is within the limit of the input.
        self.near = task.limit**2 / (self.top_gain @ np.linalg.solve(self.top_cost, self.top_gain))
        self.top_slopes = self._of_velocities(F)[0]
        n, horizon = U.shape
        F = model.value_and_jacobian(np.concatenate([Z[:, :-1], U[:, :, np.newaxis]], axis=2).reshape(-1, d + 1))[1]
        gains, costs = zip(*(riccati(own, task, self.top_cost) for own in F.reshape(n, horizon, d, -1)), strict=True)
        self.Z, self.U = Z[:, :-1].reshape(-1, d), U.reshape(-1)
        self.gain, self.cost = np.concatenate(gains), np.concatenate([own[:-1] for own in costs])
        self.ahead = Z[:, 1:].reshape(-1, d)
        self.accelerations = (self.ahead - self.Z)[:, d // 2 :] / task.dt
        self.slopes = self._of_velocities(F)
        self.horizon = horizon

    def _of_velocities(self, F: np.ndarray) -> np.ndarray:
        """Return derivatives of accelerations (n, n_joints, n_states + 1) by the Jacobians of the next state."""
        n_joints = F.shape[1] // 2
        slopes = F[:, n_joints:].copy()
        slopes[:, :, n_joints:-1] -= np.eye(n_joints)
        return slopes / self.task.dt

    def nearest(self, z: np.ndarray, stride: int = 3) -> tuple[np.ndarray, np.ndarray]:
        """Return the node of the least cost to go for each state (n, n_states), and this cost."""
        nodes, costs, some = np.empty(len(z), dtype=int), np.empty(len(z)), slice(None, None, stride)
        Z, cost = self.Z[some], self.cost[some]
        for first in range(0, len(z), 32):
            away = self.task.difference(z[first : first + 32, np.newaxis], Z)
            found = np.einsum("nmi,nmi->nm", (away[:, :, np.newaxis] @ cost)[:, :, 0], away)
            best = found.argmin(axis=1)
            nodes[first : first + 32], costs[first : first + 32] = stride * best, found[np.arange(len(best)), best]
        return nodes, costs


class Follower:
    """Time-varying LQR along the plans of a library, and LQR at the goal, for many plants at once.

    A plant that is far from its plan takes the node of the library with the least cost to go. States are filtered: a
    Kalman filter predicts by the local dynamics of the node. At the start, the arm answers to the first input. If it
    answers later than planned, measurements are late by this time, and states are predicted over it.

    Parameters
    ----------
    library : Library
    n : int
        Number of plants.
    step : float
        Time between calls, s.
    nodes : ndarray of int of shape (n,), default=None
        Node of each plant at the start. If None, the first one of the first plan.
    noise : tuple of float, default=(5e-4, 0.5)
        Standard deviations of measured positions and velocities.
    unknown : float, default=60.0
        Standard deviation of the error of predicted accelerations.
    lost : tuple of float, default=(10.0, 16.0)
        A plant is lost if its cost to go exceeds so many times ``library.near``, on a plan and at the goal.
    """

    def __init__(
        self,
        library: Library,
        n: int,
        step: float,
        *,
        nodes: np.ndarray | None = None,
        noise: tuple[float, float] = (5e-4, 0.5),
        unknown: float = 60.0,
        lost: tuple[float, float] = (10.0, 16.0),
    ):
        self.library, self.n, self.step = library, n, step
        self.node = np.zeros(n, dtype=int) if nodes is None else nodes.copy()
        self.at_goal, self.since = np.zeros(n, dtype=bool), np.zeros(n, dtype=int)
        self.lost = lost[0] * library.near, lost[1] * library.near
        self._per_node, self._count = round(library.task.dt / step), 0
        self._inputs = np.zeros((_LATEST + 3, n))  # the last ones, newest first
        self._gain = kalman_gain(noise, unknown, step)
        self._moved = 12.0 * noise[0]
        self.delay, self._answered = np.zeros(n, dtype=int), np.full(n, nodes is not None)
        # The first states of the plan, those that it expects now, and the step at which these have moved (-1: not yet).
        self._rest = self._expected = library.Z[self.node]
        self._planned_answer = np.full(n, -1)

    # --- states ---

    def _advance(self, z: np.ndarray, u: np.ndarray, node: np.ndarray, at_goal: np.ndarray, h: Any) -> np.ndarray:
        """Return states after a short time h, by the local dynamics."""
        own, d = self.library, z.shape[1] // 2
        reference = np.where(at_goal[:, np.newaxis], own.goal, own.Z[node])
        slopes = np.where(at_goal[:, np.newaxis, np.newaxis], own.top_slopes, own.slopes[node])
        away = np.concatenate(
            [own.task.difference(z, reference), (u - np.where(at_goal, 0.0, own.U[node]))[:, np.newaxis]], axis=1
        )
        a = np.where(at_goal[:, np.newaxis], 0.0, own.accelerations[node])
        a = a + (slopes @ away[:, :, np.newaxis])[:, :, 0]
        return np.hstack([z[:, :d] + h * (z[:, d:] + 0.5 * h * a), z[:, d:] + h * a])

    def _estimate(self, measured: np.ndarray) -> np.ndarray:
        """Return present states. ``self._z`` has the filtered states at the time of the measurement."""
        if self._count == 0:
            self._z = measured.copy()
            return measured
        u = self._inputs[self.delay, np.arange(self.n)]
        z = self._advance(self._z, u, self.node, self.at_goal, self.step)
        d = z.shape[1] // 2
        error = self.library.task.difference(measured, z)
        G = self._gain
        z[:, :d] += G[0, 0] * error[:, :d] + G[0, 1] * error[:, d:]
        z[:, d:] += G[1, 0] * error[:, :d] + G[1, 1] * error[:, d:]
        self._z = z
        if not self._answered.all():
            self._find_delay(measured, d)
        late = np.flatnonzero(self.delay)
        if len(late):
            z = z.copy()
            z[late] = self._predicted(z[late], late)
        return z

    def _find_delay(self, measured: np.ndarray, d: int) -> None:
        """Compare the time of the first answer of the arm to that of the plan."""
        self._expected = self._advance(self._expected, self._inputs[0], self.node, self.at_goal, self.step)
        expected, moved = (
            np.abs(self.library.task.difference(z, self._rest))[:, :d].max(axis=1) > self._moved
            for z in (self._expected, measured)
        )
        self._planned_answer[expected & (self._planned_answer < 0)] = self._count
        moved &= ~self._answered & (self._planned_answer >= 0)
        self.delay[moved] = np.clip(self._count - self._planned_answer[moved], 0, _LATEST)
        self._answered |= moved
        self._answered |= self._count > 10 * _LATEST

    def _predicted(self, z: np.ndarray, late: np.ndarray) -> np.ndarray:
        """Return present states by those of the time of the measurement, two steps at once."""
        left = self.delay[late]
        while left.any():
            n_steps = np.minimum(left, 2)
            u = 0.5 * (self._inputs[np.maximum(left - 1, 0), late] + self._inputs[np.maximum(left - n_steps, 0), late])
            z = self._advance(z, u, self.node[late], self.at_goal[late], (self.step * n_steps)[:, np.newaxis])
            left = left - n_steps
        return z

    # --- inputs ---

    def _look_around(self, z: np.ndarray, cost_at_goal: np.ndarray) -> None:
        """Go on to the next nodes. Plants that are lost take other nodes."""
        own = self.library
        at_end = (self.node + 1) % own.horizon == 0
        self.at_goal |= at_end
        self.node = np.where(self.at_goal, self.node, self.node + 1)
        self.since += 1
        away = own.task.difference(z, own.Z[self.node])
        cost = np.einsum("ni,nij,nj->n", away, own.cost[self.node], away, optimize=True)
        cost = np.where(self.at_goal, cost_at_goal, cost)
        far = np.where(self.at_goal, cost > self.lost[1], cost > self.lost[0])
        far = np.flatnonzero(far & (self.since > 5))
        if not len(far):
            return
        self.since[far] = 0
        nodes, costs = own.nearest(z[far])
        better = costs < 0.5 * cost[far]
        far = far[better]
        self.node[far], self.at_goal[far] = nodes[better], False

    def __call__(self, count: int, measured: np.ndarray) -> np.ndarray:
        """Return inputs (n,) for measured states (n, n_states)."""
        own, self._count = self.library, count
        z = self._estimate(measured)
        away = own.task.difference(z, own.goal)
        cost = np.einsum("ni,ni->n", away @ own.top_cost, away)
        if count and count % self._per_node == 0:
            self._look_around(z, cost)
        self.at_goal |= cost < own.near
        share = (count % self._per_node) / self._per_node
        planned = own.Z[self.node] + share * (own.ahead - own.Z)[self.node]
        u = own.U[self.node] + (own.task.difference(z, planned) * own.gain[self.node]).sum(axis=1)
        u = np.where(self.at_goal, away @ own.top_gain, u)
        if not self._answered.all():  # feedback on a state that may be late would disturb the answer
            u = np.where(self._answered, u, own.U[self.node])
        u = np.clip(u, -own.task.limit, own.task.limit)
        self._inputs = np.roll(self._inputs, 1, axis=0)
        self._inputs[0] = u
        return u


def kalman_gain(noise: tuple[float, float], unknown: float, step: float) -> np.ndarray:
    """Return the steady gain (2, 2) of a Kalman filter of a position and its velocity."""
    F, G = np.array([[1.0, step], [0.0, 1.0]]), np.array([0.5 * step**2, step])
    R, P = np.diag(np.square(noise)), np.eye(2)
    for _ in range(_LONG):
        P = F @ P @ F.T + unknown**2 * np.outer(G, G)
        gain = P @ np.linalg.inv(P + R)
        P = P - gain @ P
    return gain
