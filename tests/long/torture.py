"""Random fits of all estimators to data with several kinds of nastiness at once (`tests.nasty`).

Each must end with finite predictions and std > 0, or be refused by a ValueError or TypeError with a message of the
library's or of scikit-learn's validation, if it has something to refuse; without warnings of NumPy's. A fit with
L-BFGS that says it has ended must have a bound not below that of features and noise alone (`tests.alone`).

    python -m tests.long.torture --fits 10000 --seed 0

takes about 40 minutes of one core. ``--seed`` is the first case's number: case 5000 is the same with ``--fits 10000
--seed 0`` and ``--fits 1 --seed 5000``, so that a long search can be cut into pieces, and a defect looked at by itself.
"""

import argparse
import re
import time
import traceback
import warnings
from collections import Counter

import numpy as np
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning

from skevgp import EGPRegressor, EVGPRegressor
from skevgp.exceptions import DependentRowsWarning
from skevgp.solvers import LBFGS
from tests.alone import alone
from tests.nasty import MapError, random_case

OUTCOMES = ("fitted", "below, and told", "refused", "defect")
# L-BFGS stops where it gains less than 0.0015 % of what it has gained, and 0.01 nats; rounding at offsets of 1e8.
SLACK, SHARE = 0.1, 1e-4

# In sums of products other rows are lost beside one that counts so many times more.
RANGE = 1e12
# What a feature may add to a bound, and to what is left over, if rounding leaves of its precision but the order.
_DEPENDENT, _LEFT_OVER = 2.0, 0.02
# Frames that may speak for the library: a message from elsewhere is not one that names an argument.
SPEAKERS = ("skevgp", "sklearn", "tests.nasty")
# Warnings that users are to see.
KNOWN = (ConvergenceWarning, DependentRowsWarning)
KNOWN_WORDS = (
    "X does not have valid feature names",
    "X has feature names",
    "Skipping features without any observed values",
    "Object dtype",
)


class DefectError(Exception):
    """What must not be."""


