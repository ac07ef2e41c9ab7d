"""Do libraries say the same? At fixed hyperparameters and inducing points bound and predictions must agree.

Each library is compared with dense matrices, in double precision and with the least jitter that it allows: the bound of
Titsias (2009), equation 9, and the prediction of its equation 6 with noise; an exact GP where all rows are inducing
points. `against_peers.py` does this before anything is timed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal

from peers import models
from peers.jobs import Fixed, Said

# Relative.
TOLERANCE = 1e-6
KERNELS = ("rbf", "matern52")


def cases() -> list[Fixed]:
    """Each kernel with 500 rows and 20 inducing points, and with 60 rows that are all inducing points."""
    made = []
    for kernel in KERNELS:
        for n, m in ((500, 20), (60, 60)):
            rng = np.random.RandomState(m)
            X, X_test = rng.uniform(-2.0, 2.0, (n, 3)), rng.uniform(-2.0, 2.0, (50, 3))
            y = np.sin(X).sum(axis=1) + 0.2 * rng.randn(n)
            points = X if m == n else rng.uniform(-2.0, 2.0, (m, 3))
            made.append(Fixed(kernel, X, y, X_test, points, np.array([0.6, 0.9, 1.2]), 1.7, 0.05))
    return made


def covariance(fixed: Fixed, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    r = cdist(A / fixed.lengthscales, B / fixed.lengthscales)
    if fixed.kernel == "rbf":
        return fixed.signal * np.exp(-0.5 * r**2)
    return fixed.signal * (1.0 + np.sqrt(5.0) * r + 5.0 / 3.0 * r**2) * np.exp(-np.sqrt(5.0) * r)


def expected(fixed: Fixed) -> Said:
    """By dense matrices of all rows."""
    Kmm = covariance(fixed, fixed.inducing_points, fixed.inducing_points)
    Kmn, Kms = (covariance(fixed, fixed.inducing_points, X) for X in (fixed.X, fixed.X_test))
    Q = Kmn.T @ np.linalg.solve(Kmm, Kmn)
    Q = 0.5 * (Q + Q.T)
    marginal = multivariate_normal(np.zeros(len(fixed.X)), Q + fixed.noise * np.eye(len(fixed.X)))
    bound = marginal.logpdf(fixed.y) - 0.5 * (fixed.signal - np.diagonal(Q)).sum() / fixed.noise
    precision = cho_factor(Kmm + Kmn @ Kmn.T / fixed.noise)
    mean = Kms.T @ cho_solve(precision, Kmn @ fixed.y) / fixed.noise
    explained = np.einsum("ms,ms->s", Kms, np.linalg.solve(Kmm, Kms) - cho_solve(precision, Kms))
    return Said(float(bound), mean, fixed.signal - explained + fixed.noise)


def difference(said: Said, expected: Said) -> float:
    """The largest of the relative differences of bound, means (in units of the largest) and variances."""
    return float(
        np.max(
            [
                abs(said.bound / expected.bound - 1.0),
                np.max(np.abs(said.mean - expected.mean)) / np.max(np.abs(expected.mean)),
                np.max(np.abs(said.variance / expected.variance - 1.0)),
            ]
        )
    )


def check(peers: Mapping[str, str], work: Callable[[str, str, Path, Path], None]) -> None:
    """Ask one peer of each library, and print by how much each differs.

    Parameters
    ----------
    peers : mapping
        Peer -> its interpreter.
    work : callable
        (interpreter, peer, folder of `Fixed`, folder for `Said`), runs a peer in a process of its own.

    Raises
    ------
    SystemExit
        If a library disagrees, by name.
    """
    asked: dict[str, str] = {}
    for peer in peers:
        if models.PEERS[peer].at_fixed:
            asked.setdefault(models.PEERS[peer].package, peer)
    fixed = cases()
    for package, peer in asked.items():
        with tempfile.TemporaryDirectory() as folder:
            given, said = Path(folder, "given"), Path(folder, "said")
            given.mkdir(), said.mkdir()
            for index, case in enumerate(fixed):
                case.save(given / f"{index}.npz")
            try:
                work(peers[peer], peer, given, said)
            except RuntimeError as problem:
                raise SystemExit(f"{package} failed at fixed hyperparameters: {problem}") from problem
            apart = {
                int(path.stem): difference(Said.load(path), expected(fixed[int(path.stem)])) for path in said.iterdir()
            }
        worst = max(apart, key=lambda index: np.nan_to_num(apart[index], nan=np.inf))
        if not apart[worst] <= TOLERANCE:
            raise SystemExit(
                f"{package} disagrees: {apart[worst]:.1e} from the dense matrices (kernel {fixed[worst].kernel}, "
                f"{len(fixed[worst].X)} rows, {len(fixed[worst].inducing_points)} inducing points, jitter "
                f"{models.PEERS[peer].jitter}); at most {TOLERANCE:g} is allowed. Nothing was timed."
            )
        print(
            f"{package} agrees with dense matrices to {apart[worst]:.0e} (jitter: {models.PEERS[peer].jitter})",
            flush=True,
        )
