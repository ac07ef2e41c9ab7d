"""Random trajectories of a robot: random inputs, or controlled moves with noise on the torque."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from ..robots import SYSTEMS
from .control import ComputedTorqueController
from .plant import Plant
from .simulation import Controller

_LARGEST_MOVE = 1.5  # half width of the initial positions, rad or m, if limits allow it
_TRAVEL = 0.8 / 1.5  # largest distance of a target, as a fraction of that half width
_NOISE = 0.1  # noise as a fraction of the scale of torques
_LARGEST_SHAKE = 2.0  # largest acceleration by noise on one torque, rad/s² or m/s²
_LOST = 5.0  # a joint that is faster than this many largest moves per step is out of control
_UNLIMITED = 1e6  # larger position limits are ignored


@dataclass(frozen=True)
class RandomInputs:
    """Initial states center + scale * U(-1, 1), and inputs eta * N(0, 1)."""

    center: np.ndarray  # (2 * n_joints,)
    scale: np.ndarray  # (2 * n_joints,), alpha in the paper
    input_scale: np.ndarray  # (n_inputs,), eta
    n_trajectories: int
    n_steps: int

    description = "random inputs from random states"

    def draw(
        self, plant: Plant, shape: tuple[int, int], dt: float, duration: float | None, rng: np.random.RandomState
    ) -> tuple[np.ndarray, Controller]:
        if duration is not None:
            raise ValueError(
                f"duration is the time of a controlled move, but {plant.layout.name!r} is driven by random inputs; got "
                f"{duration!r}."
            )
        z0 = self.center + self.scale * rng.uniform(-1.0, 1.0, (shape[0], len(self.scale)))
        inputs = self.input_scale * rng.standard_normal((*shape, len(self.input_scale)))
        return z0, lambda step, _Z: inputs[:, step]


@dataclass(frozen=True)
class ControlledMoves:
    """Moves from rest in center + width * U(-1, 1) to a target nearby within the limits, with noise on the torques."""

    center: np.ndarray  # (n_joints,), as the following arrays
    width: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    noise: np.ndarray
    n_trajectories: int
    n_steps: int

    description = "computed-torque control along quintic references, with noise on the torques"

    def draw(
        self, plant: Plant, shape: tuple[int, int], dt: float, duration: float | None, rng: np.random.RandomState
    ) -> tuple[np.ndarray, Controller]:
        n = len(self.center)
        q0 = self.center + self.width * rng.uniform(-1.0, 1.0, (shape[0], n))
        q1 = np.clip(q0 + _TRAVEL * self.width * rng.uniform(-1.0, 1.0, (shape[0], n)), self.lower, self.upper)
        noise = self.noise * rng.standard_normal((*shape, n))
        kd = min(20.0, 0.6 / dt)  # the gains of the paper, or lower ones if dt is long
        kp = kd**2 / 4.0
        controller = ComputedTorqueController(
            plant, q0, q1, duration=shape[1] * dt if duration is None else duration, dt=dt, kp=kp, kd=kd
        )
        # Speeds detect instability better than positions: a joint with a weak motor falls as far.
        fastest = _LOST * (_TRAVEL * self.width + _LARGEST_SHAKE / kp) / dt

        def noisy(step: int, Z: np.ndarray) -> np.ndarray:
            lost = (np.abs(Z[:, n:]) > fastest).any(axis=0)
            if lost.any():
                raise ValueError(
                    f"The controlled moves of {plant.layout.name!r} are unstable in step {step}, at the joints "
                    f"{[plant.layout.position_names[joint] for joint in np.flatnonzero(lost)]}. Lower dt={dt} s, or "
                    "pass a longer duration."
                )
            return controller(step, Z) + noise[:, step]

        return np.hstack([q0, np.zeros_like(q0)]), noisy


def _random_inputs(state_scale: list[float], input_scale: float, n_trajectories: int) -> RandomInputs:
    return RandomInputs(
        np.zeros(len(state_scale)), np.array(state_scale), np.array([input_scale]), n_trajectories, n_steps=100
    )


# Table 1 of the paper, and its section IV-B for iiwa14.
_PAPER: Mapping[str, RandomInputs | ControlledMoves] = MappingProxyType(
    {
        "pendulum": _random_inputs([np.pi, 0.5], 1.0, 48),
        "cartpole": _random_inputs([1.0, np.pi, 0.5, 0.5], 100.0, 48),
        "cartpole_damped": _random_inputs([1.0, np.pi, 0.5, 0.5], 100.0, 48),
        "acrobot": _random_inputs([np.pi, 1.0, 0.5, 0.5], 0.5, 93),
        "iiwa14": ControlledMoves(
            center=np.zeros(7),
            width=np.full(7, 1.5),
            lower=np.full(7, -np.inf),
            upper=np.full(7, np.inf),
            noise=_NOISE * np.array([3.0, 15.0, 3.0, 2.0, 2.0, 2.0, 0.05]),
            n_trajectories=465,
            n_steps=50,
        ),
    }
)


def sampling_of(plant: Plant) -> RandomInputs | ControlledMoves:
    """Return the sampling of a robot: that of the paper for named systems, else with scales from the model."""
    # A robot with the name and the size of a named system counts as it. Others make controlled moves if all joints are
    # driven, and get random inputs otherwise.
    layout = plant.layout
    if layout.name in _PAPER and SYSTEMS[layout.name].layout.driven == layout.driven:
        return _PAPER[layout.name]
    lower, upper = _position_limits(plant)
    with np.errstate(invalid="ignore"):
        width = np.minimum(_LARGEST_MOVE, (upper - lower) / 2.0)
        middle = (lower + upper) / 2.0
    center = np.clip(np.where(np.isfinite(middle), middle, 0.0), lower + width, upper - width)
    noise = _noise_scale(plant, center, width)
    if layout.n_inputs == layout.n_joints:
        return ControlledMoves(center, width, lower, upper, noise, n_trajectories=100, n_steps=50)
    fastest = np.array(plant.model.velocityLimit)
    speed = np.minimum(0.5, np.where(fastest > 0.0, fastest, np.inf))
    return RandomInputs(
        np.r_[center, np.zeros_like(center)],
        np.r_[width, speed],
        noise[list(layout.driven)],
        n_trajectories=100,
        n_steps=50,
    )


def _position_limits(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Return limits of the positions, infinite if the model has none; an empty range counts as none."""
    lower, upper = np.array(plant.model.lowerPositionLimit), np.array(plant.model.upperPositionLimit)
    known = lower < upper
    return (
        np.where(known & (lower > -_UNLIMITED), lower, -np.inf),
        np.where(known & (upper < _UNLIMITED), upper, np.inf),
    )


def _noise_scale(plant: Plant, center: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return a tenth of the torque that holds a joint and gives it 1 rad/s², at most that for 2 rad/s² of any joint."""
    # Root mean squares over configurations; m/s² for prismatic joints.
    q = center + width * np.random.RandomState(0).uniform(-1.0, 1.0, (50, len(center)))
    M = np.array([plant.mass_matrix(row) for row in q])
    work = np.abs(plant.body.gravity(q)) + np.diagonal(M, axis1=1, axis2=2)
    answer = np.sqrt(np.mean(np.linalg.inv(M) ** 2, axis=0)).max(axis=0)
    return np.minimum(_NOISE * np.sqrt(np.mean(work**2, axis=0)), _LARGEST_SHAKE / answer)
