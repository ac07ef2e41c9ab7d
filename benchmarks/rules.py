"""Does each rule of a fit pay its rent? Each one is switched off in turn, on small problems.

    python benchmarks/rules.py --data ../shared/data           # an hour of one core
    python benchmarks/rules.py --rules place-again longest --seeds 1
    python benchmarks/rules.py --table                         # the worst effects of each rule

A rule is code that changes the fit of rare data. `RULES_OFF` lists the rules, and how each is switched off. `PROBLEMS`
lists the problems. A rule runs on the problems that have one of its tags. Two controls change what should not matter.
They show how much results vary by chance: about one run in six is worse by more than 1 %. The time of the processor
depends on what else runs on the machine. Ratios between 0.75 and 1.25 mean nothing.

The CSV has a row for each rule, problem and seed. `bound` is in nats per row and output. `rmse` and `nlpd` are of new
rows, in standard deviations of their targets. `seconds` are seconds of the processor. `failure` is the text of an
error. `warning` is the start of each warning. Rows of the rule "none" are fits with all rules. A run continues where
the last one ended.

These numbers of the code are no rules, and are not switched off:

* tolerances and rounding errors: `ENOUGH` and `LEAST_TOL` (the end of L-BFGS), `search._WORTH`, `_SEEN`,
  `parameters._AT_LIMIT`, `alone._ROUNDING`, `_NO_SIGNAL`, `model._BOUND_ROUNDING`, `grown._COARSE`,
  `outliers._PATIENCE`, `doubts._SETTLED`, `sharing._CONSTANT`, `_SHORT_TOL`, `units._ROUNDING`, `prior._ROUNDING`,
  `calibration._LOWEST`, `_STEP`, `_REACH`, `_CLOSE`, `inducing._DIGITS`, `folds._FLAT`, `rules.LOWEST_NOISE`;
* sizes: `LARGEST_SAMPLE`, `MAX_SAMPLE`, `LARGEST_SEARCH`, `_ROWS_AT_ONCE`, `PREDICTED_ROWS`, `FEWEST_ROWS`,
  `calibration._MOST_ROWS`, `grown._SAMPLE`, `_ITERATIONS`, `model._GROWTH`, `sharing._SAMPLE`, `_POINTS`,
  `_FIRST_ITERATIONS`, `outliers._LOOK_ROWS`, `_LOOK_ITERATIONS`, `robust._NEIGHBOURS`, `_SAMPLE`, `messages._PAIRS`,
  `Descent.memory`, `Rules.growth`;
* the local part (`local.py`): sizes of samples `_SPARSE_ROWS`, `_SAMPLES`, `_NEIGHBOURS`, `_ONE_FOLD`, starts
  `_FACTORS`, `_LENGTH_FACTORS`, `_NOISE_FACTORS`, and tolerances `_ITERATIONS`, `_TOLERANCE`, `_ROUNDS`, `_GAIN`,
  `_REACH`, `_CLOSE`;
* refusals of input: `problem._LARGEST_SPREAD`, `start.checked_variance`;
* numbers of a model: `student_t._NU`, `_WIDTH`, `_SHARE`, and those of the prior and the chain in `few_rows.py`;
* Adam: `model._FLAT`, `_NATURAL_RATES`, and the constants of `solvers/adam`.
"""

from __future__ import annotations

import argparse
import inspect
import textwrap
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pandas as pd
from sklearn.datasets import load_diabetes, make_friedman1
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, ExpSineSquared
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures
from threadpoolctl import threadpool_limits

from skevgp import CoefPrior, EGPRegressor, EVGPRegressor
from skevgp.datasets import make_dynamics, make_toy
from skevgp.features import InertiaForceGravity
from skevgp.fitting import (
    calibration,
    doubts,
    fit,
    folds,
    grown,
    inducing,
    messages,
    model,
    outliers,
    parts,
    problem,
    robust,
    rules,
    search,
    sharing,
    units,
)
from skevgp.fitting import prior as priors
from skevgp.kernels import stationary
from skevgp.metrics import negative_log_predictive_density
from skevgp.model import left_out
from skevgp.model import model as sparse
from skevgp.solvers import base, lbfgs
from skevgp.utils.linalg import Jitter

CSV = Path(__file__).parent / "results" / "rules.csv"
COLUMNS = ["rule", "problem", "seed", "bound", "rmse", "nlpd", "seconds", "failure", "warning"]

# --- switching off ----------------------------------------------------------------------------------------------------

Off = Callable[[], AbstractContextManager[Any]]


class NoSuchRuleError(Exception):
    """The rule is not in this skevgp."""


def constant(module: Any, name: str, value: Any) -> Off:
    """Replace a constant or a function of a module, or an attribute of a class."""

    def off() -> AbstractContextManager[Any]:
        if not hasattr(module, name):
            raise NoSuchRuleError(f"there is no {name}.")
        return mock.patch.object(module, name, value)

    return off


def field(**changes: Any) -> Off:
    """Replace fields of the rules for L-BFGS."""
    return lambda: mock.patch.object(rules, "RULES", replace(rules.RULES, **changes))


def edited(owner: Any, name: str, old: str, new: str) -> Off:
    """Replace a piece of the text of a function or method. The text must be there once."""

    def off() -> AbstractContextManager[Any]:
        found = inspect.getattr_static(owner, name)
        kind = type(found) if isinstance(found, (property, cached_property, classmethod, staticmethod)) else None
        function = found
        if isinstance(found, property):
            function = found.fget
        elif isinstance(found, cached_property):
            function = found.func
        elif kind is not None:
            function = found.__func__
        text = textwrap.dedent(inspect.getsource(function))
        if text.count(old) != 1:
            raise NoSuchRuleError(f"{name} has {text.count(old)} times the text {old!r}.")
        names: dict[str, Any] = {}
        exec(
            compile("from __future__ import annotations\n" + text.replace(old, new), name, "exec"),
            function.__globals__,
            names,
        )
        changed = names[name]
        if isinstance(changed, cached_property):
            changed.__set_name__(owner, name)
        return mock.patch.object(owner, name, changed)

    return off


class Rule(NamedTuple):
    """A rule of a fit."""

    purpose: str
    off: tuple[Off, ...]
    # Tags of the problems where the rule can act. Empty: all.
    tags: str = ""


def nothing(*args: Any, **options: Any) -> None:
    """Return None."""


def always(*args: Any, **options: Any) -> bool:
    """Return True."""
    return True


def never(*args: Any, **options: Any) -> bool:
    """Return False."""
    return False


