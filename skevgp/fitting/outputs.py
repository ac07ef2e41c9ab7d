"""Several outputs: which of them share what, fitted together, in the user's units."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from dataclasses import dataclass, replace
from threading import Event
from typing import Any, Literal

import numpy as np

from ..inference.bounds import PosteriorFamily
from ..inference.model import SparseModel
from ..inference.posterior import Posterior
from ..inference.statistics import Kernel
from ..kernels.parse import Starts
from ..optimizers.lbfgs import Report
from ..optimizers.parameters import ParameterTable
from ..rows.internal import Rows
from ..rows.threads import BlockMap, thread_pool
from .inducing import Placement
from .start import FIRST_NOISE, checked_variance, spread_of, starting_table
from .strategy import Learned, Options, learn
from .units import Frame

Sharing = Literal["all", "kernel", "none"]


def _models(sharing: Sharing, kernel: Kernel, frame: Frame, family: PosteriorFamily) -> list[tuple[slice, SparseModel]]:
    """The independent models and the outputs of each."""
    prior, n_outputs = frame.internal_prior(), len(frame.target_unit)
    each = tuple(slice(o, o + 1) for o in range(n_outputs))
    if sharing == "none":
        return [(o, SparseModel(kernel, prior.outputs(o), family, (slice(0, 1),))) for o in each]
    groups = (slice(0, n_outputs),) if sharing == "all" else each
    return [(slice(0, n_outputs), SparseModel(kernel, prior, family, groups))]


def _side_by_side(one: Callable[..., Learned], jobs: list[Any], n_threads: int, stop: Event) -> list[Learned]:
    """Each job's result; Ctrl-C sets ``stop``, upon which jobs end with what they have."""
    if n_threads < 2:
        return [one(*job) for job in jobs]
    futures: list[Future[Learned]] = []
    with thread_pool(n_threads) as pool:
        try:
            for job in jobs:
                futures.append(pool.submit(one, *job))
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
            if any(future.exception() for future in done):
                # The error is the result: nobody waits for the others.
                stop.set()
                pool.shutdown(wait=False, cancel_futures=True)
                next(future for future in futures if future in done and future.exception()).result()
        except KeyboardInterrupt:
            stop.set()
            futures += [pool.submit(one, *job) for job in jobs[len(futures) :]]
        return [future.result() for future in futures]


