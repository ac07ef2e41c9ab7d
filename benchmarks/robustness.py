"""Does a fit ever fail, is its jitter well chosen, does it depend on luck, and where should inducing points start?

Writes one row per fit to a CSV (fits that are there already are not repeated) and prints a summary of each part.

    python benchmarks/robustness.py                  # everything: an hour or two on one core
    python benchmarks/robustness.py --parts nasty    # 500 random data sets: no error, no NaN, std > 0
    python benchmarks/robustness.py --parts jitter   # the noise-free ones of them against fixed jitters
    python benchmarks/robustness.py --parts seeds    # ten random states on the same data: spread, collapse; restarts
                                                     # where the bounds spread by more than 2 %
    python benchmarks/robustness.py --parts inducing # k-means against greedy conditional variance
    python benchmarks/robustness.py --quick          # a few of each
"""

from __future__ import annotations

import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.preprocessing import PolynomialFeatures

import harness
import internals
from skevgp import EVGPRegressor
from skevgp.datasets import make_dynamics
from skevgp.exceptions import DependentRowsWarning
from skevgp.features import InertiaForce, InertiaForceGravity
from skevgp.solvers import LBFGS

PARTS = ("nasty", "jitter", "seeds", "inducing")
COLUMNS = ["part", "case", "variant", "seed", "outcome", "bound_per_row", "gain_per_row", "error", "noise_share"]
COLUMNS += ["n_iter", "seconds", "versions", "machine"]
FIXED_JITTERS = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
# Errors below this share of the target's standard deviation count as equal.
ERROR_FLOOR = 1e-9
# Where the final bounds of the ten seeds differ by less, restarts are not tried.
CLOSE = 0.02
# Iterations of the cartpole's fits, which would otherwise take minutes each.
CARTPOLE_ITERATIONS = 150
DIMENSIONS, NOISES = tuple(range(1, 11)), (0.0, 1e-3, 0.1)


@dataclass(frozen=True)
class Data:
    """A training and a test set, and how to fit the first.

    Attributes
    ----------
    X, Y, X_test, Y_test : ndarray
    arguments : dict
        Of EVGPRegressor.
    case : str
        What is special about it.
    noise_free : bool
        Whether Y is a smooth function of X and nothing else.
    """

    X: np.ndarray
    Y: np.ndarray
    X_test: np.ndarray
    Y_test: np.ndarray
    arguments: dict[str, Any]
    case: str
    noise_free: bool = False