RULES_OFF = {
    # Controls.
    "control-noise": Rule("no rule: the noise starts 1.1 times higher", (field(first_noise=1.1e-4),)),
    "control-length": Rule("no rule: length scales start 1.017 times higher", (field(lengthscale=0.61),)),
    # The search.
    "first-noise": Rule("the noise starts low", (field(first_noise=0.5),)),
    "other-starts": Rule("other starts after a collapsed fit", (field(other_starts=()),)),
    "much-noise": Rule("a second start with much noise", (field(much_noise=None),)),
    "short": Rule("a second start with shorter length scales", (field(short=None),)),
    "low-noise": Rule("a fit almost without noise is tried with more", (field(low_noise=0.0),), "many"),
    "few-rows": Rule("a prior of kernel and noise, and an average over draws", (field(few_rows=0.0),)),
    "forward-selection": Rule(
        "a start by forward selection", (constant(model.Model, "by_forward_selection", lambda self: None),)
    ),
    "place-again": Rule("inducing points are placed again", (constant(inducing.Placement, "anew", None),), "sparse"),
    "old-places": Rule(
        "the fit from the old places goes on too",
        (edited(search.Search, "_stages", "if not first.converged:", "if False:"),),
        "sparse",
    ),
    "sample": Rule("a fit begins on a sample", (field(sample=None),), "many"),
    "exact-sample": Rule("an exact fit begins on a sample", (field(exact_sample=None),), "many"),
    "sample-again": Rule(
        "a fit that collapsed on a sample starts again",
        (
            edited(
                search.Search,
                "_climb",
                "if not self._lost(best):\n        best =",
                "if True:\n        best =",
            ),
        ),
        "many",
    ),
    "sample-signal": Rule("a sample without a signal is left", (field(chance=-np.inf),), "many"),
    "sample-curvature": Rule(
        "more rows go on along the curvature of a sample", (constant(model.Model, "keeps_metric", False),), "many"
    ),
    "longest": Rule(
        "long length scales are tried short", (field(longest=np.inf), field(longest_of_all=np.inf)), "many"
    ),
    "last-start": Rule("a last start with little signal", (field(last_start=False),)),
    "hidden-noise": Rule(
        "features may hide the noise",
        (constant(model, "may_hide_noise", never),),
        "features",
    ),
    "most-alone": Rule(
        "the most of features alone, if the signal is fixed",
        (edited(search.Search, "_is_doubtful", "return maybe_below or", "return"),),
        "features",
    ),
    "cold-after-warm": Rule(
        "a cold start follows a collapsed warm one",
        (edited(search.Search, "run", "if self.max_iter > 0 and self.collapsed(best):", "if False:"),),
        "warm",
    ),
    "widest-signal": Rule("a wider limit of the signal", (field(widest_signal=None),)),
    "signal-limits": Rule("an upper limit of the signal", (field(signal_limits=(1e-8, 1e8), widest_signal=None),)),
    "lowest-noise": Rule("a lowest noise of the sparse model", (field(lowest_noise=1e-12),), "sparse"),
    "highest-noise": Rule("an upper limit of the noise", (field(highest_noise=1e10),)),
    "lowest-noise-exact": Rule(
        "the exact model's algebra for points at all rows", (field(lowest_noise_exact=None),), "complete"
    ),
    "all-rows": Rule("points at all rows are fixed", (constant(parts, "are_all_rows", never),), "complete"),
    "collapsed": Rule("a fit with all noise counts as collapsed", (field(collapsed=np.inf),)),
    "below": Rule("a fit below the features counts as collapsed", (constant(search.Search, "_below", never),)),
    "root-d": Rule(
        "first length scales grow with √d",
        (edited(parts, "starting_table", "root_d = np.sqrt(scale.shape[-1])", "root_d = 1.0"),),
    ),
    # L-BFGS.
    "curvature": Rule(
        "steps are scaled by the curvature",
        (constant(lbfgs, "curvature_units", lambda objective, x, alike, n, here: np.ones(len(x))),),
        "sparse",
    ),
    "cold": Rule(
        "no curvature at first guesses",
        (edited(model.Model, "_by_all_rows", "if not start.cold:", "if True:"),),
        "sparse",
    ),
    "restart-of-stall": Rule(
        "L-BFGS starts again after a stall",
        (
            edited(
                lbfgs.LBFGS,
                "minimise",
                "if ended and not before - guarded.loss > enough:",
                "if True:",
            ),
        ),
    ),
    "hair": Rule("it starts again slightly away", (constant(lbfgs, "_HAIR", 0.0),)),
    "rough": Rule(
        "it does not if the loss is rougher than the tolerance",
        (edited(lbfgs.LBFGS, "minimise", "if number > 0 and at.loss", "if False and at.loss"),),
    ),
    "patience": Rule(
        "three iterations with little gain", (constant(lbfgs.LBFGS, "descent", lbfgs.Descent(patience=1)),)
    ),
    "far-losses": Rule("losses far above the best are logarithms", (constant(base, "_FAR", 1e300),)),
    "squared-exponential": Rule(
        "an own class for the squared exponential",
        (constant(stationary.SquaredExponential, "at", stationary.Stationary.at),),
    ),
    "jitter": Rule("a jitter for nearly singular K", (field(jitter=Jitter(size=0.0)),), "sparse complete"),
    "jitter-if-needed": Rule(
        "no jitter for other K", (field(jitter=Jitter(well_conditioned=np.inf)),), "sparse complete"
    ),
    # Inducing points.
    "equal-rows": Rule(
        "rows that are equal to ten digits are one",
        (constant(inducing, "_rounded", lambda inputs, moments: (inputs - moments.mean) / moments.scale),),
    ),
    "exhausted": Rule(
        "the farthest row, if all variances are rounding errors", (constant(inducing, "_EXHAUSTED", 0.0),), "sparse"
    ),
    "missed": Rule(
        "the exact model of a sample says if points are too few",
        (constant(grown, "exact_model_of_sample", nothing),),
        "auto",
    ),
    # Starts, units and prior.
    "little-signal-of-constants": Rule(
        "constants have almost no signal in a fit",
        (
            edited(
                parts,
                "starting_table",
                "np.where(np.logical_and(constant, not still), rules.signal_limits[0], 1.0) * signal",
                "signal",
            ),
            constant(fit, "with_signal_of_constants", lambda problem, rows, table, values: (values, False)),
        ),
        "constant",
    ),
    "signal-of-constants": Rule(
        "constants get the signal of a model of their own",
        (constant(fit, "with_signal_of_constants", lambda problem, rows, table, values: (values, False)),),
        "constant",
    ),
    "noise-of-constants": Rule(
        "the noise of constants starts lowest",
        (
            edited(
                parts,
                "starting_table",
                "np.where(constant, lowest_noise, rules.first_noise * scatter)",
                "np.maximum(rules.first_noise * scatter, lowest_noise)",
            ),
        ),
        "constant",
    ),
    "widest-noise": Rule(
        "the noise may rise to the variance of y",
        (edited(parts, "starting_table", "np.maximum(highest, units.target_scatter[columns] * precision)", "None"),),
        "features",
    ),
    "moderate-prior": Rule("a moderate prior for few rows", (constant(problem, "_ENOUGH", 0),), "features"),
    "negligible": Rule("vanishing features count as 0", (constant(problem, "_NEGLIGIBLE", 0.0),), "features"),
    "independent": Rule(
        "a feature's independent share has a lower limit", (constant(priors, "_INDEPENDENT", 1e-12),), "features"
    ),
    "collinear": Rule("collinear features are no features", (constant(priors, "_COLLINEAR", 0.0),), "features"),
    "target-rounding": Rule("residuals below rounding have no unit", (constant(units, "_TARGET_ROUNDING", 0.0),)),
    "rank": Rule("directions without data have no weight", (constant(units, "_ROUNDING", 0.0),), "features"),
    "nearly-exact": Rule(
        "residuals are fitted once more if features explain all", (constant(units, "_NEARLY_EXACT", 0.0),), "features"
    ),
    # The model.
    "refined-means": Rule(
        "means are refined",
        (edited(sparse.SparseModel, "at_optimum", "if blocks is None or self.prior.shared else", "if True else"),),
        "sparse",
    ),
    "high-ratio": Rule("the exact predictor for a high ratio", (constant(model, "_HIGH_RATIO", np.inf),), "complete"),
    "exact-predictor": Rule(
        "the exact predictor for points at all rows",
        (edited(model.Model, "posterior", "if self.exact is not None:", "if False:"),),
        "complete",
    ),
    # Calibration.
    "calibration": Rule("calibration as a whole", (constant(fit, "calibrate", nothing),), "folds groups"),
    "wider": Rule(
        "calibration widens the limits of the signal", (constant(calibration, "_WIDER", 1.0),), "folds groups"
    ),
    "noiseless": Rule(
        "random folds keep the signal without noise", (constant(calibration, "_NOISELESS", 0.0),), "folds"
    ),
    "in-doubt": Rule(
        "variances grow if there are few groups",
        (constant(calibration.VarianceSearch, "in_doubt", lambda self, signal, noise, groups: 1.0),),
        "groups",
    ),
    "gone": Rule("the signal may fall if nothing holds", (constant(calibration, "_GAIN", -np.inf),), "groups"),
    "signal-stays": Rule(
        "groups do not lower the signal",
        (
            edited(
                calibration,
                "_by_folds",
                'signals = variances(table["signal"], at_bound, np.clip(at_bound, s_low, s_high), s_high)',
                'signals = variances(table["signal"], at_bound, s_low, s_high)',
            ),
        ),
        "groups",
    ),
    "squares": Rule(
        "squared errors count next to the density", (constant(calibration, "_SQUARES", 0.0),), "folds groups"
    ),
    "left-over": Rule(
        "a lowest noise from the training rows", (constant(calibration, "_LEFT_OVER", 0.0),), "folds groups"
    ),
    "prior-of-variances": Rule(
        "a prior around the values of the bound",
        (edited(calibration.VarianceSearch, "_losses", "log_prior / n", "0.0 * log_prior / n"),),
        "folds groups",
    ),
    "dependent": Rule("a test of neighbouring rows", (constant(calibration, "_dependent", never),), "folds"),
    "path-test": Rule(
        "blocks that are predicted worse must be a path",
        (constant(calibration, "follow_a_path", always),),
        "folds",
    ),
    "ends-of-blocks": Rule("ends of blocks are not predicted", (constant(folds, "_GAP", 0.0),), "groups"),
    "largest-group": Rule("a group of most rows is cut", (constant(folds, "_LARGEST_SHARE", 2.0),), "groups"),
    "no-folds-if-exact": Rule(
        "the exact model is not calibrated by random folds",
        (
            edited(
                fit,
                "finished",
                "calibration is not None and (model.exact is None or model.problem.groups is not None)",
                "calibration is not None",
            ),
        ),
        "complete",
    ),
    "constant-rows": Rule(
        "constant outputs are not calibrated",
        (
            edited(
                calibration,
                "_by_folds",
                "dependent, still = 0, False, rows.is_constant()",
                "dependent, still = 0, False, np.zeros(len(best_of), dtype=bool)",
            ),
        ),
        "constant",
    ),
    "many-features": Rule("another algebra for many features", (constant(left_out, "_MANY_FEATURES", np.inf),), "wide"),
    # Messages.
    "alike": Rule(
        "no warning if residuals look like noise",
        (constant(messages, "alike_neighbours", lambda rows: np.ones(len(rows.scatter()), dtype=bool)),),
    ),
    # Outliers.
    "medians": Rule(
        "scales begin with medians of neighbours",
        (
            edited(
                outliers,
                "_first_doubts",
                "robust = _robust_doubts(",
                "plain = replace(short, rows=rows.subset(chosen))\n"
                "    scales = model.problem.noise.row_scales(len(model.scatter), np.zeros(len(rows)))\n"
                "    return _first_of(look_at(rows, predictor_at(plain, search(plain).values)), scales)\n"
                "    robust = _robust_doubts(",
            ),
        ),
        "robust",
    ),
    "looks": Rule("short fits are repeated", (constant(outliers, "_LOOKS", 2),), "robust"),
    "together": Rule(
        "outliers next to each other are a function", (constant(outliers, "_TOGETHER", np.inf),), "robust"
    ),
    "plain-look": Rule(
        "a fit to all rows shows outliers too",
        (edited(outliers, "_first_doubts", "if robust.rejected is None or", "if True or"),),
        "robust",
    ),
    "share-of-noise": Rule("a lowest scale of errors", (constant(outliers, "_SHARE_OF_NOISE", 0.0),), "robust"),
    "far-from-median": Rule(
        "far rows of the first look do not count", (constant(outliers, "_FAR_FROM_MEDIAN", np.inf),), "robust"
    ),
    "before": Rule("scales change before the fit ends", (constant(outliers, "_BEFORE", 1.0),), "robust"),
    "few": Rule("too many outliers are none", (constant(doubts, "FEW", 1.0), constant(outliers, "FEW", 1.0)), "robust"),
    "beyond": Rule(
        "an error of one output rejects a row",
        (constant(doubts.Look, "beyond", lambda self, variance: np.zeros(len(self.errors), dtype=bool)),),
        "robust",
    ),
    "without-outliers": Rule(
        "kernel and noise are fitted without outliers",
        (constant(doubts.RowDoubts, "without_outliers", lambda self, rows: rows),),
        "robust",
    ),
    "far-targets": Rule(
        "units come from rows without far outliers",
        (constant(problem, "without_far_targets", lambda source: source),),
        "robust",
    ),
    "ordinary-share": Rule(
        "errors of medians have a scale from 70 % of them", (constant(robust, "_ORDINARY", 0.99),), "robust"
    ),
    "fewest-rows": Rule(
        "few rows do not show their share of outliers", (constant(outliers, "_FEWEST_ROWS", 0),), "robust"
    ),
    "folds-without-outliers": Rule(
        "calibration leaves out outliers",
        (edited(fit, "_calibration", "if doubts is not None and doubts.rejected is not None:", "if False:"),),
        "robust",
    ),
    # Outputs that share a kernel.
    "groups-of-outputs": Rule(
        "outputs share a kernel only if none loses much",
        (constant(sharing, "found_groups", lambda problem, rng, monitor: [list(range(problem.n_outputs))]),),
        "sharing",
    ),
    "chance": Rule(
        "outputs that gain less than chance say nothing",
        (edited(sharing, "found_groups", "0.5 * fits.n_free * np.log(fits.n_rows)", "0.0"),),
        "sharing",
    ),
    "hidden-outputs": Rule(
        "outputs that learned nothing have a group",
        (
            edited(
                sharing,
                "found_groups",
                "hidden = [o for o in unknown if variance[o] > _CONSTANT and o not in still]",
                "hidden = []",
            ),
        ),
        "sharing",
    ),
    "still-outputs": Rule(
        "constants have a group",
        (
            edited(
                sharing,
                "found_groups",
                "still = [o for o in unknown if problem.units.constant is not None and problem.units.constant[o]]",
                "still = []",
            ),
        ),
        "sharing",
    ),
}

