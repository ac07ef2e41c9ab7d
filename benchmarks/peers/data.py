"""What peers learn: tables of the UCI repository, changes of state of four systems, and a made function with noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

import harness
from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics

# Rows of an exact GP.
SUBSET = 1500


class Sets(NamedTuple):
    """Training and test rows."""

    X: np.ndarray
    Y: np.ndarray
    X_test: np.ndarray
    Y_test: np.ndarray


def standardised(X: np.ndarray, y: np.ndarray, is_test: np.ndarray) -> Sets:
    """Inputs and target less the mean of the training rows, by their standard deviation."""
    sets = []
    for table in (X, y[:, np.newaxis]):
        train = table[~is_test]
        spread = train.std(axis=0)
        sets.append((table - train.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0))
    return Sets(*(table[rows] for rows in (~is_test, is_test) for table in sets))


def tabular(name: str, seed: int, folder: Path | None) -> Sets:
    """data.csv.gz has the target last, test_mask.csv.gz a column for each split."""
    if folder is None:
        raise SystemExit(f"{name} is read from a folder: give --data-folder, or other --datasets.")
    try:
        table, masks = (np.loadtxt(folder / name / f"{file}.csv.gz", delimiter=",") for file in ("data", "test_mask"))
    except OSError as error:
        raise SystemExit(f"--data-folder {folder} does not have {name}: {error}") from error
    if not seed < masks.shape[1]:
        raise SystemExit(f"{name} has splits 0 to {masks.shape[1] - 1}; got {seed}.")
    return standardised(table[:, :-1], table[:, -1], masks[:, seed] == 1.0)


def smooth(n_rows: int, seed: int, folder: Path | None) -> Sets:
    """Sums of waves of 8 columns; about 1 % of their variance is noise."""
    pieces = harness.noisy_waves(n_rows, 8, np.random.RandomState(seed))
    (X, y, _), (X_test, y_test, _) = (next(pieces) for _ in range(2))
    is_test = np.arange(2 * n_rows) >= n_rows
    return standardised(np.vstack([X, X_test]), np.concatenate([y, y_test]), is_test)


def dynamics(system: str, seed: int, folder: Path | None, **sizes: int) -> Sets:
    """The change of the state, in the units of the system."""
    X, Y, X_test, Y_test = (
        array
        for random_state in (seed, 1000 + seed)
        for array in make_dynamics(system, random_state=random_state, return_X_y=True, **sizes)
    )
    return Sets(X, Y - X[:, : Y.shape[1]], X_test, Y_test - X_test[:, : Y.shape[1]])


@dataclass(frozen=True)
class DataSet:
    """A data set, and the size of the model that learns it.

    Attributes
    ----------
    load : callable
        (seed, folder) -> `Sets`; of tables the seed is the number of the split.
    n_inducing : int
        Of systems that of the paper's VGP (its Table 2).
    max_iter : int
        The common limit of L-BFGS, per model.
    first_noise : float
        Where the noise of other peers than skevgp starts, in mean squares of the targets: at 1, which is GPflow's own,
        but for systems, whose data have hardly any noise.
    from_folder : bool
        Whether it is read from the folder that the user gives.
    several : bool
        Whether it has several outputs, which may share.
    """

    load: Callable[[int, Path | None], Sets]
    n_inducing: int
    max_iter: int = 120
    first_noise: float = 1.0
    from_folder: bool = False
    several: bool = False


DATASETS = {
    **{name: DataSet(partial(tabular, name), 256, from_folder=True) for name in ("airfoil", "elevators", "kin40k")},
    "smooth": DataSet(partial(smooth, 10_000), 256),
    **{
        name: DataSet(partial(dynamics, name), n_inducing, max_iter, first_noise=0.01, several=True)
        for name, n_inducing, max_iter in (
            ("pendulum", 40, 120),
            ("cartpole", 100, 120),
            ("acrobot", 250, 200),
            ("iiwa14", 500, 120),
        )
    },
}
QUICK = {
    "smooth": DataSet(partial(smooth, 200), 8, 20),
    "pendulum": DataSet(partial(dynamics, "pendulum", n_trajectories=5, n_steps=12), 8, 20, 0.01, several=True),
}


@dataclass(frozen=True)
class Data:
    """Training and test rows, and where all fits of a seed start."""

    sets: Sets
    inducing_points: np.ndarray
    lengthscales: np.ndarray

    @classmethod
    def of(cls, dataset: DataSet, seed: int, folder: Path | None) -> Data:
        sets = dataset.load(seed, folder)
        start = EVGPRegressor(n_inducing=dataset.n_inducing, sharing="all", max_iter=0, random_state=seed)
        kernel = np.ravel(start.fit(sets.X, sets.Y).kernel_)[0]
        return cls(sets, start.inducing_points_, np.broadcast_to(kernel.k2.length_scale, sets.X.shape[1]))

    def rows(self, exact: bool, seed: int) -> np.ndarray | slice:
        """The training rows that a peer gets."""
        if not exact or len(self.sets.X) <= SUBSET:
            return slice(None)
        return np.random.RandomState(seed).choice(len(self.sets.X), SUBSET, replace=False)