@dataclass(frozen=True)
class FittedOutputs:
    """Fitted sparse models of consecutive outputs.

    Attributes
    ----------
    frame : Frame
    sharing : {"all", "kernel", "none"}
    outputs : tuple of slice
        Of each model.
    tables : tuple of ParameterTable
        Where each model started, and its bounds.
    learned : tuple of Learned
        Each model, in internal units.
    """

    frame: Frame
    sharing: Sharing
    outputs: tuple[slice, ...]
    tables: tuple[ParameterTable, ...]
    learned: tuple[Learned, ...]

    @classmethod
    def fit(
        cls,
        frame: Frame,
        rows: Rows,
        kernel: Kernel,
        starts: Starts,
        sharing: Sharing,
        family: PosteriorFamily,
        placement: Placement,
        options: Options,
        rng: np.random.RandomState,
        n_threads: int = 1,
        previous: FittedOutputs | None = None,
        reporter: Callable[[float], Report] | None = None,
    ) -> FittedOutputs:
        """Place inducing points and maximise the bound of each model.

        Parameters
        ----------
        frame : Frame
        rows : Rows
            In internal units.
        kernel : Kernel
        starts : Starts
            What the user says of kernel and noise.
        sharing : {"all", "kernel", "none"}
        family : {"full", "diagonal"}
        placement : Placement
            Of the inducing points.
        options : Options
        rng : RandomState
        n_threads : int, default=1
            For independent models, or else for blocks of rows.
        previous : FittedOutputs, default=None
            Start where this one ended, as far as shapes agree.
        reporter : callable, default=None
            reporter(what to add to a loss in internal units) returns the model's report.

        Returns
        -------
        fitted : FittedOutputs
        """
        models = _models(sharing, kernel, frame, family)
        spread = spread_of(rows.inputs)

        def table_of(outputs: slice, points: np.ndarray, variance: float = 1.0) -> ParameterTable:
            return starting_table(
                spread,
                points,
                frame.target_unit[outputs],
                starts,
                rows.scatter()[outputs],
                FIRST_NOISE[options.solver],
                kernel.n_hyperparameters,
                variance,
                frame.centre,
            )

        # The kernel starts alike in all models and without regard to the points, which may depend on it.
        alone = table_of(slice(0, 1), np.empty((1, 0, len(spread))))
        hyperparameters = np.log(alone.values(alone.start())["hyperparameters"])
        points = placement.points(rows.sample(placement.sample_size, rng).inputs, kernel, hyperparameters, rng)
        first = starts.hyperparameters.value
        variance = 1.0 if first is None else checked_variance(kernel, first, points)
        tables, colds = [], []
        for index, (outputs, model) in enumerate(models):
            table = cold = table_of(outputs, np.repeat(points[np.newaxis], len(model.groups), axis=0), variance)
            if previous is not None and previous.outputs == tuple(outputs for outputs, _ in models):
                values = previous._values_in(frame, rows, index)
                if previous.learned[index].model.kernel != kernel:
                    # Of another function: its inducing points and noise may serve.
                    values.pop("hyperparameters", None)
                    values.pop("signal", None)
                if isinstance(placement.method, np.ndarray):
                    values.pop("inducing_points", None)
                table = table.started_at(values)
            tables.append(table)
            colds.append(None if table is cold else cold)
        # The same for all, so that outputs that share nothing are fitted as they would be alone but for rounding.
        seed = rng.randint(np.iinfo(np.int32).max)
        threads, stop = BlockMap(n_threads if len(models) == 1 else 1), Event()
        options = replace(options, threads=threads)
        at_once = min(n_threads, len(models))

        def one(outputs: slice, model: SparseModel, table: ParameterTable, cold: ParameterTable | None) -> Learned:
            inner = reporter(len(rows) * frame.log_unit(outputs)) if reporter else None

            def report(iteration: int, loss: float) -> None:
                if stop.is_set():
                    raise KeyboardInterrupt
                if inner is not None:
                    inner(iteration, loss)

            own = rows.outputs(outputs, 1.0 / at_once)
            learned = learn(model, table, own, options, placement, np.random.RandomState(seed), report, cold)
            if learned.interrupted:
                stop.set()
            return learned

        jobs = [(*model, *start) for model, *start in zip(models, tables, colds, strict=True)]
        try:
            learned = _side_by_side(one, jobs, at_once, stop)
        finally:
            threads.close()
        return cls(frame, sharing, tuple(outputs for outputs, _ in models), tuple(tables), tuple(learned))

    def updated(self, rows: Rows, weight: float = 1.0) -> FittedOutputs:
        """Fold new rows, in internal units, into the posteriors; ``weight`` multiplies what is known of the others."""
        learned = (one.updated(rows.outputs(own), weight) for own, one in zip(self.outputs, self.learned, strict=True))
        return replace(self, learned=tuple(learned))

    def posterior(self) -> Posterior:
        """The posterior of all outputs, in the user's units but for target_mean."""
        return self.frame.posterior([one.posterior for one in self.learned])

    @property
    def lower_bound(self) -> float:
        """In nats, summed over outputs."""
        return sum(one.bound for one in self.learned) - self._shift

    @property
    def n_iter(self) -> int:
        return max(len(one.loss_curve) for one in self.learned)

    @property
    def loss_curve(self) -> np.ndarray:
        """Minus the bound per iteration, (n_iter,); a model that is done keeps its last value."""
        curves = [one.loss_curve for one in self.learned]
        if not all(curves):
            return np.empty(0)
        return np.sum([np.pad(curve, (0, self.n_iter - len(curve)), "edge") for curve in curves], axis=0) + self._shift

    @property
    def n_parameters(self) -> int:
        """Free parameters of kernels, noise, inducing points and q."""
        total = 0
        for table, one in zip(self.tables, self.learned, strict=True):
            size = len(one.posterior.mean[0])
            q = 2 * size if one.model.family == "diagonal" else size + size * (size + 1) // 2
            total += table.size + q * len(one.posterior.mean)
        return total

    @property
    def messages(self) -> list[str]:
        """What the user should know of how the fits ended."""
        if any(one.interrupted for one in self.learned):
            return [max(self.learned, key=lambda one: (one.interrupted, len(one.loss_curve))).message]
        return sorted({one.message for one in self.learned if one.message})

    def bounds(self, name: str, output: int) -> np.ndarray:
        """Bounds (n, 2) of an output's ``hyperparameters`` or ``signal``, in the user's units."""
        index = next(i for i, own in enumerate(self.outputs) if own.start <= output < own.stop)
        bounds = self.tables[index][name].value_bounds()
        if name == "signal":
            return bounds[[output - self.outputs[index].start]] * self.frame.target_unit[output] ** 2
        return bounds

    @property
    def _shift(self) -> float:
        """From internal units to the user's, for a loss of all rows."""
        return self.learned[0].statistics[0].n_rows * self.frame.log_unit(slice(None))

    def _values_in(self, frame: Frame, rows: Rows, index: int) -> dict[str, np.ndarray]:
        """A model's values in another frame's internal units; none if the inputs are others."""
        if len(frame.centre) != len(self.frame.centre):
            return {}
        outputs, values = self.outputs[index], self.learned[index].values
        points = values["inducing_points"]
        lowest, highest = rows.inputs.lowest, rows.inputs.highest
        if (points < 2.0 * lowest - highest).any() or (points > 2.0 * highest - lowest).any():
            return {}
        ratio = (self.frame.target_unit[outputs] / frame.target_unit[outputs]) ** 2
        return {
            "hyperparameters": values["hyperparameters"],
            "signal": values["signal"] * ratio,
            "noise": values["noise"] * ratio,
            "inducing_points": points,
        }