# Deleted rules whose rows are in the CSV. They are from commit e8757fa, and so are those of the calibration.
DELETED = {
    "evidence": "the likelier of two sets of outliers",
    "refinable": "means are not refined if B has no digits",
    "noise-factor": "a second estimate of the noise of rows that are no outliers",
    "products-again": "products of collinear features are summed again",
    "varying": "directions without data are left out of a step",
    "refined-units": "the fit of the features is refined",
    "search-at-limit": "the noise is searched alone if the signal is at a limit",
    "vertex": "a parabola through the best points",
}

# --- problems ---------------------------------------------------------------------------------------------------------


class Job(NamedTuple):
    """A model, the arguments of its fit, and new rows."""

    model: Any
    rows: dict[str, Any]
    X: np.ndarray
    y: np.ndarray


class Problem(NamedTuple):
    """A problem: its job for a seed, and its tags."""

    job: Callable[[int], Job]
    tags: str


def waves(X: np.ndarray) -> np.ndarray:
    """Return a smooth function of all columns."""
    rng = np.random.RandomState(len(X[0]))
    directions = rng.randn(12, X.shape[1]) * 2.0 / np.sqrt(X.shape[1])
    values = np.sin(X @ directions.T + rng.uniform(0.0, 6.0, 12)) @ rng.randn(12)
    return np.asarray(values / 2.5)


