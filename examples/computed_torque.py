"""A simulated arm with an unknown payload and unknown friction, and a computed-torque controller.

`plot_tracking.py` and `benchmarks/control.py` use this module. Trajectories are arrays of shape (n_steps, n_runs,
3 * n_joints) with rows [q, q̇, q̈]. All runs are simulated together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from skevgp import InverseDynamics
from skevgp.datasets import load_robot, perturb_robot, quintic_reference
from skevgp.features import RigidBodyRegressor
from skevgp.robots import RigidBody

# Time step of the controller, s. The simulator divides it into five Runge-Kutta steps, because friction is stiff.
DT, SUBSTEPS = 0.005, 5
KP, KD = 100.0, 20.0
HOME = np.array([0.0, 0.8, 0.0, -1.2, 0.0, 0.8, 0.0])
# The log has every fourth state: 50 Hz.
EVERY = 4
# Largest speed of a move, rad/s, and its longest duration, s.
FASTEST, SLOWEST = 2.2, 5.0
# Times of a move at which its torques are checked in advance.
INSTANTS = np.linspace(0.0, 1.0, 51)


@dataclass(frozen=True)
class Arm:
    """The true iiwa14 of the simulation.

    Its joints have Coulomb and viscous friction, which the learner's features include. They also have effects that the
    features do not include: more friction at low speeds (Stribeck) and under load.

    Attributes
    ----------
    body : RigidBody
        The true bodies, with the payload.
    effort : ndarray of shape (n_joints,)
        Torque limits of the motors, N m.
    coulomb, viscous, stribeck, load : ndarray of shape (n_joints,)
        N m, N m s, N m, and a share of the motor's torque.
    ripple, noise : ndarray of shape (n_joints,)
        Standard deviations of the errors of the motors and of the torque sensors, N m.
    """

    body: RigidBody
    effort: np.ndarray
    coulomb: np.ndarray
    viscous: np.ndarray
    stribeck: np.ndarray
    load: np.ndarray
    ripple: np.ndarray
    noise: np.ndarray

    def friction(self, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        dry = self.coulomb + self.stribeck * np.exp(-((v / 0.2) ** 2)) + self.load * np.abs(u)
        return dry * np.tanh(v / 0.02) + self.viscous * v

    def step(self, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the state after DT with constant torques."""
        h = DT / SUBSTEPS

        def rate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
            return np.array([v, self.body.accelerations(q, v, u - self.friction(v, u))])

        z = np.array([q, v])
        for _ in range(SUBSTEPS):
            first = rate(*z)
            second = rate(*z + h / 2.0 * first)
            third = rate(*z + h / 2.0 * second)
            z = z + h / 6.0 * (first + 2.0 * second + 2.0 * third + rate(*z + h * third))
        return z[0], z[1]


def make_arm(payload: float, seed: int) -> Arm:
    """Make an arm with a payload in kg. The seed draws its place in the hand and the friction."""
    rng = np.random.RandomState(seed)
    model = perturb_robot("iiwa14", 0.05, random_state=rng)
    model.armature = load_robot("iiwa14").armature  # a catalogue has it
    place = np.array([0.0, 0.0, 0.1]) + rng.uniform(-0.05, 0.05, 3)
    _carry(model, payload, place)
    effort = np.array(model.effortLimit)
    sizes = [share * effort * rng.uniform(0.5, 1.5, len(effort)) for share in (0.02, 0.01, 0.01)]
    gears = 0.1 * rng.uniform(0.5, 1.5, len(effort))
    return Arm(RigidBody(model), effort, *sizes, gears, ripple=0.001 * effort, noise=0.002 * effort)


def _carry(model: Any, payload: float, place: np.ndarray) -> None:
    link = model.inertias[model.njoints - 1]
    model.inertias[model.njoints - 1] = link + type(link)(payload, place, payload * 0.05**2 * np.eye(3))


def learner(payload: float = 2.5, **options: Any) -> InverseDynamics:
    """Make a model of the arm's torques. Its prior is the nominal model with an unknown load of a few kg."""
    model = load_robot("iiwa14").copy()
    _carry(model, payload, np.array([0.0, 0.0, 0.1]))
    return InverseDynamics(RigidBodyRegressor(model, mass_scale=1.0, com_scale=0.5), **options)


