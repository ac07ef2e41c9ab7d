"""What goes to a peer and what comes back: jobs, results, the clock, and the units in which peers fit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

# X_test -> (mean, std), with noise.
Predict = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


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
    noise : float
        Where the noise variance of other peers than skevgp starts, a share of the mean square of the targets.
    sharing : {"none", "all", "default"}
        Independent models per output, one for all of them, or what the peer does by itself.
    max_iter : int
        Of L-BFGS, per model; 0 leaves skevgp to its own rule.
    time_limit : float
        Seconds for all outputs; then the fit ends with what it has.
    seed : int
    n_checkpoints : int
        Times before the end at which the fit is looked at.
    """

    X: np.ndarray
    Y: np.ndarray
    X_test: np.ndarray
    inducing_points: np.ndarray
    lengthscales: np.ndarray
    noise: float
    sharing: str
    max_iter: int
    time_limit: float
    seed: int
    n_checkpoints: int = 0


@dataclass(frozen=True)
class Result(Archive):
    """What came out, in the units of Y.

    Attributes
    ----------
    mean, std : ndarray of shape (1 + k, n_test, o)
        With noise: at the end, and at up to ``n_checkpoints`` times before.
    seconds, cpu_seconds, bound : ndarray of shape (1 + k,)
        Wall-clock; of the processor, over all threads; the sum of the models' bounds, NaN if there is none.
    predict_seconds : float
    iterations, evaluations : float
        Over all models; NaN if unknown.
    bounds : ndarray
        On the log marginal likelihood of each model at the end, nats; empty if there is none.
    stop : str
        Why each model's fit ended, joined by spaces.
    curve : ndarray of shape (3, k)
        Wall-clock and processor's seconds, and the sum of the models' best bounds so far; a model that has not begun
        counts with its first bound. Empty for a peer of which only the checkpoints tell.
    versions : str
    """

    mean: np.ndarray
    std: np.ndarray
    seconds: np.ndarray
    cpu_seconds: np.ndarray
    bound: np.ndarray
    predict_seconds: float
    iterations: float
    evaluations: float
    bounds: np.ndarray
    stop: str
    curve: np.ndarray
    versions: str


@dataclass(frozen=True)
class Fixed(Archive):
    """A model without anything to fit, by which libraries are compared.

    Attributes
    ----------
    kernel : {"rbf", "matern52"}
    X, y, X_test : ndarray of shape (n, d), (n,), (n_test, d)
    inducing_points : ndarray of shape (m, d)
        As many as rows: then they are the rows, and the bound is the likelihood.
    lengthscales : ndarray of shape (d,)
    signal, noise : float
        Variances.
    """

    kernel: str
    X: np.ndarray
    y: np.ndarray
    X_test: np.ndarray
    inducing_points: np.ndarray
    lengthscales: np.ndarray
    signal: float
    noise: float

    @property
    def exact(self) -> bool:
        """Whether an exact GP says the same."""
        return len(self.inducing_points) == len(self.X)


@dataclass(frozen=True)
class Said(Archive):
    """What a library says of a `Fixed`: its bound, and its prediction with noise."""

    bound: float
    mean: np.ndarray
    variance: np.ndarray


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

    def curve(self) -> np.ndarray:
        """Seconds, those of the processor, and the sum of the best bounds so far: (3, k)."""
        best: dict[int, float] = {}
        for *_, model, bound in self.records:
            best.setdefault(model, bound)
        points = []
        for seconds, cpu_seconds, model, bound in self.records:
            best[model] = max(best[model], bound)
            points.append((seconds, cpu_seconds, sum(best.values())))
        return np.array(points).reshape(-1, 3).T


class Checkpoint(NamedTuple):
    """A fit as it was at a time."""

    seconds: float
    cpu_seconds: float
    bound: float
    predict: Predict


@dataclass
class Fitted:
    """A fitted peer and how the fit went.

    Attributes
    ----------
    predict : callable
    bounds : list of float
    stop : str
    iterations, evaluations : float
    at : callable, optional
        seconds -> `Checkpoint`: what there was at about that time. It is called when the clock has been read.
    curve : ndarray of shape (3, k), optional
        As of `Watch.curve`.
    """

    predict: Predict
    bounds: list[float]
    stop: str
    iterations: float = np.nan
    evaluations: float = np.nan
    at: Callable[[float], Checkpoint] | None = None
    curve: np.ndarray | None = None


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

    def predictor(self, models: list[Predict]) -> Predict:
        """(mean, std) of all outputs from each model's."""

        def predict(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            parts = [model(X / self.spread) for model in models]
            mean, std = (np.hstack([part[i].reshape(len(X), -1) for part in parts]) for i in (0, 1))
            return mean * self.unit, np.broadcast_to(std, mean.shape) * self.unit

        return predict

    def fitted(self, ways: list[list[tuple[float, Predict]]], watch: Watch, **said: Any) -> Fitted:
        """Of models that kept each step on their way: (seconds, how it predicts), the start first, the best last."""
        curve = watch.curve()

        def at(seconds: float) -> Checkpoint:
            index = max(int(np.searchsorted(curve[0], seconds, side="right")) - 1, 0)
            steps = [
                max((step for step in way if step[0] <= seconds), default=way[0], key=lambda s: s[0]) for way in ways
            ]
            return Checkpoint(*curve[:, index], self.predictor([predict for _, predict in steps]))

        return Fitted(self.predictor([way[-1][1] for way in ways]), at=at, curve=curve, **said)