def drawn(
    n: int, d: int, noise: float, seed: int, new: int = 500
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draw rows of `waves` with noise, and new rows without."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-1.0, 1.0, (n + new, d))
    y = waves(X)
    return X[:n], y[:n] + noise * rng.randn(n), X[n:], y[n:]


def sparse_of(features: Any = None, m: int = 20, seed: int = 0, **options: Any) -> EVGPRegressor:
    """Return the sparse model."""
    return EVGPRegressor(features, n_inducing=m, random_state=seed, **options)


def system(name: str, m: int, n_trajectories: int, noise: float, groups: bool = True) -> Callable[[int], Job]:
    def job(seed: int) -> Job:
        train, test = (
            make_dynamics(name, n_trajectories=n, noise=size, random_state=state)
            for n, size, state in ((n_trajectories, noise, seed), (5, 0.0, 1000 + seed))
        )
        rows = {"X": train.data, "y": train.target} | ({"groups": train.groups} if groups else {})
        return Job(sparse_of(InertiaForceGravity(name), m, seed), rows, test.data, test.target)

    return job


def simple(make: Callable[[int], tuple[np.ndarray, ...]], **options: Any) -> Callable[[int], Job]:
    """Return the job of a sparse model of some rows."""

    def job(seed: int) -> Job:
        X, y, X_new, y_new, *groups = make(seed)
        return Job(
            sparse_of(seed=seed, **options), {"X": X, "y": y} | ({"groups": groups[0]} if groups else {}), X_new, y_new
        )

    return job


def exact_job(make: Callable[[int], tuple[np.ndarray, ...]], **options: Any) -> Callable[[int], Job]:
    def job(seed: int) -> Job:
        X, y, X_new, y_new = make(seed)
        return Job(EGPRegressor(random_state=seed, **options), {"X": X, "y": y}, X_new, y_new)

    return job


def parted(X: np.ndarray, y: np.ndarray, n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draw training rows and new rows of a table."""
    order = np.random.RandomState(seed).permutation(len(X))[: n + 1000]
    return X[order[:n]], y[order[:n]], X[order[n:]], y[order[n:]]


def friedman(seed: int) -> tuple[np.ndarray, ...]:
    return parted(*make_friedman1(4000, noise=1.0, random_state=seed), 3000, seed)


def uci(name: str, n: int) -> Callable[[int], tuple[np.ndarray, ...]]:
    @cache
    def make(seed: int) -> tuple[np.ndarray, ...]:
        table = np.loadtxt(DATA / "uci" / name / "data.csv.gz", delimiter=",")
        mean, std = table.mean(axis=0), table.std(axis=0)
        table = (table - mean) / np.where(std > 0.0, std, 1.0)
        return parted(table[:, :-1], table[:, -1], n, seed)

    return make


def as_wide_as_long(seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.RandomState(seed)
    X = rng.randn(340, 40)
    y = X[:, 0] + np.sin(2.0 * X[:, 1]) + 0.1 * rng.randn(340)
    return X[:40], y[:40], X[40:], y[40:]


def offset(seed: int) -> tuple[np.ndarray, ...]:
    X, y, X_new, y_new = drawn(200, 1, 0.05, seed)
    return X, 1e4 + 30.0 * X[:, 0] + y, X_new, 1e4 + 30.0 * X_new[:, 0] + y_new


def far_features(centre: float, spread: float) -> Callable[[int], tuple[np.ndarray, ...]]:
    def make(seed: int) -> tuple[np.ndarray, ...]:
        X, y, X_new, y_new = drawn(200, 2, 0.05, seed)
        y, y_new = y + 3.0 * X[:, 0] ** 2, y_new + 3.0 * X_new[:, 0] ** 2
        return centre + spread * X, y, centre + spread * X_new, y_new

    return make


def duplicates(seed: int) -> tuple[np.ndarray, ...]:
    X, y, X_new, y_new = drawn(40, 2, 0.0, seed)
    X, y = np.repeat(X, 4, axis=0), np.repeat(y, 4) + 0.1 * np.random.RandomState(seed).randn(160)
    return X * (1.0 + 1e-14 * np.random.RandomState(seed).randn(*X.shape)), y, X_new, y_new


def many_outputs(n: int, extra: tuple[str, ...]) -> Callable[[int], tuple[np.ndarray, ...]]:
    def make(seed: int) -> tuple[np.ndarray, ...]:
        rng = np.random.RandomState(seed)
        X = rng.uniform(-1.0, 1.0, (n + 400, 2))
        columns = [waves(X), waves(X[:, ::-1]), np.sin(9.0 * X[:, 0])]
        noise = [0.1, 0.01, 0.1]
        for kind in extra:
            if kind == "constant":
                columns, noise = [*columns, np.full(len(X), 5.0)], [*noise, 0.0]
            elif kind == "noise":
                columns, noise = [*columns, np.zeros(len(X))], [*noise, 1.0]
            else:  # noise-free
                columns, noise = [*columns, np.cos(2.0 * X[:, 1])], [*noise, 0.0]
        Y = np.column_stack(columns)
        Y[:n] += np.array(noise) * rng.randn(n, len(noise))
        return X[:n], Y[:n], X[n:], Y[n:]

    return make


def constants(seed: int) -> tuple[np.ndarray, ...]:
    X, Y, X_new, Y_new = many_outputs(200, ("constant",))(seed)
    return X, Y[:, [0, 3]], X_new, Y_new[:, [0, 3]]


def of_groups(n_groups: int, shift: float, noise: float = 0.1) -> Callable[[int], tuple[np.ndarray, ...]]:
    """Rows of groups, each with a shift of its own and a slow path."""

    def make(seed: int) -> tuple[np.ndarray, ...]:
        rng = np.random.RandomState(seed)
        paths, shifts, names = [], [], []
        for group in range(n_groups + 10):
            t = np.linspace(0.0, 1.0, 30)[:, np.newaxis]
            paths.append(rng.uniform(-1.0, 1.0, (1, 2)) + 0.6 * np.sin(2.0 * t + rng.uniform(0.0, 6.0, (1, 2))))
            shifts.append(np.full(30, shift * rng.randn()))
            names.append(np.full(30, group))
        X, shifts, names = np.vstack(paths), np.concatenate(shifts), np.concatenate(names)
        y = waves(X) + shifts + noise * rng.randn(len(X))
        old = names < n_groups
        return X[old], y[old], X[~old], y[~old], names[old]

    return make


def without_groups(make: Callable[[int], tuple[np.ndarray, ...]]) -> Callable[[int], tuple[np.ndarray, ...]]:
    return lambda seed: make(seed)[:4]


def one_large_group(seed: int) -> tuple[np.ndarray, ...]:
    X, y, X_new, y_new, names = of_groups(8, 0.2)(seed)
    return X, y, X_new, y_new, np.minimum(names, 1)


def outlying(
    share: float, size: float, one_sided: bool = False, n: int = 300
) -> Callable[[int], tuple[np.ndarray, ...]]:
    def make(seed: int) -> tuple[np.ndarray, ...]:
        X, y, X_new, y_new = drawn(n, 2, 0.1, seed)
        rng = np.random.RandomState(seed + 7)
        rows = rng.permutation(n)[: int(share * n)]
        errors = size * rng.randn(len(rows))
        y[rows] += abs(errors) if one_sided else errors
        return X, y, X_new, y_new

    return make


def steep(d: int, share: float, size: float, one_sided: bool) -> Callable[[int], tuple[np.ndarray, ...]]:
    """Outliers of a function for which medians of neighbours are bad predictions."""

    def make(seed: int) -> tuple[np.ndarray, ...]:
        rng = np.random.RandomState(seed)
        X = rng.uniform(-3.0, 3.0, (900, d))
        y = np.sin(X[:, 0]) + 3.0 * X.sum(axis=1)
        y_old = y[:300] + 0.1 * rng.randn(300)
        errors = size * rng.randn(300)
        y_old += np.where(rng.rand(300) < share, abs(errors) if one_sided else errors, 0.0)
        return X[:300], y_old, X[300:], y[300:]

    return make


def bump(seed: int) -> tuple[np.ndarray, ...]:
    """A narrow high bump, which is no set of outliers."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-1.0, 1.0, (800, 1))
    y = 0.3 * np.sin(3.0 * X[:, 0]) + 8.0 * np.exp(-0.5 * ((X[:, 0] - 0.3) / 0.03) ** 2)
    return X[:300], y[:300] + 0.1 * rng.randn(300), X[300:], y[300:]


def classes(seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.RandomState(seed)
    X = rng.randn(700, 2)
    y = (X[:, 0] + 0.5 * rng.randn(700) > 0.8).astype(float)
    return X[:300], y[:300], X[300:], y[300:]


def two_outputs_with_outliers(seed: int) -> tuple[np.ndarray, ...]:
    X, y, X_new, y_new = outlying(0.1, 10.0)(seed)
    rng = np.random.RandomState(seed + 8)
    return (
        X,
        np.column_stack([y, waves(X[:, ::-1]) + 0.01 * rng.randn(len(X))]),
        X_new,
        np.column_stack([y_new, waves(X_new[:, ::-1])]),
    )


def irrelevant(n: int, noise: float) -> Callable[[int], tuple[np.ndarray, ...]]:
    """Ten columns of which one or two matter, the second only a little."""

    def make(seed: int) -> tuple[np.ndarray, ...]:
        rng = np.random.RandomState(seed)
        X = rng.randn(n + 500, 10)
        y = np.sin(2.0 * X[:, 0]) + 0.1 * np.sin(3.0 * X[:, 1])
        return X[:n], y[:n] + noise * rng.randn(n), X[n:], y[n:]

    return make


def sines(seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2.0, 2.0, (800, 5))
    y = np.sin(2.0 * X).sum(axis=1)
    return X[:300], y[:300] + 0.3 * rng.randn(300), X[300:], y[300:]


def polynomial(seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.RandomState(seed)
    X = rng.uniform(-1.0, 1.0, (600, 3))
    y = X[:, 0] ** 3 + X[:, 1] * X[:, 2] - 0.5 * X[:, 2] ** 2
    return X[:100], y[:100], X[100:], y[100:]


def sorted_rows(seed: int) -> tuple[np.ndarray, ...]:
    """Independent rows, sorted by y: blocks of them are predicted worse."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-1.0, 1.0, (800, 2))
    y = np.exp(X[:, 0]) + 0.3 * rng.randn(800)
    order = np.argsort(y[:400])
    return X[:400][order], y[:400][order], X[400:], y[400:]


def pure_noise(seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.RandomState(seed)
    return rng.randn(200, 3), rng.randn(200), rng.randn(300, 3), rng.randn(300)


def fast_waves(seed: int) -> tuple[np.ndarray, ...]:
    """Waves that look like noise for a start with a long length scale."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(0.0, 1.0, (500, 1))
    y = np.sin(60.0 * X[:, 0])
    return X[:150], y[:150] + 0.1 * rng.randn(150), X[150:], y[150:]


def faster(speed: float) -> Callable[[int], tuple[np.ndarray, ...]]:
    """Waves that ten points see as noise."""

    def make(seed: int) -> tuple[np.ndarray, ...]:
        rng = np.random.RandomState(seed)
        X = rng.uniform(0.0, 1.0, (1000, 1))
        y = np.sin(2.0 * speed * X[:, 0])
        return X[:500], y[:500] + 0.3 * rng.randn(500), X[500:], y[500:]

    return make


def ratio_1e8(n: int) -> Callable[[int], tuple[np.ndarray, ...]]:
    def make(seed: int) -> tuple[np.ndarray, ...]:
        return drawn(n, 2, 1e-4, seed)

    return make


def noise_free_duplicates(seed: int) -> tuple[np.ndarray, ...]:
    X, y, X_new, y_new = drawn(40, 1, 0.0, seed)
    return np.repeat(X, 2, axis=0), np.repeat(y, 2), X_new, y_new


def nearly_duplicates(seed: int) -> tuple[np.ndarray, ...]:
    """Rows without noise that differ from others by rounding only."""
    X, y, X_new, y_new = drawn(40, 1, 0.0, seed)
    return np.vstack([X, X * (1.0 + 1e-14)]), np.tile(y, 2), X_new, y_new


def fixed_signal(seed: int) -> Job:
    """As many features as rows, and a kernel with a fixed signal."""
    X, y, X_new, y_new = as_wide_as_long(seed)
    kernel = ConstantKernel(0.5, "fixed") * RBF(np.ones(40))
    return Job(sparse_of(PolynomialFeatures(1), 20, seed, kernel=kernel), {"X": X, "y": y}, X_new, y_new)


def periodic(seed: int) -> Job:
    """A kernel that explains less than noise alone from its first start."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2.0, 2.0, (360, 1))
    y = np.sin(2.0 * X[:, 0]) + 0.3 * X[:, 0]
    y[:60] += 0.1 * rng.randn(60)
    return Job(sparse_of(None, 60, seed, kernel=ExpSineSquared()), {"X": X[:60], "y": y[:60]}, X[60:], y[60:])


def plateau(seed: int) -> tuple[np.ndarray, ...]:
    """A point for each row: a low noise leads to a kernel that explains each row by itself."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2.0, 2.0, (360, 3))
    y = np.sin(2.0 * X[:, 0]) + 0.3 * X.sum(axis=1)
    return X[:60], y[:60] + 0.1 * rng.randn(60), X[60:], y[60:]


def cubic(seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.RandomState(seed)
    X = rng.uniform(-2.0, 2.0, (360, 2))
    y = (X**3 - X).sum(axis=1)
    y = y / y.std()
    return X[:60], y[:60] + 0.01 * rng.randn(60), X[60:], y[60:]


def interpolating(shift: float, noise: float) -> Callable[[int], Job]:
    """More features than rows, with a wide prior: residuals are rounding errors."""

    def job(seed: int) -> Job:
        rng = np.random.RandomState(seed)
        X, weights = rng.randn(110, 5), rng.randn(5)
        y = shift + X @ weights + noise * rng.randn(110)
        model = sparse_of(poly(2), 10, seed, coef_prior=CoefPrior(scale=1e3), normalize_y=True)
        return Job(model, {"X": X[:10], "y": y[:10]}, X[10:], y[10:])

    return job


def sixty_features(seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.RandomState(seed)
    X, y = rng.randn(105, 60), rng.randn(105)
    return X[:5], y[:5], X[5:], y[5:]


def missed_column(seed: int) -> tuple[np.ndarray, ...]:
    """A column that looks like noise on a sample."""
    rng = np.random.default_rng(1 + seed)
    X = rng.uniform(-1.0, 1.0, (6000, 6))
    signal = 2.0 * X[:, 1] + X[:, 2] ** 2 + 0.8 * np.sin(5.0 * X[:, 0])
    y = signal + rng.standard_normal(6000)
    return X[:5000], y[:5000], X[5000:], signal[5000:]


def parabola(seed: int) -> tuple[np.ndarray, ...]:
    X = np.random.RandomState(seed).uniform(-3.0, 3.0, (100, 1))
    return X[:60], X[:60, 0] ** 2, X[60:], X[60:, 0] ** 2


def phases(seed: int) -> tuple[np.ndarray, ...]:
    """Groups overlap, and each has a phase of its own."""
    rng = np.random.RandomState(seed)
    groups = np.repeat(np.arange(24), 25)
    X = rng.uniform(-1.0, 1.0, (24, 2))[groups] + 0.4 * rng.randn(600, 2)
    y = np.sin(2.0 * X[:, 0] + rng.uniform(0.0, 6.28, 24)[groups]) + 0.1 * rng.randn(600)
    return X[:300], y[:300], X[300:], y[300:], groups[:300]


def most_rows_in_a_group(seed: int) -> tuple[np.ndarray, ...]:
    X, y, X_new, y_new = drawn(300, 2, 0.1, seed)
    return X, y, X_new, y_new, np.repeat([0, 1, 2], [280, 10, 10])


def very_fast(seed: int) -> tuple[np.ndarray, ...]:
    """Many rows of waves that a fit to a few of them takes for noise."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(0.0, 1.0, (4500, 1))
    y = np.sin(240.0 * X[:, 0])
    return X[:4000], y[:4000] + 0.5 * rng.randn(4000), X[4000:], y[4000:]


def weak_signal(seed: int) -> tuple[np.ndarray, ...]:
    """A signal that a sample is too small to show."""
    rng = np.random.RandomState(seed)
    X = rng.uniform(-1.0, 1.0, (9000, 3))
    y = np.sin(3.0 * X[:, 0]) + X[:, 1] ** 2
    return X[:8000], y[:8000] + 8.0 * rng.randn(8000), X[8000:], y[8000:]


def weaker_signal(seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.RandomState(seed)
    X = rng.uniform(-1.0, 1.0, (20500, 3))
    y = np.sin(3.0 * X[:, 0]) + X[:, 1] ** 2
    noise = 12.0 * rng.randn(20500)
    return X[:20000], y[:20000] + noise[:20000], X[20000:], y[20000:]


def apart(seed: int) -> tuple[np.ndarray, ...]:
    """Outputs of two kinds of kernels, of very different sizes."""
    rng = np.random.RandomState(seed)
    x = rng.uniform(-2.0, 2.0, 500)
    Y = np.column_stack([np.sin(x), np.sin(12.0 * x), 100.0 * np.cos(x), 0.01 * np.cos(12.0 * x)])
    Y[:200] += np.array([0.01, 0.01, 1.0, 1e-4]) * rng.randn(200, 4)
    return x[:200, np.newaxis], Y[:200], x[200:, np.newaxis], Y[200:]


def far_bump(X: np.ndarray) -> np.ndarray:
    """A bump far from all rows, next to a line."""
    return np.column_stack([X[:, 0], np.exp(-0.5 * (X[:, 0] - 25.0) ** 2)])


def sums_of_columns(X: np.ndarray) -> np.ndarray:
    """Columns that depend on each other."""
    return np.column_stack([np.ones(len(X)), X, X.sum(axis=1), X[:, 0] * (1.0 + 1e-9)])


def warm(seed: int) -> Job:
    """A fit that starts from the fit of other rows."""
    X, y, X_new, y_new = drawn(200, 2, 0.05, seed)
    fitted = sparse_of(None, 12, seed, warm_start=True).fit(X, y)
    return Job(fitted, {"X": 1e3 * X, "y": y}, 1e3 * X_new, y_new)


def fixed_high_signal(seed: int) -> Job:
    """More features than rows, and a kernel with a fixed high signal."""
    rng = np.random.RandomState(2 * seed + 1)
    X, weights = rng.randn(112, 5), rng.randn(5)
    y = X @ weights + 0.01 * rng.randn(112)
    kernel = ConstantKernel(100.0, "fixed") * RBF(np.ones(5))
    model = sparse_of(poly(2), 6, 0, kernel=kernel, coef_prior=CoefPrior(scale=1e3), normalize_y=True)
    return Job(model, {"X": X[:12], "y": y[:12]}, X[12:], y[12:])


def toy(seed: int) -> tuple[np.ndarray, ...]:
    X, y = make_toy(600, random_state=seed, return_X_y=True)
    return parted(X, y, 200, seed)


def poly(degree: int) -> PolynomialFeatures:
    return PolynomialFeatures(degree)


DATA = Path("../shared/data")

PROBLEMS = {
    "pendulum": Problem(system("pendulum", 10, 6, 0.0), "sparse features groups sharing"),
    "pendulum-noise": Problem(system("pendulum", 10, 6, 0.01), "sparse features groups sharing"),
    "cartpole": Problem(system("cartpole", 30, 3, 0.0), "sparse features groups sharing"),
    "acrobot-noise": Problem(system("acrobot", 30, 4, 0.01), "sparse features groups sharing"),
    "pendulum-without-groups": Problem(system("pendulum", 10, 4, 0.01, groups=False), "sparse features folds sharing"),
    "friedman": Problem(simple(friedman, m=30), "sparse folds many"),
    "diabetes": Problem(
        simple(lambda seed: parted(*load_diabetes(return_X_y=True), 300, seed), features=poly(1), m=50),
        "sparse folds features",
    ),
    "airfoil": Problem(simple(uci("airfoil", 800), m=50), "sparse folds"),
    "kin40k": Problem(simple(uci("kin40k", 3000), m=30), "sparse folds many"),
    "toy": Problem(simple(toy, features=poly(1), m=10), "sparse folds features"),
    "few-rows": Problem(simple(lambda seed: drawn(18, 2, 0.1, seed)), "complete"),
    "few-rows-features": Problem(simple(lambda seed: drawn(25, 3, 0.1, seed), features=poly(2)), "complete features"),
    "columns-as-rows": Problem(simple(as_wide_as_long, features=poly(1)), "sparse features wide"),
    "fixed-signal": Problem(fixed_signal, "sparse features wide"),
    "fixed-high-signal": Problem(fixed_high_signal, "sparse features wide"),
    "features-interpolate": Problem(
        simple(lambda seed: drawn(60, 2, 0.3, seed), features=poly(9), m=12), "sparse features wide folds"
    ),
    "offset": Problem(simple(offset, features=poly(1)), "sparse folds features"),
    "offset-alone": Problem(simple(offset), "sparse folds"),
    "far-features": Problem(simple(far_features(1e4, 10.0), features=poly(3)), "sparse folds features"),
    "features-1e8": Problem(simple(far_features(0.0, 1e8), features=poly(2)), "sparse folds features"),
    "features-at-1e8": Problem(simple(far_features(1e8, 1.0), features=poly(2)), "sparse folds features"),
    "duplicates": Problem(simple(duplicates, m=100), "complete folds"),
    "noise-free-duplicates": Problem(simple(noise_free_duplicates, m=100), "complete folds"),
    "nearly-duplicates": Problem(simple(nearly_duplicates, m=100), "complete folds"),
    "constant-output": Problem(simple(many_outputs(200, ("constant",)), sharing="all"), "sparse folds constant"),
    "constant-auto": Problem(
        simple(many_outputs(200, ("constant", "noise", "noise-free"))), "sparse folds constant sharing"
    ),
    "constant-normalized": Problem(
        simple(many_outputs(200, ("constant",)), sharing="all", normalize_y=True), "sparse folds constant"
    ),
    "constant-normalized-auto": Problem(
        simple(many_outputs(200, ("constant", "noise")), normalize_y=True), "sparse folds constant sharing"
    ),
    "constant-alone": Problem(simple(constants, normalize_y=True, sharing="kernel"), "sparse folds constant"),
    "ratio-1e8": Problem(simple(ratio_1e8(300), m=60), "sparse folds"),
    "ratio-1e8-all-rows": Problem(simple(ratio_1e8(80)), "complete folds"),
    "groups": Problem(simple(of_groups(8, 0.0)), "sparse groups"),
    "groups-shifted": Problem(simple(of_groups(5, 0.5)), "sparse groups"),
    "groups-of-shifts": Problem(simple(of_groups(4, 3.0)), "sparse groups"),
    "large-group": Problem(simple(one_large_group), "sparse groups"),
    "path": Problem(simple(without_groups(of_groups(8, 0.3))), "sparse folds"),
    "student": Problem(simple(outlying(0.05, 10.0), noise="student-t"), "sparse folds robust"),
    "student-one-side": Problem(simple(outlying(0.15, 20.0, True), noise="student-t"), "sparse folds robust"),
    "student-far": Problem(simple(outlying(0.1, 1e4), noise="student-t"), "sparse folds robust"),
    "student-clean": Problem(simple(outlying(0.0, 1.0), noise="student-t"), "sparse folds robust"),
    "student-bump": Problem(simple(bump, noise="student-t"), "sparse folds robust"),
    "student-classes": Problem(simple(classes, noise="student-t"), "sparse folds robust"),
    "student-few": Problem(simple(outlying(0.1, 10.0, n=30), noise="student-t"), "robust complete"),
    "student-steep": Problem(simple(steep(5, 0.1, 5.0, False), noise="student-t"), "sparse folds robust"),
    "student-steep-one-side": Problem(simple(steep(2, 0.15, 1.0, True), noise="student-t"), "sparse folds robust"),
    "student-many": Problem(simple(outlying(0.35, 10.0), noise="student-t"), "sparse folds robust"),
    "student-3000": Problem(simple(outlying(0.1, 3.0, n=3000), noise="student-t"), "sparse folds robust"),
    "student-20-iterations": Problem(
        simple(outlying(0.1, 10.0), noise="student-t", max_iter=20), "sparse folds robust"
    ),
    "student-12": Problem(simple(outlying(0.17, 10.0, n=12), noise="student-t"), "robust complete"),
    "student-two": Problem(simple(two_outputs_with_outliers, noise="student-t"), "sparse folds robust"),
    "auto": Problem(simple(lambda seed: drawn(300, 2, 0.05, seed), m="auto"), "sparse folds auto"),
    "auto-fast": Problem(simple(fast_waves, m="auto"), "sparse folds auto"),
    "auto-very-fast": Problem(simple(faster(60.0), m="auto"), "sparse folds auto"),
    "auto-plane": Problem(simple(lambda seed: drawn(800, 4, 0.3, seed), m="auto"), "sparse folds auto"),
    "auto-irrelevant": Problem(simple(irrelevant(500, 0.1), m="auto"), "sparse folds auto"),
    "auto-sines": Problem(simple(sines, m="auto"), "sparse folds auto"),
    "exact": Problem(exact_job(lambda seed: drawn(150, 2, 0.1, seed)), "exact"),
    "exact-features": Problem(exact_job(as_wide_as_long, feature_map=poly(1)), "exact features"),
    "exact-noise-free": Problem(exact_job(polynomial), "exact"),
    "many-outputs": Problem(simple(many_outputs(200, ("noise-free",))), "sparse folds sharing"),
    "irrelevant": Problem(simple(irrelevant(400, 0.1)), "sparse folds"),
    "irrelevant-many": Problem(simple(irrelevant(3000, 0.3), m=15), "sparse folds many"),
    "sines": Problem(simple(sines), "sparse folds"),
    "polynomial": Problem(simple(polynomial), "sparse folds"),
    "sorted": Problem(simple(sorted_rows), "sparse folds"),
    "noise": Problem(simple(pure_noise), "sparse folds"),
    "fast-waves": Problem(simple(fast_waves, m=40), "sparse folds"),
    "periodic": Problem(periodic, "complete folds"),
    "plateau": Problem(simple(plateau), "complete folds"),
    "cubic": Problem(simple(cubic, m=30), "sparse folds"),
    "interpolating": Problem(interpolating(0.0, 1.0), "complete features wide"),
    "interpolating-1e8": Problem(interpolating(1e8, 0.01), "complete features wide"),
    "sixty-features": Problem(simple(sixty_features, features=poly(1), normalize_y=True), "complete features wide"),
    "missed-column": Problem(simple(missed_column, m=30), "sparse folds many"),
    "missed-column-40": Problem(simple(missed_column, m=40, noise_cv=None), "sparse many"),
    "very-fast": Problem(simple(very_fast, m=60), "sparse folds many"),
    "weak-signal": Problem(simple(weak_signal, m=20), "sparse folds many"),
    "weaker-signal": Problem(simple(weaker_signal, noise_cv=None), "sparse many"),
    "parabola": Problem(simple(parabola), "complete folds"),
    "parabola-30": Problem(simple(parabola, m=30), "sparse folds"),
    "phases": Problem(simple(phases, m=60), "sparse groups"),
    "most-rows-in-a-group": Problem(simple(most_rows_in_a_group, m=60), "sparse groups"),
    "apart": Problem(simple(apart, m=40), "sparse folds sharing"),
    "far-bump": Problem(
        simple(lambda seed: drawn(100, 1, 0.1, seed), features=FunctionTransformer(far_bump), m=15),
        "sparse folds features",
    ),
    "copied-features": Problem(
        simple(lambda seed: drawn(100, 2, 0.1, seed), features=FunctionTransformer(sums_of_columns), m=15),
        "sparse folds features",
    ),
    "warm": Problem(warm, "sparse folds warm"),
}

# --- runs -------------------------------------------------------------------------------------------------------------


def measured(rule: str, name: str, seed: int) -> dict[str, Any]:
    """Return a row of the CSV."""
    job = PROBLEMS[name].job(seed)
    row: dict[str, Any] = {"rule": rule, "problem": name, "seed": seed, "failure": "", "warning": ""}
    with ExitStack() as stack, warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for off in RULES_OFF[rule].off if rule != "none" else ():
            stack.enter_context(off())
        start_time = time.process_time()
        try:
            job.model.fit(**job.rows)
            row["seconds"] = round(time.process_time() - start_time, 3)
            mean, std = (part.reshape(len(job.X), -1) for part in job.model.predict(job.X, return_std=True))
            y = job.y.reshape(mean.shape)
            # Constants have no standard deviation.
            unit = np.where((size := y.std(axis=0)) > 1e-12 * np.abs(y).max(axis=0), size, 1.0)
            exact = isinstance(job.model, EGPRegressor)
            bound = job.model.log_marginal_likelihood_value_ if exact else job.model.lower_bound_
            row["bound"] = float(bound) / np.size(job.rows["y"])
            row["rmse"] = float(np.sqrt(np.mean(((mean - y) / unit) ** 2)))
            row["nlpd"] = float(negative_log_predictive_density(y / unit, mean / unit, std / unit))
        except Exception as error:
            row["failure"] = f"{type(error).__name__}: {error}"[:120].replace("\n", " ")
            if not isinstance(error, (ValueError, ArithmeticError, np.linalg.LinAlgError)):
                traceback.print_exc()
    row["warning"] = " | ".join(sorted({str(one.message)[:30].replace("\n", " ") for one in told}))
    return row


def cells(names: list[str], problems: list[str], seeds: list[int]) -> list[tuple[str, str, int]]:
    """The cells in the order of their runs: the first seed of everything comes first."""
    found = []
    for seed in seeds:
        for rule in ["none", *names]:
            wanted = set() if rule == "none" else set(RULES_OFF[rule].tags.split())
            found += [
                (rule, name, seed) for name in problems if not wanted or wanted & set(PROBLEMS[name].tags.split())
            ]
    return found


def run(options: argparse.Namespace) -> None:
    known = set()
    if CSV.exists():
        known = {tuple(key) for key in pd.read_csv(CSV)[["rule", "problem", "seed"]].itertuples(index=False)}
    for rule, name, seed in cells(options.rules, options.problems, list(range(options.seeds))):
        if (rule, name, seed) in known:
            continue
        try:
            with threadpool_limits(1):
                row = measured(rule, name, seed)
        except NoSuchRuleError as error:
            print(f"{rule}: {error}", flush=True)
            continue
        pd.DataFrame([row], columns=COLUMNS).to_csv(CSV, mode="a", header=not CSV.exists(), index=False)
        print(*(row.get(column) for column in COLUMNS[:-1]), flush=True)


def table(frame: pd.DataFrame) -> pd.DataFrame:
    """The worst effects of each rule's absence, and how often nothing changed."""
    key = ["problem", "seed"]
    frame = frame.assign(failure=frame.failure.fillna("").astype(str), warning=frame.warning.fillna("").astype(str))
    with_rules = frame[frame.rule == "none"].set_index(key)
    lines = []
    for rule in dict.fromkeys(frame.rule):
        if rule == "none":
            continue
        own = frame[frame.rule == rule].set_index(key)
        base_line = with_rules.loc[own.index.intersection(with_rules.index)]
        own = own.loc[base_line.index]
        loss = (base_line.bound - own.bound).fillna(0.0)
        # Errors at rounding level do not count.
        ratio = (np.maximum(own.rmse, 1e-6) / np.maximum(base_line.rmse, 1e-6)).fillna(1.0)
        nlpd = (own.nlpd - base_line.nlpd).fillna(0.0)
        changed = (abs(loss) > 1e-9) | (abs(ratio - 1.0) > 1e-9) | (abs(nlpd) > 1e-9)
        new_warning = own.warning != base_line.warning
        failed = (own.failure != "") & (base_line.failure == "")

        def shown(values: pd.Series, form: str) -> str:
            where = values.idxmax()
            return f"{format(values.max(), form)} {where[0]}" if len(values) else ""

        harmed = (loss > 0.01) | (ratio > 1.01) | (nlpd > 0.01) | failed
        helped = (loss < -0.01) | (ratio < 1.0 / 1.01) | (nlpd < -0.01)
        lines.append(
            {
                "rule": f"{rule} (deleted)" if rule in DELETED else rule,
                "runs": len(own),
                "changed": int(changed.sum()),
                "worse": int(harmed.sum()),
                "better": int(helped.sum()),
                "bound": shown(loss, ".3f"),
                "rmse": shown(ratio, ".3f"),
                "nlpd": shown(nlpd, ".3f"),
                # Over all runs, without the tails.
                "mean loss": round(float(loss.clip(-1.0, 1.0).mean()), 4),
                "mean rmse": round(float(np.exp(np.log(ratio).clip(-1.0, 1.0).mean())), 4),
                "time": round(own.seconds.sum() / max(base_line.seconds.sum(), 1e-9), 2),
                "failures": int(failed.sum()),
                "warnings": int(np.sum(new_warning)),
            }
        )
    return pd.DataFrame(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", action="store_true", help="print the worst effects of each rule")
    parser.add_argument("--rules", nargs="+", choices=list(RULES_OFF), default=list(RULES_OFF))
    parser.add_argument("--problems", nargs="+", choices=list(PROBLEMS), default=list(PROBLEMS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--data", type=Path, default=DATA, help="a folder with a folder uci")
    parser.add_argument("--output", type=Path, default=CSV, help="the CSV; default: in benchmarks/results")
    options = parser.parse_args()
    if options.table:
        with pd.option_context("display.width", 250, "display.max_rows", None, "display.max_columns", None):
            print(table(pd.read_csv(options.output)).to_string(index=False))
        return
    globals().update(DATA=options.data, CSV=options.output)
    run(options)


if __name__ == "__main__":
    main()
