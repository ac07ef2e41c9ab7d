"""Do intervals of masses and friction hold what is true, and are the torques of the identified arm right?

A simulated arm whose masses, centres of mass and inertias differ from the model's by up to 20 % (`perturb_robot`), with
Coulomb and viscous friction, follows two trajectories of half a minute at 100 Hz; torques have noise of 2 % of their
scatter. They are given as they are ("none"), or written to a file of which `load_log` makes data with a filter of 5 Hz.
`InverseDynamics` is then asked for weights whose posterior variance is below a quarter of the prior's (in
eigen-directions of the posterior, in units of the prior: what torques tell), and for torques on other trajectories.

Writes a row per run to a CSV as soon as it is done (what is there already is not run again), and a page beside it.

    python benchmarks/identification.py            # 50 runs, each without and with a filter: minutes of one core
    python benchmarks/identification.py --quick    # two runs of few rows: seconds
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))  # for what the scripts share

import numpy as np
from sklearn.utils import Bunch
from threadpoolctl import threadpool_limits

import harness
from harness import Row
from skevgp import InverseDynamics
from skevgp.datasets import load_log, load_robot, perturb_robot
from skevgp.features import RigidBodyRegressor

ROBOT, ERROR, NOISE = "ur10", 0.2, 0.02
FILTERS = {"none": None, "5 Hz": 5.0}
# Of trajectories: base frequency, rad/s, harmonics, seconds, step.
BASE, HARMONICS, SECONDS, STEP = 2.0 * np.pi * 0.03, 8, 30.0, 0.01
# Coulomb's friction, N m, and viscous, N m s/rad, as shares of the largest torque, but of no more than 100 N m.
FRICTION, LARGEST = (0.02, 0.1), 100.0
STICTION = RigidBodyRegressor().stiction_velocity
TOLD, INTERVAL = 0.25, 1.959963984540054  # a share of the prior's variance; 95 % in standard deviations


@dataclass(frozen=True)
class Cell:
    """One arm.

    Attributes
    ----------
    cutoff : str
        Of the filter.
    seed : int
    size : {"full", "quick"}
    """

    cutoff: str
    seed: int
    size: str


def trajectory(rng: np.random.Generator, n_joints: int, size: str) -> np.ndarray:
    """Rows [q, q̇, q̈] of sums of sines."""
    t = np.arange(0.0, SECONDS / (3.0 if size == "quick" else 1.0), STEP)
    waves = BASE * np.arange(1, HARMONICS + 1)
    a, b = rng.normal(size=(2, HARMONICS, n_joints)) / (1.5 * np.arange(1, HARMONICS + 1)[:, np.newaxis])
    sines, cosines = np.sin(np.outer(t, waves)), np.cos(np.outer(t, waves))
    q = sines @ a + cosines @ b
    v = (cosines * waves) @ a - (sines * waves) @ b
    return np.hstack([q, v, -(sines * waves**2) @ a - (cosines * waves**2) @ b])


def arm(cell: Cell) -> Bunch:
    """The model that is known, the true weights, and data; other trajectories, without noise and filter, as tests."""
    rng = np.random.default_rng(cell.seed)
    nominal = load_robot(ROBOT)
    true = perturb_robot(nominal, ERROR, random_state=cell.seed)
    largest = np.minimum(nominal.upperEffortLimit, LARGEST)
    viscous, coulomb = (rng.uniform(*FRICTION, nominal.nv) * largest for _ in range(2))
    links = np.concatenate([link.toDynamicParameters() for link in list(true.inertias)[1:]])
    zero = np.zeros(nominal.nv)
    weights = np.concatenate([links, viscous, coulomb, zero, zero])
    features = RigidBodyRegressor(true).fit(np.zeros((1, 3 * nominal.nv)))

    def rows(noise: float) -> tuple[np.ndarray, np.ndarray]:
        X = trajectory(rng, nominal.nv, cell.size)
        torque = features.transform(X) @ weights
        return X, torque + noise * torque.std(axis=0) * rng.normal(size=torque.shape)

    parts = [rows(NOISE) for _ in range(2)]
    if FILTERS[cell.cutoff] is not None:
        parts = [filtered(X, y, FILTERS[cell.cutoff]) for X, y in parts]
    train = [np.concatenate(one) for one in zip(*parts, strict=True)]
    groups = np.repeat(np.arange(len(parts)), [len(X) for X, _ in parts])
    test = [np.concatenate(one) for one in zip(*(rows(0.0) for _ in range(2)), strict=True)]
    return Bunch(nominal=nominal, weights=weights, data=train[0], target=train[1], groups=groups, test=test)


def filtered(X: np.ndarray, y: np.ndarray, cutoff: float | None) -> tuple[np.ndarray, np.ndarray]:
    """What becomes of a log: accelerations are not recorded."""
    n = y.shape[1]
    table = np.column_stack([STEP * np.arange(len(X)), X[:, : 2 * n], y])
    columns = {"time": 0, "position": range(1, n + 1), "velocity": range(n + 1, 2 * n + 1)}
    columns["effort"] = range(2 * n + 1, 3 * n + 1)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "log.csv"
        np.savetxt(file, table, delimiter=",")
        return load_log(file, columns=columns, dt=STEP, cutoff=cutoff, rest_velocity=0.0, return_X_y=True)


def root_of(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """C with C Cᵀ = covariance, of the columns that are not 0, and its pseudo-inverse."""
    scale = np.sqrt(np.diag(covariance))
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = eigenvalues > 1e-10 * eigenvalues.max()
    spread, vectors = np.sqrt(eigenvalues[kept]), vectors[:, kept]
    return scale[:, np.newaxis] * vectors * spread, (vectors / spread).T / scale


def told(arm: Bunch, model: InverseDynamics) -> tuple[np.ndarray, np.ndarray]:
    """Errors of what torques tell in standard deviations, and these as shares of the prior's."""
    _, covariance = model.feature_map_.coef_prior(arm.target.shape[1])
    _, whitening = root_of(covariance)
    variances, directions = np.linalg.eigh(whitening @ model.coef_cov_ @ whitening.T)
    std = np.sqrt(np.maximum(variances, 0.0))
    known = (variances < TOLD) & (variances > 0.0)
    error = directions.T @ whitening @ (model.coef_ - arm.weights)
    return error[known] / std[known], std[known]


