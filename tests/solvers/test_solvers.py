"""The solvers as records of options: what they take, what they refuse, what their callbacks are told."""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning

from skevgp import EVGPRegressor
from skevgp.solvers import LBFGS, SOLVERS, Adam, as_solver

RNG = np.random.RandomState(0)
X = RNG.uniform(-2, 2, (80, 2))
Y = np.column_stack([np.sin(2 * X[:, 0]) + X[:, 1], np.cos(X[:, 1]) * X[:, 0]]) + 0.05 * RNG.randn(80, 2)

few_iterations = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def model(**arguments):
    return EVGPRegressor(**{"n_inducing": 10, "sharing": "all", "max_iter": 5, "random_state": 0, **arguments})


# --- records of options --------------------------------------------------------------------------------------------


def test_options_are_reached_through_the_estimator():
    m = model(solver=Adam(batch_size=7))
    assert m.get_params()["solver__batch_size"] == 7
    m.set_params(solver__batch_size=9, solver__learning_rate=0.3)
    assert (m.solver.batch_size, m.solver.learning_rate) == (9, 0.3)
    assert clone(m).solver.get_params() == m.solver.get_params()
    assert clone(m).solver is not m.solver


# --- names ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["sgd", "LBFGS", None, 3, LBFGS, {"n_restarts": 2}], ids=str)
def test_invalid_solver_raises(solver):
    with pytest.raises(ValueError, match="solver must be one of .*; got ") as caught:
        as_solver(solver)
    for name, kind in SOLVERS.items():
        assert f'"{name}"' in str(caught.value)
        assert f"skevgp.solvers.{kind.__name__}(...)" in str(caught.value)
    with pytest.raises((ValueError, TypeError), match="solver"):
        model(solver=solver).fit(X, Y)


# --- options out of range ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("solver", "error", "message"),
    [
        (LBFGS(n_restarts=-1), ValueError, "n_restarts of LBFGS must be at least 0; got -1"),
        (LBFGS(n_restarts=1.5), TypeError, "n_restarts of LBFGS must be an integer; got 1.5"),
        (LBFGS(callback="print"), TypeError, "callback of LBFGS must be None or a function; got 'print'"),
        (Adam(n_restarts=True), TypeError, "n_restarts of Adam must be an integer; got True"),
        (Adam(batch_size=0), ValueError, "batch_size of Adam must be at least 1; got 0"),
        (Adam(batch_size="all"), TypeError, "batch_size of Adam must be an integer; got 'all'"),
        (Adam(learning_rate=0.0), ValueError, "learning_rate of Adam must be finite and above 0.0; got 0.0"),
        (Adam(learning_rate=np.nan), ValueError, "learning_rate of Adam must be finite and above 0.0; got nan"),
        (Adam(schedule="linear"), ValueError, 'schedule of Adam must be "cosine" or "constant"; got \'linear\''),
        (Adam(learning_rate="fast"), TypeError, "learning_rate of Adam must be a number; got 'fast'"),
        (Adam(natural_gradient=1), TypeError, "natural_gradient of Adam must be True or False; got 1"),
    ],
    ids=str,
)
def test_option_out_of_range_raises(solver, error, message):
    with pytest.raises(error, match=message):
        as_solver(solver)
    with pytest.raises(error, match=message):
        model(solver=solver).fit(X, Y)


def test_natural_gradients_need_the_full_posterior():
    with pytest.raises(ValueError, match=r'natural_gradient=True of Adam needs posterior="full"; got posterior='):
        model(solver=Adam(natural_gradient=True, posterior="diagonal")).fit(X, Y)


# --- subclasses ----------------------------------------------------------------------------------------------------


@few_iterations
def test_subclass_may_look_at_each_evaluation():
    seen = []

    class Watched(LBFGS):
        def minimise(self, objective, start, *others):
            def watched(x):
                seen.append(len(x))
                return objective(x)

            return super().minimise(watched, start, *others)

    m = model(solver=Watched(n_restarts=1), inducing_init="k-means").fit(X, Y)
    assert len(seen) >= m.n_iter_
    assert set(seen) == {2 + 2 * 2 + 10 * 2}
    np.testing.assert_array_equal(
        m.predict(X), model(solver=LBFGS(n_restarts=1), inducing_init="k-means").fit(X, Y).predict(X)
    )
    assert clone(Watched(n_restarts=3)).n_restarts == 3


# --- callbacks -----------------------------------------------------------------------------------------------------


def told(sharing, solver, n_jobs=None, y=Y, **arguments):
    """What a callback is told, and the fitted model."""
    calls = []
    m = model(
        sharing=sharing, solver=solver(callback=lambda *what: calls.append(what)), n_jobs=n_jobs, **arguments
    ).fit(X, y)
    return calls, m


@few_iterations
@pytest.mark.parametrize("max_iter", [0, 1, 7])
@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)
def test_no_solver_overruns_max_iter(solver, max_iter):
    """Of one start. All rows are few, so that no iteration is one of a sample."""
    fitted = model(solver=solver(), max_iter=max_iter).fit(X, Y)
    assert fitted.n_iter_ == len(fitted.loss_curve_) == max_iter


@few_iterations
@pytest.mark.parametrize("sharing", ["all", "kernel"])
@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)
def test_callback_is_told_each_iteration_and_bound(solver, sharing):
    calls, m = told(sharing, solver)
    assert [iteration for iteration, _, _ in calls] == list(range(1, m.n_iter_ + 1))
    assert {outputs for _, _, outputs in calls} == {range(0, 2)}
    np.testing.assert_allclose([-bound for _, bound, _ in calls], m.loss_curve_, rtol=1e-10)


# --- what Adam keeps -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)
def test_stop_iteration_of_the_callback_ends_the_fit_with_the_best_so_far(solver):
    seen = []

    def stop(iteration, bound, outputs):
        seen.append(iteration)
        if iteration == 4:
            raise StopIteration

    with pytest.warns(ConvergenceWarning, match="interrupted after 4 iterations"):
        model = EVGPRegressor(n_inducing=5, solver=solver(callback=stop), random_state=0).fit(X, Y)
    assert seen == [1, 2, 3, 4]
    assert np.isfinite(model.predict(X)).all()
