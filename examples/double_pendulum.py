"""The double pendulum of RealAIGym in simulation: acrobot and pendubot, many plants at once.

`plot_acrobot.py` and `benchmarks/realaigym.py` use this module. The numbers of the robot and of its disturbances
are those of the public repository dfki-ric-underactuated-lab/double_pendulum. Angles are 0 where the arm hangs, and the
second one is relative to the first.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from sklearn.pipeline import make_union
from sklearn.utils import Bunch

from follow_plans import Follower, Library, Reach, plan_many, sampled_slopes, waves
from skevgp import EVGPRegressor, ResidualRegressor
from skevgp.datasets import load_log
from skevgp.features import AngleEncoder, InertiaForce, InertiaForceGravity, LogNormal, NominalDynamics
from skevgp.robots.systems import GravityTerm, Link, System

# Step of the simulation and of the controller, s; number of steps of a run; limit of the torque, N m.
STEP, N_STEPS, LIMIT = 0.002, 5000, 6.0
GRAVITY, GEAR = 9.81, 6.0
LENGTHS = 0.2, 0.3
# Joint with the motor.
DRIVEN = {"acrobot": 1, "pendubot": 0}
GOAL = np.array([np.pi, 0.0, 0.0, 0.0])
# The arm is upright within these distances, rad and rad/s.
NEAR = np.array([0.35, 0.35, 1.0, 1.0])

# A controller gets the number of the step and measured states (n_plants, 4), and returns torques (n_plants,).
Controller = Callable[[int, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Plants:
    """Numbers of one robot or of many. Each is a number or an array (n_plants,). Inertias are about the joints."""

    robot: str
    m1: Any = 0.5234602302310271
    m2: Any = 0.6255677234174437
    r1: Any = 0.2
    r2: Any = 0.25569305436052964
    I1: Any = 0.031887199591513114
    I2: Any = 0.05086984812807257
    b1: Any = 0.0
    b2: Any = 0.0
    cf1: Any = 0.0
    cf2: Any = 0.0
    rotor: Any = 0.0

    def accelerations(self, z: np.ndarray, tau1: Any, tau2: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return both accelerations of states (4, n) under torques on the joints."""
        l1 = LENGTHS[0]
        q1, q2, v1, v2 = z
        h = self.m2 * l1 * self.r2
        sin2, cos2 = np.sin(q2), np.cos(q2)
        hc = h * cos2
        M01 = self.I2 + hc - GEAR * self.rotor
        M11 = self.I2 + GEAR**2 * self.rotor
        M00 = self.I1 + self.I2 + self.m2 * l1**2 + 2.0 * hc + (GEAR**2 + 1.0) * self.rotor
        tip = self.m2 * self.r2 * GRAVITY * np.sin(q1 + q2)
        hs = h * sin2
        f1 = tau1 + hs * v2 * (2.0 * v1 + v2) - (self.m1 * self.r1 + self.m2 * l1) * GRAVITY * np.sin(q1) - tip
        f2 = tau2 - hs * v1**2 - tip
        if np.any(self.b1) or np.any(self.cf1):
            f1 = f1 - self.b1 * v1 - self.cf1 * np.arctan(100.0 * v1)
        if np.any(self.b2) or np.any(self.cf2):
            f2 = f2 - self.b2 * v2 - self.cf2 * np.arctan(100.0 * v2)
        determinant = M00 * M11 - M01**2
        return (M11 * f1 - M01 * f2) / determinant, (M00 * f2 - M01 * f1) / determinant

    def rate(self, z: np.ndarray, tau1: Any, tau2: Any) -> np.ndarray:
        return np.stack([z[2], z[3], *self.accelerations(z, tau1, tau2)])

    def advance(self, z: np.ndarray, tau1: Any, tau2: Any, h: float = STEP) -> np.ndarray:
        """Return states (4, n) after a Runge-Kutta step."""
        first = self.rate(z, tau1, tau2)
        second = self.rate(z + 0.5 * h * first, tau1, tau2)
        third = self.rate(z + 0.5 * h * second, tau1, tau2)
        fourth = self.rate(z + h * third, tau1, tau2)
        return z + h / 6.0 * (first + 2.0 * (second + third) + fourth)

    def torques(self, u: Any) -> tuple[Any, Any]:
        """Return the torques on both joints by that of the motor."""
        return (u, 0.0) if DRIVEN[self.robot] == 0 else (0.0, u)

    def energy(self, z: np.ndarray) -> np.ndarray:
        """Return kinetic and potential energy of states (4, n), J."""
        l1 = LENGTHS[0]
        q1, q2, v1, v2 = z
        hc = self.m2 * l1 * self.r2 * np.cos(q2)
        M00, M01 = self.I1 + self.I2 + self.m2 * l1**2 + 2.0 * hc, self.I2 + hc
        kinetic = 0.5 * (M00 * v1**2 + self.I2 * v2**2) + M01 * v1 * v2
        heights = -(self.m1 * self.r1 + self.m2 * l1) * np.cos(q1) - self.m2 * self.r2 * np.cos(q1 + q2)
        return kinetic + GRAVITY * heights


