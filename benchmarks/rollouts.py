"""How far ahead does a learned model see, and does it know how far?

Rollouts of 100 steps from initial states and with inputs that were not seen, against the true states: position errors
of the mean fed back and of the particles' mean, shares of the truths within ±1, ±2 and ±3 standard deviations (CR-1 to
CR-3) and the continuous ranked probability score (CRPS), after 1, 10, 50 and 100 steps. Data are the paper's, without
noise and with noise of 1 % of each state's scatter on the states, which are inputs and targets; all of them, and a
tenth. The arm iiwa14 learns from its moves of 50 steps, and is tested on slower ones of 100. Writes rows per fit to a
CSV as soon as it is done (what is there already is not fitted again), and a page beside it.

    python benchmarks/rollouts.py                    # three systems, five models, two seeds: hours of one core
    python benchmarks/rollouts.py --models EVGP-IFG  # one model: twenty minutes
    python benchmarks/rollouts.py --systems iiwa14 --models EVGP-IFG  # not among the three
    python benchmarks/rollouts.py --quick            # the pendulum, few rows and particles: a minute
"""

from __future__ import annotations

import itertools
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))  # for what the scripts share

import numpy as np
from scipy.stats import norm
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils import Bunch
from threadpoolctl import threadpool_limits

import harness
from harness import Row
from paper.models import Fit, build, fitted_part, groups_of
from skevgp import rollout
from skevgp.datasets import make_dynamics

# The EVGPs' inducing points; the others have the paper's number.
SYSTEMS = {"pendulum": (10,), "cartpole": (60, 150), "acrobot": (150,), "iiwa14": (350,)}
DEFAULT_SYSTEMS = ("pendulum", "cartpole", "acrobot")
# Angles go round: a GP alone, which predicts them themselves and not how they change, cannot have them encoded.
MODELS = {
    "EVGP-IFG": "skevgp-angles",
    "EVGP-IF": "skevgp-angles",
    "RES-VGP": "skevgp-angles",
    "VGP": "skevgp",
    "RES-DBNN": "skevgp-angles",
}
MAIN = "EVGP-IFG"
NOISES, SHARES = ("0.0", "0.01"), ("1", "0.1")
HORIZONS = (1, 10, 50, 100)
TEST_TRAJECTORIES, PARTICLES, ITERATIONS = 40, 100, 300
# How each is called, and what rollout is told.
METHODS: dict[str, dict[str, str]] = {
    "consistent": {},
    "consistent, no noise": {"process_noise": "none"},
    "independent": {},
    "linearized": {"method": "linearized"},
    "mean": {"method": "mean"},
}


@dataclass(frozen=True)
class Cell:
    """One fit.

    Attributes
    ----------
    system, model : str
    n_inducing : int
        0 of a network.
    noise : str
        Of the states, in units of their scatter.
    share : str
        Of the paper's trajectories.
    seed : int
    size : {"full", "quick"}
    max_iter : int
    """

    system: str
    model: str
    n_inducing: int
    noise: str
    share: str
    seed: int
    size: str
    max_iter: int = field(compare=False)


class Independent(RegressorMixin, BaseEstimator):
    """A fitted regressor of which only predictions are known, so that each step is drawn anew."""

    def __init__(self, regressor: Any):
        self.regressor = regressor
        self.n_features_in_ = regressor.n_features_in_

    def fit(self, X: Any, y: Any) -> Independent:
        return self

    def predict(self, X: np.ndarray, return_std: bool = False) -> Any:
        return self.regressor.predict(X, return_std=return_std)


