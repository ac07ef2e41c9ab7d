"""What goes to a peer and what comes back: jobs, results, the clock, and the units in which peers fit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np


class Archive:
    """Arrays, numbers and strings by name, to and from an .npz."""

    def save(self, path: Path) -> None:
        np.savez(path, **asdict(self))

    @classmethod
    def load(cls, path: Path) -> Any:
        with np.load(path) as arrays:
            values = {field.name: arrays[field.name] for field in fields(cls)}
        return cls(**{name: value if value.ndim else value.item() for name, value in values.items()})


@dataclass(frozen=True)
class Job(Archive):
    """What to fit, from where, for how long.

    Attributes
    ----------
    X, Y, X_test : ndarray of shape (n, d), (n, o), (n_test, d)
    inducing_points : ndarray of shape (m, d)
    lengthscales : ndarray of shape (d,)
    sharing : {"none", "all"}
        Independent models per output, or one for all of them.
    max_iter : int
        Of L-BFGS, per model; 0 leaves skevgp to its own rule.
    time_limit : float
        Seconds for all outputs; then the fit ends with what it has.
    seed : int
    """

    X: np.ndarray
    Y: np.ndarray
    X_test: np.ndarray
    inducing_points: np.ndarray
    lengthscales: np.ndarray
    sharing: str
    max_iter: int
    time_limit: float
    seed: int


@dataclass(frozen=True)
class Result(Archive):
    """What came out, in the units of Y.

    Attributes
    ----------
    mean, std : ndarray of shape (n_test, o)
        With noise.
    seconds, cpu_seconds, predict_seconds : float
        Wall-clock; of the processor, over all threads; wall-clock.
    iterations, evaluations : float
        Over all models; NaN if unknown.
    bounds : ndarray
        On the log marginal likelihood of each model, nats; empty if there is none.
    stop : str
        Why each model's fit ended, joined by spaces.
    curve_seconds, curve_cpu_seconds, curve_bound : ndarray of shape (k,)
        The sum of the models' best bounds so far; a model that has not begun counts with its first bound.
    versions : str
    """

    mean: np.ndarray
    std: np.ndarray
    seconds: float
    cpu_seconds: float
    predict_seconds: float
    iterations: float
    evaluations: float
    bounds: np.ndarray
    stop: str
    curve_seconds: np.ndarray
    curve_cpu_seconds: np.ndarray
    curve_bound: np.ndarray
    versions: str


class TimeUpError(Exception):
    """The time limit has passed."""


class Watch:
    """The clock of a fit of several models, and their bounds on the way."""

    def __init__(self, time_limit: float, n_models: int):
        self.time_limit, self.n_models = time_limit, n_models
        self.records: list[tuple[float, float, int, float]] = []
        self._begin, self._begin_cpu = time.perf_counter(), time.process_time()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._begin

    @property
    def cpu_seconds(self) -> float:
        return time.process_time() - self._begin_cpu

    def deadline(self, model: int) -> float:
        """When a model has to end, if models are fitted one after the other: a fair share of what is left."""
        return self.seconds + max(self.time_limit - self.seconds, 0.0) / (self.n_models - model)

    def record(self, model: int, bound: float) -> None:
        self.records.append((self.seconds, self.cpu_seconds, model, bound))

    def curve(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Seconds, those of the processor, and the sum of the best bounds so far."""
        best: dict[int, float] = {}
        for *_, model, bound in self.records:
            best.setdefault(model, bound)
        sums = []
        for *_, model, bound in self.records:
            best[model] = max(best[model], bound)
            sums.append(sum(best.values()))
        return np.array([r[0] for r in self.records]), np.array([r[1] for r in self.records]), np.array(sums)


@dataclass
class Fitted:
    """A fitted peer: X_test -> (mean, std), and how the fit went."""

    predict: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    bounds: list[float]
    stop: str
    iterations: float = np.nan
    evaluations: float = np.nan


class Scaled:
    """A job in standard units: inputs of unit standard deviation, targets of unit root mean square."""

    def __init__(self, job: Job):
        spread = job.X.std(axis=0)
        self.spread = np.where(spread > 0.0, spread, 1.0)
        self.unit = np.sqrt(np.mean(job.Y**2, axis=0))
        self.X, self.Y, self.Z = job.X / self.spread, job.Y / self.unit, job.inducing_points / self.spread
        self.lengthscales = job.lengthscales / self.spread
        columns = list(range(job.Y.shape[1]))
        self.models = [columns] if job.sharing == "all" else [[column] for column in columns]

    def bound(self, bound: float, columns: list[int]) -> float:
        """Of the targets in their own units."""
        return bound - len(self.X) * float(np.log(self.unit[columns]).sum())

    def predictor(self, models: list[Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]]) -> Callable[..., Any]:
        """(mean, std) of all outputs from each model's."""

        def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            parts = [model(X / self.spread) for model in models]
            mean, std = (np.hstack([part[i].reshape(len(X), -1) for part in parts]) for i in (0, 1))
            return mean * self.unit, np.broadcast_to(std, mean.shape) * self.unit

        return predict