@dataclass(frozen=True)
class Disturbances:
    """What disturbs each plant: numbers, or arrays (n_plants,).

    Attributes
    ----------
    velocity_noise, torque_noise : standard deviations, rad/s and N m
    position_noise : standard deviation, rad
    response : share of the way to a new torque that the motor goes in a step
    delay : int
        Number of steps by which measured states are late.
    pulses : ndarray of shape (2, n_steps, n_plants) or None
        Torques on both joints that are added, N m.
    """

    velocity_noise: Any = 0.0
    torque_noise: Any = 0.0
    position_noise: Any = 0.0
    response: Any = 1.0
    delay: Any = 0
    pulses: np.ndarray | None = None


def simulate_plants(
    plants: Plants,
    controller: Controller,
    starts: np.ndarray,
    disturbances: Disturbances = Disturbances(),
    n_steps: int = N_STEPS,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate plants from states (n_plants, 4).

    Returns
    -------
    states : ndarray of shape (n_steps + 1, n_plants, 4)
    torques : ndarray of shape (n_steps, n_plants)
        Commanded torques, within the limit.
    """
    rng, n = np.random.RandomState(seed), len(starts)
    noise = np.stack([np.broadcast_to(disturbances.position_noise, n), np.broadcast_to(disturbances.velocity_noise, n)])
    noise, is_noisy = np.repeat(noise, 2, axis=0), np.any(noise)
    shaken, delay = np.any(disturbances.torque_noise), np.broadcast_to(disturbances.delay, n)
    states, commands, last = np.empty((n_steps + 1, n, 4)), np.empty((n_steps, n)), np.zeros(n)
    states[0], every, z = starts, np.arange(n), np.array(starts.T, dtype=float)
    for step in range(n_steps):
        measured = states[np.maximum(step - delay, 0), every]
        if is_noisy:
            measured = measured + (noise * rng.standard_normal((4, n))).T
        commands[step] = np.clip(controller(step, measured), -LIMIT, LIMIT)
        u = last + disturbances.response * (commands[step] - last)
        if shaken:
            u = u + disturbances.torque_noise * rng.standard_normal(n)
        u = np.clip(u, -LIMIT, LIMIT)
        tau = plants.torques(u)
        if disturbances.pulses is not None:
            tau = tau[0] + disturbances.pulses[0, step], tau[1] + disturbances.pulses[1, step]
        last = tau[DRIVEN[plants.robot]]  # the motor's next torque starts from all of the last one, as in RealAIGym
        z = plants.advance(z, *tau)
        states[step + 1] = z.T
    return states, commands


def is_upright(states: np.ndarray) -> np.ndarray:
    """Whether states (..., 4) are near the goal, after any number of turns."""
    return np.all(np.abs(difference(states, GOAL)) < NEAR, axis=-1)


def difference(z: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return z - other, with angles from -pi to pi."""
    found = z - other
    found[..., :2] -= 2.0 * np.pi * np.round(found[..., :2] / (2.0 * np.pi))
    return found


class Truth:
    """The simulated robot as a model of the state after a longer step, with the methods of `CompiledPredictor`."""

    def __init__(self, plants: Plants, dt: float = 0.01):
        self.plants, self.n_substeps, self.h = plants, max(round(dt / 0.005), 1), dt / max(round(dt / 0.005), 1)

    def predict(self, X: np.ndarray) -> np.ndarray:
        rows = np.moveaxis(X, -1, 0)
        z, tau = rows[:4], self.plants.torques(rows[4])
        for _ in range(self.n_substeps):
            z = self.plants.advance(z, *tau, h=self.h)
        return np.moveaxis(z, 0, -1)

    def value_and_jacobian(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        steps = 1e-6 * np.eye(5)
        slopes = [(self.predict(X + step) - self.predict(X - step)) / 2e-6 for step in steps]
        return self.predict(X), np.stack(slopes, axis=-1)


# --- data and models -------------------------------------------------------------------------------------------------

# Noise of the sensors, rad and rad/s. A run ends at this speed, rad/s.
SENSORS = Disturbances(position_noise=1e-3, velocity_noise=0.05)
FASTEST = 30.0
# Rows of 500 Hz from a state to the next, and the cutoff frequency of the filter of the log, Hz.
STRIDE = 5
CUTOFF = 30.0
DT = STRIDE * STEP

TASK = Reach(
    goal=tuple(GOAL),
    angles=(0, 1),
    limit=LIMIT,
    dt=DT,
    weights=(0.3, 0.3, 0.3, 0.3, 0.03, 0.03, 0.1),
    last_weights=(30.0, 30.0, 30.0, 30.0, 6.0, 6.0),
    state_cost=(0.64, 0.56, 0.13, 0.037),
    input_cost=0.82,
    top_state_cost=(0.97, 0.93, 0.39, 0.26),
    top_input_cost=0.11,
)

# Measured states (n_steps, 4) and commanded torques (n_steps,) of one run.
Run = tuple[np.ndarray, np.ndarray]


def record(robot: str, controller: Controller, starts: np.ndarray, n_steps: int, seed: int) -> list[Run]:
    """Return runs of the true robot from states (n_runs, 4), as its sensors see them, until it is too fast."""
    measured = []

    def watched(step: int, Z: np.ndarray) -> np.ndarray:
        measured.append(Z)
        return controller(step, Z)

    _, torques = simulate_plants(Plants(robot), watched, starts, SENSORS, n_steps, seed)
    states, runs = np.array(measured), []
    for number in range(len(starts)):
        fast = np.flatnonzero(np.any(np.abs(states[:, number, 2:]) > FASTEST, axis=1))
        end = fast[0] if len(fast) else n_steps
        runs.append((states[:end, number], torques[:end, number]))
    return runs


def random_torques(n_steps: int, n: int, size: float, rng: np.random.RandomState) -> np.ndarray:
    """Return torques (n_steps, n) that are lines between random values."""
    t, found = STEP * np.arange(n_steps), np.empty((n_steps, n))
    for number in range(n):
        times = np.arange(0.0, t[-1] + 1.0, rng.uniform(0.1, 0.5))
        found[:, number] = np.interp(t, times, rng.uniform(0.3, 1.0) * size * rng.uniform(-1.0, 1.0, len(times)))
    return found


def explore(robot: str, seconds: float, seed: int) -> list[Run]:
    """Record runs of a second with random torques, half of them from hanging and half from random states."""
    rng, n, n_steps = np.random.RandomState(seed), round(seconds), round(1.0 / STEP)
    starts, half = np.zeros((n, 4)), n // 2
    starts[half:] = np.hstack([rng.uniform(-np.pi, np.pi, (n - half, 2)), rng.uniform(-8.0, 8.0, (n - half, 2))])
    torques = random_torques(n_steps, n, 0.5 * LIMIT, rng)
    return record(robot, lambda step, Z: torques[step], starts, n_steps, seed)


def practise(robot: str, library: Library, seconds: float, seed: int) -> list[Run]:
    """Record runs of the controller with small random torques: some from hanging, others of a second near its plan.

    Half of the others start near the goal, where the feedback needs the most accurate derivatives.
    """
    rng = np.random.RandomState(seed)
    n_whole = max(round(0.3 * seconds / 2.5), 1)
    n = round(seconds - 2.5 * n_whole)
    first = rng.randint(0, library.horizon, n)
    starts = np.where(rng.uniform(size=(n, 1)) < 0.5, GOAL, library.Z[first])
    starts = starts + rng.standard_normal((n, 4)) * [0.1, 0.1, 0.5, 0.5]
    runs = []
    for nodes, states, duration in ((None, np.zeros((n_whole, 4)), 2.5), (first, starts, 1.0)):
        if not len(states):
            continue
        n_steps = round(duration / STEP)
        shakes = random_torques(n_steps, len(states), 1.0, rng) * rng.uniform(size=len(states))
        shakes[:, 0] = 0.0
        follower = Follower(library, len(states), STEP, nodes=nodes)
        runs += record(
            robot, lambda step, Z, own=follower, more=shakes: own(step, Z) + more[step], states, n_steps, seed
        )
    return runs


def transitions(robot: str, runs: list[Run]) -> Bunch:
    """Write the runs to a log, with pauses between them, and read state transitions of 0.01 s from it.

    Raw velocities are too noisy for the derivatives that feedback needs. `load_log` filters all signals alike, so that
    they still obey the same linear dynamics near the goal.
    """
    rows, now = [], 0.0
    for states, torques in runs:
        rows.append(np.column_stack([now + STEP * np.arange(len(states)), states, torques, np.zeros(len(states))]))
        now += STEP * len(states) + 2.0
    with TemporaryDirectory() as folder:
        file = Path(folder) / "runs.csv"
        np.savetxt(file, np.concatenate(rows), delimiter=",", fmt="%.6f")
        columns = {"time": 0, "position": [1, 2], "velocity": [3, 4], "effort": [5, 6]}
        log = load_log(file, columns=columns, cutoff=CUTOFF, dt=None, rest_velocity=0.0)
    X, y, groups = [], [], []
    for piece in np.unique(log.pieces):
        own = log.pieces == piece
        z, u = log.data[own, :4], log.target[own, 0]
        first = np.arange(0, len(z) - STRIDE, STRIDE)
        X.append(np.column_stack([z[first], np.mean([u[first + k] for k in range(STRIDE)], axis=0)]))
        y.append(z[first + STRIDE])
        groups.append(np.full(len(first), piece))
    return Bunch(data=np.vstack(X), target=np.vstack(y), groups=np.concatenate(groups))


def system(robot: str, seed: int | None = None, error: float = 0.2) -> System:
    """Return the robot as a table: with unit masses, or with numbers that are wrong by ``error`` (random signs)."""
    y, plants, links = (0.0, 1.0, 0.0), Plants(robot), []
    numbers = ((plants.m1, plants.r1, plants.I1), (plants.m2, plants.r2, plants.I2))
    signs = np.zeros((2, 3)) if seed is None else np.random.RandomState(seed).choice([-1.0, 1.0], (2, 3))
    for joint, (m, r, inertia) in enumerate(numbers):
        about_center = inertia - m * r**2
        if seed is None:
            m, r, about_center = 1.0, 0.1, 0.01
        m, r, about_center = np.array([m, r, about_center]) * (1.0 + error * signs[joint])
        links.append(
            Link(
                f"q{joint + 1}",
                "revolute",
                y,
                mass=m,
                com=(0.0, 0.0, -r),
                inertia=(about_center, about_center, 0.0),
                xyz=(0.0, 0.0, -LENGTHS[0] if joint else 0.0),
                effort=LIMIT if joint == DRIVEN[robot] else 0.0,
            )
        )
    return System(robot, tuple(links), (GravityTerm((0,), (0, 1)), GravityTerm((0, 1), (0, 1))))


def regressor(robot: str, kind: str, seed: int = 0, **options: Any) -> Any:
    """Return a model of the state after 0.01 s.

    ``kind`` is "IFG" (EVGP with rough physics, masses unknown), "GP" (without physics), "URDF" (EVGP with a rigid-body
    model that is 20 % off) or "parameters" (the same, whose masses, inertias and
    length of the second link are learned).
    """
    known = system(robot, seed) if kind in ("URDF", "parameters") else system(robot)
    options = {"kernel_map": AngleEncoder(known), "n_inducing": 100, "random_state": seed, **options}
    if kind == "GP":
        return ResidualRegressor(EVGPRegressor(**options))
    if kind == "IFG":
        return EVGPRegressor(InertiaForceGravity(known, dt=DT), **options)
    if kind == "URDF":
        nominal = NominalDynamics(known, terms=["midpoint"], dt=DT)
    else:
        links = {f"{number}(q{joint})": LogNormal(1.0, 0.3) for number in ("mass", "inertia") for joint in (1, 2)}
        parameters = links | {"length(q2)": LogNormal(1.0, 0.3)}
        nominal = NominalDynamics(known, terms=["midpoint"], dt=DT, parameters=parameters, model_error=0.03)
    return EVGPRegressor(make_union(InertiaForce(known, dt=DT), nominal), **options)


# --- from ignorance to a controller ----------------------------------------------------------------------------------

# Number of steps of a plan, number of first inputs from which plans start, and number of plans of a controller.
HORIZON, N_STARTS, N_PLANS = 200, 12, 3
# Seconds of data after which the robot learns a model and makes new plans. The first ones are recorded in ignorance.
STAGES = 10.0, 20.0, 40.0, 60.0, 120.0, 180.0


def plan_swing_ups(model: Any, rng: np.random.RandomState, known: np.ndarray | None = None, n_iter: int = 50) -> Bunch:
    """Plan from hanging, from random inputs and from those of known plans (n_plans, HORIZON)."""
    U = waves(N_STARTS, HORIZON, DT, 0.5 * LIMIT, rng)
    if known is not None:
        U = np.concatenate([known, U[: N_STARTS - 2 * len(known)]])
    return plan_many(model, TASK, np.zeros(4), U, n_iter)


def controller_of(model: Any, plans: Bunch, regressor: Any = None) -> Library:
    """Return the best plans with feedback. With the regressor, the feedback at the goal is cautious."""
    spread = None if regressor is None else sampled_slopes(regressor, np.append(GOAL, 0.0))
    return Library(model, TASK, plans.Z[:N_PLANS], plans.U[:N_PLANS], spread)


def study(
    robot: str, kind: str, seed: int = 0, stages: Sequence[float] = STAGES, n_inducing: int = 250
) -> Iterator[Bunch]:
    """Learn, plan and practise, stage by stage.

    Yields
    ------
    stage : Bunch
        ``seconds`` of data, ``model`` (compiled), ``plans``, ``library`` and ``fit_seconds``, processor time.
    """
    rng, runs, library, known, recorded = np.random.RandomState(seed), list[Run](), None, None, 0.0
    for number, seconds in enumerate(stages):
        if library is None:
            runs += explore(robot, seconds, seed)
        else:
            runs += practise(robot, library, seconds - recorded, 1000 * seed + number)
        recorded = seconds
        rows, start = transitions(robot, runs), time.process_time()
        fitted = regressor(robot, kind, seed, n_inducing=n_inducing).fit(rows.data, rows.target, groups=rows.groups)
        fit_seconds = time.process_time() - start
        model = fitted.compile(include_noise=False)
        plans = plan_swing_ups(model, rng, known)
        library, known = controller_of(model, plans, fitted), plans.U[:4]
        yield Bunch(
            seconds=seconds,
            model=model,
            plans=plans,
            library=library,
            fit_seconds=fit_seconds,
        )