def run_case(case):
    """How it ended: "fitted", "below, and told" or "refused"; anything else raises a DefectError."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            outcome = _fit_and_ask(case, told)
        except DefectError:
            raise
        except Exception as error:
            outcome = _refusal(case, error)
    for each in told:
        # StandardScaler's weighted variance of a constant column may be rounded below 0.
        if "sklearn" in each.filename and "in sqrt" in str(each.message):
            continue
        if not issubclass(each.category, KNOWN) and not any(words in str(each.message) for words in KNOWN_WORDS):
            raise DefectError(f"warned {each.category.__name__}: {each.message} ({each.filename}:{each.lineno})")
    return outcome


def _refusal(case, error):
    frames = traceback.extract_tb(error.__traceback__)
    where = f"{frames[-1].filename}:{frames[-1].lineno}"
    if isinstance(error, MapError) and any("raises" in name for name in case.names):
        return "refused"
    if type(error) not in (ValueError, TypeError):
        raise DefectError(f"raised {type(error).__name__}: {error} ({where})") from error
    if not any(re.search(message, str(error)) for message in case.refusals):
        raise DefectError(f"refused, for no reason known: {type(error).__name__}: {error} ({where})") from error
    module = error.__traceback__
    while module.tb_next is not None:
        module = module.tb_next
    speaker = module.tb_frame.f_globals.get("__name__", "")
    if not speaker.startswith(SPEAKERS) and "could not convert" not in str(error):
        raise DefectError(f"refused from the depths of {speaker}: {type(error).__name__}: {error}") from error
    return "refused"


def _fit_and_ask(case, told):
    model = case.model.fit(case.X, case.y, **case.fit)
    if case.must and not case.late:
        raise DefectError(f"fitted, but was to be refused: {case.refusals}")
    _check_predictions(model, case.rows)
    if case.must:
        raise DefectError(f"predicted, but was to be refused: {case.refusals}")
    outcome = "fitted"
    if isinstance(model, EVGPRegressor | EGPRegressor):
        outcome = _check_bound(case, model, told)
        _check_more(model, case)
    if case.more is not None and hasattr(model, "partial_fit"):
        X, y = case.more
        model.partial_fit(X, y)
        _check_predictions(model, case.rows)
        _check_predictions(model, X)
    return outcome


def _rows(X, n):
    return X.iloc[:n] if hasattr(X, "iloc") else X[:n]


def _check_predictions(model, rows):
    mean, std = model.predict(rows, return_std=True)
    for name, values in (("mean", mean), ("std", std)):
        if not np.isfinite(values).all():
            raise DefectError(f"predict returned a {name} that is not finite")
    if not (std > 0.0).all():
        raise DefectError(f"predict returned a std of {std.min()}")
    alone = model.predict(_rows(rows, 1))
    if not np.isfinite(alone).all():
        raise DefectError("predict of a row is not finite")


def _check_more(model, case):
    """What else the Gaussian processes are asked for."""
    few = _rows(case.rows, 3)
    for name, values in {
        "cov": model.predict(few, return_cov=True)[1],
        "samples": model.sample_y(few, 2),
        "std without noise": model.predict(few, return_std=True, include_noise=False)[1],
        "noise variance": model.noise_variance_,
        **({"coef": model.coef_, "coef_std": model.coef_std_} if model.feature_map_ is not None else {}),
    }.items():
        if not np.isfinite(values).all():
            raise DefectError(f"{name} is not finite")
    if not (np.asarray(model.noise_variance_) > 0.0).all():
        raise DefectError(f"noise variance {model.noise_variance_}")
    floats = isinstance(few, np.ndarray) and few.dtype == np.float64
    if floats and not np.isfinite(model.jacobian(few)).all():
        raise DefectError("the Jacobian is not finite")


def _check_bound(case, model, told):
    exact = isinstance(model, EGPRegressor)
    bound = model.log_marginal_likelihood_value_ if exact else model.lower_bound_
    if not np.isfinite(bound):
        raise DefectError(f"the bound is {bound}")
    if exact and getattr(model.coef_prior, "scale", None) is not np.inf:
        comparable = model.optimizer is not None
    elif exact:
        comparable = False
    else:
        if np.isnan(model.upper_bound_) or (
            isinstance(model.solver, LBFGS)
            and model.solver.n_restarts == 0
            and _weighs(case, model) <= RANGE
            and model.upper_bound_ < bound - 1e-5 * abs(bound) - 1e-3 - _hidden_nats(model, bound, case.X, case.y)
        ):
            raise DefectError(f"the upper bound {model.upper_bound_} is below the lower one {bound}")
        comparable = (
            isinstance(model.solver, LBFGS)
            and model.solver.posterior == "full"
            and model.noise != "student-t"
            and getattr(model.noise, "inputs", None) is None
        )
    shared, asked = model._fitted.units.prior.shared, model.max_iter != 0
    if not (comparable and asked) or shared or _weighs(case, model) > RANGE:
        return "fitted"
    # What noise_cv does afterwards is not for the bound's sake; nor is each iterate the best point of its line search.
    reached, floor = max([bound, *(-model.loss_curve_[-1:])]), alone(model, case.X, case.y, **_weights(case))
    least = floor - SLACK - SHARE * abs(floor)
    if reached < least and not len(model.loss_curve_) and getattr(model, "noise_cv", None) is not None:
        # It ended where it started, and left no curve.
        reached = clone(model).set_params(noise_cv=None).fit(case.X, case.y, **case.fit).lower_bound_
    if reached >= least:
        return "fitted"
    if any("still rising" in str(each.message) or "rounding errors" in str(each.message) for each in told):
        return "below, and told"
    raise DefectError(f"the bound {reached:.3f} is below {floor:.3f}, that of features and noise alone")


def _weighs(case, model):
    """How many times more the row counts that counts the most than that which counts the least; of shared weights, the
    rows of all outputs.
    """
    weight, variance = (np.asarray(case.fit.get(name, 1.0)) for name in ("sample_weight", "relative_variance"))
    precision = weight / variance
    noise = model.noise_variance_ if model._fitted.units.prior.shared else 1.0
    return precision.max() / precision[precision > 0.0].min() * np.max(noise) / np.min(noise)


def _hidden_nats(model, bound, X, y):
    """What rounding, and a jitter of K, may add to a bound where there is next to no noise."""
    nats = (_DEPENDENT + _LEFT_OVER * abs(bound)) * _dependent(model, X)
    y = np.asarray(y, dtype=float).reshape(len(X), -1)
    # Targets are known to their last digit, and what is left over of them no better.
    nats += 0.5 * np.sum((np.finfo(float).eps * y) ** 2 / model.noise_variance_)
    for one in model._fitted.models:
        if one.sparse.complete:
            # The eigenvalues of what a jitter j leaves of K are no larger than j times the rows that are the same.
            m = one.values["inducing_points"].shape[1]
            left = max(group.whitening.jitter() for group in one.predictor.groups) * (len(X) - m + 1)
            nats += 0.5 * m * np.log1p(one.values["signal"] / one.values["noise"] * left).sum()
    return nats


def _dependent(model, X):
    """How many features depend on others up to rounding: sums of products do not see that they differ."""
    if model.feature_map_ is None:
        return 0
    H = model.feature_map_.transform(X if hasattr(X, "columns") else np.asarray(X, dtype=float))
    H = np.asarray(H.toarray() if hasattr(H, "toarray") else H, dtype=float)
    lengths = np.linalg.norm(H, axis=0)
    H = H[:, lengths > 0.0] / lengths[lengths > 0.0]
    return H.shape[1] - int((np.linalg.svd(H, compute_uv=False) > 1e-7).sum())


def _weights(case):
    return {name: values for name, values in case.fit.items() if name != "groups"}


def run(numbers, tell=None):
    """Counts of outcomes by estimator, the defects, and the longest times that cases took."""
    counts, defects, longest = Counter(), [], []
    for number in numbers:
        case = random_case(number)
        about = f"{number}: {type(case.model).__name__} {' '.join(case.names)}"
        start = time.perf_counter()
        try:
            outcome = run_case(case)
        except DefectError as defect:
            outcome = "defect"
            defects.append(f"{about}: {str(defect)[:400]}")
            if tell:
                tell(defects[-1])
        longest = sorted([*longest, (time.perf_counter() - start, about)])[-5:]
        counts[type(case.model).__name__, outcome] += 1
        if tell and (number + 1) % 250 == 0:
            total = {outcome: sum(counts[own] for own in counts if own[1] == outcome) for outcome in OUTCOMES}
            tell(f"... up to {number}: " + ", ".join(f"{n} {outcome}" for outcome, n in total.items()))
    return counts, defects, longest


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    start = time.perf_counter()
    counts, defects, longest = run(
        range(options.seed, options.seed + options.fits), lambda line: print(line, flush=True)
    )
    print(f"{'':24}" + "".join(f"{each:>17}" for each in OUTCOMES))
    for kind in sorted({kind for kind, _ in counts}):
        print(f"{kind:24}" + "".join(f"{counts[kind, each]:17}" for each in OUTCOMES))
    print(f"{'all':24}" + "".join(f"{sum(counts[k, e] for k, e in counts if e == each):17}" for each in OUTCOMES))
    print(f"{time.perf_counter() - start:.0f} s in all; the longest:")
    for seconds, about in longest:
        print(f"  {seconds:.1f} s  {about}")
    raise SystemExit(bool(defects))


if __name__ == "__main__":
    main()
