"""What belongs to the process is as it was, whatever is done: fits, failures, predictions, files, pictures."""

import gc
import locale
import logging
import os
import random
import signal
import sys
import threading
import warnings

import casadi  # noqa: F401  what its import changes is not ours
import numpy as np
import pinocchio  # noqa: F401
import pytest
import sklearn
from matplotlib import pyplot
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_info

from skevgp import rollout
from skevgp.io import load, save
from skevgp.solvers import LBFGS, Adam

from .test_determinism import OTHERS, THREADED, X_NEW, X, Y, evgp

pytestmark = [
    pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning"),
    pytest.mark.filterwarnings("ignore::skevgp.exceptions.DependentRowsWarning"),
]


def state():
    """Of the process, all that a library could change unseen."""
    root = logging.getLogger()
    return {
        "floating-point errors": (np.geterr(), np.geterrcall()),
        "printing": np.get_printoptions(),
        "numpy.random": str(np.random.get_state(legacy=False)),  # noqa: NPY002
        "random": random.getstate(),
        "threads of libraries": [(own["filepath"], own["num_threads"]) for own in threadpool_info()],
        "threads": sorted(thread.name for thread in threading.enumerate()),
        "filters of warnings": list(warnings.filters),
        "showwarning": warnings.showwarning,
        "environment": {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")},
        "directory": os.getcwd(),
        "logging": (root.level, list(root.handlers), logging.root.manager.disable, logging.raiseExceptions),
        "style": dict(pyplot.rcParams),
        "figures": pyplot.get_fignums(),
        "scikit-learn": sklearn.get_config(),
        "Ctrl-C": signal.getsignal(signal.SIGINT),
        "interpreter": (sys.getrecursionlimit(), sys.getswitchinterval(), gc.isenabled(), sys.excepthook),
        "output": (sys.stdout, sys.stderr, sys.displayhook),
        "locale": locale.setlocale(locale.LC_ALL),
    }


@pytest.fixture(autouse=True)
def _as_it_was():
    """The test changes nothing; values are other than usual, so that one that is set back to a default is seen too."""
    pyplot.close("all")
    with np.errstate(invalid="print"), np.printoptions(precision=5):
        np.random.seed(7)  # noqa: NPY002
        random.seed(7)
        before = state()
        yield
        after = state()
    for name, value in before.items():
        assert after[name] == value, name


def interrupt(*told):
    raise KeyboardInterrupt


@pytest.mark.parametrize("name", ["auto", "all", "kernel", "none", "student-t", "adam", "natural", *OTHERS])
def test_fits_and_predictions(name):
    model = clone((THREADED | OTHERS)[name])
    if name in THREADED:
        model.set_params(n_jobs=2, max_iter=1)
    model.fit(X[:30], Y[:30])
    model.predict(X_NEW, return_std=True)
    model.sample_y(X_NEW)
    rollout(model, X_NEW[0], np.empty((3, 0)), n_samples=3, random_state=2)
    if hasattr(model, "partial_fit"):
        model.partial_fit(X_NEW, Y[:9])
    if hasattr(model, "lower_bound_"):
        model.value_and_jacobian(X_NEW)
        model.compile().predict(X_NEW)
        model.sample_functions(1, n_waves=9)(X_NEW)
    repr(model)
    model._repr_html_()


@pytest.mark.parametrize("solver", [LBFGS(callback=interrupt), Adam(callback=interrupt)])
@pytest.mark.parametrize("n_jobs", [1, 2])
def test_interrupted_fits(solver, n_jobs):
    with pytest.warns(ConvergenceWarning, match="interrupted"):
        evgp(solver=solver, n_jobs=n_jobs, sharing="none").fit(X, Y)


def test_files(tmp_path):
    for name in ("all", "exact", "network", "residual"):
        save(clone((THREADED | OTHERS)[name]).fit(X[:30], Y[:30, :2]), tmp_path / "model")
        load(tmp_path / "model").predict(X_NEW)
    (tmp_path / "model").write_bytes(b"no model")
    with pytest.raises(ValueError, match="cannot be loaded"):
        load(tmp_path / "model")


def test_exports(tmp_path):
    model = clone(THREADED["all"]).fit(X, Y)
    model.to_casadi()(X_NEW[0])
    model.to_c(tmp_path)