def data(cell: Cell) -> tuple[Bunch, Bunch]:
    """What to learn from, and true trajectories of other states and inputs."""
    n_test = 4 if cell.size == "quick" else TEST_TRAJECTORIES
    everything = make_dynamics(
        cell.system, random_state=cell.seed, noise=float(cell.noise), input_noise=float(cell.noise)
    )
    n_train = round(float(cell.share) * len(everything.trajectories))
    rows = everything.groups < (min(n_train, 6) if cell.size == "quick" else n_train)
    train = Bunch(
        data=everything.data[rows],
        target=everything.target[rows],
        groups=everything.groups[rows],
        scatter=everything.trajectories.reshape(-1, everything.target.shape[1]).std(axis=0),
    )
    return train, make_dynamics(cell.system, n_test, HORIZONS[-1], random_state=1000 + cell.seed)


def particles_of(model: str) -> str:
    """How its particles go: of a network no function can be followed."""
    return "independent" if model == "RES-DBNN" else "consistent"


def methods_of(model: str) -> list[str]:
    """All of the main model, what the page shows of others."""
    return list(METHODS) if model == MAIN else [particles_of(model), "mean"]


def crps_of_samples(truth: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """The score of samples (n, ...), of which no number makes it better or worse on average (Ferro 2014)."""
    n = len(samples)
    ranks = 2.0 * np.arange(n) - n + 1.0
    spread = np.tensordot(ranks, np.sort(samples, axis=0), axes=1) / (n * (n - 1))
    return np.abs(samples - truth).mean(axis=0) - spread


def crps_of_normal(truth: np.ndarray, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """The score of a normal distribution (Gneiting & Raftery 2007)."""
    z = (truth - mean) / std
    return std * (z * (2.0 * norm.cdf(z) - 1.0) + 2.0 * norm.pdf(z) - 1.0 / np.sqrt(np.pi))


def measures(truth: np.ndarray, ahead: Bunch, step: int, scatter: np.ndarray) -> dict[str, float]:
    """After so many steps; the states of truth (n, steps, 2 n_joints), positions first, have this scatter."""
    true, mean, std = (values[:, step - 1] / scatter for values in (truth, ahead.mean, ahead.std))
    errors, n_joints = np.abs(true - mean), len(scatter) // 2
    positions = np.sqrt(np.mean(errors[:, :n_joints] ** 2, axis=1))
    if "samples" in ahead:
        crps = crps_of_samples(true, np.moveaxis(ahead.samples[:, :, step - 1], 1, 0) / scatter)
    else:
        crps = crps_of_normal(true, mean, std)
    return {
        "error_median": np.median(positions),
        "error_p90": np.quantile(positions, 0.9),
        **{f"cr{k}": np.mean(errors <= k * std) for k in (1, 2, 3)},
        "crps": crps.mean(),
        # .674 if errors are as large as they are said to be.
        "errors_in_std": np.median(errors / std),
    }


def run(cell: Cell) -> list[dict[str, Any]]:
    """Fit one model, and roll it out in all ways; ``fit_seconds`` is processor time of one thread."""
    train, test = data(cell)
    model = build(Fit(cell.system, cell.model, MODELS[cell.model], cell.seed, cell.size, cell.max_iter))
    if cell.n_inducing:
        model.set_params(**{"regressor__n_inducing" if cell.model == "RES-VGP" else "n_inducing": cell.n_inducing})
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start = time.process_time()
        model.fit(train.data, train.target, **groups_of(model, train))
        seconds = time.process_time() - start
        found = {method: rolled_out(model, method, test, cell) for method in methods_of(cell.model)}
    fitted = fitted_part(model)
    common = {
        "n_rows": len(train.data),
        "n_iter": fitted.n_iter_,
        "noise_std": np.median(np.sqrt(fitted.noise_variance_) / train.scatter),
        "fit_seconds": seconds,
    }
    return [
        {
            **{name: getattr(cell, name) for name in Cell.__dataclass_fields__ if name != "max_iter"},
            **{"method": method, "steps": step},
            **measures(test.trajectories[:, 1:], ahead, step, train.scatter),
            **common,
            "rollout_seconds": taken,
            "max_iter": cell.max_iter,
            **harness.provenance(),
        }
        for method, (ahead, taken) in found.items()
        for step in HORIZONS
    ]


def rolled_out(model: Any, method: str, test: Bunch, cell: Cell) -> tuple[Bunch, float]:
    """The rollout, NaN if the learned system is unstable, and processor seconds."""
    n, n_states = len(test.trajectories), test.target.shape[1]
    inputs = test.data[:, n_states:].reshape(n, -1, test.data.shape[1] - n_states)
    options = {"n_samples": 10 if cell.size == "quick" else PARTICLES, "random_state": cell.seed, **METHODS[method]}
    start = time.process_time()
    try:
        ahead = rollout(
            Independent(model) if method == "independent" else model, test.trajectories[:, 0], inputs, **options
        )
    except ValueError as problem:
        if "unstable" not in str(problem):
            raise
        nothing = np.full(test.trajectories[:, 1:].shape, np.nan)
        ahead = Bunch(mean=nothing, std=nothing)
    return ahead, time.process_time() - start


def say(rows: list[dict[str, Any]]) -> str:
    last = {row["method"]: row for row in rows if row["steps"] == HORIZONS[-1]}
    return (
        f"after {HORIZONS[-1]} steps the mean errs by {last['mean']['error_median']:.2g}, "
        f"CR-2 {last[particles_of(rows[0]['model'])]['cr2']:.2f}, {rows[0]['fit_seconds']:.1f} s"
    )


Setting = tuple[str, ...]  # system, inducing points, model, noise, share


def setting_of(row: Row) -> Setting:
    return tuple(row[name] for name in ("system", "n_inducing", "model", "noise", "share"))


def settings_of(rows: Sequence[Row]) -> list[Setting]:
    """In the order in which they are looked at, networks last."""
    orders = list(SYSTEMS), list(MODELS), list(NOISES), list(SHARES)

    def place(setting: Setting) -> tuple[int, ...]:
        system, m, model, noise, share = setting
        known = zip(orders, (system, model, noise, share), strict=True)
        first, *others = (order.index(name) for order, name in known)
        return (first, int(m) or sys.maxsize, *others)

    return sorted({setting_of(row) for row in rows}, key=place)


def name_of(setting: Setting) -> list[str]:
    """In words, the cells of a line."""
    system, m, model, noise, share = setting
    return [f"{system} m={m}" if int(m) else system, model, *data_of(noise, share)]


def data_of(noise: str, share: str) -> list[str]:
    return [f"{100 * float(noise):g} %" if float(noise) else "none", share]


def values(rows: Sequence[Row], setting: Setting, method: str, name: str) -> np.ndarray:
    """(n_seeds, n_horizons)."""
    own = [row for row in rows if setting_of(row) == setting and row["method"] == method]
    return np.array([harness.column([row for row in own if int(row["steps"]) == step], name) for step in HORIZONS]).T


def error_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Of a table: medians and 90th percentiles of the mean fed back, medians of the particles' mean."""
    for setting in settings_of(rows):
        median, p90 = (values(rows, setting, "mean", name).mean(axis=0) for name in ("error_median", "error_p90"))
        sampled = values(rows, setting, particles_of(setting[2]), "error_median").mean(axis=0)
        yield [
            *name_of(setting),
            str(len(values(rows, setting, "mean", "crps"))),
            *(f"{harness.figure_of(a)} ({harness.figure_of(b)})" for a, b in zip(median, p90, strict=True)),
            *map(harness.figure_of, sampled[[0, -1]]),
        ]


def band_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Of a table: CR-2 and CRPS of each method with a band of many steps; of other models of the particles only."""
    for setting in settings_of(rows):
        for method in list(METHODS)[:-1] if setting[2] == MAIN else [particles_of(setting[2])]:
            cr2, crps = (values(rows, setting, method, name).mean(axis=0) for name in ("cr2", "crps"))
            yield [*name_of(setting), method, *(f"{value:.2f}" for value in cr2), *map(harness.figure_of, crps)]


def promise_lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Of a table: in how many fits of the main model bands hold, and particles score no worse than others."""
    for noise, share, method in itertools.product(NOISES, SHARES, ("consistent", "consistent, no noise")):
        own = [row for row in rows if (row["noise"], row["share"], row["model"]) == (noise, share, MAIN)]
        if not own:
            continue
        cr2, crps, others = (
            np.vstack([values(own, setting, of, name) for setting in settings_of(own)])
            for of, name in ((method, "cr2"), (method, "crps"), ("independent", "crps"))
        )
        most = 0.99 if float(noise) else 1.0
        said = f"CR-2 from 0.9 to {most:g}"
        for name, held in ((said, (cr2 >= 0.9) & (cr2 <= most)), ("CRPS no worse than independent", crps <= others)):
            yield [*data_of(noise, share), method, name, *(f"{n} of {len(held)}" for n in held.sum(axis=0))]


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page."""
    if not rows:
        return []
    steps = [str(step) for step in HORIZONS]
    said = (
        "Means over seeds. Errors are of positions, relative to their scatter; CRPS is of all "
        "states, relative to theirs. Noise is on the states, inputs and targets, in units of their scatter; what is "
        "predicted are the true states. Share is of the paper's trajectories. Angles are encoded but of the VGP."
    )
    bands = (
        "Particles follow a function of the posterior each (consistent; no noise: without the learned noise as "
        "process noise), or draw each step anew (independent). CR-2 should be .954."
    )
    setting = ["", "model", "noise", "share"]
    columns = [f"after {step}" for step in steps]
    of_bands = [*(f"CR-2: {step}" for step in steps), *(f"CRPS: {step}" for step in steps)]
    parts = [
        "# Many steps ahead",
        said,
        "## Position errors: median (90th percentile) of the mean fed back",
        harness.table([*setting, "seeds", *columns, "particles' mean: 1", steps[-1]], error_lines(rows)),
        "## Do the bands hold?",
        bands,
        harness.table([*setting, "particles", *of_bands], band_lines(rows)),
    ]
    promises = list(promise_lines(rows))
    if promises:
        header = [*setting[2:], "particles", "", *columns]
        parts += [f"In how many fits of {MAIN} ...", harness.table(header, promises)]
    iterations = ", ".join(sorted({row["max_iter"] for row in rows}))
    return [*parts, f"max_iter: {iterations}. {harness.provenance_text(rows)}"]


def main() -> None:
    parser = harness.argument_parser(
        __doc__,
        quick="the pendulum, 6 trajectories, few particles and iterations, one seed",
        seeds="seeds 0, 1, ...; default: 2, of a quick run 1",
        systems=SYSTEMS,
        default_systems=DEFAULT_SYSTEMS,
    )
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS), help="default: all")
    options = parser.parse_args()
    output, size = harness.output_path(options, "rollouts"), "quick" if options.quick else "full"
    n_seeds = (1 if options.quick else 2) if options.seeds is None else options.seeds
    systems = options.systems[:1] if options.quick else options.systems
    iterations = 20 if options.quick else ITERATIONS
    # The largest come last, and other seeds after all systems.
    cells = [
        Cell(system, model, m, noise, share, seed, size, iterations)
        for seed, model, number in itertools.product(range(n_seeds), options.models, (0, 1))
        for system in systems
        for m in sizes(system, model)[number : number + 1]
        for noise, share in itertools.product(NOISES, SHARES)
    ]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    harness.write_report(paragraphs([row for row in harness.read(output) if row["size"] == size]), output, n_failures)


def sizes(system: str, model: str) -> tuple[int, ...]:
    """Inducing points."""
    if model.startswith("EVGP"):
        return SYSTEMS[system]
    if model == "RES-DBNN":
        return (0,)
    regressor = build(Fit(system, model, MODELS[model], 0, "full", 0))
    return (getattr(regressor, "regressor", regressor).n_inducing,)


if __name__ == "__main__":
    main()