def nasty(seed: int) -> Data:
    """A random data set with some of everything that breaks Cholesky factorisations."""
    rng = np.random.RandomState(seed)
    n, d, o = int(rng.choice([1, 2, 3, 7, 20, 60, 150, 300])), rng.randint(1, 6), rng.randint(1, 4)
    notes, n_all = [f"n{n}", f"d{d}", f"o{o}"], n + 100

    def sometimes(note: str, probability: float) -> bool:
        happens = bool(rng.rand() < probability)
        if happens:
            notes.append(note)
        return happens

    latent = rng.randn(n_all, d)
    if sometimes("heavy-tails", 0.15):
        latent = rng.standard_t(1.5, (n_all, d))
    if sometimes("integers", 0.15):
        latent = np.round(2.0 * latent)
    if sometimes("constant-column", 0.15):
        latent[:, 0] = latent[0, 0]
    if sometimes("copied-column", 0.15):
        latent[:, -1] = latent[:, 0]
    if sometimes("copied-rows", 0.2):
        latent[:n] = latent[rng.randint(0, max(1, n // 4), n)]
    scale = 10.0 ** rng.uniform(-12, 12, d) if sometimes("X-scales", 0.3) else np.ones(d)
    offset = 1e8 if sometimes("X-offset", 0.15) else 0.0
    X = scale * latent + offset
    # What is left of the latent inputs after rounding, so that targets are functions of X as it is given.
    latent = (X - offset) / scale
    kind = ("waves", "linear", "bump", "constant", "nothing")[rng.choice(5, p=[0.4, 0.2, 0.2, 0.1, 0.1])]
    notes.append(kind)
    direction = rng.randn(d, o) / np.sqrt(d)
    Y = {
        "waves": np.sin(1.5 * latent @ direction),
        "linear": latent @ direction,
        "bump": np.exp(-0.5 * (latent @ direction) ** 2),
        "constant": np.full((n_all, o), 5.0),
        "nothing": rng.randn(n_all, o),
    }[kind]
    noisy = kind == "nothing" or sometimes("noise", 0.4)
    outliers = sometimes("outliers", 0.1)
    if noisy and kind != "nothing":
        Y[:n] += 0.1 * rng.randn(n, o)
    if outliers:
        Y[rng.randint(n, size=max(1, n // 50))] += 1e3
    if sometimes("Y-scales", 0.3):
        Y = Y * 10.0 ** rng.uniform(-12, 12, o)
    if sometimes("Y-offset", 0.1):
        Y = Y + 1e8
    arguments = {
        "feature_map": [None, PolynomialFeatures(1), PolynomialFeatures(2)][rng.randint(3)],
        "n_inducing": int(rng.choice([1, 5, 10, 20])),
        "inducing_init": str(rng.choice(["k-means", "greedy"])),
        "sharing": str(rng.choice(["all", "kernel", "none"])),
        "solver": LBFGS(posterior=str(rng.choice(["full", "diagonal"]))),
        "normalize_y": bool(rng.rand() < 0.5),
    }
    notes += [str(value) for value in arguments.values()]
    return Data(X[:n], Y[:n], X[n:], Y[n:], arguments, " ".join(notes), not noisy and not outliers)


def smooth(dimension: int, noise: float, seed: int) -> Data:
    """1000 rows of a smooth function of 1 to 10 columns, of unit variance."""
    rng = np.random.RandomState(1000 * seed + dimension)
    X = rng.uniform(-1, 1, (2000, dimension))
    directions, phases = rng.randn(20, dimension) * 2.0 / np.sqrt(dimension), rng.uniform(0, 2 * np.pi, 20)
    y = np.sin(X @ directions.T + phases) @ rng.randn(20)
    y = (y - y.mean()) / y.std()
    observed = y[:1000] + noise * rng.randn(1000)
    return Data(X[:1000], observed, X[1000:], y[1000:], {"n_inducing": 50}, f"smooth-{dimension}d-noise-{noise:g}")


def dynamics(system: str, name: str, seed: int) -> Data:
    """A training set and a test set of a simulated system, with the paper's inducing points (its Table 2)."""
    train, test = make_dynamics(system, random_state=seed), make_dynamics(system, random_state=1000 + seed)
    features = {"IF": InertiaForce(system), "IFG": InertiaForceGravity(system)}.get(name)
    n_outputs = train.target.shape[1]
    n_inducing = {"pendulum": (40, 10), "cartpole": (100, 60)}[system][features is not None]
    residual = train.data[:, :n_outputs], test.data[:, :n_outputs]
    if name != "RES-VGP":
        residual = np.zeros_like(residual[0]), np.zeros_like(residual[1])
    return Data(
        train.data,
        train.target - residual[0],
        test.data,
        test.target - residual[1],
        {"feature_map": features, "n_inducing": n_inducing, "noise_cv": None}
        | ({"max_iter": CARTPOLE_ITERATIONS} if system == "cartpole" else {}),
        f"{system}-{name}",
    )


def noise_alone(data: Data, target: np.ndarray) -> np.ndarray:
    """Noise variance of each output if features and noise were to explain everything: the collapsed state."""
    features, left_over = data.arguments.get("feature_map"), target - target.mean(axis=0)
    if features is not None:
        H = features.fit_transform(data.X, target)
        left_over = left_over - H @ np.linalg.lstsq(H, left_over, rcond=None)[0]
    # A target that the features explain is never explained better than it is rounded.
    return np.maximum(left_over.var(axis=0), 1e-30 * np.maximum(np.abs(target).max(axis=0), 1e-12) ** 2)


def fit(data: Data, seed: int, **arguments: Any) -> dict[str, Any]:
    """Fit and look at what comes out; what fails is the outcome."""
    start = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for category in (ConvergenceWarning, DependentRowsWarning):
                warnings.simplefilter("ignore", category)
            model = EVGPRegressor(random_state=seed, **{**data.arguments, **arguments}).fit(data.X, data.Y)
            seconds = time.perf_counter() - start
            mean, std = model.predict(data.X_test, return_std=True)
    except Exception as problem:  # what fails is what is looked for
        where = traceback.extract_tb(problem.__traceback__)[-1]
        return {"outcome": f"{type(problem).__name__} in {Path(where.filename).name}:{where.lineno}: {problem}"[:200]}
    finite = np.isfinite(mean).all() and np.isfinite(std).all() and np.isfinite(model.lower_bound_)
    outcome = "not finite" if not finite else "ok" if (std > 0.0).all() else "std of 0"
    target = data.Y.reshape(len(data.Y), -1)
    # Of a target that does not vary, rounding is the unit.
    unit = np.maximum(target.std(axis=0), 1e-14 * np.abs(target).max(axis=0))
    errors = (data.Y_test.reshape(-1, len(unit)) - mean.reshape(-1, len(unit))) / np.where(unit > 0.0, unit, 1.0)
    left_over = noise_alone(data, target)
    bound = model.lower_bound_ / len(data.X)
    return {
        "outcome": outcome,
        "bound_per_row": bound,
        "gain_per_row": bound + 0.5 * (1.0 + np.log(2.0 * np.pi * left_over)).sum(),
        "error": np.linalg.norm(errors, axis=1).mean(),
        "noise_share": np.max(model.noise_variance_ / left_over),
        "n_iter": model.n_iter_,
        "seconds": seconds,
    }


def fixed_jitter(data: Data, seed: int, jitter: float, **arguments: Any) -> dict[str, Any]:
    """`fit` with another relative jitter of k(X_m, X_m)."""
    with internals.with_jitter(jitter):
        return fit(data, seed, **arguments)


def spread(rows: list[dict[str, Any]], case: str, variant: str) -> float:
    """Range of a case's bounds, relative to what they gain over noise alone: a measure without a unit."""
    gains = [
        float(row["gain_per_row"])
        for row in rows
        if (row["part"], row["case"], row["variant"], row["outcome"]) == ("seeds", case, variant, "ok")
    ]
    return float(np.ptp(gains) / abs(np.median(gains))) if gains else 0.0


def jobs(part: str, quick: bool, restarts: int, rows: list[dict[str, Any]]) -> Iterator[tuple[str, str, int, Any]]:
    """(case, variant, seed, a function of nothing that fits) of each fit of a part; ``rows`` are those done so far."""
    limit = {"max_iter": 20} if quick else {}
    if part in ("nasty", "jitter"):
        for seed in range(6 if quick else 500):
            data = nasty(seed)
            if part == "nasty":
                yield data.case, "max_iter=100", seed, lambda data=data, seed=seed: fit(data, seed, max_iter=100)
            elif data.noise_free and len(data.X) >= 20:
                yield data.case, "default", seed, lambda data=data, seed=seed: fit(data, seed, **limit)
                for jitter in FIXED_JITTERS:
                    run = lambda data=data, seed=seed, jitter=jitter: fixed_jitter(data, seed, jitter, **limit)  # noqa: E731
                    yield data.case, f"jitter={jitter:g}", seed, run
        return
    cases: list[tuple[str, Any]] = [
        (f"pendulum-{name}", lambda seed, name=name: dynamics("pendulum", name, seed))
        for name in (() if quick else ("VGP", "RES-VGP", "IF", "IFG"))
    ]
    if part == "inducing" and not quick:
        cases += [
            (f"cartpole-{name}", lambda seed, name=name: dynamics("cartpole", name, seed)) for name in ("VGP", "IFG")
        ]
    cases += [
        (f"smooth-{d}d-noise-{noise:g}", lambda seed, d=d, noise=noise: smooth(d, noise, seed))
        for d in (DIMENSIONS[:2] if quick else DIMENSIONS)
        for noise in (NOISES[1:2] if quick else NOISES)
    ]
    variants: dict[str, dict[str, Any]] = {
        "seeds": {"n_restarts=0": {}, f"n_restarts={restarts}": {"solver": LBFGS(restarts)}},
        "inducing": {"k-means": {"inducing_init": "k-means"}, "greedy": {"inducing_init": "greedy"}},
    }[part]
    for variant, arguments in variants.items():
        for case, make in cases:
            if variant.startswith("n_restarts=") and arguments and spread(rows, case, "n_restarts=0") < CLOSE:
                continue
            for seed in range(2 if quick else {"seeds": 10, "inducing": 5}[part]):

                def run(make: Any = make, seed: int = seed, arguments: dict[str, Any] = arguments) -> dict[str, Any]:
                    # Of the seeds' part, the data are always the same.
                    return fit(make(0 if part == "seeds" else seed), seed, **arguments, **limit)

                yield case, variant, seed, run


def summary(part: str, rows: list[dict[str, Any]]) -> None:
    """Print what the rows of a part say."""
    bad = [row for row in rows if row["outcome"] != "ok"]
    print(f"\n{part}: {len(rows)} fits, {len(bad)} failures")
    for row in bad:
        print(f"  {row['case']} | {row['variant']} | seed {row['seed']}: {row['outcome']}")
    good = [row for row in rows if row["outcome"] == "ok"]

    def of(name: str, **where: str) -> np.ndarray:
        return np.array([float(row[name]) for row in good if all(row[key] == where[key] for key in where)])

    cases = list(dict.fromkeys(row["case"] for row in good))
    variants = list(dict.fromkeys(row["variant"] for row in good))
    if part == "jitter":
        by_set: dict[str, dict[str, float]] = {}
        for row in good:
            error = max(float(row["error"]), ERROR_FLOOR)
            by_set.setdefault(row["seed"], {})[row["variant"]] = error
        whole = {seed: errors for seed, errors in by_set.items() if len(errors) == 1 + len(FIXED_JITTERS)}
        print(f"  {'':14s} {'median':>9} {'90 %':>9} {'max':>9}   sets above 1.1, of {len(whole)}")
        for variant in variants:
            ratio = np.array(
                [
                    errors[variant] / min(error for name, error in errors.items() if name != "default")
                    for errors in whole.values()
                ]
            )
            print(
                f"  {variant:14s} {np.median(ratio):9.3f} {np.quantile(ratio, 0.9):9.3f} {ratio.max():9.3g}   "
                f"{(ratio > 1.1).sum()}"
            )
    elif part in ("seeds", "inducing"):
        print(
            f"  {'case':22s} {'variant':13s} {'bound/row: min':>15} {'median':>9} {'max':>9} {'spread':>8} "
            f"{'error':>10} {'noise share':>12} {'seconds':>8}"
        )
        for case in cases:
            for variant in variants:
                bound = of("bound_per_row", case=case, variant=variant)
                gain = of("gain_per_row", case=case, variant=variant)
                if len(bound):
                    error, share = (
                        of("error", case=case, variant=variant),
                        of("noise_share", case=case, variant=variant),
                    )
                    print(
                        f"  {case:22s} {variant:13s} {bound.min():15.4f} {np.median(bound):9.4f} {bound.max():9.4f} "
                        f"{np.ptp(gain) / np.median(gain):8.2%} {np.median(error):10.3g} {share.max():12.1e} "
                        f"{np.median(of('seconds', case=case, variant=variant)):8.2f}"
                    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = harness.argument_parser(__doc__, quick="a few fits of each part", in_processes=False)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="default: all")
    parser.add_argument("--cases", default="", help="only cases whose name contains this")
    parser.add_argument("--restarts", type=int, default=2, help="of the seeds' part; default: %(default)s")
    options = parser.parse_args(arguments)
    output = harness.output_path(options, "robustness")
    rows: list[dict[str, Any]] = list(harness.read(output))
    done = {(row["part"], row["case"], row["variant"], int(row["seed"])) for row in rows}
    where = harness.provenance()
    for part in options.parts:
        for case, variant, seed, run in jobs(part, options.quick, options.restarts, rows):
            if (part, case, variant, seed) in done or options.cases not in case:
                continue
            values = run()
            for name in ("bound_per_row", "gain_per_row", "error", "noise_share", "seconds"):
                if name in values:
                    values[name] = f"{values[name]:.7g}"
            row = dict.fromkeys(COLUMNS, "") | values
            row |= {"part": part, "case": case, "variant": variant, "seed": seed}
            # Once per run: the file stays small.
            row |= {name: where.pop(name, "") for name in ("versions", "machine")}
            rows.append({name: str(value) for name, value in row.items()})
            harness.append([row], output)
        summary(part, [row for row in rows if row["part"] == part])


if __name__ == "__main__":
    main()