class ComputedTorque:
    """τ = M(q) (q̈_d + k_p e + k_d ė + k_i ∫e) + C(q, q̇) q̇ + g(q) of a model, with e = q_d - q, and added torques.

    Parameters
    ----------
    body : RigidBody
        The approximate model.
    reference : ndarray of shape (n_steps, n_runs, 3 * n_joints)
    missed : ndarray of shape (n_steps, n_runs, n_joints) or callable, default=None
        Torques to add: an array computed in advance, or a function of rows [q_d, q̇_d, q̈_d].
    ki : float, default=0.0
        Integral gain, 1/s³.
    """

    def __init__(self, body: RigidBody, reference: np.ndarray, missed: Any = None, ki: float = 0.0):
        self.body, self.reference, self.missed, self.ki = body, reference, missed, ki
        self._integral = np.zeros((reference.shape[1], reference.shape[2] // 3))

    def __call__(self, step: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        wanted = self.reference[step]
        n = q.shape[1]
        off = wanted[:, :n] - q
        a = wanted[:, 2 * n :] + KP * off + KD * (wanted[:, n : 2 * n] - v)
        if self.ki:
            self._integral += DT * off
            a += self.ki * self._integral
        torque = self.body.forces(q, v, a)
        if self.missed is None:
            return torque
        return torque + (self.missed(wanted) if callable(self.missed) else self.missed[step])


@dataclass(frozen=True)
class Run:
    """The result of a simulated run.

    Attributes
    ----------
    motion : ndarray of shape (n_steps, n_runs, 3 * n_joints)
        Means of q and q̇ over each step, and q̈ as the change of q̇.
    torque : ndarray of shape (n_steps, n_runs, n_joints)
        Torques measured by the joint sensors, N m.
    error : ndarray of shape (n_steps, n_runs, n_joints)
        Position minus reference, at the start of each step.
    """

    motion: np.ndarray
    torque: np.ndarray
    error: np.ndarray


def track(arm: Arm, controller: ComputedTorque, seed: int) -> Run:
    """Follow the reference from its first state, without torque limits."""
    rng, reference = np.random.RandomState(seed), controller.reference
    n = reference.shape[2] // 3
    q, v = reference[0, :, :n].copy(), reference[0, :, n : 2 * n].copy()
    motion, torque, error = np.empty_like(reference), *np.empty((2, *reference.shape[:2], n))
    for step in range(len(reference)):
        u = controller(step, q, v) + arm.ripple * rng.standard_normal(q.shape)
        before = q, v
        q, v = arm.step(q, v, u)
        motion[step] = np.hstack([(before[0] + q) / 2.0, (before[1] + v) / 2.0, (v - before[1]) / DT])
        torque[step] = u + arm.noise * rng.standard_normal(q.shape)
        error[step] = before[0] - reference[step, :, :n]
    return Run(motion, torque, error)


def log_of(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return training rows X and y, and the run of each row."""
    X, y = (part[::EVERY].swapaxes(0, 1) for part in (run.motion, run.torque))
    return np.concatenate(X), np.concatenate(y), np.repeat(np.arange(len(X)), X.shape[1])


def waves(n_runs: int, seconds: float, seed: int, slower: float = 1.0) -> np.ndarray:
    """Return sums of three waves of each joint about HOME, with speeds up to about half a turn per second."""
    rng, t = np.random.RandomState(seed), DT * np.arange(round(seconds / DT))[:, np.newaxis, np.newaxis, np.newaxis]
    omega = 2.0 * np.pi * rng.uniform(0.05, 0.7, (n_runs, len(HOME), 3)) / slower
    phase, size = rng.uniform(0.0, 2.0 * np.pi, omega.shape), rng.uniform(0.1, 0.35, omega.shape)
    q = size * np.sin(omega * t + phase)
    parts = q, size * omega * np.cos(omega * t + phase), -(omega**2) * q
    q, v, a = (part.sum(axis=3) for part in parts)
    return np.concatenate([HOME + q, v, a], axis=2)


def moves(starts: np.ndarray, ends: np.ndarray, durations: np.ndarray, seconds: float) -> np.ndarray:
    """Return a minimum-jerk motion of each run between two positions. The last position is then held."""
    t = DT * np.arange(round(seconds / DT))
    each = [
        np.concatenate(quintic_reference(*ends_, duration, t), axis=1)
        for *ends_, duration in zip(starts, ends, durations, strict=True)
    ]
    return np.stack(each, axis=1)


def missed_by(body: RigidBody, model: Any, reference: np.ndarray) -> np.ndarray:
    """Return the difference between learned and nominal torques along a reference, in one batch."""
    rows = reference.reshape(-1, reference.shape[-1])
    missed = model.predict(rows) - body.forces(*np.split(rows, 3, axis=1))
    return missed.reshape(*reference.shape[:-1], -1)


def cautious(chance: float, n_joints: int, n_steps: int) -> float:
    """Return k such that mean ± k std keeps all torques of a move within limits with this probability (Boole)."""
    return float(norm.isf((1.0 - chance) / (n_joints * n_steps)))


def fastest(
    model: Any, starts: np.ndarray, ends: np.ndarray, limits: np.ndarray, k: float
) -> tuple[np.ndarray, np.ndarray]:
    """Find the shortest durations of moves for which |mean| + k std of all torques is within limits, by bisection.

    Returns
    -------
    durations : ndarray of shape (n_moves,)
    decided : ndarray of bool of shape (n_moves,)
        Whether torque limits determine the duration. It is false if the limit of speeds does, or if the arm cannot
        hold its load at that position.
    """
    q, v, a = quintic_reference(starts, ends, 1.0, INSTANTS)

    def holds(durations: np.ndarray) -> np.ndarray:
        T = durations[:, np.newaxis, np.newaxis]
        rows = np.concatenate([q, v / T, a / T**2], axis=2)
        mean, std = model.predict(rows.reshape(-1, rows.shape[2]), return_std=True)
        return (np.abs(mean) + k * std < limits).reshape(len(q), -1).all(axis=1)

    short, long = 1.875 * np.abs(ends - starts).max(axis=1) / FASTEST, np.full(len(q), SLOWEST)
    decided = ~holds(short) & holds(long)
    for _ in range(9):
        middle = np.sqrt(short * long)
        held = holds(middle)
        short, long = np.where(held, short, middle), np.where(held, middle, long)
    return long, decided


def positions(n_moves: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw positions at which moves start and end."""
    starts, ends = HOME + np.random.RandomState(seed).uniform(-0.7, 0.7, (2, n_moves, len(HOME)))
    return starts, ends
