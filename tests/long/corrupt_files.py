"""Damaged files of skevgp.io.save: each must be refused by a clean ValueError, or hold a model whose predictions are
right, or at least finite.

    python -m tests.long.corrupt_files --files 10000
"""

import argparse
import resource
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np

from skevgp.io import load, save
from tests.io.corruption import CORRUPTIONS
from tests.io.models import fitted, new_rows

MODELS = (
    "outputs",
    "kernel-sum",
    "student-t",
    "exact",
    "residual",
    "network-in-a-pipeline",
    "unions",
    "scalers",
    "words",
    "words-in-a-pipeline",
    "sines",
    "levers",
    "nominal",
    "inverse-dynamics",
)


def outcome(path, rows, expected):
    """What came of a file: "refused", "right", "finite"; anything else is a defect."""
    try:
        model = load(path)
    except ValueError as error:
        return "refused" if type(error) is ValueError and repr(str(path)) in str(error) else f"unclear: {error!r}"
    except Exception as error:
        return f"raised {error!r}"
    try:
        found = model.predict(rows, return_std=True)
    except Exception as error:
        return f"loaded, but predict raised {error!r}"
    if all(np.array_equal(*pair) for pair in zip(found, expected, strict=True)):
        return "right"
    return "finite" if all(np.isfinite(each).all() for each in found) else "loaded, but predicts NaN"


def run(n_files, seed=0, models=MODELS):
    """Counts of outcomes by kind of damage, the defects, and the longest time that a file took."""
    rng, counts, defects, longest = np.random.RandomState(seed), Counter(), [], (0.0, "")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path, good = Path(folder) / "model.skevgp", {}
        for name in models:
            save(fitted(name), path)
            good[name] = path.read_bytes(), fitted(name).predict(new_rows(name), return_std=True)
        for number in range(n_files):
            name, corrupt = models[rng.randint(len(models))], CORRUPTIONS[rng.randint(len(CORRUPTIONS))]
            data, expected = good[name]
            path.write_bytes(corrupt(data, rng))
            start = time.perf_counter()
            found = outcome(path, new_rows(name), expected)
            took = time.perf_counter() - start
            longest = max(longest, (took, f"{number}: {corrupt.__name__} of {name}"))
            if found not in ("refused", "right", "finite"):
                defects.append(f"{number}: {corrupt.__name__} of {name}: {found[:300]}")
                found = "defect"
            counts[corrupt.__name__, found] += 1
    return counts, defects, longest


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    counts, defects, longest = run(options.files, options.seed)
    outcomes = ("refused", "right", "finite", "defect")
    print(f"{'':28}" + "".join(f"{each:>9}" for each in outcomes))
    for kind in sorted({kind for kind, _ in counts}):
        print(f"{kind:28}" + "".join(f"{counts[kind, each]:9}" for each in outcomes))
    print(f"{'all':28}" + "".join(f"{sum(counts[k, e] for k, e in counts if e == each):9}" for each in outcomes))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"longest {longest[0]:.2f} s ({longest[1]}); at most {peak:.0f} MB of memory")
    print("\n".join(defects[:40]))
    raise SystemExit(bool(defects))


if __name__ == "__main__":
    main()