def run(cell: Cell) -> dict[str, Any]:
    """Identify one arm; ``fit_seconds`` is processor time of one thread."""
    one = arm(cell)
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start = time.process_time()
        model = InverseDynamics(one.nominal, n_inducing=0).fit(one.data, one.target, groups=one.groups)
        seconds = time.process_time() - start
    z, width = told(one, model)
    X, truth = one.test
    H = model.feature_map_.transform(X)
    scatter = truth.std(axis=0)
    missed = rms(H @ model.coef_ - truth) / scatter
    # Without friction: what a model with the identified links alone would be asked for.
    links = 10 * truth.shape[1]
    of_links = H[:, :, :links] @ (model.coef_ - one.weights)[:links]
    return {
        **{name: getattr(cell, name) for name in Cell.__dataclass_fields__},
        "n_rows": len(one.data),
        "n_told": len(z),
        "covered": np.sum(np.abs(z) <= INTERVAL),
        "squares": np.sum(z**2),
        "width": np.median(width),
        "torque_error": np.sqrt(np.mean(missed**2)),
        "torque_error_worst": missed.max(),
        "links_error_worst": (rms(of_links) / scatter).max(),
        "cad_error_worst": (rms(H @ model.coef_prior_mean_ - truth) / scatter).max(),
        "correlation_time": np.mean(model.correlation_time_),
        "fit_seconds": seconds,
        **harness.provenance(),
    }


def rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(values**2, axis=0))


def say(row: dict[str, Any]) -> str:
    return f"{row['covered']} of {row['n_told']} hold, torques err by {row['torque_error_worst']:.2%}"


def line_of(rows: Sequence[Row], cutoff: str) -> list[str]:
    """Of all runs with a filter."""
    own = [row for row in rows if row["cutoff"] == cutoff]
    n, covered, squares = (harness.column(own, name) for name in ("n_told", "covered", "squares"))
    shares = covered / n
    errors = [harness.column(own, f"{name}_worst") for name in ("torque_error", "links_error", "cad_error")]
    return [
        cutoff,
        str(len(own)),
        f"{n.mean():.1f}",
        f"{covered.sum() / n.sum():.3f}",
        f"{shares.min():.2f} to {shares.max():.2f}",
        f"{np.sqrt(squares.sum() / n.sum()):.2f}",
        harness.figure_of(float(harness.column(own, "width").mean())),
        *(f"{np.median(error):.2%} ({error.max():.2%})" for error in errors),
        f"{harness.column(own, 'correlation_time').mean():.1f}",
        f"{harness.column(own, 'fit_seconds').mean():.1f}",
    ]


def paragraphs(rows: Sequence[Row]) -> list[str]:
    """The page: nothing if there are no rows."""
    if not rows:
        return []
    header = ["filter", "runs", "combinations", "within 95 %", "of runs", "rms z", "width"]
    header += ["torques", "links' torques", "CAD's torques", "correlation time", "seconds"]
    lines = [line_of(rows, cutoff) for cutoff in FILTERS if any(row["cutoff"] == cutoff for row in rows)]
    return [
        "# What is identified of a simulated arm",
        f"{ROBOT}, masses, centres of mass and inertias off by up to {ERROR:.0%}, Coulomb and viscous friction, noise "
        f"of {NOISE:.0%} of each torque's scatter; `InverseDynamics(n_inducing=0)` on two trajectories of "
        f"{SECONDS:g} s at {1.0 / STEP:g} Hz.",
        "Combinations: weights whose posterior variance is below a quarter of the prior's, in eigen-directions of the "
        "posterior in units of the prior; a run's number, and the share of all (combination, run) pairs whose interval "
        "of 95 % holds the truth; of runs the least and the largest share. z are their errors in posterior standard "
        "deviations, width the median of these over the prior's. Torques: rms error of the identified model on other "
        "trajectories, without noise, over the torque's scatter, of the worst joint: median over runs (largest). "
        "Links' torques are those without friction. Correlation time: rows that count as one, mean of the joints.",
        harness.table(header, lines),
        harness.provenance_text(rows),
    ]


def main() -> None:
    parser = harness.argument_parser(
        __doc__, quick="a third of the rows, two seeds", seeds="seeds 0, 1, ...; default: 50, of a quick run 2"
    )
    options = parser.parse_args()
    output, size = harness.output_path(options, "identification"), "quick" if options.quick else "full"
    n_seeds = options.seeds or (2 if options.quick else 50)
    cells = [Cell(cutoff, seed, size) for seed in range(n_seeds) for cutoff in FILTERS]
    n_failures = harness.run_missing(cells, run, output, options.jobs, say, since=options.since)
    harness.write_report(paragraphs([row for row in harness.read(output) if row["size"] == size]), output, n_failures)


if __name__ == "__main__":
    main()
