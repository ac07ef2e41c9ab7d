"""Control by plans that are made before the run: iLQR from many first inputs, and feedback along the plans.

`plot_acrobot.py` and `benchmarks/realaigym.py` have it for two robots of a public benchmark. `mpc.py` plans again at
each step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.utils import Bunch

from skevgp.features import AngleEncoder

# States of a plan stay below this. Number of steps until a Riccati equation is at rest. Largest delay, in steps.
_FAR, _LONG, _LATEST = 100.0, 2000, 21


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


def plan_many(model: Any, task: Reach, start: np.ndarray, U: np.ndarray, n_iter: int = 60) -> Bunch:
    """Plan from a state by iLQR, with many first inputs at once. Each plan has its own damping and step length.

    Parameters
    ----------
    model : CompiledPredictor
        Or an object with the same `predict` and `value_and_jacobian`. Rows are [state, input].
    task : Reach
    start : ndarray of shape (n_states,)
    U : ndarray of shape (n_plans, horizon)
        First inputs.
    n_iter : int, default=60

    Returns
    -------
    plans : Bunch
        ``Z`` (n_plans, horizon + 1, n_states), ``U`` (n_plans, horizon) and ``cost`` (n_plans,), best plans first.
    """
    n, horizon = U.shape
    d = len(start)
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
        states[:, :, 0] = start
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
