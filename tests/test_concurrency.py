"""Threads that use one estimator, or fit several at once, get what they would get alone."""

import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, Event

import numpy as np
import pytest
from sklearn.base import clone

from skevgp import rollout
from skevgp.exceptions import ignored
from skevgp.io import load, save

from .test_determinism import OTHERS, THREADED, X_NEW, X, Y, assert_same, said_by

of_fits = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
N_THREADS = 16
_CALM = sys.getswitchinterval()


@pytest.fixture(autouse=True)
def _calm():
    yield
    sys.setswitchinterval(_CALM)


def at_once(jobs):
    """Results of functions that begin together, each in a thread; threads then change as often as they can.

    (Not before all are there: those that begin are given coverage's tracer one by one.)
    """
    sys.setswitchinterval(_CALM)
    barrier = Barrier(len(jobs), action=lambda: sys.setswitchinterval(1e-6))

    def one(job):
        barrier.wait(60.0)
        return job()

    with ThreadPoolExecutor(len(jobs)) as pool:
        return list(pool.map(one, jobs))


def asked(model):
    """What users ask of one model, each by its name."""
    found = {
        "mean": lambda: model.predict(X_NEW),
        "std": lambda: model.predict(X_NEW, return_std=True)[1],
        "one row": lambda: model.predict(X_NEW[:1]),
        "samples": lambda: model.sample_y(X_NEW, 2, random_state=1),
        "rollout": lambda: rollout(model, X_NEW[0], np.empty((3, 0)), n_samples=3, random_state=2).samples,
    }
    if hasattr(model, "inducing_points_"):
        found |= {
            "bound": lambda: model.lower_bound_,
            "upper bound": lambda: model.upper_bound_,
            "covariance": lambda: model.predict(X_NEW, return_cov=True)[1],
            "slopes": lambda: np.concatenate(model.value_and_jacobian(X_NEW), axis=None),
            "compiled": lambda: model.compile().predict(X_NEW),
            "novelty": lambda: model.novelty(X_NEW),
            "functions": lambda: np.array(model.sample_functions(1, 0, n_waves=9)(X_NEW)),
        }
    return found


@of_fits
@pytest.mark.parametrize("name", ["groups", "shared weights", "exact", "residual"])
def test_predictions_from_many_threads_agree(name, tmp_path):
    """The first time that something is asked, too: copies have computed nothing yet."""
    model = clone((THREADED | OTHERS)[name])
    if name in THREADED:
        model.set_params(noise_cv=None, max_iter=1)
    model.fit(X[:30], Y[:30])
    if hasattr(model, "partial_fit") and name != "network":
        model.partial_fit(X_NEW, Y[:9])
    save(model, tmp_path / "model")
    copy, expected = load(tmp_path / "model"), {which: job() for which, job in asked(model).items()}
    jobs = [*asked(copy).items()] * N_THREADS
    for first in range(0, len(jobs), N_THREADS):
        some = jobs[first : first + N_THREADS]
        for (which, _), found in zip(some, at_once([job for _, job in some]), strict=True):
            np.testing.assert_array_equal(found, expected[which], err_msg=which)


@of_fits
@pytest.mark.long
def test_fits_at_once_are_the_fits_one_after_the_other():
    models = [THREADED[name] for name in ("auto", "none", "student-t", "adam", "natural")] + [*OTHERS.values()]
    expected = [said_by(clone(model).fit(X, Y)) for model in models]
    for found, own in zip(at_once([lambda m=m: said_by(clone(m).fit(X, Y)) for m in models]), expected, strict=True):
        assert_same(found, own)


# --- warnings: their filters are the process's -----------------------------------------------------------------------


def test_two_threads_that_ignore_warnings_leave_the_filters_as_they_were():
    """Whoever comes first leaves first; without a lock he would take away the other's filters, and get them back."""
    first_is_in, first_is_out, second_is_in = Event(), Event(), Event()

    def first():
        with ignored("anything"):
            first_is_in.set()
            second_is_in.wait(0.5)
        first_is_out.set()

    def second():
        assert first_is_in.wait(60.0)
        with ignored("anything else"):
            second_is_in.set()
            assert first_is_out.wait(60.0)

    before = list(warnings.filters)
    at_once([first, second])
    assert warnings.filters == before
