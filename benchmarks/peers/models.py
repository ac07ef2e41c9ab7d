"""One fit of one peer: reads a job from an .npz, fits, predicts, writes the result to another.

`against_peers.py` runs it, each fit in a process of its own, as the peers need another interpreter: GPflow asks for
NumPy 1, skevgp for NumPy 2. So nothing but NumPy is imported here until a peer asks for it.

    python benchmarks/peers/models.py "GPflow SGPR" job.npz result.npz

Given two folders it does so with models without anything to fit, for `agreement.py`. It keeps to two cores.

All peers get the same start: inducing points, lengthscales, signal variance. Their inputs are divided by their standard
deviation and their targets by their root mean square (no mean is subtracted: the prior mean is 0 for all), and bounds
are given in the units of the targets as they were.
"""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for what the scripts share

import numpy as np

from peers.jobs import Checkpoint, Fitted, Fixed, Job, Result, Said, Watch
from peers.libraries import with_gpflow, with_gpjax, with_gpytorch, with_skevgp, with_sklearn

# Of the times of two checkpoints.
STEP = 1.4


@dataclass(frozen=True)
class Peer:
    """How a peer is fitted.

    Attributes
    ----------
    modules : tuple of str
        Imported before the clock starts; the first one is the peer's.
    fit : callable
        (Job, Watch) -> Fitted
    at_fixed : callable, optional
        Fixed -> Said; None: there is nothing to compare with others.
    jitter : str
        What is said of it there.
    sharing : tuple of str
        What it can do.
    own_rule : bool
        Whether it ends by its own rule in place of the common limit on iterations.
    points : {"inducing", "rows", "none"}
        What it has: inducing points; all its rows, an exact GP, which gets a random subset; or it is no GP.
    """

    modules: tuple[str, ...]
    fit: Callable[[Job, Watch], Fitted]
    at_fixed: Callable[[Fixed], Said] | None = None
    jitter: str = ""
    sharing: tuple[str, ...] = ("none",)
    own_rule: bool = False
    points: str = "inducing"

    @property
    def package(self) -> str:
        """An interpreter that has it can run the peer."""
        return self.modules[0].partition(".")[0]


_SKEVGP = with_skevgp.MODULES, with_skevgp.fit, with_skevgp.at_fixed, with_skevgp.JITTER
_GPFLOW = with_gpflow.at_fixed, with_gpflow.JITTER
_GPJAX = with_gpjax.at_fixed, with_gpjax.JITTER
_GPYTORCH = with_gpytorch.at_fixed, with_gpytorch.JITTER
_GPR = with_sklearn.GPR_MODULES, with_sklearn.fit_gpr, with_sklearn.at_fixed, with_sklearn.JITTER
PEERS = {
    "skevgp": Peer(*_SKEVGP, ("default", "none", "all"), own_rule=True),
    "skevgp, same limit": Peer(*_SKEVGP, ("default", "none")),
    "GPflow SGPR": Peer(with_gpflow.MODULES, with_gpflow.fit, *_GPFLOW, ("none", "all")),
    "GPJax SGPR": Peer(with_gpjax.MODULES, with_gpjax.fit, *_GPJAX),
    "GPyTorch SGPR": Peer(with_gpytorch.MODULES, lambda job, watch: with_gpytorch.fit(job, watch, False), *_GPYTORCH),
    "GPyTorch SVGP": Peer(with_gpytorch.MODULES, lambda job, watch: with_gpytorch.fit(job, watch, True)),
    "scikit-learn GPR": Peer(*_GPR, ("none", "all"), points="rows"),
    "scikit-learn HistGradientBoosting": Peer(("sklearn.ensemble", "scipy"), with_sklearn.fit_trees, points="none"),
    "scikit-learn BayesianRidge": Peer(("sklearn.linear_model", "scipy"), with_sklearn.fit_linear, points="none"),
}


def run(peer: str, job: Job) -> Result:
    """Fit and predict; the clock runs from handing over the arrays to the fitted model."""
    for name in PEERS[peer].modules:
        import_module(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        watch = Watch(job.time_limit, 1 if job.sharing == "all" else job.Y.shape[1])
        fitted = PEERS[peer].fit(job, watch)
        bound = sum(fitted.bounds) if fitted.bounds else np.nan
        end = Checkpoint(watch.seconds, watch.cpu_seconds, bound, fitted.predict)
        begin = time.perf_counter()
        predictions = [fitted.predict(job.X_test)]
        predict_seconds = time.perf_counter() - begin
        points = [end]
        for k in range(job.n_checkpoints if fitted.at else 0):
            point = fitted.at(end.seconds / STEP ** (k + 1))
            if point.seconds == points[-1].seconds:  # there was nothing before
                break
            if point.seconds > points[-1].seconds:  # a fit of its own, which other work on the machine held up
                continue
            points.append(point)
            predictions.append(point.predict(job.X_test))
    packages = [import_module(name.partition(".")[0]) for name in (*PEERS[peer].modules, "numpy")]
    mean, std = (np.array(part) for part in zip(*predictions, strict=True))
    return Result(
        mean,
        std,
        *(np.array([point[i] for point in points]) for i in range(3)),
        predict_seconds,
        fitted.iterations,
        fitted.evaluations,
        np.array(fitted.bounds),
        fitted.stop,
        np.empty((3, 0)) if fitted.curve is None else fitted.curve,
        " ".join(f"{package.__name__} {package.__version__}" for package in packages),
    )


def main() -> None:
    if len(sys.argv) != 4:
        raise SystemExit(f"usage: {Path(__file__).name} PEER JOB RESULT (started by against_peers.py)")
    name, given, result = sys.argv[1], *map(Path, sys.argv[2:])
    if name not in PEERS:
        raise SystemExit(f"error: unknown peer {name!r}; known: {', '.join(PEERS)}.")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    if not given.is_dir():
        run(name, Job.load(given)).save(result)
        return
    for path in sorted(given.iterdir()):
        fixed = Fixed.load(path)
        if fixed.exact or PEERS[name].points != "rows":
            PEERS[name].at_fixed(fixed).save(result / path.name)


if __name__ == "__main__":
    main()
